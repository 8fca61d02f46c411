"""Rerun recordings: an episode and its predictions in 3-D, in every view, and as time series.

Entities (all poses in the robot's base frame, metres, z up; cameras have OpenCV axes, x right, y down, z forward):

    world/cameras/<view>            camera pose and pinhole (K)
    world/cameras/<view>/true       recorded frames
    world/cameras/<view>/actions    heat of the action maps over the frames
    world/tools/<arm>               tool frame per time step; `world/tool_paths/<arm>`: the whole path
    predicted/<method>/<view>       predicted frames
    signals/{state,action}/<joint>  joint and gripper values

The bytes of a recording differ between runs (chunk identifiers are random), so recordings are written outside the
digested part of an artifact.
"""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from worldline_core.exports.overlays import arm_colour, gaussian
from worldline_core.exports.pictures import jpeg_bytes, png_bytes
from worldline_core.store.atomic import atomic_path

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

    from worldline_core.data.episode import Episode

Clip = NDArray[np.uint8]
"""`n h w 3` RGB frames."""


@dataclass(frozen=True)
class TrackSignals:
    """What a recording shows of the action tracks.

    uv: `n v a 2`, pixels of the frames; valid: `n v a`; gripper: `n a`; T_base_tool: `n a 4 4` (maps tool points to
    base, metres); views: the names along axis v; arms: the names along axis a.
    """

    uv: NDArray[np.floating]
    valid: NDArray[np.bool_]
    gripper: NDArray[np.floating]
    T_base_tool: NDArray[np.floating]
    views: Sequence[str]
    arms: Sequence[str]


@dataclass(frozen=True)
class RecordingContent:
    """Everything one recording holds."""

    episode: Episode
    true_frames: Mapping[str, Clip]
    """View -> frames."""
    predicted_frames: Mapping[str, Mapping[str, Clip]] = field(default_factory=dict)
    """Method -> view -> frames."""
    tracks: TrackSignals | None = None
    joint_names: Sequence[str] = ()


def write_rerun_recording(path: Path, content: RecordingContent) -> None:
    """Writes one `.rrd` with a blueprint; opens with `rerun <file>`."""
    import rerun as rr

    identity = uuid.UUID(bytes=hashlib.sha256(content.episode.episode_id.encode()).digest()[:16])
    stream = rr.RecordingStream("worldline", recording_id=identity, send_properties=False)
    with atomic_path(path) as temporary:
        stream.save(temporary, default_blueprint=blueprint(content))
        stream.send_recording_name(content.episode.episode_id)
        log_cameras(stream, content)
        log_predictions(stream, content)
        if content.tracks is not None:
            log_tools(stream, content.tracks, content.episode.fps)
            log_heat(stream, content)
        log_signals(stream, content)
        log_description(stream, content.episode)
        stream.disconnect()


def timeline(count: int, fps: float) -> list[rr.TimeColumn]:
    """The two time columns that every entity uses: frame number, and seconds since the episode's start."""
    import rerun as rr

    frames = np.arange(count)
    return [rr.TimeColumn("frame", sequence=frames), rr.TimeColumn("time", duration=frames / fps)]


def log_frames(stream: rr.RecordingStream, entity: str, frames: Clip, fps: float) -> None:
    """Logs a clip as JPEG pictures, one a time step."""
    import rerun as rr

    columns = rr.EncodedImage.columns(
        blob=[jpeg_bytes(frame, quality=92) for frame in frames], media_type=["image/jpeg"] * len(frames)
    )
    stream.send_columns(entity, timeline(len(frames), fps), columns)


def log_cameras(stream: rr.RecordingStream, content: RecordingContent) -> None:
    """Logs pinholes, poses and recorded frames of every view."""
    import rerun as rr

    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    fps = content.episode.fps
    for view, frames in content.true_frames.items():
        entity = f"world/cameras/{view}"
        camera = content.episode.cameras.get(view)
        if camera is not None:
            height, width = frames.shape[1:3]
            K = np.array(camera.resized(width, height).K, dtype=np.float64)
            K[:2, 2] += (
                0.5  # Rerun counts pixels from the picture's corner, this project from the first pixel's centre.
            )
            pinhole = rr.Pinhole(
                image_from_camera=K,
                resolution=[width, height],
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=0.15,
            )
            stream.log(entity, pinhole, static=True)
            log_poses(stream, entity, np.asarray(camera.T_base_camera, dtype=np.float64), fps)
        log_frames(stream, f"{entity}/true", frames, fps)


def log_poses(stream: rr.RecordingStream, entity: str, poses: NDArray[np.floating], fps: float) -> None:
    """Logs `n 4 4` poses, or one static pose."""
    import rerun as rr

    if len(poses) == 1:
        stream.log(entity, rr.Transform3D(translation=poses[0, :3, 3], mat3x3=poses[0, :3, :3]), static=True)
        return
    columns = rr.Transform3D.columns(translation=poses[:, :3, 3], mat3x3=np.ascontiguousarray(poses[:, :3, :3]))
    stream.send_columns(entity, timeline(len(poses), fps), columns)


