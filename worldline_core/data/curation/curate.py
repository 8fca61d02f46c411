"""Curation: recordings of several formats in, one EpisodeSet out; every input is kept or quarantined with a reason."""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import batched
from pathlib import Path
from typing import Any, ClassVar

from worldline_core.data.curation.curate_config import CurateConfig, DrawnSplits
from worldline_core.data.curation.recorded_episode import TRIMMED, check_episode, prepare_episode, trimmed
from worldline_core.data.curation.rules import check_held_out, decided_rows, drawn_episodes
from worldline_core.data.curation.source_table import write_source_table, write_source_weights
from worldline_core.data.episodes.episode_index import QuarantineRow, read_index, read_quarantine
from worldline_core.data.episodes.episode_set_writer import EMBODIMENTS_FOLDER, VIDEOS_FILE, EpisodeSetWriter
from worldline_core.data.episodes.source import EpisodeSource, check_id, unique_identity
from worldline_core.data.guards.plain_files import read_json
from worldline_core.data.guards.reader_process import read_limited
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import parse_location, portable_text, unchanged_files
from worldline_core.data.sources.open import open_source
from worldline_core.errors import CalibrationError, DataError
from worldline_core.geometry.embodiment import carry_embodiments
from worldline_core.scale.account import InputRow, check_account, crash_evidence, portable_message, write_account
from worldline_core.scale.mapping import EpisodeWork, SerialMapper, ShardMapper, ends_the_run, map_episodes
from worldline_core.store.remote import UnreachableInputError, first_line, is_remote, is_transient
from worldline_core.store.store import helper_lock
from worldline_core.untrusted_text import visible

logger = logging.getLogger(__name__)

_OPEN_SOURCES = 4


def curate(
    config: CurateConfig, inputs: Mapping[str, Path], output: Path, mapper: ShardMapper | None = None
) -> dict[str, Any]:
    """Read all sources into an EpisodeSet at `output`.

    Args:
        inputs: "source.<n>" -> folder of sources[n]; a source that is not named is read from its configured path.
        mapper: what does the shards, by default this process. The set does not depend on it.

    Returns:
        {"found", "kept", "quarantined", "reasons", "splits", "videos" (copied and encoded)}; kept + quarantined = found. With
        `trim` also "trimmed": how many of the kept ones were cut.

    Raises: DataError when a source cannot be opened or has no episode, nothing is kept, or a scene is both in training and
        in test;
        ConfigError when recordings for evaluation only are assigned to training; UnreachableInputError when inputs
        could not be read for a reason that passes (what is done stays, the next call does the rest).
    """
    for number, name in config.recordings.items():
        if f"source.{number}" not in inputs:
            raise DataError(
                "A source reads a recording of this run, which is not here", where=f"sources[{number}]", got=name,
                next_step=f"run `worldline task record --name record.{name}` with the same preset first",
            )  # fmt: skip
    mapper = mapper or SerialMapper()
    roots = tuple(str(inputs.get(f"source.{n}", source.path)) for n, source in enumerate(config.sources))
    carry_embodiments(config.own_robots().values())
    for source, place in zip(config.sources, map(parse_location, roots), strict=True):
        if source.kind == "episode_set" and not is_remote(place):
            carry_embodiments(sorted(place.glob(f"{EMBODIMENTS_FOLDER}/*.yaml")))
    work = CurateWork(output, config.with_located_robots(), roots)
    listed = work.listed_episodes()
    identities = [episode.identity for episodes in listed for episode in episodes]
    if not EpisodeSetWriter.finished(output):
        # Shards of one source each: a worker then opens few sources.
        pieces = [piece for episodes in listed for piece in batched(episodes, mapper.episodes_per_shard)]
        map_episodes(mapper, work, pieces)
        _quarantine_duplicates_and_leaks(work, listed)
        if isinstance(config.splits, DrawnSplits) and config.splits.by == "episode":
            work.writer.assign_splits(drawn_episodes(config.splits, work.writer.kept()))
        kept = work.writer.kept()
        check_held_out(config, [part["split"] for part in kept], len({part["scene"] for part in kept}))
        write_account(output, [work.row(identity) for identity in identities])
        work.writer.close()
    rows, rejected = read_index(output), read_quarantine(output)
    write_source_table(output, config, [[e.identity for e in episodes] for episodes in listed], rows, rejected)
    write_source_weights(output, rows, config.sampling_alpha)
    check_account(output, len(identities), {row.episode_id for row in rows}, {row.episode_id for row in rejected})
    if {row.split for row in rows} == {"test"}:
        logger.warning("All episodes are in split test; training needs others (curate.sources[].split, curate.splits)")
    return {
        "found": len(identities),
        "kept": len(rows),
        "quarantined": len(rejected),
        "reasons": dict(sorted(Counter(row.reason for row in rejected).items())),
        "splits": dict(sorted(Counter(row.split for row in rows).items())),
        "videos": {name: count for name, count in read_json(output / VIDEOS_FILE).items() if name != "codecs"},
        **({} if config.trim is None else {"trimmed": sum(TRIMMED in json.loads(row.conventions) for row in rows)}),
    }


