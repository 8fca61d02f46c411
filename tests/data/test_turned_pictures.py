"""Pictures that are stored turned or mirrored, and pictures of depth: one rule in every path.

The display matrix is written into the mp4's track header byte by byte, so no tool's reading of angles takes part.
"""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from PIL import Image
from pydantic import ValidationError

from tests.data.curating import PATCHES, by_ffmpeg, enlarged, off, preset, run
from tests.data.published_lerobot import FRAMES as LEROBOT_FRAMES
from tests.data.published_lerobot import HEIGHT, WIDTH, write_robocoin
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.guards.plain_files import decode_image, image_size
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.video.clip import FrameDecoder, VideoClip, read_clip, shown_size
from worldline_core.data.video.encoder import encode_video
from worldline_core.data.video.frames import VideoFrames
from worldline_core.errors import ConfigError, DataError

FRAMES, RATE = 5, 10
# (a, b, c, d) of ISO/IEC 14496-12, 6.2.2: a stored point (x, y) is shown at (a x + c y, b x + d y).
MATRICES = {
    1: (1, 0, 0, 1), 2: (-1, 0, 0, 1), 3: (-1, 0, 0, -1), 4: (1, 0, 0, -1),
    5: (0, 1, 1, 0), 6: (0, 1, -1, 0), 7: (0, -1, -1, 0), 8: (0, -1, 1, 0),
}  # fmt: skip


def as_shown(matrix: tuple[int, int, int, int]) -> np.ndarray:
    """The patches where the matrix puts them."""
    a, b, c, d = matrix
    places = {(a * x + c * y, b * x + d * y): PATCHES[y, x] for y in range(2) for x in range(3)}
    columns, rows = (sorted({place[i] for place in places}) for i in (0, 1))
    return np.array([[places[x, y] for x in columns] for y in rows])


def set_matrix(path: Path, matrix: tuple[float, float, float, float]) -> None:
    """Write a display matrix into the header of every track."""
    content = bytearray(path.read_bytes())
    a, b, c, d = (round(value * 65536) for value in matrix)
    position = 0
    while (position := content.find(b"tkhd", position)) >= 0:
        position += 4
        content[position + 40 : position + 76] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(content)


