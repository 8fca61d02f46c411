"""The rollout step: predict videos of chosen episodes from their first observation and controls."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from worldline_core.actions.action_tracks import changed_tracks
from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.actions.episode_tracks import ActionTracks, EpisodeTracks
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_index import QuarantineRow, write_quarantine
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ConfigError, DataError
from worldline_core.model.video_tokenizer import frames_to_video, video_to_frames
from worldline_core.progress import Progress
from worldline_core.rollout.captured import Captured
from worldline_core.rollout.ge_sim import GeSim
from worldline_core.rollout.ge_sim_client import RefusedPredictionError
from worldline_core.rollout.predictions import Prediction, batches, choose_episodes, plan_predictions
from worldline_core.rollout.rollout_config import RolloutConfig
from worldline_core.rollout.rollout_set import RolloutSetWriter
from worldline_core.rollout.session import Frames, encode_images
from worldline_core.rollout.speed import BatchTime, SpeedLog, device_name, long_rollout, timed
from worldline_core.rollout.text_to_video import TextToVideo
from worldline_core.rollout.worldline import WorldLine

_COPIED_AT_ONCE = 64


class FirstFrameCopy:
    """The baseline: every predicted frame is the observed one, at the size of the recordings."""

    steps = causal = None
    views: tuple[str, ...] = VIEWS
    frames_per_unit = TEMPORAL_FACTOR
    needs_cameras = False
    block_seconds = ()

    def __init__(self, episodes: EpisodeSet) -> None:
        height, width = episodes.frames(0, episodes.rows[0].views[0], [0]).shape[1:3]
        self.image_size = (height, width)

    def unit(self, frames: int) -> int:
        """Frames are copied one by one."""
        return 1

    def stream(
        self,
        images: Float[Tensor, "b v 3 h w"],
        tracks: Sequence[EpisodeTracks],
        frames: int,
        seeds: Sequence[int],
        *,
        views: Sequence[str],
        stride: int,
        without_actions: bool = False,
    ) -> Iterator[Frames]:
        """As :meth:`WorldLine.stream`; the controls and seeds play no part."""
        del tracks, seeds, stride, without_actions
        clips = [{view: video_to_frames(first[v, :, None]) for v, view in enumerate(views)} for first in images]
        for begin in range(0, frames, _COPIED_AT_ONCE):
            count = min(_COPIED_AT_ONCE, frames - begin)
            yield [{view: np.repeat(still, count, axis=0) for view, still in clip.items()} for clip in clips]


World = WorldLine | TextToVideo | FirstFrameCopy | GeSim
WITHOUT_MODEL = ("copy_first_frame", "ge_sim")
"""Samplers that read no checkpoint."""


def rollout(config: RolloutConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Predict episodes of ``episodes`` with ``tracks``, ``tokenizer`` and, but for copying, ``checkpoint``.

    Writes a RolloutSet, video by video as it is predicted: memory does not grow with the length. Chosen episodes that
    cannot be predicted lie in ``quarantine.parquet``, each with its reason. Predictions already there are kept; a batch is
    made again as a whole if one of its videos is missing, so the bytes do not depend on where an earlier call stopped.
    Times go to ``run/speed.json``: seconds per frame, and ``block_seconds`` of the block-causal sampler, per trajectory;
    ``long_rollout`` holds those of ``timed_blocks``.

    Returns:
        counts, frames, and the checkpoint's kind; where there are any, the episodes left out by reason (``left_out``), how
        many predictions lack a view of the model (``without_view``), and frames predicted past the end of a recording
        and cut off (``cut_frames``).

    Raises:
        ConfigError: an input is missing, or views are asked for that the model does not know.
        CheckpointError: the checkpoint is of the wrong kind for the sampler, or was trained on other action maps.
        DataError: no episode matches, or none can be predicted.
    """
    needed = {"episodes", "tracks", "tokenizer"} | (set() if config.sampler in WITHOUT_MODEL else {"checkpoint"})
    if not needed <= inputs.keys():
        raise ConfigError("The rollout lacks inputs", expected=sorted(needed), got=sorted(inputs))
    episodes = EpisodeSet.open(Path(inputs["episodes"]))
    tracks = ActionTracks.open(Path(inputs["tracks"]))
    chosen = choose_episodes(config, episodes)
    rates = [float(episodes.rows[position].fps) for position in chosen]
    world: World
    if config.sampler == "copy_first_frame":
        world = FirstFrameCopy(episodes)
    elif config.server is not None:
        world = GeSim(config.server, episodes)
        config = config.model_copy(update={"views": world.views, "batch_size": 1})
    elif config.sampler == "text_to_video":
        world = TextToVideo(config, Path(inputs["checkpoint"]), Path(inputs["tokenizer"]), episodes)
    else:
        world = _load(config, inputs, rates)
    if isinstance(world, GeSim) or (isinstance(world, WorldLine) and world.info.config.native_size is not None):
        tracks.episodes = episodes
    fps = world.contract.fps if isinstance(world, WorldLine) else rates[0]
    planned, left_out = plan_predictions(config, episodes, tracks, chosen, world, fps)
    if isinstance(world, WorldLine):
        world.contract.require_tracks(dict.fromkeys(item.controls_of for item in planned), tracks)
    if left_out:
        write_quarantine(output, left_out)
    writer = RolloutSetWriter(output, config.method, fps / config.stride, crf=config.crf)
    speed, first = SpeedLog(output / "run"), True
    refused: dict[str, QuarantineRow] = {}
    with Progress(f"rollout {config.method}", len(planned), "clip") as progress:
        for batch in batches(planned, config.batch_size):
            if all(writer.has(item.episode_id, item.seed, item.views) for item in batch):
                for item in batch:
                    for view in item.views:
                        writer.register(item.episode_id, item.seed, view, item.frames, world.image_size)
            else:
                pieces = _predicted(config, world, episodes, tracks, batch)
                try:
                    seconds = _write(batch, pieces, writer, world.image_size, config.device)
                except RefusedPredictionError as error:
                    refused |= {item.episode_id: _refused(episodes, item, error) for item in batch}
                    progress.advance(len(batch))
                    continue
                frames = sum(item.frames for item in batch)
                speed.add(BatchTime(len(batch), frames, seconds, tuple(world.block_seconds), first))
                first = False
            progress.advance(len(batch))
    if isinstance(world, GeSim):
        world.close()
    if refused:
        left_out += refused.values()
        write_quarantine(output, left_out)
        planned = [item for item in planned if item.episode_id not in refused]
    if not planned:
        raise DataError(
            "No episode could be predicted", where=episodes.root, expected="at least one",
            got=f"{len(refused)} refused; the first: {next(iter(refused.values())).detail}",
        )  # fmt: skip
    writer.close()
    facts: dict[str, Any] = {
        "steps": world.steps,
        "batch_size": config.batch_size,
        "device": config.device,
        "device_name": device_name(config.device),
        "dtype": "bfloat16" if config.bfloat16 else "float32",
    }
    if config.timed_blocks and isinstance(world, WorldLine):
        facts["long_rollout"] = _timed_blocks(config, world, episodes, tracks, planned[0])
    speed.close(facts)
    in_splits = len(episodes.select(split=config.splits))
    reasons = {"in other splits": len(episodes) - in_splits, "not among those asked for": in_splits - len(chosen)}
    reasons |= Counter(row.reason for row in left_out)
    return {
        "method": config.method,
        "found": len(episodes),
        "kept": len({item.position for item in planned}),
        "left_out": {name: count for name, count in reasons.items() if count},
        "episodes": len({item.position for item in planned}),
        "predictions": len(planned),
        "frames": sum(item.frames for item in planned),
        "checkpoint_kind": world.info.kind if isinstance(world, WorldLine | TextToVideo) else None,
        "steps": world.steps,
        "recent_blocks": None if world.causal is None else world.causal.recent_blocks,
        **_account(world, planned),
    }


