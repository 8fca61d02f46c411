"""Weights as safetensors: one file, or several with an index of which tensor lies in which.

The form of several files is that of transformers and diffusers: ``NAME.safetensors.index.json`` maps every tensor to a file
beside it. What is written here also states the SHA-256 of each file there, so that the index's own digest stands for all.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from worldline_core.errors import CheckpointError
from worldline_core.store.artifact_files import digest_file
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic

INDEX_SUFFIX = ".index.json"
MAX_SHARD_BYTES = 5_000_000_000
"""Weights above this go into several files."""
_AGAIN = "fetch the folder again; what makes a checkpoint here writes its description last"


def write_weights(
    path: Path, tensors: Mapping[str, Tensor], max_shard_bytes: int = MAX_SHARD_BYTES, dtype: torch.dtype | None = None
) -> str:
    """Write ``path``, or, above ``max_shard_bytes``, ``NAME-00001-of-0000N.safetensors`` and so on with an index.

    Equal tensors give equal bytes. They are cast to ``dtype`` file by file. Files of an earlier, larger or smaller write of
    the same name are removed.

    Returns:
        SHA-256 of the one file, or of the index.
    """
    sizes = {name: tensors[name].numel() * (dtype or tensors[name].dtype).itemsize for name in sorted(tensors)}
    shards = _shards(sizes, max_shard_bytes)
    index = path.with_name(path.name + INDEX_SUFFIX)
    kept = {path.name}
    if len(shards) == 1:
        content = _content(tensors, shards[0], dtype)
        write_bytes_atomic(path, content)
        digest = hashlib.sha256(content).hexdigest()
    else:
        weight_map: dict[str, str] = {}
        digests: dict[str, str] = {}
        for number, names in enumerate(shards, start=1):
            name = f"{path.stem}-{number:05d}-of-{len(shards):05d}{path.suffix}"
            content = _content(tensors, names, dtype)
            write_bytes_atomic(path.with_name(name), content)
            digests[name] = hashlib.sha256(content).hexdigest()
            weight_map |= dict.fromkeys(names, name)
        write_json_atomic(
            index, {"metadata": {"total_size": sum(sizes.values()), "sha256": digests}, "weight_map": weight_map}
        )
        digest = hashlib.sha256(index.read_bytes()).hexdigest()
        kept = {index.name, *digests}
    for old in (path, index, *path.parent.glob(f"{path.stem}-*-of-*{path.suffix}")):
        if old.name not in kept:
            old.unlink(missing_ok=True)
    return digest


def _content(tensors: Mapping[str, Tensor], names: Sequence[str], dtype: torch.dtype | None) -> bytes:
    """A file of some tensors. Those that share memory are copied: a file holds each."""
    return save({name: tensors[name].detach().to("cpu", dtype).contiguous().clone() for name in names})


def _shards(sizes: Mapping[str, int], most: int) -> list[list[str]]:
    """Names of the tensors of each file, in order; a tensor above ``most`` bytes has a file of its own."""
    shards: list[list[str]] = [[]]
    size = 0
    for name, own in sizes.items():
        if shards[-1] and size + own > most:
            shards.append([])
            size = 0
        shards[-1].append(name)
        size += own
    return shards


def read_weights(path: Path, sha256: str | None) -> dict[str, Tensor]:
    """The tensors of a safetensors file, or of those that its index names where ``path`` itself is not there.

    Args:
        sha256: digest that the description gives, of the file or of the index; None where it gives none.

    Raises:
        CheckpointError: a file is missing or damaged, or holds other weights; the index names a file outside of the folder,
            or disagrees with the files. The message names the file.
    """
    index = path.with_name(path.name + INDEX_SUFFIX)
    if path.is_file() or not index.is_file():
        if not path.is_file():
            raise CheckpointError(
                "The checkpoint has no weights", where=path, expected=f"{path.name}, or {index.name} and its files",
                next_step=_AGAIN,
            )  # fmt: skip
        return _read(path, sha256)
    content = index.read_bytes()
    _check_digest(index, hashlib.sha256(content).hexdigest(), sha256)
    tensors: dict[str, Tensor] = {}
    for shard, names, digest in _indexed(index, content):
        found = _read(shard, digest)
        if found.keys() != names:
            raise CheckpointError(
                "An index and a file of weights disagree",
                where=shard,
                expected=f"the {len(names)} tensors that {index.name} names",
                got=f"missing {sorted(names - found.keys())[:8]}, others {sorted(found.keys() - names)[:8]}",
                next_step=_AGAIN,
            )
        tensors |= found
    return tensors


def _indexed(index: Path, content: bytes) -> Iterator[tuple[Path, set[str], str | None]]:
    """Each file of an index, with the tensors that it holds and its digest where that is stated.

    Raises: CheckpointError when the index is damaged, or names something else than a file beside it.
    """
    try:
        read: Any = json.loads(content)
        weight_map = {str(key): str(name) for key, name in read["weight_map"].items()}
        digests = read.get("metadata", {}).get("sha256", {})
        stated = {str(name): str(value) for name, value in digests.items()}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise CheckpointError(
            "An index of weights is damaged", where=index, expected="{weight_map: {tensor: file}}",
            got=f"{type(error).__name__}: {error}", next_step=_AGAIN,
        ) from error  # fmt: skip
    for name in sorted(set(weight_map.values())):
        if Path(name).name != name or not name.endswith(".safetensors") or "\\" in name:
            raise CheckpointError(
                "An index of weights names something else than a file of its folder",
                where=index,
                expected="NAME.safetensors",
                got=name,
                next_step="do not use weights of this origin",
            )
        shard = index.with_name(name)
        if not shard.is_file():
            raise CheckpointError(
                "A weight file is missing", where=shard, expected=f"all files that {index.name} names",
                got="no such file", next_step=_AGAIN,
            )  # fmt: skip
        yield shard, {key for key, file in weight_map.items() if file == name}, stated.get(name)


def _read(path: Path, sha256: str | None) -> dict[str, Tensor]:
    """Views of the mapped file: it takes no memory until it is read, and can be dropped from there at any time."""
    _check_digest(path, digest_file(path), sha256)
    try:
        return load_file(path)
    except SafetensorError as error:
        raise CheckpointError("The weights file is damaged", where=path, got=str(error), next_step=_AGAIN) from error


def _check_digest(path: Path, digest: str, sha256: str | None) -> None:
    if sha256 not in (None, digest):
        raise CheckpointError(
            "The weights are not those that are described", where=path, expected=sha256, got=digest, next_step=_AGAIN
        )
