"""One episode: plan it, run the physics, judge from the motion (never from the plan) how it ended, film it.

Things are large and seen from near, plans that go wrong go wrong by a hand's width, grippers take more than half a
second, and how it ended shows in the last quarter: a model of 64 x 96 pixels can see and foresee it
(``docs/recorded_worlds.md``).

The joint targets of frame t are commanded at t and interpolated linearly up to those of frame t+1, so that the recorded
actions alone reproduce the motion.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np

from worldline_core.data.episodes.episode import Episode
from worldline_core.errors import DataError
from worldline_core.recorder.bodies import BODIES, CENTRE, HELD_OUT_BODY, Robot
from worldline_core.recorder.contact_tasks import CONTACT_TASKS, Ended, apply_contact_layout, build_contact_scene
from worldline_core.recorder.controllers import (
    ArmSolver,
    ScriptedPolicy,
    Waypoint,
    late,
    missing,
    plan_waypoints,
    sample_waypoints,
    shifted,
    tool_rotation,
)
from worldline_core.recorder.looks import HELD_OUT_CAMERA, SCENES, Look, LookName, look_of, scenes, trains
from worldline_core.recorder.rendering import SceneRenderer
from worldline_core.recorder.scene import (
    BUTTON_DOWN,
    BUTTON_TRAVEL,
    CONTACT,
    DRAWER_TRAVEL,
    FRAME_RATE,
    HANDLES,
    LIFTED,
    SUBSTEPS,
    Layout,
    SceneModel,
    apply_layout,
    build_scene,
    light_buttons,
    sample_layout,
    thing_labels,
)

# Largest accepted distance between a planned tool position and what the arm can reach.
REACH_TOLERANCE_M = 0.012
# What a recorded episode calls a task: what changes a thing's state is one family, whatever is lifted another.
_TASK_FAMILIES = {
    **dict.fromkeys(("close", "press", "roll"), "state_change"),
    **dict.fromkeys(("carry", "grip", "balance", "topple", "both", "level"), "lift"),
    **dict.fromkeys(("detour", "peg", "stack"), "place"),
}
# Share of the training episodes in which a body's links have drawn colours instead of its own.
REPAINTED = 0.4
# Thresholds of success, beside LIFTED.
ON_PAD = 0.05
DRAWER_OPEN = 0.25
# A gripper that is open by more than this holds nothing.
RELEASED = 0.88


@dataclass(frozen=True)
class Job:
    """One episode to record, with the seed of all its draws."""

    episode_id: str
    embodiment: str
    split: str
    family: str
    entropy: tuple[int, ...]
    defect: str | None = None
    held_out_camera: bool = False
    look: LookName = "plain"
    policy: ScriptedPolicy | None = None
    num_frames: int = 33


@dataclass(frozen=True)
class ExecutedMotion:
    """``state`` and ``action`` (N, J), full positions ``qpos`` (N, nq), and the measured outcome.

    ``failure`` says what went wrong; ``facts``: what a contact task measured, and the size of a miss.
    """

    state: np.ndarray
    action: np.ndarray
    qpos: np.ndarray
    outcome: str
    failure: str = ""
    facts: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Recording:
    """An episode with its frames ``(N, H, W, 3)`` and exact robot masks ``(N, h, w)`` by view; what went wrong in it.

    ``thing_labels``: uint8 (N, h, w) by view, which thing a pixel shows: 1 what the task moves, 2 where it goes, 3..
    others, 0 none.
    """

    episode: Episode
    frames: dict[str, np.ndarray]
    robot_masks: dict[str, np.ndarray]
    failure: str = ""
    thing_labels: dict[str, np.ndarray] = field(default_factory=dict)


def draw_layout(robot: Robot, family: str, random: np.random.Generator, look: Look) -> Layout:
    """Draw an initial state for any task."""
    task = CONTACT_TASKS.get(family)
    return task.layout(robot, random, look) if task else sample_layout(robot, family, random, look)


def motor_targets(scene: SceneModel, action: np.ndarray) -> np.ndarray:
    """(N, nu) targets of all servos for actions (N, J)."""
    control = np.zeros((len(action), scene.model.nu))
    given = action.astype(np.float64)  # stored as float32; the simulator is driven by exactly what is stored
    for arm in scene.arms:
        control[:, arm.actuators] = given[:, arm.columns]
        control[:, arm.finger_actuators] = scene.robot.fingers(given[:, [arm.gripper]])
    return control


def place_arms(scene: SceneModel, data: Any, command: np.ndarray) -> None:
    """Put the arms where a command (J,) sends them; things stay."""
    import mujoco

    for arm in scene.arms:
        data.qpos[arm.qpos] = command[arm.columns]
        data.qpos[arm.finger_qpos] = scene.robot.fingers(command[arm.gripper].astype(np.float64))
    mujoco.mj_forward(scene.model, data)


def drive(scene: SceneModel, data: Any, before: np.ndarray, after: np.ndarray) -> None:
    """Simulate one frame, in which the servos' targets (nu,) go evenly from ``before`` to ``after``."""
    import mujoco

    for substep in range(SUBSTEPS):
        blend = (substep + 1) / SUBSTEPS
        data.ctrl[:] = (1 - blend) * before + blend * after
        mujoco.mj_step(scene.model, data)


