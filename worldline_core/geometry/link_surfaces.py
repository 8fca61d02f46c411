"""Points on the surfaces of a robot's links, from the meshes and primitive shapes of its description.

A description of kinematics alone has none. MJCF: the geoms of bodies, with defaults by class; URDF: visuals and collisions.
Meshes are STL or OBJ files beside the description; links whose meshes are of another form, or are not there, have no points.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from worldline_core.errors import DataError
from worldline_core.geometry.embodiment import Embodiment, read_description
from worldline_core.geometry.kinematic_tree import parse_xml
from worldline_core.geometry.transforms import (
    rotation_from_euler_fixed_xyz,
    rotation_from_euler_moving_xyz,
    rotation_from_quaternion_wxyz,
)

POINTS_OF_A_LINK = 12
MAX_MESH_BYTES, SAMPLED_VERTICES = 200_000_000, 4000
RADIUS_SHARE, MIN_RADIUS_M = 0.6, 0.008
"""A point stands for the surface around it: this share of the largest distance to the next point."""


def link_surfaces(embodiment: Embodiment) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """By link: points (p, 3) in the link's frame and their radii (p,) [m]; no entry for a link without shapes."""
    text, path = read_description(embodiment), embodiment.description_path
    found = surfaces_of(parse_xml(text, path), path.parent)
    mounts = embodiment.description.mounts
    return {f"{m}/{link}": value for m in mounts for link, value in found.items()} if mounts else found


