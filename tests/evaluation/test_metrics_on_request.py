"""One entry of the registry is a metric: measured when asked for, shown, and documented."""

from __future__ import annotations

import json
from pathlib import Path
from typing import cast

import numpy as np
import pyarrow.parquet as pq
import pytest

from flows.pipeline import chain
from tasks.execution.chain import outline
from worldline_core.config import load_config
from worldline_core.errors import ConfigError
from worldline_core.evaluation.evaluation_config import VideoEvaluationConfig
from worldline_core.evaluation.metric_registry import METRICS, ON_REQUEST, metric_of
from worldline_core.evaluation.video.evaluate_video import evaluate_video
from worldline_core.evaluation.video.metrics_on_request import SceneFrames, scene_consistency
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.report.context import ReportConfig, ReportContext
from worldline_core.report.results import quality_section
from worldline_core.rollout.rollout_set import RolloutSet, RolloutSetWriter

ALWAYS = VideoEvaluationConfig(segmenters=("colour",), resamples=100)


@pytest.fixture(scope="module")
def measured(recordings, tmp_path_factory) -> Path:
    """An evaluation with every metric: `good` predicts well, `copy` stands for a model that ignores changed controls."""
    root = tmp_path_factory.mktemp("on_request")
    config = ALWAYS.model_copy(
        update={
            "metrics": ON_REQUEST,
            "changed_controls": {"good": {"delayed": "copy"}},
        }
    )
    evaluate_video(VideoEvaluationConfig.model_validate(config.model_dump()), recordings.inputs, root / "out")
    return root / "out"


def test_every_metric_of_the_registry_tells_good_videos_from_bad_ones(measured):
    summary = json.loads((measured / "summary.json").read_text())
    good, copy = (summary["metrics"]["test"][method] for method in ("good", "copy"))
    assert {metric_of(name).name for name in good} | {"lpips"} == set(METRICS)  # pyright: ignore[reportOptionalMemberAccess]
    for name, metric in METRICS.items():
        if name == "lpips" or metric.needs == "changed_controls":
            continue
        key = f"{name}@head" if f"{name}@head" in good else name
        better, worse = good[key]["mean"], copy[key]["mean"]
        assert (better < worse) == metric.lower_is_better or name == "scene_consistency", name
        assert abs(better - metric.perfect) <= abs(worse - metric.perfect) or name == "scene_consistency", name
    assert good["scene_consistency@head"]["mean"] > 0.95
    assert good["action_following[delayed]@head"]["mean"] > 0.6
    assert "counterfactual_direction[delayed]@head" in good
    differences = {row["metric"]: row for row in summary["differences"]["test"]}
    for name in ("hsd", "ndtw", "dyn", "scene_consistency"):
        assert {"mean", "low", "high", "count"} <= differences[name].keys()


def test_the_report_and_the_table_of_scores_follow_from_the_registry(measured, tmp_path):
    page = str(quality_section(ReportContext(ReportConfig(), {"evaluate_video": measured}, tmp_path)).body)
    for name in ON_REQUEST:
        assert METRICS[name].heading in page
        assert METRICS[name].title in page
    tidy = pq.read_table(measured / "scores.parquet").to_pandas()
    assert {metric_of(name).name for name in tidy["metric"]} >= set(ON_REQUEST)  # pyright: ignore[reportOptionalMemberAccess]
    assert not tidy.duplicated(["method", "episode_id", "view", "seed", "metric"]).any()


