"""The rollout step: predict videos of chosen episodes from their first observation and controls."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field, model_validator
from torch import Tensor

from worldline_core.actions.action_maps import TEMPORAL_FACTOR
from worldline_core.actions.episode_tracks import ActionTracks, EpisodeTracks
from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ConfigError, DataError
from worldline_core.model.video_tokenizer import frames_to_video, video_to_frames
from worldline_core.progress import Progress
from worldline_core.rollout.rollout_set import RolloutSetWriter
from worldline_core.rollout.speed import BatchTime, SpeedLog, device_name, long_rollout, timed
from worldline_core.rollout.worldline import WorldLine

Controls = Literal["true", "zero", "shuffled"]
"""Whose controls drive a prediction: the episode's own, none, or those of another episode."""


class RolloutConfig(StrictModel):
    """Which episodes are predicted, and how."""

    method: str = Field(default="worldline", min_length=1)
    """Name the predictions carry in scores and reports."""
    sampler: Literal["full_clip", "block_causal", "copy_first_frame"] = "block_causal"
    steps: int | None = Field(default=None, ge=1)
    """Euler steps; by default 35 for a whole clip, and per block those the causal model was trained with."""
    # Left out of dumps at its default: rollouts made before it existed keep their key in the store.
    shift: float = Field(default=1.0, gt=0, exclude_if=lambda value: value == 1.0)
    """Full clip: moves the noise levels of the steps towards noise; few steps are worth more there."""
    actions: Controls = "true"
    seeds: tuple[int, ...] = Field(default=(42,), min_length=1)
    splits: tuple[str, ...] = ("test",)
    banks: tuple[str, ...] | None = None
    """Only episodes of these candidate banks."""
    embodiments: tuple[str, ...] | None = None
    max_episodes_per_embodiment: int | None = Field(default=None, ge=1)
    num_frames: int = Field(default=33, ge=5)
    """Longest prediction; shorter episodes are predicted as far as whole blocks (or groups) go."""
    batch_size: int = Field(default=8, ge=1)
    sink_blocks: int | None = Field(default=None, ge=1)
    recent_blocks: int | None = Field(default=None, ge=0)
    """Window of the cache; by default the one that the causal model was trained with."""
    crf: int = Field(default=8, ge=0, le=51)
    bfloat16: bool = True
    device: str = "cpu"
    timed_blocks: int = Field(default=0, ge=0)
    """Blocks of one long block-causal rollout made to measure what each costs; it changes no prediction."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if len(set(self.seeds)) != len(self.seeds):
            raise ValueError(f"seeds repeat: {self.seeds}")
        if self.timed_blocks and self.sampler != "block_causal":
            raise ValueError(f"timed_blocks needs the sampler block_causal, not {self.sampler}")
        if self.shift != 1.0 and self.sampler != "full_clip":
            raise ValueError(f"shift needs the sampler full_clip, not {self.sampler}")
        return self


@dataclass(frozen=True)
class Prediction:
    """One video of every view to make: of an episode, driven by the controls of one, with a seed and a length."""

    position: int
    episode_id: str
    controls_of: str
    seed: int
    frames: int


class FirstFrameCopy:
    """The baseline: every predicted frame is the observed one, at the size of the recordings."""

    steps = causal = None
    frames_per_unit = TEMPORAL_FACTOR
    block_seconds = ()

    def __init__(self, episodes: EpisodeSet) -> None:
        self.views = tuple(episodes.rows[0].views)
        height, width = episodes.frames(0, self.views[0], [0]).shape[1:3]
        self.image_size = (height, width)

    def predict_batch(
        self,
        images: Float[Tensor, "b v 3 h w"],
        tracks: Sequence[EpisodeTracks],
        frames: Sequence[int],
        seeds: Sequence[int],
        *,
        without_actions: bool = False,
    ) -> list[dict[str, np.ndarray]]:
        """As :meth:`WorldLine.predict_batch`; the controls and seeds play no part."""
        del tracks, seeds, without_actions
        return [
            {view: np.repeat(video_to_frames(first[v, :, None]), count, axis=0) for v, view in enumerate(self.views)}
            for first, count in zip(images, frames, strict=True)
        ]


def rollout(config: RolloutConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Predict episodes of ``episodes`` with ``tracks``, ``tokenizer`` and, but for copying, ``checkpoint``.

    Writes a RolloutSet. Predictions already there are kept; a batch is made again as a whole if one of its videos is
    missing, so the bytes do not depend on where an earlier call stopped. Times go to ``run/speed.json``: seconds per
    frame, and ``block_seconds`` of the block-causal sampler, per trajectory; ``long_rollout`` holds those of
    ``timed_blocks``.

    Returns:
        counts, frames, and the checkpoint's kind.

    Raises:
        ConfigError: an input is missing.
        CheckpointError: the checkpoint is of the wrong kind for the sampler, or trained on other action maps.
        DataError: no episode matches, or one has no tracks.
    """
    needed = {"episodes", "tracks", "tokenizer"} | ({"checkpoint"} if config.sampler != "copy_first_frame" else set())
    if not needed <= inputs.keys():
        raise ConfigError("The rollout lacks inputs", expected=sorted(needed), got=sorted(inputs))
    episodes = EpisodeSet.open(Path(inputs["episodes"]))
    tracks = ActionTracks.open(Path(inputs["tracks"]))
    chosen = choose_episodes(config, episodes)
    copying = config.sampler == "copy_first_frame"
    world = FirstFrameCopy(episodes) if copying else _load(config, inputs, episodes, tracks)
    planned = plan_predictions(config, episodes, tracks, chosen, world.frames_per_unit)
    writer = RolloutSetWriter(output, config.method, float(episodes.rows[0].fps), crf=config.crf)
    speed, first = SpeedLog(output / "run"), True
    with Progress(f"rollout {config.method}", len(planned), "clip") as progress:
        for batch in batches(planned, config.batch_size):
            if all(writer.has(item.episode_id, item.seed, world.views) for item in batch):
                for item in batch:
                    for view in world.views:
                        writer.register(item.episode_id, item.seed, view, item.frames, world.image_size)
            else:
                videos, elapsed = timed(partial(_predict, config, world, episodes, tracks, batch), config.device)
                frames = sum(item.frames for item in batch)
                speed.add(BatchTime(len(batch), frames, elapsed.wall, tuple(world.block_seconds), first))
                first = False
                for item, video in zip(batch, videos, strict=True):
                    writer.add(item.episode_id, item.seed, video)
            progress.advance(len(batch))
    writer.close()
    facts: dict[str, Any] = {
        "steps": world.steps,
        "batch_size": config.batch_size,
        "device": config.device,
        "device_name": device_name(config.device),
        "dtype": "bfloat16" if config.bfloat16 else "float32",
    }
    if config.timed_blocks and isinstance(world, WorldLine):
        item = planned[0]
        encoded = world.encode(_observed(world, episodes, [item]), [tracks.tracks(item.controls_of)], [item.frames])
        simulator = partial(world.simulator, [item.seed])
        facts["long_rollout"] = long_rollout(simulator, *encoded, config.timed_blocks)
    speed.close(facts)
    return {
        "method": config.method,
        "episodes": len(chosen),
        "predictions": len(planned),
        "frames": sum(item.frames for item in planned),
        "checkpoint_kind": world.info.kind if isinstance(world, WorldLine) else None,
        "steps": world.steps,
        "recent_blocks": None if world.causal is None else world.causal.recent_blocks,
    }


