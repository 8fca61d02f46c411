"""How good models of the small world are: latent errors, drift, masks, and what the measured judge sees in their videos.

Axes: n or b clips, v views, c latent channels, f video frames, t latent frames, h w H W rows and columns of latents and
of pixels.
"""

from __future__ import annotations

import multiprocessing
import os
from collections import defaultdict
from dataclasses import dataclass
from multiprocessing.pool import Pool
from pathlib import Path

import cv2
import numpy as np
import torch
from einops import rearrange
from torch import Tensor

from benchmarks.judge_recordings import KnownMasks, area, task_of
from tools.small_world_data import SHORT, VIEWS, Recorded
from tools.small_world_memory import Memory, videos
from tools.small_world_steps import controls_of
from worldline_core.distillation.causal_objective import self_forced_rollout
from worldline_core.evaluation.metrics import frame_iou
from worldline_core.evaluation.planning.bracket import planning_indices
from worldline_core.evaluation.policy.evidence import route
from worldline_core.evaluation.policy.measured_judge import UNSEEN_SCORE, measure
from worldline_core.evaluation.segmenters.coloured_things import named_things, own_colour, thing_share
from worldline_core.evaluation.segmenters.learned import LearnedSegmenter
from worldline_core.evaluation.video.episode_measurement import MOVED_IOU
from worldline_core.model.checkpoint import load_checkpoint
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import CausalSpec
from worldline_core.rollout.samplers import integrate, shifted_sigmas

Facts = dict[str, object]


def same_noise(latents: Tensor) -> Tensor:
    """Noise for every clip of a batch, the same for all clips and all models."""
    generator = torch.Generator(latents.device).manual_seed(0)
    return torch.randn(latents.shape[1:], generator=generator, device=latents.device).expand_as(latents)


@dataclass(frozen=True)
class Predictor:
    """A checkpoint that predicts latents (b v c t h w) of its views from their first frame and all controls.

    Attributes:
        spec: of a causal model; None for a Stage II model, which takes ``sampler``: Euler steps and shift.
    """

    model: WorldModel
    views: tuple[str, ...]
    spec: CausalSpec | None
    sampler: tuple[int, float]

    @classmethod
    def open(cls, folder: Path, device: str, sampler: tuple[int, float] = (1, 1.0)) -> Predictor:
        """A Stage II or causal model."""
        model, info = load_checkpoint(folder, expect_kind=("stage2", "causal"), towers="generation")
        return cls(model.to(device).eval(), info.views, info.causal, sampler)

    @property
    def chosen(self) -> list[int]:
        """Numbers of its views."""
        return [VIEWS.index(view) for view in self.views]

    def controls(self, maps: Tensor, native: Tensor) -> Tensor:
        """What drives it, of recordings with these action maps and control vectors."""
        return controls_of(maps, native, self.views, self.model.config)

    @torch.no_grad()
    def __call__(self, latents: Tensor, controls: Tensor) -> Tensor:
        """The prediction, in single precision; of ``latents`` nothing but the first frame is read."""
        model, views, spec = self.model, self.views, self.spec
        first, noise = latents[:, :, :, :1], same_noise(latents)

        def velocity(state: Tensor, sigma: float) -> Tensor:
            levels = torch.full((len(state),), sigma, device=state.device)
            return model(state, levels, action_maps=controls, views=views).velocity

        with torch.autocast(latents.device.type, torch.bfloat16):
            if spec is None:
                state = torch.cat((first, noise[:, :, :, 1:]), dim=3)
                return integrate(velocity, state, shifted_sigmas(*self.sampler)).float()
            last = spec.steps - 1
            return self_forced_rollout(
                model, first, controls, noise, last, views=views, spec=spec, with_gradient=False
            ).float()


