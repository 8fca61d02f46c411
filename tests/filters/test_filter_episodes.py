"""The whole step on a synthetic robot whose tool poses are recorded, with one defect an episode."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

from worldline_core.data.episodes.episode import VIEWS, CameraTrack, Episode
from worldline_core.data.episodes.episode_index import read_quarantine
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.data.episodes.episode_set_writer import part_name
from worldline_core.errors import ArtifactError, ConfigError, DataError
from worldline_core.filters.filter import filter_episodes
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.filters.signals import tool_poses
from worldline_core.geometry.cameras import project_points
from worldline_core.geometry.transforms import rigid_inverse

HEIGHT, WIDTH, FRAMES, FPS = 64, 96, 33, 8.0
K = np.array([[80.0, 0, 47.5], [0, 80.0, 31.5], [0, 0, 1.0]])
HEAD = np.eye(4)
HEAD[:3, :3], HEAD[:3, 3] = np.diag([1.0, -1.0, -1.0]), [0.4, 0.0, 1.2]
MOUNT = np.eye(4)
MOUNT[:3, 3] = [0.05, 0.0, -0.1]


def tool_track(number: int) -> np.ndarray:
    time = np.arange(FRAMES) / FPS
    rng = np.random.default_rng(number)
    poses = np.tile(np.eye(4), (FRAMES, 2, 1, 1))
    for arm, side in ((0, 0.15), (1, -0.15)):
        a, b, c = rng.uniform(0.8, 1.8, 3)[:, None] * time
        place = [0.35 + 0.2 * np.sin(a), side + 0.12 * np.sin(b + 1), 0.3 + 0.05 * np.cos(c)]
        poses[:, arm, :3, 3] = np.stack(place, 1)
        turn = np.stack([0.3 * np.sin(a), 0.2 * np.sin(b), 0 * time], 1)
        poses[:, arm, :3, :3] = Rotation.from_euler("xyz", turn).as_matrix()
    return poses


def texture(seed: int, low: int, high: int, cells: tuple[int, int], size: tuple[int, int], how: int) -> np.ndarray:
    """float32 (height, width, 3); `size` is (width, height)."""
    coarse = np.random.default_rng(seed).uniform(low, high, (*cells, 3)).astype(np.float32)
    return cv2.resize(coarse, size, interpolation=how)


def render(poses: np.ndarray) -> np.ndarray:
    """uint8 (n, H, W, 3) of a textured table with a disc at each point."""
    table = texture(1, 60, 170, (8, 12), (WIDTH, HEIGHT), cv2.INTER_NEAREST)
    frames = []
    for pose in poses:
        picture = table.copy()
        for arm, colour in ((0, (250, 40, 40)), (1, (40, 40, 250))):
            (uv,), _ = project_points(pose[arm, None, :3, 3], K, HEAD[None])
            cv2.circle(picture, uv.round().astype(int).tolist(), 6, colour, -1)
        frames.append(picture)
    return np.stack(frames).astype(np.uint8)


def wrist_images(poses: np.ndarray, arm: int) -> np.ndarray:
    """A textured ceiling as a camera on the hand sees it."""
    ceiling = texture(2, 40, 200, (40, 40), (400, 400), cv2.INTER_CUBIC)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(K).T
    frames = []
    for pose in poses[:, arm] @ MOUNT:
        directions = rays @ pose[:3, :3].T
        places = pose[:3, 3] + directions * ((0.8 - pose[2, 3]) / directions[..., 2:])
        x, y = (200 + 200 * (places[..., :2] - (0.35, 0.0))).astype(np.float32).transpose(2, 0, 1)
        frames.append(cv2.remap(ceiling, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT))
    return np.clip(np.stack(frames), 0, 255).astype(np.uint8)


def record(number: int, **changes: Any) -> tuple[Episode, dict[str, np.ndarray]]:
    tools = tool_track(number)
    frames = {"head": render(tools), "left_wrist": wrist_images(tools, 0), "right_wrist": wrist_images(tools, 1)}
    gripper = np.full((FRAMES, 2), 0.5)
    state = np.concatenate([np.concatenate([tools[:, a, :3, 3], gripper[:, a : a + 1]], 1) for a in (0, 1)], 1)
    poses = {"head": HEAD[None], "left_wrist": tools[:, 0] @ MOUNT, "right_wrist": tools[:, 1] @ MOUNT}
    values: dict[str, Any] = {
        "episode_id": f"e{number:02d}", "source": "synthetic", "embodiment": "points", "scene": f"s{number}",
        "task_family": "unknown", "instruction": "", "outcome": "unknown", "split": "train", "fps": FPS,
        "state": state.astype(np.float32), "action": state.astype(np.float32), "timestamps": np.arange(FRAMES) / FPS,
        "cameras": {view: CameraTrack(view, K, pose, WIDTH, HEIGHT) for view, pose in poses.items()},
        "T_base_ee": tools, "gripper": gripper, "state_kind": "ee_pose",
        "state_names": tuple(f"{a}/{n}" for a in ("left", "right") for n in ("x", "y", "z", "gripper")),
    }  # fmt: skip
    return Episode(**(values | changes)), frames


def spoil(number: int) -> tuple[Episode, dict[str, np.ndarray]]:
    episode, frames = record(number)
    cameras = dict(episode.cameras)

    def moved(view: str, poses: np.ndarray) -> None:
        cameras[view] = replace(cameras[view], T_base_camera=poses)

    def states(index: np.ndarray) -> Episode:
        return replace(episode, T_base_ee=episode.T_base_ee[index], state=episode.state[index])  # type: ignore[index]

    if number == 1:  # frozen
        frames["head"][6:] = frames["head"][6]
    elif number == 2:  # a few black frames at the end
        frames["head"][28:31] = 0
    elif number == 3:
        moved("left_wrist", rigid_inverse(cameras["left_wrist"].T_base_camera))
    elif number == 4:
        episode = states(np.maximum(np.arange(FRAMES) - 4, 0))  # late by four frames
    elif number == 5:
        aside = np.eye(4)
        aside[:2, 3] = 0.3, 0.25
        moved("head", HEAD[None] @ aside)
    elif number == 6:
        del frames["right_wrist"], cameras["right_wrist"]
    elif number == 7:  # nothing happens
        frames = {view: np.repeat(images[:1], FRAMES, 0) for view, images in frames.items()}
        episode = states(np.zeros(FRAMES, int))
        for view, camera in list(cameras.items()):
            moved(view, np.repeat(camera.T_base_camera[:1], len(camera.T_base_camera), 0))
    elif number == 8:  # the base drives
        wide = texture(3, 40, 220, (8, 40), (400, HEIGHT), cv2.INTER_NEAREST)
        frames["head"] = np.stack([wide[:, 3 * i : 3 * i + WIDTH] for i in range(FRAMES)]).astype(np.uint8)
    return replace(episode, cameras=cameras), frames


Filtered = tuple[Path, Path, dict[str, Any]]


@pytest.fixture(scope="module")
def filtered(tmp_path_factory: pytest.TempPathFactory) -> Filtered:
    root = tmp_path_factory.mktemp("filter")
    with EpisodeSetWriter(root / "curated", video_crf=6, pixel_format="yuv444p") as writer:
        for number in range(9):
            writer.add(*spoil(number))
    counts = filter_episodes(FilterConfig(required_views=VIEWS), {"episodes": root / "curated"}, root / "filtered")
    return root / "curated", root / "filtered", counts


def test_every_defect_is_found_and_healthy_episodes_pass(filtered: Filtered) -> None:
    _, output, counts = filtered
    passed = EpisodeSet.open(output)
    assert {row.episode_id: row.reason for row in passed.quarantine()} == {
        "e01": "corrupted", "e07": "static", "e08": "base_motion",
    }  # fmt: skip
    assert {row.episode_id: row.stage2_reason for row in passed.rows} == {
        "e00": None, "e02": None, "e03": "calibration", "e04": "time_alignment", "e05": "projection",
        "e06": "missing_view",
    }  # fmt: skip
    assert all(row.stage1_ok and row.stage2_ok == (row.stage2_reason is None) for row in passed.rows)
    assert counts["found"] == counts["kept"] + counts["quarantined"] == 9
    assert counts["reasons"] == {"base_motion": 1, "corrupted": 1, "static": 1}
    assert counts["stage2_reasons"] == {"calibration": 1, "missing_view": 1, "projection": 1, "time_alignment": 1}
    assert passed.select(stage2_ok=True) == [0, 1]


def test_kept_rows_point_into_the_curated_set(filtered: Filtered) -> None:
    curated_path, output, counts = filtered
    curated, passed = EpisodeSet.open(curated_path), EpisodeSet.open(output)
    row = passed.rows[1]
    assert (row.episode_id, row.start, row.stop, row.num_frames) == ("e02", 0, 28, 28)
    assert row.dataset == "../curated/datasets/points"
    assert np.array_equal(passed.frames(1, "head"), curated.frames(2, "head")[:28])
    assert counts["cut_frames"] == 5
    assert not list(output.rglob("*.mp4"))
    rows = pq.read_table(output / "findings.parquet").to_pylist()
    findings = {(row["episode_id"], row["detector"]): row for row in reversed(rows)}  # of the first view
    assert findings["e02", "too_dark"]["cut_frames"] == 3
    dark, late = (json.loads(findings[key]["numbers"]) for key in (("e02", "too_dark"), ("e04", "pose_lag")))
    assert (dark["cut"], dark["thresholds"], abs(late["pose_lag_s"])) == ([[28, 31]], "default", pytest.approx(0.5))


def test_a_restart_gives_the_same_bytes(filtered: Filtered, tmp_path: Path) -> None:
    curated, output, counts = filtered
    again = output.parent / "again"
    verdicts = again / "run" / "verdicts"
    verdicts.mkdir(parents=True)
    # All but one that the calibration was examined of and two that were dropped before.
    for path in sorted((output / "run" / "verdicts").iterdir()):
        if path.stem not in map(part_name, ("e00", "e01", "e07")):
            (verdicts / path.name).write_bytes(path.read_bytes())
    assert len(list(verdicts.iterdir())) == 6
    assert filter_episodes(FilterConfig(required_views=VIEWS), {"episodes": curated}, again) == counts
    for name in ("index.parquet", "quarantine.parquet", "findings.parquet"):
        assert (again / name).read_bytes() == (output / name).read_bytes()


def test_nothing_left_is_an_error(filtered: Filtered, tmp_path: Path) -> None:
    curated, _, _ = filtered
    with pytest.raises(DataError, match=r"(?s)No episode passed.*out/quarantine\.parquet.*too_short.*the first, "):
        filter_episodes(FilterConfig(min_segment_frames=200), {"episodes": curated}, tmp_path / "out")
    assert "too_short" in {row.reason for row in read_quarantine(tmp_path / "out")}


def test_a_source_has_its_own_thresholds(filtered: Filtered, tmp_path: Path) -> None:
    curated, _, _ = filtered
    # At one frame in two seconds there is too little to search the calibration for mistakes: that is not what is tested.
    own = {"static": {"min_run_s": 60}, "doctor": {"rate_hz": 0.5}}
    overrides = {"synthetic": own, "elsewhere": {"min_segment_frames": 200}}
    config = FilterConfig.model_validate({"sources": overrides})
    assert config.for_source("synthetic").static == config.static.model_copy(update={"min_run_s": 60})
    assert config.for_source("other") == config
    counts = filter_episodes(config, {"episodes": curated}, tmp_path / "out")
    assert "static" not in counts["reasons"]  # the still episode is shorter than a minute
    findings = pq.read_table(tmp_path / "out" / "findings.parquet").to_pylist()
    assert {json.loads(finding["numbers"])["thresholds"] for finding in findings} == {"synthetic"}


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        ({"static": {"min_run": 2}}, r"(?s)filter\.sources\.agibot_world.*static\.min_run: unknown key.*min_run_s"),
        ({"blurr": {}}, r"(?s)filter\.sources\.agibot_world.*blurr: unknown key.*'blur'"),
        ({"static": {"min_run_s": -1}}, r"(?s)filter\.sources\.agibot_world.*static\.min_run_s"),
        ({"static": 3}, r"(?s)filter\.sources\.agibot_world.*static"),
        ({"sources": {}}, r"cannot be nested"),
    ],
)
def test_a_wrong_override_is_named(overrides: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        FilterConfig.model_validate({"sources": {"agibot_world": overrides}})


def test_a_robot_whose_description_is_not_here_is_left_out_not_fatal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("WORLDLINE_DESCRIPTION_AGIBOT_G1", raising=False)
    state = np.zeros((FRAMES, 16), np.float32)
    episode, _ = record(0, embodiment="agibot_g1", state=state, action=state, state_kind="joints", state_names=None)
    assert tool_poses(replace(episode, T_base_ee=None, gripper=None)) == (None, ())


@pytest.mark.parametrize("damage", [Path.unlink, lambda path: path.write_bytes(path.read_bytes()[:3000])])
@pytest.mark.parametrize("pattern", ["*.mp4", "cameras.parquet"])
def test_damaged_data_is_no_verdict_on_an_episode(tmp_path: Path, pattern: str, damage: Any) -> None:
    with EpisodeSetWriter(tmp_path / "set") as writer:
        writer.add(*record(0))
    shutil.rmtree(tmp_path / "set" / "thumbnails", ignore_errors=True)
    damage(sorted((tmp_path / "set").rglob(pattern))[0])
    with pytest.raises(ArtifactError, match="An input of this step is missing or damaged"):
        filter_episodes(FilterConfig(), {"episodes": tmp_path / "set"}, tmp_path / "out")
    assert not (tmp_path / "out" / "quarantine.parquet").exists()
