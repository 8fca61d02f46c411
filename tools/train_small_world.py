"""Record the small world and train the shipped models on it, on one GPU, with everything in memory.

    python -m tools.train_small_world record FOLDER --workers 15
    python -m tools.train_small_world tokenizer FOLDER TOKENIZER --plan configs/shipped/small_world.yaml
    python -m tools.train_small_world compare FOLDER OUTPUT --tokenizer TOKENIZER --plan VARIANTS.yaml
    python -m tools.train_small_world train FOLDER OUTPUT --tokenizer TOKENIZER --plan configs/shipped/small_world.yaml

Models, losses, samplers and checkpoints are the library's. What differs from its tasks: latents and action maps stay on
the device, so that a small model sees thousands of clips a second; and runs have a length in seconds, not in steps.
`record` may go on while the others train on what is there. A plan has a section for each thing to train; what is left
out is not trained. `compare` trains Stage II with each of the plan's `variants` (name: settings of Stage II) and prints
their errors on validation recordings: the choice is the reader's.

Axes: b clips, v views, c latent channels, t latent frames, h and w rows and columns.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from einops import rearrange
from torch import Tensor

from tools.small_world_data import (
    GRID,
    SHORT,
    SIGMA_PX_REF,
    VIEWS,
    Arrivals,
    Memory,
    Recorded,
    plan_files,
    record_files,
)
from tools.small_world_measures import Facts, Measuring, Predict, drift, judge_processes, predict_causal, predict_stage2
from tools.small_world_runs import (
    BaseSettings,
    CausalSettings,
    ForcingSettings,
    MatchingSettings,
    Plan,
    RegressionSettings,
    Run,
    Stage2Settings,
    TokenizerSettings,
    compile_now,
    cosine,
    plateau,
)
from worldline_core.config import load_config
from worldline_core.distillation.causal_teacher_forcing import teacher_forcing_loss
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.distillation.distribution_matching import DistributionMatchingObjective
from worldline_core.distillation.teacher_trajectories import teacher_trajectories
from worldline_core.distillation.trajectory_regression import draw_nodes, trajectory_regression_loss
from worldline_core.distillation.trajectory_store import TrajectoryBatch
from worldline_core.errors import ConfigError
from worldline_core.model.checkpoint import CheckpointInfo, load_checkpoint, save_checkpoint
from worldline_core.model.contracts import ActionContract
from worldline_core.model.patch_tokenizer import PatchTokenizer, Refinement, fit_patch_tokenizer
from worldline_core.model.text import load_text_encoder
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import TextConfig, WorldModelConfig
from worldline_core.store.atomic import write_json_atomic
from worldline_core.training.flow_matching import (
    add_noise,
    flow_matching_loss,
    motion_weights,
    sample_sigmas,
    velocity_target,
)
from worldline_core.training.stage1 import stage1_groups
from worldline_core.training.stage2 import stage2_groups
from worldline_core.training.train_tokenizer import DecoderBatch, DecoderObjective, reconstruction_metrics, to_video
from worldline_core.training.trainer import ParameterGroup, step_generator
from worldline_core.training.training_config import LossWeighting, SigmaSampling

VIEW_SHARES = (0.5, 0.25, 0.25)
"""Of steps or clips on single views: the head view counts as much as both wrist views."""


def disturb(latents: Tensor, amount: float, generator: torch.Generator) -> Tensor:
    """`worldline_core.training.train_tokenizer.disturb` of codes (b c t h w) that are on the generator's device.

    The library draws on the CPU, which gives the same bits everywhere and would take longer here than the step itself.
    """
    batch, _, frames = latents.shape[:3]

    def rand(probability: float) -> Tensor:
        level, chance = torch.rand(2, batch, 1, frames, 1, 1, generator=generator, device=latents.device)
        return level * (chance < probability)

    flat = rearrange(latents, "b c t h w -> (b t) c h w")
    blurred = F.avg_pool2d(F.pad(flat, (1, 1, 1, 1), mode="replicate"), 3, stride=1)
    disturbed = latents + rand(0.3) * (rearrange(blurred, "(b t) c h w -> b c t h w", t=frames) - latents)
    noise = torch.randn(latents.shape, generator=generator, device=latents.device)
    disturbed = disturbed + amount * rand(0.7) * noise
    return torch.cat((latents[:, :, :1], disturbed[:, :, 1:]), dim=2)


def first_recordings(arrivals: Arrivals, wanted: int) -> list[Recorded]:
    """Files in their order until they hold enough episodes.

    Raises: DataError when no more files come.
    """
    found: list[Recorded] = []

    def take() -> int:
        for recorded in arrivals.new():
            found.append(recorded)
            if sum(len(file.facts) for file in found) >= wanted:
                break
        return sum(len(file.facts) for file in found)

    arrivals.wait(take, wanted)
    return [file for file in found if file.short]


def train_tokenizer(folder: Path, output: Path, settings: TokenizerSettings, device: str) -> None:
    """Fit the bases, train the decoder, save both with what they measure on validation recordings."""
    files = first_recordings(Arrivals(folder), settings.wait)
    stack = torch.from_numpy(np.concatenate([file.frames for file in files if file.split == "train"])).to(device)
    print(f"tokenizer: {len(stack)} training episodes", flush=True)

    def clips() -> Iterator[Tensor]:
        chosen = np.random.default_rng(0)
        for _ in range(600):
            clip = stack[int(chosen.integers(len(stack))), int(chosen.choice(len(VIEWS), p=VIEW_SHARES))]
            yield to_video(rearrange(clip.cpu(), "f h w c -> 1 c f h w"))

    tokenizer = fit_patch_tokenizer(
        clips(), channels=settings.channels, refinement_width=settings.width, refinement_depth=settings.depth
    )
    torch.manual_seed(0)
    tokenizer.refinement = Refinement(tokenizer.temporal_compression, settings.width, settings.depth)
    decoder = tokenizer.to(device).refinement.train().requires_grad_(True)
    generator = torch.Generator(device).manual_seed(0)
    shares = torch.tensor(VIEW_SHARES, device=device)
    objective = DecoderObjective(tokenizer)
    size = 96

    def loss_of(step: int) -> Tensor:
        rows = torch.randint(len(stack), (size,), generator=generator, device=device)
        views = torch.multinomial(shares, size, replacement=True, generator=generator)
        # The first frame and three of the eight groups of four frames after it.
        groups = torch.randint(8, (size, 3), generator=generator, device=device).sort(dim=1).values
        index = 1 + (groups[:, :, None] * 4 + torch.arange(4, device=device)).flatten(1)
        index = torch.cat((torch.zeros_like(index[:, :1]), index), dim=1)
        video = to_video(rearrange(stack[rows[:, None], views[:, None], index], "b f h w c -> b c f h w"))
        with torch.no_grad():
            coarse = tokenizer.decode_linear(disturb(tokenizer.encode(video), 0.3, generator))
        dropped = float(torch.rand((), generator=generator, device=device)) < 0.1
        batch = DecoderBatch((), video, coarse, None if dropped else video[:, :, 0])
        with torch.autocast(device, torch.bfloat16):
            return objective.loss(batch, generator, step)[0]

    run = Run(
        title="tokenizer",
        groups=[ParameterGroup("decoder", dict(decoder.named_parameters()))],
        seconds=settings.seconds,
        lr=2e-3,
        schedule=cosine,
        ema=0.998,
        betas=(0.9, 0.99),
        weight_decay=1e-4,
    ).train(loss_of)
    decoder.eval().requires_grad_(False)
    facts: Facts = {**run, "clips": run["steps"] * size, "training_episodes": len(stack)}
    facts |= {"width": settings.width, "depth": settings.depth}
    tokenizer.save(output, facts)
    held = [file.frames[:5] for file in files if file.split == "validation"][:4]
    if held:
        shown = [
            torch.from_numpy(view).permute(3, 0, 1, 2) for part in held for view in part.reshape(-1, *part.shape[2:])
        ]
        facts["held_out"] = reconstruction_metrics(PatchTokenizer.load(output), shown[:30], SHORT)
    write_json_atomic(output / "metrics.json", facts)
    print("tokenizer", json.dumps(facts), flush=True)


def new_model(config: WorldModelConfig, towers: Literal["both", "generation"], device: str) -> WorldModel:
    """A model with random weights, the same each time."""
    model = WorldModel(config.model_copy(update={"towers": towers}))
    model.initialise(torch.Generator().manual_seed(0))
    return model.to(device)


def object_weights(things: Tensor, moved: float, others: float) -> Tensor:
    """Loss weights (b v 1 t h w) of mean one over the noisy frames, larger where things are or were at the start.

    Args:
        things: (b v 2 t h w) share of each cell that shows what the task moves, and other things.
        moved, others: extra weight of a cell that is full of them.
    """
    seen = torch.maximum(things, things[:, :, :, :1])
    weight = 1 + moved * seen[:, :, :1].sqrt() + others * seen[:, :, 1:].sqrt()
    return weight / weight[:, :, :, 1:].mean(dim=(1, 2, 3, 4, 5), keepdim=True)


def train_base(memory: Memory, model: WorldModel, settings: BaseSettings) -> dict[str, float]:
    """Text and the first frame to one view, which always takes the first slot."""
    device, size = memory.device, settings.batch
    encoder = load_text_encoder(TextConfig(), model.config.vocab_size)
    sampling, weighting = SigmaSampling(shift=3.0), LossWeighting(motion=1.0)
    generator, chosen = torch.Generator(device).manual_seed(1), np.random.default_rng(1)

    def loss_of(step: int) -> Tensor:
        episodes = memory.episodes()
        rows = episodes.draw(size, generator)
        view = int(chosen.choice(len(VIEWS), p=VIEW_SHARES))
        latents = episodes.latents[rows, view : view + 1].float()
        sigma = sample_sigmas(sampling, size, generator)
        noise = torch.randn(latents.shape, generator=generator, device=device)
        text = None
        with torch.autocast(device, torch.bfloat16):
            if chosen.random() >= 0.1:
                ids, mask = encoder([episodes.facts[row].instruction for row in rows.tolist()], [])
                text = model.encode_text(ids.to(device), mask.to(device))
            out = model(add_noise(latents, noise, sigma), sigma, text=text, views=VIEWS[view : view + 1])
        return flow_matching_loss(out.velocity, latents, noise, sigma, weighting)

    run = Run(title="base", groups=stage1_groups(model), seconds=settings.seconds, lr=settings.lr)
    facts = run.train(loss_of, memory.poll)
    return facts | {"clips": facts["steps"] * size, "episodes": memory.count()}


def train_stage2(memory: Memory, model: WorldModel, settings: Stage2Settings, title: str) -> dict[str, float]:
    """Controls and first frames to three views."""
    device, size = memory.device, settings.batch
    weighting = LossWeighting(motion=settings.motion)
    forward = torch.compile(model.forward, dynamic=False) if settings.compile else model.forward
    generator = torch.Generator(device).manual_seed(0)

    def loss_of(step: int) -> Tensor:
        episodes = memory.episodes()
        rows = episodes.draw(size, generator)
        latents, maps = episodes.clips(rows)
        sigma = sample_sigmas(settings.sigma, size, generator)
        noise = torch.randn(latents.shape, generator=generator, device=device)
        keep = torch.rand(size, generator=generator, device=device) >= settings.action_dropout
        maps = maps * rearrange(keep, "b -> b 1 1 1 1 1")
        with torch.autocast(device, torch.bfloat16):
            velocity = forward(add_noise(latents, noise, sigma), sigma, action_maps=maps, views=VIEWS).velocity
        # The library's loss, which knows no things, with their weights on top.
        error = (velocity.float() - velocity_target(latents, noise)) ** 2
        error = error * motion_weights(latents, weighting)
        error = error * object_weights(episodes.things[rows].float(), *settings.things)
        return error[:, :, :, 1:].mean()

    if settings.compile:
        compile_now(title, loss_of, (0,))
    facts = Run(
        title=title,
        groups=stage2_groups(model, settings.action_multiplier),
        seconds=settings.seconds,
        lr=settings.lr,
        schedule=partial(plateau, last=settings.decay),
        ema=settings.ema,
    ).train(loss_of, memory.poll if settings.poll else None)
    return facts | {"clips": facts["steps"] * size, "episodes": memory.count()}


@dataclass(frozen=True)
class Trajectories:
    """Clips in half precision with the teacher's states at every node, and where the robot is (None in long ones)."""

    latents: Tensor
    maps: Tensor
    nodes: Tensor
    robot: Tensor | None


