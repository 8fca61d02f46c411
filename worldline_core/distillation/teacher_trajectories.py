"""Denoising trajectories of the frozen causal teacher (appendix, "Four-Step Trajectory Regression").

For every block, explicit Euler integration from noise along sigma = 1, 15/16, 5/6, 5/8, 0, keeping the state at each of
these nodes. Between two nodes the ODE may take several sub-steps: with one sub-step everywhere the teacher is exactly
its own four-step sampler, and only the terminal objective teaches anything; finer sub-steps make the nodes those of
the teacher's many-step solution, which the student then reaches in four.

Axes: b clips, k nodes, v views, c latent channels, t latent frames (nodes leave out the observed one), h w rows and
columns.

Offline teacher trajectories on disk: shards that are made once, resumed after an interruption, and read at random.

Which clips and which noise a shard holds follows from the seed and the shard's number alone, so a shard that is missing
is remade with the same bytes. Layout: `shard-00000.safetensors` ... (`nodes`, half precision, axes n k v c u h w;
`mask`, bytes, axes n v t h w; the clips in the header) and `trajectories.json` (settings and the digest of every shard),
written last.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import torch
from einops import rearrange
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from worldline_core.distillation.causal_teacher_forcing import CacheWindow
from worldline_core.errors import ArtifactError, ConfigError
from worldline_core.model.block_causal_attention import KVCache, block_bounds
from worldline_core.model.world_model import WorldModel
from worldline_core.rollout.samplers import CAUSAL_SHIFT, CAUSAL_SIGMAS, VelocityField, integrate
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic
from worldline_core.store.digest import digest_file
from worldline_core.training.clip_source import Clip

NODES = CAUSAL_SIGMAS
"""Noise levels of the four-step sampler, at which the trajectories are kept."""


def substep_sigmas(start: float, stop: float, substeps: int) -> list[float]:
    """Noise levels from `start` down to `stop`, both included, evenly spaced before the shift of the schedule.

    With sigma = s u / (1 + (s - 1) u) the sub-steps are even in u, as the full-length sampler spaces its steps.

    Raises:
        ConfigError: no sub-step, or levels that do not descend within [0, 1].
    """
    if substeps < 1 or not 1.0 >= start > stop >= 0.0:
        raise ConfigError(
            "Cannot divide an interval of noise levels",
            expected="1 >= start > stop >= 0 and at least one sub-step",
            got=f"start {start}, stop {stop}, {substeps} sub-steps",
        )
    first, last = (sigma / (CAUSAL_SHIFT - (CAUSAL_SHIFT - 1) * sigma) for sigma in (start, stop))
    between = [first + (last - first) * i / substeps for i in range(1, substeps)]
    return [start, *(CAUSAL_SHIFT * u / (1 + (CAUSAL_SHIFT - 1) * u) for u in between), stop]


def euler_nodes(
    velocity: VelocityField, noise: Tensor, substeps: Sequence[int], nodes: Sequence[float] = NODES
) -> list[Tensor]:
    """States at all `nodes`, the first being the noise itself, by explicit Euler steps of dx/dsigma = velocity.

    Args:
        velocity: field at (state, sigma).
        substeps: Euler steps of each interval, one number an interval.

    Raises:
        ConfigError: another number of intervals than of sub-step counts.
    """
    if len(substeps) != len(nodes) - 1:
        raise ConfigError(
            "One number of sub-steps is needed for each interval between nodes",
            expected=len(nodes) - 1,
            got=list(substeps),
        )
    state, states = noise, [noise]
    for (start, stop), count in zip(itertools.pairwise(nodes), substeps, strict=True):
        state = integrate(velocity, state, substep_sigmas(start, stop, count))
        states.append(state)
    return states


@torch.no_grad()
def teacher_trajectories(
    teacher: WorldModel,
    latents: Float[Tensor, "b v c t h w"],
    action_maps: Float[Tensor, "b v a t h w"],
    noise: Float[Tensor, "b v c t h w"],
    *,
    views: Sequence[str],
    block_size: int,
    window: CacheWindow,
    substeps: Sequence[int],
    generated_history: bool = False,
) -> Float[Tensor, "b k v c u h w"]:
    """States at every node of every block after the observed frame (u = t - 1 latent frames).

    Args:
        latents: recorded clips; frame 0 is the observation. The later frames are the history that each block sees,
            unless `generated_history` puts the teacher's own clean blocks there.
        noise: starting noise; frame 0 is not read.

    Raises:
        DataError: the clip does not divide into blocks.
    """
    bounds = block_bounds(latents.shape[3], block_size)
    cache = KVCache(window.sink_blocks, window.recent_blocks)
    teacher.write_block(latents[..., :1, :, :], cache, action_maps=action_maps[..., :1, :, :], views=views)
    blocks: list[Tensor] = []
    for start, stop in bounds[1:]:
        maps = action_maps[..., start:stop, :, :]
        velocity = partial(teacher.forward_block, cache=cache, action_maps=maps, views=views)
        states = euler_nodes(velocity, noise[..., start:stop, :, :], substeps)
        blocks.append(torch.stack(states, dim=1))
        if stop < bounds[-1][1]:
            clean = states[-1] if generated_history else latents[..., start:stop, :, :]
            teacher.write_block(clean, cache, action_maps=maps, views=views)
    return torch.cat(blocks, dim=4)


def with_observed_frame(
    first: Float[Tensor, "b v c 1 h w"], later: Float[Tensor, "b v c u h w"]
) -> Float[Tensor, "b v c t h w"]:
    """A whole clip: the observed latent frame, then the others."""
    return torch.cat((first, later), dim=3)


def node_of_each_block(
    nodes: Float[Tensor, "b k v c u h w"], index: Tensor, block_size: int
) -> Float[Tensor, "b v c u h w"]:
    """The state of every block at the node that `index` (b, blocks) names for it."""
    split = rearrange(nodes, "b k v c (n s) h w -> b n k v c s h w", s=block_size)
    clips = torch.arange(index.shape[0], device=index.device)[:, None]
    blocks = torch.arange(index.shape[1], device=index.device)[None, :]
    return rearrange(split[clips, blocks, index], "b n v c s h w -> b v c (n s) h w")


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
