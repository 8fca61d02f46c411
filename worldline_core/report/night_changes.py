"""What changed since earlier nights: each metric compared with the last good night, and with several for slow drift; and
pictures of the recordings that lost most.

Where nights have scores by recording, losses are tested on the same recordings (`evaluation.paired`), all metrics and
questions together; the probability that any of them turns red on a night without a change is FALSE_ALARM:

- ``step``: against the last good night, the mean difference over recordings;
- ``level``: against the median of each recording over the last DRIFT_NIGHTS good nights, which has less noise of its own;
- ``drift``: the trend of each recording (least squares) over these nights and this one.

A loss smaller than the metric's margin does not count. Where a night has intervals only (older histories, metrics of all recordings
at once), a metric became worse when its mean left the interval of the good night.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.video.frames import VideoFrames
from worldline_core.evaluation.paired import PairedTest, Series, differences, margin_of, paired_tests, sign_of
from worldline_core.evaluation.recordings import HEAD, stride_of
from worldline_core.evaluation.scores import Interval
from worldline_core.pictures import SheetRow, contact_sheet, evenly_spaced, jpeg_bytes
from worldline_core.rollout.rollout_set import RolloutSet
from worldline_core.store.artifact_files import digest_value
from worldline_core.store.atomic import write_bytes_atomic

FALSE_ALARM = 0.02
DRIFT_NIGHTS = 7
LEAST_NIGHTS = 4
"""Level and drift are tested once there are so many good nights before this one."""
LOWER_IS_BETTER = ("lpips", "error", "seconds", "malformed", "fvd")


QUESTIONS = {
    "step": "",
    "level": f" beside the median of the last {DRIFT_NIGHTS} good nights",
    "drift": f" as a trend over the last {DRIFT_NIGHTS} good nights",
}


@dataclass(frozen=True)
class Tested:
    """One metric on the same recordings.

    Attributes:
        tests: by question; ``step`` always, the others from LEAST_NIGHTS good nights on.
        margin: a loss of less counts as none.
    """

    tests: Mapping[str, PairedTest]
    margin: float

    @property
    def worse_by(self) -> str | None:
        """The question with the most certain loss; None without a loss."""
        losses = [(t.p_worse, q) for q, t in self.tests.items() if t.p_worse <= FALSE_ALARM and -t.mean > self.margin]
        return min(losses)[1] if losses else None

    @property
    def better(self) -> bool:
        """Whether it is better than on the last good night."""
        return self.tests["step"].p_better <= FALSE_ALARM and self.tests["step"].mean > self.margin

    @property
    def shown(self) -> tuple[str, PairedTest]:
        """The question that decides the verdict, and its test."""
        question = self.worse_by or "step"
        return question, self.tests[question]


@dataclass(frozen=True)
class Change:
    """One metric beside the last good night; None where one of the two did not measure it."""

    metric: str
    present: Interval | None
    previous: Interval | None
    tested: Tested | None = None

    @property
    def verdict(self) -> Literal["better", "worse", "same", "new", "missing"]:
        """Better or worse only where chance does not explain it."""
        if self.previous is None:
            return "new"
        if self.present is None:
            return "missing"
        if self.tested is not None:
            return "worse" if self.tested.worse_by else "better" if self.tested.better else "same"
        if self.previous.low <= self.present.mean <= self.previous.high:
            return "same"
        fell = self.present.mean < self.previous.low
        return "better" if fell == any(word in self.metric for word in LOWER_IS_BETTER) else "worse"

    @property
    def worst(self) -> tuple[tuple[str, float], ...]:
        """The recordings that lost most, where the metric became worse and they are known."""
        return self.tested.shown[1].worst if self.tested and self.tested.worse_by else ()

    def __str__(self) -> str:
        """What became worse, by how much, and where most."""
        if self.tested is None or self.tested.worse_by is None:
            return f"{self.metric} ({self.verdict})"
        question, test = self.tested.shown
        worst = ", ".join(f"{recording} ({value:+.3f})" for recording, value in test.worst)
        interval = f"{test.mean:+.3f} [{test.low:+.3f}, {test.high:+.3f}]{QUESTIONS[question]}"
        return f"{self.metric}: {interval} on {test.count} recordings, most on {worst}"


@dataclass(frozen=True)
class NightlyComparison:
    """The present night against the last good one before it.

    Attributes:
        pictures: files that show the worst recordings, by recording and method.
    """

    night: str
    previous: str | None
    changes: Sequence[Change]
    pictures: Mapping[str, str] = field(default_factory=dict)

    @property
    def worse(self) -> list[Change]:
        """What became worse, or is not measured any more."""
        return [change for change in self.changes if change.verdict in ("worse", "missing")]

    @property
    def regressions(self) -> list[str]:
        """Names of what became worse, or is not measured any more."""
        return [change.metric for change in self.worse]


def compare_series(present: Series, earlier: Sequence[Series]) -> dict[str, Tested]:
    """Tests of every metric that this and the last good night have scores of by recording.

    Args:
        earlier: the good nights before the present one, oldest first, at least one.
    """
    asked = {"step": differences(present, earlier[-1])}
    if len(earlier) >= LEAST_NIGHTS:
        several = earlier[-DRIFT_NIGHTS:]
        asked |= {"level": differences(present, medians(several)), "drift": trends([*several, present])}
    tests = paired_tests({f"{q}:{name}": values for q, found in asked.items() for name, values in found.items()})
    return {
        name: Tested({q: tests[f"{q}:{name}"] for q in asked if f"{q}:{name}" in tests}, margin_of(name))
        for name in asked["step"]
        if f"step:{name}" in tests
    }


def _shared(nights: Sequence[Series]) -> Iterator[tuple[str, list[str]]]:
    """Series that all nights have, with the recordings that all have of it."""
    for name in sorted(set[str].intersection(*(set(night) for night in nights))):
        recordings = sorted(set[str].intersection(*(set(night[name]) for night in nights)))
        if recordings:
            yield name, recordings


def medians(nights: Sequence[Series]) -> Series:
    """The median of each recording over several nights."""
    return {
        name: {r: float(np.median([night[name][r] for night in nights])) for r in recordings}
        for name, recordings in _shared(nights)
    }


def trends(nights: Sequence[Series]) -> Series:
    """What each recording gained from the first to the last of several nights, by a line through its values."""
    time = np.linspace(-1.0, 1.0, len(nights))
    weights = 2 * time / (time**2).sum()
    return {
        name: {r: sign_of(name) * float(weights @ [night[name][r] for night in nights]) for r in recordings}
        for name, recordings in _shared(nights)
    }


PICTURES = "pictures"
MOST_PICTURES = 4
MOMENTS = 6


def write_night_pictures(history: Path, compared: NightlyComparison, artifacts: Mapping[str, Path]) -> dict[str, str]:
    """Head views of the recordings that lost most, or of the first recording of each method when none did.

    Args:
        artifacts: ``filter`` (the episodes) and ``rollout.<method>``; without them there are no pictures.

    Returns:
        files below ``history`` by what they show; those of the night before are removed.
    """
    shutil.rmtree(history / PICTURES, ignore_errors=True)
    rollouts = {
        name.partition(".")[2]: RolloutSet.open(path) for name, path in artifacts.items() if name.startswith("rollout.")
    }
    if "filter" not in artifacts or not rollouts:
        return {}
    episodes = EpisodeSet.open(artifacts["filter"])
    recorded = {row.episode_id for row in episodes.rows}
    written: dict[str, str] = {}
    for method, recording in _wanted(compared, rollouts):
        rollout = rollouts.get(method)
        what = f"{recording}, {method}"
        if rollout is None or recording not in recorded or what in written or len(written) == MOST_PICTURES:
            continue
        if HEAD not in rollout.views(recording):
            continue
        predicted, position = VideoFrames(rollout.clip(recording, HEAD)), episodes.position(recording)
        moments = evenly_spaced(len(predicted), MOMENTS)
        stride = stride_of(rollout, episodes.rows[position])
        true = episodes.frames(position, HEAD, [stride * moment for moment in moments])
        rows = [SheetRow("recorded", true), SheetRow(f"predicted by {method}", predicted[moments])]
        file = f"{PICTURES}/{digest_value([compared.night, what])[:16]}.jpg"
        write_bytes_atomic(history / file, jpeg_bytes(contact_sheet(rows, title=f"{compared.night}: {recording}")))
        written[what] = file
    return written


def _wanted(compared: NightlyComparison, rollouts: Mapping[str, RolloutSet]) -> Iterator[tuple[str, str]]:
    """(method, recording) of the losses; without any, the first recording of each method."""
    lost = [(change.metric.split("/")[2], recording) for change in compared.worse for recording, _ in change.worst]
    yield from lost or [(method, rollout.episode_ids[0]) for method, rollout in rollouts.items()]
