"""`worldline calibrate check`: what is listed, what it prints, writes and draws, and the line that repairs a recording."""

from __future__ import annotations

import errno
import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from flows.command_line import main
from tools.corrupted.conventions import corrupt, corrupted_image_frames
from worldline_core.actions.episode_tracks import EpisodeTracks
from worldline_core.calibration import check
from worldline_core.calibration.camera_errors import CameraError
from worldline_core.calibration.check import ListedEpisode, check_calibration, repairing_lines
from worldline_core.calibration.diagnosis import Diagnosis, Explanation, SourceDiagnosis
from worldline_core.data.episodes.conventions import RecordedConventions
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.source import LoadedEpisode
from worldline_core.data.guards.reader_process import ReaderLimits
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.sources.open import EpisodeSetSourceConfig, GuardedSource
from worldline_core.errors import DataError

CLEAN, INVERTED = "ur5e_silver-test-s1-00000", "ur5e_silver-train-s1-00002"
"""Shipped recordings; the second has inverted extrinsics (injected_defects.json)."""
HOSTILE = "<script>alert('x')</script>"
Images = dict[str, np.ndarray]


def listed(episode: Episode, images: Images, name: str = "synthetic/0") -> ListedEpisode:
    named = replace(episode, episode_id=name)
    return ListedEpisode(name, "synthetic", lambda: LoadedEpisode(named, tuple(images), lambda view: images[view]))


def diagnosis_of(conventions: RecordedConventions) -> Diagnosis:
    none = Explanation(RecordedConventions(), -80.0, {"hand_eye right_wrist": -80.0})
    best = Explanation(conventions, -1.0, {}) if conventions.departures else none
    return Diagnosis(verdict="explained", best=best, ranked=(best, none))


def test_two_mistakes_need_a_line_each_and_declared_ones_must_go_first(episode: Episode, images: Images) -> None:
    explanation = Explanation(RecordedConventions(tool_offset_z_m=0.05, gripper="inverted"), -1.0, {})
    assert explanation.mistake == "tool_offset_z_m+gripper"
    assert repairing_lines(listed(episode, images), explanation) == (
        "curate.sources[].conventions.tool_offset_z_m: 0.05",
        "curate.sources[].conventions.gripper: inverted",
    )
    declared = replace(listed(episode, images), declared=RecordedConventions(camera_lag_frames=1))
    (line,) = repairing_lines(declared, explanation)
    assert line.startswith("remove curate.sources[].conventions")
    assert repairing_lines(declared, replace(explanation, conventions=RecordedConventions())) == ()


