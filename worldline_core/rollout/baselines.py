"""Predictors without controls: a Stage I model (or the pretrained backbone) driven by text, and the copy of the first frame.

Text to video is the paper's baseline without actions. Each view is a video of its own, in the slot that Stage I trains.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.config import validate
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import CheckpointError, ConfigError
from worldline_core.model.checkpoint import load_checkpoint
from worldline_core.model.small_decoder import SmallDecoder
from worldline_core.model.text import ClipFacts, load_text_encoder
from worldline_core.model.tokenizers import load_tokenizer, tokenizer_fingerprint, video_to_frames
from worldline_core.model.world_model_config import TextConfig
from worldline_core.rollout.predictions import Prediction
from worldline_core.rollout.rollout_config import RolloutConfig, TextToVideoConfig
from worldline_core.rollout.samplers import Noise, rollout_full_clip
from worldline_core.rollout.simulation import Frames, encode_images

_COPIED_AT_ONCE = 64


def recorded_size(episodes: EpisodeSet) -> tuple[int, int]:
    """(H, W) of the recordings' pictures."""
    height, width = episodes.frames(0, episodes.rows[0].views[0], [0]).shape[1:3]
    return height, width


class FirstFrameCopy:
    """Every predicted frame is the observed one, at the size of the recordings."""

    steps = None
    views: tuple[str, ...] = VIEWS
    view_sets = None
    frames_per_unit = TEMPORAL_FACTOR
    takes_maps = False
    vector_robots: tuple[str, ...] | None = None

    def __init__(self, episodes: EpisodeSet) -> None:
        self.image_size = recorded_size(episodes)

    def unit(self, frames: int) -> int:
        """Frames are copied one by one."""
        return 1

    def stream(self, images: Float[Tensor, "b v 3 h w"], batch: Sequence[Prediction]) -> Iterator[Frames]:
        """Copies of the images, piece by piece."""
        views, frames = batch[0].views, max(item.frames for item in batch)
        clips = [{view: video_to_frames(first[v, :, None]) for v, view in enumerate(views)} for first in images]
        for begin in range(0, frames, _COPIED_AT_ONCE):
            count = min(_COPIED_AT_ONCE, frames - begin)
            yield [{view: np.repeat(still, count, axis=0) for view, still in clip.items()} for clip in clips]


class TextToVideo:
    """Predicts each view from its first image and the episode's instruction, the whole clip at once.

    Raises:
        CheckpointError: the checkpoint is no base or Stage I model with both towers, or of another tokenizer.
        ConfigError: nothing states how text is read, or the recordings' pictures do not divide into patches.
    """

    takes_maps = False
    vector_robots: tuple[str, ...] | None = None
    view_sets = None

    def __init__(
        self,
        config: RolloutConfig,
        sampler: TextToVideoConfig,
        checkpoint: Path,
        tokenizer: Path,
        episodes: EpisodeSet,
    ) -> None:
        dtype = getattr(torch, config.weights)
        model, self.info = load_checkpoint(checkpoint, expect_kind=("base", "stage1"), towers="both", dtype=dtype)
        self.model = model.to(config.device).eval().requires_grad_(False)
        self.tokenizer = load_tokenizer(tokenizer, config.device, dtype)
        found, trained = tokenizer_fingerprint(self.tokenizer, tokenizer), self.info.metadata.get("tokenizer")
        if trained not in (None, found):
            raise CheckpointError(
                "The model was trained on another tokenizer's latents", where=tokenizer, expected=trained, got=found
            )
        if sampler.decoder is not None:
            self.tokenizer = SmallDecoder.load(sampler.decoder, self.tokenizer, found, config.device)
        stated = self.info.metadata.get("text")
        if sampler.text is None and stated is None:
            raise ConfigError(
                "Nothing says how this model reads text",
                where=f"{checkpoint}, rollout.sampler.text",
                expected="kind cosmos3 and the path of the backbone's text tokenizer, or kind bytes",
                next_step="set text in the rollout's sampler",
            )
        text = sampler.text or validate(TextConfig, stated or {}, where=f"{checkpoint}, metadata.text")
        self.text = load_text_encoder(text, self.info.config)
        self.views = tuple(self.info.config.views)
        self.steps = sampler.steps
        self.frames_per_unit = self.tokenizer.temporal_compression
        self.image_size = recorded_size(episodes)
        cell = self.tokenizer.spatial_compression * self.info.config.patch_size
        if any(side % cell for side in self.image_size):
            raise ConfigError(
                "The recordings' pictures do not divide into the model's patches",
                where=episodes.root,
                expected=f"multiples of {cell} pixels",
                got=self.image_size,
                next_step="curate them at such a size (curate.image_size)",
            )
        self._config, self._sampler, self._episodes = config, sampler, episodes

    def unit(self, frames: int) -> int:
        """A prediction is as long as its frames, in whole latent frames."""
        return self.frames_per_unit

    @torch.no_grad()
    def stream(self, images: Float[Tensor, "b v 3 h w"], batch: Sequence[Prediction]) -> Iterator[Frames]:
        """Videos of a batch, in one piece."""
        config, device, frames = self._config, self._config.device, max(item.frames for item in batch)
        rows = [self._episodes.rows[item.position] for item in batch]
        latent_frames = 1 + -(-(frames - 1) // self.frames_per_unit)
        length, fps = 1 + (latent_frames - 1) * self.frames_per_unit, rows[0].fps / config.stride
        ids, mask = self.text([row.instruction for row in rows], [ClipFacts(length, fps, self.image_size)] * len(rows))
        images = images.to(device)
        with torch.autocast(device.split(":")[0], torch.bfloat16, enabled=config.bfloat16):
            text = self.model.encode_text(ids.to(device), mask.to(device))
        first = encode_images(self.tokenizer, images)
        clips: Frames = [{} for _ in rows]
        for number, view in enumerate(batch[0].views):
            latents = rollout_full_clip(
                self.model, first[:, number : number + 1], None, noise=Noise([item.seed for item in batch]),
                steps=self.steps, shift=self._sampler.shift, frames=latent_frames, views=self.views[:1], text=text, fps=fps,
                bfloat16=config.bfloat16,
            )  # fmt: skip
            with torch.autocast(device.split(":")[0], torch.bfloat16, enabled=config.bfloat16):
                for clip, one, observed in zip(clips, latents, images, strict=True):
                    video = self.tokenizer.decode(one, rearrange(observed[number], "c h w -> 1 c h w"))
                    clip[view] = video_to_frames(video[0])[:frames]
        yield clips
