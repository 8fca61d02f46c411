"""Forward kinematics and the readers of MJCF and URDF, compared with MuJoCo and recorded robots; bad descriptions are refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from scipy.spatial.transform import Rotation

from worldline_core.errors import ConfigError, DataError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.embodiment_report import random_states
from worldline_core.geometry.kinematic_tree import read_mjcf, read_urdf
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.transforms import rotation_angle

# Everything that decides a pose: each way to write an orientation, joints off the body's origin, two joints on a
# body, a slide, defaults by class and childclass, a site, an unnormalised axis and quaternion.
TOY = """
<mujoco model="toy">
  <!-- a comment -->
  <compiler angle="degree" eulerseq="zyx"/>
  <default>
    <joint axis="0 1 0"/>
    <default class="finger"><joint type="slide" axis="0 0 2" range="0 0.04"/></default>
  </default>
  <worldbody>
    <geom type="plane" size="1 1 0.1"/>
    <body name="base" pos="0.1 -0.2 0.3" euler="10 20 30">
      <geom size="0.05"/>
      <body name="shoulder" pos="0 0 0.2" quat="2 0.4 0.1 -0.3">
        <joint name="pan" axis="0 0 1"/>
        <joint name="tilt" pos="0.02 0.03 -0.01"/>
        <geom size="0.05"/>
        <body name="elbow" pos="0.3 0 0" axisangle="1 1 0 40">
          <joint name="elbow" axis="0.3 -0.5 0.7" pos="0 0 0.05"/>
          <geom size="0.05"/>
          <body name="hand" pos="0.25 0 0.02" xyaxes="0 1 0 -1 0 0.2" childclass="finger">
            <joint name="roll" type="hinge" axis="1 0 0"/>
            <geom size="0.05"/>
            <site name="tip" pos="0 0 0.1" zaxis="0.2 0.1 0.9"/>
            <body name="thumb" pos="0 0.02 0.05"><joint name="thumb"/><geom size="0.01"/></body>
            <body name="index" pos="0 -0.02 0.05"><joint name="index" axis="0 -1 0"/><geom size="0.01"/></body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
SECTIONS_TWICE = TOY.replace(
    "<worldbody>",
    """
  <compiler angle="radian"/>
  <compiler angle="degree"/>
  <default><joint pos="0 0.01 0"/><site pos="0 0 0.03" euler="90 0 10"/><default class="b"><site zaxis="1 0 1"/></default></default>
  <worldbody><body name="apart" pos="0 0 1"><joint name="apart"/><geom size="0.1"/></body></worldbody>
  <worldbody>""",
).replace(
    '<site name="tip"', '<site name="a"/><site name="b" class="b"/><site name="c" quat="1 0 0 0"/><site name="tip"'
)
ARM = {
    "name": "right", "joints": ["pan", "tilt", "elbow", "roll"], "limits": [[-3.0, 3.0]] * 4, "end_effector_link": "hand",
    "T_link_tool": {"translation": [0.0, 0.0, 0.1], "rotation_wxyz": [1.0, 0.0, 0.0, 0.0]},
    "gripper": {"closed": 0.0, "open": 1.0, "finger_joints": [
        {"name": "thumb", "closed": 0.0, "open": 0.04}, {"name": "index", "closed": 0.01, "open": 0.04},
    ]},
    "wrist_camera": {
        "link": "hand",
        "T_link_camera": [[1.0, 0.0, 0.0, 0.02], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.03], [0, 0, 0, 1.0]],
    },
}  # fmt: skip

# Origins with all three angles, unnormalised axes, a missing origin and axis, every kind of joint, an undeclared prefix.
URDF = """<?xml version="1.0"?>
<robot name="toy">
  <!-- links need not come before their joints -->
  <joint name="pan" type="continuous">
    <parent link="base"/><child link="shoulder"/>
    <origin xyz="0.1 -0.2 0.3" rpy="0.3 -0.7 1.9"/><axis xyz="0 0 2"/>
  </joint>
  <link name="base"><visual><geometry><mesh filename="package://toy/base.stl"/></geometry></visual></link>
  <link name="shoulder"/><link name="elbow"/><link name="hand"/><link name="finger"/><link name="camera"/>
  <joint name="lift" type="revolute">
    <parent link="shoulder"/><child link="elbow"/>
    <origin xyz="0.3 0 0.02" rpy="-1.5708 0.4 0"/><axis xyz="0.3 -0.5 0.7"/>
    <limit drake:acceleration="2" lower="-1.2" upper="0.8" effort="1" velocity="1"/>
  </joint>
  <joint name="roll" type="revolute">
    <parent link="elbow"/><child link="hand"/><limit lower="-3" upper="3" effort="1" velocity="1"/>
  </joint>
  <joint name="slide" type="prismatic">
    <parent link="hand"/><child link="finger"/>
    <origin xyz="0 0.02 0.05"/><axis xyz="0 1 0"/><limit lower="0" upper="0.04" effort="1" velocity="1"/>
  </joint>
  <joint name="mount" type="fixed">
    <parent link="hand"/><child link="camera"/><origin xyz="0.01 0.02 0.03" rpy="3.1 0.2 -2.2"/>
  </joint>
  <transmission name="t"/>
</robot>
"""
URDF_ARM = ARM | {
    "joints": ["pan", "lift", "roll"], "limits": [[-3.0, 3.0]] * 3,
    "gripper": {"finger_joints": [{"name": "slide", "closed": 0.0, "open": 0.04}]},
}  # fmt: skip


