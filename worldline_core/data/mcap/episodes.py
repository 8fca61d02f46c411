"""Which episodes lie in an MCAP file, and where."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase

from worldline_core.data.episodes.episode import Outcome
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.mcap.file import McapFile
from worldline_core.data.mcap.topics_config import Markers, TimeRanges, WholeFiles


@dataclass(frozen=True)
class Segment:
    """An episode inside of a file.

    Attributes:
        name: what tells it from others of the file; empty for a whole file.
        start_ns, stop_ns: log times; None: from the beginning, to the end.
        relative: the times are counted from the file's first message.
        fault: why it cannot be read, where that is known already.
    """

    name: str = ""
    start_ns: int | None = None
    stop_ns: int | None = None
    relative: bool = False
    instruction: str | None = None
    outcome: Outcome | None = None
    fault: RejectedInputError | None = None

    def log_times(self, file: McapFile) -> tuple[int | None, int | None]:
        """First and last log time [ns]."""
        if not self.relative:
            return self.start_ns, self.stop_ns
        first = file.first_log_ns
        return first + (self.start_ns or 0), None if self.stop_ns is None else first + self.stop_ns


def segments(rule: WholeFiles | TimeRanges | Markers, file: McapFile | None, relative_path: str) -> Iterator[Segment]:
    """Episodes of one file.

    Args:
        file: opened; only markers look into it.

    Raises: RejectedInputError: missing_topic, unknown_schema, unreadable while looking for markers.
    """
    if isinstance(rule, WholeFiles):
        yield Segment()
    elif isinstance(rule, TimeRanges):
        for part in rule.ranges:
            if fnmatchcase(relative_path, part.file):
                yield Segment(
                    part.name,
                    round(part.start_s * 1e9),
                    round(part.stop_s * 1e9),
                    relative=True,
                    instruction=part.instruction,
                )
    elif file is not None:
        yield from _between_markers(rule, file)


def _between_markers(rule: Markers, file: McapFile) -> Iterator[Segment]:
    """Start to stop; a start without a stop, or the reverse, is an episode that cannot be read."""
    file.check_topics([rule.topic])
    found = [message for message in file.messages([rule.topic]) if message.kind == "marker"]
    found.sort(key=lambda message: message.log_ns)
    begun: tuple[int, re.Match[str]] | None = None
    count = 0
    for message in found:
        text = str(message.message.value)
        start, stop = re.fullmatch(rule.start, text), re.fullmatch(rule.stop, text)
        if start is None and stop is None:
            continue
        if (start is not None) == (begun is not None):
            yield _unpaired(rule, file, count, text)
            count += 1
            begun = None
        if start is not None:
            begun = message.log_ns, start
        elif stop is not None and begun is not None:
            instruction = begun[1].groupdict().get("instruction")
            outcome = stop.groupdict().get("outcome")
            known = outcome if outcome in ("success", "failure") else None
            yield Segment(f"{count:04d}", begun[0], message.log_ns, instruction=instruction, outcome=known)
            count, begun = count + 1, None
    if begun is not None:
        yield _unpaired(rule, file, count, "the end of the file")


def _unpaired(rule: Markers, file: McapFile, count: int, text: str) -> Segment:
    fault = RejectedInputError(
        "missing_marker",
        "Markers of an episode are not a start and a stop",
        where=f"{file.shown}, topic {rule.topic}, episode {count}",
        expected=f"{rule.start!r}, then {rule.stop!r}",
        got=repr(text),
        evidence={"episode": count, "marker": text},
    )
    return Segment(f"{count:04d}", fault=fault)