class CausalTraining:
    """The three steps of Stage III on one model, from a Stage II model.

    Args:
        report: called with the name of every step, its run, and what its saved model predicts.
    """

    def __init__(
        self,
        memory: Memory,
        settings: CausalSettings,
        stage2: Path,
        output: Path,
        report: Callable[[str, dict[str, float], Predict], None],
    ) -> None:
        self.memory, self.settings, self.stage2, self.output, self.report = memory, settings, stage2, output, report
        self.device = memory.device
        without_lpips = {"auxiliary": {"lpips": 0.0}}
        self.config = DistillConfig.model_validate(
            {
                "clips": {"lengths": [33, 65]},
                "trajectory_regression": without_lpips | {"trajectories": {"substeps": [1, 1, 1, 1]}},
                "distribution_matching": without_lpips | {"sigma_range": [0.1, 0.98], "target": "recorded"},
            }
        )
        self.spec = self.config.spec
        self.generator = torch.Generator(self.device).manual_seed(11)
        self.model, self.info = self._load(stage2)
        self.model.train()

    def train(self) -> None:
        """Every step that the plan has."""
        self.teacher_forcing(self.settings.teacher_forcing)
        if self.settings.trajectory_regression is not None:
            self.trajectory_regression(self.settings.trajectory_regression)
        if self.settings.distribution_matching is not None:
            self.distribution_matching(self.settings.distribution_matching)

    def _load(self, folder: Path) -> tuple[WorldModel, CheckpointInfo]:
        model, info = load_checkpoint(folder, towers="generation")
        return model.to(self.device), info

    def _is_long(self, number: int) -> bool:
        every = self.settings.long_every
        return every > 0 and number % every == every - 1

    def _groups(self) -> list[ParameterGroup]:
        return [ParameterGroup("student", dict(self.model.named_parameters()))]

    def _save(self, step: str, run: dict[str, float]) -> None:
        folder = self.output / step
        metadata = {
            "distillation": step,
            "seed": 11,
            "tokenizer": self.info.contract.tokenizer,
            "start": {"kind": "stage2", "weights_sha256": self.info.weights_sha256},
            "run": run,
            **sources(self.memory),
        }
        contract = self.info.contract
        save_checkpoint(
            folder, self.model, kind="causal", action_contract=contract, causal=self.spec, metadata=metadata
        )
        saved = self._load(folder)[0].eval()
        self.report(step, run, partial(predict_causal, saved, self.spec))

    def teacher_forcing(self, settings: ForcingSettings) -> None:
        """Flow matching of every block, given disturbed copies of the recorded blocks before it."""
        generator, size = self.generator, settings.batch

        def loss_of(step: int) -> Tensor:
            if self._is_long(step):
                latents, maps = self.memory.episodes(short=False).random_cuts(size // 3, generator, blocks=4)
            else:
                episodes = self.memory.episodes()
                latents, maps = episodes.clips(episodes.draw(size, generator))
            history = None
            if settings.history_noise:
                disturbance = torch.randn(latents.shape, generator=generator, device=self.device)
                level = torch.rand((len(latents), 1, 1, 1, 1, 1), generator=generator, device=self.device)
                disturbance = disturbance * level
                disturbance[..., :1, :, :] = 0
                history = latents + settings.history_noise * disturbance
            with torch.autocast(self.device, torch.bfloat16):
                return teacher_forcing_loss(
                    self.model,
                    latents,
                    maps,
                    history=history,
                    views=VIEWS,
                    spec=self.spec,
                    sampling=settings.sigma,
                    weighting=LossWeighting(motion=1.0),
                    generator=generator,
                )

        title, forward = "teacher forcing", self.model.forward_teacher_forcing
        if settings.compile:
            self.model.forward_teacher_forcing = torch.compile(forward, dynamic=False)
            long = self.settings.long_every
            compile_now(title, loss_of, (0, long - 1) if long > 1 else (0,))
        run = Run(title=title, groups=self._groups(), seconds=settings.seconds, lr=settings.lr)
        facts = run.train(loss_of, self.memory.poll)
        self.model.forward_teacher_forcing = forward
        self._save("teacher_forcing", facts | {"clips": facts["steps"] * size})

    def trajectory_regression(self, settings: RegressionSettings) -> None:
        """Regression of the nodes of the model's own trajectories, as it is now."""
        teacher = self._load(self.output / "teacher_forcing")[0].eval().requires_grad_(False)
        stored = [self._trajectories(teacher, settings.clips, self._is_long(n)) for n in range(settings.batches)]
        config, draws = self.config.trajectory_regression, np.random.default_rng(12)
        no_robot = config.auxiliary.model_copy(update={"robot": 0.0, "robot_motion": 0.0})

        def loss_of(step: int) -> Tensor:
            made = stored[int(draws.integers(len(stored)))]
            rows = torch.randperm(len(made.latents), generator=self.generator, device=self.device)
            rows = rows[: settings.batch]
            blocks = (made.latents.shape[3] - 1) // self.spec.block_size
            with torch.autocast(self.device, torch.bfloat16):
                return trajectory_regression_loss(
                    self.model,
                    made.nodes[rows].float(),
                    made.latents[rows].float(),
                    made.maps[rows].float(),
                    draw_nodes(len(rows), blocks, self.spec.steps, self.generator),
                    mask=None if made.robot is None else made.robot[rows],
                    views=VIEWS,
                    spec=self.spec,
                    config=config if made.robot is not None else config.model_copy(update={"auxiliary": no_robot}),
                )[0]

        run = Run(
            title="trajectory regression",
            groups=self._groups(),
            seconds=settings.seconds,
            lr=settings.lr,
            warmup=20,
            ema=0.99,
        ).train(loss_of)
        self._save("trajectory_regression", run | {"trajectories": sum(len(made.latents) for made in stored)})

    def _trajectories(self, teacher: WorldModel, clips: int, long: bool) -> Trajectories:
        robot = None
        if long:
            latents, maps = self.memory.episodes(short=False).random_cuts(clips // 3, self.generator, blocks=4)
        else:
            episodes = self.memory.episodes()
            rows = episodes.draw(clips, self.generator)
            latents, maps = episodes.clips(rows)
            robot = episodes.robot[rows].float()
        noise = torch.randn(latents.shape, generator=self.generator, device=self.device)
        substeps = self.config.trajectory_regression.trajectories.substeps
        with torch.autocast(self.device, torch.bfloat16):
            nodes = teacher_trajectories(teacher, latents, maps, noise, views=VIEWS, spec=self.spec, substeps=substeps)
        return Trajectories(latents.half(), maps.half(), nodes.half(), robot)

    def distribution_matching(self, settings: MatchingSettings) -> None:
        """The student's rollouts against the Stage II model's score and that of a copy which follows the student."""
        real, fake = (self._load(self.stage2)[0] for _ in range(2))
        objective = DistributionMatchingObjective(self.model, real, fake.train(), self.config, None)

        def loss_of(step: int) -> Tensor:
            episodes = self.memory.episodes()
            rows = episodes.draw(settings.batch, self.generator)
            latents, maps = episodes.clips(rows)
            # Auxiliaries against the recording: no trajectories are read.
            batch = TrajectoryBatch(
                clips=(),
                views=VIEWS,
                latents=latents,
                action_maps=maps,
                nodes=latents[:, None],
                history=latents,
                mask=episodes.robot[rows].float(),
            )
            with torch.autocast(self.device, torch.bfloat16):
                return objective.loss(batch, step_generator(14, step, self.device), step)[0]

        rate = self.config.distribution_matching.fake_score_rate
        run = Run(
            title="distribution matching",
            groups=[*self._groups(), ParameterGroup("fake score", dict(fake.named_parameters()), rate)],
            seconds=settings.seconds,
            lr=settings.lr,
            warmup=12,
            schedule=lambda done: 1.0,
            ema=0.99,
            betas=(0.0, 0.999),
        ).train(loss_of)
        self._save("distribution_matching", run)


def sources(memory: Memory) -> Facts:
    """Where the training recordings come from, for a checkpoint."""
    return {"episodes": memory.count(), "sources": {"worldline_recorder": memory.count()}}


def compare(measuring: Measuring, plan: Plan, output: Path, limit: int) -> None:
    """Train each variant of Stage II; `compare.json` has the run, and the errors of one step and of four, of each."""
    if not plan.variants:
        raise ConfigError("The plan has nothing to compare", where="variants", expected="name: settings of Stage II")
    memory, results = measuring.memory, {}
    for name, settings in plan.variants.items():
        model = new_model(settings.model, "generation", memory.device)
        results[name] = {"train": train_stage2(memory, model, settings, name)}
        model.eval()
        for steps, shift in ((1, 1.0), (4, 5.0)):
            predict = partial(predict_stage2, model, steps, shift)
            results[name][f"steps_{steps}"] = measuring.measure(predict, "validation", limit)
        print(name, json.dumps(results[name]), flush=True)
        write_json_atomic(output / "compare.json", results)


def train(measuring: Measuring, plan: Plan, output: Path) -> None:
    """Base, Stage II and the causal model, one after the other; `results.json` has all that is measured."""
    memory, results = measuring.memory, {}
    tokenizer = memory.tokenizer.encoder_digest[:16]

    def note(name: str, value: Facts) -> None:
        results[name] = value
        write_json_atomic(output / "results.json", results)
        print(name, json.dumps(value), flush=True)

    def metadata(run: dict[str, float], start: object) -> Facts:
        return {"seed": 0, "tokenizer": tokenizer, "start": start, "run": run, **sources(memory)}

    if plan.base is not None:
        model = new_model(plan.model, "both", memory.device)
        run = train_base(memory, model, plan.base)
        run["parameters"] = sum(p.numel() for p in model.parameters())
        facts = metadata(run, "scratch") | {"text": TextConfig().model_dump(mode="json")}
        save_checkpoint(output / "base", model, kind="base", action_contract=None, metadata=facts)
        note("base", {**run})
    if plan.stage2 is not None:
        if plan.stage2.start == "base":
            model, parent = load_checkpoint(output / "base", expect_kind="base", towers="generation")
            model, start = model.to(memory.device), {"kind": "base", "weights_sha256": parent.weights_sha256}
        else:
            model, start = new_model(plan.model, "generation", memory.device), {"kind": "scratch"}
        run = train_stage2(memory, model.train(), plan.stage2, "stage 2")
        contract = ActionContract.of_these_maps(
            controls="action",
            sigma_px_ref=SIGMA_PX_REF,
            wrist_projection="current_camera",
            fps=8.0,
            grid_size=GRID,
            tokenizer=tokenizer,
        )
        facts = metadata(run, start) | {"settings": plan.stage2.model_dump(mode="json")}
        save_checkpoint(output / "stage2", model, kind="stage2", action_contract=contract, metadata=facts)
        note("stage2_run", {**run})
        model.eval()
        for steps, shift, limit in ((1, 1.0, 400), (4, 5.0, 400), (35, 1.0, 120)):
            predict, name = partial(predict_stage2, model, steps, shift), f"stage2_{steps}"
            note(
                name,
                {
                    split: measuring.measure(predict, split, limit, output / f"{name}_{split}.png")
                    for split in ("validation", "test", "ood_test")
                },
            )
    if plan.causal is not None:

        def report(step: str, run: dict[str, float], predict: Predict) -> None:
            found: Facts = {
                split: measuring.measure(predict, split, limit, output / f"{step}_{split}.png")
                for split, limit in (("validation", 300), ("test", 600), ("ood_test", 600))
            }
            note(f"causal_{step}", found | {"run": run, "long": drift(memory, predict)})

        CausalTraining(memory, plan.causal, output / "stage2", output / "causal", report).train()


def main() -> None:
    """One of the subcommands."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    recording = commands.add_parser("record", help="record files that training reads")
    recording.add_argument("folder", type=Path)
    recording.add_argument("--workers", type=int, default=15, help="processes (%(default)s)")
    recording.add_argument(
        "--last-seed", type=int, default=3019, help="chunks of training recordings end with this one"
    )
    recording.add_argument(
        "--only", help="small_world, small_world_varied, validation, small_world_test or small_world_long"
    )
    recording.add_argument("--start", type=int, default=0, help="leave out so many files, to share work among machines")
    recording.add_argument("--files", type=int, help="record so many files")
    for name, text in (
        ("tokenizer", "fit a tokenizer to the first recordings"),
        ("compare", "train and measure Stage II with each of the plan's variants"),
        ("train", "train and measure the base, Stage II and causal models of the plan"),
    ):
        command = commands.add_parser(name, help=text)
        command.add_argument("folder", type=Path, help="recordings")
        command.add_argument("output", type=Path)
        command.add_argument("--plan", type=Path, required=True, help="YAML, such as configs/shipped/small_world.yaml")
        if name != "tokenizer":
            command.add_argument("--tokenizer", type=Path, required=True)
            command.add_argument("--wait", type=int, default=1000, help="training recordings to wait for (%(default)s)")
        if name == "compare":
            command.add_argument("--limit", type=int, default=300, help="recordings to measure with (%(default)s)")
    arguments = parser.parse_args()
    if arguments.command == "record":
        tasks = plan_files(arguments.folder, arguments.last_seed, arguments.only)[arguments.start :]
        record_files(tasks[: arguments.files], arguments.workers)
        return
    torch.set_float32_matmul_precision("high")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    plan = load_config(Plan, path=arguments.plan)
    if arguments.command == "tokenizer":
        if plan.tokenizer is None:
            raise ConfigError("The plan has no tokenizer", where=arguments.plan, expected="a section tokenizer")
        train_tokenizer(arguments.folder, arguments.output, plan.tokenizer, device)
        return
    arguments.output.mkdir(parents=True, exist_ok=True)
    memory = Memory(Arrivals(arguments.folder), PatchTokenizer.load(arguments.tokenizer).to(device))
    memory.wait(arguments.wait)
    with judge_processes() as judges:
        if arguments.command == "compare":
            compare(Measuring(memory, judges), plan, arguments.output, arguments.limit)
        else:
            train(Measuring(memory, judges), plan, arguments.output)


if __name__ == "__main__":
    main()
