"""Predictions of fewer views, at a stride, and of videos of more than one piece."""

import json

import pyarrow.parquet as pq
import pytest

from worldline_core.data.video.frames import VideoFrames, pieces
from worldline_core.errors import DataError
from worldline_core.evaluation.evaluation_config import PolicyEvaluationConfig, VideoEvaluationConfig
from worldline_core.evaluation.policy.evaluate_policy import evaluate_policy
from worldline_core.evaluation.video import episode_measurement
from worldline_core.evaluation.video.evaluate_video import evaluate_video
from worldline_core.rollout.rollout_set import RolloutSet, RolloutSetWriter

VIDEO = VideoEvaluationConfig(segmenters=("colour",), resamples=100)
POLICY = PolicyEvaluationConfig(segmenter="colour", splits=("test",), resamples=100)


def rewritten(recordings, folder, source, *, views=("head", "left_wrist", "right_wrist"), stride=1, fps=8.0):
    """A method's predictions again, in some views, every so-many-th frame."""
    made = RolloutSet.open(recordings.inputs[f"rollouts.{source}"])
    writer = RolloutSetWriter(folder, folder.name, fps)
    for name in made.episode_ids:
        writer.add(name, 0, {view: made.frames(name, view, 0)[::stride] for view in views})
    writer.close()
    return {f"rollouts.{folder.name}": folder}


def summary(folder):
    return json.loads((folder / "summary.json").read_text())


def test_methods_are_compared_over_the_views_that_both_predicted(recordings, tmp_path):
    inputs = recordings.inputs | rewritten(recordings, tmp_path / "head_only", "copy", views=("head",))
    evaluate_video(VIDEO, inputs, tmp_path / "out")
    found = summary(tmp_path / "out")
    only, good = found["metrics"]["test"]["head_only"], found["metrics"]["test"]["good"]
    assert {name for name in only if name.startswith("psnr")} == {"psnr", "psnr@head"}
    assert only["psnr@head"]["count"] == good["psnr@left_wrist"]["count"] == 4
    rows = {(row["first"], row["second"], row["metric"]): row for row in found["differences"]["test"]}
    pooled, head = (rows["good", "head_only", name] for name in ("ssim", "ssim@head"))
    assert pooled["mean"] == pytest.approx(head["mean"])
    assert pooled["mean"] != pytest.approx(good["ssim"]["mean"] - only["ssim"]["mean"], abs=1e-3)
    # Where both have the same views, all of them count, as before.
    both = rows["copy", "good", "ssim"]
    copy = found["metrics"]["test"]["copy"]
    assert both["mean"] == pytest.approx(copy["ssim"]["mean"] - good["ssim"]["mean"])


def test_strided_predictions_are_compared_with_every_second_frame(recordings, tmp_path):
    inputs = {name: path for name, path in recordings.inputs.items() if not name.startswith("rollouts.")}
    inputs |= rewritten(recordings, tmp_path / "strided", "good", stride=2, fps=4.0)
    evaluate_video(VIDEO, inputs, tmp_path / "out")
    good = summary(tmp_path / "out")["metrics"]["test"]["strided"]
    assert good["robot_iou_exact"]["mean"] > 0.8
    assert good["end_effector_error_px"]["mean"] < 1
    assert good["object_iou_exact"]["mean"] > 0.8
    by_frame = pq.read_table(tmp_path / "out" / "by_frame.parquet").to_pylist()
    assert max(row["frame"] for row in by_frame if row["method"] == "strided") == 8
    # 9 frames at half the rate reach the end of 17.
    assert evaluate_policy(POLICY, inputs, tmp_path / "policy")["accuracy"]["strided"] == 1.0
    wrong = inputs | rewritten(recordings, tmp_path / "wrong", "good", fps=3.0)
    with pytest.raises(DataError, match=r"(?s)another frame rate than their recording.*8 frames per second"):
        evaluate_video(VIDEO, wrong, tmp_path / "refused")


def test_the_pieces_that_videos_are_read_in_change_no_value(recordings, tmp_path, monkeypatch):
    evaluate_video(VIDEO, recordings.inputs, tmp_path / "whole")
    monkeypatch.setattr(episode_measurement, "PIECE_FRAMES", 8)
    evaluate_video(VIDEO, recordings.inputs, tmp_path / "pieces")
    for name in ("scores.parquet", "by_frame.parquet", "summary.json"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "pieces" / name).read_bytes()


def test_longer_predictions_than_recordings_and_missing_frames_are_named(recordings, tmp_path):
    made = RolloutSet.open(recordings.inputs["rollouts.good"])
    longer = RolloutSetWriter(tmp_path / "longer", "longer", 8.0)
    frames = made.frames("ep-0", "head", 0)
    longer.add("ep-0", 0, {"head": frames[[*range(17), 16]]})
    longer.close()
    with pytest.raises(DataError, match=r"(?s)longer than its recording.*<= 17.*got: 18"):
        evaluate_video(VIDEO, recordings.inputs | {"rollouts.longer": tmp_path / "longer"}, tmp_path / "out")
    video = VideoFrames(made.clip("ep-0", "head"), stride=4)
    assert (len(video), video[[0, 4]].shape[0]) == (5, 2)
    assert [len(piece) for piece in pieces(video, 2)] == [2, 2, 1]
    assert (video[[4]][0] == frames[16]).all()