def toy(tmp_path: Path, text: str = TOY, **changes: object) -> ArmKinematics:
    values = {"name": "toy", "description": {"format": "mjcf", "file": "toy.xml"}, "base_link": "world", "arms": [ARM]}
    (tmp_path / "toy.yaml").write_text(yaml.safe_dump(values | changes))
    (tmp_path / "toy.xml").write_text(text)
    return ArmKinematics(load_embodiment(tmp_path / "toy.yaml"))


@pytest.mark.parametrize(
    ("text", "base_link"), [(TOY, "world"), (TOY, "base"), (SECTIONS_TWICE, "world"), (URDF, "base")]
)
def test_hand_written_description_equals_mujoco(tmp_path, text, base_link):
    """Every body and site, to 1e-9 m; the shipped ones: test_embodiment_report."""
    mujoco = pytest.importorskip("mujoco", reason="the independent kinematics are those of MuJoCo")
    if text == URDF:
        described = {"description": {"format": "urdf", "file": "toy.xml"}, "arms": [URDF_ARM]}
        compiler = '<mujoco><compiler fusestatic="false" discardvisual="true" boundmass="1" boundinertia="1"/></mujoco>'
        model = mujoco.MjModel.from_xml_string(
            text.replace("drake:", "").replace("<transmission", f"{compiler}<transmission")
        )
    else:
        described, model = {}, mujoco.MjModel.from_xml_string(text)
    kinematics, data = toy(tmp_path, text, base_link=base_link, **described), mujoco.MjData(model)
    (arm,) = kinematics.embodiment.arms
    states = np.random.default_rng(0).uniform(-1.5, 1.5, (7, len(arm.joints) + 1))
    states[:, -1] = np.linspace(-0.2, 1.2, 7)
    poses = kinematics.link_poses(states)
    frames = [*map(data.body, range(1, model.nbody)), *map(data.site, range(model.nsite))]
    for n, state in enumerate(states):
        for name, value in zip(arm.joints, state, strict=False):
            data.joint(name).qpos[0] = value
        for finger in arm.gripper.finger_joints:
            travel = np.clip(state[-1], 0, 1) * (finger.open - finger.closed)
            data.joint(finger.name).qpos[0] = finger.closed + travel
        mujoco.mj_kinematics(model, data)
        base = data.body("world" if text == URDF else base_link)  # the root of a URDF becomes the world
        turn = base.xmat.reshape(3, 3).T
        atol = 1e-12 if text == URDF else 1e-9
        for each in frames:
            found = poses[each.name][n].numpy()
            np.testing.assert_allclose(found[:3, 3], turn @ (each.xpos - base.xpos), atol=atol)
            np.testing.assert_allclose(found[:3, :3], turn @ each.xmat.reshape(3, 3), atol=atol)


def test_a_frame_does_not_depend_on_the_others_of_its_batch():
    kinematics = ArmKinematics(load_embodiment("yam_station"))
    states = random_states(kinematics.embodiment, 33, seed=2)
    tools, cameras = kinematics.tool_poses(states), kinematics.wrist_camera_poses(states)
    for n in (0, 32):
        torch.testing.assert_close(kinematics.tool_poses(states[n : n + 1])[0], tools[n], rtol=0, atol=1e-12)
        alone = {view: poses[0] for view, poses in kinematics.wrist_camera_poses(states[n : n + 1]).items()}
        torch.testing.assert_close(alone, {view: poses[n] for view, poses in cameras.items()}, rtol=0, atol=1e-12)
    assert {pose.dtype for pose in kinematics.link_poses(states).values()} == {torch.float64}


