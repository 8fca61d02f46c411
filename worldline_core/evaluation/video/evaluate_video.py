"""The step evaluate_video: full-frame metrics and robot-mask IoU of predicted videos.

Two robot IoUs are reported. ``robot_iou`` follows the paper: one segmenter masks the true and the predicted video
independently of each other. ``robot_iou_exact`` compares the predicted video's mask with the recording's exact one.
How good the segmenter itself is shows in the rows of the method ``true``: its masks of true frames against exact ones.
``object_iou_exact`` is of what the task moves, in the frames in which it has moved, where the recording has its exact
pixels: the colour that the instruction names masks it in the predicted video.
Means over trajectories of every frame show drift along a rollout.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import torch

from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError, UnavailableError
from worldline_core.evaluation.evaluation_config import VideoEvaluationConfig
from worldline_core.evaluation.recordings import TRUE_METHOD, open_rollouts, rows_of
from worldline_core.evaluation.scores import (
    SUMMARY_FILE,
    Score,
    kept_part,
    part_file,
    summarise,
    write_scores,
    write_table,
)
from worldline_core.evaluation.segmenters.segmenter import Segmenter, open_segmenter
from worldline_core.evaluation.video.episode_measurement import EpisodeMeasurement, finite_mean
from worldline_core.model.lpips import LPIPS, load_lpips
from worldline_core.progress import Progress
from worldline_core.store.atomic import write_json_atomic

logger = logging.getLogger(__name__)

BY_FRAME_FILE = "by_frame.parquet"
_BY_FRAME_COLUMNS: tuple[str, ...] = ("method", "split", "view", "metric", "frame", "mean", "count")


def evaluate_video(config: VideoEvaluationConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Measure every RolloutSet against the recordings.

    Inputs: episodes, tracks, rollouts.<method> (one or more), segmenter (the folder of the learned one).
    Output: scores.parquet (one row per method, episode, view, seed and metric), by_frame.parquet (means over
    trajectories of each frame), summary.json.
    """
    episodes = EpisodeSet.open(inputs["episodes"])
    tracks = ActionTracks.open(inputs["tracks"])
    rollouts = open_rollouts(inputs)
    segmenters = {
        f"[{name}]" if place else "": open_segmenter(name, learned=inputs.get("segmenter"), sam3=config.sam3_weights)
        for place, name in enumerate(config.segmenters)
    }
    lpips, unavailable = _open_lpips(config.lpips_weights)
    parts = output / "run" / "parts"
    predicted = {method: set(rollout.episode_ids) for method, rollout in rollouts.items()}

    def measure(row: EpisodeRow) -> list[tuple[str, EpisodeRow, dict[str, Any]]]:
        name = row.episode_id
        files = {method: part_file(parts, method, name) for method in rollouts if name in predicted[method]}
        files[TRUE_METHOD] = part_file(parts, TRUE_METHOD, name)
        made: dict[str, dict[str, Any]] = {}
        if not all(path.is_file() for path in files.values()):
            of_episode = {method: rollouts[method] for method in files if method != TRUE_METHOD}
            made = EpisodeMeasurement(episodes, tracks, row, config.views, segmenters, lpips).measure(of_episode)
        return [(method, row, kept_part(path, partial(made.__getitem__, method))) for method, path in files.items()]

    rows = rows_of(episodes, set().union(*predicted.values()))
    records: list[tuple[str, EpisodeRow, dict[str, Any]]] = []
    with (
        _workers(on_gpu="sam3" in config.segmenters) as pool,
        Progress("evaluate_video", len(rows), "episode") as progress,
    ):
        for found in pool.map(measure, rows):
            records += found
            progress.advance()
    return _write(config, records, segmenters, unavailable, output)


@contextmanager
def _workers(*, on_gpu: bool) -> Iterator[ThreadPoolExecutor]:
    """One thread per core, each an episode at a time: decoding, GrabCut and small networks do not fill the cores alone.

    Networks run on one thread then, so that results do not depend on the number of cores.
    """
    count = 1 if on_gpu else torch.get_num_threads()
    pool = ThreadPoolExecutor(count, initializer=torch.set_num_threads, initargs=(torch.get_num_threads() // count,))
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def _open_lpips(folder: Path | None) -> tuple[LPIPS | None, dict[str, str]]:
    """LPIPS where it is available, and otherwise the reason why it is not, by metric."""
    try:
        return load_lpips(folder), {}
    except UnavailableError as error:
        logger.warning("%s", error)
        return None, {"lpips": f"{error.what}: {error.got}" if error.got else error.what}


def _write(
    config: VideoEvaluationConfig,
    records: Sequence[tuple[str, EpisodeRow, dict[str, Any]]],
    segmenters: Mapping[str, Segmenter],
    unavailable: Mapping[str, str],
    output: Path,
) -> dict[str, Any]:
    scores: list[Score] = []
    by_frame: list[tuple[str, str, str, str, list[float | None]]] = []
    for method, row, content in records:
        for item in content["measured"]:
            for metric, frames in item["frames"].items():
                by_frame.append((method, row.split, item["view"], metric, frames))
                value = finite_mean(frames)
                if value is not None:  # otherwise empty in every frame: the video is left out
                    scores.append(
                        Score(
                            method, row.episode_id, row.embodiment, row.split, item["view"], item["seed"], metric, value,
                            row.scene, row.task_family, row.outcome,
                        )
                    )  # fmt: skip
    write_scores(output, scores)
    write_by_frame(output / BY_FRAME_FILE, by_frame)
    options = {"comparisons": config.comparisons, "resamples": config.resamples, "seed": config.seed, "by_view": True}
    predicted = [score for score in scores if score.method != TRUE_METHOD]
    found, kept = {row.episode_id for _, row, _ in records}, {score.episode_id for score in predicted}
    if not kept:
        raise DataError(
            "No prediction could be measured", where=", ".join(sorted(found)[:5]),
            expected=f"predictions of the views {', '.join(config.views)}",
            next_step="evaluate_video.views names what is measured",
        )  # fmt: skip
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
        "units": {"psnr": "dB", "end_effector_error_px": "px"},
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
