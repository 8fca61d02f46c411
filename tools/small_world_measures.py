"""How good models of the small world are: latent errors, drift, and what the measured judge sees in their videos.

Axes: n or b clips, v views, c latent channels, f video frames, t latent frames, h w H W rows and columns of latents and
of pixels.
"""

from __future__ import annotations

import multiprocessing
import os
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.pool import Pool
from pathlib import Path

import cv2
import numpy as np
import torch
from einops import rearrange
from torch import Tensor

from benchmarks.judge_recordings import KnownMasks, task_of
from benchmarks.outcome_ladder import area
from tools.small_world_data import SHORT, VIEWS, Memory, Recorded, videos
from worldline_core.distillation.causal_objective import self_forced_rollout
from worldline_core.evaluation.planning.selectors import planning_indices
from worldline_core.evaluation.policy.evidence import route
from worldline_core.evaluation.policy.measured_judge import UNSEEN_SCORE, measure, score
from worldline_core.model.contracts import CausalSpec
from worldline_core.model.world_model import WorldModel
from worldline_core.rollout.samplers import integrate, shifted_sigmas

Predict = Callable[[Tensor, Tensor], Tensor]
"""Latents (b v c t h w) of clips, from their first latent frame (the others are not read) and all their action maps."""
Facts = dict[str, object]


def same_noise(latents: Tensor) -> Tensor:
    """Noise for every clip of a batch, the same for all clips and all models."""
    generator = torch.Generator(latents.device).manual_seed(0)
    return torch.randn(latents.shape[1:], generator=generator, device=latents.device).expand_as(latents)


@torch.no_grad()
def predict_stage2(model: WorldModel, steps: int, shift: float, latents: Tensor, maps: Tensor) -> Tensor:
    """Prediction of a Stage II model, in a number of Euler steps of a shifted schedule."""
    state = torch.cat((latents[:, :, :, :1], same_noise(latents)[:, :, :, 1:]), dim=3)

    def velocity(state: Tensor, sigma: float) -> Tensor:
        levels = torch.full((len(state),), sigma, device=state.device)
        return model(state, levels, action_maps=maps, views=VIEWS).velocity

    with torch.autocast(latents.device.type, torch.bfloat16):
        return integrate(velocity, state, shifted_sigmas(steps, shift))


@torch.no_grad()
def predict_causal(model: WorldModel, spec: CausalSpec, latents: Tensor, maps: Tensor) -> Tensor:
    """Prediction of a causal model, block by block."""
    first, noise = latents[:, :, :, :1], same_noise(latents)
    with torch.autocast(latents.device.type, torch.bfloat16):
        return self_forced_rollout(
            model, first, maps, noise, spec.steps - 1, views=VIEWS, spec=spec, with_gradient=False
        )


def drift(memory: Memory, predict: Predict) -> list[float]:
    """Latent error of long held-out rollouts over that of copying the first frame, by blocks of four latent frames."""
    if not memory.count("test", short=False):
        return []
    rows = torch.arange(min(30, memory.count("test", short=False)), device=memory.device)
    latents, maps = memory.episodes("test", short=False).clips(rows)

    def error(predicted: Tensor) -> Tensor:
        return ((predicted - latents) ** 2)[:, :, :, 1:].mean(dim=(0, 1, 2, 4, 5)).unflatten(0, (-1, 4)).mean(dim=1)

    ratios = error(predict(latents, maps)) / error(latents[:, :, :, :1])
    return [round(ratio, 3) for ratio in ratios.tolist()]


def judged(task: tuple[str, np.ndarray, np.ndarray]) -> float:
    """The measured judge's score of an instruction's video uint8 (v, f, H, W, 3), with exact robot masks (f, H, W)."""
    instruction, pixels, robot = task
    shown = {view: pixels[v] for v, view in enumerate(VIEWS)}
    measured = measure(KnownMasks(robot), instruction, route(instruction), shown, None)
    return UNSEEN_SCORE if measured is None else score(measured)


