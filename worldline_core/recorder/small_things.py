"""The things of the small world: their model, where they stand in an episode, what is asked and how it ended.

Outcomes and failures are read from the simulated motion, never from what the controller meant to do. All lengths in
metres, base frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from worldline_core.errors import DataError
from worldline_core.recorder.robots import Robot
from worldline_core.recorder.scene_model import PARKED, SceneModel, add_room, compile_scene, scene_spec, slide_joint
from worldline_core.recorder.task_layout import OBJECT_COLOURS, side

# Half sizes. Grippers open to 8 cm, so a thing is 6 cm wide and stands tall.
BLOCK_HALF = (0.030, 0.030, 0.065)
CAN_RADIUS, CAN_HALF = 0.031, 0.060
PAD_RADIUS = 0.065
DRAWER_HALF, DRAWER_TRAVEL = (0.075, 0.060, 0.032), 0.14
BUTTON_PLATE_HALF, BUTTON_CAP_RADIUS, BUTTON_CAP_HALF, BUTTON_TRAVEL = 0.055, 0.034, 0.018, 0.026
PLATE_TOP = 0.024
# A tray with a handle near each end, as wide as a block: one for each arm. Its ends lie along its own y.
TRAY_HALF, HANDLE_HALF, HANDLE_APART = (0.048, 0.150, 0.010), (0.028, 0.028, 0.050), 0.115
HANDLES = {"left": HANDLE_APART, "right": -HANDLE_APART}
# What counts as done.
LIFTED = 0.07
ON_PAD = 0.05
DRAWER_OPEN = 0.25
BUTTON_DOWN = 0.5
# An opening at which nothing is held any more.
RELEASED = 0.88
TASKS = ("lift", "place", "close", "press", "carry")
# How many of each kind a scene can hold.
KINDS = {"block": 2, "can": 2, "pad": 2, "button": 2, "drawer": 1, "tray": 1}
# Height of a free thing's origin where it stands.
STANDING = {"block": BLOCK_HALF[2], "can": CAN_HALF, "tray": TRAY_HALF[2]}
UNLIT = (0.17, 0.17, 0.18)


@dataclass(frozen=True)
class Thing:
    """A thing on the table; a drawer's place is that of its front when closed."""

    kind: str
    colour: str
    x: float
    y: float
    yaw: float = 0.0

    @property
    def xy(self) -> np.ndarray:
        return np.array([self.x, self.y])


@dataclass(frozen=True)
class SmallLayout:
    """Initial state and instruction of an episode.

    Attributes:
        family: one of TASKS.
        arm: number of the arm that acts; of a carry, in which both act, the first.
        start: per arm (x, y, z, yaw, opening) of the tool and gripper at the first frame.
        target: what is lifted, placed, closed, pressed or carried.
        goal: the pad of a place.
        others: distractors.
    """

    family: str
    instruction: str
    arm: int
    start: np.ndarray
    target: Thing
    goal: Thing | None
    others: tuple[Thing, ...]

    def acting(self) -> tuple[int, ...]:
        """Numbers of the arms that act."""
        return tuple(range(len(self.start))) if self.family == "carry" else (self.arm,)

    def named(self) -> list[tuple[str, Thing]]:
        """Every thing with the name of its body: ``block_0``, ``block_1``, ..; the target is the first of its kind."""
        things = [thing for thing in (self.target, self.goal, *self.others) if thing is not None]
        counted: dict[str, int] = {}
        names = []
        for thing in things:
            number = counted.get(thing.kind, 0)
            counted[thing.kind] = number + 1
            names.append((f"{thing.kind}_{number}", thing))
        return names