def test_gripper_opening_is_linear_and_not_clipped(tmp_path):
    arm = {**ARM, "gripper": {"closed": 119.0, "open": 0.2}}
    state = np.zeros((3, 5))
    state[:, 4] = [119.0, 0.2, -11.68]
    np.testing.assert_allclose(toy(tmp_path, arms=[arm]).gripper(state).numpy()[:, 0], [0, 1, 1.1], atol=1e-9)


def test_unknown_links_and_joints_list_the_known_ones(tmp_path):
    arm = {**ARM, "end_effector_link": "paw"}
    with pytest.raises(ConfigError, match=r"no link of this name[\s\S]*elbow[\s\S]*paw"):
        toy(tmp_path, arms=[arm])
    with pytest.raises(ConfigError, match=r"no joint of this name[\s\S]*tilt[\s\S]*waist"):
        toy(tmp_path, posture={"waist": 0.1})


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("<body><freejoint/></body>", "free body"),
        ("<body><joint type='ball' name='b'/></body>", "Joint is not supported"),
        ("<body><joint ref='1'/></body>", "Joint is not supported"),
        ("<include file='x.xml'/>", "<include> is not supported"),
        ("<frame><body/></frame>", "<frame> is not supported"),
        ("<body name='b' quat='0 0 0 0'/>", r"direction of length zero[\s\S]*body b"),
        ("<body name='b' pos='0 0'/>", r"body b[\s\S]*3 finite numbers"),
        ("<body><joint name='j' axis='0 0 0'/></body>", r"direction of length zero[\s\S]*joint j"),
        ("<body name='b' quat='0 1 0 0' euler='1 0 0'/>", r"given twice[\s\S]*body b[\s\S]*quat, euler"),
        ("<body><joint name='j' class='k'/></body>", r"No such class[\s\S]*joint j[\s\S]*k"),
        ("<body><site name='s' fromto='0 0 0 1 0 0'/></body>", r"site s[\s\S]*fromto"),
        ("<body name='b' mocap='true'/>", r"body b[\s\S]*mocap"),
        ("<body name='b' pos='0 0 ${L}'/>", r"xacro[\s\S]*\$\{L\}"),
        ("</worldbody><compiler coordinate='global'/><worldbody>", "coordinate"),
        ("</worldbody><default><default class='k'/><default class='k'/></default><worldbody>", r"there twice[\s\S]*k"),
    ],
)
def test_what_the_reader_does_not_know_is_refused(body, message):
    with pytest.raises(DataError, match=message):
        read_mjcf(f"<mujoco><worldbody>{body}</worldbody></mujoco>", "toy.xml")


def joint(kind: str = "fixed", parent: str = "a", child: str = "b", inside: str = "", name: str = "j") -> str:
    return f"<joint name='{name}' type='{kind}'><parent link='{parent}'/><child link='{child}'/>{inside}</joint>"


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (joint(child="c"), r"child is no link[\s\S]*joint j[\s\S]*one of a, b"),
        (joint(parent="c"), r"parent is no link[\s\S]*one of a, b"),
        ("<joint name='j' type='fixed'/>", "parent is no link"),
        ("", r"one root link[\s\S]*\['a', 'b'\]"),
        ("<link name='a'/>", "named twice"),
        (joint() + joint(name="k"), "two parents"),
        ("<link name='c'/>" + joint() + joint(parent="b", child="a", name="k"), "circle"),
        (joint(parent="b", child="b"), "circle"),
        (joint("floating"), r"joint j[\s\S]*floating"),
        (joint("revolute", inside="<axis xyz='0 0 0'/>"), "length zero"),
        (joint("revolute", inside="<axis xyz='1e200 0 1e200'/>"), "length inf"),
        (joint("prismatic", inside="<axis xyz='0 1e-200 0'/>"), "length 0"),
        (joint("revolute", inside="<origin xyz='0 0'/>"), r"joint j, origin[\s\S]*3 finite numbers"),
        (joint("revolute", inside="<origin xyz='0 0 nan'/>"), "3 finite numbers"),
        (joint("revolute", inside="<origin rpy='a b c'/>"), "Not numbers"),
        (joint(inside="<origin quat_xyzw='1 0 0 0'/>"), r"joint j, origin[\s\S]*quat_xyzw"),
        (joint(inside="<origin quat='1 0 0 0'/>"), r"joint j, origin[\s\S]*rpy"),
        (joint(inside="<origin xyz='0 0 ${L}'/>"), r"xacro[\s\S]*\$\{L\}"),
        (joint(name="$(arg n)"), r"xacro[\s\S]*\$\(arg n\)"),
        ("<xacro:arm prefix='left'/>", r"xacro[\s\S]*<arm"),
    ],
)
def test_what_a_urdf_cannot_be_is_refused(body, message):
    with pytest.raises(DataError, match=message):
        read_urdf(f"<robot name='r'><link name='a'/><link name='b'/>{body}</robot>", "r.urdf")


