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
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from einops import rearrange
from torch import Tensor

from tools.small_world_causal import forcing_step, matching_step, regression_step
from tools.small_world_data import FIRST_SEED, NAMES, SHORT, VIEWS, Recorded, plan_files, record_files
from tools.small_world_measures import Facts, Measuring, Predictor, drift, judge_processes
from tools.small_world_memory import Memory, recorded_files
from tools.small_world_runs import (
    STEPS,
    ForcingSettings,
    MatchingSettings,
    Plan,
    RunPlan,
    Timed,
    TokenizerSettings,
    key_of,
)
from tools.small_world_steps import VIEW_SHARES, Start, Step, base_step, stage2_step
from tools.small_world_table import COLUMNS, markdown, table
from worldline_core.config import load_config
from worldline_core.distillation.distill_config import CYCLE
from worldline_core.errors import ConfigError, StoppedError
from worldline_core.evaluation.segmenters.learned import LearnedSegmenter
from worldline_core.model.checkpoint import read_checkpoint_info, save_checkpoint
from worldline_core.model.patch_tokenizer import PatchTokenizer, Refinement, fit_patch_tokenizer
from worldline_core.model.world_model_config import TextConfig
from worldline_core.store.artifact_files import read_json, read_json_lines
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic
from worldline_core.training.train_tokenizer import (
    DecoderBatch,
    DecoderObjective,
    disturb,
    reconstruction_metrics,
    to_video,
)
from worldline_core.training.trainer import ParameterGroup, TrainingResult, step_generator, train
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
PACE_STEPS = 6 * CYCLE
"""Steps that tell what a step takes; the first third, in which much is done once, does not count."""


