"""Detection in pictures: coloured things, in crisp and in faded ones, and the robot by each segmenter."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tests.evaluation.conftest import make_film  # pyright: ignore[reportMissingImports]
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ArtifactError, DataError, UnavailableError
from worldline_core.evaluation.evaluation_config import SegmenterConfig
from worldline_core.evaluation.metrics import frame_iou
from worldline_core.evaluation.policy import measured_judge
from worldline_core.evaluation.policy.judge import establishes_success, route
from worldline_core.evaluation.segmenters import coloured_things as things
from worldline_core.evaluation.segmenters import learned
from worldline_core.evaluation.segmenters.kinematic_masks import kinematic_masks
from worldline_core.evaluation.segmenters.segmenter import ColourSegmenter, Sam3Segmenter, open_segmenter
from worldline_core.rehearsal.outside_models import write_sam3
from worldline_core.store.artifact_files import digest_folder

CUBE = things.ColouredThing("red", "cube")


def faded(frames, share):
    """The first frame as it is, the others mixed with grey: ``share`` of the colour is left."""
    out = frames.astype(np.float32)
    out[1:] = share * out[1:] + (1 - share) * 110.0
    return out.round().astype(np.uint8)


def lift_score(success, share):
    frames, masks, _ = make_film(success, seed=3)
    shown = {view: faded(video, share) for view, video in frames.items()}
    return measured_judge.measure_lift(shown, CUBE, masks[-measured_judge.LATE_COUNT :], 1).score()


@pytest.mark.parametrize("share", [1.0, 0.6, 0.45])
def test_a_lifted_cube_ranks_first_even_where_it_has_faded(share):
    assert lift_score(True, share) > lift_score(False, share) + 0.3


def test_what_has_faded_is_lost_to_the_colour_word_but_not_to_its_own_colour():
    frames, _, _ = make_film(False, seed=3)
    pale = faded(frames["head"], 0.45)
    own = things.own_colour(pale, "red")
    assert own.rgb == pytest.approx([220, 20, 20], abs=6)
    assert things.colour_share(pale, "red")[-1].sum() < 0.3 * things.colour_share(pale, "red")[0].sum()
    areas = things.likeness(pale, own).sum(axis=(1, 2))
    assert areas[-1] == pytest.approx(areas[0], rel=0.2)


def test_a_thing_is_known_by_its_own_colour_alone():
    own = things.OwnColour(np.array([220, 20, 20], np.float32), 0.2)
    for other in ((20, 20, 220), (20, 200, 20), (120, 120, 120), (230, 130, 20)):
        assert things.likeness(np.full((1, 4, 4, 3), other, np.uint8), own).max() == 0
    assert things.named_things("lift the green cube") == (things.ColouredThing("green", "cube"),)
    assert things.own_colour(make_film(True, seed=1)[0]["head"], "green") is None  # it is not seen early
    frames = np.full((9, 48, 72, 3), (172, 140, 110), np.uint8)  # orange, but pale
    frames[:, 20:27, 30:37] = (235, 130, 20)
    assert things.likeness(frames, things.own_colour(frames, "orange"))[0].sum() == pytest.approx(49, rel=0.02)


def painted(*boxes):
    """A frame of a grey table with red boxes."""
    frame = np.full((48, 72, 3), 120, np.uint8)
    for box in boxes:
        frame[box] = (220, 20, 20)
    return frame


def test_a_button_that_lights_up_is_pressed_though_something_hides_a_part_of_it():
    cap, plate = (slice(20, 27), slice(30, 37)), (slice(18, 30), slice(27, 40))
    pressed = np.stack([painted(cap)] * 5 + [painted(plate)] * 3)
    pressed[-2, 18:24] = 120
    left = np.stack([painted(cap)] * 8)
    instruction = "press the red button"
    for frames, growth, done in ((pressed, 156 / 49, True), (left, 1.0, False)):
        measured = measured_judge.measure(ColourSegmenter(), instruction, route(instruction), {"head": frames}, None)
        assert measured.growth == pytest.approx(growth, rel=0.02)
        assert (
            establishes_success(measured_judge.facts(measured, instruction, "state_change"))
            is (measured.score() > 0.5)
            is done
        )
    unseen = measured_judge.measure_press({"head": np.stack([painted()] * 8)}, things.ColouredThing("red", "button"))
    assert unseen == measured_judge.PressMeasurement(None)
    assert not establishes_success(measured_judge.facts(unseen, instruction, "state_change"))


@pytest.mark.parametrize("towards_the_camera", [True, False])
@pytest.mark.parametrize(("rows", "closed"), [(2, True), (8, False)])
def test_a_drawer_is_closed_when_little_of_it_is_left(towards_the_camera, rows, closed):
    left = slice(30 - rows, 30) if towards_the_camera else slice(10, 10 + rows)
    frames = np.stack([painted((shown, slice(30, 45))) for shown in [slice(10, 30)] * 5 + [left] * 3])
    instruction = "push the red drawer closed"
    measured = measured_judge.measure(ColourSegmenter(), instruction, route(instruction), {"head": frames}, None)
    assert measured.remaining == pytest.approx(rows / 20, abs=0.02)
    facts = measured_judge.facts(measured, instruction, "state_change")
    assert establishes_success(facts) is (measured.score() > 0.5) is closed


def test_a_drawer_that_the_robot_hides_is_not_closed():
    frames = np.stack([painted((slice(10, 30), slice(30, 45)))] * 5 + [painted()] * 3)
    robot = np.zeros((3, 48, 72), bool)
    robot[:, 12:32, 30:45] = True
    drawer = things.ColouredThing("red", "drawer")
    assert measured_judge.measure_push({"head": frames}, drawer, robot).remaining is None
    robot[:, 12:18] = False
    assert measured_judge.measure_push({"head": frames}, drawer, robot).remaining == 0


@pytest.mark.parametrize(
    ("touched", "hands", "held", "firmly"), [(6, 1, 0, 0), (9, 1, 1, 0), (12, 1, 1, 1), (9, 2, 0, 0), (12, 2, 1, 1)]
)
def test_two_hands_touch_more_of_a_thing_than_one_and_a_firm_hand_more_than_another(touched, hands, held, firmly):
    """``touched`` of 20 columns are within a third of the thing's size, 5 pixels, of the robot."""
    frames = np.stack([painted((rows, slice(30, 50))) for rows in [slice(30, 40)] * 5 + [slice(10, 20)] * 3])
    robot = np.zeros((3, 48, 72), bool)
    robot[:, 8:22, 20 : 25 + touched] = True
    measured = measured_judge.measure_lift({"head": frames}, things.ColouredThing("red", "block"), robot, hands)
    assert (measured.held, measured.held_firmly) == (held, firmly)