@pytest.mark.parametrize(
    ("read", "text", "message"),
    [
        (read_mjcf, "<mujoco>", "not XML"), (read_mjcf, "not xml", "not XML"), (read_mjcf, "<robot/>", "Not an MJCF"),
        (read_urdf, "<robot", "not XML"), (read_urdf, "<mujoco/>", r"Not a URDF[\s\S]*<mujoco>"),
    ],
)  # fmt: skip
def test_what_is_no_description_is_refused(read, text, message):
    with pytest.raises(DataError, match=message):
        read(text, "toy.xml")


@pytest.mark.parametrize("demo", ["demo_000", "demo_001"])
@pytest.mark.parametrize("kind", ["state", "action"])
def test_agibot_kinematics_reproduce_the_recorded_poses(shared_data, demo, kind):
    folder = shared_data / "agibot_gesim_v2" / "assets" / demo
    urdf = shared_data / "agibot_g1_urdf" / "G1_omnipicker_calibrated.urdf"
    kinematics = ArmKinematics(load_embodiment("agibot_g1", urdf))
    state = np.load(folder / "state_joints_0.npy").astype(np.float64)
    if kind == "state":
        joints = np.concatenate([state[:, :7], state[:, 14:15], state[:, 7:14], state[:, 15:16]], axis=1)
        recorded = np.load(folder / "state_eef_poses_0.npy").astype(np.float64)
    else:
        joints = np.load(folder / "actions_0.npy").astype(np.float64)
        recorded = np.load(folder / "eef_poses_0.npy").astype(np.float64)
    names = ("idx03_head_yaw_joint", "idx04_head_pitch_joint", "idx02_waist_pitch_joint", "idx01_waist_lift_joint")
    poses = kinematics.link_poses(joints, {name: state[:, 16 + i] for i, name in enumerate(names)})
    for arm, link in enumerate(("arm_l_end_link", "arm_r_end_link")):
        error = np.linalg.norm(poses[link][:, :3, 3].numpy() - recorded[:, 7 * arm : 7 * arm + 3], axis=1)
        assert error.max() <= 1e-4, f"{link}: {error.max() * 1e3:.4f} mm"
        turn = Rotation.from_euler("xyz", recorded[:, 7 * arm + 3 : 7 * arm + 6]).as_matrix()
        np.testing.assert_allclose(poses[link][:, :3, :3].numpy(), turn, atol=1e-4)


def droid_recordings(shared_data: Path) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Joints (N, 7) and cartesian_position (N, 6) of every real DROID episode that has both."""
    found = []
    for file in sorted((shared_data / "droid_ctrl_world").glob("*/annotation/*/*.json")):
        record = json.loads(file.read_text())
        if "joints" in record:
            found.append((file.stem, np.asarray(record["joints"])[:, :7], np.asarray(record["states"])[:, :6]))
        if "observation.state.joint_position" in record:
            joints, pose = (record[f"observation.state.{key}_position"] for key in ("joint", "cartesian"))
            found.append((file.stem, np.asarray(joints), np.asarray(pose)))
    return found


def test_droid_cartesian_position_is_the_flange_from_the_joints(shared_data):
    recordings = droid_recordings(shared_data)
    assert recordings
    kinematics = ArmKinematics(load_embodiment("droid_franka"))
    for name, joints, recorded in recordings:
        assert len(joints) == len(recorded), name
        states = np.concatenate([joints, np.zeros((len(joints), 1))], axis=1)
        assert not kinematics.embodiment.outside_limits(states).any(), name
        flange = kinematics.link_poses(states)["panda_link8"].numpy()
        error = np.linalg.norm(flange[:, :3, 3] - recorded[:, :3], axis=1)
        assert error.max() <= 1e-4, f"{name}: {error.max() * 1e3:.4f} mm"
        turn = Rotation.from_euler("xyz", recorded[:, 3:6]).as_matrix()
        apart = rotation_angle(torch.from_numpy(np.swapaxes(turn, 1, 2) @ flange[:, :3, :3]))
        assert float(apart.max()) <= 1e-4, f"{name}: {float(apart.max()):.1e} rad"
