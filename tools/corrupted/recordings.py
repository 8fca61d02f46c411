"""The project's own recordings with defects that only the filters can see, and with wrong values.

Every recording is used once: the same motion with other pictures would be a near duplicate.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tools.corrupted.labels import Kind, Label
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.errors import DataError
from worldline_core.recorder.defects import DEFECTS_FILE, lagged_state
from worldline_core.recorder.simulate import Recording


def _not_finite(recording: Recording, random: np.random.Generator) -> Recording:
    state = recording.episode.state.copy()
    state[int(random.integers(len(state))), 0] = np.nan
    return replace(recording, episode=replace(recording.episode, state=state))


def _sheared(recording: Recording, random: np.random.Generator) -> Recording:
    camera = recording.episode.cameras["head"]
    pose = camera.T_base_camera.copy()
    pose[:, 0, 1] += random.uniform(0.1, 0.4)
    cameras = {**recording.episode.cameras, "head": replace(camera, T_base_camera=pose)}
    return replace(recording, episode=replace(recording.episode, cameras=cameras))


def _uncalibrated(recording: Recording, random: np.random.Generator) -> Recording:
    view = str(random.choice(sorted(recording.frames)))
    cameras = {name: camera for name, camera in recording.episode.cameras.items() if name != view}
    return replace(recording, episode=replace(recording.episode, cameras=cameras))


def _one_eyed(recording: Recording, random: np.random.Generator) -> Recording:
    episode = replace(recording.episode, cameras={"head": recording.episode.cameras["head"]})
    return Recording(episode, {"head": recording.frames["head"]}, {})


KINDS = (
    Kind("states_late", lagged_state, ("time_alignment",), "stage2"),
    Kind("view_missing", _one_eyed, ("missing_view",), "stage2"),
    Kind("view_uncalibrated", _uncalibrated, ("missing_calibration",), "stage2"),
    Kind("state_not_finite", _not_finite, ("nan_state",)),
    Kind("rotation_sheared", _sheared, ("invalid_extrinsics",)),
)


def write(
    root: Path, healthy: int, each: int, random: np.random.Generator, recordings: Path
) -> tuple[list[Label], dict[str, Any]]:
    """An EpisodeSet of at most as many episodes as `recordings` has healthy ones: labels, and its `curate.sources[]` entry.

    Kinds take turns, so that all have nearly the same number.
    """
    labels: list[Label] = []
    turns = [("clean", None)] * healthy + [(kind.name, kind) for _ in range(each) for kind in KINDS]
    with EpisodeSetWriter(root, video_crf=10, video_preset="veryfast", pixel_format="yuv444p") as writer:
        for (name, kind), recording in zip(turns, _healthy(recordings, random), strict=False):
            identity = f"{root.name}-{len(labels):06d}"
            spoilt = recording if kind is None else kind.spoil(recording, random)
            writer.add(replace(spoilt.episode, episode_id=identity), spoilt.frames)
            stage, reasons = ("kept", ()) if kind is None else (kind.stage, kind.reasons)
            labels.append(Label(identity, "episode_set", name, stage, reasons))
    return labels, {"kind": "episode_set", "path": str(root), "name": root.name}


def _healthy(recordings: Path, random: np.random.Generator) -> Iterator[Recording]:
    """Recordings with three or two views and no injected defect, in a drawn order."""
    episodes = EpisodeSet.open(recordings)
    defects = recordings / DEFECTS_FILE
    known = json.loads(defects.read_text()) if defects.is_file() else {}
    injected = set(known) if isinstance(known, dict) else {row["episode_id"] for row in known}
    usable = [i for i, row in enumerate(episodes.rows) if row.episode_id not in injected and row.num_frames >= 24]
    if not usable:
        raise DataError("No healthy recordings to spoil", where=str(recordings))
    for i in random.permutation(usable):
        frames = {view: episodes.frames(int(i), view) for view in episodes.rows[int(i)].views}
        yield Recording(episodes.episode(int(i)), frames, {})
