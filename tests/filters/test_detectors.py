from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from worldline_core.filters import calibration, detectors
from worldline_core.filters import filter_config as configs
from worldline_core.filters.signals import picture_statistics, range_speed
from worldline_core.filters.verdict import Verdict, long_runs, runs
from worldline_core.geometry.cameras import MIN_DEPTH_M, inside_image, project_points
from worldline_core.geometry.transforms import hand_eye_residual, rigid_inverse

FPS = 8.0


def swing(num_frames: int = 33) -> np.ndarray:
    """Joint positions (n, 3) of a smooth motion that begins and ends slowly."""
    time = np.arange(num_frames) / FPS
    return np.stack([0.6 * (1 - np.cos(time)), 0.4 * np.sin(1.3 * time), 0.2 * np.sin(0.7 * time) ** 2], axis=1)


def arm_poses(num_frames: int = 33) -> np.ndarray:
    time = np.arange(num_frames) / FPS
    poses = np.tile(np.eye(4), (num_frames, 1, 1))
    turn = np.stack([0.4 * np.sin(time), 0.3 * time, 0.2 * time**2 / 4], 1)
    poses[:, :3, :3] = Rotation.from_euler("xyz", turn).as_matrix()
    poses[:, :3, 3] = np.stack([0.4 + 0.15 * np.sin(time), 0.2 * np.cos(0.8 * time), 0.3 + 0.05 * np.sin(2 * time)], 1)
    return poses


MOUNT = np.eye(4)
MOUNT[:3, :3] = Rotation.from_euler("xyz", [0.3, -0.4, 0.2]).as_matrix()
MOUNT[:3, 3] = [0.05, 0.0, -0.1]
K = np.array([[80.0, 0, 47.5], [0, 80.0, 31.5], [0, 0, 1]])


