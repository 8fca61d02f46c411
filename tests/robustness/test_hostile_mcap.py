"""MCAP files whose chunks and records claim more than they hold."""

from __future__ import annotations

import json
import struct
import tracemalloc
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from mcap.records import Channel, Schema
from mcap_protobuf.schema import build_file_descriptor_set

from tests.robustness.conftest import rejected  # pyright: ignore[reportMissingImports]
from tools.corrupted import mcap
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.mcap import file as mcap_file
from worldline_core.data.mcap.exported import exported_episode_id, read_exported_episode
from worldline_core.data.mcap.file import McapFile, check_chunks
from worldline_core.data.mcap.messages import MessageDecoder

MAGIC = b"\x89MCAP0\r\n"


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def chunk(packed: bytes, unpacked: int, compression: bytes = b"zstd") -> bytes:
    head = struct.pack("<QQQI", 0, 0, unpacked, 0) + struct.pack("<I", len(compression)) + compression
    return record(0x06, head + struct.pack("<Q", len(packed)) + packed)


def checked(path: Path, compression: bytes, packed: bytes, declared: int) -> None:
    """Look at a file of one chunk, written by hand."""
    path.write_bytes(MAGIC + chunk(packed, declared, compression) + record(0x0F, bytes(4)) + MAGIC)
    check_chunks(path, "a")


@pytest.fixture
def sound(tmp_path: Path) -> tuple[Path, bytes]:
    """A file of our own, and its bytes."""
    mcap.write(tmp_path, 1, 0, np.random.default_rng(0))
    path = next(tmp_path.glob("*.mcap"))
    return path, path.read_bytes()


def refused(path: Path, content: bytes) -> bool:
    path.write_bytes(content)
    try:
        loaded = read_exported_episode(McapFile(path))
        for view in loaded.views:
            loaded.frames(view)
    except RejectedInputError:
        return True
    return False


def test_chunks_are_unpacked_no_further_than_allowed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.mcap"
    with rejected("too_large", "chunk is too large"):
        checked(path, b"zstd", zstandard.compress(b"x" * 100), 10**12)
    # The frame's own size is what the decompressor allocates, whatever the chunk declares.
    header = b"\x28\xb5\x2f\xfd" + bytes([0b1110_0000]) + struct.pack("<Q", 10**12)  # single segment, 8 bytes of size
    assert zstandard.frame_content_size(header) == 10**12
    with rejected("too_large", "chunk is too large"):
        checked(path, b"zstd", header + zstandard.compress(b"x" * 300)[6:], 300)
    monkeypatch.setattr(mcap_file, "MAX_CHUNK_BYTES", 1 << 20)
    bomb = lz4.frame.compress(b"\0" * (8 << 20))
    assert len(bomb) < 100_000
    with rejected("too_large", "chunk is too large"):
        checked(path, b"lz4", bomb, 1000)
    checked(path, b"lz4", lz4.frame.compress(b"\0" * 1000), 1000)


