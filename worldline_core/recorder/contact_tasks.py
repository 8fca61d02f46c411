"""Tasks in which contact decides: a plan's path does not tell how it ends, the first picture and physics do.

Each has something visible that the instruction does not place: which way a bar lies, where its weight is, where poles stand, which of two
frames is wide enough. A careless controller does not look at it: it draws its choice evenly. A good one knows.

Their solid things, whose sizes, masses and places a layout gives, have a model of their own: more bodies in a model
would change the recordings of the other tasks. Metres, base frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from worldline_core.recorder.bodies import REACH_X, Robot
from worldline_core.recorder.controllers import WIDE, Waypoint, first_waypoint, waypoint
from worldline_core.recorder.looks import Look
from worldline_core.recorder.scene import (
    LIFTED,
    OBJECT_COLOURS,
    PARKED,
    Layout,
    SceneModel,
    Thing,
    add_room,
    compile_scene,
    free_tool,
    scene_spec,
)

# How many of each kind a scene can hold, and the largest half size.
LOOSE = {"box": 3, "cylinder": 3, "ball": 1, "bar": 1, "tray": 1}
FIXED = {"wall": 8, "pad": 2}
_LARGEST = 0.12
BAR_HALF, TRAY_HALF, RAIL_AWAY = (0.10, 0.020, 0.025), (0.075, 0.140, 0.008), 0.120
# What has parts is as it is: half sizes, place and mass of each part. The last two are dark: a weight on the +x side, and as much flat paint
# on the other, without which the middle of the colour would point away from the weight.
_Part = tuple[tuple[float, float, float], tuple[float, float, float], float]
_RAIL = (0.075, 0.019, 0.034)
PARTS: dict[str, tuple[_Part, ...]] = {
    "bar": (
        (BAR_HALF, (0.0, 0.0, 0.0), 0.1),
        ((0.020, 0.0202, 0.0252), (-0.078, 0.0, 0.0), 0.001),
        ((0.020, 0.020, 0.042), (0.078, 0.0, 0.017), 0.3),
    ),
    "tray": (
        (TRAY_HALF, (0.0, 0.0, 0.0), 0.2),
        (_RAIL, (0.0, RAIL_AWAY, 0.042), 0.05),
        (_RAIL, (0.0, -RAIL_AWAY, 0.042), 0.05),
        ((0.022, 0.050, 0.0085), (-0.052, 0.0, 0.0), 0.001),
        ((0.022, 0.050, 0.030), (0.052, 0.0, 0.038), 1.7),
    ),
}
_DARK = [0.10, 0.10, 0.11, 1.0]


@dataclass(frozen=True)
class Solid(Thing):
    """A thing of a contact task.

    Attributes:
        half: half sizes along its own axes; of a cylinder or ball (radius, half height, unused).
        z: height of its origin. lying: a cylinder on its side, along its own y.
    """

    half: tuple[float, float, float] = BAR_HALF
    z: float = BAR_HALF[2]
    mass: float = 0.08
    lying: bool = False

    @property
    def standing(self) -> float:
        return self.z


def build_contact_scene(robot: Robot) -> SceneModel:
    """Compile a body's model with all solids, parked until a layout uses them."""
    import mujoco

    spec = scene_spec()
    add_room(spec)
    shape = mujoco.mjtGeom
    shapes = {"box": shape.mjGEOM_BOX, "cylinder": shape.mjGEOM_CYLINDER, "ball": shape.mjGEOM_SPHERE}
    contact = {"condim": 4, "friction": [1.0, 0.02, 0.001], "solref": [0.01, 1.0]}
    for kind, count in (LOOSE | FIXED).items():
        for number in range(count):
            name = f"{kind}_{number}"
            body = spec.worldbody.add_body(name=name, pos=PARKED)
            if kind in LOOSE:
                body.add_freejoint(name=name)
            if kind in PARTS:
                # A hand holds it up, but not against its turning weight.
                slim = contact | {"condim": 3, "friction": [0.8, 0.02, 0.001], "priority": 1}
                for part, (half, pos, mass) in enumerate(PARTS[kind]):
                    made = name if part == 0 else f"{name}_{part}"
                    body.add_geom(name=made, type=shape.mjGEOM_BOX, size=half, pos=pos, mass=mass, **slim)
            elif kind == "pad":
                body.add_geom(name=name, type=shape.mjGEOM_CYLINDER, size=[_LARGEST] * 3, contype=0, conaffinity=0)
            else:
                # A ball rolls on, unless something stops it.
                rolling = {"condim": 6, "friction": [1.0, 0.005, 0.00004], "priority": 1} if kind == "ball" else {}
                form = shapes.get(kind, shape.mjGEOM_BOX)
                body.add_geom(name=name, type=form, size=[_LARGEST] * 3, mass=0.08, **(contact | rolling))
    return compile_scene(spec, robot)


