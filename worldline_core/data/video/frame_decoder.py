"""Exact frames of recordings, by one of two decoders that give the same bytes.

`torchcodec` uses the machine's FFmpeg libraries, `pyav` carries its own. Either way a frame is found by its presentation
time, so a neighbouring frame is an error and never returned. Decoders keep a bounded number of files open: clips of
joined videos come from the same files again and again.
"""

from __future__ import annotations

import importlib.metadata
import logging
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Literal, Protocol

import av
import av.error
import numpy as np
from av.container import InputContainer
from av.video.stream import VideoStream

from worldline_core.data.guards.rejection import check_image_size
from worldline_core.data.guards.source_paths import AnyPath, local_file
from worldline_core.data.video.clip import (
    FRAME_TOLERANCE,
    VideoClip,
    check_video_header,
    frame_times,
    open_video,
    read_clip,
    seek_before,
    undecodable,
    wrong_count,
)
from worldline_core.errors import DataError, UnavailableError

if TYPE_CHECKING:
    from torchcodec.decoders import VideoDecoder

logger = logging.getLogger(__name__)

DecoderChoice = Literal["auto", "torchcodec", "pyav"]
_CHUNK_BYTES = 8 << 20
"""torchcodec's frames are fetched in chunks of this size, so that the allocator hands out the same warm memory again: for
whole clips of 480 x 640 the page faults of fresh memory cost about a third of the decoding."""
_NOT_IN_PLACE = "a frame is not where it should be"
FFMPEG_ADVICE = "install FFmpeg's libraries (apt-get install ffmpeg), or take decoder pyav, which carries its own"


class FrameDecoder(Protocol):
    """Frames of clips. ``name`` says which decoder and version it is."""

    name: str

    def frames(self, clip: VideoClip, indices: Sequence[int]) -> Iterator[np.ndarray]:
        """uint8 (H, W, 3) RGB of the clip's frames ``indices`` (increasing), one after the other.

        A picture is valid until the next one is asked for.

        Raises: RejectedInputError: missing_file; unreadable, truncated_video when a frame is not there. DataError when the
            indices are not increasing, or lie outside of the clip.
        """
        ...

    def close(self) -> None:
        """Close the files that are kept open."""
        ...


def open_decoder(choice: DecoderChoice = "auto", *, open_files: int = 16) -> FrameDecoder:
    """The decoder of a configuration; ``auto`` is torchcodec where it loads, else PyAV (the log says which).

    Args:
        open_files: how many files stay open at most.

    Raises: UnavailableError when torchcodec was asked for and cannot be loaded.
    """
    if choice == "pyav":
        return PyavDecoder(open_files=open_files)
    fault = torchcodec_fault()
    if fault is None:
        decoder = TorchcodecDecoder(open_files=open_files)
        logger.info("Videos are decoded with %s.", decoder.name)
        return decoder
    if choice == "torchcodec":
        raise UnavailableError(
            "torchcodec cannot be loaded.",
            where="decoder: torchcodec",
            expected="FFmpeg's shared libraries, version 4 to 8",
            got=fault,
            next_step=FFMPEG_ADVICE,
        )
    chosen = PyavDecoder(open_files=open_files)
    logger.warning("torchcodec cannot be loaded (%s): videos are decoded with %s.", fault, chosen.name)
    return chosen


@cache
def torchcodec_fault() -> str | None:
    """Why torchcodec cannot be used here, in a line, or None where it can. Loads it."""
    try:
        import torchcodec.decoders  # noqa: F401
    except (ImportError, OSError, RuntimeError) as error:  # it loads its libraries when imported
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        return f"{type(error).__name__}: {lines[0] if lines else 'no reason given'}"
    return None


def torchcodec_name() -> str:
    """Versions of torchcodec and of the FFmpeg that it found."""
    import torchcodec

    return f"torchcodec {torchcodec.__version__} (FFmpeg {torchcodec.ffmpeg_major_version})"


