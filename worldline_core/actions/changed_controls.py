"""Controls of an episode changed in a known way: what a prediction under them should show is known as well.

- ``mirrored``: each tool moves, from where it is at first, as if seen in a mirror: in the head camera's frame the
  displacement along x and the turns about y and z change their sign. A wrist camera stays mounted to its tool.
- ``delayed``: each control comes DELAY_FRAMES later; the first one holds until then.

Both leave the first frame as it is, so that they fit the same observed picture. They are poses, not joint positions: no
joint limit is looked at, and models of native control vectors know no mirrored ones.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import torch

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.actions.episode_tracks import HEAD_VIEW, EpisodeTracks
from worldline_core.actions.tool_projection import project_tools
from worldline_core.errors import DataError

Change = Literal["mirrored", "delayed"]
DELAY_FRAMES = TEMPORAL_FACTOR
_MIRROR = np.diag([-1.0, 1.0, 1.0])


def changed_tracks(tracks: EpisodeTracks, change: Change) -> EpisodeTracks:
    """An episode's tracks under changed controls.

    Raises: DataError for a head view without a camera, in whose frame motion is mirrored.
    """
    if change == "delayed":
        return tracks.clip(np.maximum(np.arange(tracks.num_frames) - DELAY_FRAMES, 0))
    head = tracks.views.index(HEAD_VIEW)
    if tracks.camera_motion[head] == "absent":
        raise DataError(
            "Mirrored controls need the head camera", where=f"episode {tracks.episode_id}",
            expected="a calibrated head view", next_step="leave the episode out, or use delayed controls",
        )  # fmt: skip
    T_base_tool = tracks.T_base_tool.astype(np.float64)
    T_head_base = np.linalg.inv(tracks.T_base_camera[0, head].astype(np.float64))
    seen = T_head_base @ T_base_tool
    moved = seen.copy()
    moved[..., :3, 3] = seen[:1, :, :3, 3] + (seen[..., :3, 3] - seen[:1, :, :3, 3]) @ _MIRROR
    first = seen[:1, :, :3, :3]
    turn = seen[..., :3, :3] @ np.swapaxes(first, -1, -2)
    moved[..., :3, :3] = _MIRROR @ turn @ _MIRROR @ first
    T_base_moved = np.linalg.inv(T_head_base) @ moved
    cameras = tracks.T_base_camera.astype(np.float64).copy()
    for column, view in enumerate(tracks.views):
        arm = next((i for i, name in enumerate(tracks.arms) if view == f"{name}_wrist"), None)
        if arm is not None and tracks.camera_motion[column] not in ("static", "absent"):
            cameras[:, column] = T_base_moved[:, arm] @ np.linalg.inv(T_base_tool[:, arm]) @ cameras[:, column]
    projected = project_tools(
        torch.from_numpy(T_base_moved),
        torch.from_numpy(tracks.gripper[:, head].astype(np.float64)),
        torch.from_numpy(tracks.K.astype(np.float64)),
        torch.from_numpy(cameras),
        tracks.image_size,
    )
    arrays = {
        name: getattr(projected, name).numpy().astype(getattr(tracks, name).dtype)
        for name in ("uv", "depth", "rot6d", "gripper", "valid")
    }
    return replace(
        tracks,
        **arrays,
        T_base_tool=T_base_moved.astype(np.float32),
        T_base_camera=cameras.astype(np.float32),
        native=None,
    )
