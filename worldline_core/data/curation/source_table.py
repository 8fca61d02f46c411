"""Sources of a set (sources.json), and how often training draws each of them (source_weights.json).

A weight per episode by source, as `ClipSampling.source_weights` takes it: sampling by hours alone lets the largest source
drown the others; equal shares repeat the smallest ones too often. A power between them, share ~ hours ** alpha, is what
multilingual and multi-robot training use (Conneau et al. 2020).
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from pydantic import TypeAdapter

from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode_index import EpisodeRow, QuarantineRow
from worldline_core.errors import DataError
from worldline_core.store.atomic import write_json_atomic

SOURCES_FILE = "sources.json"
WEIGHTS_FILE = "source_weights.json"


@dataclass(frozen=True)
class SourceFacts:
    """One configured source.

    Attributes:
        label: its name in quarantine rows. names: what the index calls its episodes' source.
        license, redistribution: as the configuration declares them; "unknown" where it does not.
        reasons: quarantined episodes by reason.
        image_size: (height, width) asked for; None keeps the recorded one. fps, stride: the same.
        conventions: declared departures from the contract, for example how the extrinsics are written.
    """

    label: str
    kind: str
    license: str
    redistribution: str
    names: tuple[str, ...]
    found: int
    kept: int
    reasons: dict[str, int]
    image_size: tuple[int, int] | None
    fps: float | None
    stride: int | None
    conventions: dict[str, str]


def write_source_table(
    output: Path,
    config: CurateConfig,
    listed: Sequence[Sequence[str]],
    rows: Sequence[EpisodeRow],
    rejected: Sequence[QuarantineRow],
) -> None:
    """Write sources.json.

    Args:
        listed: ids in the set of the episodes that each source lists, in the order of config.sources.
    """
    kept = {row.episode_id: row.source for row in rows}
    reason_of = {row.episode_id: row.reason for row in rejected}
    table: list[SourceFacts] = []
    for number, (source, identities) in enumerate(zip(config.sources, listed, strict=True)):
        own = config.for_source(number)
        reasons = Counter(reason_of[identity] for identity in identities if identity in reason_of)
        table.append(
            SourceFacts(
                source.label,
                source.kind,
                source.license,
                source.redistribution,
                tuple(sorted({kept[identity] for identity in identities if identity in kept})),
                len(identities),
                sum(identity in kept for identity in identities),
                dict(sorted(reasons.items())),
                own.image_size,
                own.fps,
                own.stride,
                {name: str(getattr(source.conventions, name)) for name in source.conventions.departures},
            )
        )
    write_json_atomic(output / SOURCES_FILE, [asdict(facts) for facts in table])


def read_source_table(root: Path) -> list[SourceFacts]:
    """Rows of sources.json; empty for a set that does not come from curation.

    Raises: DataError when the file is damaged.
    """
    path = root / SOURCES_FILE
    if not path.is_file():
        return []
    try:
        return TypeAdapter(list[SourceFacts]).validate_json(path.read_bytes())
    except ValueError as error:
        raise DataError("Table of sources is damaged", where=path, got=str(error)) from error


def write_source_weights(output: Path, rows: Sequence[EpisodeRow], alpha: float) -> None:
    """Write source_weights.json: hours, episodes, share (~ hours ** alpha) and weight of each source that trains.

    A weight is that of one episode; the mean over episodes is 1. A sampler that draws episodes by these weights draws a
    source with the probability of its share.
    """
    hours, counts = defaultdict[str, float](float), Counter[str]()
    for row in rows:
        if row.split == "train" and row.stage1_ok:
            hours[row.source] += row.video_frames / row.fps / 3600
            counts[row.source] += 1
    total, episodes = sum(value**alpha for value in hours.values()), sum(counts.values())
    shares = {source: hours[source] ** alpha / total for source in sorted(counts)}
    table = {
        source: {
            "episodes": counts[source],
            "hours": round(hours[source], 6),
            "share": round(share, 9),
            "weight": round(share * episodes / counts[source], 9),
        }
        for source, share in shares.items()
    }
    write_json_atomic(output / WEIGHTS_FILE, table)
