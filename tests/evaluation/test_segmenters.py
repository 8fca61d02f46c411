from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from worldline_core.errors import ArtifactError, DataError, UnavailableError
from worldline_core.evaluation.evaluation_config import SegmenterConfig
from worldline_core.evaluation.metrics import frame_iou
from worldline_core.evaluation.segmenters.learned import (
    LearnedSegmenter,
    MaskBatch,
    MaskObjective,
    UNet,
    augment,
    train_segmenter,
)
from worldline_core.evaluation.segmenters.segmenter import ColourSegmenter, Sam3Segmenter, open_segmenter
from worldline_core.rehearsal.outside_models import write_sam3
from worldline_core.training import trainer

CONFIG = SegmenterConfig(widths=(8, 16), steps=4, batch_size=2, checkpoint_every=1, frame_stride=4)


@pytest.fixture
def training(recordings, monkeypatch) -> Path:
    """The small recordings, with every episode taken for a training one."""
    from worldline_core.data.episodes.episode_set import EpisodeSet

    select = EpisodeSet.select
    monkeypatch.setattr(EpisodeSet, "select", lambda self, **values: select(self))
    return recordings.inputs["episodes"]


def test_killed_training_continues_to_the_same_bytes(training, tmp_path, monkeypatch):
    whole, resumed = tmp_path / "whole", tmp_path / "resumed"
    result = train_segmenter(CONFIG, {"episodes": training}, whole)
    assert result["videos"] == result["kept"] == 4
    assert result["found"] == result["kept"] + sum(result["left_out"].values())
    save = trainer.TrainingStates.save

    def killed(states, facts):
        save(states, facts)
        if facts["step"] == 2:
            raise KeyboardInterrupt("killed")

    with monkeypatch.context() as patch:
        patch.setattr(trainer.TrainingStates, "save", killed)
        with pytest.raises(KeyboardInterrupt, match="killed"):
            train_segmenter(CONFIG, {"episodes": training}, resumed)
    train_segmenter(CONFIG, {"episodes": training}, resumed)
    for name in ("model.safetensors", "segmenter.json", "metrics.jsonl"):
        assert (whole / name).read_bytes() == (resumed / name).read_bytes()
    masks = LearnedSegmenter.load(whole).segment(np.zeros((2, 30, 50, 3), np.uint8))
    assert (masks.shape, masks.dtype) == ((2, 30, 50), bool)


def test_the_network_learns_a_mask():
    """A few dozen steps on one frame pair suffice for a dark block on grey."""
    torch.manual_seed(0)
    frames = torch.full((2, 3, 16, 24), 0.6)
    masks = torch.zeros(2, 16, 24)
    masks[0, 4:12, 4:12] = masks[1, 6:14, 12:20] = 1
    frames[masks[:, None].expand_as(frames) > 0] = 0.1
    network = UNet((8, 16))
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)
    for _ in range(40):
        loss, _ = MaskObjective(network).loss(MaskBatch(("a", "b"), frames, masks), torch.Generator(), 0)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    video = (frames * 255).round().byte().permute(0, 2, 3, 1).numpy()
    assert np.nanmean(frame_iou(masks.numpy() > 0, LearnedSegmenter(network).segment(video))) > 0.9


def test_shipped_default_is_small():
    assert sum(parameter.numel() for parameter in UNet().parameters()) <= 500_000


def test_augmentation_moves_masks_with_frames_and_is_seeded():
    masks = torch.zeros(8, 32, 48)
    masks[:, 10:22, 18:34] = 1
    frames = masks[:, None].repeat(1, 3, 1, 1) * 0.8 + 0.1
    moved, moved_masks = augment(frames, frames, masks, torch.Generator().manual_seed(0))
    again, _ = augment(frames, frames, masks, torch.Generator().manual_seed(0))
    assert torch.equal(moved, again)
    assert not torch.equal(moved_masks, masks)
    inside = (moved.mean(1) * moved_masks).sum((1, 2)) / moved_masks.sum((1, 2))
    outside = (moved.mean(1) * (1 - moved_masks)).sum((1, 2)) / (1 - moved_masks).sum((1, 2))
    assert bool((inside > outside + 0.05).all())
    assert float(moved.min()) >= 0
    assert float(moved.max()) <= 1


def test_colour_segmenter_finds_the_robot_from_points_of_the_first_frame(film):
    frames, masks, points = film(True, seed=1)
    later_unknown = points.copy()
    later_unknown[1:] = np.nan
    predicted = ColourSegmenter().segment(frames["head"], later_unknown)
    assert np.nanmean(frame_iou(masks, predicted)) > 0.8
    assert np.array_equal(predicted, ColourSegmenter().segment(frames["head"], points))
    assert not ColourSegmenter().segment(frames["head"], None).any()
    assert not ColourSegmenter().segment(frames["head"], np.full_like(points, np.nan)).any()


def test_missing_weights_are_named(tmp_path, training):
    with pytest.raises(ArtifactError, match="no weights"):
        open_segmenter("learned", learned=None, sam3=None)
    with pytest.raises(ArtifactError, match="Not a trained segmenter"):
        open_segmenter("learned", learned=tmp_path, sam3=None)
    with pytest.raises(UnavailableError, match="needs local weights"):
        open_segmenter("sam3", learned=None, sam3=None)
    with pytest.raises(UnavailableError, match="weights not found"):
        open_segmenter("sam3", learned=None, sam3=tmp_path)
    (tmp_path / "segmenter.json").write_text("{")
    (tmp_path / "model.safetensors").write_bytes(b"x")
    with pytest.raises(ArtifactError, match="cannot be read"):
        open_segmenter("learned", learned=tmp_path, sam3=None)


def test_training_needs_masks(training, tmp_path, monkeypatch):
    from worldline_core.data.episodes.episode_set import EpisodeSet

    monkeypatch.setattr(EpisodeSet, "robot_masks", lambda self, index, view: None)
    with pytest.raises(DataError, match="exact robot masks"):
        train_segmenter(CONFIG, {"episodes": training}, tmp_path)


def in_pieces(segmenter: Any, video: np.ndarray, points: np.ndarray) -> np.ndarray:
    stream = segmenter.stream()
    return np.concatenate([stream(video[part], points[part]) for part in (slice(2), slice(2, 3), slice(3, None))])


def test_videos_are_masked_piece_by_piece_as_at_once(film, training):
    frames, _, points = film(True, seed=1)
    learned = LearnedSegmenter(UNet())
    for segmenter in (ColourSegmenter(), learned):
        whole = segmenter.segment(frames["head"], points)
        # Between the pieces of one video others are masked.
        other = segmenter.stream()
        other(frames["head"][::-1], points[::-1])
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
