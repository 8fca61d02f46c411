"""Input of the estimate: thinned grey pictures of one view of a set of episodes, and the robot's motion meanwhile."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from worldline_core.calibration.camera_errors import ESTIMATED_AT_HZ, StillView, delayed
from worldline_core.calibration.estimate.camera_search import MotionOfSteps
from worldline_core.calibration.observation import (
    GRAY_WIDTH,
    Motion,
    arms_of_embodiment,
    cell_means,
    measured_motion,
    observe,
    placed_surfaces,
    read,
    small_gray,
)
from worldline_core.data.episodes.conventions import RecordedConventions
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.errors import DataError
from worldline_core.geometry.cameras import project_points
from worldline_core.geometry.kinematics import ArmKinematics

logger = logging.getLogger(__name__)

MaskRobot = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Masks (n, h, w) of the robot in pictures (n, h, w, 3), given the tools' places (n, a, 2) [px]: `Segmenter.segment`."""
LoadedViews = Iterable[tuple[Episode, Mapping[str, Iterable[np.ndarray]]]]
"""Episodes with their images by view, which are gone through once."""
FINE_WIDTH, MASKED_WIDTH = 2 * GRAY_WIDTH, 320
CHANGE_FROM, TEXTURE_FROM, SURE_ABOVE, LEAST_TRUST = 2.0, 2.0, 6.0, 0.15
"""Grey levels; and the trust in flow where nothing is to be seen."""
REACH_OF_CHANGE = 1
"""Distance in cells from a changing cell up to which flow is used. Farther away, in flat parts, flow is a guess of any length."""
SHARED_SURFACES, SHARED_CAPSULES = 2.0, 8.0
"""Variance of a still camera that more episodes do not reduce, in variances of one episode; from recordings whose cameras are known."""
MOST_FRAMES, FEWEST_FRAMES = 800, 9
"""Pictures of a view that are used of all episodes together, and fewer of one episode tell nothing."""


@dataclass(frozen=True, eq=False)
class ViewOfEpisode:
    """One view of one episode, thinned: grey pictures (n, h, FINE_WIDTH), and of the robot points (n, p, 3) with radii (p,)
    [m], tool poses (n, a, 4, 4) and gripper openings (n, a), None where the state has none. With masks of the robot
    (n, h, FINE_WIDTH), what moves outside of them does not count."""

    episode_id: str
    gray: np.ndarray
    points: np.ndarray
    radii: np.ndarray
    tools: np.ndarray
    gripper: np.ndarray | None
    colour: np.ndarray | None = None
    masks: np.ndarray | None = None

    @cached_property
    def fine(self) -> Motion:
        motion = measured_motion(self.gray, exact=True)
        if self.masks is None:
            return motion
        near = np.maximum(self.masks[1:], self.masks[:-1]).astype(np.float32)
        robot = np.stack([cv2.dilate(cells, np.ones((3, 3))) for cells in cell_means(near)])
        return replace(motion, flow=motion.flow * robot[..., None], change=motion.change * robot)

    @cached_property
    def rough_gray(self) -> np.ndarray:
        """(n, h, GRAY_WIDTH)."""
        return small_gray(self.gray)

    @cached_property
    def rough(self) -> Motion:
        return measured_motion(self.rough_gray)


