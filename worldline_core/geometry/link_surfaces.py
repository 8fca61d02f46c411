"""Points on the surfaces of a robot's links, from the meshes and primitive shapes of its description.

A description of kinematics alone has none. MJCF: the geoms of bodies, with defaults by class; URDF: visuals, or collisions.
Meshes are STL or OBJ files beside the description; links whose meshes are of another form, or are not there, have no points.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from worldline_core.errors import DataError
from worldline_core.geometry.embodiment import Embodiment, read_description
from worldline_core.geometry.kinematic_tree import mjcf_defaults, overlaid, parse_xml
from worldline_core.geometry.transforms import (
    rotation_from_euler_fixed_xyz,
    rotation_from_euler_moving_xyz,
    rotation_from_quaternion_wxyz,
)

MAX_MESH_BYTES, SAMPLED_POINTS = 200_000_000, 4000
RADIUS_SHARE = 0.6
"""A point stands for the surface around it: this share of the largest distance to the next point."""


@dataclass(frozen=True)
class Sampling:
    """Number of points on a link at most, and their least radius [m]."""

    points: int
    least_radius_m: float


COARSE = Sampling(12, 0.008)
"""As an arm is seen from a metre away."""
FINE = Sampling(150, 0.002)
"""As a wrist camera sees the hand: with COARSE, an SO-101's tool was estimated 4 to 5 % of the picture's width from its place."""


def link_surfaces(embodiment: Embodiment, sampling: Sampling) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """By link: points (p, 3) in the link's frame and their radii (p,) [m]; no entry for a link without shapes."""
    text, path = read_description(embodiment), embodiment.description_path
    found = surfaces_of(parse_xml(text, path), path.parent, sampling)
    mounts = embodiment.description.mounts
    return {f"{m}/{link}": value for m in mounts for link, value in found.items()} if mounts else found


def surfaces_of(root: ET.Element, folder: Path, sampling: Sampling) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """The same of a description, whose meshes are named from a folder."""
    shapes = _urdf_shapes(root, folder) if root.tag == "robot" else _mjcf_shapes(root, folder)
    parts: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for link, points, radius in shapes:
        parts.setdefault(link, []).append((points, np.full(len(points), radius)))
    joined = {link: [np.concatenate(each) for each in zip(*found, strict=True)] for link, found in parts.items()}
    return {link: spread(points, radii, sampling) for link, (points, radii) in joined.items()}


def spread(points: np.ndarray, radii: np.ndarray, sampling: Sampling) -> tuple[np.ndarray, np.ndarray]:
    """Some points, each as far as possible from those before it, and the radii that they stand for.

    Args:
        radii: of spheres; 0 of points on a surface.
    """
    chosen = [0]
    distance = np.linalg.norm(points - points[0], axis=1)
    for _ in range(min(sampling.points, len(points)) - 1):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    apart = RADIUS_SHARE * float(distance.max())
    least = np.where(radii[chosen] > 0, apart, max(apart, sampling.least_radius_m))
    return points[chosen], np.maximum(radii[chosen], least)


def _mjcf_shapes(root: ET.Element, folder: Path) -> Iterator[tuple[str, np.ndarray, float]]:
    """(body, points in its frame, radius of a sphere or 0) of every geom; where some touch nothing, of these: the others are
    for contacts, and not seen.
    """
    compiler = {key: value for each in root.findall("compiler") for key, value in each.attrib.items()}
    defaults = mjcf_defaults(root, ("geom", "mesh"), folder)
    folder = folder / compiler.get("meshdir", compiler.get("assetdir", ""))
    files = {}
    for mesh in root.iterfind("asset/mesh"):
        values = {**defaults.get(mesh.get("class", "main"), {}).get("mesh", {}), **mesh.attrib}
        if "file" in values:
            files[values.get("name", Path(values["file"]).stem)] = values
    worldbody = root.find("worldbody")
    front = [] if worldbody is None else [(body, None) for body in worldbody.findall("body")]
    while front:
        body, inherited = front.pop()
        childclass = body.get("childclass", inherited)
        front += [(child, childclass) for child in body.findall("body")]
        described = [
            overlaid(defaults.get(geom.get("class", childclass) or "main", {}).get("geom", {}), geom.attrib)
            for geom in body.findall("geom")
        ]
        seen = [values for values in described if values.get("contype") == values.get("conaffinity") == "0"]
        for values in seen or described:
            points, radius = _geom_points(values, files, folder)
            if len(points) and body.get("name"):
                place = np.array(_floats(values.get("pos", "0 0 0")))
                yield str(body.get("name")), points @ _turn(values, compiler).T + place, radius


