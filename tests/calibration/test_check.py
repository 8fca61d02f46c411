"""`worldline calibrate check`: what is listed, what it prints and writes, and the line that repairs a recording."""

from __future__ import annotations

import errno
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from flows.command_line import main
from tools.corrupted.conventions import corrupt
from worldline_core.calibration import check as check_module
from worldline_core.calibration.check import (
    ListedEpisode,
    check_calibration,
    combined_conventions,
    repairing_lines,
)
from worldline_core.calibration.check_report import (
    CalibrationCheck,
    EpisodeCheck,
    as_json,
    cautions,
    page,
    table_text,
)
from worldline_core.calibration.diagnosis import Diagnosis, Explanation, SourceDiagnosis
from worldline_core.data.episodes.conventions import RecordedConventions, apply_conventions
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.source import LoadedEpisode
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.errors import ConfigError, DataError

CLEAN, INVERTED = "ur5e_silver-test-s1-00000", "ur5e_silver-train-s1-00002"
"""Shipped recordings; the second has inverted extrinsics (injected_defects.json)."""
HOSTILE = "<script>alert('x')</script>"


def listed(episode: Episode, images: dict[str, np.ndarray], name: str = "synthetic/0") -> ListedEpisode:
    named = replace(episode, episode_id=name)
    return ListedEpisode(name, "synthetic", lambda: LoadedEpisode(named, tuple(images), lambda view: images[view]))


def explained(conventions: RecordedConventions) -> Explanation:
    return Explanation(conventions, -1.0, {})


# --- the line that repairs


def test_what_is_declared_already_is_counted_in(episode: Episode, images: dict[str, np.ndarray]) -> None:
    declared = RecordedConventions(extrinsics="base_to_camera", camera_lag_frames=1)
    item = replace(listed(episode, images), declared=declared)
    lines = repairing_lines(item, explained(RecordedConventions(camera_lag_frames=2)))
    assert "curate.sources[].conventions.camera_lag_frames: 3" in lines
    assert "curate.sources[].conventions.extrinsics: base_to_camera" in lines
    wrongly = replace(listed(episode, images), declared=RecordedConventions(extrinsics="base_to_camera"))
    again = repairing_lines(wrongly, explained(RecordedConventions(extrinsics="base_to_camera")))
    assert again == ("remove curate.sources[].conventions",)


@pytest.mark.parametrize(
    ("declared", "found"),
    [
        (RecordedConventions(camera_lag_frames=1), RecordedConventions(camera_lag_frames=2)),
        (RecordedConventions(extrinsics="base_to_camera"), RecordedConventions(camera_axes="opengl")),
        (RecordedConventions(tool_offset_z_m=0.1), RecordedConventions(tool_offset_z_m=-0.03)),
        (RecordedConventions(gripper="inverted"), RecordedConventions(gripper="inverted")),
        (RecordedConventions(extrinsics="base_to_camera"), RecordedConventions(extrinsics="base_to_camera")),
    ],
)
def test_one_declaration_repairs_like_two(
    episode: Episode, declared: RecordedConventions, found: RecordedConventions
) -> None:
    together = combined_conventions(declared, found)
    wrong = corrupt(episode, together)
    twice, once = apply_conventions(apply_conventions(wrong, declared), found), apply_conventions(wrong, together)
    assert once.T_base_ee is not None
    assert twice.T_base_ee is not None
    assert np.allclose(twice.T_base_ee, once.T_base_ee)
    assert np.allclose(twice.state, once.state)
    for view in once.cameras:
        assert np.allclose(twice.cameras[view].T_base_camera, once.cameras[view].T_base_camera)


