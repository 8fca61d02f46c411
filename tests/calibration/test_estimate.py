"""Cameras estimated from recorded episodes alone."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from benchmarks import calibration as benchmark
from benchmarks import hidden_cameras
from flows.command_line import main
from worldline_core.calibration.camera_errors import PARAMETERS, Equations, moved_camera
from worldline_core.calibration.estimate import base_pose, estimate, estimate_report, wrist_camera
from worldline_core.calibration.estimate.estimate import camera_file, estimate_views
from worldline_core.calibration.estimate.estimate_report import estimate_text
from worldline_core.calibration.estimate.recordings import RecordedView, near_changes, recorded_views
from worldline_core.calibration.estimate.refine import FittedCamera, fit_still
from worldline_core.calibration.estimate.still_camera import (
    StillCamera,
    agreement,
    tools_apart,
    unmirrored,
)
from worldline_core.calibration.estimate.verdict import (
    BasePose,
    SourceEstimate,
    ViewEstimate,
    cause_of_disagreement,
    clearest_step,
    full_size,
    judge_still,
)
from worldline_core.calibration.estimate.wrist_camera import WristCamera, mounts_around
from worldline_core.calibration.observation import CELL_PX, CLEAR_CHANGE
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.episodes.source import LoadedEpisode
from worldline_core.data.sources.calibration_file import calibrated, read_calibration
from worldline_core.errors import DataError
from worldline_core.geometry.cameras import project_points
from worldline_core.geometry.embodiment import RigidOffset, load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.transforms import pose_from_rotation, rigid_inverse, rotation_angle_deg

Loaded = list[tuple[Episode, dict[str, np.ndarray]]]
BANKS = benchmark.RECORDINGS.parent / "banks"


@pytest.fixture(scope="module")
def bank() -> Loaded:
    """Six attempts of one body before one camera."""
    found = EpisodeSet.open(BANKS)
    chosen = [i for i, row in enumerate(found.rows) if row.bank == "bank_carry_ur5e"][:24:4]
    return [(found.episode(i), {"head": found.frames(i, "head")}) for i in chosen]


@pytest.fixture(scope="module")
def kinematics(bank: Loaded) -> ArmKinematics:
    return ArmKinematics(load_embodiment(bank[0][0].embodiment))


def test_a_camera_is_made_exact_from_a_start_nearby(bank: Loaded, kinematics: ArmKinematics) -> None:
    recorded = recorded_views(iter(bank[:2]), kinematics, 2)["head"]
    views = recorded.still_views(fine=False)
    size = views[0].camera
    true = bank[0][0].cameras["head"].resized(size.width, size.height)
    start = moved_camera(true, np.array([0.05, -0.06, 0.04, 0.03, 0.05, 0.05, 0.1, 0.0]))
    fitted = fit_still(views, start, 0.5, (2.5, 1.2), 6, 2.0)
    assert tools_apart(start, true, recorded) > 0.06
    assert tools_apart(fitted.camera, true, recorded) < 0.04
    assert abs(fitted.lag) < 0.2
    assert min(agreement(view, fitted) for view in views) > 0.6
    # Mirrored pictures that fit as well matter where they would show the tools elsewhere.
    flipped = replace(fitted.camera, K=np.array([[-1, 0, size.width - 1], [0, 1, 0], [0, 0, 1]]) @ fitted.camera.K)
    same = tools_apart(fitted.camera, unmirrored(flipped), recorded)
    elsewhere = tools_apart(fitted.camera, unmirrored(start), recorded)
    agreements = np.array([agreement(view, fitted) for view in views])
    for apart, doubted in ((same, False), (elsewhere, True)):
        found = StillCamera(fitted, (fitted, fitted), agreements, None, None, np.zeros(len(views)), 0.5, apart)
        judged = judge_still(recorded, found)
        said = [any("mirrored" in text for text in texts) for texts in (judged.reasons, judged.notes)]
        assert said == [doubted, not doubted]


@pytest.fixture(scope="module")
def hidden(rendering: None, tmp_path_factory: pytest.TempPathFactory) -> Loaded:
    """Eight episodes of another body before a camera that stands anywhere."""
    folder = tmp_path_factory.mktemp("hidden")
    hidden_cameras.record("xarm7_white", folder, 8, 0)
    return [(e, {"head": frames["head"]}) for e, frames in hidden_cameras.read_set(folder / "xarm7_white_0.json")]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        ("nothing", ""),
        ("states late by 3 frames", ""),
        ("mirrored", "left and right"),
        ("other states", "other episodes"),
        ("moved half way", "stands elsewhere"),
        (benchmark.ANOTHER_ROBOT, "another robot"),
    ],
)
def test_a_still_camera_is_found_and_what_is_wrong_with_a_set_is_named(hidden: Loaded, spoil: str, words: str) -> None:
    robot = ArmKinematics(load_embodiment("xarm7_white"))
    declared = ArmKinematics(load_embodiment("panda_ivory")) if spoil == benchmark.ANOTHER_ROBOT else robot
    (found,) = estimate_views(iter(benchmark.SPOILED[spoil](hidden)), declared, len(hidden))
    if words:
        assert found.verdict == "unsure" and words in " ".join(found.reasons)
        assert not camera_file([found])["views"]
        return
    assert found.verdict == "sure", found.reasons
    assert abs(found.lag_frames + (3 if "late" in spoil else 0)) < 0.3
    tools = np.concatenate([robot.tool_poses(episode.state.astype(np.float64)).numpy() for episode, _ in hidden])
    assert benchmark.estimate_errors(found, hidden[0][0].cameras["head"], tools, None)["tool"] < 3


@pytest.mark.slow
def test_a_second_arm_s_base_is_found_from_a_camera_of_each_arm(bank: Loaded, tmp_path: Path) -> None:
    robot = hidden_cameras.with_unknown_base(bank[0][0].embodiment, tmp_path)
    left = robot.description.mounts["left"]
    apart = robot.with_mounts({"left": RigidOffset(), "right": RigidOffset(translation=(base_pose.APART_M, 0.0, 0.0))})
    recorded = recorded_views(iter(bank[:3]), ArmKinematics(apart), 3)["head"]
    arms = base_pose.each_arm(recorded)
    true = ArmKinematics(load_embodiment(bank[0][0].embodiment)).link_poses(bank[0][0].state[:1].astype(np.float64))
    views = list(zip(*(arm.still_views(fine=True) for arm in arms), strict=True))
    size, camera = views[0][0].camera, bank[0][0].cameras["head"]
    bases = [true[f"{side}/base"][0].numpy() for side in ("left", "right")]
    seen = [replace(camera.resized(size.width, size.height), T_base_camera=rigid_inverse(T) @ camera.T_base_camera[:1]) for T in bases]  # fmt: skip
    started = [moved_camera(c, np.array([0.03, 0.02, s * 0.03, 0.02, s * 0.02, 0.02, s * 0.05, 0])) for s, c in zip((1, -1), seen, strict=True)]  # fmt: skip
    fitted = base_pose.refine_pair(views, arms, (started[0], started[1]), 0.0)
    found = base_pose.base_pose("head", "right", left.matrix(), arms, fitted)
    off = rigid_inverse(bases[1]) @ found.placed.matrix()
    assert tools_apart(started[1], seen[1], arms[1]) > 0.03 > 0.02 > tools_apart(fitted.cameras[1], seen[1], arms[1])
    assert np.linalg.norm(off[:3, 3]) < found.half_interval_mm / 1e3
    assert rotation_angle_deg(off[:3, :3]) < found.half_interval_deg and found.reason is not None, "episodes are few"


@pytest.mark.parametrize(("interval_mm", "line"), [(80.0, True), (900.0, False)], ids=["sure", "not sure"])
def test_a_found_base_is_printed_as_the_line_for_the_robot_s_file(interval_mm, line):
    base = BasePose("head", "right", RigidOffset(translation=(0.1, -0.3, 0.0)), 5.0, interval_mm, 1.0, 10.0)
    found = SourceEstimate("mine", (), Path(), None, base)
    written = "right: {translation: [0.1, -0.3, 0.0], rotation_wxyz: [1.0, 0.0, 0.0, 0.0]}"
    assert (written in estimate_text(found)) is line and ("not sure" in estimate_text(found)) is not line
    assert found.sure is line


def test_an_episode_whose_video_cannot_be_read_is_left_out(bank: Loaded, kinematics: ArmKinematics) -> None:
    def cut_off() -> Iterator[np.ndarray]:
        yield from bank[1][1]["head"][:5]
        raise DataError("Video and states differ in length")

    recorded = recorded_views(iter([bank[0], (bank[1][0], {"head": cut_off()})]), kinematics, 2)["head"]
    assert [episode.episode_id for episode in recorded.episodes] == [bank[0][0].episode_id]
    with pytest.raises(DataError, match="differ in length"):
        recorded_views(iter([(bank[1][0], {"head": cut_off()})]), kinematics, 1)


def test_flow_in_flat_parts_where_nothing_changes_does_not_count(bank: Loaded, kinematics: ArmKinematics) -> None:
    """Before a black wall flow is a guess of any length: the frame's upper part is black, and noise moves nothing there."""
    random, wall = np.random.default_rng(0), 24
    pictures = [frames["head"].copy() for _, frames in bank[:2]]
    for frames in pictures:
        frames[:, :wall] = random.integers(0, 2, (len(frames), wall, *frames.shape[2:]))
    loaded = [(episode, {"head": frames}) for (episode, _), frames in zip(bank[:2], pictures, strict=True)]
    recorded = recorded_views(iter(loaded), kinematics, 2)["head"]
    for episode in recorded.episodes:
        above = int(wall * episode.gray.shape[2] / pictures[0].shape[2] / CELL_PX) - 2
        motion = near_changes(episode.fine)
        assert np.abs(episode.fine.flow[:, :above]).max() > 1 and not motion.flow[:, :above].any()
        moving = motion.change > CLEAR_CHANGE
        assert np.array_equal(motion.flow[moving], episode.fine.flow[moving])