def _turn(values: dict[str, str], compiler: dict[str, str]) -> np.ndarray:
    """(3, 3) of a geom's quat or euler; other forms of orientation are rare, and shapes need no digits."""
    if "quat" in values:
        return rotation_from_quaternion_wxyz(np.array(_floats(values["quat"])))
    if "euler" in values:
        angles = np.array(_floats(values["euler"]))
        angles = angles if compiler.get("angle", "degree") == "radian" else np.radians(angles)
        return rotation_from_euler_moving_xyz(angles)
    return np.eye(3)


_NOTHING = np.zeros((0, 3))
_SIDE = np.array([[[1, -1, -1], [1, 1, -1], [1, 1, 1]], [[1, -1, -1], [1, 1, 1], [1, -1, 1]]])
_BOX = np.concatenate([sign * np.roll(_SIDE, axis, axis=-1) for sign in (-1.0, 1.0) for axis in range(3)])
"""(12, 3, 3) triangles of a box whose halves are 1."""


def _geom_points(values: dict[str, str], files: dict[str, dict[str, str]], folder: Path) -> tuple[np.ndarray, float]:
    """Points (n, 3) on the shape in the geom's frame, and the radius of a sphere; none of planes and what cannot be read."""
    kind = values.get("type", "mesh" if "mesh" in values else "sphere")
    size = np.array([*_floats(values.get("size", "")), 0.0, 0.0, 0.0])[:3]
    if kind == "mesh":
        mesh = files.get(values.get("mesh", ""), {})
        return points_on_mesh(folder / mesh.get("file", "")) * _floats(mesh.get("scale", "1 1 1")), 0.0
    if "fromto" in values:
        start, end = np.array(_floats(values["fromto"])).reshape(2, 3)
        return start + np.linspace(0, 1, 8)[:, None] * (end - start), float(size[0])
    if kind in ("box", "ellipsoid"):
        return _points_on(_BOX * size), 0.0
    if kind in ("capsule", "cylinder"):
        return _points_on(_BOX * (size[0] / np.sqrt(2), size[0] / np.sqrt(2), size[1])), 0.0
    return (np.zeros((1, 3)), float(size[0])) if kind == "sphere" else (_NOTHING, 0.0)


def _floats(text: str) -> list[float]:
    """Numbers of an attribute. Raises: DataError for what is no finite number."""
    try:
        values = [float(value) for value in text.split()]
    except ValueError as error:
        raise DataError("A shape's attribute holds no numbers", got=text) from error
    if not np.isfinite(values).all():
        raise DataError("A shape's attribute is not finite", got=text)
    return values


def _urdf_shapes(root: ET.Element, folder: Path) -> Iterator[tuple[str, np.ndarray, float]]:
    """The same of every visual, or of every collision where a link has no visual."""
    for link in root.findall("link"):
        for shape in link.findall("visual") or link.findall("collision"):
            origin = shape.find("origin")
            given = {} if origin is None else origin.attrib
            xyz, rpy = (np.array(_floats(given.get(key, "0 0 0"))) for key in ("xyz", "rpy"))
            for form in shape.iterfind("geometry/*"):
                points, radius = _urdf_points(form, folder)
                if len(points):
                    yield link.get("name", ""), points @ rotation_from_euler_fixed_xyz(rpy).T + xyz, radius