def build_small_scene(robot: Robot) -> SceneModel:
    """Compile a body's model with all things, parked until a layout uses them."""
    import mujoco

    spec = scene_spec(robot)
    add_room(spec)
    box, cylinder = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
    shapes = {"block": (box, BLOCK_HALF), "can": (cylinder, (CAN_RADIUS, CAN_HALF, 0.0))}
    contact = {"condim": 4, "friction": [1.0, 0.02, 0.001], "solref": [0.01, 1.0]}
    for kind, (shape, size) in shapes.items():
        for number in range(KINDS[kind]):
            name = f"{kind}_{number}"
            body = spec.worldbody.add_body(name=name, pos=PARKED)
            body.add_freejoint(name=name)
            body.add_geom(name=name, type=shape, size=size, mass=0.08, **contact)
    tray = spec.worldbody.add_body(name="tray_0", pos=PARKED)
    tray.add_freejoint(name="tray_0")
    # Heavy and smooth enough that one hand alone raises one end only.
    heavy = contact | {"friction": [0.6, 0.02, 0.001], "priority": 1}
    tray.add_geom(name="tray_0", type=box, size=TRAY_HALF, mass=1.0, **heavy)
    for name, along in HANDLES.items():
        place = [0, along, TRAY_HALF[2] + HANDLE_HALF[2]]
        tray.add_geom(name=f"tray_0_{name}", type=box, size=HANDLE_HALF, pos=place, mass=0.05, **heavy)
    seen_only = {"contype": 0, "conaffinity": 0}
    for number in range(KINDS["pad"]):
        pad = spec.worldbody.add_body(name=f"pad_{number}", pos=PARKED)
        pad.add_geom(name=f"pad_{number}", type=cylinder, size=[PAD_RADIUS, 0.0015, 0], **seen_only)
    for number in range(KINDS["button"]):
        name = f"button_{number}"
        button = spec.worldbody.add_body(name=name, pos=PARKED)
        half = PLATE_TOP / 2
        plate = [BUTTON_PLATE_HALF, BUTTON_PLATE_HALF, half]
        button.add_geom(name=f"{name}_plate", type=box, size=plate, pos=[0, 0, half], **seen_only)
        cap = button.add_body(name=f"{name}_cap", pos=[0, 0, PLATE_TOP + BUTTON_CAP_HALF], gravcomp=1.0)
        slide_joint(cap, name, axis=[0, 0, -1], travel=BUTTON_TRAVEL, frictionloss=2.0, armature=0.1, damping=8.0)
        cap.add_geom(name=name, type=cylinder, size=[BUTTON_CAP_RADIUS, BUTTON_CAP_HALF, 0], mass=0.05, condim=3)
    cabinet = spec.worldbody.add_body(name="drawer_0", pos=PARKED)
    deep, wide, high = DRAWER_HALF
    wall = 0.008
    shell = {
        "top": ([deep, wide + wall, wall], [deep + wall, 0, 2 * high + 2 * wall]),
        "left": ([deep, wall, high + wall], [deep + wall, wide + 2 * wall, high + wall]),
        "right": ([deep, wall, high + wall], [deep + wall, -wide - 2 * wall, high + wall]),
    }
    for part, (size, pos) in shell.items():
        cabinet.add_geom(name=f"drawer_0_{part}", type=box, size=size, pos=pos, rgba=[*UNLIT, 1], **seen_only)
    drawer = cabinet.add_body(name="drawer_0_box", gravcomp=1.0)
    slide_joint(drawer, "drawer_0", axis=[-1, 0, 0], travel=DRAWER_TRAVEL, frictionloss=0.8, armature=0.3, damping=6.0)
    drawer.add_geom(name="drawer_0", type=box, size=[deep, wide, high], pos=[deep, 0, high + wall], mass=0.3, condim=3)
    return compile_scene(spec, robot)


def _spot(
    robot: Robot, arm: int, random: np.random.Generator, taken: list[np.ndarray], apart: float, beyond: float = 0.0
) -> np.ndarray:
    """(x, y) of the arm's half, at least ``apart`` from what is taken; the farthest of 60 draws where there is no room.

    ``beyond`` [m]: so far before and behind what the arms reach.
    """
    best, distance = np.zeros(2), -1.0
    for _ in range(60):
        x, y = (
            random.uniform(robot.reach_x[0] - beyond, robot.reach_x[1] + beyond),
            side(robot, arm) * random.uniform(*robot.reach_y),
        )
        spot = np.array([x, y])
        nearest = min((float(np.linalg.norm(spot - other)) for other in taken), default=np.inf)
        if nearest > distance:
            best, distance = spot, nearest
        if nearest >= apart:
            break
    return best


