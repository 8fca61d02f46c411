"""Verdicts by the scores of an episode's readings, and by their sums over a source, whose episodes were written the same way."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Self

import numpy as np

from worldline_core.calibration.camera_errors import SQUARES_ALONE, SQUARES_TOGETHER, CameraError, combine
from worldline_core.calibration.evidence import (
    ARM_FLOW,
    correlation_log_likelihood,
    hand_eye_log_likelihood,
    turn_log_likelihood,
)
from worldline_core.data.episodes.conventions import RecordedConventions

VerdictName = Literal[
    "unexplained", "explained", "off", "mixed", "unreadable", "not_judged", "too_little_evidence", "consistent"
]
"""The worst first; unreadable episodes and those that could not be judged come from `check`."""

MIN_MARGIN = 2.5
"""Log-likelihood by which a mistake must beat the recording as written."""
MIN_TERM = -9.0
"""A term below this is bad: no healthy recording has one."""
SUSPICION = -4.0
"""A term below this starts the search."""
TERM_LIMITS = {
    "flow": correlation_log_likelihood(0.3, ARM_FLOW),
    "turn": turn_log_likelihood(35.0),
    "hand-eye": hand_eye_log_likelihood(0.012, 0.0),
    **dict.fromkeys(("change", "wrist", "energy", "fingers", "finger"), -np.inf),
}
"""By the first word of a term's name, where it is not MIN_TERM; noisy signs cannot veto."""
COMPLEXITY, VIEWS_COST = 2.0, 0.5
"""Cost of a reading for each departure from the contract, and for being of some views alone."""
RIVAL_MARGIN = 1.0
"""Another mistake with a score this near explains the recording as well."""
MAX_GAIN = 20.0
"""Most that one episode can contribute to a reading of its whole source."""
CONTRADICTING_SHARE = 0.1
"""Largest share of the episodes that fit by themselves which a reading of the whole source may break."""
FEWEST_SHOWING = 3
"""From this many episodes on, what one of them shows alone is not said of the source."""
FEWEST_TOGETHER = 5
"""From this many episodes on, their scatter measures their common uncertainty."""
ESTIMATED = {"intrinsics_size", "tool_offset_z_m", "embodiment"}
"""Tried only where an episode suggests them: one that fits as written and does not is evidence against them."""
NEAREST_SHOWN = 3
MAX_LAG_FRAMES = 6
"""Lags are tried up to this one, which explains nothing: the true one may be larger."""


@dataclass(frozen=True)
class Explanation:
    """One reading of the recording.

    Attributes:
        score: log-likelihood of all evidence; 0 is as in a healthy recording, lower is worse. Differences between readings
            of one episode are meaningful, and add up over episodes.
        evidence: the terms of an episode's score by name ("hand-eye left_wrist", ...); each at most 0.
        other: a mistake without a convention: ("embodiment", robot), ("wrist_extrinsics" or "wrist_videos", "exchanged").
    """

    conventions: RecordedConventions
    score: float
    evidence: Mapping[str, float]
    other: tuple[str, str] | None = None

    @property
    def departures(self) -> tuple[str, ...]:
        """Names of the mistakes."""
        return self.conventions.departures if self.other is None else (*self.conventions.departures, self.other[0])

    @property
    def mistake(self) -> str:
        """The departures joined by "+"; "none" for the recording as written."""
        return "+".join(self.departures) or "none"

    @property
    def text(self) -> str:
        """The departures with their values: "camera_axes: opengl, views: [head]"."""
        lines = [line.removeprefix(".") for line in self.conventions.config_lines("")]
        return ", ".join(lines if self.other is None else [*lines, ": ".join(self.other)]) or "as recorded"

    @property
    def lag_at_edge(self) -> bool:
        lags = self.conventions.camera_lag_frames, self.conventions.image_lag_frames
        return max(map(abs, lags)) >= MAX_LAG_FRAMES

    @property
    def key(self) -> frozenset[tuple[str, str]]:
        """Identity of the reading over episodes, with any tool offset that each of them estimates."""
        values = {name: str(getattr(self.conventions, name)) for name in self.conventions.departures}
        if "tool_offset_z_m" in values:
            values["tool_offset_z_m"] = ""
        if self.conventions.image_lag_frames and self.conventions.views is not None:
            values["views"] = str(self.conventions.views)
        return frozenset([*values.items(), *([] if self.other is None else [self.other])])