def drift(memory: Memory, predictor: Predictor) -> list[float]:
    """Latent error of long held-out rollouts over that of copying the first frame, by blocks of four latent frames."""
    if not memory.count("test", short=False):
        return []
    episodes = memory.episodes("test", short=False)
    rows = torch.arange(min(30, len(episodes)))
    latents = episodes.latents[rows][:, predictor.chosen].float()

    def error(predicted: Tensor) -> Tensor:
        return ((predicted - latents) ** 2)[:, :, :, 1:].mean(dim=(0, 1, 2, 4, 5)).unflatten(0, (-1, 4)).mean(dim=1)

    ratios = error(predictor(latents, predictor.controls(episodes.maps[rows], episodes.native[rows]))) / error(
        latents[:, :, :, :1]
    )
    return [round(ratio, 3) for ratio in ratios.tolist()]


@dataclass(frozen=True)
class Shown:
    """A predicted video, and what is known of its recording.

    Attributes:
        pixels: uint8 (v, f, H, W, 3) of ``views``.
        robot, thing: bool (f, H, W) exact masks of the robot and of what the task moves in the head view.
    """

    instruction: str
    views: tuple[str, ...]
    pixels: np.ndarray
    robot: np.ndarray
    thing: np.ndarray


def judged(shown: Shown) -> dict[str, float | None]:
    """Scores of the measured judge by all views and by the head view alone, and the IoU of what the task moves.

    The IoU is `evaluate_video`'s ``object_iou_exact``: over the frames in which the thing has moved, None without any.
    """
    chosen = list(planning_indices(SHORT))
    videos = {view: pixels[chosen] for view, pixels in zip(shown.views, shown.pixels, strict=True)}
    scores: dict[str, float | None] = {}
    for name, views in (("area", shown.views), ("area_head", ("head",))):
        frames = {view: videos[view] for view in views}
        measured = measure(KnownMasks(shown.robot[chosen]), shown.instruction, route(shown.instruction), frames, None)
        scores[name] = UNSEEN_SCORE if measured is None else measured.score()
    head, colour = shown.pixels[shown.views.index("head")], named_things(shown.instruction)[0].colour
    found = thing_share(head, colour, own_colour(head, colour)) > 0.5
    stays = frame_iou(shown.thing, shown.thing[:1].repeat(SHORT, 0))
    moved = (stays < MOVED_IOU) & shown.thing.any(axis=(1, 2))
    return scores | {"object_iou": float(frame_iou(shown.thing, found)[moved].mean()) if moved.any() else None}


