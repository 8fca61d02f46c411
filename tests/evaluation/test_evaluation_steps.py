import json
import re
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ArtifactError, DataError
from worldline_core.evaluation.evaluation_config import PlanningConfig, PolicyEvaluationConfig, VideoEvaluationConfig
from worldline_core.evaluation.planning import evaluate_planning as outcomes
from worldline_core.evaluation.planning.evaluate_planning import CHOICES_FILE, SEALED_FILE, evaluate_planning
from worldline_core.evaluation.policy.evaluate_policy import choose_trajectories, evaluate_policy
from worldline_core.evaluation.policy.evidence import SCHEMAS, MotionEvidence, Reconciliation
from worldline_core.evaluation.video import evaluate_video as evaluate_video_module
from worldline_core.evaluation.video.evaluate_video import evaluate_video
from worldline_core.evaluation.vlm import Part, Text
from worldline_core.rollout.rollout_set import RolloutSet, RolloutSetWriter

VIDEO = VideoEvaluationConfig(segmenters=("colour",), resamples=100)
POLICY = PolicyEvaluationConfig(segmenter="colour", splits=("test",), resamples=100)
PLANNING = PlanningConfig(segmenter="colour", budgets=(2, 4, 6, 32), runs=2, resamples=100)


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and "run" not in path.relative_to(folder).parts
    }


@pytest.fixture(scope="module")
def evaluated(recordings, tmp_path_factory):
    """An evaluation of videos that nothing disturbed."""
    folder = tmp_path_factory.mktemp("evaluated")
    assert evaluate_video(VIDEO, recordings.inputs, folder)["methods"] == ["copy", "good"]
    return folder


