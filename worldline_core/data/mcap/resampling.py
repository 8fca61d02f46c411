"""Measurements brought from their own times and frames to an episode: clocks, interpolation, transforms, cameras.

A message has up to two times: that of its header, and that at which the recorder wrote it (log). header <= log, and their
smallest difference over a topic is the offset between the clocks plus the shortest transport time, so topics whose
smallest differences disagree were stamped by clocks that disagree (Paxson 1998).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np

from worldline_core.data.episodes.recorded_poses import RecordedCameras, camera_pose, rejected_as
from worldline_core.data.guards.rejection import Reason, RejectedInputError
from worldline_core.data.mcap.file import Stream
from worldline_core.data.mcap.messages import Calibration, Transform
from worldline_core.data.mcap.topics_config import McapTopicsSourceConfig
from worldline_core.geometry.cameras import ImageTransform
from worldline_core.geometry.lens import distortion_from_ros, is_fisheye
from worldline_core.geometry.transforms import pose_from_rotation, rigid_inverse

MAX_INTERPOLATION_ERROR = 0.1
"""Between two joint readings [rad, m]; 10 Hz and 80 rad/s^2 make as much."""
_SAME_VALUE = 1e-3
"""Messages of one time that differ by less [rad, m] say the same: a simulation sends several per tick of its clock."""
_FEWEST_FOR_ALTERNATION = 8
MAX_TRIM_S = 1.0
"""A topic may begin this much later than the others, and end this much earlier [s]; see `check_gaps`."""
MAX_DISORDER_S = 1.0
"""A message that comes later than this behind a younger one was stamped by a clock that was set back."""


def times_by_topic(
    config: McapTopicsSourceConfig, streams: Mapping[str, Stream], where: object
) -> tuple[dict[str, np.ndarray], int]:
    """Times (n,) of each topic's messages [ns] on the configured clock, and the delay that is subtracted from a log time: the least
    one (log time minus header time) of the joints' topic, which commands must fit; where joints have no header, of all topics.

    Raises: RejectedInputError (clock_skew) where header times count, and disagree by more than allowed or are not set.
    """
    log_ns = {topic: np.array(stream.log_ns, np.int64) for topic, stream in streams.items()}
    if config.time == "log":
        return log_ns, 0
    refused = partial(RejectedInputError, "clock_skew")
    # A simulated clock is 0 once, a driver that sets none writes 0 always.
    unset = {topic: count for topic, stream in streams.items() if (count := _without_time(stream)) > 1}
    if unset:
        got = ", ".join(f"0 in {count} of {len(log_ns[topic])}" for topic, count in unset.items())
        where = f"{where}, topic {', '.join(unset)}"
        raise refused("Messages have no header time", where=where, got=got, next_step="set time: log")
    stamps_ns = {
        topic: np.array(stream.stamps_ns, np.int64) + config.offset_ns(topic)
        for topic, stream in streams.items()
        if stream.stamps_ns[0] is not None and stream.kind != "calibration"
    }
    least_ms = {topic: float((log_ns[topic] - times).min()) / 1e6 for topic, times in stamps_ns.items()}
    least, skew_ms = min(least_ms.values(), default=0.0), np.ptp(list(least_ms.values()) or [0.0])
    if skew_ms > config.max_clock_skew_ms:
        raise refused(
            "Clocks of topics disagree", where=where, evidence={"skew_ms": float(skew_ms)},
            expected=f"least delays within {config.max_clock_skew_ms} ms of each other",
            got=", ".join(f"{topic}: {delay:.1f} ms" for topic, delay in sorted(least_ms.items())),
            next_step="declare time_offsets_ms, or set time: log",
        )  # fmt: skip
    joints = config.arms[0].state.joints.topic if config.arms else ""
    header_to_log_ns = round(least_ms.get(joints, least) * 1e6)
    return {topic: stamps_ns.get(topic, times - header_to_log_ns) for topic, times in log_ns.items()}, header_to_log_ns


def _without_time(stream: Stream) -> int:
    """Number of messages that state the time 0; of transforms those of one frame, as one that came once stays."""
    if stream.kind == "transforms":
        children = Counter(each.child for transforms in stream.values for each in transforms if not each.stamp_ns)
        return max(children.values(), default=0)
    return 0 if stream.kind == "calibration" else stream.stamps_ns.count(0)


def in_order(times_ns: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Strictly ascending times (n,) of those given in the order of the file, and the index of each; the first of one time is kept.

    Raises: RejectedInputError (clock_jump) for a time more than MAX_DISORDER_S out of order.
    """
    back_s = (np.maximum.accumulate(times_ns) - times_ns) / 1e9
    if (jump_s := float(back_s.max())) > MAX_DISORDER_S:
        first = int(np.argmax(back_s > MAX_DISORDER_S))
        raise RejectedInputError(
            "clock_jump", "Times of a topic jump back", where=f"{where}, message {first}", got=f"{jump_s:.3f} s",
            next_step="set time: log, if the recorder's clock is sound, or cut the recording at the jump",
            evidence={"message": first, "jump_s": jump_s},
        )  # fmt: skip
    return np.unique(times_ns, return_index=True)