def apply_contact_layout(scene: SceneModel, data: Any, layout: Layout) -> None:
    """Reset ``data``, give every solid its size, mass, colour and place; the others float far away."""
    import mujoco

    model, used = scene.model, {name: thing for name, thing in layout.named() if isinstance(thing, Solid)}
    for name, thing in used.items():
        body, geom = model.body(name).id, model.geom(name).id
        model.geom_rgba[geom] = layout.rgba(thing)
        for part in range(1, len(PARTS.get(thing.kind, ()))):
            dark = part + 2 >= len(PARTS[thing.kind])
            model.geom_rgba[model.geom(f"{name}_{part}").id] = _DARK if dark else layout.rgba(thing)
        if thing.kind not in PARTS:
            model.geom_size[geom] = thing.half
            if thing.kind in LOOSE:
                x, y, z = np.square(
                    thing.half if thing.kind == "box" else (thing.half[0], thing.half[0], thing.half[1])
                )
                model.body_mass[body] = thing.mass
                model.body_inertia[body] = thing.mass / 3 * np.array([y + z, x + z, x + y])
    # What follows from masses and sizes.
    mujoco.mj_setConst(model, data)
    mujoco.mj_resetData(model, data)
    for row, (kind, count) in enumerate((LOOSE | FIXED).items()):
        for number in range(count):
            name = f"{kind}_{number}"
            thing, body = used.get(name), model.body(name).id
            place, turn = PARKED + np.array([0.3 * number, 0.3 * row, 0.0]), np.array([1.0, 0.0, 0.0, 0.0])
            if thing is not None:
                place = np.array([thing.x, thing.y, thing.z + 0.0005 * (kind in LOOSE)])
                turn = np.array([np.cos(thing.yaw / 2), 0.0, 0.0, np.sin(thing.yaw / 2)])
                if thing.lying:
                    mujoco.mju_mulQuat(turn, turn.copy(), np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0]))
            if kind in LOOSE:
                model.body_gravcomp[body] = 1.0 if thing is None else 0.0
                address = int(model.joint(name).qposadr[0])
                data.qpos[address : address + 7] = [*place, *turn]
            else:
                model.body_pos[body], model.body_quat[body] = place, turn


Judged = tuple[str, dict[str, float]]
# A thing that leans by more has fallen [rad].
FALLEN = 0.35
POLE_HALF = (0.013, 0.065, 0.0)


@dataclass(frozen=True)
class Ended:
    """Places of everything in each frame of an executed plan; ``data`` is at the last one."""

    scene: SceneModel
    data: Any
    qpos: np.ndarray

    def place(self, name: str) -> np.ndarray:
        """(N, 3) of a loose thing's origin."""
        address = int(self.scene.model.joint(name).qposadr[0])
        return self.qpos[:, address : address + 3]

    def lean(self, name: str) -> float:
        """Angle between a loose thing's own z axis and the vertical in the last frame [rad]."""
        address = int(self.scene.model.joint(name).qposadr[0]) + 3
        _, x, y, _ = self.qpos[-1, address : address + 4]
        return float(np.arccos(np.clip(1 - 2 * (x * x + y * y), -1, 1)))

    def touched(self, name: str) -> bool:
        """True if the robot touches the thing in the last frame."""
        body = self.scene.model.body(name).id
        pairs = self.data.contact.geom[: self.data.ncon]
        return any(
            (self.scene.model.geom_bodyid[pair] == body).any() and self.scene.robot_geoms[pair].any() for pair in pairs
        )


