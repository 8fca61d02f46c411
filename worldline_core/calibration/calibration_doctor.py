"""The calibration doctor: an episode is read as recorded and under every usual mistake, every reading is scored by its evidence,
and the mistake that explains the recording is named. Lags, an image size and a tool offset are estimated first.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import cached_property, lru_cache

import numpy as np

from worldline_core.calibration.camera_errors import estimate_camera_errors
from worldline_core.calibration.diagnosis import (
    COMPLEXITY,
    MAX_LAG_FRAMES,
    MIN_MARGIN,
    SUSPICION,
    TERM_LIMITS,
    VIEWS_COST,
    Diagnosis,
    Explanation,
    bad_terms,
    decide,
    nearest_texts,
    unjudged_gain,
)
from worldline_core.calibration.evidence import (
    WORST_TERM,
    frozen_views,
    gripper_terms,
    hand_eye,
    image_terms,
    not_judged,
    observable_views,
    pose_terms,
)
from worldline_core.calibration.observation import Observation, Reading, arms_of, observe, read
from worldline_core.data.episodes.conventions import RecordedConventions, applicable
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.errors import ConfigError, UnavailableError
from worldline_core.geometry.embodiment import Embodiment, embodiment_names, load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.transforms import rigid_inverse

PAIRED_MISTAKES = 4
"""Number of the best single mistakes that are also tried in pairs."""
MIN_TRAVEL_M = 0.02
"""A tool that moves less over the episode leaves no trace of a mistake."""
INTRINSICS_SNAP, SAME_INTRINSICS_SIZE = 0.02, 0.1
"""Relative distance within which a usual image size is taken; log distance within which the size is as recorded."""
MIN_TOOL_OFFSET_M, MAX_TOOL_OFFSET_M = 0.01, 0.5
REMEDIES = {
    "embodiment": "The recording fits {0}, not the declared {1}: name the robot that it is of",
    "wrist_extrinsics": "Each wrist camera has the other's extrinsics: exchange the two where the source is written",
    "wrist_videos": "Each wrist video is the other hand's: exchange the two where the source is written",
}
_FIXED_MISTAKES = tuple(RecordedConventions.model_validate({field: value}) for field, value in (
    ("extrinsics", "base_to_camera"), ("camera_axes", "opengl"), ("extrinsics_unit", "mm"), ("pose_unit", "mm"),
    ("quaternion", "wxyz"), ("euler", "moving_xyz"), ("angle_unit", "deg"), ("arms", "exchanged"), ("gripper", "inverted"),
))  # fmt: skip
_CAMERA_FIELDS = ("extrinsics", "camera_axes", "extrinsics_unit", "intrinsics_size")
_COMMON_SIZES = (
    (1080, 1920), (1200, 1920), (720, 1280), (800, 1280), (960, 1280), (768, 1024), (600, 960), (600, 800), (540, 960),
    (480, 848), (480, 640), (400, 640), (384, 640), (360, 640), (384, 512), (270, 480), (240, 424), (240, 320),
    (192, 320), (180, 320), (256, 256), (224, 224), (128, 128), (120, 160), (128, 192), (96, 128), (64, 96),
)  # fmt: skip


def diagnose(
    episode: Episode,
    frames: Mapping[str, Iterable[np.ndarray]],
    kinematics: ArmKinematics | None,
    *,
    quick: bool = False,
) -> Diagnosis:
    """Diagnose an episode: its calibration is consistent, or a usual mistake explains it.

    Args:
        frames: images by view, uint8 (H, W, 3) RGB or (h, w) grey, gone through once; views without images are judged by poses.
        kinematics: of the embodiment; None where unknown (tool poses must then be recorded).
        quick: try other readings only if the recorded one looks suspicious.

    Raises: DataError: images or kinematics do not fit the episode.
    """
    observation = observe(episode, frames, kinematics)
    recorded = read(observation, RecordedConventions())
    if recorded is None or not episode.cameras:
        missing = "tool poses (no kinematics for its joints)" if recorded is None else "camera calibration"
        notes = (f"The recording has no {missing}: nothing can be compared",)
        return Diagnosis(verdict="too_little_evidence", notes=notes)
    search, blind = _Search(observation, recorded), not_judged(observation)
    if quick and (fine := search.unsuspicious()) is not None:
        diagnosis = Diagnosis(verdict="consistent", best=fine, ranked=(fine,), not_judged=blind)
        return diagnosis.with_camera_errors(estimate_camera_errors(observation, recorded))
    as_recorded, judged = search.as_recorded, gripper_terms(observation, recorded)
    notes = [] if judged else ["no gripper is seen to move: polarity is not judged"]
    ranked = sorted([as_recorded, *search.singles()], key=lambda e: -e.score)
    if bad_terms(as_recorded):
        limits = ((value, TERM_LIMITS.get(name.split(" ")[0], 0.0)) for name, value in ranked[0].evidence.items())
        if any(value < SUSPICION and limit > -np.inf for value, limit in limits):
            beating = [pair for pair in search.pairs(ranked) if pair.score > ranked[0].score + MIN_MARGIN]
            ranked = sorted([*ranked, *beating], key=lambda e: -e.score)
        if bad_terms(ranked[0], as_recorded):
            ranked = sorted([*ranked, *search.other_robots()], key=lambda e: -e.score)
    verdict, best, rivals = decide(as_recorded, ranked)
    if ranked[0].lag_at_edge and verdict == "unexplained":
        notes.append(f"{ranked[0].text}: at the edge of what is tried; the lag may be larger")
    if verdict == "unexplained":
        notes += [f"{view}: its pictures stay the same while its arm moves" for view in search.frozen]
    near = ranked[0] if verdict == "consistent" and ranked[0].score - as_recorded.score >= MIN_MARGIN else best
    if near is not best and unjudged_gain(near, as_recorded) > 0.0:
        notes.append(f"{near.text} would fit the poses better; without pictures this is not judged")
    if rivals:
        notes.append(f"These explain it equally well, nothing recorded tells which: {'; '.join(rivals)}")
    if best.other is not None:
        notes.append(REMEDIES[best.other[0]].format(best.other[1], episode.embodiment))
    if near.conventions.camera_lag_frames < 0 and recorded.action_tools is None:
        notes.append("The camera poses lead the states; they may follow the commands: give the kinematics to see")
    travel = np.linalg.norm(np.diff(recorded.tools[..., :3, 3], axis=0), axis=-1).sum(axis=0).max()
    if verdict == "consistent" and travel < MIN_TRAVEL_M and not observable_views(observation):
        verdict = "too_little_evidence"
        notes.append("No tool moves and no picture changes: a mistake would leave no trace")
    nearest = nearest_texts(ranked, as_recorded) if verdict == "unexplained" else ()
    diagnosis = Diagnosis(
        verdict=verdict, best=best, ranked=tuple(ranked), notes=tuple(notes), nearest=nearest, not_judged=blind
    )
    reading = search.read(best.conventions) if best.other is None else None
    return diagnosis if reading is None else diagnosis.with_camera_errors(estimate_camera_errors(observation, reading))


def all_terms(observation: Observation, reading: Reading, poses: Mapping[str, float] | None = None) -> dict[str, float]:
    """All evidence of a reading by name; `poses` where its pose terms are known, since image lags do not change them."""
    terms = dict(pose_terms(observation, reading) if poses is None else poses)
    terms |= image_terms(observation, reading) | gripper_terms(observation, reading)
    return terms | {f"frozen {view}": WORST_TERM for view in frozen_views(observation, reading)}


class _Search:
    """One episode, read under the usual mistakes; every reading is scored."""

    def __init__(self, observation: Observation, recorded: Reading) -> None:
        self.observation, self.recorded = observation, recorded
        self.frozen = frozen_views(observation, recorded)
        self.recorded_poses = pose_terms(observation, recorded)

    def explain(
        self, conventions: RecordedConventions, terms: dict[str, float], other: tuple[str, str] | None = None
    ) -> Explanation:
        """A reading with its score: the sum of its terms, less the cost of departing from the contract."""
        departures = len(conventions.departures) + (other is not None)
        cost = COMPLEXITY * departures + VIEWS_COST * (conventions.views is not None)
        # That no video is frozen in a reading is no gain: the picture of an arm that rests stays the same.
        thawed = len(self.frozen) - sum(name.startswith("frozen ") for name in terms)
        cost -= WORST_TERM * max(0, thawed)
        return Explanation(conventions, float(sum(terms.values())) - cost, terms, other)

    @cached_property
    def as_recorded(self) -> Explanation:
        return self.explain(RecordedConventions(), all_terms(self.observation, self.recorded, self.recorded_poses))

    def unsuspicious(self) -> Explanation | None:
        """The recording as written if no cheap evidence speaks against it, else None."""
        observation = self.observation
        if self.frozen:
            return None
        images = image_terms(observation, self.recorded, wrist_flow=False)
        found = self.explain(RecordedConventions(), {**self.recorded_poses, **images})
        if min(self.recorded_poses.values(), default=0.0) < SUSPICION or bad_terms(found):
            return None
        if (inverted := self.read(RecordedConventions(gripper="inverted"))) is not None:
            written, other = (sum(gripper_terms(observation, each).values()) for each in (self.recorded, inverted))
            if other > written:
                return None
        for lag in image_lags(observation):
            other = image_terms(observation, self.recorded.with_image_lag(lag), wrist_flow=False)
            gains = [_of_view(other, view) - _of_view(images, view) for view in self.recorded.cameras]
            if sum(other.values()) > sum(images.values()) or max(gains) > MIN_MARGIN:
                return None
        if (exchanged := observation.with_exchanged_wrists()) is not None:
            other, own = (sum(image_terms(each, self.recorded).values()) for each in (exchanged, observation))
            if other > own:
                return None
        return found

    def read(self, conventions: RecordedConventions) -> Reading | None:
        """The episode under these conventions; None where they do not apply."""
        with suppress(RejectedInputError):
            return read(self.observation, conventions)
        return None

    def singles(self) -> list[Explanation]:
        """Every usual mistake, one at a time."""
        observation, recorded = self.observation, self.recorded
        tried = [c for c in _FIXED_MISTAKES if applicable(observation.episode, c.departures[0])]
        tried += [RecordedConventions(intrinsics_size=size) for size in intrinsics_sizes(observation.episode.cameras)]
        tried += [RecordedConventions(camera_lag_frames=lag) for lag in camera_lags(observation, recorded)]
        tried += [RecordedConventions(tool_offset_z_m=offset) for offset in tool_offset(observation, recorded)]
        found = [self.in_views_that_improve(reading) for reading in map(self.read, tried) if reading is not None]
        lagging = [recorded.with_image_lag(lag) for lag in image_lags(observation)]
        found += [each for late in lagging for each in self.lags_by_view(late)]
        return [*found, *self.exchanged_wrist_cameras()]

    def lags_by_view(self, late: Reading) -> Iterator[Explanation]:
        """A lag of all pictures, and of those views alone whose own pictures fit better with it."""
        terms, written = all_terms(self.observation, late, self.recorded_poses), self.as_recorded.evidence
        yield self.explain(late.conventions, terms)
        views = [view for view in late.cameras if view in self.observation.gray]
        gains = {view: _of_view(terms, view) - _of_view(written, view) for view in views}
        better = [(view,) for view in views if gains[view] > 1.0]
        clearly = tuple(view for view in views if gains[view] > MIN_MARGIN)
        for chosen in dict.fromkeys([*better, clearly]):
            if chosen and len(chosen) < len(views):
                conventions = late.conventions.model_copy(update={"views": chosen})
                yield self.explain(conventions, _exchanged(written, terms, chosen))

    def exchanged_wrist_cameras(self) -> Iterator[Explanation]:
        """Two wrist cameras with each other's poses, or each other's videos."""
        views = [arm.wrist_view for arm in self.observation.arms]
        episode = self.observation.episode
        if len(views) != 2 or not all(view in episode.cameras for view in views):
            return
        poses = {one: episode.cameras[two].T_base_camera for one, two in (views, views[::-1])}
        cameras = {view: replace(episode.cameras[view], T_base_camera=each) for view, each in poses.items()}
        exchanged = replace(episode, cameras=episode.cameras | cameras)
        yield from self.as_written(replace(self.observation, episode=exchanged), ("wrist_extrinsics", "exchanged"))
        if (videos := self.observation.with_exchanged_wrists()) is not None:
            yield from self.as_written(videos, ("wrist_videos", "exchanged"))

    def as_written(self, observation: Observation, other: tuple[str, str]) -> Iterator[Explanation]:
        """The reading of another observation as written; none where no tool poses are known."""
        if (reading := read(observation, RecordedConventions())) is not None:
            yield self.explain(reading.conventions, all_terms(observation, reading), other)

    def other_robots(self) -> Iterator[Explanation]:
        """The recording as written, with the other robots that have the same arms, if it has joints.

        Terms that another robot's description does not determine (the mount of a camera) are those of the declared one.
        """
        observation, kinematics = self.observation, self.observation.kinematics
        if kinematics is None or observation.episode.state_kind != "joints":
            return
        for robot in robots_like(_layout(kinematics.embodiment)):
            name = robot.embodiment.name
            if name == kinematics.embodiment.name:
                continue
            episode = replace(observation.episode, embodiment=name)
            other = replace(observation, episode=episode, arms=arms_of(episode, robot), kinematics=robot)
            for found in self.as_written(other, ("embodiment", name)):
                unknown = sum(v for term, v in self.as_recorded.evidence.items() if term not in found.evidence)
                yield replace(found, score=found.score + unknown)

    def in_views_that_improve(self, reading: Reading) -> Explanation:
        """The mistake in those views that it improves: one camera of a rig may be written unlike the others."""
        conventions, written = reading.conventions, self.as_recorded.evidence
        terms = all_terms(self.observation, reading)
        views = list(reading.cameras) if conventions.departures[0] in _CAMERA_FIELDS else []
        better = tuple(view for view in views if _of_view(terms, view) > _of_view(written, view) + 1.0)
        if better and len(better) < len(views):
            conventions = conventions.model_copy(update={"views": better})
            terms = _exchanged(terms, written, [view for view in views if view not in better])
        return self.explain(conventions, terms)

    def pairs(self, ranked: list[Explanation]) -> list[Explanation]:
        """Two mistakes at once: one of the best single ones, with another or with the numbers estimated beside it."""
        first: dict[str, RecordedConventions] = {}
        for explanation in ranked:
            if explanation.departures and explanation.other is None:
                first.setdefault(explanation.mistake, explanation.conventions)
        ones = list(first.values())[:PAIRED_MISTAKES]
        found: dict[RecordedConventions, Explanation] = {}
        for number, one in enumerate(ones):
            beside = () if (undone := self.read(one)) is None else (*ones[number + 1 :], *self.numbers_beside(undone))
            for both in (_together(one, conventions) for conventions in beside):
                if both is not None and both not in found and (reading := self.read(both)) is not None:
                    found[both] = self.explain(both, all_terms(self.observation, reading))
        return list(found.values())

    def numbers_beside(self, undone: Reading) -> Iterator[RecordedConventions]:
        """Lags and offset, which can only be estimated under a reading that undoes the other mistake.

        States that are late against both camera poses and images count as one mistake, with two lags.
        """
        lags = camera_lags(self.observation, undone)
        yield from (RecordedConventions(camera_lag_frames=lag) for lag in lags)
        yield from (RecordedConventions(camera_lag_frames=lag, image_lag_frames=lag) for lag in lags)
        scores = {
            lag: sum(image_terms(self.observation, undone.with_image_lag(lag), wrist_flow=False).values())
            for lag in (0, *image_lags(self.observation))
        }
        if late := _best_lag(scores):
            yield RecordedConventions(image_lag_frames=late)
        yield from (RecordedConventions(tool_offset_z_m=offset) for offset in tool_offset(self.observation, undone))


def _of_view(evidence: Mapping[str, float], view: str) -> float:
    """Sum of the terms of a view."""
    return sum(value for name, value in evidence.items() if name.endswith(f" {view}"))


def _exchanged(evidence: Mapping[str, float], other: Mapping[str, float], views: Iterable[str]) -> dict[str, float]:
    """The evidence, in which the terms of some views are those of another reading."""
    ends = tuple(f" {view}" for view in views)
    kept = {name: value for name, value in evidence.items() if not name.endswith(ends)}
    return kept | {name: value for name, value in other.items() if name.endswith(ends)}


def _together(one: RecordedConventions, two: RecordedConventions) -> RecordedConventions | None:
    """Both mistakes; None if they are of the same field, or of cameras in different views."""
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
    """The available robots with these arms (view of the wrist camera, number of joints)."""
    found: list[ArmKinematics] = []
    for name in embodiment_names():
        with suppress(ConfigError, UnavailableError):  # a package without its description, or none at all
            embodiment = load_embodiment(name)
            if _layout(embodiment) == layout:
                found.append(ArmKinematics(embodiment))
    return tuple(found)


def image_lags(observation: Observation) -> list[int]:
    """Lags to try, by size; at most a third of the pictures is given up."""
    largest = min(MAX_LAG_FRAMES, observation.num_images // 3)
    return [lag for size in range(1, largest + 1) for lag in (size, -size)]


def camera_lags(observation: Observation, recorded: Reading) -> list[int]:
    """The lags at which moving wrist cameras are most rigid against states and commands, and their neighbours."""
    lags: dict[int, None] = {}
    for tools in (recorded.tools, recorded.action_tools):
        if tools is not None and (scores := _camera_lag_scores(observation, recorded, tools)):
            best = _best_lag(scores)
            lags |= dict.fromkeys(lag for lag in (best, best - 1, best + 1) if lag in scores and lag != 0)
    return list(lags)


def _best_lag(scores: Mapping[int, float]) -> int:
    return max(scores, key=lambda lag: (scores[lag], -abs(lag)))


def _camera_lag_scores(observation: Observation, recorded: Reading, tools: np.ndarray) -> dict[int, float]:
    """Log-likelihood of the hand-eye residuals at each shift of the camera poses after the tools' (n, a, 4, 4)."""
    largest = min(MAX_LAG_FRAMES, len(tools) // 3)
    scores: dict[int, float] = {}
    for view, i in observation.wrists.items():
        if (camera := recorded.cameras.get(view)) is not None and camera.moving:
            for lag in range(-largest, largest + 1):
                _, rigid = hand_eye(*lagged(tools[:, i], camera.T_base_camera, lag))
                scores[lag] = scores.get(lag, 0.0) + rigid
    return scores


def lagged(first: np.ndarray, second: np.ndarray, lag: int) -> tuple[np.ndarray, np.ndarray]:
    """The entries of two series that belong together where the second trails the first by `lag` frames."""
    return first[max(0, -lag) : len(first) - max(0, lag)], second[max(0, lag) : len(second) - max(0, -lag)]


def intrinsics_sizes(cameras: Mapping[str, CameraTrack]) -> list[tuple[int, int]]:
    """Image sizes (height, width) that would centre a camera's principal point, where it is elsewhere."""
    sizes: list[tuple[int, int]] = []
    for camera in cameras.values():
        height, width = 2 * camera.K[1, 2] + 1, 2 * camera.K[0, 2] + 1
        same = abs(np.log(max(height, 1.0) / camera.height)) + abs(np.log(max(width, 1.0) / camera.width))
        if not np.isfinite(camera.K).all() or min(height, width) < 8 or same < SAME_INTRINSICS_SIZE:
            continue
        common = [s for s in _COMMON_SIZES if max(abs(s[0] / height - 1), abs(s[1] / width - 1)) < INTRINSICS_SNAP]
        size = min(common, key=lambda s: abs(s[0] / height - 1) + abs(s[1] / width - 1), default=None)
        sizes.append(size or (round(height), round(width)))
    return list(dict.fromkeys(sizes))


def tool_offset(observation: Observation, recorded: Reading) -> list[float]:
    """Distance of the fingertips beyond the recorded tool poses along +z [m]; none if unknown or within usual scatter.

    From the joints' kinematics where the recording has both, else from wrist cameras with a stated mount.
    """
    if observation.episode.T_base_ee is None:
        return []
    offsets: list[float] = []
    if recorded.kinematic_tools is not None:
        apart = rigid_inverse(recorded.tools) @ recorded.kinematic_tools
        offsets = np.median(apart[:, :, 2, 3], axis=0).tolist()
    else:
        for i, arm in enumerate(observation.arms):
            if arm.T_tool_mount is not None and (camera := recorded.cameras.get(arm.wrist_view)) is not None:
                mount, _ = hand_eye(recorded.tools[:, i], camera.T_base_camera)
                offsets.append(float(mount[2, 3] - arm.T_tool_mount[2, 3]))
    offset = float(np.median(offsets)) if offsets else 0.0
    return [round(offset, 4)] if MIN_TOOL_OFFSET_M <= abs(offset) <= MAX_TOOL_OFFSET_M else []
