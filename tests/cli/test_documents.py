"""Commands, options, files and configuration keys that the documents name exist."""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from pydantic import BaseModel, ValidationError

from flows.command_line import build_parser
from tasks.execution.artifact_task import find_task, task_names
from tasks.execution.command_line import add_task_arguments
from worldline_core.config import QUESTIONS, _known_keys
from worldline_core.data.sources.calibration_file import CalibrationFile
from worldline_core.data.sources.lerobot import LeRobotSourceConfig
from worldline_core.data.sources.video_folder import VideoFolderSourceConfig
from worldline_core.geometry.embodiment import Embodiment
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.report.ablation_table import Variant
from worldline_core.serving.serve_config import ServeConfig
from worldline_core.training.training_config import Stage2Config, StageConfig

ROOT = Path(__file__).resolve().parents[2]
PAGES = {path.name: path.read_text() for path in (*sorted((ROOT / "docs").glob("*.md")), ROOT / "README.md")}
PAGES |= {f"{path.parent.name}/{path.name}": path.read_text() for path in sorted((ROOT / "benchmarks").glob("*.md"))}
FENCED = re.compile(r"```(\w*)\n(.*?)```", re.DOTALL)
COMMAND = re.compile(r"(?:[A-Z_]+=\S+ +)*(?:uv run +)?(worldline|python(?: -m)?) +(\S.*)", re.DOTALL)


def quoted(text: str) -> list[str]:
    """Return the code between backticks in the text itself."""
    return [part.replace("\n", " ") for part in re.findall(r"`([^`]+)`", FENCED.sub("", text))]


def commands(text: str) -> Iterator[tuple[str, list[str]]]:
    """(program, words) of every command of ours, in blocks and in the text; what follows a pipe is left out."""
    lines = [line for _, block in FENCED.findall(text) for line in block.replace("\\\n", " ").splitlines()]
    for line in (*lines, *quoted(text)):
        found = COMMAND.fullmatch(line.strip())
        if found and "…" not in line and "'" not in re.sub(r"'[^']*'", "", line):
            words = shlex.split(re.sub(r"<[^>]*>", "X", found[2]), comments=True)
            end = next((number for number, word in enumerate(words) if word in ("|", "&", ">", ";", "&&")), len(words))
            yield found[1], [word.rstrip(";") for word in words[:end]]


def check_words(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Sub-commands, options and their choices are the parser's."""
    for word, following in zip(words, [*words, ""][1:], strict=True):
        below = next((a for a in parser._actions if isinstance(a, argparse._SubParsersAction)), None)
        if below is not None and not word.startswith("-"):
            assert word in below.choices, f"no command {word}"
            parser = below.choices[word]
        elif word.startswith("--"):
            option = word.partition("=")[0]
            assert option in parser._option_string_actions, f"{parser.prog} has no {option}"
            choices = parser._option_string_actions[option].choices
            assert choices is None or following in choices, f"{option} is not {following}"


def check_key(model: type[BaseModel], dotted: str) -> None:
    keys = dotted.split(".")
    for depth, key in enumerate(keys):
        known = _known_keys(model, keys[:depth])
        assert not known or key in known, f"no key {dotted}; there are {', '.join(known)}"


@pytest.mark.parametrize("page", [name for name, text in PAGES.items() if any(commands(text))])
def test_documented_commands_exist(page: str) -> None:
    for program, words in commands(PAGES[page]):
        if program == "worldline":
            check_words(build_parser(), words)
        elif words[0].startswith("tasks."):
            assert words[0] == "tasks.X" or words[0].removeprefix("tasks.") in task_names()
            parser = argparse.ArgumentParser()
            add_task_arguments(parser)
            check_words(parser, words[1:])
        elif words[0].startswith(("tools.", "benchmarks.", "flows.", "examples/", "benchmarks/", "tools/")):
            place = ROOT / (words[0] if words[0].endswith(".py") else words[0].replace(".", "/"))
            script = (place / "__main__.py" if place.is_dir() else place.with_suffix(".py")).read_text()
            missing = [word for word in words[1:] if word.startswith("--") and f'"{word}"' not in script]
            assert not missing, f"{words[0]} has no {missing}"
        else:
            continue
        for name in (word for word in words if re.fullmatch(r"(configs|artifacts/shipped)/[\w/.-]+", word)):
            assert (ROOT / name).exists(), f"no {name}"
        if "--set" in words and words[0] in ("pipeline", "task", "nightly", "plan"):
            for override in (words[number + 1] for number, word in enumerate(words[:-1]) if word == "--set"):
                check_key(PipelineConfig, override.partition("=")[0])


SNIPPETS = {
    "captions": VideoFolderSourceConfig, "arms": LeRobotSourceConfig, "views": CalibrationFile, "policies": ServeConfig,
    "clips": StageConfig, "input": Stage2Config,
}  # fmt: skip


@pytest.mark.parametrize("page", [name for name, text in PAGES.items() if "```yaml" in text])
def test_documented_configurations_are_valid(page: str) -> None:
    """Whole files are not shown: what is missing is no mistake."""
    blocks = "\n---\n".join(block for kind, block in FENCED.findall(PAGES[page]) if kind == "yaml")
    # Alternatives of one key stand below each other.
    blocks = re.sub(r"\n(?=description: |clips: )", "\n---\n", blocks)
    blocks = blocks.replace("\n  input: {kind: f", "\n---\ninput: {kind: f").replace(", ...}", "}")
    for key, value in (
        item for values in yaml.safe_load_all(blocks) for item in (values or {}).items() if item[0] != QUESTIONS
    ):
        model, given = SNIPPETS.get(key, PipelineConfig), {key: value}
        if page == "embodiments.md":
            model = Embodiment
        elif key in ("full", "more_noise"):
            model, given = Variant, value
        elif key in task_names() and key not in PipelineConfig.model_fields:
            model, given = find_task(key).load_config(), value
        try:
            model.model_validate(given)
        except ValidationError as error:
            if {problem["type"] for problem in error.errors()} - {"missing", "too_short"}:
                pytest.fail(str(error))
