"""Statistics of features as LeRobot stores them: min, max, mean, std, count and quantiles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
_MAX_IMAGES = 32
_LARGE_SIDE = 300
_SAMPLED_SIDE = 150


def vector_statistics(values: np.ndarray) -> dict[str, np.ndarray]:
    """Statistics over axis 0 of (N, D) values; exact, in float64.

    Rows with a value that is not finite are left out (a broken recording can still be stored, and is told apart later).
    """
    data = values.astype(np.float64)
    data = data[:, None] if data.ndim == 1 else data
    count = len(data)
    data = data[np.isfinite(data).all(axis=1)]
    data = data if len(data) else np.zeros((1, values.reshape(count, -1).shape[1]))
    result = {
        "min": data.min(axis=0),
        "max": data.max(axis=0),
        "mean": data.mean(axis=0),
        "std": data.std(axis=0),
        "count": np.array([count], dtype=np.int64),
    }
    levels = np.quantile(data, list(QUANTILES.values()), axis=0)
    return result | dict(zip(QUANTILES, levels, strict=True))


class ImageSampler:
    """Counts the values of some pixels of some pictures, as LeRobot does (datasets/compute_stats.py): at most 32 pictures
    evenly spread, and of images above 300 pixels every k-th pixel of both sides, k such that about 150 remain.

    Args:
        num_frames: of the video.
    """

    def __init__(self, num_frames: int) -> None:
        spread = np.linspace(0, num_frames - 1, min(num_frames, _MAX_IMAGES))
        self._chosen = frozenset(np.unique(spread.round().astype(int)).tolist())
        self.histogram = np.zeros((3, 256), dtype=np.int64)
        """Counts (3, 256) of the 8-bit values of each channel."""

    def wants(self, number: int) -> bool:
        """Whether a picture is one of those to be added."""
        return number in self._chosen

    def add(self, image: np.ndarray) -> None:
        """One of the wanted pictures, uint8 (H, W, 3)."""
        longest = max(image.shape[:2])
        every = longest // _SAMPLED_SIDE if longest >= _LARGE_SIDE else 1
        for channel in range(3):
            self.histogram[channel] += np.bincount(image[::every, ::every, channel].reshape(-1), minlength=256)


def image_statistics(histograms: Sequence[np.ndarray], num_frames: int) -> dict[str, np.ndarray]:
    """Per-channel statistics in 0..1, each of shape (3, 1, 1), exact for the sampled pixels."""
    counts = np.sum(np.stack(histograms), axis=0).astype(np.float64)
    levels = np.arange(256) / 255.0
    total = counts.sum(axis=1)
    mean = counts @ levels / total
    spread = np.maximum(counts @ levels**2 / total - mean**2, 0.0)
    cumulative = np.cumsum(counts, axis=1) / total[:, None]
    channels: dict[str, np.ndarray] = {
        "min": np.array([levels[np.flatnonzero(row)[0]] for row in counts]),
        "max": np.array([levels[np.flatnonzero(row)[-1]] for row in counts]),
        "mean": mean,
        "std": np.sqrt(spread),
    }
    for name, level in QUANTILES.items():
        channels[name] = np.array([levels[np.searchsorted(row, level)] for row in cumulative])
    shaped: dict[str, np.ndarray] = {name: value[:, None, None] for name, value in channels.items()}
    return shaped | {"count": np.array([num_frames], dtype=np.int64)}


def as_json(statistics: dict[str, dict[str, np.ndarray]]) -> dict[str, Any]:
    """Nested lists, for meta/stats.json."""
    return {key: {name: value.tolist() for name, value in feature.items()} for key, feature in statistics.items()}
