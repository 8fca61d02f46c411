"""Pictures of a video in order, few of them in memory at a time: whatever reads a whole episode reads it through these."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from io import BytesIO
from itertools import batched, islice
from typing import Any, Protocol

import numpy as np

from worldline_core.data.guards.plain_files import expect_layout
from worldline_core.data.video.clip import VideoClip, decode_frames, read_clip, shown_size


class Frames(Protocol):
    """Pictures in order, uint8 (n, h, w, 3), or images (n, h, w): an array, `VideoFrames` or `MadeFrames`."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[Any]: ...


class VideoFrames:
    """Frames of an encoded video, decoded when they are asked for: one after the other, or some of them.

    Args:
        stride: every how many-th frame of the file is one of these.
    """

    def __init__(self, clip: VideoClip, stride: int = 1) -> None:
        self._clip = clip
        self._stride = stride

    def __len__(self) -> int:
        return 1 + (self._clip.num_frames - 1) // self._stride

    @property
    def shape(self) -> tuple[int, ...]:
        """(n, h, w, 3), by the file's first picture."""
        return len(self), *shown_size(self._clip.path)[:2], 3

    def __iter__(self) -> Iterator[np.ndarray]:
        """Raises: as `read_clip`."""
        for number, picture in enumerate(read_clip(self._clip)):
            if number % self._stride == 0:
                yield picture.rgb

    def __getitem__(self, indices: list[int]) -> np.ndarray:
        """uint8 (len, h, w, 3) of these frames; raises as `decode_frames`."""
        return decode_frames(self._clip, [self._stride * index for index in indices])


class MadeFrames:
    """Images made one after the other, each time they are iterated.

    Args:
        make: gives the images from the first one on.
        shape: (n, ...) of all of them; (n,) where their size is not known before.
    """

    def __init__(self, make: Callable[[], Iterable[np.ndarray]], shape: tuple[int, ...], dtype: type) -> None:
        self._make = make
        self.shape = shape
        self.dtype = np.dtype(dtype)

    def __len__(self) -> int:
        return self.shape[0]

    def __iter__(self) -> Iterator[np.ndarray]:
        return iter(self._make())

    def __getitem__(self, part: slice) -> MadeFrames:
        start, stop, step = part.indices(len(self))
        count = len(range(start, stop, step))
        return MadeFrames(lambda: islice(self, start, stop, step), (count, *self.shape[1:]), self.dtype.type)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """All of them in memory: for short ones, and tests."""
        return np.array(list(self), dtype=dtype or self.dtype).reshape(self.shape)


def pieces(frames: Iterable[np.ndarray], size: int) -> Iterator[np.ndarray]:
    """All frames in order, ``size`` (in the end fewer) at a time."""
    return (np.stack(part) for part in batched(frames, size))


def in_step[Name](videos: Mapping[Name, Frames]) -> Iterator[dict[Name, np.ndarray]]:
    """The pictures of several videos instant by instant, as long as all of them last."""
    instants = zip(*videos.values(), strict=False)
    for pictures in islice(instants, min(map(len, videos.values()), default=0)):
        yield dict(zip(videos, pictures, strict=True))


PACKED = "packed bits or bytes of (N, H, W), compressed with zlib"


def packed_images(images: Frames, dtype: type, level: int) -> np.ndarray:
    """uint8 (bytes,): images (N, H, W), masks (`dtype` bool) as bits and labels (uint8) as bytes, compressed with zlib."""
    compressor = zlib.compressobj(level)
    # Of eight masks the bits end with a byte, whatever the size of an image.
    parts = (part.astype(dtype) for part in pieces(images, 8))
    content = (np.packbits(part) if dtype is bool else part for part in parts)
    packed = [compressor.compress(values.tobytes()) for values in content]
    return np.frombuffer(b"".join([*packed, compressor.flush()]), np.uint8)


def unpacked_images(packed: bytes, shape: tuple[int, int, int], dtype: type, where: object) -> Iterator[np.ndarray]:
    """The images (N, H, W), one after the other. No more is unpacked than they take: a kilobyte could become a gigabyte.

    Raises: RejectedInputError (unreadable) for other bytes, or another number of them.
    """
    count, height, width = shape
    decompressor, source = zlib.decompressobj(), BytesIO(packed)

    def read(length: int) -> bytes:
        found: list[bytes] = []
        while length and not decompressor.eof and (data := decompressor.unconsumed_tail or source.read(1 << 16)):
            found.append(decompressor.decompress(data, length))
            length -= len(found[-1])
        return b"".join(found)

    for begin in range(0, count, 8):
        size = min(8, count - begin) * height * width
        length = -(-size // 8) if dtype is bool else size
        with expect_layout(where, PACKED):
            try:
                content = read(length) + (read(1) if begin + 8 >= count else b"")
            except zlib.error as error:
                raise ValueError(str(error)) from error
            if len(content) != length:
                raise ValueError(f"{len(content)} bytes or more instead of {length} from image {begin} on")
        values = np.frombuffer(content, np.uint8)
        if dtype is bool:
            values = np.unpackbits(values, count=size).astype(bool)
        yield from values.reshape(-1, height, width)
