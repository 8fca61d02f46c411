"""What a set was made from: its sources with their licences, and how much of each came through (sources.json)."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode_index import EpisodeRow, QuarantineRow
from worldline_core.errors import DataError
from worldline_core.store.atomic import write_json_atomic

SOURCES_FILE = "sources.json"


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
        return [
            SourceFacts(**(row | {"names": tuple(row["names"]), "image_size": _size(row["image_size"])}))
            for row in json.loads(path.read_text())
        ]
    except (ValueError, TypeError, KeyError) as error:
        raise DataError("Table of sources is damaged", where=str(path), got=str(error)) from error


def _size(value: Sequence[int] | None) -> tuple[int, int] | None:
    return None if value is None else (value[0], value[1])
