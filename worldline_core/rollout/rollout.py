"""The rollout step: predict videos of chosen episodes from their first observation and controls."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ConfigError, DataError
from worldline_core.rollout.predictor import Predictor
from worldline_core.rollout.rollout_config import Job, RolloutConfig, shuffled_partners
from worldline_core.rollout.rollout_set import RolloutSetWriter
from worldline_core.rollout.samplers import BLOCK_SIZE
from worldline_core.rollout.speed import BatchTime, SpeedLog, device_name, long_rollout, timed

__all__ = ["RolloutConfig", "rollout"]


def rollout(config: RolloutConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Predict episodes of ``episodes`` with ``tracks``, ``tokenizer`` and, but for copying, ``checkpoint``.

    Writes a RolloutSet. Predictions already there are kept; a batch is made again as a whole if one of its videos is
    missing, so the bytes do not depend on where an earlier call stopped. Times go to ``run/speed.json``: seconds a frame, and
    ``block_seconds`` of the block-causal sampler, per trajectory; ``long_rollout`` holds those of ``timed_blocks``.

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
    jobs = plan_jobs(config, episodes, tracks, chosen)
    predictor = Predictor(config, inputs, episodes, tracks)
    writer = RolloutSetWriter(output, config.method, predictor.fps, crf=config.crf)
    speed, first = SpeedLog(output / "run"), True
    for batch in tqdm(list(batches(jobs, config.batch_size)), desc=f"rollout {config.method}", disable=None):
        if all(writer.has(job.episode_id, job.seed, predictor.views) for job in batch):
            for job in batch:
                for view in predictor.views:
                    writer.register(job.episode_id, job.seed, view, job.frames, predictor.image_size)
            continue
        predictions, elapsed = timed(partial(predictor.predict, batch), config.device)
        made = sum(job.frames for job in batch)
        speed.add(BatchTime(len(batch), made, elapsed.wall, tuple(predictor.block_seconds), first))
        first = False
        for job, frames in zip(batch, predictions, strict=True):
            writer.add(job.episode_id, job.seed, frames)
    writer.close()
    facts: dict[str, Any] = {
        "steps": predictor.steps,
        "batch_size": config.batch_size,
        "device": config.device,
        "device_name": device_name(config.device),
        "dtype": "bfloat16" if config.bfloat16 else "float32",
    }
    if config.timed_blocks:
        facts["long_rollout"] = long_rollout(predictor.time_blocks(jobs[0], config.timed_blocks), config.device)
    speed.close(facts)
    return {
        "method": config.method,
        "episodes": len(chosen),
        "predictions": len(jobs),
        "frames": sum(job.frames for job in jobs),
        "checkpoint_kind": None if predictor.info is None else predictor.info.kind,
        "steps": predictor.steps,
        "recent_blocks": predictor.recent_blocks,
    }


def choose_episodes(config: RolloutConfig, episodes: EpisodeSet) -> list[int]:
    """Positions of the episodes to predict, in the order of the set.

    Raises:
        DataError: none matches.
    """
    counts: dict[str, int] = {}
    chosen = []
    for position in episodes.select(split=config.splits):
        row = episodes.rows[position]
        if config.banks is not None and row.bank not in config.banks:
            continue
        if config.embodiments is not None and row.embodiment not in config.embodiments:
            continue
        counts[row.embodiment] = counts.get(row.embodiment, 0) + 1
        limit = config.max_episodes_per_embodiment
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


def plan_jobs(config: RolloutConfig, episodes: EpisodeSet, tracks: ActionTracks, chosen: Sequence[int]) -> list[Job]:
    """Every prediction to make, with its length.

    Raises:
        DataError: an episode has no action tracks, or is shorter than one block.
    """
    rows = [episodes.rows[position] for position in chosen]
    missing = [row.episode_id for row in rows if row.episode_id not in tracks]
    if missing:
        raise DataError("Episodes without action tracks", got=missing[:5], next_step="render actions of this set")
    partners = {row.episode_id: row.episode_id for row in rows}
    if config.actions == "shuffled":
        embodiment_of = {row.episode_id: row.embodiment for row in episodes.rows}
        partners = shuffled_partners(list(partners), embodiment_of, tracks.episode_ids, config.seeds[0])
    unit = 4 * BLOCK_SIZE if config.sampler == "block_causal" else 4
    jobs = []
    for position, row in zip(chosen, rows, strict=True):
        frames = 1 + (min(config.num_frames, row.num_frames) - 1) // unit * unit
        if frames < 1 + unit:
            raise DataError(
                "An episode is too short to predict", where=row.episode_id, expected=1 + unit, got=row.num_frames
            )
        jobs += [Job(position, row.episode_id, partners[row.episode_id], seed, frames) for seed in config.seeds]
    return jobs


def batches(jobs: Sequence[Job], size: int) -> Iterator[list[Job]]:
    """Jobs of equal length together, in a fixed order."""
    for frames in sorted({job.frames for job in jobs}):
        same = [job for job in jobs if job.frames == frames]
        for start in range(0, len(same), size):
            yield same[start : start + size]
