"""Times of messages, and measurements at their own times brought to instants of a fixed rate.

A message has up to three times: the one it states itself (header), the one when it was published and the one when the
recorder wrote it (log). header <= log, and their smallest difference over a topic is the offset between the clocks plus the
shortest transport time of a message, so topics whose smallest differences disagree were stamped by clocks that disagree (Paxson, On
calibrating measurements of packet transit times, 1998). Its change over time is the drift of the clock.

The error of an instant is its distance in time to the nearest measurement. For what is interpolated, the error in value is
measured too: every inner measurement is predicted from its two neighbours, which lie about twice as far apart as those
between which the grid is filled, so the figure bounds that of the grid from above for smooth motion.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.mcap.file import Stream
from worldline_core.data.mcap.topics_config import McapTopicsSourceConfig

_DRIFT_BINS = 8
# In a shorter recording the jitter of transport hides the drift.
_MIN_DRIFT_SECONDS = 30.0


@dataclass(frozen=True)
class Clock:
    """What a topic's stamps say about its clock; delays are log time minus header time [ms]."""

    least_delay_ms: float
    median_delay_ms: float
    drift_ppm: float | None

    @classmethod
    def of(cls, header_ns: np.ndarray, log_ns: np.ndarray) -> Clock:
        """From the times (n,) of a topic's messages, in any order."""
        delay = (log_ns - header_ns) / 1e6
        return cls(float(delay.min()), float(np.median(delay)), _drift(header_ns, delay))


def _drift(header_ns: np.ndarray, delay_ms: np.ndarray) -> float | None:
    """Slope [ppm] of the least delays over parts of the recording; None for one that is too short to tell."""
    seconds = (header_ns - header_ns.min()) / 1e9
    if len(seconds) < 4 * _DRIFT_BINS or seconds.max() < _MIN_DRIFT_SECONDS:
        return None
    part = np.minimum((seconds / seconds.max() * _DRIFT_BINS).astype(int), _DRIFT_BINS - 1)
    lows = [np.flatnonzero(part == number) for number in range(_DRIFT_BINS)]
    lows = [members[np.argmin(delay_ms[members])] for members in lows if len(members)]
    return float(np.polyfit(seconds[lows], delay_ms[lows], 1)[0] * 1e3) if len(lows) > 2 else None


@dataclass(frozen=True)
class Timing:
    """How the messages of one episode get their times.

    Attributes:
        to_clock_ns: what is subtracted from a log time to get a time on the clock of the headers.
        clocks: what the stamps of each topic say about its clock.
        skew_ms: largest difference between the least delays of two topics.
        headerless: topics that are timed by their log time because their messages state none.
    """

    config: McapTopicsSourceConfig
    to_clock_ns: int
    clocks: Mapping[str, Clock]
    skew_ms: float
    headerless: tuple[str, ...]

    @classmethod
    def of(cls, config: McapTopicsSourceConfig, streams: Mapping[str, Stream], where: object) -> Timing:
        """Look at the stamps of all topics.

        The least delay of the joints' topic, which commands must fit, leads from log time to header time for messages that
        have no header (where joints have none, the least of all topics does).

        Raises: RejectedInputError: clock_skew where header times are to count and disagree by more than allowed, or are
            not set.
        """
        by_header = config.time == "header"
        headed = [stream for stream in streams.values() if stream.headed and stream.kind != "calibration"]
        unset = next((stream for stream in headed if not stream.stamped), None) if by_header else None
        if unset is not None:
            raise RejectedInputError(
                "clock_skew",
                "Messages have no header time",
                where=f"{where}, topic {unset.topic}",
                expected="a header time in every message",
                got=f"0 in {sum(not stamp for stamp in unset.stamps_ns)} of {len(unset.stamps_ns)}",
                next_step="set time: log",
            )
        clocks = {
            stream.topic: Clock.of(
                np.array(stream.stamps_ns, np.int64) + config.offset_ns(stream.topic), np.array(stream.log_ns, np.int64)
            )
            for stream in headed
            if stream.stamped
        }
        least = {topic: clock.least_delay_ms for topic, clock in clocks.items()}
        skew = max(least.values()) - min(least.values()) if least else 0.0
        if by_header and skew > config.max_clock_skew_ms:
            raise RejectedInputError(
                "clock_skew",
                "Clocks of topics disagree",
                where=where,
                expected=f"least delays within {config.max_clock_skew_ms} ms of each other",
                got=", ".join(f"{topic}: {delay:.1f} ms" for topic, delay in sorted(least.items())),
                next_step="declare time_offsets_ms, or set time: log",
                evidence={"skew_ms": skew, "least_delay_ms": least},
            )
        if not by_header:
            return cls(config, 0, clocks, skew, ())
        reference = config.arms[0].state.joints.topic
        shift = round(least.get(reference, min(least.values())) * 1e6) if least else 0
        headerless = (s.topic for s in streams.values() if not s.headed and s.kind != "transforms")
        return cls(config, shift, clocks, skew, tuple(headerless))

    def times_ns(self, stream: Stream) -> np.ndarray:
        """(n,) times of a topic's messages [ns] on the clock that the configuration chooses."""
        if self.config.time == "publish":
            return np.array(stream.publish_ns, np.int64)
        if self.config.time == "log":
            return np.array(stream.log_ns, np.int64)
        if not stream.headed:
            return np.array(stream.log_ns, np.int64) - self.to_clock_ns
        return np.array(stream.stamps_ns, np.int64) + self.config.offset_ns(stream.topic)

    def notes(self) -> dict[str, str | float | int]:
        """What an episode's conventions say about its clocks."""
        drifts = [abs(clock.drift_ppm) for clock in self.clocks.values() if clock.drift_ppm is not None]
        found: dict[str, str | float | int] = {"time": self.config.time, "clock_skew_ms": round(self.skew_ms, 6)}
        if self.clocks:
            found["header_to_log_ms"] = "; ".join(
                f"{topic}: least {clock.least_delay_ms:.3f}, median {clock.median_delay_ms:.3f}"
                for topic, clock in sorted(self.clocks.items())
            )
        if drifts:
            found["clock_drift_ppm"] = round(max(drifts), 3)
        if self.headerless:
            found["timed_by_log"] = ", ".join(sorted(self.headerless))
        return found


