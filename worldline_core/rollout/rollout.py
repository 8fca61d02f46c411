"""The rollout step: predict videos of chosen episodes from their first observation and controls."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, cast

import torch

from worldline_core.actions.action_tracks import changed_tracks
from worldline_core.actions.episode_tracks import ActionTracks, open_controls
from worldline_core.data.episodes.episode_index import QuarantineRow, write_quarantine
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ConfigError, DataError
from worldline_core.model.tokenizers import frames_to_video, require_device
from worldline_core.processor import processor_name
from worldline_core.progress import Progress
from worldline_core.rollout.baselines import FirstFrameCopy, GeSim, RefusedPredictionError, TextToVideo
from worldline_core.rollout.predictions import Prediction, batches, choose_episodes, plan_predictions
from worldline_core.rollout.rollout_config import (
    BlockCausalConfig,
    CopyFirstFrameConfig,
    FullClipConfig,
    GeSimConfig,
    RolloutConfig,
    TextToVideoConfig,
)
from worldline_core.rollout.rollout_set import RolloutSetWriter
from worldline_core.rollout.simulation import Frames
from worldline_core.rollout.worldline import WorldLine
from worldline_core.store.atomic import write_json_atomic

World = WorldLine | TextToVideo | FirstFrameCopy | GeSim


def rollout(config: RolloutConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Predict episodes of ``episodes`` with ``tracks`` and, but for copying, ``tokenizer`` and ``checkpoint``. Predictions without
    actions, and models of control vectors, do without ``tracks``.

    Writes a RolloutSet, video by video as it is predicted. Chosen episodes that cannot be predicted are listed in
    ``quarantine.parquet`` with a reason. Predictions already there are kept; a batch is made again as a whole if one of its videos
    is missing, so the bytes do not depend on where an earlier call stopped. Times go to ``run/speed.json``.

    Returns:
        counts, frames, and the checkpoint's kind; where there are any, the episodes left out by reason (``left_out``), how
        many predictions lack a view of the model (``without_view``), and frames predicted past the end of a recording
        and cut off (``cut_frames``).

    Raises:
        ConfigError: an input is missing, or views are asked for that the model does not know.
        CheckpointError: the checkpoint is of the wrong kind for the sampler, or was trained on other action maps.
        DataError: no episode matches, or none can be predicted.
    """
    require_device(config.device)
    sampler = config.sampler
    without_model = isinstance(sampler, CopyFirstFrameConfig | GeSimConfig)
    needed = {"episodes"} if without_model else {"episodes", "tokenizer", "checkpoint"}
    if not needed <= inputs.keys():
        raise ConfigError("The rollout lacks inputs", expected=sorted(needed), got=sorted(inputs))
    episodes = EpisodeSet.open(Path(inputs["episodes"]))
    chosen = choose_episodes(config, episodes)
    rates = [float(episodes.rows[position].fps) for position in chosen]
    world: World
    tracks: ActionTracks | None = None
    if isinstance(sampler, CopyFirstFrameConfig | TextToVideoConfig) and "tracks" in inputs:
        tracks = ActionTracks.open(Path(inputs["tracks"]))
    if isinstance(sampler, CopyFirstFrameConfig):
        world = FirstFrameCopy(episodes)
    elif isinstance(sampler, GeSimConfig):
        tracks = open_controls(inputs, episodes, vectors=False)
        tracks.episodes = episodes
        world = GeSim(sampler, episodes, tracks, config.stride)
        config = config.model_copy(update={"views": world.views, "batch_size": 1})
    elif isinstance(sampler, TextToVideoConfig):
        world = TextToVideo(config, sampler, Path(inputs["checkpoint"]), Path(inputs["tokenizer"]), episodes)
    else:
        world = _load(config, sampler, inputs, rates)
        if not config.cameras and world.needs_cameras:
            raise ConfigError(
                "The model takes action maps alone, which are drawn through cameras", where="rollout.cameras",
                expected="true", got=False, next_step="train with train_stage2.native_size, or leave it out",
            )  # fmt: skip
        if config.actions == "mirrored" and not (config.cameras and world.takes_maps):
            raise ConfigError(
                "Controls are mirrored as poses, of which there are no control vectors", where="rollout.actions",
                expected="a model of action maps, with cameras", got=world.info.config.action_conditioning,
            )  # fmt: skip
        tracks = open_controls(inputs, episodes, vectors=not world.needs_cameras, controls=world.contract.controls)
    fps = world.contract.fps if isinstance(world, WorldLine) else rates[0]
    planned, left_out = plan_predictions(config, episodes, tracks, chosen, world, fps)
    if isinstance(world, WorldLine) and tracks is not None:
        world.contract.require_tracks(dict.fromkeys(item.controls_of for item in planned), tracks)
    if left_out:
        write_quarantine(output, left_out)
    writer = RolloutSetWriter(output, config.method, fps / config.stride, crf=config.crf)
    times: list[tuple[int, float]] = []
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
                    times.append((sum(item.frames for item in batch), seconds))
                except RefusedPredictionError as error:
                    (item,) = batch  # a server predicts one by one
                    source = episodes.rows[item.position].source
                    refused[item.episode_id] = QuarantineRow(item.episode_id, source, error.reason, str(error))
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
    if times:
        _write_speed(output, config, world, times)
    in_splits = len(episodes.select(split=config.splits))
    reasons = {"in other splits": len(episodes) - in_splits, "not among those asked for": in_splits - len(chosen)}
    reasons |= Counter(row.reason for row in left_out)
    lacking = Counter(view for item in planned for view in world.views if view not in item.views)
    account = {"without_view": dict(lacking), "cut_frames": sum(item.sampled - item.frames for item in planned)}
    kept = len({item.position for item in planned})
    return {
        "method": config.method,
        "found": len(episodes),
        "kept": kept,
        "left_out": {name: count for name, count in reasons.items() if count},
        "episodes": kept,
        "predictions": len(planned),
        "frames": sum(item.frames for item in planned),
        "checkpoint_kind": world.info.kind if isinstance(world, WorldLine | TextToVideo) else None,
        "steps": world.steps,
        **{name: count for name, count in account.items() if count},
    }


