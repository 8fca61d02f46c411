"""Train Stage I on a LeRobot dataset of your own: curate, filter, encode, train, from the shipped base model.

Needs no calibration. Stage II needs one (docs/sources.md, "Calibration") and the three views; then continue with
`worldline task render_actions` and `worldline task train_stage2` on the same configuration.

Run: python examples/train_on_lerobot.py DATASET --embodiment NAME --view observation.images.head [--steps 200]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from tasks.curate import curate
from tasks.encode_latents import encode_latents
from tasks.filter import filter_episodes
from tasks.train_stage1 import train_stage1
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.shipped import shipped_folder
from worldline_core.store.artifact_files import read_json
from worldline_core.store.store import ArtifactStore
from worldline_core.training.clip_config import EncodeLatentsConfig
from worldline_core.training.training_config import Stage1Config


def main() -> None:
    """Run the four steps; each is found in the store the next time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, help="a LeRobotDataset v3")
    parser.add_argument("--embodiment", required=True, help="a name of `worldline embodiment list`")
    parser.add_argument("--view", default="observation.images.head", help="the video key to train on")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--artifacts", type=Path, default=Path("artifacts"))
    arguments = parser.parse_args()
    settings = CurateConfig.model_validate(
        {
            "sources": [
                {"kind": "lerobot_v3", "path": arguments.dataset, "embodiment": arguments.embodiment,
                 "angle_unit": "rad", "views": {arguments.view: "head"}, "split": "train"}
            ],
            "image_size": (64, 96),
            "fps": 8,
        }
    )  # fmt: skip
    trainer = {"steps": arguments.steps, "batch_size": 8, "validation_batches": 0, "optimizer": {"warmup_steps": 10}}
    stage1 = Stage1Config.model_validate(
        {"trainer": trainer, "clips": {"lengths": [17], "view_weights": {"primary": 1.0}}}
    )
    store, models = ArtifactStore(arguments.artifacts), shipped_folder() / "models"
    curated = curate.run(store, settings, {"source.0": arguments.dataset})
    kept = filter_episodes.run(store, FilterConfig(), {"episodes": curated.path})
    latents = encode_latents.run(
        store,
        EncodeLatentsConfig(primary_alone=True),
        {"episodes": kept.path, "tokenizer": models / "tokenizer"},
    )
    inputs = {"episodes": kept.path, "latents": latents.path, "base": models / "base"}
    trained = train_stage1.run(store, stage1, inputs)
    print(json.dumps(read_json(trained.path / "manifest.json")["metrics"], indent=1))
    print(trained.path)


if __name__ == "__main__":
    main()
