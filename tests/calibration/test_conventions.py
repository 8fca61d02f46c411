"""Declared conventions: undoing one gives the contract back, and a lag keeps states, cameras and images together."""

from __future__ import annotations

from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from tools.corrupted.conventions import corrupt, corrupted_image_frames
from worldline_core.data.episodes.conventions import (
    RecordedConventions,
    along_tool_z,
    apply_conventions,
    image_frames,
    with_image_lags,
)
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.episodes.source import LoadedEpisode
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.sources.open import repair
from worldline_core.errors import ConfigError

COUNT = 12
K = np.array([[80.0, 0, 47.5], [0, 80.0, 31.5], [0, 0, 1]])


def random_poses(rng: np.random.Generator, *shape: int) -> np.ndarray:
    poses = np.tile(np.eye(4), (*shape, 1, 1))
    poses[..., :3, :3] = Rotation.random(int(np.prod(shape)), random_state=rng).as_matrix().reshape(*shape, 3, 3)
    poses[..., :3, 3] = rng.normal(size=(*shape, 3))
    return poses


def two_arms(seed: int = 0, **changes: Any) -> Episode:
    """Tool poses of two arms, three cameras; nothing in it is symmetric."""
    rng = np.random.default_rng(seed)
    tools = random_poses(rng, COUNT, 2)
    opening = rng.uniform(size=(COUNT, 2))
    quaternions = Rotation.from_matrix(tools[..., :3, :3].reshape(-1, 3, 3)).as_quat().reshape(COUNT, 2, 4)
    state = np.concatenate([tools[..., :3, 3], quaternions, opening[..., None]], axis=-1).reshape(COUNT, 16)
    cameras = {
        "head": CameraTrack("head", K, random_poses(rng, 1), 96, 64),
        "left_wrist": CameraTrack("left_wrist", K, random_poses(rng, COUNT), 96, 64),
        "right_wrist": CameraTrack("right_wrist", K, random_poses(rng, COUNT), 96, 64),
    }
    names = tuple(f"{a}/{n}" for a in ("left", "right") for n in ("x", "y", "z", "qx", "qy", "qz", "qw", "gripper"))
    values: dict[str, Any] = {
        "episode_id": "e", "source": "s", "embodiment": "none", "scene": "s", "task_family": "lift", "instruction": "",
        "outcome": "unknown", "split": "test", "fps": 10.0, "state": state.astype(np.float32),
        "action": (state + 0.01).astype(np.float32), "timestamps": np.arange(COUNT) / 10.0, "cameras": cameras,
        "T_base_ee": tools, "gripper": opening, "state_names": names, "state_kind": "ee_pose",
    }  # fmt: skip
    return Episode(**(values | changes))


def unit_quaternions(state: np.ndarray) -> np.ndarray:
    """The state with quaternions of unit length and w >= 0, as a rotation matrix gives them back; the action's are not."""
    result = state.astype(np.float64)
    for start in (3, 11):
        quaternion = result[:, start : start + 4]
        quaternion *= np.sign(quaternion[:, 3:]) / np.linalg.norm(quaternion, axis=1, keepdims=True)
    return result


def assert_same(found: Episode, wanted: Episode) -> None:
    assert found.num_frames == wanted.num_frames
    prepare = unit_quaternions if wanted.state_kind == "ee_pose" else np.asarray
    assert np.allclose(prepare(found.state), prepare(wanted.state), atol=2e-6)
    assert np.allclose(prepare(found.action), prepare(wanted.action), atol=2e-6)
    for name in ("T_base_ee", "gripper"):
        a, b = getattr(found, name), getattr(wanted, name)
        assert (a is None) == (b is None)
        assert a is None or np.allclose(a, b, atol=1e-9)
    for view, camera in wanted.cameras.items():
        assert np.allclose(found.cameras[view].K, camera.K, atol=1e-9)
        assert np.allclose(found.cameras[view].T_base_camera, camera.T_base_camera, atol=1e-9)


MISTAKES: list[dict[str, Any]] = [
    {"extrinsics": "base_to_camera"}, {"camera_axes": "opengl"}, {"extrinsics_unit": "mm"}, {"pose_unit": "mm"},
    {"quaternion": "wxyz"}, {"euler": "moving_xyz"}, {"arms": "exchanged"}, {"tool_offset_z_m": 0.12},
    {"intrinsics_size": (480, 640)}, {"gripper": "inverted"},
]  # fmt: skip
MISTAKES += [
    dict(chain(*(mistake.items() for mistake in MISTAKES))),
    {"extrinsics": "base_to_camera", "views": ("head",)},
]


