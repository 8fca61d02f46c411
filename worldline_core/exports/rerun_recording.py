"""Rerun recordings: an episode and its predictions in 3-D, in every view and as time series.

Entities (all poses in the robot's base frame, metres, z up; cameras have OpenCV axes, x right, y down, z forward):

    world/cameras/<view>            camera pose and pinhole (K), shown as a frustum
    world/cameras/<view>/true       recorded frames
    world/cameras/<view>/actions    heat of the action maps, a transparent image over the frames
    world/tools/<arm>               tool frame per time step; `world/tool_paths/<arm>`: the whole path
    world/robot                     the arms as the kinematics place them: one line per link
    predicted/<method>/<view>       predicted frames
    signals/{state,action}/<joint>  joint and gripper values

The bytes of a recording differ between runs (chunk identifiers are random), so recordings are written outside the
digested part of an artifact. Importing this module imports Rerun.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import uuid
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import batched
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from worldline_core.actions.actions_config import SIGMA_PX_REFERENCE
from worldline_core.actions.overlays import arm_colour, heat_layer
from worldline_core.pictures import jpeg_bytes, png_bytes
from worldline_core.store.atomic import atomic_path

if TYPE_CHECKING:
    from worldline_core.actions.episode_tracks import EpisodeTracks
    from worldline_core.data.episodes.episode import Episode
    from worldline_core.data.video.frames import Frames

PIECE_FRAMES = 64
"""So many pictures are logged together."""
_PIPE_BYTES = 1 << 16
FRUSTUM_M = {"fixed": 0.25, "moving": 0.08}
"""Depth at which a frustum ends: wrist cameras are near to what they see."""
ROBOT_COLOUR = (190, 194, 202)
ROBOT_LINE_M = 0.01
FRUSTUM_COLOUR = (220, 222, 228)


@dataclass(frozen=True)
class RecordingContent:
    """The data of one recording.

    Attributes:
        true_frames: by view.
        predicted_frames: by view.
        method: name of the method that predicted them; empty without predictions.
        sigma_px_ref: width of the heat, pixels on the 384 x 512 reference canvas.
    """

    episode: Episode
    true_frames: Mapping[str, Frames]
    predicted_frames: Mapping[str, Frames] = field(default_factory=dict)
    method: str = ""
    tracks: EpisodeTracks | None = None
    sigma_px_ref: float = SIGMA_PX_REFERENCE


def write_rerun_recording(path: Path, content: RecordingContent) -> None:
    """Write one `.rrd` with a blueprint; opens with `rerun <file>`."""
    identity = uuid.UUID(bytes=hashlib.sha256(content.episode.episode_id.encode()).digest()[:16])
    stream = rr.RecordingStream("worldline", recording_id=identity, send_properties=False)
    with atomic_path(path) as temporary, _pipe_into(temporary) as pipe:
        stream.save(pipe, default_blueprint=_blueprint(content))
        try:
            _log_content(stream, content)
            stream.flush()  # raises what `disconnect` only logs
        finally:
            stream.disconnect()  # closes Rerun's end of the pipe


def _log_content(stream: rr.RecordingStream, content: RecordingContent) -> None:
    episode, tracks = content.episode, content.tracks
    stream.send_recording_name(episode.episode_id)
    _log_cameras(stream, content)
    for view, frames in content.predicted_frames.items():
        _log_frames(stream, f"predicted/{content.method}/{view}", frames, episode.fps)
    if tracks is not None:
        _log_tools(stream, tracks, episode.fps)
        _log_robot(stream, tracks, episode.fps)
        for view in [view for view in tracks.views if view in content.true_frames]:
            frames = content.true_frames[view]
            size, count = (frames.shape[1], frames.shape[2]), min(len(frames), tracks.num_frames)
            heat = (png_bytes(heat_layer(tracks, n, view, size, content.sigma_px_ref)) for n in range(count))
            _log_images(stream, f"world/cameras/{view}/actions", heat, "image/png", episode.fps)
            stream.log(f"world/cameras/{view}/actions", rr.EncodedImage.from_fields(draw_order=10.0), static=True)
    _log_signals(stream, episode)
    _log_description(stream, episode, "none" if tracks is None else tracks.controls_label)


@contextmanager
def _pipe_into(path: Path) -> Iterator[str]:
    """Yield the path of a pipe that a thread copies into the file ``path``; an error of writing is raised at the end.

    Rerun may hang when it writes to a full disk itself (0.41: `flush` and `disconnect` wait for a writing thread that has ended).
    """
    failed: list[OSError] = []
    reader, writer = os.pipe()

    def write() -> None:
        with os.fdopen(reader, "rb", buffering=0) as piped:
            try:
                with path.open("wb") as file:
                    shutil.copyfileobj(piped, file)
            except OSError as error:
                failed.append(OSError(error.errno, error.strerror, str(path)))
                while piped.read(_PIPE_BYTES):
                    pass

    thread = Thread(target=write)
    thread.start()
    try:
        yield f"/dev/fd/{writer}"
    finally:
        os.close(writer)
        thread.join()
    if failed:
        raise failed[0]


def _timeline(count: int, fps: float, first: int = 0) -> list[rr.TimeColumn]:
    """The time columns of every entity: frame number, and seconds since the episode's start."""
    frames = np.arange(first, first + count)
    return [rr.TimeColumn("frame", sequence=frames), rr.TimeColumn("time", duration=frames / fps)]


