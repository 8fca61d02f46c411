"""The action-driven world model: a mixture of transformers over text and multi-view video latents.

One network, four passes: :meth:`WorldModel.forward` (a whole clip), :meth:`~WorldModel.forward_teacher_forcing` (all
blocks of a recorded clip at once), :meth:`~WorldModel.forward_block` (the next block after a cache) and
:meth:`~WorldModel.write_block` (a finished block into the cache).

Axis legend: b batch, v view, c latent channel, t latent frame, h w latent grid, n tokens in order ``(t v h w)``,
d model width. Convention: ``z_sigma = (1 - sigma) z + sigma eps``, velocity ``eps - z`` (paper, Rectified Flow).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, cast

import torch
from einops import rearrange, repeat
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint  # pyright: ignore[reportUnknownVariableType]

from worldline_core.errors import ConfigError, DataError
from worldline_core.model.block_causal_attention import (
    CachedAttention,
    CachedBlock,
    FullAttention,
    KVCache,
    TeacherForcingAttention,
    block_bounds,
)
from worldline_core.model.layers import (
    GenerationAttention,
    MixtureLayer,
    RMSNorm,
    Rotation,
    TextContext,
    TimeEmbedder,
    action_branches,
    check_shapes,
    is_action_parameter,
    is_text_parameter,
    rotation,
    text_positions,
    velocity_of,
    video_positions,
)
from worldline_core.model.world_model_config import VIEWS, CausalSpec, WorldModelConfig


@dataclass(frozen=True)
class WorldModelOutput:
    """Velocity ``(b v c t h w)``, zero on clean frames; and, when asked for, the tokens after one layer."""

    velocity: Tensor
    features: Tensor | None


class WorldModel(nn.Module):
    """Predicts the velocity of multi-view latents from the first frame, action maps, and optionally text."""

    def __init__(self, config: WorldModelConfig) -> None:
        super().__init__()
        self.config = config
        if config.towers == "both":
            self.embed_tokens = nn.Embedding(config.vocab_size, config.hidden_size)
            self.norm = RMSNorm(config.hidden_size, config.rms_norm_eps)
        self.layers = nn.ModuleList([MixtureLayer(config) for _ in range(config.num_layers)])
        self.norm_moe_gen = RMSNorm(config.hidden_size, config.rms_norm_eps)
        self.proj_in = nn.Linear(config.patch_dim, config.hidden_size)
        self.proj_out = nn.Linear(config.hidden_size, config.patch_dim)
        self.time_embedder = TimeEmbedder(config.hidden_size)
        self.action_encoder, self.action_film = action_branches(config)
        self.view_embedding = (
            nn.Parameter(torch.zeros(len(config.views), config.hidden_size)) if config.view_embedding else None
        )
        self.checkpointing: Literal["none", "block"] = "none"
        """``block``: the backward pass computes every block again from its input."""

    def compile_blocks(self) -> None:
        """Compile what every block computes around its attention; weights and their names stay as they are."""
        for layer in self._mixture():
            layer.compile_halves()

    def initialise(self, generator: torch.Generator | None = None) -> None:
        """Starting values for training from scratch.

        Matrices get normals of one over the square root of their fan-in, those that write to the residual stream less
        by the square root of twice the depth. The head, the action branch's output and the view vectors start at zero.
        """
        residual = (2 * self.config.num_layers) ** -0.5
        for name, parameter in self.named_parameters():
            if name.startswith(("proj_out.", "action_encoder.proj.", "action_film.proj.", "view_embedding")):
                nn.init.zeros_(parameter)
            elif parameter.ndim < 2:
                nn.init.constant_(parameter, 1.0 if "norm" in name else 0.0)
            else:
                small = name.startswith(("action_encoder.conv", "embed_tokens"))
                std = 0.02 if small else parameter[0].numel() ** -0.5
                if name.endswith(("to_add_out.weight", "to_out.weight", "down_proj.weight")):
                    std *= residual
                nn.init.normal_(parameter, 0.0, std, generator=generator)

    def generation_parameters(self) -> Iterator[tuple[str, nn.Parameter]]:
        """Parameters that Stage II trains besides the action branch (docs/method.md section 4)."""
        for name, parameter in self.named_parameters():
            if not is_text_parameter(name) and not is_action_parameter(name):
                yield name, parameter

    def action_parameters(self) -> Iterator[tuple[str, nn.Parameter]]:
        """The branches of the controls, trained at their own rate."""
        return ((name, parameter) for name, parameter in self.named_parameters() if is_action_parameter(name))

    def encode_text(self, text_ids: Tensor, text_mask: Tensor | None = None) -> TextContext:
        """Run the understanding tower over right-padded token ids ``(b m)``.

        Raises:
            ConfigError: the model was built or loaded without its understanding tower.
        """
        if self.config.towers != "both":
            raise ConfigError(
                "This model has no understanding tower, so it takes no text",
                expected='towers="both"',
                got=self.config.towers,
                next_step="load the Stage I checkpoint with both towers, or leave the text out",
            )
        size = text_ids.shape[1]
        mask = torch.ones_like(text_ids, dtype=torch.bool) if text_mask is None else text_mask.bool()
        cosine, sine = rotation(self.config, text_positions(mask.sum(dim=1), size))
        by = (rearrange(cosine, "b n d -> b 1 n d"), rearrange(sine, "b n d -> b 1 n d"))
        tokens = self.embed_tokens(text_ids)
        contexts: list[tuple[Tensor, Tensor]] = []
        for layer in self._mixture():
            tokens, context = layer.understand(tokens, by)
            contexts.append(context)
        return TextContext(tuple(contexts), None if bool(mask.all()) else mask, size)

    def forward(
        self,
        latents: Float[Tensor, "b v c t h w"],
        sigma: Tensor,
        *,
        action_maps: Float[Tensor, "b v a t #h #w"] | None = None,
        text: TextContext | None = None,
        views: Sequence[str] = VIEWS,
        fps: Float[Tensor, " b"] | None = None,
        features_at: int | None = None,
    ) -> WorldModelOutput:
        """Velocity of a whole clip whose first latent frame is the clean observation (Stage I and II).

        Args:
            latents: noisy latents behind a clean first frame.
            sigma: noise level in [0, 1], ``(b)`` or ``(b t)``; not read on the first frame.
            action_maps: controls as `ControlDrawing` gives them, maps or vectors in each view; None runs without controls.
            text: from :meth:`encode_text`.
            views: names of the views in ``latents``.
            fps: frames per second of each clip as it is shown; None: as the config says.
            features_at: also return the video tokens after this many layers (1-based), as ``(b v t h w d)``.

        Raises:
            DataError: a shape does not fit.
            ConfigError: a view is unknown, or there is no such layer.
        """
        check_shapes(self.config, latents, views, action_maps)
        frames, (rows, columns) = latents.shape[3], self._patch_grid(latents)
        offset = 0.0 if text is None or text.ignored else text.size + self.config.temporal_margin
        by = self._rotation(torch.arange(frames, device=latents.device), latents, views, fps, offset)
        clean = torch.zeros(len(latents), frames, dtype=torch.bool, device=latents.device)
        clean[:, 0] = True
        tokens = self._embed(latents, sigma, clean, action_maps, views)
        attend = FullAttention(by) if text is None else FullAttention(by, text.mask, text.ignored)
        tokens, features = self._run(tokens, attend, action_maps, text, features_at)
        velocity = self._velocity(tokens, latents, sigma, clean, latents[:, :, :, :1])
        if features is not None:
            features = rearrange(features, "b (t v h w) d -> b v t h w d", t=frames, v=len(views), h=rows, w=columns)
        return WorldModelOutput(velocity, features)

    def forward_block(
        self,
        noisy: Float[Tensor, "b v c t h w"],
        sigma: Tensor | float,
        cache: KVCache,
        *,
        action_maps: Float[Tensor, "b v a t #h #w"] | None = None,
        views: Sequence[str] = VIEWS,
    ) -> Float[Tensor, "b v c t h w"]:
        """Velocity of the block that follows the finished blocks in ``cache``, which stays as it is.

        Args:
            sigma: noise level in [0, 1], ``(b)`` or one for all.

        Raises:
            DataError: a shape does not fit.
            ConfigError: a view is unknown, or the cache holds no first frame for a model that predicts residuals to it.
        """
        sigma = sigma if isinstance(sigma, Tensor) else torch.full((), sigma, device=noisy.device)
        sigma = sigma.expand(len(noisy))
        clean = torch.zeros(len(noisy), noisy.shape[3], dtype=torch.bool, device=noisy.device)
        tokens = self._run_block(noisy, sigma, clean, cache, action_maps, views)
        return self._velocity(tokens, noisy, sigma, clean, cache.reference)

    def write_block(
        self,
        clean: Float[Tensor, "b v c t h w"],
        cache: KVCache,
        *,
        action_maps: Float[Tensor, "b v a t #h #w"] | None = None,
        views: Sequence[str] = VIEWS,
    ) -> CachedBlock:
        """Put the keys and values of a finished block into ``cache``, and return them: one pass over clean latents.

        The first block written is the observed frame, which the cache remembers. No gradient flows into a cache.

        Raises:
            DataError: a shape does not fit.
            ConfigError: a view is unknown.
        """
        sigma = torch.zeros(len(clean), device=clean.device)
        every_frame = torch.ones(len(clean), clean.shape[3], dtype=torch.bool, device=clean.device)
        written: dict[int, tuple[Tensor, Tensor]] = {}
        with torch.no_grad():
            self._run_block(clean, sigma, every_frame, cache, action_maps, views, written)
        block = CachedBlock(clean.shape[3], written)
        cache.append(block, clean)
        return block

    def forward_teacher_forcing(
        self,
        noisy: Float[Tensor, "b v c t h w"],
        clean: Float[Tensor, "b v c t h w"],
        sigma: Float[Tensor, "b blocks"],
        *,
        action_maps: Float[Tensor, "b v a t #h #w"] | None = None,
        spec: CausalSpec,
        views: Sequence[str] = VIEWS,
        fps: Float[Tensor, " b"] | None = None,
    ) -> Float[Tensor, "b v c t h w"]:
        """Block-causal velocity of every block in one pass (paper, Stage III step 1).

        Noisy block ``i`` sees itself, with its own action maps, and the clean blocks that ``spec`` keeps before it: what
        :meth:`forward_block` sees after these blocks were written. Frame 0 of ``noisy`` is not read; its velocity is 0.

        Raises:
            DataError: a shape does not fit, or the clip does not divide into blocks.
        """
        check_shapes(self.config, noisy, views, action_maps)
        batch, _, _, frames, _, _ = noisy.shape
        bounds = block_bounds(frames, spec.block_size)
        if clean.shape != noisy.shape or sigma.shape != (batch, len(bounds) - 1):
            raise DataError(
                "Teacher forcing needs clean latents like the noisy ones and one sigma per block",
                expected=f"{tuple(noisy.shape)} and {(batch, len(bounds) - 1)}",
                got=f"{tuple(clean.shape)} and {tuple(sigma.shape)}",
            )
        history = frames - spec.block_size
        frame_sigma = repeat(sigma, "b blocks -> b (blocks size)", size=spec.block_size)
        latents = torch.cat((clean[..., :history, :, :], noisy[..., 1:, :, :].to(clean.dtype)), dim=3)
        frame_sigma = torch.cat((frame_sigma.new_zeros(batch, history), frame_sigma), dim=1)
        is_clean = (torch.arange(history + frames - 1, device=noisy.device) < history).expand(batch, -1)
        maps = None
        if action_maps is not None:
            maps = torch.cat((action_maps[..., :history, :, :], action_maps[..., 1:, :, :]), dim=3)
        by = self._rotation(torch.arange(frames, device=noisy.device), noisy, views, fps)
        rows, columns = self._patch_grid(noisy)
        per_frame = len(views) * rows * columns
        sizes = tuple((stop - start) * per_frame for start, stop in bounds)
        tokens = self._embed(latents, frame_sigma, is_clean, maps, views)
        attend = TeacherForcingAttention(by, sizes, spec.sink_blocks, spec.recent_blocks)
        tokens, _ = self._run(tokens, attend, maps)
        velocity = self._velocity(tokens, latents, frame_sigma, is_clean, clean[:, :, :, :1])
        return torch.cat((torch.zeros_like(velocity[..., :1, :, :]), velocity[..., history:, :, :]), dim=3)

    def _mixture(self) -> Sequence[MixtureLayer]:
        return cast("Sequence[MixtureLayer]", self.layers)

    def _patch_grid(self, latents: Tensor) -> tuple[int, int]:
        """Patch rows and columns of one view."""
        return latents.shape[-2] // self.config.patch_size, latents.shape[-1] // self.config.patch_size

    def _rotation(
        self, frames: Tensor, latents: Tensor, views: Sequence[str], fps: Tensor | None, offset: float = 0.0
    ) -> Rotation:
        """Rotary angles of the tokens of these latent frames, for all heads: ``(n d)``, or ``(b 1 n d)`` by clip."""
        positions = video_positions(self.config, frames, self._patch_grid(latents), views, offset, fps)
        cosine, sine = rotation(self.config, positions)
        return (cosine, sine) if positions.ndim == 2 else (cosine[:, None], sine[:, None])

    def _run_block(
        self,
        latents: Tensor,
        sigma: Tensor,
        clean: Tensor,
        cache: KVCache,
        action_maps: Tensor | None,
        views: Sequence[str],
        written: dict[int, tuple[Tensor, Tensor]] | None = None,
    ) -> Tensor:
        """Tokens of one block that attends to itself and to the cache's window, which it follows in time."""
        check_shapes(self.config, latents, views, action_maps)
        own, window = (torch.arange(count, device=latents.device) for count in (latents.shape[3], cache.frames))
        by = self._rotation(own + cache.frames, latents, views, cache.fps)
        attend = CachedAttention(by, cache.window, self._rotation(window, latents, views, cache.fps), written)
        return self._run(self._embed(latents, sigma, clean, action_maps, views), attend, action_maps)[0]

    def _embed(
        self, latents: Tensor, sigma: Tensor, clean: Tensor, action_maps: Tensor | None, views: Sequence[str]
    ) -> Tensor:
        """Patches to tokens; time embedding on noisy frames only; action residual; view embedding."""
        size = self.config.patch_size
        patches = rearrange(latents, "b v c t (h p) (w q) -> b t (v h w) (p q c)", p=size, q=size)
        tokens = self.proj_in(patches.to(self.proj_in.weight.dtype))
        if sigma.ndim == 1:
            sigma = sigma[:, None]
        time = self.time_embedder(sigma.float() * (1000.0 * self.config.timestep_scale))
        time = torch.where(clean[..., None], torch.zeros((), dtype=time.dtype, device=time.device), time)
        tokens = tokens + rearrange(time, "b t d -> b t 1 d").to(tokens.dtype)
        if isinstance(self.view_embedding, nn.Parameter):
            chosen = torch.stack([self.view_embedding[self.config.views.index(view)] for view in views])
            chosen = repeat(chosen, "v d -> (v n) d", n=tokens.shape[2] // len(views))
            tokens = tokens + chosen.to(tokens.dtype)
        tokens = rearrange(tokens, "b t n d -> b (t n) d")
        if action_maps is not None and self.action_encoder is not None:
            tokens = tokens + self.action_encoder(action_maps.to(self.proj_in.weight.dtype)).to(tokens.dtype)
        return tokens

    def _run(
        self,
        tokens: Tensor,
        attend: GenerationAttention,
        action_maps: Tensor | None,
        text: TextContext | None = None,
        features_at: int | None = None,
    ) -> tuple[Tensor, Tensor | None]:
        if features_at is not None and not 1 <= features_at <= len(self.layers):
            raise ConfigError("features_at counts layers from 1", expected=f"1..{len(self.layers)}", got=features_at)
        features: Tensor | None = None
        for index, layer in enumerate(self._mixture()):
            context = None if text is None else text.layers[index]
            if action_maps is not None and self.action_film is not None:
                tokens = self.action_film(tokens, action_maps, index)
            if self.checkpointing == "block" and torch.is_grad_enabled():
                tokens = cast("Tensor", checkpoint(layer, tokens, attend, index, context, use_reentrant=False))
            else:
                tokens = layer(tokens, attend, index, context)
            if features_at == index + 1:
                features = tokens
        return self.norm_moe_gen(tokens), features

    def _velocity(
        self, tokens: Tensor, latents: Tensor, sigma: Tensor, clean: Tensor, reference: Tensor | None
    ) -> Tensor:
        size = self.config.patch_size
        axes = {"v": latents.shape[1], "t": latents.shape[3], "h": latents.shape[-2] // size, "p": size, "q": size}
        emitted = rearrange(self.proj_out(tokens), "b (t v h w) (p q c) -> b v c t (h p) (w q)", **axes)
        per_frame = sigma[:, None] if sigma.ndim == 1 else sigma
        level = rearrange(per_frame.float(), "b t -> b 1 1 t 1 1")
        velocity = velocity_of(self.config, emitted, latents, level, reference)
        return velocity.masked_fill(rearrange(clean, "b t -> b 1 1 t 1 1"), 0.0)