def test_metrics_whose_weights_are_not_there_are_named(recordings, tmp_path):
    evaluate_video(ALWAYS.model_copy(update={"metrics": ("action_following",)}), recordings.inputs, tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert "lpips" in summary["unavailable"]
    assert "no predictions under changed controls" in summary["unavailable"]["action_following"]


def test_what_is_asked_for_must_exist(recordings, tmp_path):
    with pytest.raises(ValueError, match="No metrics on request"):
        VideoEvaluationConfig(metrics=("hsdd",))
    with pytest.raises(ValueError, match="changed_controls go with a metric"):
        VideoEvaluationConfig(changed_controls={"good": {"mirrored": "other"}})
    config = VideoEvaluationConfig(
        segmenters=("colour",), metrics=("action_following",), changed_controls={"good": {"mirrored": "unheard"}}
    )
    with pytest.raises(ConfigError, match=r"were not predicted[\s\S]*unheard"):
        evaluate_video(config, recordings.inputs, tmp_path)


def test_a_plan_asks_only_for_pairs_that_it_predicts(project_root: Path):
    config = load_config(PipelineConfig, preset="tiny")

    assert outline(chain, config)["evaluate_video"].config == config.evaluate_video
    fewer = {name: run for name, run in config.rollouts.items() if name != "shipped_stage2_shuffled"}
    calls = outline(chain, config.model_copy(update={"rollouts": fewer}))
    assert cast("VideoEvaluationConfig", calls["evaluate_video"].config).changed_controls == {}


@pytest.mark.slow
def test_controls_that_were_ignored_are_told_from_those_that_were_followed(recordings, tmp_path):
    """Under delayed controls one model predicts the delayed video, another one the same video again."""
    good = RolloutSet.open(recordings.inputs["rollouts.good"])
    inputs = dict(recordings.inputs)
    for method, delay in (("follows", 4), ("ignores", 0)):
        writer = RolloutSetWriter(tmp_path / method, method, good.fps)
        for name in good.episode_ids:
            frames = good.frames(name, "head")
            writer.add(name, good.seeds(name)[0], {"head": frames[np.maximum(np.arange(len(frames)) - delay, 0)]})
        writer.close()
        inputs[f"rollouts.{method}"] = tmp_path / method
    values = {}
    for other in ("follows", "ignores"):
        config = ALWAYS.model_copy(
            update={
                "metrics": ("action_following", "counterfactual_direction"),
                "changed_controls": {"good": {"delayed": other}},
            }
        )
        evaluate_video(config, inputs, tmp_path / f"out_{other}")
        metrics = json.loads((tmp_path / f"out_{other}/summary.json").read_text())["metrics"]["test"]["good"]
        values[other] = [metrics[f"{name}[delayed]"]["mean"] for name in config.metrics]
    assert values["follows"][0] > 0.7
    assert values["follows"][1] > 0.9
    assert values["ignores"] == pytest.approx([0.5, 0.5], abs=0.05)


def test_scenes_that_change_are_told_from_those_that_stay():
    rng = np.random.default_rng(0)
    first = cv_smooth(rng.integers(0, 256, (48, 72, 3)).astype(np.uint8))
    still = np.repeat(first[None], 3, axis=0)
    robots = np.zeros((3, 48, 72), dtype=bool)
    robots[:, 10:30, 10:30] = True
    changed = still.copy()
    changed[2, 35:45, 50:65] = 255
    behind = still.copy()
    behind[:, 12:28, 12:28] = 0
    for predicted, expected in ((still, [1, 1, 1]), (behind, [1, 1, 1])):
        assert scene_consistency(SceneFrames(still, predicted, first, first, robots)) == pytest.approx(expected)
    values = scene_consistency(SceneFrames(still, changed, first, first, robots))
    assert values[1] == pytest.approx(1.0)
    assert values[2] < 0.95  # pyright: ignore[reportOptionalOperand]
    # What moves in the recording as well is no fault of the prediction.
    assert scene_consistency(SceneFrames(changed, changed, first, first, robots))[2] == pytest.approx(1.0)
    assert scene_consistency(SceneFrames(still, still, first, first, np.ones_like(robots))) == [None, None, None]


def cv_smooth(picture: np.ndarray) -> np.ndarray:
    import cv2

    return cv2.GaussianBlur(picture, (5, 5), 1.0)
