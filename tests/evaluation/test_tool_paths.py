"""Where tools are found in masks, and how their paths are compared; on shipped recordings with exact masks the truth is known."""

import numpy as np
import pytest
from scipy.stats import wasserstein_distance

from worldline_core.actions.action_tracks import DELAY_FRAMES, changed_tracks, compute_tracks
from worldline_core.actions.actions_config import RenderActionsConfig
from worldline_core.actions.render_actions import KinematicsByName
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.evaluation.video.metrics_on_request import (
    ControlledPair,
    ToolFinder,
    action_following,
    counterfactual_direction,
    dynamics_score,
    hausdorff_score,
    time_warping_distance,
    time_warping_score,
)

LINE = np.stack([np.linspace(10, 60, 17), np.full(17, 30.0)], axis=-1)[:, None]


@pytest.fixture(scope="module")
def recorded(project_root):
    """Tracks and exact head masks of a recording of each shipped robot."""
    episodes = EpisodeSet.open(project_root / "artifacts/shipped/recordings")
    kinematics = KinematicsByName(RenderActionsConfig().description_paths)  # type: ignore[call-arg]
    found = []
    for position in {row.embodiment: i for i, row in enumerate(episodes.rows) if row.split == "test"}.values():
        episode = episodes.episode(position)
        tracks, _ = compute_tracks(episode, kinematics.get(episode.embodiment), controls="state")
        found.append((tracks, np.asarray(episodes.robot_masks(position, "head"))))
    return found


def places_of(tracks):
    return np.where(tracks.valid[:, 0, :, None], tracks.uv[:, 0], np.nan)


@pytest.mark.slow
def test_tools_are_found_in_exact_masks_where_kinematics_says_they_are(recorded):
    own, delayed, still = [], [], []
    for tracks, masks in recorded:
        points = places_of(tracks)
        late = np.maximum(np.arange(len(points)) - 4, 0)
        for errors, predicted, truth in (
            (own, masks, points), (delayed, masks[late], points[late]), (still, masks[late * 0], points[late * 0]),
        ):  # fmt: skip
            found = ToolFinder().find(masks, predicted, points)
            errors.append(100 / masks.shape[1] * np.linalg.norm(found - truth, axis=-1).ravel())
    own, delayed, still = (np.concatenate(errors) for errors in (own, delayed, still))
    assert np.nanmax(own) < 1e-6
    assert np.nanmedian(delayed) < 1.0
    assert np.nanmean(delayed) < 2.5
    # A robot that stands still is found where it stands, however far the controls lead.
    assert np.nanmedian(still) < 2.5
    assert np.isfinite(delayed).mean() > 0.9


def test_pieces_of_a_video_are_one_search(recorded):
    tracks, masks = recorded[0]
    points, late = places_of(tracks), np.maximum(np.arange(len(masks)) - 4, 0)
    finder = ToolFinder()
    pieces = [finder.find(masks[part], masks[late][part], points[part]) for part in (slice(0, 9), slice(9, None))]
    np.testing.assert_array_equal(np.concatenate(pieces), ToolFinder().find(masks, masks[late], points))
    nothing = np.zeros((2, 40, 60), dtype=bool)
    assert np.isnan(ToolFinder().find(nothing, nothing, np.full((2, 1, 2), 20.0))).all()


def test_hausdorff_is_the_farthest_that_either_path_leaves_the_other():
    aside = LINE.copy()
    aside[8, 0, 1] += 4
    assert hausdorff_score(LINE, aside) == hausdorff_score(aside, LINE) == pytest.approx(1 / 4)
    assert hausdorff_score(LINE, LINE[::-1]) == 1.0  # a set of places has no direction
    half = LINE.copy()
    half[9:] = np.nan  # a tool that vanishes is as far as the rest of the path
    assert hausdorff_score(LINE, half) == pytest.approx(1 / 25)
    assert time_warping_score(LINE, half) == pytest.approx(17 / (3.125 * np.arange(1, 9).sum()))


def test_time_warping_follows_the_definition():
    def recursive(i, j):
        if i < 0 or j < 0:
            return 0.0 if i == j == -1 else np.inf
        before = min(recursive(i - 1, j - 1), recursive(i - 1, j), recursive(i, j - 1))
        return float(np.linalg.norm(a[i] - b[j])) + before

    a, b = np.random.default_rng(0).normal(size=(5, 2)), np.random.default_rng(1).normal(size=(6, 2))
    assert time_warping_distance(a, b) == pytest.approx(recursive(4, 5))
    delayed = LINE[np.maximum(np.arange(17) - 1, 0)]
    assert time_warping_score(LINE, delayed) == 1.0  # a delay is warped away, but for the end
    assert time_warping_score(LINE, LINE[::-1]) < 0.1  # type: ignore[operator]


