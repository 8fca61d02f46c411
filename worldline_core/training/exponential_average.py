"""The moving average of the weights under training, which is what checkpoints hold."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
from torch import nn

from worldline_core.training.sharding import own_part


class ExponentialAverage:
    """Exponential moving average of named parameters; shipped checkpoints hold it. Sharded where they are.

    The decay rises with the number of updates, ``min(decay, (1 + n) / (10 + n))``, so that the random start is
    forgotten also in short runs.
    """

    def __init__(self, parameters: Mapping[str, nn.Parameter], decay: float) -> None:
        self.parameters = dict(parameters)
        self.decay = decay
        self.average = {name: parameter.detach().clone() for name, parameter in self.parameters.items()}

    @torch.no_grad()
    def update(self, updates: int) -> None:
        """Take in the current weights; ``updates`` counts earlier updates."""
        decay = min(self.decay, (1 + updates) / (10 + updates))
        for name, parameter in self.parameters.items():
            own_part(self.average[name]).lerp_(own_part(parameter), 1 - decay)

    @contextmanager
    def swapped(self) -> Iterator[None]:
        """Within the context the model holds the average."""
        self._exchange()
        try:
            yield
        finally:
            self._exchange()

    @torch.no_grad()
    def _exchange(self) -> None:
        for name, parameter in self.parameters.items():
            weights, average = own_part(parameter), own_part(self.average[name])
            current = weights.detach().clone()
            weights.copy_(average)
            average.copy_(current)
