"""Small synthetic artifacts in the formats of the steps, for tests of the report."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from worldline_core.actions.episode_tracks import EpisodeTracks, write_index, write_shard
from worldline_core.data.episodes.episode import VIEWS, CameraTrack, Episode
from worldline_core.data.episodes.episode_set import EpisodeSetWriter
from worldline_core.evaluation.policy.evaluate_policy import summarise_decisions
from worldline_core.evaluation.scores import Score, summarise, write_scores
from worldline_core.evaluation.video.evaluate_video import write_by_frame
from worldline_core.report.report import ReportConfig, report
from worldline_core.rollout.rollout_set import RolloutSetWriter
from worldline_core.store.artifact_files import write_manifest
from worldline_core.store.atomic import write_json_atomic

HOSTILE = "<script>alert('x')</script> & \"lift\" the <b>red</b> cube"
NUM_FRAMES, HEIGHT, WIDTH, FPS = 9, 64, 96, 8.0
METHODS = ("shipped_stage2", "shipped_stage2_shuffled", "shipped_causal", "stage2", "causal", "copy_first_frame")


def camera(view: str) -> CameraTrack:
    """A camera one metre before the base, looking along +x; wrist cameras move sideways."""
    rotation = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    poses = np.tile(np.eye(4), (1 if view == "head" else NUM_FRAMES, 1, 1))
    poses[:, :3, :3] = rotation
    poses[:, :3, 3] = (-1.0, 0.0, 0.3)
    if view != "head":
        poses[:, 1, 3] = np.linspace(0, 0.1, NUM_FRAMES)
    K = np.array([[90.0, 0.0, 47.5], [0.0, 90.0, 31.5], [0.0, 0.0, 1.0]])
    return CameraTrack(view, K, poses, WIDTH, HEIGHT)


def episode(name: str, embodiment: str, split: str, outcome: str, instruction: str, scene: str) -> Episode:
    """Joints that swing, in one of several scenes."""
    time = np.linspace(0, 1, NUM_FRAMES)
    state = np.stack([np.sin(time * (joint + 1)) for joint in range(14)], axis=1).astype(np.float32)
    return Episode(
        episode_id=name, source="synthetic", embodiment=embodiment, scene=scene, task_family="lift", instruction=instruction,
        outcome=outcome, split=split, fps=FPS, state=state, action=state, timestamps=np.arange(NUM_FRAMES) / FPS,
        cameras={view: camera(view) for view in VIEWS},
    )  # fmt: skip


def frames(seed: int, shift: float = 1.0, blur: int = 1) -> dict[str, np.ndarray]:
    """A bright square that moves over a checked floor, in three views."""
    generator = np.random.default_rng(seed)
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    floor = np.where(((u // 12 + v // 12) % 2)[..., None] == 1, [150, 138, 122], [118, 108, 100])
    colour = generator.integers(60, 255, 3)
    clips: dict[str, np.ndarray] = {}
    for index, view in enumerate(VIEWS):
        clip = np.repeat(floor[None], NUM_FRAMES, axis=0)
        for frame in range(NUM_FRAMES):
            left = int(10 + 20 * index + shift * frame * 4)
            clip[frame, 24:40, left : left + 16] = colour
            clip[frame, 0:24, left + 5 : left + 11] = 225
        if blur > 1:
            clip[1:] = sum(np.roll(clip[1:], shift, axis=2) for shift in range(blur)) // blur
        clips[view] = clip.astype(np.uint8)
    return clips


EPISODES = tuple(
    (
        f"{robot}-{number}",
        robot,
        split,
        "failure" if number % 2 else "success",
        HOSTILE if number == 0 else f"lift cube {number}",
        f"scene_{split}_{robot}",
    )
    for robot, split, count in (("ur5e_pair", "train", 2), ("aloha_viperx", "test", 3), ("panda_pair", "ood_test", 1))
    for number in range(count)
)


def write_episode_set(
    folder: Path, kept: tuple[tuple[str, ...], ...] = EPISODES, name: str = "broken-1", reason: str = "truncated_video"
) -> None:
    """An EpisodeSet with one quarantined input."""
    with EpisodeSetWriter(folder) as writer:
        for row in kept:
            writer.add(episode(*row), frames(EPISODES.index(row)))
        writer.quarantine(
            name, "synthetic", reason, "the file ends early: <b>12</b> of 33 frames", {"frames": 12, "expected": 33}
        )


def write_tracks(folder: Path) -> None:
    """Tracks of two arms that cross each picture."""
    tracks = []
    for name, embodiment, *_ in EPISODES:
        shape = (NUM_FRAMES, len(VIEWS), 2)
        uv = np.zeros((*shape, 2), np.float32)
        uv[..., 0, 0] = np.linspace(10, 50, NUM_FRAMES)[:, None]
        uv[..., 1, 0] = np.linspace(85, 60, NUM_FRAMES)[:, None]
        uv[..., 1] = 36
        valid = np.ones(shape, bool)
        valid[6:, 1, 0] = False
        rot6d = np.tile(np.array([1, 0, 0, 0, 0.8, 0.6], np.float32), (*shape, 1))
        tools = np.tile(np.eye(4, dtype=np.float32), (NUM_FRAMES, 2, 1, 1))
        tools[:, 0, 1, 3] = np.linspace(0.3, 0.0, NUM_FRAMES)
        cameras = np.stack([np.broadcast_to(camera(view).T_base_camera, (NUM_FRAMES, 4, 4)) for view in VIEWS], axis=1)
        tracks.append(
            EpisodeTracks(
                episode_id=name, embodiment=embodiment, views=VIEWS, arms=("left", "right"), image_size=(HEIGHT, WIDTH),
                controls="action", camera_motion=("static", "kinematics", "kinematics"), uv=uv,
                depth=np.full(shape, 0.9, np.float32), rot6d=rot6d, gripper=np.broadcast_to(np.linspace(1, 0, NUM_FRAMES, dtype=np.float32)[:, None, None], shape),
                valid=valid, T_base_tool=tools, T_base_camera=cameras.astype(np.float32), K=np.stack([camera(view).K for view in VIEWS]).astype(np.float32),
                capsules=np.zeros((NUM_FRAMES, 1, 2, 3), np.float32), capsule_radii=np.ones(1, np.float32),
            )
        )  # fmt: skip
    write_index(folder, write_shard(folder, 0, tracks), sigma_px_ref=36.0)
    numbers = {"episodes": 2, "valid": 50, "outside_image": 4}
    write_json_atomic(folder / "summary.json", {"by_embodiment": {"aloha_viperx": numbers, "ur5e_pair": numbers}})


def write_metrics(folder: Path) -> None:
    """A falling loss with held-out values, as the trainer logs them."""
    generator = np.random.default_rng(3)
    lines = []
    for step in range(1, 121):
        loss = float(0.8 * np.exp(-step / 60) + 0.1 + 0.03 * generator.standard_normal())
        lines.append(
            {"step": step, "learning_rate": 1e-4, "loss": loss, "relational_intra": loss / 9, "gradient_norm": 0.1}
        )
        if step % 30 == 0:
            names = (
                "loss",
                "loss_shuffled_actions",
                "sample_error",
                "sample_error_shuffled_actions",
                "sample_error_copy",
            )
            lines.append({"step": step} | {f"validation/{name}": loss * (1 + 0.1 * i) for i, name in enumerate(names)})
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
        wobble = 0.04 * np.sin(number * 2.1)
        for method, base in quality.items():
            for view in VIEWS:
                values = {"ssim": 0.4 + base / 2 + wobble, "psnr": 15 + 15 * base + wobble}
                if view == "head":
                    values |= {
                        "robot_iou": base + wobble + 0.02,
                        "robot_iou_exact": base + wobble,
                        "robot_iou[colour]": base + wobble - 0.1,
                        "end_effector_error_px": 9 * (1 - base),
                    }
                for metric, value in values.items():
                    scores.append(
                        Score(method, name, embodiment, split, view, 42, metric, float(value), scene, "lift", outcome)
                    )
                    drift = [
                        None if metric.startswith("robot") and f == 0 else float(value * (1 - 0.02 * f))
                        for f in range(NUM_FRAMES)
                    ]
                    by_frame.append((method, split, view, metric, drift))
        scores.append(
            Score("true", name, embodiment, split, "head", 0, "robot_iou_exact", 0.93, scene, "lift", outcome)
        )
    write_scores(folder, scores)
    write_by_frame(folder / "by_frame.parquet", by_frame)
    options = {"comparisons": None, "resamples": 200, "seed": 0, "by_view": True}
    predicted = summarise([s for s in scores if s.method != "true"], **options)
    accuracy = summarise([s for s in scores if s.method == "true"], **options)["metrics"]
    segmenter = {
        "name": "learned", "suffix": "", "description": "small U-Net trained on exact masks of training recordings",
        "accuracy_on_true_frames": {group: methods["true"] for group, methods in accuracy.items()},
    }  # fmt: skip
    summary = {
        **predicted,
        "methods": sorted(quality),
        "unavailable": {"lpips": "no weights in the configured folder"},
        "segmenters": [segmenter, {"name": "colour", "suffix": "[colour]", "description": "colour model of the arms"}],
    }
    write_json_atomic(folder / "summary.json", summary)


def write_policy_scores(folder: Path) -> None:
    """Verdicts of three methods, the recorded videos judged best."""
    rows = []
    for method, right in (("true", 9), ("shipped_stage2", 8), ("stage2", 6)):
        for number in range(10):
            outcome = "success" if number % 2 else "failure"
            wrong = {"success": "failure", "failure": "success"}[outcome]
            rows.append({
                "method": method, "episode_id": f"e{number}", "seed": 42, "split": "test", "task_family": "lift", "outcome": outcome,
                "predicted": outcome if number < right else wrong, "answers": 2, "malformed_answers": 0,
            })  # fmt: skip
    agreement = {
        name: {"value": 0.91, "over_starts_and_policies": [0.7, 0.97]} for name in ("pearson", "spearman", "mmrv")
    }
    rates = {
        "slow": {"attempts": 3, "recorded": 0.25, "predicted": None},
        "quick": {"attempts": 3, "recorded": 0.75, "predicted": 0.5},
    }
    ranked = {**agreement, "rate_error": {"value": None, "over_starts_and_policies": None}, "policies": rates}
    keys = "auroc", "calibration_error", "error", "error_of_marked", "error_of_others"
    figures = {key: {"value": 0.61, "low": 0.5, "high": 0.72} for key in keys}
    trusted = {
        "available": True,
        "verdicts": 10,
        "marked": 2,
        **figures,
        "error_of_marked": {"value": None, "low": None, "high": None},
    }
    trust = {
        "training_recordings": 55, "settings": {"novelty_level": 0.05, "least_trust": 0.6},
        "methods": {"shipped_stage2": trusted, "stage2": {"available": False, "reason": "too few wrong verdicts"}},
    }  # fmt: skip
    more = {
        "judge": "measured",
        "shorter_than_recording": {},
        "policies": {"shipped_stage2": {"all": ranked}},
        "trust": trust,
    }
    write_json_atomic(folder / "summary.json", summarise_decisions(rows, resamples=200, seed=0) | more)


def write_planning_scores(folder: Path) -> None:
    """Three banks; success grows with the number of candidates."""

    def interval(mean: float) -> dict[str, float | int]:
        return {"mean": mean, "low": mean - 0.1, "high": min(1.0, mean + 0.1), "count": 3}

    def budgets(top: float) -> dict[str, object]:
        means = {n: 0.45 + (top - 0.45) * i / 5 for i, n in enumerate((2, 4, 8, 16, 24, 32))}
        banks = {"bank_0": 1.0, "bank_1": 0.0, "bank_2": 0.4}
        return {
            str(n): {"success": interval(m) | {"std_over_banks": 0.2}, "gain": interval(m - 0.45), "banks": banks}
            | {"over_shortcut": {"shortcut": "medoid", "gain": interval(m - 0.5)}}
            for n, m in means.items()
        }

    bank = {
        "embodiment": "ur5e_pair",
        "task_family": "lift",
        "instruction": HOSTILE,
        "candidates": 32,
        "direct_success": 0.45,
    }
    methods = {
        name: {
            "budgets": budgets(top),
            "by_family": {"lift": {"2": {"success": 0.5, "gain": 0.05}, "32": {"success": top, "gain": top - 0.45}}},
        }
        for name, top in (("true", 0.95), ("banks_shipped_causal", 0.8))
    }
    summary = {"selector": "measured", "banks": {f"bank_{i}": bank for i in range(3)}, "methods": methods}
    summary |= {"direct_execution": interval(0.45), "oracle": interval(1.0 - 0.1)}
    summary["shortcuts"] = {"medoid": {str(n): interval(0.5) for n in (2, 4, 8, 16, 24, 32)}}
    write_json_atomic(folder / "summary.json", summary)


def write_rollouts(folder: Path, method: str) -> None:
    """Predictions of every held-out episode: right, lagging, or still."""
    writer = RolloutSetWriter(folder, method, FPS)
    for seed, (name, _, split, *_) in enumerate(EPISODES):
        if split == "train":
            continue
        speed = 0.2 if "shuffled" in method else 0.0 if "copy" in method else 1.0
        writer.add(name, 42, frames(seed, speed, 1 if "copy" in method else 3))
    writer.close()
    speed: dict[str, object] = {"frames": 45, "seconds": 4.5, "seconds_per_frame": 0.1, "steps": 1, "dtype": "bfloat16"}
    if "causal" in method:
        speed |= {"steps": 4, "device_name": "a slow machine"}
        # The wall says 2, because another program ran; the processor says 1.04.
        times = {"block_seconds": [0.5] * 25 + [1.0] * 25, "block_processor_seconds": [0.5] * 25 + [0.52] * 25}
        speed["long_rollout"] = times
    write_json_atomic(folder / "run" / "speed.json", speed)


@pytest.fixture(scope="session")
def hostile_text() -> str:
    """An instruction that would break a page that does not escape it."""
    return HOSTILE


@pytest.fixture(scope="session")
def run_artifacts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Artifacts of a whole run, by step."""
    return write_all(tmp_path_factory.mktemp("artifacts"))


