"""The decoder against PyAV's plain frame-by-frame decoding: same frames, same bytes, whatever the file is like."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import av
import numpy as np
import pytest

from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.video.clip import FrameDecoder, VideoClip
from worldline_core.data.video.encoder import concatenate_videos, encode_video
from worldline_core.errors import DataError

FPS = 10.0


def moving(count: int, *, seed: int = 0, height: int = 48, width: int = 64) -> np.ndarray:
    """Frames of which no two are alike."""
    rows, columns = np.mgrid[:height, :width]
    background = np.random.default_rng(seed).integers(60, 190, (height // 8, width // 8, 3)).repeat(8, 0).repeat(8, 1)
    frames = np.empty((count, height, width, 3), np.uint8)
    for index in range(count):
        bump = np.exp(-((rows - 24 - 16 * np.sin(0.3 * index)) ** 2 + (columns - (3 * index) % width) ** 2) / 60)
        frames[index] = np.clip(background + 120 * (bump[..., None] - 0.5 * bump[..., None] * [1, 0, 1]), 0, 255)
    return frames


def write(
    path: Path, frames: np.ndarray, codec: str = "libx264", times: list[int] | None = None, **options: str
) -> Path:
    """A file as other tools write them. ``times``: presentation times in frames (default 0, 1, 2, ...)."""
    with av.open(str(path), "w") as out:
        stream = out.add_stream(codec, rate=int(FPS), options=options)
        stream.height, stream.width, stream.pix_fmt = frames.shape[1], frames.shape[2], "yuv420p"
        for index, frame in enumerate(frames):
            picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
            picture.pts = index if times is None else times[index]
            out.mux(stream.encode(picture))
        out.mux(stream.encode(None))
    return path


def plain(path: Path) -> list[np.ndarray]:
    """Every frame of a file, in the order of presentation, with nothing of this project."""
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


@pytest.fixture
def decoder() -> Iterator[FrameDecoder]:
    opened = FrameDecoder(open_files=2)
    yield opened
    opened.close()


def b_frames(path: Path) -> Path:
    return write(path, moving(60), bf="3", g="24", preset="medium")


def av1(path: Path) -> Path:
    return write(path, moving(60), "libsvtav1", preset="12", g="24", **{"svtav1-params": "lp=1"})


def hevc(path: Path) -> Path:
    return write(path, moving(60), "libx265", preset="fast", **{"x265-params": "bframes=3:keyint=24:log-level=none"})


def open_gop(path: Path) -> Path:
    return write(path, moving(60), **{"x264-params": "open-gop=1:bframes=3:keyint=20:min-keyint=20"})


def own(path: Path) -> Path:
    encode_video(path, moving(60), FPS, preset="fast")
    return path


@pytest.mark.parametrize("make", [own, b_frames, open_gop, av1, hevc])
def test_frames_are_those_of_plain_decoding(
    make: Callable[[Path], Path], decoder: FrameDecoder, tmp_path: Path
) -> None:
    path = make(tmp_path / "video.mp4")
    expected = plain(path)
    assert len({frame.tobytes() for frame in expected}) == 60
    clip = VideoClip(path, 60, FPS, 0.0)
    wanted = (range(60), range(33), range(20, 60, 3), [59], [0], [23, 24, 25], [1, 19, 20, 58], range(7, 40, 4))
    for indices in wanted:
        frames = [frame.copy() for frame in decoder.frames(clip, indices)]
        assert len(frames) == len(indices)
        for index, frame in zip(indices, frames, strict=True):
            assert np.array_equal(frame, expected[index]), index


def test_clips_of_joined_videos_start_where_they_should(decoder: FrameDecoder, tmp_path: Path) -> None:
    lengths = (13, 21, 8)
    for number, length in enumerate(lengths):
        encode_video(tmp_path / f"{number}.mp4", moving(length, seed=number), FPS, preset="fast")
    parts = [(tmp_path / f"{number}.mp4", length) for number, length in enumerate(lengths)]
    concatenate_videos(tmp_path / "joined.mp4", parts, FPS)
    start = 0
    for part, length in parts:
        clip = VideoClip(tmp_path / "joined.mp4", length, FPS, start / FPS)
        cut = clip.cut(2, length - 1)
        expected = plain(part)
        for index, frame in enumerate(decoder.frames(clip, range(length))):
            assert np.array_equal(frame, expected[index])
        assert np.array_equal(next(iter(decoder.frames(cut, [3]))), expected[5])
        start += length


def test_a_gap_in_the_times_is_found_and_the_frames_around_it_are_exact(decoder: FrameDecoder, tmp_path: Path) -> None:
    times = [*range(20), *range(23, 43)]
    path = write(tmp_path / "gap.mp4", moving(40), times=times, g="12")
    expected = dict(zip(times, plain(path), strict=True))
    clip = VideoClip(path, 43, FPS, 0.0)
    for indices in ([0, 5, 19], [23, 24, 42], [18, 19, 23, 30], range(25, 41, 5)):
        for index, frame in zip(indices, decoder.frames(clip, indices), strict=True):
            assert np.array_equal(frame, expected[index]), index
    for indices in ([21], [19, 20, 23]):
        with pytest.raises(RejectedInputError, match=r"truncated or undecodable[\s\S]*gap\.mp4") as caught:
            list(decoder.frames(clip, indices))
        assert caught.value.reason == "truncated_video"
    # A failure leaves the decoder usable.
    assert np.array_equal(next(iter(decoder.frames(clip, [7]))), expected[7])


def test_a_clip_longer_than_its_file_is_refused(decoder: FrameDecoder, tmp_path: Path) -> None:
    path = own(tmp_path / "short.mp4")
    clip = VideoClip(path, 80, FPS, 0.0)
    assert len(list(decoder.frames(clip, range(55, 60)))) == 5
    with pytest.raises(RejectedInputError, match="truncated or undecodable"):
        list(decoder.frames(clip, range(55, 70)))


def test_damaged_and_missing_files_are_named(decoder: FrameDecoder, tmp_path: Path) -> None:
    whole = own(tmp_path / "whole.mp4").read_bytes()
    (tmp_path / "half.mp4").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.mp4").write_text("no video at all")
    for name in ("half.mp4", "text.mp4", "absent.mp4"):
        with pytest.raises(RejectedInputError, match=name):
            list(decoder.frames(VideoClip(tmp_path / name, 60, FPS, 0.0), range(60)))


def test_indices_must_rise_and_lie_inside(decoder: FrameDecoder, tmp_path: Path) -> None:
    clip = VideoClip(own(tmp_path / "video.mp4"), 60, FPS, 0.0)
    for indices in ([], [3, 3], [4, 2]):
        with pytest.raises(DataError, match="read in order"):
            list(decoder.frames(clip, indices))
    for indices in ([-1, 2], [58, 60]):
        with pytest.raises(DataError, match="outside of the clip"):
            list(decoder.frames(clip, indices))


def test_open_files_are_bounded(decoder: FrameDecoder, tmp_path: Path) -> None:
    paths = []
    for number in range(4):
        paths.append(tmp_path / f"{number}.mp4")
        encode_video(paths[-1], moving(5, seed=number), FPS, preset="ultrafast")

    def descriptors() -> int:
        return sum(
            Path(link).exists() and Path(link).resolve().parent == tmp_path for link in Path("/proc/self/fd").glob("*")
        )

    for _ in range(3):
        for number, path in enumerate(paths):
            first = next(iter(decoder.frames(VideoClip(path, 5, FPS, 0.0), [0])))
            assert np.array_equal(first, plain(paths[number])[0])
            assert 1 <= descriptors() <= 2
    decoder.close()
    assert descriptors() == 0
