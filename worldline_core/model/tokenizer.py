"""The tokenizer of a folder: opened whatever its kind, and named by what it encodes."""

from __future__ import annotations

import hashlib
from pathlib import Path

from worldline_core.errors import CheckpointError
from worldline_core.model.patch_tokenizer import PatchTokenizer
from worldline_core.model.video_tokenizer import VideoTokenizer, read_description
from worldline_core.model.wan_tokenizer import WanTokenizer


def load_tokenizer(folder: Path) -> VideoTokenizer:
    """Load whatever tokenizer ``folder`` holds: a patch tokenizer, or a diffusers Wan autoencoder.

    Raises:
        CheckpointError: the folder holds none, or a damaged one.
    """
    if (folder / "config.json").is_file() or (folder / "vae" / "config.json").is_file():
        return WanTokenizer.load(folder)
    kind = read_description(folder).get("kind")
    if kind != PatchTokenizer.KIND:
        raise CheckpointError("Unknown kind of tokenizer", where=folder, expected=PatchTokenizer.KIND, got=kind)
    return PatchTokenizer.load(folder)


def tokenizer_fingerprint(tokenizer: VideoTokenizer, folder: Path) -> str:
    """Name of the encoder, 16 hexadecimal digits, so that latents and models of one tokenizer stay together.

    A patch tokenizer tells its encoder from its decoder: a better decoder keeps the latents valid. Otherwise it is a
    digest of the folder's weights and configuration.
    """
    if isinstance(tokenizer, PatchTokenizer):
        return tokenizer.encoder_digest[:16]
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.suffix in {".safetensors", ".json"} and path.name != "manifest.json":
            digest.update(path.relative_to(folder).as_posix().encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
