"""Robot masks of recordings without exact ones: the robot's capsules, cut out by the colours within them."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from worldline_core.actions.episode_tracks import EpisodeTracks
from worldline_core.actions.robot_masks import project_capsules

_ROUNDS = 3
_ROWS = 192
"""Small frames are enlarged to about this height: of a few hundred pixels GrabCut leaves nothing."""


def kinematic_masks(
    tracks: EpisodeTracks, view: str, index: NDArray[np.int64], frames: NDArray[np.uint8]
) -> NDArray[np.bool_] | None:
    """Masks (n, h, w) of the robot in frames (n, h, w, 3) of a recording, ``index`` their numbers; None without the view's camera.

    Capsules are wider than most links. What lies outside of all of them is not robot; within, GrabCut (Rother et al. 2004) parts the
    robot's colours from those of the surroundings, frame by frame.
    """
    number = tracks.views.index(view)
    if tracks.camera_motion[number] == "absent":
        return None
    capsules, radii, K, poses = (
        torch.from_numpy(np.asarray(values, dtype=np.float64))[None]
        for values in (
            tracks.capsules[index], tracks.capsule_radii, tracks.K[[number]], tracks.T_base_camera[index][:, [number]]
        )
    )  # fmt: skip
    factor = max(1, round(_ROWS / frames.shape[1]))
    size = (factor * frames.shape[1], factor * frames.shape[2])
    covered = project_capsules(capsules, radii, K, poses, tracks.image_size, size)[0, 0].numpy()
    return np.stack([_cut_out(frame, mask) for frame, mask in zip(frames, covered, strict=True)])


def _cut_out(frame: NDArray[np.uint8], covered: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask of a frame, at its size, from the capsules in it, at theirs."""
    rows, columns = covered.shape
    if covered.any() and not covered.all():
        covered = _robot_colours(cv2.resize(frame, (columns, rows), interpolation=cv2.INTER_CUBIC), covered)
    shares = cv2.resize(covered.astype(np.float32), (frame.shape[1], frame.shape[0]), interpolation=cv2.INTER_AREA)
    return shares > 0.5


def _robot_colours(frame: np.ndarray, covered: NDArray[np.bool_]) -> NDArray[np.bool_]:
    labels = np.where(covered, cv2.GC_PR_FGD, cv2.GC_BGD).astype(np.uint8)
    cv2.setRNGSeed(0)  # its colour models begin with random clusters
    colours = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(frame, labels, (0, 0, 1, 1), *colours, _ROUNDS, cv2.GC_INIT_WITH_MASK)
    return labels == cv2.GC_PR_FGD
