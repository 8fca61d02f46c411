"""Formulas of metrics against other libraries, the intervals of their means, and paths of tools found in masks."""

import cv2
import numpy as np
import pytest
import torch
from scipy.stats import wasserstein_distance
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from worldline_core.actions.action_tracks import DELAY_FRAMES, changed_tracks, compute_tracks
from worldline_core.actions.actions_config import RenderActionsConfig
from worldline_core.actions.render_actions import KinematicsByName
from worldline_core.actions.tool_error import end_effector_error, normalised_correlation
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError, UnavailableError
from worldline_core.evaluation import metrics
from worldline_core.evaluation.scores import bootstrap_mean, paired_difference
from worldline_core.model.lpips import BACKBONE_FILE, HEADS_FILE, load_lpips


@pytest.fixture
def pair():
    generator = np.random.default_rng(0)
    true = generator.integers(0, 256, (4, 32, 48, 3), dtype=np.uint8)
    true[1] = 130  # flat: variances vanish
    predicted = np.clip(true + generator.integers(-30, 31, true.shape), 0, 255).astype(np.uint8)
    predicted[2] = true[2]
    return predicted, true


def test_psnr_and_ssim_equal_scikit_image(pair):
    predicted, true = pair
    found = [
        metric(*(metrics.frames_to_unit(torch.from_numpy(x)) for x in pair)).numpy()
        for metric in (metrics.psnr, metrics.ssim)
    ]
    for index in range(4):
        reference = structural_similarity(
            true[index], predicted[index], gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
            channel_axis=-1, data_range=255,
        )  # fmt: skip
        assert found[1][index] == pytest.approx(reference, abs=2e-5)
        # Of equal frames it ends at the rounding error of eight bits.
        equal = index == 2
        reference = (
            metrics.MAX_PSNR_DB if equal else peak_signal_noise_ratio(true[index], predicted[index], data_range=255)
        )
        assert found[0][index] == pytest.approx(reference, abs=1e-3)
    assert 58.9 < metrics.MAX_PSNR_DB < 59.0
    with pytest.raises(DataError, match="differ in shape"):
        metrics.psnr(torch.zeros(2, 3, 16, 16), torch.zeros(3, 3, 16, 16))
    with pytest.raises(DataError, match="smaller than the SSIM window"):
        metrics.ssim(torch.zeros(2, 3, 8, 16), torch.zeros(2, 3, 8, 16))


def test_lpips_without_weights_says_so(tmp_path):
    with pytest.raises(UnavailableError, match="LPIPS is not available"):
        load_lpips(None)
    with pytest.raises(UnavailableError, match=f"missing .*{HEADS_FILE}"):
        load_lpips(tmp_path)
    torch.save({"features.0.weight": torch.zeros(1)}, tmp_path / BACKBONE_FILE)
    torch.save({}, tmp_path / HEADS_FILE)
    with pytest.raises(UnavailableError, match="another network"):
        load_lpips(tmp_path)


@pytest.mark.slow
def test_lpips_equals_torchmetrics_on_the_same_weights(tmp_path):
    """Checks the network, not its weights: torchmetrics gets the same random ones."""
    reference_module = pytest.importorskip("torchmetrics.functional.image.lpips")
    torch.manual_seed(0)
    reference = reference_module._LPIPS(pretrained=False, net="alex", pnet_rand=True)
    heads = {name: value.abs() for name, value in reference.state_dict().items() if name.startswith("lin")}
    reference.load_state_dict(heads, strict=False)
    numbers = iter(("0", "3", "6", "8", "10"))
    backbone = {}
    for module in reference.net.modules():
        if isinstance(module, torch.nn.Conv2d):
            number = next(numbers)
            backbone |= {f"features.{number}.weight": module.weight, f"features.{number}.bias": module.bias}
    torch.save(backbone, tmp_path / BACKBONE_FILE)
    torch.save({name: value for name, value in heads.items() if not name.startswith("lins")}, tmp_path / HEADS_FILE)
    a, b = torch.rand(2, 2, 3, 64, 96)
    expected = reference(a, b, normalize=True).flatten()
    assert torch.allclose(load_lpips(tmp_path)(a, b), expected, atol=1e-6)
    assert float(expected.min()) > 0


