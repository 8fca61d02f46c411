"""Views of a scene's cameras: frames, exact robot masks and exact camera poses of recorded positions.

Frames are rendered at twice the recorded size and averaged down: better looking and cheaper than multisampling.
Cameras are given in OpenCV axes (x right, y down, z forward), pixel centres at integer coordinates.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.errors import UnavailableError, installing
from worldline_core.recorder.looks import TEXTURES, Look
from worldline_core.recorder.scene import SceneModel

FRAME_SIZE = (128, 192)
# MuJoCo cameras look along -z with y up.
OPENCV_AXES = np.diag([1.0, -1.0, -1.0])


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

    def set_look(self, look: Look) -> None:
        """Set colours, the table's texture, light and the lens of the head camera."""
        model, tint = self.scene.model, np.array(look.tint)
        table = model.geom("table").id
        model.geom_matid[table] = -1 if look.texture is None else model.material(look.texture).id
        for name in TEXTURES:
            model.mat_texrepeat[model.material(name).id] = look.repeats
        for name, colour in (("table", look.table), ("floor", look.floor), ("wall", look.wall)):
            model.geom_rgba[model.geom(name).id] = [*colour, 1.0]
        direction = np.asarray(look.light_direction)
        model.light_dir[0] = direction / np.linalg.norm(direction)
        model.light_diffuse[0] = look.light * tint
        model.light_ambient[0] = 0.0
        model.light_specular[0] = 0.15
        model.vis.headlight.ambient[:] = look.ambient * tint
        model.vis.headlight.diffuse[:] = look.headlight * tint
        model.vis.headlight.specular[:] = 0.05
        model.cam_fovy[model.camera("head").id] = look.fovy_deg

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
        self, qpos: np.ndarray, paint: Callable[[np.ndarray], None], labels: np.ndarray | None
    ) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, np.ndarray], dict[str, CameraTrack]]:
        """Render positions (N, nq) from every camera.

        Args:
            paint: changes the model's colours before each frame, by its positions (nq,).
            labels: uint8 (number of geoms,), what thing each geom belongs to, 0 for none; None: pictures alone, without masks.

        Returns: by view, frames uint8 (N, 128, 192, 3), robot masks bool (N, 128, 192), labels uint8 (N, 128, 192) and camera
            tracks; no masks and labels where none are wanted.
        """
        import mujoco

        model, data = self.scene.model, self._data
        frames, masks, things, poses = (defaultdict[str, list[np.ndarray]](list) for _ in range(4))
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
                if labels is not None:
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
