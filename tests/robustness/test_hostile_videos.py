"""Videos that claim too much, are something else, or would never end."""

from __future__ import annotations

import os
import resource
import struct
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tools.corrupted import files
from worldline_core.data.guards.rejection import MAX_FRAMES, RejectedInputError
from worldline_core.data.video import clip as video_clip
from worldline_core.data.video.clip import VideoClip, read_clip
from worldline_core.data.video.encoder import encode_video
from worldline_core.data.video.header import check_video_header

RANDOM = np.random.default_rng(0)


def reason_of(path: Path, num_frames: int = 9) -> str:
    with pytest.raises(RejectedInputError, match=path.name) as caught:
        for _ in read_clip(VideoClip.whole_file(path, num_frames, 8.0)):
            pass
    return caught.value.reason


def patch(path: Path, box: bytes, offset: int, value: bytes) -> None:
    content = bytearray(path.read_bytes())
    start = content.index(box) + 4 + offset
    content[start : start + len(value)] = value
    path.write_bytes(bytes(content))


def claim_size(path: Path, width: int, height: int) -> None:
    content = path.read_bytes()
    entry = content.index(b"avc1", content.index(b"stsd")) - content.index(b"stsd") - 4
    patch(path, b"stsd", entry + 28, struct.pack(">HH", width, height))


def test_a_sound_file_is_handed_on(video: Path) -> None:
    assert check_video_header(video) == video
    assert sum(1 for _ in read_clip(VideoClip.whole_file(video, 9, 8.0))) == 9


def test_a_header_that_claims_gigapixels_is_refused_undecoded(video: Path) -> None:
    files.claim_pixels(video, RANDOM)
    with pytest.raises(RejectedInputError, match="side is too long") as caught:
        check_video_header(video)
    assert caught.value.reason == "too_large"
    assert caught.value.evidence["declared"] == 30_000
    assert reason_of(video) == "too_large"


def test_many_pixels_within_the_longest_side(video: Path) -> None:
    claim_size(video, 16_000, 16_000)
    with pytest.raises(RejectedInputError, match="too many pixels"):
        check_video_header(video)


def test_a_billion_frames_in_some_bytes_are_refused(video: Path) -> None:
    files.claim_frames(video, RANDOM)
    with pytest.raises(RejectedInputError, match="too many frames") as caught:
        check_video_header(video)
    assert caught.value.evidence == {"declared": 10**9, "limit": MAX_FRAMES, "unit": "frames"}
    patch(video, b"stsz", 8, struct.pack(">I", MAX_FRAMES - 1))
    with pytest.raises(RejectedInputError, match="more frames than it has bytes"):
        check_video_header(video)


def test_the_stream_may_not_be_larger_than_the_container_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "liar.mp4"
    encode_video(path, RANDOM.integers(0, 255, (3, 256, 256, 3), dtype=np.uint8), 8.0, preset="ultrafast")
    monkeypatch.setitem(video_clip._BOUNDED, "max_pixels", str(64 * 64))
    check_video_header(path)
    claim_size(path, 32, 32)  # now the container's own claim is modest
    check_video_header(path)
    assert reason_of(path, 3) in ("truncated_video", "too_large")


