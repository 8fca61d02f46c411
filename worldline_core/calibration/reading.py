"""An episode read under given conventions: tool poses, cameras at the size of the grey images, points on the robot."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np

from worldline_core.actions.robot_masks import robot_capsules
from worldline_core.calibration.observation import CELL_PX, Observation
from worldline_core.data.episodes.conventions import RecordedConventions, apply_conventions, arm_blocks, image_frames
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.rotations import rotation_angle_deg
from worldline_core.geometry.transforms import lengths, rigid_inverse

METRES_PER_RADIAN = 0.15
"""A wrist camera that turns by one radian shows about as much change as one that goes this far."""
_CAPSULE_SAMPLES = np.array([0.0, 1 / 3, 2 / 3, 1.0])
_TOOL_POINTS_M = np.array([0.0, 0.05, 0.1, 0.15])
_TOOL_RADIUS_M = 0.05
_NEAR_M = 0.03
_STILL_PX = 0.05
_SUBCELL_BITS = 4
_SUBCELL = 2**_SUBCELL_BITS


@dataclass(frozen=True)
class PredictedMotion:
    """What the robot's motion should look like in a view that stands still, step by step, in image cells.

    Attributes:
        step: (n - 1, r, c) length of the fastest robot point's projected step that touches the cell [px].
        vector: (n - 1, r, c, 2) that step.
    """

    step: np.ndarray
    vector: np.ndarray


@dataclass(frozen=True)
class Reading:
    """An episode as it is under given conventions.

    Attributes:
        tools: (n, a, 4, 4) T_base_tool; action_tools: the same of the commands, None where unknown.
        kinematic_tools: (n, a, 4, 4) from joints where the recording also has tool poses, else None.
        cameras: by view, K at the size of the grey images.
        gripper, gripper_command: (n, a) openings, None where the state has no gripper columns.
        points, radii: (n, p, 3), (p,) on the arms [m] (capsules of the links, or the hand where only tools are known).
        whole_arms: whether the points are those of whole arms.
        first_image: number of the image that belongs to frame 0 (may be negative).
    """

    conventions: RecordedConventions
    episode: Episode
    tools: np.ndarray
    action_tools: np.ndarray | None
    kinematic_tools: np.ndarray | None
    cameras: dict[str, CameraTrack]
    gripper: np.ndarray | None
    gripper_command: np.ndarray | None
    points: np.ndarray
    radii: np.ndarray
    whole_arms: bool
    first_image: int
    _predicted: dict[str, PredictedMotion] = field(default_factory=dict, repr=False)

    def with_image_lag(self, frames: int) -> Reading:
        """The same geometry with images that trail the states by so many frames."""
        conventions = self.conventions.model_copy(update={"image_lag_frames": frames})
        return replace(self, conventions=conventions, first_image=self.first_image + frames)

    def steps(self, num_images: int) -> tuple[slice, slice]:
        """Steps of the states, and steps of the images that belong to them."""
        start = max(0, -self.first_image)
        stop = max(start, min(len(self.tools), num_images - self.first_image) - 1)
        return slice(start, stop), slice(start + self.first_image, stop + self.first_image)

    @cached_property
    def tool_speed(self) -> np.ndarray:
        return tool_travel(self.tools)

    def predicted(self, view: str) -> PredictedMotion:
        """Predicted motion in a view; computed once."""
        if view not in self._predicted:
            self._predicted[view] = predict_motion(self.points, self.radii, self.cameras[view])
        return self._predicted[view]


def tool_travel(tools: np.ndarray) -> np.ndarray:
    """(n - 1, a) how far each tool (n, a, 4, 4) moves from frame to frame [m], turning counted as travel."""
    relative = rigid_inverse(tools[:-1]) @ tools[1:]
    travel = lengths(relative[..., :3, 3])
    return travel + METRES_PER_RADIAN * np.radians(rotation_angle_deg(relative[..., :3, :3]))


def read(observation: Observation, conventions: RecordedConventions) -> Reading | None:
    """The episode under these conventions; None where no tool poses are known.

    Raises: RejectedInputError where the conventions do not apply.
    """
    recorded = observation.episode
    kinematics = observation.kinematics
    episode = apply_conventions(recorded, conventions)
    tools, kinematic, action = episode.T_base_ee, None, None
    points, radii = np.zeros((episode.num_frames, 0, 3)), np.zeros(0)
    if kinematics is not None and episode.state_kind == "joints":
        kinematic, action, points, radii = _moved_arms(observation, kinematics, episode)
    if tools is None:
        if kinematic is None:
            return None
        tools, kinematic = kinematic, None
    whole_arms = len(radii) > 0
    if not whole_arms:
        points, radii = _hand_points(tools)
    blocks = arm_blocks(episode)
    columns = [block[-1] for block in blocks] if len(blocks) == tools.shape[1] else []
    cameras = {}
    for view, camera in episode.cameras.items():
        gray = observation.gray.get(view)
        cameras[view] = camera if gray is None else camera.resized(gray.shape[2], gray.shape[1])
    return Reading(
        conventions,
        episode,
        tools,
        action,
        kinematic,
        cameras,
        episode.state[:, columns].astype(np.float64) if columns else None,
        episode.action[:, columns].astype(np.float64) if columns else None,
        points,
        radii,
        whole_arms,
        image_frames(recorded.num_frames, conventions).start,
    )


def _moved_arms(
    observation: Observation, kinematics: ArmKinematics, episode: Episode
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Tool poses of states and of commands, points on the arms and their radii; of the same joints computed once."""
    both = np.concatenate([episode.state, episode.action]).astype(np.float64)
    key = (id(kinematics), both.tobytes())
    if key not in observation.moved_arms:
        links = kinematics.link_poses(both, posture=_tracks(observation.posture, len(both)))
        fk = kinematics.tools_of(links).numpy()
        capsules, radius = robot_capsules(kinematics, {k: v[: episode.num_frames] for k, v in links.items()})
        points, radii = _sampled(capsules.numpy(), radius.numpy())
        observation.moved_arms[key] = fk[: episode.num_frames], fk[episode.num_frames :], points, radii
    return observation.moved_arms[key]


