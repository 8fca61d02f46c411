"""What each step of a run trains: the library's objectives, on batches out of memory that depend on the step alone.

Axes: b clips, v views, c latent channels, t latent frames, h and w rows and columns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MethodType
from typing import Any, Literal

import torch
from einops import repeat
from torch import Tensor

from tools.small_world_data import GRID, SHORT, SIGMA_PX_REF, VIEWS
from tools.small_world_memory import Episodes, KnownRelations, Memory
from tools.small_world_runs import (
    BaseSettings,
    ForcingSettings,
    MatchingSettings,
    RegressionSettings,
    Stage2Settings,
    Timed,
)
from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.distillation.causal_objective import CausalObjective, maps_of, with_observed_frame
from worldline_core.distillation.causal_teacher_forcing import teacher_forcing_loss
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.distillation.distribution_matching import DistributionMatchingObjective
from worldline_core.distillation.teacher_trajectories import teacher_trajectories
from worldline_core.distillation.trajectory_regression import TrajectoryObjective
from worldline_core.distillation.trajectory_store import TrajectoryBatch
from worldline_core.errors import ConfigError
from worldline_core.model.action_branch import new_action_branch
from worldline_core.model.checkpoint import CheckpointInfo, load_checkpoint
from worldline_core.model.contracts import CAUSAL_SIGMAS, NATIVE_VECTORS, ActionContract, TrainedClips
from worldline_core.model.text import load_text_encoder
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import TextConfig, WorldModelConfig
from worldline_core.rollout.samplers import euler_step
from worldline_core.training.clip_loader import Batch
from worldline_core.training.clip_source import Clip
from worldline_core.training.flow_matching import FlowMatchingObjective
from worldline_core.training.relational import RelationalTerm
from worldline_core.training.stage import VALIDATION_SEED
from worldline_core.training.stage1 import stage1_groups
from worldline_core.training.stage2 import stage2_groups
from worldline_core.training.trainer import (
    NamedBatch,
    Objective,
    ParameterGroup,
    held_out_losses,
    step_generator,
)
from worldline_core.training.training_config import LossWeighting, RelationalConfig, SigmaSampling, TrainerConfig

VIEW_SHARES = (0.5, 0.25, 0.25)
"""Of steps or clips on single views: the head view counts as much as both wrist views."""
LONG_BLOCKS = 4
"""Blocks of a cut of a long recording: 65 frames."""
MOST_VALIDATED = 120
"""Validation recordings that are looked at while a model trains."""
SHORT_LATENTS = 1 + (SHORT - 1) // TEMPORAL_FACTOR
"""Latent frames of a short recording."""


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
        self, folder: Path | None, *kinds: Literal["base", "stage2", "causal"]
    ) -> tuple[WorldModel, CheckpointInfo]:
        """The video tower of a checkpoint.

        Raises: ConfigError when there is none; CheckpointError for one of another kind.
        """
        if folder is None:
            raise ConfigError(
                "This step starts from a model", expected=f"a step before it, or start: a {kinds[-1]} model"
            )
        model, info = load_checkpoint(folder, expect_kind=kinds, towers="generation")
        return model.to(self.memory.device), info


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
    torch.manual_seed(start.seed)  # of a new action branch's first layer
    if start.parent is None:
        model = start.new_model(towers="generation", **film)
    else:
        model = start.loaded(start.parent, "base", "stage2")[0]
        if size is not None and model.config.native_size != size:
            model.config = model.config.model_copy(update=film)
            model.action_encoder = new_action_branch(model.config).to(start.memory.device)
    term = None
    if settings.relational:
        term = RelationalTerm(RelationalConfig(), KnownRelations(episodes), model.config.num_layers)
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
            controls_of(episodes.maps[rows], episodes.native[rows], settings.views, size),
            weights=object_weights(episodes.things[rows][:, chosen].float(), *settings.things),
        )

    contract = ActionContract.of_these_maps(
        controls="action",
        sigma_px_ref=SIGMA_PX_REF,
        wrist_projection="current_camera",
        fps=8.0,
        grid_size=GRID,
        tokenizer=start.memory.tokenizer.encoder_digest[:16],
        **({} if size is None else {"maps": NATIVE_VECTORS}),
    )
    trained = None if settings.views == VIEWS else TrainedClips(views=settings.views, strides=(1,))
    if settings.compile:
        compile_pass(model, "forward")
    saved = {"model": model, "kind": "stage2", "action_contract": contract, "trained": trained}
    return Step(objective, stage2_groups(model, settings.action_multiplier), load, saved)


def controls_of(maps: Tensor, native: Tensor, views: Sequence[str], native_size: int | None) -> Tensor:
    """Action maps of the views, or control vectors (b v size t 1 1) for a model that takes these, in single precision."""
    if native_size is None:
        return maps[:, [VIEWS.index(view) for view in views]].float()
    return repeat(native[:, :native_size], "b c t -> b v c t 1 1", v=len(views)).float()


def distillation(seed: int, sigmas: tuple[float, ...] = CAUSAL_SIGMAS) -> DistillConfig:
    """Stage III of the small world: no perceptual term, plain few-step trajectories, recorded targets."""
    without_lpips = {"auxiliary": {"lpips": 0.0}}
    return DistillConfig.model_validate(
        {
            "clips": {"lengths": [SHORT, 1 + 16 * LONG_BLOCKS]},
            "sigmas": sigmas,
            "trajectory_regression": {**without_lpips, "trajectories": {"substeps": [1] * (len(sigmas) - 1)}},
            "distribution_matching": {
                **without_lpips,
                "sigma_range": [0.1, 0.98],
                "target": "recorded",
                "trainer": {"steps": 6, "log_every": 6, "seed": seed},
            },
        }
    )


def is_long(number: int, every: int) -> bool:
    """Whether a batch is one of long recordings."""
    return every > 0 and number % every == every - 1


def recorded_batch(
    memory: Memory, size: int, draws: torch.Generator, *, long: bool, things: tuple[float, float] = (0.0, 0.0)
) -> TrajectoryBatch:
    """Clips and where the robot is; long ones are a third as many. The nodes are the recording itself.

    Args:
        things: extra weight of what the task moves, and of other things.
    """
    episodes = memory.episodes(short=not long)
    rows = drawn(len(episodes), size // 3 if long else size, draws)
    if long:
        starts = drawn(episodes.latents.shape[3] - 4 * LONG_BLOCKS, len(rows), draws)
        latents, maps, robot, shares = episodes.cuts(rows, starts, LONG_BLOCKS)
    else:
        latents, maps, robot, shares = episodes.clips(rows)
    return TrajectoryBatch(
        clips=named(episodes, rows),
        views=VIEWS,
        latents=latents,
        action_maps=maps,
        weights=object_weights(shares, *things),
        nodes=latents[:, None],
        history=latents,
        mask=robot,
    )


class ForcingObjective(CausalObjective[Batch]):
    """Teacher forcing where the blocks before are not exact, as in a rollout.

    They are disturbed by noise of a level of its own for each clip, or what the model itself makes of them.

    Args:
        teacher: Stage II model that says in part what blocks should become; None: the recording does.
    """

    def __init__(
        self, model: WorldModel, config: DistillConfig, settings: ForcingSettings, teacher: WorldModel | None = None
    ) -> None:
        super().__init__(model, config)
        self.settings, self.teacher = settings, teacher

    def target(self, batch: Batch, noise: Tensor) -> Tensor:
        """Latents (b v c t h w) that the blocks should become; the observed frame is the recorded one."""
        latents, teacher, share = batch.latents, self.teacher, self.settings.teacher_share
        if teacher is None or latents.shape[3] != SHORT_LATENTS:  # it knows clips of one length
            return latents
        state, level = with_observed_frame(latents[..., :1, :, :], noise[..., 1:, :, :]), latents.new_ones(len(latents))
        with torch.no_grad():
            velocity = teacher(state, level, action_maps=maps_of(batch), views=batch.views).velocity
        predicted = euler_step(state, velocity, 1.0, 0.0)
        mixed = torch.lerp(latents, predicted, share)
        return with_observed_frame(latents[..., :1, :, :], mixed[..., 1:, :, :])

    def loss(self, batch: Batch, generator: torch.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        """Teacher-forcing loss of one batch."""
        device = batch.latents.device
        disturbance = torch.randn(batch.latents.shape, generator=generator, device=device)
        latents = self.target(batch, disturbance)
        if self.settings.history == "generated":
            size = self.spec.block_size  # the last block is nobody's history
            maps, noise = (value[..., :-size, :, :] for value in (maps_of(batch), disturbance))
            generated = self.rollout(batch, maps, noise, self.spec.steps - 1, with_gradient=False)
            history = torch.cat((generated.to(latents), latents[..., -size:, :, :]), dim=3)
        else:
            level = torch.rand((len(latents), 1, 1, 1, 1, 1), generator=generator, device=device)
            disturbance[..., :1, :, :] = 0
            history = batch.latents + self.settings.history_noise * level * disturbance
        loss = teacher_forcing_loss(
            self.model,
            latents,
            maps_of(batch),
            history=history,
            views=batch.views,
            spec=self.spec,
            sampling=self.settings.sigma,
            weighting=LossWeighting(motion=1.0),
            weights=batch.weights,
            generator=generator,
        )
        return loss, {}


def causal_step(start: Start, settings: ForcingSettings | RegressionSettings | MatchingSettings) -> Step:
    """One of the three steps of Stage III.

    Raises: ConfigError for a model of other views or controls than the three views and action maps.
    """
    memory = start.memory
    model, info = start.loaded(start.parent, "stage2", "causal")
    if isinstance(settings, ForcingSettings):
        config = distillation(start.seed, settings.sigmas)
    else:
        config = distillation(start.seed, CAUSAL_SIGMAS if info.causal is None else info.causal.sigmas)
    if info.views != VIEWS or info.config.native_size is not None:
        raise ConfigError(
            "The causal model takes maps and all views", where=start.parent, expected=VIEWS, got=info.views
        )
    groups = [ParameterGroup("student", dict(model.named_parameters()))]
    saved = {"model": model, "kind": "causal", "action_contract": info.contract, "causal": config.spec}
    if isinstance(settings, ForcingSettings):
        if settings.compile:
            compile_pass(model, "forward_teacher_forcing")

        def forcing(index: int) -> Batch:
            long = is_long(index, settings.long_every)
            return recorded_batch(memory, settings.batch, start.draws(index), long=long, things=settings.things)

        teacher = None if settings.teacher is None else start.loaded(settings.teacher, "stage2")[0].eval()
        objective = ForcingObjective(model, config, settings, teacher)

        def held_out(trainer: TrainerConfig) -> dict[str, float]:
            episodes, batches = memory.episodes("validation"), trainer.validation_batches
            size = max(1, min(MOST_VALIDATED, len(episodes)) // batches)

            def batch(index: int) -> Batch:
                rows = torch.arange(index * size, (index + 1) * size) % len(episodes)
                latents, maps, _, _ = episodes.clips(rows)
                return Batch(named(episodes, rows), VIEWS, latents, maps)

            return held_out_losses(trainer, batch, objective.validation_losses, VALIDATION_SEED)

        return Step(objective, groups, forcing, saved, held_out if memory.count("validation") else None)
    if isinstance(settings, MatchingSettings):
        real, fake = (start.loaded(start.stage2, "stage2")[0] for _ in range(2))
        matching = DistributionMatchingObjective(model, real, fake.train(), config, None)
        rate = config.distribution_matching.fake_score_rate
        groups.append(ParameterGroup("fake score", dict(fake.named_parameters()), rate, averaged=False))

        def matched(index: int) -> Batch:
            return recorded_batch(memory, settings.batch, start.draws(index), long=False)

        return Step(matching, groups, matched, saved)
    teacher = start.loaded(start.parent, "causal")[0].eval().requires_grad_(False)
    stored = [trajectories(start, teacher, config, settings, number) for number in range(settings.batches)]

    def regression(index: int) -> Batch:
        draws = start.draws(index)
        made = stored[int(drawn(len(stored), 1, draws))]
        rows = torch.randperm(len(made.latents), generator=draws)[: settings.batch]
        parts = {name: value[rows].float() for name, value in vars(made).items() if isinstance(value, Tensor)}
        return TrajectoryBatch(clips=tuple(made.clips[row] for row in rows.tolist()), views=VIEWS, **parts)

    return Step(TrajectoryObjective(model, config, None), groups, regression, saved)


def trajectories(
    start: Start, teacher: WorldModel, config: DistillConfig, settings: RegressionSettings, number: int
) -> TrajectoryBatch:
    """The teacher's trajectories of some clips, in half precision: a function of seed and number."""
    # Negative numbers are no steps: these are other clips than the steps'.
    draws = start.draws(-1 - number)
    batch = recorded_batch(start.memory, settings.clips, draws, long=is_long(number, settings.long_every))
    device = batch.latents.device
    noise = torch.randn(
        batch.latents.shape, generator=step_generator(start.seed, -1 - number, str(device)), device=device
    )
    with torch.autocast(device.type, torch.bfloat16):
        nodes = teacher_trajectories(
            teacher,
            batch.latents,
            maps_of(batch),
            noise,
            views=VIEWS,
            spec=config.spec,
            substeps=config.trajectory_regression.trajectories.substeps,
        )
    halves = {name: value.half() for name, value in vars(batch).items() if isinstance(value, Tensor)}
    return TrajectoryBatch(clips=batch.clips, views=VIEWS, **{**halves, "nodes": nodes.half()})


def open_step(start: Start, settings: Timed) -> Step:
    """A step by its settings."""
    if isinstance(settings, BaseSettings):
        return base_step(start, settings)
    if isinstance(settings, Stage2Settings):
        return stage2_step(start, settings)
    if isinstance(settings, ForcingSettings | RegressionSettings | MatchingSettings):
        return causal_step(start, settings)
    raise ConfigError("No step of a run", got=type(settings).__name__)
