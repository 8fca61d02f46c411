"""MCAP files whose chunks and records claim more than they hold."""

from __future__ import annotations

import struct
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, Writer

from tools.corrupted import mcap
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.mcap import file as mcap_file
from worldline_core.data.mcap.exported import exported_episode_id, read_exported_episode
from worldline_core.data.mcap.file import McapFile, check_chunks

MAGIC = b"\x89MCAP0\r\n"


def chunk_file(path: Path, compression: str, packed: bytes, declared: int) -> Path:
    """A file of one chunk, written by hand."""
    name = compression.encode()
    body = struct.pack("<QQQI", 0, 0, declared, 0) + struct.pack("<I", len(name)) + name
    body += struct.pack("<Q", len(packed)) + packed
    record = struct.pack("<BQ", 0x06, len(body)) + body
    path.write_bytes(MAGIC + record + struct.pack("<BQI", 0x0F, 4, 0) + MAGIC)
    return path


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE])
def test_sound_chunks_pass(tmp_path: Path, compression: CompressionType) -> None:
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = Writer(stream, compression=compression)
        writer.start()
        channel = writer.register_channel("/a", "json", 0)
        for number in range(100):
            writer.add_message(channel, number, b'{"a": 1}' * 100, number)
        writer.finish()
    check_chunks(tmp_path / "a.mcap", "a")


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
