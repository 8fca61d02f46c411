"""Writing video with PyAV, reproducibly and frame by frame; joining videos without encoding.

Axis legend: frames are `uint8 (N, H, W, 3)`, RGB, first frame first.

Encoding is single-threaded and without B-frames, so the same frames give the same bytes, each clip starts at a key frame,
and presentation order equals file order: clips can be joined without encoding again and found by frame number. The encoder
is libx264 (H.264, GPL), or libaom (AV1, BSD) where WORLDLINE_VIDEO_CODEC is `av1`.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain
from pathlib import Path
from types import TracebackType
from typing import Literal, Self, cast

import av
import cv2
import numpy as np
from av import Packet
from av.bitstream import BitStreamFilterContext
from av.codec.context import Flags
from av.container import OutputContainer
from av.video.stream import VideoStream

from worldline_core.errors import ConfigError, DataError, UnavailableError

_START_CODE = b"\x00\x00\x01"


def length_prefixed(packet: Packet, stream: VideoStream) -> Packet:
    """The packet as mp4 holds H.264 and H.265: with the length before each NAL unit instead of a start code.

    FFmpeg's bitstream filters give packets with start codes (Annex B), and its mp4 writer stores them unchanged even
    when the stream's header announces lengths. FFmpeg decodes that; other players and LeRobot's tools do not.

    Args:
        stream: whose header (avcC, hvcC: it begins with 1) says that lengths are expected.
    """
    header = stream.codec_context.extradata
    if not header or header[0] != 1 or stream.codec_context.codec.canonical_name not in ("h264", "hevc"):
        return packet
    data = bytes(packet)
    if not data.startswith(b"\x00" + _START_CODE) or _are_lengths(data):
        return packet
    # A NAL unit ends without zeros and holds no start code (emulation prevention), so splitting at start codes is exact.
    units = [unit.rstrip(b"\x00") for unit in data.split(_START_CODE)]
    prefixed = Packet(b"".join(len(unit).to_bytes(4, "big") + unit for unit in units if unit))
    prefixed.pts, prefixed.dts, prefixed.duration = packet.pts, packet.dts, packet.duration
    prefixed.is_keyframe = packet.is_keyframe
    if packet.time_base is not None:
        prefixed.time_base = packet.time_base
    return prefixed


def _are_lengths(data: bytes) -> bool:
    position = 0
    while position + 4 < len(data):
        position += 4 + int.from_bytes(data[position : position + 4], "big")
    return position == len(data)


PixelFormat = Literal["yuv420p", "yuv444p"]
VideoCodec = Literal["h264", "av1"]
CODEC_VARIABLE = "WORLDLINE_VIDEO_CODEC"
_ENCODERS: dict[VideoCodec, str] = {"h264": "libx264", "av1": "libaom-av1"}

# BT.601, limited range, at every size, and stated in the file: readers that ignore what it states (OpenCV) assume it too.
# Rows give Y, U, V of an RGB value in 0..255.
_RGB_TO_YUV = np.array(
    [[65.481, 128.553, 24.966], [-37.797, -74.203, 112.0], [112.0, -93.786, -18.214]], dtype=np.float32
) / np.float32(255.0)
_YUV_OFFSET = (16.0, 128.0, 128.0)
BITEXACT = {"fflags": "+bitexact", "movflags": "+faststart"}
"""Options of an mp4 that is written, so that its bytes hold no times and no versions."""
X264_PARAMETERS = "cpu-independent=1"
"""Without this x264 chooses other algorithms on other processors, and with AVX-512 about one clip in a hundred came out
differently from run to run."""


def video_codec() -> VideoCodec:
    """The codec that videos are encoded with, as the environment variable WORLDLINE_VIDEO_CODEC says (default: h264).

    Raises: ConfigError for another codec; UnavailableError where the installed PyAV has no encoder for it.
    """
    codec = os.environ.get(CODEC_VARIABLE) or "h264"
    if codec not in _ENCODERS:
        raise ConfigError(
            "Not a codec to encode with", where=CODEC_VARIABLE, expected=" or ".join(_ENCODERS), got=codec
        )
    codec = cast("VideoCodec", codec)
    if _ENCODERS[codec] not in av.codecs_available:
        raise UnavailableError(
            "PyAV has no encoder for the videos that are written",
            where=f"PyAV {av.__version__}",
            expected=_ENCODERS[codec],
            next_step=f"set {CODEC_VARIABLE}={'av1' if codec == 'h264' else 'h264'}, or install PyAV's wheel",
        )
    return codec


def _encoder_options(codec: VideoCodec, encoding: Encoding) -> dict[str, str]:
    if codec == "h264":
        return {"crf": str(encoding.crf), "preset": encoding.preset, "bf": "0", "x264-params": X264_PARAMETERS}
    # AV1's scale of quality has 63 steps instead of 51. Without lag no frame waits for later ones.
    crf = str(round(encoding.crf * 1.1))
    return {"crf": crf, "b:v": "0", "usage": "realtime", "cpu-used": "8", "lag-in-frames": "0", "row-mt": "0"}


@contextmanager
def new_mp4(path: Path) -> Iterator[OutputContainer]:
    """An mp4 to write packets into, which is ended with the context.

    Of one that could not be written (a full disk) nothing more is asked: FFmpeg crashes where a packet follows a header that
    did not fit.
    """
    out = av.open(str(path), "w", format="mp4", options=BITEXACT)
    try:
        yield out
    except BaseException:
        with suppress(OSError):
            out.close()
        raise
    out.close()


def frame_rate(fps: float) -> Fraction:
    """Frames per second as an exact fraction (29.97 becomes 30000/1001).

    Raises: DataError when fps is not a positive number.
    """
    if not np.isfinite(fps) or fps <= 0:
        raise DataError("Frame rate must be a positive number", expected="fps > 0", got=fps)
    return Fraction(fps).limit_denominator(1001)


def _planar(frame: np.ndarray, pixel_format: PixelFormat) -> np.ndarray:
    """One RGB frame (H, W, 3) as the stacked planes that `VideoFrame.from_ndarray` expects."""
    rgb = frame.astype(np.float32)
    luma = rgb @ _RGB_TO_YUV[0] + _YUV_OFFSET[0]
    height, width = frame.shape[:2]
    if pixel_format == "yuv420p":
        # Chroma from the mean of each 2x2 block, not from one of its pixels: small coloured objects keep their hue.
        rgb = cv2.resize(rgb, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    planes = [luma, rgb @ _RGB_TO_YUV[1] + _YUV_OFFSET[1], rgb @ _RGB_TO_YUV[2] + _YUV_OFFSET[2]]
    quantised = [np.clip(np.rint(plane), 0, 255).astype(np.uint8) for plane in planes]
    if pixel_format == "yuv444p":
        return np.stack(quantised)
    flat = np.concatenate([plane.reshape(-1) for plane in quantised])
    return flat.reshape(height * 3 // 2, width)


@dataclass(frozen=True)
class Encoding:
    """Encoding of pictures.

    Attributes:
        crf: quality, 0 (exact up to the colour conversion) .. 51; 18 is visually exact, 28 small.
        preset: of x264; at 128 x 192, slow saves 3 % of the bytes and takes 2.6 times as long as veryfast.
        key_frame_interval: frames from one key frame to the next at most.
    """

    crf: int = 18
    preset: str = "veryfast"
    pixel_format: PixelFormat = "yuv420p"
    key_frame_interval: int = 250


class VideoEncoder:
    """Writes an mp4 picture by picture; use as a context manager. Its bytes depend on the arguments and the codec alone.

    Args:
        size: (height, width); both even for yuv420p.

    Raises: ConfigError for a size that the pixel format cannot hold, DataError for a rate that cannot be encoded.
    """

    def __init__(self, path: Path, size: tuple[int, int], fps: float, encoding: Encoding) -> None:
        height, width = size
        pixel_format = encoding.pixel_format
        if pixel_format == "yuv420p" and (height % 2 or width % 2):
            raise ConfigError(
                "Pictures of an odd size cannot be encoded as yuv420p",
                where=path,
                expected="even height and width",
                got=f"{height}x{width}",
                next_step="set image_size to even sides, or pixel_format to yuv444p",
            )
        self.path = path
        self.size = size
        self.codec = video_codec()
        self.count = 0
        self._rate = frame_rate(fps)
        self._pixel_format: PixelFormat = pixel_format
        self._writing = ExitStack()
        self._out = self._writing.enter_context(new_mp4(path))
        stream = cast("VideoStream", self._out.add_stream(_ENCODERS[self.codec], rate=self._rate))
        stream.width, stream.height, stream.pix_fmt = width, height, pixel_format
        context = stream.codec_context
        context.thread_count = 1
        context.time_base = 1 / self._rate
        context.flags |= int(Flags.bitexact)
        stream.options = {
            **_encoder_options(self.codec, encoding),
            "g": str(encoding.key_frame_interval),
            "threads": "1",
            "colorspace": "smpte170m",
            "color_primaries": "bt709",
            "color_trc": "bt709",
            "color_range": "tv",
        }
        self._stream = stream

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._writing:
            if error is not None:
                raise error
            if self.count:
                self._out.mux(self._stream.encode(None))  # what the encoder still holds

    def add(self, image: np.ndarray) -> None:
        """The next picture, uint8 (H, W, 3) RGB.

        Raises: DataError when it has another size or type.
        """
        if image.dtype != np.uint8 or image.shape != (*self.size, 3):
            raise DataError(
                "Pictures of a video differ",
                where=f"{self.path}, frame {self.count}",
                expected=f"uint8 {(*self.size, 3)}",
                got=f"{image.dtype} {image.shape}",
            )
        picture = av.VideoFrame.from_ndarray(_planar(image, self._pixel_format), format=self._pixel_format)
        picture.pts = self.count
        picture.time_base = 1 / self._rate
        self._out.mux(self._stream.encode(picture))
        self.count += 1


def encode_video(
    path: Path,
    frames: Iterable[np.ndarray],
    fps: float,
    *,
    crf: int = 18,
    preset: str = "veryfast",
    pixel_format: PixelFormat = "yuv420p",
) -> None:
    """Write frames as an mp4 whose bytes depend on the arguments and the codec alone.

    Args:
        frames: uint8 (H, W, 3) RGB one after the other; H and W even for yuv420p.
        crf: quality, 0 (exact up to the colour conversion) .. 51.

    Raises: DataError for empty, wrongly shaped or wrongly typed frames; ConfigError for odd sides as yuv420p.
    """
    remaining = iter(frames)
    first = next(remaining, None)
    if first is None or first.ndim != 3 or first.shape[2] != 3 or first.dtype != np.uint8:
        raise DataError(
            "Cannot encode these frames as video",
            where=path,
            expected="uint8 (H, W, 3), one or more",
            got="none" if first is None else f"{first.dtype} {first.shape}",
        )
    encoding = Encoding(crf, preset, pixel_format)
    with VideoEncoder(path, (first.shape[0], first.shape[1]), fps, encoding) as encoder:
        for frame in chain([first], remaining):
            encoder.add(frame)


def concatenate_videos(path: Path, parts: Sequence[tuple[Path, int]], fps: float) -> None:
    """Join clips of one encoder setting into one mp4 without encoding again.

    Args:
        parts: (clip written by `encode_video`, its frame count), in order.

    Raises: DataError when a part holds another number of frames than stated, or was encoded with other settings than the first.
    """
    rate = frame_rate(fps)
    with new_mp4(path) as out:
        stream, header = None, None
        first_frame = 0
        for part, expected in parts:
            count = 0
            with av.open(str(part)) as source:
                template = source.streams.video[0]
                is_h264 = template.codec_context.codec.canonical_name == "h264"
                if stream is None:
                    # Opaque where the decoder (dav1d) has another name than an encoder.
                    stream = out.add_stream_from_template(template, opaque=not is_h264)
                    stream.time_base, header = template.time_base, template.codec_context.extradata
                elif template.codec_context.extradata != header:  # decoders read the header of the first one
                    raise DataError(
                        "Video part was encoded with other settings than those before it",
                        where=part,
                        next_step="remove it: it is recorded again",
                    )
                ticks = 1 / (rate * (template.time_base or 1 / rate))
                # x264's own message (a kilobyte of settings) would otherwise repeat for each clip.
                without_message = BitStreamFilterContext("filter_units=remove_types=6" if is_h264 else "null", template)
                for filtered in _filtered(source.demux(template), without_message):
                    packet = length_prefixed(filtered, template)
                    packet.pts = packet.dts = round((first_frame + count) * ticks)
                    packet.stream = stream
                    out.mux(packet)
                    count += 1
            if count != expected:
                raise DataError(
                    "Video part has another length than its episode",
                    where=part,
                    expected=f"{expected} frames",
                    got=f"{count} frames",
                )
            first_frame += count


def _filtered(packets: Iterator[av.Packet], context: BitStreamFilterContext) -> Iterator[av.Packet]:
    for packet in packets:
        if packet.size:  # the demuxer ends with an empty flushing packet
            yield from context.filter(packet)
    yield from context.filter(None)
