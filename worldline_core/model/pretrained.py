"""World models of a folder or the Hugging Face hub, and folders that can be published."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import torch

from worldline_core.errors import ArtifactError, CheckpointError
from worldline_core.http_exchange import hub_snapshot
from worldline_core.model.checkpoint import CheckpointInfo, read_checkpoint_info
from worldline_core.model.model_card import write_model_card
from worldline_core.model.tokenizers import VideoTokenizer, load_tokenizer, tokenizer_fingerprint
from worldline_core.store.artifact_files import MANIFEST_NAME, is_stored, linked_folder, read_manifest, verify_artifact

_HUB_ID = re.compile(r"[\w.-]+/[\w.-]+")


def pretrained_folder(source: Path | str) -> Path:
    """A local folder: ``source`` itself, or a snapshot of that hub repository (safetensors and JSON files alone).

    The token is HF_TOKEN's, and HF_ENDPOINT names another hub. What was fetched before is not fetched again.

    Args:
        source: a folder, or ORG/NAME where there is no such folder.

    Raises:
        CheckpointError: there is no such folder, and it is no name on the hub.
        UnavailableError: the hub does not give it.
    """
    if Path(source).is_dir():
        return Path(source)
    if isinstance(source, Path) or _HUB_ID.fullmatch(source) is None:
        raise CheckpointError("No model here", where=source, expected="a folder, or ORG/NAME of the hub")
    # Numbers and JSON, nothing that could run.
    return hub_snapshot(source, ["*.safetensors", "*.json"], what="model")


def load_model_tokenizer(
    info: CheckpointInfo,
    folder: Path,
    given: Path | str | None = None,
    device: str = "cpu",
    dtype: torch.dtype = torch.float32,
) -> tuple[VideoTokenizer, str, Path]:
    """The tokenizer that a checkpoint's contract names, its fingerprint and its folder: ``given``, or found by the checkpoint.

    Raises:
        CheckpointError: none is there, or only others are.
    """
    others: dict[Path, str] = {}
    for place in _tokenizer_folders(folder) if given is None else [Path(given)]:
        if place in others or not place.is_dir():
            continue
        codec = load_tokenizer(place, device, dtype)
        others[place] = fingerprint = tokenizer_fingerprint(codec, place)
        if fingerprint == info.contract.tokenizer:
            return codec, fingerprint, place
    for place, fingerprint in others.items():
        info.contract.require(where=place, tokenizer=fingerprint)
    raise CheckpointError(
        "The model's tokenizer is not here",
        where=folder,
        expected=f"tokenizer {info.contract.tokenizer} at "
        + (f"{folder / 'tokenizer'}, beside it, or in the checkpoint's store" if given is None else str(given)),
        next_step="give its folder as tokenizer=...",
    )


def _tokenizer_folders(folder: Path) -> Iterator[Path]:
    """Candidate folders of a checkpoint's tokenizer, likeliest first: with its files, named by its manifest or by those of its
    inputs, or anywhere in its store.
    """
    yield from (folder / "tokenizer", folder.parent / "tokenizer")
    # The steps of a distillation are checkpoints inside of the artifact.
    waiting = [path for path in (folder.resolve(), folder.resolve().parent) if is_stored(path)][:1]
    stores = [path.parent.parent for path in waiting]
    for artifact in waiting:
        inputs = {name: linked_folder(artifact, name) for name in read_manifest(artifact).get("inputs", {})}
        found = {name: path.resolve() for name, path in inputs.items() if path is not None}
        if "tokenizer" in found:
            yield found["tokenizer"]
        waiting += [path for path in found.values() if is_stored(path) and path not in waiting]
    for store in stores:  # an artifact on the way there (latents) may have been deleted
        yield from sorted(path for path in store.glob("train_tokenizer/*") if is_stored(path))


def write_pretrained(folder: Path, output: Path) -> Path:
    """Copy a checkpoint with its tokenizer and its card into a folder that can be published and loaded anywhere.

    Raises:
        ArtifactError: the folder exists, or the checkpoint or its tokenizer is damaged.
        CheckpointError: it is no Stage II or causal checkpoint, or its tokenizer is not here.
    """
    if output.exists() and any(output.iterdir()):
        raise ArtifactError("Folder exists already", where=output, next_step="export into a new folder")
    tokenizer = load_model_tokenizer(read_checkpoint_info(folder), folder)[2]
    root = tokenizer / "vae" if (tokenizer / "vae").is_dir() else tokenizer  # a pipeline's other models do not encode
    for source, target in ((folder, output), (root, output / "tokenizer")):
        verify_artifact(source)
        target.mkdir(parents=True, exist_ok=True)
        for path in sorted(source.iterdir()):
            if path.suffix in {".json", ".safetensors"} and path.name != MANIFEST_NAME:
                shutil.copyfile(path, target / path.name)
    write_model_card(folder, output)
    return output
