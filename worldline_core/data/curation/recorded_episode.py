"""A recorded episode on its way into a set: it is checked, brought to the wanted length, rate and size, and described as the
configuration asks.

Each failed check has its reason code and its numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from functools import lru_cache, partial
from hashlib import sha256
from itertools import islice

import numpy as np

from worldline_core.data.curation.curate_config import AVAILABLE, CurateConfig, DrawnSplits
from worldline_core.data.episodes.conventions import arm_blocks, is_gripper
from worldline_core.data.episodes.episode import (
    NO_EMBODIMENT,
    TRAINING_SPLITS,
    CameraTrack,
    Episode,
    Split,
    with_instruction,
)
from worldline_core.data.episodes.recorded_poses import camera_pose, check_intrinsics
from worldline_core.data.episodes.source import EVALUATION_LAYOUTS, LoadedEpisode, for_evaluation_only
from worldline_core.data.episodes.view_recording import ViewImages
from worldline_core.data.guards.rejection import RejectedInputError, all_of, check_finite, check_length, collect_faults
from worldline_core.data.video.clip import frame_times
from worldline_core.data.video.frames import Frames, MadeFrames
from worldline_core.data.video.thumbnails import ViewThumbnails
from worldline_core.errors import ConfigError
from worldline_core.geometry.cameras import ImageTransform
from worldline_core.geometry.embodiment import (
    Embodiment,
    check_embodiment_name,
    embodiment_names,
    load_embodiment,
)
from worldline_core.geometry.kinematic_tree import TreeBody, read_tree, tool_poses
from worldline_core.geometry.transforms import rotation_angle

MAX_JOINT_RAD = 4 * np.pi
"""No joint of a manipulator turns further; larger numbers are degrees or encoder ticks."""
_GRIPPER_MARGIN = 0.05
_MOVES_RAD, _APART_RAD, _MUCH_CLOSER = 0.1, 0.1, 0.25
"""Commands that are as far from the states of joints that move, and so much closer once they are read otherwise."""
_POSE_FRAMES, _POSE_ERROR_M, _POSE_ERROR_DEG = 64, 0.05, 10.0
"""Frames of tool poses compared with kinematics, and their largest errors: a mount that is a little off stays below."""
_JOINT_TOLERANCE_RAD, _DEGREES_TOLERANCE_RAD = 0.05, 0.2
"""Beyond a limit; more for degrees, whose zero is where a person calibrated it (LeRobot: the middle of what was moved through)."""
_TIME_TOLERANCE_FRAMES = 0.25
"""Largest distance of a frame from its place on the grid of its rate."""


def check_episode(config: CurateConfig, loaded: LoadedEpisode) -> None:
    """Raises: RejectedInputError where the recording does not satisfy the contract or the configuration, with the reason of
    the first failed check and what all of them say."""
    episode = loaded.episode
    check_values(episode)  # what is no number cannot be compared with anything
    faults: list[RejectedInputError] = []
    for check in (
        partial(check_lengths, loaded),
        partial(check_times, episode),
        partial(check_joints, episode),
        partial(check_commands, episode),
        partial(check_tool_poses, episode),
        *(partial(check_camera, episode, camera) for camera in episode.cameras.values()),
        partial(check_views, config, loaded),
    ):
        with collect_faults(faults):
            check()
    if config.views != AVAILABLE or not loaded.views:
        faults += loaded.absent.values()
    if faults:
        raise all_of(faults, f"episode {episode.episode_id}")


def check_lengths(loaded: LoadedEpisode) -> None:
    """Raises: RejectedInputError (length_mismatch) for a video with another number of frames than there are states."""
    states = loaded.episode.num_video_frames
    for view, clip in loaded.clips.items():
        where = f"episode {loaded.episode.episode_id}, view {view}, {clip.path}"
        check_length("Video", where, states=states, unit="frames", found=clip.num_frames)


def check_views(config: CurateConfig, loaded: LoadedEpisode) -> None:
    """Raises: RejectedInputError (missing_view, missing_calibration) for views that the configuration asks for."""
    episode = loaded.episode
    where = f"episode {episode.episode_id}"
    wanted = config.views if isinstance(config.views, tuple) else loaded.views
    missing = [view for view in wanted if view not in (*loaded.views, *loaded.absent)]
    if missing:
        raise RejectedInputError(
            "missing_view",
            "Episode lacks a view",
            where=where,
            expected=", ".join(missing),
            got=", ".join(loaded.views),
        )
    uncalibrated = [view for view in wanted if view not in episode.cameras]
    if config.require_calibration and uncalibrated:
        got = "none for " + ", ".join(uncalibrated)
        raise RejectedInputError("missing_calibration", "View has no calibration", where=where, got=got)


def check_values(episode: Episode) -> None:
    """Raises: RejectedInputError (nan_state) when a state, action, time or pose is not a finite number."""
    tracks = {"state": episode.state, "action": episode.action, "timestamps": episode.timestamps}
    if episode.T_base_ee is not None:
        tracks["T_base_ee"] = episode.T_base_ee
    for name, values in tracks.items():
        check_finite(name, values, f"episode {episode.episode_id}")


def check_joints(episode: Episode) -> None:
    """Compare joints with the limits of the embodiment, where it is described.

    Raises: RejectedInputError (unknown_embodiment, joint_out_of_range, invalid_gripper, length_mismatch).
    """
    where = f"episode {episode.episode_id}"
    described = episode.state_kind != "none" and episode.embodiment != NO_EMBODIMENT
    if described:
        try:
            check_embodiment_name(episode.embodiment)
        except ConfigError as error:
            raise RejectedInputError(
                "unknown_embodiment",
                "The robot has no description",
                where=where,
                expected=error.expected,
                got=episode.embodiment,
                next_step=error.next_step,
            ) from error
    if episode.state_kind != "joints":
        return
    joints, grippers = _joints_and_grippers(episode)
    for what, values in (("Joint positions", episode.state), ("Commands of joints", episode.action)):
        worst = float(np.abs(values[:, joints]).max()) if joints else 0.0
        if worst > MAX_JOINT_RAD:
            raise RejectedInputError(
                "joint_out_of_range",
                f"{what} are no angles in radians",
                where=where,
                expected=f"at most {MAX_JOINT_RAD:.2f} rad",
                got=worst,
                next_step="declare the unit of the source",
                evidence={"max_abs_rad": worst},
            )
    if not described:
        _check_openings(episode.state[:, grippers], where)
        return
    embodiment = _embodiment(episode.embodiment)
    if embodiment.state_size != episode.state.shape[1]:
        raise RejectedInputError(
            "length_mismatch",
            "State has another size than the embodiment",
            where=f"{where}, {episode.embodiment}",
            expected=embodiment.state_size,
            got=episode.state.shape[1],
        )
    degrees = episode.conventions.get("declared_angle_unit") == "deg"
    outside = embodiment.outside_limits(episode.state, _DEGREES_TOLERANCE_RAD if degrees else _JOINT_TOLERANCE_RAD)
    if outside.any():
        frame, column = (int(value) for value in np.argwhere(outside)[0])
        raise RejectedInputError(
            "joint_out_of_range",
            "Joint position is beyond its limit",
            where=f"{where}, frame {frame}, {embodiment.state_names[column]}",
            expected="a position within the embodiment's limits",
            got=float(episode.state[frame, column]),
            evidence={
                "frame": frame,
                "joint": embodiment.state_names[column],
                "position_rad": float(episode.state[frame, column]),
                "frames_outside": int(outside.any(axis=1).sum()),
            },
        )
    _check_openings(episode.state[:, [embodiment.gripper_column(arm) for arm in embodiment.arms]], where)


def _joints_and_grippers(episode: Episode) -> tuple[list[int], list[int]]:
    """State columns of joints, and those that are called grippers."""
    names = [*(episode.state_names or ()), *[""] * episode.state.shape[1]][: episode.state.shape[1]]
    grippers = [column for column, name in enumerate(names) if is_gripper(name)]
    return [column for column in range(len(names)) if column not in grippers], grippers


def _check_openings(opening: np.ndarray, where: str) -> None:
    if opening.size and not (opening.min() >= -_GRIPPER_MARGIN and opening.max() <= 1 + _GRIPPER_MARGIN):
        raise RejectedInputError(
            "invalid_gripper",
            "Gripper opening is not in 0 closed .. 1 open",
            where=where,
            expected="0..1",
            got=f"{opening.min():.3f}..{opening.max():.3f}",
            next_step="declare the readings of the gripper when it is closed and open",
            evidence={"min": float(opening.min()), "max": float(opening.max())},
        )


def check_commands(episode: Episode) -> None:
    """Compare commands with the states of joints that move.

    Raises: RejectedInputError (contradicting_tracks) where commands are far from the states, and close once they are read
        with another sign or unit, for the other arm, as differences, or with an inverted gripper.
    """
    if not episode.commanded or episode.state_kind != "joints":
        return
    joints, grippers = _joints_and_grippers(episode)
    state, command = episode.state.astype(np.float64), episode.action.astype(np.float64)
    moving = np.ptp(state, axis=0) > _MOVES_RAD
    blocks = arm_blocks(episode)
    arms = [[column for column in block if column in joints] for block in blocks] or [joints]
    readings: list[tuple[str, list[int], np.ndarray]] = [
        ("degrees, the states radians", joints, np.deg2rad(command)),
        ("radians, the states degrees", joints, np.rad2deg(command)),
        *(("of the other sign", columns, -command) for columns in (*arms, *([column] for column in joints))),
        *(("relative to the states, or never written", columns, state + command) for columns in arms),
        *(("inverted openings", [column], 1 - command) for column in grippers),
    ]
    if len(blocks) == 2 and len(blocks[0]) == len(blocks[1]):
        exchanged = command.copy()
        exchanged[:, [*blocks[0], *blocks[1]]] = command[:, [*blocks[1], *blocks[0]]]
        readings.append(("of the other arm", joints, exchanged))
    for meaning, columns, other in readings:
        used = [column for column in columns if moving[column]]
        apart, closer = (float(np.abs(values - state)[:, used].mean()) if used else 0.0 for values in (command, other))
        if apart > _APART_RAD and closer < _MUCH_CLOSER * apart:
            names = episode.state_names or [f"column {column}" for column in range(state.shape[1])]
            raise RejectedInputError(
                "contradicting_tracks",
                f"States and commands contradict each other: the commands look {meaning}",
                where=f"episode {episode.episode_id}, {', '.join(names[column] for column in used)}",
                expected="commands close to the states",
                got=f"{apart:.3f} apart on average, {closer:.3f} if they are {meaning}",
                next_step="declare columns and units of both as they are, or leave the commands out",
                evidence={"apart": apart, "apart_otherwise": closer},
            )


def check_tool_poses(episode: Episode) -> None:
    """Compare the recorded tools' motion with that of the joints, where the robot's kinematic description is here.

    Raises: RejectedInputError (contradicting_tracks).
    """
    if episode.T_base_ee is None or episode.state_kind != "joints" or episode.embodiment not in embodiment_names():
        return
    embodiment, tree = _embodiment(episode.embodiment), _tree(episode.embodiment)
    if tree is None or embodiment.state_size != episode.state.shape[1]:
        return
    frames = np.unique(np.linspace(0, episode.num_frames - 1, _POSE_FRAMES).round().astype(int))
    recorded = episode.T_base_ee[frames]
    expected = tool_poses(
        embodiment, tree, episode.state[frames].astype(np.float64), embodiment.noted_posture(episode.conventions)
    )
    where = f"episode {episode.episode_id}"
    if recorded.shape != expected.shape:
        raise RejectedInputError(
            "length_mismatch",
            "Recorded tool poses and embodiment differ in the number of arms",
            where=f"{where}, {embodiment.name}",
            expected=expected.shape[1],
            got=recorded.shape[1],
        )
    # From the embodiment's tools to the recorded ones, as at the first frame: both may be other points of a gripper.
    offset = np.linalg.inv(expected[0]) @ recorded[0]
    apart = np.linalg.inv(expected @ offset) @ recorded
    metres, degrees = np.linalg.norm(apart[..., :3, 3], axis=-1), np.rad2deg(rotation_angle(apart[..., :3, :3]))
    wrong = ((metres > _POSE_ERROR_M) | (degrees > _POSE_ERROR_DEG)).any(axis=1)
    if wrong.sum() >= min(3, len(frames) - 1):
        raise RejectedInputError(
            "contradicting_tracks",
            "The joints do not move the tools as the recorded tool poses do",
            where=f"{where}, {embodiment.name}",
            expected=f"at most {100 * _POSE_ERROR_M:g} cm and {_POSE_ERROR_DEG:g} deg apart",
            got=f"up to {100 * metres.max():.1f} cm and {degrees.max():.1f} deg, in {wrong.mean():.0%} of the frames",
            next_step="`worldline calibrate check` tells wrong units and orders of angles (conventions.pose_unit, euler, "
            "quaternion); else compare order and sign of the joints with the embodiment",
            evidence={"max_m": float(metres.max()), "max_deg": float(degrees.max()), "share": float(wrong.mean())},
        )


@lru_cache(maxsize=32)
def _tree(name: str) -> TreeBody | None:
    """The kinematic description; None where it is not here."""
    embodiment = _embodiment(name)
    return read_tree(embodiment) if embodiment.description_path.is_file() else None


@lru_cache(maxsize=32)
def _embodiment(name: str) -> Embodiment:
    """Read once: parsing takes as long as decoding a hundred frames."""
    return load_embodiment(name)


def check_times(episode: Episode) -> None:
    """Raises: RejectedInputError (wrong_fps) when frame times leave the grid of the stated rate."""
    grid = np.arange(episode.num_frames) / episode.fps
    off = np.abs(episode.timestamps - episode.timestamps[0] - grid) * episode.fps
    if off.max() > _TIME_TOLERANCE_FRAMES:
        steps = np.diff(episode.timestamps)
        raise RejectedInputError(
            "wrong_fps",
            "Frame times do not follow the stated rate",
            where=f"episode {episode.episode_id}",
            expected=f"{episode.fps} fps within {_TIME_TOLERANCE_FRAMES} frames",
            got=f"{off.max():.2f} frames off; median step {np.median(steps) * 1e3:.2f} ms",
            evidence={
                "stated_fps": float(episode.fps),
                "measured_fps": float(1 / np.median(steps)) if len(steps) and np.median(steps) > 0 else None,
                "max_frames_off": float(off.max()),
            },
        )


def check_camera(episode: Episode, camera: CameraTrack) -> None:
    """Raises: RejectedInputError (singular_intrinsics, invalid_extrinsics)."""
    where = f"episode {episode.episode_id}, view {camera.view}"
    check_intrinsics(camera, where)
    camera_pose(camera.view, camera.T_base_camera, where=where)


_KEPT_SPLITS = ("ood_test", "bank")
"""Splits that stay where a source declares them."""
TRIMMED = "trimmed"
"""Noted in the conventions of an episode that `trim` shortened: how many frames states and videos had."""
MAX_TRIMMED_FRAMES = 1
"""Difference that a recorder which stops at once leaves between the last state and the last picture."""


def trimmed(config: CurateConfig, loaded: LoadedEpisode) -> LoadedEpisode:
    """The episode, with `trim: common` cut to the frames that its states and all of its videos have.

    Only where each video is a file of its own, whose frames can be counted, and has one frame more or fewer than there are
    states; `check_lengths` refuses a larger difference. The episode's conventions say what was cut.
    """
    episode = loaded.episode
    files = {view: clip for view, clip in loaded.clips.items() if clip.file_frames is not None}
    if config.trim is None or episode.video_frames is not None or not files:
        return loaded
    counts = {view: len(frame_times(clip.path)) for view, clip in files.items()}
    off = max(abs(count - episode.num_frames) for count in counts.values())
    if not 0 < off <= MAX_TRIMMED_FRAMES:
        return loaded
    common = min(episode.num_frames, *counts.values())
    found = ", ".join(f"{name} {count}" for name, count in {"states": episode.num_frames, **counts}.items())
    cut = episode.cut(0, common)
    cut = replace(cut, conventions={**cut.conventions, TRIMMED: f"the first {common} frames of {found}"})
    counted = {view: replace(clip, file_frames=counts.get(view)) for view, clip in loaded.clips.items()}
    part = replace(loaded, clips=counted).cut(cut, lambda _: range(common))
    return replace(part, images=lambda view: islice(loaded.images(view), common))


def prepare_episode(
    config: CurateConfig, loaded: LoadedEpisode
) -> tuple[
    Episode,
    dict[str, ViewImages],
    dict[str, Frames],
    Callable[[Mapping[str, ViewThumbnails]], Episode],
    dict[str, Frames],
]:
    """The episode as the set will hold it. No image is decoded yet: that happens once, while the episode is written.

    Returns:
        What `EpisodeSetWriter.add` takes: the episode at the wanted rate and size; its views; bool (N, H, W) masks by view;
        what describes the episode as the configuration asks, given the thumbnails of its views; uint8 (N, H, W) labels of
        things by view.

    Raises: RejectedInputError (too_short, wrong_fps).
    """
    recorded = loaded.episode
    step = config.stride or stride_to(recorded, config.fps)
    views = config.views if isinstance(config.views, tuple) else loaded.views
    episode = recorded if step == 1 else recorded.cut(0, recorded.num_frames, step)
    if episode.num_frames < config.min_frames:
        raise RejectedInputError(
            "too_short",
            "Episode has too few frames",
            where=f"episode {episode.episode_id}",
            expected=f"at least {config.min_frames}",
            got=episode.num_frames,
        )
    frames = {
        view: ViewImages(
            partial(loaded.each_image, view),
            recorded.num_video_frames,
            loaded.clips.get(view),
            step,
            config.image_size,
            config.fit,
            calibrated=view in episode.cameras,
        )
        for view in views
    }
    masks: dict[str, Frames] = {}
    things: dict[str, Frames] = {}
    for view in views:
        mask, labels = loaded.robot_masks(view), loaded.thing_labels(view)
        if mask is not None:
            masks[view] = _fitted(config, mask[::step], ImageTransform.masks, bool)
        if labels is not None:
            things[view] = _fitted(config, labels[::step], ImageTransform.labels, np.uint8)
    cameras = {
        view: camera.transformed(ImageTransform.of((camera.height, camera.width)).fitted(config.image_size, config.fit))
        for view in views
        if (camera := episode.cameras.get(view)) is not None
    }
    prepared = replace(
        episode,
        fps=config.fps or episode.fps,
        timestamps=np.arange(episode.num_frames) / (config.fps or episode.fps),
        cameras=cameras,
    )
    return prepared, frames, masks, partial(described, config, prepared, tuple(views)), things


def _fitted(
    config: CurateConfig, images: Frames, fit: Callable[[ImageTransform, np.ndarray], np.ndarray], dtype: type
) -> Frames:
    """Masks or labels (N, H, W), each brought to the configured size when it is asked for."""
    transform = ImageTransform.of((images.shape[1], images.shape[2])).fitted(config.image_size, config.fit)
    size = len(images), *transform.image_size
    return MadeFrames(lambda: (fit(transform, image[None])[0] for image in images), size, dtype)


def described(
    config: CurateConfig, episode: Episode, views: Sequence[str], thumbnails: Mapping[str, ViewThumbnails]
) -> Episode:
    """The episode as the set describes it: its split, instruction and primary view. None of them depends on its outcome.

    Args:
        views: views that the set keeps. thumbnails: of these.

    Raises: ConfigError when a recording for evaluation only is given a training split.
    """
    primary = with_primary_view(episode, config.primary_view, views, thumbnails)
    normalised = with_instruction(primary) if config.normalise_instructions else primary
    result = with_split(normalised, config.splits)
    check_split(result)
    return result


def with_split(episode: Episode, splits: Mapping[str, Split] | DrawnSplits) -> Episode:
    """The episode in the split that the configuration gives its scene; without a rule its source's."""
    named = _named_split(episode.scene, splits)
    if named is not None:
        return replace(episode, split=named)
    if not isinstance(splits, DrawnSplits) or not is_drawn(episode.scene, episode.split, episode.conventions, splits):
        return episode
    # By episode: once all of them are known (`rules.drawn_episodes`).
    return replace(episode, split=drawn_split(episode.scene, splits) if splits.by == "scene" else "train")


