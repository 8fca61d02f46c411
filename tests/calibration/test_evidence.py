"""Single measures against scenes whose answer is known by construction."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from worldline_core.calibration.calibration_doctor import intrinsics_sizes
from worldline_core.calibration.diagnosis import Explanation, bad_terms
from worldline_core.calibration.evidence import image_terms, pose_terms, still_view_agreement, stopped_share
from worldline_core.calibration.observation import Observation, Reading, observe, read
from worldline_core.data.episodes.conventions import RecordedConventions
from worldline_core.data.episodes.episode import Episode
from worldline_core.geometry.cameras import project_points


def seen_as(recording: Episode, pictures: dict[str, np.ndarray], **mistake: object) -> tuple[Observation, Reading]:
    observation = observe(recording, pictures, None)
    reading = read(observation, RecordedConventions.model_validate(mistake))
    assert reading is not None
    return observation, reading


def head_pictures(episode: Episode, lag: int = 0) -> np.ndarray:
    """A textured patch that moves with the projected tool over a plain table; `lag`: shows what was then."""
    random, camera, tools = np.random.default_rng(4), episode.cameras["head"], episode.T_base_ee[:, 0]
    patch = cv2.resize(random.uniform(30, 220, (6, 6)).astype(np.float32), (18, 18), interpolation=cv2.INTER_CUBIC)
    uv, _ = project_points(tools[:, :3, 3] - 0.07 * tools[:, :3, 2], camera.K, camera.T_base_camera)
    frames = np.full((len(tools), camera.height, camera.width), 120.0, np.float32)
    for frame, (u, v) in zip(frames, uv[np.maximum(np.arange(len(tools)) - lag, 0)], strict=True):
        shift = np.array([[1, 0, u - 8.5], [0, 1, v - 8.5]])
        cv2.warpAffine(patch, shift, frame.shape[::-1], dst=frame, borderMode=cv2.BORDER_TRANSPARENT)
    return frames.clip(0, 255).astype(np.uint8)


def test_a_motion_of_few_cells_vetoes_nothing(episode: Episode) -> None:
    """A wrong camera is bad by the motion of many cells; by that of a few steps it is no more than suspicious."""
    shown = head_pictures(episode)
    other = np.kron(np.random.default_rng(4).uniform(30, 220, (len(shown), 15, 20)), np.ones((1, 4, 4))).astype(
        np.uint8
    )
    for first, bad in ((2, True), (len(shown) - 1, False)):
        pictures = np.where(np.arange(len(shown))[:, None, None] < first, shown[:1], other)
        terms = image_terms(*seen_as(episode, {"head": pictures}))
        assert bool(bad_terms(Explanation(RecordedConventions(), 0.0, terms))) == bad


@pytest.mark.parametrize("lag", [0, 2])
def test_the_lag_of_pictures_is_where_flow_agrees_best(episode: Episode, lag: int) -> None:
    observation, recorded = seen_as(episode, {"head": head_pictures(episode, lag)})
    found = {k: still_view_agreement(observation, recorded.with_image_lag(k), "head")[0] for k in range(-3, 4)}
    assert max(found, key=lambda k: found[k]) == lag


def test_an_object_stops_a_closing_gripper_never_an_opening_one(episode: Episode) -> None:
    closing = np.arange(episode.num_frames)[:, None] >= 10
    held = replace(episode, gripper=np.where(closing, 0.6, 1.0), state=np.where(closing, 0.6, 1.0).astype(np.float32))
    commanded = replace(held, action=np.where(closing, 0.0, 1.0).astype(np.float32))
    assert stopped_share(seen_as(commanded, {})[1], 0) == 1.0
    assert stopped_share(seen_as(commanded, {}, gripper="inverted")[1], 0) == 0.0
    assert stopped_share(seen_as(replace(held, action=held.state), {})[1], 0) is None


def test_sizes_that_put_the_principal_point_into_the_middle(episode: Episode) -> None:
    camera = episode.cameras["head"]
    off = camera.K + np.array([[0, 0, 1.5], [0, 0, 1.5], [0, 0, 0]])  # somewhat off the middle is a camera's own
    for K, sizes in (
        (camera.K, []),
        (off, []),
        *((camera.resized(w, h).K, [(h, w)]) for w, h in ((640, 480), (211, 170))),
    ):
        assert intrinsics_sizes({"head": replace(camera, K=K)}) == sizes


def test_pose_terms_blame_the_right_thing(episode: Episode) -> None:
    def terms(**mistake: object) -> dict[str, float]:
        return pose_terms(*seen_as(episode, {}, **mistake))

    assert min(terms().values()) > -0.5
    assert terms(pose_unit="mm")["hand-eye right_wrist"] < -30
    assert terms(extrinsics_unit="mm")["camera place head"] > -0.1  # a thousandth is near the base: nothing odd there
    assert terms(camera_axes="opengl")["faces its tool right_wrist"] == -15.0
    assert terms(camera_axes="opengl")["hand-eye right_wrist"] > -0.1  # still rigid: only the view direction tells
    assert terms(intrinsics_size=(480, 640))["intrinsics head"] < -20
    assert terms(extrinsics="base_to_camera")["hand-eye right_wrist"] < -20
    far = episode.T_base_ee * np.array([1000.0, 1000, 1000, 1])[:, None] ** (np.arange(4) == 3)
    assert pose_terms(*seen_as(replace(episode, T_base_ee=far), {}))["workspace"] == -40.0