def _frame_times(clip: VideoClip, indices: Sequence[int]) -> list[float]:
    """Presentation times [s] of a clip's frames.

    Raises: DataError when the indices are not increasing, or lie outside of the clip.
    """
    if not indices or any(b <= a for a, b in pairwise(indices)):
        raise DataError("Frames are read in order", where=clip.path, expected="increasing indices", got=list(indices))
    if indices[0] < 0 or indices[-1] >= clip.num_frames:
        raise DataError(
            "Frame index outside of the clip",
            where=clip.path,
            expected=f"0 <= index < {clip.num_frames}",
            got=f"{indices[0]}..{indices[-1]}",
        )
    return [clip.start_time + index / clip.fps for index in indices]


class _OpenFiles[F]:
    """A bounded number of open files by path; the least recently used one is closed first.

    Args:
        limit: how many stay open at most.
        open_file: opens the file of a clip.
    """

    def __init__(self, limit: int, open_file: Callable[[AnyPath], AbstractContextManager[F]]) -> None:
        self._limit = limit
        self._open_file = open_file
        self._open: OrderedDict[str, tuple[F, ExitStack]] = OrderedDict()

    def get(self, path: AnyPath) -> F:
        """The file, opened unless it still is."""
        if str(path) not in self._open:
            with ExitStack() as stack:
                file = stack.enter_context(self._open_file(path))
                self._open[str(path)] = file, stack.pop_all()
            while len(self._open) > self._limit:
                self.drop(next(iter(self._open)))
        self._open.move_to_end(str(path))
        return self._open[str(path)][0]

    def drop(self, path: object) -> None:
        """Close a file, where it is open: it is opened afresh next time."""
        if str(path) in self._open:
            self._open.pop(str(path))[1].close()

    def clear(self) -> None:
        """Close all files."""
        for path in list(self._open):
            self.drop(path)


@contextmanager
def _in_one_thread(path: AnyPath) -> Iterator[tuple[InputContainer, VideoStream]]:
    with open_video(path) as (container, stream):
        # dav1d starts threads of its own unless told otherwise: processes are parallel already.
        stream.codec_context.thread_count = 1
        yield container, stream


class PyavDecoder:
    """FFmpeg as PyAV carries it. Colours are converted for the wanted frames alone."""

    name = f"PyAV {importlib.metadata.version('av')}"

    def __init__(self, *, open_files: int = 16) -> None:
        self._files = _OpenFiles(open_files, _in_one_thread)

    def frames(self, clip: VideoClip, indices: Sequence[int]) -> Iterator[np.ndarray]:
        times = _frame_times(clip, indices)
        found = 0
        try:
            for frame in seek_before(*self._files.get(clip.path), times[0]):
                if frame.time is None or frame.pts is None:
                    continue
                late = (float(frame.time) - times[found]) * clip.fps
                if late < -FRAME_TOLERANCE:
                    continue
                if late > FRAME_TOLERANCE:
                    break
                yield frame.to_ndarray(format="rgb24")
                found += 1
                if found == len(times):
                    return
        except av.error.FFmpegError as error:
            self._files.drop(clip.path)
            raise wrong_count(clip.path, len(times), found, str(error)) from error
        self._files.drop(clip.path)
        raise wrong_count(clip.path, len(times), found, _NOT_IN_PLACE)

    def close(self) -> None:
        self._files.clear()


