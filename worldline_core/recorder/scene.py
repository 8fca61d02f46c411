"""The MuJoCo model of one robot with its table and the things on it: where they are in an episode, and what is asked.

One model serves all episodes of a robot: colours, lights, camera poses and the places of static bodies are set per
episode, unused objects are parked far below the table. Metres, base frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from worldline_core.errors import DataError
from worldline_core.recorder.bodies import HEAD_FOVY_DEG, REACH_X, ROBOTS_FOLDER, Robot
from worldline_core.recorder.looks import TEXTURES, Look, texture

# Frames per second, and physics steps per frame.
FRAME_RATE = 8
SUBSTEPS = 30
TIMESTEP = 1.0 / (FRAME_RATE * SUBSTEPS)
# Where objects wait that an episode does not use.
PARKED = np.array([-3.0, 0.0, -4.0])
# Bodies and their joints have the same names.
FINGER_JOINTS = ("finger_a", "finger_b")


@dataclass(frozen=True)
class ArmIndices:
    """Indices of one arm's joints, fingers and tool in the compiled model; ``limits`` (J, 2) of the joints [rad].

    ``columns``: of its joints in states and actions; ``gripper``: that of its opening behind them.
    """

    joint_names: tuple[str, ...]
    qpos: np.ndarray
    dofs: np.ndarray
    actuators: np.ndarray
    finger_qpos: np.ndarray
    finger_actuators: np.ndarray
    tool_site: int
    limits: np.ndarray
    columns: slice
    gripper: int


@dataclass(frozen=True)
class SceneModel:
    """The compiled model, its arms in the order of ``robot.arms``, which geoms belong to the robot, and the full size of each geom."""

    robot: Robot
    model: Any
    arms: tuple[ArmIndices, ...]
    robot_geoms: np.ndarray
    sizes: np.ndarray

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the state columns: ``<arm>/<joint>`` then ``<arm>/gripper``, arm after arm."""
        arms = zip(self.robot.arms, self.arms, strict=True)
        return tuple(name for placed, arm in arms for name in (*arm.joint_names, f"{placed.name}/gripper"))


def arm_spec(robot: Robot) -> Any:
    """MuJoCo specification of one arm: drawn colours, position servos, gravity compensated, simple inertia."""
    import mujoco

    folder = ROBOTS_FOLDER / robot.model
    path = folder / "arm.xml"
    if not path.is_file():
        raise DataError("Robot model not found", where=path, next_step="restore artifacts/shipped/robots")
    spec = mujoco.MjSpec.from_file(str(path))
    spec.meshdir = ""
    for mesh in spec.meshes:
        mesh.file = str(folder / "meshes" / Path(mesh.file).name)
        # Cut meshes are not watertight; their inertia is not used (bodies carry their own).
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    _scale_links(spec, robot.link_scale)
    colours = {tuple(source): drawn for source, drawn in robot.colours}
    for geom in spec.geoms:
        if geom.type == mujoco.mjtGeom.mjGEOM_MESH:
            drawn = colours.get(tuple(np.round(np.asarray(geom.rgba[:3]), 3)))
            if drawn is not None:
                geom.rgba = [*drawn, 1.0]
    for body in spec.bodies:
        if body.name == "world":
            continue
        body.gravcomp = 1.0
        body.explicitinertial = True
        body.mass = 0.05 if body.name in FINGER_JOINTS else 0.5
        body.inertia = [1e-4] * 3 if body.name in FINGER_JOINTS else [2e-3] * 3
    for joint in spec.joints:
        finger = joint.name in FINGER_JOINTS
        joint.armature = 0.05 if finger else 0.4
        gain, damping = (500.0, 15.0) if finger else (1600.0, 55.0)
        limit = (-14.0, 14.0) if finger else (-4000.0, 4000.0)
        actuator = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.gaintype = mujoco.mjtGain.mjGAIN_FIXED
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        actuator.gainprm[0] = gain
        actuator.biasprm[1], actuator.biasprm[2] = -gain, -damping
        actuator.forcerange = limit
        actuator.forcelimited = True
    return spec


