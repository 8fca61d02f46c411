"""The distill step: Stage II in, a few-step block-causal simulator out (paper, Stage III).

Folder: `teacher_forcing/` and `trajectory_regression/` hold the intermediate checkpoints (kind "causal"; both can be
rolled out), every step has its `metrics.jsonl`, the result itself is at the top. `run/` keeps the training states and
the offline trajectories; a killed run continues there, and on a CPU ends with the same bytes.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from functools import partial
from pathlib import Path
from typing import Any

import torch

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.actions.episode_tracks import open_controls
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.distillation.auxiliary_losses import PerceptualDistance, PerceptualLoss
from worldline_core.distillation.causal_objective import CausalObjective
from worldline_core.distillation.causal_teacher_forcing import TeacherForcingObjective
from worldline_core.distillation.distill_config import STEPS, DistillConfig, DistillStep
from worldline_core.distillation.distribution_matching import DistributionMatchingObjective
from worldline_core.distillation.trajectory_regression import (
    INDEX,
    TrajectoryBatch,
    TrajectoryLoader,
    TrajectoryObjective,
    TrajectoryStore,
    trajectory_shard,
    write_trajectories,
)
from worldline_core.errors import CheckpointError, ConfigError
from worldline_core.model.checkpoint import (
    CheckpointInfo,
    CheckpointKind,
    load_checkpoint,
    read_checkpoint_info,
)
from worldline_core.model.lpips import load_lpips
from worldline_core.model.tokenizers import WanTokenizer, load_tokenizer
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import match_views
from worldline_core.store.atomic import write_bytes_atomic
from worldline_core.training.adapters import prepare, save_trained
from worldline_core.training.clip_config import ClipSampling, FrameInput
from worldline_core.training.clip_loader import Batch, ClipLoader
from worldline_core.training.clip_sampler import ClipRow, ClipSampler
from worldline_core.training.clip_source import open_source, training_rows
from worldline_core.training.optimizers import require_one_process
from worldline_core.training.processes import (
    ALONE,
    BatchPlan,
    hold_weights,
    join_processes,
    place_model,
    processes,
    wait_for_all,
)
from worldline_core.training.stage import HeldOutClips, weights_of
from worldline_core.training.trainer import ParameterGroup, batch_plan, train, trained_groups
from worldline_core.training.training_config import TrainerConfig

logger = logging.getLogger(__name__)

TRAJECTORIES = "trajectories"
LPIPS_OFF = "off: no LPIPS weights configured"


def distill(config: DistillConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Distill `stage2` on `tracks` and `episodes`; `tokenizer` decodes frames for the perceptual term.

    Clips are cached `latents`, or frames that `tokenizer` encodes on the way (the trajectories keep their latents). With
    `causal`, a causal model of that Stage II model's form goes on: step 1 starts from its weights.

    Raises:
        CheckpointError: the checkpoint is not of Stage II, or its action maps and latents are not those given here.
        DataError: no clip fits the blocks.
        TrainingError: a loss or gradient is not finite.
    """
    torch.manual_seed(config.teacher_forcing.trainer.seed)
    run = DistillationRun(config, inputs, output)
    steps: dict[DistillStep, Callable[[], dict[str, float]]] = {
        "teacher_forcing": run.teacher_forcing,
        "trajectory_regression": run.trajectory_regression,
        "distribution_matching": run.distribution_matching,
    }
    metrics: dict[str, float] = {}
    for name in config.trainers:
        metrics |= steps[name]()
    kept = sum(row.split in config.splits for row in run.rows)
    return {
        "found": len(run.rows),
        "kept": kept,
        "left_out": {"in other splits": len(run.rows) - kept},
        "steps": {name: read_checkpoint_info(run.folder(name)).metadata["step"] for name in config.trainers},
        "lpips": run.lpips,
        "episodes": kept,
        **metrics,
    }


