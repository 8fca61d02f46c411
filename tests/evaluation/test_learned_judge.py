"""The learned judge: trained on recorded outcomes, calibrated, undecided within its band, used by both evaluations."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from tests.evaluation.conftest import POLICY, _write  # pyright: ignore[reportMissingImports]
from tests.evaluation.test_evaluation_steps import summary_of  # pyright: ignore[reportMissingImports]
from tests.training.conftest import write_tokenizer  # pyright: ignore[reportMissingImports]
from worldline_core.errors import ArtifactError, ConfigError, DataError
from worldline_core.evaluation.evaluation_config import JudgeConfig, PlanningConfig
from worldline_core.evaluation.planning.bracket import learned_selector, shown_video
from worldline_core.evaluation.planning.evaluate_planning import open_selector
from worldline_core.evaluation.policy import learned_judge
from worldline_core.evaluation.policy.evaluate_policy import evaluate_policy
from worldline_core.evaluation.recordings import Trajectory
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.store.artifact_files import digest_folder

CONFIG = JudgeConfig(
    widths=(8, 16), steps=40, batch_size=8, checkpoint_every=40, image_size=(24, 36), learning_rate=3e-3
)
LEARNED = POLICY.model_copy(update={"judge": "learned"})


@pytest.fixture(scope="module")
def attempts(tmp_path_factory):
    """Attempts to learn from and four to calibrate on."""
    cases = {f"ep-{number}": number % 2 == 0 for number in range(4)}
    return _write(tmp_path_factory.mktemp("attempts"), cases, split="validation", bank=None, training=12).inputs


@pytest.fixture(scope="module")
def judge(attempts, tmp_path_factory):
    folder = tmp_path_factory.mktemp("judge")
    counts = learned_judge.train_judge(CONFIG, attempts, folder)
    assert (counts["found"], counts["kept"]) == (16, 16)
    return folder


def test_outcomes_are_learned_and_verdicts_without_confidence_counted(judge, recordings, tmp_path):
    described = json.loads((judge / "judge.json").read_text())
    assert (described["verbs"], described["words"]) == (["lift"], ["cube", "lift", "the"])
    assert described["validation"]["accuracy"] == 1.0
    (judge / "judge.json").write_text(json.dumps(described | {"margin": 0.0}))
    inputs = recordings.inputs | {"judge": judge}
    accuracy = evaluate_policy(LEARNED, inputs, tmp_path / "sure")["accuracy"]
    assert (accuracy["good"], accuracy["true"]) == (1.0, 1.0)
    (judge / "judge.json").write_text(json.dumps(described | {"margin": 0.5}))
    evaluate_policy(LEARNED, inputs, tmp_path / "undecided")
    for folder, expected in (
        ("sure", {"share": 0.0, "accuracy_of_decided": 1.0}),
        ("undecided", {"share": 1.0, "accuracy_of_decided": None}),
    ):
        found = summary_of(tmp_path / folder)["methods"]["true"]["all"]
        assert (found["accuracy"]["mean"], found["undecided"]) == (1.0, expected)
    assert set(pq.read_table(tmp_path / "undecided/decisions.parquet")["undecided"].to_pylist()) == {True}
    (judge / "judge.json").write_text(json.dumps(described))


def test_a_task_without_a_known_verb_is_undecided_and_not_chosen_in(judge):
    frames = {"head": np.zeros((9, 24, 36, 3), np.uint8)}
    opened = learned_judge.LearnedJudge.load(judge)
    verdict = opened.judge(Trajectory("fold the red cloth", frames, 8.0))
    assert (verdict.success, verdict.undecided) == (False, True)
    selector = learned_selector(opened)
    with pytest.raises(DataError, match=r"does not know this task[\s\S]*lift[\s\S]*fold"):
        selector.score("fold the red cloth", shown_video(Trajectory("fold", frames, 8.0)))
    assert 0 <= selector.score("gently lift a cube", shown_video(Trajectory("lift", frames, 8.0)))[0] <= 100


@pytest.mark.parametrize(
    ("probability", "right", "margin"),
    [((0.9, 0.2, 0.6, 0.45), (1, 1, 1, 1), 0.0), ((0.9, 0.2, 0.6, 0.45), (1, 1, 0, 1), 0.1), ((0.9, 0.2), (0, 0), 0.5)],
)
def test_the_band_is_the_smallest_that_leaves_the_rest_right(probability, right, margin):
    values = np.array(probability)
    success = (values > 0.5) == np.array(right, bool)
    assert learned_judge.undecided_margin(values, success, 0.97) == pytest.approx(margin)


def test_calibration_finds_the_scale_of_the_logits():
    random = np.random.default_rng(0)
    logits = random.normal(0, 2, 4000)
    success = random.uniform(size=4000) < 1 / (1 + np.exp(-(0.5 * logits + 0.7)))
    assert learned_judge.calibrate(logits, success) == pytest.approx((0.5, 0.7), abs=0.1)


def test_mirrored_videos_change_their_wrists(attempts):
    pictures, shown = torch.full((64, 3, 4, 5, 8, 12), 0.5), torch.tensor([[1.0, 1.0, 0.0]]).repeat(64, 1)
    seen, views = learned_judge.augment(pictures, shown, torch.Generator().manual_seed(0))
    assert 16 < int(views[:, 2].sum()) < 48
    assert torch.equal(seen.abs().amax(dim=(2, 3, 4, 5)) > 0, views > 0)


def test_what_a_judge_lacks_is_named(attempts, recordings, tmp_path):
    for opened in (
        lambda: open_selector(PlanningConfig(selector="learned"), {}),
        lambda: evaluate_policy(LEARNED, attempts, tmp_path),
    ):
        with pytest.raises(ArtifactError, match=r"learned judge has no weights[\s\S]*train_judge"):
            opened()
    with pytest.raises(ArtifactError, match="Not a trained judge"):
        learned_judge.LearnedJudge.load(tmp_path)
    with pytest.raises(DataError, match=r"split train does not have both outcomes[\s\S]*curate\.splits"):
        learned_judge.train_judge(CONFIG, recordings.inputs, tmp_path)
    with pytest.raises(ConfigError, match=r"evaluate_policy\.judge: learned: models\.judge or train_judge"):
        PipelineConfig.load("tiny", None, ("evaluate_policy.judge=learned",))


@pytest.mark.parametrize(
    "change",
    [{"widths": [8, 10**9]}, {"words": ["lift"]}, {"margin": float("nan")}, {"scale": -1}, {"image_size": [10**9, 2]}],
    ids=str,
)
def test_a_description_that_fits_no_weights_is_refused(change, judge):
    path, kept = judge / "judge.json", (judge / "judge.json").read_text()
    path.write_text(json.dumps(json.loads(kept) | change))
    with pytest.raises(ArtifactError, match="judge cannot be read"):
        learned_judge.LearnedJudge.load(judge)
    path.write_text(kept)


@pytest.mark.slow
def test_killed_training_with_a_tokenizer_continues_to_the_same_bytes(attempts, tmp_path, killed_after):
    config = CONFIG.model_copy(update={"image_size": (32, 48), "steps": 4, "checkpoint_every": 1})
    inputs = attempts | {"tokenizer": write_tokenizer(tmp_path / "tokenizer")}
    whole, resumed = tmp_path / "whole", tmp_path / "resumed"
    learned_judge.train_judge(config, inputs, whole)
    with killed_after(2):
        learned_judge.train_judge(config, inputs, resumed)
    learned_judge.train_judge(config, inputs, resumed)
    assert digest_folder(whole) == digest_folder(resumed)
