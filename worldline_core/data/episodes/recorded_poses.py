"""Recorded poses made rigid, or refused with a reason; the mathematics is in geometry.

A rotation up to 1e-3 off an orthonormal one is given the nearest rotation, and the episode's conventions say how many
were and by how much; a worse one puts the episode into quarantine.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from worldline_core.data.episodes.episode import MOUNTED, CameraTrack, Episode
from worldline_core.data.guards.rejection import Reason, RejectedInputError
from worldline_core.errors import CalibrationError
from worldline_core.geometry.cameras import CameraAxes, CameraPose, Extrinsics
from worldline_core.geometry.lens import Distortion
from worldline_core.geometry.transforms import (
    MAX_ROTATION_DEVIATION,
    RotationRepair,
    repair_rotations,
    rotation_deviation,
    rotation_from_quaternion_xyzw,
)

REPAIRED = "rotations_repaired"
MAX_DISTANCE = 1e5
"""Largest distance of a camera from its base, in metres, or in millimetres that are still to be converted."""


@contextmanager
def rejected_as(reason: Reason, where: object, evidence: Mapping[str, Any] | None = None) -> Iterator[None]:
    """Turns a CalibrationError of the maths into the rejection of an episode."""
    try:
        yield
    except CalibrationError as error:
        raise RejectedInputError(
            reason,
            error.what,
            where=where if error.where is None else f"{where}, {error.where}",
            expected=error.expected,
            got=error.got,
            next_step=error.next_step,
            evidence=evidence,
        ) from error


def camera_pose(
    view: str,
    matrices: np.ndarray,
    *,
    extrinsics: Extrinsics = "camera_to_base",
    axes: CameraAxes = "opencv",
    where: object,
) -> CameraPose:
    """A source's extrinsics (N or 1, 4, 4) as a pose that says its convention.

    Raises: RejectedInputError (invalid_extrinsics) with the deviation, when one is not rigid.
    """
    with rejected_as("invalid_extrinsics", where, {"view": view, **_deviation(matrices)}):
        pose = CameraPose.of(matrices, extrinsics=extrinsics, axes=axes, where=f"view {view}")
        if (furthest := float(np.abs(matrices[..., :3, 3]).max(initial=0.0))) > MAX_DISTANCE:
            raise CalibrationError(
                "A camera is too far away", where=f"view {view}", expected=f"at most {MAX_DISTANCE:g}", got=furthest
            )
        return pose


class RecordedCameras:
    """The cameras of one episode, as a reader finds them.

    Attributes:
        tracks: by view.
        lenses: of the views whose images are not those of a pinhole.
        mounted: views whose camera is calibrated in the frame of its tool.
    """

    def __init__(self) -> None:
        self.tracks: dict[str, CameraTrack] = {}
        self.lenses: dict[str, Distortion] = {}
        self.mounted: list[str] = []
        self._repairs: dict[str, RotationRepair] = {}

    def add(
        self, view: str, K: np.ndarray, pose: CameraPose, size: tuple[int, ...], lens: Distortion | None = None
    ) -> None:
        """Add a view.

        Args:
            K: (3, 3) for images of `size` (height, width).
        """
        self.tracks[view] = CameraTrack(view, K, pose.T_base_camera, width=size[1], height=size[0])
        self._repairs[view] = pose.repair
        if lens is not None:
            self.lenses[view] = lens

    def notes(self) -> dict[str, str | int | float]:
        """`repair_notes` of the views, and which are mounted as their calibration says."""
        return repair_notes(self._repairs) | ({MOUNTED: ", ".join(sorted(self.mounted))} if self.mounted else {})


def check_intrinsics(camera: CameraTrack, where: str) -> None:
    """Raises: RejectedInputError (singular_intrinsics)."""
    K = camera.K
    pinhole = np.isfinite(K).all() and K[0, 0] > 1e-6 and K[1, 1] > 1e-6 and np.allclose(K[2], [0, 0, 1], atol=1e-6)
    if not pinhole or abs(np.linalg.det(K)) < 1e-9:
        raise RejectedInputError(
            "singular_intrinsics",
            "Camera matrix cannot be inverted",
            where=where,
            expected="[[fx, s, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0",
            got=K.tolist(),
            evidence={"view": camera.view, "K": [None if not np.isfinite(v) else float(v) for v in K.reshape(-1)]},
        )


def repair_notes(repairs: Mapping[str, RotationRepair]) -> dict[str, str | int | float]:
    """Notes for an episode's conventions on repaired rotations of its views or poses; nothing when none was."""
    touched = {name: repair for name, repair in repairs.items() if repair.count}
    if not touched:
        return {}
    return {
        REPAIRED: sum(repair.count for repair in touched.values()),
        f"{REPAIRED}_of": ", ".join(touched),
        f"{REPAIRED}_largest_deviation": max(repair.largest for repair in touched.values()),
    }


def with_rigid_poses(episode: Episode) -> Episode:
    """The episode with rigid camera and tool poses, the repaired ones counted in its conventions.

    Raises: RejectedInputError (invalid_extrinsics, invalid_tool_pose, nan_state) for a pose that is beyond repair, or a
        quaternion without direction in a state of tool poses.
    """
    where = f"episode {episode.episode_id}"
    _check_quaternions(episode, where)
    repairs: dict[str, RotationRepair] = {}
    cameras = dict(episode.cameras)
    for view, camera in cameras.items():
        pose = camera_pose(view, camera.T_base_camera, where=where)
        repairs[view] = pose.repair
        if pose.repair.count:
            cameras[view] = replace(camera, T_base_camera=pose.T_base_camera)
    tools = episode.T_base_ee
    # Poses that are not finite are reported by `check_values`, with their place.
    if tools is not None and np.isfinite(tools).all():
        with rejected_as("invalid_tool_pose", where, _deviation(tools)):
            tools, repairs["tool poses"] = repair_rotations(tools, "tool poses")
    notes = repair_notes(repairs)
    if not notes:
        return episode
    return replace(episode, cameras=cameras, T_base_ee=tools, conventions={**episode.conventions, **notes})


def _deviation(matrices: np.ndarray) -> dict[str, Any]:
    """Numbers for the quarantine row: how far which poses are from rigid."""
    if matrices.shape[-2:] != (4, 4):
        return {"shape": list(matrices.shape)}
    deviation = rotation_deviation(np.asarray(matrices, np.float64)[..., :3, :3]).reshape(len(matrices), -1).max(axis=1)
    finite = deviation[np.isfinite(deviation)]
    return {
        "frame": int(np.argmax(deviation)),
        "frames": int(np.count_nonzero(deviation > MAX_ROTATION_DEVIATION)),
        "rotation_deviation": float(finite.max()) if len(finite) else None,
        "largest_allowed": MAX_ROTATION_DEVIATION,
    }


def _check_quaternions(episode: Episode, where: str) -> None:
    """Raises: RejectedInputError (nan_state) when a state or action of tool poses holds a quaternion of no length."""
    names = episode.state_names
    if episode.state_kind != "ee_pose" or names is None:
        return
    first = [i for i, name in enumerate(names) if name.endswith("qx") and i + 3 < len(names)]
    for track, values in (("state", episode.state), ("action", episode.action)):
        for column in first:
            quaternions = values[:, column : column + 4]
            if np.isfinite(quaternions).all():
                evidence = {"track": track, "columns": list(names[column : column + 4])}
                with rejected_as("nan_state", f"{where}, {track} {names[column]}", evidence):
                    rotation_from_quaternion_xyzw(quaternions)