class TorchcodecDecoder:
    """torchcodec on the CPU, one thread per file.

    Files are opened in its approximate mode, which reads the header alone, while the exact mode first reads through the
    whole file (hundreds of megabytes where episodes are joined). Approximate is only where it looks for a frame: the
    times of the decoded frames are compared with the wanted ones, and where one differs (variable frame rates), the file
    is opened again in exact mode, and stays so (`exact_files`).
    """

    def __init__(self, *, open_files: int = 16) -> None:
        self.name = torchcodec_name()
        self._files = _OpenFiles(open_files, self._opened)
        self.exact_files: set[str] = set()

    def frames(self, clip: VideoClip, indices: Sequence[int]) -> Iterator[np.ndarray]:
        times = _frame_times(clip, indices)
        done = 0
        while done < len(times):
            decoder = self._files.get(clip.path)
            frame_bytes = 3 * (decoder.metadata.width or 0) * (decoder.metadata.height or 0)
            wanted = times[done : done + max(1, _CHUNK_BYTES // max(1, frame_bytes))]
            pictures = _frames_at(decoder, clip, wanted)
            if pictures is None:
                self._files.drop(clip.path)
                if str(clip.path) in self.exact_files:
                    raise wrong_count(clip.path, len(times), done, _NOT_IN_PLACE)
                self.exact_files.add(str(clip.path))
                continue
            yield from pictures
            done += len(wanted)

    def close(self) -> None:
        self._files.clear()

    @contextmanager
    def _opened(self, path: AnyPath) -> Iterator[VideoDecoder]:
        from torchcodec.decoders import VideoDecoder

        file = check_video_header(local_file(path))
        try:
            decoder = VideoDecoder(
                str(file),
                dimension_order="NHWC",
                num_ffmpeg_threads=1,
                seek_mode="exact" if str(path) in self.exact_files else "approximate",
                device="cpu",
            )
        except (RuntimeError, ValueError) as error:
            raise undecodable(path, str(error).splitlines()[0]) from error
        check_image_size(decoder.metadata.width or 0, decoder.metadata.height or 0, path)
        yield decoder


def _frames_at(decoder: VideoDecoder, clip: VideoClip, times: list[float]) -> np.ndarray | None:
    """uint8 (n, H, W, 3) of the frames at `times` [s]; None where torchcodec does not find them in its present mode."""
    # A little after a frame begins: rounding must not name the frame before.
    inside = [time + FRAME_TOLERANCE / clip.fps for time in times]
    try:
        batch = decoder.get_frames_played_at(inside)
    except (RuntimeError, IndexError, ValueError):
        return None
    late = (batch.pts_seconds.numpy() - np.asarray(times)) * clip.fps
    return batch.data.numpy() if bool((np.abs(late) <= FRAME_TOLERANCE).all()) else None


def describe_decoders() -> dict[str, Any]:
    """What ``auto`` would take here and why, for `worldline doctor`."""
    fault = torchcodec_fault()
    return {
        "auto": torchcodec_name() if fault is None else PyavDecoder.name,
        "torchcodec": fault or "loads",
        "next_step": "" if fault is None else FFMPEG_ADVICE,
    }


def decode_video(path: AnyPath, expected_frames: int | None = None) -> np.ndarray:
    """All frames of a video, uint8 (N, H, W, 3), with PyAV.

    Raises: RejectedInputError naming the file and the frame counts when it is truncated, undecodable or of another length.
    """
    count = len(frame_times(path)) if expected_frames is None else expected_frames
    return np.stack([picture.rgb for picture in read_clip(VideoClip.whole_file(path, count, 1.0))])


def decode_frames(clip: VideoClip, indices: Sequence[int] | None = None) -> np.ndarray:
    """Exact frames of one clip, uint8 (len, H, W, 3), with PyAV.

    Args:
        indices: frame numbers inside the clip, in any order, also repeated; None for all.

    Raises: DataError when an index lies outside of the clip; RejectedInputError when a frame cannot be decoded.
    """
    wanted = range(clip.num_frames) if indices is None else [int(index) for index in indices]
    ordered = sorted(set(wanted))
    decoder = PyavDecoder(open_files=1)
    try:
        frames = dict(zip(ordered, decoder.frames(clip, ordered), strict=True))
    finally:
        decoder.close()
    return np.stack([frames[index] for index in wanted])