class DistillationRun:
    """Clips, teacher, training and saving, shared by the three steps.

    Raises:
        CheckpointError: the checkpoint's action maps and latents are not those given here.
    """

    def __init__(self, config: DistillConfig, inputs: Mapping[str, Path], output: Path) -> None:
        device = config.teacher_forcing.trainer.device
        join_processes(device)
        for trainer in config.trainers.values():
            require_one_process(trainer, {"distill.lora": config.lora is not None})
        self.config, self.output, self.stage2 = config, output, Path(inputs["stage2"])
        self.info = info = read_checkpoint_info(self.stage2)
        self.start = Path(inputs.get("causal", self.stage2))
        if self.start != self.stage2:
            self._check_continued(read_checkpoint_info(self.start))
        native, self.vector_share = info.config.native_size, 0.0 if info.vectors is None else info.vectors.share
        self.episodes = episodes = EpisodeSet.open(Path(inputs["episodes"]))
        tracks = open_controls(inputs, episodes, vectors=native is not None, controls=info.contract.controls)
        self.source = open_source(config.input, inputs, episodes, device)
        found = {"tokenizer": self.source.description["tokenizer"], "grid_size": self.source.latent_shape[1:]}
        info.contract.require(where=self.source.root, **found)
        self.rows = training_rows(
            self.source, episodes, stage=2, views=config.views, tracks=tracks, vectors=native is not None
        )
        self.rows = self._known(self.rows)
        info.contract.require_tracks((row.episode_id for row in self.rows), tracks)
        for views in self._sampler(config.teacher_forcing.trainer, config.clips, ALONE).view_sets(info.config.views):
            match_views(info.view_sets, views, f"distill.views, of the Stage II model {self.stage2}")
        self.loader = ClipLoader(
            self.source, views=tuple(config.views), tracks=tracks,
            action_frames=info.config.action_frames, frame_rates={row.episode_id: row.fps for row in episodes.rows},
            native_size=native, maps=info.config.takes_maps, device=device,
        )  # fmt: skip
        self.tokenizer = Path(inputs["tokenizer"])
        self.perceptual = _perceptual(config, self.tokenizer, device)
        unused = LPIPS_OFF if config.lpips_weights is None else "off: teacher forcing does not use it"
        self.lpips = "on" if self.perceptual is not None else unused

    def folder(self, step: str) -> Path:
        """Folder of a step's checkpoint; the last step's is the result itself."""
        return self.output if step == self.config.last_step else self.output / step

    def _known(self, rows: Sequence[ClipRow]) -> list[ClipRow]:
        """Episodes whose views, and whose robot's control vectors, the Stage II model knows; all where it knows the views of none."""
        sets = {frozenset(views) for views in self.info.view_sets}
        robots = None if self.info.vectors is None else self.info.vectors.embodiments
        known = [row for row in rows if frozenset(row.views) & set(self.config.views) in sets] or rows
        known = [row for row in known if robots is None or row.embodiment in robots]
        if len(known) < len(rows):
            logger.warning(
                "%d of %d episodes are left out: the Stage II model knows the views %s together%s.",
                len(rows) - len(known), len(rows), " or ".join(" + ".join(views) for views in self.info.view_sets),
                "" if robots is None else f", and the control vectors of {', '.join(robots)}",
            )  # fmt: skip
        return known

    def _check_continued(self, causal: CheckpointInfo) -> None:
        """Raises: CheckpointError: the causal model has another form or contract than the Stage II model."""
        causal.contract.require(where=self.stage2, **self.info.contract.model_dump())
        ours, theirs = (info.config.model_dump(exclude={"towers"}) for info in (self.info, causal))
        differing = [name for name in ours if ours[name] != theirs[name]]
        if differing:
            raise CheckpointError(
                "A causal model goes on beside a Stage II model of its own form",
                where=f"{self.start}: {', '.join(differing)}",
                expected={name: ours[name] for name in differing},
                got={name: theirs[name] for name in differing},
                next_step="give the Stage II model that it was distilled from, or leave out the input causal",
            )
        if causal.causal != self.config.spec:
            logger.warning("The causal model goes on with other blocks: %s, now %s.", causal.causal, self.config.spec)

    def teacher_forcing(self) -> dict[str, float]:
        """Step 1, from the Stage II model, or from a causal one that goes on."""
        settings, work = self.config.teacher_forcing, self._work(STEPS[0])
        kind = "stage2" if self.start == self.stage2 else "causal"
        model, info = self._trained(self.start, settings.trainer, expect_kind=kind)
        plan = batch_plan(settings.trainer, work)
        sampler = self._sampler(settings.trainer, self.config.first_clips, plan)
        teacher = self._frozen(settings.trainer) if settings.teacher_share else None
        objective = TeacherForcingObjective(model.train(), self.config, teacher)
        loader = copy(self.loader)
        loader.object_weights = weights_of(settings.weighting, self.episodes, self.source, self.rows, loader.device)
        load = loader.batches(sampler, self.config.input.workers)
        return self._train(STEPS[0], settings.trainer, objective, load, info, self.start)

    def trajectory_regression(self) -> dict[str, float]:
        """Step 2, from step 1's model, on trajectories that this model makes."""
        settings = self.config.trajectory_regression
        self._make_trajectories()
        start = self.folder(STEPS[0])
        student, info = self._trained(start, settings.trainer, expect_kind="causal")
        objective = TrajectoryObjective(student.train(), self.config, self.perceptual)
        return self._train(STEPS[1], settings.trainer, objective, self._load_trajectories(STEPS[1]), info, start)

    def distribution_matching(self) -> dict[str, float]:
        """Step 3, from step 2's model; the real and the fake score start from the same weights."""
        settings = self.config.distribution_matching
        start = self.folder(STEPS[1])
        student, info = self._trained(start, settings.trainer, expect_kind="causal")
        real = self._frozen(settings.trainer)
        fake = self._trained(self.stage2, settings.trainer, shared=real)[0]
        objective = DistributionMatchingObjective(student.train(), real, fake.train(), self.config, self.perceptual)
        parameters = {f"fake.{name}": value for name, value in fake.named_parameters() if value.requires_grad}
        other = ParameterGroup("fake", parameters, settings.fake_score_rate, averaged=False)
        return self._train(
            STEPS[2], settings.trainer, objective, self._load_trajectories(STEPS[2]), info, start, (other, fake)
        )

    def _trained(
        self,
        folder: Path,
        trainer: TrainerConfig,
        *,
        expect_kind: CheckpointKind | None = None,
        shared: WorldModel | None = None,
    ) -> tuple[WorldModel, CheckpointInfo]:
        """A checkpoint's video tower, to be trained, shared out among the processes; the first one alone reads its weights."""
        first = processes()[0] == 0
        model, info = load_checkpoint(folder, expect_kind=expect_kind, towers="generation", weights=first)
        return prepare(model, trainer, self.config.lora, shared=shared), info

    def _frozen(self, trainer: TrainerConfig) -> WorldModel:
        """The Stage II model's video tower, which is not trained, shared out among the processes."""
        model, _ = load_checkpoint(self.stage2, towers="generation", weights=processes()[0] == 0)
        model.requires_grad_(False)
        return place_model(model, trainer.sharding, precision=trainer.precision, device=trainer.device)

    def _sampler(self, trainer: TrainerConfig, clips: ClipSampling, plan: BatchPlan) -> ClipSampler:
        rows = [row for row in self.rows if row.split in self.config.splits]
        return ClipSampler(
            rows, clips, views=self.config.views, start_step=self.source.start_step,
            batch_size=trainer.batch_size, seed=trainer.seed, plan=plan, vector_share=self.vector_share,
            where=f"clips of the splits {list(self.config.splits)}",
        )  # fmt: skip

    def _work(self, step: str) -> Path:
        """Folder of a step's training state and log until it is finished, or of the offline trajectories."""
        return self.output / "run" / step

    def _make_trajectories(self) -> None:
        """The offline trajectories of the causal teacher; shards that exist are kept."""
        config, folder = self.config, self._work(TRAJECTORIES)
        settings, trainer = config.trajectory_regression.trajectories, config.trajectory_regression.trainer
        if not (folder / INDEX).is_file():
            teacher, info = load_checkpoint(self.folder(STEPS[0]), expect_kind="causal")
            hold_weights(teacher.requires_grad_(False), trainer.precision).to(trainer.device).eval()
            per_shard = min(settings.clips, settings.clips_per_shard)
            drawn = trainer.model_copy(update={"batch_size": per_shard, "seed": settings.seed})
            facts = {
                "teacher": info.weights_sha256,
                "causal": config.spec.model_dump(mode="json"),
                "precision": trainer.precision,
                **settings.model_dump(mode="json"),
                **config.model_dump(mode="json", include={"input", "clips"}),
            }
            # Processes take shards in turn, so none is read ahead.
            load = self.loader.batches(self._sampler(drawn, config.clips, ALONE))
            make = partial(trajectory_shard, config=config, teacher=teacher, loader=self.loader, load=load)
            write_trajectories(folder, -(-settings.clips // per_shard), make, facts)
        if processes()[0] == 0:
            write_bytes_atomic(self.output / STEPS[1] / INDEX, (folder / INDEX).read_bytes())
        wait_for_all()

    def _load_trajectories(self, step: str) -> Callable[[int], TrajectoryBatch]:
        trainer: TrainerConfig = getattr(self.config, step).trainer
        store = TrajectoryStore.open(self._work(TRAJECTORIES))
        kept_latents = isinstance(self.config.input, FrameInput)
        plan = batch_plan(trainer, self._work(step))
        return TrajectoryLoader(store, self.loader, trainer, plan, kept_latents=kept_latents).load

    def _train[BatchT: Batch](
        self,
        step: str,
        trainer: TrainerConfig,
        objective: CausalObjective[BatchT],
        load: Callable[[int], BatchT],
        parent: CheckpointInfo,
        start: Path,
        *others: tuple[ParameterGroup, WorldModel],
    ) -> dict[str, float]:
        """Train one step with the shared loop, then write its checkpoint and metrics; a finished step is only read."""
        folder, log = self.folder(step), self.output / step / "metrics.jsonl"
        if (folder / "checkpoint.json").is_file() and log.is_file():
            return {f"{step}/{name}": value for name, value in read_checkpoint_info(folder).metadata["metrics"].items()}
        config, work, model = self.config, self._work(step), objective.model
        held_out = HeldOutClips(
            config.clips, config.validation_splits, self.loader, self.rows, self.episodes, self.vector_share
        )
        sampler = self._sampler(trainer, config.clips, ALONE)
        result = train(
            trainer,
            groups=trained_groups(
                ParameterGroup("student", dict(model.named_parameters())), *(group for group, _ in others)
            ),
            objective=objective,
            load=load,
            validate=held_out.validation(trainer, objective),
            probe=held_out.action_following(
                config.action_following,
                trainer,
                objective,
                self.tokenizer,
                sampler,
                TEMPORAL_FACTOR * config.spec.block_size,
            ),
            output=work,
            identity={
                "step": step,
                "config": config.model_dump(mode="json"),
                "parent": parent.weights_sha256,
                "stage2": self.info.weights_sha256,
                "episodes": [vars(row) for row in self.rows],
            },
            title=step.replace("_", " "),
            models=(model, *(other for _, other in others)),
        )
        description: dict[str, Any] = {
            "kind": "causal",
            "action_contract": self.info.contract,
            "causal": config.spec,
            "trained": sampler.trained(model.config.views),
            "vectors": self.info.vectors,
            "metadata": {
                "distillation": step,
                "step": result.steps,
                "seed": trainer.seed,
                "start": {"kind": parent.kind, "weights_sha256": parent.weights_sha256},
                "tokenizer": self.source.description["tokenizer"],
                "lpips": self.lpips,
                "metrics": result.metrics,
                **self.source.facts,
            },
        }
        if processes()[0] == 0:
            write_bytes_atomic(log, (work / "metrics.jsonl").read_bytes())
        save_trained(
            folder, model, result.average, start=start, lora=config.lora, description=description, towers="generation"
        )
        wait_for_all()
        return {f"{step}/{name}": value for name, value in result.metrics.items()}


def _perceptual(config: DistillConfig, tokenizer: Path, device: str) -> PerceptualDistance | None:
    if config.last_step == "teacher_forcing":
        return None
    last = config.last_step == "distribution_matching" and config.distribution_matching.auxiliary.lpips
    wanted = config.trajectory_regression.auxiliary.lpips or last
    if config.lpips_weights is None:
        if wanted:
            logger.warning("The perceptual auxiliary is %s; it is left out of the loss.", LPIPS_OFF)
        return None
    dtype = torch.bfloat16 if config.perceptual.bfloat16 else torch.float32
    codec, network = load_tokenizer(tokenizer, device, dtype), load_lpips(config.lpips_weights).to(device)
    if config.perceptual.bfloat16 and not isinstance(codec, WanTokenizer):
        raise ConfigError(
            "Only the Wan autoencoder decodes in bfloat16", where="distill.perceptual.bfloat16", expected="false",
            got=f"true, with a {type(codec).__name__}",
        )  # fmt: skip
    return PerceptualLoss(codec, network, config.perceptual.latent_frames)
