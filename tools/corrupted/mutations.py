"""Blind damage: bytes and JSON values changed at random, to find what a reader does not expect.

Whatever the damage, reading ends in an episode or in an error of this project; anything else is a bug of the reader.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from worldline_core.data.guards.reader_process import ReaderLimits, read_limited
from worldline_core.data.sources.open import SourceConfig, open_source
from worldline_core.errors import WorldLineError

LIMITS = ReaderLimits(memory_gb=2, seconds=10)
Mutation = Callable[[bytes, np.random.Generator], bytes]
_ODD_VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 1, 3, 10**6, 2**63, -(2**70), 1e308, 0.5, float("nan"), float("inf"), "", "x", "../../x", "\x00", "1",
    [], {}, [[]], [None], {"a": 1}, [1, "a"],
)  # fmt: skip


@dataclass(frozen=True)
class Unexpected:
    """An error that is none of this project's: what was done to which file, and where it came from."""

    file: str
    case: int
    error: str
    trace: str


def flip_bytes(content: bytes, random: np.random.Generator) -> bytes:
    """One to eight bytes get other values: anywhere, or in the first or last kilobyte, where headers and footers are."""
    changed = bytearray(content)
    start = int(random.choice([0, max(len(content) - 1024, 0)]))
    stop = int(random.choice([len(content), min(start + 1024, len(content))]))
    for place in random.integers(start, stop, int(random.integers(1, 9))):
        changed[place] = int(random.integers(256))
    return bytes(changed)


def cut(content: bytes, random: np.random.Generator) -> bytes:
    """The file ends early."""
    return content[: int(random.integers(0, len(content)))]


def overwrite(content: bytes, random: np.random.Generator) -> bytes:
    """A stretch is zeros or ones, as of a sector that was never written."""
    start = int(random.integers(0, len(content)))
    length = int(random.integers(1, 512))
    filler = bytes([int(random.choice([0, 255]))]) * length
    return (content[:start] + filler + content[start + length :])[: len(content)]


def repeat(content: bytes, random: np.random.Generator) -> bytes:
    """A stretch occurs twice."""
    start, stop = sorted(int(v) for v in random.integers(0, len(content) + 1, 2))
    return content[:stop] + content[start:]


def change_json(content: bytes, random: np.random.Generator, *, jsonl: bool = False) -> bytes:
    """A value is replaced by an odd one, left out, or given another name; of JSON lines in one of them."""
    lines = content.splitlines() if jsonl else [content]
    number = int(random.integers(len(lines)))
    value = root = json.loads(lines[number])
    odd = _ODD_VALUES[int(random.integers(len(_ODD_VALUES)))]
    place: Any = None
    key: Any = None
    while isinstance(value, dict | list) and value and (place is None or random.random() < 0.85):
        keys = list(value) if isinstance(value, dict) else range(len(value))
        place, key = value, keys[int(random.integers(len(keys)))]
        value = value[key]
    action = int(random.integers(4))
    if place is None:
        root = odd
    elif action == 0:
        del place[key]
    elif action == 1 and isinstance(place, dict):
        place[f"{key}x"] = place.pop(key)
    else:
        place[key] = odd
    lines[number] = json.dumps(root).encode()
    return b"\n".join(lines)


def mutations_of(path: Path) -> tuple[Mutation, ...]:
    """Mutations of a file of this kind."""
    if path.suffix in (".json", ".jsonl"):
        change = partial(change_json, jsonl=path.suffix == ".jsonl")
        return (change, change, change, flip_bytes, cut)
    return (flip_bytes, flip_bytes, flip_bytes, cut, overwrite, repeat)


def read_everything(config: SourceConfig, root: Path) -> None:
    """Open a source and read every episode with all of its pictures."""
    source = open_source(config, root)
    for episode_id in source.episode_ids():
        loaded = source.load(episode_id)
        for view in loaded.views:
            loaded.frames(view)
            for _ in loaded.robot_masks(view) or ():
                pass


def attack(config: SourceConfig, root: Path, cases: int, seed: int) -> Iterator[Unexpected]:
    """Damage one file of a small dataset at a time, read, and put it back; yields what was not expected."""
    random = np.random.default_rng(seed)
    listed = sorted(path for path in root.rglob("*") if path.is_file() and path.stat().st_size)
    for case in range(cases):
        path = listed[case % len(listed)]
        content = path.read_bytes()
        ways = mutations_of(path)
        path.write_bytes(ways[int(random.integers(len(ways)))](content, random))
        try:
            read_limited(LIMITS, read_everything, config, root)
        except WorldLineError:
            pass  # named: what, where, expected, got
        except Exception as error:  # noqa: BLE001 - finding these is what this is for
            trace = getattr(error, "__notes__", [""])[-1]
            yield Unexpected(str(path.relative_to(root)), case, f"{type(error).__name__}: {error}"[:300], trace)
        finally:
            path.write_bytes(content)
