"""A synthetic episode with one arm, a head camera and a wrist camera, whose geometry is made by hand."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from benchmarks import calibration as benchmark
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.sources.agibot import AgibotGesimSource, AgibotGesimSourceConfig
from worldline_core.geometry.transforms import pose_from_euler_fixed_xyz

COUNT, HEIGHT, WIDTH, FPS = 24, 60, 80, 10.0


def looking_at(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Camera-to-base pose with OpenCV axes: z to the target, y as far down as possible."""
    z = (target - position) / np.linalg.norm(target - position)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    pose[:3, 3] = position
    return pose


@pytest.fixture(scope="session")
def episode() -> Episode:
    """A tool that swings and turns over a table; the wrist camera sits behind it and looks along its z."""
    time = np.linspace(0, 2 * np.pi, COUNT)
    places = np.stack([0.5 + 0.1 * np.cos(time), 0.15 * np.sin(time), 0.2 + 0.05 * np.sin(2 * time)], 1)
    turns = np.stack([np.pi + 0.3 * np.sin(time), 0 * time, 0.6 * np.cos(1.3 * time)], 1)
    tools = pose_from_euler_fixed_xyz(places, turns)[:, None]
    mount = np.eye(4)
    mount[:3, 3] = (0.0, -0.05, -0.15)
    K = np.array([[70.0, 0, 39.5], [0, 70.0, 29.5], [0, 0, 1]])
    head = looking_at(np.array([1.2, 0.0, 0.8]), np.array([0.5, 0.0, 0.2]))[None]
    cameras = {
        "head": CameraTrack("head", K, head, WIDTH, HEIGHT),
        "right_wrist": CameraTrack("right_wrist", K, tools[:, 0] @ mount, WIDTH, HEIGHT),
    }
    opening = (0.5 + 0.5 * np.sin(time))[:, None]
    return Episode(
        episode_id="synthetic/0", source="synthetic", embodiment="no_such_robot", scene="s", task_family="lift",
        instruction="lift", outcome="success", split="test", fps=FPS, state=opening.astype(np.float32),
        action=opening.astype(np.float32), timestamps=np.arange(COUNT) / FPS, cameras=cameras, T_base_ee=tools,
        gripper=opening, state_names=("right/gripper",), state_kind="ee_pose",
    )  # fmt: skip


@pytest.fixture(scope="session")
def images() -> dict[str, np.ndarray]:
    """Noise: only sizes matter where these are used."""
    generator = np.random.default_rng(1)
    return {
        view: generator.integers(0, 255, (COUNT, HEIGHT, WIDTH, 3), dtype=np.uint8) for view in ("head", "right_wrist")
    }


@pytest.fixture(scope="session")
def healthy_episodes() -> list:
    """Every fourth episode of the test splits."""
    return list(benchmark.healthy(benchmark.RECORDINGS, {"test", "ood_test"}, 4))


@pytest.fixture(scope="session")
def healthy() -> list:
    """The first of these of each family of robots."""
    found: dict[str, benchmark.Healthy] = {}
    for item in benchmark.healthy(benchmark.RECORDINGS, {"test", "ood_test"}, 4):
        found.setdefault(item.joints.embodiment.split("_")[0], item)
        if len(found) == 4:
            break
    return list(found.values())


@pytest.fixture(scope="session")
def agibot(shared_data: Path) -> Callable[[str], list[tuple[Episode, dict[str, np.ndarray]]]]:
    """Episodes of an AgiBot layout with their pictures."""

    @cache
    def read(layout: str) -> list[tuple[Episode, dict[str, np.ndarray]]]:
        root = shared_data / layout
        source = AgibotGesimSource(AgibotGesimSourceConfig(path=root, fps=30), root)
        loaded = [source.load(name) for name in source.episode_ids()]
        return [(item.episode, {view: item.frames(view) for view in item.views}) for item in loaded]

    return read
