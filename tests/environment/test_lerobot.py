"""LeRobot's own commands, unmodified, inside the simulator: a policy is trained on the shipped recordings, evaluated, and driven as
on a robot; episodes are recorded by teleoperation."""

import importlib.util
import json
import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from worldline_core.config import read_yaml, validate
from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics

pytest.importorskip("lerobot")

POLICY = (
    "--policy.type=act", "--policy.device=cpu", "--policy.push_to_hub=false", "--policy.chunk_size=16", "--policy.n_action_steps=16",
    "--policy.dim_model=64", "--policy.n_heads=2", "--policy.dim_feedforward=128", "--policy.n_encoder_layers=1",
    "--policy.use_vae=false", "--policy.pretrained_backbone_weights=null",
)  # fmt: skip


@pytest.fixture(scope="module")
def lerobot(project_root, uv, tmp_path_factory):
    """Runs a command of LeRobot in a folder as a user would, with the wheels of both plug-ins installed and no hub; what it said."""
    built, site = tmp_path_factory.mktemp("wheels"), tmp_path_factory.mktemp("site")
    for name in ("lerobot_env_worldline", "lerobot_robot_worldline"):
        subprocess.run([uv, "build", "-q", "--wheel", "-o", built, f"packaging/{name}"], cwd=project_root, check=True)
    installing = (uv, "pip", "install", "-q", "--no-deps", "--python", sys.executable, "--target", site)
    subprocess.run([*installing, *sorted(built.glob("*.whl"))], check=True)
    path = os.pathsep.join([str(project_root), str(site), *filter(None, [os.environ.get("PYTHONPATH")])])
    hub = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path_factory.mktemp("hf"))}
    settings = {**os.environ, **hub, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}

    def run(folder, command, *arguments):
        result = subprocess.run(
            [sys.executable, "-P", "-m", f"lerobot.scripts.{command}", *arguments],
            cwd=folder, env=settings, capture_output=True, text=True, check=False, timeout=400,
        )  # fmt: skip
        assert result.returncode == 0, (result.stdout + result.stderr)[-4000:]
        return result.stdout + result.stderr

    return run


@pytest.fixture(scope="module")
def policy(lerobot, project_root, tmp_path_factory):
    """A small ACT policy, trained by LeRobot's training command."""
    if importlib.util.find_spec("accelerate") is None:
        pytest.skip("lerobot-train needs accelerate (the group dev has it)")
    folder = tmp_path_factory.mktemp("act")
    recordings = project_root / "artifacts/shipped/recordings/datasets/ur5e_silver"
    lerobot(
        folder, "lerobot_train", "--dataset.repo_id=local/ur5e_silver", f"--dataset.root={recordings}", *POLICY,
        "--steps=20", "--batch_size=4", "--num_workers=0", "--save_freq=20", "--log_freq=10", "--output_dir=out",
    )  # fmt: skip
    return folder / "out" / "checkpoints" / "last" / "pretrained_model"


def recorded_by_eval(folder):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    roots = [next((folder / "out" / "recordings").rglob(f"env_{number}")) for number in range(2)]
    return [LeRobotDataset("eval", root=root) for root in roots]


@pytest.mark.slow
@pytest.mark.parametrize("recording", [False, True])
def test_lerobot_eval_runs_a_policy_inside_the_simulator(lerobot, policy, tmp_path, recording):
    lerobot(
        tmp_path, "lerobot_eval", f"--policy.path={policy}", "--policy.device=cpu", "--env.type=worldline",
        "--env.embodiment=ur5e_silver", "--env.episode_length=16",
        "--eval.n_episodes=2", "--eval.batch_size=2", f"--eval.recording={str(recording).lower()}", "--output_dir=out", "--seed=0",
    )  # fmt: skip
    report = json.loads((tmp_path / "out" / "eval_info.json").read_text())
    assert report["overall"]["n_episodes"] == 2
    assert 0 <= report["overall"]["pc_success"] <= 100
    if not recording:
        assert len(list((tmp_path / "out" / "videos").rglob("*.mp4"))) == 2
        return
    for written in recorded_by_eval(tmp_path):
        assert (written.num_episodes, written.num_frames, written.fps) == (1, 16, 8)
        assert {"action", "observation.state", "observation.images.head", "next.success"} <= set(written.features)


@pytest.mark.slow
def test_lerobot_eval_runs_the_same_policy_in_mujoco(lerobot, policy, starts, tmp_path):
    pytest.importorskip("mujoco")
    lerobot(
        tmp_path, "lerobot_eval", f"--policy.path={policy}", "--policy.device=cpu", "--env.type=worldline", "--env.world=mujoco",
        "--env.episode_length=3", "--eval.n_episodes=2", "--eval.batch_size=2", "--eval.recording=true", "--output_dir=out",
        "--seed=1",
    )  # fmt: skip
    report = json.loads((tmp_path / "out" / "eval_info.json").read_text())
    assert report["per_task"][0]["metrics"]["successes"] == [False, False]
    for number, written in enumerate(recorded_by_eval(tmp_path)):
        assert (written.num_episodes, written.num_frames) == (1, 3)
        np.testing.assert_allclose(written[0]["observation.state"], starts[number + 1].state, atol=1e-4)