def turned_video(path: Path, matrix: tuple[float, float, float, float]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    encode_video(path, [enlarged(PATCHES, 32)] * FRAMES, RATE, crf=4)
    set_matrix(path, matrix)
    return path


def test_videos_are_turned_in_every_path(tmp_path: Path) -> None:
    for orientation, matrix in MATRICES.items():
        expected, path = as_shown(matrix), turned_video(tmp_path / "a.mp4", matrix)
        size = enlarged(expected, 32).shape
        by_command = by_ffmpeg(path, *size[:2])
        assert by_command is None or off(by_command, expected) <= 3
        clip = VideoClip.whole_file(path, FRAMES, RATE)
        decoder = FrameDecoder()
        trained = np.stack(list(decoder.frames(clip, range(FRAMES))))
        decoder.close()
        seen = list(read_clip(clip))
        assert np.array_equal(np.stack([picture.rgb for picture in seen]), trained)
        assert off(trained, expected) <= 3
        assert seen[0].size == seen[0].luma.shape == trained.shape[1:3]
        gray = cv2.cvtColor(trained[0], cv2.COLOR_RGB2GRAY)[16::32, 16::32]
        assert np.abs((seen[0].luma[16::32, 16::32] - 16.0) * 255 / 219 - gray).max() <= 3
        assert VideoFrames(clip).shape == (FRAMES, *size)
        assert shown_size(path) == (*size[:2], orientation)


@pytest.mark.parametrize("image_size", [None, (96, 96)])
def test_videos_are_stored_upright(tmp_path: Path, image_size: tuple[int, int] | None) -> None:
    for orientation, matrix in MATRICES.items():
        turned_video(tmp_path / "raw" / f"{orientation}.mp4", matrix)
    source = {"kind": "video_folder", "path": str(tmp_path / "raw"), "name": "web", "split": "train"}
    counts, curated = run(tmp_path, source, image_size=image_size, near_duplicates=False)
    copied = int(image_size is None)  # the one that is upright
    assert counts["videos"] == {"copied": copied, "encoded": len(MATRICES) - copied}
    for number, matrix in enumerate(MATRICES.values()):
        assert off(curated.frames(number, "head"), as_shown(matrix)) <= 3
        with av.open(str(curated.clip(number, "head").path)) as container:
            assert next(container.decode(video=0)).side_data.get("DISPLAYMATRIX") is None


def test_a_video_that_is_shown_askew_is_refused(tmp_path: Path) -> None:
    for angle_deg in (30.0, 45.0, 10.0):
        sine, cosine = np.sin(np.deg2rad(angle_deg)), np.cos(np.deg2rad(angle_deg))
        path = turned_video(tmp_path / "a.mp4", (cosine, sine, -sine, cosine))
        with pytest.raises(RejectedInputError, match="no whole quarter"):
            _ = next(read_clip(VideoClip.whole_file(path, FRAMES, RATE))).rgb


@pytest.mark.parametrize("image_size", [None, (36, 64)])
def test_cameras_of_turned_videos_are_refused_by_name(tmp_path: Path, image_size: tuple[int, int] | None) -> None:
    write_robocoin(tmp_path / "raw", episodes=4)
    K = [[60.0, 0.0, 63.5], [0.0, 62.0, 35.5], [0.0, 0.0, 1.0]]
    pose = np.eye(4).tolist()
    entry = {"width": WIDTH, "height": HEIGHT, "K": K, "maps": "camera_to_base", "axes": "opencv", "T": pose}
    (tmp_path / "raw/meta/calibration.json").write_text(json.dumps({"views": {"head": entry}}))
    source = preset("robocoin", tmp_path / "raw", collection=False)
    (key,) = (key for key, view in source["views"].items() if view == "head")
    for number, orientation in enumerate((3, 6, 2), 1):
        (video,) = (tmp_path / "raw").rglob(f"{key}/episode_{number:06d}.mp4")
        set_matrix(video, MATRICES[orientation])
    options = {"image_size": image_size, "near_duplicates": False}
    counts, curated = run(tmp_path, {**source, "calibration": "meta/calibration.json"}, **options)
    assert (counts["kept"], counts["reasons"]) == (1, {"missing_calibration": 3})
    for row, orientation in zip(curated.quarantine(), (3, 6, 2), strict=True):
        assert f"orientation {orientation}" in row.detail
        assert "write the pictures upright" in row.detail
    # Without a camera they are turned like any other.
    counts, free = run(tmp_path / "free", source, **options)
    assert counts["kept"] == 4
    assert free.frames(1, "head").shape[0] == LEROBOT_FRAMES


def with_exif(orientation: int, kind: str) -> bytes:
    buffer, exif = io.BytesIO(), Image.Exif()
    exif[0x0112] = orientation
    options: dict[str, Any] = {"quality": 98, "subsampling": 0} if kind == "JPEG" else {}
    Image.fromarray(enlarged(PATCHES, 32)).save(buffer, kind, exif=exif, **options)
    return buffer.getvalue()


@pytest.mark.parametrize("kind", ["JPEG", "PNG"])
def test_images_are_turned_as_exif_says(kind: str) -> None:
    for orientation, matrix in MATRICES.items():
        expected = as_shown(matrix)  # EXIF 2.32, 4.6.4: the same eight
        content = with_exif(orientation, kind)
        found = decode_image(content, "here")
        assert off(found, expected) <= 4
        assert np.array_equal(decode_image(content, "here", channels="bgr"), found[..., ::-1])
        assert image_size(content, "here") == found.shape[:2] == enlarged(expected, 32).shape[:2]
        if orientation > 1:
            with pytest.raises(RejectedInputError, match=f"orientation {orientation}") as caught:
                decode_image(content, "here", calibrated=True)
            assert caught.value.reason == "missing_calibration"
    for value in (0, 1, 9, 65535):  # turn nothing
        assert off(decode_image(with_exif(value, kind), "here", calibrated=True), PATCHES) <= 4


def test_images_of_depth_are_no_pictures() -> None:
    depth = np.arange(24 * 32, dtype=np.uint16).reshape(24, 32) * 50
    with pytest.raises(RejectedInputError, match="depth, not colour") as caught:
        decode_image(bytes(cv2.imencode(".png", depth)[1]), "here")
    assert caught.value.reason == "not_colour"
    for colour in (np.stack([depth] * 3, axis=-1), (depth >> 8).astype(np.uint8)):  # of 16 bits, of a grey camera
        assert decode_image(bytes(cv2.imencode(".png", colour)[1]), "here").shape == (24, 32, 3)


@pytest.mark.parametrize(
    ("codec", "pixel_format"), [("ffv1", "gray16le"), ("libx265", "gray12le"), ("libx265", "gray10le")]
)
def test_a_video_of_depth_is_no_video(tmp_path: Path, codec: str, pixel_format: str) -> None:
    path = tmp_path / "a.mkv"
    options = {"x265-params": "log-level=none"} if codec == "libx265" else {}
    with av.open(str(path), "w") as out:
        stream = out.add_stream(codec, rate=RATE, options=options)
        stream.width, stream.height, stream.pix_fmt = 64, 48, pixel_format
        for number in range(3):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64), 4000 * number, np.uint16), format="gray16le")
            frame = frame.reformat(format=pixel_format)
            frame.pts = number
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    with pytest.raises(RejectedInputError, match=f"video of {pixel_format}"):
        next(read_clip(VideoClip(path, 3, RATE)))


