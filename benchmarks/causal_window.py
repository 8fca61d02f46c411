"""Long causal rollouts of two models, trained for equal times on the window of the cache and on the full history.

    worldline record --config configs/recording/small_world_long.yaml --output TRAIN     # episodes of 129 frames
    worldline record ... --set num_frames=1025 --output TEST                             # held out, of 64 blocks
    python benchmarks/causal_window.py prepare TRAIN TEST OUTPUT
    python benchmarks/causal_window.py train OUTPUT window --minutes 8
    python benchmarks/causal_window.py train OUTPUT full_history --minutes 8
    python benchmarks/causal_window.py measure OUTPUT --figure docs/pictures/causal_window.svg

Both start from the shipped Stage II model and are trained by teacher forcing on 65 frames (four blocks) with a window of
the observed frame and one recent block, in processor minutes. Both are rolled out with that window, on the recorded
controls of whole held-out episodes. The figure is the squared latent error of a block over that of the copied first
frame, with 95 % bootstrap intervals over episodes. `train` continues where it was stopped.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from einops import rearrange
from safetensors.torch import load_file, save_file
from torch import Tensor

from worldline_core.actions.action_maps import latent_frame_indices, render_action_maps
from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.actions.episode_tracks import collate_tracks
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.distillation.causal_teacher_forcing import TeacherForcingObjective
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.geometry.kinematics import KinematicsByName
from worldline_core.model.checkpoint import load_checkpoint, save_checkpoint
from worldline_core.model.tokenizers import load_tokenizer
from worldline_core.model.video_tokenizer import frames_to_video
from worldline_core.model.world_model_config import VIEWS
from worldline_core.pages.charts import Series, line_chart
from worldline_core.rollout.samplers import BlockCausalSimulator, Noise
from worldline_core.store.atomic import write_json_atomic
from worldline_core.training.clip_loader import Batch
from worldline_core.training.clip_source import Clip
from worldline_core.training.trainer import ParameterGroup, step_generator, train

History = Literal["window", "full_history"]
MODELS = Path(__file__).resolve().parents[1] / "artifacts" / "shipped" / "models"
SIZE, GRID, SIGMA_PX_REF = (64, 96), (8, 12), 36.0
CUT = 17
"""Latent frames of a training clip: the observed one and four blocks."""
GROUP = 4
"""Blocks of one point of the curve."""


def config_of(history: History, steps: int, batch: int) -> DistillConfig:
    """Teacher forcing as the shipped causal model was trained, with a window that a training clip is longer than."""
    return DistillConfig.model_validate(
        {
            "clips": {"lengths": [1 + 4 * (CUT - 1)]},
            "window": {"sink_blocks": 1, "recent_blocks": 1, "trained_on": history},
            "teacher_forcing": {
                "history_noise": 0.2,
                "sigma": {"shift": 5.0},
                "weighting": {"motion": 1.0},
                "trainer": {
                    "steps": steps,
                    "batch_size": batch,
                    "ema_decay": 0.98,
                    "log_every": 10,
                    "optimizer": {"learning_rate": 4e-4, "warmup_steps": 20, "decay_steps": steps // 3},
                },
            },
        }
    )


def prepare(recordings: Path, output: Path) -> None:
    """Latents of whole episodes, of every fourth frame alone (a clip may begin there), and action maps: one file."""
    episodes, tokenizer = EpisodeSet.open(recordings), load_tokenizer(MODELS / "tokenizer")
    kinematics = KinematicsByName({})
    parts: dict[str, list[Tensor]] = {"latents": [], "alone": [], "maps": []}
    for position, row in enumerate(episodes.rows):
        count = row.num_frames
        tracks, _ = compute_tracks(episodes.episode(position), kinematics.get(row.embodiment))
        cut = tracks.clip(latent_frame_indices(count))
        maps = render_action_maps(collate_tracks([cut], views=VIEWS), cut.image_size, GRID, sigma_px_ref=SIGMA_PX_REF)
        parts["maps"].append(maps[0].half())
        views: dict[str, list[Tensor]] = {"latents": [], "alone": []}
        for view in VIEWS:
            video = frames_to_video(episodes.frames(position, view, list(range(count))), SIZE)
            views["latents"].append(tokenizer.encode(video[None])[0])
            single = tokenizer.encode(rearrange(video[:, ::4], "c t h w -> t c 1 h w"))
            views["alone"].append(rearrange(single, "t c 1 h w -> c t h w"))
        for name, found in views.items():
            parts[name].append(torch.stack(found).half())
    save_file({name: torch.stack(found) for name, found in parts.items()}, output)


def trained(output: Path, history: History, minutes: float, batch: int) -> None:
    """Train one of the two models for so many processor minutes, or go on with it."""
    data = load_file(output / "train.safetensors")
    folder = output / history
    model, info = load_checkpoint(MODELS / "stage2", expect_kind="stage2", towers="generation")
    model.train()

    def load(index: int) -> Batch:
        draws = step_generator(7, index, "cpu")
        rows = torch.randint(len(data["latents"]), (batch,), generator=draws).tolist()
        starts = torch.randint(data["latents"].shape[3] - CUT + 1, (batch,), generator=draws).tolist()
        cuts = [(row, start, start + CUT) for row, start in zip(rows, starts, strict=True)]
        latents = torch.stack([data["latents"][row, :, :, start:stop] for row, start, stop in cuts]).float()
        latents[:, :, :, 0] = torch.stack([data["alone"][row, :, :, start] for row, start, _ in cuts]).float()
        maps = torch.stack([data["maps"][row, :, :, start:stop] for row, start, stop in cuts]).float()
        clips = tuple(Clip(str(row), 4 * start, 1 + 4 * (CUT - 1), 1) for row, start, _ in cuts)
        return Batch(clips, VIEWS, latents, maps)

    planned = folder / "steps.json"
    if not planned.is_file():
        # Equal times, not equal steps: what a step costs is measured once, before the first.
        objective, spent = TeacherForcingObjective(model, config_of(history, 6, batch)), []
        for index in range(4):
            examples, start = load(index), time.process_time()
            with torch.autocast("cpu", torch.bfloat16):
                objective.loss(examples, step_generator(0, index, "cpu"), 0)[0].backward()
            spent.append(time.process_time() - start)
            model.zero_grad(set_to_none=True)
        seconds = min(spent)
        folder.mkdir(parents=True, exist_ok=True)
        write_json_atomic(planned, {"steps": round(60 * minutes / seconds), "seconds_a_step": seconds})
    facts = json.loads(planned.read_text(encoding="utf-8"))
    config = config_of(history, facts["steps"], batch)
    trainer = config.teacher_forcing.trainer
    result = train(
        trainer,
        groups=(ParameterGroup("student", dict(model.named_parameters())),),
        objective=TeacherForcingObjective(model, config),
        load=load,
        output=folder,
        identity={"config": config.model_dump(mode="json"), "start": info.weights_sha256},
        title=history,
    )
    save_checkpoint(
        folder,
        model,
        kind="causal",
        action_contract=info.contract,
        causal=config.spec,
        metadata={"benchmark": "causal_window", **facts, "batch": batch, "loss": result.metrics["loss"]},
        state_dict=model.state_dict() | result.average,
    )


Rolled = dict[str, list[list[float]]]


@torch.no_grad()
def rolled(output: Path, history: History, batch: int) -> Rolled:
    """Squared error of every block of every episode, that of copying, and the bytes of the cache after every block.

    A batch that was rolled out before is read from ``output``.
    """
    data = load_file(output / "test.safetensors")
    model, _ = load_checkpoint(output / history, expect_kind="causal")
    spec = config_of(history, steps=1, batch=1).spec
    found: Rolled = {"error": [], "copy": [], "cache_bytes": []}
    for first in range(0, len(data["latents"]), batch):
        path = output / history / f"rolled-{first:03d}-{batch}.json"
        if not path.is_file():
            latents, maps = (data[name][first : first + batch].float() for name in ("latents", "maps"))
            noise = Noise(range(42 + first, 42 + first + len(latents)))
            simulator = BlockCausalSimulator(model.eval(), spec, noise=noise, bfloat16=True)
            simulator.start(latents[:, :, :, 0], maps[:, :, :, :1])
            columns: dict[str, list[Tensor]] = {name: [] for name in found}
            for start in range(1, latents.shape[3] - spec.block_size + 1, spec.block_size):
                truth = latents[:, :, :, start : start + spec.block_size]
                block = simulator.step(maps[:, :, :, start : start + spec.block_size])
                columns["error"].append(((block - truth) ** 2).mean(dim=(1, 2, 3, 4, 5)))
                columns["copy"].append(((latents[:, :, :, :1] - truth) ** 2).mean(dim=(1, 2, 3, 4, 5)))
                columns["cache_bytes"].append(torch.full((len(truth),), simulator.cache.nbytes / len(truth)))
            part = {name: torch.stack(values, dim=1).tolist() for name, values in columns.items()}
            write_json_atomic(path, part)
        for name, values in json.loads(path.read_text(encoding="utf-8")).items():
            found[name] += values
    return found


def curve(error: np.ndarray, copy: np.ndarray, size: int = GROUP) -> np.ndarray:
    """One error over another in every group of blocks, with its 95 % interval over episodes: ``(3, groups)``."""
    error, copy = (rearrange(values, "n (g s) -> s n g", s=size).mean(axis=0) for values in (error, copy))
    draws = np.random.default_rng(0).integers(len(error), size=(2000, len(error)))
    ratios = error[draws].sum(axis=1) / copy[draws].sum(axis=1)
    return np.stack((error.sum(axis=0) / copy.sum(axis=0), *np.quantile(ratios, (0.025, 0.975), axis=0)))


STYLE = """<style>text{font:11px sans-serif;fill:#333}.end{text-anchor:end}.middle{text-anchor:middle}.grid{stroke:#ddd}
.axis{stroke:#888}.series *{fill:none;stroke-width:2}.series polygon{stroke:none;opacity:.2}.c0 *{stroke:#1f6fb4}
.c3 *{stroke:#c23b22}.c0 polygon{fill:#1f6fb4}.c3 polygon{fill:#c23b22}</style><rect width="480" height="270" fill="#fff"/>
<text x="264" y="268" class="middle">block of the rollout</text>
<text x="68" y="22" style="fill:#1f6fb4">trained on the window</text>
<text x="68" y="36" style="fill:#c23b22">trained on the full history</text>"""


def measure(output: Path, batch: int, figure: Path | None) -> None:
    """Roll out both models, print their curves, and draw them."""
    series: list[Series] = []
    figures: dict[str, object] = {}
    errors: list[np.ndarray] = []
    drawn: tuple[tuple[History, str, str], ...] = (("window", "c0", "window"), ("full_history", "c3", "full history"))
    for history, colour, label in drawn:
        found = rolled(output, history, batch)
        errors.append(np.array(found["error"]))
        value, low, high = curve(np.array(found["error"]), np.array(found["copy"]))
        blocks = [GROUP * group + (GROUP + 1) / 2 for group in range(len(value))]
        series.append(Series(label, blocks, value.tolist(), low.tolist(), high.tolist(), colour))
        figures[history] = {
            "error_over_copying": value.round(3).tolist(),
            "low": low.round(3).tolist(),
            "high": high.round(3).tolist(),
            "cache_bytes": sorted({size for sizes in found["cache_bytes"] for size in sizes}),
            **json.loads((output / history / "steps.json").read_text(encoding="utf-8")),
        }
    figures["window_over_full_history"] = {
        f"blocks {first + 1} to {first + 16}": curve(
            errors[0][:, first : first + 16], errors[1][:, first : first + 16], 16
        )
        .flatten()
        .round(3)
        .tolist()
        for first in range(0, errors[0].shape[1] - 15, 16)
    }
    figures["episodes"] = len(errors[0])
    print(json.dumps(figures, indent=1))
    if figure is not None:
        chart = str(line_chart(series, title="", x_label="block of the rollout", y_label="squared error over copying"))
        head, rest = chart[chart.index("<svg") : chart.rindex("</svg>") + len("</svg>")].split(">", 1)
        head = head if "xmlns" in head else head.replace("<svg", '<svg xmlns="http://www.w3.org/2000/svg"')
        figure.write_text(f"{head}>{STYLE}{rest}\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    preparing = verbs.add_parser("prepare")
    for name in ("train", "test", "output"):
        preparing.add_argument(name, type=Path)
    training = verbs.add_parser("train")
    training.add_argument("output", type=Path)
    training.add_argument("history", choices=("window", "full_history"))
    training.add_argument("--minutes", type=float, default=8.0)
    measuring = verbs.add_parser("measure")
    measuring.add_argument("output", type=Path)
    measuring.add_argument("--figure", type=Path)
    for verb, size in ((training, 6), (measuring, 3)):
        verb.add_argument("--batch", type=int, default=size)
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    if options.verb == "prepare":
        prepare(options.train, options.output / "train.safetensors")
        prepare(options.test, options.output / "test.safetensors")
    elif options.verb == "train":
        trained(options.output, options.history, options.minutes, options.batch)
    else:
        measure(options.output, options.batch, options.figure)


if __name__ == "__main__":
    main()
