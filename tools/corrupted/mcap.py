"""MCAP recordings of this project's layout with defects."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from tools.corrupted.content import FPS, HEIGHT, NUM_FRAMES, PAIR_NAMES, WIDTH, pair_motion, pictures
from tools.corrupted.defects import FileDefect, Kind, Layout, truncate
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.mcap.exported import write_episode_mcap

Change = Callable[[str, int, bytes], bytes | None]
"""(topic, number, message) -> the message, changed, or None to leave it out."""


def _dropped(topic: str, number: int) -> FileDefect:
    def change(found: str, index: int, message: bytes) -> bytes | None:
        return None if (found, index) == (topic, number) else message

    return lambda path, random: rewrite(path, change)


def _no_direction(topic: str, index: int, message: bytes) -> bytes:
    if topic != "/tf":
        return message
    transform = FrameTransform.FromString(message)
    transform.rotation.Clear()
    return transform.SerializeToString()


def _without_metadata(path: Path, random: np.random.Generator) -> None:
    rewrite(path, with_metadata=False)


KINDS = (
    Kind("image_dropped", ("length_mismatch",), _dropped("/head/image", 7)),
    Kind("transform_dropped", ("missing_calibration",), _dropped("/tf", 0)),
    Kind("calibration_dropped", ("missing_calibration", "length_mismatch"), _dropped("/head/calibration", 0)),
    Kind("rotation_without_direction", ("invalid_extrinsics",), lambda path, _: rewrite(path, _no_direction)),
    Kind("intrinsics_singular", ("singular_intrinsics",), settings={"focal_px": 0.0}),
    Kind("file_truncated", ("unreadable",), truncate, listed_as="{file}"),
    Kind("not_an_episode", ("unreadable", "missing_topic"), _without_metadata, listed_as="{file}"),
    Kind("id_twice", ("duplicate_id",), settings={"named_as": 0}, listed_as="{id}@{file}"),
)


def _add(
    root: Path, number: int, random: np.random.Generator, named_as: int | None = None, focal_px: float = 80.0
) -> tuple[str, dict[str, Path]]:
    path, state = root / f"{number:06d}.mcap", pair_motion(random)
    K = np.array([[focal_px, 0, (WIDTH - 1) / 2], [0, 80.0, (HEIGHT - 1) / 2], [0, 0, 1]])
    pose = np.array([[0.0, 0, -1, 2], [1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1]])
    episode = Episode(
        episode_id=f"{root.name}-{number if named_as is None else named_as:06d}",
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
        cameras={"head": CameraTrack("head", K, pose[None], WIDTH, HEIGHT)},
        state_names=PAIR_NAMES,
    )
    write_episode_mcap(path, episode, {"head": pictures(random)})
    return episode.episode_id, {"file": path}


write = Layout("mcap", _add, lambda root, lengths: {"kind": "mcap"}, KINDS).write


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
