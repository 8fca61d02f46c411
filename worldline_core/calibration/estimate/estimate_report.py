"""Results of an estimate: lines for the terminal, JSON, and a page with a picture of each view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from worldline_core.actions.overlays import OverlayStyle, draw_overlay, legend_strip
from worldline_core.calibration.check import SIGMA_PX_REF, TILE_HEIGHT, recorded_tracks
from worldline_core.data.episodes.conventions import RecordedConventions, with_image_lags
from worldline_core.errors import ConfigError
from worldline_core.pages.page import render
from worldline_core.pictures import Picture, SheetRow, contact_sheet, draw_tag, scale_frames, scaled_size

if TYPE_CHECKING:
    from worldline_core.calibration.estimate.verdict import BasePose, SourceEstimate, ViewEstimate
    from worldline_core.data.episodes.episode import CameraTrack, Episode
    from worldline_core.geometry.kinematics import ArmKinematics

LEAST_LAG = 0.75
"""Frames; what is less is left as it is."""


def headline(estimate: ViewEstimate) -> str:
    """The result of one view in one line."""
    camera = estimate.camera
    if camera is None:
        return f"{estimate.view}: no camera"
    place = ", ".join(f"{value:.3f}" for value in camera.T_base_camera[0, :3, 3])
    where = f"at {place} m in the tool's frame" if estimate.wrist else f"at {place} m"
    return (
        f"{estimate.view}: {estimate.verdict}, focal length {camera.K[0, 0]:.0f} px of {camera.width}, {where},"
        f" lag {estimate.lag_frames:+.1f} frames, agreement {estimate.agreement:.2f}"
    )


def interval_text(estimate: ViewEstimate) -> str:
    """The 95 % intervals in one line."""
    return ", ".join(f"{each.kind} ± {each.half_interval:.1f} {each.unit}" for each in estimate.intervals)


def base_text(found: SourceEstimate) -> str:
    """The found base in one line; empty where none was unknown."""
    if (base := found.base) is None:
        return ""
    place = ", ".join(f"{value:.3f}" for value in base.placed.translation)
    verdict = f"not sure: {base.reason}" if base.reason else "sure"
    return (
        f"base of {base.mount}: at {place} m by {base.view}, 95 %: ± {base.half_interval_mm:.0f} mm,"
        f" ± {base.half_interval_deg:.1f} deg; {verdict}"
    )


def mount_line(found: SourceEstimate) -> str:
    """The line for the robot's file; empty where no base is sure."""
    if (base := found.base) is None or base.reason is not None:
        return ""
    place, turn = ([round(v, 5) for v in values] for values in (base.placed.translation, base.placed.rotation_wxyz))
    return f"{base.mount}: {{translation: {place}, rotation_wxyz: {turn}}}"


def image_lags(found: SourceEstimate) -> dict[str, int]:
    """Frames by which the pictures of each sure view trail the states; less than 0.75 is none."""
    lags = {each.view: each.lag_frames for each in found.views if each.verdict == "sure"}
    return {view: round(lag) if abs(lag) >= LEAST_LAG else 0 for view, lag in lags.items()}


def estimate_text(found: SourceEstimate) -> str:
    """The lines for the terminal."""
    lines = [f"source {found.source}"]
    lines += ["", base_text(found)] if found.base is not None else []
    lines += [f"  in the robot's file, under mounts: {line}"] if (line := mount_line(found)) else []
    for each in found.views:
        lines += ["", headline(each)]
        lines += [f"  95 %: {interval_text(each)}"] if each.intervals else []
        lines += [f"  not sure: {reason}" for reason in each.reasons]
        if each.rival_agreement is not None:
            lines.append(f"  the best camera elsewhere agrees by {each.rival_agreement:.2f}")
        lines += [f"  note: {note}" for note in each.notes]
    try:
        late = with_image_lags(RecordedConventions(), image_lags(found)).config_lines()
    except ConfigError as error:
        late = (f"{error.what}: {error.got}",)
    lines += ["", "in the configuration of this source:", *late] if late else []
    lines += ["", f"pictures: {found.output / 'index.html'}"]
    if found.cameras is not None:
        lines.append(f"cameras: {found.cameras}")
        lines.append("next: copy it into the dataset's folder, add `calibration: cameras.json` to the source, and run")
        lines.append("  worldline calibrate check on the same configuration")
    return "\n".join(lines)