def test_a_wide_thing_rises_in_units_of_its_height():
    frames = np.stack([painted((rows, slice(10, 60))) for rows in [slice(34, 38)] * 5 + [slice(24, 28)] * 3])
    measured = measured_judge.measure_lift(
        {"head": frames}, things.ColouredThing("red", "tray"), np.zeros((3, 48, 72), bool), 2
    )
    assert measured.rise == pytest.approx(10 / 4, rel=0.35)


CONFIG = SegmenterConfig(widths=(8, 16), steps=4, batch_size=2, checkpoint_every=1, frame_stride=4)


@pytest.fixture
def training(recordings, monkeypatch):
    """The small recordings, with every episode taken for a training one."""
    select = EpisodeSet.select
    monkeypatch.setattr(EpisodeSet, "select", lambda self, **values: select(self))
    return {"episodes": recordings.inputs["episodes"]}


@pytest.mark.slow
def test_killed_training_continues_to_the_same_bytes(recordings, training, tmp_path, monkeypatch, killed_after):
    whole, resumed = tmp_path / "whole", tmp_path / "resumed"
    result = learned.train_segmenter(CONFIG, training, whole)
    assert result["videos"] == result["kept"] == 4
    assert result["found"] == result["kept"] + sum(result["left_out"].values())
    with killed_after(2):
        learned.train_segmenter(CONFIG, training, resumed)
    learned.train_segmenter(CONFIG, training, resumed)
    assert digest_folder(whole) == digest_folder(resumed)
    masks = learned.LearnedSegmenter.load(whole).segment(np.zeros((2, 30, 50, 3), np.uint8))
    assert (masks.shape, masks.dtype) == ((2, 30, 50), bool)
    monkeypatch.setattr(EpisodeSet, "robot_masks", lambda self, index, view: None)
    with pytest.raises(DataError, match="has robot masks"):
        learned.train_segmenter(CONFIG, training, tmp_path / "without")
    kinematic = CONFIG.model_copy(update={"labels": "kinematic"})
    assert (
        learned.train_segmenter(kinematic, training | {"tracks": recordings.inputs["tracks"]}, tmp_path / "k")["kept"]
        == 4
    )


@pytest.mark.parametrize("size", [(48, 72), (192, 288)])
def test_kinematic_masks_end_where_the_robots_colours_end(size):
    """A dark link of 2 cm within a capsule of 10 cm, one metre before the camera."""
    height, width = size
    f = 1.5 * height
    K = np.array([[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1]])
    ends = np.broadcast_to(np.array([[0, -0.2, 1], [0, 0.2, 1]]), (2, 1, 2, 3))
    tracks = SimpleNamespace(
        views=("head", "right_wrist"), camera_motion=("static", "absent"), capsules=ends, capsule_radii=np.array([0.1]),
        K=np.stack([K, K]), T_base_camera=np.broadcast_to(np.eye(4), (2, 2, 4, 4)), image_size=size,
    )  # fmt: skip
    frames = np.random.default_rng(0).integers(150, 170, (2, height, width, 3), dtype=np.uint8)
    true = np.zeros((height, width), bool)
    true[round(height * 0.2) : round(height * 0.8), round(width / 2 - 0.04 * f) : round(width / 2 + 0.04 * f)] = True
    frames[:, true] = 40
    masks = kinematic_masks(tracks, "head", np.arange(2), frames)
    assert (masks & true).sum() / (masks | true).sum() > 0.85
    assert kinematic_masks(tracks, "right_wrist", np.arange(2), frames) is None


