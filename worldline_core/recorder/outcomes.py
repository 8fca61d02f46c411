"""Outcomes of episodes, measured on the simulated motion, never taken from the controller's intent."""

from __future__ import annotations

from typing import Any

import numpy as np

from worldline_core.errors import DataError
from worldline_core.recorder.scene import (
    BUTTON_DOWN,
    BUTTON_TRAVEL,
    DRAWER_TRAVEL,
    HANDLES,
    Layout,
    SceneModel,
)

# What counts as done.
LIFTED = 0.07
ON_PAD = 0.05
DRAWER_OPEN = 0.25
# An opening at which nothing is held any more.
RELEASED = 0.88


def outcome(scene: SceneModel, data: Any, layout: Layout, qpos: np.ndarray, tool: np.ndarray) -> tuple[str, str]:
    """(``success`` or ``failure``, what went wrong: ``missed``, ``dropped``, ``slipped``, ``wrong place``, ``incomplete``).

    lift: in the last half second the thing is 7 cm above where it stood. place: it stands on the pad, its centre within
    5 cm of the pad's (less on a small one), and no finger touches it. close: the drawer is at most a quarter open. press: the cap is down.
    carry: in the last half second both ends of the tray are 7 cm above the table.

    Args:
        data: at the last frame.
        qpos: (N, nq) positions at every frame.
        tool: (N, 3) where the acting tool is.
    """
    model = scene.model
    address = int(model.joint(f"{layout.target.kind}_0").qposadr[0])
    if layout.family == "close":
        opened = qpos[:, address] / DRAWER_TRAVEL
        if opened[-1] < DRAWER_OPEN:
            return "success", ""
        return "failure", "missed" if opened[-1] > 0.93 else "incomplete"
    if layout.family == "press":
        down = qpos[-1, address] / BUTTON_TRAVEL
        if down > BUTTON_DOWN:
            return "success", ""
        other = qpos[-1, int(model.joint("button_1").qposadr[0])] > BUTTON_DOWN * BUTTON_TRAVEL
        return "failure", "wrong place" if other else "incomplete" if down > 0.1 else "missed"
    if layout.family == "carry":
        return _carried(scene, layout, qpos, address)
    position = qpos[:, address : address + 3]
    height = position[:, 2] - layout.target.standing
    touched = _touched(scene, data, f"{layout.target.kind}_0")
    if layout.family == "lift":
        if height[-4:].min() > LIFTED:
            return "success", ""
        if height.max() < 0.015:
            return "failure", "missed"
        if height[-1] > 0.01 and touched:
            return "failure", "incomplete"
        return "failure", "slipped" if _released_at(scene, layout, qpos, position, tool) is None else "dropped"
    if layout.goal is None:
        raise DataError("The layout does not fit the task", where=layout.family, expected="a pad")
    distance = float(np.linalg.norm(position[-1, :2] - layout.goal.xy))
    if abs(height[-1]) < 0.012 and distance < ON_PAD * layout.goal.size and not touched:
        return "success", ""
    if height.max() < 0.015:
        return "failure", "missed"
    if touched or height[-1] > 0.02:
        return "failure", "incomplete"
    released = _released_at(scene, layout, qpos, position, tool)
    if released is None:
        return "failure", "slipped"
    return "failure", "dropped" if height[max(released - 1, 0)] > 0.03 else "wrong place"


def _carried(scene: SceneModel, layout: Layout, qpos: np.ndarray, address: int) -> tuple[str, str]:
    """Outcome of a carry from the heights of the tray's ends; ``address`` is that of its positions."""
    w, x, y, z = qpos[:, address + 3 : address + 7].T
    middle = qpos[:, address + 2] - layout.target.standing
    ends = middle[:, None] + np.outer(2 * (y * z + w * x), list(HANDLES.values()))
    lower, higher = ends.min(axis=1), ends.max(axis=1)
    if lower[-4:].min() > LIFTED:
        return "success", ""
    if higher.max() < 0.015:
        return "failure", "missed"
    # Still up, but not high enough; or one arm lifted its end alone.
    if lower[-1] > 0.01 or lower.max() < 0.03:
        return "failure", "incomplete"
    opened = max(
        scene.robot.opening(qpos[:, scene.arms[arm].finger_qpos])[int(np.argmax(lower)) :].max()
        for arm in layout.acting()
    )
    return "failure", "dropped" if opened > RELEASED else "slipped"


def _touched(scene: SceneModel, data: Any, name: str) -> bool:
    geom = scene.model.geom(name).id
    pairs = data.contact.geom[: data.ncon]
    return any(geom in pair and scene.robot_geoms[pair].any() for pair in pairs)


def _released_at(
    scene: SceneModel, layout: Layout, qpos: np.ndarray, position: np.ndarray, tool: np.ndarray
) -> int | None:
    """The frame at which a raised thing left the hand because the gripper opened wide; None when it left otherwise."""
    opening = scene.robot.opening(qpos[:, scene.arms[layout.arm].finger_qpos])
    raised = int(np.argmax(position[:, 2] - layout.target.standing > 0.015))
    away = np.linalg.norm(position - tool, axis=1)
    left = np.flatnonzero(away[raised:] > away[raised] + 0.02)
    if len(left) == 0:
        return None
    frame = raised + int(left[0])
    # A quarter of a second: an opening gripper has opened by then, a relaxed one stays where it is.
    return frame if opening[frame : frame + 3].max() > RELEASED else None