@dataclass(frozen=True, eq=False)
class RecordedView:
    """One view of all episodes; frames lie `frame_s` seconds (`every` recorded frames) apart.

    Attributes:
        image_size: (height, width) of the recorded pictures.
        surfaces: whether the points lie on the links' surfaces.
    """

    view: str
    image_size: tuple[int, int]
    every: int
    frame_s: float
    surfaces: bool
    episodes: tuple[ViewOfEpisode, ...]

    @property
    def shared(self) -> float:
        """Variance that more episodes do not reduce."""
        return SHARED_SURFACES if self.surfaces else SHARED_CAPSULES

    def of(self, episodes: Sequence[ViewOfEpisode]) -> RecordedView:
        return replace(self, episodes=tuple(episodes))

    def mirrored(self) -> RecordedView:
        """The same robot before pictures with left and right exchanged."""
        return self.of([replace(episode, gray=episode.gray[:, :, ::-1].copy()) for episode in self.episodes])

    def unknown_camera(self, *, fine: bool) -> CameraTrack:
        """A camera of a focal length of one width at the base, to be replaced."""
        first = self.episodes[0]
        height, width = (first.gray if fine else first.rough_gray).shape[1:]
        K = np.array([[width, 0.0, (width - 1) / 2], [0.0, width, (height - 1) / 2], [0.0, 0.0, 1.0]])
        return CameraTrack(self.view, K, np.eye(4)[None], width, height)

    def still_views(self, *, fine: bool) -> list[StillView]:
        """The evidence of a still camera, one for each episode."""
        camera = self.unknown_camera(fine=fine)
        motions = [near_changes(e.fine if fine else e.rough) for e in self.episodes]
        return [
            StillView(camera, e.points, e.radii, m, certainty(m)) for e, m in zip(self.episodes, motions, strict=True)
        ]

    def masked(self, mask_robot: MaskRobot, camera: CameraTrack) -> RecordedView:
        """The same with masks of the robot, begun at the tools' places in the pictures of a camera."""
        episodes: list[ViewOfEpisode] = []
        for episode in self.episodes:
            if episode.colour is None:
                raise ValueError("masks need the coloured pictures")
            height, width = episode.colour.shape[1:3]
            points, depth = project_points(
                episode.tools[:, :, :3, 3].reshape(-1, 3), camera.resized(width, height).K, camera.T_base_camera
            )
            points[depth <= 0] = np.nan
            found = mask_robot(episode.colour, points.reshape(len(episode.tools), -1, 2))
            across, down = episode.gray.shape[2], episode.gray.shape[1]
            masks = np.stack(
                [cv2.resize(m.astype(np.uint8), (across, down), interpolation=cv2.INTER_AREA) for m in found]
            )
            episodes.append(replace(episode, masks=masks))
        return self.of(episodes)

    def motion(self, delay: float) -> MotionOfSteps:
        """All steps of all episodes, with pictures that trail by `delay` frames."""
        points = [delayed(e.points, delay) for e in self.episodes]
        flow = np.concatenate([near_changes(e.rough).flow for e in self.episodes])
        height, width = self.episodes[0].rough_gray.shape[1:]
        before, after = (np.concatenate([p[part] for p in points]) for part in (slice(None, -1), slice(1, None)))
        return MotionOfSteps(before, after, flow, width, height)


def placed(camera: CameraTrack, focal_px: float, T_base_camera: np.ndarray) -> CameraTrack:
    """A camera with square pixels of another focal length, at other poses (n, 4, 4)."""
    K = camera.K.copy()
    K[0, 0] = K[1, 1] = focal_px
    return replace(camera, K=K, T_base_camera=T_base_camera)


def near_changes(motion: Motion) -> Motion:
    """Drop flow where nothing changes nearby; for cameras that stand still."""
    size = 2 * REACH_OF_CHANGE + 1
    changes = (motion.change > CHANGE_FROM).astype(np.uint8)
    near = np.stack([cv2.dilate(cells, np.ones((size, size), np.uint8)) for cells in changes])
    return replace(motion, flow=motion.flow * near[..., None])


def certainty(motion: Motion) -> np.ndarray:
    """(n, r, c) trust in the flow: full where the picture changes or has edges; in flat parts flow spreads from beside them."""
    sure = np.maximum(motion.change - CHANGE_FROM, motion.texture - TEXTURE_FROM) / SURE_ABOVE
    return (LEAST_TRUST + (1 - LEAST_TRUST) * np.clip(sure, 0, 1)).astype(np.float32)


