"""Frames straight from an EpisodeSet: clips that are decoded and encoded when they are needed, and whole recordings.

Stage I and II train on clips (`FrameSource`); the small tokenizer and the small teacher on recordings held in memory.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float, UInt8
from torch import Tensor

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.video.frame_decoder import FrameDecoder, open_decoder
from worldline_core.data.video.frames import VideoFrames
from worldline_core.errors import ArtifactError, ConfigError, DataError
from worldline_core.model.tokenizers import load_tokenizer, tokenizer_fingerprint
from worldline_core.model.video_tokenizer import VideoTokenizer, resize_frame, resized_video
from worldline_core.progress import with_progress
from worldline_core.training.clip_config import FrameInput
from worldline_core.training.clip_source import Clip, ClipRow, ClipSource

logger = logging.getLogger(__name__)


class FrameSource(ClipSource):
    """Frames of an EpisodeSet as a source of clips.

    Args:
        tokenizer: encodes; None where frames alone are wanted (loader processes, benchmarks).
        latent_shape: (c, h, w) of one view's latent frame.
    """

    dtype: np.dtype[Any] = np.dtype(np.uint8)

    def __init__(
        self,
        episodes: EpisodeSet,
        rows: Sequence[ClipRow],
        config: FrameInput,
        *,
        tokenizer: VideoTokenizer | None,
        latent_shape: tuple[int, int, int],
        description: Mapping[str, Any],
    ) -> None:
        super().__init__(rows)
        self.root = episodes.root
        self.episodes = episodes
        self.config = config
        self.image_size = config.image_size
        self.start_step = config.start_step
        self.latent_shape = latent_shape
        self.description = dict(description)
        self._tokenizer = tokenizer
        self._decoder: FrameDecoder | None = None

    @classmethod
    def open(
        cls,
        episodes: EpisodeSet,
        tokenizer_folder: Path,
        config: FrameInput,
        *,
        views: tuple[str, ...],
        primary_alone: bool,
        device: str,
    ) -> FrameSource:
        """A source over the episodes that have all ``views`` (and perhaps others), or (``primary_alone``) their
        task-facing one.

        Raises:
            CheckpointError: the folder holds no tokenizer.
            ConfigError: the tokenizer cannot code images of this size.
            UnavailableError: the decoder that is asked for cannot be loaded.
        """
        tokenizer = load_tokenizer(tokenizer_folder, device)
        space = tokenizer.spatial_compression
        height, width = config.image_size
        if height % space or width % space:
            raise ConfigError(
                "The tokenizer cannot code images of this size.",
                where="input.image_size",
                expected=f"multiples of {space}",
                got=f"{height}x{width}",
            )
        source = cls(
            episodes,
            frame_rows(episodes, views, primary_alone=primary_alone),
            config,
            tokenizer=tokenizer,
            latent_shape=(tokenizer.latent_channels, height // space, width // space),
            description={"tokenizer": tokenizer_fingerprint(tokenizer, tokenizer_folder), "views": list(views)},
        )
        source.description["decoder"] = source.decoder.name
        return source

    def __getstate__(self) -> dict[str, Any]:
        # Loader processes read frames: they open files themselves and have no use for the tokenizer.
        episodes = EpisodeSet(self.episodes.root, self.episodes.rows)
        return {**self.__dict__, "episodes": episodes, "_tokenizer": None, "_decoder": None}

    @property
    def decoder(self) -> FrameDecoder:
        """This process's decoder."""
        if self._decoder is None:
            self._decoder = open_decoder(self.config.decoder, open_files=self.config.open_files)
        return self._decoder

    def shape(self, num_frames: int) -> tuple[int, ...]:
        """(n, H, W, 3) of one view of a clip."""
        return num_frames, *self.image_size, 3

    def read(self, clip: Clip, views: tuple[str, ...], out: np.ndarray) -> None:
        """Fill ``out`` (v, n, H, W, 3), uint8 RGB, with the clip's frames at the training size.

        Raises:
            DataError: a frame cannot be read; the message names the clip, the view and the file.
            ArtifactError: the episode is not in the set.
        """
        position = self.episodes.position(self.row(clip.episode_id).episode_id)
        for pictures, view in zip(out, views, strict=True):
            where: object = f"{clip}, view {view}"
            try:
                video = self.episodes.clip(position, view)
                where = f"{clip}, view {view}, in {video.path}"
                for target, picture in zip(pictures, self.decoder.frames(video, clip.frames), strict=True):
                    resize_frame(picture, self.image_size, out=target)
            except DataError as error:
                raise DataError(
                    f"A clip cannot be read: {error.what}",
                    where=where,
                    expected=error.expected,
                    got=error.got,
                    next_step="repair or drop the episode, or set input.on_unreadable to skip",
                ) from error

    @torch.no_grad()
    def latents(self, read: UInt8[Tensor, "b v n h w 3"], device: str) -> Float[Tensor, "b v c t h_l w_l"]:
        """Latents of frames, rounded to half precision as cached ones are.

        Clips and views are encoded one by one, as encode_latents does: another batch size might round differently.

        Raises:
            ArtifactError: this source has no tokenizer.
        """
        if self._tokenizer is None:
            raise ArtifactError("A source without a tokenizer has no latents.", where=self.root)
        encoded: list[Tensor] = []
        for frames in rearrange(read, "b v n h w c -> (b v) n h w c"):
            video = rearrange(frames.to(device, non_blocking=True), "n h w c -> 1 c n h w").contiguous()
            encoded.append(self._tokenizer.encode(video.float() / 127.5 - 1.0)[0].to(torch.float16))
        return rearrange(torch.stack(encoded).float(), "(b v) c t h w -> b v c t h w", b=read.shape[0])

    def close(self) -> None:
        """Close the open video files."""
        if self._decoder is not None:
            self._decoder.close()


def frame_rows(episodes: EpisodeSet, views: Sequence[str], *, primary_alone: bool) -> list[ClipRow]:
    """Rows of the episodes that have all ``views`` (and perhaps others), or (``primary_alone``) their task-facing one.

    Raises:
        DataError: there is none.
    """
    rows = [
        ClipRow.of(row, row.views)
        for row in episodes.rows
        if set((row.primary_view,) if primary_alone else views) <= set(row.views)
    ]
    if not rows:
        raise DataError(
            "No episode has the views that are trained on.",
            where=episodes.root,
            expected="the task-facing view" if primary_alone else ", ".join(views),
            got=f"{len(episodes)} episodes without",
        )
    if len(rows) < len(episodes):
        logger.info("%d of %d episodes lack a view that is trained on.", len(episodes) - len(rows), len(episodes))
    return rows


@dataclass(frozen=True)
class LoadedView:
    """One view of one episode at the training size; ``name`` is episode/view."""

    name: str
    frames: UInt8[Tensor, "3 n h w"]


def load_views(
    episodes: EpisodeSet, positions: Sequence[int], image_size: tuple[int, int], minimum: int
) -> list[LoadedView]:
    """All views of the episodes at ``positions`` that have ``minimum`` frames or more, in memory.

    Raises:
        DataError: there is none.
    """
    views: list[LoadedView] = []
    for position in with_progress(positions, "reading episodes", "episode"):
        row = episodes.rows[position]
        for view in row.views:
            frames = VideoFrames(episodes.clip(position, view))
            if len(frames) >= minimum:
                views.append(LoadedView(f"{row.episode_id}/{view}", resized_video(frames, image_size)))
    if not views:
        raise DataError("No episode is long enough to train on", where=episodes.root, expected=f">= {minimum} frames")
    return views
