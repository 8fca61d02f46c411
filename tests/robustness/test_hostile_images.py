"""Images that claim too much or are something else."""

from __future__ import annotations

import io
import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from worldline_core.data.guards.images import decode_image, image_size, read_image
from worldline_core.data.guards.rejection import RejectedInputError

PICTURE = np.random.default_rng(0).integers(0, 255, (30, 50, 3), dtype=np.uint8)


def png_of(width: int, height: int) -> bytes:
    """A valid PNG header (checksums included) of any size, with next to no data."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0" * 100)) + chunk(b"IEND", b"")
    )


def jpeg(**settings: object) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(PICTURE).save(stream, "JPEG", **settings)
    return stream.getvalue()


def test_png_and_jpeg_come_as_rgb() -> None:
    stream = io.BytesIO()
    Image.fromarray(PICTURE).save(stream, "PNG")
    assert np.array_equal(decode_image(stream.getvalue(), "x"), PICTURE)
    assert np.array_equal(decode_image(stream.getvalue(), "x", channels="bgr"), PICTURE[..., ::-1])
    expected = np.asarray(Image.open(io.BytesIO(jpeg(quality=95))))
    assert np.abs(decode_image(jpeg(quality=95), "x").astype(int) - expected).max() <= 3


@pytest.mark.parametrize(
    "settings", [{}, {"progressive": True}, {"restart_marker_rows": 1}, {"comment": b"\xff\xc0\x00" * 9}]
)
def test_the_size_is_found_among_other_segments(settings: dict[str, object]) -> None:
    assert image_size(jpeg(**settings), "x") == (30, 50)


def test_a_thumbnail_inside_is_not_taken_for_the_image() -> None:
    exif = Image.Exif()
    exif[0x010E] = jpeg().decode("latin-1")[:400]  # a description that is itself the beginning of a JPEG file
    assert image_size(jpeg(exif=exif), "x") == (30, 50)


@pytest.mark.parametrize("size", [(30_000, 30_000), (2**31 - 1, 1), (8_000, 8_000)])
def test_a_png_that_claims_gigapixels_is_refused_undecoded(size: tuple[int, int]) -> None:
    with pytest.raises(RejectedInputError, match="too") as caught:
        decode_image(png_of(*size), "bomb.png")
    assert caught.value.reason == "too_large"


def test_a_jpeg_that_claims_gigapixels_is_refused_undecoded() -> None:
    content = bytearray(jpeg())
    frame = content.index(b"\xff\xc0")
    content[frame + 5 : frame + 9] = struct.pack(">HH", 65_500, 65_500)
    with pytest.raises(RejectedInputError, match="too long") as caught:
        decode_image(bytes(content), "bomb.jpg")
    assert caught.value.reason == "too_large"


@pytest.mark.parametrize(
    "content",
    [b"", b"GIF89a", b"\xff\xd8\xff", jpeg()[:20], png_of(4, 4)[:20], png_of(0, 5), b"\xff\xd8\xff" + b"\xff" * 99],
)
def test_what_is_no_image_is_unreadable(content: bytes) -> None:
    with pytest.raises(RejectedInputError, match="Image") as caught:
        decode_image(content, "x")
    assert caught.value.reason == "unreadable"


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_an_image_that_breaks_off_is_not_filled_with_grey(share: float) -> None:
    stream = io.BytesIO()
    Image.fromarray(PICTURE).save(stream, "PNG")
    for content in (jpeg(quality=95), stream.getvalue()):
        assert decode_image(content + b"\0" * 999, "padded").shape == PICTURE.shape
        with pytest.raises(RejectedInputError, match="Image breaks off"):
            decode_image(content[: int(len(content) * share)], "x")


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(RejectedInputError, match="Image is missing"):
        read_image(tmp_path / "none.png")
    os.mkfifo(tmp_path / "pipe.png")
    with pytest.raises(RejectedInputError, match="a pipe"):
        read_image(tmp_path / "pipe.png")
    cv2.imwrite(str(tmp_path / "sound.png"), PICTURE[..., ::-1])
    assert np.array_equal(read_image(tmp_path / "sound.png"), PICTURE)