@dataclass(frozen=True)
class Measuring:
    """Measures predictions of held-out recordings; the judge runs in processes of its own."""

    memory: Memory
    judges: Pool
    segmenter: LearnedSegmenter

    def measure(self, predictor: Predictor, split: str, limit: int, picture: Path | None = None) -> Facts:
        """What `Facts` of a split's first recordings say: errors, IoU of robot and moved thing, area by task.

        ``error_head``, ``error_moved``: squared latent errors in the head view and where the moved thing is or was at the
        start; ``copy...``: those of the copied first frame. ``robot_iou``, ``object_iou``: as `evaluate_video`'s exact ones.
        ``area``: of the measured judge's score, successes over failures within each task, and their mean (``area_head``:
        by the head view alone). ``sharpness``: mean step from pixel to pixel where the recording moves, over the
        recording's.

        Args:
            limit: recordings to stop after.
            picture: file for some predictions under the recordings they should be.
        """
        values: dict[str, list[float]] = defaultdict(list)
        videos_shown: list[Shown] = []
        outcomes: list[tuple[str, bool] | None] = []
        strips: list[np.ndarray] = []
        count = 0
        for file in self.memory.held:
            if file.split != split or file.masks is None or count >= limit:
                continue
            count += len(file.facts)
            errors, pixels = self._predicted(predictor, file)
            for name, found in errors.items():
                values[name] += found
            strips += [
                video[v, ::4]
                for pair in zip(file.frames[:2], pixels[:2], strict=True)
                for v in range(len(pixels[0]))
                for video in pair
            ]
            for i, fact in enumerate(file.facts):
                robot, thing = file.masks[i, 0].astype(bool)
                masks = self.segmenter.segment(pixels[i, 0], None)
                values["robot_iou"].append(float(np.nanmean(frame_iou(robot, masks))))
                videos_shown.append(Shown(fact.instruction, predictor.views, pixels[i], robot, thing))
                known = fact.outcome != "unknown"
                outcomes.append((task_of(fact.instruction), fact.outcome == "success") if known else None)
        if picture is not None and strips:
            rows = [np.concatenate(list(strip), axis=1) for strip in strips[:40]]
            cv2.imwrite(str(picture), np.concatenate(rows)[..., ::-1])
        judgements = self.judges.map(judged, videos_shown, chunksize=8)
        values["object_iou"] = [found for one in judgements if (found := one["object_iou"]) is not None]
        result: Facts = {name: round(float(np.mean(found)), 4) for name, found in values.items() if found}
        for name in ("area", "area_head"):
            areas = {}
            for task in sorted({known[0] for known in outcomes if known is not None}):
                pairs = [
                    (one[name], k[1])
                    for one, k in zip(judgements, outcomes, strict=True)
                    if k is not None and k[0] == task
                ]
                scores, success = np.array(pairs, dtype=float).T
                # A task of which all recordings end alike has no area.
                if 0 < success.sum() < len(success):
                    areas[task] = round(area(scores, success.astype(bool)), 3)
            result |= {
                f"{name}_by_task": areas,
                name: round(float(np.mean(list(areas.values()))), 4) if areas else None,
            }
        return result | {"episodes": count}

    @torch.no_grad()
    def _predicted(self, predictor: Predictor, file: Recorded) -> tuple[dict[str, list[float]], np.ndarray]:
        """By name a value of each of a file's predictions, and these as uint8 (n, v, f, H, W, 3)."""
        device, chosen = self.memory.device, predictor.chosen
        video = videos(file.frames, device)
        latents = self.memory.encode(video)[:, chosen]
        video = video[:, chosen]
        maps, native = (torch.from_numpy(array).to(device) for array in (file.maps, file.native))
        predicted = predictor(latents, predictor.controls(maps, native))
        moved = torch.from_numpy(file.things[:, chosen, 0]).to(device).float()
        inside = (torch.maximum(moved, moved[:, :, :1]) > 0.1)[:, :, 1:]
        found: dict[str, Tensor] = {}
        for name, guess in (("error", predicted), ("copy", latents[:, :, :, :1])):
            error = ((guess - latents) ** 2).mean(dim=2)[:, :, 1:]
            found |= {name: error.mean(dim=(1, 2, 3, 4)), f"{name}_head": error[:, 0].mean(dim=(1, 2, 3))}
            covered = inside.flatten(1).sum(dim=1)
            of_things = (error * inside).flatten(1).sum(dim=1)
            found[f"{name}_moved"] = (of_things / covered)[covered > 0]
        with torch.autocast(device, torch.bfloat16):
            decoded = self.memory.tokenizer.decode(predicted.flatten(0, 1), video[:, :, :, 0].flatten(0, 1))
        decoded = decoded.float().clamp(-1, 1)
        changed = ((video - video[:, :, :, :1]).abs().amax(dim=2) > 0.1).flatten(0, 1)
        energy = [
            (gradient_energy(pictures) * changed).unflatten(0, video.shape[:2]).sum(dim=(1, 2, 3, 4))
            for pictures in (decoded, video.flatten(0, 1))
        ]
        found["sharpness"] = (energy[0] / energy[1])[energy[1] > 0]
        pixels = ((decoded + 1) * 127.5).round().to(torch.uint8)
        pixels = rearrange(pixels, "(n v) c f h w -> n v f h w c", v=len(chosen)).cpu().numpy()
        return {name: value.tolist() for name, value in found.items()}, pixels


def gradient_energy(video: Tensor) -> Tensor:
    """Mean absolute step to the pixel below and to the right (b f h w) of videos (b c f h w)."""
    padded = torch.nn.functional.pad(video, (0, 1, 0, 1, 0, 0), mode="replicate")
    down = (padded[..., 1:, :-1] - padded[..., :-1, :-1]).abs()
    right = (padded[..., :-1, 1:] - padded[..., :-1, :-1]).abs()
    return (down + right).mean(dim=1)


def judge_processes() -> Pool:
    """Processes for the judge, which takes a core for longer than a model takes the device."""
    return multiprocessing.get_context("spawn").Pool(min(8, os.cpu_count() or 1))