def log_predictions(stream: rr.RecordingStream, content: RecordingContent) -> None:
    """Logs predicted frames of every method and view."""
    for method, views in content.predicted_frames.items():
        for view, frames in views.items():
            log_frames(stream, f"predicted/{method}/{view}", frames, content.episode.fps)


def log_tools(stream: rr.RecordingStream, tracks: TrackSignals, fps: float) -> None:
    """Logs tool frames with axes and the path of each tool."""
    import rerun as rr

    for index, arm in enumerate(tracks.arms):
        poses = np.asarray(tracks.T_base_tool[:, index], dtype=np.float64)
        colour = arm_colour(tracks.arms, index)
        stream.log(
            f"world/tool_paths/{arm}", rr.LineStrips3D([poses[:, :3, 3]], colors=[colour], radii=0.002), static=True
        )
        stream.log(f"world/tools/{arm}", rr.TransformAxes3D(axis_length=0.08), static=True)
        log_poses(stream, f"world/tools/{arm}", poses, fps)


def log_heat(stream: rr.RecordingStream, content: RecordingContent) -> None:
    """Logs the action maps' heat as transparent pictures over the frames."""
    import rerun as rr

    tracks = content.tracks
    if tracks is None:
        return
    for view_index, view in enumerate(tracks.views):
        if view not in content.true_frames:
            continue
        frames = content.true_frames[view]
        height, width = frames.shape[1:3]
        count = min(len(frames), len(tracks.uv))
        pictures = [
            png_bytes(heat_layer(tracks.uv[i, view_index], tracks.valid[i, view_index], height, width, tracks.arms))
            for i in range(count)
        ]
        columns = rr.EncodedImage.columns(blob=pictures, media_type=["image/png"] * count, draw_order=[10.0] * count)
        stream.send_columns(f"world/cameras/{view}/actions", timeline(count, content.episode.fps), columns)


def heat_layer(
    uv: NDArray[np.floating], valid: NDArray[np.bool_], height: int, width: int, arms: Sequence[str]
) -> NDArray[np.uint8]:
    """Every valid arm's Gaussian as one RGBA picture `h w 4`, transparent where there is no heat."""
    colour = np.zeros((height, width, 3), dtype=np.float32)
    alpha = np.zeros((height, width, 1), dtype=np.float32)
    for arm in range(len(uv)):
        if valid[arm]:
            heat = gaussian(uv[arm], height, width)[..., None]
            colour += heat * np.asarray(arm_colour(arms, arm), dtype=np.float32)
            alpha += heat
    shown = np.concatenate([colour / np.maximum(alpha, 1e-6), 200.0 * np.minimum(alpha, 1.0)], axis=-1)
    return np.clip(shown, 0, 255).astype(np.uint8)


def log_signals(stream: rr.RecordingStream, content: RecordingContent) -> None:
    """Logs joint and gripper values, recorded and commanded."""
    import rerun as rr

    episode = content.episode
    for kind, values in (("state", episode.state), ("action", episode.action)):
        values = np.asarray(values, dtype=np.float64)
        for joint in range(values.shape[1] if values.ndim == 2 else 0):
            name = content.joint_names[joint] if joint < len(content.joint_names) else f"joint_{joint}"
            entity = f"signals/{kind}/{name.replace('/', '_')}"
            stream.send_columns(
                entity, timeline(len(values), episode.fps), rr.Scalars.columns(scalars=values[:, joint])
            )


def log_description(stream: rr.RecordingStream, episode: Episode) -> None:
    """Logs what the episode is, as text."""
    import rerun as rr

    facts = {
        "episode": episode.episode_id,
        "embodiment": episode.embodiment,
        "scene": episode.scene,
        "task family": episode.task_family,
        "instruction": episode.instruction,
        "outcome": episode.outcome,
        "split": episode.split,
    }
    text = "\n".join(f"{name}: {value}" for name, value in facts.items())
    stream.log("description", rr.TextDocument(text, media_type=rr.MediaType.TEXT), static=True)


def blueprint(content: RecordingContent) -> rrb.Blueprint:
    """Frames of every view (a row a method) beside the 3-D scene, time series below."""
    import rerun.blueprint as rrb

    rows = [
        rrb.Horizontal(
            *[
                rrb.Spatial2DView(origin=f"world/cameras/{view}", name=f"true, {view.replace('_', ' ')}")
                for view in content.true_frames
            ]
        )
    ]
    for method, views in content.predicted_frames.items():
        names = [(f"predicted/{method}/{view}", f"{method}, {view.replace('_', ' ')}") for view in views]
        rows.append(rrb.Horizontal(*[rrb.Spatial2DView(origin=origin, name=name) for origin, name in names]))
    series = rrb.Horizontal(
        rrb.TimeSeriesView(origin="signals/state", name="state"),
        rrb.TimeSeriesView(origin="signals/action", name="commands"),
        rrb.TextDocumentView(origin="description", name="episode"),
        column_shares=[2, 2, 1],
    )
    scene = rrb.Spatial3DView(origin="world", name="scene", contents=["$origin/**", "- $origin/cameras/*/actions"])
    top = rrb.Horizontal(rrb.Vertical(*rows), scene, column_shares=[3, 2])
    return rrb.Blueprint(rrb.Vertical(top, series, row_shares=[3, 1]), collapse_panels=True)
