"""The paper's ablations as variants of one run (paper, "Ablation Studies" and appendix, "Ablation Protocol").

A variant is a named set of changes to a run's configuration. What it does not change (recordings, filters, Stage I) has the
same key in the store.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import cast

from worldline_core.config import validate
from worldline_core.errors import ConfigError
from worldline_core.pipeline.pipeline_config import PipelineConfig, RolloutRun
from worldline_core.report.ablation_table import FULL, VARIANTS_FILE, Variant, load_variants
from worldline_core.rollout.rollout_config import RolloutConfig
from worldline_core.training.clip_config import view_subsets
from worldline_core.training.training_config import StageConfig

METHOD = "stage2"

type LoadConfig = Callable[[Sequence[str]], PipelineConfig]
"""Loads the run's configuration with some more ``a.b=value`` overrides."""


def choose_variants(names: Sequence[str] | None = None, file: Path | None = None) -> dict[str, Variant]:
    """The full model's row and those of ``names`` (default: all), of the paper's variants or a file of others.

    Raises: ConfigError for an unknown name.
    """
    variants = load_variants(file or VARIANTS_FILE)
    if unknown := sorted(set(names or ()) - set(variants)):
        raise ConfigError("Unknown ablation", expected=f"some of {', '.join(variants)}", got=unknown)
    return {name: row for name, row in variants.items() if name == FULL or names is None or name in names}


def variant_config(load: LoadConfig, variant: Variant, seed: int | None = None) -> PipelineConfig:
    """The configuration of a variant, with the rollouts and evaluations of its row of the table alone.

    Args:
        seed: of its trainings; None: as configured.

    Raises: ConfigError: the run has no rollout of its Stage II model, or no base model.
    """
    full = _with_row(load([]))
    changes = [change for change in variant.changes if _can_change(full, change)]
    if seed is not None:
        own_stages = load(changes)
        stages = ("train_stage1", "train_stage2")
        changes += [f"{stage}.trainer.seed={seed}" for stage in stages if getattr(own_stages, stage) is not None]
    # Its rollouts are not rows of the table, and a variant may train no Stage I.
    changes += [f"rollouts.{name}=null" for name, run in load([]).rollouts.items() if run.checkpoint == "stage1"]
    if variant.matched_compute:
        changes.append(f"train_stage2.trainer.{matched_length(full)}")
    rollouts = {
        name: run.model_copy(update={"config": _changed(_settings(run), variant)})
        for name, run in full.rollouts.items()
    }
    own = {"rollouts": rollouts, "evaluate_policy": None, "curate_banks": full.curate_banks}
    return load(changes).model_copy(update=own)


def matched_length(config: PipelineConfig) -> str:
    """Length ("steps=7", "minutes=3") of a Stage II without a Stage I before it that costs what both of ``config`` do.

    A step's cost is counted in video tokens, which the linear layers' FLOPs are proportional to. Attention over three views
    costs more than that, so the variant gets no less than the full model: what it loses is not for want of compute.
    """
    stage1, stage2 = config.train_stage1, config.train_stage2
    lengths = [(stage.trainer.steps, stage.trainer.minutes) for stage in (stage1, stage2) if stage is not None]
    steps, minutes = ([length for length in kind if length is not None] for kind in zip(*lengths, strict=True))
    if steps and minutes:
        raise ConfigError(
            "The compute of steps and of minutes cannot be matched", where="train_stage1.trainer, train_stage2.trainer",
            expected="steps of both, or minutes of both",
        )  # fmt: skip
    if minutes:
        return f"minutes={sum(minutes)}"
    if stage1 is None:
        return f"steps={steps[-1]}"
    views = len(stage1.model.views)
    return f"steps={steps[-1] + round(steps[0] * tokens_a_step(stage1, views) / tokens_a_step(stage2, views))}"


def tokens_a_step(stage: StageConfig, views: int) -> float:
    """Expected latent frames of one view that an optimiser step is trained on; all of a run have one size."""
    clips = stage.clips
    latent_frames = sum(1 + (length - 1) // 4 for length in clips.lengths) / len(clips.lengths)
    drawn = clips.view_weights or {"joint": 1.0}
    subsets = view_subsets(["view"] * views)
    shown = {"joint": views, "subset": sum(map(len, subsets)) / len(subsets)}
    shown = {name: shown.get(name, clips.single_view_factor) for name in drawn}
    mean_views = sum(weight * shown[name] for name, weight in drawn.items()) / sum(drawn.values())
    return stage.trainer.batch_size * stage.trainer.accumulation * latent_frames * mean_views


def _with_row(config: PipelineConfig) -> PipelineConfig:
    """The run with the rollouts of a table's row alone: its Stage II model on recordings, and on banks where it plans."""
    runs = [run for run in config.rollouts.values() if run.checkpoint == METHOD and _settings(run).actions == "true"]
    recordings = next((run for run in runs if run.episodes == "recordings"), None)
    if recordings is None:
        raise ConfigError(
            "The ablations compare Stage II models, and this run predicts nothing with its own",
            where="rollouts",
            expected="a rollout with checkpoint: stage2 on the recordings",
            got=list(config.rollouts),
        )
    rows = {METHOD: recordings}
    on_banks = [_settings(run) for run in config.rollouts.values() if run.episodes == "banks" and run.imported is None]
    if config.evaluate_planning is not None and on_banks:
        banks = next((run for run in runs if run.episodes == "banks"), None)
        rows[f"banks_{METHOD}"] = banks or RolloutRun(
            checkpoint=METHOD,
            episodes="banks",
            config=_checked({**_settings(recordings).model_dump(), **{k: getattr(on_banks[0], k) for k in _CHOICE}}),
        )
    banks = config.curate_banks if f"banks_{METHOD}" in rows else None
    return config.model_copy(update={"rollouts": rows, "curate_banks": banks})


_CHOICE = ("splits", "banks", "embodiments", "max_episodes_per_embodiment", "num_frames", "batch_size")
"""Candidates and their lengths, as in another model's rollout of the banks."""


def _settings(run: RolloutRun) -> RolloutConfig:
    return cast("RolloutConfig", run.config)  # a run with a checkpoint has one


def _changed(config: RolloutConfig, variant: Variant) -> RolloutConfig:
    return _checked({**config.model_dump(), **variant.rollout}) if variant.rollout else config


def _checked(values: dict[str, object]) -> RolloutConfig:
    return validate(RolloutConfig, values, where="a rollout of the ablations")


def _can_change(config: PipelineConfig, change: str) -> bool:
    """Returns whether a change sets a whole section, or a field of a section that the run has."""
    section, dot, _ = change.partition("=")[0].partition(".")
    return not dot or getattr(config, section, None) is not None
