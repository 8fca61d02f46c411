"""How good are the videos of another simulator? Any folder of mp4 files, one per episode and view, against recordings.

The files are named {episode}_{view}.mp4 and show what was recorded, from the first frame on, at the recordings' rate.

Run: python examples/evaluate_videos.py VIDEOS EPISODE_SET [--method NAME] [--artifacts FOLDER]
EPISODE_SET is a curated or filtered set (artifacts/filter/<key>).
"""

from __future__ import annotations

import argparse
from pathlib import Path

from worldline_core.actions.render_actions import RenderActionsConfig
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.video.frame_decoder import decode_video
from worldline_core.errors import DataError
from worldline_core.evaluation.video.evaluate_video import VideoEvaluationConfig
from worldline_core.pipeline.steps import run_step
from worldline_core.rollout.rollout_set import RolloutSetWriter
from worldline_core.shipped import shipped_folder
from worldline_core.store.artifact_files import read_json
from worldline_core.store.store import ArtifactStore

VIEWS = ("head", "left_wrist", "right_wrist")


def import_videos(videos: Path, episodes: EpisodeSet, method: str, output: Path) -> tuple[int, tuple[str, ...]]:
    """Write the videos as a RolloutSet; returns how many episodes they show, and the views that all of these have."""
    fps = {row.fps for row in episodes.rows}
    if len(fps) != 1:
        raise DataError("The recordings have several rates", where=episodes.root, got=sorted(fps))
    files = {
        row.episode_id: [view for view in VIEWS if _file(videos, row.episode_id, view).is_file()]
        for row in episodes.rows
    }
    shown = {episode: views for episode, views in files.items() if views}
    views = tuple(view for view in VIEWS if shown and all(view in there for there in shown.values()))
    if not views:
        raise DataError(
            "No view has a video of every episode", where=videos, expected="{episode}_{view}.mp4", got=shown
        )
    writer = RolloutSetWriter(output, method, fps.pop())
    for episode in shown:
        writer.add(episode, 0, {view: decode_video(_file(videos, episode, view)) for view in views})
    writer.close()
    return len(shown), views


def _file(videos: Path, episode: str, view: str) -> Path:
    return videos / f"{episode}_{view}.mp4"


def main() -> None:
    """Import, evaluate, print the means."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("videos", type=Path)
    parser.add_argument("episode_set", type=Path)
    parser.add_argument("--method", default="theirs", help="the name of the simulator in scores and reports")
    parser.add_argument("--artifacts", type=Path, default=Path("artifacts"))
    arguments = parser.parse_args()
    episodes = EpisodeSet.open(arguments.episode_set)
    imported = arguments.artifacts / "imported" / arguments.method
    count, views = import_videos(arguments.videos, episodes, arguments.method, imported)
    store = ArtifactStore(arguments.artifacts)
    tracks = run_step(store, "render_actions", RenderActionsConfig(), {"episodes": arguments.episode_set})
    scores = run_step(
        store, "evaluate_video", VideoEvaluationConfig.model_validate({"views": views}),
        {"episodes": arguments.episode_set, "tracks": tracks.path, f"rollouts.{arguments.method}": imported,
         "segmenter": shipped_folder() / "models" / "segmenter"},
    )  # fmt: skip
    print(f"{count} episodes, {scores.path}")
    for group, methods in read_json(scores.path / "summary.json")["metrics"].items():
        for metric, interval in sorted(methods.get(arguments.method, {}).items()):
            print(f"{group:24} {metric:28} {interval['mean']:7.3f}  [{interval['low']:.3f}, {interval['high']:.3f}]")


if __name__ == "__main__":
    main()