def _quarantine_duplicates_and_leaks(work: CurateWork, listed: Sequence[Sequence[SourceEpisode]]) -> None:
    """Quarantine what the rules over the whole set reject.

    Raises: DataError when a scene is both learnt from and tested on.
    """
    labels = {e.identity: work.label(e.source) for episodes in listed for e in episodes}
    kept = {part["episode_id"]: part for part in work.writer.kept()}
    for row in decided_rows(work.config, [kept[identity] for identity in labels if identity in kept], work.output):
        work.writer.quarantine(row.episode_id, labels[row.episode_id], row.reason, row.detail, row.numbers)
        work.writer.discard(row.episode_id)


@dataclass(frozen=True)
class SourceEpisode:
    """One episode that a source lists.

    Attributes:
        source: number of the source in the configuration.
        identity: its id in the set.
        listed_id: its id in the source.
        repeated: whether a source listed an episode of that id before.
    """

    source: int
    identity: str
    listed_id: str
    repeated: bool


@dataclass(frozen=True)
class CurateWork(EpisodeWork[SourceEpisode, InputRow]):
    """Keeps or quarantines listed episodes.

    Attributes:
        roots: folder of each source.
    """

    step: ClassVar[str] = "curate"
    doing: ClassVar[str] = "Processing"

    config: CurateConfig
    roots: tuple[str, ...]

    @cached_property
    def writer(self) -> EpisodeSetWriter:
        """The set that all shards write into."""
        return EpisodeSetWriter(
            self.output,
            video_crf=self.config.video_crf,
            video_preset=self.config.video_preset,
            pixel_format=self.config.pixel_format,
            video_mode=self.config.video_mode,
            key_frame_interval=self.config.key_frame_interval,
        )

    @cached_property
    def source(self) -> Callable[[int], EpisodeSource]:
        """Opens source `number`; the last few stay open."""
        sources, places = self.config.sources, [parse_location(root) for root in self.roots]
        return lru_cache(maxsize=_OPEN_SOURCES)(lambda number: open_source(sources[number], places[number]))

    def label(self, source: int) -> str:
        """Name of a source in quarantine rows."""
        return self.config.sources[source].label

    def listed_episodes(self) -> list[list[SourceEpisode]]:
        """Episodes that each source lists, in its order, under ids that are unique in the set.

        Raises: DataError for a source that lists nothing.
        """
        listed: list[list[SourceEpisode]] = []
        seen: set[str] = set()
        for number in range(len(self.config.sources)):
            episodes: list[SourceEpisode] = []
            for listed_id in read_limited(self.config.reader, _episode_ids, self, number):
                repeated = listed_id in seen
                identity = unique_identity(listed_id, number, seen)
                seen |= {identity, listed_id}
                episodes.append(SourceEpisode(number, identity, listed_id, repeated))
            listed.append(episodes)
        return listed

    def remaining(self, number: int, episodes: Sequence[SourceEpisode]) -> list[SourceEpisode]:
        del number
        return [episode for episode in episodes if not self.writer.has(episode.identity)]

    def do(self, episode: SourceEpisode) -> InputRow:
        try:
            return read_limited(self.config.reader, _process, self, episode)
        except RejectedInputError as error:
            return self._quarantine(episode, error.reason, str(error), error.evidence)

    def process(self, episode: SourceEpisode) -> InputRow:
        """Keep or quarantine an episode; called in a reader process.

        Raises: RejectedInputError (out_of_memory), MemoryError; UnreachableInputError; errors that end the run.
        """
        try:
            self._keep(episode)
        except Exception as error:
            # A reader may have wrapped it: an input that cannot be reached just now is not a bad one.
            if is_transient(error):
                raise UnreachableInputError("An input cannot be reached", got=first_line(error)) from error
            if isinstance(error, MemoryError) or getattr(error, "reason", "") == "out_of_memory" or ends_the_run(error):
                raise
            match error:
                case RejectedInputError():
                    return self._quarantine(episode, error.reason, str(error), error.evidence)
                case CalibrationError():
                    return self._quarantine(episode, "invalid_extrinsics", str(error), {})
                case DataError():
                    return self._quarantine(episode, "unreadable", str(error), {})
                case _:
                    detail = f"{self.doing} ended with {type(error).__name__}: {portable_message(str(error))}"
                    return self.quarantine_crashed(episode, detail, crash_evidence(error))
        return self.row(episode.identity)

    def _keep(self, episode: SourceEpisode) -> None:
        """Raises: DataError (RejectedInputError, CalibrationError) for an episode that does not get through."""
        label = self.label(episode.source)
        if episode.repeated:
            raise RejectedInputError(
                "duplicate_id", "Another source has an episode of this id", where=label, got=episode.listed_id
            )
        check_id(episode.listed_id, label)
        own = self.config.for_source(episode.source)
        with unchanged_files(episode.identity):
            loaded = trimmed(own, self.source(episode.source).load(episode.listed_id))
            check_episode(own, loaded)
            self.writer.add(*prepare_episode(own, loaded))

    def quarantine_crashed(self, episode: SourceEpisode, detail: str, evidence: Mapping[str, Any]) -> InputRow:
        return self._quarantine(episode, "crashed", detail, evidence)

    def _quarantine(self, episode: SourceEpisode, reason: str, detail: str, evidence: Mapping[str, Any]) -> InputRow:
        self.writer.discard(episode.identity)  # written from files that changed meanwhile
        label, root = self.label(episode.source), parse_location(self.roots[episode.source])
        self.writer.quarantine(episode.identity, label, reason, visible(portable_text(detail, root, label)), evidence)
        return self.row(episode.identity)

    def row(self, identity: str) -> InputRow:
        """The account of an episode that is done.

        Raises: DataError when it is not.
        """
        found = self.writer.recorded(identity)
        if found is None:
            raise DataError("An episode was neither kept nor quarantined", where=self.output, got=identity)
        if isinstance(found, QuarantineRow):
            return InputRow(episode_id=identity, source=found.source, status="quarantined", reason=found.reason)
        return InputRow(
            episode_id=identity,
            source=found["source"],
            status="kept",
            digest=found["fingerprint"]["digest"],
            stored_bytes=sum(file.stat().st_size for file in found.folder.iterdir()),
        )


_opened: dict[str, CurateWork] = {}
"""The work of the present run by the run's name, at most one: in a reader process all calls share what it has opened."""


def _kept_open(work: CurateWork) -> CurateWork:
    if work.run not in _opened:
        _opened.clear()
    return _opened.setdefault(work.run, work)


def _episode_ids(work: CurateWork, source: int) -> list[str]:
    return _kept_open(work).source(source).episode_ids()


def _process(work: CurateWork, episode: SourceEpisode) -> InputRow:
    with helper_lock(work.output):
        return _kept_open(work).process(episode)