def test_depth_videos_of_lerobot_are_refused_by_name(tmp_path: Path) -> None:
    source = preset("robocoin", tmp_path / "raw")
    key = next(iter(source["views"]))
    named, plain = {"video.is_depth_map": True}, {"is_depth_map": True}
    for name, said in enumerate(({}, {"info": named}, {"info": plain}, {"video_info": named}, plain)):
        write_robocoin(tmp_path / f"raw/{name}")
        path = tmp_path / f"raw/{name}/meta/info.json"
        info = json.loads(path.read_text())
        info["features"][key].update(said)
        path.write_text(json.dumps(info))
    counts, _ = run(tmp_path, source)
    assert (counts["kept"], counts["reasons"]) == (1, {"not_colour": 4})
    with pytest.raises(DataError, match=f"(?s)depth, not colour.*{key}"):
        run(tmp_path / "alone", {**source, "path": str(tmp_path / "raw/2"), "collection": False})


@pytest.mark.parametrize(
    "changes",
    [
        {"image_size": (63, 96)},
        {"image_size": (64, 95)},
        {"sources": [{"kind": "episode_set", "path": "raw", "image_size": (63, 95)}]},
    ],
)
def test_odd_sizes_with_yuv420p_are_one_error_before_work_begins(changes: dict[str, Any]) -> None:
    values = {"sources": [{"kind": "episode_set", "path": "raw"}], **changes}
    CurateConfig.model_validate(values)  # yuv444p holds them
    with pytest.raises(ValidationError, match=r"yuv420p needs even sides: .*image_size 6[34]x9[56]"):
        CurateConfig.model_validate({**values, "pixel_format": "yuv420p"})


def test_recordings_of_odd_sizes_with_yuv420p_end_the_run_once(tmp_path: Path) -> None:
    (tmp_path / "raw").mkdir()
    for name in ("a", "b", "c"):
        path = tmp_path / "raw" / f"{name}.mp4"
        encode_video(path, [np.full((63, 95, 3), 90, np.uint8)] * 3, RATE, pixel_format="yuv444p")
    source = {"kind": "video_folder", "path": str(tmp_path / "raw"), "name": "web", "split": "train"}
    with pytest.raises(ConfigError, match=r"(?s)cannot be encoded as yuv420p.*63x95"):
        run(tmp_path, source, pixel_format="yuv420p", video_mode="encode")
