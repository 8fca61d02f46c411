"""Names and links that lead out of a dataset, cannot be stored, or occur twice."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pytest

from tools.corrupted import lerobot_v21
from tools.corrupted.content import FPS, pictures
from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode_index import read_index, read_quarantine, write_index
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import fill_template, inside, safe_stem
from worldline_core.data.sources.episode_files import check_id, storable, unique_names
from worldline_core.data.sources.video_folder import VideoFolderSource, VideoFolderSourceConfig
from worldline_core.data.video.encoder import encode_video
from worldline_core.errors import DataError

Make = Callable[[int], tuple[Path, CurateConfig]]


def reasons(output: Path) -> dict[str, str]:
    return {row.episode_id: row.reason for row in read_quarantine(output)}


def kept(output: Path) -> list[str]:
    return [row.episode_id for row in read_index(output)]


@pytest.mark.parametrize(
    "relative", ["../x", "a/../../x", "/etc/hostname", "a/b/../../../x", "..", "a\0b", "link/x", "file_link"]
)
def test_a_path_out_of_the_folder_is_refused(tmp_path: Path, relative: str) -> None:
    root = tmp_path / "root"
    root.mkdir()
    (tmp_path / "outside").mkdir()
    (root / "link").symlink_to(tmp_path / "outside")
    (root / "file_link").symlink_to("/etc/hostname")
    with pytest.raises(RejectedInputError, match="outside of the dataset folder") as caught:
        inside(root, relative)
    assert caught.value.reason == "path_traversal"


def test_a_link_within_the_folder_is_followed(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").symlink_to(tmp_path / "a")
    assert inside(tmp_path, "b/x") == tmp_path / "b/x"


@pytest.mark.parametrize(
    "template", ["{video_key.__class__}/x", "{0}", "{video_key!r}", "{secret}", "{episode_index:999999d}", "{", "a}b"]
)
def test_templates_do_no_more_than_fill_in_numbers(template: str) -> None:
    with pytest.raises(RejectedInputError, match="template") as caught:
        fill_template(template, video_key="k", episode_index=1)
    assert caught.value.reason == "path_traversal"


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
    table.rename(outside / table.name)
    table.symlink_to(outside / table.name)
    video = next((root / "videos/chunk-000").glob("*top/episode_000002.mp4"))
    video.rename(outside / video.name)
    video.symlink_to(os.path.relpath(outside / video.name, video.parent))
    counts = curate(config, {}, tmp_path / "out")
    assert (counts["found"], counts["kept"]) == (4, 2)
    assert reasons(tmp_path / "out") == {"set-000001": "path_traversal", "set-000002": "path_traversal"}


def agibot_sample(folder: Path, outside: Path | None = None) -> None:
    """A GE-Sim bundle whose images may lie elsewhere."""
    length, random = 3, np.random.default_rng(len(str(folder)))
    folder.mkdir(parents=True)
    actions = np.tile([0.3, 0, 0.3, 0, 0, 0, 1, 40.0] * 2, (length, 1)) + random.uniform(0, 0.01)
    np.save(folder / "actions.npy", actions)
    from PIL import Image

    for name in ("head_color", "hand_left_color", "hand_right_color"):
        target = folder / name if outside is None else outside / name
        target.mkdir(parents=True)
        for number in range(length):
            Image.fromarray(pictures(random, 1)[0]).save(target / f"{number}.png")
        if outside is not None:
            (folder / name).symlink_to(target)
    for camera in ("head", "hand_left", "hand_right"):
        np.save(folder / f"intrinsic_{camera}.npy", np.array([[80.0, 0, 47], [0, 80.0, 35], [0, 0, 1]]))
        np.save(folder / f"extrinsic_{camera}.npy", np.tile(np.eye(4), (length, 1, 1)))


def test_a_bundle_with_linked_images(tmp_path: Path) -> None:
    agibot_sample(tmp_path / "set/sample_0")
    agibot_sample(tmp_path / "set/sample_1", tmp_path / "outside")
    source = {"kind": "agibot_gesim", "path": str(tmp_path / "set"), "fps": 30, "split": "train"}
    counts = curate(CurateConfig.model_validate({"sources": [source]}), {}, tmp_path / "out")
    assert (counts["found"], counts["kept"], counts["reasons"]) == (2, 1, {"path_traversal": 1})


def test_ids_are_never_used_as_file_names(dataset: Make, tmp_path: Path) -> None:
    """An EpisodeSet whose ids look like paths: they stay names."""
    from dataclasses import replace

    _, config = dataset(3)
    curate(config, {}, tmp_path / "set")
    rows = read_index(tmp_path / "set")
    names = ["../../../evil", "/etc/evil", "a/../../evil"]
    write_index(tmp_path / "set", [replace(row, episode_id=name) for row, name in zip(rows, names, strict=True)])
    again = CurateConfig.model_validate({"sources": [{"kind": "episode_set", "path": str(tmp_path / "set")}]})
    before = {path for path in tmp_path.rglob("*") if "out" not in path.parts}
    counts = curate(again, {}, tmp_path / "out")
    assert counts["kept"] == 3
    assert sorted(kept(tmp_path / "out")) == sorted(names)
    assert {path for path in tmp_path.rglob("*") if not path.is_relative_to(tmp_path / "out")} == before
    assert not list(Path("/etc").glob("evil*"))


def video_names(root: Path, names: list[bytes]) -> dict[str, Any]:
    root.mkdir()
    for number, name in enumerate(names):
        sound = root / f"sound{number}.mp4"
        encode_video(sound, pictures(np.random.default_rng(number)), FPS, preset="ultrafast")
        sound.rename(root / os.fsdecode(name))
    return {"kind": "video_folder", "path": str(root), "name": "folder", "split": "train"}


def test_names_that_are_no_utf8_do_not_stop_the_rest(tmp_path: Path) -> None:
    source = video_names(
        tmp_path / "videos", [b"good.mp4", b"bad\xff\xfe.mp4", b"line\nbreak.mp4", b"\xe2\x80\xae.mp4"]
    )
    counts = curate(CurateConfig.model_validate({"sources": [source]}), {}, tmp_path / "out")
    assert counts["found"] == 4 == counts["kept"] + counts["quarantined"]
    assert "folder-good" in kept(tmp_path / "out")
    assert set(reasons(tmp_path / "out").values()) <= {"invalid_id"}
    for row in read_quarantine(tmp_path / "out"):
        assert row.episode_id.isprintable()


def test_ids_that_cannot_be_stored_are_shown_escaped() -> None:
    assert storable("plain-01") == "plain-01"
    assert storable("ü 漢") == "ü 漢"
    assert storable("a\udcffb\n\x1b[31m") == "a\\xffb\\n\\x1b[31m"
    assert len(storable("x" * 10_000)) <= 512
    check_id("../../evil", "source")  # a name like others: it is never used as a path
    for bad in ("a\nb", "a\udcff", "", "x" * 513, "\u202e"):
        with pytest.raises(RejectedInputError, match="cannot be stored") as caught:
            check_id(bad, "source")
        assert caught.value.reason == "invalid_id"


def test_ids_twice_within_a_source_and_across_sources(tmp_path: Path) -> None:
    roots = [tmp_path / name / "set" for name in ("one", "two")]
    sources = [lerobot_v21.write(root, 3, 0, np.random.default_rng(n))[1] for n, root in enumerate(roots)]
    listing = roots[0] / "meta/episodes.jsonl"
    lines = listing.read_text().splitlines()
    listing.write_text("\n".join([*lines, lines[1], lines[1], lines[1]]) + "\n")
    counts = curate(CurateConfig.model_validate({"sources": sources}), {}, tmp_path / "out")
    assert counts["found"] == 9
    assert kept(tmp_path / "out") == ["set-000000", "set-000002"]
    assert reasons(tmp_path / "out") == dict.fromkeys(
        ["set-000001", "set-000001#source.0", "set-000001#source.0.2", "set-000001#source.0.3"]
        + [f"set-00000{n}#source.1" for n in range(3)],
        "duplicate_id",
    )


def test_a_set_with_an_id_twice_is_not_resolved_by_chance(dataset: Make, tmp_path: Path) -> None:
    from dataclasses import replace

    _, config = dataset(3)
    curate(config, {}, tmp_path / "set")
    rows = read_index(tmp_path / "set")
    write_index(tmp_path / "set", [rows[0], replace(rows[1], episode_id=rows[0].episode_id), rows[2]])
    again = CurateConfig.model_validate({"sources": [{"kind": "episode_set", "path": str(tmp_path / "set")}]})
    counts = curate(again, {}, tmp_path / "out")
    assert (counts["found"], counts["reasons"]) == (3, {"duplicate_id": 2})
    assert kept(tmp_path / "out") == [rows[2].episode_id]


def digested(name: str, digits: int) -> str:
    return sha256(name.encode()).hexdigest()[:digits]


@pytest.mark.parametrize(
    "names",
    [
        ["a\udcff.mp4", "a\\xff.mp4"],
        ["a-b/c.mp4", "a/b-c.mp4", f"a-b-c-{digested('a-b/c.mp4', 8)}.mp4"],
        ["a-b/c.mp4", "a/b-c.mp4", f"a-b-c-{digested('a-b/c.mp4', 8)}.mp4", f"a-b-c-{digested('a-b/c.mp4', 64)}.mp4"],
        ["x.mp4", "x.MP4"],
    ],
)
def test_every_file_has_an_id_of_its_own(tmp_path: Path, names: list[str]) -> None:
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    source = VideoFolderSource(VideoFolderSourceConfig(path=tmp_path, name="web"), tmp_path)
    assert len(source.episode_ids()) == len(names)
    assert {str(file) for file in source.files.values()} == set(names)


def test_a_unique_name_stays() -> None:
    files = {PurePosixPath(f"{n}.mp4"): f"web-{n}" for n in range(3)}
    assert unique_names(files) == files


def test_stems_of_files_differ_where_names_do() -> None:
    names = ["run 1", "run_1", "run.1", "run/1", "run\\1"]
    names += [safe_stem(name) for name in names] + [safe_stem(safe_stem("run 1"))]
    assert len({safe_stem(name) for name in names}) == len(set(names))
