"""By how much a camera is off: recovered where it was put in, found in recordings, and bounded where nothing is found."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import calibration as benchmark
from worldline_core.calibration.calibration_doctor import diagnose
from worldline_core.calibration.camera_errors import (
    ERROR_KINDS,
    PARAMETERS,
    CameraError,
    StillView,
    WristView,
    combine,
    moved_camera,
    significant,
)
from worldline_core.calibration.check_report import (
    CalibrationCheck,
    EpisodeCheck,
    conclusion_lines,
    diagnosis_picture,
    verdict_text,
)
from worldline_core.calibration.diagnosis import Diagnosis, diagnose_source
from worldline_core.calibration.observation import Motion
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.filters.calibration import detect_mistake
from worldline_core.filters.filter_config import FilterDoctorConfig
from worldline_core.geometry.transforms import pose_from_euler_fixed_xyz


@pytest.fixture(scope="module")
def healthy() -> list[benchmark.Healthy]:
    """Twenty-two episodes of the test splits, of all robots."""
    return list(benchmark.healthy(benchmark.RECORDINGS, {"test", "ood_test"}, 2))


def spoiled(episode: Episode, view: str, kind: str, *sizes: float) -> Episode:
    """The episode with one camera's calibration changed, in the unit of the kind."""
    theta = np.zeros(PARAMETERS)
    theta[ERROR_KINDS[kind].parameters] = np.asarray(sizes) / ERROR_KINDS[kind].scale
    return replace(episode, cameras={**episode.cameras, view: moved_camera(episode.cameras[view], theta)})


def quickly(item: benchmark.Healthy, episode: Episode) -> Diagnosis:
    return diagnose(episode, item.gray, item.kinematics, quick=True)


def estimated(diagnosis: Diagnosis, view: str, kind: str) -> CameraError:
    return next(r for r in diagnosis.camera_errors if (r.view, r.kind) == (view, kind))


def solved(view: StillView | WristView, kind: str) -> np.ndarray:
    """In the unit of the kind, after two looks."""
    theta = np.zeros(PARAMETERS)
    for _ in range(3):
        theta[ERROR_KINDS[kind].parameters] += ERROR_KINDS[kind].solved(view.equations(theta, 0.7), theta)[1]
    return theta[ERROR_KINDS[kind].parameters] * ERROR_KINDS[kind].scale


@pytest.mark.parametrize(
    ("kind", "sizes"),
    [
        ("rotation", (0.8, -1.0, 1.5)),
        ("translation", (15.0, -10.0, 5.0)),
        ("focal length", (3.0,)),
        ("principal point", (1.0, -1.5)),
        ("lag", (0.3,)),
    ],
)
def test_what_was_put_into_a_still_view_is_found(kind: str, sizes: tuple[float, ...]) -> None:
    random, count = np.random.default_rng(0), 24
    time = np.linspace(0, 3, count)[:, None]
    centres = random.uniform(-0.25, 0.25, (12, 3)) + np.array([0.0, 0.0, 1.0])
    phase, speed = random.uniform(0, 6, (2, 12, 3))
    points = centres + 0.12 * np.sin(phase + speed * time[..., None] * np.ones((1, 12, 1)))
    radii = np.full(12, 0.04)
    camera = CameraTrack("head", np.array([[100.0, 0, 47.5], [0, 100, 31.5], [0, 0, 1]]), np.eye(4)[None], 96, 64)
    theta = np.zeros(PARAMETERS)
    theta[ERROR_KINDS[kind].parameters] = np.asarray(sizes) / ERROR_KINDS[kind].scale
    blank = np.zeros((count - 1, 16, 24))
    view = StillView(camera, points, radii, Motion(np.zeros((*blank.shape, 2)), blank, blank))
    view.measured = view._predicted(theta, np.arange(PARAMETERS))[0]
    assert solved(view, kind) == pytest.approx(sizes, rel=0.15, abs=0.15 * np.abs(sizes).max())


@pytest.mark.parametrize(("kind", "sizes"), [("rotation", (3.0, -4.0, 2.0)), ("focal length", (8.0,)), ("lag", (0.4,))])
def test_what_was_put_into_a_wrist_view_is_found(kind: str, sizes: tuple[float, ...]) -> None:
    random, count = np.random.default_rng(1), 20
    angles = np.cumsum(random.normal(0, 0.02, (count, 3)), axis=0)
    places = np.cumsum(random.normal(0, 0.01, (count, 3)), axis=0)
    poses = pose_from_euler_fixed_xyz(places, angles)
    camera = CameraTrack("right_wrist", np.array([[60.0, 0, 47.5], [0, 60, 31.5], [0, 0, 1]]), poses, 96, 64)
    gray = random.integers(0, 255, (count, 64, 96)).astype(np.uint8)
    shown = np.full((count - 1, 16, 24), 50.0)
    nothing = (np.zeros((count, 0, 3)), np.zeros(0))
    view = WristView(camera, gray, Motion(np.zeros((*shown.shape, 2)), shown, shown), *nothing)
    theta = np.zeros(PARAMETERS)
    theta[ERROR_KINDS[kind].parameters] = np.asarray(sizes) / ERROR_KINDS[kind].scale
    view.flow = view._flow(view._seen(theta), np.full(len(view.step), 3.0))
    assert solved(view, kind) == pytest.approx(sizes, rel=0.1, abs=0.1 * np.abs(sizes).max())


