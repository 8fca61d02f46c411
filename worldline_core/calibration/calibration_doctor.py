"""The calibration doctor: reads an episode under every usual mistake and names the one that explains what it shows.

From top to bottom: an episode is observed, read as it was recorded and under one mistake at a time, every reading is
scored by its evidence (`_Search`), and the scores decide (`_decide`); `diagnose_set` adds episodes up.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from functools import cached_property
from itertools import combinations

import numpy as np

from worldline_core.calibration.diagnosis import (
    CalibrationDoctorConfig,
    Diagnosis,
    Explanation,
    SetDiagnosis,
    VerdictName,
)
from worldline_core.calibration.image_evidence import (
    correlation_log_likelihood,
    gripper_terms,
    image_terms,
    inversion_gain,
    observable_views,
    turn_log_likelihood,
)
from worldline_core.calibration.measures import conventions_to_try, image_lags, notes_on, view_measures
from worldline_core.calibration.observation import Observation, observe
from worldline_core.calibration.pose_evidence import hand_eye_log_likelihood, pose_terms
from worldline_core.calibration.reading import Reading, read
from worldline_core.data.episodes.conventions import RecordedConventions
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.geometry.kinematics import ArmKinematics

DEFAULT_CONFIG = CalibrationDoctorConfig()
PAIRED_MISTAKES = 4
"""Of the mistakes that explain most alone, each two are tried together."""
MIN_TRAVEL_M = 0.02
"""A tool that moves less over the episode leaves no trace of a mistake."""
_NOTHING = Explanation(RecordedConventions(), 0.0, {})
_CAMERA_FIELDS = ("extrinsics", "camera_axes", "extrinsics_unit", "intrinsics_size")


def diagnose(
    episode: Episode,
    frames: Mapping[str, np.ndarray],
    kinematics: ArmKinematics | None,
    config: CalibrationDoctorConfig = DEFAULT_CONFIG,
) -> Diagnosis:
    """Whether an episode's calibration is consistent and, if not, which usual mistake explains it.

    Args:
        frames: images by view, uint8 (n, H, W, 3) RGB or (n, h, w) grey; views without images are judged by poses.
        kinematics: of the embodiment; None where unknown (tool poses must then be recorded).

    Returns:
        A diagnosis; verdict too_little_evidence where nothing can be compared.

    Raises:
        DataError: images or kinematics do not fit the episode.
    """
    observation = observe(episode, frames, kinematics)
    recorded = read(observation, RecordedConventions())
    if recorded is None or not episode.cameras:
        missing = "tool poses (no kinematics for its joints)" if recorded is None else "camera calibration"
        note = f"The recording has no {missing}: nothing can be compared"
        return Diagnosis(episode.episode_id, "too_little_evidence", _NOTHING, (_NOTHING,), (), (note,))
    search = _Search(observation, recorded, config)
    if config.search == "when_suspicious" and (quick := search.unsuspicious()) is not None:
        return Diagnosis(episode.episode_id, "consistent", quick, (quick,), (), ())
    none = search.none
    moves = float(np.linalg.norm(np.diff(recorded.tools[..., :3, 3], axis=0), axis=-1).sum(axis=0).max())
    measures = view_measures(observation, recorded, config)
    notes = notes_on(observation, recorded, measures, config)
    ranked = sorted([none, *search.singles()], key=lambda e: -e.score)
    best = ranked[0]
    if not _healthy(best, config) and not _healthy(none, config):
        beating = [pair for pair in search.pairs(ranked) if pair.score > best.score + config.min_margin]
        ranked = sorted([*ranked, *beating], key=lambda e: -e.score)
        best = ranked[0]
    verdict, best = _decide(none, best, config)
    if best.conventions.camera_lag_frames < 0 and recorded.action_tools is None:
        notes = (*notes, "The camera poses lead the states; they may follow the commands: give the kinematics to see")
    if verdict == "consistent" and moves < MIN_TRAVEL_M and not observable_views(observation, config):
        verdict = "too_little_evidence"
        notes = (*notes, "No tool moves and no picture changes: a mistake would leave no trace")
    return Diagnosis(episode.episode_id, verdict, best, tuple(ranked), measures, notes)


def diagnose_set(
    source: str, diagnoses: Iterable[Diagnosis], config: CalibrationDoctorConfig = DEFAULT_CONFIG
) -> SetDiagnosis:
    """One diagnosis for episodes that were written the same way: scores of the same reading are summed.

    Episodes in which a reading was not tried (it does not apply there) count as written. One episode speaks for or
    against a reading by `max_gain` at most: a few broken recordings do not make a habit of their source. Numbers that
    each episode estimates by itself (a tool offset) are taken together under their median. Pairs are left to single
    episodes.

    Args:
        diagnoses: made with search "always", so that the readings can be compared.
    """
    listed = [d for d in diagnoses if d.verdict != "too_little_evidence"]
    votes = Counter(d.best.mistake if d.verdict == "explained" else d.verdict for d in listed)
    if not listed:
        return SetDiagnosis(source, 0, "too_little_evidence", _NOTHING, (_NOTHING,), {}, ("No episode can be judged",))
    total_none = sum(d.none.score for d in listed)
    gains: dict[str, float] = defaultdict(float)
    members: dict[str, list[Explanation]] = defaultdict(list)
    for diagnosis in listed:
        tried: dict[str, Explanation] = {}
        for explanation in diagnosis.ranked:  # the best of each key comes first
            if len(explanation.conventions.departures) == 1:
                tried.setdefault(_set_key(explanation), explanation)
        for key, explanation in tried.items():
            gains[key] += float(np.clip(explanation.score - diagnosis.none.score, -config.max_gain, config.max_gain))
            members[key].append(explanation)
    ranked = [_summed([d.none for d in listed], total_none)]
    ranked += [_summed(members[key], total_none + gain) for key, gain in gains.items()]
    ranked.sort(key=lambda e: -e.score)
    best, none = ranked[0], next(e for e in ranked if e.mistake == "none")
    limit = config.min_margin + 0.5 * len(listed)
    verdict: VerdictName = "explained"
    if best.mistake == "none" or best.score - none.score < limit:
        verdict = "unexplained" if votes["unexplained"] > len(listed) / 2 else "consistent"
        best = none
    notes = tuple(dict.fromkeys(note for d in listed for note in d.notes))
    return SetDiagnosis(source, len(listed), verdict, best, tuple(ranked), dict(votes), notes)


def _set_key(explanation: Explanation) -> str:
    """Readings with the same key are the same over episodes, whatever tool offset each episode estimates."""
    if explanation.mistake == "tool_offset_z_m":
        return explanation.mistake
    return f"{explanation.mistake}: {getattr(explanation.conventions, explanation.mistake)}"


def _summed(members: list[Explanation], score: float) -> Explanation:
    """The common reading of several episodes."""
    evidence: dict[str, float] = defaultdict(float)
    for member in members:
        for name, value in member.evidence.items():
            evidence[name] += value
    conventions = Counter(member.conventions for member in members).most_common(1)[0][0]
    if members[0].mistake == "tool_offset_z_m":
        median = float(np.median([member.conventions.tool_offset_z_m for member in members]))
        conventions = conventions.model_copy(update={"tool_offset_z_m": round(median, 4)})
    return Explanation(conventions, score, dict(evidence))


class _Search:
    """One episode, read under the usual mistakes; every reading is scored."""

    def __init__(self, observation: Observation, recorded: Reading, config: CalibrationDoctorConfig) -> None:
        self.observation, self.recorded, self.config = observation, recorded, config
        self.recorded_poses = pose_terms(observation, recorded, config)

    def terms(self, reading: Reading, poses: Mapping[str, float] | None = None) -> dict[str, float]:
        """All evidence of a reading; `poses` where its pose terms are known, since lags of images do not change them."""
        return {
            **(pose_terms(self.observation, reading, self.config) if poses is None else poses),
            **image_terms(self.observation, reading, self.config),
            **gripper_terms(self.observation, reading, self.config),
        }

    def explain(self, reading: Reading, terms: dict[str, float]) -> Explanation:
        """A reading with its score: the sum of its terms, less what departing from the contract costs."""
        conventions = reading.conventions
        cost = self.config.complexity * (len(conventions.departures) + (conventions.views is not None) / 2)
        return Explanation(conventions, float(sum(terms.values())) - cost, terms)

    @cached_property
    def none(self) -> Explanation:
        """The recording as written."""
        return self.explain(self.recorded, self.terms(self.recorded, self.recorded_poses))

    def unsuspicious(self) -> Explanation | None:
        """The recording as written where nothing speaks against it, from what is quick to compute; else None."""
        observation, config = self.observation, self.config
        images = image_terms(observation, self.recorded, config, wrist_flow=False)
        found = self.explain(self.recorded, {**self.recorded_poses, **images})
        if min(self.recorded_poses.values(), default=0.0) < config.suspicion or not _healthy(found, config):
            return None
        if inversion_gain(observation, self.recorded, config) > 0:
            return None
        score = sum(images.values())
        for lag in image_lags(observation, config):
            other = image_terms(observation, self.recorded.with_image_lag(lag), config, wrist_flow=False)
            if sum(other.values()) > score:
                return None
        return found

    def read(self, conventions: RecordedConventions) -> Reading | None:
        """The episode under these conventions; None where they do not apply, or a lag leaves nothing of it."""
        try:
            return read(self.observation, conventions)
        except RejectedInputError:
            return None

    def singles(self) -> list[Explanation]:
        """Every usual mistake, one at a time."""
        tried = map(self.read, conventions_to_try(self.observation, self.recorded, self.config))
        found = [self.in_views_that_improve(reading) for reading in tried if reading is not None]
        lagging = [self.recorded.with_image_lag(lag) for lag in image_lags(self.observation, self.config)]
        return found + [self.explain(late, self.terms(late, self.recorded_poses)) for late in lagging]

    def in_views_that_improve(self, reading: Reading) -> Explanation:
        """The mistake in those views which it improves: one camera of a rig may be written unlike the others."""
        terms, none = self.terms(reading), self.none.evidence
        if reading.conventions.departures[0] not in _CAMERA_FIELDS:
            return self.explain(reading, terms)
        views = list(reading.cameras)
        better = [view for view in views if _of_view(terms, view) > _of_view(none, view) + 1.0]
        if not better or len(better) == len(views):
            return self.explain(reading, terms)
        others = [view for view in views if view not in better]
        merged = {name: none[name] if _view_of(name, others) else value for name, value in terms.items()}
        partial = self.read(reading.conventions.model_copy(update={"views": tuple(better)}))
        return self.explain(reading if partial is None else partial, merged)

    def pairs(self, ranked: list[Explanation]) -> list[Explanation]:
        """Two mistakes at once, of those that explain most alone."""
        first: dict[str, Explanation] = {}
        for explanation in ranked:
            if explanation.mistake != "none":
                first.setdefault(explanation.mistake, explanation)
        found = []
        for one, two in combinations(list(first.values())[:PAIRED_MISTAKES], 2):
            changed = {field: getattr(two.conventions, field) for field in two.conventions.departures}
            views = one.conventions.views if one.conventions.views == two.conventions.views else None
            reading = self.read(one.conventions.model_copy(update=changed | {"views": views}))
            if reading is not None:
                found.append(self.explain(reading, self.terms(reading)))
        return found


def _of_view(terms: Mapping[str, float], view: str) -> float:
    return sum(value for name, value in terms.items() if _view_of(name, [view]))


def _view_of(name: str, views: list[str]) -> bool:
    return any(name.endswith(f" {view}") for view in views)


def _healthy(explanation: Explanation, config: CalibrationDoctorConfig) -> bool:
    """Whether nothing measured is impossible for a good recording; noisy signs cannot veto."""
    return not bad_terms(explanation, config)


def bad_terms(explanation: Explanation, config: CalibrationDoctorConfig) -> dict[str, float]:
    """The terms that no healthy recording has."""
    limits = {
        "flow": correlation_log_likelihood(config.min_flow, config.arm_flow),
        "turn": turn_log_likelihood(config.max_flow_turn_deg, config),
        "hand-eye": hand_eye_log_likelihood(config.max_hand_eye_m, 0.0, config),
        **dict.fromkeys(("change", "wrist", "energy", "fingers", "finger"), -np.inf),
    }
    return {
        name: value
        for name, value in explanation.evidence.items()
        if value < limits.get(name.split(" ")[0], config.min_term)
    }


def _decide(none: Explanation, best: Explanation, config: CalibrationDoctorConfig) -> tuple[VerdictName, Explanation]:
    wins = best.mistake != "none" and best.score - none.score >= config.min_margin
    if wins and _healthy(best, config):
        return "explained", best
    if _healthy(none, config):
        return "consistent", none
    return "unexplained", none