def _scale_links(spec: Any, scale: float) -> None:
    """Scale the arm from its base up to the body ``ee``, which moves but keeps its size, as the fingers do."""
    if scale == 1.0:
        return
    meshes = {mesh.name: mesh for mesh in spec.meshes}
    for body in spec.bodies:
        if body.name in ("world", *FINGER_JOINTS):
            continue
        body.pos = scale * np.asarray(body.pos)
        if body.name != "ee":
            for geom in body.geoms:
                geom.pos = scale * np.asarray(geom.pos)
                if geom.meshname:
                    meshes[geom.meshname].scale = [scale] * 3


def scene_spec() -> Any:
    """MuJoCo specification with physics, light and head camera, still without things and arms."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    spec.visual.quality.shadowsize = 0
    spec.visual.quality.offsamples = 0
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 384, 256
    # Clipping distances are relative to the extent, which parked objects would otherwise blow up.
    spec.stat.extent = 1.0
    spec.visual.map.znear = 0.005
    spec.visual.map.zfar = 20.0
    spec.worldbody.add_light(name="sun", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, pos=[0, 0, 3], dir=[0, 0, -1])
    spec.worldbody.add_camera(name="head", fovy=HEAD_FOVY_DEG)
    return spec


def add_room(spec: Any) -> None:
    """Floor, wall and table, with what tables may be covered with; only the table is solid."""
    import mujoco

    for name in TEXTURES:
        image = texture(name)
        made = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=128, height=128, nchannel=3)
        made.data = image.tobytes()
        material = spec.add_material(name=name, texuniform=True)
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name

    box, seen_only = mujoco.mjtGeom.mjGEOM_BOX, {"contype": 0, "conaffinity": 0}
    world = spec.worldbody
    world.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[6, 6, 1], pos=[0, 0, -0.8], **seen_only)
    world.add_geom(name="wall", type=box, size=[0.05, 6, 4], pos=[2.6, 0, 0], **seen_only)
    world.add_geom(
        name="table", type=box, size=[0.75, 1.0, 0.03], pos=[0.35, 0, -0.03], friction=[0.9, 0.02, 0.001], condim=4
    )


def slide_joint(body: Any, name: str, axis: list[float], travel: float, **dynamics: float) -> None:
    """A joint that slides by 0..``travel`` [m]; ``dynamics``: frictionloss, armature, damping."""
    import mujoco

    damping = dynamics.pop("damping")
    slide = body.add_joint(
        name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis, range=[0, travel], limited=True, **dynamics
    )
    # Newer MuJoCo versions hold three damping coefficients (linear first), older ones a number.
    slide.damping = [damping, 0.0, 0.0] if np.ndim(slide.damping) else damping


def compile_scene(spec: Any, robot: Robot) -> SceneModel:
    """Attach the arms with their wrist cameras and compile."""
    for arm in robot.arms:
        child = arm_spec(robot)
        child.body("ee").add_camera(name="wrist", fovy=robot.wrist.fovy_deg)
        about_z = [float(np.cos(arm.yaw / 2)), 0.0, 0.0, float(np.sin(arm.yaw / 2))]
        frame = spec.worldbody.add_frame(pos=list(arm.base_xyz), quat=about_z)
        spec.attach(child, prefix=f"{arm.name}/", frame=frame)
    model = spec.compile()
    prefixes = tuple(f"{arm.name}/" for arm in robot.arms)
    of_robot = np.array([model.body(int(body)).name.startswith(prefixes) for body in model.geom_bodyid])
    arms = tuple(_arm_indices(model, prefix, number) for number, prefix in enumerate(prefixes))
    return SceneModel(robot=robot, model=model, arms=arms, robot_geoms=of_robot, sizes=model.geom_size.copy())


def _arm_indices(model: Any, prefix: str, number: int) -> ArmIndices:
    names = [model.joint(j).name for j in range(model.njnt) if model.joint(j).name.startswith(prefix)]
    fingers = tuple(name for name in names if name.removeprefix(prefix) in FINGER_JOINTS)
    joints = tuple(name for name in names if name not in fingers)
    first = number * (len(joints) + 1)
    return ArmIndices(
        joint_names=joints,
        qpos=np.array([model.joint(name).qposadr[0] for name in joints]),
        dofs=np.array([model.joint(name).dofadr[0] for name in joints]),
        actuators=np.array([model.actuator(name).id for name in joints]),
        finger_qpos=np.array([model.joint(name).qposadr[0] for name in fingers]),
        finger_actuators=np.array([model.actuator(name).id for name in fingers]),
        tool_site=model.site(f"{prefix}tool").id,
        limits=np.array([model.joint(name).range for name in joints]),
        columns=slice(first, first + len(joints)),
        gripper=first + len(joints),
    )


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
# A button that is down by more than this share of its travel is pressed; a thing that is so much higher [m] is lifted.
BUTTON_DOWN, LIFTED = 0.5, 0.07
HouseholdFamily = Literal["lift", "place", "close", "press", "carry"]
ContactFamily = Literal["grip", "balance", "topple", "detour", "peg", "stack", "roll", "both", "level"]
Family = HouseholdFamily | ContactFamily
TASKS: tuple[HouseholdFamily, ...] = get_args(HouseholdFamily)
CONTACT: tuple[ContactFamily, ...] = get_args(ContactFamily)
TWO_ARMED = ("carry", "both", "level")
# How many of each kind a scene can hold.
KINDS = {"block": 2, "can": 2, "pad": 2, "button": 2, "drawer": 1, "tray": 1}
# Height of a free thing's origin where it stands.
STANDING = {"block": BLOCK_HALF[2], "can": CAN_HALF, "tray": TRAY_HALF[2]}
UNLIT = (0.17, 0.17, 0.18)
# What a look makes smaller, and along which of a geom's sizes: all three, or all but the height. Drawers and trays fit the hands.
_SIZED = {"block": (1, 1, 1), "can": (1, 1, 1), "pad": (1, 0, 0), "button": (1, 0, 0)}
OBJECT_COLOURS: dict[str, tuple[float, float, float]] = {
    "red": (0.90, 0.06, 0.06),
    "green": (0.05, 0.72, 0.12),
    "blue": (0.06, 0.20, 0.95),
    "yellow": (0.98, 0.88, 0.05),
    "purple": (0.60, 0.08, 0.80),
    "orange": (1.00, 0.48, 0.02),
}
# Of things that no instruction names.
NEUTRAL_COLOURS = {"white": (0.93, 0.92, 0.88)}


@dataclass(frozen=True)
class Thing:
    """A thing on the table; a drawer's place is that of its front when closed. ``size``: its scale, 1 or smaller."""

    kind: str
    colour: str
    x: float
    y: float
    yaw: float = 0.0
    size: float = 1.0

    @property
    def xy(self) -> np.ndarray:
        return np.array([self.x, self.y])

    @property
    def standing(self) -> float:
        """Height of a free thing's origin where it stands."""
        return STANDING[self.kind] * self.size


