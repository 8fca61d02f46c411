"""Files that claim more than they hold: headers that ask for gigabytes, tables that unpack to them, loops without end.

Each attack exchanges or changes one file of a small recording. Reading must end within the limits of the reader process: in
a sound recording, or in a rejection whose code is true.
"""

from __future__ import annotations

import io
import shutil
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import lz4.frame
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image
from pydantic import TypeAdapter

from tools.corrupted.defects import Source
from tools.corrupted.mutations import LIMITS, read_everything
from worldline_core.data.guards.reader_process import read_limited
from worldline_core.data.sources.hdf5 import require_h5py
from worldline_core.data.sources.open import SourceConfig
from worldline_core.errors import WorldLineError

READ = "read"
_LARGE = ("out_of_memory", "too_large", "unreadable")
_ROWS = (*_LARGE, "length_mismatch")


@dataclass(frozen=True)
class Attack:
    """A change of the first file of a layout that fits a pattern, and how reading may end."""

    layout: str
    pattern: str
    name: str
    change: Callable[[Path], object]
    endings: tuple[str, ...]


def _bytes_at(mark: bytes, offset: int, value: bytes) -> Callable[[Path], None]:
    """Writes a value at an offset behind the first occurrence of a mark."""

    def change(path: Path) -> None:
        content = bytearray(path.read_bytes())
        start = content.index(mark) + len(mark) + offset
        content[start : start + len(value)] = value
        path.write_bytes(bytes(content))

    return change


def _content(make: Callable[[], bytes]) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(make())


# --- HDF5 (version 1 of RoboMIND: encoded images of variable length)


def _endless_heap(path: Path) -> None:
    """The library walks on from an object of no length to itself."""
    with require_h5py().File(path) as file:
        # First entry of the images: length (4 bytes), address of its heap (8), number there (4).
        entry = file["observations/rgb_images/camera_top"].id.get_offset()
    content = bytearray(path.read_bytes())
    (heap,) = struct.unpack_from("<Q", content, entry + 4)
    struct.pack_into("<HHIQ", content, heap + 16, 0, 0, 0, 0)
    path.write_bytes(bytes(content))


def _never_written(path: Path) -> None:
    with require_h5py().File(path, "r+") as file:
        del file["puppet/joint_position"]
        file.create_dataset("puppet/joint_position", (10**9, 8), "f8", chunks=(10**6, 8))


# --- Parquet


def _rows(column: pa.Array, times: int = 1) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        table = pa.table({"timestamp": column})
        with pq.ParquetWriter(path, table.schema, compression="zstd", store_schema=False) as writer:
            for _ in range(times):
                writer.write_table(table)

    return change


# --- MCAP


def _packed_chunk(path: Path) -> None:
    """A file of one chunk, a lz4 frame of two gigabytes of zeros that says that it is small."""
    with lz4.frame.LZ4FrameCompressor() as frame:
        packed = frame.begin() + b"".join(frame.compress(bytes(1 << 20)) for _ in range(2000)) + frame.flush()
    chunk = struct.pack("<QQQII", 0, 0, 1000, 0, 3) + b"lz4" + struct.pack("<Q", len(packed)) + packed
    parts = (0x01, bytes(8)), (0x06, chunk), (0x0F, bytes(4)), (0x02, bytes(20))
    records = b"".join(struct.pack("<BQ", opcode, len(body)) + body for opcode, body in parts)
    path.write_bytes(b"\x89MCAP0\r\n" + records + b"\x89MCAP0\r\n")


# --- images


