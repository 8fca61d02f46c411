"""Resize, crop, pad and letterbox: pixels, images and K move together."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.errors import ConfigError, DataError
from worldline_core.geometry.cameras import ImageTransform, project_points

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