NOTHING_TRIED = Explanation(RecordedConventions(), 0.0, {})


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """Conclusion over an episode, or over a source; docs/calibration.md says what each verdict means.

    Attributes:
        best: the reading to believe; the recording as written unless the verdict is explained.
        ranked: all readings that were tried, best score first; of a source the one as written.
        notes: limits of the evidence, and other facts for a person.
        nearest: without an explanation, the best readings and what is most wrong under each.
        camera_errors: the error of each camera under `best` whose pictures show it; `off`: the significant ones.
        not_judged: by view, why its pictures say nothing.
        config_lines: what repairs it, in the source's configuration.
    """

    verdict: VerdictName
    best: Explanation = NOTHING_TRIED
    ranked: tuple[Explanation, ...] = (NOTHING_TRIED,)
    notes: tuple[str, ...] = ()
    nearest: tuple[str, ...] = ()
    camera_errors: tuple[CameraError, ...] = ()
    off: tuple[CameraError, ...] = ()
    not_judged: Mapping[str, str] = field(default_factory=dict)
    config_lines: tuple[str, ...] = ()

    @property
    def as_recorded(self) -> Explanation:
        return next(explanation for explanation in self.ranked if explanation.mistake == "none")

    def with_camera_errors(self, errors: tuple[CameraError, ...], *, together: bool = False) -> Self:
        """With the cameras' errors; consistent becomes `off` where one is significant (`together`: over a source), and
        `mixed` where the episodes of a source contradict each other."""
        least, verdict = SQUARES_TOGETHER if together else SQUARES_ALONE, self.verdict
        off = tuple(error for error in errors if error.squares > least)
        if verdict == "consistent":
            mixed = any(e.contradicting > tolerated_episodes(e.episodes) for e in errors)
            verdict = "mixed" if mixed else "off" if off else verdict
        return replace(self, verdict=verdict, camera_errors=errors, off=off)


@dataclass(frozen=True, kw_only=True)
class SourceDiagnosis(Diagnosis):
    """Conclusion over a source, with summed scores."""

    source: str
    num_episodes: int


def bad_terms(explanation: Explanation, as_recorded: Explanation | None = None) -> dict[str, float]:
    """The terms that no healthy recording has, by name. With `as_recorded` those of a departing explanation, which must leave
    nothing suspicious but what is tolerated as written and did not get worse."""
    bad = {}
    for name, value in explanation.evidence.items():
        kind = name.split(" ")[0]
        limit = TERM_LIMITS.get(kind, MIN_TERM)
        if as_recorded is not None:
            if value >= as_recorded.evidence.get(name, -np.inf) >= limit:
                continue
            limit = TERM_LIMITS.get(kind, SUSPICION)
        if value < limit:
            bad[name] = value
    return bad


def unjudged_gain(explanation: Explanation, as_recorded: Explanation) -> float:
    """Gain of a reading from views whose pictures say nothing; 0 where the recording as written is bad, which poses show alone."""
    if bad_terms(as_recorded):
        return 0.0
    views = [name.removeprefix("intrinsics ") for name in as_recorded.evidence if name.startswith("intrinsics ")]
    blind = tuple(f" {view}" for view in views if f"energy {view}" not in as_recorded.evidence)
    gains = ((name, value - as_recorded.evidence.get(name, value)) for name, value in explanation.evidence.items())
    return sum(max(0.0, gain) for name, gain in gains if name.endswith(blind))


def nearest_texts(ranked: Iterable[Explanation], as_recorded: Explanation) -> tuple[str, ...]:
    """The best readings without a common mistake, each with what is most wrong under it."""
    texts: list[str] = []
    shown: set[str] = set()
    for found in ranked:
        if found.score > as_recorded.score and not shown & set(found.departures):
            shown |= set(found.departures)
            bad = bad_terms(found, as_recorded)
            texts.append(f"{found.text}: still wrong {min(bad, key=lambda name: bad[name], default='nothing')}")
    return tuple(texts[:NEAREST_SHOWN])


