"""Some episodes of a LeRobotDataset that can be read, whose numbers say what the columns are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.lerobot.dataset import LeRobotDataset
from worldline_core.discovery.columns import Column
from worldline_core.errors import DataError

EPISODES, _TRIED = 8, 400


@dataclass
class Sample:
    """Some episodes that can be read: their numbers, and their columns one after the other."""

    dataset: LeRobotDataset
    indices: list[int]
    listed: int

    def values(self, columns: Sequence[Column]) -> np.ndarray:
        """(N, len(columns)) float64 of all sampled episodes; the median stands for what is no number."""
        values = np.concatenate([self.episode(index, columns) for index in self.indices])
        usual = [np.median(column[np.isfinite(column)]) if np.isfinite(column).any() else 0.0 for column in values.T]
        return np.where(np.isfinite(values), values, usual)

    def episode(self, index: int, columns: Sequence[Column]) -> np.ndarray:
        features = {c.feature: self.dataset.column(index, c.feature) for c in columns}
        flat = {name: v[:, None] if v.ndim == 1 else v for name, v in features.items()}
        for column in columns:
            if column.index >= flat[column.feature].shape[1]:
                raise RejectedInputError(
                    "length_mismatch", "Feature has fewer columns than the dataset says",
                    where=f"{self.dataset.root}, episode {index}, {column.feature}",
                    expected=f"more than {column.index}", got=flat[column.feature].shape[1],
                    next_step="correct meta/info.json, or write the dataset again",
                )  # fmt: skip
        return np.stack([flat[c.feature][:, c.index].astype(np.float64) for c in columns], axis=1)


def sample_of(dataset: LeRobotDataset) -> Sample:
    """Episodes from all over the list; where their files are not there, others.

    Raises: DataError where none can be read.
    """
    listed = [int(index) for index in dataset.episodes.indices]
    spread = np.linspace(0, len(listed) - 1, min(len(listed), EPISODES)).round().astype(int).tolist()
    order = [listed[i] for i in dict.fromkeys([*spread, *range(len(listed))])][:_TRIED]
    readable: list[int] = []
    fault: DataError | None = None
    for index in order:
        try:
            dataset.column(index, "timestamp")
            readable.append(index)
        except RejectedInputError as error:
            fault = fault or error
        if len(readable) == EPISODES:
            break
    if not readable:
        raise DataError(
            "No episode of the dataset can be read" if listed else "The dataset lists no episodes",
            where=dataset.root, expected="data files of at least one of the listed episodes", got=fault and str(fault),
            next_step="copy or download the dataset again, as a whole",
        )  # fmt: skip
    return Sample(dataset, sorted(readable), len(listed))
