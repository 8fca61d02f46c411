"""Action tracks drawn over frames: heat, point and axes of every end-effector, for previews and for checking by eye."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch

from worldline_core.actions.action_maps import REFERENCE_CANVAS, SIGMA_PX_REFERENCE, render_action_maps
from worldline_core.actions.episode_tracks import EpisodeTracks, collate_tracks

ARM_COLOURS: tuple[tuple[int, int, int], ...] = ((255, 210, 0), (255, 0, 220))
"""RGB; the left (or first) arm yellow, the right one magenta."""
AXIS_COLOURS: tuple[tuple[int, int, int], ...] = ((255, 0, 0), (0, 255, 0), (0, 0, 255))
AXIS_LENGTH_M = 0.06
_SHIFT = 4


def _fixed_point(uv: np.ndarray, scale: int) -> tuple[int, int]:
    """uv in OpenCV's fixed point, on an image enlarged `scale` times (pixel centres at whole numbers)."""
    u, v = np.clip((uv + 0.5) * scale - 0.5, -1e4, 1e4) * (1 << _SHIFT)
    return round(float(u)), round(float(v))


def draw_overlay(frame: np.ndarray, tracks: EpisodeTracks, n: int, view: str, *, scale: int = 1) -> np.ndarray:
    """Points and axes (x red, y green, z blue) of the valid end-effectors of frame n over an enlarged copy of it.

    Args:
        frame: uint8 (H, W, 3) RGB, of the tracks' frame size.
    """
    v = tracks.views.index(view)
    height, width = frame.shape[:2]
    canvas = cv2.resize(frame, (width * scale, height * scale), interpolation=cv2.INTER_LINEAR)
    radius = max(2, round(canvas.shape[0] / 80))
    for a in range(len(tracks.arms)):
        if not tracks.valid[n, v, a]:
            continue
        colour = ARM_COLOURS[1 if tracks.arms[a] == "right" else a % len(ARM_COLOURS)]
        origin = _fixed_point(tracks.uv[n, v, a], scale)
        T_camera_base = np.linalg.inv(tracks.T_base_camera[n, v].astype(np.float64))
        T_camera_tool = T_camera_base @ tracks.T_base_tool[n, a].astype(np.float64)
        for axis, axis_colour in enumerate(AXIS_COLOURS):
            tip = T_camera_tool[:3, 3] + AXIS_LENGTH_M * T_camera_tool[:3, axis]
            if tip[2] > 1e-3:
                end = tracks.K[v].astype(np.float64) @ (tip / tip[2])
                cv2.line(
                    canvas, origin, _fixed_point(end[:2], scale), axis_colour, max(1, radius // 3), cv2.LINE_AA, _SHIFT
                )
        cv2.circle(canvas, origin, radius << _SHIFT, colour, max(1, radius // 2), cv2.LINE_AA, _SHIFT)
    return canvas


def blend_heat(picture: np.ndarray, heat: np.ndarray, strength: float = 0.55) -> np.ndarray:
    """Blend a heat map (h, w) in 0..1 over a picture (H, W, 3), enlarged to it."""
    size = (picture.shape[1], picture.shape[0])
    level = cv2.resize(np.clip(heat, 0, 1).astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    coloured = cv2.applyColorMap((level * 255).astype(np.uint8), cv2.COLORMAP_INFERNO)[..., ::-1]
    weight = strength * level[..., None]
    return (picture * (1 - weight) + coloured * weight).astype(np.uint8)


def overlay_frames(
    frames: dict[str, np.ndarray],
    tracks: EpisodeTracks,
    *,
    scale: int = 2,
    sigma_px_ref: float = SIGMA_PX_REFERENCE,
    ref: tuple[int, int] = REFERENCE_CANVAS,
) -> np.ndarray:
    """Views side by side with heat, points and axes: uint8 (N, H, V*W, 3), over the frames that all views have.

    Args:
        frames: by view, uint8 (N, H, W, 3) RGB; views that are missing are left out.
    """
    views = [view for view in tracks.views if view in frames]
    count = min([tracks.num_frames, *(len(frames[view]) for view in views)])
    batch = collate_tracks([tracks.clip(range(count))], views)
    heat = render_action_maps(batch, tracks.image_size, tracks.image_size, sigma_px_ref, ref, torch.float32)[0, :, 0]
    shown = []
    for n in range(count):
        tiles = []
        for i, view in enumerate(views):
            frame = blend_heat(frames[view][n], heat[i, n].numpy())
            tiles.append(draw_overlay(frame, tracks, n, view, scale=scale))
        shown.append(np.concatenate(tiles, axis=1))
    return np.stack(shown)


def contact_sheet(overlay: np.ndarray, moments: Sequence[int], title: str) -> np.ndarray:
    """Frames of an overlay one under the other, with a heading: uint8 (H, W, 3)."""
    heading = np.full((22, overlay.shape[2], 3), 24, dtype=np.uint8)
    cv2.putText(heading, title, (6, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (235, 235, 235), 1, cv2.LINE_AA)
    rows = []
    for n in moments:
        row = overlay[n].copy()
        cv2.putText(
            row, f"frame {n}", (6, row.shape[0] - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1, cv2.LINE_AA
        )
        rows.append(row)
    return np.concatenate([heading, *rows], axis=0)
