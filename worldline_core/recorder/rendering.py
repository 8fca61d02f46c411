"""Scenes, and what their cameras see: frames, exact robot masks and exact camera poses of recorded positions.

Frames are rendered at twice the recorded size and averaged down: better looking and cheaper than multisampling.
Cameras are given in OpenCV axes (x right, y down, z forward), pixel centres at integer coordinates. Training and test
scenes share no id and no colours.
"""

from __future__ import annotations

import colorsys
import importlib
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.errors import UnavailableError, installing
from worldline_core.recorder.bodies import Colour
from worldline_core.recorder.scene import SceneModel

FRAME_SIZE = (128, 192)
# MuJoCo cameras look along -z with y up.
OPENCV_AXES = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Scene:
    """Colours and light of a room."""

    scene_id: str
    table: Colour
    floor: Colour
    wall: Colour
    light_direction: tuple[float, float, float]
    light: float
    ambient: float


def _hsv(hue: float, saturation: float, value: float) -> Colour:
    red, green, blue = colorsys.hsv_to_rgb(hue % 1.0, saturation, value)
    return (red, green, blue)


def _scene(number: int, table: Colour, floor: Colour, wall: Colour) -> Scene:
    random = np.random.default_rng(7000 + number)
    direction = (float(random.uniform(-0.5, 0.5)), float(random.uniform(-0.5, 0.5)), -1.0)
    # Six draws had another use once: without them the light of every scene would change.
    random.uniform(size=6)
    return Scene(
        scene_id=f"scene_{number:02d}",
        table=table,
        floor=floor,
        wall=wall,
        light_direction=direction,
        light=float(random.uniform(0.42, 0.62)),
        ambient=float(random.uniform(0.30, 0.42)),
    )


# Tables are of middle brightness and weak saturation: robots are dark or white, objects saturated.
_TABLES: tuple[tuple[Colour, Colour, Colour], ...] = (
    (_hsv(0.08, 0.38, 0.62), _hsv(0.60, 0.10, 0.32), _hsv(0.12, 0.08, 0.70)),
    (_hsv(0.58, 0.18, 0.58), _hsv(0.09, 0.20, 0.40), _hsv(0.58, 0.05, 0.75)),
    (_hsv(0.35, 0.16, 0.56), _hsv(0.00, 0.00, 0.30), _hsv(0.33, 0.06, 0.72)),
    (_hsv(0.10, 0.16, 0.70), _hsv(0.62, 0.25, 0.35), _hsv(0.55, 0.12, 0.60)),
    (_hsv(0.02, 0.26, 0.55), _hsv(0.10, 0.10, 0.50), _hsv(0.08, 0.10, 0.68)),
    (_hsv(0.00, 0.00, 0.55), _hsv(0.58, 0.20, 0.25), _hsv(0.00, 0.00, 0.70)),
    (_hsv(0.52, 0.24, 0.52), _hsv(0.52, 0.10, 0.30), _hsv(0.15, 0.10, 0.66)),
    (_hsv(0.13, 0.30, 0.60), _hsv(0.30, 0.12, 0.33), _hsv(0.60, 0.08, 0.62)),
    (_hsv(0.75, 0.12, 0.58), _hsv(0.75, 0.08, 0.34), _hsv(0.12, 0.05, 0.72)),
    (_hsv(0.62, 0.26, 0.48), _hsv(0.08, 0.18, 0.45), _hsv(0.60, 0.10, 0.70)),
    (_hsv(0.06, 0.30, 0.48), _hsv(0.55, 0.14, 0.40), _hsv(0.06, 0.08, 0.60)),
    (_hsv(0.25, 0.14, 0.64), _hsv(0.65, 0.10, 0.38), _hsv(0.25, 0.05, 0.74)),
    (_hsv(0.45, 0.20, 0.54), _hsv(0.05, 0.20, 0.35), _hsv(0.45, 0.05, 0.70)),
    (_hsv(0.09, 0.34, 0.54), _hsv(0.58, 0.16, 0.42), _hsv(0.70, 0.06, 0.66)),
    (_hsv(0.66, 0.16, 0.62), _hsv(0.66, 0.08, 0.28), _hsv(0.10, 0.10, 0.70)),
    (_hsv(0.95, 0.14, 0.60), _hsv(0.40, 0.10, 0.36), _hsv(0.95, 0.05, 0.70)),
)
SCENES: dict[str, Scene] = {
    scene.scene_id: scene for scene in (_scene(number, *colours) for number, colours in enumerate(_TABLES))
}
TRAIN_SCENES: tuple[str, ...] = tuple(f"scene_{n:02d}" for n in range(12))
TEST_SCENES: tuple[str, ...] = tuple(f"scene_{n:02d}" for n in range(12, 16))