def _urdf_points(form: ET.Element, folder: Path) -> tuple[np.ndarray, float]:
    given = form.attrib
    if form.tag == "mesh":
        name = given.get("filename", "").removeprefix("file://")
        if name.startswith("package://"):  # the package's folder is one of those around the description
            inside = name.removeprefix("package://").partition("/")[2]
            name = next((str(up / inside) for up in (folder, *folder.parents) if (up / inside).is_file()), inside)
        return points_on_mesh(folder / name) * _floats(given.get("scale", "1 1 1")), 0.0
    size = given.get("size") or f"{given.get('radius', 0)} {float(given.get('length', 0)) / 2}"
    halves = " ".join(str(value / 2) for value in _floats(size)) if form.tag == "box" else size
    return _geom_points({"type": form.tag, "size": halves}, {}, folder)


def points_on_mesh(path: Path) -> np.ndarray:
    """(n, 3) corners and points on the triangles of an STL or OBJ file; none of another form, or where there is no file.

    Raises: DataError for a damaged or huge file.
    """
    suffix = path.suffix.lower()
    if suffix not in (".stl", ".obj") or not path.is_file():
        return _NOTHING
    if path.stat().st_size > MAX_MESH_BYTES:
        raise DataError("A mesh is too large", where=path, expected=f"at most {MAX_MESH_BYTES:,} bytes")
    try:
        triangles = (_obj_triangles if suffix == ".obj" else _stl_triangles)(path.read_bytes())
    except (ValueError, IndexError, UnicodeDecodeError) as error:
        raise DataError("A mesh cannot be read", where=path, got=str(error)) from error
    if not len(triangles) or not np.isfinite(triangles).all():
        raise DataError("A mesh has no triangles, or a corner that is not finite", where=path)
    return _points_on(triangles)


def _obj_triangles(data: bytes) -> np.ndarray:
    lines = [line.split() for line in data.decode().splitlines()]
    vertices = np.array([line[1:4] for line in lines if line[:1] == ["v"]], dtype=np.float64).reshape(-1, 3)
    faces = [[int(corner.split("/")[0]) for corner in line[1:]] for line in lines if line[:1] == ["f"]]
    fans = [(face[0], *face[i : i + 2]) for face in faces for i in range(1, len(face) - 1)]
    corners = np.array(fans, dtype=np.int64).reshape(-1, 3)
    if (corners == 0).any():
        raise ValueError("a face names vertex 0; the first is 1")
    return vertices[np.where(corners > 0, corners - 1, corners)]


def _stl_triangles(data: bytes) -> np.ndarray:
    if data[:5] == b"solid" and b"facet" in data[:1000]:
        lines = [line.split() for line in data.decode().splitlines()]
        corners = np.array([line[1:] for line in lines if line[:1] == ["vertex"]], dtype=np.float64)
        return corners.reshape(-1, 3, 3)
    triangle = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    count = int.from_bytes(data[80:84], "little")
    return np.frombuffer(data, triangle, offset=84, count=count)["corners"].astype(np.float64)


def _points_on(triangles: np.ndarray) -> np.ndarray:
    """Corners (at most SAMPLED_POINTS) of triangles (t, 3, 3), and as many points spread evenly over their area."""
    random = np.random.default_rng(0)
    corners = random.permutation(triangles.reshape(-1, 3))[:SAMPLED_POINTS]
    sides = triangles[:, 1:] - triangles[:, :1]
    with np.errstate(over="ignore", invalid="ignore"):  # of a damaged file
        area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    if not 0 < area.sum() < np.inf:
        return corners
    chosen = random.choice(len(triangles), SAMPLED_POINTS, p=area / area.sum())
    along = random.random((SAMPLED_POINTS, 2, 1))
    along = np.where(along.sum(axis=1, keepdims=True) > 1, 1 - along, along)  # the other half of the parallelogram
    return np.concatenate([corners, triangles[chosen, 0] + (along * sides[chosen]).sum(axis=1)])