def _named_split(scene: str, splits: Mapping[str, Split] | DrawnSplits) -> Split | None:
    patterns = splits.patterns if isinstance(splits, DrawnSplits) else splits
    return next((split for pattern, split in patterns.items() if fnmatchcase(scene, pattern)), None)


def is_drawn(scene: str, split: str, conventions: Mapping[str, object], splits: DrawnSplits) -> bool:
    """True if the draw decides the split, not a pattern or the source."""
    kept = split in _KEPT_SPLITS or conventions.get("layout") in EVALUATION_LAYOUTS
    return not kept and _named_split(scene, splits) is None


def drawn_split(scene: str, splits: DrawnSplits) -> Split:
    """The split of a scene: a uniform number in [0, 1) from SHA-256 of "seed:scene", against the shares."""
    number = int.from_bytes(sha256(f"{splits.seed}:{scene}".encode()).digest()[:8]) / 2**64
    if number < splits.test:
        return "test"
    return "validation" if number < splits.test + splits.validation else "train"


def with_primary_view(
    episode: Episode, configured: str | None, views: Sequence[str], thumbnails: Mapping[str, ViewThumbnails]
) -> Episode:
    """The episode with the view that represents it in single-view training (Stage I).

    In this order: the configured view, the one that the source declares, the head's, the one that shows most motion (of
    equal ones the last by name). An episode that lacks the configured view stays out of Stage I, as the configuration
    asks.
    """
    if configured is None and episode.primary_view in views:
        return episode
    head = "head" if "head" in views else None
    most_motion = max(views, key=lambda view: (motion(thumbnails[view]), view))
    return replace(episode, primary_view=configured or head or most_motion)


