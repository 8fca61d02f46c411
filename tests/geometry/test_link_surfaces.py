"""Points on the links: from meshes and shapes of a description, where they are, and none of what cannot be read."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from worldline_core.errors import DataError
from worldline_core.geometry.embodiment import Embodiment, load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.link_surfaces import COARSE, FINE, Sampling, link_surfaces, points_on_mesh

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], dtype=np.float32)
MJCF = """<mujoco><compiler angle="degree" meshdir="meshes"/>
<default><default class="seen"><geom type="mesh" contype="0" quat="0 1 0 0"/><mesh scale=".1 .1 .1"/></default></default>
<asset><mesh class="seen" name="m" file="part.{form}"/></asset>
<worldbody><body name="arm" childclass="seen"><joint name="j"/>
<geom mesh="m" pos="0 0 1" euler="0 0 90"/></body>
<body name="ball"><geom type="sphere" size=".2" pos="1 0 0"/></body>
<body name="brick"><geom type="box" size=".1 .2 .3"/></body></worldbody></mujoco>"""
URDF = """<robot name="r"><link name="base"/>
<link name="arm"><visual><origin xyz="0 0 1" rpy="0 0 1.5707963267948966"/>
<geometry><mesh filename="package://any/meshes/part.{form}" scale=".1 .1 .1"/></geometry></visual></link>
<link name="ball"><collision><origin xyz="1 0 0"/><geometry><sphere radius=".2"/></geometry></collision></link>
<link name="brick"><visual><geometry><box size=".2 .4 .6"/></geometry></visual></link>
{joints}</robot>"""
JOINTS = "".join(
    f'<joint name="j{n}" type="revolute"><parent link="base"/><child link="{n}"/></joint>'
    for n in ("arm", "ball", "brick")
)


def write_mesh(folder: Path, form: str) -> None:
    folder.mkdir(exist_ok=True)
    faces = [(0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)]
    if form == "obj":
        lines = [f"v {x} {y} {z}" for x, y, z in CORNERS] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
        (folder / "part.obj").write_text("\n".join(lines))
        return
    body = b"".join(struct.pack("<12fH", *np.zeros(3), *CORNERS[list(face)].ravel(), 0) for face in faces)
    (folder / "part.stl").write_bytes(bytes(80) + struct.pack("<I", len(faces)) + body)


def described(folder: Path, form: str, text: str, **changes: Any) -> Embodiment:
    path = folder / f"robot.{form}"
    path.write_text(text)
    arm = {"name": "right", "joints": ["j"], "limits": [(-1, 1)], "end_effector_link": "arm",
           "T_link_tool": {}, "gripper": {"closed": 0.0, "open": 1.0}}  # fmt: skip
    return Embodiment.model_validate({
        "name": "r", "base_link": "world", "arms": [arm], "description_path": path,
        "description": {"format": form, "file": path.name, **changes},
    })  # fmt: skip


@pytest.mark.parametrize("mesh", ["stl", "obj"])
@pytest.mark.parametrize("form", ["mjcf", "urdf"])
def test_points_are_where_the_shapes_are(tmp_path: Path, form: str, mesh: str) -> None:
    write_mesh(tmp_path / "meshes", mesh)
    text = (MJCF if form == "mjcf" else URDF).format(form=mesh, joints=JOINTS)
    robot = described(tmp_path, form, text)
    found = link_surfaces(robot, COARSE)
    points, _ = link_surfaces(robot, FINE)["arm"]
    # Corners at 0, 0.1 y, -0.2 x and 0.3 z, one above the link's origin.
    inside = np.c_[points @ [0, 10, 0], points @ [-5, 0, 0], (points @ [0, 0, 1] - 1) / 0.3]
    weights = np.c_[1 - inside.sum(axis=1), inside]  # of the four corners
    assert len(points) == FINE.points and (weights > -1e-9).all() and (np.abs(weights).min(axis=1) < 1e-6).all()
    assert all((weights[:, side] < 1e-6).sum() > 15 for side in range(4))
    points, radii = found["ball"]
    assert (points.tolist(), radii.tolist()) == ([[1, 0, 0]], [0.2])
    assert np.abs(found["brick"][0]).max(axis=0) == pytest.approx([0.1, 0.2, 0.3])
    on_a_side = np.isclose(np.abs(found["brick"][0]), (0.1, 0.2, 0.3)).any(axis=1)
    assert len(on_a_side) == COARSE.points and on_a_side.all()


@pytest.mark.parametrize(("contact", "count"), [("", 1), ('contype="0" conaffinity="0"', 2)])
def test_shapes_for_contacts_count_only_where_a_body_has_no_others(tmp_path: Path, contact: str, count: int) -> None:
    seen = '<geom class="seen" type="sphere" size=".1"/>'
    touched = f'<geom type="sphere" size=".2" pos="1 0 0" {contact}/>'
    text = f"""<mujoco><default><default class="seen"><geom contype="0" conaffinity="0"/></default></default>
    <worldbody><body name="arm"><joint name="j"/>{seen}{touched}</body>
    <body name="bare">{touched}</body></worldbody></mujoco>"""
    found = link_surfaces(described(tmp_path, "mjcf", text), COARSE)
    assert (len(found["arm"][1]), found["arm"][1][0], found["bare"][1].tolist()) == (count, 0.1, [0.2])


def test_a_mesh_that_is_not_here_gives_no_points_and_a_damaged_one_is_refused(tmp_path: Path) -> None:
    assert "arm" not in link_surfaces(described(tmp_path, "mjcf", MJCF.format(form="stl")), COARSE)
    assert len(points_on_mesh(tmp_path / "part.dae")) == 0
    for data in (b"", bytes(80) + struct.pack("<I", 5) + b"\0" * 50):
        (tmp_path / "part.stl").write_bytes(data)
        with pytest.raises(DataError, match="mesh"):
            points_on_mesh(tmp_path / "part.stl")
    for text in ("v 0 0 0\nf 1 2 3", "v 0 0 0\nf 0 1 1", "v 0 0\nf 1 1 1", "v 0 0 0", "v 0 0 nan\nf 1 1 1", "f 1 1 1"):
        (tmp_path / "part.obj").write_text(text)
        with pytest.raises(DataError, match="mesh"):
            points_on_mesh(tmp_path / "part.obj")


def test_corners_counted_from_the_end_and_polygons(tmp_path: Path) -> None:
    (tmp_path / "square.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf -4/1/1 2//1 3 -1\n")
    points = points_on_mesh(tmp_path / "square.obj")
    assert (points[:, 2] == 0).all() and points.min() == 0 and points.max() == 1
    assert np.histogram2d(*points[6:, :2].T, bins=2, range=[[0, 1]] * 2)[0] == pytest.approx(1000, abs=120)


@pytest.mark.parametrize("far", ["0", "1e300"])
def test_corners_alone_stand_for_triangles_without_a_finite_area(tmp_path: Path, far: str) -> None:
    (tmp_path / "line.obj").write_text(f"v 0 0 0\nv {far} 0 0\nv 0 {far} 0\nf 1 2 3\n")
    assert points_on_mesh(tmp_path / "line.obj").shape == (3, 3)


def test_spheres_are_thinned_and_grow_to_cover_what_they_stand_for(tmp_path: Path) -> None:
    line = "".join(f'<geom type="sphere" size=".002" pos="{i / 100} 0 0"/>' for i in range(41))
    text = f'<mujoco><worldbody><body name="arm"><joint name="j"/>{line}</body></worldbody></mujoco>'
    robot = described(tmp_path, "mjcf", text)
    points, radii = link_surfaces(robot, Sampling(5, 0.008))["arm"]
    assert sorted(points[:, 0]) == pytest.approx([0, 0.1, 0.2, 0.3, 0.4]) and radii == pytest.approx(0.03)
    points, radii = link_surfaces(robot, FINE)["arm"]
    assert len(points) == 41 and radii == pytest.approx(0.002)


@pytest.mark.parametrize("name", ["viperx_graphite", "ur5e_silver", "xarm7_single", "panda_ivory"])
def test_shipped_spheres_lie_on_the_links(name: str) -> None:
    """Each link's points in MuJoCo's reading of the file, against those by our kinematics."""
    kinematics = ArmKinematics(load_embodiment(name))
    model = mujoco.MjModel.from_xml_path(str(kinematics.embodiment.description_path))
    for link, (points, radii) in kinematics.surfaces.items():
        geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] == model.body(link).id]
        assert np.allclose(model.geom_pos[geoms], points)
        assert np.allclose(model.geom_size[geoms, 0], radii)
    assert len(kinematics.surfaces) >= 8
