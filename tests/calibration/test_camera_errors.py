"""By how much a camera is off: recovered where it was put in, found in recordings, and bounded where nothing is found."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks import calibration as benchmark
from worldline_core.calibration.calibration_doctor import diagnose
from worldline_core.calibration.camera_errors import (
    KINDS,
    PARAMETERS,
    SCALE,
    SQUARES_ALONE,
    SQUARES_TOGETHER,
    CameraError,
    KindOfError,
    StillView,
    WristView,
    combine,
    moved_camera,
)
from worldline_core.calibration.check import diagnosis_picture
from worldline_core.calibration.diagnosis import Diagnosis, Explanation, diagnose_source
from worldline_core.calibration.observation import Motion
from worldline_core.data.episodes.conventions import RecordedConventions
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.filters.calibration import detect_mistake
from worldline_core.filters.filter_config import FilterDoctorConfig
from worldline_core.geometry.transforms import pose_from_euler_fixed_xyz


def spoiled(episode: Episode, view: str, kind: str, *sizes: float) -> Episode:
    """The episode with one camera's calibration changed, in the unit of the kind."""
    moved = moved_camera(episode.cameras[view], theta_of(kind, *sizes))
    return replace(episode, cameras={**episode.cameras, view: moved})


def theta_of(kind: str, *sizes: float) -> np.ndarray:
    theta = np.zeros(PARAMETERS)
    theta[KINDS[kind][0]] = sizes
    return theta / SCALE


def quickly(item: benchmark.Healthy, episode: Episode) -> Diagnosis:
    return diagnose(episode, item.gray, item.kinematics, quick=True)


def estimated(found: Diagnosis, view: str, kind: str) -> KindOfError:
    return next(each for e in found.camera_errors if e.view == view for each in e.kinds if each.kind == kind)


def solved(view: StillView | WristView) -> np.ndarray:
    """In the units of KINDS, after some looks."""
    theta = np.zeros(PARAMETERS)
    for _ in range(6):
        found = view.equations(theta, 0.7)
        theta += np.linalg.solve(found.information + np.eye(PARAMETERS) * 1e-6, found.gradient)
    return theta * SCALE


@pytest.mark.parametrize(
    ("kind", "sizes"),
    [("rotation", (0.8, -1.0, 1.5)), ("translation", (15.0, -10.0, 5.0)), ("focal length", (3.0,)), ("lag", (0.3,))],
)
def test_what_was_put_into_a_still_view_is_found(kind: str, sizes: tuple[float, ...]) -> None:
    view = waving_points()
    view.measured = view._predicted(theta_of(kind, *sizes))[0]
    tolerance = np.array([0.25] * 3 + [5.0] * 3 + [0.8, 0.08])  # of all kinds at once
    assert (np.abs(solved(view) - theta_of(kind, *sizes) * SCALE) < tolerance).all()


def waving_points() -> StillView:
    random, count = np.random.default_rng(0), 24
    time = np.linspace(0, 3, count)[:, None]
    centres = random.uniform(-0.25, 0.25, (12, 3)) + np.array([0.0, 0.0, 1.0])
    phase, speed = random.uniform(0, 6, (2, 12, 3))
    points = centres + 0.12 * np.sin(phase + speed * time[..., None] * np.ones((1, 12, 1)))
    camera = CameraTrack("head", np.array([[100.0, 0, 47.5], [0, 100, 31.5], [0, 0, 1]]), np.eye(4)[None], 96, 64)
    blank = np.zeros((count - 1, 16, 24))
    return StillView(camera, points, np.full(12, 0.04), Motion(np.zeros((*blank.shape, 2)), blank, blank))


def test_steps_that_are_left_out_count_neither_as_seen_nor_as_predicted() -> None:
    view, turned = waving_points(), theta_of("rotation", 0.8, -1.0, 1.5)
    steps = np.arange(len(view.measured)) < 12
    view.measured = view._predicted(turned)[0]
    first = view.only(steps)
    view.measured[~steps] = np.random.default_rng(1).normal(0, 3, view.measured[~steps].shape)
    for lag in (0.0, 0.3):
        theta = turned + theta_of("lag", lag)
        expected, found = first.equations(theta, 0.7), view.only(steps).equations(theta, 0.7)
        np.testing.assert_array_equal(found.information, expected.information)
        assert found.likelihood == expected.likelihood
    assert not first._predicted(np.zeros(PARAMETERS))[0][~steps].any()
    assert (np.abs(solved(view.only(steps)) - turned * SCALE)[:3] < 0.5).all()


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
    view.flow = view._flow(view._seen(theta_of(kind, *sizes)), np.full(len(view.step), 3.0))
    assert solved(view)[KINDS[kind][0]] == pytest.approx(sizes, rel=0.1, abs=0.1 * np.abs(sizes).max())


