from __future__ import annotations

from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from tests.data.curating import packets
from worldline_core.data.video.clip import VideoClip, decode_frames, decode_video, video_size
from worldline_core.data.video.encoder import (
    CODEC_VARIABLE,
    X264_PARAMETERS,
    Encoding,
    VideoEncoder,
    concatenate_videos,
    encode_video,
)
from worldline_core.errors import ConfigError, DataError, UnavailableError


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
            encode_video(tmp_path / f"{pixel_format}{len(parameters)}.mp4", scene, 8, crf=8, pixel_format=pixel_format)
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


def test_a_truncated_video_names_file_and_frame_counts(tmp_path: Path) -> None:
    path = tmp_path / "cut.mp4"
    noise = np.random.default_rng(0).integers(0, 255, (24, 32, 48, 3), dtype=np.uint8)
    encode_video(path, noise, 8)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(DataError, match=r"(?s)truncated.*cut\.mp4.*24 frames.*got: \d+ frames"):
        decode_video(path, 24)
    with pytest.raises(DataError, match=r"(?s)truncated.*cut\.mp4"):
        decode_frames(VideoClip(path, 24, 8.0, 0.0))
    assert len(decode_frames(VideoClip(path, 24, 8.0, 0.0), [0, 1, 2])) == 3  # what is left is still readable


def test_a_video_of_another_length_and_what_cannot_be_encoded_are_refused(tmp_path: Path) -> None:
    encode_video(tmp_path / "v.mp4", picture(0), 8)
    with pytest.raises(DataError, match=r"(?s)too many frames.*expected: 5 frames.*got: 12 frames"):
        decode_video(tmp_path / "v.mp4", 5)
    with pytest.raises(DataError, match="outside of the clip"):
        decode_frames(VideoClip(tmp_path / "v.mp4", 12, 8.0, 0.0), [12])
    small = np.zeros((2, 32, 48, 3), np.uint8)
    for frames, rate, message in (
        (small[:, :31], 8, "even image sides"),
        (small.astype(np.float32), 8, "Cannot encode"),
        (small, 0, "positive number"),
    ):
        with pytest.raises(DataError, match=message):
            encode_video(tmp_path / "v.mp4", frames, rate)


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