@pytest.mark.parametrize(
    "content",
    [
        b"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nfile:///etc/hostname\n#EXT-X-ENDLIST\n",
        b"ffconcat version 1.0\nfile 'a.mp4'\n",
    ],
)
def test_a_playlist_does_not_draw_in_other_files(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "list.mp4"
    path.write_bytes(content)
    assert reason_of(path) == "unreadable"


def test_a_pipe_does_not_hang_and_a_folder_is_no_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mp4")
    (tmp_path / "folder.mp4").mkdir()
    (tmp_path / "zero.mp4").symlink_to("/dev/zero")
    for name, what in (("pipe", "a pipe"), ("folder", "a folder"), ("zero", "a device")):
        with pytest.raises(RejectedInputError, match=what) as caught:
            check_video_header(tmp_path / f"{name}.mp4")
        assert caught.value.reason == "special_file"


@pytest.mark.parametrize("length", [0, 1, 7, 8, 11, 40, 300])
def test_a_file_that_breaks_off_in_its_header(video: Path, length: int) -> None:
    video.write_bytes(video.read_bytes()[:length])
    assert reason_of(video) in ("truncated_video", "unreadable")


def test_boxes_that_lie_about_their_length_end(video: Path) -> None:
    """A box of length 0 runs to the end of the file; shorter than its own header it would never get on."""
    for claimed in (0, 1, 4, 7, 2**32 - 1):
        content = bytearray(video.read_bytes())
        start = content.index(b"moov") - 4
        content[start : start + 4] = struct.pack(">I", claimed)
        broken = video.with_name(f"box{claimed}.mp4")
        broken.write_bytes(bytes(content))
        check_video_header(broken)


def test_boxes_without_end_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "boxes.mp4"
    path.write_bytes(struct.pack(">I4s8s", 16, b"ftyp", b"isom\0\0\0\0") + struct.pack(">I4s", 8, b"free") * 100_001)
    with pytest.raises(RejectedInputError, match="too many boxes"):
        check_video_header(path)


def tracks(content: bytes, count: int) -> bytes:
    """A file whose one track is listed so often."""
    start = content.index(b"trak") - 4
    length = struct.unpack(">I", content[start : start + 4])[0]
    moov = content.index(b"moov") - 4
    size = struct.unpack(">I", content[moov : moov + 4])[0]
    grown = struct.pack(">I", size + length * (count - 1))
    return (
        content[:moov]
        + grown
        + content[moov + 4 : start]
        + content[start : start + length] * count
        + content[start + length :]
    )


def changed(content: bytes, box: bytes, offset: int, value: bytes) -> bytes:
    start = content.index(box) + 4 + offset
    return content[:start] + value + content[start + len(value) :]


ODD_VIDEOS = {
    "3,000 tracks": lambda c: tracks(c, 3000),
    "no time scale": lambda c: changed(c, b"mdhd", 12, bytes(4)),
    "a time scale of 2^32": lambda c: changed(c, b"mdhd", 12, b"\xff" * 4),
    "frames without duration": lambda c: changed(c, b"stts", 12, bytes(4)),
    "frames that last for ever": lambda c: changed(c, b"stts", 12, b"\xff" * 4),
    "4 billion times": lambda c: changed(c, b"stts", 4, b"\xff" * 4),
    "an edit that begins nowhere": lambda c: changed(c, b"elst", 12, b"\x7f" + b"\xff" * 3),
    "4 billion edits": lambda c: changed(c, b"elst", 4, b"\xff" * 4),
    "frames of 4 GB": lambda c: changed(c, b"stsz", 4, b"\xff" * 4),
    "chunks beyond the end": lambda c: changed(c, b"stco", 8, b"\xff" * 4),
    "4 billion chunks": lambda c: changed(c, b"stco", 4, b"\xff" * 4),
    "a description of nothing": lambda c: changed(c, b"avcC", 5, bytes(8)),
    "31 parameter sets": lambda c: changed(c, b"avcC", 5, b"\xff"),
}


@pytest.mark.parametrize("change", ODD_VIDEOS.values(), ids=ODD_VIDEOS)
def test_tables_of_a_video_that_say_other_things_end(video: Path, change: Callable[[bytes], bytes]) -> None:
    """In the frames that were recorded, or in a named rejection; never in a wait, nor in memory of the machine."""
    expected = [picture.rgb.copy() for picture in read_clip(VideoClip.whole_file(video, 9, 8.0))]
    video.write_bytes(change(video.read_bytes()))
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.monotonic()
    try:
        pictures = [picture.rgb for picture in read_clip(VideoClip.whole_file(video, 9, 8.0))]
        found = all(np.array_equal(one, other) for one, other in zip(pictures, expected, strict=True))
    except RejectedInputError as error:
        found = error.reason
    assert found in (True, "unreadable", "truncated_video", "too_large", "wrong_fps")
    assert time.monotonic() - began < 5
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000  # KB
