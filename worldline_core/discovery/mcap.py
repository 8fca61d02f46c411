"""MCAP files: those that this project exports, and recordings of ROS 2 and Foxglove, by their topics."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from itertools import chain
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from worldline_core.data.episodes.episode import NO_EMBODIMENT
from worldline_core.data.guards.rejection import RejectedInputError, collect_faults
from worldline_core.data.guards.source_paths import AnyPath, find_files
from worldline_core.data.mcap.exported import exported_episode_id, read_exported_episode
from worldline_core.data.mcap.file import McapFile, Stream
from worldline_core.data.mcap.messages import IMAGE_KINDS, Kind, schema_kind
from worldline_core.discovery.arms import (
    ArmColumns,
    Column,
    Side,
    find_arms,
    follow_robot,
    gripper_readings,
    match_robot,
    words_of,
)
from worldline_core.discovery.cameras import name_views
from worldline_core.discovery.findings import Discovery, Question, named
from worldline_core.errors import DataError

_SECONDS = 30
_BY_HAND = "write the source by hand: configs/sources/mcap_ros2.yaml"
_COMMAND_WORDS = {
    "command", "commands", "cmd", "action", "actions", "target", "targets", "desired", "leader", "goal", "controller",
}  # fmt: skip


def discover_mcap(root: AnyPath) -> Discovery:
    """Raises: DataError where no file can be read, or none has pictures and joints."""
    files = find_files(root, "*.mcap") if root.is_dir() else [root]
    if not files:
        other = next(iter([*find_files(root, "*.db3"), *find_files(root, "*.bag"), *find_files(root, "*.mcap.zst*")]))
        McapFile(other)  # which says how it becomes an MCAP file
    file = _first_readable(files)
    exported = ""
    with suppress(DataError):
        exported = exported_episode_id(file)
    return _of_this_project(root, files, exported) if exported else _of_topics(root, files, file)


def _first_readable(files: Sequence[AnyPath]) -> McapFile:
    faults: list[RejectedInputError] = []
    for path in files[:20]:
        with collect_faults(faults):
            file = McapFile(path)
            _ = file.topics
            return file
    raise faults[0] if faults else DataError("No MCAP file can be read")


def _of_this_project(root: AnyPath, files: Sequence[AnyPath], episode_id: str) -> Discovery:
    loaded = read_exported_episode(_first_readable(files))
    episode = loaded.episode
    about = f"MCAP files of this project: {len(files)} episodes of {named([episode.embodiment])} at {episode.fps:g} fps"
    why = f"the first file is the episode {named([episode_id])}"
    found = Discovery.of("mcap", root, about, why, views=list(loaded.views), fps=episode.fps)
    found.state_size = episode.state.shape[1] or None
    found.count_cameras(episode.cameras)
    return found


def _of_topics(root: AnyPath, files: Sequence[AnyPath], file: McapFile) -> Discovery:
    kinds: dict[str, Kind] = {
        topic: kind for topic, schema in file.topics.items() if (kind := schema_kind(schema)) is not None
    }
    pictures = _one_of_each_camera(kinds)
    joints = [topic for topic, kind in kinds.items() if kind == "joints"]
    if not pictures or not joints:
        raise DataError(
            "The MCAP file has no pictures or no joints that are read", where=file.path,
            expected="a topic of images (sensor_msgs or Foxglove) and one of joint states",
            got=named([f"{topic} ({schema})" for topic, schema in file.topics.items()], 12),
            next_step="docs/mcap.md lists the schemas that are read",
        )  # fmt: skip
    start = file.first_log_ns
    others = ("numbers", "transforms", "calibration", "marker")
    wanted: dict[str, tuple[Kind, ...]] = {topic: (kinds[topic],) for topic in [*pictures, *joints]}
    wanted |= {topic: (kind,) for topic, kind in kinds.items() if kind in others}
    streams = file.streams(wanted, start, start + _SECONDS * 10**9)
    about = f"MCAP of {named(sorted(set(file.topics.values())), 4)}: {len(files)} files"
    found = Discovery.of("mcap_topics", root, about, f"{len(file.topics)} topics in {file.path.name}")
    _rate(found, [streams[topic] for topic in pictures if topic in streams])
    state_topic, arms = _state(found, [streams[topic] for topic in joints if topic in streams])
    _views(found, pictures, kinds, streams, [arm.side for arm in arms])
    _arms(found, state_topic, arms, streams, [topic for topic in kinds if topic != state_topic])
    _episodes(found, kinds, streams)
    return found


def _one_of_each_camera(kinds: dict[str, Kind]) -> list[str]:
    """Topics of pictures; compressed before raw ones of the same camera (`/cam/image` and `/cam/image/compressed`)."""
    depth = {"depth", "disparity", "infra"}
    topics = [topic for topic, kind in kinds.items() if kind in IMAGE_KINDS and not set(words_of(topic)) & depth]
    compressed = [topic for topic in topics if kinds[topic] != "raw_image"]
    return [t for t in topics if t in compressed or not any(other.startswith(t) for other in compressed)]


def _rate(found: Discovery, streams: Sequence[Stream]) -> None:
    steps = {s.topic: float(np.median(np.diff(_times(s)))) for s in streams if len(s.log_ns) > 2}
    rates = {topic: 1e9 / step for topic, step in steps.items() if step > 0}
    if not rates:
        found.source["fps"] = Question("fps", "rate to which pictures and joints are brought")
        return
    found.fps = float(max(1, round(min(rates.values()))))
    shown = ", ".join(f"{rate:.1f} Hz ({named([topic])})" for topic, rate in rates.items())
    found.say(("fps",), found.fps, f"pictures come at {shown}")


def _times(stream: Stream) -> np.ndarray:
    both = zip(stream.log_ns, stream.stamps_ns, strict=True)
    return np.array([log if stamp is None else stamp for log, stamp in both], np.float64)


def _columns(stream: Stream) -> list[Column]:
    """The joints of the topic whose positions are stated."""
    read = chain.from_iterable(zip(value.names, value.position, strict=False) for value in stream.values[:50])
    names = dict.fromkeys(name for name, place in read if np.isfinite(place))
    return [Column(stream.topic, i, name, words_of(name)) for i, name in enumerate(names)]


def _state(found: Discovery, streams: Sequence[Stream]) -> tuple[Stream, list[ArmColumns]]:
    """The topic of measured joints, and its arms."""
    candidates = sorted(streams, key=lambda s: (bool(set(words_of(s.topic)) & _COMMAND_WORDS), -len(_columns(s))))
    for stream in candidates:
        arms, why = find_arms(_columns(stream))
        if arms:
            found.evidence["arms",] = f"{stream.topic}, {why}"
            return stream, arms
    raise DataError(
        "No topic of joint states has an arm",
        got=named([column.name for s in streams for column in _columns(s)], 20),
        next_step=_BY_HAND,
    )


def _values(stream: Stream, columns: Sequence[Column]) -> np.ndarray:
    """(N, len(columns)) positions; messages that lack one are left out."""
    rows = []
    for value in stream.values:
        known = dict(zip(value.names, value.position, strict=False))
        if all(column.name in known and np.isfinite(known[column.name]) for column in columns):
            rows.append([known[column.name] for column in columns])
    return np.array(rows, np.float64).reshape(-1, len(columns))


def _views(
    found: Discovery, pictures: Sequence[str], kinds: dict[str, Kind], streams: dict[str, Stream], sides: list[Side]
) -> None:
    chosen = name_views(pictures, sides, {})
    moved = [each for s in streams.values() if s.kind == "transforms" for value in s.values for each in value]
    frames, parents = {each.child for each in moved}, {each.parent for each in moved}
    transforms = [topic for topic, kind in kinds.items() if kind == "transforms"]
    calibrations = [topic for topic, kind in kinds.items() if kind == "calibration"]
    views: dict[str, Any] = {}
    for topic, view in chosen.views.items():
        entry: dict[str, Any] = {"image": topic}
        near = [c for c in calibrations if _shared(c, topic) >= 1 or len(calibrations) == len(pictures) == 1]
        frame = streams[topic].frame if topic in streams else ""
        if near and frame in frames:
            entry["calibration"] = max(near, key=lambda c: _shared(c, topic))
        elif near:
            where = f"The pictures of {named([topic])} are in the frame {named([frame])}"
            found.notes.append(f"{where}, which no transform names: the view stays without a camera.")
        views[view] = entry
        found.evidence["views", view] = chosen.evidence[topic]
    found.source["views"] = views
    found.views = list(views)
    found.count_cameras([name for name, view in views.items() if "calibration" in view])
    posed = found.cameras != "none"
    roots = sorted(parents - frames)
    if posed and roots:
        base = next((root for root in sorted(parents) if "base" in root), roots[0])
        called = named([frame for frame in sorted(parents | frames) if "base" in frame])
        found.say(("base_frame",), base, f"transforms lead from {named(roots)}; frames called base: {called}")
    static = [topic for topic in transforms if "static" in topic]
    found.source["transforms"] = [topic for topic in transforms if topic not in static] if posed else []
    found.source["static_transforms"] = static if posed else []


def _shared(one: str, other: str) -> int:
    """Leading parts that two topics have in common."""
    pairs = list(zip(PurePosixPath(one).parts[1:-1], PurePosixPath(other).parts[1:], strict=False))
    return next((i for i, (a, b) in enumerate(pairs) if a != b), len(pairs))


def _arms(
    found: Discovery, stream: Stream, arms: list[ArmColumns], streams: dict[str, Stream], others: Sequence[str]
) -> None:
    angles = [_values(stream, arm.joints) for arm in arms]
    match, choices, said = match_robot(" ".join(column.name for arm in arms for column in arm.joints), arms, angles)
    if match is not None and all(arm.gripper for arm in arms):
        found.say(("embodiment",), match.name, match.evidence)
        follow_robot(arms, match.name)
    elif choices:
        which = f"which robot: {', '.join(choices[:10])}; or none, or the path of a description"
        found.say(("embodiment",), Question("embodiment", which), said)
    else:
        found.say(("embodiment",), NO_EMBODIMENT, said or "an arm without a gripper")
    commands = _command_topics(streams, others, arms)
    entries: list[dict[str, Any]] = []
    for number, arm in enumerate(arms):
        entries.append({"name": arm.side, "state": _readings(found, stream, arm, ("arms", arm.side, "state"))})
        if commands is not None:
            topic, columns = commands
            entries[-1]["command"] = _readings(found, topic, columns[number], ("arms", arm.side, "command"))
    found.source["arms"] = entries
    if commands is None:
        numbers = [topic for topic in others if topic in streams and streams[topic].kind == "numbers"]
        why = "no topic of commands has the joints' names"
        if numbers:
            why += f" ({named(numbers)} hold numbers without names: declare `command` where they are commands)"
        found.say(("without_commands",), "repeat_state", why)
    found.state_size = sum(len(arm.joints) + 1 for arm in arms)


def _command_topics(
    streams: dict[str, Stream], others: Sequence[str], arms: Sequence[ArmColumns]
) -> tuple[Stream, list[ArmColumns]] | None:
    """A topic of joint states that are commands, with the same joints."""
    for topic in others:
        if topic not in streams or streams[topic].kind != "joints" or not set(words_of(topic)) & _COMMAND_WORDS:
            continue
        found, _ = find_arms(_columns(streams[topic]), commanded=True)
        if [sorted(arm.joint_words) for arm in found] == [sorted(arm.joint_words) for arm in arms] and all(
            arm.gripper for arm in found
        ):
            for command, arm in zip(found, arms, strict=True):
                command.arrange(arm.joint_words)
            return streams[topic], found
    return None


def _readings(found: Discovery, stream: Stream, arm: ArmColumns, place: tuple[str, ...]) -> dict[str, Any]:
    side = place[1]
    joints = {"topic": stream.topic, "names": [column.name for column in arm.joints]}
    if arm.gripper is None:
        raise DataError(
            "An arm has no gripper among its joints", where=stream.topic, expected="a joint called gripper or finger",
            got=named([c.name for c in arm.joints]), next_step=_BY_HAND,
        )  # fmt: skip
    values, words = _values(stream, [arm.gripper])[:, 0], arm.gripper.words
    finger = True if "finger" in words and values.max() < 0.2 else None
    why = "a finger that opens by some centimetres"
    readings = gripper_readings(values, None, words, open_is_high=finger, why=why)
    said = readings.evidence
    ends: dict[str, Any] = dict(zip(("closed", "open"), readings.ends, strict=True))
    if readings.open_is_high is None:
        asked = f"reading of {named([arm.gripper.name])} when it is"
        ends = {end: Question(f"{side}_gripper_{end}", f"{asked} {end} ({said})") for end in ends}
        said += "; nothing says which end is open"
    elif not readings.open_is_high:
        ends = dict(zip(ends, reversed(readings.ends), strict=True))
    found.evidence[(*place, "gripper")] = said
    return {"joints": joints, "gripper": {"topic": stream.topic, "names": [arm.gripper.name], "range": ends}}


def _episodes(found: Discovery, kinds: dict[str, Kind], streams: dict[str, Stream]) -> None:
    for topic in (topic for topic, kind in kinds.items() if kind == "marker" and topic in streams):
        if any(str(text).startswith(("start", "stop")) for text in streams[topic].values):
            found.say(("episodes",), {"by": "markers", "topic": topic}, "its messages begin with start and stop")
            return
    why = "every file is an episode; `ranges` or `markers` cut longer ones (docs/mcap.md)"
    found.say(("episodes",), {"by": "file"}, why)
