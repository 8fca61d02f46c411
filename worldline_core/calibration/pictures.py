"""Pictures of a diagnosis: where the recorded calibration puts the tools, beside where a repaired reading puts them.

Unlike action tracks, which let wrist cameras follow the kinematics, these pictures use the camera poses *as recorded*,
frame by frame: the recording is judged. The arms' outline is drawn into the head view (in a wrist view it would fill the
picture): an outline beside the arm is the plainest sign of a wrong calibration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
import torch

from worldline_core.actions.action_tracks import tracks_of_projection
from worldline_core.actions.episode_tracks import HEAD_VIEW, EpisodeTracks
from worldline_core.actions.overlays import OverlayStyle, draw_overlay, legend_strip, view_name
from worldline_core.actions.robot_masks import robot_capsules, tool_capsules
from worldline_core.actions.tool_projection import project_tools
from worldline_core.calibration.camera_errors import corrected_camera
from worldline_core.data.episodes.conventions import along_tool_z, apply_conventions, image_frames
from worldline_core.errors import DataError
from worldline_core.pictures import (
    INK,
    MUTED,
    Picture,
    SheetRow,
    contact_sheet,
    draw_tag,
    evenly_spaced,
    pad,
    text_strip,
)

if TYPE_CHECKING:
    from worldline_core.calibration.diagnosis import Diagnosis
    from worldline_core.data.episodes.episode import Episode
    from worldline_core.data.video.frames import Frames
    from worldline_core.geometry.kinematics import ArmKinematics

TILE_HEIGHT = 256
MOMENTS = 3
MIN_WIDTH = 760
SIGMA_PX_REF = 18.0
"""Wide enough to be seen at tile size, narrow enough to leave the gripper visible."""


def recorded_tracks(
    episode: Episode, view: str, kinematics: ArmKinematics | None, tool_offset_z_m: float = 0.0
) -> EpisodeTracks:
    """The state's tools in one view, with K and camera poses as the episode has them: tracks of that one view.

    Args:
        tool_offset_z_m: from the tools to draw, along their +z.

    Raises:
        DataError: the view has no calibration, or the episode neither has tool poses nor kinematics for its joints.
    """
    where = f"episode {episode.episode_id}"
    camera = episode.cameras.get(view)
    if camera is None:
        raise DataError("View has no calibration", where=f"{where}, view {view}", expected="K and T_base_camera")
    if episode.T_base_ee is not None:
        tools = torch.from_numpy(np.asarray(episode.T_base_ee, dtype=np.float64))
        closed = np.zeros(tools.shape[:2])
        gripper = torch.from_numpy(np.asarray(closed if episode.gripper is None else episode.gripper, dtype=np.float64))
        capsules, radii = tool_capsules(tools)
    elif kinematics is not None and episode.state_kind == "joints":
        state = np.array(episode.state, dtype=np.float64)
        links = kinematics.link_poses(state)
        tools, gripper = kinematics.tools_of(links), kinematics.gripper(state)
        capsules, radii = robot_capsules(kinematics, links)
    else:
        raise DataError("No tools to draw", where=where, expected="recorded tool poses, or joints and kinematics")
    tools = torch.from_numpy(along_tool_z(tools.numpy(), tool_offset_z_m))
    poses = torch.from_numpy(np.asarray(camera.poses(np.arange(episode.num_frames)), dtype=np.float64))[:, None]
    K = torch.from_numpy(np.asarray(camera.K, dtype=np.float64))[None]
    size, count = (camera.height, camera.width), tools.shape[1]
    return tracks_of_projection(
        episode, project_tools(tools, gripper, K, poses, size), tools, poses, K, capsules, radii,
        views=(view,),
        arms=("left", "right") if count == 2 else ("right",) if count == 1 else tuple(f"arm{i}" for i in range(count)),
        image_size=size,
        controls="state",
        camera_motion=("recorded",),
    )  # fmt: skip


def differing_moments(first: EpisodeTracks, second: EpisodeTracks, shift: int, count: int, wanted: int) -> list[int]:
    """Frames of the first reading at which the two differ most in the picture, spread over the clip.

    Args:
        shift: frame n of the first reading shows the image of frame n - shift of the second.
        count: frames of the first reading that have images.
    """
    common = [n for n in range(count) if 0 <= n - shift < second.num_frames]
    if len(common) <= wanted:
        return common
    index = np.asarray(common)
    apart = np.linalg.norm(first.uv[index, 0] - second.uv[index - shift, 0], axis=-1)
    apart[first.valid[index, 0] ^ second.valid[index - shift, 0]] = max(first.image_size)
    apart[~first.valid[index, 0] & ~second.valid[index - shift, 0]] = 0.0
    score = apart.max(axis=-1)
    parts = np.array_split(np.arange(len(common)), wanted)
    return [common[int(part[np.argmax(score[part])])] for part in parts]


def diagnosis_picture(
    diagnosis: Diagnosis,
    recorded: Episode,
    frames: Mapping[str, Frames],
    kinematics: ArmKinematics | None,
    *,
    moments: int = MOMENTS,
    tile_height: int = TILE_HEIGHT,
) -> Picture:
    """One picture per episode: left as recorded, right as repaired, the same frames on both sides.

    Args:
        recorded: the episode as its source wrote it.
        frames: by view, uint8 (n, H, W, 3) of the recorded episode.

    Raises:
        DataError: nothing can be drawn in any view.
    """
    conventions = diagnosis.best.conventions
    repaired, offset, lag = None, 0.0, 0
    if conventions.departures:
        if recorded.T_base_ee is None:
            # Tools come from kinematics: apply_conventions has no recorded poses to move.
            offset = conventions.tool_offset_z_m
            conventions = conventions.model_copy(update={"tool_offset_z_m": 0.0})
        repaired = apply_conventions(recorded, conventions)
        lag = image_frames(recorded.num_frames, conventions).start
    elif diagnosis.verdict == "off":
        cameras = {e.view: corrected_camera(recorded.cameras[e.view], e) for e in diagnosis.off if e.kind != "lag"}
        repaired = replace(recorded, cameras={**recorded.cameras, **cameras})
    left: list[SheetRow] = []
    right: list[SheetRow] = []
    arms: Sequence[str] = ()
    outlined = False
    for view in frames:
        if view not in recorded.cameras:
            continue
        before = recorded_tracks(recorded, view, kinematics)
        after = before if repaired is None else recorded_tracks(repaired, view, kinematics, offset)
        count = min(len(frames[view]), before.num_frames)
        if repaired is None:
            chosen = evenly_spaced(count, 2 * moments)
        else:
            # Image m belongs to state m as recorded, and to state m - lag of the repaired episode.
            chosen = differing_moments(before, after, lag, count, moments)
        if not chosen:
            continue
        arms = before.arms
        outlined |= view == HEAD_VIEW
        # A note on one side keeps its line on the other: the two sheets must stay level.
        note = measures_note(diagnosis.measures.get(view, {})) or " "
        shown = {n: image for n, image in enumerate(islice(frames[view], max(chosen) + 1)) if n in chosen}
        left.append(SheetRow(view_name(view), _drawn(shown, before, view, 0, tile_height), note))
        if repaired is not None:
            tiles = _drawn(shown, after, view, lag, tile_height)
            right.append(SheetRow(view_name(view), tiles, _seen_note(after)))
    if not left:
        raise DataError(
            "Nothing to draw", where=f"episode {recorded.episode_id}", expected="a calibrated view with images"
        )
    sheets = [contact_sheet(left, tile_height=tile_height, title="as recorded", min_width=MIN_WIDTH)]
    if right:
        off = ", ".join(map(str, diagnosis.off))
        title = "repaired: " + (diagnosis.best.text if diagnosis.best.conventions.departures else off)
        sheets.append(contact_sheet(right, tile_height=tile_height, title=title, min_width=MIN_WIDTH))
    body = np.concatenate(sheets, axis=1)
    width = body.shape[1]
    heading = [
        text_strip(f"{recorded.episode_id}  ·  {recorded.embodiment}", width, 34, size_px=21, ink=INK),
        text_strip(headline(diagnosis), width, 24, size_px=15, ink=MUTED),
    ]
    return np.concatenate(
        [*(pad(strip, 6, width) for strip in heading), body, legend_strip(arms, width, outline=outlined)], axis=0
    )


def _drawn(
    images: Mapping[int, np.ndarray], tracks: EpisodeTracks, view: str, lag: int, tile_height: int
) -> np.ndarray:
    """Tiles of images by number."""
    style = OverlayStyle(SIGMA_PX_REF, heat=0.5, outline=view == HEAD_VIEW)
    tiles = []
    for n, image in images.items():
        tile = draw_overlay(image, tracks, n - lag, view, tile_height=tile_height, style=style)
        tiles.append(draw_tag(tile, f"frame {n}", size_px=11))
    return np.stack(tiles)


def _seen_note(tracks: EpisodeTracks) -> str:
    share = float(tracks.valid.any(axis=(1, 2)).mean())
    return f"a tool is in view in {share:.0%} of the frames"


def headline(diagnosis: Diagnosis) -> str:
    """The verdict in one line, with the numbers that decide."""
    as_recorded = diagnosis.as_recorded.score
    match diagnosis.verdict:
        case "explained":
            score = f"score {diagnosis.best.score:.1f}, as recorded {as_recorded:.1f}  (0 is healthy)"
            return f"explained by {diagnosis.best.mistake}: {score}"
        case "unexplained":
            terms = sorted(diagnosis.as_recorded.evidence.items(), key=lambda item: item[1])[:2]
            worst = ", ".join(f"{name} {value:.1f}" for name, value in terms)
            return f"unexplained: score {as_recorded:.1f} as recorded, and no reading is good; worst are {worst}"
        case "off":
            return "off: " + ", ".join(map(str, diagnosis.off))
        case "too_little_evidence":
            return "too little evidence: this recording does not show enough to judge its calibration"
        case _:
            return f"{diagnosis.consistent_within}: score {as_recorded:.1f} as recorded (0 is healthy)"


def measures_note(measures: Mapping[str, float]) -> str:
    """The measures of a view in one line."""
    parts: list[str] = []
    if "hand_eye_m" in measures:
        metres, degrees = measures["hand_eye_m"], measures["hand_eye_deg"]
        parts.append(f"camera against hand {1e3 * metres:.1f} mm, {degrees:.1f} deg")
    if "in_view" in measures:
        parts.append(f"in view {measures['in_view']:.0%}")
    if "flow" in measures:
        parts.append(f"flow agreement {measures['flow']:.2f}")
    return "  ·  ".join(parts)
