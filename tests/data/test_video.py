"""Videos as they are encoded; clips of them against plain decoding: one by one, in order, or copied packet by packet."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from tests.data.curating import packets, plain_frames, rejected, write_video
from worldline_core.data.episodes.view_recording import VideoSettings, ViewImages, copy_clip, store_view
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.video.clip import (
    FrameDecoder,
    VideoClip,
    decode_frames,
    decode_video,
    open_video,
    read_clip,
    video_size,
)
from worldline_core.data.video.encoder import (
    CODEC_VARIABLE,
    X264_PARAMETERS,
    Encoding,
    VideoEncoder,
    concatenate_videos,
    encode_video,
)
from worldline_core.errors import ConfigError, DataError, UnavailableError

FPS, COUNT = 30.0, 60
X264 = {"g": "12", "bf": "3"}
ENCODERS = {
    "h264": ("libx264", {"g": "12", "bf": "0", "preset": "ultrafast"}),
    "h264_b_frames": ("libx264", {**X264, "x264-params": "b-pyramid=normal:keyint=12"}),
    "h264_open_gop": ("libx264", {"bf": "3", "x264-params": "open-gop=1:keyint=12:min-keyint=4"}),
    "hevc": ("libx265", {"preset": "ultrafast", "x265-params": "log-level=none:keyint=12:bframes=3"}),
    "av1": ("libsvtav1", {"preset": "12", "g": "12", "svtav1-params": "lp=1"}),
}


def scene(count: int = COUNT, seed: int = 0, size: tuple[int, int] = (64, 96)) -> np.ndarray:
    """A texture that moves and never repeats: each frame is unlike its neighbours."""
    generator = np.random.default_rng(seed)
    texture = generator.integers(30, 220, (size[0] // 4 + count, size[1] // 4 + count, 3)).astype(np.uint8)
    texture = texture.repeat(4, axis=0).repeat(4, axis=1)
    return np.stack([texture[2 * t : 2 * t + size[0], t : t + size[1]] for t in range(count)])


def write(path: Path, kind: str, frames: np.ndarray, **how: object) -> Path:
    codec, options = ENCODERS[kind]
    return write_video(path, frames, rate=30, codec=codec, options=options, **how)  # type: ignore[arg-type]


Recorded = dict[str, tuple[Path, np.ndarray]]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """A video of each kind and its frames."""
    folder = tmp_path_factory.mktemp("recorded")
    paths = {kind: write(folder / f"{kind}.mp4", kind, scene()) for kind in ENCODERS}
    encode_video(folder / "own.mp4", scene(), FPS, preset="fast")
    return {kind: (path, plain_frames(path)) for kind, path in (paths | {"own": folder / "own.mp4"}).items()}


@pytest.fixture
def decoder() -> Iterator[FrameDecoder]:
    opened = FrameDecoder(open_files=2)
    yield opened
    opened.close()


def shown(clip: VideoClip) -> np.ndarray:
    return np.stack([picture.rgb for picture in read_clip(clip)])


def copied(clip: VideoClip, target: Path) -> np.ndarray | None:
    """The frames that are seen while copying, or None where the clip cannot be copied."""
    with open_video(clip.path) as (container, stream):
        pictures = copy_clip(clip, container, stream, target)
        return None if pictures is None else np.stack([picture.rgb for picture in pictures])


@pytest.mark.parametrize("kind", [*ENCODERS, "own"])
def test_frames_are_those_of_plain_decoding(
    recorded: Recorded, decoder: FrameDecoder, tmp_path: Path, kind: str
) -> None:
    source, expected = recorded[kind]
    assert len({frame.tobytes() for frame in expected}) == COUNT
    clip = VideoClip(source, COUNT, FPS, 0.0)
    for indices in (range(60), range(33), range(20, 60, 3), [59], [0], [23, 24, 25], [1, 19, 20, 58], range(7, 40, 4)):
        found = [frame.copy() for frame in decoder.frames(clip, indices)]
        assert np.array_equal(np.stack(found), expected[list(indices)])
    whole = VideoClip.whole_file(source, COUNT, FPS)
    seen = copied(whole, tmp_path / "copy.mp4")
    assert seen is not None
    assert np.array_equal(seen, expected)
    assert packets(tmp_path / "copy.mp4") == packets(source)
    # Each frame has its place on the grid, and is found there alone as well.
    for path in (source, tmp_path / "copy.mp4"):
        clip = VideoClip(path, COUNT, FPS, 0.0)
        assert np.array_equal(decode_frames(clip), expected)
        assert all(np.array_equal(decode_frames(clip, [number])[0], expected[number]) for number in range(0, COUNT, 5))
    copied(whole, tmp_path / "again.mp4")
    assert (tmp_path / "again.mp4").read_bytes() == (tmp_path / "copy.mp4").read_bytes()


@pytest.mark.parametrize("kind", ["h264_b_frames", "av1"])
def test_times_that_start_late_or_are_uneven_are_put_on_the_grid(tmp_path: Path, kind: str) -> None:
    times = range(7000, 7000 + 26 * 3001, 3001)
    source = write(tmp_path / "source.mp4", kind, scene(26), times=times, tick=Fraction(1, 90000))
    seen = copied(VideoClip.whole_file(source, 26, FPS), tmp_path / "copy.mp4")
    assert seen is not None
    assert np.array_equal(seen, plain_frames(source))
    assert np.array_equal(decode_frames(VideoClip(tmp_path / "copy.mp4", 26, FPS, 0.0)), seen)


@pytest.mark.parametrize("kind", ["h264", "h264_b_frames", "h264_open_gop", "av1"])
def test_a_part_that_begins_at_a_key_frame_is_copied(recorded: Recorded, tmp_path: Path, kind: str) -> None:
    source, expected = recorded[kind]
    with av.open(str(source)) as container:
        stream = container.streams.video[0]
        rate = float(stream.time_base) * FPS  # type: ignore[arg-type]
        keys = {round((p.pts or 0) * rate) for p in container.demux(stream) if p.size and p.is_keyframe}
    for start in {*keys, 29} - {COUNT}:
        clip = VideoClip(source, min(24, COUNT - start), FPS, from_time=start / FPS)
        wanted = expected[start : start + clip.num_frames]
        assert np.array_equal(shown(clip), wanted)
        seen = copied(clip, tmp_path / "copy.mp4")
        # Frames that are shown before an open group's key frame are stored behind it.
        assert kind == "h264_open_gop" or (seen is not None) == (start in keys)
        if seen is not None:
            assert np.array_equal(seen, wanted)
            assert np.array_equal(plain_frames(tmp_path / "copy.mp4"), wanted)


@pytest.mark.parametrize("codec", ["h264", "av1"])
@pytest.mark.parametrize(("fps", "pixel_format"), [(8.0, "yuv420p"), (29.97, "yuv444p"), (30.0, "yuv420p")])
def test_clips_of_joined_videos_start_where_they_should(
    decoder: FrameDecoder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, codec: str, fps: float, pixel_format: str
) -> None:
    monkeypatch.setenv(CODEC_VARIABLE, codec)
    parts = [(tmp_path / f"{count}.mp4", count) for count in (12, 7, 9)]
    for path, count in parts:
        encode_video(path, scene(count, count), fps, pixel_format=pixel_format)  # type: ignore[arg-type]
    concatenate_videos(tmp_path / "joined.mp4", parts, fps)
    first = 0
    for path, count in parts:
        expected, clip = plain_frames(path), VideoClip(tmp_path / "joined.mp4", count, fps, first / fps)
        wanted = [count - 1, 0, 3, 3]
        assert np.array_equal(decode_frames(clip), expected)
        assert np.array_equal(decode_frames(clip, wanted), expected[wanted])
        assert np.array_equal(np.stack(list(decoder.frames(clip, range(count)))), expected)
        assert np.array_equal(next(iter(decoder.frames(clip.cut(2, count - 1), [3]))), expected[5])
        seen = copied(clip, tmp_path / "copy.mp4")
        assert seen is not None
        assert np.array_equal(seen, expected)
        assert np.array_equal(plain_frames(tmp_path / "copy.mp4"), expected)
        first += count


def test_frames_are_cut_off_and_a_wrong_count_is_refused(
    recorded: Recorded, decoder: FrameDecoder, tmp_path: Path
) -> None:
    source, expected = recorded["h264"]
    whole = VideoClip.whole_file(source, COUNT, FPS)
    assert np.array_equal(shown(whole.cut(3, 20)), expected[3:20])
    assert copied(whole.cut(3, 20), tmp_path / "copy.mp4") is None
    seen = copied(whole.cut(12, COUNT), tmp_path / "copy.mp4")
    assert seen is not None
    assert np.array_equal(seen, expected[12:])
    for clip, reason, what in (
        (VideoClip.whole_file(source, COUNT - 1, FPS), "length_mismatch", "too many frames"),
        (VideoClip.whole_file(source, COUNT + 1, FPS), "truncated_video", "truncated or undecodable"),
        (VideoClip(source, 10, FPS, from_time=55 / FPS), "truncated_video", "truncated or undecodable"),
    ):
        assert copied(clip, tmp_path / "none.mp4") is None
        with rejected(reason, rf"{what}[\s\S]*expected: {clip.num_frames} frames[\s\S]*got: \d+ frames"):
            shown(clip)
    longer = VideoClip(source, 80, FPS, 0.0)
    assert len(list(decoder.frames(longer, range(55, 60)))) == 5
    with pytest.raises(RejectedInputError, match="truncated or undecodable"):
        list(decoder.frames(longer, range(55, 70)))
    for indices in ([], [3, 3], [4, 2]):
        with pytest.raises(DataError, match="read in order"):
            list(decoder.frames(whole, indices))
    for indices in ([-1, 2], [58, 60]):
        with pytest.raises(DataError, match="outside of the clip"):
            list(decoder.frames(whole, indices))


def test_a_gap_in_the_times_is_found_and_the_frames_around_it_are_exact(decoder: FrameDecoder, tmp_path: Path) -> None:
    times = [*range(20), *range(23, 43)]
    path = write_video(tmp_path / "gap.mp4", scene(40), rate=10, times=times, options={"g": "12"})
    expected = dict(zip(times, plain_frames(path), strict=True))
    clip = VideoClip(path, 43, 10.0, 0.0)
    for indices in ([0, 5, 19], [23, 24, 42], [18, 19, 23, 30], range(25, 41, 5)):
        for index, frame in zip(indices, decoder.frames(clip, indices), strict=True):
            assert np.array_equal(frame, expected[index]), index
    for indices in ([21], [19, 20, 23]):
        with rejected("truncated_video", r"gap\.mp4"):
            list(decoder.frames(clip, indices))
    assert np.array_equal(next(iter(decoder.frames(clip, [7]))), expected[7])  # usable after a failure


@pytest.mark.parametrize("kind", ["h264", "h264_b_frames"])
def test_damaged_packets_are_not_copied_silently(recorded: Recorded, tmp_path: Path, kind: str) -> None:
    source = tmp_path / "source.mp4"
    content = bytearray(recorded[kind][0].read_bytes())
    damaged = packets(recorded[kind][0])[17]
    position = content.index(damaged)
    content[position + 8 : position + len(damaged)] = bytes(len(damaged) - 8)
    source.write_bytes(content)
    clip = VideoClip.whole_file(source, COUNT, FPS)
    with rejected("truncated_video", r"damaged|truncated"):
        copied(clip, tmp_path / "copy.mp4")
    encoded = ViewImages(lambda: iter(()), COUNT, clip, image_size=(32, 48))
    with rejected("truncated_video", r"damaged|truncated"):
        store_view(encoded, tmp_path / "encoded.mp4", FPS, VideoSettings(preset="ultrafast"))


def test_other_codecs_are_left_to_the_encoder(tmp_path: Path) -> None:
    path = write_video(tmp_path / "old.mp4", scene(5), rate=30, codec="mpeg4")
    clip = VideoClip.whole_file(path, 5, FPS)
    assert copied(clip, tmp_path / "copy.mp4") is None
    assert np.array_equal(shown(clip), plain_frames(path))


def test_damaged_and_missing_files_are_named(recorded: Recorded, decoder: FrameDecoder, tmp_path: Path) -> None:
    whole = recorded["own"][0].read_bytes()
    (tmp_path / "half.mp4").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.mp4").write_text("no video at all")
    for name in ("half.mp4", "text.mp4", "absent.mp4"):
        clip = VideoClip(tmp_path / name, COUNT, FPS, 0.0)
        with pytest.raises(RejectedInputError, match=name):
            list(decoder.frames(clip, range(COUNT)))
        with pytest.raises(RejectedInputError, match=name):
            decode_frames(clip)
        with pytest.raises(RejectedInputError, match=name):
            decode_video(clip.path, COUNT)
    left = VideoClip(tmp_path / "half.mp4", COUNT, FPS, 0.0)
    assert len(decode_frames(left, [0, 1, 2])) == 3


def test_open_files_are_bounded(decoder: FrameDecoder, tmp_path: Path) -> None:
    paths = [tmp_path / f"{number}.mp4" for number in range(4)]
    for number, path in enumerate(paths):
        encode_video(path, scene(5, number), FPS, preset="ultrafast")

    def descriptors() -> int:
        links = Path("/proc/self/fd").glob("*")
        return sum(link.exists() and link.resolve().parent == tmp_path for link in links)

    for path in paths * 3:
        assert np.array_equal(next(iter(decoder.frames(VideoClip(path, 5, FPS, 0.0), [0]))), plain_frames(path)[0])
        assert 1 <= descriptors() <= 2
    decoder.close()
    assert descriptors() == 0


def picture(number: int, count: int = 12) -> np.ndarray:
    rows, columns = np.mgrid[:32, :48]
    value = (columns[None] * 2 + rows[None] + 5 * np.arange(count)[:, None, None] + 30 * number) % 180
    return np.stack([value, 200 - value, np.full_like(value, 100)], axis=-1).astype(np.uint8)


@pytest.fixture(params=["h264", "av1"])
def codec(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Each codec that videos are encoded with."""
    monkeypatch.setenv(CODEC_VARIABLE, request.param)
    return request.param


