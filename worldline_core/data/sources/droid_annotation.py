"""DROID-style episodes as annotation JSON and three videos a episode (Franka arm, Robotiq gripper).

States: xyz [m], roll pitch yaw [rad] about fixed axes of the flange, gripper 0 open .. 1 closed (turned round here). Views:
two exterior cameras and a wrist camera, without published calibration: such episodes serve action-free training only.
"""

from __future__ import annotations

import re
from typing import Any, Literal

import numpy as np
from pydantic import Field

from worldline_core.data.episodes.conventions import along_tool_z
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.instructions import one_annotation
from worldline_core.data.episodes.source import EVALUATION_LAYOUTS, EvaluationSourceConfig, LoadedEpisode, no_masks
from worldline_core.data.guards.plain_files import read_json, well_formed
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath, find_files, inside, relative_name
from worldline_core.data.video.clip import VideoClip
from worldline_core.data.video.decode import decode_video, frame_times, video_size
from worldline_core.geometry.transforms import pose_from_euler_fixed_xyz

_DIGITS = re.compile(r"(\d+)")


class DroidAnnotationSourceConfig(EvaluationSourceConfig):
    """`views` names the videos of an episode in order; None leaves one out."""

    kind: Literal["droid_annotation"] = "droid_annotation"
    embodiment: str = "droid_franka"
    views: tuple[str | None, ...] = ("head", "exterior_2", "right_wrist")
    tool_offset_m: float = Field(default=0.155, description="flange to fingertips along the flange's +z")
    fps: float | None = Field(
        default=None, gt=0, description="rate that the videos must have; default: what they state"
    )


class DroidAnnotationSource:
    """Reads every `annotation/<split>/<id>.json` below the root."""

    def __init__(self, config: DroidAnnotationSourceConfig, root: AnyPath) -> None:
        self._config = config
        self._root = root
        self._files: dict[str, tuple[AnyPath, AnyPath]] = {}
        for file in find_files(root, "annotation/*/*.json"):
            subset = file.parents[2]
            parts = [*relative_name(subset, root).parts, file.parent.name, file.stem]
            self._files["-".join([config.label, *parts])] = (subset, file)

    def episode_ids(self) -> list[str]:
        return sorted(self._files, key=lambda name: [int(t) if t.isdigit() else t for t in _DIGITS.split(name)])

    def load(self, episode_id: str) -> LoadedEpisode:
        subset, found = self._files[episode_id]
        file = inside(self._root, str(relative_name(found, self._root)))
        record = read_json(file)
        with well_formed(file, "an annotation: a mapping with states, joints, videos and texts"):
            return self._read(episode_id, subset, file, record)

    def _read(self, episode_id: str, subset: AnyPath, file: AnyPath, record: dict[str, Any]) -> LoadedEpisode:
        config = self._config
        states = _rows(record, "states", 7, file)
        listed = record.get("videos") or []
        videos = {
            view: inside(subset, str(video["video_path"]))
            for view, video in zip(config.views, listed, strict=False)
            if view is not None
        }
        if not videos:
            raise RejectedInputError("missing_view", "Annotation lists no video", where=file)
        fps = self._rate(videos, file)
        joints = self._joints(record, len(states), file)
        opening = np.clip(1.0 - states[:, 6:7], 0.0, 1.0)
        overshoot = int(np.count_nonzero((states[:, 6] < 0) | (states[:, 6] > 1)))
        state = np.concatenate([joints, opening], axis=1)
        command = self._command(record, len(states))
        pose = pose_from_euler_fixed_xyz(states[:, :3], states[:, 3:6])[:, None]
        success = record.get("success")
        texts = [str(text) for text in record.get("texts", []) if text]
        frames = dict(videos.items())
        episode = Episode(
            episode_id=episode_id,
            source=config.label,
            embodiment=config.embodiment,
            scene=config.scene or f"{config.label}-{subset.name}-{file.stem}",
            task_family=config.task_family,
            instruction=one_annotation(texts),
            outcome=config.outcome if success is None else "success" if success else "failure",
            split=config.split,
            fps=fps,
            state=state.astype(np.float32),
            action=(state if command is None else command).astype(np.float32),
            timestamps=np.arange(len(states)) / fps,
            T_base_ee=along_tool_z(pose, config.tool_offset_m),
            gripper=opening,
            state_names=(*(f"right/joint_{index}" for index in range(1, 8)), "right/gripper"),
            conventions={
                "layout": EVALUATION_LAYOUTS[0],
                "action": "commanded joints" if command is not None else "repeats the state: no commands are published",
                "tool_offset_m": config.tool_offset_m,
                "gripper_overshoot": overshoot,
            },
        )
        for view, path in videos.items():
            self._check_length(path, view, len(states))
        return LoadedEpisode(
            episode,
            tuple(frames),
            lambda view: decode_video(frames[view], len(states)),
            no_masks,
            clips={view: VideoClip.whole_file(path, len(states), fps) for view, path in videos.items()},
        )

    def _rate(self, videos: dict[str, AnyPath], file: AnyPath) -> float:
        rates = {view: video_size(path)[2] for view, path in videos.items()}
        wanted = self._config.fps or next(iter(rates.values()))
        if any(abs(rate - wanted) > 1e-3 for rate in rates.values()):
            raise RejectedInputError(
                "wrong_fps",
                "Videos have another frame rate",
                where=file,
                expected=f"{wanted} fps",
                got=rates,
                evidence={"expected_fps": wanted, **rates},
            )
        return wanted

    def _joints(self, record: dict[str, Any], length: int, file: AnyPath) -> np.ndarray:
        if "joints" in record:
            joints = _rows(record, "joints", 8, file)[:, :7]
        else:
            joints = _rows(record, "observation.state.joint_position", 7, file)[::3]
        if len(joints) != length:
            raise RejectedInputError(
                "length_mismatch",
                "Joints and states differ in length",
                where=file,
                expected=length,
                got=len(joints),
                evidence={"states": length, "joints": len(joints)},
            )
        return joints

    def _command(self, record: dict[str, Any], length: int) -> np.ndarray | None:
        joints, gripper = record.get("action.joint_position"), record.get("action.gripper_position")
        if joints is None or gripper is None:
            return None
        command = np.concatenate([np.asarray(joints)[::3], 1.0 - np.asarray(gripper)[::3, None]], axis=1)
        return command if command.shape == (length, 8) else None

    def _check_length(self, path: AnyPath, view: str, states: int) -> None:
        frames = len(frame_times(path))
        if frames != states:
            raise RejectedInputError(
                "length_mismatch",
                "Video and states differ in length",
                where=f"{path} ({view})",
                expected=f"{states} frames, one a state",
                got=f"{frames} frames",
                evidence={"states": states, "frames": frames},
            )


def _rows(record: dict[str, Any], key: str, width: int, file: AnyPath) -> np.ndarray:
    if key not in record:
        raise RejectedInputError(
            "missing_column", "Annotation lacks a key", where=file, expected=key, got=", ".join(record)
        )
    try:
        values = np.asarray(record[key], dtype=np.float64)
    except ValueError as error:
        raise RejectedInputError(
            "length_mismatch", "Rows differ in length", where=f"{file}, {key}", got=str(error)
        ) from error
    if values.ndim != 2 or values.shape[1] != width or not len(values):
        raise RejectedInputError(
            "length_mismatch",
            "Rows have a wrong width",
            where=f"{file}, {key}",
            expected=f"(N, {width})",
            got=values.shape,
        )
    return values