def _log_frames(stream: rr.RecordingStream, entity: str, frames: Frames, fps: float) -> None:
    """Log frames `n h w 3` as JPEG pictures, one per time step."""
    _log_images(stream, entity, (jpeg_bytes(frame, quality=92) for frame in frames), "image/jpeg", fps)


def _log_images(stream: rr.RecordingStream, entity: str, images: Iterable[bytes], kind: str, fps: float) -> None:
    """Log encoded images, one per time step, in pieces."""
    for number, part in enumerate(batched(images, PIECE_FRAMES)):
        columns = rr.EncodedImage.columns(blob=list(part), media_type=[kind] * len(part))
        stream.send_columns(entity, _timeline(len(part), fps, number * PIECE_FRAMES), columns)


def _log_cameras(stream: rr.RecordingStream, content: RecordingContent) -> None:
    """Pinholes, poses and recorded frames of every view."""
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    fps = content.episode.fps
    for view, frames in content.true_frames.items():
        entity = f"world/cameras/{view}"
        camera = content.episode.cameras.get(view)
        if camera is not None:
            height, width = frames.shape[1:3]
            K = np.array(camera.resized(width, height).K, dtype=np.float64)
            K[:2, 2] += 0.5  # Rerun counts pixels from the picture's corner, this project from the first pixel's centre
            pinhole = rr.Pinhole(
                image_from_camera=K,
                resolution=[width, height],
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=FRUSTUM_M["moving" if camera.moving else "fixed"],
                color=FRUSTUM_COLOUR,
            )
            stream.log(entity, pinhole, static=True)
            _log_poses(stream, entity, np.asarray(camera.T_base_camera, dtype=np.float64), fps)
        _log_frames(stream, f"{entity}/true", frames, fps)


def _log_poses(stream: rr.RecordingStream, entity: str, poses: NDArray[np.floating], fps: float) -> None:
    """`n 4 4` poses, or one static pose."""
    if len(poses) == 1:
        stream.log(entity, rr.Transform3D(translation=poses[0, :3, 3], mat3x3=poses[0, :3, :3]), static=True)
        return
    columns = rr.Transform3D.columns(translation=poses[:, :3, 3], mat3x3=np.ascontiguousarray(poses[:, :3, :3]))
    stream.send_columns(entity, _timeline(len(poses), fps), columns)