@dataclass(frozen=True)
class ContactTask:
    """A task.

    Attributes:
        layout: draws an initial state.
        plan: waypoints of the arms that act, by arm, the first at the layout's start; ``knows``: the controller sees what matters.
        judge: what went wrong (nothing: success), and measured facts.
    """

    layout: Callable[[Robot, np.random.Generator, Look], Layout]
    plan: Callable[[Robot, Layout, np.random.Generator, bool], dict[int, list[Waypoint]]]
    judge: Callable[[Ended, Layout], Judged]


def _start(robot: Robot, random: np.random.Generator) -> tuple[int, np.ndarray, list[str]]:
    """The arm that acts, where all arms start, and colours in drawn order."""
    arms = range(len(robot.arms))
    start = np.stack([[*free_tool(robot, arm, random), random.uniform()] for arm in arms])
    return int(random.integers(len(robot.arms))), start, [str(c) for c in random.permutation(sorted(OBJECT_COLOURS))]


def _middle(robot: Robot, arm: int, random: np.random.Generator, beside: float) -> tuple[float, float]:
    """A place in an arm's half, ``beside`` of its borders where there is room."""
    x = random.uniform(REACH_X[0] + beside, max(REACH_X[1] - beside, REACH_X[0] + beside + 0.01))
    low, high = robot.reach_y
    y = random.uniform(low + min(beside, 0.06), high - min(beside, 0.06))
    return float(x), float(robot.side(arm) * y)


def _solid(kind: str, colour: str, xy: np.ndarray | tuple[float, float], yaw: float = 0.0, **shape: Any) -> Solid:
    return Solid(kind, colour, float(xy[0]), float(xy[1]), float(yaw), **shape)


def _goal(layout: Layout) -> np.ndarray:
    """(2,) where the task's goal is."""
    return (layout.target if layout.goal is None else layout.goal).xy


def _half_turn(yaw: float) -> float:
    """The same grasp, turned by less than 90 degrees."""
    return (yaw + np.pi / 2) % np.pi - np.pi / 2


def _raise(
    layout: Layout, arm: int, random: np.random.Generator, xy: np.ndarray, yaw: float, z: float, rise: float
) -> list[Waypoint]:
    """Take what is at ``xy`` and lift it; two arms at the same time."""
    opened, pace = random.uniform(*WIDE), 1.0 if len(layout.acting()) > 1 else random.uniform(0.96, 1.03)
    times = pace * np.array([0.85, 1.3, 1.9, 2.8])
    return [
        first_waypoint(layout, arm),
        waypoint(times[0], xy, 0.21, yaw, opened),
        waypoint(times[1], xy, z, yaw, opened),
        waypoint(times[2], xy, z, yaw, 0.0),
        waypoint(times[3], xy, z + rise, yaw, 0.0),
    ]


def _move(
    layout: Layout, random: np.random.Generator, xy: np.ndarray, yaw: float, z: float, goal: np.ndarray, *, drop: float,
    over: float, via: np.ndarray | None = None,
) -> list[Waypoint]:  # fmt: skip
    """Take what is at ``xy``, bring it to ``goal`` ``over`` the table (through ``via``), let it go ``drop`` above."""
    opened = random.uniform(*WIDE)
    times = random.uniform(0.97, 1.01) * np.array([0.6, 0.9, 1.4, 1.75, 2.2, 2.7, 2.95, 3.3, 3.65])
    middle = (xy + goal) / 2 if via is None else via
    return [
        first_waypoint(layout, layout.arm),
        waypoint(times[0], xy, 0.21, yaw, opened),
        waypoint(times[1], xy, z, yaw, opened),
        waypoint(times[2], xy, z, yaw, 0.0),
        waypoint(times[3], xy, z + over, yaw, 0.0),
        waypoint(times[4], middle, z + over, yaw, 0.0),
        waypoint(times[5], goal, z + over, yaw, 0.0),
        waypoint(times[6], goal, z + drop, yaw, 0.0),
        waypoint(times[7], goal, z + drop, yaw, opened),
        waypoint(times[8], goal, z + drop + 0.11, yaw, opened),
    ]


