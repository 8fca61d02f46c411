"""Colours of videos by their matrix and range, in every path: against patches of known colour, and against `ffmpeg`.

Planes are computed here from the luma coefficients that the standards state, so nothing of this project or of libswscale
takes part in making a video.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from tests.data.curating import PATCHES, by_ffmpeg, enlarged, off, run
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.mcap.file import _decoded  # pyright: ignore[reportPrivateUsage]
from worldline_core.data.mcap.messages import EncodedImage
from worldline_core.data.video.clip import FrameDecoder, VideoClip, open_video, read_clip
from worldline_core.data.video.encoder import encode_video
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


def messages(path: Path, codec: str) -> Iterator[tuple[int, EncodedImage]]:
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        annex_b = av.bitstream.BitStreamFilterContext(f"{codec}_mp4toannexb", stream)
        packets = [packet for source in container.demux(stream) for packet in annex_b.filter(source)]
    for number, packet in enumerate(packets):
        yield number, EncodedImage("", bytes(packet), codec.replace("hevc", "h265"))


def test_video_messages_have_their_colours(made: dict[Path, Made]) -> None:
    for path, case in made.items():
        if case.codec != "av1":
            found = [image for _, image in _decoded(messages(path, case.codec.removesuffix("10")), bytes, "here")]
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