@dataclass(frozen=True)
class Measuring:
    """Measures predictions of held-out recordings; the judge runs in processes of its own."""

    memory: Memory
    judges: Pool

    def measure(self, predict: Predict, split: str, limit: int, picture: Path | None = None) -> Facts:
        """Latent errors, and by task the area under the curve of the judge's score, over a split's first recordings.

        Args:
            limit: recordings to stop after.
            picture: file for some predictions under the recordings they should be.
        """
        sums: dict[str, list[float]] = defaultdict(list)
        videos_shown: list[tuple[str, np.ndarray, np.ndarray]] = []
        outcomes: list[tuple[str, bool]] = []
        strips: list[np.ndarray] = []
        chosen, count = list(planning_indices(SHORT)), 0
        for file in self.memory.held:
            if file.split != split or file.masks is None or count >= limit:
                continue
            count += len(file.facts)
            errors, pixels = self._predicted(predict, file)
            for name, value in errors.items():
                sums[name].append(value)
            pairs = zip(file.frames[:2], pixels[:2], strict=True)
            strips += [video[v, ::4] for pair in pairs for v in range(2) for video in pair]
            for i, fact in enumerate(file.facts):
                if fact.outcome != "unknown":
                    robot = file.masks[i, 0, 0][chosen].astype(bool)
                    videos_shown.append((fact.instruction, pixels[i][:, chosen], robot))
                    outcomes.append((task_of(fact.instruction), fact.outcome == "success"))
        if picture is not None and strips:
            rows = [np.concatenate(list(strip), axis=1) for strip in strips[:40]]
            cv2.imwrite(str(picture), np.concatenate(rows)[..., ::-1])
        scores = np.array(self.judges.map(judged, videos_shown, chunksize=8))
        table = {}
        for task in sorted({task for task, _ in outcomes}):
            of_task = np.array([name == task for name, _ in outcomes])
            success = np.array([success for _, success in outcomes])[of_task]
            table[task] = area(scores[of_task], success)
        result: Facts = {name: round(float(np.mean(values)), 4) for name, values in sums.items()}
        # A task of which all recordings end alike has no area.
        areas = {task: round(value, 3) for task, value in table.items() if not np.isnan(value)}
        mean = round(float(np.mean(list(areas.values()))), 3) if areas else None
        return result | {"area": areas, "mean_area": mean, "episodes": count}

    @torch.no_grad()
    def _predicted(self, predict: Predict, file: Recorded) -> tuple[dict[str, float], np.ndarray]:
        """Squared latent errors of a file's predictions, and the predictions as uint8 (n, v, f, H, W, 3)."""
        device = self.memory.device
        video = videos(file.frames, device)
        moved = torch.from_numpy(file.things[:, :, 0]).to(device).float()
        latents = self.memory.encode(video)
        predicted = predict(latents, torch.from_numpy(file.maps).to(device).float()).float()
        error = ((predicted - latents) ** 2).mean(dim=2)[:, :, 1:]
        copy = ((latents[:, :, :, :1] - latents) ** 2).mean(dim=2)[:, :, 1:]
        inside = (torch.maximum(moved, moved[:, :, :1]) > 0.1)[:, :, 1:]
        parts = {
            "error": error,
            "copy": copy,
            "error_head": error[:, 0],
            "error_moved": error[inside],
            "copy_moved": copy[inside],
        }
        with torch.autocast(device, torch.bfloat16):
            decoded = self.memory.tokenizer.decode(predicted.flatten(0, 1), video[:, :, :, 0].flatten(0, 1))
        pixels = ((decoded.float().clamp(-1, 1) + 1) * 127.5).round().to(torch.uint8)
        pixels = rearrange(pixels, "(n v) c f h w -> n v f h w c", v=len(VIEWS)).cpu().numpy()
        return {name: float(part.mean()) for name, part in parts.items()}, pixels


def judge_processes() -> Pool:
    """Processes for the judge, which takes a core for longer than a model takes the device."""
    return multiprocessing.get_context("spawn").Pool(min(8, os.cpu_count() or 1))
