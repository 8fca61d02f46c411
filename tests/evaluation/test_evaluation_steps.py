"""The steps of evaluation end to end on a small world with known outcomes."""

import itertools
import json
import re
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from flows.pipeline import chain
from tasks.execution.chain import outline
from tests.evaluation.conftest import EVERY, POLICY, VIDEO
from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.config import load_config
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.video.frames import VideoFrames, pieces
from worldline_core.errors import ArtifactError, ConfigError, DataError
from worldline_core.evaluation.evaluation_config import PlanningConfig, VideoEvaluationConfig
from worldline_core.evaluation.metric_registry import METRICS, ON_REQUEST, metric_of
from worldline_core.evaluation.metrics import SceneFrames, scene_consistency
from worldline_core.evaluation.planning import evaluate_planning as outcomes
from worldline_core.evaluation.planning.evaluate_planning import (
    CANDIDATE_SCORES_FILE,
    CHOICES_FILE,
    SEALED_FILE,
    evaluate_planning,
)
from worldline_core.evaluation.policy.evaluate_policy import choose_trajectories, evaluate_policy
from worldline_core.evaluation.policy.judge import SCHEMAS, MotionEvidence, Reconciliation
from worldline_core.evaluation.scores import SCORES_FILE, area_under_curve
from worldline_core.evaluation.video import episode_measurement
from worldline_core.evaluation.video import evaluate_video as evaluate_video_module
from worldline_core.evaluation.video.evaluate_video import evaluate_video
from worldline_core.evaluation.vlm import Text
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.report.context import ReportConfig, ReportContext
from worldline_core.report.results import quality_section
from worldline_core.rollout.rollout_set import RolloutSet, RolloutSetWriter
from worldline_core.store.artifact_files import digest_folder

PLANNING = PlanningConfig(segmenter="colour", budgets=(2, 4, 6, 32), runs=2, resamples=100)


def summary_of(folder):
    return json.loads((folder / "summary.json").read_text())


def measure(inputs, output, config=VIDEO, **changes):
    """The summary of an evaluation of videos, and the means of each method in the test split."""
    evaluate_video(config.model_copy(update=changes), inputs, output)
    found = summary_of(output)
    return found, found["metrics"]["test"]


@pytest.fixture(scope="module")
def few(recordings, tmp_path_factory):
    """Inputs for what one method and two recordings show."""
    made = rewritten(recordings, tmp_path_factory.mktemp("few") / "good", names=("ep-0", "ep-1"))
    return {name: path for name, path in recordings.inputs.items() if not name.startswith("rollouts.")} | made


def differences_of(summary):
    return {(row["first"], row["second"], row["metric"]): row["mean"] for row in summary["differences"]["test"]}


def rewritten(
    world, output, change=lambda frames: frames, *, source="good", names=None, views=("head", "right_wrist"), fps=8.0
):
    """A method's predictions again, changed, of some episodes and views: its entry among inputs."""
    made, writer = RolloutSet.open(world.inputs[f"rollouts.{source}"]), RolloutSetWriter(output, output.name, fps)
    for name in names or made.episode_ids:
        writer.add(name, 0, {view: change(made.frames(name, view, 0)) for view in views})
    writer.close()
    return {f"rollouts.{output.name}": output}


@pytest.mark.parametrize(
    ("floor", "camera", "reason"),
    [
        pytest.param(-1.0, "static", None, marks=pytest.mark.slow),
        (0.7, "static", r"box_arm: its masks .* by 0\.\d\d \(of"),
        (-1.0, "absent", "unchecked"),
    ],
)
def test_a_segmenter_without_exact_masks_is_measured_first(few, tmp_path, monkeypatch, floor, camera, reason):
    monkeypatch.setattr(EpisodeSet, "robot_masks", lambda *_: None)
    monkeypatch.setattr(evaluate_video_module, "MIN_SEGMENTER_IOU", floor)
    tracks = ActionTracks.tracks
    monkeypatch.setattr(ActionTracks, "tracks", lambda self, i: replace(tracks(self, i), camera_motion=(camera,) * 3))
    summary, means = measure(few, tmp_path, views=("head",))
    frames = set(pq.read_table(tmp_path / "by_frame.parquet")["metric"].to_pylist())
    assert ("robot_iou_kinematic" in frames) == (camera == "static")
    assert ("robot_iou" in frames) == ("robot_iou" in means["good"]) == (reason is None)
    assert reason is None or re.search(reason, summary["unavailable"]["robot_iou"])


