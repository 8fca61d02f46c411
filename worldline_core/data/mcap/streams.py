"""The messages of one episode by topic: times, and the values of everything but images, which stay in the file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.mcap.file import McapFile, Received
from worldline_core.data.mcap.images import is_key_frame
from worldline_core.data.mcap.messages import IMAGE_KINDS, Kind
from worldline_core.data.mcap.resampling import Clock, TimeSource

READING_MARGIN_NS = 10**9
"""Messages from so long before and after an episode are read too: they may be of its time, and instants lie between two."""


@dataclass
class Stream:
    """Messages of one topic in the order of the file.

    Attributes:
        stamps_ns: times that the messages state; None where the schema has none.
        values: what they say; empty for images.
        key_frames: of a video, whether decoding can begin with a message.
        frame: the frame that the first message names, of images.
    """

    topic: str
    kind: Kind
    stamps_ns: list[int | None] = field(default_factory=list)
    log_ns: list[int] = field(default_factory=list)
    publish_ns: list[int] = field(default_factory=list)
    values: list[Any] = field(default_factory=list)
    key_frames: list[bool] = field(default_factory=list)
    frame: str = ""

    def add(self, received: Received) -> None:
        if received.kind != self.kind:
            raise RejectedInputError(
                "unknown_schema",
                "Messages of a topic are of several schemas",
                where=f"topic {self.topic}",
                expected=self.kind,
                got=received.kind,
            )
        message = received.message
        self.stamps_ns.append(message.stamp_ns)
        self.log_ns.append(received.log_ns)
        self.publish_ns.append(received.publish_ns)
        if self.kind in IMAGE_KINDS:
            self.frame = self.frame or message.value.frame
            if self.kind == "video":
                self.key_frames.append(is_key_frame(message.value))
        else:
            self.values.append(message.value)

    @property
    def headed(self) -> bool:
        """Whether the messages state their own time."""
        return bool(self.stamps_ns) and self.stamps_ns[0] is not None

    @property
    def stamped(self) -> bool:
        """Whether these times are set: a simulated clock begins at 0 once, a driver that sets none writes it always."""
        return None not in self.stamps_ns and self.stamps_ns.count(0) <= 1


def read_streams(
    file: McapFile, roles: Mapping[str, tuple[Kind, ...]], start_ns: int | None, stop_ns: int | None
) -> dict[str, Stream]:
    """All messages of the topics of `roles` (topic -> kinds that it may be of) around an episode, by topic.

    Args:
        start_ns, stop_ns: log times of the episode; None: the whole file.

    Raises: RejectedInputError: unknown_schema for a topic that is of none of the kinds its role needs; unreadable.
    """
    streams: dict[str, Stream] = {}
    first = None if start_ns is None else max(start_ns - READING_MARGIN_NS, 0)
    last = None if stop_ns is None else stop_ns + READING_MARGIN_NS
    for received in file.messages(roles, first, last):
        if received.topic not in streams:
            if received.kind not in roles[received.topic]:
                raise RejectedInputError(
                    "unknown_schema",
                    "Topic has messages of another kind than its role needs",
                    where=f"{file.shown}, topic {received.topic}",
                    expected=" or ".join(roles[received.topic]),
                    got=f"{received.kind} ({file.topics.get(received.topic, '')})",
                    next_step="correct the topics in curate.sources[]",
                    evidence={"topic": received.topic, "kind": received.kind},
                )
            streams[received.topic] = Stream(received.topic, received.kind)
        streams[received.topic].add(received)
    return streams


@dataclass(frozen=True)
class Timing:
    """How messages of one episode are put in time.

    Attributes:
        to_clock_ns: what is taken from a log time to get the time on the clock that counts.
        clocks: what the stamps of each topic say about its clock.
        skew_ms: largest difference between the least delays of two topics.
        headerless: topics that are timed by their log time because their messages state none.
    """

    source: TimeSource
    offsets_ms: Mapping[str, float]
    to_clock_ns: int
    clocks: Mapping[str, Clock]
    skew_ms: float
    headerless: tuple[str, ...]

    @classmethod
    def of(
        cls,
        streams: Mapping[str, Stream],
        source: TimeSource,
        offsets_ms: Mapping[str, float],
        max_skew_ms: float,
        reference: str,
        where: object,
    ) -> Timing:
        """Look at the stamps of all topics.

        Args:
            reference: topic whose least delay leads from log time to header time, for messages that have no header: that of
                the joints, which commands must fit (where it has headers, else the topic with the least delay).

        Raises: RejectedInputError: clock_skew where header times are to count and disagree by more than allowed, or are
            not set.
        """
        headed = [stream for stream in streams.values() if stream.headed and stream.kind != "calibration"]
        headerless = tuple(
            stream.topic for stream in streams.values() if not stream.headed and stream.kind != "transforms"
        )
        if source == "header":
            for stream in headed:
                _check_stamped(stream, where)
        clocks = {
            stream.topic: Clock.of(
                np.array(stream.stamps_ns, np.int64) + round(offsets_ms.get(stream.topic, 0.0) * 1e6),
                np.array(stream.log_ns, np.int64),
            )
            for stream in headed
            if stream.stamped
        }
        least = {topic: clock.least_delay_ms for topic, clock in clocks.items()}
        skew = max(least.values()) - min(least.values()) if least else 0.0
        if source == "header" and skew > max_skew_ms:
            raise RejectedInputError(
                "clock_skew",
                "Clocks of topics disagree",
                where=where,
                expected=f"least delays within {max_skew_ms} ms of each other",
                got=", ".join(f"{topic}: {delay:.1f} ms" for topic, delay in sorted(least.items())),
                next_step="declare time_offsets_ms, or set time: log",
                evidence={"skew_ms": skew, "least_delay_ms": least},
            )
        shift = 0
        if least and source == "header":
            shift = round(least.get(reference, min(least.values())) * 1e6)
        return cls(source, offsets_ms, shift, clocks, skew, headerless if source == "header" else ())

    def times_ns(self, stream: Stream) -> np.ndarray:
        """(n,) when the messages of a topic are of, on the clock that counts."""
        if self.source == "publish":
            return np.array(stream.publish_ns, np.int64)
        if self.source == "log":
            return np.array(stream.log_ns, np.int64)
        if not stream.headed:
            return np.array(stream.log_ns, np.int64) - self.to_clock_ns
        return np.array(stream.stamps_ns, np.int64) + round(self.offsets_ms.get(stream.topic, 0.0) * 1e6)

    def notes(self) -> dict[str, str | float | int]:
        """What an episode's conventions say about its clocks."""
        drifts = [abs(clock.drift_ppm) for clock in self.clocks.values() if clock.drift_ppm is not None]
        found: dict[str, str | float | int] = {"time": self.source, "clock_skew_ms": round(self.skew_ms, 6)}
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


def _check_stamped(stream: Stream, where: object) -> None:
    if not stream.stamped:
        missing = sum(1 for stamp in stream.stamps_ns if not stamp)
        raise RejectedInputError(
            "clock_skew",
            "Messages have no header time",
            where=f"{where}, topic {stream.topic}",
            expected="a header time in every message",
            got=f"0 in {missing} of {len(stream.stamps_ns)}",
            next_step="set time: log",
            evidence={"topic": stream.topic, "without_time": missing},
        )
