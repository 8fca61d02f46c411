"""Findings about a folder of recordings with their evidence, open questions and the stated licence: as text, JSON and a configuration file.

The file extends a preset, and its comments say why each value is there.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Container, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Self

import yaml

from worldline_core.config import QUESTIONS, TODO
from worldline_core.data.episodes.episode import NO_EMBODIMENT
from worldline_core.data.guards.source_paths import AnyPath, is_file, regular_file
from worldline_core.data.sources.calibration_file import read_calibration
from worldline_core.errors import ConfigError
from worldline_core.untrusted_text import cut, printable, shown, visible

Place = tuple[str, ...]
"""Keys that lead to a value within the source: ("arms", "right", "state", "gripper")."""


@dataclass(frozen=True)
class Question:
    """A value that cannot be known from the files: it becomes a TODO line, to which its place refers."""

    name: str
    text: str


@dataclass
class Discovery:
    """A folder of recordings, as it was understood.

    Attributes:
        about: one line: layout, robot, number of episodes, rate.
        source: an entry of `curate.sources`; questions stand for what is unknown.
        evidence: place within the source -> a sentence with the numbers that led to it.
        views: those that a model is to see, head first.
        fps: of the recordings.
        state_size: columns of the state; None of videos without states.
        episodes: those that can be read, where that is known without reading them; `frames`: of half of them, or more.
        cameras: how many of these views have one; `head_camera`: the head has.
        trains: False of recordings that are for evaluation only.
        notes: what the user should know, and no value says.
    """

    kind: str
    about: str
    source: dict[str, Any]
    evidence: dict[Place, str] = field(default_factory=dict)
    views: list[str] = field(default_factory=list)
    fps: float | None = None
    state_size: int | None = None
    episodes: int | None = None
    frames: int | None = None
    cameras: Literal["all", "some", "none"] = "none"
    head_camera: bool = False
    trains: bool = True
    notes: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, kind: str, root: AnyPath, about: str, evidence: str, **known: Any) -> Self:
        """Recordings of a kind of source, by this evidence."""
        return cls(kind, about, {"kind": kind, "path": str(root)}, {("kind",): evidence}, **known)

    def say(self, place: Place, value: Any, evidence: str) -> None:
        """Set a value of the source, with its evidence."""
        inner = self.source
        for key in place[:-1]:
            inner = inner.setdefault(key, {})
        inner[place[-1]] = value
        self.evidence[place] = evidence

    def count_cameras(self, *known: Container[str]) -> None:
        """Set ``cameras`` and ``head_camera`` from the views with a camera, of each episode looked at."""
        have = [view in each for each in known for view in self.views]
        self.cameras = "all" if have and all(have) else "some" if any(have) else "none"
        self.head_camera = all("head" in each for each in known)

    @property
    def questions(self) -> list[Question]:
        """Everything that has to be asked, once."""
        return list(dict.fromkeys(_questions(self.source)))


_CALIBRATIONS = (
    *(f"meta/calibration.{suffix}" for suffix in ("yaml", "yml", "json")),
    *("calibration.yaml", "calibration.json", "cameras.json"),
)


def name_calibration(found: Discovery, root: AnyPath) -> None:
    """Names the calibration file of a source's folder, if there is one. Raises: RejectedInputError: it cannot be read."""
    for name in _CALIBRATIONS:
        if (root / name).exists():
            known = list(read_calibration(root, name))
            found.say(("calibration",), name, f"cameras of {named(known)}")
            found.count_cameras(known)
            return


def _questions(value: Any) -> list[Question]:
    if isinstance(value, Question):
        return [value]
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list | tuple) else ()
    return [each for part in parts for each in _questions(part)]


def named(texts: Sequence[object], most: int = 8) -> str:
    """A list of texts of others within a sentence."""
    shown = [cut(visible(str(text)).replace("\n", " "), 60) for text in texts[:most]]
    return ", ".join(shown) + (f" and {len(texts) - most} more" if len(texts) > most else "")


_TEXT_WIDTH = 110


