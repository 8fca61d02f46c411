"""A shard of curation: some episodes of one source, each kept or quarantined, wherever the shard is worked on."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.curation.recorded_episode import check_episode, prepare_episode
from worldline_core.data.episodes.episode_index import QuarantineRow
from worldline_core.data.episodes.episode_set_writer import EpisodeSetWriter
from worldline_core.data.episodes.source import EpisodeSource
from worldline_core.data.guards.rejection import RejectedInputError, check_id
from worldline_core.data.guards.source_paths import AnyPath, parse_location, portable_text, unchanged_files, watch_run
from worldline_core.data.sources.open import open_source
from worldline_core.errors import CalibrationError, DataError
from worldline_core.scale.mapping import crash_evidence, ends_the_run, portable_message
from worldline_core.scale.shard_manifest import InputRow, write_shard_manifest
from worldline_core.store.digest import digest_value
from worldline_core.store.remote import UnreachableInputError, is_transient


@dataclass(frozen=True)
class ListedEpisode:
    """One episode that a source lists.

    Attributes:
        identity: its id in the set.
        listed_id: its id in the source.
        repeated: another source has an episode of that id.
    """

    identity: str
    listed_id: str
    repeated: bool


@dataclass(frozen=True)
class CurateShard:
    """Plain values only: a shard is sent to other processes and machines, which share the output folder.

    Attributes:
        run: names the call of `curate`, so that a source that one call opened does not serve the next.
        config: JSON of the CurateConfig.
        source, root: which of its sources, and where that one lies.
    """

    number: int
    run: str
    config: str
    source: int
    root: str
    output: str
    episodes: tuple[ListedEpisode, ...]

    @property
    def label(self) -> str:
        return f"curate shard {self.number}"

    def __len__(self) -> int:
        return len(self.episodes)

    def split(self) -> list[CurateShard]:
        return [replace(self, episodes=(episode,)) for episode in self.episodes]

    @property
    def name(self) -> str:
        """Of its manifest: other episodes, another file."""
        return f"shard-{self.number:06d}-{digest_value([e.identity for e in self.episodes])[:12]}"


@lru_cache(maxsize=4)
def read_config(text: str) -> CurateConfig:
    """The configuration of a shard."""
    return CurateConfig.model_validate_json(text)


@lru_cache(maxsize=4)
def opened_source(run: str, config: str, number: int, root: str) -> EpisodeSource:
    """A source, opened once for all shards of a run that this process works on."""
    watch_run(run)
    return open_source(read_config(config).sources[number], parse_location(root))


def open_writer(config: CurateConfig, output: Path) -> EpisodeSetWriter:
    """The set that all shards of a run write into."""
    return EpisodeSetWriter(
        output,
        fps=config.common_fps,
        image_size=config.common_image_size,
        video_crf=config.video_crf,
        video_preset=config.video_preset,
        pixel_format=config.pixel_format,
        video_mode=config.video_mode,
        key_frame_interval=config.key_frame_interval,
    )


def curate_shard(shard: CurateShard) -> int:
    """Keep or quarantine every episode of a shard that is not done yet, and write the shard's manifest.

    Returns: the number of episodes.

    Raises: UnreachableInputError when the inputs of some could not be read for a reason that passes (all others are
        done); ConfigError or UnavailableError for what no episode can get past.
    """
    config, output = read_config(shard.config), Path(shard.output)
    writer = open_writer(config, output)
    own = config.for_source(shard.source)
    source = opened_source(shard.run, shard.config, shard.source, shard.root)
    label = config.sources[shard.source].label
    rows: list[InputRow] = []
    unreachable: list[Exception] = []
    for episode in shard.episodes:
        if not writer.has(episode.identity):
            clock, processor = time.perf_counter(), time.process_time()
            try:
                _process(own, source, episode, label, parse_location(shard.root), writer, output)
            except Exception as error:
                if not is_transient(error):
                    raise
                unreachable.append(error)
                continue
            seconds, cpu_seconds = time.perf_counter() - clock, time.process_time() - processor
            rows.append(replace(input_row(writer, output, episode.identity), seconds=seconds, cpu_seconds=cpu_seconds))
    if rows:
        write_shard_manifest(output, shard.name, rows)
    if unreachable:
        raise UnreachableInputError(
            f"{len(unreachable)} of {len(shard)} episodes could not be read",
            where=shard.label,
            got=str(unreachable[0]).splitlines()[0],
        ) from unreachable[0]
    return len(shard)


def _process(
    config: CurateConfig,
    source: EpisodeSource,
    episode: ListedEpisode,
    label: str,
    root: AnyPath,
    writer: EpisodeSetWriter,
    output: Path,
) -> None:
    """Keep or quarantine one episode. Raises: what is transient, and what ends the run."""
    identity = episode.identity
    try:
        if episode.repeated:
            raise RejectedInputError(
                "duplicate_id", "Another source has an episode of this id", where=label, got=episode.listed_id
            )
        check_id(episode.listed_id, label)
        with unchanged_files(identity):
            loaded = source.load(episode.listed_id)
            check_episode(config, loaded)
            prepared = prepare_episode(config, loaded)
            writer.add(prepared.episode, prepared.frames, prepared.masks or None, prepared.described)
    except Exception as error:
        # A reader may have wrapped it: an input that cannot be reached just now is not a bad one.
        if is_transient(error) or ends_the_run(error):
            raise
        reason, detail, evidence = _judge(error)
        writer.discard(identity)  # written from files that changed meanwhile
        writer.quarantine(identity, label, reason, portable_text(detail, root, label), evidence)


def _judge(error: Exception) -> tuple[str, str, dict[str, object]]:
    """(reason, detail, evidence) of an episode that did not get through."""
    match error:
        case RejectedInputError():
            return error.reason, str(error), error.evidence
        case CalibrationError():
            return "invalid_extrinsics", str(error), {}
        case DataError():
            return "unreadable", str(error), {}
        case _:
            detail = f"Processing ended with {type(error).__name__}: {portable_message(str(error))}"
            return "crashed", detail, crash_evidence(error)


def quarantine_crashed(shard: CurateShard, error: Exception) -> None:
    """Quarantine the one episode of a shard that ended its worker (or failed outside of any episode) twice."""
    config, output = read_config(shard.config), Path(shard.output)
    writer, (episode,) = open_writer(config, output), shard.episodes
    if not writer.has(episode.identity):
        detail = "Processing this episode alone ended its process, twice"
        label = config.sources[shard.source].label
        writer.quarantine(episode.identity, label, "crashed", detail, crash_evidence(error))


def input_row(writer: EpisodeSetWriter, output: Path, identity: str) -> InputRow:
    """The account of an episode that is done.

    Raises: DataError when it is not.
    """
    found = writer.recorded(identity)
    if found is None:
        raise DataError("An episode was neither kept nor quarantined", where=str(output), got=identity)
    if isinstance(found, QuarantineRow):
        return InputRow(identity, found.source, "quarantined", found.reason, "", 0)
    stored = sum(file.stat().st_size for file in found.folder.iterdir())
    return InputRow(identity, found["source"], "kept", None, found["fingerprint"]["digest"], stored)


def account(
    writer: EpisodeSetWriter, output: Path, identities: Sequence[str], seen: dict[str, InputRow]
) -> list[InputRow]:
    """One row an input, as things stand now; times from the shards' manifests."""
    rows: list[InputRow] = []
    for identity in identities:
        row, known = input_row(writer, output, identity), seen.get(identity)
        rows.append(row if known is None else replace(row, seconds=known.seconds, cpu_seconds=known.cpu_seconds))
    return rows
