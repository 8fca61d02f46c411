"""Tracks and shares of things on the training device, beside resident latents: a batch of any size is a few gathers."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from worldline_core.actions.action_maps import control_frames
from worldline_core.actions.episode_tracks import SAMPLES, ActionTracks, TrackBatch, collate_tracks
from worldline_core.errors import DataError
from worldline_core.progress import with_progress
from worldline_core.training.clip_sampler import Clip, ClipRow


def on_device(values: np.ndarray | Tensor, device: torch.device | str) -> Tensor:
    """Small values of the host on a device, from page-locked memory: the host does not wait for what the device is doing."""
    host = torch.as_tensor(values)
    return host.pin_memory().to(device, non_blocking=True) if torch.device(device).type == "cuda" else host.to(device)


def frame_numbers(clips: Sequence[Clip], within: Sequence[int]) -> Int[np.ndarray, "b n"]:
    """Numbers in their episodes of these frames of every clip."""
    start, stride = np.array([(clip.start, clip.stride) for clip in clips]).T
    return start[:, None] + stride[:, None] * np.array(within)


def track_bytes(views: int, arms: int, native_size: int | None) -> int:
    """Bytes of the samples of a frame."""
    return 49 * views * arms + (0 if native_size is None else 4 * native_size + views)


class ResidentTracks:
    """Track samples of the frames of many episodes on one device.

    Raises: DataError: the episodes' frames have several sizes, or there are fewer tracks than frames.
    """

    def __init__(
        self,
        tracks: ActionTracks,
        rows: Sequence[ClipRow],
        views: tuple[str, ...],
        device: str,
        native_size: int | None,
    ) -> None:
        episodes = [tracks.tracks(row.episode_id) for row in with_progress(rows, "reading tracks", "episode")]
        for episode, row in zip(episodes, rows, strict=True):
            episode.index((0, row.num_frames - 1))
        sizes = {episode.image_size for episode in episodes if episode.calibrated_views}
        if len(sizes) > 1:
            raise DataError("Resident action tracks have frames of one size", where=tracks.root, got=sorted(sizes))
        self.image_size = sizes.pop() if sizes else (1, 1)
        starts = accumulate((one.num_frames for one in episodes), initial=0)
        self._first = dict(zip((row.episode_id for row in rows), starts, strict=False))
        samples = [vars(collate_tracks([episode], views, native_size)) for episode in episodes]
        arms = max(len(episode.arms) for episode in episodes)
        self._samples = {
            name: torch.cat([_padded(one[name][0], arms) if name in SAMPLES else one[name][0] for one in samples]).to(
                device
            )
            for name in (name for name, values in samples[0].items() if values is not None)
        }
        self._views, self._device = views, device

    def batch(self, clips: Sequence[Clip], per_latent_frame: int, views: Sequence[str]) -> TrackBatch:
        """Samples of the control frames of clips of one length, as `collate_tracks` gives them."""
        first = np.array([self._first[clip.episode_id] for clip in clips])
        within = frame_numbers(clips, control_frames(clips[0].num_frames, per_latent_frame))
        frames = on_device(first[:, None] + within, self._device)
        shown = on_device(np.array([self._views.index(view) for view in views]), self._device)
        found = {
            name: values[frames] if name == "native" else values[frames[..., None], shown]
            for name, values in self._samples.items()
        }
        return TrackBatch(**found)


def _padded(values: Tensor, arms: int) -> Tensor:
    """``values`` (n v a ...) with more arms, which are never valid."""
    return torch.cat([values, values.new_zeros((*values.shape[:2], arms - values.shape[2], *values.shape[3:]))], 2)
