"""The paper's baseline without actions: a Stage I model, or the pretrained backbone, given a first image and the task's text.

Each view is a video of its own, in the slot that Stage I trains; no controls reach the model. What such a model predicts of a
trajectory is what the text and the picture make likely.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from worldline_core.actions.episode_tracks import EpisodeTracks
from worldline_core.config import validate
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import CheckpointError, ConfigError
from worldline_core.model.checkpoint import load_checkpoint
from worldline_core.model.small_decoder import SmallDecoder
from worldline_core.model.text import ClipFacts, load_text_encoder
from worldline_core.model.tokenizers import load_tokenizer, tokenizer_fingerprint
from worldline_core.model.video_tokenizer import video_to_frames
from worldline_core.model.world_model_config import TextConfig
from worldline_core.rollout.rollout_config import RolloutConfig
from worldline_core.rollout.samplers import FULL_STEPS, Noise, rollout_full_clip
from worldline_core.rollout.session import Frames, encode_images


class TextToVideo:
    """Predicts each view from its first image and the episode's instruction, the whole clip at once.

    Args:
        text: how instructions become ids; by default as the checkpoint says that it was trained.

    Raises:
        CheckpointError: the checkpoint is no base or Stage I model with both towers, or of another tokenizer.
        ConfigError: neither the checkpoint nor the configuration says how text is read, or the recordings' pictures do not
            divide into patches.
    """

    causal = None
    needs_cameras = False
    block_seconds = ()

    def __init__(self, config: RolloutConfig, checkpoint: Path, tokenizer: Path, episodes: EpisodeSet) -> None:
        model, self.info = load_checkpoint(
            checkpoint, expect_kind=("base", "stage1"), towers="both", dtype=getattr(torch, config.weights)
        )
        self.model = model.to(config.device).eval().requires_grad_(False)
        self.tokenizer = load_tokenizer(tokenizer, config.device, getattr(torch, config.weights))
        found, trained = tokenizer_fingerprint(self.tokenizer, tokenizer), self.info.metadata.get("tokenizer")
        if trained not in (None, found):
            raise CheckpointError(
                "The model was trained on another tokenizer's latents", where=tokenizer, expected=trained, got=found
            )
        if config.decoder is not None:
            self.tokenizer = SmallDecoder.load(config.decoder, self.tokenizer, found, config.device)
        stated = self.info.metadata.get("text")
        if config.text is None and stated is None:
            raise ConfigError(
                "Nothing says how this model reads text",
                where=f"{checkpoint}, rollout.text",
                expected="kind cosmos3 and the path of the backbone's text tokenizer, or kind bytes",
                next_step="set text in the rollout's config",
            )
        text = config.text or validate(TextConfig, stated or {}, where=f"{checkpoint}, metadata.text")
        self.text = load_text_encoder(text, self.info.config.vocab_size)
        self.views = tuple(self.info.config.views)
        self.steps = config.steps or FULL_STEPS
        self.frames_per_unit = self.tokenizer.temporal_compression
        height, width = episodes.frames(0, episodes.rows[0].views[0], [0]).shape[1:3]
        self.image_size = (height, width)
        cell = self.tokenizer.spatial_compression * self.info.config.patch_size
        if height % cell or width % cell:
            raise ConfigError(
                "The recordings' pictures do not divide into the model's patches",
                where=episodes.root,
                expected=f"multiples of {cell} pixels",
                got=self.image_size,
                next_step="curate them at such a size (curate.image_size)",
            )
        self._config, self._episodes = config, episodes

    def unit(self, frames: int) -> int:
        """A prediction is as long as its frames, in whole latent frames."""
        return self.frames_per_unit

    @torch.no_grad()
    def stream(
        self,
        images: Float[Tensor, "b v 3 h w"],
        tracks: Sequence[EpisodeTracks],
        frames: int,
        seeds: Sequence[int],
        *,
        views: Sequence[str],
        stride: int,
        without_actions: bool = False,
    ) -> Iterator[Frames]:
        """As :meth:`WorldLine.stream`, in one piece; the tracks only say which episodes they are."""
        del without_actions
        config, device = self._config, self._config.device
        rows = [self._episodes.rows[self._episodes.position(track.episode_id)] for track in tracks]
        latent_frames = 1 + -(-(frames - 1) // self.frames_per_unit)
        length, fps = 1 + (latent_frames - 1) * self.frames_per_unit, rows[0].fps / stride
        ids, mask = self.text([row.instruction for row in rows], [ClipFacts(length, fps, self.image_size)] * len(rows))
        with torch.autocast(device.split(":")[0], torch.bfloat16, enabled=config.bfloat16):
            text = self.model.encode_text(ids.to(device), mask.to(device))
        first = encode_images(self.tokenizer, images.to(device))
        clips: Frames = [{} for _ in rows]
        for number, view in enumerate(views):
            latents = rollout_full_clip(
                self.model, first[:, number : number + 1], None, noise=Noise(seeds), steps=self.steps,
                shift=config.shift, frames=latent_frames, views=self.views[:1], text=text, fps=fps,
                bfloat16=config.bfloat16,
            )  # fmt: skip
            with torch.autocast(device.split(":")[0], torch.bfloat16, enabled=config.bfloat16):
                for clip, one, observed in zip(clips, latents, images.to(device), strict=True):
                    video = self.tokenizer.decode(one, rearrange(observed[number], "c h w -> 1 c h w"))
                    clip[view] = video_to_frames(video[0])[:frames]
        yield clips
