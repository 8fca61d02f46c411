"""One episode of another tool's MCAP recording: declared topics read, checked, and brought to instants of a fixed rate."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

import numpy as np

from worldline_core.data.episodes.episode import REPEATS_STATE, Episode, Outcome
from worldline_core.data.episodes.recorded_poses import RecordedCameras
from worldline_core.data.episodes.source import LoadedEpisode
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.mcap.file import ImageTrack, McapFile, Stream, frames_after_loss
from worldline_core.data.mcap.messages import IMAGE_KINDS, Calibration, Joints, Kind
from worldline_core.data.mcap.resampling import (
    TransformTree,
    add_camera,
    check_alternation,
    check_gaps,
    check_interpolation,
    checked_poses,
    in_order,
    in_order_with_values,
    instants,
    nearest,
    resampled,
    resampled_poses,
    times_by_topic,
    uncalibrated,
)
from worldline_core.data.mcap.topics_config import ArmReadings, McapTopicsSourceConfig, TopicReadings

LAYOUT = "mcap topics"
_KINDS: dict[str, tuple[Kind, ...]] = {
    "images": IMAGE_KINDS,
    "calibrations": ("calibration",),
    "readings": ("joints", "numbers"),
    "tool poses": ("pose",),
}
_READING_MARGIN_NS = 10**9
"""Messages logged up to this long before and after an episode are read too: their own time may be within it."""
_TOGETHER_NS = 1_000_000
"""Topics that begin within a millisecond begin together: no image is left out for that."""
_FIXED_TOLERANCE = 1e-6
"""A camera is fixed if no entry of its pose moves by more [m, or entries of R]."""
_Signal = tuple[np.ndarray, np.ndarray]
"""Measurements of a topic in order of time: times (n,) [ns] and values (n, d)."""


@dataclass(frozen=True)
class Segment:
    """An episode inside of a file.

    Attributes:
        name: distinguishes it from others of the file; empty for a whole file.
        start_ns, stop_ns: log times; None: from the beginning, to the end.
        fault: why it cannot be read, where that is known already.
    """

    name: str = ""
    start_ns: int | None = None
    stop_ns: int | None = None
    instruction: str | None = None
    outcome: Outcome | None = None
    fault: RejectedInputError | None = None


class _Recording:
    """Topics of one episode, before resampling; every fault is a RejectedInputError."""

    def __init__(self, config: McapTopicsSourceConfig, file: McapFile, segment: Segment) -> None:
        self.config, self.file = config, file
        self.start_log_ns = start = segment.start_ns
        stop = segment.stop_ns
        self.around_ns = (
            None if start is None else max(start - _READING_MARGIN_NS, 0),
            None if stop is None else stop + _READING_MARGIN_NS,
        )
        self.absent: dict[str, RejectedInputError] = {}
        self.streams = self._read_streams()
        config = self.config  # without the views that have no images
        self.times_ns, header_to_log_ns = times_by_topic(config, self.streams, file.path)
        self.start_ns, self.stop_ns = (None if t is None else t - header_to_log_ns for t in (start, stop))
        self.signals = {readings: self._signal(readings) for readings in config.readings}
        self.tools = {arm.tool_pose: self._tool(arm.tool_pose) for arm in config.arms if arm.tool_pose is not None}
        """By topic: times and poses (n, 7), and the frame that these are given in."""
        frames = (arm.tool_frame if arm.tool_pose is None else self.tools[arm.tool_pose][1] for arm in config.arms)
        self.tool_frames = [frame.lstrip("/") for frame in frames if frame is not None]
        """For each arm, the frame that is its tool, or the one that its recorded poses are given in."""
        self.images = {
            view: in_order(self.times_ns[each.image], self.at(each.image)) for view, each in config.views.items()
        }
        """Times (n,) [ns] of each view's images, and the index of each in the order of the file."""
        read = {view: self._calibration(each.calibration) for view, each in config.views.items() if each.calibration}
        reasons = {view: uncalibrated(each, rectified=config.views[view].rectified) for view, each in read.items()}
        self.uncalibrated = {view: reason for view, reason in reasons.items() if reason is not None}
        self.calibrations = {view: each for view, each in read.items() if view not in self.uncalibrated}
        self.camera_frames = {
            view: (config.views[view].frame or each.frame or self.streams[config.views[view].image].frame).lstrip("/")
            for view, each in self.calibrations.items()
        }
        self.tree = self._transforms([*self.camera_frames.values(), *self.tool_frames])

    def at(self, topic: str) -> str:
        return f"{self.file.path}, topic {topic}"

    def _read_streams(self) -> dict[str, Stream]:
        """Every topic that the episode needs; a missing transform is reported where a pose needs it."""
        topics = self.config.topics
        self._leave_out_views({topic for role in _KINDS for topic in topics[role]} - set(self.file.topics))
        topics = self.config.topics
        roles = {topic: kinds for role, kinds in _KINDS.items() for topic in sorted(topics[role])}
        needed = set(roles) - topics["calibrations"]
        roles |= {topic: ("transforms",) for topic in self.config.transforms if topic in self.file.topics}
        streams = self.file.streams(roles, *self.around_ns)
        self._leave_out_views(needed - set(streams))
        return streams

    def _leave_out_views(self, missing: set[str]) -> None:
        """Go on without the views whose images are missing.

        Raises: RejectedInputError (missing_topic) for all that is missing, where that is not only images.
        """

        def fault(topics: set[str]) -> RejectedInputError:
            if not topics <= set(self.file.topics):
                return self.file.lacks_topics(topics)
            what, expected = "A topic has no messages during the episode", ", ".join(sorted(topics))
            return RejectedInputError("missing_topic", what, where=self.file.path, expected=expected)

        config = self.config
        kept = {view: each for view, each in config.views.items() if each.image not in missing}
        primary = config.primary_view if config.primary_view in kept else None
        self.config = config.model_copy(update={"views": kept, "primary_view": primary})
        if missing and (not kept or any(missing & topics for topics in self.config.topics.values())):
            raise fault(missing)
        self.absent |= {view: fault({each.image}) for view, each in config.views.items() if view not in kept}

    def _signal(self, readings: TopicReadings) -> _Signal:
        """The declared numbers of a topic; messages with other joints (several drivers may share it) are left out."""
        stream, wanted = self.streams[readings.topic], readings.names or readings.columns or ()
        taken: list[int] = []
        rows: list[list[float]] = []
        for number, value in enumerate(stream.values):
            named = isinstance(value, Joints)
            known = dict(zip(value.names, value.position, strict=False) if named else enumerate(value))
            if known.keys() >= set(wanted):
                taken.append(number)
                rows.append([known[each] for each in wanted])
        if not rows:
            what, expected = "No message of a topic has the declared joints or columns", ", ".join(map(str, wanted))
            got = ", ".join(sorted({name for v in stream.values for name in getattr(v, "names", ())})) or "an array"
            raise RejectedInputError("missing_column", what, where=self.at(stream.topic), expected=expected, got=got)
        times = self.times_ns[stream.topic][taken]
        return in_order_with_values(times, np.array(rows, np.float64), self.at(stream.topic))

    def _tool(self, topic: str) -> tuple[_Signal, str]:
        """Poses (n, 7) of a topic, and the frame that they are given in."""
        stream, where = self.streams[topic], self.at(topic)
        values = checked_poses([pose.values for pose in stream.values], "invalid_tool_pose", where)
        frames = sorted({pose.parent for pose in stream.values})
        if len(frames) != 1:
            what = "Tool poses change their frame"
            raise RejectedInputError("invalid_tool_pose", what, where=where, got=", ".join(frames))
        return in_order_with_values(self.times_ns[topic], values, where), frames[0]

    def _calibration(self, topic: str) -> Calibration:
        """The calibration around the episode, or in the whole file where it was sent only once."""
        stream = self.streams.get(topic) or self.file.streams({topic: _KINDS["calibrations"]}).get(topic)
        if stream is None:
            raise RejectedInputError("missing_calibration", "Calibration topic has no messages", where=self.at(topic))
        first = stream.values[0]
        different = next((value for value in stream.values if value != first), None)
        if different is not None:
            what = "Calibration changes during the recording: a zoom, or two cameras on one topic"
            raise RejectedInputError("changing_calibration", what, where=self.at(topic), expected=first, got=different)
        return first

    def _transforms(self, wanted: Iterable[str]) -> TransformTree:
        """Static transforms of the whole file, and moving ones around the episode. Where these do not lead to a wanted frame, the
        moving ones before the episode are read too: a fixed camera may be published once, when the recording starts.
        """
        config = self.config

        def read_static(topics: Collection[str], stop_ns: int | None) -> TransformTree:
            tree = TransformTree(self.file.path, config.max_gap_s)
            for _, _, log_ns, _, transforms in self.file.messages(topics, None, stop_ns):
                tree.add(transforms, [log_ns] * len(transforms), static=True)
            return tree

        tree = read_static(config.static_transforms, None)
        for stream in (self.streams[topic] for topic in config.transforms if topic in self.streams):
            for transforms, time_ns in zip(stream.values, self.times_ns[stream.topic], strict=True):
                times = [int(time_ns)] * len(transforms)
                if config.time == "header":  # every transform of a message has its own
                    times = [transform.stamp_ns + config.offset_ns(stream.topic) for transform in transforms]
                tree.add(transforms, times, static=False)
        start = self.start_log_ns
        if start is not None and not all(tree.connected(config.base_frame, frame) for frame in wanted):
            tree.complete(read_static(config.transforms, start))
        return tree

    def grid(self) -> np.ndarray:
        """(t,) instants [ns]: from the first image of the primary view after all topics have begun, until the first ends."""
        config = self.config
        # Gaps between images are judged in `track`, by the distance of instants from the nearest image.
        topics = [(config.views[view].image, times, float("inf")) for view, (times, _) in self.images.items()]
        topics += [(readings.topic, times, config.max_gap_s) for readings, (times, _) in self.signals.items()]
        topics += [(topic, times, config.max_gap_s) for topic, ((times, _), _) in self.tools.items()]
        start = min(int(times[0]) for _, times, _ in topics) if self.start_ns is None else self.start_ns
        stop = max(int(times[-1]) for _, times, _ in topics) if self.stop_ns is None else self.stop_ns
        for topic, times, max_gap_s in topics:
            check_gaps(times, start, stop, max_gap_s=max_gap_s, where=self.at(topic))
        everything = [times for _, times, _ in topics]
        for frame in (*self.camera_frames.values(), *self.tool_frames):
            everything += self.tree.moving_times(config.base_frame, frame)
        first = max(start, *(int(times[0]) for times in everything))
        last = min(stop, *(int(times[-1]) for times in everything))
        primary = self.images[config.timing_view][0]
        begin = int(np.searchsorted(primary, first - _TOGETHER_NS))
        grid = instants(int(primary[begin]), last, config.fps) if begin < len(primary) else np.zeros(0, np.int64)
        if len(grid) < 2:
            what, next_step = "Topics overlap for less than two frames", "set time: log or time_offsets_ms"
            got = f"{max(last - first, 0) / 1e9:.3f} s"
            raise RejectedInputError("too_short", what, where=self.file.path, got=got, next_step=next_step)
        return grid

    def track(self, view: str, grid: np.ndarray) -> ImageTrack:
        """The nearest image of each instant, none of which is a video frame that depends on a lost message."""
        config, (times, order) = self.config, self.images[view]
        stream, fps = self.streams[config.views[view].image], config.fps
        step_ns = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
        where = self.at(stream.topic)
        if step_ns * fps > 1.25e9:
            raise RejectedInputError(
                "wrong_fps", "Camera is slower than the wanted rate", where=where, expected=f"{fps} fps",
                got=f"{1e9 / step_ns:.2f} fps", next_step="lower the source's fps",
                evidence={"measured_fps": 1e9 / step_ns},
            )  # fmt: skip
        chosen = nearest(times, grid)
        distance = np.abs(times[chosen] - grid) * fps / 1e9
        furthest, at_s = float(distance.max()), float((grid[np.argmax(distance)] - grid[0]) / 1e9)
        if furthest > config.max_image_distance_frames:
            raise RejectedInputError(
                "time_gap", "Images are missing", where=where, got=f"{furthest:.2f} frames at {at_s:.3f} s",
                expected=f"an image within {config.max_image_distance_frames} frames of every instant",
                evidence={"gap_s": 2 * furthest / fps},
            )  # fmt: skip
        track = ImageTrack(self.file, stream, order, chosen, self.around_ns)
        if stream.kind == "video":
            spoiled = frames_after_loss(times, step_ns, track.key_frames, track.log_ns)[chosen]
            if spoiled.any():
                first, count = int(np.argmax(spoiled)), int(spoiled.sum())
                raise RejectedInputError(
                    "truncated_video", "Video frames depend on a message that is missing",
                    where=f"{where}, frame {first}", next_step="cut the recording at the gap",
                    got=f"{count} of {len(chosen)} frames after a gap, before the next key frame",
                    evidence={"first_frame": first, "frames": count},
                )  # fmt: skip
        return track

    def _check_values(self, arm: ArmReadings, grid: np.ndarray, share: float) -> None:
        """Readings around the episode, in radians and as openings, are finite, of one publisher, and can be interpolated."""
        for readings in (arm.joints, arm.gripper):
            (times, values), where = self.signals[readings], self.at(readings.topic)
            first, last = np.searchsorted(times, grid[[0, -1]]).tolist()
            used = slice(max(first - 1, 0), last + 1)
            times, values = times[used], values[used]
            finite: np.ndarray = np.all(np.isfinite(values), axis=1)
            if not finite.all():
                at_s = float((times[np.argmin(finite)] - grid[0]) / 1e9)
                raise RejectedInputError(
                    "nan_state", "Readings of a topic are not finite", where=where, evidence={"at_s": at_s},
                    expected="finite numbers between the episode's beginning and end",
                    got=f"{int((~finite).sum())} of {len(finite)} messages, the first at {at_s:.3f} s",
                )  # fmt: skip
            if readings is arm.gripper:  # which may be switched: it has no speed
                check_alternation(times, arm.gripper.range.opening(values)[0], where)
                continue
            values = np.deg2rad(values) if arm.joints.unit == "deg" else values
            check_alternation(times, values, where, share=share)
            if readings.resample == "linear":
                check_interpolation(times, values, where)

    def arm_vectors(self, arms: Iterable[ArmReadings], grid: np.ndarray, share: float) -> tuple[np.ndarray, int]:
        """(t, J) joints [rad] and opening of each arm, and how many openings lay outside of 0..1; `share` as in `check_alternation`."""
        columns: list[np.ndarray] = [np.zeros((len(grid), 0))]
        outside = 0
        for arm in arms:
            self._check_values(arm, grid, share)
            joints, fingers = (
                resampled(*self.signals[readings], grid, hold=readings.resample == "hold")
                for readings in (arm.joints, arm.gripper)
            )
            opening, beyond = arm.gripper.range.opening(fingers.mean(axis=1))
            columns += [np.deg2rad(joints) if arm.joints.unit == "deg" else joints, opening[:, None]]
            outside += beyond
        return np.concatenate(columns, axis=1), outside

    def tool_poses(self, grid: np.ndarray) -> np.ndarray | None:
        """(t, A, 4, 4) T_base_tool where it is recorded, else None."""
        base = self.config.base_frame
        poses: list[np.ndarray] = []
        for arm, frame in zip(self.config.arms, self.tool_frames, strict=False):
            pose = self.tree.poses(base, frame, grid) if frame != base else np.eye(4)
            if arm.tool_pose is not None:
                pose = pose @ resampled_poses(*self.tools[arm.tool_pose][0], grid)
            poses.append(np.broadcast_to(pose, (len(grid), 4, 4)))
        return np.stack(poses, axis=1) if poses else None