@dataclass(frozen=True)
class Layout:
    """Initial state and instruction of an episode.

    Attributes:
        family: one of TASKS or CONTACT.
        arm: number of the arm that acts; of a carry, in which both act, the first.
        start: per arm (x, y, z, yaw, opening) of the tool and gripper at the first frame.
        target: what is lifted, placed, closed, pressed or carried.
        goal: the pad of a place.
        others: distractors.
        look: what colours and sizes things have.
    """

    family: str
    instruction: str
    arm: int
    start: np.ndarray
    target: Thing
    goal: Thing | None
    others: tuple[Thing, ...]
    look: Look

    def acting(self) -> tuple[int, ...]:
        return tuple(range(len(self.start))) if self.family in TWO_ARMED else (self.arm,)

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

    def rgba(self, thing: Thing) -> list[float]:
        return [*self.look.paint((OBJECT_COLOURS | NEUTRAL_COLOURS)[thing.colour]), 1.0]


def build_scene(robot: Robot) -> SceneModel:
    """Compile a body's model with all things, parked until a layout uses them."""
    import mujoco

    spec = scene_spec()
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
            random.uniform(REACH_X[0] - beyond, REACH_X[1] + beyond),
            robot.side(arm) * random.uniform(*robot.reach_y),
        )
        spot = np.array([x, y])
        nearest = min((float(np.linalg.norm(spot - other)) for other in taken), default=np.inf)
        if nearest > distance:
            best, distance = spot, nearest
        if nearest >= apart:
            break
    return best


