"""The world model as users open and hand it on: from a folder or the Hugging Face hub, with its card."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping
from math import isfinite
from pathlib import Path
from typing import Any, Literal, Self

import torch

from worldline_core.data.curation.source_table import read_source_table
from worldline_core.errors import CheckpointError, ConfigError, UnavailableError
from worldline_core.model.checkpoint import (
    MAX_SHARD_BYTES,
    CheckpointInfo,
    CheckpointKind,
    load_checkpoint,
    save_checkpoint,
)
from worldline_core.model.world_model import WorldModel
from worldline_core.store.artifact_files import read_manifest
from worldline_core.store.atomic import write_bytes_atomic

_HUB_ID = re.compile(r"[\w.-]+/[\w.-]+")
_WANTED = ("*.safetensors", "*.json")
"""All that is fetched: numbers and JSON, nothing that could run."""


def pretrained_folder(source: Path | str, revision: str | None = None) -> Path:
    """A local folder: ``source`` itself, or a snapshot of that hub repository (safetensors and JSON files alone).

    The token is HF_TOKEN's, and HF_ENDPOINT names another hub. What was fetched before is not fetched again.

    Args:
        source: a folder, or ORG/NAME where there is no such folder.
        revision: branch, tag or commit of a hub repository.

    Raises:
        CheckpointError: there is no such folder, and it is no name on the hub.
        ConfigError: a revision of a folder.
        UnavailableError: the hub does not give it.
    """
    if Path(source).is_dir():
        if revision is not None:
            raise ConfigError("A folder has no revisions", where=source, got=revision, next_step="leave it out")
        return Path(source)
    if isinstance(source, Path) or _HUB_ID.fullmatch(source) is None:
        raise CheckpointError("No model here", where=source, expected="a folder, or ORG/NAME of the hub")
    import httpx
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError

    try:
        found = snapshot_download(
            source,
            revision=revision,
            allow_patterns=list(_WANTED),
            endpoint=os.environ.get("HF_ENDPOINT"),
            # False: without a token the client would look for one that some other program stored.
            token=os.environ.get("HF_TOKEN") or False,
        )
    except (HfHubHTTPError, HFValidationError, LocalEntryNotFoundError, httpx.HTTPError, OSError, ValueError) as error:
        text = str(error).strip().splitlines()
        raise UnavailableError(
            "The hub does not give this model",
            where=source,
            expected="a folder of that name here, or the repository on the hub or in its local cache",
            got=f"{type(error).__name__}: {text[0] if text else ''}"[:300],
            next_step="check the name, the network and HF_TOKEN; offline, download it elsewhere and give its folder",
        ) from error
    return Path(found)


class PretrainedWorldModel(WorldModel):
    """The network with the description of its checkpoint.

    Attributes:
        info: kind, contract of the controls, causal blocks, and what it was trained on.
    """

    info: CheckpointInfo
    manifest: dict[str, object]

    @classmethod
    def from_pretrained(
        cls,
        source: Path | str,
        *,
        revision: str | None = None,
        expect_kind: CheckpointKind | None = None,
        towers: Literal["both", "generation"] | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> Self:
        """Open a checkpoint of a folder or of the hub.

        Args:
            source: a folder, or ORG/NAME.
            expect_kind: refuse checkpoints of another kind.
            towers: ``generation`` leaves the text tower out.

        Raises:
            CheckpointError: nothing is here, or something does not fit; the message says what.
            UnavailableError: the hub does not give it.
        """
        folder = pretrained_folder(source, revision)
        model, info = load_checkpoint(folder, expect_kind=expect_kind, towers=towers, dtype=dtype, model_class=cls)
        model.info = info
        model.manifest = manifest_with_sources(folder)
        return model.eval()

    def save_pretrained(self, folder: Path | str, *, max_shard_bytes: int = MAX_SHARD_BYTES) -> None:
        """Write the checkpoint as it was opened, with a model card (README.md); weights keep their stored type.

        Args:
            max_shard_bytes: weights above this go into several files with an index.

        Raises:
            CheckpointError: a weight is not finite in the type of the checkpoint, or the model was not opened from one.
        """
        target, info = Path(folder), self.__dict__.get("info")
        if info is None:
            raise CheckpointError(
                "The model has no description to save",
                expected="a model of PretrainedWorldModel.from_pretrained",
                got="one that was built from a configuration",
                next_step="write it with save_checkpoint, which is told its kind and contract",
            )
        save_checkpoint(
            target,
            self,
            kind=info.kind,
            action_contract=info.action_contract,
            causal=info.causal,
            trained=info.trained,
            metadata=info.metadata,
            dtype=getattr(torch, info.dtype),
            max_shard_bytes=max_shard_bytes,
        )
        write_bytes_atomic(target / "README.md", model_card(info, self.manifest).encode())


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
    from huggingface_hub import EvalResult, ModelCard, ModelCardData

    metrics = _metrics(info, manifest)
    data = ModelCardData(
        library_name="worldline",
        license=license_name,
        tags=["robotics", "world-model", "image-to-video"],
        model_name=f"WorldLine {info.kind}" if metrics else None,
        eval_results=[
            EvalResult("image-to-video", "robotics", "the recordings that it was trained on", name, value)
            for name, value in metrics.items()
        ]
        or None,
    )
    sections = [
        f"---\n{data.to_yaml()}\n---",
        f"# WorldLine {info.kind}\n\nA {_KINDS[info.kind]}.",
        _usage(info),
        "## Trained on\n\n" + "\n".join(_training(info, manifest)),
        "## Reached\n\n" + ("\n".join(f"- {name}: {value:.4g}" for name, value in metrics.items()) or f"Metrics: {UNKNOWN}."),
        "## Contract\n\nData that contradict it are refused by name before the first step.\n\n" + "\n".join(_contract(info)),
        f"## Licence\n\nOf the weights: {license_name or UNKNOWN}. The licences of what it was trained on hold as well.",
    ]  # fmt: skip
    return str(ModelCard("\n\n".join(sections) + "\n"))


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
    name = "WorldLine" if info.kind in ("stage2", "causal") else "PretrainedWorldModel"
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


def _metrics(info: CheckpointInfo, manifest: Mapping[str, Any]) -> dict[str, float]:
    found = info.metadata.get("metrics") or manifest.get("metrics", {})
    return {
        n: v for n, v in sorted(found.items()) if isinstance(v, int | float) and not isinstance(v, bool) and isfinite(v)
    }


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
