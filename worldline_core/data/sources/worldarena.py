"""WorldArena's sets: a first frame, an instruction and a trajectory of two arms for each episode. For evaluation only.

Track 1 (`test_dataset`, `val_dataset`):
    data/<task>/episode<N>.hdf5            joint_action/vector (T, 14)
    first_frame/<task>/episode<N>.png
    instructions/<task>/episode<N>.json    {"instruction": "..."}
    video/<task>/episode<N>.mp4            the true video of T frames, in sets that have it
Track 2, policies in closed loop (`dataset`):
    actions/<task>/episode<N>.npy (T, 14), images/<task>/episode<N>.png, instructions/<task>/episode<N>.json

A row holds six joints and the gripper (0 closed .. 1 open) of the left arm, then of the right one. Sources: WorldArena's
repository (tsinghua-fib-lab/WorldArena: `assets/README_submission.md`; `docs/DETAILS.md` and `dataset.py` of
`embodied_task/worldarena_track2`) and the card of its dataset (WorldArena/WorldArena_Robotwin2.0 of the hub). They name the
place of the trajectories both `data` and `data/_traj_data`, so folders of that name do not count; a task's folder may be
missing. They also disagree about the quaternions of end poses, which are not read.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import PurePosixPath
from typing import Literal

import cv2
import numpy as np
from pydantic import BaseModel, Field

from worldline_core.config import FrameRate
from worldline_core.data.episodes.episode import NO_EMBODIMENT
from worldline_core.data.episodes.source import (
    EVALUATION_LAYOUTS,
    EmbodimentName,
    EpisodeFiles,
    EvaluationSourceConfig,
    GripperRange,
    LoadedEpisode,
    joint_names,
    timed_video_size,
)
from worldline_core.data.guards.plain_files import read_image, read_json, read_npy, validated
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath, find_files, inside, is_file, relative_name
from worldline_core.data.sources.hdf5 import open_hdf5, require_h5py
from worldline_core.data.video.clip import VideoClip, read_clip

_GRIPPERS = [6, 13]
_GRIPPER = GripperRange(closed=0.0, open=1.0)
_NAMES = joint_names({"left": 6, "right": 6})
_ASPECT_TOLERANCE = 0.01


class WorldArenaSourceConfig(EvaluationSourceConfig):
    """The sets hold no cameras: a model of action maps needs `calibration` of `head`, one of control vectors the robot's name."""

    kind: Literal["worldarena"] = "worldarena"
    fps: FrameRate = Field(default=24.0, description="of trajectories and true videos, which must have it")
    embodiment: EmbodimentName = NO_EMBODIMENT


class _Instruction(BaseModel):
    instruction: str


class WorldArenaSource(EpisodeFiles[WorldArenaSourceConfig]):
    """Reads every trajectory below the root; the head view is the first frame, then the true video where there is one."""

    looked_for = "data/**/episode*.hdf5 or actions/**/episode*.npy"

    def __init__(self, config: WorldArenaSourceConfig, root: AnyPath) -> None:
        files = [relative_name(path, root) for path in find_files(root, "episode*")]
        self._beside: dict[tuple[str, str], list[PurePosixPath]] = {}
        for file in files:
            self._beside.setdefault((file.parts[0], file.name), []).append(file)
        found = [file for file in files if (file.parts[0], file.suffix) in (("data", ".hdf5"), ("actions", ".npy"))]
        if any(file.suffix == ".hdf5" for file in found):
            require_h5py()
        super().__init__(config, root, [root / str(file) for file in found], _episode_parts)

    def load(self, episode_id: str) -> LoadedEpisode:
        config, relative, path = self.config, self.files[episode_id], self.path(episode_id)
        parts, track_1 = _episode_parts(relative), relative.suffix == ".hdf5"
        if track_1:
            with open_hdf5(path) as file:
                values = file.array("joint_action/vector", (None, 14))
        else:
            values = read_npy(path, (None, 14))
        length = len(values)
        values[:, _GRIPPERS], overshoot = _GRIPPER.opening(values[:, _GRIPPERS])
        picture = self._file("first_frame" if track_1 else "images", parts, ".png")
        first = read_image(picture, calibrated=config.calibration is not None)
        size: tuple[int, int] = first.shape[:2]
        video = self._file("video", parts, ".mp4")
        filmed = track_1 and is_file(video)
        if filmed:
            size = timed_video_size(video, config.fps)
            if abs(size[0] * first.shape[1] / (size[1] * first.shape[0]) - 1) > _ASPECT_TOLERANCE:
                raise RejectedInputError(
                    "contradicting_tracks",
                    "First frame and true video differ in shape",
                    where=picture,
                    expected=f"the proportions of {size[1]} x {size[0]}",
                    got=f"{first.shape[1]} x {first.shape[0]}",
                )

        def images(_: str) -> Iterator[np.ndarray]:
            yield first if first.shape[:2] == size else cv2.resize(first, size[::-1], interpolation=cv2.INTER_CUBIC)
            if filmed:
                clip = VideoClip.whole_file(video, length, config.fps)
                shown = read_clip(clip, calibrated=config.calibration is not None)
                yield from (following.rgb for following in islice(shown, 1, None))

        episode = self.episode(
            episode_id,
            "-".join([config.label, *parts]),
            layout=EVALUATION_LAYOUTS[2],
            state=values,
            action=values,
            overshoot=overshoot,
            instruction=self._instruction(parts),
            video_frames=None if filmed or length == 1 else 1,
            primary_view="head",
            state_names=_NAMES,
            conventions={"state": "repeats the actions"},
        )
        return LoadedEpisode(episode, ("head",), images)

    def _file(self, kind: str, parts: tuple[str, ...], suffix: str) -> AnyPath:
        """A file of an episode: that of its task, else the only one of its number."""
        found = self._beside.get((kind, parts[-1] + suffix), [])
        own = PurePosixPath(kind, *parts[:-1], parts[-1] + suffix)
        return inside(self.root, str(found[0] if len(found) == 1 and own not in found else own))

    def _instruction(self, parts: tuple[str, ...]) -> str:
        file = self._file("instructions", parts, ".json")
        return validated(_Instruction, read_json(file), file, "File of the instruction").instruction


def _episode_parts(file: PurePosixPath) -> tuple[str, ...]:
    """The path that names an episode: task and file, without the folders that are the same for all."""
    return tuple(part for part in file.with_suffix("").parts[1:] if part != "_traj_data")
