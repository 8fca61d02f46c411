"""The doctor on shipped recordings: every usual mistake is named, and healthy recordings are left alone."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import calibration as benchmark
from tools.corrupted.conventions import corrupt
from worldline_core.calibration import calibration_doctor
from worldline_core.calibration.calibration_doctor import diagnose
from worldline_core.calibration.check import ListedEpisode, repairing_lines, verdict_text
from worldline_core.calibration.diagnosis import MAX_GAIN, MIN_MARGIN, Diagnosis, diagnose_source
from worldline_core.data.episodes.conventions import RecordedConventions, along_tool_z
from worldline_core.data.episodes.episode import Episode
from worldline_core.errors import DataError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics

Agibot = Callable[[str], list[tuple[Episode, dict[str, np.ndarray]]]]


def test_a_mistake_in_one_view_is_told_from_one_in_all(healthy: list) -> None:
    item = healthy[1]
    for mistake in ({"intrinsics_size": (480, 640)}, {"camera_axes": "opengl"}):
        conventions = RecordedConventions(**mistake, views=("head",))  # type: ignore[arg-type]
        diagnosis = benchmark.examine(item, item.joints, conventions)
        assert diagnosis.best.conventions == conventions
        assert diagnosis.best.conventions.config_lines()[-1].endswith("views: [head]")


@pytest.mark.slow
@pytest.mark.parametrize("view", ["head", "left_wrist"])
def test_what_no_usual_mistake_explains_is_called_unexplained(healthy: list, view: str) -> None:
    """A head camera turned by 40 degrees, a wrist camera that wanders."""
    item = healthy[0]
    poses = item.joints.cameras[view].T_base_camera.copy()
    if view == "head":
        poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_euler("z", 40, degrees=True).as_matrix()
    else:
        poses[:, :3, 3] += np.random.default_rng(0).normal(0, 0.05, (len(poses), 3))
    cameras = {**item.joints.cameras, view: replace(item.joints.cameras[view], T_base_camera=poses)}
    diagnosis = diagnose(replace(item.joints, cameras=cameras), item.gray, item.kinematics)
    assert diagnosis.verdict == "unexplained"
    assert diagnosis.best is diagnosis.as_recorded


def test_a_wrong_tool_of_the_embodiment_is_its_files_fault(healthy: list) -> None:
    item = healthy[0]
    embodiment = load_embodiment(item.joints.embodiment)
    arms = []
    for arm in embodiment.arms:
        moved = np.asarray(arm.T_link_tool.translation) - 0.06 * arm.T_link_tool.matrix()[:3, 2]
        tool = arm.T_link_tool.model_copy(update={"translation": tuple(moved.tolist())})
        arms.append(arm.model_copy(update={"T_link_tool": tool}))
    # The stated mount is relative to the link, so in the tool's frame it moves with a wrong tool; pictures decide.
    wrong = ArmKinematics(embodiment.model_copy(update={"arms": tuple(arms)}))
    diagnosis = diagnose(item.joints, item.gray, wrong)
    assert diagnosis.verdict == "consistent"  # 6 cm of the tool alone leave no trace in a recording of joints
    assert diagnosis.as_recorded.evidence["mount left_wrist"] > -0.1


def test_without_anything_to_compare_nothing_is_claimed(healthy: list) -> None:
    item = healthy[0]

    def first(values: np.ndarray) -> np.ndarray:
        return values[:1].repeat(len(values), 0)

    poses, state = item.poses, first(item.poses.state)
    cameras = {v: replace(c, T_base_camera=first(c.T_base_camera)) for v, c in poses.cameras.items()}
    still = {"T_base_ee": first(poses.T_base_ee), "gripper": first(poses.gripper), "cameras": cameras}
    rest = replace(poses, state=state, action=state, **still)
    pictures = {view: first(images) for view, images in item.gray.items()}
    for episode, images, kinematics, note in (
        (item.joints, item.gray, None, "no kinematics"),
        (replace(item.joints, cameras={}), item.gray, item.kinematics, "camera calibration"),
        (rest, pictures, item.kinematics, "polarity is not judged"),
    ):
        diagnosis = diagnose(episode, images, kinematics)
        assert diagnosis.verdict == "too_little_evidence"
        assert any(note in each for each in diagnosis.notes)


def test_poses_without_pictures_still_show_what_poses_can_show(healthy: list) -> None:
    item = healthy[0]
    fine = diagnose(item.poses, {}, item.kinematics)
    assert (fine.verdict, fine.camera_errors) == ("consistent", ())  # no bound is claimed
    assert verdict_text(fine).endswith("not judged: " + ", ".join(item.poses.cameras))
    diagnosis = diagnose(corrupt(item.poses, RecordedConventions(quaternion="wxyz")), {}, None)
    assert diagnosis.best.mistake == "quaternion"
    assert all("too few to compare motion" in why for why in diagnosis.not_judged.values())


def test_images_of_a_wrong_kind_are_refused_and_a_single_one_is_not_judged(healthy: list) -> None:
    item = healthy[0]
    diagnosis = diagnose(item.joints, {**item.gray, "head": item.gray["head"][:1]}, item.kinematics)
    assert diagnosis.not_judged.keys() == {"head"}
    with pytest.raises(DataError, match="wrong shape"):
        diagnose(item.joints, {"head": item.gray["head"].astype(np.float32)}, item.kinematics)
    with pytest.raises(DataError, match="number of arms"):
        diagnose(replace(item.poses, T_base_ee=item.poses.T_base_ee[:, :1]), item.gray, item.kinematics)


def test_quick_search_finds_the_same(healthy: list) -> None:
    conventions = RecordedConventions(gripper="inverted")
    assert benchmark.examine(healthy[0], healthy[0].joints, conventions, quick=True).best.conventions == conventions


@pytest.mark.slow
def test_evidence_adds_up_over_the_episodes_of_a_source() -> None:
    """Two episodes in which the gripper alone is too weak a sign, one in which it is not."""
    items = list(benchmark.healthy(benchmark.RECORDINGS, {"test"}, 7))
    inverted = RecordedConventions(gripper="inverted")
    diagnoses = [benchmark.examine(item, item.joints, inverted) for item in items]
    found = diagnose_source("source", diagnoses)
    assert (found.verdict, found.best.conventions) == ("explained", inverted)
    gains = [d.ranked[[e.mistake for e in d.ranked].index("gripper")].score - d.as_recorded.score for d in diagnoses]
    gain = sum(min(value, MAX_GAIN) for value in gains)
    none = next(e for e in found.ranked if e.mistake == "none")
    assert found.best.score - none.score == pytest.approx(gain)
    assert found.num_episodes == len(items)
    clean = [diagnose(item.joints, item.gray, item.kinematics) for item in items]
    assert diagnose_source("source", clean).verdict == "consistent"
    assert diagnose_source("source", []).verdict == "too_little_evidence"


@pytest.mark.slow
def test_mistakes_named_over_the_test_splits() -> None:
    """The acceptance figures on every eighth recording: at least 95 % named, at most 2 % false alarms."""
    right: dict[bool, list[bool]] = defaultdict(list)
    for number, item in enumerate(benchmark.healthy(benchmark.RECORDINGS, {"test", "ood_test"}, 8)):
        for name, base, conventions in benchmark.injected(item, number):
            diagnosis = benchmark.examine(item, base, conventions)
            best, clean = diagnosis.best, name.startswith("none")
            right[clean].append(benchmark.right(name, conventions, benchmark.named(diagnosis), best.conventions))
            if clean or not right[clean][-1]:
                continue
            assert best is diagnosis.ranked[0] and best.score - diagnosis.as_recorded.score >= MIN_MARGIN
            if name == "tool_offset_z_m":
                assert best.conventions.tool_offset_z_m == pytest.approx(conventions.tool_offset_z_m, abs=1e-3)
            if name == "intrinsics_size":
                assert best.conventions.intrinsics_size == pytest.approx(conventions.intrinsics_size, rel=0.02)
    assert np.mean(right[True]) >= 0.98
    assert np.mean(right[False]) >= 0.95


def test_agibot_v1_extrinsics_are_camera_to_base_and_may_trail(agibot: Agibot) -> None:
    """Four pictures show no motion, so a lag that only makes the poses fit better is noted, and claimed of none."""
    diagnoses = [diagnose(episode, frames, None) for episode, frames in agibot("agibot_gesim")]
    for diagnosis in diagnoses:
        by_name = {e.mistake: e.score for e in reversed(diagnosis.ranked)}
        assert by_name["extrinsics"] < diagnosis.as_recorded.score - 40  # camera-to-base as read, not the inverse
        assert by_name["quaternion"] < diagnosis.as_recorded.score - 30
        assert (diagnosis.verdict, diagnosis.best.mistake) == ("consistent", "none")
        assert verdict_text(diagnosis).endswith("not judged: head, left_wrist, right_wrist")
        assert any(note.startswith("camera_lag_frames: 2 would fit the poses better") for note in diagnosis.notes)
    together = diagnose_source("agibot", diagnoses)
    assert (together.verdict, together.best.mistake) == ("consistent", "none")


@pytest.mark.slow
def test_agibot_v2_wrist_extrinsics_follow_the_action(shared_data: Path, agibot: Agibot) -> None:
    description = shared_data / "agibot_g1_urdf" / "G1_omnipicker_calibrated.urdf"
    kinematics = ArmKinematics(load_embodiment("agibot_g1", description))
    for episode, frames in agibot("agibot_gesim_v2"):
        diagnosis = diagnose(episode, frames, kinematics)
        assert diagnosis.verdict == "consistent"
        assert any("may follow the commands" in note for note in diagnose(episode, frames, None).notes)
        spoiled = corrupt(episode, RecordedConventions(euler="moving_xyz"))
        assert diagnose(spoiled, frames, kinematics).best.mistake == "euler"


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
    one, two = (episode.cameras[view] for view in ("left_wrist", "right_wrist"))
    exchanged = [replace(a, T_base_camera=b.T_base_camera) for a, b in ((one, two), (two, one))]
    return replace(episode, cameras=dict(episode.cameras) | {camera.view: camera for camera in exchanged})


@pytest.mark.slow
@pytest.mark.parametrize(("truth", "declared"), [("ur5e", "viperx_graphite"), ("panda", "xarm7_white")])
def test_another_robot_than_declared_is_named(healthy: list, truth: str, declared: str) -> None:
    item = of_robot(healthy, truth)
    diagnosis = declared_as(item, declared)
    robot = item.joints.embodiment
    assert (diagnosis.verdict, diagnosis.best.other) == ("explained", ("embodiment", robot))
    assert any(robot in note and declared in note for note in diagnosis.notes)
    together = diagnose_source("source", [diagnosis, diagnosis])
    assert (together.verdict, together.best.text) == ("explained", f"embodiment: {robot}")
    listed = ListedEpisode("e", "source", lambda: None, "curate.sources[1].conventions", declares_robot=True)  # type: ignore[arg-type,return-value]
    assert repairing_lines(listed, together.best) == (f"curate.sources[1].embodiment: {robot}",)
    assert repairing_lines(replace(listed, declares_robot=False), together.best) == ()


@pytest.mark.slow
def test_a_reading_that_leaves_the_recording_ill_does_not_win(healthy: list, monkeypatch: pytest.MonkeyPatch) -> None:
    """Degrees bring the joints of an unknown robot within their limits, and explain nothing."""
    monkeypatch.setattr(calibration_doctor, "robots_like", lambda _: ())
    diagnosis = declared_as(of_robot(healthy, "ur5e"), "viperx_graphite")
    assert diagnosis.verdict == "unexplained"
    assert all(fact in diagnosis.nearest[0] for fact in ("angle_unit: deg", "hand-eye"))
    together = diagnose_source("source", [diagnosis] * 3)
    assert (together.verdict, together.best.mistake) == ("unexplained", "none")
    assert any("angle_unit: deg: healthy in 0 of 3" in near for near in together.nearest)


def test_flange_poses_do_not_turn_the_wrist_cameras(agibot: Agibot) -> None:
    diagnoses = []
    for episode, pictures in agibot("agibot_gesim"):
        ends = along_tool_z(episode.T_base_ee, -0.23)
        flange = replace(episode, T_base_ee=ends, conventions={**episode.conventions, "tool_offset_m": 0.0})
        diagnoses.append(diagnose(flange, pictures, None))
    together = diagnose_source("agibot", diagnoses)
    assert {diagnosis.verdict for diagnosis in (*diagnoses, together)} == {"unexplained"}
    assert all("camera_axes: opengl" in diagnosis.nearest[0] for diagnosis in diagnoses)


@pytest.mark.slow
def test_exchanged_wrist_extrinsics_are_not_exchanged_arms(healthy: list) -> None:
    item = of_robot(healthy, "ur5e")
    diagnosis = diagnose(with_exchanged_extrinsics(item.joints), item.gray, item.kinematics)
    assert (diagnosis.verdict, diagnosis.best.other) == ("explained", ("wrist_extrinsics", "exchanged"))
    assert benchmark.examine(item, item.joints, RecordedConventions(arms="exchanged")).best.mistake == "arms"


def test_what_nothing_recorded_tells_apart_is_not_claimed(agibot: Agibot) -> None:
    """Without pictures and kinematics either the arms or the cameras may be exchanged."""
    exchanged = [(with_exchanged_extrinsics(episode), pictures) for episode, pictures in agibot("agibot_gesim")]
    diagnoses = [diagnose(episode, pictures, None) for episode, pictures in exchanged]
    assert all(any("wrist_extrinsics: exchanged" in note for note in diagnosis.notes) for diagnosis in diagnoses)
    together = diagnose_source("agibot", diagnoses)
    assert {diagnosis.verdict for diagnosis in (*diagnoses, together)} == {"unexplained"}
    assert {near.split(": ")[0] for near in together.nearest} >= {"arms", "wrist_extrinsics"}


@pytest.mark.parametrize(("cameras", "images"), [(-3, -3), *slow((3, 0), (0, 3))])
def test_inverse_and_late(healthy: list, cameras: int, images: int) -> None:
    """A lag shows only where the other mistake is undone."""
    item = of_robot(healthy, "xarm7")
    conventions = INVERSE.model_copy(update={"camera_lag_frames": cameras, "image_lag_frames": images})
    diagnosis = benchmark.examine(item, item.joints, conventions)
    for found in (diagnosis, diagnose_source("source", [diagnosis] * 2)):
        assert (found.verdict, found.best.conventions) == ("explained", conventions)


@pytest.mark.slow
@pytest.mark.parametrize("mistake", [{"image_lag_frames": 3}, {"extrinsics": "base_to_camera"}])
def test_one_good_and_one_bad_episode_prescribe_nothing_for_both(healthy: list, mistake: dict[str, Any]) -> None:
    good, bad = of_robot(healthy, "xarm7"), of_robot(healthy, "ur5e")
    fine = diagnose(good.joints, good.gray, good.kinematics)
    wrong = benchmark.examine(bad, bad.joints, RecordedConventions.model_validate(mistake))
    assert (fine.verdict, wrong.verdict) == ("consistent", "explained")
    together = diagnose_source("source", [fine, wrong])
    assert (together.verdict, together.best.mistake) == ("mixed", "none")
    assert diagnose_source("source", [fine] * 10 + [wrong]).verdict == "consistent"
    assert diagnose_source("source", [fine] + [wrong] * 10).best.mistake == next(iter(mistake))


AXES, UNIT, ANGLES = (
    RecordedConventions.model_validate(one)
    for one in ({"camera_axes": "opengl"}, {"extrinsics_unit": "mm"}, {"angle_unit": "deg"})
)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (ANGLES, None),
        *slow((UNIT, INVERSE), (AXES, INVERSE), (ANGLES, INVERSE), (AXES, UNIT), (AXES, ANGLES), (UNIT, ANGLES)),
        *slow((AXES, None), (UNIT, None)),
    ],
)
def test_two_errors_at_once_are_judged(healthy, first, second):
    """Under some readings of these nothing of the robot is before the head camera (None: exchanged wrist extrinsics)."""
    item = of_robot(healthy, "ur5e")
    once = corrupt(item.joints, first)
    spoiled = with_exchanged_extrinsics(once) if second is None else corrupt(once, second)
    assert diagnose(spoiled, item.gray, item.kinematics, quick=True).verdict != "consistent"


@pytest.mark.parametrize(
    ("robot", "frames"), [("xarm7", 1), *slow(("ur5e", 2), ("viperx", 3), ("xarm7", -2), ("panda", -1))]
)
def test_the_delay_of_one_camera_is_its_own(healthy: list, robot: str, frames: int) -> None:
    item = of_robot(healthy, robot)
    lag = RecordedConventions(image_lag_frames=frames, views=("head",))
    diagnosis, quick = (benchmark.examine(item, item.joints, lag, quick=quick) for quick in (False, True))
    assert (diagnosis.verdict, diagnosis.best.conventions) == ("explained", lag)
    assert quick.best == diagnosis.best


def test_a_lag_at_the_edge_of_the_search_explains_nothing(healthy: list) -> None:
    item = of_robot(healthy, "ur5e")
    diagnosis = benchmark.examine(item, item.joints, RecordedConventions(image_lag_frames=6))
    assert diagnosis.verdict == diagnose_source("source", [diagnosis] * 3).verdict == "unexplained"
    assert any("at the edge" in note for note in diagnosis.notes)


@pytest.mark.parametrize(
    ("kind", "begins", "quick"),
    [
        ("wrist", 0, True),
        *slow(("head", 10, False), ("head", 0, False), ("wrist", 0, False), ("wrist", 10, False), ("head", 10, True)),
    ],
)
def test_a_frozen_video_is_no_consistent_one(healthy: list, kind: str, begins: int, quick: bool) -> None:
    item = of_robot(healthy, "ur5e")
    views = [view for view in item.gray if view.endswith(kind)]  # the head, or the liveliest wrist
    view = max(views, key=lambda view: np.abs(np.diff(item.gray[view].astype(float), axis=0)).sum())
    frozen = item.gray[view].copy()
    frozen[begins:] = frozen[begins]
    diagnosis = diagnose(item.joints, {**item.gray, view: frozen}, item.kinematics, quick=quick)
    assert diagnosis.verdict == "unexplained"
    assert any(note.startswith(f"{view}: its pictures stay the same") for note in diagnosis.notes)
    together = diagnose_source("source", [diagnosis] * 3)
    assert (together.verdict, together.not_judged) == ("unexplained", diagnosis.not_judged)
    assert (view in together.not_judged) == (begins == 0)
