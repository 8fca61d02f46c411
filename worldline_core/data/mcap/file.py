"""One MCAP file: checked before it is unpacked, its topics, and the messages of chosen topics in the order of the file.

The library trusts a chunk's header: it allocates what a zstd frame claims, and unpacks an lz4 frame to its end, up to 255
bytes per byte. The size of every chunk is therefore checked first. Records (https://mcap.dev/spec): an opcode, a length
of 8 bytes, then the record.
"""

from __future__ import annotations

import struct
import zlib
from collections import deque
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame
import zstandard
from mcap.exceptions import McapError
from mcap.reader import McapReader, NonSeekingReader, SeekingReader
from mcap.records import Channel, Footer, Schema
from mcap.records import Message as Record
from mcap.stream_reader import StreamReader
from mcap.summary import Summary

from worldline_core.data.guards.rejection import MAX_CHUNK_BYTES, RejectedInputError, too_large
from worldline_core.data.guards.source_paths import AnyPath, regular_file
from worldline_core.data.mcap.messages import IMAGE_KINDS, Kind, MessageDecoder

# What the library raises for a damaged file: its own errors, and those of the decompressors and parsers below it.
_DAMAGE = (
    McapError, zstandard.ZstdError, EOFError, OSError, ValueError, RuntimeError, LookupError, struct.error, OverflowError, MemoryError,
)  # fmt: skip
_MAGIC = b"\x89MCAP0\r\n"
_CHUNK = 0x06
_DATA_END = 0x0F
_FOOTER_BYTES = 9 + 20
_LZ4_RATIO = 255
# Two magics and an empty footer: in less than this the reader would look for the footer before the file's beginning.
_SMALLEST_BYTES = 2 * len(_MAGIC) + _FOOTER_BYTES


@dataclass
class Stream:
    """Messages of one topic in the order of the file.

    Attributes:
        stamps_ns: times in the messages' headers; None where the schema has none.
        log_ns: times at which the recorder wrote them.
        values: decoded contents; empty for images.
        key_frames: of a video, whether decoding can begin with a message.
        frame: coordinate frame named by the first image.
    """

    topic: str
    kind: Kind
    stamps_ns: list[int | None] = field(default_factory=list)
    log_ns: list[int] = field(default_factory=list)
    values: list[Any] = field(default_factory=list)
    key_frames: list[bool] = field(default_factory=list)
    frame: str = ""

    @property
    def has_header(self) -> bool:
        """Whether the schema has a header time."""
        return bool(self.stamps_ns) and self.stamps_ns[0] is not None

    @property
    def has_header_times(self) -> bool:
        """Whether the times are set: a simulated clock is 0 once, a driver that sets none writes 0 always."""
        return None not in self.stamps_ns and self.stamps_ns.count(0) <= 1


class McapFile:
    """Read access to one file, which is open only while it is read.

    Raises: RejectedInputError: missing_file, special_file, too_large, unreadable (damaged, not finished).
    """

    def __init__(self, path: AnyPath) -> None:
        self.path = path
        self._decoder = MessageDecoder(path)
        _ = self._summary

    @cached_property
    def _summary(self) -> Summary | None:
        """None for a complete file without a summary, which is then read from its beginning."""
        chunks = check_chunks(regular_file(self.path, "MCAP file"), self.path)
        with self._reader(indexed=True) as reader:
            summary = reader.get_summary()
            indexed = [] if summary is None else [index.chunk_start_offset for index in summary.chunk_indexes]
            if len(set(indexed)) < len(indexed) or not set(indexed) <= set(chunks):
                raise ValueError("an index that leads to something else than the chunks, or to one twice")
            return summary

    def check_sums(self) -> None:
        """Compares the whole file with the checksums of its data and its summary (0: none).

        Raises: RejectedInputError (unreadable) where a byte differs.
        """
        path = regular_file(self.path, "MCAP file")
        with _damage_as_rejection(self.path), path.open("rb") as stream:
            reader = StreamReader(stream, emit_chunks=True, validate_crcs=True, record_size_limit=MAX_CHUNK_BYTES)
            (footer,) = deque(reader.records, maxlen=1)
            if not isinstance(footer, Footer):
                raise ValueError("no footer at the end")
            end = path.stat().st_size - len(_MAGIC)
            stream.seek(footer.summary_start or end - _FOOTER_BYTES)
            if footer.summary_crc not in (0, zlib.crc32(stream.read(end - 4 - stream.tell()))):
                raise ValueError("a summary that does not fit its checksum")

    @cached_property
    def metadata(self) -> dict[str, dict[str, str]]:
        """Metadata records by name; the last one where a name is repeated."""
        with self._reader() as reader:
            return {record.name: record.metadata for record in reader.iter_metadata()}

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
        if statistics is None:
            first = min((record.log_time for _, _, record in self._records(None)), default=None)
        else:
            first = statistics.message_start_time if statistics.message_count else None
        if first is None:
            raise RejectedInputError("missing_topic", "MCAP file holds no messages", where=self.path)
        return first

    def check_topics(self, wanted: Collection[str]) -> None:
        """Raises: RejectedInputError (missing_topic) listing the missing topics and those in the file."""
        missing = sorted(set(wanted) - set(self.topics))
        if missing:
            raise RejectedInputError(
                "missing_topic",
                "MCAP file lacks a topic",
                where=self.path,
                expected=", ".join(missing),
                got=", ".join(f"{topic} ({schema})" for topic, schema in self.topics.items()) or "no topics",
                next_step="correct the topics in curate.sources[]",
            )

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[str, Kind, int, int | None, Any]]:
        """(topic, kind, log time, header time or None, content) of these topics' messages with start <= log time < stop.

        Raises: RejectedInputError: unknown_schema, unreadable.
        """
        for schema, channel, record in self._records(topics, start_ns, stop_ns):
            kind, stamp_ns, value = self._decoder.decode(channel, schema, record.data)
            yield channel.topic, kind, record.log_time, stamp_ns, value

    def streams(
        self, roles: Mapping[str, tuple[Kind, ...]], start_ns: int | None = None, stop_ns: int | None = None
    ) -> dict[str, Stream]:
        """Messages with start <= log time < stop by topic, for the topics of `roles` (topic -> accepted kinds).

        Raises: RejectedInputError: unknown_schema for a topic with messages of another kind, or of several; unreadable.
        """
        streams: dict[str, Stream] = {}
        for topic, kind, log_ns, stamp_ns, value in self.messages(roles, start_ns, stop_ns):
            expected = (streams[topic].kind,) if topic in streams else roles[topic]
            if kind not in expected:
                raise RejectedInputError(
                    "unknown_schema",
                    "Topic has messages of another kind than its role or its first message",
                    where=f"{self.path}, topic {topic}",
                    expected=" or ".join(expected),
                    got=f"{kind} ({self.topics.get(topic, '')})",
                    next_step="correct the topics in curate.sources[]",
                )
            stream = streams.setdefault(topic, Stream(topic, kind))
            stream.log_ns.append(log_ns)
            stream.stamps_ns.append(stamp_ns)
            if kind not in IMAGE_KINDS:
                stream.values.append(value)
                continue
            stream.frame = stream.frame or value.frame
            if kind == "video":
                stream.key_frames.append(value.is_key_frame)
        return streams

    def _records(
        self, topics: Collection[str] | None, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[Schema | None, Channel, Record]]:
        with self._reader() as reader:
            # Not in order of log time: the reader would hold all chunks that overlap in time.
            yield from reader.iter_messages(
                None if topics is None else list(topics),
                log_time_order=False,
                starting_at=start_ns,
                ending_before=stop_ns,
            )

    @contextmanager
    def _reader(self, *, indexed: bool | None = None) -> Iterator[McapReader]:
        """A reader of the open file, by its index where the summary has one."""
        if indexed is None:
            indexed = self._summary is not None and bool(self._summary.chunk_indexes and self._summary.channels)
        path = regular_file(self.path, "MCAP file")
        with _damage_as_rejection(self.path), path.open("rb") as stream:
            if path.stat().st_size < _SMALLEST_BYTES:
                raise EOFError(f"{path.stat().st_size} bytes")
            kind = SeekingReader if indexed else NonSeekingReader
            yield kind(stream, validate_crcs=True, record_size_limit=MAX_CHUNK_BYTES)


