"""Action following while a model trains: a second of held-out clips is predicted under its own controls, under another clip's, and by
copying the first picture; then each tool is looked for in the predicted picture (`actions/tool_error.py`).

Where no camera is known, the part of the recorded picture that has changed most stands for the tool.
"""

from __future__ import annotations

import logging
import math
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from worldline_core.actions.tool_error import PATCH_FRACTION, background_of, end_effector_error, moving_part
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import CheckpointError, ConfigError, TrainingError
from worldline_core.model.tokenizers import (
    VideoTokenizer,
    load_tokenizer,
    resized_frames,
    tokenizer_fingerprint,
    video_to_frames,
)
from worldline_core.training.clip_loader import Batch, ClipLoader
from worldline_core.training.clip_sampler import Clip, ClipBatch, ClipRow
from worldline_core.training.trainer import autocast, step_generator
from worldline_core.training.training_config import ActionFollowingConfig, TrainerConfig

logger = logging.getLogger(__name__)

SEED = 30_000
LEAST_MOTION = 0.05
"""Way of a tool in that second, of the frame's height, from which a clip can tell predictions apart."""
LEAST_CLIPS = 4
FIRST_SECONDS = 3.0
"""Assumed cost of the first measurement."""
STARTS = 4
"""Clips of an episode that are looked at; more where few episodes are held out."""


class MeasuredObjective(Protocol):
    """An objective that can be measured on held-out clips: by its losses, and by what it predicts from their first frames."""

    def validation_losses(self, batch: Batch, generator: torch.Generator) -> dict[str, float]: ...

    def predict(
        self, batch: Batch, action_maps: Float[Tensor, "b v a t #h #w"], noise: Float[Tensor, "b v c t h w"]
    ) -> Float[Tensor, "b v c t h w"]: ...


@dataclass(frozen=True)
class Place:
    """A clip, and where its tools are after a second: (arms, 2) u, v [px of the model's picture], NaN where they do not move;
    for a static camera also the recording's background (h, w, 3)."""

    clip: Clip
    points: np.ndarray
    background: np.ndarray | None = None


