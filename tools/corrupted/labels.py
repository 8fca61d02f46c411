"""What is true about each recording of a corpus, kept apart from what curation and filtering may see."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

SECOND = "#source.?"
"""End of the id of an episode that its source lists again; `corpus` puts the source's number in."""
Stage = Literal["kept", "curate", "filter", "stage2"]


@dataclass(frozen=True)
class Label:
    """The truth about one listed recording.

    Attributes:
        episode_id: the id in the curated set.
        kind: what was done to it; "clean" when nothing.
        stage: where it has to be found: kept, quarantined by curation or by the filters, or left out of Stage II.
        reasons: the codes that name the defect rightly.
    """

    episode_id: str
    layout: str
    kind: str
    stage: Stage = "kept"
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True)
class Kind:
    """A defect of one layout: `spoil(files or values, random)` is applied to a healthy recording."""

    name: str
    spoil: Callable[..., Any]
    reasons: tuple[str, ...]
    stage: Stage = "curate"
