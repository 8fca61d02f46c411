"""Stage II: action-driven prediction of three synchronised views, without text (docs/method.md section 4).

Successes and failures are trained alike; no outcome label reaches the model.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Collection, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.actions.episode_tracks import open_controls
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ConfigError
from worldline_core.model.checkpoint import CheckpointInfo, load_checkpoint, read_checkpoint_info
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import ActionContract, WorldModelConfig
from worldline_core.training.flow_matching import FlowMatchingObjective
from worldline_core.training.processes import processes
from worldline_core.training.relational import RelationalTerm, TeacherSimilarities
from worldline_core.training.stage import Stage
from worldline_core.training.trainer import ParameterGroup, trained_groups
from worldline_core.training.training_config import Stage2Config
from worldline_core.training.video_teacher import load_teacher

logger = logging.getLogger(__name__)


def stage2_groups(model: WorldModel, action_multiplier: float) -> list[ParameterGroup]:
    """Generation modules, time embedding and latent projections (or their adapters) at the base rate; the action branch faster."""
    return trained_groups(
        ParameterGroup("generation", dict(model.generation_parameters())),
        ParameterGroup("action", dict(model.action_parameters()), action_multiplier),
    )


def stage2_model_config(config: Stage2Config, start: WorldModelConfig, *, drawn: bool = True) -> WorldModelConfig:
    """The model that Stage II trains from a checkpoint: its video tower, with the configured action branches.

    Args:
        drawn: there are action tracks to draw maps from.

    Raises: ConfigError: the checkpoint takes vectors of another size.
    """
    if start.native_size is not None and config.native_size not in (None, start.native_size):
        raise ConfigError(
            "The model that Stage II starts from takes vectors of another size", where="train_stage2.native_size",
            expected=start.native_size, got=config.native_size,
        )  # fmt: skip
    takes = "maps" if config.native_size is None else "either" if drawn and config.vector_share < 1 else "vectors"
    controls = {"action_frames": config.action_frames, "native_size": config.native_size, "action_conditioning": takes}
    return start.model_copy(update={"towers": "generation", **controls})


def train_stage2(config: Stage2Config, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Train on ``episodes`` and ``tracks`` from the checkpoint ``stage1``, a base, Stage I or Stage II one; ``teacher`` for the
    relational terms. A Stage II model goes on with latents and maps of the same meaning; robots, rates and controls that are new to
    it are logged.

    Clips are cached ``latents``, or frames that ``tokenizer`` encodes on the way.

    Raises:
        CheckpointError: if the checkpoint is of the wrong kind, or was trained on latents or maps of another meaning.
        ConfigError: if relational terms are asked for without a teacher.
        DataError: if no clip fits, or one cannot be read.
    """
    parent = Path(inputs["stage1"])
    episodes = EpisodeSet.open(Path(inputs["episodes"]))
    tracks = open_controls(inputs, episodes, vectors=config.native_size is not None)

    def load_model() -> tuple[WorldModel, CheckpointInfo]:
        adapt = partial(stage2_model_config, config, drawn="tracks" in inputs)
        kinds = ("base", "stage1", "stage2")
        return load_checkpoint(parent, expect_kind=kinds, towers="generation", adapt=adapt, weights=processes()[0] == 0)

    stage = Stage.open(
        config, inputs, output, number=2, title="stage II", load_model=load_model, parent=parent, tracks=tracks
    )
    model = stage.model
    contract = ActionContract.model_validate(
        {
            "controls": tracks.tracks(stage.training_rows[0].episode_id).controls,
            "fps": stage.episodes.rows[0].fps,
            "sigma_px_ref": tracks.sigma_px_ref if model.config.takes_maps else None,
            "grid_size": stage.source.latent_shape[1:],
            "tokenizer": stage.source.description["tokenizer"],
        }
    )
    contract.require_tracks((row.episode_id for row in stage.rows), tracks)
    seen = Counter(row.embodiment for row in stage.training_rows)
    _require_same_meaning(parent, contract, model.config, seen, tracks.root)
    loader = stage.loader(tracks=tracks)
    objective = FlowMatchingObjective(
        model,
        sigma=config.sigma,
        weighting=config.weighting,
        action_dropout=config.action_dropout,
        relational=_relational(config, inputs, model),
    )
    if config.action_following is not None:
        objective.sampler_steps = config.action_following.steps
    probe = stage.held_out(loader).action_following(
        config.action_following, config.trainer, objective, inputs.get("tokenizer"), stage.sampler, TEMPORAL_FACTOR
    )
    groups = stage2_groups(model, config.action_multiplier)
    result = stage.train(objective, groups, loader, probe)
    facts = {
        "start": {"kind": stage.parent_kind, "weights_sha256": stage.start},
        "embodiments": dict(sorted(seen.items())),
    }
    counts = stage.save(result, kind="stage2", action_contract=contract, facts=facts)
    trained = sum(value.numel() for group in groups for value in group.parameters.values())
    return {**counts, "trained_parameters": trained, **result.metrics}


def _require_same_meaning(
    start: Path, contract: ActionContract, config: WorldModelConfig, robots: Collection[str], tracks: Path
) -> None:
    """Refuse latents and maps that mean something else to the Stage II start model; log what else has changed.

    Raises: CheckpointError: another tokenizer, or another width of the maps.
    """
    info = read_checkpoint_info(start)
    learnt, was = info.action_contract, info.config
    if learnt is None:
        return
    kept = {"tokenizer", "sigma_px_ref"} if was.takes_maps and config.takes_maps else {"tokenizer"}
    learnt.require(where=tracks, **contract.model_dump(include=kept))
    known = info.metadata.get("embodiments")
    new = sorted(name for name in robots if known is None or name not in known)
    if new:
        was_of = "robots that it does not name" if known is None else ", ".join(sorted(known))
        logger.info("The Stage II start model learned from %s; it now learns %s.", was_of, ", ".join(new))
    for name, before, now in (
        ("controls", learnt.controls, contract.controls),
        ("frames per second", learnt.fps, contract.fps),
        ("size of the latents", learnt.grid_size, contract.grid_size),
        ("conditioning", was.action_conditioning, config.action_conditioning),
    ):
        if before != now:
            logger.info("Changed from the Stage II start model: %s %s, previously %s.", name, now, before)


def _relational(config: Stage2Config, inputs: Mapping[str, Path], model: WorldModel) -> RelationalTerm | None:
    if config.relational is None:
        return None
    if "teacher" not in inputs:
        raise ConfigError(
            "The relational terms need a teacher.",
            where="train_stage2.relational",
            expected="an input named teacher (a trained small teacher, or a folder with V-JEPA 2)",
            got="no such input",
            next_step="give the teacher's folder, or set relational to null",
        )
    teacher = load_teacher(Path(inputs["teacher"]), device=config.trainer.device)
    similarities = TeacherSimilarities(teacher, Path(inputs["episodes"]), config.relational)
    return RelationalTerm(config.relational, similarities, model.config.num_layers)
