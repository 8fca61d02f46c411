"""Text, JSON, NumPy, Parquet and image files of others: every fault becomes a rejection with its reason.

JSON may repeat no key. NaN and infinities are read as they are: recorders write them, and the checks of values name the
frame. A file that asks for more memory than there is is the business of `reader_process`.
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import ExifTags, Image
from pydantic import BaseModel, ValidationError

from worldline_core.data.guards.rejection import (
    MAX_PIXELS,
    RejectedInputError,
    check_image_size,
    check_shape,
    depth_picture,
    too_large,
    unreadable,
)
from worldline_core.data.guards.source_paths import AnyPath, regular_file

UPRIGHT = 1
QUARTER_TURNS = (5, 6, 7, 8)
"""Orientations in which height and width change places."""

# By the signs of a display matrix ((a, b), (c, d)): a stored point (x, y) is shown at (a x + c y, b x + d y).
_ORIENTATIONS = {
    ((1, 0), (0, 1)): UPRIGHT,
    ((-1, 0), (0, 1)): 2,
    ((-1, 0), (0, -1)): 3,
    ((1, 0), (0, -1)): 4,
    ((0, 1), (1, 0)): 5,
    ((0, 1), (-1, 0)): 6,
    ((0, -1), (-1, 0)): 7,
    ((0, -1), (1, 0)): 8,
}


def orientation_of(matrix: tuple[tuple[int, int], tuple[int, int]]) -> int:
    """EXIF's orientation (1..8) of a display matrix.

    Raises: RejectedInputError (unreadable) for a matrix that does not turn by whole quarters.
    """
    values = np.asarray(matrix, dtype=np.float64)
    values /= abs(values).max() or 1.0
    (a, b), (c, d) = np.rint(values).astype(int).tolist()
    whole = np.abs(values - np.rint(values)).max() < np.sin(np.deg2rad(1.0))
    found = _ORIENTATIONS.get(((a, b), (c, d))) if whole else None
    if found is None:
        raise RejectedInputError(
            "unreadable",
            "Video is shown turned by no whole quarter",
            expected="a display matrix of 0, 90, 180 or 270 degrees",
            got=matrix,
            next_step="write the video upright: ffmpeg -i in.mp4 out.mp4",
        )
    return found


def upright(image: np.ndarray, orientation: int) -> np.ndarray:
    """The image (H, W, ...) as it is shown."""
    if orientation == UPRIGHT:
        return image
    if orientation in QUARTER_TURNS:
        image = image.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    return np.ascontiguousarray(image)


def turned_view(where: object, orientation: int) -> RejectedInputError:
    """The rejection of a view whose K is of the stored picture, or of the shown one: the recording does not say which."""
    return RejectedInputError(
        "missing_calibration",
        "Pictures are stored turned or mirrored, and the view has a camera",
        where=where,
        expected="upright pictures, to which K belongs",
        got=f"orientation {orientation} (as EXIF counts; of a video by its display matrix)",
        next_step="write the pictures upright (ffmpeg -i in.mp4 out.mp4) and give K of those, or take the camera out",
    )


def read_json(path: AnyPath) -> Any:
    """JSON of a file.

    Raises: RejectedInputError: missing_file, special_file, unreadable (no UTF-8, no JSON, a key given twice,
        nested too deeply, a number of thousands of digits).
    """
    return parse_json(read_text(path), path)


def parse_json(text: str | bytes, where: object) -> Any:
    """JSON of a text.

    Raises: RejectedInputError (unreadable).
    """
    # ValueError: of the decoder, of UTF-8, of a key given twice, of a number with too many digits.
    # A byte order mark is no part of JSON, but Windows' editors write one.
    text = text.removeprefix("\ufeff") if isinstance(text, str) else text.removeprefix(b"\xef\xbb\xbf")
    with unreadable("File is not valid JSON", where, (ValueError, RecursionError)):
        return json.loads(text, object_pairs_hook=_without_repetition)


def read_json_lines(path: AnyPath) -> Iterator[Any]:
    """The values of a file with one JSON value per line; empty lines are skipped.

    Raises: RejectedInputError as `read_json`, naming the line.
    """
    for number, line in enumerate(read_text(path).splitlines(), 1):
        if line.strip():
            yield parse_json(line, f"{path}, line {number}")


def read_text(path: AnyPath, *, encoding: str = "utf-8") -> str:
    """The text of a file.

    Raises: RejectedInputError: missing_file, special_file, unreadable (no UTF-8).
    """
    file = regular_file(path, "Text file")
    with unreadable("File cannot be read as text", path, (OSError, UnicodeDecodeError)):
        return file.read_text(encoding=encoding)


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) != len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))
        raise ValueError(f"the key {twice!r} is given twice")
    return values


@contextmanager
def expect_layout(where: object, layout: str) -> Iterator[None]:
    """Reject the file when parsed content read inside of the context has another shape than `layout` says.

    Raises: RejectedInputError (unreadable) for a missing key, another type, another length, a number out of range.
    """
    try:
        yield
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise RejectedInputError(
            "unreadable",
            "Content has another shape than its layout",
            where=where,
            expected=layout,
            got=f"{type(error).__name__}: {error}",
        ) from error


def validated[M: BaseModel](model: type[M], content: Any, where: object, what: str) -> M:
    """Parsed content as a model.

    Raises: RejectedInputError (missing_column) at the first key that is missing, unknown or of another kind.
    """
    try:
        return model.model_validate(content)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        raise RejectedInputError(
            "missing_column",
            f"{what} is not understood",
            where=", ".join([str(where), ".".join(map(str, first["loc"]))]),
            expected=first["msg"],
            next_step="see the layout in docs/sources.md",
        ) from error


def read_npy(path: AnyPath, shape: Sequence[int | None]) -> np.ndarray:
    """float64 array of a .npy file, of a wanted shape (None for any size but 0); never unpickles.

    Raises: RejectedInputError: missing_file, special_file, out_of_memory, length_mismatch, unreadable (damaged, of objects,
        not numeric, or cut off).
    """
    file = regular_file(path)
    # Damaged headers: SyntaxError, TokenError (an Exception only), OverflowError, ...
    with unreadable("Array cannot be read", path, (Exception,)), file.open("rb") as stream:
        values = np.load(stream, allow_pickle=False)
        if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiu":
            raise ValueError("no numeric array")
    check_shape("Array", path, values.shape, shape)
    return values.astype(np.float64)


_PARQUET_FAULTS = (pa.ArrowException, OSError, ValueError, TypeError, OverflowError)


def read_table(
    path: AnyPath, columns: Sequence[str] | Callable[[Sequence[str]], Sequence[str]] | None = None
) -> pa.Table:
    """Table of a Parquet file.

    Args:
        columns: their names, or what chooses some of the names of all.

    Raises: RejectedInputError: missing_file, special_file, missing_column (the message names it), out_of_memory, unreadable.
    """
    local = regular_file(path)
    # No memory map: if the file is truncated meanwhile, a map ends in a signal instead of an error.
    with unreadable("Parquet file cannot be read", path, _PARQUET_FAULTS), pq.ParquetFile(local) as file:
        names = file.schema_arrow.names
        wanted = columns(names) if callable(columns) else names if columns is None else columns
        missing = [column for column in wanted if column not in names]
        if missing:
            raise RejectedInputError(
                "missing_column",
                "Parquet file lacks a column",
                where=path,
                expected=", ".join(missing),
                got="columns " + ", ".join(names),
            )
        return file.read(columns=None if columns is None else list(wanted), use_threads=False)


_END_MARKS = {"PNG": b"IEND\xaeB`\x82", "JPEG": b"\xff\xd9"}
_LAST_BYTES = 256
_SCAN = b"\xff\xda"
_MAX_SCANS = 100
_PNG_DEPTH, _PNG_GRAY, _DEPTH_BITS = 24, (0, 4), 16
"""Place of the bits per channel in a PNG file, before the kind of colour; kinds of one channel."""


def image_size(content: bytes, where: object) -> tuple[int, int]:
    """(height, width) that a PNG or JPEG file is shown at, without decoding it.

    Raises: RejectedInputError: too_large; not_colour; unreadable for another format, a header that breaks off, an animation, an image
        without its end.
    """
    height, width, orientation = _image_header(content, where)
    return (width, height) if orientation in QUARTER_TURNS else (height, width)


def _image_header(content: bytes, where: object) -> tuple[int, int, int]:
    """Stored height and width, and orientation."""
    try:
        with Image.open(io.BytesIO(content), formats=tuple(_END_MARKS)) as image:
            (width, height), kind = image.size, "PNG" if image.format == "PNG" else "JPEG"
            animated = kind == "PNG" and getattr(image, "is_animated", False)
            orientation = _exif_orientation(image)
    except Image.DecompressionBombError as error:
        raise too_large("Image has too many pixels", where=where, limit=MAX_PIXELS, got=str(error)) from error
    except Exception as error:
        raise RejectedInputError(
            "unreadable",
            "Image is of no known format, or its header is damaged",
            where=where,
            expected="PNG (not animated) or JPEG",
            got=f"{len(content)} bytes that begin with {content[:8].hex() or 'nothing'}",
        ) from error
    check_image_size(width, height, where)
    # The decoder fills what is missing with grey and says nothing. Recorders pad with zeros, cameras add some bytes.
    if animated or _END_MARKS[kind] not in content.rstrip(b"\0")[-_LAST_BYTES:]:
        raise RejectedInputError(
            "unreadable",
            "Image is animated" if animated else "Image breaks off",
            where=where,
            expected="one whole picture with the end mark of its format",
            got=f"{len(content)} bytes that end with {content[-8:].hex()}",
        )
    if kind == "PNG" and content[_PNG_DEPTH] == _DEPTH_BITS and content[_PNG_DEPTH + 1] in _PNG_GRAY:
        raise depth_picture(where, f"a PNG of one channel of {_DEPTH_BITS} bits")
    return height, width, orientation


def _exif_orientation(image: Image.Image) -> int:
    if not image.info.get("exif"):
        return UPRIGHT
    try:
        found = image.getexif().get(ExifTags.Base.Orientation, UPRIGHT)
    except (ValueError, TypeError, LookupError, SyntaxError, OSError, OverflowError, struct.error):
        return UPRIGHT  # of damaged notes no viewer turns a picture
    return found if isinstance(found, int) and 1 <= found <= 8 else UPRIGHT


def decode_image(content: bytes, where: object, *, channels: str = "rgb", calibrated: bool = False) -> np.ndarray:
    """uint8 (H, W, 3) of a PNG or JPEG file.

    Args:
        channels: "rgb", or "bgr" for OpenCV's order.
        calibrated: whether the view has a camera; of a turned picture (EXIF) it is not known to which K belongs.

    Raises: RejectedInputError: too_large by its header, unreadable, not_colour; missing_calibration for a turned picture of
        a calibrated view.
    """
    height, width, orientation = _image_header(content, where)
    if calibrated and orientation != UPRIGHT:
        raise turned_view(where, orientation)
    # Every scan of a progressive JPEG goes over the whole picture, however little it says; usual files have ten.
    if content.startswith(b"\xff\xd8") and (scans := content.count(_SCAN)) > _MAX_SCANS:
        raise too_large("Image has too many scans", where=where, limit=_MAX_SCANS, got=scans)
    with unreadable("Image cannot be decoded", where, (cv2.error,)):
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None or image.shape[:2] != (height, width):
        raise RejectedInputError(
            "unreadable",
            "Image cannot be decoded",
            where=where,
            expected=f"{width}x{height} as its header says",
            got="nothing" if image is None else f"{image.shape[1]}x{image.shape[0]}",
        )
    return upright(cv2.cvtColor(image, cv2.COLOR_BGR2RGB) if channels == "rgb" else image, orientation)


def read_image(path: AnyPath, *, calibrated: bool = False) -> np.ndarray:
    """uint8 (H, W, 3) RGB of a PNG or JPEG file.

    Raises: RejectedInputError: missing_file, special_file, and as `decode_image`.
    """
    file = regular_file(path, "Image")
    with unreadable("Image cannot be read", path, (OSError,)):
        content = file.read_bytes()
    return decode_image(content, path, calibrated=calibrated)