def test_every_metric_of_the_registry_tells_good_videos_from_bad_ones_and_is_shown(evaluated, tmp_path):
    summary = summary_of(evaluated)
    good, copy = (summary["metrics"]["test"][method] for method in ("good", "copy"))
    assert {metric_of(name).name for name in good} | {"lpips", "invented_motion"} == set(METRICS)  # no thing stays here
    for name, metric in METRICS.items():
        if name in ("lpips", "scene_consistency", "sharpness", "invented_motion") or metric.needs == "changed_controls":
            continue
        key = f"{name}@head" if f"{name}@head" in good else name
        better, worse = good[key]["mean"], copy[key]["mean"]
        assert (better < worse) == metric.lower_is_better, name
        assert abs(better - metric.perfect) <= abs(worse - metric.perfect), name
    assert good["robot_iou_exact"]["mean"] > 0.8 > copy["robot_iou_exact"]["mean"]
    assert min(good[n]["mean"] for n in ("robot_iou", "scene_consistency@head", "sharpness@head")) > 0.9
    assert good["end_effector_error_px"]["mean"] < 1 < copy["end_effector_error_px"]["mean"]
    # Of four attempts the cube moves in the two that succeed.
    assert good["object_iou_exact"]["mean"] > 0.8 > 0.2 > copy["object_iou_exact"]["mean"]
    assert good["object_iou_exact"]["count"] == 2
    assert good["action_following[delayed]@head"]["mean"] > 0.6
    assert good.keys() >= {"counterfactual_direction[delayed]@head", "psnr@right_wrist"}
    assert set(summary["metrics"]) == {"test", "test/box_arm", "test/success", "test/failure"}
    differences = differences_of(summary)
    difference = copy["robot_iou_exact"]["mean"] - good["robot_iou_exact"]["mean"]
    assert differences["copy", "good", "robot_iou_exact"] == pytest.approx(difference)
    assert {metric for *_, metric in differences} >= {"hsd", "ndtw", "dyn", "scene_consistency"}
    accuracy = summary["segmenters"][0]["accuracy_on_true_frames"]["test"]
    assert min(accuracy[name]["mean"] for name in ("robot_iou_exact", "object_iou_exact")) > 0.8
    assert "LPIPS is not available" in summary["unavailable"]["lpips"]
    tidy = pq.read_table(evaluated / "scores.parquet").to_pandas()
    assert {*ON_REQUEST} <= {metric_of(name).name for name in tidy["metric"]} <= {*METRICS} - {"lpips"}
    assert not tidy.duplicated(["method", "episode_id", "view", "seed", "metric"]).any()
    by_frame = pq.read_table(evaluated / "by_frame.parquet").to_pylist()
    first = [row["mean"] for row in by_frame if (row["method"], row["metric"], row["frame"]) == ("copy", "psnr", 0)]
    assert min(first) > 30  # the conditioning frame counts
    page = str(quality_section(ReportContext(ReportConfig(), {"evaluate_video": evaluated}, tmp_path)).body)
    assert all(METRICS[name].heading in page and METRICS[name].title in page for name in ON_REQUEST)


def test_videos_are_compared_with_videos_without_action_tracks(recordings, evaluated, tmp_path):
    """Plain mp4s beside plain mp4s: full frames, and what moves most, need no states, cameras or segmenter."""
    inputs = {name: path for name, path in recordings.inputs.items() if name not in ("tracks", "segmenter")}
    config = VideoEvaluationConfig(resamples=100, metrics=("hsd", "scene_consistency"))
    found, means = measure(inputs, tmp_path, config)
    assert {name.partition("@")[0] for name in means["good"]} == {"psnr", "ssim", "sharpness", "end_effector_error_px"}
    assert means["good"]["end_effector_error_px"]["mean"] < 1 < means["copy"]["end_effector_error_px"]["mean"]
    assert means["good"]["psnr"] == summary_of(evaluated)["metrics"]["test"]["good"]["psnr"]
    for name in ("robot_iou", "hsd", "scene_consistency"):
        assert "have no action tracks" in found["unavailable"][name]


@pytest.mark.slow
def test_interrupted_evaluation_ends_with_the_same_bytes(recordings, evaluated, tmp_path, monkeypatch):
    again = shutil.copytree(evaluated, tmp_path / "again")
    parts = sorted((again / "run/parts").rglob("*.json"))
    for path in [*parts[::2], again / "scores.parquet", again / "summary.json"]:
        path.unlink()
    written = {path: path.stat().st_mtime_ns for path in parts[1::2]}
    assert len(written) >= 4
    monkeypatch.setattr(episode_measurement, "PIECE_FRAMES", 8)  # the pieces that videos are read in change no value
    evaluate_video(EVERY, recordings.inputs, again)
    assert {path: path.stat().st_mtime_ns for path in written} == written  # what was there is not measured again
    assert digest_folder(evaluated) == digest_folder(again)


