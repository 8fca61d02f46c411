"""From clip names to tensors: latents (cached, or encoded from frames), action maps rendered from tracks, text ids."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from worldline_core.actions.action_maps import latent_frame_indices, render_action_maps
from worldline_core.actions.episode_tracks import EpisodeTracks, collate_tracks
from worldline_core.actions.track_store import ActionTracks
from worldline_core.errors import ArtifactError
from worldline_core.model.text import ClipFacts, TextEncoder
from worldline_core.training.clip_reader import ReadBatch, batch_views, read_clips
from worldline_core.training.clip_sampler import Clip, ClipBatch
from worldline_core.training.clip_source import ClipSource

WristProjection = Literal["current_camera", "clip_start_camera"]


@dataclass(frozen=True)
class Batch:
    """One micro-batch. Outcome labels are not here on purpose: they never reach the model.

    ``frames``: where clips are read as frames, those that the latents are of, valid until the next batch is read.
    """

    clips: tuple[Clip, ...]
    views: tuple[str, ...]
    latents: Float[Tensor, "b v c t h w"]
    action_maps: Float[Tensor, "b v 9 t h w"] | None = None
    text_ids: Int[Tensor, "b n"] | None = None
    text_mask: Bool[Tensor, "b n"] | None = None
    frames: UInt8[Tensor, "b v n h w 3"] | None = None


class ClipLoader:
    """Loads batches of clips.

    Args:
        store: where clips are read from.
        text: turns instructions into ids; its prompts may name a clip's duration and size.
        frame_rates: frames a second of the recordings, by episode; needed with ``text``.
    """

    def __init__(
        self,
        store: ClipSource,
        *,
        views: tuple[str, ...],
        tracks: ActionTracks | None = None,
        text: TextEncoder | None = None,
        frame_rates: Mapping[str, float] | None = None,
        sigma_px_ref: float = 10.0,
        wrist_projection: WristProjection = "current_camera",
        device: str = "cpu",
    ) -> None:
        self.store = store
        self.views = views
        self.tracks = tracks
        self.text = text
        self.frame_rates = frame_rates or {}
        self.sigma_px_ref = sigma_px_ref
        self.wrist_projection: WristProjection = wrist_projection
        self.device = device
        self._tracks: dict[str, EpisodeTracks] = {}

    def load(self, batch: ClipBatch) -> Batch:
        """Read, render and move one batch.

        Raises:
            ArtifactError: if the store or the tracks lack an episode.
            DataError: if a clip is damaged, or cached latents are not finite.
        """
        return self.finish(ReadBatch(batch, read_clips(self.store, batch, self.views)))

    def finish(self, read: ReadBatch) -> Batch:
        """What a model sees of clips that were read, here or in a loader process.

        Raises:
            ArtifactError: if the tracks lack an episode.
        """
        batch = read.batch
        views, _ = batch_views(batch, self.store, self.views)
        latents = self.store.latents(read.data, self.device)
        maps = None if self.tracks is None else self.action_maps(batch.clips, views)
        ids = mask = None
        if self.text is not None:
            facts = [self.clip_facts(clip) for clip in batch.clips]
            instructions = [self.store.row(clip.episode_id).instruction for clip in batch.clips]
            ids, mask = self.text(instructions, facts)
            ids, mask = ids.to(self.device), mask.to(self.device)
        frames = read.data if read.data.dtype == torch.uint8 else None
        return Batch(batch.clips, views, latents, maps, ids, mask, frames)

    def clip_facts(self, clip: Clip) -> ClipFacts:
        """What a prompt may say of a clip: a stride shows its frames at a lower rate."""
        rate = self.frame_rates.get(clip.episode_id)
        if rate is None:
            raise ArtifactError("The frame rate of an episode is not known.", where=clip.episode_id)
        return ClipFacts(clip.num_frames, rate / clip.stride, self.store.image_size)

    def action_maps(self, clips: tuple[Clip, ...], views: tuple[str, ...]) -> Float[Tensor, "b v 9 t h w"]:
        """Maps at latent resolution: latent frame j takes the control of video frame 4 j (method.md section 2)."""
        cut = []
        for clip in clips:
            frames = [clip.start + clip.stride * index for index in latent_frame_indices(clip.num_frames)]
            tracks = self._episode_tracks(clip.episode_id)
            cut.append(tracks.clip(frames, wrist_projection=self.wrist_projection, start=clip.start))
        grid = (self.store.latent_shape[1], self.store.latent_shape[2])
        tensors = collate_tracks(cut, views=views).to(self.device)
        return render_action_maps(tensors, cut[0].image_size, grid_size=grid, sigma_px_ref=self.sigma_px_ref)

    def _episode_tracks(self, episode_id: str) -> EpisodeTracks:
        if self.tracks is None:
            raise ArtifactError("Action maps were asked for, but there are no action tracks.", where=episode_id)
        if episode_id not in self._tracks:
            self._tracks[episode_id] = self.tracks.tracks(episode_id)
        return self._tracks[episode_id]