EMPTY = np.zeros((4, 6), dtype=bool)
LEFT = EMPTY.copy()
LEFT[:, :2] = True
MIDDLE = EMPTY.copy()
MIDDLE[:, 1:3] = True


def test_overlap_over_union_of_each_frame_that_shows_something():
    assert metrics.frame_iou(LEFT[None], MIDDLE[None])[0] == pytest.approx(1 / 3)
    assert metrics.frame_iou(np.stack([LEFT, LEFT, EMPTY]), np.stack([LEFT, EMPTY, LEFT])).tolist() == [1.0, 0.0, 0.0]
    assert np.isnan(metrics.frame_iou(EMPTY[None], EMPTY[None]))
    for true, predicted in ((LEFT[None], MIDDLE[None, :2]), (LEFT[None].astype(np.uint8), MIDDLE[None])):
        with pytest.raises(DataError, match="do not fit"):
            metrics.frame_iou(true, predicted)


def _video_with_patch(column):
    video = np.full((1, 64, 96, 3), 90, dtype=np.uint8)
    video[0, 21:40, column - 3 : column + 16] = np.random.default_rng(0).integers(0, 256, (19, 19, 3), dtype=np.uint8)
    return video


def test_end_effector_error_is_the_displacement_of_the_gripper():
    points = np.array([[[46.0, 30.0], [np.nan, np.nan]]])
    true = _video_with_patch(40)
    assert end_effector_error(true, true, points)[0, 0] == 0.0
    assert end_effector_error(true, _video_with_patch(47), points)[0, 0] == 7.0
    assert np.isnan(end_effector_error(true, true, points)[0, 1])
    noise = np.random.default_rng(1).integers(0, 256, (1, 64, 96, 3), dtype=np.uint8)
    assert end_effector_error(true, noise, points)[0, 0] == 16.0  # found nowhere: the search radius


@pytest.mark.parametrize("shape", [(53, 53), (40, 53), (21, 23)])
def test_the_correlation_that_finds_tools_is_opencvs(shape):
    region = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (*shape, 3), np.uint8), (0, 0), 1.5)
    region[:, :4] = 90  # flat
    patch = np.ascontiguousarray(region[-21:, 1:22])
    expected = cv2.matchTemplate(region, patch, cv2.TM_CCOEFF_NORMED)
    np.testing.assert_allclose(normalised_correlation(region, patch), expected, atol=1e-3)
    assert not normalised_correlation(np.full_like(region, 7), patch).any()


def test_a_tool_is_not_found_on_the_table_behind_it():
    """A copied first frame shows the tool 10 pixels too far left, before an unchanged table."""
    table = np.random.default_rng(2).normal(110, 25, (64, 96, 3)).clip(0, 255).astype(np.uint8)
    true, copy = (np.repeat(table[None], 1, axis=0) for _ in range(2))
    for video, column in ((true, 48), (copy, 38)):
        video[0, 28:33, column - 2 : column + 3] = np.array([[[240, 40, 20]]])
        video[0, 30, column] = 10
    points = np.array([[[48.0, 30.0]]])
    assert end_effector_error(true, copy, points)[0, 0] == 0.0
    background = table.astype(np.float32)
    assert end_effector_error(true, copy, points, background)[0, 0] == 10.0
    assert end_effector_error(true, true, points, background)[0, 0] == 0.0


def test_interval_covers_the_true_mean_about_as_often_as_it_says():
    generator = np.random.default_rng(0)
    samples = generator.normal(3.0, 2.0, (200, 40))
    intervals = [bootstrap_mean(values, resamples=300, seed=trial) for trial, values in enumerate(samples)]
    assert 0.88 <= np.mean([interval.low <= 3.0 <= interval.high for interval in intervals]) <= 0.99
    assert bootstrap_mean(samples[0], seed=5) == bootstrap_mean(samples[0], seed=5)
    assert bootstrap_mean(samples[0], seed=5) != bootstrap_mean(samples[0], seed=6)