def trained(
    settings: Timed, seed: int, device: str, title: str, output: Path, identity: Facts, make: Callable[[], Step]
) -> tuple[TrainingResult, dict[str, int], Step]:
    """Train, or go on: averaged weights, counts of steps and clips, and what ``make`` made.

    A length in seconds becomes a number of steps once, in ``pace.json`` beside ``output``, for all seeds alike.
    """

    def run(step: Step, folder: Path, steps: int, log_every: int) -> TrainingResult:
        config = settings.trainer(steps, seed, device, log_every)
        return train(
            config,
            groups=step.groups,
            objective=step.objective,
            load=step.load,
            validate=None if step.held_out is None else partial(step.held_out, config),
            output=folder,
            identity={**identity, "steps": steps},
            title=title,
            schedule=partial(settings.factor, steps=steps) if isinstance(settings, TokenizerSettings) else None,
        )

    steps = settings.steps
    if steps is None:
        path, key = output.parent / "pace.json", key_of({"step": title, "settings": settings.model_dump(mode="json")})
        pace = read_json(path)
        if key not in pace:
            with TemporaryDirectory() as folder:
                run(make(), Path(folder), PACE_STEPS, CYCLE)
                seconds = [row["seconds"] for row in read_json_lines(Path(folder) / "run" / "timings.jsonl")]
            first = len(seconds) // 3
            pace[key] = (seconds[-1] - seconds[first - 1]) / (CYCLE * (len(seconds) - first))
            write_json_atomic(path, pace)
        steps = max(1, round((settings.seconds or 0.0) / pace[key]))
    if isinstance(settings, MatchingSettings):
        steps = CYCLE * -(-steps // CYCLE)
    step = make()
    return run(step, output, steps, 5 * CYCLE), {"steps": steps, "clips": steps * settings.batch}, step


def train_tokenizer(folder: Path, output: Path, settings: TokenizerSettings, device: str) -> None:
    """Fit the bases, train the decoder, save both with what they measure on validation recordings."""
    files: list[Recorded] = []
    for name in recorded_files(folder):
        if sum(len(file.facts) for file in files) < settings.episodes and (file := Recorded.read(folder / name)).short:
            files.append(file)
    stack = torch.from_numpy(np.concatenate([file.frames for file in files if file.split == "train"])).to(device)
    shares = torch.tensor(VIEW_SHARES)
    chosen = np.random.default_rng(0)

    def fitted() -> Tensor:
        clip = stack[int(chosen.integers(len(stack))), int(chosen.choice(len(VIEWS), p=VIEW_SHARES))]
        return to_video(rearrange(clip.cpu(), "f h w c -> 1 c f h w"))

    tokenizer = fit_patch_tokenizer(
        (fitted() for _ in range(600)),
        channels=settings.channels,
        refinement_width=settings.width,
        refinement_depth=settings.depth,
    )

    def load(index: int) -> DecoderBatch:
        draws = step_generator(50, index, "cpu")
        rows = torch.randint(len(stack), (settings.batch,), generator=draws)
        views = torch.multinomial(shares, settings.batch, replacement=True, generator=draws)
        # The first frame and three of the eight groups of four frames after it.
        groups = torch.randint(8, (settings.batch, 3), generator=draws).sort(dim=1).values
        frames = 1 + (groups[:, :, None] * 4 + torch.arange(4)).flatten(1)
        frames = torch.cat((torch.zeros_like(frames[:, :1]), frames), dim=1)
        video = to_video(rearrange(stack[rows[:, None], views[:, None], frames], "b f h w c -> b c f h w"))
        with torch.no_grad():
            codes = disturb(tokenizer.encode(video), 0.3, step_generator(51, index, device))
            coarse = tokenizer.decode_linear(codes)
        dropped = float(torch.rand((), generator=draws)) < 0.1
        return DecoderBatch(("",) * settings.batch, video, coarse, None if dropped else video[:, :, 0])

    def make() -> Step:
        torch.manual_seed(0)
        tokenizer.refinement = Refinement(tokenizer.temporal_compression, settings.width, settings.depth)
        decoder = tokenizer.to(device).refinement.train().requires_grad_(True)
        groups = [ParameterGroup("decoder", dict(decoder.named_parameters()))]
        return Step(DecoderObjective(tokenizer.refine), groups, load)

    identity: Facts = {"settings": settings.model_dump(mode="json"), "encoder": tokenizer.encoder_digest}
    result, counts, _ = trained(settings, 0, device, "tokenizer", output, identity, make)
    tokenizer.refinement.load_state_dict(result.average)
    tokenizer.refinement.eval().requires_grad_(False)
    facts: Facts = {**counts, "training_episodes": len(stack), "width": settings.width, "depth": settings.depth}
    tokenizer.save(output, facts)
    held = [file.frames[:5] for file in files if file.split == "validation"][:4]
    if held:
        shown = [
            torch.from_numpy(view).permute(3, 0, 1, 2) for part in held for view in part.reshape(-1, *part.shape[2:])
        ]
        facts["held_out"] = reconstruction_metrics(PatchTokenizer.load(output), shown[:30], SHORT)
    write_json_atomic(output / "figures.json", facts)
    print("tokenizer", json.dumps(facts), flush=True)


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
    output.mkdir(parents=True, exist_ok=True)
    begun = read_json(output / "recordings.json") or {"files": recorded_files(folder)}
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
    if arguments.command == "record":
        tasks = plan_files(arguments.folder, arguments.last_seed, arguments.only, arguments.first_seed)
        record_files(tasks[arguments.start :][: arguments.files], arguments.workers)
        return
    torch.set_float32_matmul_precision("high")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    plan = load_config(Plan, path=arguments.plan)
    try:
        if arguments.command == "train":
            plan = plan.of_seeds(arguments.seeds)
            train_plan(arguments.folder, arguments.output, arguments.tokenizer, plan, device)
        elif plan.tokenizer is None:
            raise ConfigError("The plan has no tokenizer", where=arguments.plan, expected="a section tokenizer")
        else:
            train_tokenizer(arguments.folder, arguments.output, plan.tokenizer, device)
    except StoppedError as stopped:
        print(stopped, file=sys.stderr)
        sys.exit(143)


if __name__ == "__main__":
    main()
