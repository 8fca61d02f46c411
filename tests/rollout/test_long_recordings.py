"""Recordings of minutes through rollout, video metrics and policy rules: the memory does not grow with them."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import torch

from worldline_core.data.episodes.episode import VIEWS
from worldline_core.evaluation.evaluation_config import PolicyEvaluationConfig, VideoEvaluationConfig
from worldline_core.evaluation.policy.evaluate_policy import evaluate_policy
from worldline_core.evaluation.video.evaluate_video import evaluate_video
from worldline_core.rollout.rollout import rollout
from worldline_core.rollout.rollout_config import RolloutConfig
from worldline_core.rollout.rollout_set import RolloutSet

SAMPLERS = {
    "causal": {"kind": "block_causal", "steps": 2},
    "stage2": {"kind": "full_clip", "steps": 1, "clip_frames": 33},
}
RETURNED = {"MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536", "MALLOC_ARENA_MAX": "1"}
"""Lets glibc return freed blocks at once: what it kept, up to 45 MiB as its threshold grew, counted as memory in use."""


def run_chain(output, kind, segmenter, inputs):
    """Rollout, video metrics and policy rules, in a process of its own; prints its peak memory [MiB]."""
    torch.set_num_threads(1)
    values = {"method": "model", "num_frames": "whole", "bfloat16": False, "sampler": SAMPLERS[kind]}
    rollout(RolloutConfig.model_validate(values), inputs, output / "rollout")
    scored = {name: inputs[name] for name in ("episodes", "tracks")}
    scored |= {"rollouts.model": output / "rollout", "segmenter": segmenter}
    evaluate_video(VideoEvaluationConfig(segmenters=("learned",), resamples=100), scored, output / "video")
    policy = PolicyEvaluationConfig(segmenter="learned", balanced=False, resamples=100)
    evaluate_policy(policy, scored, output / "policy")
    # Not ru_maxrss: a process begins with that of the one that started it.
    (peak,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    print(int(peak.split()[1]) / 1024)


@pytest.mark.slow
@pytest.mark.parametrize("kind", SAMPLERS)
def test_four_minutes_go_through_in_the_memory_of_one(inputs, tmp_path, project_root, kind):
    """1920 frames of three views against 480: of decoded frames alone 1440 more would take 19 MiB, as floats 76 MiB."""
    from tests.rollout.conftest import write_recordings  # not known where this file is run by itself

    peaks, segmenter = [], project_root / "artifacts" / "shipped" / "models" / "segmenter"
    for count in (480, 1920):
        output = tmp_path / str(count)
        made = write_recordings(output, [("a", "test", count, VIEWS, VIEWS)])
        given = inputs | made | {"checkpoint": inputs["checkpoint"].parent / kind}
        folders = json.dumps({name: str(folder) for name, folder in given.items()})
        done = subprocess.run(
            [sys.executable, __file__, str(output), kind, str(segmenter), folders], check=False, capture_output=True,
            text=True, env=os.environ | RETURNED | {"PYTHONPATH": str(project_root)},
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        peaks.append(float(done.stdout.split()[-1]))
        assert {row.view: row.num_frames for row in RolloutSet.open(output / "rollout").rows} == dict.fromkeys(
            VIEWS, count
        )
        decisions = pq.read_table(output / "policy" / "decisions.parquet")
        assert sorted(decisions["method"].to_pylist()) == ["model", "true"]
        by_frame = pq.read_table(output / "video" / "by_frame.parquet")
        assert max(by_frame["frame"].to_pylist()) == count - 1
    print(f"{kind}: {peaks[0]:.0f} MiB for one minute, {peaks[1]:.0f} MiB for four")
    assert peaks[1] - peaks[0] < 12, peaks


if __name__ == "__main__":
    folders = {name: Path(folder) for name, folder in json.loads(sys.argv[4]).items()}
    run_chain(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]), folders)