@pytest.fixture(scope="session")
def full_report(run_artifacts: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a whole run."""
    output = tmp_path_factory.mktemp("report")
    report(ReportConfig(tile_height=64), run_artifacts, output)
    return output


def write_all(root: Path) -> dict[str, Path]:
    """Artifacts of a whole run, by step."""
    inputs = {
        name: root / name for name in ("curate", "filter", "render_actions", "train_stage1", "train_stage2", "distill")
    }
    inputs |= {
        name: root / name for name in ("evaluate_video", "evaluate_policy", "evaluate_planning", "models.tokenizer")
    }
    inputs |= {f"rollout.{method}": root / method for method in METHODS}
    write_episode_set(inputs["curate"], EPISODES)
    write_episode_set(inputs["filter"], EPISODES[1:], name=EPISODES[0][0], reason="static")
    finding = {"episode_id": EPISODES[1][0], "detector": "blur", "cut_frames": 0}
    pq.write_table(pa.Table.from_pylist([finding]), inputs["filter"] / "findings.parquet")
    write_tracks(inputs["render_actions"])
    for folder in (
        inputs["train_stage1"],
        inputs["train_stage2"],
        inputs["distill"] / "teacher_forcing",
        inputs["distill"] / "trajectory_regression",
    ):
        write_metrics(folder)
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
        "step": "curate",
        "version": 1,
        "config": {"note": HOSTILE},
        "seeds": {"seed": 7},
        "wall_seconds": 12.5,
        "resumed": False,
        "finished_at": "2026-11-21T05:00:00Z",
        "environment": {
            "python": "3.12",
            "platform": "Linux",
            "cpu_count": 2,
            "packages": {"torch": "2.11"},
            "git_commit": "abc",
        },
    }
    write_manifest(inputs["curate"], manifest)
    return inputs