def decide(as_recorded: Explanation, ranked: Sequence[Explanation]) -> tuple[VerdictName, Explanation, list[str]]:
    """The verdict, the reading to believe, and the mistakes that explain the recording equally well, if several do."""
    best, bad = ranked[0], bool(bad_terms(as_recorded))
    gain = best.score - as_recorded.score - unjudged_gain(best, as_recorded)
    if best is not as_recorded and gain >= MIN_MARGIN and not bad_terms(best, as_recorded):
        # Of mistakes that occur together, the one that explains most alone is compared with the others.
        alone = next((e for e in ranked if len(e.departures) == 1 and e.departures[0] in best.departures), best)
        near = [e for e in ranked if e is not as_recorded and e.score > alone.score - RIVAL_MARGIN]
        near = [e for e in near if not set(e.departures) & set(best.departures)]
        rivals = [e.text for e in near if len(best.departures) > 1 or not bad_terms(e, as_recorded)]
        # The same lag in some views alone: the pictures that it leaves out lose by it, if hardly.
        close = [e for e in ranked if best.departures == ("image_lag_frames",) and best.score - e.score < VIEWS_COST]
        some = [e for e in close if e.conventions.views is not None]
        in_doubt = [e.text for e in some if e.conventions.model_copy(update={"views": None}) == best.conventions]
        rivals += in_doubt
        if not rivals:
            return ("unexplained", as_recorded, []) if best.lag_at_edge else ("explained", best, [])
        if bad or in_doubt:
            return "unexplained", as_recorded, [best.text, *rivals]
    return "unexplained" if bad else "consistent", as_recorded, []


def tolerated_episodes(count: int) -> float:
    """Number of episodes of a source that may differ from the others: a tenth, and one of five."""
    return max(CONTRADICTING_SHARE * count, 1.0 if count >= FEWEST_TOGETHER else 0.0)


def diagnose_source(source: str, diagnoses: Sequence[Diagnosis]) -> SourceDiagnosis:
    """The reading of a source: better than the recordings as written, and healthy in most of them.

    One episode contributes MAX_GAIN at most for or against a reading: a few broken recordings are no habit of their
    source. A reading that breaks episodes which fit by themselves is not believed: such a source is mixed.
    """
    listed = [d for d in diagnoses if d.verdict != "too_little_evidence"]
    notes = tuple(dict.fromkeys(note for d in diagnoses for note in d.notes))
    if not listed:
        return SourceDiagnosis(verdict="too_little_evidence", notes=notes, source=source, num_episodes=0)
    count, verdicts = len(listed), Counter(d.verdict for d in listed)
    readings = _source_readings(listed)
    as_recorded = _summed([d.as_recorded for d in listed], sum(d.as_recorded.score for d in listed))
    sound = [r for r in readings if r.wins and r.contradicting <= CONTRADICTING_SHARE * count]
    sound = sorted(sound, key=lambda r: r.regret(sound))
    rivals = [r for r in sound[1:] if r.fits_like(sound[0], sound)]
    verdict: VerdictName = "mixed"
    best = as_recorded
    if sound and not rivals and not sound[0].tried[0].lag_at_edge:
        verdict, best = "explained", _summed(sound[0].tried, as_recorded.score + sound[0].gain)
    elif sound or verdicts["unexplained"] > count / 2:
        verdict = "unexplained"
    elif count - verdicts["consistent"] - verdicts["off"] <= tolerated_episodes(count):
        verdict = "consistent"
    nearest = _nearest(readings, count) if verdict == "unexplained" else ()
    in_none = {view: why for view, why in listed[0].not_judged.items() if all(view in d.not_judged for d in listed)}
    found = SourceDiagnosis(
        verdict=verdict, best=best, ranked=(as_recorded,), notes=notes, nearest=nearest, not_judged=in_none,
        source=source, num_episodes=count,
    )  # fmt: skip
    if best.other is not None:
        return found
    alike = [d.camera_errors for d in listed if d.best.conventions == best.conventions]
    return found.with_camera_errors(combine(alike), together=len(alike) >= FEWEST_TOGETHER)


_Key = frozenset[tuple[str, str]]
_ByKey = dict[_Key, Explanation]