def sample_small_layout(robot: Robot, family: str, random: np.random.Generator) -> SmallLayout:
    """Draw an initial state for a task."""
    arm = int(random.integers(len(robot.arms)))
    colours = [str(colour) for colour in random.permutation(sorted(OBJECT_COLOURS))]
    start = np.stack([[*free_tool(robot, a, random), random.uniform(0.0, 1.0)] for a in range(len(robot.arms))])
    kind = str(random.choice(["block", "can"]))
    goal = None
    taken: list[np.ndarray] = []
    if family == "close":
        y = side(robot, arm) * random.uniform(robot.reach_y[0] + 0.05, robot.reach_y[1] - 0.05)
        target = Thing("drawer", colours[0], robot.reach_x[1] + float(random.uniform(0.0, 0.03)), float(y))
        taken = [target.xy - [reach, 0.0] for reach in (0.0, 0.07, 0.14)]
        instruction = f"push the {colours[0]} drawer closed"
    elif family == "press":
        x, y = _spot(robot, arm, random, taken, 0.0)
        target = Thing("button", colours[0], float(x), float(y))
        instruction = f"press the {colours[0]} button"
    elif family == "carry":
        x, y = random.uniform(robot.reach_x[0] + 0.01, robot.reach_x[1] - 0.01), random.uniform(-0.04, 0.04)
        target = Thing("tray", colours[0], float(x), float(y), float(random.uniform(-0.12, 0.12)))
        taken = [target.xy + np.array([0.0, along]) for along in (-0.1, 0.0, 0.1)]
        instruction = f"lift the {colours[0]} tray with both arms"
    else:
        x, y = _spot(robot, arm, random, taken, 0.0)
        target = Thing(kind, colours[0], float(x), float(y), float(random.uniform(-0.4, 0.4)))
        instruction = f"lift the {colours[0]} {kind}"
        if family == "place":
            x, y = _spot(robot, arm, random, [target.xy], 0.15)
            goal = Thing("pad", colours[1], float(x), float(y))
            instruction = f"place the {colours[0]} {kind} on the {colours[1]} pad"
    taken += [thing.xy for thing in (target, goal) if thing is not None]
    others: list[Thing] = []
    for colour in colours[2 : 2 + int(random.integers(0, 3))]:
        # A second button stands within reach of the same arm, so that it can be pressed by mistake.
        second = family == "press" and not others
        choices = ["button"] if second else ["block", "can", "pad"]
        half = arm if second else int(random.integers(len(robot.arms)))
        spot = _spot(robot, half, random, taken, 0.15, 0.09 if family == "carry" else 0.0)
        if min(float(np.linalg.norm(spot - other)) for other in taken) < 0.15:
            continue
        thing = Thing(
            str(random.choice(choices)), colour, float(spot[0]), float(spot[1]), float(random.uniform(-0.7, 0.7))
        )
        if sum(thing.kind == other.kind for other in (target, goal, *others) if other is not None) < KINDS[thing.kind]:
            others.append(thing)
            taken.append(spot)
    return SmallLayout(family, instruction, arm, start, target, goal, tuple(others))


def free_tool(robot: Robot, arm: int, random: np.random.Generator) -> np.ndarray:
    """(x, y, z, yaw) of a tool above the things."""
    x, y = random.uniform(*robot.reach_x), side(robot, arm) * random.uniform(robot.reach_y[0] + 0.02, robot.reach_y[1])
    return np.array([x, y, random.uniform(0.18, 0.25), random.uniform(-0.4, 0.4)])


def apply_small_layout(scene: SceneModel, data: Any, layout: SmallLayout) -> None:
    """Reset ``data`` and put every thing at its place; the others float far away."""
    import mujoco

    model = scene.model
    mujoco.mj_resetData(model, data)
    used = dict(layout.named())
    for kind, count in KINDS.items():
        for number in range(count):
            name = f"{kind}_{number}"
            thing = used.get(name)
            body = model.body(name).id
            if kind in STANDING:
                address = int(model.joint(name).qposadr[0])
                model.body_gravcomp[body] = 1.0 if thing is None else 0.0
                place = PARKED + np.array([0.3 * number, 0.3 * list(STANDING).index(kind), 0.0])
                angle = 0.0
                if thing is not None:
                    place, angle = np.array([thing.x, thing.y, STANDING[kind] + 0.0005]), thing.yaw / 2
                data.qpos[address : address + 7] = [*place, np.cos(angle), 0, 0, np.sin(angle)]
            else:
                height = 0.0015 if kind == "pad" else 0.0
                model.body_pos[body] = PARKED if thing is None else [thing.x, thing.y, height]
            if thing is not None:
                for part in (name, *(f"{name}_{end}" for end in HANDLES if kind == "tray")):
                    model.geom_rgba[model.geom(part).id] = [*OBJECT_COLOURS[thing.colour], 1.0]
    opened = DRAWER_TRAVEL if "drawer_0" in used else 0.0
    data.qpos[int(model.joint("drawer_0").qposadr[0])] = opened