def motion(view: ViewThumbnails) -> float:
    """Mean absolute change between the moments of a view, in grey levels of 255, over at most 64 moments."""
    step = max(1, len(view.gray) // 64)
    moments = view.gray[::step].astype(np.int16)
    return float(np.abs(np.diff(moments, axis=0)).mean()) if len(moments) > 1 else 0.0


def check_split(episode: Episode) -> None:
    """Raises: ConfigError when an episode for evaluation only is given a split that trains or selects a model.

    The layout is noted in the episode, so a set made of such recordings earlier is refused as well.
    """
    kept_out = for_evaluation_only(episode.conventions, episode.source, episode.embodiment)
    if kept_out and episode.split in TRAINING_SPLITS:
        raise ConfigError(
            "Recordings for evaluation only were assigned to training",
            where=f"episode {episode.episode_id}, scene {episode.scene} ({episode.conventions.get('layout')})",
            expected="split test or ood_test",
            got=episode.split,
            next_step="change the source's split or curate.splits; what is not DROID must not be called so",
        )


def stride_to(episode: Episode, fps: float | None) -> int:
    """The stride that brings an episode to the wanted rate.

    Raises: RejectedInputError (wrong_fps) when the recorded rate is no whole multiple of it.
    """
    if fps is None:
        return 1
    ratio = episode.fps / fps
    step = round(ratio)
    if step < 1 or abs(ratio - step) > 1e-2:
        raise RejectedInputError(
            "wrong_fps",
            "Recorded rate is no whole multiple of the wanted one",
            where=f"episode {episode.episode_id}",
            expected=f"a multiple of {fps} fps",
            got=f"{episode.fps} fps",
            next_step="set curate.fps to a divisor of the recorded rate, or to null to keep it",
            evidence={"wanted_fps": float(fps), "recorded_fps": float(episode.fps)},
        )
    return step