@pytest.mark.slow
def test_five_degrees_and_a_wrong_focal_length_are_found_in_one_episode(healthy: list) -> None:
    item = healthy[4]
    turned = quickly(item, spoiled(item.joints, "head", "rotation", 0.0, 5.0, 0.0))
    assert turned.verdict == "off"
    assert [residual.view for residual in turned.off] == ["head"]
    assert estimated(turned, "head", "rotation").estimate[1] == pytest.approx(-5.0, abs=1.5)
    assert verdict_text(turned).startswith("off: head ")
    assert "±" in verdict_text(turned)
    scaled = quickly(item, spoiled(item.joints, "head", "focal length", 15.0))
    assert scaled.verdict == "off"
    assert estimated(scaled, "head", "focal length").estimate[0] == pytest.approx(-13.0, abs=6.0)
    frames = {view: np.repeat(images[..., None], 3, axis=-1) for view, images in item.gray.items()}
    recorded = spoiled(item.joints, "head", "rotation", 0.0, 5.0, 0.0)
    beside = diagnosis_picture(turned, recorded, frames, item.kinematics)
    alone = diagnosis_picture(replace(turned, verdict="consistent"), recorded, frames, item.kinematics)
    assert beside.shape != alone.shape  # on its right the camera is where the estimate puts it


def test_the_filter_says_which_camera_is_off(healthy: list) -> None:
    item = healthy[4]
    bad = np.zeros(item.joints.num_frames, dtype=bool)
    found = detect_mistake(
        spoiled(item.joints, "head", "rotation", 0.0, 5.0, 0.0), item.gray, bad, FilterDoctorConfig()
    )
    assert (found.passed, found.reason) == (False, "calibration")
    assert str(found.numbers["off"]).startswith("head ")
    clean = detect_mistake(item.joints, item.gray, bad, FilterDoctorConfig())
    assert clean.passed
    unseen = clean.numbers["head rotation unseen up to"]
    assert isinstance(unseen, float)
    assert 0 < unseen < 15
    json.dumps(clean.numbers, allow_nan=False)


@pytest.mark.slow
def test_two_degrees_are_found_in_twenty_episodes_and_healthy_ones_are_bounded(healthy: list, tmp_path: Path) -> None:
    clean = [quickly(item, item.joints) for item in healthy]
    assert len(clean) >= 20
    assert np.mean([d.verdict == "consistent" for d in clean]) >= 0.95
    found = diagnose_source("source", clean)
    assert found.verdict == "consistent"
    bounds = {residual.kind: residual.bound for residual in found.camera_errors if residual.view == "head"}
    assert bounds["rotation"] < 3
    assert bounds["focal length"] < 5
    findings = tuple(EpisodeCheck(d.episode_id, "source", d) for d in clean)
    said = "\n".join(conclusion_lines(CalibrationCheck(findings, (found,), tmp_path)))
    assert "together: consistent within " in said
    assert "head within: rotation " in said
    for sizes in ((2.0, 0.0, 0.0), (0.0, -2.0, 0.0)):
        turned = diagnose_source(
            "source", [quickly(item, spoiled(item.joints, "head", "rotation", *sizes)) for item in healthy]
        )
        assert turned.verdict == "off"
        assert {residual.view for residual in turned.off} == {"head"}
        residual = next(r for r in turned.camera_errors if (r.view, r.kind) == ("head", "rotation"))
        assert residual.estimate == pytest.approx(-np.asarray(sizes), abs=1.0)


def test_many_episodes_say_more_than_one_and_a_broken_one_does_not_speak_for_them() -> None:
    random = np.random.default_rng(0)

    def episode(value: float) -> tuple[CameraError, ...]:
        return (
            CameraError("head", "focal length", "%", np.array([value]), np.array([[1 / 9]]), value**2 / 18, 30.0, 0.5),
        )

    values = 3.5 + 3.0 * random.normal(size=24)
    (together,) = combine([episode(value) for value in values])
    (alone,) = episode(3.5)
    assert together.half_interval < alone.half_interval / 2
    assert together.bound < alone.bound
    assert significant([together], together=True) == (together,)
    assert significant([alone]) == ()
    (spoiled_by_one,) = combine([episode(value) for value in (*values, 300.0)])
    assert spoiled_by_one.estimate == pytest.approx(together.estimate, abs=1.0)


def test_without_pictures_no_bound_is_claimed(healthy: list) -> None:
    item = healthy[0]
    diagnosis = diagnose(item.poses, {}, item.kinematics, quick=True)
    assert diagnosis.camera_errors == ()
    assert verdict_text(diagnosis) == "consistent, but no picture says within what"


def test_exchanged_wrist_videos_are_found(healthy: list) -> None:
    found = []
    for item in healthy[8:16:2]:
        left, right = (arm.camera_view for arm in item.kinematics.embodiment.arms)
        exchanged = {**item.gray, left: item.gray[right], right: item.gray[left]}
        found.append(diagnose(item.joints, exchanged, item.kinematics, quick=True))
    assert sum(d.best.mistake == "wrist_videos" for d in found) >= 3
    together = diagnose_source("source", found)
    assert (together.verdict, together.best.other) == ("explained", ("wrist_videos", "exchanged"))
    named = next(d for d in found if d.best.mistake == "wrist_videos")
    assert any("exchange the two where the source is written" in note for note in named.notes)
