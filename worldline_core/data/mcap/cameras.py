"""Where cameras and tools are (the tree of frames that transforms span), and how cameras project (calibration messages)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from worldline_core.data.episodes.episode import CameraTrack
from worldline_core.data.episodes.recorded_poses import camera_pose, rejected_as
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.mcap import timing as resampling
from worldline_core.data.mcap.file import McapFile, Stream
from worldline_core.data.mcap.messages import Calibration, Transform
from worldline_core.data.mcap.timing import Timing, check_gaps, in_order
from worldline_core.data.mcap.topics_config import McapTopicsSourceConfig, ViewTopics
from worldline_core.geometry.cameras import CameraPose, ImageTransform
from worldline_core.geometry.distortion import Distortion, distortion_from_ros
from worldline_core.geometry.transforms import pose_from_quaternion_xyzw, rigid_inverse

FIXED_TOLERANCE = 1e-6
"""A pose whose every entry moves by less [m, or entries of R] is one of a fixed camera."""


@dataclass(frozen=True)
class Edge:
    """Poses of a frame in its parent.

    Attributes:
        times_ns: (n,) as they lie in the file.
        values: (n, 7) x y z [m] qx qy qz qw.
        fixed: the transform stays: it came over a static topic, or came once.
    """

    parent: str
    times_ns: np.ndarray
    values: np.ndarray
    fixed: bool


class TransformTree:
    """Frames below their parents.

    Raises: RejectedInputError (invalid_extrinsics) for a quaternion without length.
    """

    def __init__(self, edges: Mapping[str, Edge], where: object, max_gap_s: float, max_disorder_s: float) -> None:
        self._where = where
        self._max_gap_s = max_gap_s
        self.parents = {child: edge.parent for child, edge in edges.items()}
        self._edges: dict[str, Edge] = {}
        self.disordered = 0
        for child, edge in edges.items():
            values = np.array(edge.values, np.float64)
            length = np.linalg.norm(values[:, 3:], axis=1)
            if not (np.isfinite(values).all() and (length > 1e-6).all()):
                raise RejectedInputError(
                    "invalid_extrinsics",
                    "Transform is not finite or has a quaternion without direction",
                    where=f"{where}, {edge.parent} -> {child}",
                    evidence={"parent": edge.parent, "child": child},
                )
            values[:, 3:] /= length[:, None]
            times = edge.times_ns
            if edge.fixed:
                times, values = times[-1:], values[-1:]
            else:
                arrivals = in_order(times, f"{where}, {edge.parent} -> {child}", max_disorder_s)
                self.disordered += arrivals.disordered
                times, values = arrivals.times_ns, values[arrivals.order]
            self._edges[child] = Edge(edge.parent, times, values, edge.fixed)

    def chain(self, frame: str) -> list[str]:
        """The frame, its parent, and so on up to the root.

        Raises: RejectedInputError (invalid_extrinsics) for frames that are above themselves.
        """
        found = [frame]
        while found[-1] in self.parents:
            above = self.parents[found[-1]]
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
        return [self._edges[child].times_ns for child in self._between(base, frame) if not self._edges[child].fixed]

    def _between(self, base: str, frame: str) -> list[str]:
        """Frames whose transforms lead from one to the other."""
        up, down = self.chain(base), self.chain(frame)
        common = next((name for name in down if name in up), None)
        if common is None:
            raise RejectedInputError(
                "missing_calibration",
                "No transforms lead from the base to a frame",
                where=self._where,
                expected=f"{base} -> {frame}",
                got=", ".join(f"{parent} -> {child}" for child, parent in sorted(self.parents.items()))
                or "no transforms",
                next_step="correct base_frame and the frames, or name all topics of transforms",
                evidence={"base": base, "frame": frame, "frames": sorted({*self.parents, *self.parents.values()})},
            )
        return up[: up.index(common)] + down[: down.index(common)]

    def poses(self, base: str, frame: str, grid_ns: np.ndarray) -> np.ndarray:
        """(t, 4, 4) T_base_frame at the instants; linear in place and slerp in rotation of every transform between.

        Raises: RejectedInputError: missing_calibration where the frames are not connected, time_gap where a moving
            transform is missing for too long.
        """
        self._between(base, frame)
        return rigid_inverse(self._to_root(base, frame, grid_ns)) @ self._to_root(frame, base, grid_ns)

    def _to_root(self, frame: str, other: str, grid_ns: np.ndarray) -> np.ndarray:
        """Pose of a frame in the first frame above both it and the other."""
        above = set(self.chain(other))
        pose = np.tile(np.eye(4), (len(grid_ns), 1, 1))
        for child in self.chain(frame):
            if child in above:
                break
            edge = self._edges[child]
            if not edge.fixed:
                where = f"{self._where}, transform {edge.parent} -> {child}"
                check_gaps(edge.times_ns, int(grid_ns[0]), int(grid_ns[-1]), self._max_gap_s, self._max_gap_s, where)
            values = resampling.poses(edge.times_ns, edge.values, grid_ns)
            pose = pose_from_quaternion_xyzw(values[:, :3], values[:, 3:]) @ pose
        return pose


def fixed_or_moving(poses: np.ndarray) -> np.ndarray:
    """(1, 4, 4) where poses (t, 4, 4) do not move, else all of them."""
    return poses[:1] if np.abs(poses - poses[:1]).max() <= FIXED_TOLERANCE else poses


@dataclass
class _Collected:
    parent: str
    static: bool
    times_ns: list[int] = field(default_factory=list)
    values: list[tuple[float, ...]] = field(default_factory=list)


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

    Raises: RejectedInputError: invalid_extrinsics for a frame with two parents.
    """
    found: dict[str, _Collected] = {}
    static = [topic for topic in config.static_transforms if topic in file.topics]
    if static:
        for received in file.messages(static):
            _collect(found, received.value, [received.log_ns] * len(received.value), True, file.shown)
    for topic in config.transforms:
        if topic in streams:
            stream = streams[topic]
            for value, time_ns in zip(stream.values, timing.times_ns(stream), strict=True):
                times = _times(value, int(time_ns), timing, topic)
                _collect(found, value, times, False, file.shown)
    tree = _tree(config, found, file)
    if start_ns is not None and not all(tree.connected(config.base_frame, frame) for frame in wanted):
        earlier: dict[str, _Collected] = {}
        topics = [topic for topic in config.transforms if topic in file.topics]
        for received in file.messages(topics, None, start_ns):
            _collect(earlier, received.value, [received.log_ns] * len(received.value), True, file.shown)
        found = {**earlier, **found}
        tree = _tree(config, found, file)
    return tree


