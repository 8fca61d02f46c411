"""Wan 2.2's network (TI2V-5B): one transformer, driven by time in every layer, that reads text by cross-attention.

Every latent frame has a time of its own, 0 where it is clean: that is how TI2V takes its first frame, and how a finished
block enters the cache. Text comes as embeddings of umT5, which is no part of the model; where none is given the model reads
its own prompt, whose embeddings are saved with its weights, and then padding, as it was trained.

Names of modules are those of diffusers' ``WanTransformer3DModel`` within a layer; `wan_weights.py` has the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from worldline_core.errors import DataError
from worldline_core.model.layers import (
    GenerationAttention,
    RMSNorm,
    Rotation,
    TextContext,
    TimeEmbedder,
    action_branches,
    grouped_attention,
)
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import WanConfig

SHIFTS = 6
"""Vectors by which time drives a layer: shift, scale and gate of its self-attention, then of its feed-forward."""


def driven(tokens: Tensor, shift: Tensor, scale: Tensor, eps: float) -> Tensor:
    """Layer-normalised tokens ``(b (t n) d)``, scaled and shifted by their latent frame, ``(b t d)``; in float32 inside."""
    grid = rearrange(tokens.float(), "b (t n) d -> b t n d", t=shift.shape[1])
    grid = F.layer_norm(grid, grid.shape[-1:], eps=eps) * (1 + scale[:, :, None]) + shift[:, :, None]
    return rearrange(grid, "b t n d -> b (t n) d").to(tokens.dtype)


def gated(tokens: Tensor, change: Tensor, gate: Tensor) -> Tensor:
    """Tokens ``(b (t n) d)`` and a change of theirs, by the gate of their latent frame, ``(b t d)``."""
    grid = rearrange(change, "b (t n) d -> b t n d", t=gate.shape[1]) * gate[:, :, None]
    return (tokens.float() + rearrange(grid, "b t n d -> b (t n) d")).to(tokens.dtype)


class WanAttention(nn.Module):
    """Projections of one attention; queries and keys are normalised over all heads together."""

    def __init__(self, config: WanConfig) -> None:
        super().__init__()
        self.head_dim, size = config.head_dim, config.hidden_size
        self.to_q, self.to_k, self.to_v, self.to_out = (nn.Linear(size, size) for _ in range(4))
        self.norm_q, self.norm_k = (RMSNorm(size, config.norm_eps) for _ in range(2))

    def project(self, tokens: Tensor, read: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Queries of ``tokens``, keys and values of what they read, ``(b heads n d)``.

        Wan rotates neighbouring channels of a head together, the rest of this package those half a head apart: queries and keys
        are put in that order, which changes no product of theirs.
        """
        queries, keys = self.norm_q(self.to_q(tokens)), self.norm_k(self.to_k(read))
        paired = "b n (k d two) -> b k n (two d)"
        queries, keys = (rearrange(x, paired, two=2, d=self.head_dim // 2) for x in (queries, keys))
        return queries, keys, rearrange(self.to_v(read), "b n (k d) -> b k n d", d=self.head_dim)


class Condition(NamedTuple):
    """Input of every layer besides tokens: ``drive`` ``(b t 6 d)`` of the latent frames' times, and the tokens of a text."""

    drive: Tensor
    text: Tensor


class WanLayer(nn.Module):
    """Self-attention and feed-forward driven by time, and between them cross-attention to the text."""

    def __init__(self, config: WanConfig) -> None:
        super().__init__()
        size, self.eps = config.hidden_size, config.norm_eps
        self.attn1, self.attn2 = WanAttention(config), WanAttention(config)
        self.norm2 = nn.LayerNorm(size, config.norm_eps)
        self.ffn = nn.Sequential(
            nn.Linear(size, config.intermediate_size), nn.GELU("tanh"), nn.Linear(config.intermediate_size, size)
        )
        self.scale_shift_table = nn.Parameter(torch.empty(1, SHIFTS, size))

    def forward(
        self, tokens: Float[Tensor, "b n d"], attend: GenerationAttention, layer: int, condition: Condition
    ) -> Float[Tensor, "b n d"]:
        queries, keys, values = self.before_attention(tokens, condition.drive)
        return self.after_attention(tokens, attend(layer, queries, keys, values, None), *condition)

    def before_attention(self, tokens: Tensor, drive: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        shift, scale = (self.scale_shift_table + drive)[:, :, :2].unbind(2)
        tokens = driven(tokens, shift, scale, self.eps)
        return self.attn1.project(tokens, tokens)

    def after_attention(self, tokens: Tensor, mixed: Tensor, drive: Tensor, text: Tensor) -> Tensor:
        """Tokens after what self-attention mixed, cross-attention and the feed-forward."""
        gate, shift, scale, last_gate = (self.scale_shift_table + drive)[:, :, 2:].unbind(2)
        tokens = gated(tokens, self.attn1.to_out(mixed), gate)
        plain = F.layer_norm(
            tokens.float(), tokens.shape[-1:], self.norm2.weight.float(), self.norm2.bias.float(), self.eps
        )
        queries, keys, values = self.attn2.project(plain.to(tokens.dtype), text)
        keys, values = (read.expand(len(queries), -1, -1, -1) for read in (keys, values))
        tokens = tokens + self.attn2.to_out(grouped_attention(queries, keys, values))
        return gated(tokens, self.ffn(driven(tokens, shift, scale, self.eps)), last_gate)


class TextProjection(nn.Module):
    """Two-layer perceptron from embeddings of text to tokens."""

    def __init__(self, config: WanConfig) -> None:
        super().__init__()
        self.linear_1 = nn.Linear(config.text_size, config.hidden_size)
        self.linear_2 = nn.Linear(config.hidden_size, config.hidden_size)

    def forward(self, embeddings: Tensor) -> Tensor:
        hidden = self.linear_1(embeddings.to(self.linear_1.weight.dtype))
        return self.linear_2(F.gelu(hidden, approximate="tanh"))


class WanModel(WorldModel):
    """The world model over Wan's network."""

    small = (*WorldModel.small, "time_proj")
    residual = ("to_out.weight", "ffn.2.weight")
    adapted = r"layers\.\d+\.(attn[12]\.to_(q|k|v|out)|ffn\.[02])"
    prompt: Tensor
    """Embeddings of the text that the model reads where it is given none, ``(m text_size)``."""

    def __init__(self, config: WanConfig) -> None:
        super().__init__(config)
        self._wan = config
        self.layers = nn.ModuleList([WanLayer(config) for _ in range(config.num_layers)])
        self.proj_in = nn.Linear(config.patch_dim, config.hidden_size)
        self.proj_out = nn.Linear(config.hidden_size, config.patch_dim)
        self.scale_shift_table = nn.Parameter(torch.empty(1, 2, config.hidden_size))
        self.time_embedder = TimeEmbedder(config.hidden_size)
        self.time_proj = nn.Linear(config.hidden_size, SHIFTS * config.hidden_size)
        self.text_embedder = TextProjection(config)
        self.action_encoder, self.action_film = action_branches(config)
        self.register_buffer("prompt", torch.zeros(config.prompt_length, config.text_size))

    def rotation(self, positions: Float[Tensor, "3 *batch n"]) -> Rotation:
        """Cosines and sines; the frequencies of time come first, then those of height and of width, a third of the head each."""
        config = self._wan
        space = 2 * (config.head_dim // 6)
        angles: list[Tensor] = []
        for place, size in zip(positions.to(torch.float32), (config.head_dim - 2 * space, space, space), strict=True):
            exponent = torch.arange(0, size, 2, dtype=torch.float32, device=positions.device) / size
            angles.append(place[..., None] * config.rope_theta**-exponent)
        both = torch.cat(angles * 2, dim=-1)
        return both.cos(), both.sin()

    def _text_tokens(self, embeddings: Float[Tensor, "b m s"]) -> Float[Tensor, "b n d"]:
        """Tokens of a text filled up with zeros to the length that the model was trained at, none of them hidden."""
        missing = self._wan.text_length - embeddings.shape[1]
        if missing < 0 or embeddings.shape[2:] != (self._wan.text_size,):
            raise DataError(
                "Text embeddings have the wrong shape", got=tuple(embeddings.shape),
                expected=f"(b, at most {self._wan.text_length}, {self._wan.text_size}), from umT5 (`text.kind: stored`)",
            )  # fmt: skip
        return self.text_embedder(F.pad(embeddings, (0, 0, 0, missing)))

    def _read_text(self, text_ids: Tensor, mask: Tensor) -> TextContext:
        """Tokens of embeddings ``(b m s)``, the same for every layer."""
        tokens = self._text_tokens(text_ids * mask[..., None])
        return TextContext(((tokens,),) * len(self.layers), None, tokens.shape[1])

    def _run(
        self,
        latents: Tensor,
        sigma: Tensor,
        clean: Tensor,
        attend: GenerationAttention,
        action_maps: Tensor | None,
        views: Sequence[str],
        text: TextContext | None = None,
        features_at: int | None = None,
    ) -> tuple[Tensor, Tensor | None]:
        levels = (sigma[:, None] if sigma.ndim == 1 else sigma).float()
        time = self.time_embedder(torch.where(clean, torch.zeros_like(levels), levels) * 1000.0)
        drive = self.time_proj(F.silu(time).to(self.time_proj.weight.dtype)).float()
        drive = rearrange(drive, "b t (k d) -> b t k d", k=SHIFTS)
        read = self._text_tokens(self.prompt[None]) if text is None or text.ignored else text.layers[0][0]
        tokens = self._with_controls(self._patches(latents), action_maps, views)
        conditions = [Condition(drive, read)] * len(self.layers)
        tokens, features = self._through_layers(tokens, attend, conditions, action_maps, features_at)
        shift, scale = (self.scale_shift_table + time.float()[:, :, None]).unbind(2)
        return self.proj_out(driven(tokens, shift, scale, self._wan.norm_eps)), features
