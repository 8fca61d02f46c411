"""Times of a topic's messages: which clock they are of, in which order they came, and what is missing.

A message has up to three times: the one it states itself (header), the one when it was published and the one when the
recorder wrote it (log). header <= log, and their least difference over a topic is the offset between the clocks plus the
shortest way of a message, so topics whose least differences disagree were stamped by clocks that disagree (Paxson, On
calibrating measurements of packet transit times, 1998). Its change over time is the drift of the clock.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from worldline_core.data.guards.rejection import RejectedInputError

TimeSource = Literal["header", "log", "publish"]
_DRIFT_BINS = 8
# A shorter recording shows a way's jitter, not a drift.
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
class Arrivals:
    """Messages of a topic in order of time.

    Attributes:
        times_ns: (n,) strictly ascending.
        order: (n,) which message of the topic, counted as they lie in the file, each one is.
        disordered: messages that lie behind a later one in the file.
        repeated: messages left out because another one has the same time.
        lost: messages missing by the rate: the lesser of what intervals beyond 1.5 times the median leave out and what the
            whole time would have held, since jitter makes long intervals too.
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