class ActionFollowing:
    """Measures a model that trains, and spends no more than a share of the run's time.

    Raises:
        ConfigError: the tokenizer is not given.
        CheckpointError: it is not the one whose latents are trained on.
    """

    def __init__(
        self,
        config: ActionFollowingConfig,
        objective: MeasuredObjective,
        loader: ClipLoader,
        rows: Sequence[ClipRow],
        episodes: EpisodeSet,
        tokenizer: Path | None,
        *,
        view_sets: Sequence[tuple[str, ...]],
        frames_per_unit: int,
        trainer: TrainerConfig,
    ) -> None:
        """
        Args:
            rows: the held-out episodes.
            view_sets: views that are trained together.
            frames_per_unit: clips have 1 + k times so many frames.
        """
        self.config, self.objective, self.loader, self.episodes = config, objective, loader, episodes
        self.trainer = trainer
        self.tokenizer = _open_tokenizer(tokenizer, loader)
        self.spent, self.longest = 0.0, FIRST_SECONDS
        self.batches: list[tuple[ClipBatch, list[Place]]] = []
        self.frame = 0
        kinds = {row.episode_id: (_shared(row, view_sets), loader.frame_rates[row.episode_id]) for row in rows}
        if kinds:
            (views, fps), _ = Counter(kinds.values()).most_common(1)[0]
            alike = [row for row in rows if kinds[row.episode_id] == (views, fps)]
            self.frame = max(1, round(config.seconds * fps))
            frames = 1 + math.ceil(self.frame / frames_per_unit) * frames_per_unit
            # Neighbours exchange their controls: those of one robot, where there are several.
            loader.source.require_length(frames, "action_following.seconds")
            places = sorted(
                self._places(alike, views, frames),
                key=lambda place: loader.source.row(place.clip.episode_id).embodiment,
            )
            size = max(2, trainer.batch_size)
            for first in range(0, len(places) - 1, size):
                part = places[first : first + size]
                if len(part) > 1:  # another clip's controls are needed
                    clips = ClipBatch(tuple(place.clip for place in part), views, primary=False)
                    self.batches.append((clips, part))
        if sum(len(places) for _, places in self.batches) < LEAST_CLIPS:
            logger.warning(
                "Action following is not measured: fewer than %d held-out clips in which a tool moves within %.3g s.",
                LEAST_CLIPS, config.seconds,
            )  # fmt: skip
            self.batches = []

    def _places(self, rows: Sequence[ClipRow], views: tuple[str, ...], frames: int) -> list[Place]:
        """Up to ``clips`` clips in which a tool moves, of as many episodes as possible."""
        step, wanted = self.loader.source.start_step, self.config.clips
        turns = max(STARTS, math.ceil(2 * wanted / max(1, len(rows))))
        by_turn: list[list[Place]] = [[] for _ in range(turns)]
        for number in np.random.default_rng(SEED).permutation(len(rows)) if views else ():
            row = rows[number]
            last = (row.num_frames - frames) // step
            starts = sorted({int(share) for share in np.linspace(0, last, turns)}) if last >= 0 else []
            clips = [Clip(row.episode_id, start * step, frames, 1) for start in starts]
            places = self._moved(clips, views[0])
            moved = [place for place in places if np.isfinite(place.points).any()]
            for turn, place in zip(by_turn, moved, strict=False):
                turn.append(place)
            if len(by_turn[0]) == wanted:
                break
        return [place for turn in by_turn for place in turn][:wanted]

    def _moved(self, clips: Sequence[Clip], view: str) -> list[Place]:
        """Clips of one episode with the places of the tools that move, else of the part of the picture that does."""
        if not clips:
            return []
        episode_id = clips[0].episode_id
        tracks = None if self.loader.tracks is None else self.loader.tracks.tracks(episode_id)
        if tracks is None or not tracks.valid[:, tracks.views.index(view)].any():
            background = self._background(episode_id, view)
            pictures = [self._recorded(clip, view, (0, self.frame)) for clip in clips]
            return [
                Place(clip, moving_part(first, later, background), background)
                for clip, (first, later) in zip(clips, pictures, strict=True)
            ]
        (height, width), column = self.loader.source.image_size, tracks.views.index(view)
        scale = np.array([width / tracks.image_size[1], height / tracks.image_size[0]])
        background = self._background(episode_id, view) if tracks.camera_motion[column] == "static" else None
        found: list[Place] = []
        for clip in clips:
            cut = tracks.clip([clip.start, clip.start + self.frame])
            points = (cut.uv[:, column].astype(np.float64) + 0.5) * scale - 0.5
            points[~cut.valid[:, column].astype(bool)] = np.nan
            still = ~(np.linalg.norm(points[1] - points[0], axis=-1) >= LEAST_MOTION * height)
            outside = ~_inside(points[1], height, width)
            found.append(Place(clip, np.where((still | outside)[:, None], np.nan, points[1]), background))
        return found

    def _background(self, episode_id: str, view: str) -> np.ndarray:
        position, size = self.episodes.position(episode_id), self.loader.source.image_size
        return background_of(
            self.episodes.rows[position].video_frames,
            lambda frames: resized_frames(self.episodes.frames(position, view, frames), size),
        )

    def _recorded(self, clip: Clip, view: str, frames: Sequence[int]) -> np.ndarray:
        indices = [clip.start + frame for frame in frames]
        found = self.episodes.frames(self.episodes.position(clip.episode_id), view, indices)
        return resized_frames(found, self.loader.source.image_size)

    def due(self, seconds: float) -> bool:
        """True when another measurement stays within the share of ``seconds``, the run's time so far."""
        return bool(self.batches) and self.spent + self.longest <= self.config.share * seconds

    def measure(self, step: int) -> dict[str, float]:
        """Errors after ``step`` steps, in pixels of the model's picture; no value where no clip can be measured.

        - ``tool_error_px``, ``_shuffled``, ``_copy``: mean distance of the tools from where the controls put them;
        - ``shuffled_gap_px``, ``shuffled_gap_low_px``: by how much they are farther off under another clip's controls, and the lower
          bound of its 95 % interval over the clips; ``copy_gap_px``, ``copy_gap_low_px``: the same of copying;
        - ``hand_psnr``, ``frame_psnr``: around the tools, and of the whole picture [dB].

        Raises: TrainingError: ``stop_when_ignored`` steps are done and the controls make no difference.
        """
        if not self.batches:
            return {}
        began = time.monotonic()
        errors: dict[str, list[float]] = {"": [], "_shuffled": [], "_copy": []}
        squared: dict[str, list[float]] = {"hand": [], "frame": []}
        for number, (clips, places) in enumerate(self.batches):
            batch = self.loader.load(clips)
            maps = batch.action_maps
            if maps is None:
                raise ConfigError("Action following needs controls", where="action_following")
            generator = step_generator(SEED, number, str(batch.latents.device))
            noise = torch.randn(batch.latents.shape, generator=generator, device=batch.latents.device)
            own, shuffled = (self._pictures(batch, controls, noise) for controls in (maps, maps.roll(1, dims=0)))
            for place, of_own, of_other in zip(places, own, shuffled, strict=True):
                first, true = self._recorded(place.clip, clips.views[0], (0, self.frame))
                compared = {"": of_own, "_shuffled": of_other, "_copy": first}
                found = {name: _error(true, picture, place) for name, picture in compared.items()}
                if any(value is None for value in found.values()):
                    continue
                for name, value in found.items():
                    errors[name].append(value or 0.0)
                difference = (of_own.astype(np.float64) - true) ** 2
                squared["frame"].append(float(difference.mean()))
                squared["hand"].append(_around(difference, place.points))
        took = time.monotonic() - began
        self.longest = max(self.longest, took) if self.spent else took
        self.spent += took
        values = _summary(errors, squared)
        self._require_followed(step, values)
        return values

    @torch.no_grad()
    def _pictures(self, batch: Batch, maps: Tensor, noise: Tensor) -> list[np.ndarray]:
        """The first view's picture of each clip after a second."""
        with autocast(self.trainer):
            latents = self.objective.predict(batch, maps, noise)[:, 0].float()
        firsts = [self._recorded(clip, batch.views[0], (0,)) for clip in batch.clips]
        reference = torch.from_numpy(np.concatenate(firsts)).permute(0, 3, 1, 2).to(latents.device) / 127.5 - 1.0
        video = self.tokenizer.decode(latents, reference)
        return [video_to_frames(clip[:, self.frame : self.frame + 1])[0] for clip in video]

    def _require_followed(self, step: int, values: Mapping[str, float]) -> None:
        limit = self.config.stop_when_ignored
        if limit is None or step < limit or not values or values["shuffled_gap_low_px"] > 0:
            return
        raise TrainingError(
            "The model does not follow its controls",
            where=f"step {step}, action_following.stop_when_ignored {limit}",
            expected="tools nearer to their true places under the true controls than under another clip's",
            got=f"{values['tool_error_px']:.2f} px and {values['tool_error_px_shuffled']:.2f} px (copying: "
            f"{values['tool_error_px_copy']:.2f} px)",
            next_step="look at the overlays of render_actions for controls beside the arm: wrong units or camera, views exchanged; run "
            "calibrate check for a lag between states and pictures; or give the model more steps",
        )


