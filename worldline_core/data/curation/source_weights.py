"""How often each source is drawn in training: a weight per episode by source, as `ClipSampling.source_weights` takes it.

Sampling by hours alone lets the largest source drown the others; equal shares repeat the smallest ones too often. A
power between them, share ~ hours ** alpha, is what multilingual and multi-robot training use (Conneau et al. 2020).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from pydantic import Field

from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.errors import ConfigError, DataError
from worldline_core.store.atomic import write_json_atomic

WEIGHTS_FILE = "source_weights.json"
TRAINING_SPLIT = "train"


class SourceSampling(StrictModel):
    """Shares of the sources in training."""

    alpha: float = Field(default=1.0, ge=0, le=1, description="share ~ hours ** alpha: 1 by hours, 0 all equal")
    shares: dict[str, float] | None = Field(
        default=None, description="source -> share, given instead; every source that trains must be named"
    )


def source_weights(rows: Sequence[EpisodeRow], sampling: SourceSampling) -> dict[str, float]:
    """Weight of one episode of each source that trains; the mean over episodes is 1.

    A sampler that draws episodes by these weights draws source s with probability share_s / sum of shares.

    Raises: ConfigError when given shares leave a source out, name an unknown one, or are not positive.
    """
    hours, counts = _hours_and_counts(rows)
    if not counts:
        return {}
    if sampling.shares is None:
        shares = {source: hours[source] ** sampling.alpha for source in hours}
    else:
        shares = sampling.shares
        if set(shares) != set(counts) or min(shares.values()) < 0 or sum(shares.values()) <= 0:
            raise ConfigError(
                "Shares do not fit the sources that train",
                where="curate.sampling.shares",
                expected=", ".join(f"{source}: a share of at least 0" for source in sorted(counts)),
                got=", ".join(f"{source}: {share}" for source, share in sorted(shares.items())),
            )
    total, episodes = sum(shares.values()), sum(counts.values())
    return {source: shares[source] / total * episodes / counts[source] for source in sorted(counts)}


def write_source_weights(output: Path, rows: Sequence[EpisodeRow], sampling: SourceSampling) -> None:
    """Write source_weights.json: hours, episodes, weight and share of each source that trains."""
    weights, (hours, counts) = source_weights(rows, sampling), _hours_and_counts(rows)
    total = sum(counts.values())
    table = {
        source: {
            "episodes": counts[source],
            "hours": round(hours[source], 6),
            "share": round(weight * counts[source] / total, 9),
            "weight": round(weight, 9),
        }
        for source, weight in weights.items()
    }
    write_json_atomic(output / WEIGHTS_FILE, table)


def read_source_weights(root: Path) -> dict[str, float]:
    """Weights of a curated set, as `ClipSampling.source_weights` takes them.

    Raises: DataError when the set has none, or the file is damaged.
    """
    path = root / WEIGHTS_FILE
    if not path.is_file():
        raise DataError("Set has no sampling weights", where=str(path), next_step="curate again")
    try:
        return {source: float(entry["weight"]) for source, entry in json.loads(path.read_text()).items()}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise DataError("Table of sampling weights is damaged", where=str(path), got=str(error)) from error


def _hours_and_counts(rows: Sequence[EpisodeRow]) -> tuple[dict[str, float], dict[str, int]]:
    """Hours of video and number of episodes by source, of the episodes that train."""
    hours: dict[str, float] = {}
    counts: dict[str, int] = {}
    for row in rows:
        if row.split == TRAINING_SPLIT and row.stage1_ok:
            hours[row.source] = hours.get(row.source, 0.0) + row.video_frames / row.fps / 3600
            counts[row.source] = counts.get(row.source, 0) + 1
    return hours, counts