# grip: a bar that fits between the fingers across, not along.
def _grip_layout(robot: Robot, random: np.random.Generator, look: Look) -> Layout:
    arm, start, colours = _start(robot, random)
    half = (random.uniform(0.056, 0.066), random.uniform(0.018, 0.023), random.uniform(0.032, 0.038))
    x, y = _middle(robot, arm, random, 0.02)
    bar = Solid("box", colours[0], x, y, random.uniform(-np.pi / 2, np.pi / 2), half=half, z=half[2])
    return Layout("grip", f"lift the {colours[0]} bar", arm, start, bar, None, (), look)


def _grip_plan(robot: Robot, layout: Layout, random: np.random.Generator, knows: bool) -> dict[int, list[Waypoint]]:
    bar = layout.target
    yaw = _half_turn(bar.yaw + random.normal(0, 0.1)) if knows else random.uniform(-np.pi / 2, np.pi / 2)
    xy = bar.xy + random.normal(0, 0.005, 2)
    return {layout.arm: _raise(layout, layout.arm, random, xy, yaw, 0.045, random.uniform(0.13, 0.17))}


def _grip_judge(ended: Ended, layout: Layout) -> Judged:
    height = ended.place("box_0")[:, 2] - ended.place("box_0")[0, 2]
    facts = {"height": float(height[-4:].min())}
    return "" if height[-4:].min() > LIFTED else "missed" if height.max() < 0.015 else "slipped", facts


# balance: a bar with a weight at one end, to be raised level.
def _balance_layout(robot: Robot, random: np.random.Generator, look: Look) -> Layout:
    arm, start, colours = _start(robot, random)
    x, y = random.uniform(0.37, 0.40), _middle(robot, arm, random, 0.03)[1]
    yaw = random.uniform(-0.5, 0.5) + np.pi * random.integers(2)
    bar = _solid("bar", colours[0], (x, y), yaw)
    return Layout("balance", f"lift the {colours[0]} bar and keep it level", arm, start, bar, None, (), look)


def _balance_plan(robot: Robot, layout: Layout, random: np.random.Generator, knows: bool) -> dict[int, list[Waypoint]]:
    bar = layout.target
    along = random.uniform(0.045, 0.075) if knows else random.uniform(-0.075, 0.075)
    xy = bar.xy + along * np.array([np.cos(bar.yaw), np.sin(bar.yaw)]) + random.normal(0, 0.004, 2)
    yaw = _half_turn(bar.yaw + random.normal(0, 0.06))
    return {layout.arm: _raise(layout, layout.arm, random, xy, yaw, 0.035, random.uniform(0.13, 0.16))}


def _level_judge(ended: Ended, layout: Layout) -> Judged:
    """Judge `balance` and `level`: a bar or a tray must be lifted and stay level."""
    name, half = ("bar_0", BAR_HALF) if layout.target.kind == "bar" else ("tray_0", TRAY_HALF)
    height, lean = ended.place(name)[:, 2] - half[2], ended.lean(name)
    facts = {"height": float(height[-1]), "lean": lean}
    if height[-1] < 0.03:
        return "missed" if height.max() < 0.03 else "slipped", facts
    return "" if height[-1] > 0.05 and lean < FALLEN else "tilted", facts


