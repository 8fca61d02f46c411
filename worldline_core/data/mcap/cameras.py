"""Calibration messages as pinhole cameras with lenses."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.data.episodes.recorded_poses import camera_pose, rejected_as
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.mcap.file import McapFile
from worldline_core.data.mcap.messages import Calibration
from worldline_core.data.mcap.streams import Stream
from worldline_core.data.mcap.topics_config import McapTopicsSourceConfig, ViewTopics
from worldline_core.data.mcap.transforms import TransformTree, fixed_or_moving
from worldline_core.geometry.cameras import CameraPose, ImageTransform
from worldline_core.geometry.distortion import Distortion, distortion_from_ros


def one_calibration(values: list[Calibration], where: str) -> Calibration:
    """What all messages of a topic say.

    Raises: RejectedInputError (changing_calibration) when they differ: a zoom, or two cameras on one topic.
    """
    different = next((value for value in values if value != values[0]), None)
    if different is not None:
        raise RejectedInputError(
            "changing_calibration",
            "Calibration changes during the recording",
            where=where,
            expected=f"K {list(values[0].K)}, D {list(values[0].D)} of {values[0].width}x{values[0].height}",
            got=f"K {list(different.K)}, D {list(different.D)} of {different.width}x{different.height}",
        )
    return values[0]


def intrinsics(calibration: Calibration, *, rectified: bool, where: str) -> tuple[np.ndarray, tuple[int, int]]:
    """K (3, 3) of the published image, and its size (height, width), after binning and region of interest.

    K and P are of the whole sensor (ROS REP 104); a region is cut out first, then binned.

    Raises: RejectedInputError (singular_intrinsics) for a wrong number of values.
    """
    numbers = calibration.P if rectified else calibration.K
    if len(numbers) != (12 if rectified else 9):
        raise RejectedInputError(
            "singular_intrinsics",
            "Calibration message has a wrong number of values",
            where=where,
            expected="12 values of P" if rectified else "9 values of K",
            got=len(numbers),
        )
    K = np.array(numbers, np.float64).reshape(3, -1)[:, :3]
    height, width = calibration.height, calibration.width
    if min(height, width) < 1:
        raise RejectedInputError(
            "singular_intrinsics", "Calibration has no image size", where=where, got=f"{width}x{height}"
        )
    transform = ImageTransform.of((height, width))
    x, y, region_width, region_height = calibration.roi
    if region_width and region_height:
        if x + region_width > width or y + region_height > height:
            raise RejectedInputError(
                "singular_intrinsics",
                "Region of interest leaves the image",
                where=where,
                expected=f"inside of {width}x{height}",
                got=calibration.roi,
            )
        transform = transform.crop(y, x, (region_height, region_width))
    bins = max(calibration.binning[0], 1), max(calibration.binning[1], 1)
    if bins != (1, 1):
        height, width = transform.image_size
        transform = transform.resize((height // bins[1], width // bins[0]))
    return transform.intrinsics(K), transform.image_size


def lens(calibration: Calibration, view: str, *, rectified: bool, where: str) -> Distortion | None:
    """The lens of the images, None for a pinhole.

    Raises: RejectedInputError (invalid_distortion).
    """
    if rectified:
        return None
    evidence = {"view": view, "model": calibration.model, "coefficients": list(calibration.D)}
    with rejected_as("invalid_distortion", where, evidence):
        return distortion_from_ros(calibration.model, calibration.D, None)


def read_calibration(file: McapFile, streams: Mapping[str, Stream], topics: ViewTopics) -> Calibration | None:
    """Of the messages around the episode, or of the file's first one where it was sent only once."""
    if topics.calibration is None:
        return None
    if topics.calibration in streams:
        values = streams[topics.calibration].values
    else:
        values = [
            received.message.value for received in file.messages([topics.calibration]) if received.kind == "calibration"
        ]
    if not values:
        raise RejectedInputError(
            "missing_calibration",
            "Calibration topic has no messages",
            where=f"{file.shown}, topic {topics.calibration}",
        )
    return one_calibration(values, f"{file.shown}, topic {topics.calibration}")


def camera_tracks(
    config: McapTopicsSourceConfig,
    tree: TransformTree,
    calibrations: Mapping[str, Calibration | None],
    frames: Mapping[str, str],
    grid: np.ndarray,
    file: McapFile,
) -> tuple[dict[str, CameraTrack], dict[str, CameraPose], dict[str, Distortion]]:
    """Camera, recorded pose and lens of the calibrated views."""
    cameras: dict[str, CameraTrack] = {}
    recorded: dict[str, CameraPose] = {}
    lenses: dict[str, Distortion] = {}
    for view, calibration in calibrations.items():
        if calibration is None:
            continue
        rectified = config.views[view].rectified
        where = f"{file.shown}, topic {config.views[view].calibration}"
        K, (height, width) = intrinsics(calibration, rectified=rectified, where=where)
        poses = fixed_or_moving(tree.poses(config.base_frame, frames[view], grid))
        recorded[view] = camera_pose(view, poses, where=f"{file.shown}, frame {frames[view]}")
        cameras[view] = CameraTrack.from_pose(view, K, recorded[view], width=width, height=height)
        distortion = lens(calibration, view, rectified=rectified, where=where)
        if distortion is not None:
            lenses[view] = distortion
    return cameras, recorded, lenses
