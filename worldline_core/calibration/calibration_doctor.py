"""The calibration doctor: reads an episode under every usual mistake and names the one that explains what it shows.

From top to bottom: an episode is observed, read as it was recorded and under one mistake at a time, every reading is
scored by its evidence (`_Search`), and the scores decide (`verdict`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property, lru_cache

import numpy as np

from worldline_core.calibration.diagnosis import CalibrationDoctorConfig, Diagnosis, Explanation
from worldline_core.calibration.image_evidence import gripper_terms, image_terms, inversion_gain, observable_views
from worldline_core.calibration.measures import (
    camera_lags,
    conventions_to_try,
    image_lags,
    notes_on,
    tool_offset,
    view_measures,
)
from worldline_core.calibration.observation import Observation, arms_of, observe
from worldline_core.calibration.pose_evidence import pose_terms
from worldline_core.calibration.reading import Reading, read
from worldline_core.calibration.residual import with_residuals
from worldline_core.calibration.verdict import bad_terms, decide, limits, nearest_texts
from worldline_core.data.episodes.conventions import RecordedConventions
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.errors import ConfigError, UnavailableError
from worldline_core.geometry.embodiment import Embodiment, embodiment_names, load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics

DEFAULT_CONFIG = CalibrationDoctorConfig()
PAIRED_MISTAKES = 4
"""So many of the mistakes that explain most alone are tried together with others."""
MIN_TRAVEL_M = 0.02
"""A tool that moves less over the episode leaves no trace of a mistake."""
NOTHING = Explanation(RecordedConventions(), 0.0, {})
WHAT_TO_DO = {
    "embodiment": "The recording fits {0}, not the declared {1}: name the robot that it is of",
    "wrist_extrinsics": "Each wrist camera has the other's extrinsics: exchange the two where the source is written",
    "wrist_videos": "Each wrist video is the other hand's: exchange the two where the source is written",
}
EXCHANGED_DOUBT = 3.0
"""Wrist videos that fit worse by more when they change places are each its own hand's."""
_CAMERA_FIELDS = ("extrinsics", "camera_axes", "extrinsics_unit", "intrinsics_size")


