"""From jobs to predicted frames: observe, encode, render controls, sample, decode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from einops import rearrange
from torch import Tensor

from worldline_core.actions.action_maps import latent_frame_indices, render_action_maps
from worldline_core.actions.episode_tracks import ActionTracks, collate_tracks
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ConfigError, DataError
from worldline_core.model.checkpoint import CheckpointInfo, check_action_contract, load_checkpoint
from worldline_core.model.tokenizer import load_tokenizer
from worldline_core.model.video_tokenizer import VideoTokenizer, frames_to_video, video_to_frames
from worldline_core.model.world_model import WorldModel
from worldline_core.rollout.rollout_config import Job, RolloutConfig
from worldline_core.rollout.samplers import (
    BLOCK_SIZE,
    BlockCausalSimulator,
    Noise,
    rollout_full_clip,
    sigmas_causal,
    sigmas_full,
)
from worldline_core.rollout.speed import Elapsed, timed

WARM_UP_BLOCKS = 2


class Predictor:
    """Everything loaded that a batch of predictions needs."""

    def __init__(
        self, config: RolloutConfig, inputs: Mapping[str, Path], episodes: EpisodeSet, tracks: ActionTracks
    ) -> None:
        self.config = config
        self.episodes = episodes
        self.tracks = tracks
        self.tokenizer: VideoTokenizer = load_tokenizer(Path(inputs["tokenizer"]))
        self.model: WorldModel | None = None
        self.info: CheckpointInfo | None = None
        first = episodes.rows[0]
        self.fps = float(first.fps)
        self.views: tuple[str, ...] = tuple(first.views)
        recorded = episodes.frames(0, self.views[0], [0]).shape
        self.image_size: tuple[int, int] = (recorded[1], recorded[2])
        self.steps: int | None = None
        self.recent_blocks: int | None = None
        self.block_seconds: list[float] = []
        """Wall seconds of each block of the last batch; empty where the clip was sampled whole."""
        if config.sampler != "copy_first_frame":
            self._load_model(Path(inputs["checkpoint"]))
        if isinstance(self.tokenizer, torch.nn.Module):
            self.tokenizer.to(config.device)

    def _load_model(self, folder: Path) -> None:
        config = self.config
        kinds = ("stage2",) if config.sampler == "full_clip" else ("causal",)
        model, info = load_checkpoint(folder, expect_kind=kinds, towers="generation")
        self.model, self.info = model.to(config.device).eval().requires_grad_(False), info
        self.views = tuple(info.config.views)
        contract = info.action_contract
        wanted: dict[str, Any] = {"fps": self.fps}
        if "grid_size" in contract:
            rows, columns = contract["grid_size"]
            space = self.tokenizer.spatial_compression
            self.image_size = (rows * space, columns * space)
        coder = getattr(self.tokenizer, "encoder_digest", None)
        if isinstance(coder, str) and "tokenizer" in contract:
            wanted["tokenizer"] = coder[: len(contract["tokenizer"])]
        check_action_contract(contract, wanted, where=folder)
        if info.config.latent_channels != self.tokenizer.latent_channels:
            raise DataError(
                "The tokenizer does not fit the checkpoint",
                expected=f"{info.config.latent_channels} latent channels",
                got=self.tokenizer.latent_channels,
            )
        self.steps = config.steps or (35 if config.sampler == "full_clip" else 4)
        if config.sampler == "block_causal":
            self.recent_blocks = config.recent_blocks
            if self.recent_blocks is None:
                trained = info.metadata.get("clip_latent_frames")
                self.recent_blocks = 3 if trained is None else max(0, min(3, (int(trained) - 1) // BLOCK_SIZE - 1))

    def predict(self, batch: Sequence[Job]) -> list[dict[str, np.ndarray]]:
        """Predicted frames of every view of every job, the observed frame first."""
        self.block_seconds = []
        observed = self._observed(batch)
        if self.model is None:
            return [
                {
                    view: np.repeat(video_to_frames(first[v, :, None]), job.frames, axis=0)
                    for v, view in enumerate(self.views)
                }
                for first, job in zip(observed, batch, strict=True)
            ]
        flat = rearrange(observed, "b v c h w -> (b v) c 1 h w").to(self.config.device)
        with torch.no_grad():
            first, maps = self._encoded(batch, flat)
            latents = self._sample(self.model, first, maps, batch)
            flat_latents = rearrange(latents, "b v c t h w -> (b v) c t h w")
            with torch.autocast(self.config.device.split(":")[0], torch.bfloat16, enabled=self.config.bfloat16):
                video = self.tokenizer.decode(flat_latents, flat[:, :, 0])
        video = rearrange(video, "(b v) c t h w -> b v c t h w", v=len(self.views))
        return [{view: video_to_frames(clip[v]) for v, view in enumerate(self.views)} for clip in video]

    def time_blocks(self, job: Job, blocks: int) -> list[Elapsed]:
        """What every block takes of one long rollout, for the cost alone; nothing of it is kept.

        The trajectory goes on beyond its own end with its last controls. A few blocks before it warm up.

        Raises:
            ConfigError: the sampler has no blocks.
        """
        if self.model is None or self.config.sampler != "block_causal":
            raise ConfigError("Only a block-causal rollout has blocks to time", where="timed_blocks", got=blocks)
        flat = rearrange(self._observed([job]), "b v c h w -> (b v) c 1 h w").to(self.config.device)
        with torch.no_grad():
            first, maps = self._encoded([job], flat)
        controls = maps[:, :, :, -BLOCK_SIZE:]
        times: list[Elapsed] = []
        for count in (WARM_UP_BLOCKS, blocks):
            simulator = self._simulator(self.model, [job])
            simulator.start(first, maps[:, :, :, :1])
            times = [timed(partial(simulator.step, controls), self.config.device)[1] for _ in range(count)]
        return times

    def _encoded(self, batch: Sequence[Job], flat: Tensor) -> tuple[Tensor, Tensor]:
        """Latents of the observed frames, and the controls' maps at their resolution."""
        first = rearrange(self.tokenizer.encode(flat), "(b v) c 1 h w -> b v c h w", v=len(self.views))
        return first, self._action_maps(batch, (first.shape[-2], first.shape[-1]))

    def _observed(self, batch: Sequence[Job]) -> Tensor:
        firsts = []
        for job in batch:
            row = self.episodes.rows[job.position]
            absent = [view for view in self.views if view not in row.views]
            if absent:
                raise DataError(
                    "An episode lacks views the model needs", where=job.episode_id, expected=self.views, got=row.views
                )
            frames = [self.episodes.frames(job.position, view, [0]) for view in self.views]
            firsts.append(torch.stack([frames_to_video(frame, self.image_size)[:, 0] for frame in frames]))
        return torch.stack(firsts)

    def _action_maps(self, batch: Sequence[Job], grid: tuple[int, int]) -> Tensor:
        """Maps of the controls; zero maps for predictions without them."""
        contract = {} if self.info is None else self.info.action_contract
        cut = []
        for job in batch:
            track = self.tracks.tracks(job.controls_of)
            indices = [min(i, track.num_frames - 1) for i in latent_frame_indices(job.frames)]
            cut.append(
                track.clip(indices, wrist_projection=contract.get("wrist_projection", "current_camera"), start=0)
            )
        check_action_contract(contract, {"controls": cut[0].controls} if "controls" in contract else {}, where="tracks")
        maps = render_action_maps(
            collate_tracks(cut, views=self.views),
            cut[0].image_size,
            grid_size=grid,
            sigma_px_ref=float(contract.get("sigma_px_ref", 10.0)),
        ).to(self.config.device)
        return torch.zeros_like(maps) if self.config.actions == "zero" else maps

    def _sample(self, model: WorldModel, first: Tensor, maps: Tensor, batch: Sequence[Job]) -> Tensor:
        if self.config.sampler == "full_clip":
            return rollout_full_clip(
                model,
                first,
                maps,
                noise=Noise([job.seed for job in batch]),
                sigmas=sigmas_full(self.steps or 1),
                views=self.views,
                bfloat16=self.config.bfloat16,
            )
        simulator = self._simulator(model, batch)
        simulator.start(first, maps[:, :, :, :1])
        blocks = [first[:, :, :, None]]
        for start in range(1, maps.shape[3], BLOCK_SIZE):
            controls = maps[:, :, :, start : start + BLOCK_SIZE]
            block, elapsed = timed(partial(simulator.step, controls), self.config.device)
            blocks.append(block)
            self.block_seconds.append(elapsed.wall)
        return torch.cat(blocks, dim=3)

    def _simulator(self, model: WorldModel, batch: Sequence[Job]) -> BlockCausalSimulator:
        return BlockCausalSimulator(
            model,
            noise=Noise([job.seed for job in batch]),
            sigmas=sigmas_causal(self.steps or 1),
            sink_blocks=self.config.sink_blocks,
            recent_blocks=self.recent_blocks if self.recent_blocks is not None else 3,
            views=self.views,
            bfloat16=self.config.bfloat16,
        )
