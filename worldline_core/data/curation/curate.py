"""Curation: recordings of several formats in, one EpisodeSet out; every input is kept or quarantined with a reason."""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tqdm import tqdm

from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.curation.rules import decided_findings
from worldline_core.data.curation.shard import (
    CurateShard,
    ListedEpisode,
    account,
    curate_shard,
    open_writer,
    opened_source,
    quarantine_crashed,
)
from worldline_core.data.curation.source_table import write_source_table
from worldline_core.data.curation.source_weights import write_source_weights
from worldline_core.data.episodes.episode_index import read_index, read_quarantine
from worldline_core.data.episodes.episode_set_writer import VIDEOS_FILE, EpisodeSetWriter
from worldline_core.data.guards.plain_files import read_json
from worldline_core.data.guards.rejection import unique_identity
from worldline_core.scale.mapping import SerialMapper, ShardMapper, cut, run_jobs
from worldline_core.scale.shard_manifest import (
    check_account,
    read_merged_manifest,
    read_shard_manifests,
    write_merged_manifest,
)


def curate(
    config: CurateConfig, inputs: Mapping[str, Path], output: Path, mapper: ShardMapper | None = None
) -> dict[str, Any]:
    """Read all sources into an EpisodeSet at `output`.

    Args:
        inputs: "source.<n>" -> folder of sources[n]; a source that is not named is read from its configured path.
        mapper: what does the shards, by default this process. The set does not depend on it.

    Returns:
        {"found", "kept", "quarantined", "reasons", "splits", "videos" (copied and encoded)}; kept + quarantined = found.

    Raises: DataError when a source cannot be opened, nothing is kept, or a scene is both in training and in test;
        ConfigError when recordings for evaluation only are assigned to training; UnreachableInputError when inputs
        could not be read for a reason that passes (what is done stays, the next call does the rest).
    """
    mapper = mapper or SerialMapper()
    try:
        shards = _shards(config, inputs, output, mapper.episodes_per_shard)
        identities = [episode.identity for shard in shards for episode in shard.episodes]
        if not EpisodeSetWriter.finished(output):
            _work(config, shards, identities, output, mapper)
        _describe(config, shards, output)
    finally:
        opened_source.cache_clear()
    return _counts(output, identities)


def _shards(config: CurateConfig, inputs: Mapping[str, Path], output: Path, size: int) -> list[CurateShard]:
    """Every episode that the sources list, in their order, cut into shards of one source each."""
    shards: list[CurateShard] = []
    seen: set[str] = set()
    run, text = uuid.uuid4().hex, config.model_dump_json()
    for number, source_config in enumerate(config.sources):
        root = str(inputs.get(f"source.{number}", source_config.path))
        source = opened_source(run, text, number, root)
        episodes: list[ListedEpisode] = []
        for listed_id in filter(source_config.includes, source.episode_ids()):
            repeated = listed_id in seen
            identity = unique_identity(listed_id, number, seen)
            seen |= {identity, listed_id}
            episodes.append(ListedEpisode(identity, listed_id, repeated))
        for piece in cut(episodes, size):
            shards.append(CurateShard(len(shards), run, text, number, root, str(output), tuple(piece)))
    return shards


def _work(
    config: CurateConfig, shards: list[CurateShard], identities: list[str], output: Path, mapper: ShardMapper
) -> None:
    writer = open_writer(config, output)
    todo = [shard for shard in shards if not all(writer.has(episode.identity) for episode in shard.episodes)]
    with tqdm(total=len(identities), desc="curate", unit="episode", disable=None) as progress:
        progress.update(len(identities) - sum(len(shard) for shard in todo))
        run_jobs(mapper, curate_shard, todo, done=progress.update, crashed=quarantine_crashed)
    _take_out(config, shards, writer, output)
    write_merged_manifest(output, account(writer, output, identities, read_shard_manifests(output)))
    writer.close()


def _take_out(config: CurateConfig, shards: list[CurateShard], writer: EpisodeSetWriter, output: Path) -> None:
    """Quarantine what the rules over the whole set refuse: duplicates, leaking scenes.

    Raises: DataError when a scene is both learnt from and tested on.
    """
    labels = {episode.identity: config.sources[shard.source].label for shard in shards for episode in shard.episodes}
    kept = {part["episode_id"]: part for part in writer.kept()}
    findings = decided_findings(config, [kept[identity] for identity in labels if identity in kept], output)
    for row in findings.rows:
        writer.quarantine(row.episode_id, labels[row.episode_id], row.reason, row.detail, row.numbers)
        writer.discard(row.episode_id)


def _describe(config: CurateConfig, shards: list[CurateShard], output: Path) -> None:
    """Write what the finished set does not say of itself: its sources with their licences, their weights in training."""
    listed: list[list[str]] = [[] for _ in config.sources]
    for shard in shards:
        listed[shard.source] += [episode.identity for episode in shard.episodes]
    rows = read_index(output)
    write_source_table(output, config, listed, rows, read_quarantine(output))
    write_source_weights(output, rows, config.sampling)


def _counts(output: Path, identities: list[str]) -> dict[str, Any]:
    rows, rejected = read_index(output), read_quarantine(output)
    kept, quarantined = {row.episode_id for row in rows}, {row.episode_id for row in rejected}
    check_account(len(identities), kept, quarantined, read_merged_manifest(output), output)
    reasons: dict[str, int] = {}
    for rejection in rejected:
        reasons[rejection.reason] = reasons.get(rejection.reason, 0) + 1
    splits: dict[str, int] = {}
    for row in rows:
        splits[row.split] = splits.get(row.split, 0) + 1
    return {
        "found": len(identities),
        "kept": len(rows),
        "quarantined": len(rejected),
        "reasons": dict(sorted(reasons.items())),
        "splits": dict(sorted(splits.items())),
        "videos": {name: count for name, count in read_json(output / VIDEOS_FILE).items() if name != "codecs"},
    }
