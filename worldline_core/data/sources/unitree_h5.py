"""HDF5 sets that Unitree's tools make from their LeRobot datasets, in two layouts.

UnifoLM-WMA (`prepare_training_data.py`), found by the folder `transitions`:
    transitions/<dataset>/<n>.h5                observation.state, action; attributes state_type, action_type
    videos/<dataset>/<camera>/<n>.mp4
    <dataset>.csv                               videoid, instruction
unitree_IL_lerobot (`convert_lerobot_to_h5.py`):
    <any folders>/episode_<n>.hdf5              observations/qpos, action, observations/images/<camera>, language_raw

ALOHA's recorder writes the second layout too. Vectors are joint positions [rad] and gripper readings in the order of the
robot's motors, as unitree_IL_lerobot lists them; some published sets of two Z1 arms have both grippers at the end.
Neither layout has camera calibration. In Unitree's files of the second layout images are uncompressed and hold blue before
green and red: the tool exchanges LeRobot's channels.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import PurePosixPath
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from worldline_core.config import FrameRate
from worldline_core.data.episodes.source import (
    EmbodimentName,
    EpisodeFiles,
    ForeignSourceConfig,
    GripperRange,
    LoadedEpisode,
    sorted_views,
    timed_video_size,
)
from worldline_core.data.guards.rejection import RejectedInputError, all_of
from worldline_core.data.guards.source_paths import AnyPath, find_files, inside, is_file, relative_name
from worldline_core.data.sources.hdf5 import ArmPlace, Channels, Columns, hdf5_images, open_hdf5, require_h5py
from worldline_core.data.sources.video_folder import caption_table
from worldline_core.data.video.clip import VideoClip

Robot = Literal["z1_single", "z1_dual", "z1_dual_grippers_last", "g1_dex1", "aloha"]
_IMAGES = "observations/images"


def _arm(name: Literal["left", "right"], start: int, num_joints: int, gripper: int, width: int) -> ArmPlace:
    joints = Columns("{track}", slice(start, start + num_joints), (width,))
    return ArmPlace(name, joints, Columns("{track}", slice(gripper, gripper + 1), (width,)))


ROBOTS: Mapping[Robot, tuple[ArmPlace, ...]] = {
    "z1_single": (_arm("right", 0, 6, 6, 7),),
    "z1_dual": (_arm("left", 0, 6, 6, 14), _arm("right", 7, 6, 13, 14)),
    "z1_dual_grippers_last": (_arm("left", 0, 6, 12, 14), _arm("right", 6, 6, 13, 14)),
    "g1_dex1": (_arm("left", 0, 7, 14, 16), _arm("right", 7, 7, 15, 16)),
    "aloha": (_arm("left", 0, 6, 6, 14), _arm("right", 7, 6, 13, 14)),
}
_Z1_LIMITS = np.array(
    [[-2.618, 2.618], [0, 3.1416], [-2.88, 0], [-1.5184, 1.5184], [-1.4835, 1.4835], [-2.7925, 2.7925]]
)
"""Joints of a Z1 [rad], as wide as its manual or its description has them; no file of configs/embodiments describes one."""
_LIMIT_TOLERANCE_RAD = 0.1


def _share_outside(values: np.ndarray, robot: Robot) -> float:
    """Share of frames of a track (N, D) in which some joint is beyond the limits of a Z1."""
    blocks = [values[:, arm.joints.chosen] for arm in ROBOTS[robot]]
    beyond = [np.abs(block - block.clip(*_Z1_LIMITS.T)) > _LIMIT_TOLERANCE_RAD for block in blocks]
    return float(np.hstack(beyond).any(axis=1).mean())


def check_columns(values: np.ndarray, robot: Robot, where: str) -> None:
    """Raises: RejectedInputError (joint_out_of_range) where a track (N, D) is not in a Z1's order of columns; names the order
    that fits."""
    width = values.shape[1]
    orders: list[Robot] = ["z1_single"] if width == 7 else ["z1_dual", "z1_dual_grippers_last"]
    if robot not in orders or (share := _share_outside(values, robot)) <= 0.5:
        return
    fitting = [order for order in orders if _share_outside(values, order) < 0.05]
    raise RejectedInputError(
        "joint_out_of_range",
        "Columns are not those of the declared robot",
        where=where,
        expected=f"joints within a Z1's limits in the order of {robot}",
        got=f"joints beyond them in {share:.0%} of the frames",
        next_step=f"set robot: {fitting[0]}" if fitting else "compare units, signs and order of the columns",
        evidence={"share": share},
    )


class UnitreeH5SourceConfig(ForeignSourceConfig):
    """A folder of one robot's recordings."""

    kind: Literal["unitree_h5"] = "unitree_h5"
    robot: Robot = Field(
        description="whose motors the columns are: two arms with Dex1 grippers (G1), one or two Z1 arms (each gripper behind "
        "its arm, or both last), ALOHA"
    )
    embodiment: EmbodimentName
    fps: FrameRate = Field(description="of the states; videos must have it (Unitree records 30 Hz)")
    views: dict[str, str] = Field(
        min_length=1, description="view -> camera: the name of its folder of videos, or of its images in the file"
    )
    gripper_state: GripperRange = Field(description="measured readings")
    gripper_command: GripperRange = Field(description="commanded readings")
    channels: Channels | None = Field(
        default=None,
        description="of images in the file: standard (pixels: blue first, which Unitree's tool writes, and the default), "
        "as_written (red first, by ACT's recorder); must be declared for ALOHA and for encoded images",
    )

    @model_validator(mode="after")
    def _declared_channels(self) -> UnitreeH5SourceConfig:
        if self.robot == "aloha" and self.channels is None:
            raise ValueError("ALOHA's files do not say in which order channels are, so declare channels")
        return self