def test_the_network_learns_a_mask():
    """A few dozen steps on one frame pair suffice for a dark block on grey."""
    torch.manual_seed(0)
    frames = torch.full((2, 3, 16, 24), 0.6)
    masks = torch.zeros(2, 16, 24)
    masks[0, 4:12, 4:12] = masks[1, 6:14, 12:20] = 1
    frames[masks[:, None].expand_as(frames) > 0] = 0.1
    network = learned.UNet((8, 16))
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)
    for _ in range(40):
        loss, _ = learned.MaskObjective(network).loss(
            learned.MaskBatch(("a", "b"), frames, masks), torch.Generator(), 0
        )
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    video = (frames * 255).round().byte().permute(0, 2, 3, 1).numpy()
    assert np.nanmean(frame_iou(masks.numpy() > 0, learned.LearnedSegmenter(network).segment(video))) > 0.9


def test_augmentation_moves_masks_with_frames_and_is_seeded():
    masks = torch.zeros(8, 32, 48)
    masks[:, 10:22, 18:34] = 1
    frames = masks[:, None].repeat(1, 3, 1, 1) * 0.8 + 0.1
    moved, moved_masks = learned.augment(frames, frames, masks, torch.Generator().manual_seed(0))
    again, _ = learned.augment(frames, frames, masks, torch.Generator().manual_seed(0))
    assert torch.equal(moved, again)
    assert not torch.equal(moved_masks, masks)
    inside = (moved.mean(1) * moved_masks).sum((1, 2)) / moved_masks.sum((1, 2))
    outside = (moved.mean(1) * (1 - moved_masks)).sum((1, 2)) / (1 - moved_masks).sum((1, 2))
    assert bool((inside > outside + 0.05).all())
    assert 0 <= float(moved.min()) < float(moved.max()) <= 1


def test_colour_segmenter_finds_the_robot_from_points_of_the_first_frame():
    frames, masks, points = make_film(True, seed=1)
    predicted = ColourSegmenter().segment(frames["head"], points)
    assert np.nanmean(frame_iou(masks, predicted)) > 0.8
    unknown = np.full_like(points, np.nan)
    assert not ColourSegmenter().segment(frames["head"], None).any()
    assert not ColourSegmenter().segment(frames["head"], unknown).any()
    unknown[0] = points[0]
    assert np.array_equal(predicted, ColourSegmenter().segment(frames["head"], unknown))


@pytest.mark.parametrize(
    ("kind", "given", "error", "message"),
    [
        ("learned", False, ArtifactError, "no weights"), ("learned", True, ArtifactError, "Not a trained segmenter"),
        ("sam3", False, UnavailableError, "needs local weights"), ("sam3", True, UnavailableError, "weights not found"),
    ],
)  # fmt: skip
def test_missing_weights_are_named(tmp_path, kind, given, error, message):
    with pytest.raises(error, match=message):
        open_segmenter(kind, **{"learned": None, "sam3": None, kind: tmp_path if given else None})


def in_pieces(segmenter, video, points):
    stream = segmenter.stream()
    return np.concatenate([stream(video[part], points[part]) for part in (slice(2), slice(2, 3), slice(3, None))])


@pytest.mark.parametrize("segmenter", [ColourSegmenter(), learned.LearnedSegmenter(learned.UNet())])
def test_videos_are_masked_piece_by_piece_as_at_once(segmenter):
    frames, _, points = make_film(True, seed=1)
    whole = segmenter.segment(frames["head"], points)
    segmenter.stream()(frames["head"][::-1], points[::-1])  # between the pieces of one video others are masked
    assert np.array_equal(in_pieces(segmenter, frames["head"], points), whole)


@pytest.mark.slow
def test_sam3_classes_at_small_random_size(tmp_path):
    """The real tracker and processor classes out of a folder as published, random weights: shapes, prompts, loading."""
    torch.manual_seed(0)
    write_sam3(tmp_path)
    segmenter = Sam3Segmenter.load(tmp_path)
    video = np.random.default_rng(0).integers(0, 256, (4, 64, 96, 3), dtype=np.uint8)
    points = np.full((4, 2, 2), np.nan)
    assert not segmenter.segment(video, points).any()
    points[:, 0] = (30, 30)
    one = segmenter.segment(video, points)
    assert (one.shape, one.dtype) == ((4, 64, 96), bool)
    points[0, 1] = (200, 30)  # outside of the frame: ignored
    assert np.array_equal(segmenter.segment(video, points), one)
    assert np.array_equal(in_pieces(segmenter, video, points), one)
    assert np.array_equal(Sam3Segmenter.load(tmp_path).segment(video, points), one)