@pytest.mark.parametrize("content", [b"", b"x" * 100, MAGIC, MAGIC + struct.pack("<BQ", 0x06, 2**63) + b"x" * 50])
def test_what_is_no_mcap_file_is_unreadable(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.mcap").write_bytes(content)
    for read in (exported_episode_id, read_exported_episode):
        with rejected("unreadable", "MCAP"):
            read(McapFile(tmp_path / "a.mcap"))


def test_lengths_of_records_that_no_number_can_hold(sound: tuple[Path, bytes]) -> None:
    """Every length in the file in turn: found by blind damage (OverflowError in the library)."""
    path, content = sound
    position, places = 8, []
    while position + 9 <= len(content) - 8:
        places.append(position + 1)
        position += 9 + struct.unpack_from("<Q", content, position + 1)[0]
    assert len(places) > 8
    lies = [content[:p] + struct.pack("<Q", n) + content[p + 8 :] for p in places for n in (2**63, 2**64 - 1, 2**40, 0)]
    assert sum(refused(path, lie) for lie in lies) > len(places)


def indexed_file(path: Path, data: bytes, chunks: list[tuple[int, int]]) -> Path:
    """A file whose summary says that chunks (offset, length) are there; its one channel makes readers trust it."""
    summary = record(0x04, struct.pack("<HH", 0, 0) + struct.pack("<I", 2) + b"/a" + struct.pack("<I", 0) * 2)
    for offset, length in chunks:
        index = struct.pack("<QQQQ", 0, 1, offset, length) + struct.pack("<IQ", 0, 0)
        summary += record(0x08, index + struct.pack("<I", 4) + b"zstd" + struct.pack("<QQ", length - 49, 1 << 20))
    header = record(0x01, struct.pack("<II", 0, 0))
    start = len(MAGIC) + len(header) + len(data) + 13
    footer = record(0x02, struct.pack("<QQI", start, 0, 0))
    path.write_bytes(MAGIC + header + data + record(0x0F, bytes(4)) + summary + footer + MAGIC)
    return path


def test_an_index_that_leads_into_an_attachment_or_twice_to_a_chunk(tmp_path: Path) -> None:
    """The size of a chunk in there was never looked at."""
    small = chunk(zstandard.compress(b"\0" * 1000), 1000)
    attachment = record(0x09, struct.pack("<QQII", 0, 0, 0, 0) + struct.pack("<Q", len(small)) + small + bytes(4))
    inside = len(MAGIC) + 9 + 8 + 9 + 24 + 8
    path = indexed_file(tmp_path / "a.mcap", attachment, [(inside, len(small))])
    assert path.read_bytes()[inside] == 0x06
    with pytest.raises(RejectedInputError, match=r"damaged or was not finished[\s\S]*something else than the chunks"):
        McapFile(path)
    place = (len(MAGIC) + 17, len(small))
    assert McapFile(indexed_file(path, small, [place])).topics == {"/a": ""}
    with pytest.raises(RejectedInputError, match="or to one twice"):
        McapFile(indexed_file(path, small, [place] * 1000))
    content = indexed_file(path, b"", []).read_bytes()
    end = content.index(record(0x0F, bytes(4))) + 13
    path.write_bytes(content[:end] + small + content[end:])
    with pytest.raises(RejectedInputError, match="behind the end of the data"):
        McapFile(path)


def test_every_flipped_byte_of_our_own_file_is_noticed(sound: tuple[Path, bytes]) -> None:
    """Text in the metadata lies in no chunk: the chunks' own sums say nothing of it."""
    path, content = sound
    assert not refused(path, content)
    places = np.random.default_rng(1).integers(8, len(content) - 8, 60).tolist()
    places += [content.index(word) + 1 for word in (b"instruction", b"outcome", b"scene")]
    flipped = {p: content[:p] + bytes([content[p] ^ 0x01]) + content[p + 1 :] for p in places}
    assert [place for place, changed in flipped.items() if not refused(path, changed)] == []


def decode(encoding: str, schema: Schema, data: bytes) -> object:
    return MessageDecoder("a").decode(Channel(1, "/a", encoding, {}, 1), schema, data)


def ros(definition: bytes) -> Schema:
    return Schema(1, definition, "ros2msg", "sensor_msgs/msg/JointState")


def foxglove(name: str) -> Schema:
    return Schema(1, b"{}", "jsonschema", f"foxglove.{name}")


@pytest.mark.parametrize(
    ("definition", "data"),
    [
        (b"Empty[] name\nfloat64[] position\n===\nMSG: sensor_msgs/Empty\n", b"\0\1\0\0" + struct.pack("<I", 2**26)),
        (b"Empty[] name\n===\nMSG: sensor_msgs/Empty\nuint8[0] x\n", b"\0\1\0\0" + struct.pack("<I", 2**31)),
        (b"Empty[4000000000] name\n===\nMSG: sensor_msgs/Empty\nA[ 0 ] x\n===\nMSG: sensor_msgs/A\nint8 x", bytes(8)),
        (b"string[] name\nfloat64[] position\n", b"\0\1\0\0" + struct.pack("<I", 2**26) + bytes(2**26)),
    ],
)
def test_ros_messages_of_a_few_bytes_do_not_become_millions_of_objects(definition: bytes, data: bytes) -> None:
    tracemalloc.start()
    with pytest.raises(RejectedInputError, match=r"arrays of length 0|Message is too large|cannot be decoded"):
        decode("cdr", ros(definition), data)
    assert tracemalloc.get_traced_memory()[1] < 64 << 20
    tracemalloc.stop()


DESCRIPTORS = build_file_descriptor_set(JointStates).SerializeToString()
STATES = {"timestamp": {"sec": 1, "nsec": 0}, "joints": [{"name": "a", "position": 1.0}] * 1001}


@pytest.mark.parametrize(
    ("encoding", "schema", "data", "match"),
    [
        *(
            ("json", foxglove(name), b"[" + content * 300_000 + b"1]", r"is too large|too many values")
            for name in ("JointStates", "CompressedImage")
            for content in (b"[],", b"{},", b"[[]],", b"1,")
        ),
        ("json", foxglove("JointStates"), json.dumps(STATES).encode(), "more columns than a robot"),
        ("protobuf", Schema(1, DESCRIPTORS, "protobuf", "foxglove.JointStates"), b"\x12\x00" * 1_000_000, "is too large"),
    ],
)  # fmt: skip
def test_messages_of_millions_of_values_are_not_unpacked(
    encoding: str, schema: Schema, data: bytes, match: str
) -> None:
    with rejected("too_large", match):
        decode(encoding, schema, data)


@pytest.mark.parametrize(
    "definition", [b"\x1b[2J\x1b[31mred", b"int32 \x1b]0;title\x07 x", b"float64 a\n\x1b[1A", b"T\xc2\x9b31m x"]
)
def test_escapes_in_a_schema_reach_no_terminal(definition: bytes, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(RejectedInputError, match="Schema definition cannot be read") as caught:
        decode("cdr", ros(definition), bytes(8))
    assert "".join(capfd.readouterr()) == ""
    assert not set(str(caught.value)) & set("\x1b\x07\x9b")


@pytest.mark.parametrize("definition", [b"", b" \n", b"\n\n"])
def test_an_empty_definition_says_so(definition: bytes) -> None:
    with rejected("unknown_schema", r"(?s)no definition of its messages.*JointState.*next step"):
        decode("cdr", ros(definition), bytes(8))
