"""Rerun recordings: an episode and its predictions in 3-D, in every view, and as time series.

Entities (all poses in the robot's base frame, metres, z up; cameras have OpenCV axes, x right, y down, z forward):

    world/cameras/<view>            camera pose and pinhole (K), shown as a frustum
    world/cameras/<view>/true       recorded frames
    world/cameras/<view>/actions    heat of the action maps, a transparent image over the frames
    world/cameras/<view>/points     projected tools, the wider the further the gripper is open; only valid ones
    world/cameras/<view>/axes       projected tool axes; only of valid tools
    world/tools/<arm>               tool frame per time step; `world/tool_paths/<arm>`: the whole path
    world/robot                     the arms as the kinematics place them: one line a part
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

from worldline_core.actions.action_maps import SIGMA_PX_REFERENCE
from worldline_core.actions.overlays import AXIS_COLOURS, arm_colour, axis_tips, heat_layer, picture_pixel
from worldline_core.exports.rerun_blueprint import blueprint
from worldline_core.pictures.labels import jpeg_bytes, png_bytes
from worldline_core.store.atomic import atomic_path

if TYPE_CHECKING:
    import rerun as rr

    from worldline_core.actions.episode_tracks import EpisodeTracks
    from worldline_core.data.episodes.episode import Episode

Clip = NDArray[np.uint8]
"""`n h w 3` RGB frames."""

FRUSTUM_M = {"fixed": 0.25, "moving": 0.08}
"""Depth at which a frustum ends: wrist cameras are near to what they see."""
ROBOT_COLOUR = (190, 194, 202)
ROBOT_LINE_M = 0.01
FRUSTUM_COLOUR = (220, 222, 228)


@dataclass(frozen=True)
class RecordingContent:
    """Everything one recording holds."""

    episode: Episode
    true_frames: Mapping[str, Clip]
    """View -> frames."""
    predicted_frames: Mapping[str, Mapping[str, Clip]] = field(default_factory=dict)
    """Method -> view -> frames."""
    tracks: EpisodeTracks | None = None
    joint_names: Sequence[str] = ()
    sigma_px_ref: float = SIGMA_PX_REFERENCE
    """Of the heat, pixels on the 384 x 512 reference canvas."""


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
            log_robot(stream, content.tracks, content.episode.fps)
            for view, frames in content.true_frames.items():
                if view in content.tracks.views:
                    log_overlay(stream, content.tracks, view, frames, content.episode.fps, content.sigma_px_ref)
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
                image_plane_distance=FRUSTUM_M["fixed" if len(camera.T_base_camera) == 1 else "moving"],
                color=FRUSTUM_COLOUR,
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


def log_tools(stream: rr.RecordingStream, tracks: EpisodeTracks, fps: float) -> None:
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


def log_robot(stream: rr.RecordingStream, tracks: EpisodeTracks, fps: float) -> None:
    """Logs the axes of the robot's capsules as thin grey lines; a capsule of radius 0 is left out.

    Solid ones would hide the tools and the cameras that sit on the hands.
    """
    import rerun as rr

    drawn = np.flatnonzero(tracks.capsule_radii > 0)
    if len(drawn) == 0:
        return
    count, parts = tracks.num_frames, len(drawn)
    strips = np.asarray(tracks.capsules[:, drawn], dtype=np.float32).reshape(count * parts, 2, 3)
    columns = rr.LineStrips3D.columns(
        strips=list(strips), radii=[ROBOT_LINE_M] * (count * parts), colors=[ROBOT_COLOUR] * (count * parts)
    )
    stream.send_columns("world/robot", timeline(count, fps), columns.partition([parts] * count))


def log_overlay(
    stream: rr.RecordingStream, tracks: EpisodeTracks, view: str, frames: Clip, fps: float, sigma_px_ref: float
) -> None:
    """Logs what `draw_overlay` draws over a view, as layers that can be shown and hidden one by one."""
    import rerun as rr

    v, entity = tracks.views.index(view), f"world/cameras/{view}"
    count, size = min(len(frames), tracks.num_frames), (frames.shape[1], frames.shape[2])
    pictures = [png_bytes(heat_layer(tracks, n, view, size, sigma_px_ref)) for n in range(count)]
    heat = rr.EncodedImage.columns(blob=pictures, media_type=["image/png"] * count, draw_order=[10.0] * count)
    stream.send_columns(f"{entity}/actions", timeline(count, fps), heat)
    shown = [(n, a) for n in range(count) for a in range(len(tracks.arms)) if tracks.valid[n, v, a]]
    points = [rerun_pixel(tracks.uv[n, v, a], tracks.image_size, size) for n, a in shown]
    lengths = [int(tracks.valid[n, v].sum()) for n in range(count)]
    if points:
        radii = [size[0] * (0.008 + 0.022 * float(tracks.gripper[n, v, a])) for n, a in shown]
        colours = [arm_colour(tracks.arms, a) for _, a in shown]
        marks = rr.Points2D.columns(
            positions=points, radii=radii, colors=colours, labels=[tracks.arms[a] for _, a in shown]
        )
        stream.send_columns(f"{entity}/points", timeline(count, fps), marks.partition(lengths))
        stream.log(f"{entity}/points", rr.Points2D.from_fields(draw_order=30.0, show_labels=False), static=True)
        axes: list[list[list[float]]] = []
        axis_colours: list[tuple[int, int, int]] = []
        for (n, a), origin in zip(shown, points, strict=True):
            for tip, colour in zip(axis_tips(tracks, n, v, a), AXIS_COLOURS, strict=True):
                end = origin if tip is None else rerun_pixel(tip, tracks.image_size, size)
                axes.append([origin, end])
                axis_colours.append(colour)
        strips = rr.LineStrips2D.columns(
            strips=np.asarray(axes, dtype=np.float32), radii=[size[0] / 200] * len(axes), colors=axis_colours
        )
        stream.send_columns(f"{entity}/axes", timeline(count, fps), strips.partition([3 * k for k in lengths]))
        stream.log(f"{entity}/axes", rr.LineStrips2D.from_fields(draw_order=20.0), static=True)


def rerun_pixel(uv: NDArray[np.floating], image_size: tuple[int, int], size: tuple[int, int]) -> list[float]:
    """A pixel of the tracks in a picture of `size`, counted from the picture's corner as Rerun does."""
    return (picture_pixel(uv, image_size, size) + 0.5).tolist()


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
