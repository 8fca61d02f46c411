"""Evaluate the videos of another simulator: any folder of mp4 files, one per episode and view, against recordings.

The files are named {episode}_{view}.mp4 and show what was recorded, from the first frame on, at the recordings' rate.

Run: python examples/evaluate_videos.py VIDEOS EPISODE_SET [--method NAME] [--artifacts FOLDER]
EPISODE_SET is a curated or filtered set (artifacts/filter/<key>).
"""

from __future__ import annotations

import argparse
from pathlib import Path

from tasks.evaluate_video import evaluate_video
from tasks.import_rollouts import import_rollouts
from tasks.render_actions import render_actions
from worldline_core.actions.actions_config import RenderActionsConfig
from worldline_core.evaluation.evaluation_config import VideoEvaluationConfig
from worldline_core.rollout.rollout_config import ImportRolloutsConfig
from worldline_core.rollout.rollout_set import RolloutSet
from worldline_core.shipped import shipped_folder
from worldline_core.store.artifact_files import read_json
from worldline_core.store.store import ArtifactStore


def main() -> None:
    """Import, evaluate, print the means."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("videos", type=Path)
    parser.add_argument("episode_set", type=Path)
    parser.add_argument("--method", default="theirs", help="the name of the simulator in scores and reports")
    parser.add_argument("--artifacts", type=Path, default=Path("artifacts"))
    arguments = parser.parse_args()
    store = ArtifactStore(arguments.artifacts)
    config = ImportRolloutsConfig(method=arguments.method, missing="report")
    imported = import_rollouts.run(store, config, {"videos": arguments.videos, "episodes": arguments.episode_set}).path
    predicted = RolloutSet.open(imported)
    count, views = len(predicted.episode_ids), sorted({row.view for row in predicted.rows})
    tracks = render_actions.run(store, RenderActionsConfig(), {"episodes": arguments.episode_set})
    scores = evaluate_video.run(
        store, VideoEvaluationConfig.model_validate({"views": views}),
        {"episodes": arguments.episode_set, "tracks": tracks.path, f"rollouts.{arguments.method}": imported,
         "segmenter": shipped_folder() / "models" / "segmenter"},
    )  # fmt: skip
    print(f"{count} episodes, {scores.path}")
    for group, methods in read_json(scores.path / "summary.json")["metrics"].items():
        for metric, interval in sorted(methods.get(arguments.method, {}).items()):
            print(f"{group:24} {metric:28} {interval['mean']:7.3f}  [{interval['low']:.3f}, {interval['high']:.3f}]")


if __name__ == "__main__":
    main()
