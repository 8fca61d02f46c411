"""Thumbnails that curation left beside a set, so that filtering need not decode the same videos again.

They lie in the set's `run/thumbnails`, which belongs to no digest: without them everything is computed again from the
stored videos, to the same bytes. Each names the digest of the video that it was made from and is not used for another one.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa

from worldline_core.data.video.thumbnails import GRAY_WIDTH, ViewThumbnails
from worldline_core.store.digest import digest_file

# Raised whenever thumbnails of the same video come out differently.
_VERSION = "1"
_SUFFIX = ".arrow"


def cache_path(set_root: Path, video: Path) -> Path:
    """Where the thumbnails of one of the set's videos lie."""
    return (set_root / "run" / "thumbnails" / video.relative_to(set_root)).with_suffix(_SUFFIX)


def write_thumbnails(path: Path, video: Path, thumbnails: ViewThumbnails) -> None:
    """Note the thumbnails of a whole video file."""
    images = thumbnails.gray.reshape(len(thumbnails), -1)
    table = pa.table(
        {
            "gray": pa.FixedSizeBinaryArray.from_buffers(
                pa.binary(images.shape[1]), len(images), [None, pa.py_buffer(np.ascontiguousarray(images))]
            ),
            "sharpness": pa.array(thumbnails.sharpness, pa.float32()),
        }
    ).replace_schema_metadata({"version": _VERSION, "video": digest_file(video)})
    # Noise does not compress: zstd saves a third and takes longer than half of the detectors.
    options = pa.ipc.IpcWriteOptions(compression="lz4")
    with pa.OSFile(str(path), "wb") as sink, pa.ipc.new_file(sink, table.schema, options=options) as writer:
        writer.write_table(table)


def read_thumbnails(path: Path, video: Path) -> ViewThumbnails | None:
    """The thumbnails of a video file; None where there are none, or not of this very file."""
    if not path.is_file():
        return None
    try:
        with pa.OSFile(str(path)) as source:
            table = pa.ipc.open_file(source).read_all()
    except pa.ArrowInvalid:  # cut off while it was written, or by somebody: it is only a cache
        return None
    noted = table.schema.metadata or {}
    if noted.get(b"version") != _VERSION.encode() or noted.get(b"video") != digest_file(video).encode():
        return None
    gray = table["gray"].combine_chunks()
    pixels = np.frombuffer(gray.buffers()[1], dtype=np.uint8, count=len(gray) * gray.type.byte_width)
    shaped = pixels.reshape(len(gray), gray.type.byte_width // GRAY_WIDTH, GRAY_WIDTH)
    return ViewThumbnails(shaped, table["sharpness"].to_numpy())