def _load(config: RolloutConfig, inputs: Mapping[str, Path], episodes: EpisodeSet, tracks: ActionTracks) -> WorldLine:
    """The model for these recordings.

    Raises:
        CheckpointError: it is of the wrong kind for the sampler, or was trained with other controls.
    """
    world = WorldLine.from_pretrained(
        Path(inputs["checkpoint"]),
        tokenizer=Path(inputs["tokenizer"]),
        expect_kind="stage2" if config.sampler == "full_clip" else "causal",
        device=config.device,
        bfloat16=config.bfloat16,
        steps=config.steps,
        shift=config.shift,
        sink_blocks=config.sink_blocks,
        recent_blocks=config.recent_blocks,
    )
    world.contract.require(where=inputs["episodes"], fps=float(episodes.rows[0].fps))
    world.contract.require(where=inputs["tracks"], sigma_px_ref=tracks.sigma_px_ref)
    if world.info.config.native_size is not None:
        tracks.episodes = episodes
    return world


def _observed(
    world: WorldLine | FirstFrameCopy, episodes: EpisodeSet, batch: Sequence[Prediction]
) -> Float[Tensor, "b v 3 h w"]:
    """First frames of every view in [-1, 1].

    Raises:
        DataError: an episode lacks a view.
    """
    firsts = []
    for item in batch:
        row = episodes.rows[item.position]
        if not set(world.views) <= set(row.views):
            raise DataError(
                "An episode lacks views the model needs", where=item.episode_id, expected=world.views, got=row.views
            )
        frames = [episodes.frames(item.position, view, [0]) for view in world.views]
        firsts.append(torch.stack([frames_to_video(frame, world.image_size)[:, 0] for frame in frames]))
    return torch.stack(firsts)