def read_topics_episode(
    config: McapTopicsSourceConfig, file: McapFile, segment: Segment, episode_id: str, scene: str
) -> LoadedEpisode:
    """The episode; its images stay in the file until they are asked for. Raises: RejectedInputError."""
    recording = _Recording(config, file, segment)
    config, unknown = recording.config, recording.uncalibrated
    grid = recording.grid()
    tracks = {view: recording.track(view, grid) for view in config.views}
    cameras = RecordedCameras()
    for view, frame in recording.camera_frames.items():
        topics = config.views[view]
        poses = recording.tree.poses(config.base_frame, frame, grid)
        fixed = np.abs(poses - poses[:1]).max() <= _FIXED_TOLERANCE
        where = f"{recording.at(topics.calibration or '')}, frame {frame}"
        calibration = recording.calibrations[view]
        add_camera(cameras, view, calibration, poses[:1] if fixed else poses, where, rectified=topics.rectified)
    state, outside = recording.arm_vectors([arm.state for arm in config.arms], grid, share=0.01)
    action, commands = state, [arm.command for arm in config.arms if arm.command is not None]
    if commands:
        action, beyond = recording.arm_vectors(commands, grid, share=0.05)
        outside += beyond
    state_names = []
    for arm in config.arms:
        joints = arm.state.joints
        given = joints.names or tuple(f"joint_{number}" for number in range(1, joints.width + 1))
        state_names += [f"{arm.name}/{name}" for name in (*given, "gripper")]
    tools = recording.tool_poses(grid)
    episode = Episode(
        **config.declared(scene),
        episode_id=episode_id,
        embodiment=config.embodiment,
        instruction=(segment.instruction if segment.instruction is not None else config.instruction).strip(),
        outcome=segment.outcome or config.outcome,
        fps=config.fps,
        state=state.astype(np.float32),
        action=action.astype(np.float32),
        timestamps=(grid - grid[0]) / 1e9,
        cameras=cameras.tracks,
        T_base_ee=tools,
        gripper=None if tools is None else state[:, [name.endswith("/gripper") for name in state_names]],
        primary_view=config.timing_view,
        state_names=tuple(state_names),
        state_kind="joints" if config.arms else "none",
        conventions={
            "layout": LAYOUT,
            "time": config.time,
            "gripper_overshoot": outside,
            "action": "commanded" if commands else f"{REPEATS_STATE}: no commands are recorded",
            **({"uncalibrated": "; ".join(f"{view}: {why}" for view, why in unknown.items())} if unknown else {}),
            **cameras.notes(),
        },
    )
    tracks = {view: replace(track, camera=cameras.tracks.get(view)) for view, track in tracks.items()}
    views, lenses, absent = tuple(tracks), cameras.lenses, recording.absent
    return LoadedEpisode(episode, views, lambda view: tracks[view].frames(), distortions=lenses, absent=absent)
