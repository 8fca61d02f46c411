"""One episode of another tool's MCAP recording: declared topics read, checked, and brought to instants of a fixed rate."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from worldline_core.data.episodes.episode import REPEATS_STATE, CameraTrack, Episode, Outcome
from worldline_core.data.episodes.recorded_poses import RecordedCameras
from worldline_core.data.episodes.source import LoadedEpisode
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.mcap.cameras import add_camera, fixed_or_moving, read_calibration, read_tree
from worldline_core.data.mcap.file import McapFile, Stream, read_streams
from worldline_core.data.mcap.images import ImageTrack, spoiled_frames
from worldline_core.data.mcap.messages import IMAGE_KINDS, Kind
from worldline_core.data.mcap.robot import RobotSignals, read_robot
from worldline_core.data.mcap.timing import Arrivals, TimeError, Timing, check_gaps, in_order, instants, nearest
from worldline_core.data.mcap.topics_config import McapTopicsSourceConfig

LAYOUT = "mcap topics"
_KINDS: dict[str, tuple[Kind, ...]] = {
    "images": IMAGE_KINDS,
    "calibrations": ("calibration",),
    "readings": ("joints", "numbers"),
    "tool poses": ("pose",),
    "transforms": ("transforms",),
}
_READING_MARGIN_NS = 10**9
"""Messages logged up to this long before and after an episode are read too: their own time may lie within it, and the instants at
its ends need a message on both sides."""
_TOGETHER_NS = 1_000_000
"""Topics that begin within a millisecond begin together: no image is left out for that."""


@dataclass(frozen=True)
class Segment:
    """An episode inside of a file.

    Attributes:
        name: distinguishes it from others of the file; empty for a whole file.
        start_ns, stop_ns: log times; None: from the beginning, to the end.
        relative: the times are counted from the file's first message.
        fault: why it cannot be read, where that is known already.
    """

    name: str = ""
    start_ns: int | None = None
    stop_ns: int | None = None
    relative: bool = False
    instruction: str | None = None
    outcome: Outcome | None = None
    fault: RejectedInputError | None = None

    def log_times(self, file: McapFile) -> tuple[int | None, int | None]:
        """First and last log time [ns]."""
        if not self.relative:
            return self.start_ns, self.stop_ns
        first = file.first_log_ns
        return first + (self.start_ns or 0), None if self.stop_ns is None else first + self.stop_ns


def read_topics_episode(
    config: McapTopicsSourceConfig, file: McapFile, segment: Segment, episode_id: str, scene: str
) -> LoadedEpisode:
    """The episode; its images stay in the file until they are asked for.

    Raises: RejectedInputError with the reason.
    """
    start_log, stop_log = segment.log_times(file)
    around = (
        None if start_log is None else max(start_log - _READING_MARGIN_NS, 0),
        None if stop_log is None else stop_log + _READING_MARGIN_NS,
    )
    streams = _streams(config, file, around)
    timing = Timing.of(config, streams, file.path)
    robot = read_robot(config, streams, timing, file.path)
    images = {
        view: in_order(timing.times_ns(streams[each.image]), f"{file.path}, topic {each.image}", config.max_disorder_s)
        for view, each in config.views.items()
    }
    read = {view: read_calibration(file, streams, each) for view, each in config.views.items()}
    calibrations = {view: calibration for view, calibration in read.items() if calibration is not None}
    frames = {
        view: (config.views[view].frame or calibration.frame or streams[config.views[view].image].frame).lstrip("/")
        for view, calibration in calibrations.items()
    }
    wanted = [*frames.values(), *robot.frames]
    tree = read_tree(config, file, streams, timing, start_log, wanted)
    moving = [times for frame in wanted for times in tree.moving_times(config.base_frame, frame)]
    start, stop = (None if log_ns is None else log_ns - timing.to_clock_ns for log_ns in (start_log, stop_log))
    grid = _grid(config, file, images, robot, moving, start, stop)
    chosen = {view: _chosen_images(config, file, view, arrivals, grid) for view, arrivals in images.items()}
    cameras = RecordedCameras()
    for view, frame in frames.items():
        topics = config.views[view]
        poses = fixed_or_moving(tree.poses(config.base_frame, frame, grid))
        add_camera(
            cameras, view, calibrations[view], poses,
            where=file.path, frame=frame, topic=topics.calibration, rectified=topics.rectified,
        )  # fmt: skip
    state, action, outside = robot.vectors(grid)
    tools = robot.tools(tree, config.base_frame, grid)
    errors = {f"image {view}": TimeError.of(arrivals.times_ns, grid) for view, arrivals in images.items()}
    errors |= {f"topic {signal.topic}": TimeError.of(signal.times_ns, grid) for signal in robot.signals()}
    if moving:
        errors |= {"transforms": max((TimeError.of(times, grid) for times in moving), key=lambda error: error.max_ms)}
    arrivals = [*images.values(), *robot.arrivals()]
    episode = Episode(
        episode_id=episode_id,
        source=config.label,
        embodiment=config.embodiment,
        scene=scene,
        task_family=config.task_family,
        instruction=(segment.instruction if segment.instruction is not None else config.instruction).strip(),
        outcome=segment.outcome or config.outcome,
        split=config.split,
        fps=config.fps,
        state=state.astype(np.float32),
        action=action.astype(np.float32),
        timestamps=(grid - grid[0]) / 1e9,
        cameras=cameras.tracks,
        T_base_ee=tools,
        gripper=None if tools is None else state[:, robot.gripper_columns],
        primary_view=config.timing_view,
        state_names=robot.state_names,
        conventions={
            "layout": LAYOUT,
            **timing.notes(),
            **_resampling_notes(errors),
            "interpolation_error_rad": round(robot.prediction_error_rad(), 9),
            "messages_out_of_order": sum(each.disordered for each in arrivals) + tree.disordered,
            "messages_repeated": sum(each.repeated for each in arrivals),
            "messages_lost": sum(each.lost for each in arrivals),
            "repeated_images": sum(int(len(numbers) - len(np.unique(numbers))) for numbers in chosen.values()),
            "gripper_overshoot": outside,
            "action": "commanded" if robot.commanded else f"{REPEATS_STATE}: no commands are recorded",
            **cameras.notes(),
        },
    )
    tracks = {
        view: _track(file, streams[each.image], images[view], chosen[view], around, cameras.tracks.get(view))
        for view, each in config.views.items()
    }
    return LoadedEpisode(episode, tuple(config.views), lambda view: tracks[view].frames(), distortions=cameras.lenses)


def _streams(
    config: McapTopicsSourceConfig, file: McapFile, around_ns: tuple[int | None, int | None]
) -> dict[str, Stream]:
    """Every topic that the episode needs. Transforms are optional here: a missing one is reported where a pose needs it.

    Raises: RejectedInputError: missing_topic for one that is not in the file, or silent during the episode.
    """
    topics = config.topics
    roles: dict[str, tuple[Kind, ...]] = {
        topic: kinds for role, kinds in _KINDS.items() if role != "transforms" for topic in sorted(topics[role])
    }
    file.check_topics(roles)
    needed = set(roles) - topics["calibrations"]
    roles |= {topic: _KINDS["transforms"] for topic in config.transforms if topic in file.topics}
    streams = read_streams(file, roles, *around_ns)
    silent = sorted(needed - set(streams))
    if silent:
        raise RejectedInputError(
            "missing_topic",
            "A topic has no messages during the episode",
            where=file.path,
            expected=", ".join(silent),
            got=", ".join(f"{topic}: {len(stream.log_ns)}" for topic, stream in sorted(streams.items()))
            or "no messages",
        )
    return streams


def _grid(
    config: McapTopicsSourceConfig,
    file: McapFile,
    images: Mapping[str, Arrivals],
    robot: RobotSignals,
    moving: list[np.ndarray],
    start_ns: int | None,
    stop_ns: int | None,
) -> np.ndarray:
    """(t,) instants [ns]: from the first image of the primary view after all topics have begun, until the first topic ends.

    Raises: RejectedInputError: time_gap for a topic that is silent for too long, too_short.
    """
    named = {f"topic {config.views[view].image}": arrivals.times_ns for view, arrivals in images.items()}
    named |= {f"topic {signal.topic}": signal.times_ns for signal in robot.signals()}
    start = min(times[0] for times in named.values()) if start_ns is None else start_ns
    stop = max(times[-1] for times in named.values()) if stop_ns is None else stop_ns
    of_images = {f"topic {topics.image}" for topics in config.views.values()}
    for name, times in named.items():
        # Gaps between images are judged in `_chosen_images`, by the distance of instants from the nearest image.
        max_gap = float("inf") if name in of_images else config.max_gap_s
        check_gaps(times, int(start), int(stop), max_gap, config.max_trim_s, f"{file.path}, {name}")
    everything = [*named.values(), *moving]
    first = max(int(start), *(int(times[0]) for times in everything))
    last = min(int(stop), *(int(times[-1]) for times in everything))
    primary = images[config.timing_view].times_ns
    begin = int(np.searchsorted(primary, first - _TOGETHER_NS))
    grid = instants(int(primary[begin]), last, config.fps) if begin < len(primary) else np.zeros(0, np.int64)
    if len(grid) < 2:
        raise RejectedInputError(
            "too_short",
            "Topics overlap for less than two frames",
            where=file.path,
            expected=f"at least {1 / config.fps:.3f} s",
            got=f"{max(last - first, 0) / 1e9:.3f} s",
            next_step="if the topics' clocks differ, set time: log or time_offsets_ms",
        )
    return grid


def _chosen_images(
    config: McapTopicsSourceConfig, file: McapFile, view: str, arrivals: Arrivals, grid: np.ndarray
) -> np.ndarray:
    """(t,) the nearest image of each instant.

    Raises: RejectedInputError: wrong_fps for a camera that is slower than the wanted rate, time_gap where images are missing.
    """
    where = f"{file.path}, topic {config.views[view].image}"
    if arrivals.median_step_ns * config.fps > 1.25e9:
        raise RejectedInputError(
            "wrong_fps",
            "Camera is slower than the wanted rate",
            where=where,
            expected=f"{config.fps} fps",
            got=f"{1e9 / arrivals.median_step_ns:.2f} fps",
            next_step="lower the source's fps",
            evidence={"wanted_fps": config.fps, "measured_fps": float(1e9 / arrivals.median_step_ns)},
        )
    chosen = nearest(arrivals.times_ns, grid)
    distance = np.abs(arrivals.times_ns[chosen] - grid) * config.fps / 1e9
    if distance.max() > config.max_image_distance_frames:
        worst = int(np.argmax(distance))
        raise RejectedInputError(
            "time_gap",
            "Images are missing",
            where=where,
            expected=f"an image within {config.max_image_distance_frames} frames of every instant",
            got=f"{distance.max():.2f} frames at {(grid[worst] - grid[0]) / 1e9:.3f} s",
            evidence={
                "view": view,
                "gap_s": float(2 * distance.max() / config.fps),
                "at_s": float((grid[worst] - grid[0]) / 1e9),
                "instants_without": int(np.count_nonzero(distance > config.max_image_distance_frames)),
            },
        )
    return chosen


def _track(
    file: McapFile,
    stream: Stream,
    arrivals: Arrivals,
    chosen: np.ndarray,
    around_ns: tuple[int | None, int | None],
    camera: CameraTrack | None,
) -> ImageTrack:
    """Raises: RejectedInputError (truncated_video) for video frames that depend on a lost message."""
    keys = np.array(stream.key_frames, bool)[arrivals.order] if stream.key_frames else None
    if keys is not None:
        spoiled = spoiled_frames(arrivals.times_ns, arrivals.median_step_ns, keys)[chosen]
        if spoiled.any():
            first = int(np.argmax(spoiled))
            raise RejectedInputError(
                "truncated_video",
                "Video frames depend on a message that is missing",
                where=f"{file.path}, topic {stream.topic}, frame {first}",
                expected=f"a message every {arrivals.median_step_ns / 1e6:.1f} ms between key frames",
                got=f"{int(spoiled.sum())} of {len(chosen)} frames after a gap, before the next key frame",
                next_step="cut the recording at the gap",
                evidence={"first_frame": first, "frames": int(spoiled.sum())},
            )
    return ImageTrack(file, stream.topic, stream.kind, around_ns, arrivals.order, chosen, keys, camera)


def _resampling_notes(errors: Mapping[str, TimeError]) -> dict[str, str | float | int]:
    by_topic = {
        name: {"max_ms": round(error.max_ms, 6), "mean_ms": round(error.mean_ms, 6)} for name, error in errors.items()
    }
    return {
        "resampling_max_ms": round(max(error.max_ms for error in errors.values()), 6),
        "resampling_mean_ms": round(float(np.mean([error.mean_ms for error in errors.values()])), 6),
        "resampling": json.dumps(by_topic, sort_keys=True),
    }
