"""Transforms of a recording as a tree of frames."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.mcap.topics.config import McapTopicsSourceConfig
from worldline_core.data.mcap.topics.file import McapFile
from worldline_core.data.mcap.topics.messages import Transform
from worldline_core.data.mcap.topics.streams import Stream, Timing
from worldline_core.data.mcap.topics.transforms import Edge, TransformTree


@dataclass
class _Collected:
    parent: str
    static: bool
    times_ns: list[int] = field(default_factory=list)
    values: list[tuple[float, ...]] = field(default_factory=list)


def read_tree(
    config: McapTopicsSourceConfig,
    file: McapFile,
    streams: Mapping[str, Stream],
    timing: Timing,
    start_ns: int | None,
    wanted: Iterable[str],
) -> TransformTree:
    """The frames of an episode.

    Transforms that stay are looked for in the whole file, those on the moving topics around the episode; only where
    these do not lead to a wanted frame are the ones before the episode read too (a fixed camera may be published once,
    when the recording starts).

    Args:
        start_ns: log time at which the episode begins; None: with the file.
        wanted: frames that must be reached from the base.

    Raises: RejectedInputError: invalid_extrinsics for a frame with two parents.
    """
    found: dict[str, _Collected] = {}
    static = [topic for topic in config.static_transforms if topic in file.topics]
    if static:
        for received in file.messages(static):
            _collect(found, received.message.value, [received.log_ns] * len(received.message.value), True, file.shown)
    for topic in config.transforms:
        if topic in streams:
            stream = streams[topic]
            for value, time_ns in zip(stream.values, timing.times_ns(stream), strict=True):
                times = _times(value, int(time_ns), timing, topic)
                _collect(found, value, times, False, file.shown)
    tree = _tree(config, found, file)
    if start_ns is not None and not all(tree.connected(config.base_frame, frame) for frame in wanted):
        earlier: dict[str, _Collected] = {}
        topics = [topic for topic in config.transforms if topic in file.topics]
        for received in file.messages(topics, None, start_ns):
            _collect(earlier, received.message.value, [received.log_ns] * len(received.message.value), True, file.shown)
        found = {**earlier, **found}
        tree = _tree(config, found, file)
    return tree


def _times(value: tuple[Transform, ...], time_ns: int, timing: Timing, topic: str) -> list[int]:
    """When the transforms of one message are of."""
    if timing.source != "header":
        return [time_ns] * len(value)
    offset = round(timing.offsets_ms.get(topic, 0.0) * 1e6)
    return [transform.stamp_ns + offset for transform in value]


def _collect(
    found: dict[str, _Collected], value: tuple[Transform, ...], times_ns: list[int], static: bool, where: object
) -> None:
    for transform, time_ns in zip(value, times_ns, strict=True):
        known = found.setdefault(transform.child, _Collected(transform.parent, static))
        if known.parent != transform.parent:
            raise RejectedInputError(
                "invalid_extrinsics",
                "A frame has two parents",
                where=f"{where}, frame {transform.child}",
                expected=known.parent,
                got=transform.parent,
            )
        known.static = known.static and static
        known.times_ns.append(time_ns)
        known.values.append(transform.values)


def _tree(config: McapTopicsSourceConfig, found: Mapping[str, _Collected], file: McapFile) -> TransformTree:
    edges = {
        child: Edge(
            collected.parent,
            np.array(collected.times_ns, np.int64),
            np.array(collected.values, np.float64),
            collected.static or len(collected.times_ns) == 1,
        )
        for child, collected in found.items()
    }
    return TransformTree(edges, file.shown, config.max_gap_s, config.max_disorder_s)
