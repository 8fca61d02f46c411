"""State, commands and tool poses of a recording's arms: the declared numbers of topics, brought to an episode's instants."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.mcap.cameras import TransformTree, unit_poses
from worldline_core.data.mcap.file import Stream
from worldline_core.data.mcap.messages import Joints
from worldline_core.data.mcap.timing import (
    Arrivals,
    Timing,
    hold,
    in_order,
    interpolated_poses,
    largest_prediction_error,
    linear,
)
from worldline_core.data.mcap.topics_config import ArmReadings, ArmTopics, McapTopicsSourceConfig, TopicReadings
from worldline_core.geometry.transforms import pose_from_quaternion_xyzw


@dataclass(frozen=True)
class Signal:
    """Measurements of a topic, in order of time: arrivals of n messages and their values (n, d)."""

    topic: str
    arrivals: Arrivals
    values: np.ndarray

    @property
    def times_ns(self) -> np.ndarray:
        return self.arrivals.times_ns


@dataclass(frozen=True)
class _Track:
    """What is measured, or commanded, of one arm."""

    readings: ArmReadings
    joints: Signal
    gripper: Signal

    def at(self, grid_ns: np.ndarray) -> tuple[np.ndarray, int]:
        """(t, joints + 1) joints [rad] and opening at the instants, and how many openings lay outside of 0..1."""
        joints, fingers = (
            (hold if readings.resample == "hold" else linear)(signal.times_ns, signal.values, grid_ns)
            for readings, signal in ((self.readings.joints, self.joints), (self.readings.gripper, self.gripper))
        )
        if self.readings.joints.unit == "deg":
            joints = np.deg2rad(joints)
        opening, outside = self.readings.gripper.range.opening(fingers.mean(axis=1))
        return np.concatenate([joints, opening[:, None]], axis=1), outside


@dataclass(frozen=True)
class _Arm:
    """One arm.

    Attributes:
        tool: poses of the tool, where a topic has them.
        frame: of the transforms: the one that the tool's poses are given in or, without them, the tool itself.
    """

    topics: ArmTopics
    state: _Track
    command: _Track | None
    tool: Signal | None
    frame: str | None


@dataclass(frozen=True)
class RobotSignals:
    """All arms, before resampling."""

    arms: tuple[_Arm, ...]

    @property
    def commanded(self) -> bool:
        return self.arms[0].command is not None

    @property
    def frames(self) -> list[str]:
        """Frames that must be reached from the base."""
        return [arm.frame for arm in self.arms if arm.frame is not None]

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
        return [column for column, name in enumerate(self.state_names) if name.endswith("/gripper")]

    def signals(self) -> list[Signal]:
        """Every signal once."""
        found: list[Signal] = []
        for arm in self.arms:
            found += [signal for track in (arm.state, arm.command) if track for signal in (track.joints, track.gripper)]
            found += [arm.tool] if arm.tool is not None else []
        return found

    def arrivals(self) -> list[Arrivals]:
        """Messages of the signals, those that two signals share counted once."""
        return list({(signal.topic, len(signal.times_ns)): signal.arrivals for signal in self.signals()}.values())

    def vectors(self, grid_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        """State and action (t, J) float64, and how many gripper readings were clipped; without commands the action
        repeats the state."""
        state = [arm.state.at(grid_ns) for arm in self.arms]
        action = [arm.command.at(grid_ns) for arm in self.arms if arm.command is not None]
        states, actions = (np.concatenate([part for part, _ in track], axis=1) for track in (state, action or state))
        return states, actions, sum(outside for _, outside in state + action)

    def tools(self, tree: TransformTree, base: str, grid_ns: np.ndarray) -> np.ndarray | None:
        """(t, A, 4, 4) T_base_tool where it is recorded, else None."""
        poses: list[np.ndarray] = []
        for arm in self.arms:
            if arm.frame is None:
                continue
            if arm.tool is None:
                poses.append(tree.poses(base, arm.frame, grid_ns))
                continue
            values = interpolated_poses(arm.tool.times_ns, arm.tool.values, grid_ns)
            pose = pose_from_quaternion_xyzw(values[:, :3], values[:, 3:])
            poses.append(pose if arm.frame == base else tree.poses(base, arm.frame, grid_ns) @ pose)
        return np.stack(poses, axis=1) if poses else None

    def prediction_error_rad(self) -> float:
        """Largest distance of a measured joint from the line through its neighbours in time."""
        errors = []
        for arm in self.arms:
            error = largest_prediction_error(arm.state.joints.times_ns, arm.state.joints.values)
            errors.append(float(np.deg2rad(error)) if arm.topics.state.joints.unit == "deg" else error)
        return max(errors)


def read_robot(
    config: McapTopicsSourceConfig, streams: Mapping[str, Stream], timing: Timing, where: object
) -> RobotSignals:
    """The declared joints, grippers and tool poses.

    Raises: RejectedInputError: missing_column, invalid_tool_pose, clock_jump.
    """

    def track(readings: ArmReadings) -> _Track:
        joints, gripper = (
            _read_signal(streams[each.topic], each, timing, config.max_disorder_s, where)
            for each in (readings.joints, readings.gripper)
        )
        return _Track(readings, joints, gripper)

    arms: list[_Arm] = []
    for arm in config.arms:
        tool, frame = None, None if arm.tool_frame is None else arm.tool_frame.lstrip("/")
        if arm.tool_pose is not None:
            tool, frame = _read_tool(streams[arm.tool_pose], timing, config.max_disorder_s, where)
        arms.append(_Arm(arm, track(arm.state), None if arm.command is None else track(arm.command), tool, frame))
    return RobotSignals(tuple(arms))


def _read_signal(
    stream: Stream, readings: TopicReadings, timing: Timing, max_disorder_s: float, where: object
) -> Signal:
    """The declared numbers of a topic.

    Messages of a JointState topic that hold other joints (several drivers may share it) are left out.

    Raises: RejectedInputError: missing_column where no message has the joints or columns; clock_jump.
    """
    at = f"{where}, topic {stream.topic}"
    taken: list[int] = []
    rows: list[list[float]] = []
    for number, value in enumerate(stream.values):
        if not isinstance(value, Joints):
            columns, numbers = readings.columns, value
        elif readings.names is not None and set(readings.names) <= set(value.names):
            columns, numbers = [value.names.index(name) for name in readings.names], getattr(value, readings.field)
        else:
            columns, numbers = None, ()
        if columns is not None and max(columns) < len(numbers):
            taken.append(number)
            rows.append([numbers[column] for column in columns])
    if not rows:
        raise _missing(stream, readings, at)
    arrivals = in_order(timing.times_ns(stream)[taken], at, max_disorder_s)
    return Signal(stream.topic, arrivals, np.array(rows, np.float64)[arrivals.order])


def _read_tool(stream: Stream, timing: Timing, max_disorder_s: float, where: object) -> tuple[Signal, str]:
    """Poses (n, 7) of a topic, quaternions of unit length, and the frame that they are given in.

    Raises: RejectedInputError: invalid_tool_pose, clock_jump.
    """
    at = f"{where}, topic {stream.topic}"
    values = unit_poses([pose.values for pose in stream.values], "invalid_tool_pose", at)
    frames = sorted({pose.frame for pose in stream.values})
    if len(frames) != 1:
        raise RejectedInputError(
            "invalid_tool_pose", "Tool poses change their frame", where=at, expected="one frame", got=", ".join(frames)
        )
    arrivals = in_order(timing.times_ns(stream), at, max_disorder_s)
    return Signal(stream.topic, arrivals, values[arrivals.order]), frames[0]


def _missing(stream: Stream, readings: TopicReadings, where: str) -> RejectedInputError:
    first = stream.values[0]
    if isinstance(first, Joints):
        known = sorted({name for value in stream.values for name in value.names})
        got = f"joints {', '.join(known)}; {len(getattr(first, readings.field))} {readings.field} values"
    else:
        got = f"{len(first)} columns"
    wanted = readings.names if readings.names is not None else tuple(map(str, readings.columns or ()))
    return RejectedInputError(
        "missing_column",
        "No message of a topic has the declared joints or columns",
        where=where,
        expected=f"{readings.field} of {', '.join(wanted)}",
        got=got,
    )