# topple: a can between slim poles, which the fingers must not brush.
def _topple_layout(robot: Robot, random: np.random.Generator, look: Look) -> Layout:
    arm, start, colours = _start(robot, random)
    x, y = _middle(robot, arm, random, 0.02)
    can = Solid("cylinder", colours[0], x, y, half=(0.030, 0.060, 0.0), z=0.060)
    first = random.uniform(-np.pi, np.pi)
    poles = []
    for angle in (first, first + random.choice([-1, 1]) * random.uniform(0.6, 1.4)):
        xy = can.xy + random.uniform(0.056, 0.062) * np.array([np.cos(angle), np.sin(angle)])
        poles.append(_solid("cylinder", "white", xy, half=POLE_HALF, z=POLE_HALF[1], mass=0.03))
    instruction = f"lift the {colours[0]} can and knock nothing over"
    return Layout("topple", instruction, arm, start, can, None, tuple(poles), look)


def _topple_plan(robot: Robot, layout: Layout, random: np.random.Generator, knows: bool) -> dict[int, list[Waypoint]]:
    yaw = random.uniform(-np.pi / 2, np.pi / 2)
    if knows:
        # Fingers open along the tool's y axis: as far from all poles as they can be.
        away = np.array([pole.xy - layout.target.xy for pole in layout.others])
        angles = np.arctan2(away[:, 1], away[:, 0]) - np.pi / 2
        choices = np.linspace(-np.pi / 2, np.pi / 2, 60)
        clear = np.abs((choices[:, None] - angles + np.pi / 2) % np.pi - np.pi / 2).min(axis=1)
        yaw = float(choices[np.argmax(clear)])
    xy = layout.target.xy + random.normal(0, 0.003, 2)
    return {layout.arm: _raise(layout, layout.arm, random, xy, yaw, 0.085, random.uniform(0.13, 0.17))}


def _topple_judge(ended: Ended, layout: Layout) -> Judged:
    height = ended.place("cylinder_0")[:, 2] - ended.place("cylinder_0")[0, 2]
    lean = max(ended.lean("cylinder_1"), ended.lean("cylinder_2"))
    facts = {"height": float(height[-4:].min()), "lean": lean}
    return "knocked over" if lean > FALLEN else "" if height[-4:].min() > LIFTED else "missed", facts


# both: two such bars, one for each arm; shorter ones, which leave more room.
def _both_layout(robot: Robot, random: np.random.Generator, look: Look) -> Layout:
    _, start, colours = _start(robot, random)
    bars = []
    for arm in range(len(robot.arms)):
        half = (random.uniform(0.046, 0.050), random.uniform(0.018, 0.022), random.uniform(0.032, 0.038))
        x, y = _middle(robot, arm, random, 0.03)
        bars.append(Solid("box", colours[0], x, y, random.uniform(-np.pi / 2, np.pi / 2), half=half, z=half[2]))
    return Layout("both", f"lift both {colours[0]} bars", 0, start, bars[0], None, tuple(bars[1:]), look)


def _both_plan(robot: Robot, layout: Layout, random: np.random.Generator, knows: bool) -> dict[int, list[Waypoint]]:
    plans, rise = {}, random.uniform(0.13, 0.17)
    for arm, bar in enumerate((layout.target, *layout.others)):
        yaw = _half_turn(bar.yaw + random.normal(0, 0.1)) if knows else random.uniform(-np.pi / 2, np.pi / 2)
        plans[arm] = _raise(layout, arm, random, bar.xy + random.normal(0, 0.005, 2), yaw, 0.045, rise)
    return plans


def _both_judge(ended: Ended, layout: Layout) -> Judged:
    heights = [ended.place(name)[-4:, 2].min() - ended.place(name)[0, 2] for name in ("box_0", "box_1")]
    facts = {"height": float(min(heights)), "other_height": float(max(heights))}
    return "" if min(heights) > LIFTED else "missed" if max(heights) < LIFTED else "incomplete", facts


