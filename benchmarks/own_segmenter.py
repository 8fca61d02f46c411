"""Masks of a segmenter that learned a robot from its joints and head camera, and of the shipped one, against exact masks.

    python -m benchmarks.own_segmenter OUTPUT [--bodies xarm7_single,ur5e_silver] [--episodes 54] [--seed 31]

Recordings of `benchmarks.hidden_cameras`: tables, lights and cameras that the shipped one never saw. Eight more are held out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.harness import command_line, print_table
from benchmarks.hidden_cameras import HiddenCameras, drawn_jobs
from worldline_core.actions.actions_config import RenderActionsConfig
from worldline_core.actions.render_actions import render_actions
from worldline_core.data.episodes.episode_set_writer import EpisodeSetWriter
from worldline_core.evaluation.evaluation_config import SegmenterConfig
from worldline_core.evaluation.metrics import frame_iou
from worldline_core.evaluation.segmenters.learned import LearnedSegmenter, train_segmenter
from worldline_core.geometry.cameras import ImageTransform
from worldline_core.recorder.rendering import prepare_rendering
from worldline_core.shipped import shipped_folder

HELD_OUT, SIZE = 8, (64, 96)


def measured(body: str, output: Path, episodes: int, seed: int) -> Iterator[float]:
    """Mean IoU with exact masks of the segmenter that is trained on `episodes` recordings, and of the shipped one."""
    recorder = HiddenCameras(body, seed)
    recordings = [recorder.record(job) for job in drawn_jobs(body, episodes + HELD_OUT, seed)]
    with EpisodeSetWriter(output / "set") as writer:
        for recording in recordings[:episodes]:
            writer.add(replace(recording.episode, split="train"), recording.frames)
    render_actions(RenderActionsConfig.model_validate({}), {"episodes": output / "set"}, output / "tracks")
    inputs = {"episodes": output / "set", "tracks": output / "tracks"}
    train_segmenter(SegmenterConfig(labels="kinematic", steps=400, image_size=SIZE), inputs, output / "segmenter")
    for folder in (output / "segmenter", shipped_folder() / "models" / "segmenter"):
        segmenter, found = LearnedSegmenter.load(folder), []
        for recording in recordings[episodes:]:
            frames, masks = recording.frames["head"], recording.robot_masks["head"]
            small = ImageTransform.of(frames.shape[1:3]).fitted(SIZE).frames(frames)
            exact = ImageTransform.of(masks.shape[1:3]).fitted(SIZE).masks(masks)
            found.append(float(np.mean(frame_iou(exact, segmenter.segment(small)))))
        yield float(np.mean(found))
    recorder.close()


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("output", type=Path)
    parser.add_argument("--bodies", default="xarm7_single,ur5e_silver")
    parser.add_argument("--episodes", type=int, default=54)
    parser.add_argument("--seed", type=int, default=31)
    given = parser.parse_args()
    prepare_rendering()
    rows = (
        (body, *measured(body, given.output / body, given.episodes, given.seed)) for body in given.bodies.split(",")
    )
    print_table(("robot", "its own", "shipped"), rows)


if __name__ == "__main__":
    main()
