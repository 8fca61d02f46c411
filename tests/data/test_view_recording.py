"""Curation decodes each video once, and copies it where nothing in the picture changes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.data.conftest import make_sample
from tests.data.curating import files_of, packets, rejected, run, write_video
from tools.labelled_clips import view_thumbnails
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.data.episodes.source import LoadedEpisode
from worldline_core.data.episodes.view_recording import VideoSettings, ViewImages, recorded_size, store_view
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.video.clip import VideoClip, read_clip
from worldline_core.data.video.thumbnails import ThumbnailMaker, shrunk
from worldline_core.filters.filter import examine
from worldline_core.filters.filter_config import FilterConfig

FRAMES, VIEWS = 40, ("head", "left_wrist")
Copied = tuple[dict[str, Any], dict[str, Any], EpisodeSet]


def recordings(folder: Path) -> dict[str, Any]:
    """An EpisodeSet of two recordings whose videos another program wrote, each in a file of its own."""
    with EpisodeSetWriter(folder / "raw") as writer:
        for number in range(2):
            episode, frames, _ = make_sample(number, num_frames=FRAMES, views=VIEWS, height=128, width=192)
            views = {}
            for view, images in frames.items():
                path = write_video(
                    folder / f"{number}.{view}.mp4", images, options={"crf": "20", "preset": "ultrafast"}
                )
                views[view] = ViewImages(lambda: iter(()), FRAMES, VideoClip.whole_file(path, FRAMES, 8.0))
            writer.add(episode, views)
    return {"kind": "episode_set", "path": str(folder / "raw")}


@pytest.fixture(scope="module")
def copied(tmp_path_factory: pytest.TempPathFactory) -> Copied:
    """The source of two recordings, the counts of their curation, and the set."""
    folder = tmp_path_factory.mktemp("two")
    source = recordings(folder)
    return source, *run(folder, source)


@pytest.fixture
def one(copied: Copied) -> dict[str, Any]:
    """The source of the first recording alone."""
    return {**copied[0], "include": ["episode-000"]}


@pytest.fixture
def curated(tmp_path: Path, copied: Copied) -> EpisodeSet:
    """A copy of that set, to be changed."""
    return EpisodeSet.open(shutil.copytree(copied[2].root, tmp_path / "curated"))


def cached_thumbnails(episodes: EpisodeSet) -> Path:
    return next((episodes.root / "run/thumbnails").rglob("*head*/*/file-000.npz"))


def test_curation_copies_the_packets_and_counts_them(tmp_path: Path, copied: Copied) -> None:
    source, counts, after = copied
    assert counts["videos"] == {"copied": 4, "encoded": 0}
    before = EpisodeSet.open(source["path"])
    for i, row in enumerate(after.rows):
        for view in row.views:
            written = Path(source["path"]).parent / f"{i}.{view}.mp4"
            assert packets(after.clip(i, view).path) == packets(written)  # type: ignore[arg-type]
            assert np.array_equal(after.frames(i, view), before.frames(i, view))
            assert np.array_equal(after.frames(i, view, [7, 33, 2]), before.frames(i, view)[[7, 33, 2]])
    info = json.loads((after.root / "datasets/ur5e_pair/meta/info.json").read_text())
    feature = info["features"]["observation.images.head"]["info"]
    assert (feature["video.codec"], feature["video.pix_fmt"]) == ("h264", "yuv420p")
    again, set_again = run(tmp_path, source)
    assert again == counts
    assert files_of(set_again.root) == files_of(after.root)


@pytest.mark.parametrize(
    "changes", [{"video_mode": "encode"}, {"image_size": [64, 96]}, {"fps": 4}, {"stride": 2}], ids=str
)
def test_what_changes_the_picture_is_encoded(tmp_path: Path, one: dict[str, Any], changes: dict[str, Any]) -> None:
    counts, after = run(tmp_path, one, video_crf=2, **changes)
    assert counts["videos"] == {"copied": 0, "encoded": 2}
    step = 2 if "fps" in changes or "stride" in changes else 1
    shown = after.frames(0, "head")
    assert len(shown) == after.rows[0].num_frames == FRAMES // step
    if "image_size" not in changes:
        assert np.abs(shown.astype(int) - EpisodeSet.open(one["path"]).frames(0, "head")[::step]).mean() < 3
    assert not list((after.root / "run").rglob("*.npz"))
    if "image_size" in changes:  # the recording's own changes nothing
        assert run(tmp_path / "same", one, image_size=[128, 192], fps=8)[0]["videos"]["copied"] == 2


def test_verdicts_do_not_depend_on_the_cached_thumbnails(curated: EpisodeSet) -> None:
    assert len(list((curated.root / "run/thumbnails").rglob("*.npz"))) == 4
    cached = {view: curated.thumbnails(1, view) for view in curated.rows[1].views}
    verdicts = [examine(FilterConfig(), curated, i) for i in range(len(curated))]
    shutil.rmtree(curated.root / "run")
    again = EpisodeSet.open(curated.root)
    assert [examine(FilterConfig(), again, i) for i in range(len(curated))] == verdicts
    assert all(verdict.findings for verdict in verdicts)
    for view, thumbnails in cached.items():
        made = curated.thumbnails(1, view)
        assert np.array_equal(made.gray, thumbnails.gray)
        assert np.array_equal(made.sharpness, thumbnails.sharpness)


def test_cached_thumbnails_of_another_video_and_damaged_ones_are_not_used(curated: EpisodeSet) -> None:
    true, other = curated.thumbnails(0, "head"), curated.thumbnails(1, "head")
    assert not np.array_equal(true.gray, other.gray)
    cache, video = cached_thumbnails(curated), curated.clip(0, "head").path
    content = cache.read_bytes()
    flipped = range(0, len(content), len(content) // 40)
    damaged = [content[:n] + bytes([content[n] ^ 16]) + content[n + 1 :] for n in flipped]
    for each in [*damaged, content[:200]]:
        cache.write_bytes(each)
        found = curated.thumbnails(0, "head")
        assert np.array_equal(found.gray, true.gray)
        assert np.array_equal(found.sharpness, true.sharpness)
    cache.write_bytes(content)
    shutil.copy(curated.clip(1, "head").path, video)  # type: ignore[arg-type]
    assert np.array_equal(curated.thumbnails(0, "head").gray, other.gray)


def test_thumbnails_of_a_segment_are_those_of_the_whole_cut(curated: EpisodeSet) -> None:
    whole = curated.thumbnails(0, "head")
    curated.rows[0] = replace(curated.rows[0], start=5, stop=25, num_frames=20, video_frames=20)
    part = curated.thumbnails(0, "head")
    assert np.array_equal(part.gray, whole.gray[5:25])
    assert np.array_equal(part.sharpness, whole.sharpness[5:25])


def test_thumbnails_are_luma_at_full_range_and_area_averages() -> None:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 255, (9, 12, 16, 3), dtype=np.uint8).repeat(8, axis=1).repeat(8, axis=2)
    found = view_thumbnails(images, fps=8.0)
    assert found.gray.shape == (9, 72, 96)
    luma = images @ np.array([0.299, 0.587, 0.114])
    assert np.abs(found.gray.mean(axis=(1, 2)) - luma.mean(axis=(1, 2))).max() < 1.0
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


def test_sharpness_falls_with_blur_and_is_that_of_the_definition() -> None:
    rng = np.random.default_rng(3)
    sharp = rng.integers(0, 255, (120, 160, 3), dtype=np.uint8)
    blurred = cv2.GaussianBlur(sharp, (0, 0), 2)
    found = view_thumbnails([sharp, blurred], fps=4.0)
    gray = cv2.cvtColor(sharp, cv2.COLOR_RGB2GRAY)
    assert found.sharpness[0] == pytest.approx(cv2.Laplacian(gray, cv2.CV_64F).var(), rel=1e-5)
    assert found.sharpness[1] < 0.05 * found.sharpness[0]


@pytest.mark.slow
def test_an_enlarged_picture_is_as_sharp_as_its_recording(tmp_path: Path, one: dict[str, Any]) -> None:
    raw = EpisodeSet.open(one["path"])
    recorded = raw.thumbnails(0, "head").sharpness
    assert "recorded_size" not in raw.rows[0].conventions
    head = {"views": ["head"], "video_preset": "ultrafast"}
    _, large = run(tmp_path, one, image_size=[300, 384], **head)
    assert json.loads(large.rows[0].conventions)["recorded_size.head"] == "128x192"
    assert large.thumbnails(0, "head").sharpness == pytest.approx(recorded, rel=0.25)
    # Curated again: copied, enlarged further, cut at the sides, reduced below the recording.
    for number, (changes, noted) in enumerate((
        ({}, "128x192"),
        ({"image_size": [450, 384]}, "128x192"),
        ({"image_size": [300, 192], "fit": "crop"}, "128x96"),
        ({"image_size": [64, 384]}, "64x192"),
        ({"image_size": [64, 96]}, None),
    )):  # fmt: skip
        _, again = run(tmp_path / str(number), {"kind": "episode_set", "path": str(large.root)}, **head, **changes)
        assert json.loads(again.rows[0].conventions).get("recorded_size.head") == noted
        sharpness = again.thumbnails(0, "head").sharpness
        if noted == "128x192":
            assert sharpness == pytest.approx(recorded, rel=0.3)
        shutil.rmtree(again.root / "run", ignore_errors=True)
        assert np.array_equal(EpisodeSet.open(again.root).thumbnails(0, "head").sharpness, sharpness)


@pytest.mark.parametrize("noted", ["large", "0x9", "48", "-1x5"])
def test_a_recorded_size_that_is_none_is_refused(noted: str) -> None:
    with rejected("unreadable", r"(?s)conventions, recorded_size\.head.*HEIGHTxWIDTH"):
        recorded_size({"recorded_size.head": noted}, "head")


def test_too_few_or_too_many_images_are_refused(tmp_path: Path) -> None:
    _, frames, _ = make_sample(0)
    images = frames["head"]
    for count in (len(images) - 1, len(images) + 1):
        recorded = ViewImages(lambda: iter(images), count)
        with rejected("length_mismatch", rf"(?s)differ in length.*expected: {count} frames"):
            store_view(recorded, tmp_path / "v.mp4", 8.0, VideoSettings())
    with pytest.raises(RejectedInputError, match=r"no pictures|differ in length"):
        store_view(ViewImages(lambda: iter(()), 3), tmp_path / "v.mp4", 8.0, VideoSettings())


def test_a_source_without_clips_gives_its_images_one_by_one() -> None:
    episode, frames, _ = make_sample(0)
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
    white = np.full((1, 64, 96, 3), 255, np.uint8)
    path = write_video(tmp_path / "full.mp4", white, codec="mjpeg", pixel_format="yuvj420p")
    picture = next(read_clip(VideoClip.whole_file(path, 1, 8.0)))
    assert picture.full_range
    assert picture.luma.min() >= 253