# level: a tray with a weight on one side, to be raised level by its rails.
def _level_layout(robot: Robot, random: np.random.Generator, look: Look) -> Layout:
    _, start, colours = _start(robot, random)
    x, y = random.uniform(0.378, 0.392), random.uniform(-0.02, 0.02)
    yaw = random.uniform(-0.12, 0.12) + np.pi * random.integers(2)
    tray = _solid("tray", colours[0], (x, y), yaw, z=TRAY_HALF[2])
    return Layout(
        "level", f"lift the {colours[0]} tray with both arms and keep it level", 0, start, tray, None, (), look
    )


def _level_plan(robot: Robot, layout: Layout, random: np.random.Generator, knows: bool) -> dict[int, list[Waypoint]]:
    tray, plans, rise = layout.target, {}, random.uniform(0.12, 0.15)
    forward, left = np.array([np.cos(tray.yaw), np.sin(tray.yaw)]), np.array([-np.sin(tray.yaw), np.cos(tray.yaw)])
    along = random.uniform(0.03, 0.05) if knows else random.uniform(-0.065, 0.065)
    for arm in layout.acting():
        side = robot.side(arm) * np.sign(left[1])
        xy = tray.xy + along * forward + side * RAIL_AWAY * left + random.normal(0, 0.003, 2)
        plans[arm] = _raise(layout, arm, random, xy, _half_turn(tray.yaw), 0.060, rise)
    return plans


