"""DROID-style episodes: one annotation JSON and three videos each (Franka arm, Robotiq gripper).

States: xyz [m], roll pitch yaw [rad] about fixed axes of the flange, gripper 0 open .. 1 closed (inverted here). Views:
two exterior cameras and a wrist camera, without published calibration.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from worldline_core.data.episodes.conventions import along_tool_z
from worldline_core.data.episodes.episode import one_annotation
from worldline_core.data.episodes.source import (
    EVALUATION_LAYOUTS,
    EmbodimentName,
    EpisodeFiles,
    EvaluationSourceConfig,
    GripperRange,
    LoadedEpisode,
    joint_names,
    sorted_views,
)
from worldline_core.data.guards.plain_files import expect_layout, read_json
from worldline_core.data.guards.rejection import RejectedInputError, all_of, check_length, check_rate, check_shape
from worldline_core.data.guards.source_paths import AnyPath, find_files, inside
from worldline_core.data.video.clip import VideoClip, frame_times, video_size
from worldline_core.geometry.transforms import pose_from_euler_fixed_xyz

_GRIPPER = GripperRange(closed=1.0, open=0.0)
_TOOL_OFFSET_M = 0.155
"""Flange to fingertips along the flange's +z."""


class DroidAnnotationSourceConfig(EvaluationSourceConfig):
    """`views` names the videos of an episode in order; None leaves one out."""

    kind: Literal["droid_annotation"] = "droid_annotation"
    embodiment: EmbodimentName = "droid_franka"
    views: tuple[str | None, ...] = ("head", "exterior_2", "right_wrist")


class DroidAnnotationSource(EpisodeFiles[DroidAnnotationSourceConfig]):
    """Reads every `annotation/<split>/<id>.json` below the root."""

    looked_for = "annotation/<split>/<id>.json"

    def __init__(self, config: DroidAnnotationSourceConfig, root: AnyPath) -> None:
        found = find_files(root, "annotation/*/*.json")
        super().__init__(config, root, found, lambda file: (*file.parts[:-3], *file.parts[-2:-1], file.stem))

    def load(self, episode_id: str) -> LoadedEpisode:
        file = self.path(episode_id)
        record = read_json(file)
        with expect_layout(file, "an annotation: a mapping with states, joints, videos and texts"):
            return self._read(episode_id, file.parents[2], file, record)

    def _read(self, episode_id: str, subset: AnyPath, file: AnyPath, record: dict[str, Any]) -> LoadedEpisode:
        config = self.config
        states = _rows(record, "states", 7, file)
        listed = record.get("videos") or []
        videos = {
            view: inside(subset, str(video["video_path"]))
            for view, video in zip(config.views, listed, strict=False)
            if view is not None
        }
        if not videos:
            raise RejectedInputError("missing_view", "Annotation lists no video", where=file)
        faults: list[RejectedInputError] = []
        rates, absent = sorted_views(videos, lambda view: video_size(videos[view])[2], faults)
        if faults or not rates:
            raise all_of([*faults, *absent.values()], file)
        fps = next(iter(rates.values()))
        for view, rate in rates.items():
            check_rate(rate, fps, videos[view], tolerance=1e-3)
        if "joints" in record:
            joints = _rows(record, "joints", 8, file)[:, :7]
        else:
            joints = _rows(record, "observation.state.joint_position", 7, file)[::3]
        check_length("Joints", file, states=len(states), unit="rows", found=len(joints))
        opening, overshoot = _GRIPPER.opening(states[:, 6:7])
        state = np.concatenate([joints, opening], axis=1)
        command = _command(record, len(states))
        pose = pose_from_euler_fixed_xyz(states[:, :3], states[:, 3:6])[:, None]
        success = record.get("success")
        texts = [str(text) for text in record.get("texts", []) if text]
        episode = self.episode(
            episode_id,
            f"{config.label}-{subset.name}-{file.stem}",
            layout=EVALUATION_LAYOUTS[0],
            state=state,
            action=command,
            overshoot=overshoot,
            instruction=one_annotation(texts),
            outcome=config.outcome if success is None else "success" if success else "failure",
            fps=fps,
            T_base_ee=along_tool_z(pose, _TOOL_OFFSET_M),
            gripper=opening,
            state_names=joint_names({"right": 7}),
            conventions={"tool_offset_m": _TOOL_OFFSET_M},
        )
        counts = {view: len(frame_times(videos[view])) for view in rates}
        clips = {view: VideoClip.whole_file(videos[view], count, fps) for view, count in counts.items()}
        return LoadedEpisode(episode, tuple(clips), clips=clips, absent=absent)


def _command(record: dict[str, Any], length: int) -> np.ndarray | None:
    joints, gripper = record.get("action.joint_position"), record.get("action.gripper_position")
    if joints is None or gripper is None:
        return None
    command = np.concatenate([np.asarray(joints)[::3], 1.0 - np.asarray(gripper)[::3, None]], axis=1)
    return command if command.shape == (length, 8) else None


def _rows(record: dict[str, Any], key: str, width: int, file: AnyPath) -> np.ndarray:
    if key not in record:
        raise RejectedInputError("missing_column", "Annotation lacks a key", where=file, expected=key)
    try:
        values = np.asarray(record[key], dtype=np.float64)
    except ValueError as error:
        where = f"{file}, {key}"
        raise RejectedInputError("length_mismatch", "Rows differ in length", where=where, got=str(error)) from error
    check_shape("Rows", f"{file}, {key}", values.shape, (None, width))
    return values