class UnitreeH5Source(EpisodeFiles[UnitreeH5SourceConfig]):
    """Reads every recording of either layout below the root; frames are decoded when they are asked for."""

    looked_for = "transitions/*/*.h5 or episode_*.hdf5"

    def __init__(self, config: UnitreeH5SourceConfig, root: AnyPath) -> None:
        require_h5py()
        found = [path for path in find_files(root, "*.h5") if relative_name(path, root).parts[:-2] == ("transitions",)]
        super().__init__(config, root, [*found, *find_files(root, "episode_*.hdf5")], _episode_parts)
        self._instructions = lru_cache(maxsize=1)(self._read_instructions)  # episodes are read in order of datasets

    def load(self, episode_id: str) -> LoadedEpisode:
        config, relative, path = self.config, self.files[episode_id], self.path(episode_id)
        trained = relative.suffix == ".h5"
        arms, measured = ROBOTS[config.robot], "observation.state" if trained else "observations/qpos"
        with open_hdf5(path) as file:
            for track in (measured, "action"):
                check_columns(file.array(track, (None, None)), config.robot, f"{path}, {track}")
            state = file.arms(arms, config.gripper_state, track=measured)
            length = len(state.values)
            action = file.arms(arms, config.gripper_command, track="action", length=length)
            for name in ("state_type", "action_type"):
                if (found := file.attribute("/", name)) not in (None, "joint position"):
                    raise RejectedInputError(
                        "unreadable",
                        "Recording holds no joint positions",
                        where=f"{path}, attribute {name}",
                        expected="joint position",
                        got=found,
                    )
            if trained:
                text = self._instruction(relative, path)
                views, absent = dict(config.views), dict[str, RejectedInputError]()
            else:
                views, absent = file.cameras(_IMAGES, config.views)
                for camera in views.values():
                    if config.channels is None and not file.holds_pixels(f"{_IMAGES}/{camera}"):
                        raise RejectedInputError(
                            "unreadable",
                            "Encoded images do not say in which order their channels are",
                            where=f"{path}, {_IMAGES}/{camera}",
                            expected="channels: standard, or as_written where the recorder gave OpenCV RGB",
                            next_step="declare channels, and look at the colours of a frame",
                        )
                text = (file.text("language_raw") or "").strip()
        clips: dict[str, VideoClip] = {}
        if trained:

            def clip(view: str) -> VideoClip:
                video = inside(self.root, f"videos/{relative.parent.name}/{views[view]}/{relative.stem}.mp4")
                timed_video_size(video, config.fps)
                return VideoClip.whole_file(video, length, config.fps)

            faults: list[RejectedInputError] = []
            clips, absent = sorted_views(views, clip, faults)
            if faults:
                raise all_of([*faults, *absent.values()], f"episode {episode_id}")
        episode = self.episode(
            episode_id,
            "-".join([config.label, *_episode_parts(relative)[:-1]]),
            layout="unitree unifolm" if trained else "unitree hdf5",
            state=state.values,
            action=action.values,
            overshoot=state.overshoot + action.overshoot,
            instruction=text,
            primary_view=next(iter(config.views)),
            state_names=state.names,
        )
        return LoadedEpisode(
            episode,
            tuple(clips if trained else views),
            lambda view: hdf5_images(path, f"{_IMAGES}/{views[view]}", length, config.channels or "standard"),
            clips=clips,
            absent=absent,
        )

    def _instruction(self, relative: PurePosixPath, path: AnyPath) -> str:
        table = self._instructions(relative.parent.name)
        if table is not None and relative.stem not in table:
            raise RejectedInputError(
                "missing_column",
                "Table of the dataset does not name the recording",
                where=path,
                expected=f"a row with videoid {relative.stem} in {relative.parent.name}.csv",
            )
        return "" if table is None else table[relative.stem]

    def _read_instructions(self, dataset: str) -> dict[str, str] | None:
        path = inside(self.root, f"{dataset}.csv")
        return caption_table(path, "videoid", "instruction") if is_file(path) else None


def _episode_parts(file: PurePosixPath) -> tuple[str, ...]:
    """The path that names an episode: without the folder `transitions`, the same for all."""
    parts = file.with_suffix("").parts
    return parts[1:] if parts[0] == "transitions" else parts
