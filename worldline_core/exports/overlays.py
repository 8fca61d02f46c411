"""Action maps drawn over frames: where the Gaussians of the 9-channel maps lie in each view.

The heat shown is the first channel `h` of the action maps (method: section 2), at picture resolution instead of
latent resolution, with sigma scaled from the 384 x 512 reference canvas.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from worldline_core.exports.labels import Picture

REFERENCE_SIZE = (384, 512)
REFERENCE_SIGMA_PX = 10.0
ARM_COLOURS: dict[str, tuple[int, int, int]] = {"left": (255, 138, 30), "right": (48, 150, 255)}
OTHER_ARM_COLOUR = (60, 200, 120)
AXIS_COLOURS: tuple[tuple[int, int, int], ...] = ((230, 60, 60), (60, 190, 80), (70, 110, 240))


def arm_colour(arms: Sequence[str], index: int) -> tuple[int, int, int]:
    """Colour of an arm by its name: left orange, right blue, any other green."""
    return ARM_COLOURS.get(arms[index] if index < len(arms) else "", OTHER_ARM_COLOUR)


def gaussian(
    uv: NDArray[np.floating], height: int, width: int, sigma_px_ref: float = REFERENCE_SIGMA_PX
) -> NDArray[np.float32]:
    """`h(u) = exp(-|u - u_t|^2 / (2 sigma^2))` on an `h w` grid of pixel centres; sigma is given on the reference canvas."""
    sigma_v, sigma_u = sigma_px_ref * height / REFERENCE_SIZE[0], sigma_px_ref * width / REFERENCE_SIZE[1]
    v, u = np.mgrid[0:height, 0:width].astype(np.float32)
    return np.exp(-0.5 * (((u - uv[0]) / sigma_u) ** 2 + ((v - uv[1]) / sigma_v) ** 2)).astype(np.float32)


def draw_action_overlay(
    frame: Picture,
    uv: NDArray[np.floating],
    valid: NDArray[np.bool_],
    *,
    gripper: NDArray[np.floating] | None = None,
    rot6d: NDArray[np.floating] | None = None,
    depth: NDArray[np.floating] | None = None,
    K: NDArray[np.floating] | None = None,
    scale: int = 4,
    arms: Sequence[str] = ("left", "right"),
    sigma_px_ref: float = REFERENCE_SIGMA_PX,
) -> Picture:
    """Draws every valid arm's heat, tool axes and gripper opening over an enlarged frame.

    Args:
        frame: `h w 3` RGB.
        uv: `a 2`, end-effector in pixels of the frame.
        valid: `a`; arms that are not valid in this view are left out.
        gripper: `a`, 0 closed .. 1 open; drawn as the radius of a ring.
        rot6d: `a 6`, first two columns of the end-effector's rotation in the camera frame; drawn as a triad.
        depth: `a`, metres, and K: `3 3`, pixels: both are needed to draw the triad in perspective.
        scale: whole enlargement of the frame.
        arms: names along `a`, which choose the colours.
        sigma_px_ref: sigma on the 384 x 512 reference canvas.
    """
    height, width = frame.shape[0] * scale, frame.shape[1] * scale
    canvas = cv2.resize(frame, (width, height), interpolation=cv2.INTER_LANCZOS4).astype(np.float32)
    for arm in range(uv.shape[0]):
        if not valid[arm]:
            continue
        colour = np.asarray(arm_colour(arms, arm), dtype=np.float32)
        heat = gaussian((uv[arm] + 0.5) * scale - 0.5, height, width, sigma_px_ref)[..., None] * 0.9
        canvas = canvas * (1 - heat) + colour * heat
    picture = np.ascontiguousarray(np.clip(canvas, 0, 255).astype(np.uint8))
    for arm in range(uv.shape[0]):
        if not valid[arm]:
            continue
        centre = (uv[arm].astype(np.float64) + 0.5) * scale - 0.5
        if rot6d is not None and depth is not None and K is not None:
            draw_triad(picture, centre, rot6d[arm].astype(np.float64), float(depth[arm]), enlarged_intrinsics(K, scale))
        opening = 0.5 if gripper is None else float(np.clip(gripper[arm], 0.0, 1.0))
        # The ring encloses the heat: from 1.5 sigma (closed) to 2.5 sigma (open).
        radius = (1.5 + opening) * sigma_px_ref * height / REFERENCE_SIZE[0]
        cv2.circle(picture, fixed_point(centre), round(radius * 16), (255, 255, 255), 1, cv2.LINE_AA, shift=4)
    return picture


def enlarged_intrinsics(K: NDArray[np.floating], scale: float) -> NDArray[np.float64]:
    """K after an enlargement; pixel centres lie at whole coordinates, so u' = (u + 1/2) s - 1/2."""
    shift = (scale - 1) / 2
    return np.array([[scale, 0.0, shift], [0.0, scale, shift], [0.0, 0.0, 1.0]]) @ np.asarray(K, dtype=np.float64)


def draw_triad(
    picture: Picture, centre: NDArray[np.float64], rot6d: NDArray[np.float64], depth: float, K: NDArray[np.float64]
) -> None:
    """Draws x (red), y (green) and z (blue) of the tool, 6 cm long, into the picture; skips what lies behind."""
    x, y = rot6d[:3], rot6d[3:]
    axes = np.stack([x, y, np.cross(x, y)])
    ray = np.array([(centre[0] - K[0, 2]) / K[0, 0], (centre[1] - K[1, 2]) / K[1, 1], 1.0])
    tips = ray * depth + 0.06 * axes
    for tip, colour in zip(tips, AXIS_COLOURS, strict=True):
        if tip[2] <= 1e-3:
            continue
        end = np.array([K[0, 0] * tip[0] / tip[2] + K[0, 2], K[1, 1] * tip[1] / tip[2] + K[1, 2]])
        if np.all(np.abs(end) < 1e5):
            cv2.line(picture, fixed_point(centre), fixed_point(end), colour, 2, cv2.LINE_AA, shift=4)


def fixed_point(point: NDArray[np.float64]) -> tuple[int, int]:
    """A point with 4 fractional bits, as OpenCV's drawing functions take it."""
    return round(float(point[0]) * 16), round(float(point[1]) * 16)


def heat_picture(channel: NDArray[np.floating], *, tile_height: int = 128) -> Picture:
    """One channel of an action map as a picture: blue negative, grey zero, red positive, symmetric range."""
    peak = float(np.abs(channel).max()) or 1.0
    value = np.clip(channel / peak, -1.0, 1.0)[..., None].astype(np.float32)
    zero, red, blue = (np.array(c, np.float32) for c in ((234, 232, 226), (200, 48, 38), (36, 84, 180)))
    picture = np.where(value >= 0, zero + (red - zero) * value, zero + (blue - zero) * -value)
    factor = max(1, tile_height // channel.shape[0])
    return picture.round().astype(np.uint8).repeat(factor, axis=0).repeat(factor, axis=1)
