"""Stage III, step 2: four-step trajectory regression (appendix, same title).

    L_traj = lambda_next sum_k ||z^(k+1) - z_T^(k+1)||^2 + lambda_terminal ||z^clean - z_T^clean||^2 + L_aux

The student starts at a node of the teacher's trajectory, takes one Euler step to the next node, and its clean
prediction is compared with the teacher's clean end. A node is drawn for every block of every clip, so the sum over
nodes is taken in expectation (times K); all blocks are trained in one teacher-forcing pass.

Trajectories of the frozen causal teacher are made once and read at random.

Every block is integrated from noise along the nodes of the sampler by explicit Euler steps (the paper's: sigma = 1, 15/16,
5/6, 5/8, 0), and the state at each node is kept. Between two nodes the ODE may take several sub-steps: with one sub-step
everywhere the teacher is exactly its own few-step sampler, and only the terminal objective teaches anything; finer
sub-steps make the nodes those of the teacher's many-step solution, which the student then reaches in few.

Clips and noise of a shard follow from the seed and its number, so a missing shard is remade with the same bytes. Layout:
`shard-00000.safetensors` ... (`nodes`, half precision, axes n k v c u h w; `mask`, bytes, axes n v t h w; where clips are read
as frames their `latents`, half precision, axes n v c t h w; the clips and the views that they show in the header) and `trajectories.json` (settings and the
digest of every shard), written last.

Axes: b clips (n in a shard), k nodes, v views, c latent channels, t latent frames, u = t - 1 without the observed one, h w rows
and columns.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float, Int
from pydantic import ConfigDict, TypeAdapter
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from worldline_core.distillation.auxiliary_losses import PerceptualDistance, auxiliary_losses, clip_robot_masks
from worldline_core.distillation.causal_objective import CausalObjective, frame_sigmas, maps_of, with_observed_frame
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.errors import ArtifactError, ConfigError
from worldline_core.model.block_causal_attention import KVCache, block_bounds
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import CAUSAL_SHIFT, CausalSpec
from worldline_core.progress import Progress
from worldline_core.rollout.samplers import VelocityField, integrate
from worldline_core.store.artifact_files import digest_file, read_json
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic
from worldline_core.training.clip_config import FrameInput
from worldline_core.training.clip_loader import Batch, ClipLoader
from worldline_core.training.clip_sampler import Clip, ClipBatch
from worldline_core.training.flow_matching import broadcast_sigma
from worldline_core.training.processes import BatchPlan, processes, wait_for_all
from worldline_core.training.trainer import autocast, step_generator
from worldline_core.training.training_config import TrainerConfig


def substep_sigmas(start: float, stop: float, substeps: int) -> list[float]:
    """Noise levels from `start` down to `stop`, both included, evenly spaced before the shift of the schedule.

    With sigma = s u / (1 + (s - 1) u) the sub-steps are even in u, as the full-length sampler spaces its steps.
    """
    first, last = (sigma / (CAUSAL_SHIFT - (CAUSAL_SHIFT - 1) * sigma) for sigma in (start, stop))
    between = [first + (last - first) * i / substeps for i in range(1, substeps)]
    return [start, *(CAUSAL_SHIFT * u / (1 + (CAUSAL_SHIFT - 1) * u) for u in between), stop]


def euler_nodes(
    velocity: VelocityField, noise: Tensor, substeps: Sequence[int], nodes: Sequence[float]
) -> list[Tensor]:
    """States at all `nodes`, the first being the noise itself, by explicit Euler steps of dx/dsigma = velocity.

    Args:
        velocity: field at (state, sigma).
        substeps: Euler steps of each interval between nodes.
    """
    states = [noise]
    for (start, stop), count in zip(itertools.pairwise(nodes), substeps, strict=True):
        states.append(integrate(velocity, states[-1], substep_sigmas(start, stop, count)))
    return states


@torch.no_grad()
def teacher_trajectories(
    teacher: WorldModel,
    latents: Float[Tensor, "b v c t h w"],
    action_maps: Float[Tensor, "b v a t #h #w"],
    noise: Float[Tensor, "b v c t h w"],
    *,
    views: Sequence[str],
    spec: CausalSpec,
    substeps: Sequence[int],
    fps: Float[Tensor, " b"] | None = None,
) -> Float[Tensor, "b k v c u h w"]:
    """States at every node of every block after the observed frame (u = t - 1 latent frames).

    Args:
        latents: recorded clips; frame 0 is the observation, the later frames are the history that each block sees.
        noise: starting noise; frame 0 is not read.

    Raises:
        DataError: the clip does not divide into blocks.
    """
    bounds = block_bounds(latents.shape[3], spec.block_size)
    cache = KVCache(spec.sink_blocks, spec.recent_blocks, fps)
    teacher.write_block(latents[..., :1, :, :], cache, action_maps=action_maps[..., :1, :, :], views=views)
    blocks: list[Tensor] = []
    for start, stop in bounds[1:]:
        maps = action_maps[..., start:stop, :, :]
        velocity = partial(teacher.forward_block, cache=cache, action_maps=maps, views=views)
        states = euler_nodes(velocity, noise[..., start:stop, :, :], substeps, spec.sigmas)
        blocks.append(torch.stack(states, dim=1))
        if stop < bounds[-1][1]:
            teacher.write_block(latents[..., start:stop, :, :], cache, action_maps=maps, views=views)
    return torch.cat(blocks, dim=4)


def robot_masks(loader: ClipLoader, clips: Sequence[Clip], views: Sequence[str]) -> Float[Tensor, "b v t h w"]:
    """Robot masks of some clips from their action tracks.

    Raises:
        ConfigError: the loader has no action tracks.
    """
    if loader.tracks is None:
        raise ConfigError("Robot masks come from action tracks", next_step="give the tracks to the clip loader")
    cut = [loader.tracks.tracks(one.episode_id).clip(one.frames) for one in clips]  # pyright: ignore[reportUnknownMemberType]
    return clip_robot_masks(cut, views, loader.source.latent_shape[1:])


def trajectory_shard(
    number: int, config: DistillConfig, teacher: WorldModel, loader: ClipLoader, load: Callable[[int], Batch]
) -> tuple[ClipBatch, dict[str, Tensor]]:
    """Clips and tensors of one shard of the store: a function of the seed and the shard's number.

    Args:
        load: reads the shard's clips by its number.
    """
    settings, trainer = config.trajectory_regression.trajectories, config.trajectory_regression.trainer
    batch = load(number)
    generator = step_generator(settings.seed, number, trainer.device)
    noise = torch.randn(batch.latents.shape, generator=generator, device=batch.latents.device)
    with autocast(trainer):
        nodes = teacher_trajectories(
            teacher,
            batch.latents,
            maps_of(batch),
            noise,
            views=batch.views,
            spec=config.spec,
            substeps=settings.substeps,
            fps=batch.fps,
        )
    tensors = {"nodes": nodes, "mask": robot_masks(loader, batch.clips, batch.views)}
    if isinstance(config.input, FrameInput):
        tensors["latents"] = batch.latents
    return ClipBatch(batch.clips, batch.views), tensors


INDEX = "trajectories.json"
_opened: Any = safe_open  # it has no types

MakeShard = Callable[[int], tuple[ClipBatch, Mapping[str, Tensor]]]
"""Clips of a shard by its number, and their ``nodes`` (n k v c u h w), robot ``mask`` (n v t h w) and perhaps ``latents``
(n v c t h w)."""


def shard_path(folder: Path, number: int) -> Path:
    """File of a shard."""
    return folder / f"shard-{number:05d}.safetensors"


def write_trajectories(folder: Path, shards: int, make: MakeShard, settings: dict[str, Any]) -> None:
    """Make every shard that is not there yet, then the index. Processes of a run share the shards.

    Args:
        settings: everything that decides the content (teacher, seed, schedule), JSON values.

    Raises:
        ArtifactError: the folder holds trajectories made with other settings.
    """
    found = read_json(folder / "settings.json") or settings
    if found != settings:
        raise ArtifactError(
            "The folder holds trajectories made with other settings",
            where=folder,
            expected=settings,
            got=found,
            next_step="remove the folder, or use another one",
        )
    rank, world_size = processes()
    write_json_atomic(folder / "settings.json", settings)
    mine = range(rank, shards, world_size)
    with Progress("teacher trajectories", len(mine), "shard", shown=rank == 0) as progress:
        for number in mine:
            path = shard_path(folder, number)
            if not path.is_file():
                drawn, tensors = make(number)
                # One entry: safetensors writes several in an order of its own, another one each time.
                header = {"clips": json.dumps([[asdict(clip) for clip in drawn.clips], drawn.views])}
                content = {
                    name: value.to("cpu", torch.uint8 if name == "mask" else torch.float16).contiguous()
                    for name, value in tensors.items()
                }
                write_bytes_atomic(path, save(content, metadata=header))
            progress.advance()
    wait_for_all()
    if rank > 0:
        return
    digests = [digest_file(shard_path(folder, number)) for number in range(shards)]
    write_json_atomic(folder / INDEX, {"settings": settings, "shards": digests})


class TrajectoryStore:
    """Read access to finished trajectories.

    Attributes:
        views: shown by the clip of each trajectory.
    """

    def __init__(self, folder: Path, shards: Sequence[tuple[list[Clip], tuple[str, ...]]]) -> None:
        self.folder = folder
        places = [(number, row) for number, (clips, _) in enumerate(shards) for row in range(len(clips))]
        self._clips = [(number, row, shards[number][0][row]) for number, row in places]
        self.views = [shards[number][1] for number, _ in places]

    @classmethod
    def open(cls, folder: Path) -> TrajectoryStore:
        """Open a finished folder.

        Raises:
            ArtifactError: it has no index, or a shard is missing or damaged.
        """
        if not (folder / INDEX).is_file():
            raise ArtifactError("Not a folder of finished trajectories", where=folder, expected=INDEX)
        shards: Any = read_json(folder / INDEX).get("shards")
        if (kind := type(shards).__name__) != "list" or not shards:
            raise ArtifactError("The index lists no shards", where=folder / INDEX, got=kind)
        return cls(folder, [_clips(shard_path(folder, number)) for number in range(len(shards))])

    def __len__(self) -> int:
        return len(self._clips)

    def clips(self, indices: Sequence[int]) -> tuple[Clip, ...]:
        return tuple(self._clips[index][2] for index in indices)

    def read(self, name: str, indices: Sequence[int]) -> Tensor:
        """``nodes`` (b k v c u h w), ``mask`` (b v t h w) or, where they are kept, ``latents`` (b v c t h w) of some
        trajectories, in single precision."""
        rows = list[Tensor]()
        for index in indices:
            number, row, _ = self._clips[index]
            path = shard_path(self.folder, number)
            with _opened(path, framework="pt") as shard:
                if name not in shard.keys():  # noqa: SIM118  (no mapping)
                    raise ArtifactError("A shard of trajectories lacks a tensor", where=path, expected=name)
                rows.append(shard.get_slice(name)[row : row + 1])
        values = torch.cat(rows).float()
        if not bool(torch.isfinite(values).all()):
            raise ArtifactError(f"A trajectory's {name} are not finite", where=self.folder, next_step="make them again")
        return values


_CLIPS = TypeAdapter(tuple[list[Clip], tuple[str, ...]], config=ConfigDict(strict=True))


def _clips(path: Path) -> tuple[list[Clip], tuple[str, ...]]:
    """The clips of a shard whose tensors are one row of half-precision nodes and one of byte masks for each, and their views.

    Raises:
        ArtifactError: it is missing, damaged, or of another form.
    """
    try:
        with _opened(path, framework="pt") as shard:
            header: dict[str, str] = shard.metadata() or {}
            clips, views = _CLIPS.validate_json(header.get("clips", ""))
            forms = {name: shard.get_slice(name) for name in ("nodes", "mask")}
            found = {name: (form.get_dtype(), form.get_shape()) for name, form in forms.items()}
    except (OSError, SafetensorError, ValueError) as error:  # pydantic's ValidationError is a ValueError
        raise ArtifactError("A shard of trajectories cannot be read", where=path, got=str(error)) from error
    (nodes_type, nodes), (mask_type, mask) = found["nodes"], found["mask"]
    fits = (
        len(nodes) == 7 and len(mask) == 5 and nodes[0] == mask[0] == len(clips) and nodes[2] == mask[1] == len(views)
    )
    if not fits or (nodes_type, mask_type) != ("F16", "U8"):
        expected = f"F16 ({len(clips)}, k, {len(views)}, c, u, h, w) and U8 ({len(clips)}, {len(views)}, t, h, w)"
        raise ArtifactError(
            "Tensors of a shard of trajectories do not fit its clips", where=path, expected=expected, got=found
        )
    return clips, views


@dataclass(frozen=True, kw_only=True)
class TrajectoryBatch(Batch):
    """A batch with the teacher's trajectories of its clips.

    Attributes:
        history: what the teacher saw before each block, observed frame included.
        mask: where the robot is.
    """

    nodes: Float[Tensor, "b k v c u h w"]
    history: Float[Tensor, "b v c t h w"]
    mask: Float[Tensor, "b v t h w"]


class TrajectoryLoader:
    """Draws trajectories at random; what a step sees depends on (seed, step) alone.

    Args:
        kept_latents: whether the clips' latents are with the trajectories.
    """

    def __init__(
        self, store: TrajectoryStore, loader: ClipLoader, trainer: TrainerConfig, plan: BatchPlan, *, kept_latents: bool
    ) -> None:
        self.store, self.loader, self.trainer, self.plan = store, loader, trainer, plan
        self.kept_latents = kept_latents
        # A batch has one shape, so its clips have one length and the same views: a group of such clips is drawn by its size,
        # then clips within it.
        lengths = [clip.num_frames for clip in store.clips(range(len(store)))]
        kinds = list(zip(lengths, store.views, strict=True))
        self._kinds = sorted(set(kinds))
        self._groups = [[row for row, kind in enumerate(kinds) if kind == wanted] for wanted in self._kinds]
        self._shares = np.array([len(group) for group in self._groups]) / len(store)

    def load(self, index: int) -> TrajectoryBatch:
        """The batch of this process's micro-step `index`."""
        index, part = self.plan.drawn(index)
        size, device = self.trainer.batch_size, self.loader.device
        random = np.random.Generator(np.random.Philox(key=[self.trainer.seed, index]))
        number = int(random.choice(len(self._groups), p=self._shares))
        group, (_, views) = self._groups[number], self._kinds[number]
        draws = random.integers(len(group), size=size * self.plan.together)
        rows = [group[int(draw)] for draw in draws[part * size : (part + 1) * size]]
        clips = ClipBatch(self.store.clips(rows), views)
        if self.kept_latents:
            batch = self.loader.conditioned(clips, self.store.read("latents", rows).to(device))
        else:
            batch = self.loader.load(clips)
        nodes, mask = (self.store.read(name, rows).to(device) for name in ("nodes", "mask"))
        return TrajectoryBatch(**vars(batch), nodes=nodes, history=batch.latents, mask=mask)