def as_json(found: Discovery, written: Path, commands: Sequence[str]) -> dict[str, Any]:
    """Everything that was found, what is to be filled in, the file and what to run next."""
    return {
        "kind": found.kind,
        "about": found.about,
        "file": str(written),
        "source": _plain(found.source),
        "views": found.views,
        "fps": found.fps,
        "state_size": found.state_size,
        "cameras": found.cameras,
        "trains": found.trains,
        "evidence": [{"key": list(place), "sentence": text} for place, text in found.evidence.items()],
        "todo": {each.name: each.text for each in found.questions},
        "notes": found.notes,
        "next": list(commands),
    }


def _plain(value: Any) -> Any:
    if isinstance(value, Question):
        return f"{QUESTIONS}.{value.name}"
    if isinstance(value, dict):
        return {str(key): _plain(inner) for key, inner in value.items()}
    return [_plain(inner) for inner in value] if isinstance(value, list | tuple) else value


def as_text(found: Discovery, written: Path, commands: Sequence[str]) -> str:
    """The same for a terminal."""
    lines = [shown(found.about)]
    for place, text in found.evidence.items():
        lines += _wrapped(f"{'.'.join(place)}: {shown(text)}", "  ")
    for note in found.notes:
        lines += _wrapped(f"note: {shown(note)}", "")
    lines.append(f"written: {written}")
    if found.questions:
        lines.append(f"to be filled in there, under `{QUESTIONS}`:")
        for each in found.questions:
            lines += _wrapped(f"{each.name}: {shown(each.text)}", "  ")
    return "\n".join([*lines, *(f"next: {command}" for command in commands)])


def _wrapped(text: str, indent: str) -> list[str]:
    return textwrap.wrap(
        " ".join(text.split()),
        _TEXT_WIDTH,
        initial_indent=indent,
        subsequent_indent=f"{indent}    ",
        break_on_hyphens=False,
    )


_SPDX = {
    "apache-2.0": "Apache-2.0", "mit": "MIT", "bsd-3-clause": "BSD-3-Clause", "cc0-1.0": "CC0-1.0", "cc-by-4.0": "CC-BY-4.0",
    "cc-by-sa-4.0": "CC-BY-SA-4.0", "cc-by-nc-4.0": "CC-BY-NC-4.0", "cc-by-nc-sa-4.0": "CC-BY-NC-SA-4.0",
}  # fmt: skip
_TEXTS = {
    "apache license": "Apache-2.0", "mit license": "MIT", "attribution-noncommercial-sharealike 4.0": "CC-BY-NC-SA-4.0",
    "attribution-noncommercial 4.0": "CC-BY-NC-4.0", "attribution-sharealike 4.0": "CC-BY-SA-4.0",
    "attribution 4.0": "CC-BY-4.0", "cc0 1.0": "CC0-1.0",
}  # fmt: skip
_IN_CARD = re.compile(r"^licen[cs]e:[ \t]*[\"']?([\w.+-]{2,40})[\"']?[ \t]*$", re.MULTILINE)
_MOST_BYTES = 1 << 16


def stated_licence(root: AnyPath) -> tuple[str, str] | None:
    """(identifier, evidence) by the head of the dataset's card, or by the text of its licence file; None where nothing says."""
    for name in ("README.md", "LICENSE", "LICENSE.md", "LICENSE.txt", "LICENCE"):
        if not is_file(root / name):
            continue
        with regular_file(root / name).open("rb") as file:
            text = file.read(_MOST_BYTES).decode("utf-8", errors="replace")
        if name == "README.md":
            head = text.split("---", 2)[1] if text.startswith("---") and text.count("---") > 1 else ""
            if (found := _IN_CARD.search(head)) is not None:
                said = found[1]
                return _SPDX.get(said.lower(), cut(printable(visible(said)), 40)), "README.md says so"
            continue
        first = " ".join(text[:400].lower().split())
        if (known := next((spdx for words, spdx in _TEXTS.items() if words in first), None)) is not None:
            return known, f"by the text of {name}"
    return None


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
_FILE_WIDTH = 120


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
            "  # There are two episodes and one is held out, so no loss is measured while a model trains.",
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
    return textwrap.wrap(plain, _FILE_WIDTH, initial_indent=start, subsequent_indent=start, break_on_hyphens=False)


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
