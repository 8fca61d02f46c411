"""Names and links that lead out of a dataset, cannot be stored, or occur twice."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.data.curating import rejected
from tools.corrupted import lerobot_v21
from tools.corrupted.content import FPS, pictures
from tools.corrupted.one_of_each import write_one_of_each
from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode_index import read_index, read_quarantine, write_index
from worldline_core.data.episodes.source import check_id, storable
from worldline_core.data.guards.source_paths import fill_template, inside, safe_stem
from worldline_core.data.sources.video_folder import VideoFolderSource, VideoFolderSourceConfig
from worldline_core.data.video.encoder import encode_video
from worldline_core.errors import DataError

Make = Callable[[int], tuple[Path, CurateConfig]]


def curated(source: CurateConfig | dict[str, Any] | list[Any], output: Path) -> tuple[int, list[str], dict[str, str]]:
    """Return the number of recordings, the kept ones, and the reasons against the others."""
    if not isinstance(source, CurateConfig):
        source = CurateConfig.model_validate({"sources": source if isinstance(source, list) else [source]})
    counts = curate(source, {}, output)
    refused = {row.episode_id: row.reason for row in read_quarantine(output)}
    return counts["found"], [row.episode_id for row in read_index(output)], refused


@pytest.mark.parametrize(
    "relative", ["../x", "a/../../x", "/etc/hostname", "a/b/../../../x", "..", "a\0b", "link/x", "file_link"]
)
def test_a_path_out_of_the_folder_is_refused(tmp_path: Path, relative: str) -> None:
    for folder in ("root/a", "outside"):
        (tmp_path / folder).mkdir(parents=True)
    root = tmp_path / "root"
    for link, target in {"link": tmp_path / "outside", "file_link": "/etc/hostname", "b": root / "a"}.items():
        (root / link).symlink_to(target)
    with rejected("path_traversal", "outside of the dataset folder"):
        inside(root, relative)
    assert inside(root, "b/x") == root / "b/x"  # a link within the folder is followed


@pytest.mark.parametrize(
    "template", ["{video_key.__class__}/x", "{0}", "{video_key!r}", "{secret}", "{episode_index:999999d}", "{", "a}b"]
)
def test_templates_do_no_more_than_fill_in_numbers(template: str) -> None:
    with rejected("path_traversal", "template"):
        fill_template(template, video_key="k", episode_index=1)


@pytest.mark.parametrize("template", ["../../{episode_index}.parquet", "/etc/{episode_index}", "x/../../../y"])
def test_a_template_that_leads_out_costs_every_episode_and_opens_nothing(
    dataset: Make, tmp_path: Path, template: str
) -> None:
    root, config = dataset(2)
    info = json.loads((root / "meta/info.json").read_text())
    (root / "meta/info.json").write_text(json.dumps({**info, "data_path": template}))
    with pytest.raises(DataError, match=r"2 quarantined \(2 path_traversal\)"):
        curate(config, {}, tmp_path / "out")


def test_links_out_of_the_dataset_cost_their_own_episodes(dataset: Make, tmp_path: Path) -> None:
    root, config = dataset(4)
    outside = tmp_path / "outside"
    outside.mkdir()
    table = root / "data/chunk-000/episode_000001.parquet"
    video = next((root / "videos/chunk-000").glob("*top/episode_000002.mp4"))
    for file in (table, video):
        file.rename(outside / file.name)
    table.symlink_to(outside / table.name)
    video.symlink_to(os.path.relpath(outside / video.name, video.parent))
    refused = {"set-000001": "path_traversal", "set-000002": "path_traversal"}
    assert curated(config, tmp_path / "out") == (4, ["set-000000", "set-000003"], refused)


def test_a_bundle_with_linked_images(tmp_path: Path) -> None:
    pytest.importorskip("h5py", reason="the extra `hdf5` is not installed")
    source = write_one_of_each(tmp_path / "layouts")["agibot_gesim"]
    images = next(Path(source["path"]).rglob("head_color"))
    images.rename(tmp_path / "outside").mkdir(exist_ok=True)
    images.symlink_to(tmp_path / "outside")
    with pytest.raises(DataError, match=r"1 quarantined \(1 path_traversal\)"):
        curated(source, tmp_path / "out")


def renamed(config: CurateConfig, folder: Path, names: list[str]) -> dict[str, Any]:
    """A set whose episodes have other names."""
    curate(config, {}, folder)
    rows = [replace(row, episode_id=name) for row, name in zip(read_index(folder), names, strict=True)]
    write_index(folder, rows)
    return {"kind": "episode_set", "path": str(folder)}


def test_ids_are_never_used_as_file_names(dataset: Make, tmp_path: Path) -> None:
    """An EpisodeSet whose ids look like paths: they stay names."""
    names = ["../../../evil", "/etc/evil", "a/../../evil"]
    again = renamed(dataset(3)[1], tmp_path / "set", names)
    before = set(tmp_path.rglob("*"))
    assert sorted(curated(again, tmp_path / "out")[1]) == sorted(names)
    assert {path for path in tmp_path.rglob("*") if not path.is_relative_to(tmp_path / "out")} == before
    assert not list(Path("/etc").glob("evil*"))


def test_names_that_are_no_utf8_do_not_stop_the_rest(tmp_path: Path) -> None:
    root = tmp_path / "videos"
    root.mkdir()
    for number, name in enumerate([b"good.mp4", b"bad\xff\xfe.mp4", b"line\nbreak.mp4", b"\xe2\x80\xae.mp4"]):
        encode_video(root / "a.mp4", pictures(np.random.default_rng(number)), FPS, preset="ultrafast")
        (root / "a.mp4").rename(root / os.fsdecode(name))
    source = {"kind": "video_folder", "path": str(root), "name": "folder", "split": "train"}
    found, kept, refused = curated(source, tmp_path / "out")
    assert found == 4 == len(kept) + len(refused)
    assert "folder-good" in kept
    assert set(refused.values()) <= {"invalid_id"}
    assert all(name.isprintable() for name in refused)


def test_ids_that_cannot_be_stored_are_shown_escaped() -> None:
    for name in ("plain-01", "ü 漢"):
        assert storable(name) == name
    assert storable("a\udcffb\n\x1b[31m") == "a\\xffb\\n\\x1b[31m"
    assert len(storable("x" * 10_000)) <= 512
    check_id("../../evil", "source")  # a name like others: it is never used as a path
    for bad in ("a\nb", "a\udcff", "", "x" * 513, "\u202e"):
        with rejected("invalid_id", "cannot be stored"):
            check_id(bad, "source")


def test_ids_twice_within_a_source_and_across_sources(tmp_path: Path) -> None:
    roots = [tmp_path / name / "set" for name in ("one", "two")]
    sources = [lerobot_v21.write(root, 3, 0, np.random.default_rng(n))[1] for n, root in enumerate(roots)]
    listing = roots[0] / "meta/episodes.jsonl"
    lines = listing.read_text().splitlines()
    listing.write_text("\n".join([*lines, lines[1], lines[1], lines[1]]) + "\n")
    names = ["set-000001", "set-000001#source.0", "set-000001#source.0.2", "set-000001#source.0.3"]
    names += [f"set-00000{n}#source.1" for n in range(3)]
    refused = dict.fromkeys(names, "duplicate_id")
    assert curated(sources, tmp_path / "out") == (9, ["set-000000", "set-000002"], refused)


def test_a_set_with_an_id_twice_is_not_resolved_by_chance(dataset: Make, tmp_path: Path) -> None:
    found, kept, refused = curated(renamed(dataset(3)[1], tmp_path / "set", ["a", "a", "b"]), tmp_path / "out")
    assert (found, kept, list(refused.values())) == (3, ["b"], ["duplicate_id"] * 2)


COLLIDING = ["a-b/c.mp4", "a/b-c.mp4", *(f"a-b-c-{sha256(b'a-b/c.mp4').hexdigest()[:n]}.mp4" for n in (8, 64))]


@pytest.mark.parametrize(
    "names", [["a\udcff.mp4", "a\\xff.mp4"], COLLIDING[:3], COLLIDING, ["x.mp4", "x.MP4"], ["1.mp4", "2.mp4"]]
)
def test_every_file_has_an_id_of_its_own(tmp_path: Path, names: list[str]) -> None:
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    source = VideoFolderSource(VideoFolderSourceConfig(path=tmp_path, name="web"), tmp_path)
    assert len(source.episode_ids()) == len(names)
    assert {str(file) for file in source.files.values()} == set(names)
    if "1.mp4" in names:  # unique names stay
        assert list(source.episode_ids()) == ["web-1", "web-2"]


def test_stems_of_files_differ_where_names_do() -> None:
    names = ["run 1", "run_1", "run.1", "run/1", "run\\1"]
    names += [safe_stem(name) for name in names] + [safe_stem(safe_stem("run 1"))]
    assert len({safe_stem(name) for name in names}) == len(set(names))