def test_degrees_of_joints() -> None:
    episode = replace(two_arms(), state_kind="joints", T_base_ee=None, gripper=None)
    conventions = RecordedConventions(angle_unit="deg")
    spoiled = corrupt(episode, conventions)
    assert np.allclose(spoiled.state[:, 3], np.degrees(episode.state[:, 3]))
    assert np.array_equal(spoiled.state[:, 7], episode.state[:, 7])  # an opening is no angle
    assert_same(apply_conventions(spoiled, conventions), episode)


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: "+".join(mistake))
@pytest.mark.parametrize("source_offset", [0.0, 0.23])
def test_a_mistake_is_undone_and_changes_something(mistake: dict[str, Any], source_offset: float) -> None:
    conventions = RecordedConventions(**mistake)
    episode = two_arms(conventions={"tool_offset_m": source_offset} if source_offset else {})
    spoiled = corrupt(episode, conventions)
    repaired = apply_conventions(spoiled, conventions)
    assert_same(repaired, episode)
    with pytest.raises(AssertionError):
        assert_same(spoiled, episode)
    # Tensors refuse an array that is read backwards, such as exchanged arms.
    assert torch.from_numpy(repaired.T_base_ee).shape == (*torch.from_numpy(repaired.gripper).shape, 4, 4)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10_000))
def test_reordered_quaternions_and_angles_against_scipy(seed: int) -> None:
    episode = two_arms(seed)
    rotation = Rotation.from_matrix(episode.T_base_ee[..., :3, :3].reshape(-1, 3, 3))
    x, y, z, w = rotation.as_quat().T
    read = Rotation.from_quat(np.stack([w, x, y, z], axis=1))  # written w x y z, read as x y z w
    spoiled = corrupt(episode, RecordedConventions(quaternion="wxyz")).T_base_ee
    assert np.allclose(spoiled[..., :3, :3].reshape(-1, 3, 3), read.as_matrix(), atol=1e-9)
    angles = rotation.as_euler("XYZ")
    turned = corrupt(episode, RecordedConventions(euler="moving_xyz")).T_base_ee
    expected = Rotation.from_euler("xyz", angles).as_matrix()
    assert np.allclose(turned[..., :3, :3].reshape(-1, 3, 3), expected, atol=1e-7)


def test_the_offset_that_a_reader_added_goes_along_the_true_axis() -> None:
    """A reader that misread the rotation moved the tool along a wrong z: the repaired pose has it along the true one."""
    flange = two_arms().T_base_ee
    misread = corrupt(two_arms(), RecordedConventions(quaternion="wxyz")).T_base_ee
    read = two_arms(T_base_ee=along_tool_z(misread, 0.2), conventions={"tool_offset_m": 0.2})
    repaired = apply_conventions(read, RecordedConventions(quaternion="wxyz")).T_base_ee
    assert np.allclose(repaired[..., :3, 3], flange[..., :3, 3] + 0.2 * flange[..., :3, 2], atol=1e-9)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(camera_lag=st.integers(-2, 2), image_lag=st.integers(-3, 3), video_frames=st.sampled_from([None, 5]))
def test_lags_keep_states_cameras_and_images_together(camera_lag, image_lag, video_frames):
    conventions = RecordedConventions(camera_lag_frames=camera_lag, image_lag_frames=image_lag)
    marks = np.arange(COUNT, dtype=np.float32)
    healthy, poses = two_arms(), np.tile(np.eye(4), (COUNT, 1, 1))
    state = healthy.state.copy()
    state[:, 0] = poses[:, 0, 3] = marks
    cameras = {"left_wrist": replace(healthy.cameras["left_wrist"], T_base_camera=poses)}
    healthy = replace(healthy, state=state, cameras=cameras, video_frames=video_frames)
    images = marks[: healthy.num_video_frames]
    spoiled = corrupt(healthy, conventions)
    spoiled_images = images[corrupted_image_frames(COUNT, conventions, "head")]
    both = min(len(spoiled_images), spoiled.num_frames)
    offset = spoiled.state[:, 0] - spoiled.cameras["left_wrist"].T_base_camera[:, 0, 3]
    assert (offset == camera_lag).all()
    assert (spoiled.state[:both, 0] - spoiled_images[:both] == image_lag).all()
    repaired = apply_conventions(spoiled, conventions)
    kept = spoiled_images[image_frames(spoiled.num_frames, conventions, "head")]
    assert repaired.num_video_frames == len(kept)
    assert np.array_equal(repaired.state[:, 0], repaired.cameras["left_wrist"].T_base_camera[:, 0, 3])
    assert np.array_equal(repaired.state[: len(kept), 0], kept)


