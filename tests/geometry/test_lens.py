"""Lens models against OpenCV, and what may not pass: wrong counts, lenses that fold back, unknown names."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from worldline_core.errors import CalibrationError
from worldline_core.geometry.lens import (
    MAX_HALF_ANGLE_DEG,
    Distortion,
    distort_points,
    distortion_from_ros,
    undistort_rays,
    undistorted_intrinsics,
    undistortion,
)

K = np.array([[400.0, 0.0, 318.0], [0.0, 410.0, 239.0], [0.0, 0.0, 1.0]])
SIZE = (480, 640)
LENSES = {
    "barrel": Distortion("radtan", (-0.3, 0.1, 0.001, -0.002, -0.01)),
    "four": Distortion("radtan", (0.2, 0.05, 0.001, 0.002)),
    "rational": Distortion("radtan", (5.2, 3.1, 0.0003, -0.0002, 0.2, 5.5, 4.6, 0.9)),
    "fisheye": Distortion("fisheye", (0.02, -0.01, 0.003, -0.001)),
    "equidistant": Distortion("fisheye", (0.0, 0.0, 0.0, 0.0)),
}
each_lens = pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
steady = settings(derandomize=True, deadline=None, max_examples=40)


def undistort_points(points: np.ndarray, lens: Distortion) -> np.ndarray:
    """(x', y') -> (x, y) on the plane in front of the camera."""
    rays = undistort_rays(points, lens)
    return rays[:, :2] / rays[:, 2:]


def small(limit: float) -> st.SearchStrategy[float]:
    return st.floats(-limit, limit, allow_nan=False)


lenses = st.one_of(
    st.tuples(small(0.3), small(0.1), small(0.01), small(0.01), small(0.05)).map(lambda c: Distortion("radtan", c)),
    st.tuples(*map(small, (0.2, 0.1, 0.01, 0.01, 0.05, 0.2, 0.1, 0.05))).map(lambda c: Distortion("radtan", c)),
    st.tuples(small(0.1), small(0.05), small(0.02), small(0.01)).map(lambda c: Distortion("fisheye", c)),
)
plane = st.tuples(small(0.9), small(0.9))


@steady
@given(lenses, st.lists(plane, min_size=1, max_size=20))
def test_undistort_undoes_distort(lens, points):
    # The image that reaches to these points must not fold back: elsewhere there is no inverse to find.
    reach = np.linalg.norm(points, axis=1).max() * 1.1 + 0.1
    assume(lens.turning_point[0] > (math.atan(reach) if lens.model == "fisheye" else reach))
    back = undistort_points(distort_points(np.array(points), lens), lens)
    np.testing.assert_allclose(back, points, atol=1e-9)


@each_lens
def test_undistorted_points_are_those_of_opencv(lens):
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (300, 2))
    distorted = distort_points(points, lens)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 500, 1e-14)
    coefficients = np.array(lens.coefficients)
    if lens.model == "fisheye":
        expected = cv2.fisheye.undistortPoints(distorted[None], np.eye(3), coefficients, criteria=criteria)[0]
    else:
        expected = cv2.undistortPointsIter(distorted[:, None], np.eye(3), coefficients, None, None, criteria)[:, 0]
    found = undistort_points(distorted, lens)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    np.testing.assert_allclose(found, points, atol=1e-12)


@each_lens
def test_maps_are_those_of_opencv_and_stay_inside_of_the_recorded_image(lens):
    lens_maps = undistortion(lens, K, SIZE)
    coefficients = np.array(lens.coefficients)
    if lens.model == "fisheye":
        u, v = cv2.fisheye.initUndistortRectifyMap(K, coefficients, np.eye(3), lens_maps.K, SIZE[::-1], cv2.CV_32FC1)
    else:
        u, v = cv2.initUndistortRectifyMap(K, coefficients, None, lens_maps.K, SIZE[::-1], cv2.CV_32FC1)
        whole, _ = cv2.getOptimalNewCameraMatrix(K, coefficients, SIZE[::-1], 0)
        np.testing.assert_allclose(lens_maps.K, whole, atol=1.0)  # OpenCV looks at 9x9 points of the border
    np.testing.assert_allclose(lens_maps.map_u, u, atol=1e-3)
    np.testing.assert_allclose(lens_maps.map_v, v, atol=1e-3)
    # As large as it can be: each side of the rectangle comes within a pixel of the recorded image's border.
    assert -1e-3 < lens_maps.map_u.min() <= lens_maps.map_u[:, 0].min() < 1
    assert -1e-3 < lens_maps.map_v.min() <= lens_maps.map_v[0].min() < 1
    assert 638 < lens_maps.map_u[:, -1].max() <= lens_maps.map_u.max() < 639 + 1e-3
    assert 478 < lens_maps.map_v[-1].max() <= lens_maps.map_v.max() < 479 + 1e-3


def test_a_skewed_camera_matrix_is_kept_in_mind():
    # OpenCV's maps forget the skew; here a pixel of the new image is looked up where K with skew sees its ray.
    skewed = K.copy()
    skewed[0, 1] = 7.0
    maps = undistortion(LENSES["barrel"], skewed, SIZE)
    ray = np.linalg.inv(maps.K) @ [100.0, 400.0, 1.0]
    x, y = distort_points(ray[None, :2], LENSES["barrel"])[0]
    expected = skewed @ [x, y, 1.0]
    np.testing.assert_allclose([maps.map_u[400, 100], maps.map_v[400, 100]], expected[:2], atol=1e-3)


def test_a_fisheye_beyond_a_half_space_gets_a_pinhole_of_bounded_width():
    # 200 degrees across: the border looks backwards, where no plane in front of the camera has a place for it.
    lens = LENSES["equidistant"]
    focal = 319.5 / math.radians(100)
    wide = np.array([[focal, 0, 319.5], [0, focal, 239.5], [0, 0, 1.0]])
    rays = undistort_rays(np.array([[-319.5 / focal, 0.0]]), lens)
    assert math.degrees(math.acos(float(rays[0, 2]))) == pytest.approx(100)
    new_K = undistorted_intrinsics(lens, wide, SIZE)
    half_angle = math.degrees(math.atan(319.5 / new_K[0, 0]))
    assert half_angle == pytest.approx(MAX_HALF_ANGLE_DEG)


@pytest.mark.parametrize(
    "lens",
    [
        Distortion("radtan", (-0.9, 0.1, 0.0, 0.0)),
        Distortion("radtan", (0.0, -0.5, 0.0, 0.0, 0.0)),
        Distortion("radtan", (0.1, 0, 0, 0, 0, 2.5, 0, 0)),
        Distortion("fisheye", (-0.6, 0.0, 0.0, 0.0)),
    ],
    ids=["k1", "k2", "rational", "fisheye"],
)
def test_a_lens_that_folds_back_inside_of_the_image_is_refused(lens):
    # The turning point, found by looking: where the distorted radius stops to grow.
    distances = np.linspace(0, 3, 300_001)[1:]
    turn = distances[np.flatnonzero(np.diff(lens.radius(distances)) <= 0)[0]]
    assert lens.turning_point == pytest.approx((turn, float(lens.radius(turn))), abs=2e-5)
    with pytest.raises(CalibrationError, match=r"folds back inside of the image"):
        undistortion(lens, K, SIZE)
    # The same lens on a camera that uses its inner part only is fine.
    telephoto = np.diag([4000.0, 4000.0, 1.0]) + np.array([[0, 0, 319.5], [0, 0, 239.5], [0, 0, 0]])
    assert undistortion(lens, telephoto, SIZE).K[0, 0] > 3000


def test_what_describes_no_lens_is_refused():
    with pytest.raises(CalibrationError, match="no single ray"):  # tangential terms that fold
        undistortion(Distortion("radtan", (0.0, 0.0, 0.9, 0.9)), K, SIZE)
    for count in (0, 1, 3, 6, 12):
        with pytest.raises(CalibrationError, match=rf"radtan lens are incomplete[\s\S]*got: {count}"):
            Distortion("radtan", (0.1,) * count)
        with pytest.raises(CalibrationError, match="fisheye lens are incomplete"):
            Distortion("fisheye", (0.1,) * (count + 5))
    with pytest.raises(CalibrationError, match="not finite"):
        Distortion("radtan", (0.1, math.nan, 0.0, 0.0))
    with pytest.raises(CalibrationError, match="Unknown distortion model"):
        Distortion("brown", (0.1, 0.0, 0.0, 0.0))  # type: ignore[arg-type]


def test_ros_names():
    four = [0.1, 0.2, 0.001, 0.002]
    assert distortion_from_ros("plumb_bob", [*four, 0.3]) == Distortion("radtan", (*four, 0.3))
    assert distortion_from_ros("rational_polynomial", [0.1] * 8) == Distortion("radtan", (0.1,) * 8)
    assert distortion_from_ros("rational_polynomial", [0.1] * 8 + [0.0] * 6) == Distortion("radtan", (0.1,) * 8)
    for name in ("kannala_brandt", "equidistant", "fisheye", "Equidistant"):
        assert distortion_from_ros(name, four) == Distortion("fisheye", tuple(four))
    for nothing in ([], [0.0] * 5):
        assert distortion_from_ros("plumb_bob", nothing) is None
    assert distortion_from_ros("", []) is None
    # An equidistant lens without corrections still is no pinhole.
    assert distortion_from_ros("equidistant", [0.0] * 4) == Distortion("fisheye", (0.0,) * 4)
    with pytest.raises(CalibrationError, match=r"fisheye lens are incomplete"):
        distortion_from_ros("fisheye", [])
    with pytest.raises(CalibrationError, match=r"Unknown distortion model[\s\S]*'ds'"):
        distortion_from_ros("ds", [0.1])
    with pytest.raises(CalibrationError, match="radtan lens are incomplete"):
        distortion_from_ros("rational_polynomial", [0.1] * 12)  # thin prism terms would be lost
