"""A reading wins only where the recording is healthy under it: other robots, exchanged cameras, two mistakes at once."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from benchmarks import calibration as benchmark
from tools.corrupted.conventions import corrupt, corrupted_image_frames
from worldline_core.calibration import calibration_doctor
from worldline_core.calibration.calibration_doctor import diagnose
from worldline_core.calibration.check import ListedEpisode, check_command, repairing_lines
from worldline_core.calibration.check_report import table_text, verdict_text
from worldline_core.calibration.diagnosis import Diagnosis, diagnose_source
from worldline_core.data.episodes.conventions import RecordedConventions, along_tool_z
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.source import LoadedEpisode
from worldline_core.data.sources.agibot import AgibotGesimSource, AgibotGesimSourceConfig
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics

INVERSE = RecordedConventions(extrinsics="base_to_camera")


def slow(*cases: Any) -> list[Any]:
    """Further cases of a kind of which one is always tested: each search takes about a second."""
    return [pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.slow) for case in cases]


def of_robot(healthy: list, name: str):
    return next(item for item in healthy if item.joints.embodiment.startswith(name))


def declared_as(item, name: str) -> Diagnosis:
    kinematics = ArmKinematics(load_embodiment(name))
    return diagnose(replace(item.joints, embodiment=name), item.gray, kinematics)


def with_exchanged_extrinsics(episode: Episode) -> Episode:
    left, right = episode.cameras["left_wrist"], episode.cameras["right_wrist"]
    exchanged = {
        "left_wrist": replace(left, T_base_camera=right.T_base_camera),
        "right_wrist": replace(right, T_base_camera=left.T_base_camera),
    }
    return replace(episode, cameras=dict(episode.cameras) | exchanged)


def agibot(shared_data: Path, layout: str) -> list[LoadedEpisode]:
    root = shared_data / layout
    source = AgibotGesimSource(AgibotGesimSourceConfig(path=root, fps=30), root)
    return [source.load(name) for name in source.episode_ids()]


def pictures_of(item, conventions: RecordedConventions) -> dict[str, np.ndarray]:
    count = item.joints.num_frames
    return {v: gray[corrupted_image_frames(count, conventions, v)] for v, gray in item.gray.items()}


def pictures(loaded: LoadedEpisode) -> dict[str, np.ndarray]:
    return {view: loaded.frames(view) for view in loaded.views}


@pytest.mark.parametrize(("truth", "declared"), [("ur5e", "viperx_graphite"), ("panda", "xarm7_white")])
def test_another_robot_than_declared_is_named(healthy: list, truth: str, declared: str) -> None:
    item = of_robot(healthy, truth)
    diagnosis = declared_as(item, declared)
    robot = item.joints.embodiment
    assert (diagnosis.verdict, diagnosis.best.other) == ("explained", ("embodiment", robot))
    assert any(f"fits {robot}, not the declared {declared}" in note for note in diagnosis.notes)
    together = diagnose_source("source", [diagnosis, diagnosis])
    assert (together.verdict, together.best.text) == ("explained", f"embodiment: {robot}")
    listed = ListedEpisode("e", "source", lambda: None, "curate.sources[1].conventions", declares_robot=True)  # type: ignore[arg-type,return-value]
    assert repairing_lines(listed, together.best) == (f"curate.sources[1].embodiment: {robot}",)
    assert repairing_lines(replace(listed, declares_robot=False), together.best) == ()


def test_a_reading_that_leaves_the_recording_ill_does_not_win(healthy: list, monkeypatch: pytest.MonkeyPatch) -> None:
    """Degrees bring the joints of an unknown robot within their limits, and explain nothing."""
    monkeypatch.setattr(calibration_doctor, "robots_like", lambda _: ())
    diagnosis = declared_as(of_robot(healthy, "ur5e"), "viperx_graphite")
    assert diagnosis.verdict == "unexplained"
    assert "angle_unit: deg" in diagnosis.nearest[0]
    assert "still wrong hand-eye" in diagnosis.nearest[0]
    together = diagnose_source("source", [diagnosis] * 3)
    assert (together.verdict, together.best.mistake) == ("unexplained", "none")
    assert any("angle_unit: deg: healthy in 0 of 3 episodes" in near for near in together.nearest)


def test_flange_poses_do_not_turn_the_wrist_cameras(shared_data: Path) -> None:
    diagnoses = []
    for item in agibot(shared_data, "agibot_gesim"):
        assert item.episode.T_base_ee is not None
        ends = along_tool_z(item.episode.T_base_ee, -0.23)
        flange = replace(item.episode, T_base_ee=ends, conventions={**item.episode.conventions, "tool_offset_m": 0.0})
        diagnoses.append(diagnose(flange, pictures(item), None))
    assert {diagnosis.verdict for diagnosis in diagnoses} == {"unexplained"}
    assert all("camera_axes: opengl" in diagnosis.nearest[0] for diagnosis in diagnoses)
    together = diagnose_source("agibot", diagnoses)
    assert together.verdict == "unexplained"
    assert "healthy in 0 of 2 episodes" in together.nearest[0]


def test_exchanged_wrist_extrinsics_are_not_exchanged_arms(healthy: list) -> None:
    item = of_robot(healthy, "ur5e")
    diagnosis = diagnose(with_exchanged_extrinsics(item.joints), item.gray, item.kinematics)
    assert (diagnosis.verdict, diagnosis.best.other) == ("explained", ("wrist_extrinsics", "exchanged"))
    assert any("exchange the two where the source is written" in note for note in diagnosis.notes)
    arms = corrupt(item.joints, RecordedConventions(arms="exchanged"))
    assert diagnose(arms, item.gray, item.kinematics).best.mistake == "arms"


def test_what_nothing_recorded_tells_apart_is_not_claimed(shared_data: Path) -> None:
    """Without pictures and kinematics either the arms or the cameras may be exchanged."""
    loaded = agibot(shared_data, "agibot_gesim")
    exchanged = [with_exchanged_extrinsics(item.episode) for item in loaded]
    diagnoses = [diagnose(episode, pictures(item), None) for episode, item in zip(exchanged, loaded, strict=True)]
    for diagnosis in diagnoses:
        assert diagnosis.verdict == "unexplained"
        assert any("equally well" in note and "wrist_extrinsics: exchanged" in note for note in diagnosis.notes)
    together = diagnose_source("agibot", diagnoses)
    assert together.verdict == "unexplained"
    assert {near.split(": ")[0] for near in together.nearest} >= {"arms", "wrist_extrinsics"}


@pytest.mark.parametrize("late", ["states", *slow("cameras", "images")])
def test_inverse_and_late(healthy: list, late: str) -> None:
    """A lag shows only where the other mistake is undone."""
    item = of_robot(healthy, "xarm7")
    lags = {"cameras": (3, 0), "images": (0, 3), "states": (-3, -3)}[late]
    conventions = INVERSE.model_copy(update={"camera_lag_frames": lags[0], "image_lag_frames": lags[1]})
    gray = pictures_of(item, conventions)
    diagnosis = diagnose(corrupt(item.joints, conventions), gray, item.kinematics)
    assert (diagnosis.verdict, diagnosis.best.conventions) == ("explained", conventions)
    together = diagnose_source("source", [diagnosis] * 2)
    assert (together.verdict, together.best.conventions) == ("explained", conventions)


@pytest.mark.slow
def test_one_good_and_one_bad_episode_prescribe_nothing_for_both(healthy: list) -> None:
    good, bad = of_robot(healthy, "xarm7"), of_robot(healthy, "ur5e")
    fine = diagnose(good.joints, good.gray, good.kinematics)
    mistakes: list[dict[str, object]] = [
        {"image_lag_frames": 3},
        {"extrinsics": "base_to_camera"},
    ]
    for mistake in mistakes:
        wrong = benchmark.examine(bad, bad.joints, RecordedConventions.model_validate(mistake))
        assert (fine.verdict, wrong.verdict) == ("consistent", "explained")
        together = diagnose_source("source", [fine, wrong])
        assert (together.verdict, together.best.mistake) == ("mixed", "none")
        assert diagnose_source("source", [fine] * 10 + [wrong]).verdict == "consistent"
        assert diagnose_source("source", [fine] + [wrong] * 10).best.mistake == next(iter(mistake))


def test_what_the_cameras_may_follow_is_printed(shared_data: Path, tmp_path: Path) -> None:
    """Of a single episode as well, beside a lag that few pictures leave unjudged."""
    config = tmp_path / "agibot.yaml"
    source = {"kind": "agibot_gesim", "path": str(shared_data / "agibot_gesim_v2"), "fps": 30}
    config.write_text(yaml.safe_dump({"curate": {"sources": [source]}}))
    episode = "agibot_gesim_v2-assets-demo_000"
    check = check_command(config, None, episodes=[episode], output=tmp_path / "out")
    printed = table_text(check)
    assert "camera_lag_frames: -2 would fit the poses better; without pictures this is not judged" in printed
    assert check.episodes[0].config_lines == ()
    assert "they may follow the commands: give the kinematics to see" in printed
    assert "without kinematics of agibot_g1" in printed
    assert json.loads((tmp_path / "out" / "diagnoses.json").read_text())["episodes"][0]["nearest"] == []


AXES, UNIT, ANGLES = (
    RecordedConventions.model_validate(one)
    for one in ({"camera_axes": "opengl"}, {"extrinsics_unit": "mm"}, {"angle_unit": "deg"})
)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (AXES, INVERSE),
        (ANGLES, None),
        *slow(
            (UNIT, INVERSE), (ANGLES, INVERSE), (AXES, UNIT), (AXES, ANGLES), (UNIT, ANGLES), (AXES, None), (UNIT, None)
        ),
    ],
)
def test_two_errors_at_once_are_judged(
    healthy: list, first: RecordedConventions, second: RecordedConventions | None
) -> None:
    """Under some readings of these nothing of the robot is before the head camera (None: exchanged wrist extrinsics)."""
    item = of_robot(healthy, "ur5e")
    spoiled = corrupt(item.joints, first)
    spoiled = with_exchanged_extrinsics(spoiled) if second is None else corrupt(spoiled, second)
    assert diagnose(spoiled, item.gray, item.kinematics, quick=True).verdict != "consistent"


def lively(item, kind: str) -> str:
    """The head, or the wrist view that changes most."""
    views = [view for view in item.gray if view.endswith(kind)]
    return max(views, key=lambda view: np.abs(np.diff(item.gray[view].astype(float), axis=0)).sum())


@pytest.mark.parametrize(
    ("robot", "frames"), [("xarm7", 1), *slow(("ur5e", 2), ("viperx", 3), ("xarm7", -2), ("panda", -1))]
)
def test_the_delay_of_one_camera_is_its_own(healthy: list, robot: str, frames: int) -> None:
    item = of_robot(healthy, robot)
    lag = RecordedConventions(image_lag_frames=frames, views=("head",))
    diagnosis = diagnose(corrupt(item.joints, lag), pictures_of(item, lag), item.kinematics)
    assert (diagnosis.verdict, diagnosis.best.conventions) == ("explained", lag)
    assert (
        diagnose(corrupt(item.joints, lag), pictures_of(item, lag), item.kinematics, quick=True).best == diagnosis.best
    )


def test_a_lag_at_the_edge_of_the_search_explains_nothing(healthy: list) -> None:
    item = of_robot(healthy, "ur5e")
    lag = RecordedConventions(image_lag_frames=6)
    diagnosis = diagnose(corrupt(item.joints, lag), pictures_of(item, lag), item.kinematics)
    assert diagnosis.verdict == "unexplained"
    assert diagnose_source("source", [diagnosis] * 3).verdict == "unexplained"
    assert any("at the edge of what is tried" in note for note in diagnosis.notes)


@pytest.mark.parametrize(
    ("kind", "begins", "quick"),
    [
        ("head", 10, False),
        ("wrist", 0, True),
        *slow(("head", 0, False), ("wrist", 0, False), ("wrist", 10, False), ("head", 10, True)),
    ],
)
def test_a_frozen_video_is_no_consistent_one(healthy: list, kind: str, begins: int, quick: bool) -> None:
    item = of_robot(healthy, "ur5e")
    view = lively(item, kind)
    frozen = item.gray[view].copy()
    frozen[begins:] = frozen[begins]
    diagnosis = diagnose(item.joints, {**item.gray, view: frozen}, item.kinematics, quick=quick)
    assert diagnosis.verdict == "unexplained"
    assert f"{view}: its pictures stay the same while its arm moves" in diagnosis.notes
    together = diagnose_source("source", [diagnosis] * 3)
    assert (together.verdict, together.not_judged) == ("unexplained", diagnosis.not_judged)
    assert (view in together.not_judged) == (begins == 0)


def test_what_no_picture_judges_is_printed_as_such(healthy: list) -> None:
    item = of_robot(healthy, "ur5e")
    few = {**item.gray, "head": item.gray["head"][:1]}
    diagnosis = diagnose(item.joints, few, item.kinematics)
    assert diagnosis.not_judged == {"head": "1 pictures are too few to compare motion with"}
    assert verdict_text(diagnosis).endswith("; not judged: head")