def prepare_rendering() -> None:
    """Choose the off-screen OpenGL back end; ``MUJOCO_GL`` decides where it is set, otherwise EGL.

    Raises: UnavailableError when MuJoCo is not installed.
    """
    chosen = "MUJOCO_GL" in os.environ
    os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        import mujoco  # noqa: F401
    except ImportError as error:
        raise UnavailableError(
            "Recording needs MuJoCo",
            got=str(error),
            next_step=f"{installing('sim')}; on Debian also libegl1 libegl-mesa0 libgl1-mesa-dri",
        ) from error
    if not chosen:
        # MuJoCo reads the variable once, when it is imported: what was imported earlier has chosen a window.
        for name in ("mujoco.rendering.classic.gl_context", "mujoco.gl_context"):
            if name in sys.modules:
                importlib.reload(sys.modules[name])


def look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """MuJoCo camera rotation (3, 3) at ``eye`` looking at ``target``."""
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back], axis=1)


def wrist_camera_pose(scene: SceneModel, arm: int) -> tuple[np.ndarray, np.ndarray]:
    """Position (3,) and MuJoCo camera rotation (3, 3) of an arm's wrist camera in its ``ee`` body."""
    import mujoco

    model, site, mount = scene.model, scene.arms[arm].tool_site, scene.robot.wrist
    flat = np.zeros(9)
    mujoco.mju_quat2Mat(flat, model.site_quat[site])
    rotation = flat.reshape(3, 3)
    eye, target = np.asarray(mount.eye), np.asarray(mount.target)
    in_tool = look_at(eye, target, np.array([-1.0, 0.0, 0.0]))
    return model.site_pos[site] + rotation @ eye, rotation @ in_tool


def intrinsics(fovy_deg: float, height: int, width: int) -> np.ndarray:
    """K (3, 3) of a pinhole with square pixels; the principal point is the image centre ((W-1)/2, (H-1)/2)."""
    focal = 0.5 * height / np.tan(np.deg2rad(fovy_deg) / 2)
    return np.array([[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]])