@pytest.mark.slow
def test_names_of_episodes_and_banks_never_become_names_of_files(oddly_named, tmp_path):
    recordings, bank = oddly_named
    _seal(bank.inputs["banks"], bank.outcomes)
    steps = (
        (evaluate_video, VIDEO, recordings), (evaluate_policy, POLICY, recordings),
        (evaluate_planning, PLANNING.model_copy(update={"budgets": (2, 4)}), bank),
    )  # fmt: skip
    for step, config, world in steps:
        output = tmp_path / "store" / step.__name__ / "key"
        step(config, world.inputs, output)
        parts = (output / "run" / "parts").iterdir()
        assert sum(re.fullmatch(r"[0-9a-f]{32}\.json", path.name) is not None for path in parts) >= 3
    assert {path.name for path in tmp_path.iterdir()} == {"store"}
    assert not list(tmp_path.rglob("*outside*"))
    assert not list(Path("/tmp").glob("outside*"))


def test_what_cannot_be_measured_is_refused(few, recordings, bank, tmp_path):
    without = {name: path for name, path in few.items() if not name.startswith("rollouts.")}
    longer = rewritten(recordings, tmp_path / "longer", lambda frames: frames[[*range(17), 16]], names=("ep-0",))
    wrong = rewritten(recordings, tmp_path / "wrong", names=("ep-0",), fps=3.0)
    for config, given, error, message in (
        (VIDEO, few | {"rollouts.other": bank.inputs["rollouts.good"]}, DataError, "not in the EpisodeSet"),
        (VIDEO, without, ArtifactError, "No predicted videos"),
        (VIDEO.model_copy(update={"views": ()}), few, DataError, "No prediction could be measured"),
        (VIDEO, without | wrong, DataError, "another frame rate than their recording.*8 frames per second"),
        (VIDEO, without | longer, DataError, "longer than its recording.*<= 17.*got: 18"),
    ):
        with pytest.raises(error, match=f"(?s){message}"):
            evaluate_video(config, given, tmp_path / "refused")
    made = RolloutSet.open(recordings.inputs["rollouts.good"])
    video = VideoFrames(made.clip("ep-0", "head"), stride=4)
    assert (len(video), [len(piece) for piece in pieces(video, 2)]) == (5, [2, 2, 1])
    assert (video[[4]][0] == made.frames("ep-0", "head", 0)[16]).all()


def test_policy_accuracy_against_recorded_outcomes(recordings, tmp_path):
    inputs = recordings.inputs | rewritten(recordings, tmp_path / "copy", source="copy", names=("ep-0", "ep-1", "ep-2"))
    del inputs["rollouts.good"]
    counts = evaluate_policy(POLICY, inputs, tmp_path / "three")
    assert (counts["found"], counts["kept"]) == (3, 2)
    assert {reason: count for reason, count in counts["left_out"].items() if count} == {
        "not drawn (evaluate_policy.balanced)": 1
    }
    counts = evaluate_policy(POLICY, recordings.inputs, tmp_path)
    assert counts["accuracy"] == {"copy": 0.5, "good": 1.0, "true": 1.0}
    summary = summary_of(tmp_path)
    assert summary["trajectories"] == 4
    assert summary["methods"]["copy"]["test/lift"]["confusion"] == {
        "true_success": 0, "false_success": 0, "true_failure": 2, "false_failure": 2,
    }  # fmt: skip
    over = summary["methods"]["good"]["all"]["over_shortcut"]
    best = max(found["all"]["mean"] for found in summary["shortcuts"].values())
    assert summary["shortcuts"][over["shortcut"]]["all"]["mean"] == best == 1.0 - over["gain"]["mean"]
    assert summary["shortcuts"]["one_verdict"]["all"]["mean"] == 0.5 <= best  # a gain is never over less than guessing
    evidence = pq.read_table(tmp_path / "decisions.parquet")["evidence"][0].as_py()
    assert "head_view_confirms_target_displacement" in json.loads(evidence)[0]
    with pytest.raises(DataError, match=r"No video can be judged[\s\S]*4 in other splits[\s\S]*evaluate_policy: null"):
        evaluate_policy(POLICY.model_copy(update={"splits": ("nowhere",)}), recordings.inputs, tmp_path / "none")