def _tracks(posture: dict[str, float], length: int) -> dict[str, np.ndarray]:
    return {name: np.full(length, value) for name, value in posture.items()}


def _sampled(capsules: np.ndarray, radii: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points along capsules (n, s, 2, 3)."""
    t = _CAPSULE_SAMPLES[:, None]
    points = capsules[:, :, None, 0] * (1 - t) + capsules[:, :, None, 1] * t
    return points.reshape(len(capsules), -1, 3), np.repeat(radii, len(t))


def _hand_points(tools: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points from the tool back along its z axis: all that a recording without joints tells."""
    points = tools[:, :, None, :3, 3] - _TOOL_POINTS_M[:, None] * tools[:, :, None, :3, 2]
    points = points.reshape(len(tools), -1, 3)
    return points, np.full(points.shape[1], _TOOL_RADIUS_M)


def predict_motion(points: np.ndarray, radii: np.ndarray, camera: CameraTrack) -> PredictedMotion:
    """Projected steps of points (n, p, 3) with radii (p,) [m] in a camera that stands still, in cells of its image."""
    rows, columns = camera.height // CELL_PX, camera.width // CELL_PX
    if not len(radii):
        return PredictedMotion(
            np.zeros((len(points) - 1, rows, columns)), np.zeros((len(points) - 1, rows, columns, 2))
        )
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
    covered = owner >= 0
    frames = np.arange(len(step))[:, None, None]
    best = np.where(covered, length[frames, owner], 0.0)
    vector = np.where(covered[..., None], step[frames, owner], 0.0)
    return PredictedMotion(best, vector)