def recorded_views(
    loaded: LoadedViews,
    kinematics: ArmKinematics,
    count: int,
    *,
    colour: bool = False,
) -> dict[str, RecordedView]:
    """The views of about `count` episodes, each gone through once, with coloured pictures if `colour`. An episode whose videos
    cannot be read is left out with a warning.

    Raises: DataError when no episode's videos can be read, pictures differ in size, or the states say nothing of the robot.
    """
    found: dict[str, list[ViewOfEpisode]] = {}
    sizes: dict[str, tuple[int, int]] = {}
    every, frame_s, surfaces = 1, 1.0, True
    faults: list[DataError | RejectedInputError] = []
    wrists = {arm.wrist_view for arm in arms_of_embodiment(kinematics)}
    for episode, frames in loaded:
        every = max(1, round(episode.fps / ESTIMATED_AT_HZ))
        frame_s = every / episode.fps
        reading = read(observe(replace(episode, cameras={}), {}, kinematics), RecordedConventions())
        if reading is None:
            raise DataError("The states do not say where the robot is", where=f"episode {episode.episode_id}")
        try:
            pictures = {view: _thinned(images, every, colour=colour) for view, images in frames.items()}
        except (DataError, RejectedInputError) as error:
            faults.append(error)
            continue
        surfaces = reading.shape == "surfaces"
        joints = episode.state_kind == "joints"
        openings = kinematics.gripper(episode.state.astype(np.float64)).numpy() if joints else None
        length = len(reading.tools[::every])
        kept = _busiest(reading.points[::every], max(FEWEST_FRAMES, MOST_FRAMES // count))
        for view, (shown_sizes, gray, coloured) in pictures.items():
            for size in shown_sizes:
                if size != sizes.setdefault(view, size):
                    raise DataError(
                        "Pictures of one view differ in size", where=f"episode {episode.episode_id}, view {view}",
                        expected=f"{sizes[view][1]}x{sizes[view][0]}", got=f"{size[1]}x{size[0]}",
                        next_step="give each size a source of its own",
                    )  # fmt: skip
            found.setdefault(view, [])
            frames_of = slice(kept.start, min(kept.stop, len(gray), length))
            if frames_of.stop - frames_of.start < FEWEST_FRAMES:
                continue
            gripper = None if openings is None else openings[::every][frames_of]
            points, radii = reading.points[::every][frames_of], reading.radii
            if surfaces and view in wrists:
                states = episode.state[::every][frames_of].astype(np.float64)
                links = kinematics.link_poses(states, kinematics.embodiment.noted_posture(episode.conventions))
                points, radii = placed_surfaces(kinematics.fine_surfaces, links)
            shown = ViewOfEpisode(
                episode.episode_id, np.stack(gray[frames_of]), points, radii,
                reading.tools[::every][frames_of], gripper, np.stack(coloured[frames_of]) if colour else None,
            )  # fmt: skip
            found[view].append(shown)
    if faults and not found:
        raise faults[0]
    if faults:
        logger.warning("Videos of %d episodes cannot be used, the first: %s", len(faults), faults[0])
    return {
        view: RecordedView(view, sizes[view], every, frame_s, surfaces, tuple(episodes))
        for view, episodes in found.items()
    }


def _thinned(
    images: Iterable[np.ndarray], every: int, *, colour: bool
) -> tuple[list[tuple[int, int]], list[np.ndarray], list[np.ndarray]]:
    """(height, width) of each kept picture, the pictures in grey and, if `colour`, at most MASKED_WIDTH wide in colour."""
    sizes, gray, coloured = list[tuple[int, int]](), list[np.ndarray](), list[np.ndarray]()
    # The last ones are read, too: only then is the number of pictures known.
    for number, image in enumerate(images):
        if number % every == 0:
            sizes.append(image.shape[:2])
            gray.append(small_gray([image], FINE_WIDTH)[0])
            if colour:
                height, width = image.shape[:2]
                scale = min(1.0, MASKED_WIDTH / width)
                size = (round(width * scale), round(height * scale))
                coloured.append(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
    return sizes, gray, coloured


def _busiest(points: np.ndarray, count: int) -> slice:
    """The window of this many frames in which points (n, p, 3) travel most."""
    if len(points) <= count:
        return slice(0, len(points))
    travel = np.linalg.norm(np.diff(points, axis=0), axis=-1).mean(axis=1)
    sums = np.convolve(travel, np.ones(count - 1), "valid")
    start = int(sums.argmax())
    return slice(start, start + count)