class SceneRenderer:
    """Renders one scene model; call ``close`` when done (software OpenGL needs it)."""

    def __init__(self, scene: SceneModel) -> None:
        import mujoco

        self.scene = scene
        self.cameras = {"head": "head", **{f"{arm.name}_wrist": f"{arm.name}/wrist" for arm in scene.robot.arms}}
        self._data: Any = mujoco.MjData(scene.model)
        height, width = FRAME_SIZE
        self._colour: Any = mujoco.Renderer(scene.model, 2 * height, 2 * width)
        self._masks: Any = mujoco.Renderer(scene.model, height, width)
        self._masks.enable_segmentation_rendering()
        self._option: Any = mujoco.MjvOption()
        self._option.geomgroup[3] = 0
        self._option.sitegroup[:] = 0

    def close(self) -> None:
        self._colour.close()
        self._masks.close()

    def set_look(self, look: Scene) -> None:
        """Colours and light."""
        model = self.scene.model
        for name, colour in (("table", look.table), ("floor", look.floor), ("wall", look.wall)):
            model.geom_rgba[model.geom(name).id] = [*colour, 1.0]
        direction = np.asarray(look.light_direction)
        model.light_dir[0] = direction / np.linalg.norm(direction)
        model.light_diffuse[0] = look.light
        model.light_ambient[0] = 0.0
        model.light_specular[0] = 0.15
        model.vis.headlight.ambient[:] = look.ambient
        model.vis.headlight.diffuse[:] = 0.28
        model.vis.headlight.specular[:] = 0.05

    def place_cameras(self, eye: np.ndarray, target: np.ndarray) -> None:
        """The head camera at ``eye`` (3,) looking at ``target`` (3,), the wrist cameras at their mounts."""
        self._place("head", eye, look_at(eye, target, np.array([0.0, 0.0, 1.0])))
        for number, arm in enumerate(self.scene.robot.arms):
            self._place(f"{arm.name}/wrist", *wrist_camera_pose(self.scene, number))

    def _place(self, camera: str, position: np.ndarray, rotation: np.ndarray) -> None:
        import mujoco

        number = self.scene.model.camera(camera).id
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, np.ascontiguousarray(rotation).reshape(9))
        self.scene.model.cam_pos[number] = position
        self.scene.model.cam_quat[number] = quat

    def render(
        self, qpos: np.ndarray, paint: Callable[[np.ndarray], None], labels: np.ndarray
    ) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, np.ndarray], dict[str, CameraTrack]]:
        """Render positions (N, nq) from every camera.

        Args:
            paint: changes the model's colours before each frame, by its positions (nq,).
            labels: uint8 (number of geoms,), what thing each geom belongs to, 0 for none.

        Returns: frames uint8 (N, 128, 192, 3); robot masks bool (N, 128, 192); labels uint8 (N, 128, 192);
            camera tracks.
        """
        import mujoco

        model, data = self.scene.model, self._data
        frames: dict[str, list[np.ndarray]] = {view: [] for view in self.cameras}
        masks: dict[str, list[np.ndarray]] = {view: [] for view in self.cameras}
        things: dict[str, list[np.ndarray]] = {view: [] for view in self.cameras}
        poses: dict[str, list[np.ndarray]] = {view: [] for view in self.cameras}
        height, width = FRAME_SIZE
        for positions in qpos:
            data.qpos[:] = positions
            paint(positions)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_camlight(model, data)
            for view, camera in self.cameras.items():
                self._colour.update_scene(data, camera, self._option)
                frames[view].append(cv2.resize(self._colour.render(), (width, height), interpolation=cv2.INTER_AREA))
                self._masks.update_scene(data, camera, self._option)
                drawn = self._masks.render()
                is_geom = (drawn[..., 1] == int(mujoco.mjtObj.mjOBJ_GEOM)) & (drawn[..., 0] >= 0)
                geoms = np.maximum(drawn[..., 0], 0)
                masks[view].append(is_geom & self.scene.robot_geoms[geoms])
                things[view].append(np.where(is_geom, labels[geoms], 0))
                pose = np.eye(4)
                pose[:3, :3] = data.camera(camera).xmat.reshape(3, 3) @ OPENCV_AXES
                pose[:3, 3] = data.camera(camera).xpos
                poses[view].append(pose)
        tracks = {}
        for view, camera in self.cameras.items():
            T_base_camera = np.array(poses[view])
            tracks[view] = CameraTrack(
                view=view,
                K=intrinsics(float(model.camera(camera).fovy[0]), height, width),
                # The head camera stands still: one pose serves all frames.
                T_base_camera=T_base_camera[:1] if view == "head" else T_base_camera,
                width=width,
                height=height,
            )
        pictures, robot, labelled = ({v: np.array(i) for v, i in images.items()} for images in (frames, masks, things))
        return pictures, robot, labelled, tracks
