"""The preset that makes the small world and its models from nothing, at the smallest size."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from prefect.settings import PREFECT_LOCAL_STORAGE_PATH, temporary_settings

from flows.pipeline import pipeline
from worldline_core.store.artifact_files import finished_artifacts, read_manifest

SMALL = """
extends: small_world
record:
  train:
    episodes:
      groups:
        - {embodiment: viperx_graphite, split: train, count: 4, families: [lift, press]}
        - {embodiment: viperx_graphite, split: validation, count: 2, families: [lift, press]}
  long: {episodes: {num_frames: 65, groups: [{embodiment: viperx_graphite, split: train, count: 2, families: [lift, press]}]}}
  test: {episodes: {groups: [{embodiment: viperx_graphite, split: test, count: 2, families: [lift, press]}]}}
  banks: {banks: {candidates: 2, success_range: [0, 1], banks: [{name: one, embodiment: viperx_graphite, family: press, scene: scene_12, layout: 0}]}}
curate: {near_duplicates: false, leakage: {action: "off"}}
evaluate_policy: {balanced: false}
train_tokenizer: {steps: 4, fit_clips: 4, refinement_width: 8, refinement_depth: 1, batch_size: 2}
train_segmenter: {steps: 4, batch_size: 2, widths: [8, 8]}
train_stage1:
  model: {hidden_size: 32, num_heads: 2, num_layers: 2}
  trainer: {minutes: null, steps: 2, batch_size: 2}
train_stage2: {trainer: {minutes: null, steps: 2, batch_size: 2}}
distill:
  teacher_forcing: {trainer: {minutes: null, steps: 2, batch_size: 2}, weighting: {things: [3, 0.5]}}
  trajectory_regression: {trainer: {minutes: null, steps: 1, batch_size: 2}, trajectories: {clips: 2, clips_per_shard: 2}}
  distribution_matching: {trainer: {minutes: null, steps: 6, batch_size: 2}}
"""


@pytest.mark.slow
def test_the_small_world_is_recorded_trained_and_evaluated(
    prefect_server: None, tmp_path: Path, project_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mujoco", reason="the extra `sim` is not installed")
    monkeypatch.chdir(project_root)
    (tmp_path / "small.yaml").write_text(SMALL)
    with temporary_settings({PREFECT_LOCAL_STORAGE_PATH: tmp_path / "prefect"}):
        report = pipeline(None, tmp_path / "small.yaml", (), tmp_path / "store")
    assert (report.folder / "index.html").is_file()
    steps: list[Any] = [read_manifest(folder) for folder in finished_artifacts(tmp_path / "store")]
    count = Counter(step["step"] for step in steps)
    assert count["record"] == 4
    trained = {"train_tokenizer", "train_segmenter", "train_stage1", "train_stage2", "distill"}
    assert trained | {"evaluate_planning"} <= set(count)
    (curated,) = (step for step in steps if step["step"] == "curate" and step["metrics"]["splits"].get("train"))
    assert curated["metrics"]["splits"] == {"test": 2, "train": 6, "validation": 2}