def test_what_moves_outside_of_the_robot_s_masks_does_not_count(bank: Loaded, kinematics: ArmKinematics) -> None:
    recorded = recorded_views(iter(bank[:2]), kinematics, 2, colour=True)["head"]
    camera = bank[0][0].cameras["head"]
    seen: list[np.ndarray] = []

    def right_half(video: np.ndarray, points: np.ndarray) -> np.ndarray:
        seen.append(points)
        masks = np.zeros(video.shape[:3], bool)
        masks[:, :, video.shape[2] // 2 :] = True
        return masks

    (plain, _), (masked, _) = recorded.episodes, recorded.masked(right_half, camera).episodes
    columns = plain.fine.change.shape[2]
    assert np.array_equal(masked.fine.flow[:, :, columns // 2 + 1 :], plain.fine.flow[:, :, columns // 2 + 1 :])
    left = slice(None, columns // 2 - 1)
    assert np.abs(plain.fine.flow[:, :, left]).max() > 1
    assert not np.abs(masked.fine.flow[:, :, left]).any() and not masked.fine.change[:, :, left].any()
    # The tools are where the camera shows them: inside of the picture most of the time.
    height, width = bank[0][1]["head"].shape[1:3]
    assert np.mean((seen[0] > 0) & (seen[0] < [width, height])) > 0.8


@pytest.mark.parametrize(
    ("later", "deviations", "expected"),
    [((0.0, 0.0), 1.0, None), ((-8.0, -6.0), 6.0, None), ((-8.0, -8.0), 1.0, 6), ((-8.0, 9.0), 1.0, None)],
    ids=["stands", "hardly known", "moved", "scattered"],
)
def test_a_camera_has_moved_where_episodes_that_know_it_say_so(later, deviations, expected):
    values, spread = np.random.default_rng(0).normal(0, 0.5, (10, 2)), np.ones(10)
    values[6::2, 0], values[7::2, 0], spread[6:] = later[0], later[1], deviations
    assert clearest_step(values, spread[:, None, None] ** 2 * np.eye(2), 2.5) == expected


def test_a_segmenter_needs_its_weights(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["calibrate", "estimate", "my.yaml", "--segmenter", "sam3"])
    assert ended.value.code == 2 and "--weights" in capsys.readouterr().err


def test_what_cannot_be_estimated_is_named(bank: Loaded, kinematics: ArmKinematics) -> None:
    pictures = [(episode, {"head": frames["head"][:4]}) for episode, frames in bank]
    spoiled = (bank[:2], "2 episodes"), (benchmark.SPOILED["still"](bank), "not enough motion"), (pictures, "pictures")
    for episodes, reason in spoiled:
        (found,) = estimate_views(iter(episodes), kinematics, len(episodes))
        assert found.camera is None and reason in found.reasons[0]


@pytest.mark.parametrize(
    ("spoil", "views", "words"),
    [
        ("nothing", ("head", "left_wrist"), "another robot"),
        ("wrists exchanged", ("left_wrist", "right_wrist"), "exchanged"),
        ("other states", ("head", "left_wrist"), "other episodes"),
    ],
)
def test_why_pictures_do_not_show_the_robot_of_the_states_is_named(spoil, views, words):
    found, defects = EpisodeSet.open(benchmark.RECORDINGS), benchmark.RECORDINGS / "injected_defects.json"
    rows = {i: row for i, row in enumerate(found.rows) if row.episode_id not in json.loads(defects.read_text())}
    of_one_arm = [i for i, row in rows.items() if row.embodiment == "ur5e_silver" and row.task_family != "carry"]
    loaded = [
        (replace(found.episode(i), cameras={}), {v: found.frames(i, v) for v in ("head", "left_wrist", "right_wrist")})
        for i in of_one_arm[:6]
    ]
    robot = ArmKinematics(load_embodiment("ur5e_silver"))
    recorded = recorded_views(iter(benchmark.SPOILED[spoil](loaded)), robot, len(loaded))
    for view in views:
        assert words in cause_of_disagreement(recorded[view], {"left_wrist": 0, "right_wrist": 1}.get(view))


@pytest.mark.parametrize(
    "hand", [np.array([[0.0, 0.02, -0.1], [0.01, -0.02, -0.06]]), np.empty((0, 3))], ids=["known", "unknown"]
)
def test_searched_mounts_see_the_tool_from_behind_the_hand(hand: np.ndarray) -> None:
    mounts = np.stack(list(mounts_around(hand)))
    assert len(np.unique(mounts.round(6), axis=0)) == 128
    np.testing.assert_allclose(
        mounts[:, :3, :3] @ mounts[:, :3, :3].swapaxes(1, 2), np.tile(np.eye(3), (128, 1, 1)), atol=1e-9
    )
    seen = -np.einsum("nji,nj->ni", mounts[:, :3, :3], mounts[:, :3, 3])  # the tool's origin before each camera
    assert (np.hypot(seen[:, 0], seen[:, 1]) < 0.5 * seen[:, 2]).all() and (mounts[:, 2, 3] < 0).all()


def test_a_longer_lens_from_farther_away_shows_the_tool_at_the_same_place_and_size() -> None:
    camera = CameraTrack("right_wrist", np.diag([50.0, 50.0, 1.0]), next(mounts_around(np.empty((0, 3))))[None], 96, 72)
    far = wrist_camera._zoomed(camera, 1.5)
    assert far.K[0, 0] == far.K[1, 1] == 75.0
    across = camera.T_base_camera[0, :3, :2].T * 0.01  # beside the tool, at its distance
    points = np.concatenate([np.zeros((1, 3)), across])
    (near_uv, near_depth), (uv, depth) = (project_points(points, c.K, c.T_base_camera) for c in (camera, far))
    np.testing.assert_allclose(uv, near_uv, atol=1e-9)
    np.testing.assert_allclose(depth, 1.5 * near_depth)


def test_wrist_views_have_more_and_smaller_points_of_the_hand() -> None:
    robot = ArmKinematics(load_embodiment("so101"))
    random, count = np.random.default_rng(0), 12
    state = random.uniform(-0.5, 0.5, (count, 6)).astype(np.float32)
    episode = Episode(
        episode_id="a", source="s", embodiment="so101", scene="s", task_family="unknown", instruction="", outcome="unknown",
        split="train", fps=8.0, state=state, action=state, timestamps=np.arange(count) / 8.0,
    )  # fmt: skip
    pictures = random.integers(0, 255, (count, 48, 64, 3)).astype(np.uint8)
    views = recorded_views(iter([(episode, {"head": pictures, "right_wrist": pictures})]), robot, 1)
    head, wrist = (views[view].episodes[0] for view in ("head", "right_wrist"))
    links = len(robot.surfaces)
    assert head.points.shape == (count, 12 * links, 3) and wrist.points.shape[1] == 12 * (links - 2) + 2 * 150
    assert np.median(wrist.radii) < 0.006 < head.radii.min()


def without_mounts(kinematics: ArmKinematics) -> ArmKinematics:
    arms = [arm.model_copy(update={"wrist_camera": None}) for arm in kinematics.embodiment.arms]
    return ArmKinematics(kinematics.embodiment.model_copy(update={"arms": tuple(arms)}))


def test_of_searched_mounts_the_one_that_held_out_episodes_show_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """The likelihood compares what one of them sees, in the episodes that both were fitted to."""
    equations = Equations(np.eye(PARAMETERS), np.zeros(PARAMETERS), 0.0)
    fits = []
    for likelihood, across in ((-700.0, 0.05), (-720.0, -0.05)):
        pose = pose_from_rotation(np.array([across, 0.0, -0.1]), np.eye(3))
        camera = CameraTrack("right_wrist", np.diag([50.0, 50.0, 1.0]), pose[None], 96, 72)
        fits.append(FittedCamera(camera, 0.0, replace(equations, likelihood=likelihood)))
    shown = {id(fits[0]): np.array([0.4, 0.5, 0.45]), id(fits[1]): np.array([0.8, 0.7, 0.75])}
    monkeypatch.setattr(wrist_camera, "lag_by_amounts", lambda _: 0.0)
    monkeypatch.setattr(wrist_camera, "_few", lambda recorded: recorded)
    monkeypatch.setattr(wrist_camera, "_searched_starts", lambda *_: [(fit.camera, []) for fit in fits])
    monkeypatch.setattr(wrist_camera, "_distinct", lambda _: fits)
    monkeypatch.setattr(wrist_camera, "wrist_evidence", lambda *_: [])
    monkeypatch.setattr(wrist_camera, "fit_wrist", lambda _, camera, *__: next(f for f in fits if f.camera is camera))
    monkeypatch.setattr(
        wrist_camera, "_made_exact", lambda _, __, fit, *___: WristCamera(fit, (fit, fit), shown[id(fit)], (), 30, 1.0)
    )
    found = wrist_camera.estimate_wrist(cast("RecordedView", None), 0, None)
    assert (found.fitted, found.rival, found.searched) == (fits[1], fits[0], True)
    assert found.rival_agreements is shown[id(fits[0])]


@pytest.mark.slow
@pytest.mark.usefixtures("rendering")
def test_a_wrist_camera_is_found_where_no_description_mounts_it(
    tmp_path: Path, bank: Loaded, kinematics: ArmKinematics
) -> None:
    hidden_cameras.record("xarm7_single", tmp_path, 8, 0)
    loaded = [
        (e, {"right_wrist": f["right_wrist"]}) for e, f in hidden_cameras.read_set(tmp_path / "xarm7_single_0.json")
    ]
    robot = ArmKinematics(load_embodiment("xarm7_single"))
    (found,) = estimate_views(iter(loaded), without_mounts(robot), len(loaded))
    assert found.verdict == "sure", found.reasons
    tools = np.concatenate([robot.tool_poses(episode.state.astype(np.float64)).numpy() for episode, _ in loaded])
    assert benchmark.estimate_errors(found, loaded[0][0].cameras["right_wrist"], tools, 0)["tool"] < 4
    wrist = [(episode, {"left_wrist": frames["head"]}) for episode, frames in bank[:3]]
    (found,) = estimate_views(iter(wrist), without_mounts(kinematics), 3)
    assert found.verdict == "unsure" and "mount" in found.notes[0], "a still camera is no wrist camera"


def test_sure_cameras_are_read_back_as_a_calibration_file(tmp_path, bank, kinematics):
    episode = bank[0][0]
    K = np.array([[90.0, 0, 47.5], [0, 90.0, 31.5], [0, 0, 1]])
    pose = np.array([[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, -0.1], [0, 0, 0, 1.0]])
    camera = CameraTrack("left_wrist", K, pose[None], 96, 64)
    sure = [
        ViewEstimate("left_wrist", wrist=True, verdict="sure", camera=full_size(camera, (128, 192))),
        ViewEstimate("head", wrist=False, verdict="sure", camera=replace(camera, view="head")),
        ViewEstimate("right_wrist", wrist=True, verdict="unsure", camera=camera),
    ]
    (tmp_path / "cameras.json").write_text(json.dumps(camera_file(sure)))
    entries = read_calibration(tmp_path, "cameras.json")
    assert entries.keys() == {"left_wrist", "head"}
    pictures = [np.zeros((128, 192, 3), np.uint8)]
    loaded = LoadedEpisode(episode, ("head", "left_wrist"), lambda _: pictures)
    loaded = calibrated(loaded, entries, "here", entries)
    cameras = loaded.with_mounted(loaded).episode.cameras
    tools = kinematics.tool_poses(episode.state.astype(np.float64)).numpy()[:, 0]
    assert np.allclose(cameras["left_wrist"].T_base_camera, tools @ pose, atol=1e-5)
    assert np.allclose(cameras["head"].T_base_camera, pose[None])
    assert np.allclose(cameras["head"].K[:2, 2], (95.5, 63.5))


def test_an_estimated_wrist_camera_is_drawn_where_its_tool_carries_it(bank, kinematics, monkeypatch):
    episode, rows = bank[0][0], []
    recorded = episode.cameras["left_wrist"]
    tools = kinematics.tool_poses(episode.state.astype(np.float64)).numpy()[:, 0]
    mount = replace(recorded, T_base_camera=(rigid_inverse(tools) @ recorded.T_base_camera)[:1])
    picture = np.full((recorded.height, recorded.width, 3), 90, np.uint8)
    sheet = np.zeros((256, 384, 3), np.uint8)
    monkeypatch.setattr(estimate_report, "contact_sheet", lambda found, **_: rows.extend(found) or sheet)
    found = ViewEstimate("left_wrist", wrist=True, verdict="sure", camera=mount)
    estimate_report.view_picture(found, [(episode, n, picture) for n in (4, 20)], kinematics)
    above, below = (row.frames[:, :200] for row in rows)  # without the name of the episode
    assert (below != 90).any(axis=-1).mean() > 0.02  # the tool is in the picture
    assert np.abs(above.astype(int) - below).mean() < 0.5


@pytest.mark.slow
def test_the_command_writes_cameras_pages_and_pictures(tmp_path, bank, monkeypatch, capsys):
    (tmp_path / "my.yaml").write_text(
        f"curate:\n  sources:\n  - {{kind: episode_set, path: {BANKS}, name: banks, include: ['bank_carry_ur5e-00[0-3]']}}\n"
    )
    true = bank[0][0].cameras["head"]
    found = [
        ViewEstimate("head", wrist=False, verdict="sure", camera=true, lag_frames=2.1, agreement=0.9, episodes=4),
        ViewEstimate("left_wrist", wrist=True, verdict="unsure", camera=None, reasons=("<b>too little</b>",)),
    ]
    monkeypatch.setattr(estimate, "estimate_views", lambda loaded, *_: list(loaded) and found)
    with pytest.raises(SystemExit) as ended:
        main(["calibrate", "estimate", str(tmp_path / "my.yaml"), "--view", "head", "--output", str(tmp_path / "out")])
    said, page = capsys.readouterr().out, (tmp_path / "out" / "index.html").read_text()
    assert ended.value.code == 1
    assert "conventions.image_lag_frames: 2" in said and "<b>too little</b>" in said
    assert "<b>too little</b>" not in page and "head.jpg" in page
    assert (tmp_path / "out" / "head.jpg").is_file()
    assert read_calibration(tmp_path / "out", "cameras.json").keys() == {"head"}
    listed = json.loads((tmp_path / "out" / "estimate.json").read_text())
    assert [view["verdict"] for view in listed["views"]] == ["sure", "unsure"] and not listed["sure"]
    with pytest.raises(SystemExit) as ended:
        main(["calibrate", "estimate", str(tmp_path / "my.yaml"), "--view", "front", "--output", str(tmp_path / "out")])
    assert ended.value.code == 2 and "No such view" in capsys.readouterr().err