def test_repair_of_a_loaded_episode_takes_images_and_masks_along() -> None:
    images = np.arange(COUNT, dtype=np.uint8)[:, None, None, None] * np.ones((1, 2, 2, 3), np.uint8)
    masks = images[..., 0] > 5
    loaded = LoadedEpisode(two_arms(), ("head",), lambda _: images, lambda _: masks)
    found = repair(loaded, RecordedConventions(image_lag_frames=2))
    assert found.episode.num_frames == COUNT - 2
    assert np.array_equal(found.frames("head"), images[2:])
    assert np.array_equal(found.robot_masks("head"), masks[2:])
    assert found.episode.conventions["declared_image_lag_frames"] == "2"
    assert repair(loaded, RecordedConventions()) is loaded
    short = LoadedEpisode(two_arms(), ("head",), lambda _: images[:-1])
    with pytest.raises(RejectedInputError, match="differ in length") as caught:
        repair(short, RecordedConventions(image_lag_frames=2)).frames("head")
    assert caught.value.reason == "length_mismatch"


@pytest.mark.parametrize(
    ("changes", "mistake", "reason", "needed"),
    [
        ({"T_base_ee": None, "gripper": None}, {"quaternion": "wxyz"}, "convention_not_applicable", "tool poses"),
        ({"T_base_ee": None, "gripper": None}, {"tool_offset_z_m": 0.1}, "convention_not_applicable", "tool poses"),
        ({"cameras": {}}, {"extrinsics": "base_to_camera"}, "convention_not_applicable", "camera"),
        ({}, {"angle_unit": "deg"}, "convention_not_applicable", "joint positions"),
        ({"state_names": None}, {"gripper": "inverted"}, "convention_not_applicable", "gripper"),
        ({"state_names": None}, {"arms": "exchanged"}, "convention_not_applicable", "two arms"),
        ({}, {"camera_lag_frames": 11}, "too_short", "fewer than two frames"),
    ],
)
def test_a_convention_that_cannot_be_applied_is_refused(changes, mistake, reason, needed):
    with pytest.raises(RejectedInputError, match=needed) as caught:
        apply_conventions(two_arms(**changes), RecordedConventions(**mistake))
    assert caught.value.reason == reason


def test_lines_are_what_a_configuration_reads() -> None:
    conventions = RecordedConventions(intrinsics_size=(480, 640), views=("head", "left_wrist"), camera_lag_frames=-2)
    lines = conventions.config_lines("conventions")
    assert all(line.startswith("conventions.") for line in lines)
    values = yaml.safe_load("\n".join(line.removeprefix("conventions.") for line in lines))
    assert RecordedConventions.model_validate(values) == conventions
    assert RecordedConventions(views=("head",)).config_lines() == ()
    for wrong, said in (({"intrinsics_size": (0, 640)}, "no image size"), ({"extrinsic": "base_to_camera"}, "extra")):
        with pytest.raises(ValidationError, match=said):
            RecordedConventions.model_validate(wrong)


@pytest.mark.parametrize(
    ("recorded", "lags", "expected"),
    [
        ({}, {"head": 0}, {}),
        ({"image_lag_frames": 1}, {"head": -3, "left_wrist": -3}, {"image_lag_frames": -2}),
        ({}, {"head": 2, "left_wrist": 0}, {"image_lag_frames": 2, "views": ("head",)}),
        ({}, {"head": 2, "left_wrist": 1}, None),
        ({"image_lag_frames": 1}, {"head": 2, "left_wrist": 0}, None),
        ({"image_lag_frames": 1, "views": ("head",)}, {"head": 1}, None),
    ],
)
def test_measured_lags_become_one_line_or_an_error(recorded, lags, expected):
    if expected is None:
        with pytest.raises(ConfigError, match="head by"):
            with_image_lags(RecordedConventions(**recorded), lags)
    else:
        assert with_image_lags(RecordedConventions(**recorded), lags) == RecordedConventions(**expected)
