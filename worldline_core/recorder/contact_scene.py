"""Scenes of the contact tasks: solid things whose sizes, masses and places a layout gives.

They have a model of their own, because more bodies in a model would change the recordings of the other tasks. Metres, base frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from worldline_core.recorder.bodies import Robot
from worldline_core.recorder.scene import (
    PARKED,
    Layout,
    SceneModel,
    Thing,
    add_room,
    compile_scene,
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


def solid_labels(scene: SceneModel, layout: Layout) -> np.ndarray:
    """uint8 (number of geoms,) as of `scene.thing_labels`."""
    labels = np.zeros(scene.model.ngeom, np.uint8)
    others = 3
    for name, thing in layout.named():
        label = 1 if thing is layout.target else 2 if thing is layout.goal else others
        others += label > 2
        labels[scene.model.geom_bodyid == scene.model.body(name).id] = label
    return labels
