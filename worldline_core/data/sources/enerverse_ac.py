"""Bundles of EnerVerse-AC and of the world-model challenges that build on it: one folder per clip, made from AgiBot World.

    <any folders>/<clip>/proprio_stats.h5                      as AgiBot World's, cut to the clip
    <any folders>/<clip>/<camera>_intrinsic_params.json
    <any folders>/<clip>/<camera>_extrinsic_params_aligned.json
    <any folders>/<clip>/<camera>_color.mp4                    all frames; or
    <any folders>/<clip>/frame.png                             the first frame, of one camera
or, of the head camera, as its inference script reads them:
    <any folders>/<clip>/{action,intrinsics,extrinsics}.npy    (N, 16), (3, 3) and (4, 4), and frame.png

What `agibot_world` says about poses, readings and cameras holds here: `action.npy` has the measured poses of the two end
links (xyz [m], quaternion xyzw, gripper reading), extrinsics are camera-to-base with OpenCV axes. Where a clip has joints
and their commands, they are its state and action; otherwise the state is the end poses, and the action repeats it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from pydantic import Field

from worldline_core.data.episodes.conventions import along_tool_z
from worldline_core.data.episodes.recorded_poses import RecordedCameras, camera_pose
from worldline_core.data.episodes.source import (
    EmbodimentName,
    ForeignSourceConfig,
    GripperRange,
    LensConfig,
    LoadedEpisode,
)
from worldline_core.data.guards.plain_files import read_image
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath, find_files, inside_folder, is_file
from worldline_core.data.sources.agibot_gesim import (
    AGIBOT_CAMERAS,
    AGIBOT_POSE_NAMES,
    AGIBOT_STATE_NAMES,
    GRIPPER_COMMAND_RAW,
    GRIPPER_STATE_RAW,
    TOOL_OFFSET_RAW_M,
    numbers,
    pose_state,
)
from worldline_core.data.sources.agibot_world import (
    View,
    add_camera,
    arm_vector,
    first_posture,
    timed_video_size,
    two_grippers,
)
from worldline_core.data.sources.episode_files import EpisodeFiles
from worldline_core.data.sources.hdf5 import open_hdf5
from worldline_core.data.video.clip import VideoClip

_PARTS = ("proprio_stats.h5", "action.npy", "frame.png", *(f"{camera}_color.mp4" for camera in AGIBOT_CAMERAS.values()))
_STEP_OF_EPISODE = re.compile(r"(\d+)-(\d+)-(\d+)")
"""Name of a clip's folder where all lie side by side: task, episode, step."""


class EnerverseAcSourceConfig(ForeignSourceConfig):
    """Clips state no rate, so it is declared here (AgiBot World records 30 Hz); a video must have it.

    Clips of one task share a scene unless `scene` says otherwise: several may be cut from one recording.
    """

    kind: Literal["enerverse_ac"] = "enerverse_ac"
    fps: float = Field(gt=0)
    embodiment: EmbodimentName = "agibot_g1"
    views: tuple[View, ...] = Field(
        default=("head",), min_length=1, description="views that must be there; clips with frame.png have one"
    )
    gripper_state: GripperRange = GRIPPER_STATE_RAW
    gripper_command: GripperRange = GRIPPER_COMMAND_RAW
    tool_offset_m: float = TOOL_OFFSET_RAW_M
    distortions: dict[View, LensConfig] = Field(default={}, description="view -> lens, where images are distorted")


@dataclass(frozen=True)
class _Controls:
    """State (N, 16), action (N, 16) where joints and commands are recorded, poses of the end links (N, 2, 4, 4), openings
    (N, 2), times (N,) [s], `first_posture`."""

    state: np.ndarray
    action: np.ndarray | None
    ends: np.ndarray
    opening: np.ndarray
    times: np.ndarray
    overshoot: int
    posture: dict[str, float] = field(default_factory=dict)


