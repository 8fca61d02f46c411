"""Clips taken out of videos that other encoders wrote: with B-frames, AV1, HEVC, late first times, joined files."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from worldline_core.data.episodes.view_recording import RecordedView, VideoSettings, copy_clip, store_view
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.video.clip import VideoClip, decode_frames, decode_video, open_video, read_clip
from worldline_core.data.video.encoder import concatenate_videos, encode_video

FPS = 30.0
ENCODERS = {
    "h264": ("libx264", {"bf": "0", "g": "12", "preset": "ultrafast"}),
    "h264_b_frames": (
        "libx264",
        {"g": "12", "bf": "3", "preset": "medium", "x264-params": "b-pyramid=normal:keyint=12"},
    ),
    "h264_open_gop": ("libx264", {"bf": "3", "x264-params": "open-gop=1:keyint=12:min-keyint=4"}),
    "hevc": ("libx265", {"preset": "ultrafast", "x265-params": "log-level=none:keyint=12:bframes=3"}),
    "av1": ("libsvtav1", {"preset": "12", "g": "12", "svtav1-params": "lp=1"}),
}


def scene(count: int, seed: int = 0, size: tuple[int, int] = (64, 96)) -> np.ndarray:
    """A texture that moves and never repeats: each frame is unlike its neighbours."""
    generator = np.random.default_rng(seed)
    texture = generator.integers(30, 220, (size[0] // 4 + count, size[1] // 4 + count, 3)).astype(np.uint8)
    texture = texture.repeat(4, axis=0).repeat(4, axis=1)
    return np.stack([texture[2 * t : 2 * t + size[0], t : t + size[1]] for t in range(count)])


def write(
    path: Path,
    kind: str,
    frames: np.ndarray,
    *,
    first_pts: int = 0,
    time_base: Fraction = Fraction(1, 30),
    step: int = 1,
) -> Path:
    codec, options = ENCODERS[kind]
    with av.open(str(path), "w", format="mp4") as out:
        stream = out.add_stream(codec, rate=30)
        stream.height, stream.width, stream.pix_fmt, stream.options = *frames.shape[1:3], "yuv420p", options
        stream.codec_context.thread_count = 1
        stream.codec_context.time_base = time_base
        for number, image in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = first_pts + number * step, time_base
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    return path


def own_decode(path: Path) -> np.ndarray:
    """Every frame as FFmpeg shows it, by the shortest way there is."""
    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


def copied(clip: VideoClip, target: Path) -> np.ndarray | None:
    """The frames that are seen while copying, or None where the clip cannot be copied."""
    with open_video(clip.path) as (container, stream):
        pictures = copy_clip(clip, container, stream, target)
        return None if pictures is None else np.stack([picture.rgb for picture in pictures])


def packets(path: Path) -> list[bytes]:
    with av.open(str(path)) as container:
        return [bytes(packet) for packet in container.demux(video=0) if packet.size]


@pytest.mark.parametrize("kind", ENCODERS)
def test_a_whole_file_is_copied_packet_by_packet(tmp_path: Path, kind: str) -> None:
    source = write(tmp_path / "source.mp4", kind, scene(40))
    expected = own_decode(source)
    seen = copied(VideoClip.whole_file(source, 40, FPS), tmp_path / "copy.mp4")
    assert seen is not None
    assert np.array_equal(seen, expected)
    assert packets(tmp_path / "copy.mp4") == packets(source)
    assert np.array_equal(own_decode(tmp_path / "copy.mp4"), expected)
    # Each frame lies at its place on the grid, and is found there alone as well.
    assert np.array_equal(decode_frames(VideoClip(tmp_path / "copy.mp4", 40, FPS, 0.0)), expected)
    for number in range(40):
        assert np.array_equal(
            decode_frames(VideoClip(tmp_path / "copy.mp4", 40, FPS, 0.0), [number])[0], expected[number]
        )
    first = (tmp_path / "copy.mp4").read_bytes()
    copied(VideoClip.whole_file(source, 40, FPS), tmp_path / "again.mp4")
    assert (tmp_path / "again.mp4").read_bytes() == first


@pytest.mark.parametrize("kind", ["h264_b_frames", "av1"])
def test_times_that_start_late_or_are_uneven_are_put_on_the_grid(tmp_path: Path, kind: str) -> None:
    source = write(tmp_path / "source.mp4", kind, scene(26), first_pts=7000, time_base=Fraction(1, 90000), step=3001)
    expected = own_decode(source)
    seen = copied(VideoClip.whole_file(source, 26, FPS), tmp_path / "copy.mp4")
    assert seen is not None
    assert np.array_equal(seen, expected)
    assert np.array_equal(decode_frames(VideoClip(tmp_path / "copy.mp4", 26, FPS, 0.0)), expected)


@pytest.mark.parametrize("kind", ["h264", "h264_b_frames", "av1"])
def test_a_clip_in_a_joined_file_is_copied_where_it_begins_at_a_key_frame(tmp_path: Path, kind: str) -> None:
    source = write(tmp_path / "source.mp4", kind, scene(60))
    expected = own_decode(source)
    clip = VideoClip(source, 24, FPS, from_time=24 / FPS)
    seen = copied(clip, tmp_path / "copy.mp4")
    assert seen is not None
    assert np.array_equal(seen, expected[24:48])
    assert np.array_equal(own_decode(tmp_path / "copy.mp4"), expected[24:48])
    assert np.array_equal(np.stack([p.rgb for p in read_clip(clip)]), expected[24:48])
    inside = VideoClip(source, 20, FPS, from_time=29 / FPS)
    assert copied(inside, tmp_path / "none.mp4") is None
    assert np.array_equal(np.stack([p.rgb for p in read_clip(inside)]), expected[29:49])


def test_a_key_frame_whose_neighbours_are_stored_behind_it_is_no_beginning(tmp_path: Path) -> None:
    source = write(tmp_path / "source.mp4", "h264_open_gop", scene(60))
    expected = own_decode(source)
    with av.open(str(source)) as container:
        stream = container.streams.video[0]
        order = [(packet.pts, packet.is_keyframe) for packet in container.demux(stream) if packet.size]
    starts = sorted(round(pts * float(stream.time_base) * FPS) for pts, key in order if key)  # type: ignore[arg-type]
    for start in starts:
        clip = VideoClip(source, 10, FPS, from_time=start / FPS)
        assert np.array_equal(np.stack([p.rgb for p in read_clip(clip)]), expected[start : start + 10])
        seen = copied(clip, tmp_path / "copy.mp4")
        if seen is not None:
            assert np.array_equal(seen, expected[start : start + 10])
            assert np.array_equal(own_decode(tmp_path / "copy.mp4"), expected[start : start + 10])


@pytest.mark.parametrize("kind", ["h264", "h264_b_frames", "av1"])
def test_every_frame_of_a_foreign_file_is_found_by_its_time(tmp_path: Path, kind: str) -> None:
    source = write(tmp_path / "source.mp4", kind, scene(50))
    expected = own_decode(source)
    for number in range(50):
        assert np.array_equal(decode_frames(VideoClip(source, 50, FPS, 0.0), [number])[0], expected[number])


def test_clips_of_this_project_are_copied_out_of_their_joined_file(tmp_path: Path) -> None:
    parts = []
    for number, count in enumerate((12, 7, 9)):
        encode_video(tmp_path / f"{number}.mp4", scene(count, number), FPS, pixel_format="yuv444p")
        parts.append((tmp_path / f"{number}.mp4", count))
    joined = tmp_path / "joined.mp4"
    concatenate_videos(joined, parts, FPS)
    first = 0
    for part, count in parts:
        seen = copied(VideoClip(joined, count, FPS, from_time=first / FPS), tmp_path / "copy.mp4")
        assert seen is not None
        assert np.array_equal(seen, decode_video(part))
        assert np.array_equal(decode_video(tmp_path / "copy.mp4", count), decode_video(part))
        first += count


def test_a_lag_cuts_frames_off_and_a_wrong_count_is_refused(tmp_path: Path) -> None:
    source = write(tmp_path / "source.mp4", "h264", scene(30))
    expected = own_decode(source)
    whole = VideoClip.whole_file(source, 30, FPS)
    assert np.array_equal(np.stack([p.rgb for p in read_clip(whole.cut(3, 20))]), expected[3:20])
    assert copied(whole.cut(3, 20), tmp_path / "copy.mp4") is None
    seen = copied(whole.cut(12, 30), tmp_path / "copy.mp4")
    assert seen is not None
    assert np.array_equal(seen, expected[12:])
    for count, reason in ((29, "length_mismatch"), (31, "truncated_video")):
        wrong = VideoClip.whole_file(source, count, FPS)
        assert copied(wrong, tmp_path / "none.mp4") is None
        with pytest.raises(RejectedInputError, match=f"expected: {count} frames") as caught:
            list(read_clip(wrong))
        assert caught.value.reason == reason
    with pytest.raises(RejectedInputError, match="expected: 10 frames") as caught:
        list(read_clip(VideoClip(source, 10, FPS, from_time=25 / FPS)))
    assert caught.value.reason == "truncated_video"


@pytest.mark.parametrize("kind", ["h264", "h264_b_frames"])
def test_damaged_packets_are_not_copied_silently(tmp_path: Path, kind: str) -> None:
    source = write(tmp_path / "source.mp4", kind, scene(40))
    content = bytearray(source.read_bytes())
    with av.open(str(source)) as container:
        places = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
    position, size = places[17]
    content[position + 8 : position + size] = bytes(size - 8)
    source.write_bytes(content)
    with pytest.raises(RejectedInputError, match=r"(?s)damaged|truncated") as caught:
        copied(VideoClip.whole_file(source, 40, FPS), tmp_path / "copy.mp4")
    assert caught.value.reason == "truncated_video"
    clip = VideoClip.whole_file(source, 40, FPS)
    encoded = RecordedView(lambda: iter(()), 40, clip, image_size=(32, 48))
    with pytest.raises(RejectedInputError, match=r"(?s)damaged|truncated") as caught:
        store_view(encoded, tmp_path / "encoded.mp4", FPS, VideoSettings(preset="ultrafast"))
    assert caught.value.reason == "truncated_video"


def test_other_codecs_are_left_to_the_encoder(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "old.mp4"), "w") as out:
        stream = out.add_stream("mpeg4", rate=30)
        stream.height, stream.width, stream.pix_fmt = 64, 96, "yuv420p"
        for image in scene(5):
            out.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        out.mux(stream.encode(None))
    clip = VideoClip.whole_file(tmp_path / "old.mp4", 5, FPS)
    assert copied(clip, tmp_path / "copy.mp4") is None
    assert np.array_equal(np.stack([p.rgb for p in read_clip(clip)]), own_decode(tmp_path / "old.mp4"))