def sample_layout(robot: Robot, family: str, random: np.random.Generator, look: Look) -> Layout:
    """Draw an initial state for a task, with things of the look's size."""
    arm = int(random.integers(len(robot.arms)))
    colours = [str(colour) for colour in random.permutation(sorted(OBJECT_COLOURS))]
    start = np.stack([[*free_tool(robot, a, random), random.uniform(0.0, 1.0)] for a in range(len(robot.arms))])
    kind = str(random.choice(["block", "can"]))
    goal = None
    taken: list[np.ndarray] = []
    if family == "close":
        y = robot.side(arm) * random.uniform(robot.reach_y[0] + 0.05, robot.reach_y[1] - 0.05)
        target = Thing("drawer", colours[0], REACH_X[1] + float(random.uniform(0.0, 0.03)), float(y))
        taken = [target.xy - [reach, 0.0] for reach in (0.0, 0.07, 0.14)]
        instruction = f"push the {colours[0]} drawer closed"
    elif family == "press":
        x, y = _spot(robot, arm, random, taken, 0.0)
        target = Thing("button", colours[0], float(x), float(y))
        instruction = f"press the {colours[0]} button"
    elif family == "carry":
        x, y = random.uniform(REACH_X[0] + 0.01, REACH_X[1] - 0.01), random.uniform(-0.04, 0.04)
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

    def sized(thing: Thing) -> Thing:
        return replace(thing, size=look.size) if thing.kind in _SIZED else thing

    return Layout(family, instruction, arm, start, sized(target), goal and sized(goal), tuple(map(sized, others)), look)


def free_tool(robot: Robot, arm: int, random: np.random.Generator) -> np.ndarray:
    """(x, y, z, yaw) of a tool above the things."""
    x, y = random.uniform(*REACH_X), robot.side(arm) * random.uniform(robot.reach_y[0] + 0.02, robot.reach_y[1])
    return np.array([x, y, random.uniform(0.18, 0.25), random.uniform(-0.4, 0.4)])


def apply_layout(scene: SceneModel, data: Any, layout: Layout) -> None:
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
                    place, angle = np.array([thing.x, thing.y, thing.standing + 0.0005]), thing.yaw / 2
                data.qpos[address : address + 7] = [*place, np.cos(angle), 0, 0, np.sin(angle)]
            else:
                height = 0.0015 if kind == "pad" else 0.0
                model.body_pos[body] = PARKED if thing is None else [thing.x, thing.y, height]
            if thing is not None:
                for part in (name, *(f"{name}_{end}" for end in HANDLES if kind == "tray")):
                    geom = model.geom(part).id
                    model.geom_rgba[geom] = layout.rgba(thing)
                    along = np.array(_SIZED.get(kind, (0, 0, 0)))
                    model.geom_size[geom] = scene.sizes[geom] * np.where(along, thing.size, 1.0)
    opened = DRAWER_TRAVEL if "drawer_0" in used else 0.0
    data.qpos[int(model.joint("drawer_0").qposadr[0])] = opened


def thing_labels(scene: SceneModel, layout: Layout) -> np.ndarray:
    """uint8 (number of geoms,): 1 for those of the target, 2 of the goal, 3.. of the others, 0 for the rest.

    A drawer has only what slides; any other thing has all of its geoms, also a button's plate, because it lights up.
    """
    labels = np.zeros(scene.model.ngeom, np.uint8)
    others = 3
    for name, thing in layout.named():
        label = 1 if thing is layout.target else 2 if thing is layout.goal else others
        others += label > 2
        labels[scene.model.geom(name).id] = label
        if thing.kind != "drawer":
            labels[scene.model.geom_bodyid == scene.model.body(name).id] = label
    return labels


def light_buttons(scene: SceneModel, layout: Layout, qpos: np.ndarray) -> None:
    """A button's plate shines in its colour while its cap is down."""
    model = scene.model
    for name, thing in layout.named():
        if thing.kind == "button":
            down = qpos[int(model.joint(name).qposadr[0])] > BUTTON_DOWN * BUTTON_TRAVEL
            model.geom_rgba[model.geom(f"{name}_plate").id] = layout.rgba(thing) if down else [*UNLIT, 1.0]
