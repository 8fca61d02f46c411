"""RoboMIND 1 and 2: one HDF5 file per episode, images as JPEG bytes, joints of the robot (puppet) and of what leads it (master).

    <robot>/<task>/success_episodes/[train|val/]<episode>/data/trajectory.hdf5
    version 1: observations/rgb_images/<camera>, {puppet,master}/joint_position[_left,_right]
    version 2: camera_observations/color_images/<camera>, {puppet,master}/{arm,end_effector}_{left,right}_position_align/data

Joints are radians. No extrinsics are published: Stage I only. Episodes of one task share a scene, whatever the release's
own train and val folders say: they split by trajectory. The simulated robots of version 1 (states at about four times the
rate of the images, in tracks of different lengths) and robots with dexterous hands in version 2 are not read.
"""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.source import ForeignSourceConfig, GripperRange, LoadedEpisode, joint_names
from worldline_core.data.guards.hdf5 import Channels, Hdf5File, hdf5_images, open_hdf5, require_h5py
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath, find_files, inside, relative_name
from worldline_core.data.sources.ids import file_ids, printable
from worldline_core.data.sources.robomind_layouts import ROBOMIND_LAYOUTS, RobomindLayout, Track
from worldline_core.data.sources.video_folder import caption_table

LayoutName = Literal[
    "h5_franka_1rgb",
    "h5_franka_3rgb",
    "h5_franka_fr3_dual",
    "h5_ur_1rgb",
    "h5_agilex_3rgb",
    "h5_tienkung_gello_1rgb",
    "h5_tienkung_prod1_gello_1rgb",
    "h5_tienkung_xsens_1rgb",
    "v2_franka",
    "v2_ur",
    "v2_agilex",
]
_FILE = "trajectory.hdf5"
_SUCCESS, _FAILURE = "success_episodes", "fail"


class RobomindSourceConfig(ForeignSourceConfig):
    """A folder of one robot. The files say neither their rate nor what a gripper reading means."""

    kind: Literal["robomind"] = "robomind"
    layout: LayoutName = Field(description="the release's folder name (version 1), or v2_ and it (version 2)")
    fps: float = Field(gt=0, description="of the images and states; stated in no file")
    embodiment: str | None = Field(default=None, description="default: the layout's")
    views: dict[str, str] | None = Field(
        default=None, min_length=1, description="view -> camera; default: the layout's"
    )
    channels: Channels | None = Field(
        default=None, description="of the images; default: the layout's, where it is known"
    )
    action: Track | None = Field(
        default=None, description="puppet: the action repeats the state; default: the layout's"
    )
    gripper_state: GripperRange | None = Field(default=None, description="readings of the puppet's gripper")
    gripper_command: GripperRange | None = Field(default=None, description="readings of the master's gripper")
    instructions: str | None = Field(
        default=None,
        description="RoboMIND_v1_2_instr.csv in this folder; default: what the file itself says, or nothing",
    )

    @model_validator(mode="after")
    def _declared(self) -> RobomindSourceConfig:
        layout, missing = ROBOMIND_LAYOUTS[self.layout], []
        grippers = any(arm.gripper is not None for arm in layout.arms)
        if self.channels is None and layout.channels is None:
            missing.append("channels")
        if grippers and self.gripper_state is None:
            missing.append("gripper_state")
        if grippers and self.command == "master" and self.gripper_command is None:
            missing.append("gripper_command")
        if missing:
            raise ValueError(f"RoboMIND does not say it of {self.layout}, so declare {', '.join(missing)}")
        return self

    @property
    def command(self) -> Track:
        return self.action or ROBOMIND_LAYOUTS[self.layout].command


