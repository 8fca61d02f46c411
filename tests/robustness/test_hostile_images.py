"""Images that claim too much or are something else."""

from __future__ import annotations

import io
import os
import resource
import struct
import time
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


def test_a_jpeg_of_thousands_of_scans_is_refused_undecoded() -> None:
    """20,000 bytes that take the decoder minutes: every scan goes over all of the picture."""
    stream = io.BytesIO()
    Image.new("L", (6000, 6000)).save(stream, "JPEG", progressive=True)
    sound = stream.getvalue()
    last = sound.rindex(b"\xff\xda")
    bomb = sound[:last] + sound[last:-2] * 5000 + sound[-2:]
    began = time.monotonic()
    with pytest.raises(RejectedInputError, match="too many scans") as caught:
        decode_image(bomb, "x")
    assert time.monotonic() - began < 2
    assert caught.value.reason == "too_large"
    assert decode_image(sound, "x").shape == (6000, 6000, 3)


def png_with(*chunks: tuple[bytes, bytes], data: bytes | None = None) -> bytes:
    """A PNG of 50 x 30 with further chunks behind its header."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    rows = b"".join(b"\0" + row.tobytes() for row in PICTURE)
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 50, 30, 8, 2, 0, 0, 0))
    parts = [chunk(*each) for each in chunks]
    body = chunk(b"IDAT", zlib.compress(rows) if data is None else data)
    return b"\x89PNG\r\n\x1a\n" + header + b"".join(parts) + body + chunk(b"IEND", b"")


def zeros(megabytes: int) -> bytes:
    """Compressed; each megabyte alike, so that one is compressed."""
    stream = zlib.compressobj(wbits=-zlib.MAX_WBITS)
    block = stream.compress(b"\0" * (1 << 20)) + stream.flush(zlib.Z_FULL_FLUSH)
    check = 1 + (megabytes * (1 << 20) % 65521 << 16)  # Adler-32 of zeros
    return b"\x78\x9c" + block * megabytes + stream.flush() + struct.pack(">I", check)


ZEROS = zeros(200)
ODD_PNGS = {
    "a text of 200 MB": png_with((b"zTXt", b"a\0\0" + ZEROS)),
    "a profile of 200 MB": png_with((b"iCCP", b"a\0\0" + ZEROS)),
    "another header": png_with((b"IHDR", struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0))),
    "a billion pictures": png_with((b"acTL", struct.pack(">II", 10**9, 0))),
    "data of 200 MB": png_with(data=ZEROS),
    "ten thousand chunks": png_with(*[(b"tEXt", b"a\0b")] * 10_000),
    "a palette of nothing": png_with((b"PLTE", b"")),
}


@pytest.mark.parametrize("content", ODD_PNGS.values(), ids=ODD_PNGS)
def test_what_else_a_png_may_carry_costs_nothing(content: bytes) -> None:
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.monotonic()
    try:
        image = decode_image(content, "x")
        found = np.array_equal(image, image * 0 if content == ODD_PNGS["data of 200 MB"] else PICTURE)
    except RejectedInputError as error:
        found = error.reason
    assert found in (True, "unreadable")
    assert time.monotonic() - began < 2
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # KB


def test_a_jpeg_with_a_second_larger_frame_is_no_image() -> None:
    sound = jpeg()
    frame = sound.index(b"\xff\xc0")
    length = struct.unpack(">H", sound[frame + 2 : frame + 4])[0]
    second = bytearray(sound[frame : frame + 2 + length])
    second[5:9] = struct.pack(">HH", 60_000, 60_000)
    for content in (
        sound[:frame] + bytes(second) + sound[frame:],
        sound[: frame + 2 + length] + bytes(second) + sound[frame:],
    ):
        with pytest.raises(RejectedInputError, match="Image"):
            decode_image(content, "x")
