"""State, commands and tool poses of a recording's arms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from worldline_core.data.mcap.topics import resampling
from worldline_core.data.mcap.topics.clock import Arrivals
from worldline_core.data.mcap.topics.config import ArmReadings, ArmTopics, McapTopicsSourceConfig
from worldline_core.data.mcap.topics.resampling import TimeError
from worldline_core.data.mcap.topics.signals import ArmSignals, Signal, read_poses, read_signal
from worldline_core.data.mcap.topics.streams import Stream, Timing
from worldline_core.data.mcap.topics.transforms import TransformTree
from worldline_core.geometry.pose_formats import pose_from_quaternion_xyzw


@dataclass(frozen=True)
class _Arm:
    topics: ArmTopics
    state: ArmSignals
    command: ArmSignals | None
    tool: tuple[Signal, str] | None


@dataclass(frozen=True)
class RobotSignals:
    """All arms, before resampling."""

    arms: tuple[_Arm, ...]

    @property
    def commanded(self) -> bool:
        return self.arms[0].command is not None

    @property
    def frames(self) -> list[str]:
        """Frames that must be reached from the base: of tools, and those that tool poses are given in."""
        found = [arm.topics.tool_frame for arm in self.arms if arm.topics.tool_frame is not None]
        return [frame.lstrip("/") for frame in found] + [arm.tool[1] for arm in self.arms if arm.tool is not None]

    @property
    def state_names(self) -> tuple[str, ...]:
        names: list[str] = []
        for arm in self.arms:
            joints = arm.topics.state.joints
            given = joints.names or tuple(f"joint_{number}" for number in range(1, joints.width + 1))
            names += [f"{arm.topics.name}/{name}" for name in (*given, "gripper")]
        return tuple(names)

    @property
    def gripper_columns(self) -> list[int]:
        widths = np.cumsum([arm.topics.state.joints.width + 1 for arm in self.arms])
        return [int(width) - 1 for width in widths]

    def signals(self) -> list[Signal]:
        """Every signal once."""
        found: list[Signal] = []
        for arm in self.arms:
            found += arm.state.signals
            found += arm.command.signals if arm.command is not None else ()
            found += [arm.tool[0]] if arm.tool is not None else []
        return found

    def arrivals(self) -> list[Arrivals]:
        """Messages of the signals, those that two signals share counted once."""
        return list({(signal.topic, len(signal.times_ns)): signal.arrivals for signal in self.signals()}.values())

    def vectors(self, grid_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        """State and action (t, J) float64, and how many gripper readings were clipped."""
        states, actions, outside = [], [], 0
        for arm in self.arms:
            state, clipped = arm.state.at(grid_ns)
            action, clipped_too = (state, 0) if arm.command is None else arm.command.at(grid_ns)
            states.append(state)
            actions.append(action)
            outside += clipped + clipped_too
        return np.concatenate(states, axis=1), np.concatenate(actions, axis=1), outside

    def tools(self, tree: TransformTree, base: str, grid_ns: np.ndarray) -> np.ndarray | None:
        """(t, A, 4, 4) T_base_tool where it is recorded, else None."""
        poses: list[np.ndarray] = []
        for arm in self.arms:
            if arm.tool is not None:
                signal, frame = arm.tool
                values = resampling.poses(signal.times_ns, signal.values, grid_ns)
                T_frame_tool = pose_from_quaternion_xyzw(values[:, :3], values[:, 3:])
                poses.append(T_frame_tool if frame == base else tree.poses(base, frame, grid_ns) @ T_frame_tool)
            elif arm.topics.tool_frame is not None:
                poses.append(tree.poses(base, arm.topics.tool_frame.lstrip("/"), grid_ns))
        return np.stack(poses, axis=1) if poses else None

    def time_errors(self, grid_ns: np.ndarray) -> dict[str, TimeError]:
        return {f"topic {signal.topic}": signal.time_error(grid_ns) for signal in self.signals()}

    def prediction_error_rad(self) -> float:
        """Of the measured joints."""
        return max(arm.state.prediction_error_rad() for arm in self.arms)


def read_robot(
    config: McapTopicsSourceConfig, streams: Mapping[str, Stream], timing: Timing, where: object
) -> RobotSignals:
    """The declared joints, grippers and tool poses.

    Raises: RejectedInputError: missing_column, invalid_tool_pose, clock_jump.
    """

    def signals(readings: ArmReadings) -> ArmSignals:
        joints, gripper = (
            read_signal(streams[each.topic], each, timing, config.max_disorder_s, where)
            for each in (readings.joints, readings.gripper)
        )
        return ArmSignals(readings, joints, gripper)

    return RobotSignals(
        tuple(
            _Arm(
                topics=arm,
                state=signals(arm.state),
                command=None if arm.command is None else signals(arm.command),
                tool=None
                if arm.tool_pose is None
                else read_poses(streams[arm.tool_pose], timing, config.max_disorder_s, where),
            )
            for arm in config.arms
        )
    )