@contextmanager
def _damage_as_rejection(where: object) -> Iterator[None]:
    try:
        yield
    except _DAMAGE as error:
        raise RejectedInputError(
            "unreadable",
            "MCAP file is damaged or was not finished",
            where=where,
            expected="a complete MCAP file",
            got=repr(error)[:200],
            next_step="copy the file again, or repair it with `mcap recover`",
        ) from error


def check_chunks(path: Path, where: object) -> list[int]:
    """Offsets of the chunks of the data section, none of which unpacks to more than MAX_CHUNK_BYTES.

    Raises: RejectedInputError: too_large; unreadable for what is no MCAP file, breaks off, or has chunks after its data.
    """
    size, chunks, ended = path.stat().st_size, list[int](), False
    with _damage_as_rejection(where), path.open("rb") as stream:
        if stream.read(len(_MAGIC)) != _MAGIC:
            raise ValueError("another beginning than that of an MCAP file")
        position = len(_MAGIC)
        while position < size - len(_MAGIC):
            stream.seek(position)
            opcode, length = struct.unpack("<BQ", stream.read(9))
            if position + 9 + length > size:
                raise EOFError(f"a record of {length} bytes where {size - position - 9} are left")
            if opcode == _CHUNK:
                if ended:
                    raise ValueError("a chunk behind the end of the data")
                unpacked = _unpacked_bytes(stream, length)
                if unpacked > MAX_CHUNK_BYTES:
                    raise too_large(
                        "MCAP chunk is too large", where=where, limit=MAX_CHUNK_BYTES, got=unpacked, unit="bytes"
                    )
                chunks.append(position)
            ended = ended or opcode == _DATA_END
            position += 9 + length
    return chunks


def _unpacked_bytes(stream: BinaryIO, length: int) -> int:
    """Size that the chunk record at the stream's position unpacks to: the larger of its header's and its frame's claim.

    Raises: ValueError, or what the decompressors raise, for a damaged chunk.
    """
    *_, declared, _, name_length = struct.unpack("<QQQII", stream.read(32))
    if name_length > 32:
        raise ValueError(f"a name of a compression of {name_length} bytes")
    compression = stream.read(name_length)
    packed_length = struct.unpack("<Q", stream.read(8))[0]
    if packed_length > length:
        raise ValueError(f"a chunk of {packed_length} bytes in a record of {length}")
    if compression == b"zstd":
        return max(declared, zstandard.frame_content_size(stream.read(min(packed_length, 32))))  # -1: unknown
    if compression == b"lz4" and packed_length * _LZ4_RATIO > MAX_CHUNK_BYTES >= declared:
        # An lz4 frame may unpack to more than it declares; only a frame of this length can unpack to too much.
        frame = lz4.frame.LZ4FrameDecompressor().decompress(stream.read(packed_length), max_length=MAX_CHUNK_BYTES + 1)
        return max(declared, len(frame))
    return declared