def test_weights_make_the_mean_one_over_pairs_of_finite_values():
    # Two trajectories: one with three views of 1.0, one with a single view of 0.0.
    assert bootstrap_mean([1.0, 0.0], weights=[3, 1]).mean == pytest.approx(0.75)
    for values in ([1.0, float("nan")], []):
        with pytest.raises(DataError, match="finite"):
            bootstrap_mean(values)


def test_pairing_removes_what_is_hard_for_both():
    generator = np.random.default_rng(2)
    difficulty = {f"t{i}": float(generator.normal(0, 10)) for i in range(30)}
    better = {name: value + 1.0 for name, value in difficulty.items()}
    interval = paired_difference(better, difficulty)
    assert interval.mean == pytest.approx(1.0) and interval.low > 0.9
    # Common trajectories alone count.
    interval = paired_difference({"a": 1.0, "b": 5.0}, {"a": 0.5, "c": 9.0})
    assert (interval.mean, interval.count) == (0.5, 1)
    assert paired_difference({"a": 1.0}, {"b": 1.0}) is None


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
            found = metrics.ToolFinder().find(masks, predicted, points)
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
    finder = metrics.ToolFinder()
    pieces = [finder.find(masks[part], masks[late][part], points[part]) for part in (slice(0, 9), slice(9, None))]
    np.testing.assert_array_equal(np.concatenate(pieces), metrics.ToolFinder().find(masks, masks[late], points))
    nothing = np.zeros((2, 40, 60), dtype=bool)
    assert np.isnan(metrics.ToolFinder().find(nothing, nothing, np.full((2, 1, 2), 20.0))).all()


def test_hausdorff_is_the_farthest_that_either_path_leaves_the_other():
    aside = LINE.copy()
    aside[8, 0, 1] += 4
    assert metrics.hausdorff_score(LINE, aside) == metrics.hausdorff_score(aside, LINE) == pytest.approx(1 / 4)
    assert metrics.hausdorff_score(LINE, LINE[::-1]) == 1.0  # a set of places has no direction
    half = LINE.copy()
    half[9:] = np.nan  # a tool that vanishes is as far as the rest of the path
    assert metrics.hausdorff_score(LINE, half) == pytest.approx(1 / 25)
    assert metrics.time_warping_score(LINE, half) == pytest.approx(17 / (3.125 * np.arange(1, 9).sum()))


def test_time_warping_follows_the_definition():
    def recursive(i, j):
        if i < 0 or j < 0:
            return 0.0 if i == j == -1 else np.inf
        before = min(recursive(i - 1, j - 1), recursive(i - 1, j), recursive(i, j - 1))
        return float(np.linalg.norm(a[i] - b[j])) + before

    a, b = np.random.default_rng(0).normal(size=(5, 2)), np.random.default_rng(1).normal(size=(6, 2))
    assert metrics.time_warping_distance(a, b) == pytest.approx(recursive(4, 5))
    delayed = LINE[np.maximum(np.arange(17) - 1, 0)]
    assert metrics.time_warping_score(LINE, delayed) == 1.0  # a delay is warped away, but for the end
    assert metrics.time_warping_score(LINE, LINE[::-1]) < 0.1  # type: ignore[operator]


def test_dynamics_compare_speeds_and_accelerations():
    twice = LINE[0] + 2 * (LINE - LINE[0])
    # Speeds differ by the true path's own speed; accelerations are zero in both.
    assert metrics.dynamics_score(LINE, twice) == pytest.approx(1 / (1 + 1 / 2))
    bent = LINE.copy()
    bent[9:, 0, 1] += 4.0
    terms = []
    for order in (1, 2):
        own, other = (np.linalg.norm(np.diff(path[:, 0], n=order, axis=0), axis=-1) for path in (LINE, bent))
        terms.append(wasserstein_distance(own, other) / max(own.mean(), 0.1))
    assert metrics.dynamics_score(LINE, bent) == pytest.approx(1 / (1 + sum(terms) / 2))
    assert metrics.dynamics_score(LINE, LINE + 7) == 1.0  # places play no part