@pytest.mark.parametrize(
    ("floor", "camera", "reason"),
    [(-1.0, "static", None), (0.7, "static", r"box_arm: its masks .* by 0\.\d\d \(of"), (-1.0, "absent", "unchecked")],
)
def test_a_segmenter_without_exact_masks_is_measured_first(
    recordings, tmp_path, monkeypatch, floor: float, camera: str, reason: str | None
) -> None:
    monkeypatch.setattr(EpisodeSet, "robot_masks", lambda *_: None)
    monkeypatch.setattr(evaluate_video_module, "MIN_SEGMENTER_IOU", floor)
    tracks = ActionTracks.tracks
    monkeypatch.setattr(ActionTracks, "tracks", lambda self, i: replace(tracks(self, i), camera_motion=(camera,) * 3))
    evaluate_video(VIDEO, recordings.inputs, tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    frames = set(pq.read_table(tmp_path / "by_frame.parquet")["metric"].to_pylist())
    assert ("robot_iou_kinematic" in frames) == (camera == "static")
    assert ("robot_iou" in frames) == ("robot_iou" in summary["metrics"]["test"]["good"]) == (reason is None)
    assert reason is None or re.search(reason, summary["unavailable"]["robot_iou"])


def test_video_metrics_prefer_the_right_videos(evaluated):
    summary = json.loads((evaluated / "summary.json").read_text())
    good, copy = summary["metrics"]["test"]["good"], summary["metrics"]["test"]["copy"]
    assert good["robot_iou_exact"]["mean"] > 0.8 > copy["robot_iou_exact"]["mean"]
    assert good["robot_iou"]["mean"] > 0.9
    assert good["ssim"]["mean"] > copy["ssim"]["mean"]
    assert good["end_effector_error_px"]["mean"] < 1 < copy["end_effector_error_px"]["mean"]
    assert set(summary["metrics"]) == {"test", "test/box_arm", "test/success", "test/failure"}
    assert "psnr@left_wrist" in good
    difference = next(
        row for row in summary["differences"]["test"] if row["metric"] == "robot_iou_exact" and row["first"] == "copy"
    )
    assert difference["second"] == "good"
    assert difference["mean"] == pytest.approx(copy["robot_iou_exact"]["mean"] - good["robot_iou_exact"]["mean"])
    accuracy = summary["segmenters"][0]["accuracy_on_true_frames"]["test"]["robot_iou_exact"]
    assert accuracy["mean"] > 0.8
    # Of four attempts the cube moves in the two that succeed.
    assert good["object_iou_exact"]["mean"] > 0.8 > 0.2 > copy["object_iou_exact"]["mean"]
    assert good["object_iou_exact"]["count"] == 2
    assert summary["segmenters"][0]["accuracy_on_true_frames"]["test"]["object_iou_exact"]["mean"] > 0.8
    assert "LPIPS is not available" in summary["unavailable"]["lpips"]
    assert "lpips" not in pq.read_table(evaluated / "scores.parquet")["metric"].to_pylist()
    by_frame = pq.read_table(evaluated / "by_frame.parquet").to_pylist()
    first = [row["mean"] for row in by_frame if (row["method"], row["metric"], row["frame"]) == ("copy", "psnr", 0)]
    assert min(first) > 30  # the conditioning frame counts


def test_videos_are_compared_with_videos_without_action_tracks(recordings, evaluated, tmp_path):
    """Plain mp4s beside plain mp4s: full-frame metrics need no states, cameras or segmenter."""
    inputs = {name: path for name, path in recordings.inputs.items() if name not in ("tracks", "segmenter")}
    evaluate_video(VideoEvaluationConfig(resamples=100, metrics=("hsd", "scene_consistency")), inputs, tmp_path)
    found, full = (json.loads((folder / "summary.json").read_text()) for folder in (tmp_path, evaluated))
    means, whole = (summary["metrics"]["test"]["good"] for summary in (found, full))
    assert {name.partition("@")[0] for name in means} == {"psnr", "ssim"}
    assert means["psnr"] == whole["psnr"]
    for name in ("robot_iou", "end_effector_error_px", "hsd", "scene_consistency"):
        assert "have no action tracks" in found["unavailable"][name]


def test_interrupted_evaluation_ends_with_the_same_bytes(recordings, evaluated, tmp_path):
    shutil.copytree(evaluated, tmp_path / "again")
    parts = sorted((tmp_path / "again/run/parts").rglob("*.json"))
    for path in [*parts[::2], tmp_path / "again/scores.parquet", tmp_path / "again/summary.json"]:
        path.unlink()
    written = {path: path.stat().st_mtime_ns for path in parts[1::2]}
    assert len(written) >= 4
    evaluate_video(VIDEO, recordings.inputs, tmp_path / "again")
    assert {path: path.stat().st_mtime_ns for path in written} == written  # what was there is not measured again
    assert contents(evaluated) == contents(tmp_path / "again")


@pytest.mark.slow
def test_names_of_episodes_and_banks_never_become_names_of_files(oddly_named, tmp_path):
    recordings, bank = oddly_named
    _seal(bank.inputs["banks"], bank.outcomes)
    steps: Any = (
        (evaluate_video, VIDEO, recordings), (evaluate_policy, POLICY, recordings),
        (evaluate_planning, PLANNING.model_copy(update={"budgets": (2, 4)}), bank),
    )  # fmt: skip
    for step, config, world in steps:
        output = tmp_path / "store" / step.__name__ / "key"
        step(config, world.inputs, output)
        parts = [
            path for path in (output / "run" / "parts").iterdir() if re.fullmatch(r"[0-9a-f]{32}\.json", path.name)
        ]
        assert len(parts) >= 3
    assert {path.name for path in tmp_path.iterdir()} == {"store"}
    assert not list(tmp_path.rglob("*outside*"))
    assert not list(Path("/tmp").glob("outside*"))


def test_predictions_of_unknown_episodes_are_refused(recordings, bank, tmp_path):
    inputs = recordings.inputs | {"rollouts.other": bank.inputs["rollouts.good"]}
    with pytest.raises(DataError, match="not in the EpisodeSet"):
        evaluate_video(VIDEO, inputs, tmp_path)
    without = {name: path for name, path in recordings.inputs.items() if not name.startswith("rollouts")}
    with pytest.raises(ArtifactError, match="No predicted videos"):
        evaluate_video(VIDEO, without, tmp_path)


def test_policy_accuracy_against_recorded_outcomes(recordings, tmp_path):
    result = evaluate_policy(POLICY, recordings.inputs, tmp_path)
    assert result["accuracy"] == {"copy": 0.5, "good": 1.0, "true": 1.0}
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["trajectories"] == 4
    assert summary["methods"]["copy"]["test/lift"]["confusion"] == {
        "true_success": 0, "false_success": 0, "true_failure": 2, "false_failure": 2,
    }  # fmt: skip
    decisions = pq.read_table(tmp_path / "decisions.parquet").to_pylist()
    evidence = json.loads(decisions[0]["evidence"])
    assert "head_view_confirms_target_displacement" in evidence[0]


def test_nothing_to_judge_is_an_error_that_says_why(recordings, tmp_path):
    with pytest.raises(DataError, match=r"No video can be judged[\s\S]*4 in other splits[\s\S]*evaluate_policy: null"):
        evaluate_policy(POLICY.model_copy(update={"splits": ("nowhere",)}), recordings.inputs, tmp_path / "none")
    counts = evaluate_policy(POLICY.model_copy(update={"max_per_group": 1}), recordings.inputs, tmp_path / "few")
    assert (counts["found"], counts["kept"]) == (4, 2)
    assert {reason: count for reason, count in counts["left_out"].items() if count} == {
        "not drawn (evaluate_policy.balanced, max_per_group)": 2
    }


def test_nothing_to_measure_is_an_error_that_says_why(recordings, tmp_path):
    without_views = VIDEO.model_copy(update={"views": ()})
    with pytest.raises(DataError, match=r"No prediction could be measured"):
        evaluate_video(without_views, recordings.inputs, tmp_path)


def test_no_bank_large_enough_is_an_error(sealed, tmp_path):
    with pytest.raises(DataError, match=r"enough candidates[\s\S]*at least 32[\s\S]*up to 6"):
        evaluate_planning(PLANNING.model_copy(update={"budgets": (32,)}), sealed, tmp_path)


@pytest.mark.parametrize(
    ("changes", "counts"), [({}, (4, 4)), ({"balanced": False}, (5, 4)), ({"max_per_group": 1}, (1, 1))]
)
def test_as_many_successes_as_failures_are_judged(policies, changes, counts):
    """Of nine attempts five succeed."""
    rows = EpisodeSet.open(policies.inputs["episodes"]).rows
    chosen = choose_trajectories(POLICY.model_copy(update=changes), rows, Counter())
    found = Counter(row.outcome for row in chosen)
    assert (found["success"], found["failure"]) == counts


@pytest.mark.slow
def test_a_method_with_few_videos_narrows_no_other_method(recordings, tmp_path):
    good = RolloutSet.open(recordings.inputs["rollouts.good"])
    few = RolloutSetWriter(tmp_path / "few", "few", 8.0)
    for name in ("ep-2", "ep-3"):
        few.add(name, 0, {view: good.frames(name, view, 0) for view in ("head", "left_wrist", "right_wrist")})
    few.close()
    inputs = recordings.inputs | {"rollouts.few": tmp_path / "few"}
    evaluate_policy(POLICY, inputs, tmp_path / "all")
    summary = json.loads((tmp_path / "all/summary.json").read_text())
    counts = {method: groups["all"]["accuracy"]["count"] for method, groups in summary["methods"].items()}
    assert counts == {"copy": 4, "few": 2, "good": 4, "true": 4}
    # Where fewer are asked for, those that every method predicted come first.
    limited = POLICY.model_copy(update={"max_per_group": 1})
    evaluate_policy(limited, inputs, tmp_path / "limited")
    rows = pq.read_table(tmp_path / "limited/decisions.parquet").to_pylist()
    assert {row["episode_id"] for row in rows} == {"ep-2", "ep-3"}


def _seal(folder: Path, labels: dict[str, str]) -> None:
    table = pa.table({"episode_id": list(labels), "outcome": list(labels.values())})
    pq.write_table(table, folder / SEALED_FILE)


@pytest.fixture
def sealed(bank, tmp_path):
    banks = tmp_path / "banks"
    shutil.copytree(bank.inputs["banks"], banks)
    _seal(banks, bank.outcomes)
    return bank.inputs | {"banks": banks}


def test_planning_chooses_by_predicted_videos(sealed, tmp_path):
    result = evaluate_planning(PLANNING, sealed, tmp_path / "out")
    summary = json.loads((tmp_path / "out/summary.json").read_text())
    assert result["direct_execution"] == pytest.approx(1 / 6)
    budgets = summary["methods"]["good"]["budgets"]
    assert set(budgets) == {"2", "4", "6"}  # 32 is more than the bank has
    choices = pq.read_table(tmp_path / "out" / CHOICES_FILE).to_pylist()
    recorded_order = {c["budget"]: c["episode_id"] for c in choices if (c["method"], c["run"]) == ("good", 0)}
    assert recorded_order[2] in ("cand-0", "cand-1")  # prefixes of the recorded order
    assert recorded_order[4] in ("cand-0", "cand-1", "cand-2", "cand-3")
    assert recorded_order[6] == "cand-4"
    assert budgets["6"]["success"]["mean"] == 1.0
    assert budgets["6"]["success"]["std_over_runs"] == 0.0
    assert budgets["6"]["gain"]["mean"] == pytest.approx(5 / 6)
    assert summary["methods"]["true"]["budgets"]["6"]["success"]["mean"] == 1.0
    assert summary["oracle"]["mean"] == 1.0
    assert set(summary["methods"]) == {"true", "good", "copy"}
    best = max(summary["shortcuts"].items(), key=lambda item: item[1]["6"]["mean"])
    over = budgets["6"]["over_shortcut"]
    assert summary["shortcuts"][over["shortcut"]]["6"]["mean"] == best[1]["6"]["mean"]
    assert over["gain"]["mean"] == pytest.approx(1.0 - best[1]["6"]["mean"])


def test_labels_are_opened_only_after_every_choice_is_on_disk(sealed, tmp_path, monkeypatch):
    opened = []
    read = outcomes.read_outcomes

    def watched(path, episode_ids):
        choices = pq.read_table(tmp_path / "out" / CHOICES_FILE).to_pylist()
        opened.append({(row["method"], row["budget"]) for row in choices})
        return read(path, episode_ids)

    monkeypatch.setattr(outcomes, "read_outcomes", watched)
    evaluate_planning(PLANNING, sealed, tmp_path / "out")
    shortcuts = ("shortcut_medoid", "shortcut_nearest_hand", "shortcut_hand_rule")
    assert opened == [{(method, budget) for method in ("true", "good", "copy", *shortcuts) for budget in (2, 4, 6)}]


def test_choices_do_not_depend_on_labels(bank, sealed, tmp_path):
    evaluate_planning(PLANNING, sealed, tmp_path / "one")
    flipped = {name: "failure" if label == "success" else "success" for name, label in bank.outcomes.items()}
    _seal(sealed["banks"], flipped)
    evaluate_planning(PLANNING, sealed, tmp_path / "two")
    assert (tmp_path / "one" / CHOICES_FILE).read_bytes() == (tmp_path / "two" / CHOICES_FILE).read_bytes()
    (sealed["banks"] / SEALED_FILE).unlink()
    with pytest.raises(ArtifactError, match="no sealed outcomes"):
        evaluate_planning(PLANNING, sealed, tmp_path / "three")
    assert (tmp_path / "three" / CHOICES_FILE).read_bytes() == (tmp_path / "one" / CHOICES_FILE).read_bytes()


def test_candidates_without_a_label_are_named(sealed, tmp_path):
    _seal(sealed["banks"], {"cand-0": "success"})
    with pytest.raises(DataError, match="without a sealed outcome"):
        evaluate_planning(PLANNING, sealed, tmp_path / "out")


def test_ordinary_recordings_are_no_bank(recordings, tmp_path):
    inputs = {name: path for name, path in recordings.inputs.items() if name != "episodes"}
    with pytest.raises(DataError, match="no candidate"):
        evaluate_planning(PLANNING, inputs | {"banks": recordings.inputs["episodes"]}, tmp_path)


ODD = {
    "half character": '"observations": "\\ud800 \\u001b[2J", "reason": "\\udfff"',
    "endless confidence": '"confidence": 1e999',
    "no number": '"confidence": NaN',
    "4,000 digits": '"confidence": ' + "9" * 4000,
}


class OddJudge:
    """States failures (and middling scores) with something odd beside them."""

    name = "odd"

    def __init__(self, odd: str) -> None:
        self._facts = ", ".join(
            f'"{key}": false'
            for schema in (*SCHEMAS.values(), Reconciliation, MotionEvidence)
            for key in schema.REQUIRED
        )
        self._odd, self.asked = odd, ""

    def answer(self, parts: Sequence[Part]) -> str:
        self.asked += "".join(part.text for part in parts if isinstance(part, Text))
        return f'{{{self._facts}, "wrong_object_or_drop": null, "selected_labels": ["A", "B", "\\ud800"], "score": 50, {self._odd}}}'


@pytest.mark.parametrize("odd", ODD.values(), ids=ODD)
def test_odd_values_of_a_judge_go_through_the_whole_step(recordings, tmp_path, monkeypatch, odd):
    judge, seen = OddJudge(odd), r"\ud800 \x1b[2J" if "observations" in odd else ""
    monkeypatch.setattr("worldline_core.evaluation.policy.evaluate_policy.open_vlm", lambda kind, config: judge)
    evaluate_policy(POLICY.model_copy(update={"judge": "openai"}), recordings.inputs, tmp_path)
    judge.asked.encode()  # a tokenizer takes nothing else
    rows = pq.read_table(tmp_path / "decisions.parquet").to_pylist()
    assert len(rows) == 3 * 4  # two methods and the recordings
    for row in rows:
        assert (row["answers"], row["malformed_answers"], row["predicted"]) == (3, 0, "failure")
        evidence = json.loads(row["evidence"])
        json.dumps(evidence, allow_nan=False, ensure_ascii=False).encode()
        assert len(evidence) == 3
        assert {statement.get("confidence", 0.0) for statement in evidence} == {0.0}
        assert {statement["observations"] for statement in evidence} == {seen}