# detour: a pole stands on one side of the way to the pad; plans pass on either.
def _across(robot: Robot, arm: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Two places at either side of an arm's half, in drawn order."""
    low, high = robot.reach_y if len(robot.arms) == 2 else (-0.09, 0.09)
    ends = [np.array([random.uniform(0.375, 0.395), robot.side(arm) * y]) for y in (low + 0.005, high - 0.005)]
    first = int(random.integers(2))
    return ends[first], ends[1 - first]


def _detour_layout(robot: Robot, random: np.random.Generator, look: Look) -> Layout:
    arm, start, colours = _start(robot, random)
    source, goal = _across(robot, arm, random)
    block = _solid("box", colours[0], source, random.uniform(-0.2, 0.2), half=(0.024, 0.024, 0.055), z=0.055)
    pad = _solid("pad", colours[1], goal, half=(0.052, 0.0015, 0.0), z=0.0015)
    aside = [random.choice([-1, 1]) * random.uniform(0.022, 0.034), random.normal(0, 0.008)]
    pole = _solid("cylinder", "white", (source + goal) / 2 + aside, half=(0.013, 0.075, 0.0), z=0.075, mass=0.03)
    instruction = f"place the {colours[0]} block on the {colours[1]} pad and knock nothing over"
    return Layout("detour", instruction, arm, start, block, pad, (pole,), look)


def _detour_plan(robot: Robot, layout: Layout, random: np.random.Generator, knows: bool) -> dict[int, list[Waypoint]]:
    block, goal = layout.target, _goal(layout)
    middle = (block.xy + goal) / 2
    side = -np.sign(layout.others[0].x - middle[0]) if knows else random.choice([-1, 1])
    via = middle + np.array([side * random.uniform(0.06, 0.075), 0.0])
    xy = block.xy + random.normal(0, 0.004, 2)
    return {
        layout.arm: _move(
            layout, random, xy, block.yaw, 0.075, goal + random.normal(0, 0.006, 2), drop=0.004, over=0.035, via=via
        )
    }


def _detour_judge(ended: Ended, layout: Layout) -> Judged:
    away = float(np.linalg.norm(ended.place("box_0")[-1, :2] - _goal(layout)))
    facts = {"away": away, "lean": ended.lean("cylinder_0"), "own_lean": ended.lean("box_0")}
    if facts["lean"] > FALLEN:
        return "knocked over", facts
    placed = away < 0.045 and facts["own_lean"] < FALLEN and not ended.touched("box_0")
    return "" if placed else "wrong place", facts


# peg and stack: two goals of one colour, of which one takes the block; of about equal area, so that the colour's middle tells nothing.
def _two_goals(robot: Robot, arm: int, random: np.random.Generator) -> tuple[np.ndarray, list[np.ndarray]]:
    """Place of the block and of the two goals; the one that takes it comes first."""
    low, high = robot.reach_y if len(robot.arms) == 2 else (-0.0875, 0.0875)
    middle = robot.side(arm) * (low + high) / 2
    goals = [np.array([random.uniform(0.435, 0.45), middle + side * random.uniform(0.064, 0.070)]) for side in (-1, 1)]
    block = np.array([random.uniform(0.315, 0.33), middle + random.uniform(-0.03, 0.03)])
    return block, goals[:: int(random.choice([-1, 1]))]


def _frame(colour: str, xy: np.ndarray, inner: float, thick: float) -> list[Solid]:
    """Four walls, 2 ``thick``, around a square hole of 2 ``inner``."""
    high = 0.018
    offsets = [(inner + thick, 0.0), (-inner - thick, 0.0), (0.0, inner + thick), (0.0, -inner - thick)]
    long = inner + 2 * thick
    halves = [(thick, long, high) if dx else (long, thick, high) for dx, _ in offsets]
    return [
        _solid("wall", colour, xy + offset, half=half, z=high) for offset, half in zip(offsets, halves, strict=True)
    ]


def _peg_layout(robot: Robot, random: np.random.Generator, look: Look) -> Layout:
    arm, start, colours = _start(robot, random)
    at, goals = _two_goals(robot, arm, random)
    block = _solid("box", colours[0], at, random.uniform(-0.1, 0.1), half=(0.022, 0.022, 0.060), z=0.060)
    wide, narrow = (
        _frame(colours[1], xy, *form) for xy, form in zip(goals, ((0.036, 0.005), (0.015, 0.010)), strict=True)
    )
    instruction = f"put the {colours[0]} block into a {colours[1]} frame"
    return Layout("peg", instruction, arm, start, block, wide[0], (*wide[1:], *narrow), look)


def _frame_middles(layout: Layout) -> list[np.ndarray]:
    walls = [thing.xy for thing in (layout.goal, *layout.others) if thing is not None and thing.kind == "wall"]
    return [np.mean(walls[:4], axis=0), np.mean(walls[4:], axis=0)]


def _peg_plan(robot: Robot, layout: Layout, random: np.random.Generator, knows: bool) -> dict[int, list[Waypoint]]:
    goal = _frame_middles(layout)[0 if knows else int(random.integers(2))] + random.normal(0, 0.003, 2)
    xy = layout.target.xy + random.normal(0, 0.002, 2)
    return {layout.arm: _move(layout, random, xy, layout.target.yaw, 0.09, goal, drop=0.042, over=0.09)}


def _peg_judge(ended: Ended, layout: Layout) -> Judged:
    place = ended.place("box_0")
    away = min(float(np.linalg.norm(place[-1, :2] - middle)) for middle in _frame_middles(layout))
    facts = {"height": float(place[-1, 2] - layout.target.standing), "away": away, "lean": ended.lean("box_0")}
    inside = facts["height"] < 0.012 and away < 0.03 and facts["lean"] < FALLEN
    return "" if inside and not ended.touched("box_0") else "outside", facts


def _stack_layout(robot: Robot, random: np.random.Generator, look: Look) -> Layout:
    arm, start, colours = _start(robot, random)
    at, (flat, round_) = _two_goals(robot, arm, random)
    block = _solid("box", colours[0], at, random.uniform(-0.2, 0.2), half=(0.022, 0.022, 0.045), z=0.045)
    high, yaw = random.uniform(0.024, 0.028), random.uniform(-0.4, 0.4)
    base = _solid("box", colours[1], flat, yaw, half=(0.034, 0.034, high), z=high, mass=0.5)
    roller = _solid("cylinder", colours[1], round_, yaw, half=(high, 0.043, 0.0), z=high, mass=0.5, lying=True)
    instruction = f"put the {colours[0]} block on something {colours[1]}"
    return Layout("stack", instruction, arm, start, block, base, (roller,), look)


def _stack_plan(robot: Robot, layout: Layout, random: np.random.Generator, knows: bool) -> dict[int, list[Waypoint]]:
    roller = layout.others[0]
    goal = (_goal(layout) if knows or random.integers(2) else roller.xy) + random.normal(0, 0.005, 2)
    xy = layout.target.xy + random.normal(0, 0.003, 2)
    drop = 2 * layout.others[0].standing + 0.004
    return {layout.arm: _move(layout, random, xy, layout.target.yaw, 0.065, goal, drop=drop, over=0.11)}


def _stack_judge(ended: Ended, layout: Layout) -> Judged:
    height = float(ended.place("box_0")[-1, 2] - layout.target.standing)
    facts = {"height": height, "lean": ended.lean("box_0")}
    standing = height > 0.03 and facts["lean"] < FALLEN and not ended.touched("box_0")
    return "" if standing else "fallen", facts


# roll: a ball that a rail stops, on one side.
BALL, STOP_AWAY = 0.028, 0.10


def _roll_layout(robot: Robot, random: np.random.Generator, look: Look) -> Layout:
    arm, start, colours = _start(robot, random)
    middle = robot.side(arm) * sum(robot.reach_y) / 2
    x, y = random.uniform(0.35, 0.42), middle + random.uniform(-0.005, 0.005)
    ball = _solid("ball", colours[0], (x, y), half=(BALL, BALL, BALL), z=BALL, mass=0.06)
    rail_y = y + random.choice([-1, 1]) * STOP_AWAY
    rail = _solid("wall", "white", (x, rail_y), half=(0.075, 0.006, 0.022), z=0.022)
    return Layout("roll", f"push the {colours[0]} ball against the rail", arm, start, ball, None, (rail,), look)


def _roll_plan(robot: Robot, layout: Layout, random: np.random.Generator, knows: bool) -> dict[int, list[Waypoint]]:
    ball, rail = layout.target, layout.others[0]
    side = float(np.sign(rail.y - ball.y) if knows else random.choice([-1, 1]))
    x, yaw = random.normal(0, 0.003), random.normal(0, 0.05)
    xy = ball.xy + np.array([x, 0.0])
    before, end = xy - np.array([0.0, side * 0.075]), xy + np.array([0.0, side * random.uniform(0.015, 0.03)])
    times = random.uniform(0.96, 1.03) * np.array([0.8, 1.2, 1.9, 2.5])
    return {
        layout.arm: [
            first_waypoint(layout, layout.arm),
            waypoint(times[0], before, 0.15, yaw, 0.0),
            waypoint(times[1], before, 0.035, yaw, 0.0),
            waypoint(times[2], end, 0.035, yaw, 0.0),
            waypoint(times[3], end - [0.0, side * 0.05], 0.15, yaw, 0.0),
        ]
    }


def _roll_judge(ended: Ended, layout: Layout) -> Judged:
    place, rail = ended.place("ball_0"), layout.others[0]
    gap = float(abs(place[-1, 1] - rail.y)) - BALL - 0.006
    facts = {
        "gap": gap,
        "moved": float(np.linalg.norm(place[-1] - place[-4])),
        "away": float(abs(place[-1, 0] - rail.x)),
    }
    return "" if gap < 0.03 and facts["away"] < 0.075 else "rolled away", facts


CONTACT_TASKS: dict[str, ContactTask] = {
    "grip": ContactTask(_grip_layout, _grip_plan, _grip_judge),
    "balance": ContactTask(_balance_layout, _balance_plan, _level_judge),
    "topple": ContactTask(_topple_layout, _topple_plan, _topple_judge),
    "level": ContactTask(_level_layout, _level_plan, _level_judge),
    "both": ContactTask(_both_layout, _both_plan, _both_judge),
    "detour": ContactTask(_detour_layout, _detour_plan, _detour_judge),
    "peg": ContactTask(_peg_layout, _peg_plan, _peg_judge),
    "stack": ContactTask(_stack_layout, _stack_plan, _stack_judge),
    "roll": ContactTask(_roll_layout, _roll_plan, _roll_judge),
}
