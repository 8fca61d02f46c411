"""Pictures of a diagnosis: tools where the recording's own cameras put them, before and after the repair."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tools.corrupted.conventions import corrupt, corrupted_image_frames
from worldline_core.actions.episode_tracks import EpisodeTracks
from worldline_core.calibration import pictures
from worldline_core.calibration.diagnosis import Diagnosis, Explanation, VerdictName
from worldline_core.calibration.pictures import (
    MIN_WIDTH,
    diagnosis_picture,
    differing_moments,
    headline,
    measures_note,
    recorded_tracks,
)
from worldline_core.data.episodes.conventions import RecordedConventions
from worldline_core.data.episodes.episode import Episode
from worldline_core.errors import DataError


def diagnosis_of(conventions: RecordedConventions, verdict: VerdictName = "explained") -> Diagnosis:
    none = Explanation(RecordedConventions(), -80.0, {"hand_eye right_wrist": -80.0})
    best = Explanation(conventions, -1.0, {"hand_eye right_wrist": -1.0})
    measures = {"right_wrist": {"hand_eye_m": 0.2, "hand_eye_deg": 31.4, "flow": 0.5}}
    ranked = (best, none) if conventions.departures else (none,)
    return Diagnosis(episode_id="synthetic/0", verdict=verdict, best=ranked[0], ranked=ranked, measures=measures)


def by_hand(episode: Episode, view: str, n: int) -> np.ndarray:
    camera = episode.cameras[view]
    pose = camera.T_base_camera[n if camera.moving else 0]
    assert episode.T_base_ee is not None
    x, y, z = pose[:3, :3].T @ (episode.T_base_ee[n, 0, :3, 3] - pose[:3, 3])
    return np.array([camera.K[0, 0] * x / z + camera.K[0, 2], camera.K[1, 1] * y / z + camera.K[1, 2]])


@pytest.mark.parametrize("view", ["head", "right_wrist"])
def test_tools_lie_where_the_recorded_camera_puts_them(episode: Episode, view: str) -> None:
    tracks = recorded_tracks(episode, view, None)
    assert tracks.views == (view,)
    assert tracks.arms == ("right",)
    assert tracks.valid.all()
    for n in (0, 7, 23):
        assert np.allclose(tracks.uv[n, 0, 0], by_hand(episode, view, n), atol=1e-3)


def test_a_corrupted_camera_moves_the_drawing(episode: Episode) -> None:
    # The wrist camera's own poses are used, not those that follow from kinematics and a mount.
    wrong = corrupt(episode, RecordedConventions(camera_lag_frames=3))
    right, lagging = (recorded_tracks(e, "right_wrist", None) for e in (episode, wrong))
    apart = np.linalg.norm(lagging.uv[:, 0, 0] - right.uv[3 : 3 + lagging.num_frames, 0, 0], axis=-1)
    assert apart.max() > 3
    for n in (0, 10):
        assert np.allclose(lagging.uv[n, 0, 0], by_hand(wrong, "right_wrist", n), atol=1e-3)


def test_a_tool_offset_moves_along_the_tool(episode: Episode) -> None:
    moved = recorded_tracks(episode, "head", None, tool_offset_z_m=0.1)
    assert episode.T_base_ee is not None
    expected = episode.T_base_ee[:, :, :3, 3] + 0.1 * episode.T_base_ee[:, :, :3, 2]
    assert np.allclose(moved.T_base_tool[:, :, :3, 3], expected, atol=1e-6)


def test_moments_are_those_at_which_the_readings_differ(episode: Episode) -> None:
    tracks = recorded_tracks(episode, "head", None)
    other = replace(tracks, uv=tracks.uv.copy(), valid=tracks.valid.copy())
    other.uv[[4, 13, 20], 0, 0] += 9.0
    other.uv[[2, 10, 22], 0, 0] += 2.0
    assert differing_moments(tracks, other, 0, 24, 3) == [4, 13, 20]
    # Frame n of the first is frame n - 2 of the second.
    shifted = replace(other, uv=other.uv[2:], valid=other.valid[2:], capsules=other.capsules[2:], depth=other.depth[2:])
    assert differing_moments(tracks, shifted, 2, 24, 3) == [4, 13, 20]
    # A tool that leaves the picture counts for more than one that moves in it.
    other.valid[6, 0, 0] = False
    assert differing_moments(tracks, other, 0, 24, 3)[0] == 6
    # Only frames with images can be shown.
    assert differing_moments(tracks, other, 0, 2, 3) == [0, 1]


def test_an_explained_episode_is_shown_twice(episode: Episode, images: dict[str, np.ndarray]) -> None:
    conventions = RecordedConventions(extrinsics="base_to_camera")
    wrong = corrupt(episode, conventions)
    grey = {view: np.full_like(clip, 90) for view, clip in images.items()}
    picture = diagnosis_picture(diagnosis_of(conventions), wrong, grey, None, moments=2, tile_height=120)
    half = picture.shape[1] // 2
    assert picture.shape[1] >= 2 * MIN_WIDTH
    left, right = picture[90:-30, :half], picture[90:-30, half : 2 * half]
    # The same frames with other overlays: much is equal, the repaired side has the drawing.
    changed = (left != right).any(axis=-1)
    assert 0.005 < changed.mean() < 0.6
    blue = lambda part: (np.abs(part.astype(int) - (40, 150, 255)).max(axis=-1) < 30).sum()  # noqa: E731
    assert blue(left) == 0
    assert blue(right) > 15


@pytest.mark.parametrize(
    "conventions",
    [
        RecordedConventions(image_lag_frames=4),
        RecordedConventions(image_lag_frames=-3),
        RecordedConventions(camera_lag_frames=-2, image_lag_frames=2),
        RecordedConventions(camera_lag_frames=3),
    ],
)
def test_the_repaired_side_draws_each_image_with_its_own_tools(
    episode: Episode, conventions: RecordedConventions, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Image i of the healthy episode has the grey value 10 i, so that a drawn image tells its number.
    numbered = np.repeat(10 * np.arange(24, dtype=np.uint8), 60 * 80 * 3).reshape(24, 60, 80, 3)
    wrong = corrupt(episode, conventions)
    late = numbered[corrupted_image_frames(episode.num_frames, conventions)]
    drawn: list[tuple[int, np.ndarray]] = []

    def record(frame: np.ndarray, tracks: EpisodeTracks, n: int, view: str, **_: object) -> np.ndarray:
        drawn.append(
            (int(frame[0, 0, 0]) // 10, np.concatenate([tracks.T_base_tool[n, 0], tracks.T_base_camera[n, 0]]))
        )
        return frame

    monkeypatch.setattr(pictures, "draw_overlay", record)
    images = {"right_wrist": late}
    diagnosis_picture(diagnosis_of(conventions), wrong, images, None, moments=4, tile_height=60)
    healthy = recorded_tracks(episode, "right_wrist", None)
    assert len(drawn) == 8
    for number, shown in drawn[4:]:
        expected = np.concatenate([healthy.T_base_tool[number, 0], healthy.T_base_camera[number, 0]])
        assert np.allclose(shown, expected, atol=1e-6)
    # As recorded they do not belong together.
    number, shown = drawn[0]
    expected = np.concatenate([healthy.T_base_tool[number, 0], healthy.T_base_camera[number, 0]])
    assert not np.allclose(shown, expected, atol=1e-3)


def test_exchanged_arms_are_drawn_with_recorded_tool_poses(episode: Episode, images: dict[str, np.ndarray]) -> None:
    assert episode.T_base_ee is not None
    assert episode.gripper is not None
    away = episode.T_base_ee.copy()
    away[..., 1, 3] += 0.2
    names = ("left/x", "left/gripper", "right/x", "right/gripper")
    state = np.zeros((episode.num_frames, 4), np.float32)
    poses, gripper = np.concatenate([away, episode.T_base_ee], axis=1), np.repeat(episode.gripper, 2, axis=1)
    two = replace(episode, T_base_ee=poses, gripper=gripper, state=state, action=state, state_names=names)
    conventions = RecordedConventions(arms="exchanged")
    wrong = corrupt(two, conventions)
    picture = diagnosis_picture(diagnosis_of(conventions), wrong, images, None, moments=2, tile_height=60)
    assert picture.shape[1] >= 2 * MIN_WIDTH


def test_what_cannot_be_drawn_says_why(episode: Episode, images: dict[str, np.ndarray]) -> None:
    plain = diagnosis_of(RecordedConventions(), "too_little_evidence")
    with pytest.raises(DataError, match="Nothing to draw"):
        diagnosis_picture(plain, replace(episode, cameras={}), images, None)
    joints = replace(episode, T_base_ee=None, gripper=None, state_kind="joints")
    with pytest.raises(DataError, match=r"(?s)No tools to draw.*joints and kinematics"):
        diagnosis_picture(plain, joints, images, None)
    with pytest.raises(DataError, match=r"(?s)no calibration.*left_wrist"):
        recorded_tracks(episode, "left_wrist", None)


def test_texts_say_the_verdict_and_the_numbers() -> None:
    found = diagnosis_of(RecordedConventions(intrinsics_size=(480, 640)))
    assert headline(found).startswith("explained by intrinsics_size: score -1.0, as recorded -80.0")
    assert (
        measures_note(found.measures["right_wrist"]) == "camera against hand 200.0 mm, 31.4 deg  ·  flow agreement 0.50"
    )
    assert measures_note({}) == ""
    for verdict, word in (
        ("unexplained", "worst are hand_eye right_wrist -80.0"),
        ("consistent", "consistent"),
        ("too_little_evidence", "too little"),
    ):
        assert word in headline(diagnosis_of(RecordedConventions(), verdict))  # type: ignore[arg-type]
