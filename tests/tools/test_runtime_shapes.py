"""The checker of shapes that all tests run under finds what it is there for."""

from __future__ import annotations

import pytest
import torch
from beartype.roar import BeartypeCallHintViolation

from worldline_core.model.layers import rotate
from worldline_core.training.flow_matching import first_frame, velocity_target

LATENTS = torch.zeros(1, 1, 2, 3, 4, 5)


def test_sizes_of_one_name_are_one_size_in_all_arguments_and_every_call_has_its_own() -> None:
    with pytest.raises(BeartypeCallHintViolation, match="velocity_target"):
        velocity_target(LATENTS, LATENTS.transpose(-1, -2))
    assert velocity_target(LATENTS, LATENTS).shape == LATENTS.shape
    assert velocity_target(LATENTS[..., :3], LATENTS[..., :3]).shape[-1] == 3
    with pytest.raises(BeartypeCallHintViolation, match="first_frame"):
        first_frame(LATENTS[0])
    with pytest.raises(BeartypeCallHintViolation, match="rotate"):
        rotate(torch.zeros(2, 3, 4, 6, dtype=torch.int64), (torch.zeros(1), torch.zeros(1)))  # type: ignore[arg-type]


@pytest.mark.usefixtures("unchecked_shapes")
def test_a_test_can_switch_it_off() -> None:
    with pytest.raises(RuntimeError, match="must match the size"):
        velocity_target(LATENTS, LATENTS.transpose(-1, -2))