def scene(
    num_frames: int = 33, height: int = 64, width: int = 96, *, drift: float = 0.0, centres: np.ndarray | None = None
) -> np.ndarray:
    """uint8 (n, h, w): a textured table, drifting by `drift` px a frame, with a bright disc at centres (n, 2)."""
    rng = np.random.default_rng(0)
    coarse = rng.uniform(60, 180, (height // 8 + 2, (width + int(drift * num_frames)) // 8 + 3))
    big = np.kron(coarse, np.ones((8, 8)))
    rows, columns = np.mgrid[:height, :width]
    frames = []
    for i in range(num_frames):
        shift = drift * i
        left, share = int(shift), shift - int(shift)
        picture = (1 - share) * big[:height, left : left + width] + share * big[:height, left + 1 : left + 1 + width]
        if centres is not None:
            u, v = centres[i]
            picture = np.where((columns - u) ** 2 + (rows - v) ** 2 < 25, 250, picture)
        frames.append(picture)
    return np.stack(frames).astype(np.uint8)


NOTHING = np.zeros(33, bool)
TABLE = scene()
DISC = scene(centres=np.stack([20 + 1.5 * np.arange(33), np.full(33, 30.0)], axis=1))


def cut(verdict: Verdict) -> list[int]:
    assert verdict.bad_frames is not None
    return np.flatnonzero(verdict.bad_frames).tolist()


def test_runs() -> None:
    marks = np.array([1, 1, 0, 1, 0, 0, 1], bool)
    assert runs(marks) == [(0, 2), (3, 4), (6, 7)]
    assert runs(long_runs(marks, 3, gap=1)) == [(0, 4)]
    assert not long_runs(np.array([0, 1, 1, 0], bool), 3, gap=1).any()  # an edge is no gap


def test_static_stretches_are_found_and_short_pauses_left() -> None:
    joints = np.concatenate([np.repeat(swing()[:1], 16, 0), swing(), np.repeat(swing()[-1:], 7, 0)])
    joints += np.random.default_rng(0).normal(0, 0.0015, (56, 3))
    assert np.abs(np.diff(joints, axis=0)).max(axis=1)[:15].max() * FPS > 0.03  # neighbours would say: moving
    speed, zeros = range_speed(joints, FPS), np.zeros(56)
    change = np.where(speed < 0.03, 0.0, 3.0)
    change[:16] = 0.0

    def judged(*signals: np.ndarray) -> Verdict:
        return detectors.detect_static(*signals, FPS, configs.StaticConfig())

    found = cut(judged(speed, zeros, change))
    assert 14 <= found[-1] <= 17  # the pause of 7 frames at the end is shorter than 1.5 s
    assert found == list(range(found[-1] + 1))
    assert cut(judged(speed, zeros + 1.0, change)) == []  # a closing gripper is no rest
    assert cut(judged(speed, zeros, zeros + 2.0)) == []  # nor are things that move
    assert not judged(zeros, zeros, zeros).passed


def test_range_speed_is_that_of_the_fastest_column() -> None:
    time = np.arange(30)[:, None] / 10.0
    speed = range_speed(np.concatenate([0.2 * time, -0.5 * time], axis=1), 10.0)
    assert np.allclose(speed[3:-3], 0.5)
    assert range_speed(np.zeros((5, 0)), 10.0).tolist() == [0.0] * 5


def resets(joints: np.ndarray) -> list[int]:
    return cut(detectors.detect_reset(joints, FPS, configs.ResetConfig()))


def jumps(joints: np.ndarray) -> list[int]:
    return cut(detectors.detect_joint_jump(joints, configs.JointMotionConfig()))


@pytest.mark.parametrize("steps", [1, 3, 5])
def test_a_quick_way_home_is_a_reset_and_motion_is_not(steps: int) -> None:
    joints = swing()
    back = np.linspace(joints[-1], joints[0], steps + 1)[1:-1]
    home = np.concatenate([joints, back, joints[:16]])
    assert resets(home) == list(range(33, len(home)))
    away = joints + 1.5  # a jump, but not home
    for motion in (joints, np.concatenate([joints, joints[::-1]]), np.concatenate([joints, away]), joints[:1]):
        assert resets(motion) == []
    one_joint = np.concatenate([joints[:, :1], joints[:, :1]])  # nothing else could come home with it
    assert resets(one_joint)[0] == 33


@pytest.mark.parametrize(
    ("arms", "frames", "joints", "off", "jumped"),
    [
        (1, slice(20, None), slice(0, 1), 0.0, {20}),
        (2, slice(20, 23), slice(None), 0.0, {20, 21, 22, 23}),
        (2, slice(20, 30), slice(0, 2), 2.0, set(range(20, 31))),
    ],
)
def test_readings_that_break_are_jumps_and_no_reset(arms, frames, joints, off, jumped):
    broken = np.concatenate([swing(), 0.7 * swing()], axis=1)[:, : 3 * arms]
    broken[frames, joints] = broken[0, joints] + off
    assert resets(broken) == []
    assert set() < set(jumps(broken)) <= jumped


def test_two_readings_that_break_together_while_the_arm_rests_are_no_reset() -> None:
    rest = np.full((40, 6), 0.2) + np.random.default_rng(0).normal(0, 1e-3, (40, 6))
    broken, dead = rest.copy(), rest.copy()
    broken[12:30, [1, 3]] += 1.1  # away, and back after more than a second
    dead[:, [1, 3]] += np.clip(np.arange(40) / 10, 0, 1)[:, None]  # two joints move, and then read as at the start
    commands = dead.copy()
    dead[25:, [1, 3]] = rest[0, [1, 3]]
    for values, wanted, jumped in (
        (broken, rest, list(range(12, 31))), (broken, None, list(range(12, 31))), (dead, commands, [25]),
    ):  # fmt: skip
        assert cut(detectors.detect_reset(values, FPS, configs.ResetConfig(), wanted)) == []
        assert jumps(values) == jumped
    for home in (None, dead):  # the commands go home as well, or are unknown
        assert cut(detectors.detect_reset(dead, FPS, configs.ResetConfig(), home))[0] == 25


def test_joint_readings_that_jump_run_away_or_ignore_their_commands() -> None:
    config, joints = configs.JointMotionConfig(), 1.5 * swing()
    spike, slipped, fast, stuck, idle = (joints.copy() for _ in range(5))
    spike[10:12, 1] += 0.7
    slipped[20:, 0] -= 0.5
    fast[:, 2] += np.clip(np.arange(33) - 8, 0, 6) * 1.2
    for values, jumped, ran in (
        (joints, [], []), (spike, [10, 11, 12], []), (slipped, [20], []), (fast, [], list(range(9, 15))),
    ):  # fmt: skip
        assert jumps(values) == jumped
        assert cut(detectors.detect_joint_speed(values, FPS, config)) == ran
    stuck[15:, 0] = joints[15, 0]
    idle[:, 1] = 0.4
    for values, commands, bad in ((stuck, joints, list(range(16, 33))), (joints, joints, []), (idle, idle, [])):
        assert cut(detectors.detect_joint_stuck(values, commands, FPS, config)) == bad


def test_picture_statistics_are_what_numpy_says() -> None:
    found = picture_statistics(DISC)
    value = DISC.astype(np.float64)
    assert np.allclose(found.mean, value.mean(axis=(1, 2)))
    assert np.allclose(found.contrast, value.std(axis=(1, 2)))
    assert np.abs(found.bright_level - np.percentile(value.reshape(33, -1), 95, axis=1)).max() <= 1
    across = (np.diff(value, axis=2) ** 2).mean(axis=(1, 2))
    down = (np.diff(value, axis=1) ** 2).mean(axis=(1, 2))
    assert np.allclose(found.detail, across + down)
    assert np.allclose(found.roughness, np.maximum(across, down) / (2 * value.var(axis=(1, 2))))
    change = np.abs(np.diff(value, axis=0)).mean(axis=(1, 2))
    assert np.allclose(found.change, np.concatenate([[0.0], change]))
    assert (found.flat_share == 0).all()
    half = DISC.copy()
    half[:, 32:] = 128
    assert np.allclose(picture_statistics(half).flat_share, 0.5)


TRACKS = 0.02 * np.arange(33.0)[:, None, None] * np.array([1.0, 0, 0])
REST = np.zeros((33, 1, 3))


def corrupted(gray: np.ndarray, tracks: np.ndarray = REST, **changes: Any) -> Verdict:
    given = {"lost": NOTHING, "unreliable": NOTHING, "fps": FPS, "config": configs.CorruptedConfig()} | changes
    return detectors.detect_corrupted(picture_statistics(gray), tracks, **given)


@pytest.mark.parametrize("defect", ["blank", "noise", "frozen", "blocks", "band"])
def test_corrupted_frames(defect: str) -> None:
    assert corrupted(DISC, TRACKS).clean
    bad, random = DISC.copy(), np.random.default_rng(1)
    if defect == "blank":
        bad[10:14] = 130
    elif defect == "noise":
        bad[10:14] = random.integers(0, 255, bad[10:14].shape)
    elif defect == "frozen":
        bad[10:14] = bad[9]
    elif defect == "band":
        bad[10:14, 30:] = 128
    else:
        for i in range(10, 14):
            for _ in range(30):
                row, column = random.integers(0, 56), random.integers(0, 88)
                bad[i, row : row + 8, column : column + 8] = 255 - bad[i, row : row + 8, column : column + 8]
    verdict = corrupted(bad, TRACKS)
    assert (cut(verdict), verdict.passed) == ([10, 11, 12, 13], True)
    assert verdict.numbers["garbled_frames" if defect in ("blocks", "band") else f"{defect}_frames"] == 4
    if defect == "frozen":
        for tracks in (random.normal(0, 0.005, (33, 1, 3)), REST):
            assert cut(corrupted(bad, tracks)) == []
        for unsure in ({"unreliable": np.arange(33) == 12}, {"wrist": True}):
            assert cut(corrupted(bad, TRACKS, **unsure)) == []


def test_dark_and_overexposed_pictures_are_not_counted_twice() -> None:
    config = configs.ExposureConfig()
    pictures = picture_statistics(TABLE)
    assert detectors.detect_dark(pictures, NOTHING, config).clean
    assert detectors.detect_overexposed(pictures, config).clean
    gray, lost = TABLE.copy(), np.isin(np.arange(33), [4, 5, 6, 7, 20, 21, 22])
    gray[4:8] = gray[4:8] // 12
    gray[10:14] = np.random.default_rng(0).integers(0, 30, gray[10:14].shape)  # noise is noise, however dark
    gray[20:23] = np.clip(gray[20:23].astype(int) * 3, 0, 255)
    pictures = picture_statistics(gray)
    noise = detectors.without_signal(pictures, configs.CorruptedConfig())[1]
    assert cut(detectors.detect_dark(pictures, noise, config)) == [4, 5, 6, 7]
    assert cut(detectors.detect_overexposed(pictures, config)) == [20, 21, 22]
    verdict = corrupted(gray, lost=lost)
    assert (cut(verdict), verdict.numbers["noise_frames"]) == ([10, 11, 12, 13], 4)
    gray[:30] = 0
    assert not detectors.detect_dark(picture_statistics(gray), NOTHING, config).passed
    # A thing in the gripper may cover a wrist camera.
    covered = picture_statistics(np.full((9, 64, 96), 20, np.uint8))
    assert detectors.detect_dark(covered, np.zeros(9, bool), config, wrist=True).clean


def test_blurred_stretches_are_found_whatever_is_seen() -> None:
    sharpness = np.repeat(np.random.default_rng(0).uniform(300, 900, 17), 2)[:33]  # what is seen changes
    pictures = replace(picture_statistics(TABLE), detail=sharpness / 100)

    def judged(values: np.ndarray, lost: np.ndarray = NOTHING) -> Verdict:
        return detectors.detect_blur(values, pictures, lost, FPS, configs.BlurConfig())

    blurred = np.where((np.arange(33) >= 10) & (np.arange(33) < 16), 0.1, 1.0) * sharpness
    assert judged(sharpness).clean
    assert cut(judged(blurred)) == list(range(10, 16))
    assert judged(blurred, np.arange(33) < 16).clean
    assert not judged(np.full(33, 5.0)).passed  # never in focus


def test_a_driving_base_moves_the_whole_picture_an_arm_or_a_lamp_does_not() -> None:
    config = configs.BaseMotionConfig()
    centres = np.stack([10 + 2.0 * np.arange(33), 30 + 8 * np.sin(np.arange(33))], axis=1)

    def judged(gray: np.ndarray, *, usable: bool = True) -> Verdict:
        area = detectors.changed_area(gray, np.full(len(gray), usable), FPS, config)
        return detectors.detect_base_motion(area, FPS, config)

    lamp = np.concatenate([TABLE[:16], (TABLE[:17] * 1.3).clip(0, 255).astype(np.uint8)])
    for healthy in (scene(centres=centres), lamp, TABLE[:3]):
        assert judged(healthy).clean
    for drift in (1.0, 2.5):
        assert not judged(scene(drift=drift, centres=centres)).passed
    assert judged(scene(drift=2.5), usable=False).clean


def test_wrist_cameras_are_rigidly_mounted_or_condemned() -> None:
    tool, other_mount = arm_poses(), MOUNT.copy()
    camera = tool @ MOUNT
    found, metres, degrees = hand_eye_residual(tool, camera)
    assert np.abs(found - MOUNT).max() < 1e-9
    assert (metres.max(), degrees.max()) == pytest.approx((0.0, 0.0), abs=1e-4)
    other_mount[:3, 3] += [0.0, 0.2, 0.0]
    jitter = camera.copy()
    jitter[:, :3, 3] += np.random.default_rng(0).normal(scale=0.004, size=(33, 3))
    for poses, mount, passed in (
        (camera, MOUNT, True),
        (rigid_inverse(camera), MOUNT, False),
        (camera, other_mount, False),
        (jitter, None, True),  # millimetres are what real recordings have
    ):
        assert calibration.detect_hand_eye(tool, poses, mount, configs.CalibrationConfig()).passed is passed


def test_camera_values() -> None:
    config, pose = configs.CalibrationConfig(), np.eye(4)
    assert calibration.detect_camera(K, pose[None], 96, 64, config).passed
    larger = np.diag([640 / 96, 480 / 64, 1.0]) @ K
    for bad in (larger, np.zeros((3, 3)), np.full((3, 3), np.nan), np.diag([80.0, -80.0, 1.0])):
        assert not calibration.detect_camera(bad, pose[None], 96, 64, config).passed
    for diagonal in ([1.0, 1.0, -1.0, 1.0], [1.01, 1.01, 1.01, 1.0]):  # mirrored, scaled
        assert not calibration.detect_camera(K, np.diag(diagonal)[None], 96, 64, config).passed
    assert calibration.detect_fixed_camera(pose[None].repeat(9, 0), config).passed
    assert not calibration.detect_fixed_camera(arm_poses(), config).passed


@pytest.mark.parametrize("lag", [-4, 0, 3])
def test_the_lag_of_the_images_is_measured(lag: int) -> None:
    rng = np.random.default_rng(lag + 10)
    signal = np.abs(np.convolve(rng.normal(size=80), np.ones(4) / 4, mode="same"))
    motion = signal[20:60, None]
    change = signal[20 - lag : 60 - lag, None] * 30 + rng.uniform(0, 0.5, (40, 1))
    measured, best, _ = calibration.lag_by_correlation(motion, change, 6)
    assert abs(measured - lag) < 0.5
    assert best > 0.9
    assert calibration.detect_image_lag(motion, change, FPS, configs.TimeAlignmentConfig()).passed == (lag == 0)


def test_images_without_relation_to_the_motion_prove_no_lag() -> None:
    change, *motions = *np.random.default_rng(5).uniform(size=(2, 32, 2)), np.zeros((32, 2))
    for motion in motions:
        assert calibration.detect_image_lag(motion, change, FPS, configs.TimeAlignmentConfig()).passed


def test_camera_poses_that_lag_are_found_and_wrong_ones_are_not_called_late() -> None:
    config, tool = configs.TimeAlignmentConfig(), arm_poses(60)
    camera = tool @ MOUNT
    assert calibration.detect_pose_lag(tool, camera, FPS, config).passed
    late = calibration.detect_pose_lag(tool[4:44], camera[:40], FPS, config)
    assert (late.passed, late.numbers["pose_lag_s"]) == (False, pytest.approx(0.5))
    assert calibration.detect_pose_lag(tool, rigid_inverse(camera), FPS, config).passed


def projected(gray: np.ndarray, uv: np.ndarray, inside: np.ndarray | None = None, **config: Any) -> Verdict:
    inside = np.ones((len(uv), 1), bool) if inside is None else inside[:, None]
    return calibration.detect_projection(gray, uv[:, None], inside, configs.ProjectionConfig(**config))


def test_a_tool_among_much_motion_is_found_by_rank() -> None:
    uv = np.stack([30 + 2.0 * np.arange(20), np.full(20, 40.0)], axis=1)
    gray = np.zeros((20, 64, 96))
    # All of the lower half flickers, next to the tool half as much again: no place can change twice as much as the mean.
    gray[:, 24:] = 100 + np.random.default_rng(0).uniform(-20, 20, (20, 40, 96))
    rows, columns = np.mgrid[:64, :96]
    for frame, (u, v) in zip(gray, uv, strict=True):
        near = np.hypot(columns - u, rows - v) < 9
        frame[near] = 100 + 1.5 * (frame[near] - 100)
    found = projected(gray.astype(np.uint8), uv, min_contrast=2.5)
    assert found.passed
    assert found.numbers["motion_contrast"] < 2.5  # type: ignore[operator]
    assert not projected(gray.astype(np.uint8), uv - [0, 30], min_contrast=2.5).passed


def test_motion_must_be_where_the_tool_is_projected() -> None:
    T = np.diag([1.0, -1.0, -1.0, 1.0])  # looks down -z of the base
    T[:3, 3] = [0.4, 0.0, 1.2]
    tool = np.stack([0.1 + 0.018 * np.arange(33), 0.15 * np.sin(np.arange(33) / 3), np.full(33, 0.3)], axis=1)
    uv, depth = project_points(tool, K, T[None].repeat(33, 0))
    gray, inside = scene(centres=uv), (depth > MIN_DEPTH_M) & inside_image(uv, (64, 96))
    right = projected(gray, uv, inside)
    assert right.passed
    assert right.numbers["motion_contrast"] > 3  # type: ignore[operator]
    shifted = uv + np.array([0.0, 25.0])
    assert not projected(gray, shifted, inside_image(shifted, (64, 96))).passed
    assert not projected(gray, uv + 500, NOTHING).passed
    resting = np.repeat(uv[:1], 33, 0)
    unproven = projected(scene(centres=resting), resting, inside[:1].repeat(33))
    assert (unproven.passed, unproven.numbers["motion_contrast"]) == (True, None)