def _times(value: tuple[Transform, ...], time_ns: int, timing: Timing, topic: str) -> list[int]:
    """When the transforms of one message are of."""
    if timing.source != "header":
        return [time_ns] * len(value)
    offset = round(timing.offsets_ms.get(topic, 0.0) * 1e6)
    return [transform.stamp_ns + offset for transform in value]


def _collect(
    found: dict[str, _Collected], value: tuple[Transform, ...], times_ns: list[int], static: bool, where: object
) -> None:
    for transform, time_ns in zip(value, times_ns, strict=True):
        known = found.setdefault(transform.child, _Collected(transform.parent, static))
        if known.parent != transform.parent:
            raise RejectedInputError(
                "invalid_extrinsics",
                "A frame has two parents",
                where=f"{where}, frame {transform.child}",
                expected=known.parent,
                got=transform.parent,
            )
        known.static = known.static and static
        known.times_ns.append(time_ns)
        known.values.append(transform.values)


def _tree(config: McapTopicsSourceConfig, found: Mapping[str, _Collected], file: McapFile) -> TransformTree:
    edges = {
        child: Edge(
            collected.parent,
            np.array(collected.times_ns, np.int64),
            np.array(collected.values, np.float64),
            collected.static or len(collected.times_ns) == 1,
        )
        for child, collected in found.items()
    }
    return TransformTree(edges, file.shown, config.max_gap_s, config.max_disorder_s)


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
        values = [received.value for received in file.messages([topics.calibration]) if received.kind == "calibration"]
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
