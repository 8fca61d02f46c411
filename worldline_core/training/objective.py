"""The flow-matching objective of Stage I and Stage II, with the relational terms where they are asked for."""

from __future__ import annotations

from typing import Any

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from worldline_core.errors import ConfigError
from worldline_core.model.world_model import WorldModel
from worldline_core.training.clip_loader import Batch
from worldline_core.training.flow_matching import (
    LossWeighting,
    SigmaSampling,
    add_noise,
    flow_matching_loss,
    sample_sigmas,
)
from worldline_core.training.processes import average_values
from worldline_core.training.relational import (
    PoolingShape,
    RelationalConfig,
    RelationalScales,
    pool_features,
    relational_losses,
)
from worldline_core.training.video_teacher import TeacherFeatures


class RelationalTerm:
    """Teacher features, student layer and running scales of the relational terms."""

    def __init__(self, config: RelationalConfig, teacher: TeacherFeatures, num_layers: int) -> None:
        self.config = config
        self.teacher = teacher
        self.layer = config.student_layer or max(1, num_layers // 2)
        self.scales = RelationalScales(config)

    def add(
        self, flow: Float[Tensor, ""], features: Float[Tensor, "b v t h w d"], batch: Batch, step: int
    ) -> tuple[Tensor, dict[str, float]]:
        """The flow-matching loss plus the weighted relational terms."""
        taught = self.teacher.features(batch.clips, batch.views, batch.frames).to(features.device)
        student_shape = (features.shape[2], features.shape[3], features.shape[4])
        teacher_shape = (taught.shape[2], taught.shape[3], taught.shape[4])
        shape = PoolingShape.common(self.config, student_shape, teacher_shape)
        intra, cross = relational_losses(pool_features(features, shape), pool_features(taught, shape), step)
        # Over all processes, so that their scales stay equal and one saved state is everyone's.
        seen = average_values({"flow": flow.item(), "intra": intra.item(), "cross": cross.item()})
        scale_intra, scale_cross = self.scales.update(seen["flow"], seen["intra"], seen["cross"], step)
        values = {
            "relational_intra": intra.item(),
            "relational_cross": cross.item(),
            "scale_intra": scale_intra,
            "scale_cross": scale_cross,
        }
        return flow + scale_intra * intra + scale_cross * cross, values


class FlowMatchingObjective:
    """Flow matching on clips. The batch decides what conditions the model: text, action maps, or neither."""

    def __init__(
        self,
        model: WorldModel,
        *,
        sigma: SigmaSampling,
        weighting: LossWeighting,
        text_dropout: float = 0.0,
        action_dropout: float = 0.0,
        relational: RelationalTerm | None = None,
    ) -> None:
        self.model = model
        self.sigma = sigma
        self.weighting = weighting
        self.text_dropout = text_dropout
        self.action_dropout = action_dropout
        self.relational = relational

    def loss(self, batch: Batch, generator: torch.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        """Loss of one micro-batch and its parts."""
        latents = batch.latents
        sigma = sample_sigmas(self.sigma, latents.shape[0], generator)
        noise = torch.randn(latents.shape, generator=generator, device=latents.device)
        draws = torch.rand(latents.shape[0], generator=generator, device=latents.device)
        maps = batch.action_maps
        if maps is not None and self.action_dropout > 0:
            maps = maps * rearrange(draws >= self.action_dropout, "b -> b 1 1 1 1 1")
        with_text = batch.text_ids is not None and draws[0].item() >= self.text_dropout
        output = self.model(
            add_noise(latents, noise, sigma),
            sigma,
            action_maps=maps,
            text_ids=batch.text_ids if with_text else None,
            text_mask=batch.text_mask if with_text else None,
            views=batch.views,
            features_at=None if self.relational is None else self.relational.layer,
        )
        flow = flow_matching_loss(output.velocity, latents, noise, sigma, self.weighting)
        if self.relational is None:
            return flow, {}
        if output.features is None:
            raise ConfigError("The model returned no features for the relational terms.", where="features_at")
        total, values = self.relational.add(flow, output.features, batch, step)
        return total, {"flow_matching": flow.item(), **values}

    def state(self) -> dict[str, Any]:
        """Running loss scales."""
        return {} if self.relational is None else self.relational.scales.state()

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from saved scales."""
        if self.relational is not None:
            self.relational.scales.load_state(state)

    def validation_losses(self, batch: Batch, generator: torch.Generator) -> dict[str, float]:
        """Unweighted velocity loss, and the squared error of the clean latents, on a held-out batch.

        With action maps, also for the maps of another clip of the batch (shuffled) and for no maps: a model that
        follows its controls is worse with both.
        """
        latents = batch.latents
        sigma = sample_sigmas(self.sigma, latents.shape[0], generator)
        noise = torch.randn(latents.shape, generator=generator, device=latents.device)
        noisy = add_noise(latents, noise, sigma)
        conditions: dict[str, Tensor | None] = {"": batch.action_maps}
        if batch.action_maps is not None:
            conditions["_shuffled_actions"] = batch.action_maps.roll(1, dims=0)
            conditions["_no_actions"] = torch.zeros_like(batch.action_maps)
        losses: dict[str, float] = {}
        for suffix, maps in conditions.items():
            velocity = self.model(
                noisy,
                sigma,
                action_maps=maps,
                text_ids=batch.text_ids,
                text_mask=batch.text_mask,
                views=batch.views,
            ).velocity
            for name, kind in (("loss", "velocity"), ("sample_error", "sample")):
                weighting = LossWeighting.model_validate({"kind": kind})
                losses[name + suffix] = flow_matching_loss(velocity, latents, noise, sigma, weighting).item()
        losses["sample_error_copy"] = float(((latents - latents[:, :, :, :1]) ** 2)[:, :, :, 1:].mean())
        return losses
