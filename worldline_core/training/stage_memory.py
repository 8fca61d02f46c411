"""How much memory a training stage takes, from its configuration alone, and what to change where it does not fit.

Activations come from the stage's own objective (`stage_cost.py`); weights, gradients, moments and averages follow from the
parameters that it trains. `worldline plan` prints this before anything is there, and training asks the same before its
first step.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import torch

from worldline_core.errors import ConfigError
from worldline_core.model.step_cost import StepCost
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import WorldModelConfig
from worldline_core.training.clip_config import JOINT, ClipSampling
from worldline_core.training.clip_loader import Batch
from worldline_core.training.clip_sampler import Clip, latent_frame_count
from worldline_core.training.training_config import TrainerConfig

USABLE = 0.92
"""Part of a device's memory that a stage may fill; the rest is for the driver, communication and fragments."""
Checkpointing = Literal["none", "block", "selective"]


@dataclass(frozen=True)
class ClipShape:
    """What one micro-batch of a stage holds on one device.

    Attributes:
        clips, views: how many; frames: of every clip, as recorded; grid: rows and columns of a latent.
    """

    clips: int
    views: tuple[str, ...]
    frames: int
    grid: tuple[int, int]

    def tokens(self, model: WorldModelConfig) -> int:
        """Video tokens of one clip."""
        rows, columns = (size // model.patch_size for size in self.grid)
        return latent_frame_count(self.frames) * len(self.views) * rows * columns

    def batch(self, model: WorldModelConfig, *, maps: bool, text: int = 0) -> Batch:
        """A batch of this shape, to be made within `without_values`; ``text``: tokens of every clip's text, 0 for none."""
        size, count = (self.clips, len(self.views)), latent_frame_count(self.frames)
        drawn = self.grid if model.native_size is None else (1, 1)
        return Batch(
            (Clip("", 0, self.frames, 1),) * self.clips,
            self.views,
            torch.empty(*size, model.latent_channels, count, *self.grid),
            torch.empty(*size, model.map_channels, count, *drawn) if maps else None,
            torch.zeros(self.clips, text, dtype=torch.long) if text else None,
            torch.ones(self.clips, text, dtype=torch.bool) if text else None,
        )


def largest_clips(
    clips: ClipSampling, batch_size: int, views: Sequence[str], grid: tuple[int, int], frames: int | None = None
) -> ClipShape:
    """The micro-batch of a stage that holds most: all views where steps are joint, else one.

    Args:
        frames: of its clips; None: of the longest.
    """
    weights, longest = clips.view_weights, frames or max(clips.lengths)
    if weights is None or JOINT in weights:
        return ClipShape(batch_size, tuple(views), longest, grid)
    return ClipShape(batch_size * clips.single_view_factor, (views[0],), longest, grid)


@dataclass(frozen=True)
class Spread:
    """How a stage lies on its devices.

    Attributes:
        shards: parts of every weight; checkpointing: what is computed again on the way back (`ShardingConfig`).
        micro_steps: of a step, whose gradients add up.
        reduced_at_once: gradients are summed over processes after every micro-step, so that no device keeps whole ones.
        frames: longest clips, to ask for shorter ones; None: as configured.
    """

    shards: int = 1
    checkpointing: Checkpointing = "none"
    micro_steps: int = 1
    reduced_at_once: bool = True
    frames: int | None = None

    @classmethod
    def of(cls, trainer: TrainerConfig, devices: int) -> Spread:
        """What a trainer's configuration says for so many devices."""
        sharding = trainer.sharding
        shards, micro_steps = min(sharding.shards or devices, devices), trainer.accumulation
        if trainer.global_batch is not None:
            micro_steps = -(-trainer.global_batch // (trainer.batch_size * devices))
        return cls(shards, sharding.checkpointing, micro_steps, sharding.reduce_every_micro_step or micro_steps == 1)


@dataclass(frozen=True)
class StageMemory:
    """What one training stage holds on one device at its worst moment, in bytes, and what its micro-steps compute.

    Attributes:
        shape: of its longest micro-batch; tokens: of one clip of it.
        trained: parameters that an optimiser holds; not_averaged: those of them without an average; block: all those of
            one transformer block.
        cost: of the longest micro-step, as ``spread`` has it.
        frozen: bytes of models that are not trained, by name, whole on every device.
        frozen_parts: of those that are sharded like the trained one (in float32).
        before: what is done before the model's own step (encoding clips, the teacher), and gone when that begins.
    """

    title: str
    trainer: TrainerConfig
    spread: Spread
    shape: ClipShape
    tokens: int
    trained: int
    block: int
    cost: StepCost
    frozen: Mapping[str, int] = field(default_factory=dict[str, int])
    frozen_parts: int = 0
    not_averaged: int = 0
    before: StepCost = field(default_factory=StepCost)

    @property
    def parts(self) -> dict[str, float]:
        """Bytes a device of everything that is held at the worst moment, by name; their sum is ``total``."""
        own, shards = 4 * self.trained / self.spread.shards, self.spread.shards
        average = own - 4 * self.not_averaged / shards
        parts = {"weights": own, "moments": 2 * own, "average": average, **self.frozen}
        if torch.device(self.trainer.device).type == "cpu":
            parts["state being written"] = 3 * own + average  # elsewhere this copy lies in the host's memory
        parts["frozen scores"] = self.frozen_parts / shards
        # Two blocks are gathered at a time, and the gradients of one are summed, in bfloat16 and float32.
        parts["gathered"] = 0 if shards == 1 else self.block * (2 * 2 + 2 + 4)
        gradients = self.cost.gradients  # of one model at a time, where two are trained in turn
        if shards == 1 and self.spread.micro_steps == 1:
            # Gradients come as activations go.
            step = {"gradients": gradients, "activations": self.cost.peak - gradients}
        else:
            step = {
                "gradients": gradients / shards if self.spread.reduced_at_once else gradients,
                "activations": self.cost.activations,
            }
        if sum(step.values()) < self.before.activations:
            step = {"encoding clips": self.before.activations}
        return {name: size for name, size in (parts | step).items() if size}

    @property
    def total(self) -> float:
        """Most bytes at once on one device."""
        return sum(self.parts.values())

    def fits(self, memory: float) -> bool:
        """Whether a device of so many bytes holds it."""
        return self.total <= USABLE * memory

    def line(self, memory: float) -> str:
        """The sheet's line: the sum and its parts, in GB."""
        named = ", ".join(f"{name} {gigabytes(size)}" for name, size in self.parts.items())
        return f"{self.title}: {gigabytes(self.total)} of {gigabytes(memory)} GB a device ({named})"


def gigabytes(size: float) -> str:
    """Bytes as GB (10^9), short enough for a table."""
    value = size / 1e9
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 0.1 else f"{value:.3f}"


Estimate = Callable[[Spread], StageMemory]


def fitting_setting(estimate: Estimate, spread: Spread, memory: float, lengths: Sequence[int]) -> str:
    """The nearest setting with which a stage would fit devices of ``memory`` bytes, in words."""
    again = replace(spread, checkpointing="block", reduced_at_once=True)
    block = estimate(again)
    for shards in (spread.shards * 2**power for power in range(11)):
        wider = replace(block, spread=replace(again, shards=shards))  # more parts change nothing in what is computed
        if wider.fits(memory):
            devices = "" if shards == spread.shards else f" over {shards} devices"
            summed = "" if spread.reduced_at_once or shards == 1 else ", reduce_every_micro_step: true"
            return f"trainer.sharding.checkpointing: block{summed}{devices} ({gigabytes(wider.total)} GB a device)"
    for frames in sorted(set(lengths), reverse=True)[1:]:
        shorter = estimate(replace(again, frames=frames, shards=spread.shards * 1024))
        if shorter.fits(memory):
            return f"trainer.sharding.checkpointing: block, and clips of at most {frames} frames, over more devices"
    return "devices of more memory, or a smaller model"


def device_memory(device: str, root: Path = Path("/")) -> float:
    """Bytes that a training may take: all of a card's, or what this machine could hand out now.

    On a CPU: available memory, or what the control group leaves where it is less. Files in the page cache count as free:
    they give way. Where the system does not say what is available (it is not Linux), all of its memory.

    Args:
        root: where ``proc`` and ``sys`` are mounted.
    """
    if torch.device(device).type == "cuda":
        return float(torch.cuda.get_device_properties(device).total_memory)
    meminfo, group = root / "proc/meminfo", root / "sys/fs/cgroup"
    if not meminfo.is_file():
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    free = 1024 * _numbers(meminfo)["MemAvailable:"]
    limit = group / "memory.max"
    if limit.is_file() and (most := limit.read_text(encoding="ascii").strip()) != "max":
        held, files = int((group / "memory.current").read_text(encoding="ascii")), _numbers(group / "memory.stat")
        free = min(free, int(most) - held + files["active_file"] + files["inactive_file"])
    return float(free)


def _numbers(path: Path) -> dict[str, int]:
    """The lines of a file of the kernel that say one number."""
    rows = (line.split() for line in path.read_text(encoding="ascii").splitlines())
    return {row[0]: int(row[1]) for row in rows}


def rough_bytes(model: WorldModelConfig, shape: ClipShape, *, models: int = 1) -> float:
    """Some three times what training takes, in no time: most small models need no closer look.

    Args:
        models: how many are held, trained or not.
    """
    with torch.device("meta"):
        parameters = sum(value.numel() for value in WorldModel(model).parameters())
    width = 20 * model.hidden_size + 8 * model.num_heads * model.head_dim + 6 * model.intermediate_size
    return models * (24 * parameters + 4 * width * model.num_layers * shape.clips * shape.tokens(model))


def require_fit(estimate: Estimate, trainer: TrainerConfig, lengths: Sequence[int], rough: float) -> None:
    """Refuse a stage that this process's device cannot hold. Call it before processes join: nothing is computed.

    Args:
        rough: from `rough_bytes`; where twice that is there, nothing else is asked.

    Raises:
        ConfigError: the sheet's line, and the setting that would fit.
    """
    memory = device_memory(trainer.device)
    if 2 * rough < memory:
        return
    spread = Spread.of(trainer, int(os.environ.get("WORLD_SIZE", "1")))
    need = estimate(spread)
    if not need.fits(memory):
        raise ConfigError(
            "This training does not fit the device's memory.",
            where=f"{need.title} on {trainer.device}",
            expected=f"at most {gigabytes(USABLE * memory)} GB",
            got=need.line(memory),
            next_step=f"set {fitting_setting(estimate, spread, memory, lengths)}; `worldline plan` shows every stage",
        )