@pytest.mark.parametrize("score", [metrics.hausdorff_score, metrics.time_warping_score, metrics.dynamics_score])
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
        assert metrics.action_following(metrics.ControlledPair(LINE, own, other, None)) == pytest.approx(followed)
    for own, other, asked, direction in (
        (LINE, elsewhere, elsewhere, 1.0), (LINE, LINE, elsewhere, 0.5), (elsewhere, LINE, elsewhere, 0.0),
        (LINE, LINE, LINE, None), (LINE, elsewhere, None, None),
    ):  # fmt: skip
        assert metrics.counterfactual_direction(metrics.ControlledPair(LINE, own, other, asked)) == direction


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


@pytest.fixture
def moving_robot():
    """A grey robot that goes to the right before a coloured pattern with two things; its exact masks, and labels of the things."""
    table = np.random.default_rng(1).integers(120, 256, (32, 48, 3), dtype=np.uint8)
    labels, robot = np.zeros((8, 32, 48), np.uint8), np.zeros((8, 32, 48), bool)
    labels[:, 2:6, 2:6], labels[:, 26:30, 40:44] = 1, 2
    for n in range(8):
        robot[n, 10:22, 4 * n : 4 * n + 12] = True
    robot[:, 30:, :4] = True  # always there
    frames = np.where(robot[..., None], 20, np.where(labels[..., None] > 0, (255, 0, 0), table)).astype(np.uint8)
    return frames, robot, labels


def test_the_background_shows_the_robot_and_every_cloud_around_it(moving_robot):
    frames, robot, labels = moving_robot
    background = metrics.Background.of(frames, robot, labels)  # an array, as a video's frames are asked for
    assert not background.uncovered[30:, :4].any() and background.uncovered[10:22, :40].all()
    assert not background.known[3, 3] and background.uncovered[3, 3]
    assert background.robot_iou(robot, frames).min() > 0.7  # less one pixel around it
    clouded = frames.copy()
    clouded[:, 6:26, 20:44] = 90
    assert background.robot_iou(robot, clouded).max() < 0.6
    still = np.repeat(frames[:1], 8, axis=0)
    assert background.robot_iou(robot, still)[-1] == 0.0
    assert (
        background.uncovered_iou(robot, np.repeat(robot[:1], 8, axis=0))[-1] == 0.0
    )  # what is always covered is no merit


def test_still_things_that_change_are_invented_motion(moving_robot):
    frames, robot, labels = moving_robot
    assert not metrics.invented_motion(labels, labels[0], robot, frames, frames[0]).any()
    gone = frames.copy()
    gone[4:, 24:32, 38:46] = 200
    found = metrics.invented_motion(labels, labels[0], robot, gone, frames[0])
    assert (found == [0, 0, 0, 0, 1, 1, 1, 1]).all()
    away = np.where(labels == 2, 0, labels)  # in the recording it moves as well
    away[0] = labels[0]
    assert np.isnan(metrics.invented_motion(away, labels[0], robot, gone, frames[0])[1:]).all()


def test_blurred_and_noisy_pictures_are_not_sharp(moving_robot):
    frames = moving_robot[0]
    blurred = np.stack([cv2.blur(frame, (3, 3)) for frame in frames])
    noisy = np.clip(0.2 * frames.astype(float) + np.random.default_rng(2).normal(128, 60, frames.shape), 0, 255).astype(
        np.uint8
    )
    assert metrics.sharpness(frames, frames).min() == 1.0
    assert max(metrics.sharpness(frames, blurred).max(), metrics.sharpness(blurred, frames).max()) < 0.6
    assert metrics.sharpness(blurred, noisy).max() < 0.6
