"""`worldline inspect` on a filter step's artifact: kept and dropped clips by reason, with timelines."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.errors import DataError
from worldline_core.filters.filter import filter_episodes
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.report.inspect import KEPT_COLOUR, LOST_COLOUR, clips_by_reason, episode_of, inspect
from worldline_core.store.atomic import write_json_atomic

CONFIG = FilterConfig(min_segment_frames=8)


@pytest.fixture(scope="module")
def filtered(project_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four episodes of one recording: healthy, dark in the middle, black throughout, and with a camera turned about."""
    root = tmp_path_factory.mktemp("artifacts")
    episodes = EpisodeSet.open(project_root / "artifacts" / "shipped" / "recordings")
    i = episodes.position("ur5e_silver-test-s1-00002")
    episode = episodes.episode(i)
    frames = {view: episodes.frames(i, view) for view in episodes.rows[i].views}
    with EpisodeSetWriter(root / "curate" / "key") as writer:
        writer.add(replace(episode, episode_id="healthy"), frames)
        dark = frames["head"].copy()
        dark[12:18] = dark[12:18] // 16
        writer.add(replace(episode, episode_id="dark"), {**frames, "head": dark})
        writer.add(replace(episode, episode_id="black"), {**frames, "head": frames["head"] // 16})
        head = episode.cameras["head"]
        turned = replace(head, T_base_camera=np.linalg.inv(head.T_base_camera))
        writer.add(replace(episode, episode_id="turned", cameras={**episode.cameras, "head": turned}), frames)
    folder = root / "filter" / "key"
    filter_episodes(CONFIG, {"episodes": root / "curate" / "key"}, folder)
    content = {
        "config": CONFIG.model_dump(mode="json"),
        "inputs": {"episodes": {"path": "curate/key", "digest": "0"}},
    }
    write_json_atomic(folder / "manifest.json", content)
    return folder


def test_every_clip_stands_under_its_reasons(filtered: Path) -> None:
    found = clips_by_reason(filtered)
    assert next(iter(found)) == "too_dark"
    assert list(found)[-1] == "kept"
    assert set(found["kept"]) == {"healthy"}
    assert {name: clip.decision for name, clip in found["too_dark"].items()} == {
        "black": "dropped whole", "dark": "6 frames cut",
    }  # fmt: skip
    assert "threshold bright level" in found["too_dark"]["dark"].numbers
    assert "turned" in {name for reason, clips in found.items() if reason != "kept" for name in clips}
    assert [len(found["too_dark"][name].kept) for name in ("black", "dark")] == [0, 2]
    assert [episode_of(name) for name in ("a@00012", "a@b", "a", "a@b@00001")] == ["a", "a@b", "a", "a@b"]


def test_a_page_shows_kept_and_dropped_clips(filtered: Path, tmp_path: Path) -> None:
    result = inspect(filtered, tmp_path)
    html = (tmp_path / "index.html").read_text()
    assert "4 segments of 4 episodes were kept" in html
    assert "2 episodes, 1 dropped whole" in html
    pictures = [path for path in result.written if path.name.startswith("reason_")]
    assert {"reason_too_dark.jpg", "reason_kept.jpg"} <= {path.name for path in pictures}
    for path in pictures:
        assert f'src="{path.name}"' in html
        with Image.open(path) as image:
            assert image.width > 800


def test_the_timeline_has_the_dropped_frames_at_their_place(filtered: Path, tmp_path: Path) -> None:
    result = inspect(filtered, tmp_path, episode_id="dark")
    assert [path.name for path in result.written] == ["index.html", "reason_dark_too_dark.jpg"]
    with Image.open(tmp_path / "reason_dark_too_dark.jpg") as image:
        picture = np.asarray(image.convert("RGB"))
    row = next(r for r in picture if (np.abs(r.astype(int) - KEPT_COLOUR).max(axis=-1) < 8).mean() > 0.6)
    dropped = np.flatnonzero(np.abs(row.astype(int) - LOST_COLOUR).max(axis=-1) < 8)
    width = len(row) - 24
    assert abs((dropped[0] - 12) / width - 12 / 33) < 0.02
    assert abs((dropped[-1] - 12) / width - 18 / 33) < 0.02


def test_a_kept_episode_is_shown_with_its_controls_as_well(filtered: Path, tmp_path: Path) -> None:
    names = [path.name for path in inspect(filtered, tmp_path, episode_id="healthy").written]
    assert {"reason_healthy_kept.jpg", "contact_sheet.jpg", "healthy_controls.jpg"} <= set(names)
    segment = [path.name for path in inspect(filtered, tmp_path, episode_id="dark@00018").written]
    assert "reason_dark_too_dark.jpg" in segment
    assert any(name.startswith("dark_00018") and name.endswith("_controls.jpg") for name in segment)
    black = [path.name for path in inspect(filtered, tmp_path, episode_id="black").written]
    assert black == ["index.html", "reason_black_too_dark.jpg"]
    with pytest.raises(DataError, match="nobody"):
        inspect(filtered, tmp_path, episode_id="nobody")


def test_without_the_curated_set_it_is_said(filtered: Path, tmp_path: Path) -> None:
    (filtered / "manifest.json").rename(tmp_path / "manifest.json")
    try:
        assert "dropped clips are not shown" in str(inspect(filtered, tmp_path))
    finally:
        (tmp_path / "manifest.json").rename(filtered / "manifest.json")


def test_hostile_reasons_stay_text(filtered: Path, hostile_text: str, tmp_path: Path) -> None:
    copy = tmp_path / "filter" / "key"
    shutil.copytree(filtered, copy)
    (tmp_path / "curate").symlink_to(filtered.parent.parent / "curate")
    for name, column in (("quarantine.parquet", "reason"), ("index.parquet", "stage2_reason")):
        table = pq.read_table(copy / name)
        texts = [None if text is None else hostile_text for text in table[column].to_pylist()]
        place = table.column_names.index(column)
        pq.write_table(table.set_column(place, table.schema.field(place), pa.array(texts, pa.string())), copy / name)
    inspect(copy, tmp_path / "out")
    page = (tmp_path / "out" / "index.html").read_text()
    assert "<script>alert" not in page
    assert page.count("&lt;script&gt;alert(") >= 2