@pytest.mark.parametrize(("balanced", "successes"), [(True, {*"1234"}), (False, {*"01234"})])
def test_as_many_successes_as_failures_are_judged_first_those_that_every_method_predicted(
    recordings, balanced, successes
):
    """Five of nine attempts succeed; one of two methods predicted number 0."""
    row = EpisodeSet.open(recordings.inputs["episodes"]).rows[0]
    rows = [replace(row, episode_id=f"{n}", outcome=("failure", "success")[n < 5]) for n in range(9)]
    times = Counter({f"{n}": 1 + (n > 0) for n in range(9)})
    chosen = choose_trajectories(POLICY.model_copy(update={"balanced": balanced}), rows, times)
    assert {row.episode_id for row in chosen} == successes | {*"5678"}


@pytest.mark.slow
def test_a_method_with_few_videos_narrows_no_other_method(recordings, tmp_path):
    inputs = recordings.inputs | rewritten(recordings, tmp_path / "few", names=("ep-2", "ep-3"))
    evaluate_policy(POLICY, inputs, tmp_path / "all")
    methods = summary_of(tmp_path / "all")["methods"]
    counts = {method: groups["all"]["accuracy"]["count"] for method, groups in methods.items()}
    assert counts == {"copy": 4, "few": 2, "good": 4, "true": 4}


def _seal(folder, labels):
    table = pa.table({"episode_id": list(labels), "outcome": list(labels.values())})
    pq.write_table(table, folder / SEALED_FILE)


@pytest.fixture(scope="module")
def planned(bank, tmp_path_factory):
    """Inputs with sealed labels, the folder, the result, and the choices on the disk at each opening of the labels."""
    root, opened, read = tmp_path_factory.mktemp("planned"), [], outcomes.read_outcomes
    shutil.copytree(bank.inputs["banks"], root / "banks")
    _seal(root / "banks", bank.outcomes)
    inputs = bank.inputs | {"banks": root / "banks"}

    def watched(path, episode_ids):
        choices = pq.read_table(root / "out" / CHOICES_FILE).to_pylist()
        opened.append({(row["method"], row["budget"]) for row in choices})
        return read(path, episode_ids)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(outcomes, "read_outcomes", watched)
        return inputs, root / "out", evaluate_planning(PLANNING, inputs, root / "out"), opened


def test_planning_chooses_by_predicted_videos(planned):
    _, output, result, opened = planned
    shortcuts = ("shortcut_medoid", "shortcut_nearest_hand", "shortcut_hand_rule")
    # The labels are opened once, when every choice is on the disk; 32 is more than the bank has.
    assert opened == [{(method, budget) for method in ("true", "good", "copy", *shortcuts) for budget in (2, 4, 6)}]
    assert result["direct_execution"] == pytest.approx(1 / 6)
    choices = pq.read_table(output / CHOICES_FILE).to_pylist()
    recorded_order = {c["budget"]: c["episode_id"] for c in choices if (c["method"], c["run"]) == ("good", 0)}
    assert recorded_order[2] in ("cand-0", "cand-1")  # prefixes of the recorded order
    assert recorded_order[4] in ("cand-0", "cand-1", "cand-2", "cand-3")
    assert recorded_order[6] == "cand-4"
    summary = summary_of(output)
    assert set(summary["methods"]) == {"true", "good", "copy"}
    budgets = summary["methods"]["good"]["budgets"]
    assert set(budgets) == {"2", "4", "6"}
    assert budgets["6"]["success"]["mean"] == 1.0
    assert budgets["6"]["gain"]["mean"] == pytest.approx(5 / 6)
    assert summary["methods"]["true"]["budgets"]["6"]["success"]["mean"] == summary["oracle"]["mean"] == 1.0
    best, over = max(found["6"]["mean"] for found in summary["shortcuts"].values()), budgets["6"]["over_shortcut"]
    assert summary["shortcuts"][over["shortcut"]]["6"]["mean"] == best
    assert over["gain"]["mean"] == pytest.approx(1.0 - best)
    # The fifth candidate alone succeeds, and alone looks like it; in a copied first frame all look the same.
    areas = summary["areas"]["methods"]
    assert {name: areas[name]["all"]["mean"] for name in areas} == {"true": 1.0, "good": 1.0, "copy": 0.5}
    of_banks = [row for row in pq.read_table(output / SCORES_FILE).to_pylist() if row["metric"] == "area"]
    assert {(row["method"], row["value"]) for row in of_banks} >= {("true", 1.0), ("good", 1.0), ("copy", 0.5)}
    scored = pq.read_table(output / CANDIDATE_SCORES_FILE).to_pylist()
    of_good = {row["episode_id"]: row["value"] for row in scored if row["method"] == "good"}
    assert len(of_good) == 6
    assert max(of_good, key=of_good.__getitem__) == "cand-4"


