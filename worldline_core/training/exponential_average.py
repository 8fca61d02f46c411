"""Exponential moving average of the trained weights; shipped checkpoints hold the average."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
from torch import Tensor, nn


class ExponentialAverage:
    """Average of named parameters.

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
            self.average[name].lerp_(parameter, 1 - decay)

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
            current = parameter.detach().clone()
            parameter.copy_(self.average[name])
            self.average[name] = current

    def load(self, average: Mapping[str, Tensor]) -> None:
        """Continue from stored averages."""
        for name, value in self.average.items():
            value.copy_(average[name])
