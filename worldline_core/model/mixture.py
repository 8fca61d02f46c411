"""Cosmos3's network: a mixture of transformers, an understanding half (text) beside a generation half (video).

Module names equal those of diffusers' ``Cosmos3OmniTransformer``, so that its state dict loads directly.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from worldline_core.model.layers import (
    GenerationAttention,
    RMSNorm,
    Rotation,
    TextContext,
    TimeEmbedder,
    action_branches,
    grouped_attention,
    rotate,
)
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import MixtureConfig


def text_positions(lengths: Tensor, size: int) -> Float[Tensor, "3 b n"]:
    """Coordinates of right-padded text tokens.

    Cosmos3 counts text 0..n-1 on all axes and starts the video at ``n + margin``. In a batch the video start is shared
    (``size + margin``), so shorter texts are moved on the temporal axis until they end where the longest ends: rotary
    attention depends on differences only, so every sample sees the distances it would see alone.
    """
    index = torch.arange(size, device=lengths.device, dtype=torch.float32)
    index = rearrange(index, "n -> 1 n").expand(len(lengths), size)
    time = index + rearrange(size - lengths.to(torch.float32), "b -> b 1")
    return torch.stack((time, index, index))


class FeedForward(nn.Module):
    """SwiGLU, or the squared ReLU without a gate."""

    def __init__(self, config: MixtureConfig) -> None:
        super().__init__()
        size, inner = config.hidden_size, config.intermediate_size
        self.gate_proj = nn.Linear(size, inner, bias=False) if config.feed_forward == "swiglu" else None
        self.up_proj = nn.Linear(size, inner, bias=False)
        self.down_proj = nn.Linear(inner, size, bias=False)

    def forward(self, values: Tensor) -> Tensor:
        up = self.up_proj(values)
        return self.down_proj(F.relu(up).square() if self.gate_proj is None else F.silu(self.gate_proj(values)) * up)


class MixtureAttention(nn.Module):
    """Query, key, value and output projections of both halves; how they meet is the caller's choice."""

    def __init__(self, config: MixtureConfig) -> None:
        super().__init__()
        self.head_dim = config.head_dim
        inner, shared = config.num_heads * config.head_dim, config.num_kv_heads * config.head_dim
        if config.towers == "both":
            self.to_q = nn.Linear(config.hidden_size, inner, bias=False)
            self.to_k = nn.Linear(config.hidden_size, shared, bias=False)
            self.to_v = nn.Linear(config.hidden_size, shared, bias=False)
            self.to_out = nn.Linear(inner, config.hidden_size, bias=False)
            if config.text_keys == "normalised":
                self.norm_q = RMSNorm(config.head_dim, config.rms_norm_eps)
                self.norm_k = RMSNorm(config.head_dim, config.rms_norm_eps)
            else:
                self.norm_q = self.norm_k = nn.Identity()
                self.k_norm_und_for_gen = RMSNorm(config.head_dim, config.rms_norm_eps)
        self.text_keys = config.text_keys
        self.add_q_proj = nn.Linear(config.hidden_size, inner, bias=False)
        self.add_k_proj = nn.Linear(config.hidden_size, shared, bias=False)
        self.add_v_proj = nn.Linear(config.hidden_size, shared, bias=False)
        self.to_add_out = nn.Linear(inner, config.hidden_size, bias=False)
        self.norm_added_q = RMSNorm(config.head_dim, config.rms_norm_eps)
        self.norm_added_k = RMSNorm(config.head_dim, config.rms_norm_eps)

    def _heads(self, values: Tensor) -> Tensor:
        return rearrange(values, "b n (k d) -> b n k d", d=self.head_dim)

    def understand(self, values: Tensor, by: Rotation) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """Causal self-attention over text; also returns the rotated keys and values the video reads."""
        queries = rotate(rearrange(self.norm_q(self._heads(self.to_q(values))), "b n k d -> b k n d"), by)
        keys = read = rotate(rearrange(self.norm_k(self._heads(self.to_k(values))), "b n k d -> b k n d"), by)
        if self.text_keys == "normalised_for_video":
            normalised = self.k_norm_und_for_gen(self._heads(self.to_k(values)))
            read = rotate(rearrange(normalised, "b n k d -> b k n d"), by)
        value = rearrange(self._heads(self.to_v(values)), "b n k d -> b k n d")
        size = queries.shape[-2]
        causal = torch.ones(size, size, dtype=torch.bool, device=values.device).tril()
        mixed = grouped_attention(queries, keys, value, causal[None, None])
        return self.to_out(mixed), (read, value)

    def project(self, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Queries, keys and values of the video tokens, ``(b heads n d)``, normalised and not yet rotated."""
        queries = rearrange(self.norm_added_q(self._heads(self.add_q_proj(values))), "b n k d -> b k n d")
        keys = rearrange(self.norm_added_k(self._heads(self.add_k_proj(values))), "b n k d -> b k n d")
        value = rearrange(self._heads(self.add_v_proj(values)), "b n k d -> b k n d")
        return queries, keys, value


class MixtureLayer(nn.Module):
    """Pre-norm attention and feed-forward of both halves. There is no adaptive normalisation."""

    def __init__(self, config: MixtureConfig) -> None:
        super().__init__()
        eps = config.rms_norm_eps
        self.self_attn = MixtureAttention(config)
        if config.towers == "both":
            self.mlp = FeedForward(config)
            self.input_layernorm = RMSNorm(config.hidden_size, eps)
            self.post_attention_layernorm = RMSNorm(config.hidden_size, eps)
        self.mlp_moe_gen = FeedForward(config)
        self.input_layernorm_moe_gen = RMSNorm(config.hidden_size, eps)
        self.post_attention_layernorm_moe_gen = RMSNorm(config.hidden_size, eps)

    def forward(
        self,
        tokens: Float[Tensor, "b n d"],
        attend: GenerationAttention,
        layer: int,
        text: tuple[Tensor, Tensor] | None = None,
    ) -> Float[Tensor, "b n d"]:
        """Advance the video tokens; ``text``: keys and values of the text in this layer, from `understand`."""
        queries, keys, values = self.before_attention(tokens)
        return self.after_attention(tokens, attend(layer, queries, keys, values, text))

    def before_attention(self, tokens: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return self.self_attn.project(self.input_layernorm_moe_gen(tokens))

    def after_attention(self, tokens: Tensor, mixed: Tensor) -> Tensor:
        """Tokens after what attention mixed, and the feed-forward."""
        tokens = tokens + self.self_attn.to_add_out(mixed)
        return tokens + self.mlp_moe_gen(self.post_attention_layernorm_moe_gen(tokens))

    def understand(
        self, tokens: Float[Tensor, "b m d"], by: Rotation
    ) -> tuple[Float[Tensor, "b m d"], tuple[Tensor, Tensor]]:
        """Advance the text tokens; also returns their keys and values, which the video tokens of this layer read."""
        mixed, read = self.self_attn.understand(self.input_layernorm(tokens), by)
        tokens = tokens + mixed
        return tokens + self.mlp(self.post_attention_layernorm(tokens)), read


TEXT_PARAMETERS = (
    "embed_tokens.",
    "norm.",
    ".to_q.",
    ".to_k.",
    ".to_v.",
    ".to_out.",
    ".norm_q.",
    ".norm_k.",
    ".k_norm_und_for_gen.",
    ".mlp.",
    ".input_layernorm.",
    ".post_attention_layernorm.",
)
"""Name parts of the understanding tower's parameters; everything else belongs to the generation tower."""


def is_text_parameter(name: str) -> bool:
    """True for parameters of the understanding (text) tower."""
    return name.startswith(TEXT_PARAMETERS[:2]) or any(part in name for part in TEXT_PARAMETERS[2:])


class MixtureModel(WorldModel):
    """The world model over Cosmos3's network, or a small one of its form."""

    layer_passes = ("understand",)
    small = (*WorldModel.small, "embed_tokens")
    residual = ("to_add_out.weight", "to_out.weight", "down_proj.weight")
    adapted = r"layers\.\d+\.(self_attn\.(add_[qkv]_proj|to_add_out)|mlp_moe_gen\.\w+_proj)"

    def __init__(self, config: MixtureConfig) -> None:
        super().__init__(config)
        self._mixture = config
        if config.towers == "both":
            self.embed_tokens = nn.Embedding(config.vocab_size, config.hidden_size)
            self.norm = RMSNorm(config.hidden_size, config.rms_norm_eps)
        self.layers = nn.ModuleList([MixtureLayer(config) for _ in range(config.num_layers)])
        self.norm_moe_gen = RMSNorm(config.hidden_size, config.rms_norm_eps)
        self.proj_in = nn.Linear(config.patch_dim, config.hidden_size)
        self.proj_out = nn.Linear(config.hidden_size, config.patch_dim)
        self.time_embedder = TimeEmbedder(config.hidden_size)
        self.action_encoder, self.action_film = action_branches(config)

    def rotation(self, positions: Float[Tensor, "3 *batch n"]) -> Rotation:
        """Cosines and sines; frequency ``i`` belongs to axis ``i % 3`` within the sections, else to time."""
        config = self._mixture
        half = config.head_dim // 2
        # Angles stay in float32 even under autocast: bfloat16 cannot tell consecutive integers apart beyond 256.
        exponent = torch.arange(0, config.head_dim, 2, dtype=torch.float32, device=positions.device) / config.head_dim
        frequencies = 1.0 / (config.rope_theta**exponent)
        axis_of = torch.zeros(half, dtype=torch.long, device=positions.device)
        for axis in (1, 2):
            axis_of[axis : config.rope_sections[axis] * 3 : 3] = axis
        chosen = positions.to(torch.float32)[axis_of]
        angles = torch.movedim(chosen, 0, -1) * frequencies
        angles = torch.cat((angles, angles), dim=-1)
        return angles.cos(), angles.sin()

    def is_text_parameter(self, name: str) -> bool:
        return is_text_parameter(name)

    def text_offset(self, text: TextContext | None) -> float:
        """Text begins at 0; the video follows it at a distance."""
        return 0.0 if text is None or text.ignored else text.size + self._mixture.temporal_margin

    def _read_text(self, text_ids: Tensor, mask: Tensor) -> TextContext:
        """Run the understanding tower over token ids ``(b m)``."""
        size = text_ids.shape[1]
        cosine, sine = self.rotation(text_positions(mask.sum(dim=1), size))
        by = (rearrange(cosine, "b n d -> b 1 n d"), rearrange(sine, "b n d -> b 1 n d"))
        tokens = self.embed_tokens(text_ids)
        contexts: list[tuple[Tensor, Tensor]] = []
        for layer in cast("Sequence[MixtureLayer]", self.layers):
            tokens, context = layer.understand(tokens, by)
            contexts.append(context)
        return TextContext(tuple(contexts), None if bool(mask.all()) else mask, size)

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
        tokens = self._patches(latents)
        levels = sigma[:, None] if sigma.ndim == 1 else sigma
        time = self.time_embedder(levels.float() * (1000.0 * self._mixture.timestep_scale))
        # Clean frames have no time embedding at all.
        time = torch.where(clean[..., None], torch.zeros((), dtype=time.dtype, device=time.device), time)
        tokens = tokens + rearrange(time, "b t d -> b t 1 d").to(tokens.dtype)
        contexts = [None] * len(self.layers) if text is None else text.layers
        tokens = self._with_controls(tokens, action_maps, views)
        tokens, features = self._through_layers(tokens, attend, contexts, action_maps, features_at)
        return self.proj_out(self.norm_moe_gen(tokens)), features
