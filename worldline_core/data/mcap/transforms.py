"""Places of cameras and tools (the tree of frames spanned by transforms), and cameras from their calibration messages."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from worldline_core.data.episodes.recorded_poses import RecordedCameras, camera_pose, rejected_as
from worldline_core.data.guards.rejection import Reason, RejectedInputError
from worldline_core.data.mcap.messages import Calibration, Transform
from worldline_core.data.mcap.timing import check_gaps, in_order, resampled_poses
from worldline_core.geometry.cameras import ImageTransform
from worldline_core.geometry.distortion import distortion_from_ros
from worldline_core.geometry.transforms import rigid_inverse


def checked_poses(poses: Sequence[tuple[float, ...]], reason: Reason, where: str) -> np.ndarray:
    """Poses x y z qx qy qz qw as (n, 7).

    Raises: RejectedInputError of this reason for one that is not finite, or has a quaternion without length.
    """
    values = np.array(poses, np.float64)
    if not (np.isfinite(values).all() and (np.linalg.norm(values[:, 3:], axis=1) > 1e-6).all()):
        raise RejectedInputError(reason, "Pose is not finite or has a quaternion without direction", where=where)
    return values


@dataclass
class _Edge:
    """Poses of a frame in its parent, in the order of the file.

    Attributes:
        static: all of them came over topics of static transforms.
    """

    parent: str
    where: str
    static: bool = True
    times_ns: list[int] = field(default_factory=list)
    values: list[tuple[float, ...]] = field(default_factory=list)

    @property
    def moving(self) -> bool:
        """Whether the transform came more than once over a topic of moving ones; otherwise the last one counts."""
        return not self.static and len(self.times_ns) > 1

    @cached_property
    def ordered(self) -> tuple[np.ndarray, np.ndarray]:
        """Times (n,) and poses (n, 7) in order of time.

        Raises: RejectedInputError: invalid_extrinsics, clock_jump.
        """
        values = checked_poses(self.values, "invalid_extrinsics", self.where)
        if not self.moving:
            return np.array(self.times_ns[-1:], np.int64), values[-1:]
        arrivals = in_order(np.array(self.times_ns, np.int64), self.where)
        return arrivals.times_ns, values[arrivals.order]


class TransformTree:
    """Frames below their parents."""

    def __init__(self, where: object, max_gap_s: float) -> None:
        self._where = where
        self._max_gap_s = max_gap_s
        self._edges: dict[str, _Edge] = {}

    def add(self, transforms: Sequence[Transform], times_ns: Iterable[int], *, static: bool) -> None:
        """Adds the transforms of one message.

        Raises: RejectedInputError (invalid_extrinsics) for a frame with two parents.
        """
        for transform, time_ns in zip(transforms, times_ns, strict=True):
            parent, child = transform.parent, transform.child
            edge = self._edges.setdefault(child, _Edge(parent, f"{self._where}, transform {parent} -> {child}"))
            if edge.parent != parent:
                raise RejectedInputError(
                    "invalid_extrinsics", "A frame has two parents", where=edge.where, expected=edge.parent, got=parent
                )
            edge.static = edge.static and static
            edge.times_ns.append(time_ns)
            edge.values.append(transform.values)

    def complete(self, earlier: TransformTree) -> None:
        """Adds frames that only an earlier part of the recording has."""
        self._edges = {**earlier._edges, **self._edges}

    def _chain(self, frame: str) -> list[str]:
        """The frame, its parent, and so on up to the root.

        Raises: RejectedInputError (invalid_extrinsics) for frames that are above themselves.
        """
        found = [frame]
        while found[-1] in self._edges:
            above = self._edges[found[-1]].parent
            if above in found:
                raise RejectedInputError(
                    "invalid_extrinsics", "Transforms form a ring", where=self._where, got=" -> ".join([*found, above])
                )
            found.append(above)
        return found

    def connected(self, base: str, frame: str) -> bool:
        """Whether transforms lead from one frame to the other."""
        return bool(set(self._chain(base)) & set(self._chain(frame)))

    def moving_times(self, base: str, frame: str) -> list[np.ndarray]:
        """Times of every moving transform between two connected frames."""
        edges = [self._edges[child] for side in self._between(base, frame) for child in side]
        return [edge.ordered[0] for edge in edges if edge.moving]

    def _between(self, base: str, frame: str) -> tuple[list[str], list[str]]:
        """Frames from the base, and from the frame, up to the first frame above both (in neither list)."""
        up, down = self._chain(base), self._chain(frame)
        common = next((name for name in down if name in up), None)
        if common is None:
            known = ", ".join(f"{edge.parent} -> {child}" for child, edge in sorted(self._edges.items()))
            raise RejectedInputError(
                "missing_calibration",
                "No transforms lead from the base to a frame",
                where=self._where,
                expected=f"{base} -> {frame}",
                got=known or "no transforms",
                next_step="correct base_frame and the frames, or name all topics of transforms",
            )
        return up[: up.index(common)], down[: down.index(common)]

    def poses(self, base: str, frame: str, grid_ns: np.ndarray) -> np.ndarray:
        """(t, 4, 4) T_base_frame at the instants; every transform between the two is resampled by itself.

        Raises: RejectedInputError: missing_calibration for unconnected frames, invalid_extrinsics, clock_jump, time_gap.
        """
        up, down = self._between(base, frame)
        return rigid_inverse(self._product(up, grid_ns)) @ self._product(down, grid_ns)

    def _product(self, frames: list[str], grid_ns: np.ndarray) -> np.ndarray:
        """Pose of the first of these frames, each the child of the next, in the parent of the last."""
        pose, gap = np.tile(np.eye(4), (len(grid_ns), 1, 1)), self._max_gap_s
        for child in frames:
            edge = self._edges[child]
            times_ns, values = edge.ordered
            if edge.moving:
                start, stop = int(grid_ns[0]), int(grid_ns[-1])
                check_gaps(times_ns, start, stop, max_gap_s=gap, max_trim_s=gap, where=edge.where)
            pose = resampled_poses(times_ns, values, grid_ns) @ pose
        return pose


def add_camera(
    cameras: RecordedCameras,
    view: str,
    calibration: Calibration,
    poses: np.ndarray,
    *,
    where: object,
    rectified: bool = False,
) -> None:
    """Adds a view from its calibration message and its poses (n or 1, 4, 4) in the base.

    Args:
        where: file and calibration topic.
        rectified: the images are rectified: P holds their K, and no lens is left.

    Raises: RejectedInputError: singular_intrinsics, invalid_extrinsics, invalid_distortion.
    """
    K, size = _intrinsics(calibration, rectified=rectified, where=where)
    pose = camera_pose(view, poses, where=where)
    with rejected_as("invalid_distortion", where):
        lens = None if rectified else distortion_from_ros(calibration.model, calibration.D, None)
    cameras.add(view, K, pose, size, lens)


def _intrinsics(calibration: Calibration, *, rectified: bool, where: object) -> tuple[np.ndarray, tuple[int, int]]:
    """K (3, 3) of the published image, and its size (height, width), after region of interest and binning.

    K and P belong to the whole sensor (ROS REP 104); a region is cut out first, then binned.

    Raises: RejectedInputError (singular_intrinsics) for numbers that do not fit together.
    """

    def refused(what: str, expected: object, got: object) -> RejectedInputError:
        return RejectedInputError("singular_intrinsics", what, where=where, expected=expected, got=got)

    numbers, count = (calibration.P, 12) if rectified else (calibration.K, 9)
    if len(numbers) != count:
        name = "P" if rectified else "K"
        raise refused("Calibration has a wrong number of values", f"{count} values of {name}", len(numbers))
    K = np.array(numbers, np.float64).reshape(3, -1)[:, :3]
    height, width = calibration.height, calibration.width
    if min(height, width) < 1:
        raise refused("Calibration has no image size", "at least one pixel", f"{width}x{height}")
    transform = ImageTransform.of((height, width))
    x, y, region_width, region_height = calibration.roi
    if region_width and region_height:
        if x + region_width > width or y + region_height > height:
            raise refused("Region of interest leaves the image", f"inside of {width}x{height}", calibration.roi)
        transform = transform.crop(y, x, (region_height, region_width))
    across, down = max(calibration.binning[0], 1), max(calibration.binning[1], 1)
    if (across, down) != (1, 1):
        height, width = transform.image_size
        transform = transform.resize((height // down, width // across))
    return transform.intrinsics(K), transform.image_size
