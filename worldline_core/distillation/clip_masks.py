"""Robot masks of training clips at latent resolution, from the capsules stored with the action tracks.

Masks weigh the robot-focused losses during distillation; no model ever receives them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from worldline_core.actions.episode_tracks import EpisodeTracks
from worldline_core.actions.robot_masks import kinematic_robot_masks
from worldline_core.geometry.cameras import valid_intrinsics
from worldline_core.geometry.se3 import is_rigid


def clip_robot_masks(
    clips: Sequence[EpisodeTracks], views: Sequence[str], grid_size: tuple[int, int]
) -> Float[Tensor, "b v t h w"]:
    """Masks (0 or 1) of clips of equal length, one for each latent frame.

    A view without a valid calibration shows no robot: its mask is empty, and the losses leave it out.

    Args:
        clips: tracks cut to every RGB frame of each clip (4 k + 1 frames).
        grid_size: (rows, columns) of the latents.

    Raises:
        ConfigError: the clips do not fit the tokenizer.
    """
    parts = max(len(clip.capsule_radii) for clip in clips)
    order = [[clip.views.index(view) for view in views] for clip in clips]
    capsules = np.stack([_padded(clip.capsules, 1, parts) for clip in clips])
    radii = np.stack([_padded(clip.capsule_radii, 0, parts) for clip in clips])
    K = torch.from_numpy(np.stack([clip.K[index] for clip, index in zip(clips, order, strict=True)]))
    cameras = torch.from_numpy(
        np.stack([clip.T_base_camera[:, index] for clip, index in zip(clips, order, strict=True)])
    )
    calibrated = valid_intrinsics(K) & is_rigid(cameras).all(dim=1)
    identity = torch.eye(4, dtype=K.dtype)
    K = torch.where(calibrated[..., None, None], K, identity[:3, :3])
    cameras = torch.where(calibrated[:, None, :, None, None], cameras, identity)
    masks = kinematic_robot_masks(
        torch.from_numpy(capsules), torch.from_numpy(radii), K, cameras, clips[0].image_size, grid_size
    )
    return masks * calibrated[:, :, None, None, None].to(masks)


def _padded(array: np.ndarray, axis: int, size: int) -> np.ndarray:
    """Zeros at the end of `axis`: a capsule of radius 0 covers nothing."""
    widths = [(0, 0)] * array.ndim
    widths[axis] = (0, size - array.shape[axis])
    return np.pad(array, widths)
