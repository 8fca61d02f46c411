"""Exact frames of recordings for training, by one of two decoders that give the same bytes.

``torchcodec`` uses the machine's FFmpeg libraries, ``pyav`` carries its own. Either way a frame is found by its
presentation time, so a frame beside the wanted one is an error and never returned. Decoders keep a bounded number of
files open: clips of joined videos come from the same files again and again.
"""

from __future__ import annotations

import importlib.metadata
import logging
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from functools import cache
from itertools import pairwise
from typing import Any, Literal, Protocol

import av
import av.error
import numpy as np
from av.container import InputContainer
from av.video.stream import VideoStream

from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.video.clip import FRAME_TOLERANCE, VideoClip, open_video, seek_before, undecodable, wrong_count
from worldline_core.errors import DataError, UnavailableError

logger = logging.getLogger(__name__)

DecoderChoice = Literal["auto", "torchcodec", "pyav"]
FFMPEG_ADVICE = "install FFmpeg's libraries (apt-get install ffmpeg), or take decoder pyav, which carries its own"


class FrameDecoder(Protocol):
    """Frames of clips. ``name`` says which decoder and version it is."""

    name: str

    def frames(self, clip: VideoClip, indices: Sequence[int]) -> Iterator[np.ndarray]:
        """uint8 (H, W, 3) RGB of the clip's frames ``indices`` (increasing), one after the other.

        A picture is valid until the next one is asked for.

        Raises:
            RejectedInputError: missing_file; unreadable, truncated_video when a frame is not there.
            DataError: the indices are not increasing, or lie outside of the clip.
        """
        ...

    def close(self) -> None:
        """Close the files that are kept open."""
        ...


def open_decoder(choice: DecoderChoice = "auto", *, open_files: int = 16) -> FrameDecoder:
    """The decoder of a configuration; ``auto`` is torchcodec where it loads, else PyAV (the log says which).

    Args:
        open_files: how many files stay open at most.

    Raises:
        UnavailableError: torchcodec was asked for and cannot be loaded.
    """
    if choice == "pyav":
        return PyavDecoder(open_files=open_files)
    fault = torchcodec_fault()
    if fault is None:
        from worldline_core.data.video.torchcodec_decoder import TorchcodecDecoder

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


def frame_times(clip: VideoClip, indices: Sequence[int]) -> list[float]:
    """Presentation times [s] of a clip's frames.

    Raises:
        DataError: the indices are not increasing, or lie outside of the clip.
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


def lost_frame(clip: VideoClip, wanted: int, found: int, cause: str | None = None) -> RejectedInputError:
    """The rejection of a clip of which only ``found`` of ``wanted`` frames can be decoded."""
    return wrong_count(clip.path, wanted, found, cause or "a frame is not where it should be")


class OpenFiles[F]:
    """A bounded number of open things by path, the longest unused closed first."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._open: OrderedDict[str, F] = OrderedDict()

    def get(self, path: object) -> F | None:
        """What is open for a path, now the most recently used, or None."""
        key = str(path)
        if key in self._open:
            self._open.move_to_end(key)
        return self._open.get(key)

    def add(self, path: object, value: F) -> list[F]:
        """Keep one more; returns those that have to be closed for it."""
        self._open[str(path)] = value
        return [self._open.popitem(last=False)[1] for _ in range(len(self._open) - self.limit)]

    def remove(self, path: object) -> F | None:
        """Forget one."""
        return self._open.pop(str(path), None)

    def clear(self) -> list[F]:
        """Forget all and return them."""
        values = list(self._open.values())
        self._open.clear()
        return values

    def __len__(self) -> int:
        return len(self._open)


class _PyavFile:
    def __init__(self, clip: VideoClip) -> None:
        self._stack = ExitStack()
        self.container: InputContainer
        self.stream: VideoStream
        self.container, self.stream = self._stack.enter_context(open_video(clip.path))
        # dav1d starts threads of its own unless told otherwise: processes are parallel already.
        self.stream.codec_context.thread_count = 1

    def close(self) -> None:
        self._stack.close()


class PyavDecoder:
    """FFmpeg as PyAV carries it. Colours are converted for the wanted frames alone."""

    name = f"PyAV {importlib.metadata.version('av')}"

    def __init__(self, *, open_files: int = 16) -> None:
        self._files: OpenFiles[_PyavFile] = OpenFiles(open_files)

    def frames(self, clip: VideoClip, indices: Sequence[int]) -> Iterator[np.ndarray]:
        times = frame_times(clip, indices)
        found = 0
        try:
            file = self._file(clip)
            for frame in seek_before(file.container, file.stream, times[0]):
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
            self._drop(clip)
            raise undecodable(clip.path, error) from error
        self._drop(clip)
        raise lost_frame(clip, len(times), found)

    def close(self) -> None:
        for file in self._files.clear():
            file.close()

    def _file(self, clip: VideoClip) -> _PyavFile:
        file = self._files.get(clip.path)
        if file is None:
            file = _PyavFile(clip)
            for old in self._files.add(clip.path, file):
                old.close()
        return file

    def _drop(self, clip: VideoClip) -> None:
        """A file that failed is opened afresh next time."""
        file = self._files.remove(clip.path)
        if file is not None:
            file.close()


def describe_decoders() -> dict[str, Any]:
    """What ``auto`` would take here and why, for `worldline doctor`."""
    fault = torchcodec_fault()
    return {
        "auto": torchcodec_name() if fault is None else PyavDecoder.name,
        "torchcodec": fault or "loads",
        "next_step": "" if fault is None else FFMPEG_ADVICE,
    }
