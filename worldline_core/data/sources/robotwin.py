"""RoboTwin 2 episodes: one HDF5 file each, with camera matrices and end poses. For evaluation only.

    <task>/<setting>/data/episode<N>.hdf5
    <task>/<setting>/instructions/episode<N>.json                {"seen": [...], "unseen": [...]}, where generated

Cameras: `intrinsic_cv` (N, 3, 3), `extrinsic_cv` (N, 3, 4) world-to-camera with OpenCV axes, `cam2world_gl` (N, 4, 4)
camera-to-world with OpenGL axes; the two must agree. End poses: xyz [m] and quaternion wxyz in the simulation's world,
gripper along their +x, 0.12 m behind its centre. Grippers: 0 closed .. 1 open. One joint track is recorded; the action
repeats it. Images are JPEG files that OpenCV wrote from RGB arrays, so their channels come out of OpenCV as RGB.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import BaseModel, Field

from worldline_core.config import FrameRate
from worldline_core.data.episodes.episode import NO_EMBODIMENT
from worldline_core.data.episodes.recorded_poses import RecordedCameras, camera_pose, rejected_as
from worldline_core.data.episodes.source import (
    EVALUATION_LAYOUTS,
    EmbodimentName,
    EpisodeFiles,
    EvaluationSourceConfig,
    GripperRange,
    LoadedEpisode,
)
from worldline_core.data.guards.plain_files import image_size, read_json, validated
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath, find_files, inside, is_file, relative_name
from worldline_core.data.sources.hdf5 import ArmPlace, Columns, Hdf5File, hdf5_images, open_hdf5, require_h5py
from worldline_core.geometry.transforms import pose_from_quaternion_wxyz

_ARMS = tuple(
    ArmPlace(arm, Columns(f"joint_action/{arm}_arm"), Columns(f"joint_action/{arm}_gripper", widths=(1,)))
    for arm in ("left", "right")
)
_GRIPPER = GripperRange(closed=0.0, open=1.0)
_MAX_DISAGREEMENT = 1e-3
_TOOL_OFFSET_M = 0.12
_END_FROM_TOOL = np.array(
    [[0.0, 0.0, 1.0, _TOOL_OFFSET_M], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""The end pose's x (out of the gripper) becomes the tool's z, its y the tool's x; the tool lies between the fingertips."""


class RobotwinSourceConfig(EvaluationSourceConfig):
    """The files state no rate, so it is declared here (the simulation's rate divided by the setting's `save_freq`)."""

    kind: Literal["robotwin"] = "robotwin"
    fps: FrameRate
    embodiment: EmbodimentName = NO_EMBODIMENT
    views: dict[str, str] = Field(
        default={"head": "head_camera", "left_wrist": "left_camera", "right_wrist": "right_camera"},
        min_length=1,
        description="view -> camera of the file",
    )


class _Instructions(BaseModel):
    seen: list[str] = Field(min_length=1)


class RobotwinSource(EpisodeFiles[RobotwinSourceConfig]):
    """Reads every `episode*.hdf5` below the root; images are decoded when their frames are asked for."""

    looked_for = "episode*.hdf5"

    def __init__(self, config: RobotwinSourceConfig, root: AnyPath) -> None:
        require_h5py()
        super().__init__(config, root, find_files(root, self.looked_for))

    def load(self, episode_id: str) -> LoadedEpisode:
        config, path = self.config, self.path(episode_id)
        cameras = RecordedCameras()
        with open_hdf5(path) as file:
            ends = [file.array("endpose/left_endpose", (None, 7))]
            length = len(ends[0])
            ends.append(file.array("endpose/right_endpose", (length, 7)))
            with rejected_as("nan_state", f"{path}, end poses"):
                T_base_end = [pose_from_quaternion_wxyz(end[:, :3], end[:, 3:]) for end in ends]
            readings = [file.array(f"endpose/{arm.name}_gripper", (length,)) for arm in _ARMS]
            opening, overshoot = _GRIPPER.opening(np.stack(readings, axis=1))
            state = file.arms(_ARMS, _GRIPPER, length=length)
            views, absent = file.cameras("observation", config.views)
            for view, camera in views.items():
                _add_camera(cameras, file, path, view, f"observation/{camera}", length)
        setting = "-".join(relative_name(path, self.root).parts[:-2])
        episode = self.episode(
            episode_id,
            f"{config.label}-{setting}-{path.stem}",
            layout=EVALUATION_LAYOUTS[1],
            state=state.values,
            overshoot=overshoot + state.overshoot,
            instruction=self._instruction(path),
            cameras=cameras.tracks,
            T_base_ee=np.stack(T_base_end, axis=1) @ _END_FROM_TOOL,
            gripper=opening,
            primary_view=next(iter(config.views)),
            state_names=state.names,
            conventions={
                "base_frame": "world of the simulation",
                "tool_offset_m": _TOOL_OFFSET_M,
                **cameras.notes(),
            },
        )
        return LoadedEpisode(
            episode,
            tuple(views),
            lambda view: hdf5_images(path, f"observation/{views[view]}/rgb", length, "as_written", calibrated=True),
            absent=absent,
        )

    def _instruction(self, path: AnyPath) -> str:
        """The first of the seen instructions; they are generated apart from the recording and may not be there."""
        relative = relative_name(path, self.root).parent.parent / "instructions" / f"{path.stem}.json"
        file = inside(self.root, str(relative))
        if not is_file(file):
            return ""
        return validated(_Instructions, read_json(file), file, "File of instructions").seen[0]


def _add_camera(cameras: RecordedCameras, file: Hdf5File, path: AnyPath, view: str, group: str, length: int) -> None:
    first = next(file.image_files(f"{group}/rgb", length))
    intrinsics = file.array(f"{group}/intrinsic_cv", (length, 3, 3))
    change = float(np.ptp(intrinsics, axis=0).max())
    if change > 1e-6:
        raise RejectedInputError(
            "singular_intrinsics",
            "Camera matrix changes during the episode",
            where=f"{path}, {group}/intrinsic_cv",
            expected="one K per episode",
            got=f"changes of up to {change:.3g} pixels",
        )
    world_to_camera = np.tile(np.eye(4), (length, 1, 1))
    world_to_camera[:, :3] = file.array(f"{group}/extrinsic_cv", (length, 3, 4))
    where = f"{path}, {group}/extrinsic_cv"
    pose = camera_pose(view, world_to_camera, extrinsics="base_to_camera", axes="opencv", where=where)
    model = file.array(f"{group}/cam2world_gl", (length, 4, 4))
    other = camera_pose(view, model, axes="opengl", where=f"{path}, {group}/cam2world_gl")
    disagreement = float(np.abs(pose.T_base_camera - other.T_base_camera).max())
    if disagreement > _MAX_DISAGREEMENT:
        raise RejectedInputError(
            "invalid_extrinsics",
            "The two recorded camera matrices disagree",
            where=where,
            expected="extrinsic_cv = the inverse of cam2world_gl, up to the axes",
            got=f"{disagreement:.3g} apart",
        )
    cameras.add(view, intrinsics[0], pose, image_size(first, f"{path}, {group}/rgb, frame 0"))
