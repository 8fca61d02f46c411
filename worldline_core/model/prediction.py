"""From what the head emits to the velocity of the flow."""

from __future__ import annotations

from torch import Tensor

from worldline_core.errors import ConfigError
from worldline_core.model.config import WorldModelConfig


def velocity_of(
    config: WorldModelConfig, emitted: Tensor, noisy: Tensor, sigma: Tensor, reference: Tensor | None
) -> Tensor:
    """Velocity under the config's ``prediction``; in float32 where clean latents are emitted.

    Args:
        emitted: output of the head, ``(b v c t h w)``.
        sigma: noise level, broadcastable to ``emitted``.
        reference: clean latents of the first frame, ``(b v c 1 h w)``.

    Raises:
        ConfigError: residuals to the first frame are predicted, but there is none.
    """
    if config.prediction == "velocity":
        return emitted
    emitted, noisy = emitted.float(), noisy.float()
    if config.prediction == "first_frame_residual":
        if reference is None:
            raise ConfigError("The cache holds no first frame", next_step="write the observed frame first")
        if config.first_frame_std is not None:
            return preconditioned_velocity(emitted, noisy, sigma, reference.float(), config.first_frame_std)
        emitted = emitted + reference.float()
    return (noisy - emitted) / sigma.clamp_min(config.minimum_sigma)


def preconditioned_velocity(emitted: Tensor, noisy: Tensor, sigma: Tensor, reference: Tensor, std: float) -> Tensor:
    """Velocity of the posterior mean under z ~ N(reference, std^2), corrected by ``emitted`` posterior deviations.

    With D = (1 - sigma)^2 std^2 + sigma^2 the posterior of z given the noisy latents has the mean
    ``reference + (1 - sigma) std^2 / D (noisy - (1 - sigma) reference)`` and the deviation ``sigma std / sqrt(D)``.
    ``(noisy - z) / sigma`` then has no division by sigma left.
    """
    spread = (1 - sigma) ** 2 * std**2 + sigma**2
    mean = ((sigma - (1 - sigma) * std**2) * noisy - sigma * reference) / spread
    return mean - std * emitted * spread.rsqrt()
