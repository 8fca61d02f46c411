"""MCAP files: those written by this project, one episode per file, and recordings of other tools (ROS 2, Foxglove).

Topics of the latter are declared (`McapTopicsSourceConfig`), nothing is guessed. See docs/mcap.md.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from operator import itemgetter
from pathlib import PurePosixPath
from typing import Literal

from worldline_core.config import read_yaml
from worldline_core.data.episodes.source import LoadedEpisode, SourceConfigBase
from worldline_core.data.guards.plain_files import expect_layout
from worldline_core.data.guards.rejection import RejectedInputError, collect_faults
from worldline_core.data.guards.source_paths import (
    AnyPath,
    find_files,
    inside,
    is_file,
    regular_file,
    relative_name,
)
from worldline_core.data.mcap.exported import exported_episode_id, read_exported_episode
from worldline_core.data.mcap.file import McapFile, SplitMcap
from worldline_core.data.mcap.recording import Segment, read_topics_episode
from worldline_core.data.mcap.topics_config import Markers, McapTopicsSourceConfig, TimeRanges, WholeFiles
from worldline_core.errors import ConfigError, DataError

_PATTERNS = ("*.mcap", "*.mcap.zst*", "*.db3", "*.bag")
"""The last three are bags that `McapFile` refuses with their next step."""


class McapSourceConfig(SourceConfigBase):
    """Every *.mcap below the folder, or one file."""

    kind: Literal["mcap"] = "mcap"


def _files(root: AnyPath) -> dict[str, AnyPath]:
    if is_file(root):
        return {root.name: root}
    found = {str(relative_name(path, root)): path for pattern in _PATTERNS for path in find_files(root, pattern)}
    return dict(sorted(found.items()))


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


@dataclass(frozen=True)
class _Recording:
    """One recorder's output: a file, or the parts of a split bag of rosbag2 in their order.

    Attributes:
        name: of the file or the bag's folder, below the source's folder.
        parts: names of the files, below the source's folder.
        fault: why the bag's list of parts cannot be used.
    """

    name: str
    parts: tuple[str, ...]
    fault: RejectedInputError | None = None

    def open(self, root: AnyPath) -> McapFile:
        """Raises: RejectedInputError: path_traversal; missing_file for a part that is not there; as `McapFile`."""
        if self.fault is not None:
            raise self.fault
        if is_file(root):
            return McapFile(root)
        paths = [inside(root, part) for part in self.parts]
        return McapFile(paths[0]) if len(paths) == 1 else SplitMcap(root / self.name, paths)


def _recordings(root: AnyPath) -> list[_Recording]:
    """Recordings below a folder; files that a `metadata.yaml` lists together are one."""
    found = {name: _Recording(name, (name,)) for name in _files(root)}
    for listing in [] if is_file(root) else find_files(root, "metadata.yaml"):
        folder = relative_name(listing, root).parent
        faults: list[RejectedInputError] = []
        parts: tuple[str, ...] = ()
        with collect_faults(faults):
            parts = tuple(str(folder / name) for name in _listed_parts(inside(root, str(folder / "metadata.yaml"))))
        name = str(folder) if folder.parts else root.name
        beside = [file for file in found if PurePosixPath(file).parent == folder]
        if faults and beside:
            found[name] = _Recording(name, (), faults[0])
        elif len(parts) > 1:
            found = {file: each for file, each in found.items() if file not in parts}
            found[name] = _Recording(name, parts)
    return sorted(found.values(), key=lambda recording: recording.name)


def _listed_parts(path: AnyPath) -> list[str]:
    """Names of a bag's files in the order in which they were written; older bags list them with their folder."""
    try:
        content = read_yaml(regular_file(path))
    except ConfigError as error:
        raise RejectedInputError(
            "unreadable",
            "List of a bag's files cannot be read",
            where=path,
            got=error.got,
            next_step="write it again: ros2 bag reindex",
        ) from error
    with expect_layout(path, "rosbag2_bagfile_information with relative_file_paths"):
        if "rosbag2_bagfile_information" not in content:
            return []
        listed = content["rosbag2_bagfile_information"]["relative_file_paths"]
        return [PurePosixPath(name).name for name in listed]


class McapTopicsSource:
    """Reads every *.mcap below a folder, or one file; ids are label-path[-episode].

    The parts of a split bag are one recording, with the path of their folder. A recording in which no episodes can be
    looked for is listed as one, which then says why.
    """

    looked_for = "*.mcap, and in them what `episodes` declares"

    def __init__(self, config: McapTopicsSourceConfig, root: AnyPath) -> None:
        self._config = config
        self._root = root
        self._episodes: dict[str, tuple[_Recording, str, Segment]] = {}
        for recording in _recordings(root):
            stem = f"{config.label}-{recording.name.removesuffix('.mcap')}"
            try:
                found = list(_segments(config.episodes, recording, root))
            except RejectedInputError as error:
                found = [Segment(fault=error)]
            for segment in found:
                self._episodes[f"{stem}-{segment.name}" if segment.name else stem] = recording, stem, segment

    def episode_ids(self) -> list[str]:
        return list(self._episodes)

    def load(self, episode_id: str) -> LoadedEpisode:
        recording, stem, segment = self._episodes[episode_id]
        if segment.fault is not None:
            raise segment.fault
        file = recording.open(self._root)
        return read_topics_episode(self._config, file, segment, episode_id, stem)


def _segments(rule: WholeFiles | TimeRanges | Markers, recording: _Recording, root: AnyPath) -> Iterator[Segment]:
    """Episodes of one recording."""
    if isinstance(rule, WholeFiles):
        yield Segment()
    elif isinstance(rule, TimeRanges):
        first = recording.open(root).first_log_ns
        for part in rule.ranges:
            start, stop = (first + round(seconds * 1e9) for seconds in (part.start_s, part.stop_s))
            yield Segment(part.name, start, stop, part.instruction)
    else:
        yield from _between_markers(rule, recording.open(root))


def _between_markers(rule: Markers, file: McapFile) -> Iterator[Segment]:
    """Start to stop; a start without a stop, or the reverse, is an episode that cannot be read."""
    if rule.topic not in file.topics:
        raise file.lacks_topics([rule.topic])
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
