"""Measurements of an episode that assume nothing about its conventions, and the episode read under given ones.

Axis legend: n frames, a arms, p points on the robot, r c rows and columns of image cells.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Literal

import cv2
import numpy as np
from torch import Tensor

from worldline_core.actions.robot_masks import robot_capsules
from worldline_core.data.episodes.conventions import RecordedConventions, apply_conventions, arm_blocks, frames_with_all
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.errors import DataError
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.transforms import hand_eye_residual, lengths, rigid_inverse, rotation_angle_deg

GRAY_WIDTH = 96
CELL_PX = 4
STILL_CHANGE, CLEAR_CHANGE = 4.0, 8.0
"""Changes below this many grey levels are compression or sensor noise; above the second something moves there."""
METRES_PER_RADIAN = 0.15
"""A wrist camera that turns by one radian shows about as much change as one that travels this far."""
MIN_SHAPED_LINKS = 3
"""With shapes of fewer links of an arm, capsules along its links stand for it."""
_STEPS_AT_ONCE = 64
_CAPSULE_SAMPLES = np.array([0.0, 1 / 3, 2 / 3, 1.0])
_TOOL_POINTS_M = np.array([0.0, 0.05, 0.1, 0.15])
_TOOL_RADIUS_M = 0.05
_NEAR_M = 0.03
_STILL_PX = 0.05
LONGEST_STEP_PX = 20.0
"""One outlier of a hundred pixels must not outweigh a thousand cells."""
_SUBCELL_BITS = 4
_SUBCELL = 2**_SUBCELL_BITS


@dataclass(frozen=True)
class ObservedArm:
    """One arm; `T_tool_mount` is its wrist camera's pose in the tool frame, None if unknown."""

    name: str
    wrist_view: str
    T_tool_mount: np.ndarray | None


@dataclass(frozen=True)
class Motion:
    """Image motion of one view, in cells of CELL_PX pixels; entry i belongs to the step from image i to i + 1.

    Attributes:
        flow: (n - 1, r, c, 2) mean optical flow [px]. change: (n - 1, r, c) mean absolute change, of 255.
        texture: (n - 1, r, c) mean gradient: where there is none, flow is a guess.
    """

    flow: np.ndarray
    change: np.ndarray
    texture: np.ndarray

    @cached_property
    def moves(self) -> bool:
        return bool((self.change.max(axis=(1, 2)) > STILL_CHANGE).sum() >= 4)


@dataclass(frozen=True)
class Observation:
    """One episode, its small grey images by view (n, h, GRAY_WIDTH), its arms and kinematics."""

    episode: Episode
    gray: Mapping[str, np.ndarray]
    arms: tuple[ObservedArm, ...]
    kinematics: ArmKinematics | None
    _motion: dict[str, Motion] = field(default_factory=dict, repr=False)
    moved_arms: dict[tuple[int, bytes], tuple[np.ndarray, ...]] = field(default_factory=dict, repr=False)
    """Cached by kinematics and joints: most readings leave both as they are."""

    def motion(self, view: str) -> Motion:
        if view not in self._motion:
            self._motion[view] = measured_motion(self.gray[view])
        return self._motion[view]

    @cached_property
    def still_views(self) -> set[str]:
        """Views whose recorded camera poses stay the same (2 cm, 2 degrees; at any unit of length)."""
        found = set[str]()
        for view, camera in self.episode.cameras.items():
            poses = camera.T_base_camera
            _, metres, degrees = hand_eye_residual(np.eye(4)[None], poses)
            if metres.max() < 0.02 * max(1.0, float(np.linalg.norm(poses[0, :3, 3]))) and degrees.max() < 2.0:
                found.add(view)
        return found

    def with_exchanged_wrists(self) -> Observation | None:
        """The same with the videos of two wrist cameras exchanged; None without two of one size."""
        views = [arm.wrist_view for arm in self.arms]
        both = self.gray.keys() & self.episode.cameras.keys()
        if len(views) != 2 or not both >= set(views) or self.gray[views[0]].shape != self.gray[views[1]].shape:
            return None
        others = {view: view for view in self.gray} | {views[0]: views[1], views[1]: views[0]}
        gray = {view: self.gray[other] for view, other in others.items()}
        return replace(self, gray=gray, _motion={view: self.motion(other) for view, other in others.items()})

    @property
    def wrists(self) -> dict[str, int]:
        """Wrist view -> index of its arm."""
        return {arm.wrist_view: i for i, arm in enumerate(self.arms)}

    @property
    def num_images(self) -> int:
        return min((len(images) for images in self.gray.values()), default=0)