def _open_tokenizer(folder: Path | None, loader: ClipLoader) -> VideoTokenizer:
    if folder is None:
        raise ConfigError(
            "Action following looks at pictures, which only a tokenizer decodes", where="action_following",
            expected="the input tokenizer", got="none", next_step="give it, or set action_following to null",
        )  # fmt: skip
    tokenizer = load_tokenizer(folder, loader.device)
    found, trained = tokenizer_fingerprint(tokenizer, folder), loader.source.description["tokenizer"]
    if found != trained:
        raise CheckpointError("The latents are of another tokenizer", where=folder, expected=trained, got=found)
    return tokenizer


def _shared(row: ClipRow, view_sets: Sequence[tuple[str, ...]]) -> tuple[str, ...]:
    """The largest set of trained views that an episode has."""
    return max((views for views in view_sets if set(views) <= set(row.views)), key=len, default=())


def _inside(points: np.ndarray, height: int, width: int) -> np.ndarray:
    """(arms,) whether the patch around a point is within the picture; false for NaN."""
    half = max(2, round(PATCH_FRACTION * height))
    u, v = points[..., 0], points[..., 1]
    return (u >= half) & (u <= width - half - 1) & (v >= half) & (v <= height - half - 1)


def _error(true: np.ndarray, predicted: np.ndarray, place: Place) -> float | None:
    errors = end_effector_error(true[None], predicted[None], place.points[None], place.background)
    return float(np.nanmean(errors)) if np.isfinite(errors).any() else None


def _around(difference: np.ndarray, points: np.ndarray) -> float:
    """Mean squared error of the patches around the tools."""
    half = max(2, round(PATCH_FRACTION * len(difference)))
    centres = np.rint(points[np.isfinite(points).all(-1)]).astype(int)
    patches = [difference[v - half : v + half + 1, u - half : u + half + 1] for u, v in centres]
    return float(np.mean([patch.mean() for patch in patches]))


def _summary(errors: Mapping[str, Sequence[float]], squared: Mapping[str, Sequence[float]]) -> dict[str, float]:
    if len(errors[""]) < LEAST_CLIPS:
        return {}
    values = {f"tool_error_px{name}": float(np.mean(found)) for name, found in errors.items()}
    for name in ("shuffled", "copy"):
        gap = np.subtract(errors[f"_{name}"], errors[""])
        margin = 1.96 * float(gap.std(ddof=1)) / math.sqrt(len(gap))
        values |= {f"{name}_gap_px": float(gap.mean()), f"{name}_gap_low_px": float(gap.mean()) - margin}
    psnr = {
        f"{name}_psnr": 10 * math.log10(255**2 / max(float(np.mean(found)), 1 / 12)) for name, found in squared.items()
    }
    return values | psnr | {"clips": float(len(errors[""]))}
