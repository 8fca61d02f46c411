"""Curation decodes each video once, and copies it where nothing in the picture changes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from tools.thumbnails import view_thumbnails
from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.data.episodes.source import LoadedEpisode
from worldline_core.data.episodes.view_recording import RecordedView, VideoSettings, recorded_size, store_view
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.video.clip import VideoClip, read_clip
from worldline_core.data.video.thumbnails import ThumbnailMaker, shrunk
from worldline_core.filters.filter import examine
from worldline_core.filters.filter_config import FilterConfig

Sample = tuple[Episode, dict[str, np.ndarray], dict[str, np.ndarray]]
Make = Callable[..., Sample]
FRAMES = 40


def write_video(path: Path, frames: np.ndarray, fps: int = 8) -> Path:
    """As another program would: B-frames, its own key frames."""
    with av.open(str(path), "w", format="mp4") as out:
        stream = out.add_stream("libx264", rate=fps)
        stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], "yuv420p"
        stream.options = {"crf": "20", "threads": "1"}
        for image in frames:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        out.mux(stream.encode(None))
    return path


def recordings(folder: Path, sample: Make, count: int = 3) -> Path:
    """An EpisodeSet of such videos, each in a file of its own."""
    with EpisodeSetWriter(folder / "raw") as writer:
        for number in range(count):
            episode, frames, _ = sample(number, num_frames=FRAMES, height=128, width=192)
            views = {}
            for view, images in frames.items():
                path = write_video(folder / f"{number}.{view}.mp4", images)
                views[view] = RecordedView(lambda: iter(()), FRAMES, VideoClip.whole_file(path, FRAMES, 8.0))
            writer.add(episode, views)
    return folder / "raw"


def config(raw: Path, **changes: object) -> CurateConfig:
    return CurateConfig.model_validate({"sources": [{"kind": "episode_set", "path": str(raw)}], **changes})


def packets(path: Path) -> list[bytes]:  # pyright: ignore[reportReturnType]
    with av.open(str(path)) as container:
        return [bytes(packet) for packet in container.demux(video=0) if packet.size]


def files_of(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.relative_to(folder).parts[0] != "run"
    }


def test_curation_copies_the_packets_and_counts_them(tmp_path: Path, sample: Make) -> None:
    raw = recordings(tmp_path, sample)
    counts = curate(config(raw), {}, tmp_path / "out")
    assert counts["kept"] == 3
    assert counts["videos"] == {"copied": 9, "encoded": 0}
    before, after = EpisodeSet.open(raw), EpisodeSet.open(tmp_path / "out")
    for i, row in enumerate(after.rows):
        for view in row.views:
            assert packets(after.clip(i, view).path) == packets(tmp_path / f"{i}.{view}.mp4")  # type: ignore[arg-type]
            assert np.array_equal(after.frames(i, view), before.frames(i, view))
            assert np.array_equal(after.frames(i, view, [7, 33, 2]), before.frames(i, view)[[7, 33, 2]])
    info = json.loads((tmp_path / "out" / "datasets" / "ur5e_pair" / "meta" / "info.json").read_text())
    feature = info["features"]["observation.images.head"]["info"]
    assert (feature["video.codec"], feature["video.pix_fmt"]) == ("h264", "yuv420p")
    again = curate(config(raw), {}, tmp_path / "again")
    assert again == counts
    assert files_of(tmp_path / "again") == files_of(tmp_path / "out")


@pytest.mark.parametrize(
    "changes", [{"video_mode": "encode"}, {"image_size": [64, 96]}, {"fps": 4}, {"stride": 2}], ids=str
)
def test_what_changes_the_picture_or_asks_for_it_is_encoded(tmp_path: Path, sample: Make, changes: dict) -> None:
    raw = recordings(tmp_path, sample, 1)
    counts = curate(config(raw, video_crf=2, **changes), {}, tmp_path / "out")
    assert counts["videos"] == {"copied": 0, "encoded": 3}
    before, after = EpisodeSet.open(raw), EpisodeSet.open(tmp_path / "out")
    step = 2 if "fps" in changes or "stride" in changes else 1
    expected = before.frames(0, "head")[::step]
    shown = after.frames(0, "head")
    assert len(shown) == after.rows[0].num_frames == FRAMES // step
    if "image_size" not in changes:
        assert np.abs(shown.astype(int) - expected).mean() < 3
    assert not list((tmp_path / "out" / "run").rglob("*.npz"))


def test_an_image_size_that_is_the_recordings_own_changes_nothing(tmp_path: Path, sample: Make) -> None:
    raw = recordings(tmp_path, sample, 1)
    assert curate(config(raw, image_size=[128, 192], fps=8), {}, tmp_path / "out")["videos"]["copied"] == 3


def test_verdicts_do_not_depend_on_the_cached_thumbnails(tmp_path: Path, sample: Make) -> None:
    curate(config(recordings(tmp_path, sample)), {}, tmp_path / "out")
    left = sorted((tmp_path / "out" / "run" / "thumbnails").rglob("*.npz"))
    assert len(left) == 9
    curated = EpisodeSet.open(tmp_path / "out")
    cached = {view: curated.thumbnails(1, view) for view in curated.rows[1].views}
    settings = FilterConfig()
    verdicts = [examine(settings, curated, i) for i in range(len(curated))]
    shutil.rmtree(tmp_path / "out" / "run")
    assert [examine(settings, EpisodeSet.open(tmp_path / "out"), i) for i in range(len(curated))] == verdicts
    assert all(verdict.findings for verdict in verdicts)
    for view, thumbnails in cached.items():
        made = curated.thumbnails(1, view)
        assert np.array_equal(made.gray, thumbnails.gray)
        assert np.array_equal(made.sharpness, thumbnails.sharpness)


def test_cached_thumbnails_of_another_video_are_not_used(tmp_path: Path, sample: Make) -> None:
    curate(config(recordings(tmp_path, sample)), {}, tmp_path / "out")
    curated = EpisodeSet.open(tmp_path / "out")
    own, other = curated.thumbnails(0, "head"), curated.thumbnails(1, "head")
    assert not np.array_equal(own.gray, other.gray)
    path = curated.clip(0, "head").path
    shutil.copy(curated.clip(1, "head").path, path)  # type: ignore[arg-type]
    assert np.array_equal(curated.thumbnails(0, "head").gray, other.gray)
    cache = next((tmp_path / "out" / "run" / "thumbnails").rglob("*head*/*/file-000.npz"))
    content = cache.read_bytes()
    cache.write_bytes(content[:200])
    assert np.array_equal(curated.thumbnails(0, "head").gray, other.gray)


def test_a_flipped_byte_in_cached_thumbnails_changes_nothing(tmp_path: Path, sample: Make) -> None:
    curate(config(recordings(tmp_path, sample, 1)), {}, tmp_path / "out")
    curated = EpisodeSet.open(tmp_path / "out")
    cache = next((tmp_path / "out" / "run" / "thumbnails").rglob("*head*/*/file-000.npz"))
    content, true = cache.read_bytes(), curated.thumbnails(0, "head")
    for position in range(0, len(content), len(content) // 40):
        cache.write_bytes(content[:position] + bytes([content[position] ^ 16]) + content[position + 1 :])
        found = curated.thumbnails(0, "head")
        assert np.array_equal(found.gray, true.gray)
        assert np.array_equal(found.sharpness, true.sharpness)


def test_thumbnails_of_a_segment_are_those_of_the_whole_cut(tmp_path: Path, sample: Make) -> None:
    curate(config(recordings(tmp_path, sample, 1)), {}, tmp_path / "out")
    curated = EpisodeSet.open(tmp_path / "out")
    whole = curated.thumbnails(0, "head")
    curated.rows[0] = replace(curated.rows[0], start=5, stop=25, num_frames=20, video_frames=20)
    part = curated.thumbnails(0, "head")
    assert np.array_equal(part.gray, whole.gray[5:25])
    assert np.array_equal(part.sharpness, whole.sharpness[5:25])


def test_thumbnails_are_luma_at_full_range_and_area_averages() -> None:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 255, (9, 96, 128, 3), dtype=np.uint8)
    images = np.stack([np.kron(image[::8, ::8], np.ones((8, 8, 1), np.uint8)) for image in images])
    found = view_thumbnails(images, fps=8.0)
    assert found.gray.shape == (9, 72, 96)
    weights = np.array([0.299, 0.587, 0.114])
    luma = images.astype(np.float64) @ weights
    assert np.abs(found.gray.mean(axis=(1, 2)) - luma.mean(axis=(1, 2))).max() < 1.0
    assert np.array_equal(found.sharpness[::2], found.sharpness[np.arange(0, 9, 2)])
    assert found.sharpness[0] == found.sharpness[1] != found.sharpness[2]  # measured every 0.25 s, two frames at 8 Hz
    limited = ThumbnailMaker(8.0)
    limited.add(np.full((72, 96), 16, np.uint8), full_range=False)
    limited.add(np.full((72, 96), 235, np.uint8), full_range=False)
    assert limited.thumbnails().gray.max(axis=(1, 2)).tolist() == [0, 255]


@pytest.mark.parametrize(("height", "width"), [(480, 640), (720, 1280), (128, 192), (90, 160), (101, 333), (40, 60)])
def test_thumbnails_of_any_size_keep_brightness_and_place(height: int, width: int) -> None:
    rows, columns = np.mgrid[:height, :width]
    luma = (40 + 160 * columns / width + 30 * (rows > height / 2)).astype(np.uint8)
    small = shrunk(luma)
    assert small.shape == (max(2, round(height * 96 / width)), 96)
    centres = (np.arange(96) + 0.5) * width / 96
    assert np.abs(small[2].astype(float) - (40 + 160 * centres / width)).max() < 3.5
    assert abs(float(small.mean()) - float(luma.mean())) < 2


def test_sharpness_falls_with_blur_and_is_that_of_the_definition(tmp_path: Path) -> None:
    import cv2

    rng = np.random.default_rng(3)
    sharp = rng.integers(0, 255, (120, 160, 3), dtype=np.uint8)
    blurred = cv2.GaussianBlur(sharp, (0, 0), 2)
    found = view_thumbnails([sharp, blurred], fps=4.0)
    gray = cv2.cvtColor(sharp, cv2.COLOR_RGB2GRAY)
    assert found.sharpness[0] == pytest.approx(cv2.Laplacian(gray, cv2.CV_64F).var(), rel=1e-5)
    assert found.sharpness[1] < 0.05 * found.sharpness[0]


@pytest.mark.slow
def test_an_enlarged_picture_is_as_sharp_as_its_recording(tmp_path: Path, sample: Make) -> None:
    raw = recordings(tmp_path, sample, 1)
    recorded = EpisodeSet.open(raw).thumbnails(0, "head").sharpness
    assert "recorded_size" not in EpisodeSet.open(raw).rows[0].conventions
    head = {"views": ["head"], "video_preset": "ultrafast"}
    curate(config(raw, image_size=[300, 384], **head), {}, tmp_path / "large")
    large = EpisodeSet.open(tmp_path / "large")
    assert json.loads(large.rows[0].conventions)["recorded_size.head"] == "128x192"
    assert large.thumbnails(0, "head").sharpness == pytest.approx(recorded, rel=0.25)

    # Curated again: copied, enlarged further, cut at the sides, reduced below the recording.
    for changes, noted in (
        ({}, "128x192"),
        ({"image_size": [450, 384]}, "128x192"),
        ({"image_size": [300, 192], "fit": "crop"}, "128x96"),
        ({"image_size": [64, 384]}, "64x192"),
        ({"image_size": [64, 96]}, None),
    ):
        out = tmp_path / "-".join(map(str, [*changes.values(), noted]))
        curate(config(tmp_path / "large", **head, **changes), {}, out)
        again = EpisodeSet.open(out)
        assert json.loads(again.rows[0].conventions).get("recorded_size.head") == noted
        if noted == "128x192":
            assert again.thumbnails(0, "head").sharpness == pytest.approx(recorded, rel=0.3)
        shutil.rmtree(out / "run", ignore_errors=True)
        assert np.array_equal(
            EpisodeSet.open(out).thumbnails(0, "head").sharpness, again.thumbnails(0, "head").sharpness
        )


@pytest.mark.parametrize("noted", ["large", "0x9", "48", "-1x5"])
def test_a_recorded_size_that_is_none_is_refused(noted: str) -> None:
    with pytest.raises(RejectedInputError, match=r"(?s)conventions, recorded_size\.head.*HEIGHTxWIDTH") as caught:
        recorded_size({"recorded_size.head": noted}, "head")
    assert caught.value.reason == "unreadable"


def test_too_few_or_too_many_images_are_refused(tmp_path: Path, sample: Make) -> None:
    _, frames, _ = sample(0)
    images = frames["head"]
    for count in (len(images) - 1, len(images) + 1):
        recorded = RecordedView(lambda: iter(images), count)
        with pytest.raises(RejectedInputError, match=rf"(?s)differ in length.*expected: {count} frames") as caught:
            store_view(recorded, tmp_path / "v.mp4", 8.0, VideoSettings())
        assert caught.value.reason == "length_mismatch"
    with pytest.raises(RejectedInputError, match=r"no pictures|differ in length"):
        store_view(RecordedView(lambda: iter(()), 3), tmp_path / "v.mp4", 8.0, VideoSettings())


def test_images_come_one_at_a_time(sample: Make, tmp_path: Path) -> None:
    episode, frames, _ = sample(0, num_frames=30)
    alive = 0

    class Counted(np.ndarray):
        most = 0

        def __del__(self) -> None:
            nonlocal alive
            alive -= 1

    def images():
        nonlocal alive
        for image in frames["head"]:
            alive += 1
            Counted.most = max(Counted.most, alive)
            yield image.copy().view(Counted)

    settings = VideoSettings(preset="ultrafast")
    _, thumbnails, _ = store_view(RecordedView(images, 30), tmp_path / "v.mp4", episode.fps, settings)
    assert len(thumbnails) == 30
    assert Counted.most <= 8  # a few views into the same picture; never a whole view


def test_a_source_without_clips_gives_its_images_one_by_one(sample: Make) -> None:
    episode, frames, _ = sample(0)
    asked: list[int] = []

    def images(view: str) -> Iterator[np.ndarray]:
        for number, image in enumerate(frames[view]):
            asked.append(number)
            yield image

    loaded = LoadedEpisode(episode, tuple(frames), images)
    one_by_one = loaded.each_image("head")
    assert np.array_equal(next(one_by_one), frames["head"][0])
    assert asked == [0], "only what is looked at may be read"
    assert np.array_equal(np.stack(list(one_by_one)), frames["head"][1:])
    assert np.array_equal(loaded.frames("head"), frames["head"])


def test_read_clip_says_the_range_of_its_luma(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "full.mp4"), "w") as out:
        stream: Any = out.add_stream("mjpeg", rate=8)
        stream.height, stream.width, stream.pix_fmt = 64, 96, "yuvj420p"
        out.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((64, 96, 3), 255, np.uint8), format="rgb24")))
        out.mux(stream.encode(None))
    picture = next(read_clip(VideoClip.whole_file(tmp_path / "full.mp4", 1, 8.0)))
    assert picture.full_range
    assert picture.luma.min() >= 253
