"""The step evaluate_video: full-frame metrics and robot-mask IoU of predicted videos.

The method ``true`` shows how good a segmenter itself is, against exact masks or kinematic ones; where it does not know a robot, ``robot_iou``
is withheld with the reason. Means over trajectories of every frame show drift along a rollout. `metric_registry` lists every metric.
"""

from __future__ import annotations

import logging
import os
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from worldline_core.actions.action_tracks import changed_tracks
from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ConfigError, DataError, UnavailableError
from worldline_core.evaluation.evaluation_config import VideoEvaluationConfig
from worldline_core.evaluation.metric_registry import METRICS
from worldline_core.evaluation.metrics import ControlledPair
from worldline_core.evaluation.recordings import HEAD, open_rollouts, open_tracks, rows_of, stride_of, tool_points
from worldline_core.evaluation.scores import (
    SUMMARY_FILE,
    TRUE_METHOD,
    Score,
    kept_part,
    part_file,
    summarise,
    write_scores,
    write_table,
)
from worldline_core.evaluation.segmenters.segmenter import Segmenter, open_segmenter
from worldline_core.evaluation.video.episode_measurement import EpisodeMeasurement, finite_mean
from worldline_core.model.lpips import load_lpips
from worldline_core.progress import Progress
from worldline_core.rollout.rollout_set import RolloutSet
from worldline_core.store.atomic import write_json_atomic

logger = logging.getLogger(__name__)

MIN_SEGMENTER_IOU = 0.7
"""Below this agreement with kinematic masks on true frames a segmenter does not know the robot."""
BY_FRAME_FILE = "by_frame.parquet"
_BY_FRAME_COLUMNS: tuple[str, ...] = ("method", "split", "view", "metric", "frame", "mean", "count")