@pytest.mark.slow
def test_five_degrees_are_a_warning_of_the_filter(healthy_episodes: list) -> None:
    item = healthy_episodes[2]
    recorded = spoiled(item.joints, "head", "rotation", 0.0, 5.0, 0.0)
    turned, bad = quickly(item, recorded), np.zeros(item.joints.num_frames, dtype=bool)
    assert (turned.verdict, [error.view for error in turned.off]) == ("off", ["head"])
    assert "rotation" in turned.off[0].named
    size = estimated(turned, "head", "rotation")
    assert np.linalg.norm(size.estimate - (0, -5, 0)) < size.half_interval
    found, clean = (detect_mistake(each, item.gray, bad, FilterDoctorConfig()) for each in (recorded, item.joints))
    assert found.passed and clean.passed  # an estimate bars nothing
    assert str(found.numbers["off"]).startswith("head ")
    assert 0 < float(str(clean.numbers["head rotation unseen up to"])) < 40
    json.dumps(found.numbers, allow_nan=False)
    frames = {view: np.repeat(images[..., None], 3, axis=-1) for view, images in item.gray.items()}
    beside, alone = (
        diagnosis_picture(replace(turned, verdict=verdict), recorded, frames, item.kinematics)
        for verdict in ("off", "consistent")
    )
    assert beside.shape != alone.shape  # on its right the camera is where the estimate puts it


@pytest.mark.slow
def test_sources_are_judged_together() -> None:
    healthy = list(benchmark.healthy(benchmark.RECORDINGS, {"test", "ood_test"}, 2))
    clean = [quickly(item, item.joints) for item in healthy]
    assert np.mean([d.verdict == "consistent" for d in clean]) >= 0.95
    found = diagnose_source("source", clean)
    assert found.verdict == "consistent"
    assert estimated(found, "head", "in the picture").bound < 8
    for sizes in ((3.0, 0.0, 0.0), (0.0, -3.0, 0.0), (0.0, 0.0, 10.0)):
        wrong = [quickly(item, spoiled(item.joints, "head", "rotation", *sizes)) for item in healthy]
        turned = diagnose_source("source", wrong)
        assert (turned.verdict, {error.view for error in turned.off}) == ("off", {"head"})
        rotation = estimated(turned, "head", "rotation")
        assert np.linalg.norm(rotation.estimate + sizes) < rotation.half_interval
    random = np.random.default_rng(0)
    others = [quickly(i, spoiled(i.joints, "head", "rotation", *random.normal(size=3) * 15)) for i in healthy]
    assert diagnose_source("source", others).verdict in ("mixed", "unexplained")


def camera_error(value: float, shared: float = 0.1) -> CameraError:
    """An error of the focal length alone, in percent."""
    solved, information = np.zeros(PARAMETERS), np.eye(PARAMETERS) / 9
    solved[6] = value
    return CameraError("head", solved, information, shared)


def test_many_episodes_say_more_than_one_and_a_broken_one_does_not_speak_for_them() -> None:
    values = 8.0 + 3.0 * np.random.default_rng(0).normal(size=24)
    (together,) = combine([(camera_error(value),) for value in values])
    alone = camera_error(8.0)
    assert together.kinds[2].half_interval < alone.kinds[2].half_interval / 2
    assert together.kinds[2].bound < alone.kinds[2].bound
    assert together.squares > SQUARES_TOGETHER
    assert together.named == ("focal length",)
    assert alone.squares < SQUARES_ALONE
    (spoiled_by_one,) = combine([(camera_error(value),) for value in (*values, 90.0)])
    assert spoiled_by_one.estimate == pytest.approx(together.estimate, abs=1.0)
    assert (together.contradicting, spoiled_by_one.contradicting) == (0, 1)


def test_a_translation_is_named_beside_a_rotation_alone() -> None:
    """Also where a focal length explains the pictures too."""
    solved, toward = np.zeros(PARAMETERS), np.zeros((2, PARAMETERS))
    solved[4], toward[0, [4, 6]], toward[1, 0] = 300.0, (1.0, 20.0), 1.0
    information = toward.T @ np.diag([1e-2, 1e-1]) @ toward
    found = CameraError("head", solved, information, 0.0)
    assert found.named == ("rotation", "translation", "focal length")


def test_what_one_episode_alone_shows_is_not_said_of_its_source() -> None:
    def one(gain: float) -> Diagnosis:
        written = Explanation(RecordedConventions(), -20.0, {"flow head": -20.0})
        late = Explanation(RecordedConventions(image_lag_frames=1), gain - 20.0, {"flow head": 0.0})
        return Diagnosis(verdict="unexplained", best=written, ranked=(late, written))

    assert diagnose_source("source", [one(20.0), *[one(0.0)] * 4]).verdict != "explained"
    assert diagnose_source("source", [one(4.0)] * 5).best.mistake == "image_lag_frames"


def test_episodes_beyond_their_bounds_are_mixed() -> None:
    def source(*values: float) -> str:
        each = [Diagnosis(verdict="consistent").with_camera_errors((camera_error(value),)) for value in values]
        return diagnose_source("source", each).verdict

    assert source(*(-60.0, 60.0) * 4) == "mixed"
    assert source(*(1.0, -2.0) * 4) == "consistent"
    assert source(*[20.0] * 8) == "off"


@pytest.mark.slow
def test_exchanged_wrist_videos_are_found(healthy_episodes: list) -> None:
    found = []
    for item in healthy_episodes[4:8]:
        left, right = (arm.camera_view for arm in item.kinematics.embodiment.arms)
        exchanged = {**item.gray, left: item.gray[right], right: item.gray[left]}
        found.append(diagnose(item.joints, exchanged, item.kinematics, quick=True))
    assert sum(d.best.mistake == "wrist_videos" for d in found) >= 3
    together = diagnose_source("source", found)
    assert (together.verdict, together.best.other) == ("explained", ("wrist_videos", "exchanged"))
