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


def chunk_file(path: Path, compression: str, packed: bytes, declared: int) -> Path:
    """A file of one chunk, written by hand."""
    path.write_bytes(MAGIC + chunk(packed, declared, compression.encode()) + record(0x0F, bytes(4)) + MAGIC)
    return path


def test_chunks_that_claim_terabytes(tmp_path: Path) -> None:
    small = zstandard.compress(b"x" * 100)
    with pytest.raises(RejectedInputError, match="chunk is too large") as caught:
        check_chunks(chunk_file(tmp_path / "a.mcap", "zstd", small, 10**12), "a")
    assert caught.value.reason == "too_large"
    # The frame's own size is what the decompressor allocates, whatever the chunk declares.
    frame = bytearray(zstandard.ZstdCompressor().compress(b"x" * 300))
    assert zstandard.frame_content_size(bytes(frame)) == 300
    header = b"\x28\xb5\x2f\xfd" + bytes([0b1110_0000]) + struct.pack("<Q", 10**12)  # single segment, 8 bytes of size
    assert zstandard.frame_content_size(header) == 10**12
    with pytest.raises(RejectedInputError, match="chunk is too large"):
        check_chunks(chunk_file(tmp_path / "b.mcap", "zstd", header + bytes(frame)[6:], 300), "b")


def test_an_lz4_chunk_is_unpacked_no_further_than_allowed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcap_file, "MAX_CHUNK_BYTES", 1 << 20)
    bomb = lz4.frame.compress(b"\0" * (8 << 20))
    assert len(bomb) < 100_000
    with pytest.raises(RejectedInputError, match="chunk is too large"):
        check_chunks(chunk_file(tmp_path / "a.mcap", "lz4", bomb, 1000), "a")
    check_chunks(chunk_file(tmp_path / "b.mcap", "lz4", lz4.frame.compress(b"\0" * 1000), 1000), "b")