def png_with(*chunks: tuple[bytes, bytes], size: tuple[int, int] = (96, 72)) -> bytes:
    """A black PNG with further chunks behind its header."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", *size, 8, 2, 0, 0, 0))
    body = chunk(b"IDAT", zlib.compress(bytes(72 * (1 + 3 * 96))))
    return b"\x89PNG\r\n\x1a\n" + header + b"".join(chunk(*each) for each in chunks) + body + chunk(b"IEND", b"")


def jpeg_of_scans(count: int) -> bytes:
    """A progressive JPEG whose last scan is repeated: each goes over all of the picture."""
    stream = io.BytesIO()
    Image.new("L", (6000, 6000)).save(stream, "JPEG", progressive=True)
    sound = stream.getvalue()
    last = sound.rindex(b"\xff\xda")
    return sound[:last] + sound[last:-2] * count + sound[-2:]


_MP4, _PNG = ("video_folder", "*.mp4"), ("agibot_gesim", "head_color/0.png")
_H5, _TABLE, _NPY = ("robomind", "*.hdf5"), ("lerobot_v21", "data/*/*.parquet"), ("agibot_gesim", "actions.npy")
_VIDEO = (READ, "truncated_video", "unreadable", "too_large", "wrong_fps", "out_of_memory")

ATTACKS = (
    Attack(*_H5, "a heap without end", _endless_heap, ("out_of_time", "unreadable")),
    Attack(*_H5, "10^9 rows that were never written", _never_written, ("unreadable",)),
    Attack(*_TABLE, "a text of 100 kB, 50,000 times",
           _rows(pa.DictionaryArray.from_arrays(np.zeros(50_000, np.int32), ["x" * 100_000])), _ROWS),
    Attack(*_TABLE, "3 * 10^8 equal rows", _rows(pa.array(np.zeros(10**7)), 30), _ROWS),
    Attack("mcap", "*.mcap", "a chunk of a terabyte", _bytes_at(b"\x04\0\0\0zstd", -20, struct.pack("<Q", 10**12)),
            ("out_of_memory", "unreadable")),
    Attack("mcap", "*.mcap", "a chunk of 2 GB in a frame of 8 MB", _packed_chunk, ("out_of_memory", "unreadable")),
    Attack(*_NPY, "10^12 rows", _bytes_at(b"'shape': (", 0, b"1000000000000, 16), }"), _LARGE),
    Attack(*_NPY, "an array of objects", lambda path: np.save(path, np.array([print]), allow_pickle=True), ("unreadable",)),
    Attack(*_PNG, "30,000 x 30,000 pixels", _content(lambda: png_with(size=(30_000, 30_000))), ("too_large",)),
    Attack(*_PNG, "10^9 pictures", _content(lambda: png_with((b"acTL", struct.pack(">II", 10**9, 0)))), ("unreadable",)),
    Attack(*_PNG, "5,000 scans", _content(lambda: jpeg_of_scans(5000)), ("too_large",)),
    Attack(*_MP4, "30,000 x 30,000 pixels", _bytes_at(b"stsd", 40, struct.pack(">HH", 30_000, 30_000)), _VIDEO),
    Attack(*_MP4, "10^9 frames", _bytes_at(b"stsz", 8, struct.pack(">I", 10**9)), _VIDEO[1:]),
    Attack(*_MP4, "no time scale", _bytes_at(b"mdhd", 12, bytes(4)), _VIDEO),
    Attack(*_MP4, "4 billion edits", _bytes_at(b"elst", 4, b"\xff" * 4), _VIDEO),
    Attack(*_MP4, "chunks beyond the end", _bytes_at(b"stco", 8, b"\xff" * 4), _VIDEO),
    Attack(*_MP4, "a description of nothing", _bytes_at(b"avcC", 5, bytes(8)), _VIDEO),
    Attack(*_MP4, "a playlist", _content(lambda: b"#EXTM3U\n#EXTINF:1,\nfile:///etc/hostname\n#EXT-X-ENDLIST\n"),
           ("unreadable",)),
)  # fmt: skip


def ending(attack: Attack, source: Source, folder: Path) -> str:
    """Reads an attacked copy of a source at `folder`; the reason of the rejection, or `READ`."""
    shutil.copytree(source["path"], folder)
    attack.change(next(path for path in sorted(folder.rglob(attack.pattern))))
    config = TypeAdapter(SourceConfig).validate_python({**source, "path": str(folder)})
    limits = LIMITS.model_copy(update={"seconds": 3}) if "out_of_time" in attack.endings else LIMITS
    try:
        read_limited(limits, read_everything, config, folder)
    except WorldLineError as error:
        return getattr(error, "reason", type(error).__name__)
    finally:
        shutil.rmtree(folder)
    return READ