@pytest.mark.parametrize(
    ("scores", "ends", "area"),
    [
        ([3, 2, 1], [True, False, False], 1.0),
        ([1, 2, 3], [True, False, False], 0.0),
        ([2, 2, 1, 3], [True, False, True, False], 0.125),
        ([1, 2], [True, True], np.nan),
    ],
)
def test_the_area_counts_pairs_of_a_success_and_a_failure(scores, ends, area):
    assert area_under_curve(scores, ends) == pytest.approx(area, nan_ok=True)


@pytest.mark.slow
def test_choices_do_not_depend_on_labels(planned, bank, recordings, tmp_path):
    inputs, output, *_ = planned
    made = inputs | {"banks": shutil.copytree(inputs["banks"], tmp_path / "banks")}
    _seal(
        made["banks"], {name: "failure" if label == "success" else "success" for name, label in bank.outcomes.items()}
    )
    evaluate_planning(PLANNING, made, tmp_path / "flipped")
    (made["banks"] / SEALED_FILE).unlink()
    with pytest.raises(ArtifactError, match="no sealed outcomes"):
        evaluate_planning(PLANNING, made, tmp_path / "unsealed")
    for folder in ("flipped", "unsealed"):
        assert (tmp_path / folder / CHOICES_FILE).read_bytes() == (output / CHOICES_FILE).read_bytes()
    _seal(made["banks"], {"cand-0": "success"})
    no_bank = {name: path for name, path in recordings.inputs.items() if name != "episodes"}
    cases = (
        (PLANNING, made, "without a sealed outcome"),
        (PLANNING, no_bank | {"banks": recordings.inputs["episodes"]}, "no candidate"),
        (PLANNING.model_copy(update={"budgets": (32,)}), inputs, r"enough candidates[\s\S]*at least 32[\s\S]*up to 6"),
    )
    for number, (config, given, message) in enumerate(cases):
        with pytest.raises(DataError, match=message):
            evaluate_planning(config, given, tmp_path / str(number))


ODD = (  # half a character, an endless confidence, no number, 4,000 digits
    '"observations": "\\ud800 \\u001b[2J", "reason": "\\udfff"',
    '"confidence": 1e999',
    '"confidence": NaN',
    '"confidence": ' + "9" * 4000,
)


class OddJudge:
    """States failures (and middling scores), each time with another odd thing beside them."""

    name = "odd"

    def __init__(self):
        schemas = (*SCHEMAS.values(), Reconciliation, MotionEvidence)
        self._facts = ", ".join(f'"{key}": false' for schema in schemas for key in schema.REQUIRED)
        self._odd, self.asked = itertools.cycle(ODD), ""

    def answer(self, parts):
        self.asked += "".join(part.text for part in parts if isinstance(part, Text))
        return f'{{{self._facts}, "wrong_object_or_drop": null, "selected_labels": ["A", "B", "\\ud800"], "score": 50, {next(self._odd)}}}'


@pytest.mark.slow
def test_odd_values_of_a_judge_go_through_the_whole_step(recordings, tmp_path, monkeypatch):
    judge, seen = OddJudge(), set()
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
        seen.update(statement["observations"] for statement in evidence)
    assert seen == {"", r"\ud800 \x1b[2J"}


@pytest.mark.slow
def test_methods_are_compared_over_the_views_that_both_predicted(recordings, tmp_path):
    inputs = recordings.inputs | rewritten(recordings, tmp_path / "head_only", source="copy", views=("head",))
    found, means = measure(inputs, tmp_path / "out")
    only, good, copy = (means[name] for name in ("head_only", "good", "copy"))
    assert {name for name in only if name.startswith("psnr")} == {"psnr", "psnr@head"}
    assert only["psnr@head"]["count"] == good["psnr@right_wrist"]["count"] == 4
    rows = differences_of(found)
    assert rows["good", "head_only", "ssim"] == pytest.approx(rows["good", "head_only", "ssim@head"])
    assert rows["good", "head_only", "ssim"] != pytest.approx(good["ssim"]["mean"] - only["ssim"]["mean"], abs=1e-3)
    # Where both have the same views, all of them count, as before.
    assert rows["copy", "good", "ssim"] == pytest.approx(copy["ssim"]["mean"] - good["ssim"]["mean"])


