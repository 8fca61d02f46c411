"""What Stage I and Stage II of a run train (the library's objectives, on batches out of memory that depend on the step alone)
and how each step is trained.

Axes: b clips, v views, c latent channels, t latent frames, h and w rows and columns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MethodType
from typing import Any, Literal

import torch
from einops import repeat
from torch import Tensor

from tools.small_world_data import GRID, SHORT, SIGMA_PX_REF, VIEWS
from tools.small_world_memory import Episodes, KnownSimilarities, Memory, maps_of_latent_frames
from tools.small_world_runs import BaseSettings, MatchingSettings, Stage2Settings, Timed, TokenizerSettings, key_of
from worldline_core.distillation.distill_config import CYCLE
from worldline_core.errors import ConfigError
from worldline_core.model.checkpoint import CheckpointInfo, load_checkpoint
from worldline_core.model.layers import new_action_branch
from worldline_core.model.text import load_text_encoder
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import (
    ActionContract,
    TextConfig,
    TrainedClips,
    WorldModelConfig,
)
from worldline_core.store.artifact_files import read_json, read_json_lines
from worldline_core.store.atomic import write_json_atomic
from worldline_core.training.clip_loader import Batch
from worldline_core.training.clip_sampler import Clip
from worldline_core.training.flow_matching import FlowMatchingObjective
from worldline_core.training.relational import RelationalTerm
from worldline_core.training.stage1 import stage1_groups
from worldline_core.training.stage2 import stage2_groups
from worldline_core.training.trainer import (
    NamedBatch,
    Objective,
    ParameterGroup,
    TrainingResult,
    step_generator,
    train,
)
from worldline_core.training.training_config import LossWeighting, RelationalConfig, SigmaSampling, TrainerConfig

VIEW_SHARES = (0.5, 0.25, 0.25)
"""Of steps or clips on single views: the head view counts as much as both wrist views."""
PACE_STEPS = 6 * CYCLE
"""Steps that tell what a step takes; the first third, in which much is done once, does not count."""


@dataclass(frozen=True)
class Step:
    """What is ready to train.

    Attributes:
        saved: what `save_checkpoint` is told of a model besides averaged weights and metadata.
        held_out: losses on validation recordings; None where none are measured while it trains.
    """

    objective: Objective[Any]
    groups: list[ParameterGroup]
    load: Callable[[int], NamedBatch]
    saved: dict[str, Any] = field(default_factory=dict)
    held_out: Callable[[TrainerConfig], dict[str, float]] | None = None


@dataclass(frozen=True)
class Start:
    """What a step starts from: recordings, a seed, and a checkpoint (None: nothing, a model of ``config``).

    ``stage2``: the Stage II model of the run, whose score distribution matching follows.
    """

    memory: Memory
    seed: int
    config: WorldModelConfig
    parent: Path | None
    stage2: Path | None

    def draws(self, index: int) -> torch.Generator:
        """Random numbers for the clips of a step: others than those of its noise."""
        return step_generator(self.seed + 50, index, "cpu")

    def new_model(self, **changes: object) -> WorldModel:
        """A model with random weights, the same for a seed."""
        model = WorldModel(self.config.model_copy(update=changes))
        model.initialise(torch.Generator().manual_seed(self.seed))
        return model.to(self.memory.device)

    def loaded(
        self,
        folder: Path | None,
        *kinds: Literal["base", "stage2", "causal"],
        action_frames: Literal[1, 4] | None = None,
    ) -> tuple[WorldModel, CheckpointInfo]:
        """The video tower of a checkpoint; ``action_frames`` as in `load_checkpoint`.

        Raises: ConfigError when there is none; CheckpointError for one of another kind.
        """
        if folder is None:
            raise ConfigError(
                "This step starts from a model", expected=f"a step before it, or start: a {kinds[-1]} model"
            )
        model, info = load_checkpoint(folder, expect_kind=kinds, towers="generation", action_frames=action_frames)
        return model.to(self.memory.device), info


def trained(
    settings: Timed,
    seed: int,
    device: str,
    title: str,
    output: Path,
    identity: dict[str, Any],
    make: Callable[[], Step],
) -> tuple[TrainingResult, dict[str, int], Step]:
    """Train, or go on: averaged weights, counts of steps and clips, and what ``make`` made.

    A length in seconds becomes a number of steps once, in ``pace.json`` beside ``output``, for all seeds alike.
    """

    def run(step: Step, folder: Path, steps: int, log_every: int) -> TrainingResult:
        config = settings.trainer(steps, seed, device, log_every)
        return train(
            config,
            groups=step.groups,
            objective=step.objective,
            load=step.load,
            validate=None if step.held_out is None else partial(step.held_out, config),
            output=folder,
            identity={**identity, "steps": steps},
            title=title,
            schedule=partial(settings.factor, steps=steps) if isinstance(settings, TokenizerSettings) else None,
        )

    steps = settings.steps
    if steps is None:
        path, key = output.parent / "pace.json", key_of({"step": title, "settings": settings.model_dump(mode="json")})
        pace = read_json(path)
        if key not in pace:
            with TemporaryDirectory() as folder:
                run(make(), Path(folder), PACE_STEPS, CYCLE)
                seconds = [row["seconds"] for row in read_json_lines(Path(folder) / "run" / "timings.jsonl")]
            first = len(seconds) // 3
            pace[key] = (seconds[-1] - seconds[first - 1]) / (CYCLE * (len(seconds) - first))
            write_json_atomic(path, pace)
        steps = max(1, round((settings.seconds or 0.0) / pace[key]))
    if isinstance(settings, MatchingSettings):
        steps = CYCLE * -(-steps // CYCLE)
    step = make()
    return run(step, output, steps, 5 * CYCLE), {"steps": steps, "clips": steps * settings.batch}, step


def named(episodes: Episodes, rows: Tensor) -> tuple[Clip, ...]:
    """Whole episodes as clips."""
    return tuple(Clip(episodes.facts[row].id, 0, SHORT, 1) for row in rows.tolist())


def drawn(count: int, size: int, draws: torch.Generator) -> Tensor:
    """Random numbers (size,) below ``count``."""
    return torch.randint(count, (size,), generator=draws)


def object_weights(things: Tensor, moved: float, others: float) -> Tensor:
    """Loss weights (b v 1 t h w) of mean one over the noisy frames, larger where things are or were at the start.

    Args:
        things: (b v 2 t h w) share of each cell that shows what the task moves, and other things.
        moved, others: extra weight of a cell that is full of them.
    """
    seen = torch.maximum(things, things[:, :, :, :1])
    weight = 1 + moved * seen[:, :, :1].sqrt() + others * seen[:, :, 1:].sqrt()
    return weight / weight[:, :, :, 1:].mean(dim=(1, 2, 3, 4, 5), keepdim=True)


_COMPILED: dict[str, Callable[..., Any]] = {}


def compile_pass(model: WorldModel, name: Literal["forward", "forward_teacher_forcing"]) -> None:
    """Compile a pass of this model, or take what was compiled for one of its kind before."""
    from torch._dynamo import config as compiler

    compiler.recompile_limit = 64  # each kind of model and each shape is compiled once
    if name not in _COMPILED:
        _COMPILED[name] = torch.compile(getattr(WorldModel, name), dynamic=False)
    setattr(model, name, MethodType(_COMPILED[name], model))


def base_step(start: Start, settings: BaseSettings) -> Step:
    """Text and the first frame to one view."""
    episodes, shares = start.memory.episodes(), torch.tensor(VIEW_SHARES)
    model = start.new_model(towers="both")
    encoder = load_text_encoder(TextConfig(), model.config.vocab_size)
    objective = FlowMatchingObjective(
        model, sigma=SigmaSampling(shift=3.0), weighting=LossWeighting(motion=1.0), text_dropout=0.1
    )

    def load(index: int) -> Batch:
        draws = start.draws(index)
        rows = drawn(len(episodes), settings.batch, draws)
        view = int(torch.multinomial(shares, 1, generator=draws))
        ids, mask = encoder([episodes.facts[row].instruction for row in rows.tolist()], [])
        latents = episodes.latents[rows, view : view + 1].float()
        ids, mask = ids.to(latents.device), mask.to(latents.device)
        return Batch(named(episodes, rows), VIEWS[view : view + 1], latents, text_ids=ids, text_mask=mask)

    return Step(objective, stage1_groups(model), load, {"model": model, "kind": "base", "action_contract": None})


def stage2_step(start: Start, settings: Stage2Settings) -> Step:
    """Controls and first frames to the views."""
    episodes, size = start.memory.episodes(), settings.native_size
    film = {} if size is None else {"action_conditioning": "native_film", "action_channels": size}
    taken = settings.action_frames
    torch.manual_seed(start.seed)  # of a new action branch's first layer
    if start.parent is None:
        model = start.new_model(towers="generation", action_frames=taken, **film)
    else:
        model = start.loaded(start.parent, "base", "stage2", action_frames=taken)[0]
        if size is not None and model.config.native_size != size:
            model.config = model.config.model_copy(update=film)
            model.action_encoder = new_action_branch(model.config).to(start.memory.device)
    term = None
    if settings.relational:
        term = RelationalTerm(RelationalConfig(), KnownSimilarities(episodes), model.config.num_layers)
    objective = FlowMatchingObjective(
        model,
        sigma=settings.sigma,
        weighting=LossWeighting(motion=settings.motion),
        action_dropout=settings.action_dropout,
        relational=term,
    )
    eligible, chosen = episodes.ended(settings.outcomes), [VIEWS.index(view) for view in settings.views]

    def load(index: int) -> Batch:
        rows = eligible[drawn(len(eligible), settings.batch, start.draws(index))]
        return Batch(
            named(episodes, rows),
            settings.views,
            episodes.latents[rows][:, chosen].float(),
            controls_of(episodes.maps[rows], episodes.native[rows], settings.views, model.config),
            weights=object_weights(episodes.things[rows][:, chosen].float(), *settings.things),
        )

    contract = ActionContract(
        controls="action",
        sigma_px_ref=SIGMA_PX_REF,
        fps=8.0,
        grid_size=GRID,
        tokenizer=start.memory.tokenizer.encoder_digest[:16],
    )
    trained = None if settings.views == VIEWS else TrainedClips(views=settings.views, strides=(1,))
    if settings.compile:
        compile_pass(model, "forward")
    saved = {"model": model, "kind": "stage2", "action_contract": contract, "trained": trained}
    return Step(objective, stage2_groups(model, settings.action_multiplier), load, saved)


def controls_of(maps: Tensor, native: Tensor, views: Sequence[str], config: WorldModelConfig) -> Tensor:
    """What a model takes of the maps of every frame, or of control vectors (b v size t 1 1), in single precision."""
    if config.native_size is None:
        chosen = maps[:, [VIEWS.index(view) for view in views]]
        return maps_of_latent_frames(chosen, config.action_frames).float()
    return repeat(native[:, : config.native_size], "b c t -> b v c t 1 1", v=len(views)).float()
