"""Model cards, written from a model's own files: its shape, its training, its contract, and what evaluations measured."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite, prod
from pathlib import Path
from typing import Any

from safetensors import safe_open

from worldline_core.data.curation.source_table import read_source_table
from worldline_core.errors import CheckpointError
from worldline_core.model.checkpoint import DESCRIPTION, CheckpointInfo, read_checkpoint_info
from worldline_core.store.artifact_files import read_json, read_manifest, verify_artifact

UNKNOWN = "not stated"
DESCRIPTIONS = (DESCRIPTION, "tokenizer.json", "segmenter.json", "judge.json", "teacher.json")
"""Files that describe a model, one in each folder of weights."""


@dataclass(frozen=True)
class Measurement:
    """A figure of a finished evaluation: its 95 % interval over `count` recordings or banks, and the artifact that holds it."""

    what: str
    recordings: str
    mean: float
    low: float
    high: float
    count: int
    source: str


def model_facts(folder: Path) -> dict[str, str]:
    """Kind, parameters, resolution, rate and training of a model: what its files state, in words.

    Raises:
        CheckpointError: the folder holds no model.
    """
    name = next((name for name in DESCRIPTIONS if (folder / name).is_file()), None)
    if name is None:
        raise CheckpointError("No model here", where=folder, expected=" or ".join(DESCRIPTIONS))
    described, metrics = read_json(folder / name), read_manifest(folder).get("metrics", {})
    noted = described.get("metadata") or described
    run = {**noted, **noted.get("run", {})}
    parameters = sum(_count(path) for path in folder.glob("*.safetensors"))
    facts = {"kind": described.get("kind") or name.removesuffix(".json"), "parameters": f"{parameters / 1e6:.2f} M"}
    if name == DESCRIPTION:
        facts |= _checkpoint_facts(read_checkpoint_info(folder))
    elif size := described.get("shape", {}).get("image_size"):
        facts["pixels"] = "\u00a0x\u00a0".join(map(str, size))
    names = {
        "training recordings": ("episodes", "training_episodes"), "clips": ("clips",), "steps": ("step", "steps"),
        "training seconds": ("seconds",),
    }  # fmt: skip
    for name, keys in names.items():
        values = [run.get(key) for key in keys] + ([metrics.get("kept")] if "recordings" in name else [])
        if number := next((value for value in values if type(value) in (int, float)), None):
            facts[name] = f"{number:,}".replace(",", "\u202f")
    return facts


def _count(path: Path) -> int:
    with safe_open(path, framework="numpy") as weights:
        return sum(prod(weights.get_slice(name).get_shape()) for name in weights.keys())  # noqa: SIM118  # no mapping


def _checkpoint_facts(info: CheckpointInfo) -> dict[str, str]:
    facts = {"views": ", ".join(info.views).replace("_", " ")}
    if (contract := info.action_contract) is not None:
        height, width = (info.config.spatial_compression * cells for cells in contract.grid_size)
        facts |= {"pixels": f"{height}\u00a0x\u00a0{width}", "frames a second": f"{contract.fps:g}"}
    if (causal := info.causal) is not None:
        facts["steps of a block"] = str(len(causal.sigmas) - 1)
    return facts


def write_model_card(
    folder: Path, output: Path, measured: Sequence[Measurement] = (), license_name: str | None = None
) -> Path:
    """Write the card of a finished checkpoint to ``output/README.md``; equal artifacts give equal bytes.

    Args:
        measured: what evaluations of the model found.
        license_name: of the weights, as the hub writes it.

    Raises:
        ArtifactError: the checkpoint is damaged.
    """
    verify_artifact(folder)
    path = output / "README.md"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(model_card(folder, measured, license_name), encoding="utf-8")
    return path


def model_card(folder: Path, measured: Sequence[Measurement] = (), license_name: str | None = None) -> str:
    """The card of a checkpoint in the hub's form."""
    from huggingface_hub import EvalResult, ModelCard, ModelCardData

    info, manifest = read_checkpoint_info(folder), _manifest_with_sources(folder)
    reached = info.metadata.get("metrics") or manifest.get("metrics", {})
    finite = {name: value for name, value in sorted(reached.items()) if type(value) in (int, float) and isfinite(value)}
    losses = {name: value for name, value in finite.items() if "loss" in name or "error" in name}
    data = ModelCardData(
        library_name="worldline",
        license=license_name,
        tags=["robotics", "world-model", "image-to-video"],
        model_name=f"WorldLine {info.kind}" if measured else None,
        eval_results=[EvalResult("image-to-video", "robotics", m.recordings, m.what, m.mean) for m in measured] or None,
    )
    contract = {} if info.action_contract is None else info.action_contract.model_dump(mode="json")
    causal = {} if info.causal is None else {"causal": info.causal.model_dump(mode="json")}
    trained = {"views together": list(info.view_sets), "strides": list(info.strides), "weights": info.dtype}
    sections = (
        f"# WorldLine {info.kind}",
        _table(("", ""), [(key, value) for key, value in model_facts(folder).items()]),
        "## Trained on\n\n" + "\n".join(_training(info, manifest)),
        "## Measured\n\n" + _measured(measured),
        "## Losses at the end of training\n\n" + ("\n".join(f"- {n}: {v:.4g}" for n, v in losses.items()) or UNKNOWN),
        "## Contract\n\n" + "\n".join(f"- {n}: {json.dumps(v)}" for n, v in (contract | causal | trained).items()),
        f"## Licence\n\nOf the weights: {license_name or UNKNOWN}. The licences of what it was trained on hold as well.",
    )
    return str(ModelCard(f"---\n{data.to_yaml()}\n---\n\n" + "\n\n".join(sections) + "\n"))


def _measured(measured: Sequence[Measurement]) -> str:
    rows = [
        (m.what, m.recordings, f"{m.mean:.3f} ({m.low:.3f} to {m.high:.3f})", str(m.count), f"`{m.source}`")
        for m in measured
    ]
    headings = "figure", "recordings", "mean (95 % interval)", "n", "artifact"
    return _table(headings, rows) if rows else "Nothing: no evaluation of this model is in its store."


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _manifest_with_sources(folder: Path) -> dict[str, Any]:
    """A folder's manifest, with ``sources``: licence by source of the recordings that it was trained on, where they are."""
    manifest = read_manifest(folder)
    found = manifest.get("inputs", {}).get("episodes", {}).get("path")
    store = folder.resolve().parent.parent
    for _ in range(2):  # a filtered set points to the curated one, which has the table
        episodes = None if found is None else (store / found).resolve()
        # A manifest that came with the weights may name any place: only its own store is read.
        if episodes is None or not episodes.is_relative_to(store) or not episodes.is_dir():
            break
        if table := read_source_table(episodes):
            manifest["sources"] = {source.label: source.license for source in table}
            break
        found = read_manifest(episodes).get("inputs", {}).get("episodes", {}).get("path")
    return manifest


def _training(info: CheckpointInfo, manifest: Mapping[str, Any]) -> Iterator[str]:
    facts, licences = info.metadata, manifest.get("sources", {})
    counts = dict.fromkeys(licences, UNKNOWN) | facts.get("sources", {})
    yield f"- episodes: {facts.get('episodes', UNKNOWN)}"
    for source, count in sorted(counts.items()):
        yield f"- source {source}: {count} episodes, licence {licences.get(source, UNKNOWN)}"
    yield f"- seed: {facts.get('seed', UNKNOWN)}"
    for name, version in sorted(manifest.get("environment", {}).get("packages", {}).items()):
        yield f"- {name} {version}"