def observe(
    episode: Episode, frames: Mapping[str, Iterable[np.ndarray]], kinematics: ArmKinematics | None
) -> Observation:
    """Measures an episode; images by view, uint8 (H, W, 3) RGB or (h, w) grey, are resized to GRAY_WIDTH.

    Raises: DataError when images have another shape or the kinematics belong to another number of arms.
    """
    gray = {view: small_gray(images) for view, images in frames.items()}
    return Observation(episode, gray, arms_of(episode, kinematics), kinematics)


def small_gray(images: Iterable[np.ndarray], width: int = GRAY_WIDTH) -> np.ndarray:
    """uint8 (n, h, width) of RGB (H, W, 3) or grey (H, W) images. Raises: DataError for images of another shape."""
    small = []
    for image in images:
        if image.ndim not in (2, 3) or image.dtype != np.uint8 or (image.ndim == 3 and image.shape[2] != 3):
            expected, got = "uint8 (H, W, 3) or (H, W)", f"{image.dtype} {image.shape}"
            raise DataError("Images have a wrong shape", expected=expected, got=got)
        gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        size = width, max(2, round(image.shape[0] * width / image.shape[1]))
        small.append(cv2.resize(gray, size, interpolation=cv2.INTER_AREA))
    return np.stack(small)


def cell_centres(height: int, width: int) -> np.ndarray:
    """(r, c, 2) pixel coordinates of the cells' centres."""
    rows, columns = np.mgrid[: height // CELL_PX, : width // CELL_PX]
    return np.stack([columns, rows], axis=-1) * float(CELL_PX) + (CELL_PX - 1) / 2


def cell_means(values: np.ndarray) -> np.ndarray:
    """(n, h, w, ...) -> (n, r, c, ...): mean over CELL_PX squares; incomplete ones at the border are dropped."""
    n, height, width = values.shape[:3]
    r, c = height // CELL_PX, width // CELL_PX
    cut = np.ascontiguousarray(values[:, : r * CELL_PX, : c * CELL_PX], dtype=np.float32)
    # Rows of pixels first: whole rows are added, which is several times as fast as square by square.
    rows = cut.reshape(n, r, CELL_PX, -1).sum(axis=2)
    return rows.reshape(n, r, c, CELL_PX, *values.shape[3:]).sum(axis=3) / np.float32(CELL_PX**2)


def measured_motion(gray: np.ndarray, *, exact: bool = False) -> Motion:
    """Image motion of a view's small grey images (n, h, w); `exact` takes three times as long."""
    if len(gray) < 2:
        empty = np.zeros((0, gray.shape[1] // CELL_PX, gray.shape[2] // CELL_PX), dtype=np.float32)
        return Motion(np.zeros((*empty.shape, 2), dtype=np.float32), empty, empty)
    preset = cv2.DISOPTICAL_FLOW_PRESET_FAST if exact else cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST
    engine = cv2.DISOpticalFlow.create(preset)
    engine.setFinestScale(0 if exact else 1)
    parts: list[tuple[np.ndarray, ...]] = []
    # Cells alone are kept of an episode: flow of every pixel of some minutes would fill gigabytes.
    for begin in range(0, len(gray) - 1, _STEPS_AT_ONCE):
        part = gray[begin : begin + _STEPS_AT_ONCE + 1]
        flow = np.stack([engine.calc(a, b, None) for a, b in pairwise(part)])  # type: ignore[call-overload]
        across, down = np.zeros((2, *part[1:].shape), np.uint8)
        across[:, :, :-1] = cv2.absdiff(part[:-1, :, 1:], part[:-1, :, :-1])
        down[:, :-1] = cv2.absdiff(part[:-1, 1:], part[:-1, :-1])
        change = cv2.absdiff(part[1:], part[:-1])
        parts.append((cell_means(flow), cell_means(change), cell_means(np.maximum(across, down))))
    flow, change, texture = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Motion(flow, change, texture)


def arms_of(episode: Episode, kinematics: ArmKinematics | None) -> tuple[ObservedArm, ...]:
    """The arms of the embodiment; without kinematics, those of the recorded tool poses under the usual names.

    A mount that the recording's calibration gives takes the place of the described one.
    """
    recorded = None if episode.T_base_ee is None else episode.T_base_ee.shape[1]
    if kinematics is None:
        count = recorded or 0
        names = {1: ("right",), 2: ("left", "right")}.get(count, tuple(f"arm_{i}" for i in range(count)))
        return tuple(ObservedArm(name, f"{name}_wrist", None) for name in names)
    arms = arms_of_embodiment(kinematics)
    if recorded not in (None, len(arms)):
        what = "Recorded tool poses and embodiment differ in the number of arms"
        where = f"episode {episode.episode_id}, embodiment {kinematics.embodiment.name}"
        raise DataError(what, where=where, expected=f"{len(arms)} arms", got=f"{recorded} tool poses per frame")
    calibrated = episode.calibrated_mounts
    return tuple(replace(arm, T_tool_mount=None) if arm.wrist_view in calibrated else arm for arm in arms)


def arms_of_embodiment(kinematics: ArmKinematics) -> tuple[ObservedArm, ...]:
    """The arms of a robot, and where its description mounts their cameras."""
    arms = []
    for arm in kinematics.embodiment.arms:
        mount, camera = None, arm.wrist_camera
        if camera is not None and camera.link == arm.end_effector_link:
            mount = np.linalg.inv(arm.T_link_tool.matrix()) @ np.asarray(camera.T_link_camera, dtype=np.float64)
        arms.append(ObservedArm(arm.name, arm.camera_view, mount))
    return tuple(arms)


@dataclass(frozen=True)
class Reading:
    """An episode read under given conventions.

    Attributes:
        tools: (n, a, 4, 4) T_base_tool; action_tools: the same of the commands, None where unknown.
        tool_speed: (n - 1, a) `tool_travel` of the tools.
        kinematic_tools: (n, a, 4, 4) from joints where the recording also has tool poses, else None.
        cameras: by view, K at the size of the grey images.
        gripper, gripper_command: (n, a) openings, None where the state has no gripper columns.
        points, radii: (n, p, 3), (p,) on the arms [m].
        capsules: points and radii along the links' capsules, whose thin fingers are separate.
        shape: what the points are of: the links' surfaces, capsules along the links, or hands where only tools are known.
        first: recorded frame that is frame 0.
    """

    conventions: RecordedConventions
    episode: Episode
    tools: np.ndarray
    tool_speed: np.ndarray
    action_tools: np.ndarray | None
    kinematic_tools: np.ndarray | None
    cameras: dict[str, CameraTrack]
    gripper: np.ndarray | None
    gripper_command: np.ndarray | None
    points: np.ndarray
    radii: np.ndarray
    shape: Literal["surfaces", "capsules", "hands"]
    capsules: tuple[np.ndarray, np.ndarray]
    first: int
    predictions: dict[str, np.ndarray] = field(default_factory=dict, repr=False)
    """Cached results of `predict_motion`; readings that differ by a lag of the images share it."""

    def with_image_lag(self, frames: int) -> Reading:
        """The same geometry with images that trail the states by so many frames."""
        conventions = self.conventions.model_copy(update={"image_lag_frames": frames})
        return replace(self, conventions=conventions)

    def steps(self, num_images: int, view: str) -> tuple[slice, slice]:
        """Steps of the states, and the steps of a view's images that belong to them."""
        first = self.first + self.conventions.image_lag(view)
        start = max(0, -first)
        stop = max(start, min(len(self.tools), num_images - first) - 1)
        return slice(start, stop), slice(start + first, stop + first)

    def predicted(self, view: str) -> np.ndarray:
        """`predict_motion` in a view, cached."""
        if view not in self.predictions:
            self.predictions[view] = predict_motion(self.points, self.radii, self.cameras[view])
        return self.predictions[view]


def tool_travel(tools: np.ndarray) -> np.ndarray:
    """(n - 1, a) travel of each tool (n, a, 4, 4) from frame to frame [m], including its turning."""
    relative = rigid_inverse(tools[:-1]) @ tools[1:]
    travel = lengths(relative[..., :3, 3])
    return travel + METRES_PER_RADIAN * np.radians(rotation_angle_deg(relative[..., :3, :3]))


def read(observation: Observation, conventions: RecordedConventions) -> Reading | None:
    """The episode under these conventions; None where no tool poses are known."""
    kinematics, episode = observation.kinematics, apply_conventions(observation.episode, conventions)
    tools, kinematic, action = episode.T_base_ee, None, None
    points, radii = along = np.zeros((episode.num_frames, 0, 3)), np.zeros(0)
    if kinematics is not None and episode.state_kind == "joints":
        kinematic, action, points, radii, *along = _moved_arms(observation, kinematics, episode)
    if tools is None:
        if kinematic is None:
            return None
        tools, kinematic = kinematic, None
    shape: Literal["surfaces", "capsules", "hands"] = "hands"
    if kinematics is not None and len(radii):
        shape = "surfaces" if _has_surfaces(kinematics) else "capsules"
    else:  # from the tool back along its z axis
        points = tools[:, :, None, :3, 3] - _TOOL_POINTS_M[:, None] * tools[:, :, None, :3, 2]
        points = points.reshape(len(tools), -1, 3)
        radii = np.full(points.shape[1], _TOOL_RADIUS_M)
    blocks = arm_blocks(episode)
    columns = [block[-1] for block in blocks] if len(blocks) == tools.shape[1] else []
    arrays = episode.state, episode.action
    opening, command = (each[:, columns].astype(np.float64) if columns else None for each in arrays)
    cameras = dict(episode.cameras)
    for view in cameras.keys() & observation.gray.keys():
        height, width = observation.gray[view].shape[1:]
        cameras[view] = cameras[view].resized(width, height)
    poses = tools, tool_travel(tools), action, kinematic
    on_arms = points, radii, shape, (along[0], along[1])
    first = frames_with_all(observation.episode.num_frames, conventions)[0]
    return Reading(conventions, episode, *poses, cameras, opening, command, *on_arms, first)


def _moved_arms(observation: Observation, kinematics: ArmKinematics, episode: Episode) -> tuple[np.ndarray, ...]:
    """Tool poses of states and of commands, points on the arms and their radii, and those of capsules along the links."""
    both = np.concatenate([episode.state, episode.action]).astype(np.float64)
    key = (id(kinematics), both.tobytes())
    if key not in observation.moved_arms:
        links = kinematics.link_poses(both, kinematics.embodiment.noted_posture(observation.episode.conventions))
        fk = kinematics.tools_of(links).numpy()
        links = {name: poses[: episode.num_frames] for name, poses in links.items()}
        capsules, radius = (each.numpy() for each in robot_capsules(kinematics, links))
        share = _CAPSULE_SAMPLES[:, None]
        points = capsules[:, :, None, 0] * (1 - share) + capsules[:, :, None, 1] * share
        points, radii = along = points.reshape(len(capsules), -1, 3), np.repeat(radius, len(share))
        if _has_surfaces(kinematics):
            points, radii = placed_surfaces(kinematics.surfaces, links)
        observation.moved_arms[key] = fk[: episode.num_frames], fk[episode.num_frames :], points, radii, *along
    return observation.moved_arms[key]


def placed_surfaces(
    surfaces: Mapping[str, tuple[np.ndarray, np.ndarray]], links: Mapping[str, Tensor]
) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, p, 3) and radii (p,) of `ArmKinematics.surfaces` at poses of the links (n, 4, 4)."""
    poses = ((links[name].numpy(), shape) for name, shape in surfaces.items())
    parts = [(shape @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3], size) for T, (shape, size) in poses]
    return np.concatenate([p for p, _ in parts], axis=1), np.concatenate([r for _, r in parts])


def _has_surfaces(kinematics: ArmKinematics) -> bool:
    """True if the description has the shapes of each arm's links, of at least MIN_SHAPED_LINKS."""
    for arm in kinematics.embodiment.arms:
        link, shaped = arm.end_effector_link, 0
        while link in kinematics.link_parents:
            shaped, link = shaped + (link in kinematics.surfaces), kinematics.link_parents[link]
        if shaped < MIN_SHAPED_LINKS:
            return False
    return True


def predict_motion(points: np.ndarray, radii: np.ndarray, camera: CameraTrack) -> np.ndarray:
    """(n - 1, r, c, 2) [px]: in each cell of a fixed camera, the projected step of the fastest robot point (n, p, 3) with
    radius (p,) [m] that touches it."""
    rows, columns = camera.height // CELL_PX, camera.width // CELL_PX
    if not len(radii):
        return np.zeros((len(points) - 1, rows, columns, 2))
    T_camera_base = rigid_inverse(camera.T_base_camera[:1])[0]
    in_camera = points @ T_camera_base[:3, :3].T + T_camera_base[:3, 3]
    depth = in_camera[..., 2]
    visible = depth > _NEAR_M
    safe = np.where(visible, depth, 1.0)
    uv = ((in_camera / safe[..., None]) @ camera.K.T)[..., :2]
    step = np.where((visible[1:] & visible[:-1])[..., None], np.diff(uv, axis=0), 0.0)
    length = lengths(step)
    # Discs are drawn on the grid of cells, in 1/16 of a cell, the fastest last.
    reach = (camera.K[0, 0] * radii / safe + CELL_PX / 2) / CELL_PX
    place = (uv - (CELL_PX - 1) / 2) / CELL_PX
    near = (
        visible & (place > -reach[..., None]).all(-1) & (place < np.array([columns, rows]) + reach[..., None]).all(-1)
    )
    # Lists: an element of an array costs more than the disc that it places.
    centres = np.clip(place * _SUBCELL, -(2**20), 2**20).astype(int).tolist()
    radius = np.clip(reach * _SUBCELL, 1, 2**20).astype(int).tolist()
    owner, shown = np.full((len(step), rows, columns), -1, dtype=np.int32), near.tolist()
    for i, cells in enumerate(owner):
        moving = np.flatnonzero((length[i] > _STILL_PX) & (near[i] | near[i + 1]))
        for point in moving[np.argsort(length[i, moving], kind="stable")].tolist():
            for j in (i, i + 1):
                if shown[j][point]:
                    cv2.circle(cells, centres[j][point], radius[j][point], point, -1, cv2.LINE_8, _SUBCELL_BITS)
    frames = np.arange(len(step))[:, None, None]
    return np.where((owner >= 0)[..., None], step[frames, owner], 0.0)
