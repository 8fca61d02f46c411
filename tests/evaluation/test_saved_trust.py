"""Trust that was calibrated where outcomes are known, on videos whose outcome nobody recorded."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest

from worldline_core.errors import ArtifactError, ConfigError
from worldline_core.evaluation.evaluation_config import PolicyEvaluationConfig, TrustConfig
from worldline_core.evaluation.policy.evaluate_policy import evaluate_policy
from worldline_core.evaluation.policy.saved_trust import TRUST_FILE, SavedTrust
from worldline_core.evaluation.policy.trust import fit_right, probability
from worldline_core.pages.page import render
from worldline_core.report.decisions import policy_evaluation

CONFIG = PolicyEvaluationConfig(
    segmenter="colour", splits=("test",), views=("head",), balanced=False, resamples=100, trust=TrustConfig()
)


@pytest.fixture(scope="module")
def calibrated(attempts, tmp_path_factory):
    """An evaluation with known outcomes."""
    output = tmp_path_factory.mktemp("calibrated")
    evaluate_policy(CONFIG, attempts[0].inputs, output)
    return output


def told(folder, method="copy"):
    rows = pq.read_table(folder / "decisions.parquet").to_pylist()
    return {row["episode_id"]: row for row in rows if row["method"] == method}


def later(calibration):
    return CONFIG.model_copy(update={"trust": TrustConfig(calibration=calibration)})


@pytest.mark.slow
def test_verdicts_without_outcomes_are_trusted_as_verdicts_with_outcomes_taught(calibrated, attempts, tmp_path):
    """A first frame repeated is judged a failure, rightly of every second attempt."""
    before = told(calibrated)
    assert evaluate_policy(later(calibrated), attempts[1].inputs, tmp_path)["accuracy"] == {}
    after = told(tmp_path)
    assert {row["outcome"] for row in after.values()} == {"unknown"}
    names = sorted(after)
    signals = np.log([
        [(before[n]["doubt"] + 0.02) / (1.02 - before[n]["doubt"]), np.clip(before[n]["new_controls"], 0.1, 10), np.clip(before[n]["new_setup"], 0.1, 10)]
        for n in names
    ])  # fmt: skip
    right = np.array([before[n]["predicted"] == before[n]["outcome"] for n in names])
    expected = probability(fit_right(signals, right), signals)
    assert [after[n]["trust"] for n in names] == pytest.approx(expected, abs=1e-9)
    assert "new controls" in after["try-29"]["do_not_trust"]
    # Of the true predictions every verdict is right: nothing could be calibrated, so nothing is claimed.
    assert {row["trust"] for row in told(tmp_path, "good").values()} == {None}
    found = json.loads((tmp_path / "summary.json").read_text())
    assert "no outcome is recorded" in found["trust"]["methods"]["copy"]["reason"]
    assert "checkpoint good" in found["trust"]["methods"]["good"]["reason"]
    assert found["methods"]["good"]["all"]["predicted_success"]["mean"] == 0.5
    assert not pq.read_table(tmp_path / "scores.parquet").num_rows
    page = render("report/policy.html", evaluations=[policy_evaluation(found, list(after.values()))])
    assert "Recordings whose outcome is not known" in page


@pytest.mark.slow
def test_a_calibration_is_held_against_new_outcomes(calibrated, attempts, tmp_path):
    evaluate_policy(later(calibrated / TRUST_FILE), attempts[0].inputs, tmp_path)
    found = json.loads((tmp_path / "summary.json").read_text())["trust"]["methods"]["copy"]
    assert (found["available"], found["verdicts"], found["error"]["value"]) == (True, 30, 0.5)
    assert not (tmp_path / TRUST_FILE).exists()


@pytest.mark.slow
def test_a_calibration_of_something_else_is_refused(calibrated, attempts, tmp_path):
    inputs = attempts[1].inputs
    with pytest.raises(ConfigError, match=r"(?s)of another judge.*left_wrist.*next step: judge as it was made"):
        evaluate_policy(later(calibrated).model_copy(update={"views": ("head", "left_wrist")}), inputs, tmp_path)
    saved = SavedTrust.read(calibrated)
    with pytest.raises(ConfigError, match=r"(?s)not made with these robots.*box_arm.*other_arm"):
        saved.require(saved.judged_by, ["box_arm", "other_arm"])
    asked = saved.methods["copy"].predicted_by.model_copy(update={"checkpoint": "d" * 64})
    assert "is of other videos than these (checkpoint dddddddddddd" in str(saved.calibration_of(asked))
    assert "videos of an unknown model" in str(saved.calibration_of(None))
    with pytest.raises(ArtifactError, match=r"(?s)no saved calibration.*run evaluate_policy with trust"):
        evaluate_policy(later(tmp_path), inputs, tmp_path)
    (tmp_path / TRUST_FILE).write_bytes((calibrated / TRUST_FILE).read_bytes()[:-9])
    with pytest.raises(ArtifactError, match="Not a saved calibration"):
        SavedTrust.read(tmp_path)