@np.errstate(invalid="ignore", over="ignore")  # values that are not finite are refused later
def in_order_with_values(times_ns: np.ndarray, values: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) and values (n, d) in order of time, each time once.

    Raises: RejectedInputError: clock_jump; conflicting_messages for one time with different values.
    """
    times, order = in_order(times_ns, where)
    kept = values[order][np.searchsorted(times, times_ns)]
    empty = np.isnan(kept) & np.isnan(values)
    differs = ~((np.abs(kept - values) <= _SAME_VALUE) | (kept == values) | empty).all(axis=1)
    if differs.any():
        got = f"{int(differs.sum())} messages, by up to {np.nanmax(np.abs(kept - values)):.3f}"
        where = f"{where}, message {int(np.argmax(differs))}"
        raise _conflict("Messages of one time have different values", where, got)
    return times, values[order]


def _conflict(what: str, where: str, got: str) -> RejectedInputError:
    next_step = "record the topic with one publisher, or declare another topic (a command that steps: resample: hold)"
    return RejectedInputError(
        "conflicting_messages", what, where=where, expected="one publisher", got=got, next_step=next_step
    )


@np.errstate(over="ignore")
def check_alternation(times_ns: np.ndarray, values: np.ndarray, where: str, *, share: float | None = None) -> None:
    """Refuses values (n, d) at ascending times that jump to and fro as those of two publishers do.

    Half of all values differ by more than 0.01 from both neighbours, which agree; or, with `share`, so many jumps of more
    than 0.05, faster than 100 per second^2, are taken back within four messages.

    Raises: RejectedInputError (conflicting_messages).
    """
    count = len(values)
    if count < _FEWEST_FOR_ALTERNATION:
        return
    jumps = np.diff(values, axis=0)

    def taken_back(after: int) -> np.ndarray:
        """(n - 1, d) jumps whose end returns to their beginning so many messages later."""
        back = np.full(jumps.shape, np.inf)
        back[: count - 1 - after] = np.abs(values[1 + after :] - values[: count - 1 - after])
        return back < np.abs(jumps) / 2

    at_once = (taken_back(1) & (np.abs(jumps) > 0.01)).any(axis=1)
    fast = np.abs(jumps) > max(0.05, 100 * float(np.median(np.diff(times_ns)) / 1e9) ** 2)
    soon = (np.logical_or.reduce([taken_back(after) for after in range(1, 5)]) & fast).any(axis=1)
    if at_once.sum() >= (count - 2) / 2 or (share is not None and soon.sum() >= max(3, share * count)):
        found, largest = max(at_once.sum(), soon.sum()), np.abs(jumps[at_once | soon]).max()
        what = "Values of a topic jump to and fro, as those of two publishers"
        raise _conflict(what, where, f"{found} of {count} messages, by up to {largest:.3f}")


@np.errstate(over="ignore")
def check_interpolation(times_ns: np.ndarray, values: np.ndarray, where: str) -> None:
    """Raises: RejectedInputError (conflicting_messages) where values (n, d) between two messages are uncertain by more than
    MAX_INTERPOLATION_ERROR: by h^2 / 8 times the second derivative (the larger one of both messages)."""
    if len(values) < 3:
        return
    steps = (np.diff(times_ns) / 1e9)[:, None]
    bends = np.abs(np.diff(np.diff(values, axis=0) / steps, axis=0)) / ((steps[1:] + steps[:-1]) / 2)
    bends = np.concatenate([bends[:1], bends, bends[-1:]])
    errors = (steps**2 / 8 * np.maximum(bends[1:], bends[:-1])).max(axis=1)
    worst = int(np.argmax(errors))
    if errors[worst] > MAX_INTERPOLATION_ERROR:
        where = f"{where}, {(times_ns[worst] - times_ns[0]) / 1e9:.3f} s after its first message"
        got = f"an error of about {errors[worst]:.3f}, allowed {MAX_INTERPOLATION_ERROR}"
        raise _conflict("Values of a topic cannot be interpolated", where, got)


def check_gaps(
    times_ns: np.ndarray, start_ns: int, stop_ns: int, *, max_gap_s: float, where: str, max_trim_s: float = MAX_TRIM_S
) -> None:
    """Raises: RejectedInputError (time_gap) when messages (n > 0, ascending) are missing for too long between start and stop:
    `max_gap_s` between two of them, `max_trim_s` before the first and after the last."""
    # From the last message before to the first one after: an instant near an end lies between those.
    first = max(int(np.searchsorted(times_ns, start_ns, side="right")) - 1, 0)
    last = min(int(np.searchsorted(times_ns, stop_ns)), len(times_ns) - 1)
    inside = times_ns[first : last + 1]
    steps = np.append(np.diff(inside), 0)
    for seconds, allowed, what, at_ns in (
        (steps.max() / 1e9, max_gap_s, "Messages are missing", int(inside[np.argmax(steps)])),
        ((times_ns[0] - start_ns) / 1e9, max_trim_s, "Topic begins too late", start_ns),
        ((stop_ns - times_ns[-1]) / 1e9, max_trim_s, "Topic ends too early", int(times_ns[-1])),
    ):
        if seconds > allowed:
            expected, got = f"at most {allowed:.3f} s", f"{seconds:.3f} s from {(at_ns - start_ns) / 1e9:.3f} s on"
            evidence = {"gap_s": float(seconds)}
            raise RejectedInputError("time_gap", what, where=where, expected=expected, got=got, evidence=evidence)


def instants(start_ns: int, stop_ns: int, fps: float) -> np.ndarray:
    """(t,) start, start + 1 / fps, ... up to stop, within a nanosecond of rounding. Empty when stop < start."""
    count = int(np.floor((stop_ns - start_ns) * fps / 1e9 + 1e-6)) + 1
    return start_ns + np.round(np.arange(max(count, 0)) * (1e9 / fps)).astype(np.int64)


def nearest(times_ns: np.ndarray, grid_ns: np.ndarray) -> np.ndarray:
    """(t,) index of the measurement nearest to each instant; of two equally near ones the earlier."""
    right = np.searchsorted(times_ns, grid_ns).clip(0, len(times_ns) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(grid_ns - times_ns[left] <= times_ns[right] - grid_ns, left, right)


def resampled(times_ns: np.ndarray, values: np.ndarray, grid_ns: np.ndarray, *, hold: bool = False) -> np.ndarray:
    """(t, d) of values (n, d) at strictly ascending times; linear, constant beyond the ends, or with `hold` the last one."""
    if hold:
        return values[np.maximum(np.searchsorted(times_ns, grid_ns, side="right") - 1, 0)]
    times, grid = times_ns - times_ns[0], grid_ns - times_ns[0]
    return np.stack([np.interp(grid, times, column) for column in values.T], axis=1)


def resampled_poses(times_ns: np.ndarray, values: np.ndarray, grid_ns: np.ndarray) -> np.ndarray:
    """(t, 4, 4) of poses (n, 7) x y z qx qy qz qw: linear in place, slerp in rotation; constant beyond the ends."""
    from scipy.spatial.transform import Rotation, Slerp  # takes a third of a reader's start, which few need

    rotations = Rotation.from_quat(values[:, 3:])
    if len(times_ns) == 1:
        turned = rotations[np.zeros(len(grid_ns), np.int64)]
    else:
        inside = np.clip(grid_ns, times_ns[0], times_ns[-1]) - times_ns[0]
        turned = Slerp(times_ns - times_ns[0], rotations)(inside)
    return pose_from_rotation(resampled(times_ns, values[:, :3], grid_ns), turned.as_matrix())


def checked_poses(poses: Sequence[tuple[float, ...]], reason: Reason, where: str) -> np.ndarray:
    """Poses x y z qx qy qz qw as (n, 7), none of which is not finite or has a quaternion without length."""
    values = np.array(poses, np.float64)
    if not (np.isfinite(values).all() and (np.linalg.norm(values[:, 3:], axis=1) > 1e-6).all()):
        raise RejectedInputError(reason, "Pose is not finite or has a quaternion without direction", where=where)
    # Of one length, and of the sign that follows the pose before, so that neighbours can be compared.
    values[:, 3:] /= np.linalg.norm(values[:, 3:], axis=1, keepdims=True)
    turned = (values[1:, 3:] * values[:-1, 3:]).sum(axis=1) < 0
    values[1:, 3:] *= np.where(np.cumsum(turned) % 2, -1.0, 1.0)[:, None]
    return values


@dataclass
class _Edge:
    """Poses of a frame in its parent, in the order of the file; `static`: all came over topics of static transforms."""

    parent: str
    where: str
    static: bool = True
    times_ns: list[int] = field(default_factory=list)
    values: list[tuple[float, ...]] = field(default_factory=list)

    @property
    def moving(self) -> bool:
        """True if the transform came more than once over a topic of moving ones; otherwise the last one counts."""
        return not self.static and len(self.times_ns) > 1

    @cached_property
    def ordered(self) -> tuple[np.ndarray, np.ndarray]:
        """Times (n,) and poses (n, 7) in order of time."""
        values = checked_poses(self.values, "invalid_extrinsics", self.where)
        if not self.moving:
            return np.array(self.times_ns[-1:], np.int64), values[-1:]
        times_ns, values = in_order_with_values(np.array(self.times_ns, np.int64), values, self.where)
        check_alternation(times_ns, values, self.where)
        return times_ns, values


class TransformTree:
    """Frames below their parents; one that has two, or is above itself, is rejected (invalid_extrinsics)."""

    def __init__(self, where: object, max_gap_s: float) -> None:
        self._where = where
        self._max_gap_s = max_gap_s
        self._edges: dict[str, _Edge] = {}

    def add(self, transforms: Sequence[Transform], times_ns: Iterable[int], *, static: bool) -> None:
        """Adds the transforms of one message."""
        for transform, time_ns in zip(transforms, times_ns, strict=True):
            parent, child = transform.parent, transform.child
            edge = self._edges.setdefault(child, _Edge(parent, f"{self._where}, transform {parent} -> {child}"))
            if edge.parent != parent:
                what, expected = "A frame has two parents", edge.parent
                raise RejectedInputError("invalid_extrinsics", what, where=edge.where, expected=expected, got=parent)
            edge.static = edge.static and static
            edge.times_ns.append(time_ns)
            edge.values.append(transform.values)

    def complete(self, earlier: TransformTree) -> None:
        """Adds frames that only an earlier part of the recording has."""
        self._edges = {**earlier._edges, **self._edges}

    def _chain(self, frame: str) -> list[str]:
        """The frame, its parent, and so on up to the root."""
        found = [frame]
        while found[-1] in self._edges:
            above = self._edges[found[-1]].parent
            if above in found:
                what, got = "Transforms form a ring", " -> ".join([*found, above])
                raise RejectedInputError("invalid_extrinsics", what, where=self._where, got=got)
            found.append(above)
        return found

    def connected(self, base: str, frame: str) -> bool:
        return bool(set(self._chain(base)) & set(self._chain(frame)))

    def _path(self, base: str, frame: str) -> tuple[list[_Edge], list[_Edge]]:
        """Transforms from the base, and from the frame, up to the first frame above both."""
        up, down = self._chain(base), self._chain(frame)
        common = next((name for name in down if name in up), None)
        if common is None:
            known = ", ".join(f"{edge.parent} -> {child}" for child, edge in sorted(self._edges.items()))
            what, expected = "No transforms lead from the base to a frame", f"{base} -> {frame}"
            raise RejectedInputError("missing_calibration", what, where=self._where, expected=expected, got=known)
        above, below = ([self._edges[name] for name in side[: side.index(common)]] for side in (up, down))
        return above, below

    def moving_times(self, base: str, frame: str) -> list[np.ndarray]:
        return [edge.ordered[0] for side in self._path(base, frame) for edge in side if edge.moving]

    def poses(self, base: str, frame: str, grid_ns: np.ndarray) -> np.ndarray:
        """(t, 4, 4) T_base_frame at the instants; every transform between the two is resampled by itself."""
        up, down = self._path(base, frame)
        return rigid_inverse(self._product(up, grid_ns)) @ self._product(down, grid_ns)

    def _product(self, edges: list[_Edge], grid_ns: np.ndarray) -> np.ndarray:
        """Pose of the first of these frames, each the child of the next, in the parent of the last."""
        pose, gap = np.tile(np.eye(4), (len(grid_ns), 1, 1)), self._max_gap_s
        for edge in edges:
            times_ns, values = edge.ordered
            if edge.moving:
                start, stop = int(grid_ns[0]), int(grid_ns[-1])
                check_gaps(times_ns, start, stop, max_gap_s=gap, max_trim_s=gap, where=edge.where)
            pose = resampled_poses(times_ns, values, grid_ns) @ pose
        return pose


def uncalibrated(calibration: Calibration, *, rectified: bool) -> str | None:
    """Why a message holds no calibration, by the conventions of ROS and Foxglove and its drivers; None where it holds one."""
    if not any(calibration.P if rectified else calibration.K):
        return f"{'P' if rectified else 'K'} is all zeros"
    if min(calibration.height, calibration.width) < 1:
        return f"its image size is {calibration.width}x{calibration.height}"
    if not rectified and calibration.D and not any(calibration.D) and is_fisheye(calibration.model):
        return f"D of a {calibration.model} lens is all zeros"
    return None


def add_camera(
    cameras: RecordedCameras, view: str, message: Calibration, poses: np.ndarray, where: str, *, rectified: bool = False
) -> None:
    """Adds a view from its calibration message (`rectified`: P holds K, and no lens is left) and its poses (n or 1, 4, 4) in the base.

    Raises: RejectedInputError: singular_intrinsics, invalid_extrinsics, invalid_distortion.
    """
    K, size = _intrinsics(message, rectified=rectified, where=where)
    pose = camera_pose(view, poses, where=where)
    with rejected_as("invalid_distortion", where):
        lens = None if rectified else distortion_from_ros(message.model, message.D)
    cameras.add(view, K, pose, size, lens)


def _intrinsics(calibration: Calibration, *, rectified: bool, where: str) -> tuple[np.ndarray, tuple[int, int]]:
    """K (3, 3) of the published image, and its size (height, width), after region of interest and binning.

    K and P belong to the whole sensor (ROS REP 104); a region is cut out first, then binned.
    """
    refused = partial(RejectedInputError, "singular_intrinsics", where=where)
    numbers, count = (calibration.P, 12) if rectified else (calibration.K, 9)
    if len(numbers) != count:
        raise refused(f"Calibration has not {count} values of {'P' if rectified else 'K'}", got=len(numbers))
    K = np.array(numbers, np.float64).reshape(3, -1)[:, :3]
    height, width = calibration.height, calibration.width
    transform = ImageTransform.of((height, width))
    x, y, region_width, region_height = calibration.roi
    if region_width and region_height:
        if x + region_width > width or y + region_height > height:
            raise refused(f"Region of interest leaves the image of {width}x{height}", got=calibration.roi)
        transform = transform.crop(y, x, (region_height, region_width))
    (height, width), (across, down) = transform.image_size, (max(each, 1) for each in calibration.binning)
    transform = transform.resize((height // down, width // across))
    return transform.intrinsics(K), transform.image_size