class EnerverseAcSource(EpisodeFiles[EnerverseAcSourceConfig]):
    """Reads every folder below the root that holds a file of a clip; videos are decoded when their frames are asked for."""

    looked_for = "folders with one of " + ", ".join(_PARTS)

    def __init__(self, config: EnerverseAcSourceConfig, root: AnyPath) -> None:
        found = sorted({path.parent for name in _PARTS for path in find_files(root, name)})
        super().__init__(config, root, found, lambda folder: folder.parts or (root.name,))

    def load(self, episode_id: str) -> LoadedEpisode:
        config, relative = self.config, self.files[episode_id]
        folder = inside_folder(self.root, str(relative))
        recorded = is_file(folder / "proprio_stats.h5") or not is_file(folder / "action.npy")
        found = self._recorded(folder / "proprio_stats.h5") if recorded else self._poses(folder / "action.npy")
        length = len(found.state)
        videos = {view: folder / f"{AGIBOT_CAMERAS[view]}_color.mp4" for view in config.views}
        picture = folder / "frame.png"
        clips: dict[str, VideoClip] = {}
        if is_file(picture) and not any(map(is_file, videos.values())):
            if len(config.views) != 1:
                raise RejectedInputError(
                    "missing_view",
                    "Clip has a single picture",
                    where=picture,
                    expected="one view",
                    got=", ".join(config.views),
                    next_step="name the camera of these clips in curate.sources[].views",
                )
            sizes = {config.views[0]: read_image(picture).shape[:2]}
        else:
            sizes = {view: timed_video_size(path, config.fps) for view, path in videos.items()}
            clips = {view: VideoClip.whole_file(path, length, config.fps) for view, path in videos.items()}
        cameras = RecordedCameras()
        for view, size in sizes.items():
            if recorded:
                add_camera(cameras, view, self.root, str(relative), size, length)
            else:
                pose = camera_pose(view, _extrinsics(folder / "extrinsics.npy", view, length), where=folder)
                cameras.add(view, numbers(folder / "intrinsics.npy", (3, 3)), pose, size)
        clip = _STEP_OF_EPISODE.fullmatch(folder.name)
        task = clip[1] if clip is not None else "-".join(relative.parts[:-1])
        episode = self.episode(
            episode_id,
            "-".join(filter(None, [config.label, task])),
            layout="enerverse_ac",
            state=found.state,
            action=found.action,
            overshoot=found.overshoot,
            timestamps=found.times,
            cameras=cameras.tracks,
            T_base_ee=along_tool_z(found.ends, config.tool_offset_m),
            gripper=found.opening,
            video_frames=None if clips or length == 1 else 1,
            primary_view=config.views[0],
            state_names=AGIBOT_STATE_NAMES if found.action is not None else AGIBOT_POSE_NAMES,
            state_kind="joints" if found.action is not None else "ee_pose",
            conventions={"tool_offset_m": config.tool_offset_m, **found.posture, **cameras.notes()},
        )
        lenses = {view: lens.distortion for view, lens in config.distortions.items()}
        return LoadedEpisode(episode, config.views, lambda view: [read_image(picture)], distortions=lenses, clips=clips)

    def _recorded(self, path: AnyPath) -> _Controls:
        config = self.config
        with open_hdf5(path) as file:
            positions = file.array("state/end/position", (None, 2, 3))
            length = len(positions)
            rows = np.concatenate(
                [
                    positions,
                    file.array("state/end/orientation", (length, 2, 4)),
                    two_grippers(file, "state", length, path)[..., None],
                ],
                axis=2,
            )
            times = file.times_ns("timestamp", length) if file.has("timestamp") else np.arange(length) / config.fps
            state, ends, overshoot = pose_state(rows.reshape(length, 16), config.gripper_state, path)
            opening, action = state[:, [7, 15]], None
            if all(file.has(f"{track}/joint/position") for track in ("state", "action")):
                state, opening, overshoot = arm_vector(file, "state", length, config.gripper_state, path)
                action, _, more = arm_vector(file, "action", length, config.gripper_command, path)
                overshoot += more
            posture = first_posture(file, length)
        return _Controls(state, action, ends, opening, times, overshoot, posture)

    def _poses(self, path: AnyPath) -> _Controls:
        state, ends, overshoot = pose_state(numbers(path, (None, 16)), self.config.gripper_state, path)
        times = np.arange(len(state)) / self.config.fps
        return _Controls(state, None, ends, state[:, [7, 15]], times, overshoot)


def _extrinsics(path: AnyPath, view: str, length: int) -> np.ndarray:
    """(1, 4, 4): the one pose of these files, which is that of the first frame.

    Raises: RejectedInputError: missing_calibration for a camera that moves, and as `numbers`.
    """
    poses = numbers(path, (4, 4))[None]
    if view != "head" and length > 1:
        raise RejectedInputError(
            "missing_calibration",
            "Clip has one pose of a camera that moves",
            where=f"{path}, view {view}",
            expected="the head camera, or proprio_stats.h5 with a pose for each frame",
            got=f"one pose for {length} states",
        )
    return poses