def test_dynamics_compare_speeds_and_accelerations():
    twice = LINE[0] + 2 * (LINE - LINE[0])
    # Speeds differ by the true path's own speed; accelerations are zero in both.
    assert dynamics_score(LINE, twice) == pytest.approx(1 / (1 + 1 / 2))
    bent = LINE.copy()
    bent[9:, 0, 1] += 4.0
    terms = []
    for order in (1, 2):
        own, other = (np.linalg.norm(np.diff(path[:, 0], n=order, axis=0), axis=-1) for path in (LINE, bent))
        terms.append(wasserstein_distance(own, other) / max(own.mean(), 0.1))
    assert dynamics_score(LINE, bent) == pytest.approx(1 / (1 + sum(terms) / 2))
    assert dynamics_score(LINE, LINE + 7) == 1.0  # places play no part


@pytest.mark.parametrize("score", [hausdorff_score, time_warping_score, dynamics_score])
def test_only_arms_that_move_are_scored(score):
    """A resting arm, one out of view, one that hovers by what cannot be measured: none flatters, an arm that vanishes scores 0."""
    still, unseen, rest = np.repeat(LINE[:1], 17, axis=0), np.full_like(LINE, np.nan), np.full_like(LINE, 20.0)
    hovering = rest + np.random.default_rng(0).normal(size=LINE.shape)
    copied = score(LINE, still)
    assert copied < 0.7
    for other in (rest, unseen, hovering):
        assert score(np.concatenate([LINE, other], axis=1), np.concatenate([still, other], axis=1)) == copied
    both = np.concatenate([LINE, LINE[::-1]], axis=1)
    assert score(both, np.concatenate([LINE, unseen], axis=1)) == 0.5
    assert score(both, both) == 1.0
    assert score(rest, rest) is None
    gone = LINE.copy()
    gone[3:] = np.nan
    assert score(LINE, gone) == 0.0


def test_controls_are_followed_or_not():
    elsewhere = LINE + np.array([0.0, 9.0])
    for own, other, followed in ((LINE, elsewhere, 0.9), (LINE, LINE, 0.5), (elsewhere, LINE, 0.1)):
        assert action_following(ControlledPair(LINE, own, other, None)) == pytest.approx(followed)
    for own, other, asked, direction in (
        (LINE, elsewhere, elsewhere, 1.0), (LINE, LINE, elsewhere, 0.5), (elsewhere, LINE, elsewhere, 0.0),
        (LINE, LINE, LINE, None), (LINE, elsewhere, None, None),
    ):  # fmt: skip
        assert counterfactual_direction(ControlledPair(LINE, own, other, asked)) == direction


def test_changed_controls_begin_alike_and_then_differ_as_said(recorded):
    for tracks, _ in recorded:
        mirrored, delayed = (changed_tracks(tracks, change) for change in ("mirrored", "delayed"))
        for changed in (mirrored, delayed):
            np.testing.assert_allclose(changed.uv[0], tracks.uv[0], atol=1e-3)
            np.testing.assert_allclose(changed.rot6d[0], tracks.rot6d[0], atol=1e-5)
        np.testing.assert_array_equal(delayed.uv[DELAY_FRAMES:], tracks.uv[:-DELAY_FRAMES])
        turns = mirrored.T_base_tool[..., :3, :3]
        np.testing.assert_allclose(np.linalg.det(turns), 1.0, atol=1e-4)
        T_head_base = np.linalg.inv(tracks.T_base_camera[0, 0])
        own, other = ((T_head_base @ t.T_base_tool)[..., :3, 3] for t in (tracks, mirrored))
        moved, moved_other = own - own[:1], other - other[:1]
        np.testing.assert_allclose(moved_other, moved * [-1, 1, 1], atol=1e-5)
        # A wrist camera stays mounted: its own tool is seen where it was.
        for column, view in enumerate(tracks.views):
            arm = next((i for i, name in enumerate(tracks.arms) if view == f"{name}_wrist"), None)
            if arm is not None and tracks.valid[:, column, arm].any():
                np.testing.assert_allclose(mirrored.uv[:, column, arm], tracks.uv[:, column, arm], atol=0.05)
