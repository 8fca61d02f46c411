"""One decoded frame as players show it: in the colours that its stream states, turned as its file asks.

Matrix and range are those of the frame (FFmpeg takes them from the stream, or else from the container). A stream that
states no matrix has BT.709's from 720 lines on and BT.601's below; one that states no range has the limited one.
"""

from __future__ import annotations

import struct
from functools import cached_property

import numpy as np
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange, Interpolation, VideoReformatter

from worldline_core.data.guards.plain_files import QUARTER_TURNS, UPRIGHT, orientation_of, upright
from worldline_core.data.guards.rejection import RejectedInputError

_LUMA_FIRST = frozenset(
    ("yuv420p", "yuvj420p", "yuv422p", "yuvj422p", "yuv444p", "yuvj444p", "nv12", "nv21", "gray", "yuv440p", "yuvj440p")
)
_FULL_RANGE = frozenset(("yuvj420p", "yuvj422p", "yuvj444p", "yuvj440p"))
# ITU-T H.273, table 4: the matrices that libswscale knows by the same numbers.
_BT709, _BT601 = 1, 6
_MATRICES = {_BT709: "BT.709", 4: "FCC", 5: "BT.601", _BT601: "BT.601", 7: "SMPTE 240M", 9: "BT.2020", 10: "BT.2020"}
_UNSPECIFIED = 2
_HD_LINES = 720


class Picture:
    """One decoded frame.

    Args:
        where: the file or topic that it comes from, for errors.
        reformatter: shared by frames of one size and format, since setting one up costs as much as a small frame.
    """

    def __init__(self, frame: VideoFrame, where: object, reformatter: VideoReformatter | None = None) -> None:
        self._frame = frame
        self._where = where
        self._reformatter = reformatter

    @cached_property
    def orientation(self) -> int:
        """Turn by which the frame is shown, as EXIF counts (1: as it is)."""
        found = self._frame.side_data.get("DISPLAYMATRIX")
        if found is None:
            return UPRIGHT
        a, b, _, c, d = struct.unpack("<5i", bytes(found)[:20])
        return orientation_of(((a, b), (c, d)))

    @property
    def stored_size(self) -> tuple[int, int]:
        """(height, width) before it is turned."""
        return self._frame.height, self._frame.width

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) as it is shown."""
        height, width = self.stored_size
        return (width, height) if self.orientation in QUARTER_TURNS else (height, width)

    @property
    def full_range(self) -> bool:
        """True if black is 0 and white 255 in `luma`, instead of 16 and 235."""
        frame = self._frame
        gray = frame.format.name == "gray" and frame.color_range != ColorRange.MPEG
        return gray or frame.format.is_rgb or frame.format.name in _FULL_RANGE or frame.color_range == ColorRange.JPEG

    @property
    def luma(self) -> np.ndarray:
        """uint8 (H, W), a view into the decoder's memory where the format allows it."""
        frame = self._frame
        if frame.format.is_rgb:
            frame = frame.reformat(
                format="yuv420p", src_colorspace=_BT709, dst_colorspace=_BT601, dst_color_range=ColorRange.JPEG
            )
        elif frame.format.name not in _LUMA_FIRST:  # more than 8 bits
            frame = frame.reformat(
                format="yuv420p", src_color_range=frame.color_range, dst_color_range=frame.color_range
            )
        plane = frame.planes[0]
        rows = np.frombuffer(plane, dtype=np.uint8, count=plane.line_size * plane.height)
        return upright(rows.reshape(plane.height, plane.line_size)[:, : plane.width], self.orientation)

    @property
    def rgb(self) -> np.ndarray:
        """uint8 (H, W, 3).

        Raises: RejectedInputError (unreadable) for a matrix that cannot be converted.
        """
        frame, reformatter = self._frame, self._reformatter or VideoReformatter()
        if frame.format.is_rgb:
            converted = reformatter.reformat(frame, format="rgb24")
        else:
            matrix = self._matrix()
            converted = reformatter.reformat(
                frame,
                format="rgb24",
                src_colorspace=matrix,
                # RGB has no matrix, but PyAV hands the source's on only where the two differ.
                dst_colorspace=_BT709 if matrix != _BT709 else _BT601,
                src_color_range=ColorRange.JPEG if self.full_range else ColorRange.MPEG,
                interpolation=Interpolation.BICUBIC,
            )
        return upright(converted.to_ndarray(), self.orientation)

    @property
    def damaged(self) -> bool:
        """True if the decoder had to make up parts of it."""
        return bool(self._frame.is_corrupt)

    def _matrix(self) -> int:
        stated = int(self._frame.colorspace)
        if stated == _UNSPECIFIED or self._frame.format.name == "gray":
            return _BT709 if self._frame.height >= _HD_LINES else _BT601
        if stated not in _MATRICES:
            raise RejectedInputError(
                "unreadable",
                "Colours of the video cannot be converted",
                where=self._where,
                expected="a matrix of " + ", ".join(dict.fromkeys(_MATRICES.values())),
                got=f"matrix coefficients {stated} (ITU-T H.273)",
                next_step="encode the video again with -vf scale=out_color_matrix=bt709 -colorspace bt709",
            )
        return stated
