"""Train Stage II on recordings of your own, step by step: `worldline init` looks at them, then the steps run on the file that it wrote.

`worldline fit` does this and more in one command: it estimates cameras, distils, evaluates and reports. Needs no calibration
(docs/your_robot.md). Where a line of that file has to be filled in, the first step says which.

Run: python examples/train_on_lerobot.py DATASET [--set train_stage2.trainer.minutes=30]
"""

from __future__ import annotations

import sys
from pathlib import Path

from flows.command_line import main as worldline
from worldline_core.pipeline.pipeline_config import PipelineConfig


def main() -> None:
    """Write my.yaml unless it is there, and run the steps; each is found in the store the next time."""
    dataset, *options = sys.argv[1:]
    if not Path("my.yaml").exists():
        worldline(["init", dataset])
    cameras = PipelineConfig.load(None, Path("my.yaml")).render_actions is not None
    for step in ("curate", "filter", *(["render_actions"] if cameras else []), "encode_latents", "train_stage2"):
        worldline(["task", step, "--config", "my.yaml", *options])


if __name__ == "__main__":
    main()
