"""The model card: what a checkpoint is, was trained on, reaches and asks of its data, from its own description."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from worldline_core.data.curation.source_table import read_source_table
from worldline_core.model.checkpoint import CheckpointInfo
from worldline_core.store.artifact_files import read_manifest

_KINDS = {
    "base": "base model that Stage I starts from",
    "stage1": "Stage I model: a first frame and a text to video of one view",
    "stage2": "Stage II model: first frames and controls to video of all views, a clip at once",
    "causal": "causal model: first frames and controls to video of all views, block by block in a few steps",
}
UNKNOWN = "not stated"


def model_card(info: CheckpointInfo, manifest: Mapping[str, Any], license_name: str | None = None) -> str:
    """The card as Markdown, with the header that the hub reads.

    Args:
        manifest: of the step that trained it; an empty one leaves out what it would say.
        license_name: of the weights; nothing is claimed where it is not given.
    """
    header = {"library_name": "worldline", "tags": ["robotics", "world-model", "image-to-video"]}
    header |= {"license": license_name} if license_name else {}
    sections = [
        f"---\n{yaml.safe_dump(header, sort_keys=True)}---",
        f"# WorldLine {info.kind}\n\nA {_KINDS[info.kind]}.",
        _usage(info),
        "## Trained on\n\n" + "\n".join(_training(info, manifest)),
        "## Reached\n\n" + ("\n".join(_metrics(info, manifest)) or f"Metrics: {UNKNOWN}."),
        "## Contract\n\nData that contradict it are refused by name before the first step.\n\n" + "\n".join(_contract(info)),
        f"## Licence\n\nOf the weights: {license_name or UNKNOWN}. The licences of what it was trained on hold as well.",
    ]  # fmt: skip
    return "\n\n".join(sections) + "\n"


def write_model_card(folder: Path, info: CheckpointInfo, license_name: str | None = None) -> Path:
    """Write the card of a finished checkpoint folder to its ``run/card``, which is no part of its digest."""
    path = folder / "run" / "card" / "README.md"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(model_card(info, manifest_with_sources(folder), license_name), encoding="utf-8")
    return path


def manifest_with_sources(folder: Path) -> dict[str, Any]:
    """A folder's manifest, with ``sources``: licence by source of the recordings that it was trained on, where they are."""
    manifest = read_manifest(folder)
    found = manifest.get("inputs", {}).get("episodes", {}).get("path")
    store = folder.resolve().parent.parent
    for _ in range(2):  # a filtered set points to the curated one, which has the table
        episodes = None if found is None else (store / found).resolve()
        # A manifest that came with the weights may name any place: only the store that the folder lies in is read.
        if episodes is None or not episodes.is_relative_to(store) or not episodes.is_dir():
            break
        if table := read_source_table(episodes):
            manifest["sources"] = {source.label: source.license for source in table}
            break
        found = read_manifest(episodes).get("inputs", {}).get("episodes", {}).get("path")
    return manifest


def _usage(info: CheckpointInfo) -> str:
    name = "WorldLine" if info.kind in ("stage2", "causal") else "WorldModel"
    return f'```python\nfrom worldline_core import {name}\n\nmodel = {name}.from_pretrained("FOLDER or ORG/NAME")\n```'


def _training(info: CheckpointInfo, manifest: Mapping[str, Any]) -> Iterator[str]:
    facts = info.metadata
    licences = manifest.get("sources", {})
    yield f"- episodes: {facts.get('episodes', UNKNOWN)}"
    for source, count in facts.get("sources", {}).items():
        yield f"- source {source}: {count} episodes, licence {licences.get(source, UNKNOWN)}"
    for source in sorted(licences.keys() - facts.get("sources", {}).keys()):
        yield f"- source {source}: licence {licences[source]}"
    yield f"- steps: {facts.get('step', UNKNOWN)}, seed {facts.get('seed', UNKNOWN)}"
    if "start" in facts:
        yield f"- from: {json.dumps(facts['start'], sort_keys=True)}"
    environment = manifest.get("environment", {})
    if environment:
        packages = ", ".join(f"{name} {version}" for name, version in sorted(environment.get("packages", {}).items()))
        yield f"- made by: step {manifest.get('step')} version {manifest.get('version')}, {packages}"


def _metrics(info: CheckpointInfo, manifest: Mapping[str, Any]) -> Iterator[str]:
    found = info.metadata.get("metrics") or manifest.get("metrics", {})
    for name, value in sorted(found.items()):
        if isinstance(value, int | float):
            yield f"- {name}: {value:.4g}"


def _contract(info: CheckpointInfo) -> Iterator[str]:
    if info.action_contract is None:
        yield "- takes no controls"
    else:
        for name, value in info.action_contract.model_dump(mode="json").items():
            yield f"- {name}: {json.dumps(value)}"
    if info.causal is not None:
        yield f"- causal: {json.dumps(info.causal.model_dump(mode='json'))}"
    yield f"- views: {', '.join(info.views)}; strides: {', '.join(map(str, info.strides))}"
    yield f"- weights: {info.dtype}, sha256 {info.weights_sha256}"
