"""Rollout, video metrics and policy rules of one set of recordings, in a process of its own: prints its peak memory [MiB].

    python tests/rollout/run_chain.py FOLDER CONFIG.json

CONFIG.json: {"rollout": ..., "inputs": {name: folder}, "segmenter": folder}.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import torch

from worldline_core.evaluation.evaluation_config import PolicyEvaluationConfig, VideoEvaluationConfig
from worldline_core.evaluation.policy.evaluate_policy import evaluate_policy
from worldline_core.evaluation.video.evaluate_video import evaluate_video
from worldline_core.rollout.rollout import rollout
from worldline_core.rollout.rollout_config import RolloutConfig


def run_chain(output: Path, given: dict) -> None:
    """Run the three steps."""
    inputs = {name: Path(folder) for name, folder in given["inputs"].items()}
    rollout(RolloutConfig.model_validate(given["rollout"]), inputs, output / "rollout")
    scored = {name: inputs[name] for name in ("episodes", "tracks")} | {"rollouts.model": output / "rollout"}
    scored["segmenter"] = Path(given["segmenter"])
    video = VideoEvaluationConfig(segmenters=("learned",), resamples=100)
    policy = PolicyEvaluationConfig(segmenter="learned", balanced=False, resamples=100)
    evaluate_video(video, scored, output / "video")
    evaluate_policy(policy, scored, output / "policy")


if __name__ == "__main__":
    torch.set_num_threads(1)
    run_chain(Path(sys.argv[1]), json.loads(Path(sys.argv[2]).read_text()))
    # Not ru_maxrss: a process begins with that of the one that started it.
    (peak,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    print(int(peak.split()[1]) / 1024)
