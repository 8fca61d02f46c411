"""The step evaluate_video: full-frame metrics and robot-mask IoU of predicted videos.

Two robot IoUs are reported. ``robot_iou`` follows the paper: one segmenter masks the true and the predicted video
independently of each other. ``robot_iou_exact`` compares the predicted video's mask with the recording's exact one.
How good the segmenter itself is shows in the rows of the method ``true``: its masks of true frames against exact ones.
Means over trajectories of every frame show drift along a rollout.
"""

from __future__ import annotations

import json
import logging
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa
import torch
from pydantic import Field
from tqdm import tqdm

from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode import VIEWS, Episode
from worldline_core.errors import UnavailableError
from worldline_core.evaluation.recordings import TRUE_METHOD, Recordings, open_rollouts
from worldline_core.evaluation.scores import SUMMARY_FILE, Score, summarise, write_scores, write_table
from worldline_core.evaluation.segmenters.segmenter import Segmenter, SegmenterName, open_segmenter
from worldline_core.evaluation.video.episode_measurement import EpisodeMeasurement, finite_mean
from worldline_core.model.lpips import LPIPS, load_lpips
from worldline_core.store.atomic import write_json_atomic

logger = logging.getLogger(__name__)

BY_FRAME_FILE = "by_frame.parquet"
_BY_FRAME_SCHEMA = pa.schema(
    [
        ("method", pa.string()),
        ("split", pa.string()),
        ("view", pa.string()),
        ("metric", pa.string()),
        ("frame", pa.int32()),
        ("mean", pa.float64()),
        ("count", pa.int32()),
    ]
)


class VideoEvaluationConfig(StrictModel):
    """What evaluate_video measures."""

    views: tuple[Literal["head", "left_wrist", "right_wrist"], ...] = VIEWS
    segmenters: tuple[SegmenterName, ...] = Field(
        default=("learned",), min_length=1, description="the first one names the metrics without a suffix"
    )
    sam3_weights: Path | None = Field(default=None, description="local folder of SAM 3 weights")
    lpips_weights: Path | None = Field(default=None, description="local folder of LPIPS weights; none: not available")
    comparisons: tuple[tuple[str, str], ...] | None = Field(
        default=None, description="pairs of methods whose differences are reported; none: every pair"
    )
    resamples: int = Field(default=2000, ge=100)
    seed: int = Field(default=42, ge=0)


def evaluate_video(config: VideoEvaluationConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Measure every RolloutSet against the recordings.

    Inputs: episodes, tracks, rollouts.<method> (one or more), segmenter (the folder of the learned one).
    Output: scores.parquet (one row per method, episode, view, seed and metric), by_frame.parquet (means over
    trajectories of each frame), summary.json.
    """
    recordings = Recordings.open(inputs["episodes"])
    tracks = ActionTracks.open(inputs["tracks"])
    rollouts = open_rollouts(inputs)
    segmenters = {
        name: open_segmenter(name, learned=inputs.get("segmenter"), sam3=config.sam3_weights)
        for name in config.segmenters
    }
    lpips, lpips_reason = _open_lpips(config.lpips_weights)
    parts = output / "run" / "parts"

    predicted = {method: set(rollout.episode_ids) for method, rollout in rollouts.items()}

    def measure(episode_id: str) -> list[tuple[str, Episode, dict[str, Any]]]:
        episode = recordings.episode(episode_id)
        measurement = EpisodeMeasurement(recordings, tracks, episode_id, config.views, segmenters, lpips)
        found: list[tuple[str, Episode, dict[str, Any]]] = []
        for method, rollout in rollouts.items():
            if episode_id in predicted[method]:
                part = parts / method / f"{episode_id}.json"
                if not part.exists():
                    write_json_atomic(part, measurement.measure(method, rollout))
                found.append((method, episode, json.loads(part.read_text())))
        num_frames = max(content["num_frames"] for _, _, content in found)
        part = parts / TRUE_METHOD / f"{episode_id}.json"
        if not part.exists():
            write_json_atomic(part, measurement.segmenter_accuracy(num_frames))
        return [*found, (TRUE_METHOD, episode, json.loads(part.read_text()))]

    episode_ids = sorted(set().union(*predicted.values()))
    records: list[tuple[str, Episode, dict[str, Any]]] = []
    with _workers(on_gpu="sam3" in config.segmenters) as pool:
        for found in tqdm(
            pool.map(measure, episode_ids), total=len(episode_ids), desc="evaluate_video", unit="episode", disable=None
        ):
            records += found
    return _write(config, records, segmenters, lpips_reason, output)


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


def _open_lpips(folder: Path | None) -> tuple[LPIPS | None, str | None]:
    try:
        return load_lpips(folder), None
    except UnavailableError as error:
        logger.warning("%s", error)
        return None, f"{error.what}: {error.got}" if error.got else error.what


def _write(
    config: VideoEvaluationConfig,
    records: Sequence[tuple[str, Episode, dict[str, Any]]],
    segmenters: Mapping[str, Segmenter],
    lpips_reason: str | None,
    output: Path,
) -> dict[str, Any]:
    scores: list[Score] = []
    by_frame: list[tuple[str, str, str, str, list[float | None]]] = []
    for method, episode, content in records:
        for item in content["measured"]:
            for metric, frames in item["frames"].items():
                by_frame.append((method, episode.split, item["view"], metric, frames))
                value = finite_mean(frames)
                if value is None:
                    continue  # empty in every frame: the video is left out
                scores.append(
                    Score(
                        method, episode.episode_id, episode.embodiment, episode.split, item["view"], item["seed"], metric,
                        value, episode.scene, episode.task_family, episode.outcome,
                    )
                )  # fmt: skip
    write_scores(output, scores)
    write_by_frame(output / BY_FRAME_FILE, by_frame)
    options = {"comparisons": config.comparisons, "resamples": config.resamples, "seed": config.seed, "by_view": True}
    predicted = summarise([score for score in scores if score.method != TRUE_METHOD], **options)
    accuracy = summarise([score for score in scores if score.method == TRUE_METHOD], **options)["metrics"]
    summary = {
        **predicted,
        "methods": sorted({score.method for score in scores if score.method != TRUE_METHOD}),
        "unavailable": {} if lpips_reason is None else {"lpips": lpips_reason},
        "segmenters": [
            {
                "name": name,
                "description": segmenter.description,
                "suffix": "" if name == config.segmenters[0] else f"[{name}]",
                "accuracy_on_true_frames": {
                    group: methods[TRUE_METHOD] for group, methods in accuracy.items() if TRUE_METHOD in methods
                },
            }
            for name, segmenter in segmenters.items()
        ],
        "units": {"psnr": "dB", "end_effector_error_px": "px"},
        "num_episodes": len({episode.episode_id for _, episode, _ in records}),
        "interval": "95 % bootstrap over trajectories",
    }
    write_json_atomic(output / SUMMARY_FILE, summary)
    return {"episodes": summary["num_episodes"], "methods": summary["methods"], "scores": len(scores)}


def write_by_frame(path: Path, videos: Iterable[tuple[str, str, str, str, Sequence[float | None]]]) -> None:
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
        dict(zip(_BY_FRAME_SCHEMA.names, (*key, sum(values) / len(values), len(values)), strict=True))
        for key, values in sorted(cells.items())
    ]
    write_table(path, rows, _BY_FRAME_SCHEMA)