@dataclass(frozen=True)
class Arrivals:
    """Messages of a topic in order of time.

    Attributes:
        times_ns: (n,) strictly ascending.
        order: (n,) which message of the topic, counted as they lie in the file, each one is.
        disordered: messages that lie behind a later one in the file.
        repeated: messages left out because another one has the same time.
        lost: messages missing by the rate: the smaller of two estimates, from intervals longer than 1.5 times the median
            and from the whole duration, since jitter makes long intervals too.
        median_step_ns: 0 for a single message.
    """

    times_ns: np.ndarray
    order: np.ndarray
    disordered: int
    repeated: int
    lost: int
    median_step_ns: float


def in_order(times_ns: np.ndarray, where: str, max_disorder_s: float) -> Arrivals:
    """Sort times (n > 0,) as they lie in the file.

    Raises: RejectedInputError (clock_jump) when a message is so much earlier than one before it that the clock was set back.
    """
    latest = np.maximum.accumulate(times_ns)
    back = latest - times_ns
    if back.max() > max_disorder_s * 1e9:
        first = int(np.argmax(back > max_disorder_s * 1e9))
        raise RejectedInputError(
            "clock_jump",
            "Times of a topic jump back",
            where=f"{where}, message {first}",
            expected=f"at most {max_disorder_s} s out of order",
            got=f"{back.max() / 1e9:.3f} s",
            next_step="set time: log, if the recorder's clock is sound, or cut the recording at the jump",
            evidence={"message": first, "jump_s": float(back.max() / 1e9)},
        )
    order = np.argsort(times_ns, kind="stable")
    ordered = times_ns[order]
    new = np.concatenate([[True], np.diff(ordered) > 0])
    unique = ordered[new]
    steps = np.diff(unique)
    median = float(np.median(steps)) if len(steps) else 0.0
    lost = 0
    if median:
        left_out = float(np.sum(np.round(steps[steps > 1.5 * median] / median) - 1))
        expected = (unique[-1] - unique[0]) / median + 1
        lost = round(max(min(left_out, expected - len(unique)), 0))
    return Arrivals(
        times_ns=unique,
        order=order[new],
        disordered=int(np.count_nonzero(back > 0)),
        repeated=int(len(ordered) - len(unique)),
        lost=lost,
        median_step_ns=median,
    )


