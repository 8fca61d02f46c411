"""Frozen video encoders whose features the relational terms compare with, and a cache of the features of clips.

``SmallVideoTeacher`` is the embedded default (trained by the train_teacher step); ``VJepa2Teacher`` is V-JEPA 2 from a
local folder. Neither is ever used with random weights.
"""

from __future__ import annotations

import json
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import CheckpointError, UnavailableError
from worldline_core.training.clip_source import Clip
from worldline_core.training.small_teacher import DESCRIPTION, load_small_teacher

JEPA_BLOCKS = 4


class VideoTeacher(Protocol):
    """Frames in [0, 1] to features on a (t, h, w) grid of its own, without gradients."""

    name: str

    def features(self, frames: Float[Tensor, "b 3 t h w"]) -> Float[Tensor, "b t2 h2 w2 d"]: ...


class VJepa2Teacher:
    """V-JEPA 2 (paper: ViT-g/384), weights from a local transformers folder.

    The outputs of the last four blocks are layer-normalised and concatenated. Frames are resized to the encoder's
    crop size, because its rotary grid follows from it.
    """

    name = "V-JEPA 2"
    # Mean and standard deviation of the images it was trained on (ImageNet).
    mean = (0.485, 0.456, 0.406)
    std = (0.229, 0.224, 0.225)

    def __init__(self, folder: Path, device: str = "cpu", dtype: torch.dtype | None = None) -> None:
        from transformers import VJEPA2Model

        if not any(folder.glob("*.safetensors")):
            raise UnavailableError(
                "The weights of V-JEPA 2 are not here.",
                where=folder,
                expected="a transformers folder of facebook/vjepa2-vitg-fpc64-384 with model*.safetensors",
                next_step="download it, use the small teacher, or set relational to null",
            )
        model = VJEPA2Model.from_pretrained(folder, local_files_only=True, dtype=dtype or torch.float32)
        self.model = model.eval().requires_grad_(False)
        self.model.to(torch.device(device))  # pyright: ignore[reportArgumentType]
        self.device = device
        self.crop: int = self.model.config.crop_size
        self.side = self.crop // int(self.model.config.patch_size)  # pyright: ignore[reportArgumentType]
        self.tubelet: int = self.model.config.tubelet_size
        self._outputs: list[Tensor] = []
        for layer in self.model.encoder.layer[-JEPA_BLOCKS:]:
            layer.register_forward_hook(self._keep)

    def _keep(self, module: torch.nn.Module, inputs: object, output: tuple[Tensor, ...] | Tensor) -> None:
        del module, inputs
        self._outputs.append(output if isinstance(output, Tensor) else output[0])

    @torch.no_grad()
    def features(self, frames: Float[Tensor, "b 3 t h w"]) -> Float[Tensor, "b t2 h2 w2 d"]:
        """Concatenated, normalised outputs of the last four blocks."""
        batch = frames.shape[0]
        pixels = rearrange(frames, "b c t h w -> (b t) c h w")
        pixels = functional.interpolate(pixels, (self.crop, self.crop), mode="bilinear", antialias=True)
        mean, std = (rearrange(torch.tensor(value), "c -> c 1 1").to(pixels) for value in (self.mean, self.std))
        video = rearrange((pixels - mean) / std, "(b t) c h w -> b t c h w", b=batch)
        if video.shape[1] % self.tubelet:
            # The clip's 4 k + 1 frames do not fill the last tubelet: hold the last frame.
            video = torch.cat(
                [video, video[:, -1:].expand(-1, self.tubelet - video.shape[1] % self.tubelet, -1, -1, -1)], 1
            )
        self._outputs.clear()
        parameter = next(self.model.parameters())
        self.model(pixel_values_videos=video.to(parameter.device, parameter.dtype), skip_predictor=True)
        normalised = [functional.layer_norm(output.float(), output.shape[-1:]) for output in self._outputs]
        self._outputs.clear()
        return rearrange(torch.cat(normalised, dim=-1), "b (t h w) d -> b t h w d", h=self.side, w=self.side)


def load_teacher(folder: Path, device: str = "cpu") -> VideoTeacher:
    """The teacher in ``folder``: the small one, or V-JEPA 2.

    Raises:
        CheckpointError: if it holds neither.
        UnavailableError: if V-JEPA 2's weights are missing.
    """
    if (folder / DESCRIPTION).is_file():
        return load_small_teacher(folder).to(device)
    config = folder / "config.json"
    if config.is_file() and json.loads(config.read_text()).get("model_type") == "vjepa2":
        return VJepa2Teacher(folder, device)
    raise CheckpointError(
        "This folder holds no relational teacher.",
        where=folder,
        expected=f"{DESCRIPTION} of the small teacher, or config.json of V-JEPA 2",
        got=sorted(path.name for path in folder.glob("*"))[:8],
        next_step="run train_teacher, or download V-JEPA 2",
    )


class TeacherFeatures:
    """Teacher features of clips, from the recordings' frames, kept in memory (half precision)."""

    def __init__(self, teacher: VideoTeacher, episodes: Path, *, cached_clips: int) -> None:
        self.teacher = teacher
        self.episodes = EpisodeSet.open(episodes)
        self.cached_clips = cached_clips
        self._cache: OrderedDict[tuple[Clip, tuple[str, ...]], Tensor] = OrderedDict()

    def features(
        self, clips: Sequence[Clip], views: Sequence[str], frames: UInt8[Tensor, "b v n height width 3"] | None = None
    ) -> Float[Tensor, "b v t h w d"]:
        """Features of every clip and view.

        Args:
            frames: of these clips, where they are read already; else they are decoded here, at the size of the recording.
        """
        given = [None] * len(clips) if frames is None else list(frames)
        # Half precision does not survive a stack under CPU autocast.
        return torch.stack([self._clip(c, tuple(views), f).float() for c, f in zip(clips, given, strict=True)])

    def _clip(
        self, clip: Clip, views: tuple[str, ...], frames: UInt8[Tensor, "v n height width 3"] | None
    ) -> Float[Tensor, "v t h w d"]:
        key = (clip, views)
        if key in self._cache:
            self._cache.move_to_end(key)
            return self._cache[key]
        if frames is None:
            position = self.episodes.position(clip.episode_id)
            decoded = [self.episodes.frames(position, view, list(clip.frames)) for view in views]
            frames = torch.from_numpy(np.stack(decoded))
        video = rearrange(frames.float() / 255.0, "v t h w c -> v c t h w")
        features = self.teacher.features(video).to("cpu", torch.float16)
        # Computed and cached values must be the same bits, so that a resumed run equals an undisturbed one.
        if self.cached_clips:
            self._cache[key] = features
            if len(self._cache) > self.cached_clips:
                self._cache.popitem(last=False)
        return features
