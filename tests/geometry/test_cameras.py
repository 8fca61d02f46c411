"""Cameras: pixels, images and K move together; poses say their convention, and rotations are repaired or refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.errors import CalibrationError, ConfigError, DataError
from worldline_core.geometry.cameras import CameraPose, ImageTransform, project_points
from worldline_core.geometry.tensor_transforms import is_rigid
from worldline_core.geometry.transforms import MAX_ROTATION_DEVIATION, mean_pose, repair_rotations, rotation_deviation

K = np.array([[322.0, 0.5, 318.2], [0.0, 430.0, 241.7], [0.0, 0.0, 1.0]])
SIZE = (480, 640)
steady = settings(max_examples=40, derandomize=True, deadline=None)
sides = st.integers(8, 700)


@st.composite
def transforms(draw: st.DrawFn) -> ImageTransform:
    """Chains of up to four changes, whatever their order."""
    transform = ImageTransform.of(SIZE)
    for kind in draw(st.lists(st.sampled_from(["resize", "crop", "letterbox", "centre_crop"]), max_size=4)):
        height, width = transform.image_size
        if kind == "crop":
            size = draw(st.integers(1, height)), draw(st.integers(1, width))
            top, left = draw(st.integers(0, height - size[0])), draw(st.integers(0, width - size[1]))
            transform = transform.crop(top, left, size)
        else:
            transform = getattr(transform, kind)((draw(sides), draw(sides)))
    return transform


@steady
@given(transforms(), st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(0.2, 4)))
def test_transform_then_project_equals_project_then_transform(transform, point):
    p, eye = np.array([point]), np.eye(4)[None]
    uv, _ = project_points(p, K, eye)
    transformed, _ = project_points(p, transform.intrinsics(K), eye)
    np.testing.assert_allclose(transformed, transform.pixels(uv), atol=1e-7, rtol=1e-11)
    np.testing.assert_allclose(transform.intrinsics(np.stack([K, K]))[1], transform.intrinsics(K))


@steady
@given(sides, sides, st.floats(-300, 900), st.floats(-300, 900))
def test_a_resize_maps_pixel_borders_to_pixel_borders(height, width, u, v):
    # From the definition, without the module's matrices: distances from the image's edge (-1/2) scale.
    pixel = ImageTransform.of(SIZE).resize((height, width)).pixels(np.array([u, v]))
    expected = [(u + 0.5) * width / 640 - 0.5, (v + 0.5) * height / 480 - 0.5]
    np.testing.assert_allclose(pixel, expected, atol=1e-9)


@steady
@given(sides, sides)
def test_letterbox_shows_all_and_centre_crop_fills(height, width):
    corners, border = np.array([[-0.5, -0.5], [639.5, 479.5]]), np.array([width, height])
    for kind, sign in (("letterbox", 1), ("centre_crop", -1)):
        transform = getattr(ImageTransform.of(SIZE), kind)((height, width))
        assert transform.image_size == (height, width)
        low, high = transform.pixels(corners) + 0.5
        assert (sign * low >= -1e-9).all()
        assert (sign * (border - high) >= -1e-9).all()
        assert kind == "centre_crop" or (np.abs(low - (border - high)) <= 1 + 1e-9).all()  # up to an odd pixel


@pytest.mark.parametrize(
    "transform",
    [
        ImageTransform.of(SIZE).resize((96, 160)),
        ImageTransform.of(SIZE).resize((960, 1100)),
        ImageTransform.of(SIZE).letterbox((487, 657)).crop(101, 57, (333, 400)),
        ImageTransform.of(SIZE).letterbox((100, 300)).crop(3, 60, (90, 180)).resize((45, 91)),
        ImageTransform.of(SIZE).centre_crop((240, 240)),
    ],
    ids=["shrink", "enlarge", "enlarge and crop", "letterbox", "centre_crop"],
)
def test_a_drawn_blob_is_found_where_the_transformed_camera_projects_it(transform):
    spot = np.array([211.3, 253.8])
    v, u = np.mgrid[0:480, 0:640]
    blob = np.exp(-((u - spot[0]) ** 2 + (v - spot[1]) ** 2) / (2 * 14.0**2))
    picture = np.repeat((255 * blob).round().astype(np.uint8)[..., None], 3, axis=2)
    result = transform.frames(picture[None])[0, ..., 0].astype(float)
    assert result.shape == transform.image_size
    rows, columns = np.indices(result.shape)
    found = np.array([(columns * result).sum(), (rows * result).sum()]) / result.sum()
    ray = np.linalg.inv(K) @ [*spot, 1.0]
    expected = project_points(1.7 * ray[None], transform.intrinsics(K), np.eye(4)[None])[0][0]
    np.testing.assert_allclose(found, expected, atol=0.03)
    centre = np.argwhere(transform.masks((blob > 0.3)[None])[0]).mean(axis=0)[::-1]
    np.testing.assert_allclose(centre, expected, atol=0.3)


def test_frames_are_those_of_opencv_and_padding_is_empty():
    frames = np.random.default_rng(0).integers(0, 255, (2, *SIZE, 3), dtype=np.uint8)
    boxed = ImageTransform.of(SIZE).letterbox((100, 160)).frames(frames)
    inner = cv2.resize(frames[1], (133, 100), interpolation=cv2.INTER_AREA)
    assert np.array_equal(boxed[1], cv2.copyMakeBorder(inner, 0, 0, 13, 14, cv2.BORDER_CONSTANT))
    assert ImageTransform.of(SIZE).resize(SIZE).frames(frames) is frames


def test_a_camera_track_follows_the_same_transform():
    track = CameraTrack("head", K, np.eye(4)[None], 640, 480)
    transform = ImageTransform.of(SIZE).letterbox((256, 256))
    moved = track.transformed(transform)
    assert (moved.height, moved.width) == (256, 256)
    assert np.array_equal(moved.K, transform.intrinsics(K))
    assert np.array_equal(track.resized(64, 48).K, ImageTransform.of(SIZE).resize((48, 64)).intrinsics(K))


def test_a_window_outside_of_the_image_and_other_sizes_are_refused():
    whole = ImageTransform.of(SIZE)
    for change, error, said in (
        (lambda: whole.crop(400, 0, (100, 100)), ConfigError, "row 400"),
        (lambda: ImageTransform.of((0, 640)), ConfigError, "no pixels"),
        (lambda: whole.resize((9, 9)).frames(np.zeros((1, 48, 64, 3), np.uint8)), DataError, r"\(480, 640\)[\s\S]*\(48, 64\)"),
    ):  # fmt: skip
        with pytest.raises(error, match=said):
            change()


def poses(count: int = 5, seed: int = 0) -> np.ndarray:
    result = np.tile(np.eye(4), (count, 1, 1))
    result[:, :3, :3] = Rotation.random(count, random_state=seed).as_matrix()
    result[:, :3, 3] = np.random.default_rng(seed).normal(size=(count, 3))
    return result


def off_by(deviation: float, rotation: np.ndarray) -> np.ndarray:
    """A shear of the rotation with max |R R^T - I| equal to `deviation`, to first order."""
    return (np.eye(3) + deviation * np.array([[0, 1.0, 0], [0, 0, 0], [0, 0, 0]])) @ rotation


def test_all_four_conventions_of_one_camera_project_alike() -> None:
    T_base_camera = poses(1)
    gl = T_base_camera @ np.diag([1.0, -1.0, -1.0, 1.0])
    made = [
        CameraPose.of(T_base_camera, extrinsics="camera_to_base", axes="opencv", where="head"),
        CameraPose.of(gl, extrinsics="camera_to_base", axes="opengl", where="head"),
        CameraPose.of(np.linalg.inv(T_base_camera), extrinsics="base_to_camera", axes="opencv", where="head"),
        CameraPose.of(np.linalg.inv(gl)[0], extrinsics="base_to_camera", axes="opengl", where="head"),
    ]
    points = np.random.default_rng(1).normal(size=(20, 3))
    # OpenCV's own extrinsics (rvec, tvec) map base to camera.
    T_camera_base = np.linalg.inv(T_base_camera[0])
    rvec, _ = cv2.Rodrigues(T_camera_base[:3, :3])
    no_skew = np.array(K)
    no_skew[0, 1] = 0.0  # OpenCV knows none
    expected, _ = cv2.projectPoints(points, rvec, T_camera_base[:3, 3], no_skew, None)
    for pose in made:
        np.testing.assert_allclose(pose.T_base_camera, T_base_camera, atol=1e-12)
        uv, _ = project_points(points, no_skew, pose.T_base_camera)
        np.testing.assert_allclose(uv, expected[:, 0], rtol=1e-8, atol=1e-7)


@pytest.mark.parametrize("deviation", [2e-6, 1e-4, 0.99e-3])
def test_a_rotation_within_the_threshold_is_repaired_and_counted(deviation: float) -> None:
    recorded = poses()
    true = recorded.copy()
    recorded[[1, 3], :3, :3] = off_by(deviation, recorded[[1, 3], :3, :3])
    for extrinsics, expected in (("camera_to_base", true), ("base_to_camera", np.linalg.inv(true))):
        pose = CameraPose.of(recorded, extrinsics=extrinsics, axes="opencv", where="episode 4, view head")
        assert pose.repair.count == 2
        assert pose.repair.largest == pytest.approx(deviation, rel=1e-2)
        assert rotation_deviation(pose.T_base_camera[:, :3, :3]).max() < 1e-14
        # The nearest rotation is not further from the true one than the recorded matrix was.
        np.testing.assert_allclose(pose.T_base_camera[:, :3, :3], expected[:, :3, :3], atol=deviation)


def test_what_is_exact_or_rounded_stays_the_same_array() -> None:
    for recorded in (poses(), poses().astype(np.float32).astype(np.float64)):
        repaired, repair = repair_rotations(recorded, "head")
        assert repaired is recorded
        assert repair.count == 0


@pytest.mark.parametrize("kind", ["beyond", "mirrored", "scaled", "nan", "last_row", "infinite_place"])
def test_what_is_beyond_repair_is_refused(kind: str) -> None:
    recorded = poses()
    if kind == "beyond":
        recorded[2, :3, :3] = off_by(1.02 * MAX_ROTATION_DEVIATION, recorded[2, :3, :3])
    elif kind == "mirrored":
        recorded[2, :3, 0] *= -1
    elif kind == "scaled":
        recorded[2, :3, :3] *= 1.01
    elif kind == "nan":
        recorded[2, 0, 0] = np.nan
    elif kind == "infinite_place":
        recorded[2, 0, 3] = np.inf
    else:
        recorded[2, 3, 0] = 0.1
    assert not bool(is_rigid(torch.from_numpy(recorded[2])))
    with pytest.raises(CalibrationError, match=r"Not a rigid transform[\s\S]*episode 4, frame 2[\s\S]*1 of 5"):
        CameraPose.of(recorded, extrinsics="camera_to_base", axes="opencv", where="episode 4")
    with pytest.raises(CalibrationError, match=r"wrong shape[\s\S]*\(3, 4\)"):
        CameraPose.of(np.eye(4)[:3], extrinsics="camera_to_base", axes="opencv", where="head")


def test_the_mean_pose_is_that_of_scipy() -> None:
    turns = Rotation.from_rotvec(0.2 * np.random.default_rng(3).normal(size=(30, 3)))
    scattered = poses(1)[:, :3, :3] @ turns.as_matrix()
    many = np.tile(np.eye(4), (30, 1, 1))
    many[:, :3, :3] = scattered
    np.testing.assert_allclose(mean_pose(many)[:3, :3], Rotation.from_matrix(scattered).mean().as_matrix(), atol=1e-12)
