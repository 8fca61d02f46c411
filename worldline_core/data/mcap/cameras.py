"""Where cameras and tools are (the tree of frames that transforms span), and how cameras project (calibration messages)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from worldline_core.data.episodes.recorded_poses import RecordedCameras, camera_pose, rejected_as
from worldline_core.data.guards.rejection import Reason, RejectedInputError
from worldline_core.data.mcap.file import McapFile, Stream
from worldline_core.data.mcap.messages import Calibration, Transform
from worldline_core.data.mcap.timing import Arrivals, Timing, check_gaps, in_order, interpolated_poses
from worldline_core.data.mcap.topics_config import McapTopicsSourceConfig, ViewTopics
from worldline_core.geometry.cameras import ImageTransform
from worldline_core.geometry.distortion import distortion_from_ros
from worldline_core.geometry.transforms import pose_from_quaternion_xyzw, rigid_inverse

FIXED_TOLERANCE = 1e-6
"""A pose whose every entry moves by less [m, or entries of R] is one of a fixed camera."""


@dataclass
class _Edge:
    """Poses of a frame in its parent: x y z [m] qx qy qz qw, as they lie in the file.

    Attributes:
        static: all came over topics of transforms that stay.
    """

    parent: str
    where: str
    max_disorder_s: float
    static: bool = True
    times_ns: list[int] = field(default_factory=list)
    values: list[tuple[float, ...]] = field(default_factory=list)

    @property
    def fixed(self) -> bool:
        """Whether the transform stays: it came over a static topic, or came once. The last one then counts."""
        return self.static or len(self.times_ns) == 1

    @cached_property
    def arrivals(self) -> Arrivals:
        times = np.array(self.times_ns[-1:] if self.fixed else self.times_ns, np.int64)
        return in_order(times, self.where, self.max_disorder_s)

    @cached_property
    def poses(self) -> np.ndarray:
        """(n, 7) in order of time, quaternions of unit length.

        Raises: RejectedInputError (invalid_extrinsics) for a quaternion without length.
        """
        values = unit_poses(self.values, "invalid_extrinsics", self.where)
        return values[-1:] if self.fixed else values[self.arrivals.order]


def unit_poses(poses: Sequence[tuple[float, ...]], reason: Reason, where: str) -> np.ndarray:
    """Poses x y z qx qy qz qw as (n, 7) with quaternions of unit length.

    Raises: RejectedInputError of this reason for one that is not finite, or has a quaternion without length.
    """
    values = np.array(poses, np.float64)
    length = np.linalg.norm(values[:, 3:], axis=1)
    if not (np.isfinite(values).all() and (length > 1e-6).all()):
        raise RejectedInputError(reason, "Pose is not finite or has a quaternion without direction", where=where)
    values[:, 3:] /= length[:, None]
    return values


class TransformTree:
    """Frames below their parents, as transforms are added."""

    def __init__(self, where: object, config: McapTopicsSourceConfig) -> None:
        self._where = where
        self._config = config
        self._edges: dict[str, _Edge] = {}

    def add(self, transforms: Sequence[Transform], times_ns: Sequence[int], *, static: bool) -> None:
        """The transforms of one message.

        Raises: RejectedInputError (invalid_extrinsics) for a frame with two parents.
        """
        for transform, time_ns in zip(transforms, times_ns, strict=True):
            parent, child = transform.parent, transform.child
            where = f"{self._where}, transform {parent} -> {child}"
            edge = self._edges.setdefault(child, _Edge(parent, where, self._config.max_disorder_s))
            if edge.parent != parent:
                raise RejectedInputError(
                    "invalid_extrinsics", "A frame has two parents", where=where, expected=edge.parent, got=parent
                )
            edge.static = edge.static and static
            edge.times_ns.append(time_ns)
            edge.values.append(transform.values)

    def complete(self, earlier: TransformTree) -> None:
        """Take over frames that only an earlier part of the recording has."""
        self._edges = {**earlier._edges, **self._edges}

    @cached_property
    def disordered(self) -> int:
        """How many moving transforms lie behind a later one in the file.

        Raises: RejectedInputError: invalid_extrinsics for a quaternion without length, clock_jump.
        """
        return sum(edge.arrivals.disordered for edge in self._edges.values() if len(edge.poses))

    def chain(self, frame: str) -> list[str]:
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
        return bool(set(self.chain(base)) & set(self.chain(frame)))

    def moving_times(self, base: str, frame: str) -> list[np.ndarray]:
        """Times of every moving transform between two connected frames."""
        edges = [self._edges[child] for side in self._between(base, frame) for child in side]
        return [edge.arrivals.times_ns for edge in edges if not edge.fixed]

    def _between(self, base: str, frame: str) -> tuple[list[str], list[str]]:
        """Frames from the base, and from the frame, up to the first frame above both (which is in neither list)."""
        up, down = self.chain(base), self.chain(frame)
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
        """(t, 4, 4) T_base_frame at the instants; linear in place and slerp in rotation of every transform between.

        Raises: RejectedInputError: missing_calibration where the frames are not connected, time_gap where a moving
            transform is missing for too long.
        """
        up, down = self._between(base, frame)
        return rigid_inverse(self._product(up, grid_ns)) @ self._product(down, grid_ns)

    def _product(self, frames: list[str], grid_ns: np.ndarray) -> np.ndarray:
        """Pose of the first of these frames, each the child of the next, in the parent of the last."""
        pose, max_gap_s = np.tile(np.eye(4), (len(grid_ns), 1, 1)), self._config.max_gap_s
        for child in frames:
            edge = self._edges[child]
            times_ns = edge.arrivals.times_ns
            if not edge.fixed:
                check_gaps(times_ns, int(grid_ns[0]), int(grid_ns[-1]), max_gap_s, max_gap_s, edge.where)
            values = interpolated_poses(times_ns, edge.poses, grid_ns)
            pose = pose_from_quaternion_xyzw(values[:, :3], values[:, 3:]) @ pose
        return pose


def read_tree(
    config: McapTopicsSourceConfig,
    file: McapFile,
    streams: Mapping[str, Stream],
    timing: Timing,
    start_ns: int | None,
    wanted: Iterable[str],
) -> TransformTree:
    """The frames of an episode.

    Transforms that stay are looked for in the whole file, those on the moving topics around the episode; only where
    these do not lead to a wanted frame are the ones before the episode read too (a fixed camera may be published once,
    when the recording starts).

    Args:
        start_ns: log time at which the episode begins; None: with the file.
        wanted: frames that must be reached from the base.

    Raises: RejectedInputError: invalid_extrinsics, clock_jump.
    """

    def read_static(topics: Iterable[str], stop_ns: int | None) -> TransformTree:
        tree = TransformTree(file.path, config)
        present = [topic for topic in topics if topic in file.topics]
        for received in file.messages(present, None, stop_ns) if present else ():
            tree.add(received.value, [received.log_ns] * len(received.value), static=True)
        return tree

    tree = read_static(config.static_transforms, None)
    for stream in (streams[topic] for topic in config.transforms if topic in streams):
        offset_ns = config.offset_ns(stream.topic)
        for transforms, time_ns in zip(stream.values, timing.times_ns(stream), strict=True):
            times = [int(time_ns)] * len(transforms)
            if config.time == "header":  # every transform of a message has its own
                times = [transform.stamp_ns + offset_ns for transform in transforms]
            tree.add(transforms, times, static=False)
    if start_ns is not None and not all(tree.connected(config.base_frame, frame) for frame in wanted):
        tree.complete(read_static(config.transforms, start_ns))
    _ = tree.disordered  # a transform that nobody asks for is refused as well
    return tree


def read_calibration(file: McapFile, streams: Mapping[str, Stream], topics: ViewTopics) -> Calibration | None:
    """Of the messages around the episode, or of all in the file where it was sent only once.

    Raises: RejectedInputError: missing_calibration; changing_calibration when messages differ: a zoom, or two cameras on one
        topic.
    """
    if topics.calibration is None:
        return None
    if topics.calibration in streams:
        values = streams[topics.calibration].values
    else:
        values = [received.value for received in file.messages([topics.calibration]) if received.kind == "calibration"]
    where = f"{file.path}, topic {topics.calibration}"
    if not values:
        raise RejectedInputError("missing_calibration", "Calibration topic has no messages", where=where)
    first = values[0]
    different = next((value for value in values if value != first), None)
    if different is not None:
        raise RejectedInputError(
            "changing_calibration",
            "Calibration changes during the recording",
            where=where,
            expected=f"K {list(first.K)}, D {list(first.D)} of {first.width}x{first.height}",
            got=f"K {list(different.K)}, D {list(different.D)} of {different.width}x{different.height}",
        )
    return first


def add_camera(
    cameras: RecordedCameras,
    view: str,
    calibration: Calibration,
    poses: np.ndarray,
    *,
    where: object,
    frame: str,
    topic: str | None,
    rectified: bool = False,
) -> None:
    """Add a view from its calibration message and its poses (n or 1, 4, 4) in the base.

    Args:
        where, frame, topic: file, frame and topic that they are of, for messages.
        rectified: the images are rectified: P holds their K, and no lens is left.

    Raises: RejectedInputError: singular_intrinsics, invalid_extrinsics, invalid_distortion.
    """
    at = f"{where}, topic {topic}"
    K, size = _intrinsics(calibration, rectified=rectified, where=at)
    pose = camera_pose(view, poses, where=f"{where}, frame {frame}")
    with rejected_as("invalid_distortion", at):
        lens = None if rectified else distortion_from_ros(calibration.model, calibration.D, None)
    cameras.add(view, K, pose, size, lens)


def fixed_or_moving(poses: np.ndarray) -> np.ndarray:
    """(1, 4, 4) where poses (t, 4, 4) do not move, else all of them."""
    return poses[:1] if np.abs(poses - poses[:1]).max() <= FIXED_TOLERANCE else poses


def _intrinsics(calibration: Calibration, *, rectified: bool, where: str) -> tuple[np.ndarray, tuple[int, int]]:
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
