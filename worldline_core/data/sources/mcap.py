"""MCAP files: those written by this project, one episode per file, and recordings of other tools (ROS 2, Foxglove).

Topics of the latter are declared (`McapTopicsSourceConfig`), nothing is guessed. See docs/mcap.md.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from fnmatch import fnmatchcase
from operator import itemgetter
from typing import Literal

from worldline_core.data.episodes.source import LoadedEpisode, SourceConfigBase
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath, find_files, inside, is_file, relative_name
from worldline_core.data.mcap.exported import exported_episode_id, read_exported_episode
from worldline_core.data.mcap.file import McapFile
from worldline_core.data.mcap.recording import Segment, read_topics_episode
from worldline_core.data.mcap.topics_config import Markers, McapTopicsSourceConfig, TimeRanges, WholeFiles
from worldline_core.errors import DataError


class McapSourceConfig(SourceConfigBase):
    """Every *.mcap below the folder, or one file."""

    kind: Literal["mcap"] = "mcap"


def _files(root: AnyPath) -> dict[str, AnyPath]:
    return {root.name: root} if is_file(root) else {str(relative_name(p, root)): p for p in find_files(root, "*.mcap")}


def _checked(path: AnyPath, name: str, root: AnyPath) -> AnyPath:
    """The file; a name that leads out of the source's folder is refused."""
    return path if path == root else inside(root, name)


class McapSource:
    """Reads a folder of MCAP files; a damaged file is known by its name."""

    looked_for = "*.mcap"

    def __init__(self, _: McapSourceConfig, root: AnyPath) -> None:
        self._root = root
        self._episodes: dict[str, tuple[AnyPath, str]] = {}
        for name, path in _files(root).items():
            try:
                identity = exported_episode_id(McapFile(_checked(path, name, root)))
            except DataError:
                identity = name  # `load` says what is wrong
            if identity in self._episodes:
                identity = f"{identity}@{path.name}"
            self._episodes[identity] = path, name

    def episode_ids(self) -> list[str]:
        return list(self._episodes)

    def load(self, episode_id: str) -> LoadedEpisode:
        path, name = self._episodes[episode_id]
        loaded = read_exported_episode(McapFile(_checked(path, name, self._root)))
        if loaded.episode.episode_id != episode_id:
            raise RejectedInputError(
                "duplicate_id", "Two files hold an episode of this id", where=path, got=loaded.episode.episode_id
            )
        return loaded


class McapTopicsSource:
    """Reads every *.mcap below a folder, or one file; ids are label-path[-episode].

    A file in which no episodes can be looked for is listed as one, which then says why.
    """

    looked_for = "*.mcap, and in them what `episodes` declares"

    def __init__(self, config: McapTopicsSourceConfig, root: AnyPath) -> None:
        self._config = config
        self._episodes: dict[str, tuple[AnyPath, str, Segment]] = {}
        for name, path in _files(root).items():
            stem = f"{config.label}-{name.removesuffix('.mcap')}"
            try:
                checked = _checked(path, name, root)
                found = list(_segments(config.episodes, checked, name))
            except RejectedInputError as error:
                found = [Segment(fault=error)]
            for segment in found:
                self._episodes[f"{stem}-{segment.name}" if segment.name else stem] = path, stem, segment

    def episode_ids(self) -> list[str]:
        return list(self._episodes)

    def load(self, episode_id: str) -> LoadedEpisode:
        path, stem, segment = self._episodes[episode_id]
        if segment.fault is not None:
            raise segment.fault
        return read_topics_episode(self._config, McapFile(path), segment, episode_id, self._config.scene or stem)


def _segments(rule: WholeFiles | TimeRanges | Markers, path: AnyPath, relative_path: str) -> Iterator[Segment]:
    """Episodes of one file."""
    if isinstance(rule, WholeFiles):
        yield Segment()
    elif isinstance(rule, TimeRanges):
        for part in rule.ranges:
            if fnmatchcase(relative_path, part.file):
                first = McapFile(path).first_log_ns
                start, stop = (first + round(seconds * 1e9) for seconds in (part.start_s, part.stop_s))
                yield Segment(part.name, start, stop, part.instruction)
    else:
        yield from _between_markers(rule, McapFile(path))


def _between_markers(rule: Markers, file: McapFile) -> Iterator[Segment]:
    """Start to stop; a start without a stop, or the reverse, is an episode that cannot be read."""
    file.check_topics([rule.topic])
    markers = [(log_ns, str(text)) for _, kind, log_ns, _, text in file.messages([rule.topic]) if kind == "marker"]
    begun: tuple[int, re.Match[str]] | None = None
    count = 0
    for log_ns, text in sorted(markers, key=itemgetter(0)):
        start, stop = rule.start.fullmatch(text), rule.stop.fullmatch(text)
        if start is None and stop is None:
            continue
        if (start is not None) == (begun is not None):
            yield _unpaired(rule, file, count, text)
            count += 1
            begun = None
        if start is not None:
            begun = log_ns, start
        elif stop is not None and begun is not None:
            outcome = stop.groupdict().get("outcome")
            known = outcome if outcome in ("success", "failure") else None
            yield Segment(f"{count:04d}", begun[0], log_ns, begun[1].groupdict().get("instruction"), known)
            count, begun = count + 1, None
    if begun is not None:
        yield _unpaired(rule, file, count, "the end of the file")


def _unpaired(rule: Markers, file: McapFile, count: int, text: str) -> Segment:
    fault = RejectedInputError(
        "missing_marker",
        "Markers of an episode are not a start and a stop",
        where=f"{file.path}, topic {rule.topic}, episode {count}",
        expected=f"{rule.start.pattern!r}, then {rule.stop.pattern!r}",
        got=repr(text),
    )
    return Segment(f"{count:04d}", fault=fault)
