"""One MCAP file: its topics, and the messages of some of them in the order in which they lie in it."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

from mcap.reader import McapReader, NonSeekingReader, SeekingReader
from mcap.records import Channel, Schema
from mcap.records import Message as Record
from mcap.summary import Summary

from worldline_core.data.guards.limits import MAX_CHUNK_BYTES, regular_file
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath
from worldline_core.data.mcap.chunks import DAMAGE, check_chunks
from worldline_core.data.mcap.messages import Kind, Message, MessageDecoder

# Two magics and an empty footer: in less than this the reader would look for the footer before the file's beginning.
_SMALLEST_BYTES = 2 * 8 + 29


@dataclass(frozen=True, slots=True)
class Received:
    """A decoded message with what its record says: log and publish time [ns] and sequence number (0: none)."""

    topic: str
    kind: Kind
    log_ns: int
    publish_ns: int
    sequence: int
    message: Message


class McapFile:
    """Read access to one file; nothing is held open between calls.

    Raises: RejectedInputError: missing_file, special_file, too_large, unreadable (damaged, not finished).
    """

    def __init__(self, path: AnyPath) -> None:
        self.path = self.shown = path
        self._decoder = MessageDecoder(self.shown)
        _ = self._summary

    @cached_property
    def _summary(self) -> Summary | None:
        """None where the file is complete but has no summary; then it is read from the beginning."""
        check_chunks(regular_file(self.path, "MCAP file"), self.shown)
        with self._opened(indexed=True) as reader:
            return reader.get_summary()

    @cached_property
    def topics(self) -> dict[str, str]:
        """Topic -> schema name of everything in the file."""
        if self._summary is not None and self._summary.channels:
            schemas = self._summary.schemas
            return {
                channel.topic: schemas[channel.schema_id].name if channel.schema_id in schemas else ""
                for channel in self._summary.channels.values()
            }
        found = {channel.topic: schema.name if schema else "" for schema, channel, _ in self._records(None)}
        return dict(sorted(found.items()))

    @property
    def first_log_ns(self) -> int:
        """Log time of the first message.

        Raises: RejectedInputError (missing_topic) for a file without messages.
        """
        statistics = self._summary.statistics if self._summary is not None else None
        if statistics is not None:
            first = statistics.message_start_time if statistics.message_count else None
        else:
            first = min((record.log_time for _, _, record in self._records(None)), default=None)
        if first is None:
            raise RejectedInputError("missing_topic", "MCAP file holds no messages", where=self.shown)
        return first

    def check_topics(self, wanted: Collection[str]) -> None:
        """Raises: RejectedInputError (missing_topic) naming what is missing and what is there."""
        missing = sorted(set(wanted) - set(self.topics))
        if missing:
            raise RejectedInputError(
                "missing_topic",
                "MCAP file lacks a topic",
                where=self.shown,
                expected=", ".join(missing),
                got=", ".join(f"{topic} ({schema})" for topic, schema in self.topics.items()) or "no topics",
                next_step="correct the topics in curate.sources[]",
                evidence={"missing": missing, "found": sorted(self.topics)},
            )

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Received]:
        """Decoded messages of these topics with start <= log time < stop, in the order of the file.

        Raises: RejectedInputError: unknown_schema, unreadable.
        """
        for schema, channel, record in self._records(topics, start_ns, stop_ns):
            kind = self._decoder.kind(channel, schema)
            message = self._decoder.decode(channel, schema, record.data)
            yield Received(channel.topic, kind, record.log_time, record.publish_time, record.sequence, message)

    def _records(
        self, topics: Collection[str] | None, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[Schema | None, Channel, Record]]:
        indexed = self._summary is not None and bool(self._summary.chunk_indexes and self._summary.channels)
        with self._opened(indexed=indexed) as reader:
            # Not in order of log time: the reader would hold all chunks that overlap in time.
            yield from reader.iter_messages(
                None if topics is None else list(topics),
                log_time_order=False,
                starting_at=start_ns,
                ending_before=stop_ns,
            )

    @contextmanager
    def _opened(self, *, indexed: bool) -> Iterator[McapReader]:
        path = regular_file(self.path, "MCAP file")
        try:
            with path.open("rb") as stream:
                if path.stat().st_size < _SMALLEST_BYTES:
                    raise EOFError(f"{path.stat().st_size} bytes")
                kind = SeekingReader if indexed else NonSeekingReader
                yield kind(stream, validate_crcs=True, record_size_limit=MAX_CHUNK_BYTES)
        except DAMAGE as error:
            raise RejectedInputError(
                "unreadable",
                "MCAP file is damaged or was not finished",
                where=self.shown,
                got=repr(error)[:200],
                next_step="copy the file again, or repair it with `mcap recover`",
            ) from error