def check_gaps(
    times_ns: np.ndarray, start_ns: int, stop_ns: int, max_gap_s: float, max_trim_s: float, where: str
) -> None:
    """Raises: RejectedInputError (time_gap) when messages are missing for longer than that, inside or at the ends.

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
    steps = np.diff(inside)
    late = (times_ns[0] - start_ns) / 1e9
    early = (stop_ns - times_ns[-1]) / 1e9
    worst = float(steps.max() / 1e9) if len(steps) else 0.0
    for seconds, allowed, what, at_ns in (
        (worst, max_gap_s, "Messages are missing", int(inside[int(np.argmax(steps))]) if len(steps) else start_ns),
        (late, max_trim_s, "Topic begins too late", start_ns),
        (early, max_trim_s, "Topic ends too early", int(times_ns[-1])),
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


@dataclass(frozen=True)
class TimeError:
    """Distance [ms] between instants and the measurements they were made of."""

    max_ms: float
    mean_ms: float

    @classmethod
    def of(cls, times_ns: np.ndarray, grid_ns: np.ndarray) -> TimeError:
        """Of instants (t,) against the nearest of the measurements (n,), both ascending."""
        distance = np.abs(times_ns[nearest(times_ns, grid_ns)] - grid_ns) / 1e6
        return cls(float(distance.max()), float(distance.mean()))


def nearest(times_ns: np.ndarray, grid_ns: np.ndarray) -> np.ndarray:
    """(t,) index of the measurement nearest to each instant; of two equally near ones the earlier."""
    right = np.clip(np.searchsorted(times_ns, grid_ns), 1, max(len(times_ns) - 1, 1))
    if len(times_ns) == 1:
        return np.zeros(len(grid_ns), dtype=np.int64)
    earlier = grid_ns - times_ns[right - 1] <= times_ns[right] - grid_ns
    return np.where(earlier, right - 1, right)


def hold(times_ns: np.ndarray, values: np.ndarray, grid_ns: np.ndarray) -> np.ndarray:
    """(t, ...) the last measurement at or before each instant (the first, where there is none before)."""
    return values[np.maximum(np.searchsorted(times_ns, grid_ns, side="right") - 1, 0)]


def _bracket(times_ns: np.ndarray, grid_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(t,) index of the measurement before each instant, and how far between it and the next the instant lies, 0..1."""
    before = np.clip(np.searchsorted(times_ns, grid_ns, side="right") - 1, 0, len(times_ns) - 2)
    step = (times_ns[before + 1] - times_ns[before]).astype(np.float64)
    return before, np.clip((grid_ns - times_ns[before]) / step, 0.0, 1.0)


def linear(times_ns: np.ndarray, values: np.ndarray, grid_ns: np.ndarray) -> np.ndarray:
    """(t, d) from values (n, d) at strictly ascending times; constant beyond the ends."""
    if len(times_ns) == 1:
        return np.repeat(values, len(grid_ns), axis=0)
    before, share = _bracket(times_ns, grid_ns)
    return values[before] + share[:, None] * (values[before + 1] - values[before])


def slerp(a: np.ndarray, b: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Unit quaternions (t, 4) on the shorter arc from a to b at 0..1; any order of the components.

    Shoemake, Animating rotation with quaternion curves, 1985.
    """
    cosine = np.sum(a * b, axis=1)
    b = np.where(cosine[:, None] < 0, -b, b)
    angle = np.arccos(np.clip(np.abs(cosine), -1.0, 1.0))
    sine = np.sin(angle)
    near = sine < 1e-9  # sin(k x) / sin(x) -> k
    safe = np.where(near, 1.0, sine)
    weight_a = np.where(near, 1 - share, np.sin((1 - share) * angle) / safe)
    weight_b = np.where(near, share, np.sin(share * angle) / safe)
    mixed = weight_a[:, None] * a + weight_b[:, None] * b
    return mixed / np.linalg.norm(mixed, axis=1, keepdims=True)


def interpolated_poses(times_ns: np.ndarray, values: np.ndarray, grid_ns: np.ndarray) -> np.ndarray:
    """(t, 7) from poses (n, 7) x y z qx qy qz qw: linear in place, slerp in rotation; constant beyond the ends.

    Quaternions must be of unit length.
    """
    if len(times_ns) == 1:
        return np.repeat(values, len(grid_ns), axis=0)
    before, share = _bracket(times_ns, grid_ns)
    place = values[before, :3] + share[:, None] * (values[before + 1, :3] - values[before, :3])
    return np.concatenate([place, slerp(values[before, 3:], values[before + 1, 3:], share)], axis=1)


def largest_prediction_error(times_ns: np.ndarray, values: np.ndarray) -> float:
    """Largest distance, in the unit of values (n, d), between an inner measurement and the line through its neighbours."""
    if len(times_ns) < 3:
        return 0.0
    share = (times_ns[1:-1] - times_ns[:-2]) / (times_ns[2:] - times_ns[:-2])
    predicted = values[:-2] + share[:, None] * (values[2:] - values[:-2])
    return float(np.abs(predicted - values[1:-1]).max())


def instants(start_ns: int, stop_ns: int, fps: float) -> np.ndarray:
    """(t,) start, start + 1 / fps, ... up to stop; an error of a nanosecond from rounding is tolerated. Empty when stop < start."""
    count = int(np.floor((stop_ns - start_ns) * fps / 1e9 + 1e-6)) + 1
    return start_ns + np.round(np.arange(max(count, 0)) * (1e9 / fps)).astype(np.int64)