class TrajectoryObjective(CausalObjective[TrajectoryBatch]):
    """Regression of the teacher's trajectories."""

    def __init__(self, model: WorldModel, config: DistillConfig, perceptual: PerceptualDistance | None) -> None:
        super().__init__(model, config)
        self.perceptual = perceptual

    def loss(self, batch: TrajectoryBatch, generator: torch.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        del step
        blocks = (batch.latents.shape[3] - 1) // self.spec.block_size
        total, terms = self.regression(batch, draw_nodes(len(batch.latents), blocks, self.spec.steps, generator))
        return total, {name: value.item() for name, value in terms.items()}

    def regression(
        self, batch: TrajectoryBatch, index: Int[Tensor, "b blocks"]
    ) -> tuple[Float[Tensor, ""], dict[str, Tensor]]:
        """Regression of the next node and of the clean end, plus the auxiliaries against the teacher's clean end.

        Returns:
            The weighted total, and its parts.

        Args:
            index: node of each block, see :func:`draw_nodes`.
        """
        spec, config, nodes = self.spec, self.config.trajectory_regression, batch.nodes
        first = batch.history[..., :1, :, :]
        levels = torch.tensor(spec.sigmas, device=nodes.device, dtype=nodes.dtype)
        state = with_observed_frame(first, node_of_each_block(nodes, index, spec.block_size))
        following = with_observed_frame(first, node_of_each_block(nodes, index + 1, spec.block_size))
        end = with_observed_frame(first, nodes[:, -1])
        sigma, sigma_next = levels[index], levels[index + 1]
        velocity = self.model.forward_teacher_forcing(
            state, batch.history, sigma, action_maps=maps_of(batch), spec=spec, views=batch.views, fps=batch.fps
        ).float()
        here = broadcast_sigma(frame_sigmas(sigma, spec.block_size))
        there = broadcast_sigma(frame_sigmas(sigma_next, spec.block_size))
        stepped = state + (there - here) * velocity
        predicted = state - here * velocity
        # Frame 0 is the observation in both: it adds nothing and is left out of the means.
        next_loss = spec.steps * ((stepped - following)[..., 1:, :, :] ** 2).mean()
        terminal_loss = ((predicted - end)[..., 1:, :, :] ** 2).mean()
        auxiliary, terms = auxiliary_losses(
            predicted, end, batch.mask, batch.views, spec.block_size, config.auxiliary, self.perceptual
        )
        total = config.next_weight * next_loss + config.terminal_weight * terminal_loss + auxiliary
        return total, {"next": next_loss.detach(), "terminal": terminal_loss.detach(), **terms}


def draw_nodes(clips: int, blocks: int, steps: int, generator: torch.Generator) -> Int[Tensor, "b blocks"]:
    """A noisy node, 0 (pure noise) to K - 1 (K = `steps`), for every block, all equally likely."""
    return torch.randint(steps, (clips, blocks), generator=generator, device=generator.device)


def node_of_each_block(
    nodes: Float[Tensor, "b k v c u h w"], index: Tensor, block_size: int
) -> Float[Tensor, "b v c u h w"]:
    """The state of every block at the node that `index` (b, blocks) names for it."""
    split = rearrange(nodes, "b k v c (n s) h w -> b n k v c s h w", s=block_size)
    clips = torch.arange(index.shape[0], device=index.device)[:, None]
    blocks = torch.arange(index.shape[1], device=index.device)[None, :]
    return rearrange(split[clips, blocks, index], "b n v c s h w -> b v c (n s) h w")
