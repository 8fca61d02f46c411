"""Pictures as players show them, in every path: colours by matrix and range, against patches of known colour and against `ffmpeg`;
pictures that are stored turned or mirrored; pictures of depth.

Planes are computed here from the luma coefficients that the standards state, and the display matrix is written into the mp4's
track header byte by byte, so nothing of this project, of libswscale or of a tool's reading of angles takes part in making a video.
"""

from __future__ import annotations

import io
import itertools
import json
import struct
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import cv2
import numpy as np
import pytest
from PIL import Image
from pydantic import ValidationError

from tests.data.curating import PATCHES, by_ffmpeg, enlarged, off, preset, rejected, run
from tests.data.published_lerobot import FRAMES as LEROBOT_FRAMES
from tests.data.published_lerobot import HEIGHT, WIDTH, write_robocoin
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.guards.plain_files import decode_image, image_size
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.mcap.file import ImageTrack, Stream
from worldline_core.data.mcap.messages import EncodedImage
from worldline_core.data.video.clip import FrameDecoder, VideoClip, open_video, read_clip, shown_size
from worldline_core.data.video.encoder import encode_video
from worldline_core.data.video.frames import VideoFrames
from worldline_core.errors import ConfigError, DataError
from worldline_core.exports.export import export

FRAMES, RATE, TOLERANCE = 4, 10, 3
LUMA = {"bt601": (0.299, 0.114), "bt709": (0.2126, 0.0722), "bt2020": (0.2627, 0.0593)}
"""Weights of red and blue: BT.601, BT.709 and BT.2020, each section 3."""
TAGS = {"bt601": 6, "bt709": 1, "bt2020": 9, "unspecified": 2, "ycgco": 8}
"""ITU-T H.273, table 4."""
CODECS = {
    "h264": ("libx264", "yuv420p", {"crf": "2", "bf": "2"}),
    "hevc10": ("libx265", "yuv420p10le", {"crf": "2", "x265-params": "log-level=none"}),
    "av1": ("libsvtav1", "yuv420p10le", {"crf": "4", "preset": "8", "svtav1-params": "lp=1"}),
}


@dataclass(frozen=True)
class Made:
    """Stated is the tag in the file, matrix what the planes have."""

    codec: str = "h264"
    matrix: str = "bt709"
    full: bool = False
    stated: str | None = None
    side: int = 48
    mark: int = 0

    def picture(self) -> np.ndarray:
        """The patches, with a mark in a corner by which recordings differ."""
        picture = enlarged(PATCHES, self.side)
        picture[:16, :16] = self.mark
        return picture

    def write(self, path: Path) -> Path:
        encoder, pixel_format, options = CODECS[self.codec]
        picture = self.picture()
        red, blue = LUMA[self.matrix]
        rgb = picture.astype(float) / 255
        luma = rgb @ (red, 1 - red - blue, blue)
        chroma = ((rgb[..., 2] - luma) / (2 - 2 * blue), (rgb[..., 0] - luma) / (2 - 2 * red))
        scales = (0, 255, 255) if self.full else (16, 219, 224)
        planes = [scales[0] + scales[1] * luma, *(128 + scales[2] * plane for plane in chroma)]
        yuv = np.clip(np.rint(planes), 0, 255).astype(np.uint8)
        with av.open(str(path), "w", format="mp4") as out:
            stream = out.add_stream(encoder, rate=RATE, options=options)
            stream.height, stream.width, stream.pix_fmt = *picture.shape[:2], pixel_format
            context = stream.codec_context
            context.thread_count = 1
            context.colorspace = TAGS[self.stated or self.matrix]
            context.color_range = 0 if self.stated == "unspecified" else 2 if self.full else 1
            for number in range(FRAMES):
                frame = av.VideoFrame.from_ndarray(yuv, format="yuv444p").reformat(format=pixel_format)
                frame.colorspace, frame.color_range = context.colorspace, context.color_range
                frame.pts, frame.time_base = number, Fraction(1, RATE)
                out.mux(stream.encode(frame))
            out.mux(stream.encode(None))
        return path


CASES = [
    Made(codec, matrix, full, mark=12 * number)
    for number, (codec, matrix, full) in enumerate(itertools.product(CODECS, LUMA, (False, True)))
    if codec == "h264" or (matrix == "bt2020") == full
]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[Path, Made]:
    """A video of every case, in one folder."""
    folder = tmp_path_factory.mktemp("made")
    return {case.write(folder / f"{number:02d}.mp4"): case for number, case in enumerate(CASES)}


