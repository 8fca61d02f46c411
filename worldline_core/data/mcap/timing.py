"""Times of messages, and measurements brought from their own times to instants of a fixed rate.

A message has up to two times: that of its header, and that at which the recorder wrote it (log). header <= log, and their
smallest difference over a topic is the offset between the clocks plus the shortest transport time, so topics whose
smallest differences disagree were stamped by clocks that disagree (Paxson, On calibrating measurements of packet transit
times, 1998).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.mcap.file import Stream
from worldline_core.data.mcap.topics_config import McapTopicsSourceConfig
from worldline_core.geometry.transforms import pose_from_rotation

MAX_DISORDER_S = 1.0
"""A message that comes later than this behind a younger one was stamped by a clock that was set back."""


@dataclass(frozen=True)
class Clocks:
    """Clocks of one episode's topics.

    Attributes:
        header_to_log_ns: subtracted from a log time to get a time on the clock of the headers.
        skew_ms: largest difference between the least delays of two topics.
        without_header: topics timed by their log time.
    """

    config: McapTopicsSourceConfig
    header_to_log_ns: int
    skew_ms: float
    without_header: tuple[str, ...]

    @classmethod
    def from_streams(cls, config: McapTopicsSourceConfig, streams: Mapping[str, Stream], where: object) -> Clocks:
        """Compares the clocks of all topics by their least delays (log time minus header time).

        The least delay of the joints' topic, which commands must fit, leads from log to header time for messages without
        a header; where the joints have none, the least of all topics does.

        Raises: RejectedInputError (clock_skew) where header times count, and disagree by more than allowed or are not set.
        """
        by_header = config.time == "header"
        headed = [stream for stream in streams.values() if stream.has_header and stream.kind != "calibration"]
        unset = next((stream for stream in headed if not stream.has_header_times), None) if by_header else None
        if unset is not None:
            raise RejectedInputError(
                "clock_skew",
                "Messages have no header time",
                where=f"{where}, topic {unset.topic}",
                expected="a header time in every message",
                got=f"0 in {sum(not stamp for stamp in unset.stamps_ns)} of {len(unset.stamps_ns)}",
                next_step="set time: log",
            )
        least_ms: dict[str, float] = {}
        for stream in headed:
            if stream.has_header_times:
                delay = np.array(stream.log_ns, np.int64) - np.array(stream.stamps_ns, np.int64)
                least_ms[stream.topic] = float(delay.min() - config.offset_ns(stream.topic)) / 1e6
        skew_ms = max(least_ms.values()) - min(least_ms.values()) if least_ms else 0.0
        if by_header and skew_ms > config.max_clock_skew_ms:
            raise RejectedInputError(
                "clock_skew",
                "Clocks of topics disagree",
                where=where,
                expected=f"least delays within {config.max_clock_skew_ms} ms of each other",
                got=", ".join(f"{topic}: {delay:.1f} ms" for topic, delay in sorted(least_ms.items())),
                next_step="declare time_offsets_ms, or set time: log",
                evidence={"skew_ms": skew_ms, "least_delay_ms": least_ms},
            )
        if not by_header:
            return cls(config, 0, skew_ms, ())
        reference = config.arms[0].state.joints.topic
        shift = round(least_ms.get(reference, min(least_ms.values())) * 1e6) if least_ms else 0
        without = (s.topic for s in streams.values() if not s.has_header and s.kind != "transforms")
        return cls(config, shift, skew_ms, tuple(sorted(without)))

    def times_ns(self, stream: Stream) -> np.ndarray:
        """(n,) times of a topic's messages [ns] on the configured clock."""
        if self.config.time == "log":
            return np.array(stream.log_ns, np.int64)
        if not stream.has_header:
            return np.array(stream.log_ns, np.int64) - self.header_to_log_ns
        return np.array(stream.stamps_ns, np.int64) + self.config.offset_ns(stream.topic)


@dataclass(frozen=True)
class Arrivals:
    """Messages of a topic in order of time.

    Attributes:
        times_ns: (n,) strictly ascending; of messages with the same time the first is kept.
        order: (n,) index of each message in the order of the file.
        lost: messages missing by the rate: the smaller of two estimates, from intervals longer than 1.5 times the median
            and from the whole duration, since jitter makes long intervals too.
        median_step_ns: 0 for a single message.
    """

    times_ns: np.ndarray
    order: np.ndarray
    lost: int
    median_step_ns: float