@pytest.mark.parametrize(
    ("declared", "found", "message"),
    [
        (RecordedConventions(quaternion="wxyz"), RecordedConventions(quaternion="wxyz"), "cannot be declared on top"),
        (
            RecordedConventions(camera_axes="opengl", views=("head",)),
            RecordedConventions(extrinsics="base_to_camera"),
            "different views",
        ),
    ],
)
def test_what_one_declaration_cannot_say_is_refused(
    declared: RecordedConventions, found: RecordedConventions, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        combined_conventions(declared, found)


def test_two_mistakes_are_named_together_and_need_a_line_each(episode: Episode, images: dict[str, np.ndarray]) -> None:
    explanation = explained(RecordedConventions(tool_offset_z_m=0.05, gripper="inverted"))
    assert explanation.mistake == "tool_offset_z_m+gripper"
    assert repairing_lines(listed(episode, images), explanation) == (
        "curate.sources[].conventions.tool_offset_z_m: 0.05",
        "curate.sources[].conventions.gripper: inverted",
    )


# --- the check


def test_an_episode_that_ends_in_a_bug_does_not_cost_the_others_their_reports(
    episode: Episode, images: dict[str, np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def draw(diagnosis: Diagnosis, *_: object, **__: object) -> np.ndarray:
        if diagnosis.episode_id == "synthetic/1":
            raise ValueError("At least one stride is negative")
        return np.zeros((8, 8, 3), np.uint8)

    monkeypatch.setattr(check_module, "diagnosis_picture", draw)
    names = [f"synthetic/{n}" for n in range(3)]
    check = check_calibration([listed(episode, images, name) for name in names], tmp_path)
    assert [episode.episode_id for episode in check.episodes] == names
    assert [episode.reason for episode in check.episodes] == [None, "crashed", None]
    assert "ValueError: At least one stride is negative (" in table_text(check)
    assert not check.consistent  # the command's exit status
    stored = json.loads((tmp_path / "diagnoses.json").read_text())["episodes"]
    assert [entry["picture"] is not None for entry in stored] == [True, False, True]
    assert all((tmp_path / entry["picture"]).is_file() for entry in stored if entry["picture"])
    assert "At least one stride is negative" in (tmp_path / "index.html").read_text()


def test_a_full_disk_ends_the_check(
    episode: Episode, images: dict[str, np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, data: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(check_module, "write_bytes_atomic", full)
    with pytest.raises(OSError, match="No space left"):
        check_calibration([listed(episode, images)], tmp_path)
    assert not (tmp_path / "diagnoses.json").exists()


def test_a_bad_episode_is_listed_and_the_rest_goes_on(
    episode: Episode, images: dict[str, np.ndarray], tmp_path: Path
) -> None:
    def refuse() -> LoadedEpisode:
        raise RejectedInputError("truncated_video", "The file ends early", expected=24, got=12)

    broken = ListedEpisode("synthetic/broken", "synthetic", refuse)
    short = listed(episode, {view: clip[:5] for view, clip in images.items()}, "synthetic/short")
    holes = replace(episode, T_base_ee=np.full_like(episode.T_base_ee, np.nan))
    check = check_calibration(
        [broken, short, listed(holes, images, "synthetic/nan"), listed(episode, images)], tmp_path, pictures=False
    )
    assert [episode.reason for episode in check.episodes] == ["truncated_video", "length_mismatch", "nan_state", None]
    assert check.episodes[-1].diagnosis is not None
    assert not check.consistent
    text = table_text(check)
    assert "truncated_video: The file ends early; expected 24; got 12" in text
    assert "3 unreadable" in text
    stored = json.loads((tmp_path / "diagnoses.json").read_text())
    assert [entry.get("reason") for entry in stored["episodes"]] == [
        "truncated_video",
        "length_mismatch",
        "nan_state",
        None,
    ]
    assert not (tmp_path / "pictures").exists()


def test_kinematics_of_other_arms_are_not_used(episode: Episode, images: dict[str, np.ndarray], tmp_path: Path) -> None:
    # One arm is recorded, the robot has two; and a robot that is not known at all.
    pair = replace(episode, embodiment="ur5e_pair")
    check = check_calibration(
        [listed(pair, images, "synthetic/pair"), listed(episode, images, "synthetic/unknown")], tmp_path, pictures=False
    )
    assert [episode.reason for episode in check.episodes] == [None, None]
    assert "other arms than the recording" in check.episodes[0].notes[0]
    assert "without kinematics of no_such_robot" in check.episodes[1].notes[0]


def test_nothing_to_check_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no episodes to check"):
        check_calibration([], tmp_path)


def test_an_empty_source_says_what_it_looked_for_and_what_is_there(tmp_path: Path) -> None:
    (tmp_path / "videos").mkdir()
    (tmp_path / "videos" / "notes.txt").write_text("no video")
    config = tmp_path / "source.yaml"
    config.write_text(
        f"curate: {{sources: [{{kind: video_folder, path: {tmp_path / 'videos'}, name: mine, split: train}}]}}"
    )
    with pytest.raises(DataError, match=r"no episodes to check[\s\S]*mp4[\s\S]*notes\.txt"):
        check_module.check_command(config, None, output=tmp_path / "out")


def made_up() -> CalibrationCheck:
    """Three verdicts, with names that would break a page that does not escape them."""
    none = Explanation(RecordedConventions(), -80.0, {"hand_eye right_wrist": -80.0})
    best = explained(RecordedConventions(camera_axes="opengl"))
    measures = {"head": {"in_view": 0.25, "flow": np.nan}}
    broken = Diagnosis(
        episode_id="b", verdict="explained", best=best, ranked=(best, none), measures=measures, notes=("a note",)
    )
    fine = Diagnosis(episode_id="a", verdict="consistent", best=none, ranked=(none,), measures={})
    summed = SourceDiagnosis(
        source="s", num_episodes=2, verdict="explained", best=best, ranked=(best, none),
        votes={"camera_axes": 1, "consistent": 1}, notes=("of the set",), config_lines=("line three",),
    )  # fmt: skip
    episodes = (
        EpisodeCheck(f"a {HOSTILE}", "s", fine, picture="pictures/a.jpg"),
        EpisodeCheck("b", "s", broken, config_lines=("line one", "line two")),
        EpisodeCheck("c", "s", None, "unreadable", f"why {HOSTILE}"),
    )
    return CalibrationCheck(episodes, (summed,), Path("out"))


def test_the_table_shows_verdicts_and_scores() -> None:
    lines = table_text(made_up()).splitlines()
    row = next(line for line in lines if line.startswith("b "))
    for shown in ("explained", "camera_axes", "-1.0", "-80.0"):
        assert shown in row
    text = "\n".join(lines)
    assert "3 episodes: 1 explained, 1 unreadable, 1 consistent" in text
    assert "source s, 2 episodes together: explained by camera_axes (score -1.0, as recorded -80.0)" in text
    assert "single episodes say: camera axes 1, consistent 1" in text
    assert "    line three" in text
    assert "  b:\n    line one\n    line two" in text


def test_an_episode_that_cannot_be_read_takes_one_line_and_notes_are_printed() -> None:
    check = made_up()
    gone = EpisodeCheck(
        "d", "s", None, "missing_file", "2 things are wrong; got \n    file is missing\n" + 40 * "      where: /x "
    )
    noted = replace(check.episodes[0], notes=("without kinematics of x: set Y",))
    text = table_text(replace(check, episodes=(noted, *check.episodes[1:], gone)))
    row = next(line for line in text.splitlines() if line.startswith("d "))
    assert "missing_file: 2 things are wrong; got file is missing where: /x" in row
    assert row.endswith(" ...")
    assert len(row) < 250
    assert text.count("note: without kinematics of x: set Y") == 1


@pytest.mark.parametrize(("agreeing", "cautious"), [(1, True), (4, True), (5, False), (10, False)])
def test_a_minority_does_not_change_a_source_unnoticed(agreeing: int, cautious: bool) -> None:
    best = explained(RecordedConventions(camera_axes="opengl"))
    votes = {"camera_axes": agreeing - 1, "camera_axes+gripper": 1, "consistent": 10 - agreeing}
    found = SourceDiagnosis(source="s", num_episodes=10, verdict="explained", best=best, ranked=(best,), votes=votes)
    assert bool(cautions(found)) == cautious
    if cautious:
        assert f"only {agreeing} of 10 episodes" in cautions(found)[0]
    assert cautions(replace(found, verdict="consistent")) == []


def test_the_page_escapes_what_it_shows() -> None:
    html = page(made_up())
    assert HOSTILE not in html
    assert html.count("&lt;script&gt;") >= 3
    assert 'src="pictures/a.jpg"' in html
    # The worst first.
    assert html.index('id="b"') < html.index('id="a ')


def test_json_holds_no_number_that_json_does_not_know() -> None:
    content = json.loads(json.dumps(as_json(made_up()), allow_nan=False))
    assert content["episodes"][1]["ranked"][0]["reading"] == "camera_axes: opengl"
    assert content["episodes"][1]["measures"] == {"head": {"in_view": 0.25, "flow": None}}
    assert content["sources"][0]["config_lines"] == ["line three"]


# --- the command, on shipped recordings


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["calibrate", "check", *arguments])
    return int(ended.value.code or 0)


def source_config(path: Path, project_root: Path, conventions: dict[str, object] | None = None) -> Path:
    source = {"kind": "episode_set", "path": str(project_root / "artifacts/shipped/recordings"), "include": [INVERTED]}
    content = {"curate": {"sources": [source | ({"conventions": conventions} if conventions else {})]}}
    path.write_text(yaml.safe_dump(content))
    return path


def test_a_mistake_is_found_and_the_printed_line_repairs_it(
    project_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = source_config(tmp_path / "mine.yaml", project_root)
    assert run(str(config), "--output", str(tmp_path / "wrong")) == 1
    printed = capsys.readouterr().out
    line = "curate.sources[0].conventions.extrinsics: base_to_camera"
    assert line in printed
    assert f"{INVERTED}  explained" in " ".join(printed.split()).replace(" explained", "  explained")
    assert (tmp_path / "wrong" / "pictures" / f"{INVERTED}.jpg").stat().st_size > 20_000
    key, value = line.removeprefix("curate.sources[0].conventions.").split(": ")
    repaired = source_config(tmp_path / "repaired.yaml", project_root, {key: value})
    assert run(str(repaired), "--output", str(tmp_path / "right"), "--json", "--no-pictures") == 0
    content = json.loads(capsys.readouterr().out)
    assert content["consistent"] is True
    assert content["episodes"][0]["verdict"] == "consistent"


def test_a_clean_set_is_consistent(project_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = project_root / "artifacts/shipped/recordings"
    assert run("--artifact", str(folder), "--episode", CLEAN, "--output", str(tmp_path)) == 0
    assert "1 episodes: 1 consistent" in capsys.readouterr().out
    assert CLEAN in (tmp_path / "index.html").read_text()


def test_agibot_samples(shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = shared_data / "agibot_gesim"
    if not folder.is_dir():
        pytest.skip("the AgiBot samples are not here")
    config = tmp_path / "agibot.yaml"
    source = {"kind": "agibot_gesim", "path": str(folder), "fps": 30}
    config.write_text(yaml.safe_dump({"curate": {"sources": [source]}}))
    assert run(str(config), "--output", str(tmp_path / "out"), "--no-pictures") == 1
    assert "curate.sources[0].conventions.camera_lag_frames: 2" in capsys.readouterr().out
    config.write_text(yaml.safe_dump({"curate": {"sources": [source | {"conventions": {"camera_lag_frames": 2}}]}}))
    assert run(str(config), "--output", str(tmp_path / "out"), "--no-pictures") == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["absent.yaml"], "No such configuration file"),
        (["--artifact", "absent"], "absent"),
        (["configs/embodiments/so101.yaml"], "configures no source"),
        (["configs/sources/mcap.yaml", "--set", "curate.sorces=[]"], "unknown key"),
        (["--artifact", "artifacts/shipped/recordings", "--episode", "nobody"], "No such episode"),
        (["--artifact", "artifacts/shipped/recordings", "--set", "a=1"], "--set changes a configuration file"),
    ],
)
def test_wrong_usage_ends_with_status_2(
    arguments: list[str],
    message: str,
    project_root: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(project_root)
    assert run(*arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error
