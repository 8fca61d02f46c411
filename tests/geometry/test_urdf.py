"""The URDF reader against MuJoCo, against pytorch_kinematics' own parser, and on files that cannot be."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from worldline_core.errors import DataError
from worldline_core.geometry.kinematic_tree import read_urdf
from worldline_core.geometry.kinematics import chain_from_tree

# Origins with all three angles, unnormalised axes, a missing origin and axis, every kind of joint, an undeclared prefix.
TOY = """<?xml version="1.0"?>
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
VALUES = np.random.default_rng(0).uniform(-1, 1, (9, 4))


def ours(names: list[str]) -> tuple[list[str], dict[str, np.ndarray]]:
    chain = chain_from_tree(read_urdf(TOY, "toy.urdf"))
    joints = chain.get_joint_parameter_names()
    poses = chain.forward_kinematics_tensor(torch.from_numpy(VALUES))
    return joints, {name: poses[chain.frame_to_idx[name]].numpy() for name in names}


def test_reader_equals_mujoco():
    mujoco = pytest.importorskip("mujoco", reason="the independent kinematics are those of MuJoCo")
    text = TOY.replace("drake:acceleration", "acceleration").replace(
        "<transmission",
        '<mujoco><compiler fusestatic="false" discardvisual="true" boundmass="1" boundinertia="1"/></mujoco><transmission',
    )
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    names = ["shoulder", "elbow", "hand", "finger", "camera"]
    joints, poses = ours(names)
    assert joints == ["pan", "lift", "roll", "slide"]
    for n, values in enumerate(VALUES):
        for joint, value in zip(joints, values, strict=True):
            data.joint(joint).qpos[0] = value
        mujoco.mj_kinematics(model, data)
        for name in names:
            np.testing.assert_allclose(poses[name][n, :3, 3], data.body(name).xpos, atol=1e-12)
            np.testing.assert_allclose(poses[name][n, :3, :3], data.body(name).xmat.reshape(3, 3), atol=1e-12)


def robot(body: str) -> str:
    return f"<robot name='r'><link name='a'/><link name='b'/>{body}</robot>"


JOINT = "<joint name='{}' type='{}'><parent link='{}'/><child link='{}'/>{}</joint>"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<mujoco/>", r"Not a URDF file[\s\S]*<mujoco>"),
        ("<robot", "not XML"),
        (
            robot(JOINT.format("j", "fixed", "a", "c", "")),
            r"A joint's child is no link[\s\S]*joint j[\s\S]*one of a, b",
        ),
        (robot(JOINT.format("j", "fixed", "c", "b", "")), r"A joint's parent is no link[\s\S]*one of a, b"),
        (robot("<joint name='j' type='fixed'/>"), "A joint's parent is no link"),
        (robot(""), r"one root link[\s\S]*\['a', 'b'\]"),
        (robot("<link name='a'/>"), "named twice"),
        (robot(JOINT.format("j", "fixed", "a", "b", "") + JOINT.format("k", "fixed", "a", "b", "")), "two parents"),
        (
            robot(
                "<link name='c'/>" + JOINT.format("j", "fixed", "a", "b", "") + JOINT.format("k", "fixed", "b", "a", "")
            ),
            "circle",
        ),
        (robot(JOINT.format("j", "floating", "a", "b", "")), r"Joint is not supported[\s\S]*joint j[\s\S]*floating"),
        (robot(JOINT.format("j", "revolute", "a", "b", "<axis xyz='0 0 0'/>")), "direction of length zero"),
        (robot(JOINT.format("j", "revolute", "a", "b", "<axis xyz='1e200 0 1e200'/>")), "length inf"),
        (robot(JOINT.format("j", "prismatic", "a", "b", "<axis xyz='0 1e-200 0'/>")), "length 0"),
        (
            robot(JOINT.format("j", "revolute", "a", "b", "<origin xyz='0 0'/>")),
            r"joint j, origin[\s\S]*3 finite numbers",
        ),
        (robot(JOINT.format("j", "revolute", "a", "b", "<origin xyz='0 0 nan'/>")), "3 finite numbers"),
        (robot(JOINT.format("j", "revolute", "a", "b", "<origin rpy='a b c'/>")), "Not numbers"),
        (
            robot(JOINT.format("j", "fixed", "a", "b", "<origin quat_xyzw='1 0 0 0'/>")),
            r"joint j, origin[\s\S]*quat_xyzw",
        ),
        (robot(JOINT.format("j", "fixed", "a", "b", "<origin quat='1 0 0 0'/>")), r"joint j, origin[\s\S]*rpy"),
        (robot(JOINT.format("j", "fixed", "a", "b", "<origin xyz='0 0 ${L}'/>")), r"xacro[\s\S]*\$\{L\}"),
        (robot(JOINT.format("$(arg n)", "fixed", "a", "b", "")), r"xacro[\s\S]*\$\(arg n\)"),
        (robot("<xacro:arm prefix='left'/>"), r"xacro[\s\S]*<arm"),
    ],
)
def test_what_cannot_be_is_refused(text, message):
    with pytest.raises(DataError, match=message):
        read_urdf(text, "r.urdf")
