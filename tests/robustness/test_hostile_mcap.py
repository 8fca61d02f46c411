"""MCAP files whose chunks and records claim more than they hold."""

from __future__ import annotations

import json
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import zstandard
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from mcap.records import Channel, Schema
from mcap_protobuf.schema import build_file_descriptor_set

from tests.data.curating import rejected
from tools.corrupted import mcap
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.mcap import messages
from worldline_core.data.mcap.exported import exported_episode_id, read_exported_episode
from worldline_core.data.mcap.file import McapFile

MAGIC = b"\x89MCAP0\r\n"


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def chunk(packed: bytes, unpacked: int) -> bytes:
    head = struct.pack("<QQQI", 0, 0, unpacked, 0) + struct.pack("<I", 4) + b"zstd"
    return record(0x06, head + struct.pack("<Q", len(packed)) + packed)


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


def test_an_index_that_leads_twice_to_a_chunk(tmp_path: Path) -> None:
    small = chunk(zstandard.compress(b"\0" * 1000), 1000)
    path, place = tmp_path / "a.mcap", (len(MAGIC) + 17, len(small))
    assert McapFile(indexed_file(path, small, [place])).topics == {"/a": ""}
    with pytest.raises(RejectedInputError, match="to one chunk twice"):
        McapFile(indexed_file(path, small, [place] * 1000))


def test_every_flipped_byte_of_our_own_file_is_noticed(sound: tuple[Path, bytes]) -> None:
    """Text in the metadata lies in no chunk: the chunks' own sums say nothing of it."""
    path, content = sound
    assert not refused(path, content)
    places = np.random.default_rng(1).integers(8, len(content) - 8, 60).tolist()
    places += [content.index(word) + 1 for word in (b"instruction", b"outcome", b"scene")]
    flipped = {p: content[:p] + bytes([content[p] ^ 0x01]) + content[p + 1 :] for p in places}
    assert [place for place, changed in flipped.items() if not refused(path, changed)] == []


def decode(encoding: str, schema: Schema, data: bytes) -> object:
    return messages.decode(Channel(1, "/a", encoding, {}, 1), schema, data, "a")


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
    ],
)
def test_ros_messages_of_a_few_bytes_do_not_become_millions_of_objects(definition: bytes, data: bytes) -> None:
    tracemalloc.start()
    with pytest.raises(RejectedInputError, match=r"arrays of length 0|cannot be decoded"):
        decode("cdr", ros(definition), data)
    assert tracemalloc.get_traced_memory()[1] < 64 << 20
    tracemalloc.stop()


DESCRIPTORS = build_file_descriptor_set(JointStates).SerializeToString()
STATES = {"timestamp": {"sec": 1, "nsec": 0}, "joints": [{"name": "a", "position": 1.0}] * 1001}


@pytest.mark.parametrize(
    ("encoding", "schema", "data"),
    [
        ("json", foxglove("JointStates"), json.dumps(STATES).encode()),
        ("protobuf", Schema(1, DESCRIPTORS, "protobuf", "foxglove.JointStates"), b"\x12\x00" * 1001),
    ],
)
def test_messages_of_more_joints_than_a_robot_has(encoding: str, schema: Schema, data: bytes) -> None:
    with rejected("too_large", "more columns than a robot"):
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