def _refused(episodes: EpisodeSet, item: Prediction, error: RefusedPredictionError) -> QuarantineRow:
    return QuarantineRow(item.episode_id, episodes.rows[item.position].source, error.reason, str(error))


def _account(world: World, planned: Sequence[Prediction]) -> dict[str, Any]:
    """What was not wholly predicted; nothing where all was."""
    lacking = Counter(view for item in planned for view in world.views if view not in item.views)
    cut = sum(item.sampled - item.frames for item in planned)
    account = {"without_view": dict(lacking), "cut_frames": cut}
    return {name: value for name, value in account.items() if value}


def _load(config: RolloutConfig, inputs: Mapping[str, Path], rates: Sequence[float]) -> WorldLine:
    """The model for recordings of these rates.

    Raises:
        CheckpointError: it is of the wrong kind for the sampler, or was trained at another rate than any of these.
    """
    world = WorldLine.from_pretrained(
        Path(inputs["checkpoint"]),
        tokenizer=Path(inputs["tokenizer"]),
        decoder=config.decoder,
        expect_kind="stage2" if config.sampler == "full_clip" else "causal",
        device=config.device,
        bfloat16=config.bfloat16,
        weights=config.weights,
        steps=config.steps,
        shift=config.shift,
        clip_frames=config.clip_frames,
        sink_blocks=config.sink_blocks,
        recent_blocks=config.recent_blocks,
    )
    if config.captured:
        world.run = Captured(config.device)
    if world.contract.fps not in rates:
        world.contract.require(where=inputs["episodes"], fps=rates[0])
    return world