def test_pictures_have_the_colours_that_ffmpeg_shows(made: dict[Path, Made]) -> None:
    decoder = FrameDecoder()
    for path, case in made.items():
        clip = VideoClip.whole_file(path, FRAMES, RATE)
        pictures = list(read_clip(clip))
        found = np.stack([picture.rgb for picture in pictures])
        assert off(found) <= TOLERANCE, case
        assert np.array_equal(np.stack(list(decoder.frames(clip, range(FRAMES)))), found)  # what training reads
        shown = by_ffmpeg(path, *found.shape[1:3])
        assert shown is None or shown.shape == found.shape, case
        assert shown is None or np.abs(shown.astype(int) - found).max() <= TOLERANCE, case
        # What filters look at: the same light, whatever the depth and the range.
        red, blue = LUMA[case.matrix]
        light = PATCHES @ (red, 1 - red - blue, blue)
        luma = pictures[0].luma[case.side // 2 :: case.side, case.side // 2 :: case.side].astype(float)
        assert np.abs((luma if pictures[0].full_range else (luma - 16) * 255 / 219) - light).max() <= TOLERANCE, case
    decoder.close()


@pytest.mark.slow
@pytest.mark.parametrize("image_size", [None, (96, 120)])
def test_colours_stay_through_curation_and_export(tmp_path: Path, made: dict[Path, Made], image_size: Any) -> None:
    folder = next(iter(made)).parent
    source = {"kind": "video_folder", "path": str(folder), "name": "web", "split": "train"}
    counts, curated = run(tmp_path, source, image_size=image_size, near_duplicates=False)
    assert counts["kept"] == len(CASES)
    export(curated.root, tmp_path / "exported", formats=("lerobot",))
    exported = EpisodeSet.open(tmp_path / "exported")
    for number, case in enumerate(CASES):
        for episodes in (curated, exported):
            assert off(episodes.frames(number, "head")) <= TOLERANCE, case
    # Without another size the packets are those that the test above shows to ffmpeg; with one, all are encoded alike.
    shown = by_ffmpeg(Path(str(curated.clip(0, "head").path)), *image_size) if image_size else None
    assert shown is None or off(shown) <= TOLERANCE


@pytest.mark.parametrize(("lines", "matrix"), [(240, "bt601"), (716, "bt601"), (720, "bt709"), (1080, "bt709")])
def test_a_matrix_that_is_not_stated_follows_from_the_number_of_lines(tmp_path: Path, lines: int, matrix: str) -> None:
    made = Made("h264", matrix, stated="unspecified", side=lines // 2)
    clip = VideoClip.whole_file(made.write(tmp_path / "a.mp4"), FRAMES, RATE)
    assert off(next(read_clip(clip)).rgb) <= TOLERANCE


def track(path: Path, codec: str) -> ImageTrack:
    """The video's packets as messages of a topic, each with its time of presentation."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        annex_b = av.bitstream.BitStreamFilterContext(f"{codec}_mp4toannexb", stream)
        packets = [packet for source in container.demux(stream) for packet in annex_b.filter(source)]
    sent = [EncodedImage("", bytes(packet), codec.replace("hevc", "h265")) for packet in packets]
    file: Any = SimpleNamespace(path=path, messages=lambda *_: (("/video", "video", 0, 0, image) for image in sent))
    keys = [image.picture == "key" for image in sent]
    topic = Stream("/video", "video", log_ns=list(range(len(sent))), key_frames=keys)
    return ImageTrack(file, topic, np.argsort([packet.pts for packet in packets]), np.arange(len(sent)))


def test_video_messages_have_their_colours(made: dict[Path, Made]) -> None:
    for path, case in made.items():
        if case.codec != "av1":
            found = list(track(path, case.codec.removesuffix("10")).frames())
            assert found
            assert max(map(off, found)) <= TOLERANCE, case


def test_a_matrix_that_cannot_be_converted_is_named(tmp_path: Path) -> None:
    path = Made("h264", "bt709", stated="ycgco").write(tmp_path / "a.mp4")
    with pytest.raises(RejectedInputError, match=r"(?s)a\.mp4.*matrix coefficients 8"):
        _ = next(read_clip(VideoClip(path, FRAMES, RATE))).rgb


@pytest.mark.parametrize("pixel_format", ["yuv420p", "yuv444p"])
def test_what_is_encoded_states_its_colours(tmp_path: Path, pixel_format: Any) -> None:
    encode_video(tmp_path / "a.mp4", [Made().picture()] * 3, RATE, pixel_format=pixel_format)
    with open_video(tmp_path / "a.mp4") as (container, stream):
        context = stream.codec_context
        assert (context.colorspace, context.color_range) == (6, 1)  # BT.601, limited
        assert (context.color_primaries, context.color_trc) == (1, 1)  # BT.709's, which are those of sRGB
        assert off(next(container.decode(stream)).to_ndarray(format="rgb24")) <= TOLERANCE
    shown = by_ffmpeg(tmp_path / "a.mp4", *Made().picture().shape[:2])
    assert shown is None or off(shown) <= TOLERANCE
    assert cv2.VideoCapture(str(tmp_path / "a.mp4")).isOpened()


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
        assert by_command is None or (len(by_command) == FRAMES and off(by_command, expected) <= 3)
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
            with rejected("missing_calibration", f"orientation {orientation}"):
                decode_image(content, "here", calibrated=True)
    for value in (0, 1, 9, 65535):  # turn nothing
        assert off(decode_image(with_exif(value, kind), "here", calibrated=True), PATCHES) <= 4


def test_images_of_depth_are_no_pictures() -> None:
    depth = np.arange(24 * 32, dtype=np.uint16).reshape(24, 32) * 50
    with rejected("not_colour", "depth, not colour"):
        decode_image(bytes(cv2.imencode(".png", depth)[1]), "here")
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