def diagnose(
    episode: Episode,
    frames: Mapping[str, Iterable[np.ndarray]],
    kinematics: ArmKinematics | None,
    config: CalibrationDoctorConfig = DEFAULT_CONFIG,
) -> Diagnosis:
    """Whether an episode's calibration is consistent and, if not, which usual mistake explains it.

    Args:
        frames: images by view, uint8 (H, W, 3) RGB or (h, w) grey, gone through once; views without images are judged by poses.
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
        return Diagnosis(episode.episode_id, "too_little_evidence", NOTHING, (NOTHING,), (), (note,))
    search = _Search(observation, recorded, config)
    if config.search == "when_suspicious" and (quick := search.unsuspicious()) is not None:
        quickly = Diagnosis(episode.episode_id, "consistent", quick, (quick,), (), ())
        return with_residuals(quickly, observation, recorded, config)
    none = search.none
    moves = float(np.linalg.norm(np.diff(recorded.tools[..., :3, 3], axis=0), axis=-1).sum(axis=0).max())
    measures = view_measures(observation, recorded, config)
    notes = notes_on(observation, recorded, measures, config)
    ranked = sorted([none, *search.singles()], key=lambda e: -e.score)
    if bad_terms(none, config):
        if search.residual(ranked[0]):
            beating = [pair for pair in search.pairs(ranked) if pair.score > ranked[0].score + config.min_margin]
            ranked = sorted([*ranked, *beating], key=lambda e: -e.score)
        if bad_terms(ranked[0], config, none):
            ranked = sorted([*ranked, *search.other_robots()], key=lambda e: -e.score)
    verdict, best, rivals = decide(none, ranked, config)
    if rivals:
        notes = (*notes, f"These explain it equally well, nothing recorded tells which: {'; '.join(rivals)}")
    if best.other is not None:
        notes = (*notes, WHAT_TO_DO[best.other[0]].format(best.other[1], episode.embodiment))
    if best.conventions.camera_lag_frames < 0 and recorded.action_tools is None:
        notes = (*notes, "The camera poses lead the states; they may follow the commands: give the kinematics to see")
    if verdict == "consistent" and moves < MIN_TRAVEL_M and not observable_views(observation, config):
        verdict = "too_little_evidence"
        notes = (*notes, "No tool moves and no picture changes: a mistake would leave no trace")
    nearest = nearest_texts(ranked, none, config) if verdict == "unexplained" else ()
    diagnosis = Diagnosis(episode.episode_id, verdict, best, tuple(ranked), measures, notes, nearest)
    reading = search.read(best.conventions) if best.other is None else None
    return diagnosis if reading is None else with_residuals(diagnosis, observation, reading, config)


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

    def explain(self, reading: Reading, terms: dict[str, float], other: tuple[str, str] | None = None) -> Explanation:
        """A reading with its score: the sum of its terms, less what departing from the contract costs."""
        found = Explanation(reading.conventions, float(sum(terms.values())), terms, other)
        cost = self.config.complexity * (len(found.departures) + (reading.conventions.views is not None) / 2)
        return replace(found, score=found.score - cost)

    @cached_property
    def none(self) -> Explanation:
        """The recording as written."""
        return self.explain(self.recorded, self.terms(self.recorded, self.recorded_poses))

    def unsuspicious(self) -> Explanation | None:
        """The recording as written where nothing speaks against it, from what is quick to compute; else None."""
        observation, config = self.observation, self.config
        images = image_terms(observation, self.recorded, config, wrist_flow=False)
        found = self.explain(self.recorded, {**self.recorded_poses, **images})
        if min(self.recorded_poses.values(), default=0.0) < config.suspicion or bad_terms(found, config):
            return None
        if inversion_gain(observation, self.recorded, config) > 0:
            return None
        score = sum(images.values())
        for lag in image_lags(observation, config):
            other = image_terms(observation, self.recorded.with_image_lag(lag), config, wrist_flow=False)
            if sum(other.values()) > score:
                return None
        return None if self.fits_exchanged_wrists(images) else found

    def fits_exchanged_wrists(self, images: Mapping[str, float]) -> bool:
        """Whether the pictures fit better if the wrist videos change places; flow is compared where the rest leaves doubt.

        Args:
            images: the image terms as recorded, without the flow in wrist views.
        """
        exchanged = self.observation.with_exchanged_wrists()
        if exchanged is None:
            return False
        quick = image_terms(exchanged, self.recorded, self.config, wrist_flow=False)
        if sum(quick.values()) < sum(images.values()) - EXCHANGED_DOUBT:
            return False
        both = (image_terms(o, self.recorded, self.config) for o in (exchanged, self.observation))
        gain, written = (sum(terms.values()) for terms in both)
        return gain > written

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
        found += [self.explain(late, self.terms(late, self.recorded_poses)) for late in lagging]
        return [*found, *self.exchanged_wrist_cameras()]

    def exchanged_wrist_cameras(self) -> Iterator[Explanation]:
        """Two wrist cameras that bear each other's poses, or each other's videos; rarer than exchanged arms, and where
        there are no pictures as rigid."""
        views = [arm.wrist_view for arm in self.observation.arms]
        episode = self.observation.episode
        if len(views) != 2 or not all(view in episode.cameras for view in views):
            return
        one, two = (episode.cameras[view] for view in views)
        cameras = {
            views[0]: replace(one, T_base_camera=two.T_base_camera),
            views[1]: replace(two, T_base_camera=one.T_base_camera),
        }
        exchanged = replace(episode, cameras=dict(episode.cameras) | cameras)
        read_so = {"wrist_extrinsics": replace(self.observation, episode=exchanged, _stands={})}
        if (videos := self.observation.with_exchanged_wrists()) is not None:
            read_so["wrist_videos"] = videos
        for name, observation in read_so.items():
            other = _Search.of(observation, self.config)
            if other is not None:
                yield self.explain(other.recorded, dict(other.none.evidence), (name, "exchanged"))

    def other_robots(self) -> Iterator[Explanation]:
        """The recording as written, of another robot than declared: those with the same arms, if it has joints.

        What another robot's description does not state (the mount of a camera) counts as for the declared one.
        """
        observation, kinematics = self.observation, self.observation.kinematics
        if kinematics is None or observation.episode.state_kind != "joints":
            return
        for robot in robots_like(_layout(kinematics.embodiment)):
            name = robot.embodiment.name
            if name == kinematics.embodiment.name:
                continue
            episode = replace(observation.episode, embodiment=name)
            arms = arms_of(episode, robot)
            other = _Search.of(replace(observation, episode=episode, arms=arms, kinematics=robot), self.config)
            if other is not None:
                found = self.explain(other.recorded, dict(other.none.evidence), ("embodiment", name))
                unknown = sum(value for term, value in self.none.evidence.items() if term not in found.evidence)
                yield replace(found, score=found.score + unknown)

    @classmethod
    def of(cls, observation: Observation, config: CalibrationDoctorConfig) -> _Search | None:
        """Of a recording as written; None where no tool poses are known."""
        recorded = read(observation, RecordedConventions())
        return None if recorded is None else cls(observation, recorded, config)

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

    def residual(self, explanation: Explanation) -> bool:
        """Whether a reading leaves anything suspicious."""
        judged = limits(self.config)
        return any(
            value < self.config.suspicion and judged.get(name.split(" ")[0], 0.0) > -np.inf
            for name, value in explanation.evidence.items()
        )

    def pairs(self, ranked: list[Explanation]) -> list[Explanation]:
        """Two mistakes at once: one of those that explain most alone, and what is found where it is undone.

        A lag or an offset cannot be estimated before the other mistake is undone. States that are late against both
        camera poses and images count as one mistake, with two lags.
        """
        first: dict[str, Explanation] = {}
        for explanation in ranked:
            if explanation.mistake != "none" and explanation.other is None:
                first.setdefault(explanation.mistake, explanation)
        ones = list(first.values())[:PAIRED_MISTAKES]
        found: dict[RecordedConventions, Explanation] = {}
        for number, one in enumerate(ones):
            undone = self.read(one.conventions)
            if undone is None:
                continue
            others = [two.conventions for two in ones[number + 1 :]]
            for conventions in (*others, *self.numbers_beside(undone)):
                both = _together(one.conventions, conventions)
                reading = None if both is None or both in found else self.read(both)
                if both is not None and reading is not None:
                    found[both] = self.explain(reading, self.terms(reading))
        return list(found.values())

    def numbers_beside(self, undone: Reading) -> Iterator[RecordedConventions]:
        """Lags and offset as they are estimated under a reading that undoes another mistake."""
        lags = camera_lags(self.observation, undone, self.config)
        yield from (RecordedConventions(camera_lag_frames=lag) for lag in lags)
        yield from (RecordedConventions(camera_lag_frames=lag, image_lag_frames=lag) for lag in lags)
        scores = {
            lag: sum(image_terms(self.observation, undone.with_image_lag(lag), self.config, wrist_flow=False).values())
            for lag in (0, *image_lags(self.observation, self.config))
        }
        if late := max(scores, key=lambda lag: (scores[lag], -abs(lag))):
            yield RecordedConventions(image_lag_frames=late)
        if offset := tool_offset(self.observation, undone):
            yield RecordedConventions(tool_offset_z_m=round(offset, 4))


def _together(one: RecordedConventions, two: RecordedConventions) -> RecordedConventions | None:
    """Both mistakes; None where they are of the same field, or no declaration can name the views of each."""
    if set(one.departures) & set(two.departures):
        return None
    of_cameras = [c.views for c in (one, two) if set(c.departures) & set(_CAMERA_FIELDS)]
    if len(of_cameras) == 2 and of_cameras[0] != of_cameras[1]:
        return None
    changed = {field: getattr(two, field) for field in two.departures}
    return one.model_copy(update=changed | {"views": of_cameras[0] if of_cameras else None})


def _layout(embodiment: Embodiment) -> tuple[tuple[str, int], ...]:
    return tuple((arm.camera_view, len(arm.joints)) for arm in embodiment.arms)


@lru_cache(maxsize=4)
def robots_like(layout: tuple[tuple[str, int], ...]) -> tuple[ArmKinematics, ...]:
    """The robots with these arms (view of the wrist camera, number of joints) whose descriptions are here."""
    found = []
    for name in embodiment_names():
        try:
            embodiment = load_embodiment(name)
            if _layout(embodiment) == layout:
                found.append(ArmKinematics(embodiment))
        except (ConfigError, UnavailableError):  # a package without its description, or none at all
            continue
    return tuple(found)


def _of_view(terms: Mapping[str, float], view: str) -> float:
    return sum(value for name, value in terms.items() if _view_of(name, [view]))


def _view_of(name: str, views: list[str]) -> bool:
    return any(name.endswith(f" {view}") for view in views)