def _load(
    config: RolloutConfig,
    sampler: FullClipConfig | BlockCausalConfig,
    inputs: Mapping[str, Path],
    rates: Sequence[float],
) -> WorldLine:
    """The model for recordings of these rates.

    Raises:
        CheckpointError: it is of the wrong kind for the sampler, or was trained at another rate than any of these.
    """
    world = WorldLine.from_pretrained(
        Path(inputs["checkpoint"]),
        tokenizer=Path(inputs["tokenizer"]),
        expect_kind="stage2" if isinstance(sampler, FullClipConfig) else "causal",
        device=config.device,
        bfloat16=config.bfloat16,
        weights=config.weights,
        compiled=config.compile,
        **sampler.model_dump(exclude={"kind"}),
    )
    if world.contract.fps not in rates:
        world.contract.require(where=inputs["episodes"], fps=rates[0])
    return world


def _predicted(
    config: RolloutConfig, world: World, episodes: EpisodeSet, tracks: ActionTracks | None, batch: Sequence[Prediction]
) -> Iterator[Frames]:
    """Frames of a batch, piece by piece."""
    firsts = []  # of every view, in [-1, 1]
    for item in batch:
        frames = [episodes.frames(item.position, view, [0]) for view in item.views]
        firsts.append(torch.stack([frames_to_video(frame, world.image_size)[:, 0] for frame in frames]))
    images = torch.stack(firsts)
    if not isinstance(world, WorldLine):
        yield from world.stream(images, batch)
        return
    controls = [cast("ActionTracks", tracks).tracks(item.controls_of) for item in batch]
    if config.actions in ("mirrored", "delayed"):
        controls = [changed_tracks(control, config.actions) for control in controls]
    yield from world.stream(
        images,
        controls,
        max(item.frames for item in batch),
        [item.seed for item in batch],
        views=batch[0].views,
        stride=config.stride,
        without_actions=config.actions == "zero",
        by_vector=not config.cameras,
    )


def _write(
    batch: Sequence[Prediction], pieces: Iterator[Frames], writer: RolloutSetWriter, size: tuple[int, int], device: str
) -> float:
    """Write a batch as it is predicted; wall seconds of predicting (writing is left out)."""
    seconds, done = 0.0, 0
    with ExitStack() as stack:
        videos = [stack.enter_context(writer.video(item.episode_id, item.seed, item.views, size)) for item in batch]
        begin = _finished(device)
        for piece in pieces:
            seconds += _finished(device) - begin
            for add, item, clip in zip(videos, batch, piece, strict=True):
                add({view: frames[: max(0, item.frames - done)] for view, frames in clip.items()})
            done += len(next(iter(piece[0].values())))
            begin = _finished(device)
    return seconds


def _finished(device: str) -> float:
    """Seconds of a clock when the kernels of the current stream are done."""
    if torch.device(device).type == "cuda":
        torch.cuda.current_stream(device).synchronize()
    return time.perf_counter()


def _write_speed(output: Path, config: RolloutConfig, world: World, times: Sequence[tuple[int, float]]) -> None:
    """Write ``run/speed.json`` from (frames, seconds) of the batches; the first one warms up, unless it is alone."""
    frames, seconds = (sum(column) for column in zip(*(times[1:] or times), strict=True))
    speed = {
        "steps": world.steps,
        "batch_size": config.batch_size,
        "device_name": device_name(config.device),
        "dtype": "bfloat16" if config.bfloat16 else "float32",
        "frames": frames,
        "seconds_per_frame": seconds / frames,
    }
    write_json_atomic(output / "run" / "speed.json", speed)


def device_name(device: str) -> str:
    """Name of the GPU, or of the processor with the number of threads in use."""
    if torch.device(device).type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{processor_name()}, {torch.get_num_threads()} threads of {os.cpu_count()} cores"