RECORDED = (
    "--dataset.fps=8", "--dataset.num_episodes=2", "--dataset.episode_time_s=3.5", "--dataset.reset_time_s=0",
    "--dataset.single_task=Lift.", "--dataset.push_to_hub=false", "--play_sounds=false", "--dataset.root=out",
)  # fmt: skip


def check_recorded(world, starts, root, *, lossless):
    """Each of two recorded episodes is a simulation under its commands, which are returned."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    driven, written = [], LeRobotDataset("local/any", root=root)
    assert (written.num_episodes, written.fps, written.meta.robot_type) == (2, 8, "worldline")
    names = [f"{name.replace('/', '_')}.pos" for name in load_embodiment("ur5e_silver").state_names]
    assert written.features["action"]["names"] == written.features["observation.state"]["names"] == names
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # as the command
    try:
        for number, episode in enumerate(written.meta.episodes):
            rows = [written[i] for i in range(episode["dataset_from_index"], episode["dataset_to_index"])]
            assert len(rows) > 16
            commands, start = torch.stack([row["action"] for row in rows]).double().numpy(), starts[number]
            simulation = world.start(
                start.images, start.cameras, embodiment="ur5e_silver", state=start.state, seed=number
            )
            states = np.concatenate(([simulation.state[0]], simulation.follow(commands[None])[1][0]))[: len(rows)]
            np.testing.assert_allclose(torch.stack([row["observation.state"] for row in rows]), states, atol=1e-6)
            first = simulation.pictures[0]
            simulation.step(commands[:16])
            for row, pictures in zip(rows, [first] * 16 + [simulation.pictures[0]], strict=False):
                for view in VIEWS:
                    shown = 255 * row[f"observation.images.{view}"].permute(1, 2, 0).double().numpy()
                    if lossless:
                        np.testing.assert_array_equal(shown.round(), pictures[view])
                    else:
                        assert np.abs(shown - pictures[view]).mean() < 6
            driven.append(commands)
    finally:
        torch.set_num_threads(threads)
    return driven


@pytest.mark.slow
def test_lerobot_record_writes_what_recorded_commands_lead_to_and_goes_on(lerobot, world, starts, tmp_path):
    """Another command records the second episode; it begins at the second start."""
    pytest.importorskip("deepdiff", reason="--resume compares features with deepdiff, of LeRobot's core_scripts")
    replay = ("--robot.type=worldline", "--teleop.type=worldline_replay", "--robot.dataset_root=out")
    written = ("--dataset.repo_id=local/simulated", "--dataset.video=false", *RECORDED)
    asked = [option.replace("num_episodes=2", "num_episodes=1") for option in (*replay, *written)]
    assert "Commands come at" not in lerobot(tmp_path, "lerobot_record", *asked)
    lerobot(tmp_path, "lerobot_record", *asked, "--resume=true")
    for number, commands in enumerate(check_recorded(world, starts, tmp_path / "out", lossless=True)):
        np.testing.assert_array_equal(commands, starts.commands(number)[: len(commands)])
    assert len(list((tmp_path / "out" / "meta" / "cameras").iterdir())) == 2


@pytest.mark.slow
def test_lerobot_rollout_drives_a_policy_as_on_a_robot(lerobot, policy, world, starts, tmp_path):
    lerobot(
        tmp_path, "lerobot_rollout", "--strategy.type=episodic", f"--policy.path={policy}", "--policy.device=cpu",
        "--robot.type=worldline", "--robot.dataset_root=out", "--fps=8", "--dataset.repo_id=local/rollout_act", *RECORDED,
    )  # fmt: skip
    check_recorded(world, starts, tmp_path / "out", lossless=False)
    # It is curated by the file that lies in it; the cameras are where the robot carried them.
    config = validate(CurateConfig, read_yaml(tmp_path / "out" / "curate.yaml")["curate"], where="curate.yaml")
    counts = curate(config, {}, tmp_path / "curated")
    assert (counts["kept"], counts["quarantined"]) == (2, 0), counts
    episodes = EpisodeSet.open(tmp_path / "curated")
    assert all(row.stage2_ok and row.embodiment == "ur5e_silver" and row.views == VIEWS for row in episodes.rows)
    episode = episodes.episode(0)
    kinematics = ArmKinematics(load_embodiment("ur5e_silver"))
    for view, carried in kinematics.wrist_cameras_of(kinematics.link_poses(np.array(episode.state))).items():
        np.testing.assert_allclose(episode.cameras[view].T_base_camera, carried, atol=2e-3)
    assert not episode.cameras["head"].moving