@pytest.mark.parametrize("content", [b"", b"x" * 100, MAGIC, MAGIC + struct.pack("<BQ", 0x06, 2**63) + b"x" * 50])
def test_what_is_no_mcap_file_is_unreadable(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    for read in (exported_episode_id, read_exported_episode):
        with pytest.raises(RejectedInputError, match="MCAP") as caught:
            read(McapFile(path))
        assert caught.value.reason == "unreadable"


def test_lengths_of_records_that_no_number_can_hold(tmp_path: Path) -> None:
    """Every length in the file in turn: found by blind damage (OverflowError in the library)."""
    mcap.write(tmp_path, 1, 0, np.random.default_rng(0))
    path = next(tmp_path.glob("*.mcap"))
    sound = path.read_bytes()
    position, places = 8, []
    while position + 9 <= len(sound) - 8:
        places.append(position + 1)
        position += 9 + struct.unpack_from("<Q", sound, position + 1)[0]
    assert len(places) > 8
    failed = 0
    for place in places:
        for claimed in (2**63, 2**64 - 1, 2**40, 0):
            path.write_bytes(sound[:place] + struct.pack("<Q", claimed) + sound[place + 8 :])
            try:
                loaded = read_exported_episode(McapFile(path))
                for view in loaded.views:
                    loaded.frames(view)
            except RejectedInputError:
                failed += 1
    assert failed > len(places)


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


def test_an_index_that_leads_into_an_attachment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The size of a chunk in there was never looked at."""
    monkeypatch.setattr(mcap_file, "MAX_CHUNK_BYTES", 1 << 20)
    bomb = chunk(zstandard.compress(b"\0" * (8 << 20)), 8 << 20)
    attachment = record(0x09, struct.pack("<QQII", 0, 0, 0, 0) + struct.pack("<Q", len(bomb)) + bomb + bytes(4))
    inside = len(MAGIC) + 9 + 8 + 9 + 24 + 8
    path = indexed_file(tmp_path / "a.mcap", attachment, [(inside, len(bomb))])
    assert path.read_bytes()[inside] == 0x06
    with pytest.raises(RejectedInputError, match=r"damaged or was not finished[\s\S]*something else than the chunks"):
        McapFile(path)


def test_one_chunk_that_is_listed_a_thousand_times(tmp_path: Path) -> None:
    small = chunk(zstandard.compress(b"\0" * 1000), 1000)
    place = (len(MAGIC) + 17, len(small))
    assert McapFile(indexed_file(tmp_path / "a.mcap", small, [place])).topics == {"/a": ""}
    with pytest.raises(RejectedInputError, match="or to one twice"):
        McapFile(indexed_file(tmp_path / "b.mcap", small, [place] * 1000))


def test_a_chunk_behind_the_end_of_the_data(tmp_path: Path) -> None:
    path = indexed_file(tmp_path / "a.mcap", b"", [])
    content = path.read_bytes()
    end = content.index(record(0x0F, bytes(4))) + 13
    path.write_bytes(content[:end] + chunk(zstandard.compress(b"\0" * 1000), 1000) + content[end:])
    with pytest.raises(RejectedInputError, match="behind the end of the data"):
        McapFile(path)


def test_every_flipped_byte_of_our_own_file_is_noticed(tmp_path: Path) -> None:
    """Text in the metadata lies in no chunk: the chunks' own sums say nothing of it."""
    mcap.write(tmp_path, 1, 0, np.random.default_rng(0))
    path = next(tmp_path.glob("*.mcap"))
    sound = path.read_bytes()
    read_exported_episode(McapFile(path))
    places = np.random.default_rng(1).integers(8, len(sound) - 8, 120).tolist()
    places += [sound.index(word) + 1 for word in (b"instruction", b"outcome", b"scene")]
    unnoticed = []
    for place in places:
        path.write_bytes(sound[:place] + bytes([sound[place] ^ 0x01]) + sound[place + 1 :])
        try:
            read_exported_episode(McapFile(path))
            unnoticed.append(place)
        except RejectedInputError:
            continue
    assert not unnoticed


def ros_channel(definition: bytes, name: str = "sensor_msgs/msg/JointState") -> tuple[Channel, Schema]:
    return Channel(1, "/a", "cdr", {}, 1), Schema(1, definition, "ros2msg", name)


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
        MessageDecoder("a").decode(*ros_channel(definition), data)
    assert tracemalloc.get_traced_memory()[1] < 64 << 20
    tracemalloc.stop()


@pytest.mark.parametrize("schema", ["foxglove.JointStates", "foxglove.CompressedImage"])
def test_json_of_a_million_lists_is_not_parsed(schema: str) -> None:
    channel = Channel(1, "/a", "json", {}, 1)
    for content in (b"[],", b"{},", b"[[]],", b"1,"):
        with pytest.raises(RejectedInputError, match=r"is too large|too many values") as caught:
            MessageDecoder("a").decode(
                channel, Schema(1, b"{}", "jsonschema", schema), b"[" + content * 300_000 + b"1]"
            )
        assert caught.value.reason == "too_large"


def test_protobuf_messages_of_a_million_joints_are_not_unpacked() -> None:
    descriptors = build_file_descriptor_set(JointStates).SerializeToString()
    channel = Channel(1, "/a", "protobuf", {}, 1)
    with pytest.raises(RejectedInputError, match="Message is too large"):
        MessageDecoder("a").decode(
            channel, Schema(1, descriptors, "protobuf", "foxglove.JointStates"), b"\x12\x00" * 1_000_000
        )


def test_messages_of_more_joints_than_a_robot_has_are_refused() -> None:
    channel = Channel(1, "/a", "json", {}, 1)
    message = {"timestamp": {"sec": 1, "nsec": 0}, "joints": [{"name": "a", "position": 1.0}] * 1001}
    stamped = json.dumps(message).encode()
    with pytest.raises(RejectedInputError, match="more columns than a robot") as caught:
        MessageDecoder("a").decode(channel, Schema(1, b"{}", "jsonschema", "foxglove.JointStates"), stamped)
    assert caught.value.reason == "too_large"


@pytest.mark.parametrize(
    "definition", [b"\x1b[2J\x1b[31mred", b"int32 \x1b]0;title\x07 x", b"float64 a\n\x1b[1A", b"T\xc2\x9b31m x"]
)
def test_escapes_in_a_schema_reach_no_terminal(definition: bytes, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(RejectedInputError, match="Schema definition cannot be read") as caught:
        MessageDecoder("a").decode(*ros_channel(definition), bytes(8))
    printed = capfd.readouterr()
    assert printed.out + printed.err == ""
    assert not set(str(caught.value)) & set("\x1b\x07\x9b")


@pytest.mark.parametrize("definition", [b"", b" \n", b"\n\n"])
def test_an_empty_definition_says_so(definition: bytes) -> None:
    with pytest.raises(RejectedInputError, match=r"(?s)no definition of its messages.*JointState.*next step") as caught:
        MessageDecoder("a").decode(*ros_channel(definition), bytes(8))
    assert caught.value.reason == "unknown_schema"
