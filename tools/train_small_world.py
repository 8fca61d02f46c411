"""Record the small world, train models on it and compare them, on one GPU, with everything in memory.

    python -m tools.train_small_world record FOLDER
    python -m tools.train_small_world tokenizer FOLDER TOKENIZER --plan configs/shipped/small_world.yaml
    python -m tools.train_small_world train FOLDER OUTPUT --plan configs/shipped/small_world.yaml

Models, losses, loops and checkpoints are the library's. What differs from its tasks: latents and action maps stay on the
device, so that a small model sees thousands of clips a second; and steps have a length in seconds.

`train` makes every run of the plan with every seed, measures what it made, and writes `table.md` after each. Any of the three
may be stopped or killed at any moment: the same command goes on where it was, a training with the same bits on a CPU.

OUTPUT holds a folder for each step, named after all that decides its content, so that runs share what they have in
common; `runs.json` says which run has which.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch

from tools.small_world_causal import forcing_step, matching_step, regression_step
from tools.small_world_data import FIRST_SEED, NAMES, plan_files, record_files
from tools.small_world_measures import Facts, Measuring, Predictor, drift, judge_processes
from tools.small_world_memory import Memory, recorded_files
from tools.small_world_runs import (
    STEPS,
    ForcingSettings,
    MatchingSettings,
    Plan,
    RunPlan,
    Timed,
    key_of,
)
from tools.small_world_steps import Start, Step, base_step, stage2_step, trained
from tools.small_world_table import COLUMNS, markdown, table
from tools.small_world_tokenizer import train_tokenizer
from worldline_core.config import load_config
from worldline_core.errors import ConfigError, StoppedError, WorldLineError
from worldline_core.evaluation.segmenters.learned import LearnedSegmenter
from worldline_core.model.checkpoint import read_checkpoint_info, save_checkpoint
from worldline_core.model.tokenizers import PatchTokenizer
from worldline_core.model.world_model_config import TextConfig
from worldline_core.store.artifact_files import read_json
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic
from worldline_core.training.training_state import STATES
from worldline_core.training.video_teacher import load_teacher

MODELS = Path(__file__).resolve().parents[1] / "artifacts" / "shipped" / "models"
MAKERS: dict[str, Callable[[Start, Any], Step]] = {
    "base": base_step,
    "stage2": stage2_step,
    "teacher_forcing": forcing_step,
    "trajectory_regression": regression_step,
    "distribution_matching": matching_step,
}
"""What makes the steps of a run."""


def sampler_name(kind: str, sampler: tuple[int, float]) -> str:
    """What a sampler's figures are stored under: files have their names in the order of the alphabet."""
    return f"{sampler[0]} steps, shift {sampler[1]:g}" if kind == "stage2" else "causal"


@dataclass
class Training:
    """The runs of a plan on recordings in memory; finished steps and figures are read from ``output``."""

    memory: Memory
    plan: Plan
    output: Path
    measuring: Measuring
    _folders: dict[str, dict[str, str]] = field(default_factory=dict)
    _figures: dict[str, dict[int, dict[str, float]]] = field(default_factory=dict)

    def all(self) -> None:
        """Every run with the first seed, then with the next: a plan that is cut short has compared something."""
        reference = self.plan.reference or next(iter(self.plan.runs))
        for seed in self.plan.seeds:
            for name, run in self.plan.runs.items():
                folders = self.run(run, seed)
                self._folders[f"{name}, seed {seed}"] = {step: path.name for step, path in folders.items()}
                write_json_atomic(self.output / "runs.json", self._folders)
                last = list(folders.values())[-1]
                if read_checkpoint_info(last).kind != "base":
                    self._figures.setdefault(name, {})[seed] = self.figures(last)
                write_json_atomic(self.output / "table.json", table(self._figures, reference))
                write_bytes_atomic(self.output / "table.md", markdown(self._figures, reference).encode())
        print((self.output / "table.md").read_text(encoding="utf-8"))

    def run(self, run: RunPlan, seed: int) -> dict[str, Path]:
        """The folders of a run's steps.

        Raises: ConfigError when it has none.
        """
        steps = run.steps()
        if not steps:
            raise ConfigError("A run has no steps", expected=f"some of {', '.join(STEPS)}")
        folders: dict[str, Path] = {}
        parent = stage2 = run.start
        for name, settings in steps.items():
            start = Start(self.memory, 100 * seed + STEPS.index(name), run.model or self.plan.model, parent, stage2)
            parent = folders[name] = self.step(name, settings, start, seed)
            if name == "stage2":
                stage2 = parent
            self.measured(parent)
        return folders

    def step(self, name: str, settings: Timed, start: Start, seed: int) -> Path:
        """The folder of a step's checkpoint, trained where it is not there yet."""
        tokenizer = self.memory.tokenizer.encoder_digest[:16]
        parent = None if start.parent is None else read_checkpoint_info(start.parent)
        follows = None
        if isinstance(settings, ForcingSettings):
            follows = settings.teacher
        elif isinstance(settings, MatchingSettings):
            follows = start.stage2
        identity: Facts = {
            "step": name,
            "settings": settings.model_dump(mode="json"),
            "seed": seed,
            "start": start.config.model_dump(mode="json") if parent is None else parent.weights_sha256,
            "stage2": None if follows is None else read_checkpoint_info(follows).weights_sha256,
            "tokenizer": tokenizer,
            "recordings": key_of({"names": self.memory.names}),
        }
        folder = self.output / f"{name}-{key_of(identity)}"
        if (folder / "checkpoint.json").is_file():
            return folder

        result, counts, step = trained(
            settings, start.seed, self.memory.device, name, folder, identity, partial(MAKERS[name], start, settings)
        )
        metadata: Facts = {
            **identity,
            "start": "scratch" if parent is None else {"kind": parent.kind, "weights_sha256": parent.weights_sha256},
            "run": {**counts, "loss": round(result.metrics["loss"], 5)},
            "episodes": self.memory.count(),
            "sources": {"worldline_recorder": self.memory.count()},
            **({"text": TextConfig().model_dump(mode="json")} if name == "base" else {}),
        }
        weights = step.saved["model"].state_dict() | result.average
        save_checkpoint(folder, **step.saved, metadata=metadata, state_dict=weights)
        shutil.rmtree(folder / STATES)
        print(folder.name, json.dumps(metadata["run"]), flush=True)
        return folder

    def measured(self, folder: Path) -> Facts:
        """What is measured of a checkpoint, by sampler and split; nothing of a base model."""
        info, wanted = read_checkpoint_info(folder), self.plan.measure
        if info.kind == "base":
            return {}
        path = folder / f"measured-{key_of(wanted.model_dump(mode='json'))}.json"
        if found := read_json(path):
            return found
        found = {}
        for sampler in wanted.samplers if info.kind == "stage2" else wanted.samplers[:1]:
            predictor = Predictor.open(folder, self.memory.device, sampler)
            found[sampler_name(info.kind, sampler)] = {
                split: self.measuring.measure(predictor, split, limit, folder / f"{split}-{len(found)}.png")
                for split, limit in wanted.splits.items()
            }
            if info.kind == "causal":
                found["drift"] = drift(self.memory, predictor)
        write_json_atomic(path, found)
        print(folder.name, json.dumps(found), flush=True)
        return found

    def figures(self, folder: Path) -> dict[str, float]:
        """The figures of the table: of the plan's first sampler and split, and of what was unseen besides scenes."""
        found: Any = self.measured(folder)
        wanted = self.plan.measure
        splits = found[sampler_name(read_checkpoint_info(folder).kind, wanted.samplers[0])]
        first = splits[next(iter(wanted.splits))]
        figures = {name: first[name] for name in COLUMNS if first.get(name) is not None}
        if unseen := splits.get("ood_test"):
            figures["unseen_robot_iou"] = unseen["robot_iou"]
        return figures | ({"drift_last": found["drift"][-1]} if found.get("drift") else {})