def execute(scene: SceneModel, data: Any, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Drive the simulator with the recorded actions (N, J); ``data`` holds the things at their places.

    Returns: states (N, J) float32 and full positions (N, nq); ``data`` is left at the last frame.
    """
    control = motor_targets(scene, action)
    place_arms(scene, data, action[0])
    states, snapshots = [read_state(scene, data)], [data.qpos.copy()]
    for frame in range(1, len(action)):
        drive(scene, data, control[frame - 1], control[frame])
        states.append(read_state(scene, data))
        snapshots.append(data.qpos.copy())
    return np.array(states, dtype=np.float32), np.array(snapshots)


def read_state(scene: SceneModel, data: Any) -> np.ndarray:
    """(J,) joint positions then opening, arm after arm."""
    parts = ((data.qpos[arm.qpos], [scene.robot.opening(data.qpos[arm.finger_qpos])]) for arm in scene.arms)
    return np.concatenate([part for arm in parts for part in arm])


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
    touched = Ended(scene, data, qpos).touched(f"{layout.target.kind}_0")
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


class EpisodeRecorder:
    """Records episodes of one body; holds the compiled model and its renderers.

    ``contact``: the tasks are contact tasks.

    Raises: DataError for an unknown body.
    """

    def __init__(self, body: str, contact: bool = False) -> None:
        if body not in BODIES:
            raise DataError("Unknown body", expected=" | ".join(sorted(BODIES)), got=body)
        self.scene = build_contact_scene(BODIES[body]) if contact else build_scene(BODIES[body])
        self.contact = contact
        self._solver = ArmSolver(self.scene)
        self._data = self.new_data()
        self._kinematics = self.new_data()
        self._own_colours = self.scene.model.geom_rgba[self.scene.robot_geoms].copy()
        self._renderer: SceneRenderer | None = None

    def new_data(self) -> Any:
        """A state of the world of its own (MuJoCo's ``MjData``), which recording does not touch."""
        import mujoco

        return mujoco.MjData(self.scene.model)

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def move(
        self, layout: Layout, random: np.random.Generator, num_frames: int, policy: ScriptedPolicy | None = None
    ) -> ExecutedMotion | None:
        """Plan and execute, as well or badly as ``policy`` does; None when the plan leaves what the arms can reach.

        Raises: DataError for a layout of the other kind of tasks.
        """
        self._check(layout)
        duration, mistakes = (num_frames - 1) / FRAME_RATE, None if policy is None else policy.mistakes
        robot, acting = self.scene.robot, None
        if self.contact:
            knows = mistakes is not None and random.uniform() >= mistakes
            acting = CONTACT_TASKS[layout.family].plan(robot, layout, random, knows)
        plans = plan_waypoints(robot, layout, random, duration, mistakes=mistakes, acting=acting)
        if policy is not None:
            if policy.miss is not None:
                missing(robot, layout, plans, policy.miss, random)
            for arm in layout.acting():
                plans[arm] = shifted(plans[arm], np.array(policy.bias_m) + random.normal(0, policy.noise_m, 2))
        action = self.follow(plans, num_frames)
        if action is None:
            return None
        if policy is not None:
            action = late(action, policy.delay_frames)
            grippers = [arm.gripper for arm in self.scene.arms]
            action[:, grippers] = late(action, policy.gripper_delay_frames)[:, grippers]
        motion = self.replay(layout, action)
        if policy is None or policy.miss is None:
            return motion
        return replace(motion, facts=motion.facts | {f"miss_{policy.miss.kind}": policy.miss.size})

    def set_up(self, data: Any, layout: Layout) -> None:
        """Put every thing at its place in ``data``, with its looks; raises as `move`."""
        self._check(layout)
        (apply_contact_layout if self.contact else apply_layout)(self.scene, data, layout)

    def _check(self, layout: Layout) -> None:
        if (layout.family in CONTACT) != self.contact:
            raise DataError(
                "The scene lacks the task's things", where=layout.family,
                expected="a contact task" if self.contact else "no contact task",
            )  # fmt: skip

    def follow(self, plans: list[list[Waypoint]], num_frames: int) -> np.ndarray | None:
        """Actions (N, J) that lead every arm along its waypoints; None when these leave what the arms can reach."""
        times, columns = np.arange(num_frames) / FRAME_RATE, []
        for arm, points in enumerate(plans):
            positions, yaws, openings = sample_waypoints(points, times)
            joints, targets = np.asarray(self.scene.robot.arms[arm].home, dtype=np.float64), []
            for frame, position in enumerate(positions):
                joints, error = self._solver.solve(
                    arm, joints, position, tool_rotation(yaws[frame]), 300 if frame == 0 else 80
                )
                if error > REACH_TOLERANCE_M:
                    return None
                targets.append(joints)
            columns += [np.array(targets), openings[:, None]]
        return np.concatenate(columns, axis=1).astype(np.float32)

    def replay(self, layout: Layout, action: np.ndarray) -> ExecutedMotion:
        """Execute recorded actions (N, J) from the layout's initial state."""
        self.set_up(self._data, layout)
        state, qpos = execute(self.scene, self._data, action)
        if self.contact:
            failure, facts = CONTACT_TASKS[layout.family].judge(Ended(self.scene, self._data, qpos), layout)
            return ExecutedMotion(state, action, qpos, "failure" if failure else "success", failure, facts)
        tool = self.tool_positions(layout.arm, qpos)
        return ExecutedMotion(state, action, qpos, *outcome(self.scene, self._data, layout, qpos, tool))

    def film(
        self,
        layout: Layout,
        motion: ExecutedMotion,
        *,
        episode_id: str,
        scene_id: str,
        split: str,
        jitter: np.random.Generator,
        bank: str | None = None,
        candidate: int | None = None,
        masked: bool = True,
        held_out_camera: bool = False,
    ) -> Recording:
        """Render a motion in a scene and describe it as an episode; with masks of the robot and of things unless told otherwise.

        With ``held_out_camera`` the head camera stands where it never stands otherwise.
        """
        if self._renderer is None:
            self._renderer = SceneRenderer(self.scene)
        # Another layout may have been executed since: this one decides where objects stand and what they look like.
        self.set_up(self._data, layout)
        self._set_scene(self._renderer, scene_id, jitter, held_out_camera)
        labels = thing_labels(self.scene, layout)
        frames, masks, things, cameras = self._renderer.render(
            motion.qpos, lambda qpos: light_buttons(self.scene, layout, qpos), labels if masked else None
        )
        drawn = scene_id not in SCENES
        held_out = {
            "look": scene_id.startswith("unseen"),
            "body": self.scene.robot.name == HELD_OUT_BODY,
            "camera": held_out_camera,
        }
        shift = "+".join(name for name, holds in held_out.items() if holds and drawn)
        episode = Episode(
            episode_id=episode_id,
            source="worldline_recorder",
            embodiment=self.scene.robot.name,
            scene=scene_id,
            task_family=_TASK_FAMILIES.get(layout.family, layout.family),
            instruction=layout.instruction,
            outcome=motion.outcome,
            split=split,
            fps=float(FRAME_RATE),
            state=motion.state,
            action=motion.action,
            timestamps=np.arange(len(motion.state)) / FRAME_RATE,
            cameras=cameras,
            bank=bank,
            candidate=candidate,
            primary_view="head",
            state_names=self.scene.state_names,
            conventions={"shift": shift} if shift else {},
        )
        return Recording(episode, frames, masks, motion.failure, things)

    def draw(self, job: Job) -> tuple[Layout, ExecutedMotion, str, np.random.Generator]:
        """Layout, executed motion and scene id of one episode, and the generator to continue with for its cameras.

        Raises: DataError when no reachable plan is found in 50 draws.
        """
        random = np.random.default_rng(job.entropy)
        scene_id = str(random.choice(scenes(job.look, job.split in ("train", "validation"))))
        for _ in range(50):
            layout = draw_layout(self.scene.robot, job.family, random, look_of(scene_id))
            motion = self.move(layout, random, job.num_frames, job.policy)
            if motion is not None:
                return layout, motion, scene_id, random
        raise DataError(
            "No reachable plan found", where=f"episode {job.episode_id}", next_step="check the robot's reach"
        )

    def record(self, job: Job) -> Recording:
        """Draw, execute and film one episode, a function of the job's ``entropy``; raises as :meth:`draw`."""
        layout, motion, scene_id, random = self.draw(job)
        return self.film(
            layout, motion, episode_id=job.episode_id, scene_id=scene_id, split=job.split, jitter=random,
            held_out_camera=job.held_out_camera,
        )  # fmt: skip

    def tool_positions(self, arm: int, qpos: np.ndarray) -> np.ndarray:
        """(N, 3) of an arm's tool."""
        import mujoco

        model, data, site = self.scene.model, self._kinematics, self.scene.arms[arm].tool_site
        positions = []
        for positions_of_frame in qpos:
            data.qpos[:] = positions_of_frame
            mujoco.mj_kinematics(model, data)
            positions.append(data.site_xpos[site].copy())
        return np.array(positions)

    def _set_scene(
        self, renderer: SceneRenderer, scene_id: str, jitter: np.random.Generator, held_out_camera: bool
    ) -> None:
        """Colours, light and cameras of an episode."""
        look = look_of(scene_id)
        place = HELD_OUT_CAMERA if held_out_camera else look.head
        azimuth, elevation, distance = (
            jitter.uniform(*limits) for limits in (place.aside_deg, place.elevation_deg, place.distance)
        )
        turn, rise = np.deg2rad(azimuth * jitter.choice([-1.0, 1.0])), np.deg2rad(elevation)
        target = np.array(CENTRE) + jitter.normal(0, 0.01, 3)
        back = np.array([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)])
        renderer.set_look(look)
        self._paint_body(jitter, repaint=trains(scene_id) and jitter.uniform() < REPAINTED)
        renderer.place_cameras(target + distance * back, target)

    def _paint_body(self, random: np.random.Generator, repaint: bool) -> None:
        """Give each link its own colour, or, link by link of one colour, another weakly saturated one."""
        colours = self._own_colours.copy()
        if repaint:
            for colour in np.unique(self._own_colours, axis=0):
                if colour[3] > 0:
                    hue, saturation, value = random.uniform(0, 360), random.uniform(0, 0.22), random.uniform(0.12, 0.9)
                    drawn = cv2.cvtColor(np.array([[[hue, saturation, value]]], np.float32), cv2.COLOR_HSV2RGB)[0, 0]
                    colours[(self._own_colours == colour).all(axis=1), :3] = drawn
        self.scene.model.geom_rgba[self.scene.robot_geoms] = colours
