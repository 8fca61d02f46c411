"""State, commands and tool poses of a recording's arms: the declared numbers of topics, brought to an episode's instants."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.mcap import timing as resampling
from worldline_core.data.mcap.cameras import TransformTree
from worldline_core.data.mcap.file import Stream
from worldline_core.data.mcap.messages import Joints, Pose
from worldline_core.data.mcap.timing import Arrivals, TimeError, Timing, in_order
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

    def at(self, grid_ns: np.ndarray, how: str) -> np.ndarray:
        """(t, d) at the instants."""
        fill = resampling.hold if how == "hold" else resampling.linear
        return fill(self.times_ns, self.values, grid_ns)


@dataclass(frozen=True)
class _ArmSignals:
    """One arm: (joints, gripper) measured and commanded, and the tool's poses with the frame that they are given in."""

    topics: ArmTopics
    state: tuple[Signal, Signal]
    command: tuple[Signal, Signal] | None
    tool: tuple[Signal, str] | None


@dataclass(frozen=True)
class RobotSignals:
    """All arms, before resampling."""

    arms: tuple[_ArmSignals, ...]

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
        return [column for column, name in enumerate(self.state_names) if name.endswith("/gripper")]

    def signals(self) -> list[Signal]:
        """Every signal once."""
        found: list[Signal] = []
        for arm in self.arms:
            found += [*arm.state, *(arm.command or ()), *(arm.tool[:1] if arm.tool is not None else ())]
        return found

    def arrivals(self) -> list[Arrivals]:
        """Messages of the signals, those that two signals share counted once."""
        return list({(signal.topic, len(signal.times_ns)): signal.arrivals for signal in self.signals()}.values())

    def vectors(self, grid_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        """State and action (t, J) float64, and how many gripper readings were clipped."""
        states, actions, clipped = [], [], 0
        for arm in self.arms:
            state, outside = _vector(arm.topics.state, arm.state, grid_ns)
            action, outside_too = state, 0
            if arm.command is not None and arm.topics.command is not None:
                action, outside_too = _vector(arm.topics.command, arm.command, grid_ns)
            states.append(state)
            actions.append(action)
            clipped += outside + outside_too
        return np.concatenate(states, axis=1), np.concatenate(actions, axis=1), clipped

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
        return {f"topic {signal.topic}": TimeError.of(signal.times_ns, grid_ns) for signal in self.signals()}

    def prediction_error_rad(self) -> float:
        """Largest distance of a measured joint from the line through its neighbours in time."""
        errors = []
        for arm in self.arms:
            error = resampling.largest_prediction_error(arm.state[0].times_ns, arm.state[0].values)
            errors.append(float(np.deg2rad(error)) if arm.topics.state.joints.unit == "deg" else error)
        return max(errors)


def _vector(readings: ArmReadings, signals: tuple[Signal, Signal], grid_ns: np.ndarray) -> tuple[np.ndarray, int]:
    """(t, joints + 1) joints [rad] and opening, and how many openings lay outside of 0..1."""
    joints = signals[0].at(grid_ns, readings.joints.resample)
    if readings.joints.unit == "deg":
        joints = np.deg2rad(joints)
    raw = signals[1].at(grid_ns, readings.gripper.resample).mean(axis=1)
    opening, outside = readings.gripper.range.opening(raw)
    return np.concatenate([joints, opening[:, None]], axis=1), outside


def read_robot(
    config: McapTopicsSourceConfig, streams: Mapping[str, Stream], timing: Timing, where: object
) -> RobotSignals:
    """The declared joints, grippers and tool poses.

    Raises: RejectedInputError: missing_column, invalid_tool_pose, clock_jump.
    """

    def read(readings: ArmReadings) -> tuple[Signal, Signal]:
        joints, gripper = (
            _read_signal(streams[each.topic], each, timing, config.max_disorder_s, where)
            for each in (readings.joints, readings.gripper)
        )
        return joints, gripper

    arms: list[_ArmSignals] = []
    for arm in config.arms:
        tool = None
        if arm.tool_pose is not None:
            tool = _read_poses(streams[arm.tool_pose], timing, config.max_disorder_s, where)
        arms.append(_ArmSignals(arm, read(arm.state), None if arm.command is None else read(arm.command), tool))
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


def _read_poses(stream: Stream, timing: Timing, max_disorder_s: float, where: object) -> tuple[Signal, str]:
    """Poses (n, 7) of a topic, quaternions of unit length, and the frame that they are given in.

    Raises: RejectedInputError: invalid_tool_pose, clock_jump.
    """
    at = f"{where}, topic {stream.topic}"
    poses = [value for value in stream.values if isinstance(value, Pose)]
    frames = sorted({pose.frame for pose in poses})
    values = np.array([pose.values for pose in poses], np.float64)
    length = np.linalg.norm(values[:, 3:], axis=1)
    usable = bool(np.isfinite(values).all() and (length > 1e-6).all())
    if len(frames) != 1 or not usable:
        raise RejectedInputError(
            "invalid_tool_pose",
            "Tool poses change their frame"
            if usable
            else "Tool pose is not finite or has a quaternion without direction",
            where=at,
            expected="one frame and unit quaternions",
            got=", ".join(frames) or "no poses",
        )
    values[:, 3:] /= length[:, None]
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
        evidence={"topic": stream.topic, "expected": list(wanted)},
    )
