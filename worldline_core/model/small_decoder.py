"""A small decoder beside a tokenizer's own: the latents of that tokenizer to pictures, at a fraction of the operations.

The encoder stays as it is, so that latents and models keep their meaning; only what pictures look like changes. A latent
frame is decoded beside the first one and the one before it, the first alone: pictures can be decoded as latents arrive.
Where the scene still is as it was observed, the observed pixels are taken over.

Axis legend: b batch, c channel, t frame, g frames of a group, h w pixels; ``_l`` marks the latent grid.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

import torch
import torch.nn.functional as F
from einops import rearrange, repeat
from jaxtyping import Float
from pydantic import Field, ValidationError
from torch import Tensor, nn

from worldline_core.config import StrictModel
from worldline_core.errors import CheckpointError, ConfigError, DataError
from worldline_core.model.checkpoint import described, fill, read_description, read_weights, write_weights
from worldline_core.model.tokenizers import Residual, VideoDecoder, VideoTokenizer, check_latents
from worldline_core.store.atomic import write_json_atomic

DESCRIPTION, WEIGHTS = "decoder.json", "decoder.safetensors"
FORMAT, VERSION = "worldline.decoder", 1


class SmallDecoderConfig(StrictModel):
    """The tokenizer whose latents are decoded, and the size of the decoder.

    Attributes:
        tokenizer: fingerprint of the tokenizer (`tokenizer_fingerprint`).
        width: channels at half the pictures' height and width; twice as many at every halving, down to the latent grid.
        depth: residual blocks at each of these sizes.
    """

    tokenizer: str
    latent_channels: int = Field(ge=1)
    spatial_compression: Literal[4, 8, 16, 32]
    temporal_compression: int = Field(ge=1)
    width: int = Field(default=128, ge=4)
    depth: int = Field(default=2, ge=1)

    @classmethod
    def of(cls, tokenizer: VideoTokenizer, fingerprint: str, **size: int) -> SmallDecoderConfig:
        """For the latents of this tokenizer. Raises: ConfigError when it compresses pictures by another factor."""
        layout = {name: getattr(tokenizer, name) for name in _LAYOUT}
        try:
            return cls.model_validate({"tokenizer": fingerprint, **layout, **size})
        except ValidationError as error:
            raise ConfigError(
                "No small decoder for this tokenizer", expected="compression 4, 8, 16 or 32 in space", got=str(error)
            ) from error


_LAYOUT = ("latent_channels", "spatial_compression", "temporal_compression")


class SmallDecoder(nn.Module, VideoTokenizer):
    """A linear decode of each latent cell, refined by residual convolutions from the latent grid up to half the pictures' size.

    Where the observed first picture is given, each frame is ``mask * observed + (1 - mask) * made``, else ``made``. With the
    encoder of ``tokenizer`` it is a `VideoTokenizer`.
    """

    def __init__(self, config: SmallDecoderConfig, tokenizer: VideoTokenizer) -> None:
        super().__init__()
        self.config = config
        self.latent_channels = config.latent_channels
        self.spatial_compression: int = config.spatial_compression
        self.temporal_compression = config.temporal_compression
        self._tokenizer = (tokenizer,)  # a tuple: its weights are no part of this module's
        levels = config.spatial_compression.bit_length() - 2
        widths = [config.width * 2**level for level in range(levels, -1, -1)]
        seen, frames = 3 * config.latent_channels + 1, config.temporal_compression
        self.linear = nn.Conv2d(seen, frames * 3 * config.spatial_compression**2, 1)
        self.enter = nn.Conv2d(seen, widths[0], 3, padding=1)
        self.levels = nn.ModuleList(nn.Sequential(*[Residual(width) for _ in range(config.depth)]) for width in widths)
        self.ups = nn.ModuleList(nn.Conv2d(width, 2 * width, 1) for width in widths[:-1])
        self.look = nn.Conv2d((frames + 2) * 3 * 4 + 1, config.width, 3, padding=1)
        self.leave = nn.Conv2d(config.width, frames * 4 * 4, 3, padding=1)
        nn.init.zeros_(self.leave.weight)
        bias = torch.zeros(frames, 4, 4)
        bias[:, 3] = -1.0
        self.leave.bias = nn.Parameter(bias.flatten())

    def forward(
        self, window: Float[Tensor, "b window h_l w_l"], reference: Float[Tensor, "b 3 h w"] | None = None
    ) -> Float[Tensor, "b g 3 h w"]:
        """Frames of a group (of the first latent frame: all the same) from its window; see `windows`."""
        first = window[:, : self.latent_channels]
        coarse = self._linear(window)
        still = self._linear(torch.cat((first, first, first, torch.ones_like(first[:, :1])), dim=1))[:, :3]
        observed = still if reference is None else reference.to(coarse.dtype)
        shown = F.pixel_unshuffle(torch.cat((coarse, still, observed), dim=1), 2)
        shown = F.pad(shown, (0, 0, 0, 0, 0, 1), value=float(reference is not None))
        features = self.enter(window.contiguous(memory_format=torch.channels_last))
        for level, blocks in enumerate(self.levels):
            if level:
                features = F.pixel_shuffle(self.ups[level - 1](F.gelu(features)), 2)
            if level == len(self.levels) - 1:
                features = features + self.look(shown.contiguous(memory_format=torch.channels_last))
            features = blocks(features)
        out = self.leave(F.gelu(features)).float()
        out = rearrange(out, "b (g k p q) h w -> b g k (h p) (w q)", k=4, p=2, q=2)
        made = rearrange(coarse, "b (g c) h w -> b g c h w", c=3) + out[:, :, :3]
        if reference is None:
            return made
        return made + torch.sigmoid(out[:, :, 3:]) * (rearrange(observed, "b c h w -> b 1 c h w") - made)

    def _linear(self, window: Tensor) -> Tensor:
        with torch.autocast(window.device.type, enabled=False):
            return F.pixel_shuffle(self.linear(window.float()), self.spatial_compression)

    @torch.no_grad()
    def fit(self, clips: Iterable[Float[Tensor, "b 3 t h w"]]) -> None:
        """Begin at the linear decode with the least squared error on these clips. Raises: DataError when there are none."""
        gram = cross = torch.zeros(())
        for clip in clips:
            video = clip.to(self.linear.weight.device)
            given = rearrange(windows(self.encode(video)), "b t window h w -> (b t h w) window").float()
            given = F.pad(given, (0, 1), value=1.0)
            first = repeat(video[:, :, 0], "b c h w -> b c g h w", g=self.temporal_compression)
            wanted = rearrange(
                torch.cat((first, video[:, :, 1:]), dim=2), "b c (t g) (h p) (w q) -> (b t h w) (g c p q)",
                g=self.temporal_compression, p=self.spatial_compression, q=self.spatial_compression,
            )  # fmt: skip
            gram, cross = gram + (given.T @ given).double().cpu(), cross + (given.T @ wanted).double().cpu()
        if gram.ndim == 0:
            raise DataError("No clips to fit the decoder to", next_step="check the selection of episodes")
        # Frames of clips that begin tell the parts of a window apart only by this small weight.
        gram += 1e-4 * gram.diagonal().mean() * torch.eye(len(gram), dtype=torch.float64)
        solution = torch.linalg.solve(gram, cross).float()
        weight = rearrange(solution[:-1], "window out -> out window 1 1")
        self.linear.load_state_dict({"weight": weight, "bias": solution[-1]})

    def encode(self, video: Float[Tensor, "b 3 t h w"]) -> Float[Tensor, "b c t_l h_l w_l"]:
        return self._tokenizer[0].encode(video)

    def decoder(self, reference: Float[Tensor, "b 3 h w"] | None = None) -> SmallDecoding:
        return SmallDecoding(self, reference)

    def save(self, folder: Path, metadata: Mapping[str, Any] | None = None) -> None:
        """Write the weights in float16. Equal weights give equal bytes."""
        digest = write_weights(folder / WEIGHTS, self.state_dict(), torch.float16)
        description = {"format": FORMAT, "version": VERSION, "config": self.config.model_dump(mode="json")}
        stated = {"metadata": dict(metadata or {}), "weights_sha256": digest}
        write_json_atomic(folder / DESCRIPTION, description | stated)

    @classmethod
    def load(cls, folder: Path, tokenizer: VideoTokenizer, fingerprint: str, device: str = "cpu") -> SmallDecoder:
        """The decoder that ``train_tokenizer`` wrote for the tokenizer of this fingerprint, in float32.

        Raises:
            CheckpointError: the folder holds none, or a damaged one, or one for latents of another tokenizer.
        """
        path, weights = folder / DESCRIPTION, folder / WEIGHTS
        content = read_description(path, FORMAT, "decoder", VERSION)
        config = described(SmallDecoderConfig, content.get("config"), path)
        layout = {"tokenizer": fingerprint, **{name: getattr(tokenizer, name) for name in _LAYOUT}}
        found = {name: getattr(config, name) for name in layout}
        if found != layout:
            raise CheckpointError(
                "The decoder was trained for another tokenizer", where=path, expected=layout, got=found,
                next_step="train one for this tokenizer: `worldline task train_tokenizer --input encoder=FOLDER`",
            )  # fmt: skip
        decoder = cls(config, tokenizer)
        fill(decoder, read_weights(weights, str(content.get("weights_sha256"))), where=weights, dtype=torch.float32)
        return decoder.to(device).eval().requires_grad_(False)


def windows(
    latents: Float[Tensor, "b c t_l h_l w_l"], first: Tensor | None = None, before: Tensor | None = None
) -> Float[Tensor, "b t_l window h_l w_l"]:
    """Input that each latent frame is decoded from: the clip's first one, the one before, itself, and a channel that is 1 at the
    clip's first frame, which is all three.

    Args:
        first, before: ``(b, c, h_l, w_l)``, the clip's first latent frame and the last one so far, where it goes on.
    """
    begins = torch.zeros_like(latents[:, :1])
    if first is None or before is None:
        first = before = latents[:, :, 0]
        begins[:, :, 0] = 1.0
    earlier = torch.cat((before[:, :, None], latents[:, :, :-1]), dim=2)
    window = torch.cat((first[:, :, None].expand_as(latents), earlier, latents, begins), dim=1)
    return rearrange(window, "b w t h_l w_l -> b t w h_l w_l")


class SmallDecoding(VideoDecoder):
    """Decodes clips as their latents arrive, one latent frame after the other, however many come at once."""

    def __init__(self, network: SmallDecoder, reference: Tensor | None) -> None:
        self._network = network
        self._reference = reference
        self._first: Tensor | None = None
        self._before: Tensor | None = None

    def __call__(self, latents: Float[Tensor, "b c t_l h_l w_l"]) -> Float[Tensor, "b 3 t h w"]:
        """Frames of the next latents. Raises: DataError when they, or the observed picture, have another layout."""
        check_latents(self._network, latents)
        batch, space = len(latents), self._network.spatial_compression
        size = (batch, 3, latents.shape[3] * space, latents.shape[4] * space)
        if self._reference is not None and self._reference.shape != size:
            raise DataError(
                "The reference frame does not fit the latents", expected=size, got=tuple(self._reference.shape)
            )
        begins = self._first is None
        # One by one, so that no sum depends on how many come at once, and memory on how long a clip is.
        pieces = windows(latents, self._first, self._before).unbind(dim=1)
        groups = [self._network(piece, self._reference) for piece in pieces]
        if begins:
            self._first, groups[0] = latents[:, :, 0], groups[0][:, :1]
        self._before = latents[:, :, -1]
        return rearrange(torch.cat(groups, dim=1), "b t c h w -> b c t h w").to(latents.dtype)

    def begin(self, first: Float[Tensor, "b c 1 h_l w_l"]) -> None:
        self._first = self._before = first[:, :, 0]
