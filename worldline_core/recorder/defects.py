"""Defects: a healthy recording spoiled in one known way, for the filters to find.

Which recording has which defect is written to ``injected_defects.json``, which no filter reads.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.recorder.simulate import Recording

DEFECTS_FILE = "injected_defects.json"


def _stretch(recording: Recording, index: np.ndarray) -> Recording:
    """The recording at frame numbers ``index`` (frames may repeat); time stays even."""
    episode = recording.episode
    cameras = {
        view: replace(camera, T_base_camera=camera.T_base_camera[index]) if camera.moving else camera
        for view, camera in episode.cameras.items()
    }
    return Recording(
        replace(
            episode,
            state=episode.state[index],
            action=episode.action[index],
            timestamps=np.arange(len(index)) / episode.fps,
            cameras=cameras,
        ),
        {view: images[index] for view, images in recording.frames.items()},
        {view: masks[index] for view, masks in recording.robot_masks.items()},
    )


def static_lead_in(recording: Recording, random: np.random.Generator) -> Recording:
    """The robot stands still for two seconds before it starts."""
    count = recording.episode.num_frames
    return _stretch(recording, np.concatenate([np.zeros(16, dtype=np.int64), np.arange(count)]))


def reset_segment(recording: Recording, random: np.random.Generator) -> Recording:
    """The arms jump back to where they started, as when a second attempt is recorded into the same file."""
    count = recording.episode.num_frames
    return _stretch(recording, np.concatenate([np.arange(count), np.arange(count // 2)]))


def frozen_camera(recording: Recording, random: np.random.Generator) -> Recording:
    """The head camera delivers one picture from a quarter of the episode on."""
    images = recording.frames["head"].copy()
    start = len(images) // 4
    images[start:] = images[start]
    return replace(recording, frames={**recording.frames, "head": images})


def corrupted_frames(recording: Recording, random: np.random.Generator) -> Recording:
    """Some frames of the head view are noise or black."""
    images = recording.frames["head"].copy()
    chosen = random.choice(np.arange(4, len(images)), size=8, replace=False)
    for number, frame in enumerate(sorted(int(c) for c in chosen)):
        if number % 2:
            images[frame] = 0
        else:
            images[frame] = random.integers(0, 256, images[frame].shape, dtype=np.uint8)
    return replace(recording, frames={**recording.frames, "head": images})


def lagged_state(recording: Recording, random: np.random.Generator) -> Recording:
    """States and actions are stamped four frames (0.5 s) late against the pictures."""
    index = np.maximum(np.arange(recording.episode.num_frames) - 4, 0)
    episode = replace(recording.episode, state=recording.episode.state[index], action=recording.episode.action[index])
    return replace(recording, episode=episode)


def _with_camera(recording: Recording, view: str, camera: CameraTrack) -> Recording:
    cameras = {**recording.episode.cameras, view: camera}
    return replace(recording, episode=replace(recording.episode, cameras=cameras))


def inverted_extrinsics(recording: Recording, random: np.random.Generator) -> Recording:
    """All camera poses are given as base-in-camera instead of camera-in-base."""
    for view, camera in recording.episode.cameras.items():
        inverse = np.linalg.inv(camera.T_base_camera)
        recording = _with_camera(recording, view, replace(camera, T_base_camera=inverse))
    return recording


def intrinsics_of_other_size(recording: Recording, random: np.random.Generator) -> Recording:
    """K of the head camera belongs to pictures of 480 x 640, the recorded ones are smaller."""
    camera = recording.episode.cameras["head"]
    scale = np.diag([640 / camera.width, 480 / camera.height, 1.0])
    return _with_camera(recording, "head", replace(camera, K=scale @ camera.K))


DEFECTS: dict[str, Callable[[Recording, np.random.Generator], Recording]] = {
    spoil.__name__: spoil
    for spoil in (
        static_lead_in, reset_segment, frozen_camera, corrupted_frames, lagged_state, inverted_extrinsics,
        intrinsics_of_other_size,
    )
}  # fmt: skip