def thing_labels(scene: SceneModel, layout: SmallLayout) -> np.ndarray:
    """uint8 (number of geoms,): 1 for those of the target, 2 of the goal, 3.. of the others, 0 for the rest.

    Of a drawer only what slides belongs to it; a button's plate belongs to it, because it lights up.
    """
    labels = np.zeros(scene.model.ngeom, np.uint8)
    others = 3
    for name, thing in layout.named():
        label = 1 if thing is layout.target else 2 if thing is layout.goal else others
        others += label > 2
        labels[scene.model.geom(name).id] = label
        for part in {"button": ("plate",), "tray": tuple(HANDLES)}.get(thing.kind, ()):
            labels[scene.model.geom(f"{name}_{part}").id] = label
    return labels


def light_buttons(scene: SceneModel, layout: SmallLayout, qpos: np.ndarray) -> None:
    """A button's plate shines in its colour while its cap is down."""
    model = scene.model
    for name, thing in layout.named():
        if thing.kind == "button":
            down = qpos[int(model.joint(name).qposadr[0])] > BUTTON_DOWN * BUTTON_TRAVEL
            model.geom_rgba[model.geom(f"{name}_plate").id] = [*(OBJECT_COLOURS[thing.colour] if down else UNLIT), 1.0]


def small_outcome(
    scene: SceneModel, data: Any, layout: SmallLayout, qpos: np.ndarray, tool: np.ndarray
) -> tuple[str, str]:
    """(``success`` or ``failure``, what went wrong: ``missed``, ``dropped``, ``slipped``, ``wrong place``, ``incomplete``).

    lift: in the last half second the thing is 7 cm above where it stood. place: it stands on the pad, its centre within
    5 cm of the pad's, and no finger touches it. close: the drawer is at most a quarter open. press: the cap is down.
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
    height = position[:, 2] - STANDING[layout.target.kind]
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
    if abs(height[-1]) < 0.012 and distance < ON_PAD and not touched:
        return "success", ""
    if height.max() < 0.015:
        return "failure", "missed"
    if touched or height[-1] > 0.02:
        return "failure", "incomplete"
    released = _released_at(scene, layout, qpos, position, tool)
    if released is None:
        return "failure", "slipped"
    return "failure", "dropped" if height[max(released - 1, 0)] > 0.03 else "wrong place"


def _carried(scene: SceneModel, layout: SmallLayout, qpos: np.ndarray, address: int) -> tuple[str, str]:
    """Outcome of a carry from the heights of the tray's ends; ``address`` is that of its positions."""
    w, x, y, z = qpos[:, address + 3 : address + 7].T
    middle = qpos[:, address + 2] - STANDING["tray"]
    ends = middle[:, None] + np.outer(2 * (y * z + w * x), list(HANDLES.values()))
    lower, higher = ends.min(axis=1), ends.max(axis=1)
    if lower[-4:].min() > LIFTED:
        return "success", ""
    if higher.max() < 0.015:
        return "failure", "missed"
    # Still up, but not high enough; or one arm lifted its end alone.
    if lower[-1] > 0.01 or lower.max() < 0.03:
        return "failure", "incomplete"
    opened = max(_opening(scene, arm, qpos)[int(np.argmax(lower)) :].max() for arm in layout.acting())
    return "failure", "dropped" if opened > RELEASED else "slipped"


def _touched(scene: SceneModel, data: Any, name: str) -> bool:
    geom = scene.model.geom(name).id
    pairs = data.contact.geom[: data.ncon]
    return any(geom in pair and scene.robot_geoms[pair].any() for pair in pairs)


def _released_at(
    scene: SceneModel, layout: SmallLayout, qpos: np.ndarray, position: np.ndarray, tool: np.ndarray
) -> int | None:
    """The frame at which a raised thing left the hand because the gripper opened wide; None when it left otherwise."""
    opening = _opening(scene, layout.arm, qpos)
    raised = int(np.argmax(position[:, 2] - STANDING[layout.target.kind] > 0.015))
    away = np.linalg.norm(position - tool, axis=1)
    left = np.flatnonzero(away[raised:] > away[raised] + 0.02)
    if len(left) == 0:
        return None
    frame = raised + int(left[0])
    # A quarter of a second: an opening gripper has opened by then, a relaxed one stays where it is.
    return frame if opening[frame : frame + 3].max() > RELEASED else None


def _opening(scene: SceneModel, arm: int, qpos: np.ndarray) -> np.ndarray:
    """(N,) how far a gripper is open."""
    closed, opened = scene.robot.finger_travel
    return (qpos[:, scene.arms[arm].finger_qpos].mean(axis=1) - closed) / (opened - closed)
