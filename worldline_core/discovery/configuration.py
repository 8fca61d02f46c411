"""The configuration file for a folder of recordings: it extends a preset, and its comments say why each value is there."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import yaml

from worldline_core.config import QUESTIONS, TODO
from worldline_core.data.episodes.episode import NO_EMBODIMENT
from worldline_core.discovery.findings import Discovery, Place, Question
from worldline_core.errors import ConfigError
from worldline_core.untrusted_text import visible

BASE_RATES = {"my_robot": 8.0}
"""Frames a second that a preset's base model knows: episodes are thinned to the nearest rate."""
OTHER_RATE = 15.0
"""Frames a second for Cosmos3, which knows any rate: a clip of 33 frames lasts two seconds."""
_VIDEOS_ALONE = """
# Videos alone: Stage I learns from them, from the shipped base.
models: {base: artifacts/shipped/models/base}
train_stage1:
  weighting: {kind: velocity, motion: 1.0}
  sigma: {kind: uniform, shift: 3.0}
  trainer: {minutes: 20, batch_size: 8, ema_decay: 0.98, optimizer: {learning_rate: 5.0e-4, warmup_steps: 20, decay: 0.3125}}"""
_CLIP_FRAMES = 33
_WIDTH = 120


def kept_frame(fps: float, frames: int | None, base_rate: float = BASE_RATES["my_robot"]) -> int:
    """Step between kept frames, so that the rate is near the base model's and the usual episode as long as a clip."""
    nearest = max(1, round(fps / base_rate))
    return nearest if frames is None else max(1, min(nearest, frames // _CLIP_FRAMES))


def write_config(found: Discovery, path: Path, given: str, preset: str = "my_robot") -> None:
    """Write the file, which must not be there.

    Args:
        given: folder or hub id as the user gave it.
        preset: what the file extends.

    Raises: ConfigError where the file is there already, or its folder is not.
    """
    text = config_text(found, given, preset)
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError as error:
        raise ConfigError(
            "The file is there already", where=path, next_step="give another name: --output FILE.yaml"
        ) from error
    except OSError as error:
        raise ConfigError(
            "The file cannot be written",
            where=path,
            got=error.strerror,
            next_step="give another place: --output FILE.yaml",
        ) from error


def config_text(found: Discovery, given: str, preset: str = "my_robot") -> str:
    """The file's text."""
    lines = [*_comment(f"Written by `worldline init {given}`: {found.about}.", 0)]
    for note in found.notes:
        lines += _comment(note, 0)
    lines += [f"extends: {preset}", ""]
    if found.questions:
        lines += ["# To be filled in, behind the &name: no command takes this file before.", f"{QUESTIONS}:"]
        lines += [f"  {each.name}: &{each.name} {_flow(f'{TODO} {each.text}')}" for each in found.questions]
        lines.append("")
    lines += ["curate:", "  sources:"]
    first, *others = _block(found.source, (), found, 6)
    lines += [*_comment(found.evidence.get(("kind",), ""), 4), f"    - {first.lstrip()}", *others]
    lines += [*_rate(found, BASE_RATES.get(preset, OTHER_RATE)), *_splits(found), *_stages(found, preset)]
    return "\n".join(lines) + "\n"


def _rate(found: Discovery, base_rate: float) -> list[str]:
    if found.fps is None:
        return [
            f"  # Every recording keeps its rate; the preset is made for {base_rate:g} frames a second.",
            "  fps: null",
        ]
    every = kept_frame(found.fps, found.frames, base_rate)
    rate = f"{found.fps / every:.3g} frames a second"
    kept = f"{rate} of {found.fps:g}" if every > 1 else f"All {found.fps:g} frames a second"
    return [
        *_comment(f"{kept}; the preset is made for {base_rate:g}.", 2),
        "  fps: null",
        f"  stride: {every}",
    ]


def _splits(found: Discovery) -> list[str]:
    """Splits of few episodes, for which the preset's shares do not work."""
    if not found.trains:
        return ["  # They are not for training: every episode keeps the split above, or test.", "  splits: null"]
    if found.episodes is None or found.episodes > 2:
        return []
    if found.episodes == 2:
        return [
            "  # Of two episodes one is held out; no loss is measured while a model trains.",
            "  splits: {validation: 0}",
        ]
    return ["  # One episode: nothing is held out, so nothing can be measured.", "  splits: {test: 0, validation: 0}"]


def _stages(found: Discovery, preset: str) -> list[str]:
    """Sections that depend on views and cameras."""
    if found.state_size is None:
        return [_VIDEOS_ALONE if preset == "my_robot" else "\n# Videos alone: Stage I learns from them."]
    views = f"[{', '.join(found.views)}]"
    lines = [
        "",
        "# Views that models see; of each episode those that it has.",
        f"encode_latents: {{views: {views}}}",
    ]
    described = found.source.get("embodiment") != NO_EMBODIMENT
    if found.cameras == "all" and described:
        return lines
    if found.cameras == "some" and described:
        drawn = [] if found.head_camera else ["train_segmenter: null"]
        text = (
            "Controls are drawn into the views that have a camera; in the others the joints themselves drive the model."
        )
    else:
        why = "No camera is calibrated" if found.cameras == "none" else "No description of the robot"
        drawn = ["render_actions: null"]
        text = (
            f"{why}: the joints themselves drive the model. With cameras (docs/your_robot.md) remove both lines,"
            " and the controls are drawn into the pictures, which models follow better."
        )
    return [*lines, "", *_comment(text, 0), *drawn, f"train_stage2: {{native_size: {found.state_size}}}"]


def _comment(text: str, indent: int) -> list[str]:
    """A text of others as comment lines."""
    plain = " ".join(visible(text.replace("\n", " ")).split())
    start = " " * indent + "# "
    return textwrap.wrap(plain, _WIDTH, initial_indent=start, subsequent_indent=start, break_on_hyphens=False)


def _block(value: dict[str, Any], place: Place, found: Discovery, indent: int) -> list[str]:
    """A mapping with a line for each key, its evidence above it."""
    lines: list[str] = []
    for key, inner in value.items():
        here = (*place, str(key))
        if here in found.evidence and here != ("kind",):
            lines += _comment(found.evidence[here], indent)
        start = f"{' ' * indent}{_flow(key)}:"
        below = any(len(other) > len(here) and other[: len(here)] == here for other in found.evidence)
        if isinstance(inner, list) and inner and isinstance(inner[0], dict):
            lines.append(start)
            for item in inner:
                item_lines = _block(item, (*here, str(item.get("name", ""))), found, indent + 4)
                lines += [f"{' ' * (indent + 2)}- {item_lines[0].lstrip()}", *item_lines[1:]]
        elif isinstance(inner, dict) and inner and (below or any(isinstance(part, dict) for part in inner.values())):
            lines += [start, *_block(inner, here, found, indent + 2)]
        else:
            lines.append(f"{start} {_flow(inner)}")
    return lines


def _flow(value: Any) -> str:
    """A value on one line."""
    if isinstance(value, Question):
        return f"*{value.name}"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_flow(key)}: {_flow(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_flow, value)) + "]"
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    quoted = '"' if isinstance(value, str) and not value.isprintable() else None  # one line, whatever is in it
    text = yaml.safe_dump(value, default_style=quoted, default_flow_style=True, width=10**9, allow_unicode=False)
    return text.removesuffix("\n").removesuffix("\n...")
