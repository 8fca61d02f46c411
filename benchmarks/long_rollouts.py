"""Long rollouts of a causal model with several anchors: how many outcomes are undone later, and the IoU of each block.

    worldline record --config configs/recording/long.yaml --output RECORDINGS
    python benchmarks/long_rollouts.py RECORDINGS [--model FOLDER] [--anchors 0 2] [--limit 60]

RECORDINGS is an EpisodeSet with exact masks. An outcome is undone where the measured judge sees success at the end of some block in
both the recording and the prediction, and at the end of the last block in the recording alone. Anchors: blocks after which the
rollout begins anew at its own last picture (0: never).
"""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np
import torch
from tqdm import tqdm

from benchmarks.harness import command_line
from benchmarks.judge_recordings import IMAGE, shrunk, task_of
from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.evaluation.metrics import frame_iou
from worldline_core.evaluation.planning.bracket import planning_indices
from worldline_core.evaluation.policy.judge import establishes_success, route
from worldline_core.evaluation.policy.measured_judge import facts, measure
from worldline_core.evaluation.scores import bootstrap_mean
from worldline_core.evaluation.segmenters.coloured_things import named_things, own_colour, thing_share
from worldline_core.evaluation.segmenters.learned import LearnedSegmenter
from worldline_core.evaluation.video.episode_measurement import MOVED_IOU
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.model.tokenizers import frames_to_video
from worldline_core.rollout.worldline import WorldLine
from worldline_core.shipped import SHIPPED

HALF = 16
"""Frames of the beginning, and before a cut, that the judge sees: as in a clip of 33."""
Video = dict[str, np.ndarray]


def successes(segmenter: LearnedSegmenter, instruction: str, video: Video, cuts: list[int]) -> list[bool]:
    """The judge's verdict at each of ``cuts``, on a clip of the first frames and the last ones before the cut."""
    family = route(instruction)
    seen = []
    for cut in cuts:
        clip = [*range(HALF + 1), *range(cut - HALF, cut)]
        shown = {view: frames[[clip[i] for i in planning_indices(len(clip))]] for view, frames in video.items()}
        seen.append(
            establishes_success(facts(measure(segmenter, instruction, family, shown, None), instruction, family))
        )
    return seen


def object_iou(episodes: EpisodeSet, position: int, head: np.ndarray) -> np.ndarray:
    """IoU (n) of what the task moves with its exact mask; NaN where it has not moved or is hidden."""
    labels, (thing, *_) = episodes.thing_labels(position, "head"), named_things(episodes.rows[position].instruction)
    shares = [
        cv2.resize(np.float32(label == 1), IMAGE[::-1], interpolation=cv2.INTER_AREA) for label in np.asarray(labels)
    ]
    exact = np.stack(shares)[: len(head)] >= 0.5
    moved = (frame_iou(exact, np.repeat(exact[:1], len(exact), axis=0)) < MOVED_IOU) & exact.any(axis=(1, 2))
    found = thing_share(head, thing.colour, own_colour(head, thing.colour)) > 0.5
    return np.where(moved, frame_iou(exact, found), np.nan)


def main() -> None:
    """Predict every recording with each anchor; print a table."""
    parser = command_line(__doc__)
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--model", type=Path, default=SHIPPED / "models" / "causal")
    parser.add_argument("--anchors", type=int, nargs="+", default=[0, 2])
    parser.add_argument("--limit", type=int)
    arguments = parser.parse_args()
    episodes = EpisodeSet.open(arguments.recordings)
    segmenter = LearnedSegmenter.load(SHIPPED / "models" / "segmenter")
    world = WorldLine.from_pretrained(arguments.model, expect_kind="causal")
    spec, block = world.causal, world.frames_per_unit
    undone: dict[str, dict[str, list[bool]]] = defaultdict(lambda: defaultdict(list))
    ious: dict[str, list[np.ndarray]] = defaultdict(list)
    chosen = [p for p in episodes.select() if episodes.rows[p].outcome == "success"][: arguments.limit]
    for position in tqdm(chosen, disable=None):
        row, episode = episodes.rows[position], episodes.episode(position)
        cuts = list(range(1 + 2 * block, row.num_frames + 1, block))
        truth = {view: shrunk(episodes.frames(position, view)) for view in world.views}
        tracks, _ = compute_tracks(episode, ArmKinematics(load_embodiment(str(episode.embodiment))))
        first = torch.stack([frames_to_video(truth[view][:1])[:, 0] for view in world.views])[None]
        videos, known = {"true": truth}, []
        for anchor in arguments.anchors:
            world.causal = spec.model_copy(update={"anchor_blocks": anchor or None})
            pieces = [clips[0] for clips in world.stream(first, [tracks], row.num_frames, [42])]
            videos[f"anchor {anchor}"] = {v: np.concatenate([piece[v] for piece in pieces]) for v in world.views}
        for name, video in videos.items():
            seen = successes(segmenter, row.instruction, video, cuts)
            known = seen if name == "true" else known
            if known[-1] and any(both[0] and both[1] for both in zip(seen[:-1], known[:-1], strict=True)):
                undone[name][task_of(row.instruction)].append(not seen[-1])
            ious[name].append(object_iou(episodes, position, video["head"]))
    table = {}
    for name, values in ious.items():
        blocks = np.stack(
            [
                np.nanmean(np.pad(v[1:], (0, -(len(v) - 1) % block), constant_values=np.nan).reshape(-1, block), axis=1)
                for v in values
            ]
        )
        happened = [one for task in undone[name].values() for one in task]
        table[name] = {
            "undone": f"{sum(happened)} of {len(happened)}",
            "by_task": {task: f"{sum(one)} of {len(one)}" for task, one in sorted(undone[name].items())},
            "object_iou_by_block": [round(float(mean), 3) for mean in np.nanmean(blocks, axis=0)],
            "object_iou_last_block": str(bootstrap_mean([v for v in blocks[:, -1] if np.isfinite(v)], seed=42)),
        }
    print(json.dumps(table, indent=1))


if __name__ == "__main__":
    main()