def test_an_episode_that_ends_in_a_bug_does_not_cost_the_others_their_reports(
    episode: Episode, images: Images, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def draw(_: Diagnosis, episode: Episode, *__: object) -> np.ndarray:
        if episode.episode_id == "synthetic/0":
            raise ValueError("At least one stride is negative")
        return np.zeros((8, 8, 3), np.uint8)

    fine = diagnosis_of(RecordedConventions())
    monkeypatch.setattr(check, "diagnose", lambda *_: fine)
    monkeypatch.setattr(check, "diagnosis_picture", draw)
    names = ["synthetic/0", "synthetic/1"]
    found = check_calibration([listed(episode, images, name) for name in names], tmp_path)
    assert [episode.episode_id for episode in found.episodes] == names
    assert [episode.reason for episode in found.episodes] == ["crashed", None]
    stored = json.loads((tmp_path / "diagnoses.json").read_text())["episodes"]
    pictures = [entry["picture"] and (tmp_path / entry["picture"]).is_file() for entry in stored]
    assert pictures == [None, True]
    for shown in (check.table_text(found), (tmp_path / "index.html").read_text()):
        assert "At least one stride is negative" in shown


def test_a_full_disk_ends_the_check(episode, images, tmp_path, monkeypatch):
    def full(path: Path, data: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(check, "diagnose", lambda *_: diagnosis_of(RecordedConventions()))
    monkeypatch.setattr(check, "write_bytes_atomic", full)
    with pytest.raises(OSError, match="No space left"):
        check_calibration([listed(episode, images)], tmp_path)
    assert not (tmp_path / "diagnoses.json").exists()


@pytest.mark.slow
def test_a_bad_episode_is_listed_and_the_rest_goes_on(episode: Episode, images: Images, tmp_path: Path) -> None:
    def refuse() -> LoadedEpisode:
        raise RejectedInputError("truncated_video", "The file\nends early", expected=24, got=f"{200 * '-'} 12")

    broken = ListedEpisode("synthetic/broken", "synthetic", refuse)
    short = listed(episode, {view: clip[:5] for view, clip in images.items()}, "synthetic/short")
    holes = replace(episode, T_base_ee=np.full_like(episode.T_base_ee, np.nan))
    # One arm is recorded, the robot has two; and `listed` names a robot that is not known at all.
    pair = listed(replace(episode, embodiment="ur5e_pair"), images, "synthetic/pair")
    given = [broken, short, listed(holes, images, "synthetic/nan"), listed(episode, images), pair]
    found = check_calibration(given, tmp_path)
    reasons = ["truncated_video", "length_mismatch", "nan_state", None, None]
    assert [episode.reason for episode in found.episodes] == reasons
    assert "no_such_robot" in found.episodes[3].diagnosis.notes[-1]
    assert "ur5e_pair" in found.episodes[4].diagnosis.notes[-1]
    assert not found.consistent
    why = f"truncated_video: The file ends early; expected 24; got {200 * '-'} 12"  # whole, in one line
    assert why in check.table_text(found)
    stored = json.loads((tmp_path / "diagnoses.json").read_text())
    assert stored["episodes"][0]["notes"] == [why]
    assert [entry["reason"] for entry in stored["episodes"]] == reasons


@pytest.mark.slow
def test_recordings_are_read_in_a_process_with_limits_first(project_root: Path) -> None:
    config = EpisodeSetSourceConfig(kind="episode_set", path=project_root / "artifacts/shipped/recordings")
    source = GuardedSource(config, ReaderLimits())
    first = source.episode_ids()[0]
    assert source.load(first).episode.num_frames > 1
    small = GuardedSource(config, ReaderLimits(memory_gb=0.01))
    # A thread has a reader of its own: one that has read this recording before may need no more memory.
    with ThreadPoolExecutor(1) as fresh, pytest.raises(RejectedInputError) as caught:
        fresh.submit(small.load, first).result()
    assert caught.value.reason == "out_of_memory"


def test_one_episode_that_cannot_be_judged_makes_the_check_inconsistent() -> None:
    error = CameraError("head", np.zeros(8), np.eye(8), 0.0)
    fine = check.EpisodeCheck("a", "s", Diagnosis(verdict="consistent", camera_errors=(error,)))
    healthy = check.CalibrationCheck((fine,), (), Path("out"))
    assert healthy.consistent  # the command's exit status
    crashed = check.EpisodeCheck("b", "s", Diagnosis(verdict="not_judged"), "crashed")
    assert not replace(healthy, episodes=(fine, crashed)).consistent


def made_up() -> check.CalibrationCheck:
    """Three verdicts, with names that would break a page that does not escape them."""
    none = Explanation(RecordedConventions(), np.nan, {})
    best = Explanation(RecordedConventions(camera_axes="opengl"), -1.0, {})
    lines = "line one", "line two"
    broken = Diagnosis(verdict="explained", best=best, ranked=(best, none), notes=("a note",), config_lines=lines)
    fine = Diagnosis(verdict="consistent", best=none, ranked=(none,), notes=("set Y",))
    unread = Diagnosis(verdict="unreadable", notes=(f"why {HOSTILE}",))
    summed = SourceDiagnosis(
        source="s", num_episodes=2, verdict="explained", best=best, ranked=(best, none),
        notes=("of the set",), config_lines=("line three",),
    )  # fmt: skip
    episodes = (
        check.EpisodeCheck(f"a {HOSTILE}", "s", fine, picture="pictures/a.jpg"),
        check.EpisodeCheck("b", "s", broken),
        check.EpisodeCheck("c", "s", unread, "missing_file"),
    )
    return check.CalibrationCheck(episodes, (summed,), Path("out"))


def test_the_page_escapes_what_it_shows_and_json_is_plain() -> None:
    html = check.page(made_up())
    assert HOSTILE not in html
    assert html.count("&lt;script&gt;") >= 3
    assert html.index('id="b"') < html.index('id="a ')  # the worst first
    text = check.table_text(made_up())
    assert {"    line one", "    line two", "    line three"} <= set(text.splitlines())
    assert max(map(len, text.splitlines())) < 250
    content = json.loads(json.dumps(check.as_json(made_up()), allow_nan=False))
    assert [content["episodes"][1][name] for name in ("mistake", "verdict")] == ["camera_axes", "explained"]
    assert content["sources"][0]["config_lines"] == ["line three"]


@pytest.mark.parametrize("lag", [0, 3])
def test_tools_are_drawn_where_the_recorded_camera_puts_them(episode: Episode, lag: int) -> None:
    """The wrist camera's own poses are used, not those that follow from kinematics and a mount."""
    recorded = corrupt(episode, RecordedConventions(camera_lag_frames=lag))
    for view, camera in recorded.cameras.items():
        tracks = check.recorded_tracks(recorded, view, None)
        assert lag or tracks.valid.all()
        for n in (0, 10):
            pose = camera.T_base_camera[n if camera.moving else 0]
            x, y, z = pose[:3, :3].T @ (recorded.T_base_ee[n, 0, :3, 3] - pose[:3, 3])
            by_hand = camera.K[0, 0] * x / z + camera.K[0, 2], camera.K[1, 1] * y / z + camera.K[1, 2]
            assert np.allclose(tracks.uv[n, 0, 0], by_hand, atol=1e-3)


@pytest.mark.parametrize("lags", [(0, -3), (-2, 2), (3, 0)])
def test_the_repaired_side_draws_each_image_with_its_own_tools(episode, lags, monkeypatch):
    conventions = RecordedConventions(camera_lag_frames=lags[0], image_lag_frames=lags[1])
    # Image i of the healthy episode has the grey value 10 i.
    numbered = np.repeat(10 * np.arange(24, dtype=np.uint8), 60 * 80 * 3).reshape(24, 60, 80, 3)
    late = numbered[corrupted_image_frames(episode.num_frames, conventions, "right_wrist")]
    drawn: list[tuple[int, np.ndarray]] = []

    def shown(tracks: EpisodeTracks, n: int) -> np.ndarray:
        return np.concatenate([tracks.T_base_tool[n, 0], tracks.T_base_camera[n, 0]])

    def record(frame: np.ndarray, tracks: EpisodeTracks, n: int, view: str, **_: object) -> np.ndarray:
        drawn.append((int(frame[0, 0, 0]) // 10, shown(tracks, n)))
        return frame

    monkeypatch.setattr(check, "draw_overlay", record)
    monkeypatch.setattr(check, "TILE_HEIGHT", 60)
    wrong = corrupt(episode, conventions)
    check.diagnosis_picture(diagnosis_of(conventions), wrong, {"right_wrist": late}, None)
    healthy = check.recorded_tracks(episode, "right_wrist", None)
    assert len(drawn) == 6
    assert all(np.allclose(poses, shown(healthy, number), atol=1e-6) for number, poses in drawn[3:])
    number, poses = drawn[0]  # as recorded they do not belong together
    assert not np.allclose(poses, shown(healthy, number), atol=1e-3)


def test_what_cannot_be_drawn_says_why(episode: Episode, images: Images) -> None:
    plain = diagnosis_of(RecordedConventions())
    with pytest.raises(DataError, match="Nothing to draw"):
        check.diagnosis_picture(plain, replace(episode, cameras={}), images, None)
    joints = replace(episode, T_base_ee=None, gripper=None, state_kind="joints")
    with pytest.raises(DataError, match=r"(?s)No tools to draw.*joints and kinematics"):
        check.diagnosis_picture(plain, joints, images, None)


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["calibrate", "check", *arguments])
    return int(ended.value.code or 0)


def configured(folder: Path, **source: Any) -> str:
    (folder / "mine.yaml").write_text(yaml.safe_dump({"curate": {"sources": [source]}}))
    return str(folder / "mine.yaml")


@pytest.mark.slow
def test_a_mistake_is_found_and_the_printed_line_repairs_it(project_root, tmp_path, capsys):
    source = {"kind": "episode_set", "path": str(project_root / "artifacts/shipped/recordings"), "include": [INVERTED]}
    assert run(configured(tmp_path, **source), "--output", str(tmp_path / "wrong")) == 1
    printed = capsys.readouterr().out
    assert "curate.sources[0].conventions.extrinsics: base_to_camera" in printed
    assert f"{INVERTED} explained" in " ".join(printed.split())
    assert (tmp_path / "wrong" / "pictures" / f"{INVERTED}.jpg").stat().st_size > 20_000
    repaired = configured(tmp_path, **source, conventions={"extrinsics": "base_to_camera"})
    assert run(repaired, "--output", str(tmp_path / "right"), "--json") == 0
    content = json.loads(capsys.readouterr().out)
    assert (content["consistent"], content["episodes"][0]["verdict"]) == (True, "consistent")


@pytest.mark.slow
def test_a_clean_set_and_one_that_few_pictures_judge(project_root, shared_data, tmp_path, capsys):
    clean = ("--artifact", str(project_root / "artifacts/shipped/recordings"), "--episode", CLEAN)
    assert run(*clean, "--output", str(tmp_path / "clean")) == 0
    assert "1 consistent" in capsys.readouterr().out
    config = configured(tmp_path, kind="agibot_gesim", path=str(shared_data / "agibot_gesim"), fps=30)
    assert run(config, "--output", str(tmp_path / "few")) == 1
    assert "not judged: head, left_wrist, right_wrist" in capsys.readouterr().out


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
def test_wrong_usage_ends_with_status_2(arguments, message, project_root, monkeypatch, capsys):
    monkeypatch.chdir(project_root)
    assert run(*arguments) == 2
    assert message in capsys.readouterr().err