@pytest.mark.slow
def test_strided_predictions_are_compared_with_every_second_frame(recordings, tmp_path):
    inputs = {name: path for name, path in recordings.inputs.items() if not name.startswith("rollouts.")}
    inputs |= rewritten(recordings, tmp_path / "strided", lambda frames: frames[::2], fps=4.0)
    good = measure(inputs, tmp_path / "out", views=("head",))[1]["strided"]
    assert good["robot_iou_exact"]["mean"] > 0.8 and good["object_iou_exact"]["mean"] > 0.8
    assert good["end_effector_error_px"]["mean"] < 1
    by_frame = pq.read_table(tmp_path / "out" / "by_frame.parquet").to_pylist()
    assert max(row["frame"] for row in by_frame if row["method"] == "strided") == 8
    # 9 frames at half the rate reach the end of 17.
    assert evaluate_policy(POLICY, inputs, tmp_path / "policy")["accuracy"]["strided"] == 1.0


def test_what_is_asked_for_must_exist(few, tmp_path):
    asked = {"metrics": ("action_following",)}
    found, _ = measure(few, tmp_path / "none", views=("head",), **asked)
    assert {"lpips", "action_following"} <= set(found["unavailable"])
    for values, message in (
        ({"metrics": ("hsdd",)}, "No metrics on request"),
        ({"changed_controls": {"good": {"mirrored": "other"}}}, "changed_controls go with a metric"),
    ):
        with pytest.raises(ValueError, match=message):
            VideoEvaluationConfig(**values)
    with pytest.raises(ConfigError, match=r"were not predicted[\s\S]*unheard"):
        measure(few, tmp_path, **asked, changed_controls={"good": {"mirrored": "unheard"}})
    # A plan asks only for pairs that it predicts.
    config = load_config(PipelineConfig, preset="tiny")
    assert outline(chain, config)["evaluate_video"].config == config.evaluate_video
    fewer = {name: run for name, run in config.rollouts.items() if name != "shipped_stage2_shuffled"}
    calls = outline(chain, config.model_copy(update={"rollouts": fewer}))
    assert calls["evaluate_video"].config.changed_controls == {}


@pytest.mark.slow
def test_controls_that_were_ignored_are_told_from_those_that_were_followed(recordings, tmp_path):
    """Under delayed controls one model predicts the delayed video, another one the same video again."""
    inputs, values = dict(recordings.inputs), {}
    for method, delay in (("follows", 4), ("ignores", 0)):
        late = lambda frames, delay=delay: frames[np.maximum(np.arange(len(frames)) - delay, 0)]  # noqa: E731
        inputs |= rewritten(recordings, tmp_path / method, late, views=("head",))
    names = ("action_following", "counterfactual_direction")
    for other in ("follows", "ignores"):
        changes = {"metrics": names, "changed_controls": {"good": {"delayed": other}}}
        _, means = measure(inputs, tmp_path / f"out_{other}", **changes)
        values[other] = [means["good"][f"{name}[delayed]"]["mean"] for name in names]
    assert values["follows"][0] > 0.7 and values["follows"][1] > 0.9
    assert values["ignores"] == pytest.approx([0.5, 0.5], abs=0.05)


def test_scenes_that_change_are_told_from_those_that_stay():
    rng = np.random.default_rng(0)
    first = cv2.GaussianBlur(rng.integers(0, 256, (48, 72, 3)).astype(np.uint8), (5, 5), 1.0)
    still, robots = np.repeat(first[None], 3, axis=0), np.zeros((3, 48, 72), dtype=bool)
    changed, behind = still.copy(), still.copy()
    robots[:, 10:30, 10:30], changed[2, 35:45, 50:65], behind[:, 12:28, 12:28] = True, 255, 0
    # What is behind the robot does not count; what moves in the recording as well is no fault of the prediction.
    for recorded, predicted in ((still, still), (still, behind), (changed, changed)):
        found = scene_consistency(SceneFrames(recorded, predicted, first, first, robots))
        assert found == pytest.approx([1, 1, 1])
    values = scene_consistency(SceneFrames(still, changed, first, first, robots))
    assert values[1] == pytest.approx(1.0) and values[2] < 0.95
    assert scene_consistency(SceneFrames(still, still, first, first, np.ones_like(robots))) == [None, None, None]
