"""MCAP recordings of this project's layout with defects."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from tools.corrupted import defects
from tools.corrupted.content import FPS, HEIGHT, NUM_FRAMES, WIDTH, gripper_motion, joint_motion, pictures
from tools.corrupted.defects import Kind, Label
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.mcap.exported import write_episode_mcap

_BASES = 4
_CHUNK = 0x06
Sample = tuple[Episode, dict[str, np.ndarray]]
_Change = Callable[[str, int, Any], Any]
"""(topic, number, protobuf message) -> the message, changed, or None to leave it out."""


def _beyond_limit(sample: Sample, random: np.random.Generator) -> Sample:
    state = sample[0].state.copy()
    state[int(random.integers(NUM_FRAMES)), int(random.integers(6))] = 8.0
    return replace(sample[0], state=state), sample[1]


def _slow_clock(sample: Sample, random: np.random.Generator) -> Sample:
    return replace(sample[0], timestamps=sample[0].timestamps * random.uniform(1.2, 1.6)), sample[1]


def _singular(sample: Sample, random: np.random.Generator) -> Sample:
    camera = sample[0].cameras["head"]
    K = camera.K.copy()
    K[int(random.integers(2))] = 0
    return replace(sample[0], cameras={"head": replace(camera, K=K)}), sample[1]


VALUE_KINDS = (
    Kind("joint_beyond_limit", _beyond_limit, ("joint_out_of_range",)),
    Kind("clock_slow", _slow_clock, ("wrong_fps",)),
    Kind("intrinsics_singular", _singular, ("singular_intrinsics",)),
)


def _dropped(topic: str, number: int) -> _Change:
    return lambda found, index, message: None if (found, index) == (topic, number) else message


def _bomb(found: str, index: int, message: Any) -> Any:
    """A PNG header that claims 30,000 x 30,000 pixels."""
    if found == "/head/image":
        header = message.data[12:16] + struct.pack(">II", 30_000, 30_000) + message.data[24:29]
        message.data = message.data[:12] + header + struct.pack(">I", zlib.crc32(header)) + message.data[33:]
    return message


def _no_direction(found: str, index: int, message: Any) -> Any:
    if found == "/tf":
        message.rotation.Clear()
    return message


MESSAGE_KINDS: tuple[tuple[str, _Change, tuple[str, ...]], ...] = (
    ("image_dropped", _dropped("/head/image", 7), ("length_mismatch",)),
    ("state_dropped", _dropped("/joint_states", 3), ("length_mismatch",)),
    ("transform_dropped", _dropped("/tf", 0), ("missing_calibration",)),
    ("calibration_dropped", _dropped("/head/calibration", 0), ("missing_calibration", "length_mismatch")),
    ("image_claims_pixels", _bomb, ("too_large",)),
    ("rotation_without_direction", _no_direction, ("invalid_extrinsics",)),
)


def claim_chunk(path: Path, random: np.random.Generator) -> None:
    """The first chunk claims to unpack to a terabyte."""
    content = bytearray(path.read_bytes())
    position = 8
    while content[position] != _CHUNK:
        position += 9 + struct.unpack_from("<Q", content, position + 1)[0]
    struct.pack_into("<Q", content, position + 9 + 16, 10**12)
    path.write_bytes(bytes(content))


FILE_KINDS = (
    Kind("file_truncated", defects.truncate, ("unreadable",)),
    Kind("file_empty", defects.empty, ("unreadable",)),
    Kind("file_garbage", defects.garbage, ("unreadable",)),
    Kind("file_linked_out", defects.link_out, ("path_traversal",)),
)


def write(root: Path, healthy: int, each: int, random: np.random.Generator) -> tuple[list[Label], dict[str, Any]]:
    """A folder of files: labels, and the `curate.sources[]` entry that reads it."""
    labels: list[Label] = []

    def place(sample: Sample, kind: str, reasons: tuple[str, ...] = ()) -> Path:
        identity = f"{root.name}-{len(labels):06d}"
        path = root / f"{len(labels):06d}.mcap"
        write_episode_mcap(path, replace(sample[0], episode_id=identity), sample[1])
        labels.append(Label(identity, "mcap", kind, "curate" if reasons else "kept", reasons))
        return path

    def known_by_its_name(path: Path) -> None:
        labels[-1] = replace(labels[-1], episode_id=path.name)

    for _ in range(healthy):
        place(_sample(random), "clean")
    bases = [_sample(random) for _ in range(_BASES)]
    for number in range(each):
        base = bases[number % _BASES]
        for kind in VALUE_KINDS:
            place(kind.spoil(base, random), kind.name, kind.reasons)
        for name, change, reasons in MESSAGE_KINDS:
            _rewrite(place(base, name, reasons), change)
        for kind in FILE_KINDS:
            path = place(base, kind.name, kind.reasons)
            kind.spoil(path, random)
            known_by_its_name(path)
        claim_chunk(place(base, "chunk_claims_bytes", ("unreadable", "out_of_memory")), random)
        path = place(base, "not_an_episode", ("unreadable", "missing_topic"))
        _rewrite(path, lambda found, index, message: message, with_metadata=False)
        known_by_its_name(path)
        if number < healthy:
            path = place(base, "id_twice", ("duplicate_id",))
            first = f"{root.name}-{number:06d}"
            write_episode_mcap(path, replace(base[0], episode_id=first), base[1])
            labels[-1] = replace(labels[-1], episode_id=f"{first}@{path.name}")
    return labels, {"kind": "mcap", "path": str(root), "name": root.name}


def _sample(random: np.random.Generator) -> Sample:
    arms = [np.concatenate([joint_motion(random, 6), gripper_motion(random)[:, None]], axis=1) for _ in range(2)]
    state = np.concatenate(arms, axis=1).astype(np.float32)
    K = np.array([[80.0, 0, (WIDTH - 1) / 2], [0, 80.0, (HEIGHT - 1) / 2], [0, 0, 1]])
    pose = np.array([[0.0, 0, -1, 2], [1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1]])
    episode = Episode(
        episode_id="base",
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
        state_names=tuple(
            f"{arm}/{n}" for arm in ("left", "right") for n in (*(f"joint_{j}" for j in range(6)), "gripper")
        ),
    )
    return episode, {"head": pictures(random)}


def _rewrite(path: Path, change: _Change, *, with_metadata: bool = True) -> None:
    """The same file with some messages changed or left out."""
    with path.open("rb") as stream:
        reader = make_reader(stream)
        metadata = list(reader.iter_metadata())
        found = list(reader.iter_messages())
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(profile="", library="worldline")
        for record in metadata if with_metadata else ():
            writer.add_metadata(record.name, record.metadata)
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        count: dict[str, int] = {}
        for schema, channel, message in found:
            if schema is None:
                continue
            index = count.get(channel.topic, 0)
            count[channel.topic] = index + 1
            name = schema.name.removeprefix("foxglove.")
            published = getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)
            changed = change(channel.topic, index, published.FromString(message.data))
            if changed is None:
                continue
            if schema.name not in schemas:
                schemas[schema.name] = writer.register_schema(schema.name, schema.encoding, schema.data)
            if channel.topic not in channels:
                channels[channel.topic] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.name]
                )
            data = changed.SerializeToString()
            writer.add_message(channels[channel.topic], message.log_time, data, message.publish_time)
        writer.finish()