def train_plan(folder: Path, output: Path, tokenizer: Path, plan: Plan, device: str) -> None:
    """All runs of a plan, on the recordings that were there when ``output`` was begun."""
    if not plan.runs:
        raise ConfigError("The plan has nothing to train", where="runs", expected="name: steps of a run")
    begun = read_json(output / "recordings.json") or {"files": recorded_files(folder)}
    output.mkdir(parents=True, exist_ok=True)
    write_json_atomic(output / "recordings.json", begun)
    teacher = load_teacher(MODELS / "teacher", device=device) if plan.relational else None
    memory = Memory(folder, begun["files"], PatchTokenizer.load(tokenizer).to(device), teacher)
    segmenter = LearnedSegmenter.load(MODELS / "segmenter")
    segmenter.network.to(device)
    with judge_processes() as judges:
        Training(memory, plan, output, Measuring(memory, judges, segmenter)).all()


def main() -> None:
    """One of the subcommands."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    recording = commands.add_parser("record", help="record files that training reads")
    recording.add_argument("folder", type=Path)
    cores = min(15, os.cpu_count() or 1)
    recording.add_argument("--workers", type=int, default=cores, help="processes (here %(default)s)")
    recording.add_argument(
        "--last-seed", type=int, default=3019, help="chunks of training recordings end with this one"
    )
    recording.add_argument(
        "--first-seed", type=int, default=FIRST_SEED, help="leave out chunks before this one (%(default)s)"
    )
    recording.add_argument("--only", nargs="+", choices=NAMES, help="recordings of some configurations alone")
    recording.add_argument("--start", type=int, default=0, help="leave out so many files, to share work among machines")
    recording.add_argument("--files", type=int, help="record so many files")
    for name, text in (("tokenizer", "fit a tokenizer"), ("train", "train, measure and compare the runs of the plan")):
        command = commands.add_parser(name, help=text)
        command.add_argument("folder", type=Path, help="recordings")
        command.add_argument("output", type=Path)
        command.add_argument("--plan", type=Path, required=True, help="YAML, such as configs/shipped/small_world.yaml")
        if name == "train":
            command.add_argument("--tokenizer", type=Path, default=MODELS / "tokenizer", help="(the shipped one)")
            command.add_argument("--seeds", type=int, nargs="+", help="some of the plan's seeds alone")
    arguments = parser.parse_args()
    # `timeout` ends a call so: what runs beside this process is ended with it, and a training saves its state first.
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    try:
        _called(arguments)
    except WorldLineError as error:
        print(error, file=sys.stderr)
        sys.exit(143 if isinstance(error, StoppedError) else 1)


def _called(arguments: argparse.Namespace) -> None:
    if arguments.command == "record":
        tasks = plan_files(arguments.folder, arguments.last_seed, arguments.only, arguments.first_seed)
        record_files(tasks[arguments.start :][: arguments.files], arguments.workers)
        return
    torch.set_float32_matmul_precision("high")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    plan = load_config(Plan, path=arguments.plan)
    if arguments.command == "train":
        train_plan(arguments.folder, arguments.output, arguments.tokenizer, plan.of_seeds(arguments.seeds), device)
    elif plan.tokenizer is None:
        raise ConfigError("The plan has no tokenizer", where=arguments.plan, expected="a section tokenizer")
    else:
        train_tokenizer(arguments.folder, arguments.output, plan.tokenizer, device)


if __name__ == "__main__":
    main()