def evaluate_video(config: VideoEvaluationConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Measure every RolloutSet against the recordings.

    Inputs: episodes, rollouts.<method> (one or more), tracks, segmenter (the folder of the learned one). Full frames alone (PSNR, SSIM,
    LPIPS) are measured of recordings without tracks.
    Output: scores.parquet (one row per method, episode, view, seed and metric), by_frame.parquet (means over
    trajectories of each frame), summary.json.
    """
    episodes = EpisodeSet.open(inputs["episodes"])
    tracks, rollouts = open_tracks(inputs), open_rollouts(inputs)
    segmenters = {
        f"[{name}]" if place else "": open_segmenter(name, learned=inputs.get("segmenter"), sam3=config.sam3_weights)
        for place, name in enumerate(config.segmenters if tracks else ())
    }
    metrics = {name: METRICS[name] for name in config.metrics}
    check_changed_controls(config, list(rollouts))
    unavailable: dict[str, str] = {}
    try:
        lpips = load_lpips(config.lpips_weights)
    except UnavailableError as error:
        logger.warning("%s", error)
        lpips, unavailable["lpips"] = None, f"{error.what}: {error.got}" if error.got else error.what
    if not config.changed_controls:
        missing = "no predictions under changed controls (evaluate_video.changed_controls)"
        unavailable |= {name: missing for name, metric in metrics.items() if metric.needs == "changed_controls"}
    parts = output / "run" / "parts"
    predicted = {method: set(rollout.episode_ids) for method, rollout in rollouts.items()}

    def measure(row: EpisodeRow) -> list[Measured]:
        name = row.episode_id
        files = {method: part_file(parts, method, name) for method in rollouts if name in predicted[method]}
        files[TRUE_METHOD] = part_file(parts, TRUE_METHOD, name)
        made: dict[str, dict[str, Any]] = {}
        if not all(path.is_file() for path in files.values()):
            of_episode = {method: rollouts[method] for method in files if method != TRUE_METHOD}
            episode = EpisodeMeasurement(episodes, tracks, row, config.views, segmenters, lpips, metrics)
            made = episode.measure(of_episode)
        return [(method, row, kept_part(path, partial(made.__getitem__, method))) for method, path in files.items()]

    rows = rows_of(episodes, set().union(*predicted.values()))
    if without := sum(tracks is None or row.episode_id not in tracks for row in rows):
        missing = f"{without} of {len(rows)} recordings have no action tracks"
        unavailable |= dict.fromkeys(("robot_iou", *metrics), missing)
    records: list[Measured] = []
    with (
        _workers(on_gpu="sam3" in config.segmenters) as pool,
        Progress("evaluate_video", len(rows), "episode") as progress,
    ):
        for found in pool.map(measure, rows):
            records += found
            progress.advance()
    pairs = [] if tracks is None else list(controlled_values(config, records, tracks, rollouts))
    return _write(config, records, pairs, segmenters, unavailable, output)


@contextmanager
def _workers(*, on_gpu: bool) -> Iterator[ThreadPoolExecutor]:
    """One thread per core, each an episode at a time: decoding, GrabCut and small networks do not fill the cores alone.

    Networks run on one thread then, so that results do not depend on the number of cores. Where steps run side by side it takes all cores,
    too: it is the last to end.
    """
    count, threads = (1, torch.get_num_threads()) if on_gpu else (len(os.sched_getaffinity(0)), 1)
    pool = ThreadPoolExecutor(count, initializer=torch.set_num_threads, initargs=(threads,))
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def _write(
    config: VideoEvaluationConfig,
    records: Sequence[Measured],
    pairs: Sequence[tuple[str, EpisodeRow, int, str, float]],
    segmenters: Mapping[str, Segmenter],
    unavailable: Mapping[str, str],
    output: Path,
) -> dict[str, Any]:
    def score(method: str, row: EpisodeRow, view: str, seed: int, metric: str, value: float) -> Score:
        return Score(
            method, row.episode_id, row.embodiment, row.split, view, seed, metric, value,
            row.scene, row.task_family, row.outcome,
        )  # fmt: skip

    scores = [score(method, row, HEAD, seed, metric, value) for method, row, seed, metric, value in pairs]
    by_frame: list[tuple[str, str, str, str, list[float | None]]] = []
    withheld = unchecked_segmenters(records, segmenters)
    for method, row, content in records:
        for item in content["measured"]:
            kept_frames = {n: frames for n, frames in item["frames"].items() if (row.embodiment, n) not in withheld}
            by_frame += [(method, row.split, item["view"], name, frames) for name, frames in kept_frames.items()]
            values = {name: finite_mean(frames) for name, frames in kept_frames.items()} | item.get("video", {})
            # What is empty in every frame is left out.
            scores += [
                score(method, row, item["view"], item["seed"], name, value)
                for name, value in values.items()
                if value is not None
            ]
    write_scores(output, scores)
    write_by_frame(output / BY_FRAME_FILE, by_frame)
    options = {"resamples": config.resamples, "seed": config.seed, "by_view": True}
    predicted = [score for score in scores if score.method != TRUE_METHOD]
    found, kept = {row.episode_id for _, row, _ in records}, {score.episode_id for score in predicted}
    if not kept:
        raise DataError(
            "No prediction could be measured", where=", ".join(sorted(found)[:5]),
            expected=f"predictions of the views {', '.join(config.views)}",
            next_step="evaluate_video.views names what is measured",
        )  # fmt: skip
    for (embodiment, metric), reason in withheld.items():
        logger.warning("%s is withheld: %s: %s", metric, embodiment, reason)
        known = [unavailable[metric]] if metric in unavailable else []
        unavailable = {**unavailable, metric: "; ".join([*known, f"{embodiment}: {reason}"])}
    accuracy = summarise([score for score in scores if score.method == TRUE_METHOD], **options)["metrics"]
    accuracy = {group: methods[TRUE_METHOD] for group, methods in accuracy.items()}
    summary = {
        **summarise(predicted, **options),
        "methods": sorted({score.method for score in predicted}),
        "unavailable": unavailable,
        "segmenters": [
            {"name": s.name, "description": s.description, "suffix": suffix, "accuracy_on_true_frames": accuracy}
            for suffix, s in segmenters.items()
        ],
        "units": {metric.name: metric.unit for metric in METRICS.values() if metric.unit},
        "num_episodes": len(found),
        "interval": "95 % bootstrap over trajectories",
    }
    write_json_atomic(output / SUMMARY_FILE, summary)
    return {
        "found": len(found),
        "kept": len(kept),
        "left_out": {"without a view that is measured": len(found - kept)},
        "episodes": summary["num_episodes"],
        "methods": summary["methods"],
        "scores": len(scores),
    }


def unchecked_segmenters(
    records: Sequence[Measured], segmenters: Mapping[str, Segmenter]
) -> dict[tuple[str, str], str]:
    """By embodiment and metric, why a segmenter's IoU says nothing about a robot.

    Where a recording has no exact masks, the segmenter's masks of its true frames must agree with the kinematic ones.
    """
    withheld = {}
    for suffix in segmenters:
        agreed: dict[str, list[float | None]] = defaultdict(list)
        for method, row, content in records:
            for item in content["measured"] if method == TRUE_METHOD else ():
                if f"robot_iou_exact{suffix}" not in item["frames"]:
                    agreed[row.embodiment].append(finite_mean(item["frames"].get(f"robot_iou_kinematic{suffix}", ())))
        for embodiment, values in agreed.items():
            mean = finite_mean(values)
            if mean is None:
                reason = "no exact masks, and no head camera to draw kinematic ones with: the segmenter is unchecked"
            elif mean < MIN_SEGMENTER_IOU:
                reason = (
                    f"its masks of true frames agree with kinematic ones by {mean:.2f} (of {len(values)} episodes), "
                    f"less than {MIN_SEGMENTER_IOU}"
                )
            else:
                continue
            withheld[embodiment, f"robot_iou{suffix}"] = reason
    return withheld


def write_by_frame(path: Path, videos: Sequence[tuple[str, str, str, str, Sequence[float | None]]]) -> None:
    """Average per-frame values over videos.

    Args:
        videos: (method, split, view, metric, value of each frame; None where a frame is left out).
    """
    cells: dict[tuple[str, str, str, str, int], list[float]] = defaultdict(list)
    for method, split, view, metric, frames in videos:
        for frame, value in enumerate(frames):
            if value is not None:
                cells[method, split, view, metric, frame].append(value)
    rows = [
        dict(zip(_BY_FRAME_COLUMNS, (*key, sum(values) / len(values), len(values)), strict=True))
        for key, values in sorted(cells.items())
    ]
    write_table(path, rows, _BY_FRAME_COLUMNS)


Measured = tuple[str, EpisodeRow, dict[str, Any]]
"""A method, an episode, and what was measured of its predictions."""


def check_changed_controls(config: VideoEvaluationConfig, methods: Sequence[str]) -> None:
    """Raises ConfigError where a method of ``changed_controls`` was not predicted."""
    named = {name for method, changes in config.changed_controls.items() for name in (method, *changes.values())}
    if missing := sorted(named - set(methods)):
        raise ConfigError(
            "Methods of evaluate_video.changed_controls were not predicted", expected=f"some of {sorted(methods)}",
            got=missing, next_step="add them to rollouts (actions: mirrored, delayed or shuffled), or leave them out",
        )  # fmt: skip


def controlled_values(
    config: VideoEvaluationConfig, records: Sequence[Measured], tracks: ActionTracks, rollouts: Mapping[str, RolloutSet]
) -> Iterator[tuple[str, EpisodeRow, int, str, float]]:
    """(method, episode, seed, ``metric[change]``, value) of every pair of predictions of the head view.

    Raises: DataError when both were not predicted at one rate.
    """
    metrics = {name: METRICS[name] for name in config.metrics if METRICS[name].needs == "changed_controls"}
    tools: dict[tuple[str, str], dict[int, np.ndarray]] = {}
    for method, row, content in records:
        found = {
            item["seed"]: np.array(item["tools"], dtype=np.float64) for item in content["measured"] if "tools" in item
        }
        tools[method, row.episode_id] = found
    for method, row, _ in records:
        for change, other in sorted(config.changed_controls.get(method, {}).items()):
            own, changed = (tools.get((name, row.episode_id), {}) for name in (method, other))
            for seed in sorted(own.keys() & changed.keys()):
                strides = [stride_of(rollouts[name], row) for name in (method, other)]
                if strides[0] != strides[1]:
                    raise DataError(
                        "Predictions under true and changed controls have different rates",
                        where=f"{method} and {other}, episode {row.episode_id}", got=f"strides {strides}",
                    )  # fmt: skip
                pair = _pair(tracks, row, change, own[seed], changed[seed], strides[0])
                for name, metric in metrics.items():
                    value = metric.load()(pair)
                    if value is not None:
                        yield method, row, seed, f"{name}[{change}]", value


def _pair(
    tracks: ActionTracks, row: EpisodeRow, change: str, own: np.ndarray, changed: np.ndarray, stride: int
) -> ControlledPair:
    """Both predictions over the frames that both have; of shuffled controls it is not known where they lead."""
    count, recorded = min(len(own), len(changed)), tracks.tracks(row.episode_id)
    scale, commanded = 100.0 / recorded.image_size[0], None
    if change == "mirrored" or change == "delayed":
        seen, view = changed_tracks(recorded, change), VIEWS.index(HEAD)
        frames = slice(0, stride * count, stride)
        commanded = scale * np.where(seen.valid[frames, view, :, None], seen.uv[frames, view], np.nan)
    true = scale * tool_points(tracks, row.episode_id, count, stride)
    return ControlledPair(true, own[:count], changed[:count], commanded)
