"""Single measures against scenes whose answer is known by construction."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from worldline_core.calibration.calibration_doctor import camera_lags, intrinsics_sizes
from worldline_core.calibration.diagnosis import Explanation, bad_terms
from worldline_core.calibration.evidence import (
    finger_flow,
    image_terms,
    pose_terms,
    rms_hand_eye,
    still_view_agreement,
    stopped_share,
    wrist_flow_agreement,
)
from worldline_core.calibration.observation import Observation, Reading, observe, read
from worldline_core.data.episodes.conventions import RecordedConventions
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.geometry.cameras import project_points
from worldline_core.geometry.transforms import rigid_inverse

COUNT, HEIGHT, WIDTH = 30, 64, 96
K = np.array([[80.0, 0, 47.5], [0, 80.0, 31.5], [0, 0, 1]])
MOUNT = np.eye(4)
MOUNT[:3, 3] = [0.0, -0.05, -0.15]
HEAD = np.eye(4)
HEAD[:3, :3], HEAD[:3, 3] = np.diag([1.0, -1.0, -1.0]), [0.4, 0.0, 1.2]


def tools() -> np.ndarray:
    time = np.arange(COUNT) / 6
    poses = np.tile(np.eye(4), (COUNT, 1, 1, 1))
    turn = np.stack([np.pi + 0.25 * np.sin(time), 0.2 * np.cos(1.4 * time), 0.3 * np.sin(0.8 * time)], 1)
    poses[:, 0, :3, :3] = Rotation.from_euler("xyz", turn).as_matrix()
    poses[:, 0, :3, 3] = np.stack([0.4 + 0.15 * np.sin(time), 0.15 * np.sin(1.7 * time), 0.3 + 0.04 * np.cos(time)], 1)
    return poses


def episode(opening: np.ndarray | None = None) -> Episode:
    grip = np.full((COUNT, 1), 0.5) if opening is None else opening[:, None]
    track = tools()
    return Episode(
        episode_id="e", source="s", embodiment="none", scene="s", task_family="lift", instruction="",
        outcome="unknown", split="test", fps=8.0, state=grip.astype(np.float32), action=grip.astype(np.float32),
        timestamps=np.arange(COUNT) / 8, T_base_ee=track, gripper=grip, state_names=("right/gripper",),
        state_kind="ee_pose", cameras={
            "head": CameraTrack("head", K, HEAD[None], WIDTH, HEIGHT),
            "right_wrist": CameraTrack("right_wrist", K, track[:, 0] @ MOUNT, WIDTH, HEIGHT),
        },
    )  # fmt: skip


def seen_as(recording: Episode, pictures: dict[str, np.ndarray], **mistake: object) -> tuple[Observation, Reading]:
    observation = observe(recording, pictures, None)
    reading = read(observation, RecordedConventions.model_validate(mistake))
    assert reading is not None
    return observation, reading


def texture(height: int, width: int, coarseness: int = 8) -> np.ndarray:
    values = np.random.default_rng(4).uniform(30, 220, (height // coarseness + 1, width // coarseness + 1))
    return cv2.resize(values.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC).clip(0, 255)


def head_pictures(lag: int = 0) -> np.ndarray:
    """A textured patch that moves with the projected tool over a plain table; `lag`: shows what was then."""
    patch = texture(22, 22, 4)
    frames = []
    for i in range(COUNT):
        pose = tools()[max(0, i - lag), 0]
        uv, _ = project_points(pose[None, :3, 3] - 0.07 * pose[None, :3, 2], K, HEAD[None])
        shift = np.array([[1, 0, uv[0, 0] - 10.5], [0, 1, uv[0, 1] - 10.5]])
        frame = np.full((HEIGHT, WIDTH), 120.0, np.float32)
        cv2.warpAffine(patch, shift, (WIDTH, HEIGHT), dst=frame, borderMode=cv2.BORDER_TRANSPARENT)
        frames.append(frame)
    return np.stack(frames).astype(np.uint8)


def wrist_pictures() -> np.ndarray:
    """What a wrist camera sees of a textured table at z = 0: the exact homography of the plane."""
    table = texture(400, 400, 16)
    T_px_m = np.array([[200.0, 0, 120], [0, 200.0, 200], [0, 0, 1]])  # table metres to texture pixels
    frames = []
    for pose in tools()[:, 0] @ MOUNT:
        T = rigid_inverse(pose)
        table_to_image = K @ np.stack([T[:3, 0], T[:3, 1], T[:3, 3]], axis=1)
        frames.append(cv2.warpPerspective(table, table_to_image @ np.linalg.inv(T_px_m), (WIDTH, HEIGHT)))
    return np.stack(frames).astype(np.uint8)


@pytest.fixture(scope="module")
def seen() -> dict[str, np.ndarray]:
    return {"head": head_pictures(), "right_wrist": wrist_pictures()}


def test_flow_of_the_tool_agrees_with_a_right_camera_only(seen: dict[str, np.ndarray]) -> None:
    flow, change, turn = still_view_agreement(*seen_as(episode(), seen), "head")
    assert flow > 0.85
    assert change > 0.4
    assert abs(turn) < 8
    angle = np.radians(40)
    roll = np.eye(4)
    roll[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    # The camera turned about its axis by 40 degrees, and the tool by as much about the same axis: the patch stays where
    # it is predicted while its motion is turned.
    rolled = replace(episode().cameras["head"], T_base_camera=(HEAD @ roll)[None])
    other = seen_as(replace(episode(), cameras={"head": rolled}), {"head": seen["head"]})
    rolled_flow, _, rolled_turn = still_view_agreement(*other, "head")
    assert rolled_flow < flow - 0.1
    assert abs(abs(rolled_turn) - 40) < 12
    mirrored = seen_as(episode(), seen, camera_axes="opengl", views=("head",))
    assert still_view_agreement(*mirrored, "head") == (0.0, 0.0, 0.0)  # the tool is behind the camera


def test_a_motion_of_few_cells_vetoes_nothing(seen: dict[str, np.ndarray]) -> None:
    """A wrong camera is bad by the motion of many cells; by that of a few steps it is no more than suspicious."""
    other = texture(COUNT * HEIGHT, WIDTH, 4).reshape(COUNT, HEIGHT, WIDTH).astype(np.uint8)
    shown = seen["head"].copy()
    for first, bad in ((2, True), (COUNT - 1, False)):
        pictures = np.where(np.arange(COUNT)[:, None, None] < first, shown[:1], other)
        terms = image_terms(*seen_as(episode(), {"head": pictures}))
        assert bool(bad_terms(Explanation(RecordedConventions(), 0.0, terms))) == bad


@pytest.mark.parametrize("lag", [0, 2])
def test_the_lag_of_pictures_is_where_flow_agrees_best(lag: int) -> None:
    observation, recorded = seen_as(episode(), {"head": head_pictures(lag)})
    found = {k: still_view_agreement(observation, recorded.with_image_lag(k), "head")[0] for k in range(-3, 4)}
    assert max(found, key=lambda k: found[k]) == lag


def test_background_flow_of_a_wrist_camera_tells_its_axes(seen: dict[str, np.ndarray]) -> None:
    right, opengl, inverse = (
        wrist_flow_agreement(*seen_as(episode(), seen, **mistake), "right_wrist")
        for mistake in ({}, {"camera_axes": "opengl"}, {"extrinsics": "base_to_camera"})
    )
    assert right > 0.9
    assert max(opengl, inverse) < right - 0.05
    assert opengl < 0.5


def finger_pictures(opening: np.ndarray, still: CameraTrack) -> np.ndarray:
    """Two bars at the projected tool point that part as the opening grows."""
    point = np.linalg.inv(MOUNT)[:3, 3]
    u, v = (still.K @ (point / point[2]))[:2]
    frames = []
    for value in opening:
        frame = np.full((HEIGHT, WIDTH), 90, np.uint8)
        for side in (-1, 1):
            x = u + side * (4 + 14 * value)
            corners = ((round(16 * (x + 3 * i)), round(16 * (v + 12 * i))) for i in (-1, 1))
            cv2.rectangle(frame, *corners, 220, -1, shift=4)
        frames.append(frame)
    return np.stack(frames)


def test_fingers_that_part_mean_opening() -> None:
    opening = 0.5 + 0.5 * np.sin(np.arange(COUNT) / 4)
    recording = episode(opening)
    pictures = {"right_wrist": finger_pictures(opening, recording.cameras["right_wrist"])}
    right = finger_flow(*seen_as(recording, pictures), 0)
    assert right is not None
    assert right > 0.6
    assert finger_flow(*seen_as(recording, pictures, gripper="inverted"), 0) == pytest.approx(-right)
    assert finger_flow(*seen_as(episode(), pictures), 0) is None


def test_an_object_stops_a_closing_gripper_never_an_opening_one() -> None:
    command = np.where(np.arange(COUNT) < 10, 1.0, 0.0)
    opening = np.where(np.arange(COUNT) < 10, 1.0, 0.6)
    recording = replace(episode(opening), action=command[:, None].astype(np.float32))
    assert stopped_share(seen_as(recording, {})[1], 0) == 1.0
    assert stopped_share(seen_as(recording, {}, gripper="inverted")[1], 0) == 0.0
    assert stopped_share(seen_as(episode(opening), {})[1], 0) is None


def test_lag_of_camera_poses() -> None:
    recording = episode()
    wrist = recording.cameras["right_wrist"]
    late = wrist.T_base_camera[np.maximum(np.arange(COUNT) - 3, 0)]
    cameras = {"right_wrist": replace(wrist, T_base_camera=late)}
    observation, reading = seen_as(replace(recording, cameras=cameras), {})
    assert camera_lags(observation, reading)[0] == 3
    mount, metres, degrees = rms_hand_eye(reading.tools[:-3, 0], late[3:])
    assert np.allclose(mount, MOUNT, atol=1e-9)
    assert (metres, degrees) == pytest.approx((0.0, 0.0), abs=1e-4)


def test_sizes_that_put_the_principal_point_into_the_middle() -> None:
    camera = CameraTrack("head", K, HEAD[None], WIDTH, HEIGHT)
    assert intrinsics_sizes({"head": camera}) == []
    vga = replace(camera, K=camera.resized(640, 480).K)
    assert intrinsics_sizes({"head": vga, "other": vga}) == [(480, 640)]
    # A principal point somewhat off the middle is a camera's own.
    off = K.copy()
    off[:2, 2] += 1.5
    assert intrinsics_sizes({"head": replace(camera, K=off)}) == []
    odd = replace(camera, K=camera.resized(211, 170).K)
    assert intrinsics_sizes({"head": odd}) == [(170, 211)]


def test_pose_terms_blame_the_right_thing() -> None:
    def terms(**mistake: object) -> dict[str, float]:
        return pose_terms(*seen_as(episode(), {}, **mistake))

    assert min(terms().values()) > -0.5
    assert terms(pose_unit="mm")["hand-eye right_wrist"] < -30
    assert terms(extrinsics_unit="mm")["camera place head"] > -0.1  # a thousandth is near the base: nothing odd there
    assert terms(camera_axes="opengl")["faces its tool right_wrist"] == -15.0
    assert terms(camera_axes="opengl")["hand-eye right_wrist"] > -0.1  # still rigid: only the view direction tells
    assert terms(intrinsics_size=(480, 640))["intrinsics head"] < -20
    assert terms(extrinsics="base_to_camera")["hand-eye right_wrist"] < -20
    scaled = tools()
    scaled[..., :3, 3] *= 1000
    assert pose_terms(*seen_as(replace(episode(), T_base_ee=scaled), {}))["workspace"] == -40.0
