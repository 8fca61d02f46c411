"""MCAP recordings of this project's layout with defects."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from tools.corrupted import defects
from tools.corrupted.content import FPS, HEIGHT, NUM_FRAMES, PAIR_NAMES, WIDTH, pair_motion, pictures
from tools.corrupted.defects import Kind, Label
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.mcap.exported import write_episode_mcap

Change = Callable[[str, int, bytes], bytes | None]
"""(topic, number, message) -> the message, changed, or None to leave it out."""


def _dropped(topic: str, number: int) -> Change:
    return lambda found, index, message: None if (found, index) == (topic, number) else message


def _no_direction(topic: str, index: int, message: bytes) -> bytes:
    if topic != "/tf":
        return message
    transform = FrameTransform.FromString(message)
    transform.rotation.Clear()
    return transform.SerializeToString()


MESSAGE_KINDS: tuple[tuple[str, Change, tuple[str, ...]], ...] = (
    ("image_dropped", _dropped("/head/image", 7), ("length_mismatch",)),
    ("transform_dropped", _dropped("/tf", 0), ("missing_calibration",)),
    ("calibration_dropped", _dropped("/head/calibration", 0), ("missing_calibration", "length_mismatch")),
    ("rotation_without_direction", _no_direction, ("invalid_extrinsics",)),
)
FILE_KINDS = (
    Kind("file_truncated", defects.truncate, ("unreadable",)),
    Kind("file_garbage", defects.garbage, ("unreadable",)),
    Kind("not_an_episode", lambda path, random: rewrite(path, with_metadata=False), ("unreadable", "missing_topic")),
)


def write(root: Path, healthy: int, each: int, random: np.random.Generator) -> tuple[list[Label], dict[str, Any]]:
    """A folder of files: labels, and the `curate.sources[]` entry that reads it."""
    labels: list[Label] = []

    def place(kind: str = "clean", reasons: tuple[str, ...] = (), **changes: Any) -> Path:
        name = f"{len(labels):06d}"
        path = root / f"{name}.mcap"
        episode = {"episode_id": f"{root.name}-{name}", **changes}
        write_episode_mcap(path, _episode(random, **episode), {"head": pictures(random)})
        labels.append(Label(episode["episode_id"], "mcap", kind, "curate" if reasons else "kept", reasons))
        return path

    for _ in range(healthy):
        place()
    for number in range(each):
        place("intrinsics_singular", ("singular_intrinsics",), cameras={"head": _camera(0.0)})
        for name, change, reasons in MESSAGE_KINDS:
            rewrite(place(name, reasons), change)
        for kind in FILE_KINDS:
            path = place(kind.name, kind.reasons)
            kind.spoil(path, random)
            labels[-1] = replace(labels[-1], episode_id=path.name)
        if number < healthy:
            path = place("id_twice", ("duplicate_id",), episode_id=labels[number].episode_id)
            labels[-1] = replace(labels[-1], episode_id=f"{labels[number].episode_id}@{path.name}")
    return labels, {"kind": "mcap", "path": str(root), "name": root.name}


def _camera(focal_px: float = 80.0) -> CameraTrack:
    K = np.array([[focal_px, 0, (WIDTH - 1) / 2], [0, 80.0, (HEIGHT - 1) / 2], [0, 0, 1]])
    pose = np.array([[0.0, 0, -1, 2], [1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1]])
    return CameraTrack("head", K, pose[None], WIDTH, HEIGHT)


def _episode(random: np.random.Generator, **changes: Any) -> Episode:
    state = pair_motion(random)
    episode = Episode(
        episode_id="",
        source="mcap",
        embodiment="ur5e_pair",
        scene="mcap",
        task_family="lift",
        instruction="lift the block",
        outcome="success",
        split="train",
        fps=FPS,
        state=state,
        action=state + np.float32(0.002),
        timestamps=np.arange(NUM_FRAMES) / FPS,
        cameras={"head": _camera()},
        state_names=PAIR_NAMES,
    )
    return replace(episode, **changes)


def rewrite(path: Path, change: Change = lambda topic, index, message: message, *, with_metadata: bool = True) -> None:
    """The same file with some messages changed or left out."""
    with path.open("rb") as stream:
        reader = make_reader(stream)
        metadata, messages = list(reader.iter_metadata()), list(reader.iter_messages())
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start()
        for record in metadata if with_metadata else ():
            writer.add_metadata(record.name, record.metadata)
        channels: dict[str, int] = {}
        count: Counter[str] = Counter()
        for schema, channel, message in messages:
            data = change(channel.topic, count[channel.topic], message.data)
            count[channel.topic] += 1
            if data is None or schema is None:
                continue
            if channel.topic not in channels:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, kind)
            writer.add_message(channels[channel.topic], message.log_time, data, message.publish_time)
        writer.finish()