def _observed(world: World, episodes: EpisodeSet, batch: Sequence[Prediction]) -> Float[Tensor, "b v 3 h w"]:
    """First frames of every view in [-1, 1]."""
    firsts = []
    for item in batch:
        frames = [episodes.frames(item.position, view, [0]) for view in item.views]
        firsts.append(torch.stack([frames_to_video(frame, world.image_size)[:, 0] for frame in frames]))
    return torch.stack(firsts)


def _predicted(
    config: RolloutConfig, world: World, episodes: EpisodeSet, tracks: ActionTracks, batch: Sequence[Prediction]
) -> Iterator[Frames]:
    """Frames of a batch, piece by piece."""
    controls = [tracks.tracks(item.controls_of) for item in batch]
    if config.actions == "mirrored" or config.actions == "delayed":
        controls = [changed_tracks(control, config.actions) for control in controls]
    yield from world.stream(
        _observed(world, episodes, batch),
        controls,
        max(item.frames for item in batch),
        [item.seed for item in batch],
        views=batch[0].views,
        stride=config.stride,
        without_actions=config.actions == "zero",
    )


def _write(
    batch: Sequence[Prediction], pieces: Iterator[Frames], writer: RolloutSetWriter, size: tuple[int, int], device: str
) -> float:
    """Write a batch as it is predicted; wall seconds of predicting (writing is left out)."""
    seconds, done = 0.0, 0
    with ExitStack() as stack:
        videos = [stack.enter_context(writer.video(item.episode_id, item.seed, item.views, size)) for item in batch]
        while True:
            piece, elapsed = timed(partial(next, pieces, None), device)
            seconds += elapsed.wall
            if piece is None:
                return seconds
            for add, item, clip in zip(videos, batch, piece, strict=True):
                add({view: frames[: max(0, item.frames - done)] for view, frames in clip.items()})
            done += len(next(iter(piece[0].values())))


def _timed_blocks(
    config: RolloutConfig, world: WorldLine, episodes: EpisodeSet, tracks: ActionTracks, item: Prediction
) -> dict[str, list[float]]:
    first = encode_images(world.tokenizer, _observed(world, episodes, [item]).to(config.device))
    index = range(0, world.frames_per_unit + 1, TEMPORAL_FACTOR)
    maps = world.action_maps([tracks.tracks(item.controls_of)], index, start=0, views=item.views)
    return long_rollout(partial(world.simulator, [item.seed], item.views), first, maps, config.timed_blocks)
