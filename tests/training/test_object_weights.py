"""Loss weights from exact masks of things."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from worldline_core.errors import DataError
from worldline_core.training.clip_loader import ObjectWeights, object_weights
from worldline_core.training.clip_sampler import Clip


class Masks:
    """An episode of 9 frames of 16 x 24 pixels: from frame 6 on the moved thing (1) fills the first cell of a 2 x 3 grid."""

    root = "here"

    def __init__(self, known: bool = True) -> None:
        labels = np.zeros((9, 16, 24), np.uint8)
        labels[6:, :8, :8] = 1
        labels[:, 8:, 16:20] = 3  # half of the last cell, always
        self.labels = labels if known else None

    def position(self, episode_id: str) -> int:
        return 0

    def thing_labels(self, position: int, view: str) -> Any:
        return self.labels


def test_cells_of_things_count_more_where_they_are_or_were() -> None:
    weights = ObjectWeights(Masks(), (2, 3), 3.0, 0.5)((Clip("a", 0, 9, 1),), [("head",)])  # type: ignore[arg-type]
    assert weights.shape == (1, 1, 1, 3, 2, 3)
    raw = torch.ones(3, 2, 3)
    raw[2, 0, 0] = 4.0  # the latent frame of frames 5 to 8 takes the largest share of them
    raw[:, 1, 2] = 1 + 0.5 * (127 / 255) ** 0.5
    assert torch.allclose(weights[0, 0, 0], raw / raw[1:].mean(), atol=2e-3)
    assert weights[:, :, :, 1:].mean() == pytest.approx(1, abs=1e-6)


def test_what_was_there_at_the_start_counts_later() -> None:
    shares = torch.zeros(1, 1, 2, 3, 1, 2)
    shares[0, 0, 0, 0, 0, 0] = 1.0
    weights = object_weights(shares, 3.0, 0.0)[0, 0, 0, :, 0]
    assert torch.allclose(weights[:, 0] / weights[:, 1], torch.full((3,), 4.0))


def test_recordings_without_masks_are_refused() -> None:
    with pytest.raises(DataError, match=r"(?s)a, view head.*weighting.things"):
        ObjectWeights(Masks(known=False), (2, 3), 1.0, 0.0)((Clip("a", 0, 9, 1),), [("head",)])  # type: ignore[arg-type]
