"""Action tracks of all episodes on the training device, beside resident latents."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate

import numpy as np
import torch
from torch import Tensor

from worldline_core.actions.action_maps import control_frames
from worldline_core.actions.episode_tracks import SAMPLES, ActionTracks, TrackBatch, collate_tracks
from worldline_core.errors import DataError
from worldline_core.training.clip_sampler import Clip


class ResidentTracks:
    """Track samples of many episodes on one device: a batch is one gather there, whatever the number of its clips.

    Raises: DataError: the episodes' frames have several sizes.
    """

    def __init__(
        self,
        tracks: ActionTracks,
        episode_ids: Sequence[str],
        views: tuple[str, ...],
        device: str,
        native_size: int | None,
    ) -> None:
        episodes = [tracks.tracks(episode_id) for episode_id in episode_ids]
        sizes = {episode.image_size for episode in episodes if episode.calibrated_views}
        if len(sizes) > 1:
            raise DataError("Resident action tracks have frames of one size", where=tracks.root, got=sorted(sizes))
        self.image_size = sizes.pop() if sizes else (1, 1)
        self._first = dict(zip(episode_ids, accumulate((one.num_frames for one in episodes), initial=0), strict=False))
        samples = [vars(collate_tracks([episode], views, native_size)) for episode in episodes]
        arms = max(len(episode.arms) for episode in episodes)
        self._samples = {
            name: torch.cat([_padded(one[name][0], arms) if name in SAMPLES else one[name][0] for one in samples]).to(
                device
            )
            for name in (name for name, values in samples[0].items() if values is not None)
        }
        self._views = views

    def batch(self, clips: Sequence[Clip], per_latent_frame: int, views: Sequence[str]) -> TrackBatch:
        """Samples of the control frames of clips of one length, as `collate_tracks` gives them."""
        within = np.array(control_frames(clips[0].num_frames, per_latent_frame))
        frames = [self._first[clip.episode_id] + clip.start + clip.stride * within for clip in clips]
        numbers = torch.from_numpy(np.stack(frames)).to(self._samples["uv"].device)
        chosen = [self._views.index(view) for view in views]
        found = {name: values[numbers] for name, values in self._samples.items()}
        return TrackBatch(**{k: values if k == "native" else values[:, :, chosen] for k, values in found.items()})


def _padded(values: Tensor, arms: int) -> Tensor:
    """``values`` (n v a ...) with more arms, which are never valid."""
    return torch.cat([values, values.new_zeros((*values.shape[:2], arms - values.shape[2], *values.shape[3:]))], 2)