class RobomindSource:
    """Reads every `trajectory.hdf5` below the root; images are decoded one by one when they are asked for."""

    def __init__(self, config: RobomindSourceConfig, root: AnyPath) -> None:
        require_h5py()
        self._config = config
        self._layout: RobomindLayout = ROBOMIND_LAYOUTS[config.layout]
        self._root = root
        found = [relative_name(path, root) for path in find_files(root, _FILE)]
        self._files = file_ids(config.label, {str(file): _episode_parts(file) for file in found})
        table = config.instructions
        self._instructions = None if table is None else caption_table(inside(root, table), "task", "instruction")

    def episode_ids(self) -> list[str]:
        return sorted(self._files)

    def load(self, episode_id: str) -> LoadedEpisode:
        config, layout = self._config, self._layout
        relative = self._files[episode_id]
        path = inside(self._root, relative)
        views = dict(config.views or layout.views)
        with open_hdf5(path) as file:
            state, overshoot = self._vector(file, path, "puppet")
            action, more = (state, 0) if config.command == "puppet" else self._vector(file, path, "master")
            self._check_compression(file, path)
            file.require_cameras(layout.images, views)
            # Who collected it: some stations recorded the arms exchanged.
            collector = file.attribute("metadata", "collector") if layout.version == 2 else None
            text = self._text(file, relative, path)
        names = tuple(
            name
            for arm in layout.arms
            for name in joint_names({arm.name: arm.num_joints}, gripper=arm.gripper is not None)
        )
        episode = Episode(
            **config.declared("-".join([config.label, *_task_parts(PurePosixPath(relative))])),
            episode_id=episode_id,
            embodiment=config.embodiment or layout.embodiment,
            instruction=text,
            outcome=_outcome(relative, config.outcome),
            fps=config.fps,
            state=state,
            action=action,
            timestamps=np.arange(len(state)) / config.fps,
            primary_view=next(iter(views)),
            state_names=names,
            conventions={
                "layout": f"robomind {layout.version}",
                "gripper_overshoot": overshoot + more,
                **({"action": "repeats the state"} if config.command == "puppet" else {}),
                **({} if collector is None else {"collector": collector}),
            },
        )
        channels: Channels = config.channels or layout.channels or "standard"

        return LoadedEpisode(
            episode,
            tuple(views),
            lambda view: hdf5_images(path, f"{layout.images}/{views[view]}", len(state), channels),
        )

    def _vector(self, file: Hdf5File, path: AnyPath, track: Track) -> tuple[np.ndarray, int]:
        """(N, J) float32 in the contract's layout, and how many gripper readings were clipped."""
        span = self._config.gripper_state if track == "puppet" else self._config.gripper_command
        blocks: list[np.ndarray] = []
        overshoot, length = 0, None
        for arm in self._layout.arms:
            key = arm.joints.format(track=track)
            values = file.columns(key, length)
            if values.shape[1] not in arm.widths:
                raise RejectedInputError(
                    "length_mismatch",
                    "Joints have another number of columns than this robot's",
                    where=f"{path}, {key}",
                    expected=" or ".join(map(str, arm.widths)),
                    got=values.shape[1],
                    next_step="check curate.sources[].layout: each robot has a folder and a layout of its own",
                    evidence={"expected": list(arm.widths), "found": values.shape[1]},
                )
            length = len(values)
            blocks.append(values[:, arm.start : arm.start + arm.num_joints])
            if arm.gripper is not None and span is not None:
                opening, outside = span.opening(self._gripper(file, path, arm.gripper, track, length))
                overshoot += outside
                blocks.append(opening)
        with np.errstate(over="ignore"):  # what is no float32 becomes infinite, and is refused as such
            return np.concatenate(blocks, axis=1).astype(np.float32), overshoot

    def _gripper(self, file: Hdf5File, path: AnyPath, place: tuple[str, int], track: Track, length: int) -> np.ndarray:
        """(N, 1) raw readings."""
        key, column = place[0].format(track=track), place[1]
        values = file.columns(key, length)
        if self._layout.version == 2 and values.shape[1] != 1:
            raise RejectedInputError(
                "invalid_gripper",
                "End effector is no gripper of one value",
                where=f"{path}, {key}",
                expected="1 value per frame",
                got=f"{values.shape[1]} (a dexterous hand?)",
                evidence={"values": values.shape[1]},
            )
        return values[:, column : column + 1]

    def _check_compression(self, file: Hdf5File, path: AnyPath) -> None:
        compressed = file.attribute("/", "compress") if self._layout.version == 1 else None
        if compressed is not None and compressed not in ("True", "1"):
            raise RejectedInputError(
                "unreadable",
                "Images are stored without compression",
                where=f"{path}, attribute compress",
                expected="True: encoded images",
                got=compressed,
            )

    def _text(self, file: Hdf5File, relative: str, path: AnyPath) -> str:
        if self._instructions is not None:
            task = (_task_parts(PurePosixPath(relative)) or ("",))[-1]
            if task not in self._instructions:
                raise RejectedInputError(
                    "missing_column",
                    "Table of instructions does not name the task",
                    where=str(path),
                    expected=task,
                    got=f"{len(self._instructions)} tasks",
                )
            return self._instructions[task]
        if self._layout.version == 1:
            return (file.text("language_raw") or "").strip()
        return (file.attribute("metadata", "language_instruction") or "").replace("_", " ").strip()


def _episode_parts(file: PurePosixPath) -> tuple[str, ...]:
    """The path that names an episode: without the file's own name and the folder `data`, the same for all."""
    parts = file.parts[:-1]
    return parts[:-1] if parts and parts[-1] == "data" else parts


def _task_parts(file: PurePosixPath) -> tuple[str, ...]:
    """The folders down to the task's: what stands before `success_episodes`, else all but the episode's own."""
    parts = _episode_parts(file)
    named = parts[: parts.index(_SUCCESS)] if _SUCCESS in parts else parts[:-1]
    return tuple(map(printable, named))


def _outcome(relative: str, declared: str) -> str:
    if declared != "unknown":
        return declared
    parts = PurePosixPath(relative).parts
    if _SUCCESS in parts:
        return "success"
    return "failure" if any(part.lower().startswith(_FAILURE) for part in parts[:-2]) else "unknown"
