"""A small world with known outcomes: a dark gripper over a grey table, a red cube, two views."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from tests.rollout.conftest import held_out  # noqa: F401 - a fixture
from tests.training.conftest import build_episode, build_tracks, killed_after  # noqa: F401 - a fixture
from worldline_core.actions.episode_tracks import write_index, write_shard
from worldline_core.data.episodes.episode_set import EpisodeSetWriter
from worldline_core.evaluation.evaluation_config import PolicyEvaluationConfig, VideoEvaluationConfig
from worldline_core.evaluation.metric_registry import ON_REQUEST
from worldline_core.evaluation.video.evaluate_video import evaluate_video
from worldline_core.rollout.rollout_set import RolloutSetWriter

VIDEO = VideoEvaluationConfig(segmenters=("colour",), resamples=100)
EVERY = VIDEO.model_copy(update={"metrics": ON_REQUEST, "changed_controls": {"good": {"delayed": "copy"}}})
POLICY = PolicyEvaluationConfig(segmenter="colour", splits=("test",), resamples=100)
NUM_FRAMES = 17
HEIGHT, WIDTH = 48, 72
FPS = 8.0


@dataclass(frozen=True)
class SmallWorld:
    """Folders of the inputs of the evaluation steps, and what each episode shows."""

    inputs: dict[str, Path]
    outcomes: dict[str, str]


def make_film(success, seed):
    """Frames by view, exact head masks, tool points of one attempt to lift the red cube."""
    generator = np.random.default_rng(seed)
    column = int(generator.integers(20, 50))
    head = np.full((NUM_FRAMES, HEIGHT, WIDTH, 3), (120, 116, 110), dtype=np.uint8)
    head += generator.integers(0, 6, head.shape[1:], dtype=np.uint8)
    masks = np.zeros(head.shape[:3], dtype=bool)
    wrist = np.full_like(head, 100)
    points = np.zeros((NUM_FRAMES, 1, 2))
    for frame in range(NUM_FRAMES):
        down = np.clip(frame / 8, 0, 1)
        up = np.clip((frame - 8) / 6, 0, 1)
        tip = round(14 + 17 * down - 16 * up)
        cube_top = 32 - (round(16 * up) if success else 0)
        head[frame, cube_top : cube_top + 7, column : column + 7] = (220, 20, 20)
        masks[frame, max(0, tip - 12) : tip, column - 3 : column + 10] = True
        for finger in (column - 3, column + 7):
            masks[frame, tip : tip + 5, finger : finger + 3] = True
        head[frame][masks[frame]] = (25, 25, 28)
        points[frame, 0] = (column + 3, tip - 6)
        if frame < 9 or success:
            wrist[frame, 20:44, 24:48] = (220, 20, 20)
    return {"head": head, "right_wrist": wrist}, masks, points


def _tracks(episode_id, points, path):
    uv, valid = np.zeros((NUM_FRAMES, 3, 1, 2)), np.zeros((NUM_FRAMES, 3, 1), dtype=bool)
    uv[:, 0], valid[:, 0] = points, True
    poses = np.tile(np.eye(4), (NUM_FRAMES, 1, 1, 1))
    poses[:, 0, 2, 3] = path
    gripper = np.zeros((NUM_FRAMES, 3, 1))
    moved = {"uv": uv, "valid": valid, "T_base_tool": poses, "gripper": gripper}
    return build_tracks(episode_id, NUM_FRAMES, embodiment="box_arm", image_size=(HEIGHT, WIDTH), **moved)


def _write(root, cases, *, split, bank, sources=None, training=0, late=()):
    """With ``training`` further recordings that nobody predicted; the robot of those that are ``late`` stands still at first."""
    episodes, tracks = root / "episodes", root / "tracks"
    methods = {"good": root / "good", "copy": root / "copy"}
    writers = {name: RolloutSetWriter(path, name, FPS) for name, path in methods.items()}
    index = []
    with EpisodeSetWriter(episodes, video_preset="slow", pixel_format="yuv444p") as writer:
        learned = {f"train-{number:02d}": bool(number % 2) for number in range(training)}
        middle = (training + 3) / 2
        for number, (episode_id, success) in enumerate({**cases, **learned}.items()):
            frames, masks, points = make_film(success, seed=0 if bank else number)
            state = np.zeros((NUM_FRAMES, 2), dtype=np.float32)
            outcome = "success" if success else "failure"
            episode = build_episode(
                episode_id, state, source=(sources or {}).get(episode_id, "test"), embodiment="box_arm",
                scene=f"scene_{number % 2}", outcome="unknown" if bank else outcome, bank=bank,
                split="train" if episode_id in learned else split, candidate=number if bank else None,
            )  # fmt: skip
            cube = (frames["head"] == (220, 20, 20)).all(axis=-1).astype(np.uint8)
            writer.add(episode, frames, {"head": masks}, thing_labels={"head": cube})
            waits = 8 if episode_id in late else 0
            speed = 0.02 + 0.0002 * (number if episode_id in learned else middle)
            path = speed * np.maximum(np.arange(NUM_FRAMES) - waits, 0)
            index += write_shard(tracks, number, [_tracks(episode_id, points, path if training else 0 * path)])
            if episode_id in learned:
                continue
            writers["good"].add(episode_id, 0, frames)
            writers["copy"].add(
                episode_id, 0, {view: np.repeat(video[:1], NUM_FRAMES, 0) for view, video in frames.items()}
            )
    write_index(tracks, index, sigma_px_ref=40.0)
    for rollout in writers.values():
        rollout.close()
    inputs = {"tracks": tracks, **{f"rollouts.{name}": path for name, path in methods.items()}}
    inputs["banks" if bank else "episodes"] = episodes
    return SmallWorld(inputs, {name: "success" if success else "failure" for name, success in cases.items()})


@pytest.fixture(scope="session")
def recordings(tmp_path_factory):
    """Two successes and two failures of the test split."""
    cases = {"ep-0": True, "ep-1": False, "ep-2": True, "ep-3": False}
    return _write(tmp_path_factory.mktemp("recordings"), cases, split="test", bank=None)


@pytest.fixture(scope="session")
def policies(tmp_path_factory):
    """Three policies, which succeed in three, two and none of three attempts."""
    cases = {f"{name}-{start}": start < wins for name, wins in (("a", 3), ("b", 2), ("c", 0)) for start in range(3)}
    root = tmp_path_factory.mktemp("policies")
    return _write(root, cases, split="test", bank=None, sources={name: f"policy_{name[0]}" for name in cases})


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """Two attempts beside the recordings that the model knows; the second one begins later than any of these."""
    root = tmp_path_factory.mktemp("trained")
    return _write(root, {"prompt": True, "late": True}, split="test", bank=None, training=8, late=("late",))


@pytest.fixture(scope="session")
def oddly_named(tmp_path_factory):
    """Recordings and a bank whose names lead out of every folder, or are longer than a file's name may be."""
    cases = {"../../../../outside": True, "/tmp/outside": False, "x" * 400: True, "x" * 399 + "y": False}
    root = tmp_path_factory.mktemp("oddly named")
    recordings = _write(root / "recordings", cases, split="test", bank=None)
    return recordings, _write(root / "bank", cases, split="bank", bank="../../../outside" + "b" * 300)


@pytest.fixture(scope="session")
def bank(tmp_path_factory):
    """One bank of six candidates, the fifth one alone succeeds; labels are sealed nowhere yet."""
    cases = {f"cand-{number}": number == 4 for number in range(6)}
    return _write(tmp_path_factory.mktemp("bank"), cases, split="bank", bank="bank-0")


@pytest.fixture(scope="session")
def evaluated(recordings, tmp_path_factory):
    """Every metric of videos that nothing disturbed; `copy` plays a model that ignores changed controls."""
    folder = tmp_path_factory.mktemp("evaluated")
    assert evaluate_video(EVERY, recordings.inputs, folder)["methods"] == ["copy", "good"]
    return folder