def _log_tools(stream: rr.RecordingStream, tracks: EpisodeTracks, fps: float) -> None:
    """Tool frames with axes and the path of each tool."""
    for index, arm in enumerate(tracks.arms):
        poses = np.asarray(tracks.T_base_tool[:, index], dtype=np.float64)
        path = rr.LineStrips3D([poses[:, :3, 3]], colors=[arm_colour(tracks.arms, index)], radii=0.002)
        stream.log(f"world/tool_paths/{arm}", path, static=True)
        stream.log(f"world/tools/{arm}", rr.TransformAxes3D(axis_length=0.08), static=True)
        _log_poses(stream, f"world/tools/{arm}", poses, fps)


def _log_robot(stream: rr.RecordingStream, tracks: EpisodeTracks, fps: float) -> None:
    """The axes of the robot's capsules as thin grey lines; a capsule of radius 0 is left out.

    Solid ones would hide the tools and the cameras that sit on the hands.
    """
    drawn = np.flatnonzero(tracks.capsule_radii > 0)
    if len(drawn) == 0:
        return
    count, links = tracks.num_frames, len(drawn)
    strips = np.asarray(tracks.capsules[:, drawn], dtype=np.float32).reshape(count * links, 2, 3)
    columns = rr.LineStrips3D.columns(
        strips=list(strips), radii=[ROBOT_LINE_M] * (count * links), colors=[ROBOT_COLOUR] * (count * links)
    )
    stream.send_columns("world/robot", _timeline(count, fps), columns.partition([links] * count))


def _log_signals(stream: rr.RecordingStream, episode: Episode) -> None:
    """Joint and gripper values, recorded and commanded."""
    names = episode.state_names or [f"joint_{joint}" for joint in range(episode.state.shape[1])]
    for kind, values in (("state", episode.state), ("action", episode.action)):
        for name, column in zip(names, np.asarray(values, dtype=np.float64).T, strict=True):
            entity = f"signals/{kind}/{name.replace('/', '_')}"
            stream.send_columns(entity, _timeline(len(column), episode.fps), rr.Scalars.columns(scalars=column))


def _log_description(stream: rr.RecordingStream, episode: Episode, tools: str) -> None:
    names = ("episode_id", "embodiment", "scene", "task_family", "instruction", "outcome", "split")
    lines = [f"{name.replace('_', ' ')}: {getattr(episode, name)}" for name in names]
    text = "\n".join([*lines, f"tools and action maps: {tools}"])
    stream.log("description", rr.TextDocument(text, media_type=rr.MediaType.TEXT), static=True)


def _blueprint(content: RecordingContent) -> rrb.Blueprint:
    """The initial layout: true and predicted views in a row each, the scene under or beside them, time series below."""
    views, method = list(content.true_frames), content.method
    rows = [("world/cameras", "true", views), (f"predicted/{method}", method, list(content.predicted_frames))]
    pictures = [
        rrb.Horizontal(*[rrb.Spatial2DView(origin=f"{at}/{v}", name=f"{name}, {v.replace('_', ' ')}") for v in shown])
        for at, name, shown in rows
        if shown
    ]
    # The heat over the frames would float in the scene twice.
    flat = [f"- $origin/cameras/{view}/actions" for view in views]
    scene = rrb.Spatial3DView(
        origin="world", name="scene", contents=["$origin/**", *flat], line_grid=True, background=(24, 26, 31)
    )
    if len(pictures) == 1:
        top = rrb.Vertical(*pictures, scene, row_shares=[5, 6])
    else:
        top = rrb.Horizontal(rrb.Vertical(*pictures), scene, column_shares=[3, 2])
    series = rrb.Horizontal(
        rrb.TimeSeriesView(origin="signals/state", name="state", plot_legend=rrb.PlotLegend(visible=False)),
        rrb.TimeSeriesView(origin="signals/action", name="commands", plot_legend=rrb.PlotLegend(visible=False)),
        rrb.TextDocumentView(origin="description", name="episode"),
        column_shares=[2, 2, 1],
    )
    return rrb.Blueprint(
        rrb.Vertical(top, series, row_shares=[4, 1]),
        rrb.TimePanel(timeline="frame", fps=content.episode.fps, state="collapsed"),
        collapse_panels=True,
    )