def in_order(times_ns: np.ndarray, where: str) -> Arrivals:
    """Sorts times (n > 0,) given in the order of the file.

    Raises: RejectedInputError (clock_jump) for a message more than MAX_DISORDER_S earlier than one before it.
    """
    back_s = (np.maximum.accumulate(times_ns) - times_ns) / 1e9
    if back_s.max() > MAX_DISORDER_S:
        first = int(np.argmax(back_s > MAX_DISORDER_S))
        raise RejectedInputError(
            "clock_jump",
            "Times of a topic jump back",
            where=f"{where}, message {first}",
            expected=f"at most {MAX_DISORDER_S} s out of order",
            got=f"{back_s.max():.3f} s",
            next_step="set time: log, if the recorder's clock is sound, or cut the recording at the jump",
            evidence={"message": first, "jump_s": float(back_s.max())},
        )
    times, order = np.unique(times_ns, return_index=True)
    steps = np.diff(times)
    median = float(np.median(steps)) if len(steps) else 0.0
    lost = 0
    if median:
        left_out = float(np.sum(np.round(steps[steps > 1.5 * median] / median) - 1))
        expected = (times[-1] - times[0]) / median + 1
        lost = round(max(min(left_out, expected - len(times)), 0))
    return Arrivals(times, order, lost, median)


def check_gaps(
    times_ns: np.ndarray, start_ns: int, stop_ns: int, *, max_gap_s: float, max_trim_s: float, where: str
) -> None:
    """Raises: RejectedInputError (time_gap) when messages are missing for too long, inside or at the ends.

    Args:
        times_ns: (n > 0,) ascending.
        start_ns, stop_ns: what the topic should cover.
        max_gap_s: between two messages.
        max_trim_s: before the first and after the last.
    """
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
            raise RejectedInputError(
                "time_gap",
                what,
                where=where,
                expected=f"at most {allowed:.3f} s",
                got=f"{seconds:.3f} s from {(at_ns - start_ns) / 1e9:.3f} s on",
                evidence={"gap_s": float(seconds), "allowed_s": float(allowed), "at_s": (at_ns - start_ns) / 1e9},
            )


def instants(start_ns: int, stop_ns: int, fps: float) -> np.ndarray:
    """(t,) start, start + 1 / fps, ... up to stop, within a nanosecond of rounding. Empty when stop < start."""
    count = int(np.floor((stop_ns - start_ns) * fps / 1e9 + 1e-6)) + 1
    return start_ns + np.round(np.arange(max(count, 0)) * (1e9 / fps)).astype(np.int64)


def nearest(times_ns: np.ndarray, grid_ns: np.ndarray) -> np.ndarray:
    """(t,) index of the measurement nearest to each instant; of two equally near ones the earlier."""
    if len(times_ns) == 1:
        return np.zeros(len(grid_ns), dtype=np.int64)
    right = np.clip(np.searchsorted(times_ns, grid_ns), 1, len(times_ns) - 1)
    earlier = grid_ns - times_ns[right - 1] <= times_ns[right] - grid_ns
    return np.where(earlier, right - 1, right)


def largest_distance_ms(times_ns: np.ndarray, grid_ns: np.ndarray) -> float:
    """Largest distance of an instant from its nearest measurement [ms]."""
    return float(np.abs(times_ns[nearest(times_ns, grid_ns)] - grid_ns).max() / 1e6)


def resampled(times_ns: np.ndarray, values: np.ndarray, grid_ns: np.ndarray, *, hold: bool = False) -> np.ndarray:
    """(t, d) of values (n, d) at strictly ascending times; linear or, with `hold`, the last one up to each instant.

    Constant beyond the ends.
    """
    if hold:
        return values[np.maximum(np.searchsorted(times_ns, grid_ns, side="right") - 1, 0)]
    times, grid = times_ns - times_ns[0], grid_ns - times_ns[0]
    return np.stack([np.interp(grid, times, column) for column in values.T], axis=1)


def resampled_poses(times_ns: np.ndarray, values: np.ndarray, grid_ns: np.ndarray) -> np.ndarray:
    """(t, 4, 4) of poses (n, 7) x y z qx qy qz qw: linear in place, slerp in rotation; constant beyond the ends."""
    rotations = Rotation.from_quat(values[:, 3:])
    if len(times_ns) == 1:
        turned = rotations[np.zeros(len(grid_ns), np.int64)]
    else:
        inside = np.clip(grid_ns, times_ns[0], times_ns[-1]) - times_ns[0]
        turned = Slerp(times_ns - times_ns[0], rotations)(inside)
    return pose_from_rotation(resampled(times_ns, values[:, :3], grid_ns), turned.as_matrix())
