"""Pictures, exact robot masks and exact cameras of recorded positions.

Frames are rendered at twice the recorded size and averaged down: better looking and cheaper than multisampling.
Cameras are given in OpenCV axes (x right, y down, z forward), pixel centres at integer coordinates.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.recorder.scene_model import SceneModel
from worldline_core.recorder.task_layout import Scene

FRAME_SIZE = (128, 192)
# MuJoCo cameras look along -z with y up.
OPENCV_AXES = np.diag([1.0, -1.0, -1.0])


def look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """MuJoCo camera rotation (3, 3) at ``eye`` looking at ``target``."""
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back], axis=1)


def intrinsics(fovy_deg: float, height: int, width: int) -> np.ndarray:
    """K (3, 3) of a pinhole with square pixels; the principal point is the image centre ((W-1)/2, (H-1)/2)."""
    focal = 0.5 * height / np.tan(np.deg2rad(fovy_deg) / 2)
    return np.array([[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]])


class SceneRenderer:
    """Renders one scene model; call ``close`` when done (software OpenGL needs it)."""

    def __init__(self, scene: SceneModel) -> None:
        import mujoco

        self.scene = scene
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

    def set_scene(self, look: Scene, jitter: np.random.Generator) -> None:
        """Colours, light and cameras of an episode; ``jitter`` moves the head camera a little per episode."""
        import mujoco

        model, robot = self.scene.model, self.scene.robot
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
        scale = robot.scale if len(robot.arms) == 1 else 1.0
        eye = np.asarray(robot.head.eye) + scale * (np.asarray(look.camera_shift) + jitter.normal(0, 0.006, 3))
        target = np.asarray(robot.head.target) + scale * (np.asarray(look.target_shift) + jitter.normal(0, 0.004, 3))
        self._place("head", eye, look_at(eye, target, np.array([0.0, 0.0, 1.0])))
        for number, arm in enumerate(robot.arms):
            site = self.scene.tool_sites[number]
            rotation = np.zeros(9)
            mujoco.mju_quat2Mat(rotation, model.site_quat[site])
            rotation = rotation.reshape(3, 3)
            eye, target = np.asarray(robot.wrist.eye), np.asarray(robot.wrist.target)
            in_tool = look_at(eye, target, np.array([-1.0, 0.0, 0.0]))
            self._place(f"{arm.name}/wrist", model.site_pos[site] + rotation @ eye, rotation @ in_tool)

    def _place(self, camera: str, position: np.ndarray, rotation: np.ndarray) -> None:
        import mujoco

        number = self.scene.model.camera(camera).id
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, np.ascontiguousarray(rotation).reshape(9))
        self.scene.model.cam_pos[number] = position
        self.scene.model.cam_quat[number] = quat

    def render(self, qpos: np.ndarray) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, CameraTrack]]:
        """Frames uint8 (N, 128, 192, 3), robot masks bool (N, 128, 192) and camera tracks per view for (N, nq)."""
        import mujoco

        model, robot, data = self.scene.model, self.scene.robot, self._data
        cameras = {"head": "head", **{f"{arm.name}_wrist": f"{arm.name}/wrist" for arm in robot.arms}}
        frames: dict[str, list[np.ndarray]] = {view: [] for view in cameras}
        masks: dict[str, list[np.ndarray]] = {view: [] for view in cameras}
        poses: dict[str, list[np.ndarray]] = {view: [] for view in cameras}
        height, width = FRAME_SIZE
        for positions in qpos:
            data.qpos[:] = positions
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_camlight(model, data)
            for view, camera in cameras.items():
                self._colour.update_scene(data, camera, self._option)
                picture = self._colour.render().reshape(height, 2, width, 2, 3).astype(np.uint16)
                frames[view].append(((picture.sum(axis=(1, 3)) + 2) // 4).astype(np.uint8))
                self._masks.update_scene(data, camera, self._option)
                geoms = self._masks.render()
                geom_mask = (geoms[..., 1] == int(mujoco.mjtObj.mjOBJ_GEOM)) & (geoms[..., 0] >= 0)
                masks[view].append(geom_mask & self.scene.robot_geoms[np.maximum(geoms[..., 0], 0)])
                number = model.camera(camera).id
                pose = np.eye(4)
                pose[:3, :3] = data.cam_xmat[number].reshape(3, 3) @ OPENCV_AXES
                pose[:3, 3] = data.cam_xpos[number]
                poses[view].append(pose)
        tracks = {}
        for view, camera in cameras.items():
            stacked = np.array(poses[view])
            fovy = float(model.cam_fovy[model.camera(camera).id])
            tracks[view] = CameraTrack(
                view=view,
                K=intrinsics(fovy, height, width),
                T_base_camera=stacked[:1] if view == "head" else stacked,
                width=width,
                height=height,
            )
        return (
            {view: np.array(value) for view, value in frames.items()},
            {view: np.array(value) for view, value in masks.items()},
            tracks,
        )
