"""Small synthetic artifacts in the formats of the steps, for tests of the report."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.data.conftest import Sample, make_sample  # pyright: ignore[reportMissingImports]
from tests.training.conftest import build_tracks  # pyright: ignore[reportMissingImports]
from worldline_core.actions.episode_tracks import write_index, write_shard
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_set import EpisodeSetWriter
from worldline_core.evaluation.policy.evaluate_policy import summarise_decisions
from worldline_core.evaluation.scores import Score, summarise, write_scores
from worldline_core.evaluation.video.evaluate_video import write_by_frame
from worldline_core.pictures import png_bytes
from worldline_core.report.report import ReportConfig, report
from worldline_core.rollout.rollout_set import RolloutSetWriter
from worldline_core.store.artifact_files import write_manifest
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic

HOSTILE = "<script>alert('x')</script> & \"lift\" the <b>red</b> cube"
NUM_FRAMES, HEIGHT, WIDTH, FPS = 9, 64, 96, 8.0
METHODS = ("shipped_stage2", "shipped_stage2_shuffled", "shipped_causal", "stage2", "causal", "copy_first_frame")


def sample(name: str, embodiment: str, split: str, outcome: str, instruction: str, scene: str) -> Sample:
    """Joints that swing, in one of several scenes, before colours that move."""
    named = {"episode_id": name, "embodiment": embodiment, "split": split, "outcome": outcome}
    return make_sample(
        sum(name.encode()) % 40, height=HEIGHT, width=WIDTH, instruction=instruction, scene=scene, **named
    )


COUNTS = (("ur5e_pair", "train", 2), ("aloha_viperx", "test", 3), ("panda_pair", "ood_test", 1))
EPISODES = tuple(
    (
        f"{robot}-{n}", robot, split, ("success", "failure")[n % 2], f"lift cube {n}" if n else HOSTILE,
        f"scene_{split}_{robot}",
    )
    for robot, split, count in COUNTS
    for n in range(count)
)  # fmt: skip


def write_episode_set(
    folder: Path, kept: tuple[tuple[str, ...], ...] = EPISODES, name: str = "broken-1", reason: str = "truncated_video"
) -> None:
    """An EpisodeSet with one quarantined input."""
    evidence = {"frames": 12, "expected": 33}
    with EpisodeSetWriter(folder) as writer:
        for row in kept:
            writer.add(*sample(*row)[:2])
        writer.quarantine(name, "synthetic", reason, "the file ends early: <b>12</b> of 33 frames", evidence)


def write_tracks(folder: Path) -> None:
    """Tracks of two arms that cross each picture."""
    n, shape = NUM_FRAMES, (NUM_FRAMES, len(VIEWS), 2)
    uv = np.full((*shape, 2), 36, np.float32)
    uv[..., 0, 0] = np.linspace(10, 50, n)[:, None]
    uv[..., 1, 0] = np.linspace(85, 60, n)[:, None]
    valid = np.ones(shape, bool)
    valid[6:, 1, 0] = False
    tools = np.tile(np.eye(4, dtype=np.float32), (n, 2, 1, 1))
    tools[:, 0, 1, 3] = np.linspace(0.3, 0.0, n)
    moved = {
        "image_size": (HEIGHT, WIDTH), "camera_motion": ("static", "kinematics", "kinematics"), "uv": uv, "valid": valid,
        "depth": np.full(shape, 0.9, np.float32), "T_base_tool": tools,
        "rot6d": np.tile(np.array([1, 0, 0, 0, 0.8, 0.6], np.float32), (*shape, 1)),
        "gripper": np.tile(np.linspace(1, 0, n, dtype=np.float32)[:, None, None], (1, len(VIEWS), 2)),
    }  # fmt: skip
    tracks = []
    for row in EPISODES:
        cameras = [sample(*row)[0].cameras[view] for view in VIEWS]
        K = np.stack([camera.K for camera in cameras]).astype(np.float32)
        poses = np.stack([np.broadcast_to(camera.T_base_camera, (n, 4, 4)) for camera in cameras], axis=1)
        own = {"embodiment": row[1], "K": K, "T_base_camera": poses.astype(np.float32)}
        tracks.append(build_tracks(row[0], n, 2, **moved, **own))
    write_index(folder, write_shard(folder, 0, tracks), sigma_px_ref=36.0)
    write_bytes_atomic(folder / "previews" / "0.png", png_bytes(np.full((HEIGHT, WIDTH, 3), 90, np.uint8)))


def write_metrics(folder: Path) -> None:
    """A falling loss with held-out values, as the trainer logs them."""
    generator = np.random.default_rng(3)
    lines = []
    errors = ("loss", "loss_shuffled_actions", "sample_error", "sample_error_shuffled_actions", "sample_error_copy")
    for step in range(1, 121):
        loss = float(0.8 * np.exp(-step / 60) + 0.1 + 0.03 * generator.standard_normal())
        values = {"learning_rate": 1e-4, "loss": loss, "relational_intra": loss / 9, "gradient_norm": 0.1}
        lines.append({"step": step} | values)
        if step % 30 == 0:
            lines.append({"step": step} | {f"validation/{name}": loss * (1 + i / 10) for i, name in enumerate(errors)})
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "metrics.jsonl").write_text("\n".join(json.dumps(line) for line in lines) + "\n")


def write_video_scores(folder: Path) -> None:
    """Scores whose order of methods is known: long-trained above short-trained above baselines."""
    quality = dict(zip(METHODS, (0.62, 0.41, 0.58, 0.37, 0.33, 0.36), strict=True))
    scores: list[Score] = []
    by_frame = []
    for number, (name, embodiment, split, outcome, _, scene) in enumerate(EPISODES):
        if split == "train":
            continue
        more = (scene, "lift", outcome)
        wobble = 0.04 * np.sin(number * 2.1)
        for (method, base), view in itertools.product(quality.items(), VIEWS):
            values = {"ssim": 0.4 + base / 2 + wobble, "psnr": 15 + 15 * base + wobble}
            if view == "head":
                iou = base + wobble
                values |= {"robot_iou": iou + 0.02, "robot_iou_exact": iou, "robot_iou[colour]": iou - 0.1}
                values["end_effector_error_px"] = 9 * (1 - base)
            for metric, value in values.items():
                scores.append(Score(method, name, embodiment, split, view, 42, metric, float(value), *more))
                drift: list[float | None] = [float(value * (1 - 0.02 * f)) for f in range(NUM_FRAMES)]
                by_frame.append((method, split, view, metric, [None, *drift[1:]] if "robot" in metric else drift))
        scores.append(Score("true", name, embodiment, split, "head", 0, "robot_iou_exact", 0.93, *more))
    write_scores(folder, scores)
    write_by_frame(folder / "by_frame.parquet", by_frame)
    options = {"resamples": 200, "seed": 0, "by_view": True}
    accuracy = summarise([s for s in scores if s.method == "true"], **options)["metrics"]
    segmenter = {
        "name": "learned", "suffix": "", "description": "small U-Net trained on exact masks of training recordings",
        "accuracy_on_true_frames": {group: methods["true"] for group, methods in accuracy.items()},
    }  # fmt: skip
    summary = summarise([s for s in scores if s.method != "true"], **options) | {
        "methods": sorted(quality), "unavailable": {"lpips": "no weights in the configured folder"},
        "segmenters": [segmenter, {**segmenter, "name": "colour", "suffix": "[colour]", "description": "colour model"}],
    }  # fmt: skip
    write_json_atomic(folder / "summary.json", summary)


def write_evaluation(folder: Path, scores: list[Score]) -> dict[str, Path]:
    """An evaluation of videos with these scores, as an input."""
    folder.mkdir(parents=True)
    write_scores(folder, scores)
    write_json_atomic(folder / "summary.json", summarise(scores, resamples=100, seed=0, by_view=True))
    return {"evaluate_video": folder}


def write_policy_scores(folder: Path) -> None:
    """Verdicts of three methods, the recorded videos judged best."""
    outcomes = ("failure", "success")
    rows = [
        {
            "method": method, "episode_id": f"e{number}", "seed": 42, "split": "test", "task_family": "lift",
            "outcome": outcomes[number % 2], "predicted": outcomes[(number + (number >= right)) % 2],
            "answers": 2, "malformed_answers": 0, "undecided": method == "stage2" and number < 4,
        }
        for method, right in (("true", 9), ("shipped_stage2", 8), ("stage2", 6))
        for number in range(10)
    ]  # fmt: skip
    ranked = {
        **{name: {"value": 0.91, "over_starts_and_policies": [0.7, 0.97]} for name in ("pearson", "spearman", "mmrv")},
        "rate_error": {"value": None, "over_starts_and_policies": None},
        "policies": {
            "slow": {"attempts": 3, "recorded": 0.25, "predicted": None},
            "quick": {"attempts": 3, "recorded": 0.75, "predicted": 0.5},
        },
    }
    keys = ("auroc", "calibration_error", "error", "error_of_others")
    trusted: dict[str, Any] = {key: {"value": 0.61, "low": 0.5, "high": 0.72} for key in keys}
    trusted["error_of_marked"] = {"value": None, "low": None, "high": None}
    methods = {
        "shipped_stage2": {"available": True, "verdicts": 10, "marked": 2, **trusted},
        "stage2": {"available": False, "reason": "too few wrong verdicts"},
    }
    settings = {"novelty_level": 0.05, "least_trust": 0.6}
    more = {
        "judge": "measured", "shorter_than_recording": {}, "policies": {"shipped_stage2": {"all": ranked}},
        "trust": {"training_recordings": 55, "settings": settings, "methods": methods},
    }  # fmt: skip
    write_json_atomic(
        folder / "summary.json",
        summarise_decisions(
            rows, {"trees_commands": {f"e{n}": (n % 2 == 0) == (n < 8) for n in range(10)}}, resamples=200, seed=0
        )
        | more,
    )


def write_planning_scores(folder: Path) -> None:
    """Three banks; success grows with the number of candidates."""
    numbers = (2, 4, 8, 16, 24, 32)

    def interval(mean: float) -> dict[str, float | int]:
        return {"mean": mean, "low": mean - 0.1, "high": min(1.0, mean + 0.1), "count": 3}

    def budget(mean: float) -> dict[str, object]:
        return {
            "success": interval(mean), "gain": interval(mean - 0.45),
            "banks": {"bank_0": 1.0, "bank_1": 0.0, "bank_2": 0.4},
            "over_shortcut": {"shortcut": "medoid", "gain": interval(mean - 0.5)},
        }  # fmt: skip

    methods = {
        name: {
            "budgets": {str(n): budget(0.45 + (top - 0.45) * i / 5) for i, n in enumerate(numbers)},
            "by_family": {"lift": {"2": {"success": {"mean": 0.5}}, "32": {"success": {"mean": top}}}},
        }
        for name, top in (("true", 0.95), ("banks_shipped_causal", 0.8))
    }
    summary = {
        "selector": "measured", "methods": methods, "direct_execution": interval(0.45), "oracle": interval(0.9),
        "banks": {f"bank_{i}": {"task_family": "lift", "candidates": 32, "direct_success": 0.45} for i in range(3)},
        "shortcuts": {"medoid": {str(n): interval(0.5) for n in numbers}},
        "areas": {"methods": {"true": {"all": interval(0.87), "lift": interval(0.87)}}, "shortcuts": {}},
    }  # fmt: skip
    write_json_atomic(folder / "summary.json", summary)


def write_rollouts(folder: Path, method: str) -> None:
    """Predictions of every held-out episode: right, lagging, or still."""
    pace = 0.2 if "shuffled" in method else 0.0 if "copy" in method else 1.0
    shown = (pace * np.arange(NUM_FRAMES)).astype(int)
    writer = RolloutSetWriter(folder, method, FPS)
    for row in EPISODES:
        if row[2] != "train":
            writer.add(row[0], 42, {view: clip[shown] for view, clip in sample(*row)[1].items()})
    writer.close()
    speed: dict[str, object] = {"frames": 45, "seconds": 4.5, "seconds_per_frame": 0.1, "steps": 1, "dtype": "bfloat16"}
    if "causal" in method:
        speed |= {"steps": 4, "device_name": "a slow machine"}
    write_json_atomic(folder / "run" / "speed.json", speed)


@pytest.fixture(scope="session")
def hostile_text() -> str:
    """An instruction that would break a page that does not escape it."""
    return HOSTILE


@pytest.fixture(scope="session")
def run_artifacts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Artifacts of a whole run, by step."""
    root = tmp_path_factory.mktemp("artifacts")
    names = (
        "curate", "filter", "render_actions", "train_stage1", "train_stage2", "distill",
        "evaluate_video", "evaluate_policy", "evaluate_planning", "models.tokenizer",
    )  # fmt: skip
    inputs = {name: root / name for name in names} | {f"rollout.{method}": root / method for method in METHODS}
    write_episode_set(inputs["curate"], EPISODES, name=HOSTILE)
    write_episode_set(inputs["filter"], EPISODES[1:], name=EPISODES[0][0], reason=HOSTILE)
    finding = {"episode_id": EPISODES[1][0], "detector": HOSTILE, "cut_frames": 3}
    pq.write_table(pa.Table.from_pylist([finding]), inputs["filter"] / "findings.parquet")
    write_tracks(inputs["render_actions"])
    stages = ("train_stage1", "train_stage2", "distill/teacher_forcing", "distill/trajectory_regression")
    for stage in stages:
        write_metrics(root / stage)
    write_video_scores(inputs["evaluate_video"])
    write_policy_scores(inputs["evaluate_policy"])
    write_planning_scores(inputs["evaluate_planning"])
    inputs["models.tokenizer"].mkdir()
    (inputs["models.tokenizer"] / "MODEL_CARD.md").write_text(
        f"# Tokenizer\n\nA **small** one, `train_tokenizer`.\n\n- seed 0\n\n| metric | value |\n|---|---|\n| PSNR | {HOSTILE} |\n"
    )
    for method in METHODS:
        write_rollouts(inputs[f"rollout.{method}"], method)
    manifest = {
        "step": "curate", "version": 1, "config": {"note": HOSTILE}, "seeds": {"seed": 7}, "wall_seconds": 12.5,
        "resumed": False, "finished_at": "2026-11-21T05:00:00Z",
        "environment": {
            "python": "3.12", "platform": "Linux", "cpu_count": 2, "packages": {"torch": "2.11"}, "git_commit": "abc",
        },
    }  # fmt: skip
    write_manifest(inputs["curate"], manifest)
    return inputs


@pytest.fixture(scope="session")
def full_report(run_artifacts: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a whole run."""
    output = tmp_path_factory.mktemp("report")
    report(ReportConfig(tile_height=64), run_artifacts, output)
    return output
