"""Blind damage: bytes and JSON values changed at random, to find what a reader does not expect.

Whatever the damage, reading ends in an episode or in an error of this project; anything else is a bug of the reader.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from worldline_core.data.guards.reader_process import ReaderLimits, read_limited
from worldline_core.data.sources.open import SourceConfig, open_source
from worldline_core.errors import WorldLineError

LIMITS = ReaderLimits(memory_gb=2, seconds=10)
_ODD_VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 1, 3, 10**6, 2**63, -(2**70), 1e308, 0.5, float("nan"), float("inf"), "", "x", "../../x", "\x00", "1",
    [], {}, [[]], [None], {"a": 1}, [1, "a"],
)  # fmt: skip


def flip_bytes(content: bytes, random: np.random.Generator) -> bytes:
    """One to eight bytes get other values: anywhere, or in the first or last kilobyte, where headers and footers are."""
    changed = bytearray(content)
    start = int(random.choice([0, max(len(content) - 1024, 0)]))
    for place in random.integers(start, random.choice([len(content), start + 1024]), int(random.integers(1, 9))):
        changed[place % len(content)] = int(random.integers(256))
    return bytes(changed)


def exchange_stretch(content: bytes, random: np.random.Generator) -> bytes:
    """A stretch is lost, zeros as of a sector that was never written, or occurs twice; or the file ends there."""
    start, stop = sorted(int(v) for v in random.integers(0, len(content) + 1, 2))
    middle = (b"", bytes(stop - start), 2 * content[start:stop])
    return content[:start] if (way := int(random.integers(4))) == 3 else content[:start] + middle[way] + content[stop:]


def change_json(content: bytes, random: np.random.Generator) -> bytes:
    """A value of one line of JSON is replaced by an odd one, left out, or given another name."""
    lines = re.split(rb"\n(?=\{)", content.rstrip())
    number = int(random.integers(len(lines)))
    odd = _ODD_VALUES[int(random.integers(len(_ODD_VALUES)))]
    value: Any = [json.loads(lines[number])]
    root, place, key = value, value, 0
    while isinstance(value, dict | list) and value and (value is root or random.random() < 0.85):
        keys = list(value) if isinstance(value, dict) else range(len(value))
        place, key = value, keys[int(random.integers(len(keys)))]
        value = value[key]
    action = int(random.integers(4))
    if action == 0 and place is not root:
        del place[key]
    elif action == 1 and isinstance(place, dict):
        place[f"{key}x"] = place.pop(key)
    else:
        place[key] = odd
    lines[number] = json.dumps(root[0]).encode()
    return b"\n".join(lines)


def read_everything(config: SourceConfig, root: Path) -> None:
    """Open a source and read every episode with all of its pictures."""
    source = open_source(config, root)
    for episode_id in source.episode_ids():
        loaded = source.load(episode_id)
        for view in loaded.views:
            loaded.frames(view)
            for _ in loaded.robot_masks(view) or ():
                pass


def attack(config: SourceConfig, root: Path, cases: int, seed: int) -> Iterator[str]:
    """Damage one file of a small dataset at a time, read, and put it back; yields what was not expected."""
    random = np.random.default_rng(seed)
    listed = sorted(path for path in root.rglob("*") if path.is_file() and path.stat().st_size)
    for case in range(cases):
        path = listed[case % len(listed)]
        content = path.read_bytes()
        ways = (change_json if path.suffix in (".json", ".jsonl") else flip_bytes, flip_bytes, exchange_stretch)
        path.write_bytes(ways[int(random.integers(3))](content, random))
        try:
            read_limited(LIMITS, read_everything, config, root)
        except WorldLineError:
            pass  # named: what, where, expected, got
        except Exception as error:  # noqa: BLE001 - finding these is what this is for
            trace = getattr(error, "__notes__", [""])[-1]
            yield f"{type(error).__name__} {error} {trace}; {path.relative_to(root)}, case {case}"
        finally:
            path.write_bytes(content)