def surfaces_of(root: ET.Element, folder: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """The same of a description, whose meshes are named from a folder."""
    shapes = _urdf_shapes(root, folder) if root.tag == "robot" else _mjcf_shapes(root, folder)
    vertices: dict[str, list[np.ndarray]] = {}
    spheres: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for link, points, radius in shapes:
        if radius:
            spheres.setdefault(link, []).append((points, np.array([radius])))
        else:
            vertices.setdefault(link, []).append(points)
    for link, parts in vertices.items():
        spheres.setdefault(link, []).append(spread(np.concatenate(parts)))
    return {link: (np.concatenate([p for p, _ in s]), np.concatenate([r for _, r in s])) for link, s in spheres.items()}


def spread(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Some vertices, each as far as possible from those before it, and the radius that they stand for."""
    if len(vertices) > SAMPLED_VERTICES:
        vertices = vertices[np.random.default_rng(0).permutation(len(vertices))[:SAMPLED_VERTICES]]
    chosen = [0]
    distance = np.linalg.norm(vertices - vertices[0], axis=1)
    for _ in range(min(POINTS_OF_A_LINK, len(vertices)) - 1):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(vertices - vertices[chosen[-1]], axis=1))
    radius = max(RADIUS_SHARE * float(distance.max()), MIN_RADIUS_M)
    return vertices[chosen], np.full(len(chosen), radius)


def _mjcf_shapes(root: ET.Element, folder: Path) -> Iterator[tuple[str, np.ndarray, float]]:
    """(body, points in its frame, radius of a sphere or 0) of every geom."""
    compiler = {key: value for each in root.findall("compiler") for key, value in each.attrib.items()}
    folder = folder / compiler.get("meshdir", compiler.get("assetdir", ""))
    geoms, meshes = dict[str, dict[str, str]](), dict[str, dict[str, str]]()
    for default in root.findall("default"):
        _defaults(default, "main", geoms, meshes, {}, {})
    files = {}
    for mesh in root.iterfind("asset/mesh"):
        values = {**meshes.get(mesh.get("class", "main"), {}), **mesh.attrib}
        if "file" in values:
            files[values.get("name", Path(values["file"]).stem)] = values
    worldbody = root.find("worldbody")
    front = [] if worldbody is None else [(body, None) for body in worldbody.findall("body")]
    while front:
        body, inherited = front.pop()
        childclass = body.get("childclass", inherited)
        front += [(child, childclass) for child in body.findall("body")]
        for geom in body.findall("geom"):
            values = {**geoms.get(geom.get("class", childclass) or "main", {}), **geom.attrib}
            points, radius = _geom_points(values, files, folder)
            if len(points) and body.get("name"):
                place = np.array(_floats(values.get("pos", "0 0 0")))
                yield str(body.get("name")), points @ _turn(values, compiler).T + place, radius


def _defaults(
    element: ET.Element, name: str, geoms: dict[str, dict[str, str]], meshes: dict[str, dict[str, str]],
    geom: dict[str, str], mesh: dict[str, str],
) -> None:  # fmt: skip
    """Collects the defaults of geoms and meshes by class; a class inherits those around it."""
    of_geoms, of_meshes = element.find("geom"), element.find("mesh")
    name = element.get("class", name)
    geoms[name] = {**geom, **geoms.get(name, {}), **({} if of_geoms is None else of_geoms.attrib)}
    meshes[name] = {**mesh, **meshes.get(name, {}), **({} if of_meshes is None else of_meshes.attrib)}
    for child in element.findall("default"):
        _defaults(child, name, geoms, meshes, geoms[name], meshes[name])


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
_CORNERS = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]), axis=-1).reshape(-1, 3)


def _geom_points(values: dict[str, str], files: dict[str, dict[str, str]], folder: Path) -> tuple[np.ndarray, float]:
    """Points (n, 3) on the shape in the geom's frame, and the radius of a sphere; none of planes and what cannot be read."""
    kind = values.get("type", "mesh" if "mesh" in values else "sphere")
    size = np.array([*_floats(values.get("size", "")), 0.0, 0.0, 0.0])[:3]
    if kind == "mesh":
        mesh = files.get(values.get("mesh", ""), {})
        return mesh_vertices(folder / mesh.get("file", "")) * _floats(mesh.get("scale", "1 1 1")), 0.0
    if "fromto" in values:
        start, end = np.array(_floats(values["fromto"])).reshape(2, 3)
        return start + np.linspace(0, 1, 8)[:, None] * (end - start), 0.0
    if kind in ("box", "ellipsoid"):
        return _CORNERS * size, 0.0
    if kind in ("capsule", "cylinder"):
        return _CORNERS * (size[0] / np.sqrt(2), size[0] / np.sqrt(2), size[1]), 0.0
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
        return mesh_vertices(folder / name) * _floats(given.get("scale", "1 1 1")), 0.0
    size = given.get("size") or f"{given.get('radius', 0)} {float(given.get('length', 0)) / 2}"
    halves = " ".join(str(value / 2) for value in _floats(size)) if form.tag == "box" else size
    return _geom_points({"type": form.tag, "size": halves}, {}, folder)


def mesh_vertices(path: Path) -> np.ndarray:
    """(n, 3) vertices of an STL or OBJ file; none of another form, or where there is no file.

    Raises: DataError for a damaged or huge file.
    """
    suffix = path.suffix.lower()
    if suffix not in (".stl", ".obj") or not path.is_file():
        return _NOTHING
    if path.stat().st_size > MAX_MESH_BYTES:
        raise DataError("A mesh is too large", where=path, expected=f"at most {MAX_MESH_BYTES:,} bytes")
    data = path.read_bytes()
    try:
        if suffix == ".obj":
            vertices = np.array([line.split()[1:4] for line in data.decode().splitlines() if line.startswith("v ")])
        elif data[:5] == b"solid" and b"facet" in data[:1000]:
            vertices = np.array(
                [line.split()[1:] for line in data.decode().splitlines() if line.split()[:1] == ["vertex"]]
            )
        else:
            triangle = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
            vertices = np.frombuffer(data, triangle, offset=84, count=int.from_bytes(data[80:84], "little"))["corners"]
        vertices = np.asarray(vertices, dtype=np.float64).reshape(-1, 3)
    except (ValueError, UnicodeDecodeError) as error:
        raise DataError("A mesh cannot be read", where=path, got=str(error)) from error
    if not len(vertices) or not np.isfinite(vertices).all():
        raise DataError("A mesh has no vertices, or one that is not finite", where=path)
    return vertices
