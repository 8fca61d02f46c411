"""From what a person does with keys, a gamepad or a mouse to commands of all joints, and to marks over the pictures.

Wishes are in the head camera's terms (the base's, where no camera is known), level with the ground: to its right, away from it,
up. They move a wanted pose of each tool, which inverse kinematics follows within the joint limits; a pose that cannot be reached
is drawn back to what was reached.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.spatial.transform import Rotation

from worldline_core.actions.episode_tracks import EpisodeTracks
from worldline_core.actions.overlays import axis_tips
from worldline_core.errors import DataError
from worldline_core.geometry.kinematics import ArmKinematics, InverseKinematics
from worldline_core.rollout.observation import image_size, project_controls
from worldline_core.rollout.recorded_starts import RecordedStart

SPEED_M_S, TURN_RAD_S, GRIPPER_S = 0.2, 1.0, 2.0
"""At a full wish; a gripper's whole way takes half a second."""
ITERATIONS = 8
LOST_M, LOST_RAD = 0.02, 0.1
"""Further than this a tool does not stay behind what is wanted of it."""

Wish = Annotated[float, Field(ge=-1, le=1)]
Share = Annotated[float, Field(ge=0, le=1)]


class _Input(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Goal(_Input):
    """A place in a picture, as shares of its width and height, that a tool is dragged to at its own depth."""

    view: str
    u: Share
    v: Share


class ArmInput(_Input):
    """Wishes for one arm during a frame: moves and turns to the right, away, up, and the gripper's opening."""

    move: tuple[Wish, Wish, Wish] = (0.0, 0.0, 0.0)
    turn: tuple[Wish, Wish, Wish] = (0.0, 0.0, 0.0)
    grip: Wish = 0.0
    goal: Goal | None = None


class Teleoperation:
    """One person at one robot.

    Attributes:
        command: (j) of the last frame.
    """

    def __init__(self, start: RecordedStart, kinematics: ArmKinematics, fps: float) -> None:
        self._start, self._kinematics, self._fps = start, kinematics, fps
        self._solver = InverseKinematics(kinematics)
        self._image_size = image_size(start.images, start.cameras)
        self._axes = self._level_axes()
        self.take_over(start.state)

    def _level_axes(self) -> np.ndarray:
        """(3, 3) columns: right, away and up of the first camera in the base frame, or of someone who stands behind the base and looks
        along its x axis.
        """
        view = next(iter(self._start.cameras), None)
        if view is None:
            return np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        tracks = self._tracks(self._start.state[None])
        pose = tracks.T_base_camera[0, tracks.views.index(view)]
        away = pose[:3, 2] + 1e-3 * -pose[:3, 1]  # of a camera that looks straight down: where its picture's top is
        away = np.array([away[0], away[1], 0.0]) / max(float(np.hypot(away[0], away[1])), 1e-9)
        up = np.array([0.0, 0.0, 1.0])
        return np.stack([np.cross(away, up), away, up], axis=1)

    def _tracks(self, rows: np.ndarray) -> EpisodeTracks:
        """Tracks of these commands, which follow the start."""
        tracks = project_controls(
            self._start.cameras, self._image_size, self._kinematics,
            controls=np.concatenate((self._start.state[None], rows)), fps=self._fps,
        )  # fmt: skip
        return tracks.clip(range(1, tracks.num_frames))

    def take_over(self, command: np.ndarray) -> None:
        """Go on from another command: after a policy, or at another moment."""
        self.command = np.array(command, np.float64)
        self._wanted = self._poses()
        self._seen = self._tracks(self.command[None])

    def _poses(self) -> np.ndarray:
        return self._kinematics.tool_poses(self.command[None])[0].numpy()

    def tick(self, arms: Sequence[ArmInput]) -> np.ndarray:
        """The command (j) of the next frame.

        Raises: DataError: the wishes are not of this robot's arms, or a goal is in a view that is not there.
        """
        described = self._kinematics.embodiment.arms
        if len(arms) != len(described):
            raise DataError("Wishes are given for each arm", expected=[arm.name for arm in described], got=len(arms))
        wanted = self._wanted.copy()
        for index, wish in enumerate(arms):
            shift = self._axes @ np.array(wish.move) * SPEED_M_S / self._fps
            if wish.goal is not None:
                shift = self._towards(index, wish.goal)
            wanted[index, :3, 3] += shift
            turn = Rotation.from_rotvec(self._axes @ np.array(wish.turn) * TURN_RAD_S / self._fps).as_matrix()
            wanted[index, :3, :3] = turn @ wanted[index, :3, :3]
        found = self._solver.solve(self.command, wanted, iterations=ITERATIONS)
        self.command = found.state
        for arm, wish in zip(described, arms, strict=True):
            column, gripper = self._kinematics.embodiment.gripper_column(arm), arm.gripper
            step = wish.grip * GRIPPER_S / self._fps * (gripper.open - gripper.closed)
            low, high = sorted((gripper.closed, gripper.open))
            self.command[column] = np.clip(self.command[column] + step, low, high)
        lost = (found.position_error_m > LOST_M) | (found.rotation_error_rad > LOST_RAD)
        self._wanted = np.where(lost[:, None, None], self._poses(), wanted) if lost.any() else wanted
        self._seen = self._tracks(self.command[None])
        return self.command.copy()

    def copy(self) -> Teleoperation:
        """Another one from here on."""
        return copy(self)

    def _towards(self, arm: int, goal: Goal) -> np.ndarray:
        """Step [m] of a tool towards the point of its own depth that a view shows at a pixel."""
        seen = self._seen
        if goal.view not in self._start.images:
            raise DataError("No such view", expected=list(self._start.images), got=goal.view)
        if goal.view not in self._start.cameras:
            raise DataError(
                "Nothing can be dragged in a view without a camera",
                where=goal.view,
                next_step="use keys, or another view",
            )
        v = seen.views.index(goal.view)
        height, width = seen.image_size
        ray = np.linalg.solve(seen.K[v], np.array([goal.u * width - 0.5, goal.v * height - 0.5, 1.0]))
        T = seen.T_base_camera[0, v].astype(np.float64)
        point = T[:3, :3] @ (ray * float(seen.depth[0, v, arm])) + T[:3, 3]
        way = point - self._wanted[arm, :3, 3]
        return way * min(1.0, SPEED_M_S / self._fps / max(float(np.linalg.norm(way)), 1e-9))

    def marks(self) -> dict[str, Any]:
        """Places of the commanded tools: `views` as of `frame_marks`, and `position` [m] by arm."""
        return {
            "views": frame_marks(self._seen, 0, list(self._start.images)),
            "position": self._seen.T_base_tool[0, :, :3, 3].tolist(),
        }


def frame_marks(tracks: EpisodeTracks, frame: int, views: Sequence[str]) -> dict[str, list[dict[str, Any] | None]]:
    """By view and arm: the tool's place and the end of its axis out of the gripper, as shares of the picture, and its
    opening; None where the view does not show it."""
    size = np.array(tracks.image_size[::-1])
    places = (tracks.uv[frame].astype(np.float64) + 0.5) / size
    tips = (axis_tips(tracks, frame)[..., 2, :] + 0.5) / size

    def mark(v: int, arm: int) -> dict[str, Any] | None:
        if not tracks.valid[frame, v, arm]:
            return None
        tip = None if np.isnan(tips[v, arm]).any() else tips[v, arm].tolist()
        return {"at": places[v, arm].tolist(), "tip": tip, "open": float(tracks.gripper[frame, v, arm])}

    return {view: [mark(tracks.views.index(view), arm) for arm in range(len(tracks.arms))] for view in views}