def as_json(found: SourceEstimate) -> dict[str, Any]:
    """Everything in plain values."""
    return {
        "source": found.source,
        "sure": found.sure,
        "cameras": None if found.cameras is None else found.cameras.name,
        "image_lags": image_lags(found),
        "base": None if found.base is None else _base_json(found.base),
        "views": [_view_json(each) for each in found.views],
    }


def _base_json(base: BasePose) -> dict[str, Any]:
    return {
        "mount": base.mount,
        "view": base.view,
        "reason": base.reason,
        **base.placed.model_dump(),
        "intervals_95": {"rotation_deg": base.half_interval_deg, "translation_mm": base.half_interval_mm},
    }


def _view_json(each: ViewEstimate) -> dict[str, Any]:
    camera, rival, pose = each.camera, each.rival, "T_tool_camera" if each.wrist else "T_base_camera"
    return {
        "view": each.view,
        "verdict": each.verdict,
        "wrist": each.wrist,
        "K": None if camera is None else camera.K.tolist(),
        pose: None if camera is None else camera.T_base_camera[0].tolist(),
        "lag_frames": each.lag_frames,
        "intervals_95": {k.kind: {"half": k.half_interval, "unit": k.unit} for k in each.intervals},
        "agreement": each.agreement,
        "rival": None if rival is None else {"K": rival.K.tolist(), pose: rival.T_base_camera[0].tolist()},
        "rival_agreement": each.rival_agreement,
        "reasons": each.reasons,
        "notes": each.notes,
        "moved_at": each.moved_at,
        "episodes": each.episodes,
    }


def view_picture(
    estimate: ViewEstimate, shown: Sequence[tuple[Episode, int, np.ndarray]], kinematics: ArmKinematics
) -> Picture:
    """Frames of some episodes; above as recorded, below with the robot where the estimated camera puts it: its tools and outline, in a
    wrist view the tools alone.
    """
    style = OverlayStyle(SIGMA_PX_REF, heat=0.5, outline=not estimate.wrist)
    before, after = [], []
    arms: Sequence[str] = ()
    for episode, n, image in shown:
        size = scaled_size(image.shape[0], image.shape[1], TILE_HEIGHT)
        recorded = episode.cameras.get(estimate.view)
        tile = scale_frames(image[None], size)[0]
        if recorded is not None:
            tile = draw_overlay(
                image, recorded_tracks(episode, estimate.view, kinematics), n, estimate.view,
                tile_height=TILE_HEIGHT, style=style,
            )  # fmt: skip
        before.append(draw_tag(tile, f"{episode.episode_id} frame {n}", size_px=11))
        if (camera := _camera_in(episode, estimate, kinematics)) is not None:
            tracks = recorded_tracks(replace(episode, cameras={estimate.view: camera}), estimate.view, kinematics)
            arms = tracks.arms
            tile = draw_overlay(image, tracks, n, estimate.view, tile_height=TILE_HEIGHT, style=style)
        after.append(tile)
    rows = [SheetRow("recorded", np.stack(before)), SheetRow("estimated", np.stack(after))]
    body = contact_sheet(rows, tile_height=TILE_HEIGHT, title=headline(estimate))
    return np.concatenate([body, legend_strip(arms, body.shape[1], outline=style.outline)])


def _camera_in(episode: Episode, estimate: ViewEstimate, kinematics: ArmKinematics) -> CameraTrack | None:
    """The estimated camera in the frame of the robot's base; that of a wrist moves with its tool."""
    if estimate.camera is None or not estimate.wrist:
        return estimate.camera
    tools = episode.T_base_ee
    if tools is None:
        tools = kinematics.tool_poses(episode.state.astype(np.float64)).numpy()
    arm = [each.camera_view for each in kinematics.embodiment.arms].index(estimate.view)
    return replace(estimate.camera, T_base_camera=tools[:, arm] @ estimate.camera.T_base_camera)


def page(found: SourceEstimate, pictures: Mapping[str, str]) -> str:
    """The page: each view with its camera, its intervals, the reasons against it and its picture."""
    return render(
        "calibration/estimate_page.html",
        title="Estimated cameras",
        subtitle=f"{found.source}: what the recorded episodes show of their cameras.",
        found=found,
        pictures=pictures,
        headline=headline,
        intervals=interval_text,
        base=[line for line in (base_text(found), mount_line(found)) if line],
    )
