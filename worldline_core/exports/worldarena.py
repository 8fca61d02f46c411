"""Predictions in the layout that WorldArena's video evaluation reads (arXiv 2602.08971; `video_quality/README.md` of its
repository, "Data and Naming Rules"):

```
<method>_sort/<task>_episode_<n>.mp4     predicted head views, no subfolders
gt_video/<task>_episode_<n>.mp4          the recorded ones, as long and at the same rate
gt_frames/<task>_episode_<n>.png         their first frames
summary.json                             [{gt_path, image, prompt: [instruction]}, ...]
episodes.json                            our episode id by their name
```

Its action following compares ``<method>_sort`` with ``<method>_1_sort`` and ``<method>_2_sort``: export the predictions under
changed controls beside it and rename their folders. The leaderboard asks for RoboTwin's recordings, 121 frames at 24 fps.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.guards.source_paths import safe_stem
from worldline_core.data.video.encoder import encode_video
from worldline_core.data.video.frames import VideoFrames
from worldline_core.data.video.header import check_video_header
from worldline_core.errors import DataError
from worldline_core.pictures.labels import png_bytes
from worldline_core.rollout.rollout_set import RolloutSet
from worldline_core.store.atomic import atomic_path, write_bytes_atomic, write_json_atomic

HEAD = "head"


def export_worldarena(rollouts: RolloutSet, episodes: EpisodeSet, names: Sequence[str], output: Path) -> list[Path]:
    """Write the predictions (of the smallest seed) of some episodes; returns the files.

    Raises: DataError for an episode without a predicted head view, whose rate is no whole part of the recording's, or that is longer.
    """
    written: list[Path] = []
    summary, ids = [], {}
    for number, name in enumerate(sorted(names)):
        if HEAD not in rollouts.views(name):
            raise DataError("WorldArena looks at the head view", where=name, got=", ".join(rollouts.views(name)))
        position = episodes.position(name)
        row, clip = episodes.rows[position], rollouts.clip(name, HEAD)
        stride = round(row.fps / rollouts.fps)
        if stride < 1 or abs(row.fps / rollouts.fps - stride) > 1e-3:
            raise DataError("Another rate than the recording's", where=name, expected=row.fps, got=rollouts.fps)
        if stride * (clip.num_frames - 1) >= row.video_frames:
            raise DataError("Longer than its recording", where=name, expected=row.video_frames, got=clip.num_frames)
        stem = f"{safe_stem(row.task_family or 'task')}_episode_{number}"
        predicted, true, first = (
            output / folder / f"{stem}.{suffix}"
            for folder, suffix in (
                (f"{safe_stem(rollouts.method)}_sort", "mp4"),
                ("gt_video", "mp4"),
                ("gt_frames", "png"),
            )
        )
        with atomic_path(predicted) as temporary:
            shutil.copyfile(check_video_header(clip.path), temporary)
        frames = VideoFrames(episodes.clip(position, HEAD), stride)
        with atomic_path(true) as temporary:
            shown = islice(frames, clip.num_frames)
            encode_video(temporary, shown, rollouts.fps, crf=8, preset="veryfast", pixel_format="yuv444p")
        write_bytes_atomic(first, png_bytes(frames[[0]][0]))
        written += [predicted, true, first]
        summary.append({"gt_path": f"{true.resolve()}", "image": f"{first.resolve()}", "prompt": [row.instruction]})
        ids[stem] = name
    for file, content in (("summary.json", summary), ("episodes.json", ids)):
        write_json_atomic(output / file, content)
        written.append(output / file)
    return written
