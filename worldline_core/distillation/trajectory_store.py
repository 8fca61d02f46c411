"""Offline teacher trajectories on disk: shards that are made once, resumed after an interruption, and read at random.

Which clips and which noise a shard holds follows from the seed and the shard's number alone, so a shard that is missing
is remade with the same bytes. Layout: `shard-00000.safetensors` ... (`nodes`, half precision, axes n k v c u h w;
`mask`, bytes, axes n v t h w; the clips in the header) and `trajectories.json` (settings and the digest of every shard),
written last.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from worldline_core.errors import ArtifactError
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic
from worldline_core.store.digest import digest_file
from worldline_core.training.clip_sampler import Clip

INDEX = "trajectories.json"

MakeShard = Callable[[int], tuple[Sequence[Clip], Tensor, Tensor]]
"""Clips, their nodes (n k v c u h w) and robot masks (n v t h w) of a shard, by its number."""


def shard_path(folder: Path, number: int) -> Path:
    """File of a shard."""
    return folder / f"shard-{number:05d}.safetensors"


def write_trajectories(folder: Path, shards: int, make: MakeShard, settings: dict[str, Any]) -> None:
    """Make every shard that is not there yet, then the index.

    Args:
        settings: everything that decides the content (teacher, seed, schedule), JSON values.

    Raises:
        ArtifactError: the folder holds trajectories made with other settings.
    """
    from tqdm import tqdm

    recorded = folder / "settings.json"
    if recorded.is_file():
        found = json.loads(recorded.read_text(encoding="utf-8"))
        if found != settings:
            raise ArtifactError(
                "The folder holds trajectories made with other settings",
                where=folder,
                expected=settings,
                got=found,
                next_step="remove the folder, or use another one",
            )
    write_json_atomic(recorded, settings)
    for number in tqdm(range(shards), desc="teacher trajectories", unit="shard", disable=None):
        path = shard_path(folder, number)
        if path.is_file():
            continue
        clips, nodes, mask = make(number)
        header = {"clips": json.dumps([asdict(clip) for clip in clips])}
        tensors = {"nodes": nodes.to("cpu", torch.float16), "mask": mask.to("cpu", torch.uint8)}
        write_bytes_atomic(path, save({name: value.contiguous() for name, value in tensors.items()}, metadata=header))
    index = {
        "settings": settings,
        "shards": [digest_file(shard_path(folder, number)) for number in range(shards)],
    }
    write_json_atomic(folder / INDEX, index)


class TrajectoryStore:
    """Read access to finished trajectories."""

    def __init__(self, folder: Path, clips: Sequence[tuple[int, int, Clip]]) -> None:
        self.folder = folder
        self._clips = list(clips)

    @classmethod
    def open(cls, folder: Path) -> TrajectoryStore:
        """Open a finished folder.

        Raises:
            ArtifactError: it has no index, or a shard is missing or damaged.
        """
        if not (folder / INDEX).is_file():
            raise ArtifactError("Not a folder of finished trajectories", where=folder, expected=INDEX)
        shards = json.loads((folder / INDEX).read_text(encoding="utf-8"))["shards"]
        clips: list[tuple[int, int, Clip]] = []
        for number in range(len(shards)):
            path = shard_path(folder, number)
            try:
                with safe_open(path, framework="pt") as shard:
                    header = shard.metadata() or {}
            except (OSError, SafetensorError) as error:
                raise ArtifactError("A shard of trajectories cannot be read", where=path, got=str(error)) from error
            if "clips" not in header:
                raise ArtifactError("Not a shard of trajectories", where=path, expected="clips in its header")
            clips += [(number, row, Clip(**clip)) for row, clip in enumerate(json.loads(header["clips"]))]
        return cls(folder, clips)

    def __len__(self) -> int:
        return len(self._clips)

    def clips(self, indices: Sequence[int]) -> tuple[Clip, ...]:
        """The clips of some trajectories."""
        return tuple(self._clips[index][2] for index in indices)

    def nodes(self, indices: Sequence[int]) -> Float[Tensor, "b k v c u h w"]:
        """The states of some trajectories, in single precision."""
        return self._read("nodes", indices)

    def masks(self, indices: Sequence[int]) -> Float[Tensor, "b v t h w"]:
        """The robot masks of some trajectories."""
        return self._read("mask", indices)

    def _read(self, name: str, indices: Sequence[int]) -> Tensor:
        rows = []
        for index in indices:
            number, row, _ = self._clips[index]
            with safe_open(shard_path(self.folder, number), framework="pt") as shard:
                rows.append(shard.get_slice(name)[row : row + 1])
        return torch.cat(rows).float()