def _predict(
    config: RolloutConfig,
    world: WorldLine | FirstFrameCopy,
    episodes: EpisodeSet,
    tracks: ActionTracks,
    batch: Sequence[Prediction],
) -> list[dict[str, np.ndarray]]:
    """Predicted frames of every view, the observed frame first.

    Raises:
        CheckpointError: the model was trained with other controls than these.
    """
    images = _observed(world, episodes, batch)
    driven = [tracks.tracks(item.controls_of) for item in batch]
    if isinstance(world, WorldLine):
        for track in driven:
            world.contract.require(where=f"{tracks.root}, episode {track.episode_id}", controls=track.controls)
    return world.predict_batch(
        images,
        driven,
        [item.frames for item in batch],
        [item.seed for item in batch],
        without_actions=config.actions == "zero",
    )


def choose_episodes(config: RolloutConfig, episodes: EpisodeSet) -> list[int]:
    """Positions of the episodes to predict, in the order of the set.

    Raises:
        DataError: none matches.
    """
    counts: Counter[str] = Counter()
    chosen = []
    limit = config.max_episodes_per_embodiment
    for position in episodes.select(split=config.splits):
        row = episodes.rows[position]
        if config.banks is not None and row.bank not in config.banks:
            continue
        if config.embodiments is not None and row.embodiment not in config.embodiments:
            continue
        counts[row.embodiment] += 1
        if limit is None or counts[row.embodiment] <= limit:
            chosen.append(position)
    if not chosen:
        raise DataError(
            "No episode to predict",
            where=episodes.root,
            expected=f"splits {config.splits}, banks {config.banks}, embodiments {config.embodiments}",
            got=sorted({row.split for row in episodes.rows}),
        )
    return chosen


def plan_predictions(
    config: RolloutConfig, episodes: EpisodeSet, tracks: ActionTracks, chosen: Sequence[int], unit: int
) -> list[Prediction]:
    """Every prediction to make, with its length: 1 + k * ``unit`` frames.

    Raises:
        DataError: an episode has no action tracks, or is shorter than one unit.
    """
    rows = [episodes.rows[position] for position in chosen]
    missing = [row.episode_id for row in rows if row.episode_id not in tracks]
    if missing:
        raise DataError("Episodes without action tracks", got=missing[:5], next_step="render actions of this set")
    partners = {row.episode_id: row.episode_id for row in rows}
    if config.actions == "shuffled":
        embodiment_of = {row.episode_id: row.embodiment for row in episodes.rows}
        partners = shuffled_partners(list(partners), embodiment_of, tracks.episode_ids, config.seeds[0])
    planned: list[Prediction] = []
    for position, row in zip(chosen, rows, strict=True):
        frames = 1 + (min(config.num_frames, row.num_frames) - 1) // unit * unit
        if frames < 1 + unit:
            raise DataError(
                "An episode is too short to predict", where=row.episode_id, expected=1 + unit, got=row.num_frames
            )
        partner = partners[row.episode_id]
        planned += [Prediction(position, row.episode_id, partner, seed, frames) for seed in config.seeds]
    return planned


def batches(planned: Sequence[Prediction], size: int) -> Iterator[list[Prediction]]:
    """Predictions of equal length together, in a fixed order."""
    for frames in sorted({item.frames for item in planned}):
        same = [item for item in planned if item.frames == frames]
        for start in range(0, len(same), size):
            yield same[start : start + size]


def shuffled_partners(
    episodes: Sequence[str], embodiment_of: Mapping[str, str], pool: Sequence[str], seed: int
) -> dict[str, str]:
    """For every episode another of the same embodiment, no one its own, as far as possible no two the same.

    Episodes of an embodiment are arranged in a random circle (a function of ``seed`` and the ids only) and each takes
    its successor's controls. An embodiment with a single chosen episode draws its partner from ``pool``.

    Raises:
        DataError: an episode has no other of its embodiment.
    """
    partners: dict[str, str] = {}
    for embodiment in sorted({embodiment_of[episode] for episode in episodes}):
        members = sorted(episode for episode in episodes if embodiment_of[episode] == embodiment)
        generator = np.random.default_rng([seed, *embodiment.encode()])
        if len(members) == 1:
            others = sorted(e for e in pool if embodiment_of.get(e) == embodiment and e not in members)
            if not others:
                raise DataError(
                    "No other episode of this embodiment to take controls from",
                    where=members[0],
                    expected="at least two episodes with tracks",
                    got=embodiment,
                )
            partners[members[0]] = others[int(generator.integers(len(others)))]
            continue
        circle = [members[int(i)] for i in generator.permutation(len(members))]
        partners.update(zip(circle, [*circle[1:], circle[0]], strict=True))
    return partners
