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
from pydantic import Field

from worldline_core.data.episodes.episode import NO_EMBODIMENT
from worldline_core.data.episodes.recorded_poses import RecordedCameras, camera_pose, rejected_as
from worldline_core.data.episodes.source import (
    EVALUATION_LAYOUTS,
    EmbodimentName,
    EvaluationSourceConfig,
    GripperRange,
    LoadedEpisode,
    joint_names,
)
from worldline_core.data.guards.plain_files import image_size, read_json
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath, find_files, inside, is_file, relative_name
from worldline_core.data.sources.episode_files import EpisodeFiles
from worldline_core.data.sources.hdf5 import Channels, Hdf5File, hdf5_images, open_hdf5, require_h5py
from worldline_core.geometry.transforms import pose_from_quaternion_wxyz

_ARMS = ("left", "right")
_GRIPPER = GripperRange(closed=0.0, open=1.0)
_MAX_DISAGREEMENT = 1e-3
_END_FROM_TOOL = np.array([[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""The end pose's x (out of the gripper) becomes the tool's z, its y the tool's x."""


class RobotwinSourceConfig(EvaluationSourceConfig):
    """The files state no rate, so it is declared here (the simulation's rate divided by the setting's `save_freq`)."""

    kind: Literal["robotwin"] = "robotwin"
    fps: float = Field(gt=0)
    embodiment: EmbodimentName = NO_EMBODIMENT
    views: dict[str, str] = Field(
        default={"head": "head_camera", "left_wrist": "left_camera", "right_wrist": "right_camera"},
        min_length=1,
        description="view -> camera of the file",
    )
    tool_offset_m: float = Field(default=0.12, description="end pose to gripper centre along the end pose's +x")
    channels: Channels = Field(
        default="as_written", description="standard: for images that were encoded again with the usual channel order"
    )


class RobotwinSource(EpisodeFiles[RobotwinSourceConfig]):
    """Reads every `episode*.hdf5` below the root; images are decoded when their frames are asked for."""

    looked_for = "episode*.hdf5"

    def __init__(self, config: RobotwinSourceConfig, root: AnyPath) -> None:
        require_h5py()
        super().__init__(config, root, find_files(root, "episode*.hdf5"))

    def load(self, episode_id: str) -> LoadedEpisode:
        config, path = self.config, self.path(episode_id)
        cameras = RecordedCameras()
        with open_hdf5(path) as file:
            ends, grippers, blocks = [], [], []
            length = len(file.array("endpose/left_endpose", (None, 7)))
            for arm in _ARMS:
                end = file.array(f"endpose/{arm}_endpose", (length, 7))
                joints = file.array(f"joint_action/{arm}_arm", (length, None))
                with rejected_as("nan_state", f"{path}, {arm} end pose"):
                    ends.append(pose_from_quaternion_wxyz(end[:, :3], end[:, 3:]))
                grippers.append(file.array(f"endpose/{arm}_gripper", (length,)))
                blocks.append((joints, file.array(f"joint_action/{arm}_gripper", (length,))))
            file.require_cameras("observation", config.views)
            for view, camera in config.views.items():
                _add_camera(cameras, file, path, view, f"observation/{camera}", length)
        opening, overshoot = _GRIPPER.opening(np.stack(grippers, axis=1))
        clipped = [(joints, *_GRIPPER.opening(gripper)) for joints, gripper in blocks]
        state = np.concatenate([part for joints, grip, _ in clipped for part in (joints, grip[:, None])], axis=1)
        names = joint_names({arm: joints.shape[1] for arm, (joints, _) in zip(_ARMS, blocks, strict=True)})
        # From between the fingertips, with +z out of the gripper, to the recorded end pose.
        T_end_tool = _END_FROM_TOOL.copy()
        T_end_tool[0, 3] = config.tool_offset_m
        setting = "-".join(relative_name(path, self.root).parts[:-2])
        episode = self.episode(
            episode_id,
            f"{config.label}-{setting}-{path.stem}",
            layout=EVALUATION_LAYOUTS[1],
            state=state,
            overshoot=overshoot + sum(count for *_, count in clipped),
            instruction=self._instruction(path),
            cameras=cameras.tracks,
            T_base_ee=np.stack(ends, axis=1) @ T_end_tool,
            gripper=opening,
            primary_view=next(iter(config.views)),
            state_names=names,
            conventions={
                "base_frame": "world of the simulation",
                "tool_offset_m": config.tool_offset_m,
                **cameras.notes(),
            },
        )
        return LoadedEpisode(
            episode,
            tuple(config.views),
            lambda view: hdf5_images(path, f"observation/{config.views[view]}/rgb", length, config.channels),
        )

    def _instruction(self, path: AnyPath) -> str:
        """The first of the seen instructions; they are generated apart from the recording and may not be there."""
        relative = relative_name(path, self.root).parent.parent / "instructions" / f"{path.stem}.json"
        file = inside(self.root, str(relative))
        if not is_file(file):
            return ""
        record = read_json(file)
        seen = record.get("seen") if isinstance(record, dict) else None
        if not isinstance(seen, list) or not seen:
            raise RejectedInputError(
                "missing_column", "Instructions lack the seen ones", where=file, expected='{"seen": [...]}', got=record
            )
        return str(seen[0])


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
