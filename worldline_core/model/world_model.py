"""The action-driven world model: one transformer over multi-view video latents, driven four ways.

What is common to all networks (`mixture.py`, `wan.py`) is here, their four passes: :meth:`WorldModel.forward` (a whole clip), :meth:`~WorldModel.forward_teacher_forcing` (all
blocks of a recorded clip at once), :meth:`~WorldModel.forward_block` (the next block after a cache) and
:meth:`~WorldModel.write_block` (a finished block into the cache).

Axis legend: b batch, v view, c latent channel, t latent frame, h w latent grid, n tokens in order ``(t v h w)``,
d model width. Convention: ``z_sigma = (1 - sigma) z + sigma eps``, velocity ``eps - z`` (paper, Rectified Flow).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, cast

import torch
from einops import rearrange, repeat
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint  # pyright: ignore[reportUnknownVariableType]

from worldline_core.errors import ConfigError, DataError
from worldline_core.model.block_causal_attention import (
    CachedAttention,
    CachedBlock,
    CacheWindow,
    FollowedAttention,
    FullAttention,
    KVCache,
    TeacherForcingAttention,
    block_bounds,
)
from worldline_core.model.layers import (
    ActionEncoder,
    GenerationAttention,
    NativeActionFilm,
    Rotation,
    TextContext,
    TimeEmbedder,
    check_shapes,
    is_action_parameter,
    velocity_of,
    video_positions,
)
from worldline_core.model.world_model_config import VIEWS, CausalSpec, WorldModelConfig


@dataclass(frozen=True)
class WorldModelOutput:
    """Velocity ``(b v c t h w)``, zero on clean frames; and, when asked for, the tokens after one layer."""

    velocity: Tensor
    features: Tensor | None


class WorldModel(nn.Module, ABC):
    """Predicts the velocity of multi-view latents from the first frame, action maps, and optionally text.

    A network has the parts that are declared here by the same names, says how it turns positions (`rotation`), runs over the
    tokens (`_run`) and reads a text (`_read_text`). Its layers take (tokens, attention, number, condition), and compute in
    `before_attention` and `after_attention`, which can be compiled.
    """

    layers: nn.ModuleList
    proj_in: nn.Linear
    proj_out: nn.Linear
    time_embedder: TimeEmbedder
    action_encoder: ActionEncoder | None
    action_film: NativeActionFilm | None

    layer_passes: tuple[str, ...] = ()
    """Methods of a layer, besides its forward pass, that compute with its weights."""
    small: tuple[str, ...] = ("action_encoder.conv",)
    """Beginnings of the names of matrices that start small, whatever their fan-in."""
    residual: tuple[str, ...]
    """Ends of the names of matrices that write to the residual stream."""
    adapted: str
    """Names of the linear layers of attention and feed-forward that LoRA adapts, as a regular expression."""

    def __init__(self, config: WorldModelConfig) -> None:
        super().__init__()
        self.config = config
        self.view_embedding = (
            nn.Parameter(torch.zeros(len(config.views), config.hidden_size)) if config.view_embedding else None
        )
        self.checkpointing: Literal["none", "block"] = "none"
        """``block``: the backward pass computes every block again from its input."""

    @abstractmethod
    def rotation(self, positions: Float[Tensor, "3 *batch n"]) -> Rotation:
        """Rotary angles at (time, height, width) of tokens."""

    @abstractmethod
    def _read_text(self, text_ids: Tensor, mask: Tensor) -> TextContext: ...

    @abstractmethod
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
        """Output of the head ``(b n p)``, and the tokens after one layer.

        Args:
            sigma: noise level by clip or latent frame, ``(b)`` or ``(b t)``.
            clean: latent frames without noise, ``(b t)``; their sigma is not read.
        """

    def text_offset(self, text: TextContext | None) -> float:
        """Time of the first latent frame on the rotary axis, where text precedes it."""
        return 0.0

    def is_text_parameter(self, name: str) -> bool:
        """Returns whether a parameter serves text alone, and is left out of a model that takes none."""
        return False

    def compile_blocks(self) -> None:
        """Compile what every block computes around its attention, which differs from pass to pass; weights keep their names."""
        for layer in cast("Sequence[Any]", self.layers):
            for part in ("before_attention", "after_attention"):
                setattr(layer, part, torch.compile(getattr(layer, part)))  # pyright: ignore[reportUnknownMemberType]

    def initialise(self, generator: torch.Generator | None = None) -> None:
        """Starting values for training from scratch.

        Matrices get normals of one over the square root of their fan-in, those that write to the residual stream less
        by the square root of twice the depth. The head, the action branch's output and the view vectors start at zero.
        """
        for name, parameter in self.named_parameters():
            if name.startswith(("proj_out.", "action_encoder.proj.", "action_film.proj.", "view_embedding")):
                nn.init.zeros_(parameter)
            elif parameter.ndim < 2:
                nn.init.constant_(parameter, 1.0 if "norm" in name and name.endswith("weight") else 0.0)
            else:
                std = 0.02 if name.startswith(self.small) else parameter[0].numel() ** -0.5
                if name.endswith(self.residual):
                    std *= (2 * self.config.num_layers) ** -0.5
                nn.init.normal_(parameter, 0.0, std, generator=generator)

    def generation_parameters(self) -> Iterator[tuple[str, nn.Parameter]]:
        """Parameters that Stage II trains besides the action branch (docs/method.md section 4)."""
        for name, parameter in self.named_parameters():
            if not self.is_text_parameter(name) and not is_action_parameter(name):
                yield name, parameter

    def text_parameters(self) -> Iterator[tuple[str, nn.Parameter]]:
        """Parameters of a text tower, which Stage I trains besides; a network without one has none."""
        return ((name, parameter) for name, parameter in self.named_parameters() if self.is_text_parameter(name))

    def action_parameters(self) -> Iterator[tuple[str, nn.Parameter]]:
        """The branches of the controls, trained at their own rate."""
        return ((name, parameter) for name, parameter in self.named_parameters() if is_action_parameter(name))

    def encode_text(self, text_ids: Tensor, text_mask: Tensor | None = None) -> TextContext:
        """Encode right-padded texts for the layers: token ids ``(b m)`` or embeddings ``(b m s)``, as the model's `TextEncoder`
        returns them.

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
        every = torch.ones(text_ids.shape[:2], dtype=torch.bool, device=text_ids.device)
        return self._read_text(text_ids, every if text_mask is None else text_mask.bool())

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
        frame_numbers = torch.arange(frames, device=latents.device)
        by = self._rotation(frame_numbers, latents, views, fps, self.text_offset(text))
        clean = torch.zeros(len(latents), frames, dtype=torch.bool, device=latents.device)
        clean[:, 0] = True
        attend = FullAttention(by) if text is None else FullAttention(by, text.mask, text.ignored)
        emitted, features = self._run(latents, sigma, clean, attend, action_maps, views, text, features_at)
        velocity = self._velocity(emitted, latents, sigma, clean, latents[:, :, :, :1])
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
        emitted = self._run_block(noisy, sigma, clean, cache, action_maps, views)
        return self._velocity(emitted, noisy, sigma, clean, cache.reference)

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

    @torch.no_grad()
    def write_and_forward_block(
        self,
        clean: Float[Tensor, "b v c t h w"],
        noisy: Float[Tensor, "b v c t2 h w"],
        sigma: Tensor | float,
        cache: KVCache,
        *,
        clean_maps: Float[Tensor, "b v a t #h #w"] | None = None,
        action_maps: Float[Tensor, "b v a t2 #h #w"] | None = None,
        views: Sequence[str] = VIEWS,
    ) -> Float[Tensor, "b v c t2 h w"]:
        """:meth:`write_block`, then :meth:`forward_block`: in one pass where the second sees the first."""
        window = cache.window_beside_next()
        if window is None or (clean_maps is None) != (action_maps is None):
            self.write_block(clean, cache, action_maps=clean_maps, views=views)
            return self.forward_block(noisy, sigma, cache, action_maps=action_maps, views=views)
        count, latents = clean.shape[3], torch.cat((clean, noisy), dim=3)
        maps = None if clean_maps is None or action_maps is None else torch.cat((clean_maps, action_maps), dim=3)
        check_shapes(self.config, latents, views, maps)
        times = torch.arange(latents.shape[3], device=latents.device)
        is_clean = (times < count).expand(len(latents), -1)
        sigma = sigma if isinstance(sigma, Tensor) else torch.full((), sigma, device=latents.device)
        levels = sigma.expand(len(latents))[:, None].expand_as(is_clean)
        written: dict[int, tuple[Tensor, Tensor]] = {}

        def attention(
            frames: Tensor, seen: CacheWindow, keep: dict[int, tuple[Tensor, Tensor]] | None
        ) -> CachedAttention:
            before = torch.arange(seen.frames, device=latents.device)
            own, window_by = (self._rotation(f, latents, views, cache.fps) for f in (frames + seen.frames, before))
            return CachedAttention(own, seen, window_by, keep)

        tokens = count * len(views) * math.prod(self._patch_grid(latents))
        attend = FollowedAttention(
            attention(times[:count], cache.window, written), attention(times, window, None), tokens
        )
        emitted = self._run(latents, levels, is_clean, attend, maps, views)[0]
        cache.append(CachedBlock(count, written), clean)
        return self._velocity(emitted[:, tokens:], noisy, levels[:, count:], is_clean[:, count:], cache.reference)

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
        attend = TeacherForcingAttention(by, sizes, spec.sink_blocks, spec.recent_blocks)
        emitted, _ = self._run(latents, frame_sigma, is_clean, attend, maps, views)
        velocity = self._velocity(emitted, latents, frame_sigma, is_clean, clean[:, :, :, :1])
        return torch.cat((torch.zeros_like(velocity[..., :1, :, :]), velocity[..., history:, :, :]), dim=3)

    def _patch_grid(self, latents: Tensor) -> tuple[int, int]:
        return latents.shape[-2] // self.config.patch_size, latents.shape[-1] // self.config.patch_size

    def _rotation(
        self, frames: Tensor, latents: Tensor, views: Sequence[str], fps: Tensor | None, offset: float = 0.0
    ) -> Rotation:
        """Rotary angles of the tokens of these latent frames, for all heads: ``(n d)``, or ``(b 1 n d)`` by clip."""
        positions = video_positions(self.config, frames, self._patch_grid(latents), views, offset, fps)
        kind = latents.device.type
        dtype = torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else self.proj_in.weight.dtype
        cosine, sine = (part.to(dtype) for part in self.rotation(positions))  # once, not in every layer
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
        """Output of the head for one block that attends to itself and to the cache's window, which it follows in time."""
        check_shapes(self.config, latents, views, action_maps)
        own, window = (torch.arange(count, device=latents.device) for count in (latents.shape[3], cache.frames))
        by = self._rotation(own + cache.frames, latents, views, cache.fps)
        attend = CachedAttention(by, cache.window, self._rotation(window, latents, views, cache.fps), written)
        return self._run(latents, sigma, clean, attend, action_maps, views)[0]

    def _patches(self, latents: Tensor) -> Tensor:
        """Patches of the latents, projected to tokens, ``(b t n d)`` with the n tokens of a latent frame in order ``(v h w)``."""
        size = self.config.patch_size
        patches = rearrange(latents, "b v c t (h p) (w q) -> b t (v h w) (p q c)", p=size, q=size)
        return self.proj_in(patches.to(self.proj_in.weight.dtype))

    def _with_controls(self, tokens: Tensor, action_maps: Tensor | None, views: Sequence[str]) -> Tensor:
        """Tokens ``(b t n d)`` with their view's vector and the residual of the maps, in one sequence."""
        if isinstance(self.view_embedding, nn.Parameter):
            chosen = torch.stack([self.view_embedding[self.config.views.index(view)] for view in views])
            chosen = repeat(chosen, "v d -> (v n) d", n=tokens.shape[2] // len(views))
            tokens = tokens + chosen.to(tokens.dtype)
        tokens = rearrange(tokens, "b t n d -> b (t n) d")
        if action_maps is not None and self.action_encoder is not None:
            tokens = tokens + self.action_encoder(action_maps.to(self.proj_in.weight.dtype)).to(tokens.dtype)
        return tokens

    def _through_layers(
        self,
        tokens: Tensor,
        attend: GenerationAttention,
        conditions: Sequence[object],
        action_maps: Tensor | None,
        features_at: int | None,
    ) -> tuple[Tensor, Tensor | None]:
        """Tokens after all layers, each of which gets its condition, and after one of them."""
        if features_at is not None and not 1 <= features_at <= len(self.layers):
            raise ConfigError("features_at counts layers from 1", expected=f"1..{len(self.layers)}", got=features_at)
        features: Tensor | None = None
        for index, (layer, condition) in enumerate(zip(self.layers, conditions, strict=True)):
            if action_maps is not None and self.action_film is not None:
                tokens = self.action_film(tokens, action_maps, index)
            if self.checkpointing == "block" and torch.is_grad_enabled():
                tokens = cast("Tensor", checkpoint(layer, tokens, attend, index, condition, use_reentrant=False))
            else:
                tokens = layer(tokens, attend, index, condition)
            if features_at == index + 1:
                features = tokens
        return tokens, features

    def _velocity(
        self, emitted: Tensor, latents: Tensor, sigma: Tensor, clean: Tensor, reference: Tensor | None
    ) -> Tensor:
        size = self.config.patch_size
        axes = {"v": latents.shape[1], "t": latents.shape[3], "h": latents.shape[-2] // size, "p": size, "q": size}
        emitted = rearrange(emitted, "b (t v h w) (p q c) -> b v c t (h p) (w q)", **axes)
        per_frame = sigma[:, None] if sigma.ndim == 1 else sigma
        level = rearrange(per_frame.float(), "b t -> b 1 1 t 1 1")
        velocity = velocity_of(self.config, emitted, latents, level, reference)
        return velocity.masked_fill(rearrange(clean, "b t -> b 1 1 t 1 1"), 0.0)
