"""Encoded images (PNG, JPEG) that are not to be trusted: the size is read from the header before anything is decoded."""

from __future__ import annotations

import struct

import cv2
import numpy as np

from worldline_core.data.guards.rejection import MAX_PIXELS, RejectedInputError, check_image_size, too_large, unreadable
from worldline_core.data.guards.source_paths import AnyPath, regular_file

_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8\xff"
_PNG_END = b"IEND\xaeB`\x82"
_JPEG_END = b"\xff\xd9"
_SCAN = b"\xff\xda"
_MAX_SCANS = 100
_LAST_BYTES = 256
# Start-of-frame markers; C4, C8 and CC in their midst are tables and reserved.
_START_OF_FRAME = {0xC0 + n for n in range(16)} - {0xC4, 0xC8, 0xCC}
_BARE_MARKERS = {0x01, *range(0xD0, 0xD9)}
# An encoded image is never much larger than its pixels.
_MAX_FILE_BYTES = 4 * MAX_PIXELS


def image_size(content: bytes, where: object) -> tuple[int, int]:
    """(height, width) that a PNG or JPEG file states, without decoding it.

    Raises: RejectedInputError: unreadable for another format or a header that breaks off.
    """
    with unreadable("Image header breaks off", where, (struct.error, IndexError)):
        if content.startswith(_PNG) and content[12:16] == b"IHDR" and b"acTL" not in content[: content.find(b"IDAT")]:
            width, height = struct.unpack(">II", content[16:24])
            return height, width
        if content.startswith(_JPEG):
            return _jpeg_size(content)
    raise RejectedInputError(
        "unreadable",
        "Image is of no known format",
        where=where,
        expected="PNG (not animated) or JPEG",
        got=f"{len(content)} bytes that begin with {content[:8].hex() or 'nothing'}",
    )


def _jpeg_size(content: bytes) -> tuple[int, int]:
    position = 2
    while True:
        while content[position] != 0xFF:
            position += 1
        while content[position] == 0xFF:
            position += 1
        marker = content[position]
        position += 1
        if marker in _BARE_MARKERS:
            continue
        if marker in _START_OF_FRAME:
            height, width = struct.unpack(">HH", content[position + 3 : position + 7])
            return height, width
        position += max(2, struct.unpack(">H", content[position : position + 2])[0])


def decode_image(content: bytes, where: object, *, channels: str = "rgb") -> np.ndarray:
    """uint8 (H, W, 3) of a PNG or JPEG file.

    Args:
        channels: "rgb", or "bgr" for OpenCV's order.

    Raises: RejectedInputError: too_large by its header, unreadable.
    """
    height, width = image_size(content, where)
    check_image_size(width, height, where)
    # The decoder fills what is missing with grey and says nothing. Recorders pad with zeros, cameras add some bytes.
    end = _PNG_END if content.startswith(_PNG) else _JPEG_END
    if end not in content.rstrip(b"\0")[-_LAST_BYTES:]:
        raise RejectedInputError(
            "unreadable",
            "Image breaks off",
            where=where,
            expected="the end mark of its format",
            got=f"{len(content)} bytes that end with {content[-8:].hex()}",
        )
    # Every scan of a progressive JPEG goes over the whole picture, however little it says; usual files have ten.
    if not content.startswith(_PNG) and (scans := content.count(_SCAN)) > _MAX_SCANS:
        raise too_large("Image has too many scans", where=where, limit=_MAX_SCANS, got=scans, unit="scans")
    with unreadable("Image cannot be decoded", where, (cv2.error,)):
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    if image is None or image.shape[:2] not in ((height, width), (width, height)):  # EXIF may turn a JPEG
        raise RejectedInputError(
            "unreadable",
            "Image cannot be decoded",
            where=where,
            expected=f"{width}x{height} as its header says",
            got="nothing" if image is None else f"{image.shape[1]}x{image.shape[0]}",
        )
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB) if channels == "rgb" else image


def read_image(path: AnyPath) -> np.ndarray:
    """uint8 (H, W, 3) RGB of a PNG or JPEG file.

    Raises: RejectedInputError: missing_file, special_file, too_large, unreadable.
    """
    file = regular_file(path, "Image", max_bytes=_MAX_FILE_BYTES)
    with unreadable("Image cannot be read", path, (OSError,)):
        content = file.read_bytes()
    return decode_image(content, path)
