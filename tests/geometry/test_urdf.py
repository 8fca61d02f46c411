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
def test_what_cannot_be_is_refused(body, message):
    with pytest.raises(DataError, match=message):
        read_urdf(f"<robot name='r'><link name='a'/><link name='b'/>{body}</robot>", "r.urdf")


@pytest.mark.parametrize(("text", "message"), [("<mujoco/>", r"Not a URDF[\s\S]*<mujoco>"), ("<robot", "not XML")])
def test_what_is_no_urdf_is_refused(text, message):
    with pytest.raises(DataError, match=message):
        read_urdf(text, "r.urdf")
