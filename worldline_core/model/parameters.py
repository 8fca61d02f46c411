"""Parameters by tower, and their starting values."""

from __future__ import annotations

import torch
from torch import nn

TEXT_PARAMETERS = (
    "embed_tokens.",
    "norm.",
    ".to_q.",
    ".to_k.",
    ".to_v.",
    ".to_out.",
    ".norm_q.",
    ".norm_k.",
    ".mlp.",
    ".input_layernorm.",
    ".post_attention_layernorm.",
)
"""Name parts of the understanding tower's parameters; everything else belongs to the generation tower."""


def is_text_parameter(name: str) -> bool:
    """Whether a parameter belongs to the understanding (text) tower."""
    return name.startswith(TEXT_PARAMETERS[:2]) or any(part in name for part in TEXT_PARAMETERS[2:])


def initialise(model: nn.Module, num_layers: int, generator: torch.Generator | None = None) -> None:
    """Starting values of a :class:`~worldline_core.model.world_model.WorldModel` that is trained from scratch.

    Matrices get normals of one over the square root of their fan-in, those that write to the residual stream less
    by the square root of twice the depth. The head, the action branch's output and the view vectors start at zero.
    """
    residual = (2 * num_layers) ** -0.5
    for name, parameter in model.named_parameters():
        if name.startswith(("proj_out.", "action_encoder.proj.", "view_embedding")):
            nn.init.zeros_(parameter)
        elif parameter.ndim < 2:
            nn.init.constant_(parameter, 1.0 if "norm" in name else 0.0)
        else:
            small = name.startswith(("action_encoder.conv", "embed_tokens"))
            std = 0.02 if small else parameter[0].numel() ** -0.5
            if name.endswith(("to_add_out.weight", "to_out.weight", "down_proj.weight")):
                std *= residual
            nn.init.normal_(parameter, 0.0, std, generator=generator)
