"""LeRobot's own commands, unmodified: a policy trained on the shipped recordings, evaluated inside the simulator."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("lerobot")

POLICY = (
    "--policy.type=act", "--policy.device=cpu", "--policy.push_to_hub=false", "--policy.chunk_size=16", "--policy.n_action_steps=16",
    "--policy.dim_model=64", "--policy.n_heads=2", "--policy.dim_feedforward=128", "--policy.n_encoder_layers=1",
    "--policy.use_vae=false", "--policy.pretrained_backbone_weights=null",
)  # fmt: skip


def lerobot(project_root: Path, folder: Path, command: str, *arguments: str) -> None:
    """Run a command of LeRobot as a user would, with the plug-in installed and no hub."""
    plugin = project_root / "packaging" / "lerobot_env_worldline"
    # What an installation leaves for LeRobot to find the plug-in by.
    installed = folder / "site" / "lerobot_env_worldline-0.1.0.dist-info"
    installed.mkdir(parents=True, exist_ok=True)
    (installed / "METADATA").write_text("Metadata-Version: 2.1\nName: lerobot_env_worldline\nVersion: 0.1.0\n")
    paths = [str(project_root), str(plugin), str(installed.parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    settings = {
        "PYTHONPATH": os.pathsep.join(paths),
        "HF_HUB_OFFLINE": "1",
        "HF_HOME": str(folder / "hf"),
        "OMP_NUM_THREADS": "1",
    }
    result = subprocess.run(
        [sys.executable, "-m", f"lerobot.scripts.{command}", *arguments],
        cwd=folder, env={**os.environ, **settings}, capture_output=True, text=True, check=False, timeout=170,
    )  # fmt: skip
    assert result.returncode == 0, (result.stdout + result.stderr)[-4000:]


@pytest.fixture(scope="module")
def policy(project_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small ACT policy, trained by LeRobot's training command."""
    if importlib.util.find_spec("accelerate") is None:
        pytest.skip("lerobot-train needs accelerate (the group dev has it)")
    folder = tmp_path_factory.mktemp("act")
    recordings = project_root / "artifacts" / "shipped" / "recordings" / "datasets" / "ur5e_silver"
    lerobot(
        project_root, folder, "lerobot_train", "--dataset.repo_id=local/ur5e_silver", f"--dataset.root={recordings}", *POLICY,
        "--steps=20", "--batch_size=4", "--num_workers=0", "--save_freq=20", "--log_freq=10", "--output_dir=out",
    )  # fmt: skip
    return folder / "out" / "checkpoints" / "last" / "pretrained_model"


@pytest.mark.slow
@pytest.mark.parametrize("recording", [False, True])
def test_lerobot_eval_runs_a_policy_inside_the_simulator(
    project_root: Path, policy: Path, tmp_path: Path, recording: bool
) -> None:
    lerobot(
        project_root, tmp_path, "lerobot_eval", f"--policy.path={policy}", "--policy.device=cpu", "--env.type=worldline",
        "--env.embodiment=ur5e_silver", "--env.episode_length=16",
        "--eval.n_episodes=2", "--eval.batch_size=2", f"--eval.recording={str(recording).lower()}", "--output_dir=out", "--seed=0",
    )  # fmt: skip
    report = json.loads((tmp_path / "out" / "eval_info.json").read_text())
    assert report["overall"]["n_episodes"] == 2
    assert 0 <= report["overall"]["pc_success"] <= 100
    if not recording:
        assert len(list((tmp_path / "out" / "videos").rglob("*.mp4"))) == 2
        return
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    for number in range(2):
        root = next((tmp_path / "out" / "recordings").rglob(f"env_{number}"))
        written = LeRobotDataset("eval", root=root)
        assert (written.num_episodes, written.num_frames, written.fps) == (1, 16, 8)
        assert {"action", "observation.state", "observation.images.head", "next.success"} <= set(written.features)