class _SourceReading:
    """One reading over all episodes of a source: its `gain` over the recordings as written, and the numbers of episodes that are
    `healthy` under it, and that fit as written or under another reading but not under this one (`contradicting`)."""

    def __init__(self, key: _Key, listed: list[Diagnosis], by_key: list[_ByKey]) -> None:
        self.names = {name for name, _ in key}
        self.tried = [found[key] for found in by_key if key in found]
        tolerated = MIN_MARGIN + COMPLEXITY * len(key)
        self.scores: list[float] = []
        gains: list[float] = []
        self.healthy = self.contradicting = 0
        for diagnosis, found in zip(listed, by_key, strict=True):
            as_recorded = diagnosis.as_recorded
            own = found.get(key) or _instead_of(key, found)
            bad = bool(bad_terms(own, as_recorded))
            self.scores.append(own.score)
            gain = own.score - as_recorded.score - unjudged_gain(own, as_recorded)
            gains.append(float(np.clip(gain, -MAX_GAIN, MAX_GAIN)))
            self.healthy += not bad
            fits = diagnosis.verdict in ("consistent", "off")
            worse = fits and own.score < as_recorded.score - tolerated
            unseen = fits and self.names & ESTIMATED and key not in found
            bad_here = bad and (fits or diagnosis.verdict == "explained")
            self.contradicting += bool(worse or unseen or bad_here)
        self.gain, count = sum(gains), len(gains)
        alone = count >= FEWEST_SHOWING and self.gain - max(gains) < MIN_MARGIN  # one episode shows it, and no other
        self.wins = self.gain >= MIN_MARGIN + 0.5 * count and self.healthy > count / 2 and not alone

    def regret(self, others: list[_SourceReading]) -> float:
        """Score of the best of several readings above this one, summed over the episodes."""
        best = np.max([other.scores for other in others], axis=0)
        return float(np.minimum(best - self.scores, MAX_GAIN).sum())

    def fits_like(self, best: _SourceReading, others: list[_SourceReading]) -> bool:
        """True for another mistake that explains the episodes as well as the best one."""
        near = self.regret(others) - best.regret(others) < RIVAL_MARGIN * len(self.scores)
        return near and not self.names & best.names


def _instead_of(key: _Key, found: _ByKey) -> Explanation:
    """Substitute for a reading that was not tried in an episode: the largest part of it that was, since a mistake beside
    another leaves no trace there. For a lag the best other lag if it is worse than none: that lag was not worth trying."""
    part = max((tried for tried in found if tried <= key), key=lambda tried: (len(tried), found[tried].score))
    fields = {name for name, _ in key}
    others = [e for tried, e in found.items() if tried and {name for name, _ in tried} == fields]
    other = max(others, key=lambda e: e.score, default=found[part])
    return min(found[part], other, key=lambda e: e.score) if not part else found[part]


def _nearest(readings: list[_SourceReading], count: int) -> tuple[str, ...]:
    """The readings that are healthy in most episodes, then those with the best scores; one for each mistake."""
    best: dict[str, str] = {}
    for reading in sorted((r for r in readings if r.gain > 0), key=lambda r: (-r.healthy, r.regret(readings))):
        found = _summed(reading.tried, reading.gain)
        best.setdefault(found.mistake, f"{found.text}: healthy in {reading.healthy} of {count} episodes")
    return tuple(list(best.values())[:NEAREST_SHOWN])


def _source_readings(listed: list[Diagnosis]) -> list[_SourceReading]:
    """Every single mistake, and those together that explain some episode."""
    by_key: list[_ByKey] = []
    keys: dict[_Key, None] = {}
    for diagnosis in listed:
        found: _ByKey = {}
        for explanation in diagnosis.ranked:  # the best of each key comes first
            found.setdefault(explanation.key, explanation)
        by_key.append(found)
        keys |= {key: None for key, e in found.items() if len(key) == 1 or e is diagnosis.best}
    return [_SourceReading(key, listed, by_key) for key in keys if key]


def _summed(members: list[Explanation], score: float) -> Explanation:
    """The common reading of several episodes."""
    conventions = Counter(member.conventions for member in members).most_common(1)[0][0]
    if conventions.tool_offset_z_m:
        median = float(np.median([member.conventions.tool_offset_z_m for member in members]))
        conventions = conventions.model_copy(update={"tool_offset_z_m": round(median, 4)})
    return Explanation(conventions, score, {}, members[0].other)