@pytest.mark.parametrize("pixel_format", ["yuv420p", "yuv444p"])
def test_a_video_keeps_its_pictures_and_its_bytes(tmp_path: Path, pixel_format: str, codec: str) -> None:
    frames = picture(0)
    for name in ("a.mp4", "b.mp4"):
        encode_video(tmp_path / name, frames, 8, crf=8, pixel_format=pixel_format)  # type: ignore[arg-type]
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()
    decoded = decode_video(tmp_path / "a.mp4", len(frames))
    assert decoded.shape == frames.shape
    assert np.abs(decoded.astype(int) - frames).mean() < 4
    assert video_size(tmp_path / "a.mp4") == (32, 48, 8.0)
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert container.streams.video[0].codec_context.codec.canonical_name == codec


def test_a_codec_is_named_where_it_cannot_be_had(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(av, "codecs_available", av.codecs_available - {"libx264"})
    with pytest.raises(UnavailableError, match=r"(?s)expected: libx264.*WORLDLINE_VIDEO_CODEC=av1"):
        encode_video(tmp_path / "a.mp4", picture(0), 8)
    monkeypatch.setenv(CODEC_VARIABLE, "mpeg4")
    with pytest.raises(ConfigError, match=r"(?s)WORLDLINE_VIDEO_CODEC.*h264 or av1.*mpeg4"):
        encode_video(tmp_path / "a.mp4", picture(0), 8)


def test_bytes_do_not_depend_on_the_processor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # A noisy scene with moving shapes: on this one x264's choices differ between processors unless it is told otherwise.
    generator = np.random.default_rng(2)
    colours = generator.integers(60, 180, (8, 12, 3)).astype(np.float32)
    background = cv2.resize(colours, (96, 64), interpolation=cv2.INTER_CUBIC)
    scene = []
    for t in range(33):
        picture = background + generator.normal(0, 3, (64, 96, 3))
        centre = (round(20 + 1.7 * t), round(30 + 10 * np.sin(t / 5)))
        cv2.circle(picture, centre, 9, (20, 60, 200), -1)
        cv2.line(picture, (0, 0), centre, (230, 220, 40), 4)
        scene.append(np.clip(picture, 0, 255).astype(np.uint8))
    for parameters in (X264_PARAMETERS, X264_PARAMETERS + ":asm=0"):
        monkeypatch.setattr("worldline_core.data.video.encoder.X264_PARAMETERS", parameters)
        for pixel_format in ("yuv420p", "yuv444p"):
            encode_video(
                tmp_path / f"{pixel_format}{len(parameters)}.mp4",
                scene,
                8,
                crf=8,
                preset="slow",
                pixel_format=pixel_format,
            )
    assert len({path.read_bytes() for path in tmp_path.iterdir()}) == 2


@pytest.mark.usefixtures("codec")
def test_key_frames_are_where_they_are_wanted(tmp_path: Path) -> None:
    with VideoEncoder(tmp_path / "k.mp4", (32, 48), 30, Encoding(key_frame_interval=32)) as encoder:
        for frame in np.tile(picture(0, 1), (70, 1, 1, 1)):
            encoder.add(frame)
    with av.open(str(tmp_path / "k.mp4")) as container:
        keys = [number for number, packet in enumerate(container.demux(video=0)) if packet.size and packet.is_keyframe]
    assert keys == [0, 32, 64]


@pytest.mark.usefixtures("codec")
def test_colours_are_not_shifted(tmp_path: Path) -> None:
    for colour in ((255, 0, 0), (0, 255, 0), (0, 0, 255), (200, 100, 50), (0, 0, 0), (255, 255, 255)):
        encode_video(tmp_path / "c.mp4", np.tile(np.array(colour, np.uint8), (4, 32, 48, 1)), 8, crf=5)
        assert np.abs(decode_video(tmp_path / "c.mp4")[2].astype(int) - colour).max() <= 3, colour


def test_what_cannot_be_encoded_is_refused(tmp_path: Path) -> None:
    small = np.zeros((2, 32, 48, 3), np.uint8)
    for frames, rate, error, message in (
        (small[:, :31], 8, ConfigError, "odd size cannot be encoded as yuv420p"),
        (small.astype(np.float32), 8, DataError, "Cannot encode"),
        (small, 0, DataError, "positive number"),
    ):
        with pytest.raises(error, match=message):
            encode_video(tmp_path / "v.mp4", frames, rate)


def test_clips_of_different_settings_are_not_joined(tmp_path: Path) -> None:
    frames = np.random.default_rng(5).integers(0, 255, (8, 32, 48, 3), dtype=np.uint8)
    for preset in ("slow", "veryfast"):
        encode_video(tmp_path / f"{preset}.mp4", frames, 10, preset=preset)
    parts = [(tmp_path / f"{preset}.mp4", 8) for preset in ("slow", "veryfast")]
    with pytest.raises(DataError, match=r"veryfast\.mp4"):
        concatenate_videos(tmp_path / "joined.mp4", parts, 10)


def test_joined_videos_hold_lengths_not_start_codes(tmp_path: Path) -> None:
    """As mp4 wants it, and LeRobot's own joining of datasets needs it: FFmpeg's decoder alone would not mind."""
    frames = np.random.default_rng(5).integers(0, 255, (8, 32, 48, 3), dtype=np.uint8)
    encode_video(tmp_path / "part.mp4", frames, 10)
    concatenate_videos(tmp_path / "joined.mp4", [(tmp_path / "part.mp4", 8)] * 2, 10)
    assert len(packets(tmp_path / "joined.mp4")) == 16
    for packet in packets(tmp_path / "joined.mp4"):
        position = 0
        while position < len(packet):
            length = int.from_bytes(packet[position : position + 4], "big")
            assert packet[position + 4] & 0x1F in (1, 5, 7, 8)  # slices and parameter sets
            position += 4 + length
        assert position == len(packet)
    assert np.array_equal(decode_video(tmp_path / "joined.mp4")[8:], decode_video(tmp_path / "part.mp4"))
