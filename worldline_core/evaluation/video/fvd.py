"""Fréchet Video Distance (Unterthiner et al. 2018, arXiv 1812.01717) of head views, with I3D from a local file.

The file is the TorchScript export of I3D trained on Kinetics-400 that FVD is usually computed with (``i3d_torchscript.pt``:
called with ``rescale=True, resize=True, return_features=True`` on (b, 3, t, h, w) in 0..255, it gives (b, 400)). It is opened
by TorchScript's own reader, not by pickle, and nothing is downloaded; but it is a program, so take it from where you trust.
The distance of two small sets of videos is biased upwards: compare only methods over the same recordings.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from einops import rearrange

from worldline_core.errors import UnavailableError
from worldline_core.evaluation.scores import Interval

LEAST_FRAMES = 10  # shorter videos do not pass through I3D's strides
LEAST_VIDEOS = 2
_RESAMPLES = 200
Features = Callable[[np.ndarray], np.ndarray]
"""Of one video, uint8 (n, h, w, 3), its features (channels,)."""
FrechetDistances = tuple[dict[str, dict[str, dict[str, Any]]], dict[str, list[dict[str, Any]]]]
"""Intervals by group and method, and paired differences by group, as `scores.summarise` gives them."""


def open_i3d(path: Path | None) -> Features:
    """The features of I3D in a local file.

    Raises: UnavailableError without the file, or when it is no TorchScript.
    """
    if path is None or not path.is_file():
        raise UnavailableError(
            "FVD is not available", where=path, expected="the TorchScript file of I3D",
            got="no file" if path else "no weights configured", next_step="set evaluate_video.fvd_weights",
        )  # fmt: skip
    try:
        network = torch.jit.load(str(path), map_location="cpu").eval()
    except RuntimeError as error:
        raise UnavailableError("FVD is not available: no TorchScript", where=path, got=str(error)[:200]) from error

    @torch.no_grad()
    def features(video: np.ndarray) -> np.ndarray:
        clip = rearrange(torch.from_numpy(np.ascontiguousarray(video)).float(), "t h w c -> 1 c t h w")
        return network(clip, rescale=True, resize=True, return_features=True)[0].double().numpy()

    return features


def frechet_distance(true: np.ndarray, predicted: np.ndarray) -> float:
    """|m - m'|^2 + tr(C + C' - 2 (C C')^(1/2)) of the Gaussians fitted to features (n, c) and (m, c).

    The trace of the root is the sum of the singular values of X X'^T / ((n - 1)(m - 1))^(1/2), X and X' the centred
    features: no root of a c by c matrix, which few videos leave singular, is needed.
    """
    centred = [values - values.mean(axis=0) for values in (true, predicted)]
    spread = [np.square(values).sum() / (len(values) - 1) for values in centred]
    roots = np.linalg.svd(centred[0] @ centred[1].T, compute_uv=False).sum()
    shared = roots / np.sqrt((len(true) - 1.0) * (len(predicted) - 1.0))
    mean = np.square(true.mean(axis=0) - predicted.mean(axis=0)).sum()
    return float(max(mean + sum(spread) - 2 * shared, 0.0))


def distances(
    features: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]],
    groups: Mapping[str, Sequence[str]],
    comparisons: Sequence[tuple[str, str]],
    seed: int,
) -> FrechetDistances:
    """Of several methods over the same recordings, resampled together.

    Args:
        features: by method and episode, of the true and of the predicted video (of equal length and rate).
        groups: names of the episodes of each group.
    """
    metrics: dict[str, dict[str, dict[str, Any]]] = defaultdict(dict)
    differences: dict[str, list[dict[str, Any]]] = defaultdict(list)

    def values(method: str, names: Sequence[str], chosen: np.ndarray) -> np.ndarray:
        true, predicted = (np.stack([features[method][name][side] for name in names]) for side in (0, 1))
        return np.array([frechet_distance(true[rows], predicted[rows]) for rows in chosen])

    for group, names in groups.items():
        for first, second in [*((method, None) for method in sorted(features)), *comparisons]:
            own = [
                n for n in names if n in features.get(first, {}) and (second is None or n in features.get(second, {}))
            ]
            if len(own) < LEAST_VIDEOS:
                continue
            draws = np.random.default_rng(seed).integers(0, len(own), (_RESAMPLES, len(own)))
            # A draw of one recording alone has no spread to fit a Gaussian to.
            draws = np.stack([np.arange(len(own)), *(row for row in draws if len(set(row.tolist())) > 1)])
            found = values(first, own, draws) - (0 if second is None else values(second, own, draws))
            low, high = np.quantile(found[1:], [0.025, 0.975]) if len(found) > 1 else (found[0], found[0])
            interval = asdict(Interval(float(found[0]), float(low), float(high), len(own)))
            if second is None:
                metrics[group][first] = interval
            else:
                differences[group].append({"first": first, "second": second, "metric": "fvd@head", **interval})
    return metrics, differences
