"""Sets that LeRobot's own classes record, and readings that its motors' own normalisation gives."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.discovery.recorded_sets import SO_JOINTS, SO_NAMES, pictures, so101_states
from worldline_core.data.curation.curate import curate
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.sources.lerobot import LeRobotSourceConfig, state_columns
from worldline_core.discovery.findings import write_config
from worldline_core.discovery.look import look
from worldline_core.pipeline.pipeline_config import PipelineConfig

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]  # importing LeRobot alone takes minutes on a busy machine


@pytest.fixture(autouse=True)
def offline(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_DATASETS_CACHE", str(tmp_path / "cache"))


@pytest.mark.parametrize("videos", [True, False])
def test_a_recorded_so101(tmp_path: Path, videos: bool) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    cameras = {"observation.images.front": "still", "observation.images.wrist": "wrist"}
    kind = {"dtype": "video" if videos else "image", "shape": (48, 64, 3), "names": ["height", "width", "channels"]}
    vector = {"dtype": "float32", "shape": (6,), "names": SO_NAMES}
    features = {**dict.fromkeys(cameras, kind), "observation.state": vector, "action": vector}
    recorded: Any = LeRobotDataset.create(
        "local/arm", 30, features, root=tmp_path / "raw", robot_type="so101_follower", use_videos=videos
    )
    for seed, states in enumerate(so101_states(episodes=3)):
        frames = {key: pictures(states[:, :5], motion, seed) for key, motion in cameras.items()}
        for i, state in enumerate(states.astype(np.float32)):
            images = {key: values[i] for key, values in frames.items()}
            recorded.add_frame({**images, "observation.state": state, "action": state, "task": "pick the cube up"})
        recorded.save_episode()
    recorded.finalize()
    found = look(tmp_path / "raw")
    assert (found.source["kind"], found.source["embodiment"], found.source["angle_unit"]) == (
        "lerobot_v3",
        "so101",
        "deg",
    )
    assert found.source["views"] == {"observation.images.front": "head", "observation.images.wrist": "right_wrist"}
    write_config(found, tmp_path / "my.yaml", "raw")
    config = PipelineConfig.load(None, tmp_path / "my.yaml")
    assert curate(config.curate, {}, tmp_path / "curated")["kept"] == 3
    state = EpisodeSet.open(tmp_path / "curated").episode(0).state
    assert np.allclose(state[:, :5], np.deg2rad(so101_states()[0][:, :5]), atol=1e-5)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("mode", ["DEGREES", "RANGE_M100_100"])
def test_readings_of_its_motors_become_the_angles_of_their_ticks(mode: str, mirrored: bool) -> None:
    from lerobot.motors.motors_bus import MotorCalibration, MotorNormMode, SerialMotorsBus

    rng = np.random.default_rng(0)
    low, high = rng.integers(700, 1000, 5), rng.integers(3000, 3400, 5)
    calibration = {
        name: MotorCalibration(id=i, drive_mode=int(mirrored), homing_offset=0, range_min=int(low[i]), range_max=int(high[i]))
        for i, name in enumerate(SO_JOINTS)
    }  # fmt: skip
    bus: Any = SimpleNamespace(
        calibration=calibration,
        motors={name: SimpleNamespace(norm_mode=MotorNormMode[mode]) for name in SO_JOINTS},
        apply_drive_mode=True,
        model_resolution_table={"sts3215": 4096},
        _id_to_name=SO_JOINTS.__getitem__,
        _id_to_model=lambda _: "sts3215",
    )
    ticks = rng.integers(low, high, (50, 5))
    readings = np.array([[*SerialMotorsBus._normalize(bus, dict(enumerate(row))).values()] for row in ticks.tolist()])
    middle = (low + high) / 2
    expected = (ticks - middle) * 2 * np.pi / 4095
    bounds = (np.stack([low, high], 1) - middle[:, None]) * 2 * np.pi / 4095
    joints: dict[str, Any] = {"feature": "observation.state", "columns": SO_JOINTS}
    if mode == "RANGE_M100_100":
        joints |= {"ranges": bounds.tolist(), "signs": [-1] * 5 if mirrored else None}
    config = LeRobotSourceConfig.model_validate({
        "kind": "lerobot_v3", "path": "x", "embodiment": "so101", "views": {}, "arms": [{"name": "right", "state": {"joints": joints}}],
        "angle_unit": "deg" if mode == "DEGREES" else "range_m100_100",
    })  # fmt: skip
    features = {"observation.state": {"shape": [5], "names": SO_JOINTS}}
    state, _, _ = state_columns(config, features, "x").read(lambda _: readings)
    assert np.allclose(state, expected, atol=1e-6)
