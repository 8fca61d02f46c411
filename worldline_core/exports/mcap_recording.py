"""MCAP files of an episode's predictions: one a method, with cameras and commanded tool poses."""

from __future__ import annotations

import json
from pathlib import Path

from worldline_core.data.mcap.io import write_rollout_mcap
from worldline_core.exports.rerun_recording import RecordingContent


def write_mcap_recordings(content: RecordingContent, output: Path, stem: str) -> list[Path]:
    """Writes `<stem>_<method>.mcap` for every method and returns the files.

    Calibration follows the frames' size; poses are cut to the prediction's length.
    """
    episode = content.episode
    written: list[Path] = []
    for method, views in content.predicted_frames.items():
        count = min(len(frames) for frames in views.values())
        cameras = {
            view: episode.cameras[view].resized(frames.shape[2], frames.shape[1]).cut(0, count)
            for view, frames in views.items()
            if view in episode.cameras
        }
        facts = {
            "method": method,
            "episode_id": episode.episode_id,
            "embodiment": episode.embodiment,
            "instruction": episode.instruction,
        }
        path = output / f"{stem}_{method}.mcap"
        write_rollout_mcap(
            path,
            {view: frames[:count] for view, frames in views.items()},
            episode.fps,
            metadata={key: json.dumps(value) for key, value in facts.items()},
            cameras=cameras,
            T_base_ee=None if content.tracks is None else content.tracks.T_base_tool[:count],
        )
        written.append(path)
    return written
