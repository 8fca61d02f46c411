"""`worldline init` on LeRobot datasets: arms, units, grippers, robots and cameras, and the file that is written."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from published_lerobot import write_droid, write_galaxea, write_robocoin
from recorded_sets import (
    ALOHA,
    SO_JOINTS,
    SO_NAMES,
    gripper,
    motion,
    pictures,
    so101_states,
    write_aloha,
    write_lerobot,
    write_so101,
)

from worldline_core.data.curation.curate import curate
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.discovery.configuration import write_config
from worldline_core.discovery.findings import Discovery
from worldline_core.discovery.look import discover, look
from worldline_core.errors import ConfigError, DataError
from worldline_core.filters.filter import filter_episodes
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.pipeline.pipeline_config import PipelineConfig


def init(root: Path, tmp_path: Path) -> tuple[Discovery, Path]:
    found = look(root)
    write_config(found, tmp_path / "my.yaml", str(root))
    return found, tmp_path / "my.yaml"


def run(path: Path, tmp_path: Path) -> tuple[dict[str, Any], EpisodeSet]:
    """Curate and filter with the written file, as the tasks do."""
    config = PipelineConfig.load(None, path)
    counts = curate(config.curate, {}, tmp_path / "curated")
    filter_episodes(config.filter, {"episodes": tmp_path / "curated"}, tmp_path / "filtered")
    return counts, EpisodeSet.open(tmp_path / "filtered")


@pytest.mark.parametrize("version", ["v3.0", "v2.1", "v2.0"])
def test_an_so101_runs_as_it_was_recorded(tmp_path: Path, version: str) -> None:
    write_so101(tmp_path / "raw", version=version)
    found, path = init(tmp_path / "raw", tmp_path)
    assert (found.source["angle_unit"], found.source["embodiment"], found.questions) == ("deg", "so101", [])
    assert found.views == ["head", "right_wrist"]
    text = path.read_text()
    assert "ticks of 360/4095 degrees" in text
    assert "details change while an arm moves" in text
    counts, curated = run(path, tmp_path)
    assert (counts["found"], counts["kept"]) == (4, 4)
    assert {row.fps for row in curated.rows} == {30.0}  # two seconds: every frame is kept for a clip
    config = PipelineConfig.load(None, path)
    assert (config.render_actions, config.train_stage2.native_size) == (None, 6)
    assert {row.split for row in EpisodeSet.open(tmp_path / "curated").rows} == {"train", "validation", "test"}
    first = next(i for i, row in enumerate(curated.rows) if row.episode_id.endswith("000000"))
    expected = so101_states()[0]
    state = curated.episode(first).state
    start = next(
        i for i in range(60) if np.allclose(np.deg2rad(expected[i : i + len(state), :5]), state[:, :5], atol=1e-5)
    )
    assert np.allclose(state[:, 5], expected[start : start + len(state), 5] / 100, atol=1e-5)


def test_an_aloha_of_two_arms_and_three_cameras(tmp_path: Path) -> None:
    write_aloha(tmp_path / "raw")
    found, path = init(tmp_path / "raw", tmp_path)
    assert (found.source["embodiment"], found.source["angle_unit"]) == ("aloha", "rad")
    assert found.source["views"] == {
        "observation.images.cam_high": "head",
        "observation.images.cam_left_wrist": "left_wrist",
        "observation.images.cam_right_wrist": "right_wrist",
    }
    assert PipelineConfig.load(None, path).curate.stride == 2  # 80 frames: not every sixth, as 8 a second would be
    counts, _ = run(path, tmp_path)
    assert counts["kept"] == 4


def arms_of(found: Discovery) -> list[dict[str, Any]]:
    return found.source["arms"]


@pytest.mark.parametrize(
    ("states", "robot", "unit", "doubtful"),
    [
        ([motion(5, 60, seed, size=80) for seed in range(3)], "so101_follower", "deg", True),
        ([motion(5, 60, seed, size=80) for seed in range(3)], "koch_follower", "range_m100_100", True),
        ([motion(5, 60, s, size=400).clip(-100, 100) for s in range(3)], "so101_follower", "range_m100_100", False),
        ([motion(5, 60, s, size=50).round(0) for s in range(3)], "koch_follower", "range_m100_100", False),
        ([motion(5, 60, s, size=200) for s in range(3)], "so100_follower", "deg", False),
        ([motion(5, 60, s) for s in range(3)], "so101_follower", "rad", False),
    ],
    ids=["simulated", "simulated-koch", "cut-off", "coarse", "beyond-100", "radians"],
)
def test_units_of_lerobots_own_arms(
    tmp_path: Path, states: list[np.ndarray], robot: str, unit: str, doubtful: bool
) -> None:
    whole = [np.concatenate([state, gripper(60)[:, None]], axis=1) for state in states]
    found = look(write_so101(tmp_path / "raw", states=whole, robot=robot))
    assert found.source["angle_unit"] == unit, found.evidence["angle_unit",]
    if unit == "range_m100_100":
        ranges = arms_of(found)[0]["state"]["joints"]["ranges"]
        assert ranges[4] == [-3.1416, 3.1416]
        described = found.source["embodiment"] == "so101"
        assert described == robot.startswith("so")  # a Koch has the same names and other links
        limits = load_embodiment("so101").arms[0].limits if described else [(-np.pi / 2, np.pi / 2)] * 5
        assert np.allclose(ranges[:4], limits[:4], atol=1e-4)
    assert {arm["state"]["gripper"]["open"] for arm in arms_of(found)} == {100}
    assert any("both fit" in note for note in found.notes) is doubtful


def test_an_so100_calibrated_before_lerobots_change(tmp_path: Path) -> None:
    """Shoulder and elbow were 90 degrees where they are 0 now, and the shoulder counted the other way."""
    new = so101_states()
    old = [np.concatenate([s[:, :1], 90 - s[:, 1:2], s[:, 2:3] + 90, s[:, 3:]], axis=1) for s in new]
    names = [f"main_{name}" for name in (*SO_JOINTS, "gripper")]
    write_so101(tmp_path / "raw", states=old, names=names, robot="so100", version="v2.1")
    found, path = init(tmp_path / "raw", tmp_path)
    assert arms_of(found)[0]["state"]["joints"]["zeros"] == [0, 90, 90, 0, 0]
    _, curated = run(path, tmp_path)
    states = np.concatenate([curated.episode(i).state[:, 1] for i in range(len(curated.rows))])
    lift = np.deg2rad(np.concatenate(new)[:, 1])
    assert (states.min(), states.max()) == pytest.approx((lift.min(), lift.max()), abs=0.05)


def bimanual(prefixes: tuple[str, str]) -> list[str]:
    return [f"{prefix}_{name}" for prefix in prefixes for name in SO_NAMES]


def test_leader_and_follower_sides_and_mirrored_joints_are_told_apart_by_their_names(tmp_path: Path) -> None:
    arm = so101_states()
    both = [np.concatenate([state, state[:, ::-1][:, [5, 4, 3, 2, 1, 0]] + 1], axis=1) for state in arm]
    actions = [state[:, :6] for state in both]
    vectors = {
        "observation.state": (bimanual(("leader", "follower")), both),
        "action": ([f"leader_{name}" for name in SO_NAMES], actions),
    }
    videos = {"observation.images.top": [pictures(state[:, :5], "still") for state in both]}
    found = look(write_lerobot(tmp_path / "roles", vectors, videos))
    (only,) = arms_of(found)
    assert only["state"]["joints"]["columns"][0] == "follower_shoulder_pan.pos"
    assert only["action"]["joints"]["columns"][0] == "leader_shoulder_pan.pos"
    # One side alone is a single arm; of two sides the left comes first, whatever the order of columns.
    vectors = {"observation.state": (bimanual(("right", "left")), both)}
    found = look(write_lerobot(tmp_path / "sides", vectors, videos, robot="bi_so_follower"))
    assert [each["name"] for each in arms_of(found)] == ["left", "right"]
    assert arms_of(found)[0]["state"]["joints"]["columns"][0] == "left_shoulder_pan.pos"
    # A mirrored ViperX: its elbow is beyond the limits unless it counts the other way.
    names = [f"{side}_{name}" for side in ("left", "right") for name in (*ALOHA, "gripper")]
    limits = np.array(load_embodiment("aloha").arms[0].limits)
    turned = [
        np.tile(np.concatenate([motion(6, 60, s, size=0.1), gripper(60, 0, 1)[:, None]], axis=1), 2) for s in range(3)
    ]
    for state in turned:
        state[:, 11] = -limits[4, 1] + 0.05 * motion(1, 60)[:, 0]  # the right arm's wrist_angle
    found = look(write_lerobot(tmp_path / "mirrored", {"observation.state": (names, turned)}, videos, robot="aloha"))
    assert "signs" not in arms_of(found)[0]["state"]["joints"]
    assert arms_of(found)[1]["state"]["joints"]["signs"] == [1, 1, 1, 1, -1, 1]


def seven(frames: int = 60, **ends: float) -> list[np.ndarray]:
    pose = np.array([0.0, -0.3, 0.0, -2.0, 0.0, 2.0, 0.5])
    return [
        np.concatenate([pose + motion(7, frames, seed, size=0.3), gripper(frames, **ends)[:, None]], axis=1)
        for seed in range(3)
    ]


@pytest.mark.parametrize(
    ("names", "robot", "embodiment", "ends"),
    [
        ([*(f"joint_{i}" for i in range(7)), "gripper"], "droid", "droid_franka", {"closed": 1, "open": 0}),
        ([*(f"panda_joint{i}" for i in range(1, 8)), "gripper_width"], "franka", "franka_panda", {"closed": 0, "open": 1}),
        ([*(f"joint{i}.pos" for i in range(1, 8)), "gripper_open.pos"], "xarm7", "xarm7", {"closed": 0, "open": 1}),
        (None, "franka", "franka_panda", None),
        ([f"motor_{i}" for i in range(8)], None, None, None),
    ],
)  # fmt: skip
def test_robots_are_matched_and_what_nothing_says_is_asked(
    tmp_path: Path, names: list[str] | None, robot: str | None, embodiment: str | None, ends: dict[str, float] | None
) -> None:
    vectors = {"observation.state": (names, seven(low=0.02, high=0.97))}
    videos = {
        "observation.images.front": [pictures(state[:, :7], "still") for state in vectors["observation.state"][1]]
    }
    found = look(write_lerobot(tmp_path / "raw", vectors, videos, robot=robot))
    asked = {question.name for question in found.questions}
    assert ("embodiment" in asked) == (embodiment is None)
    if embodiment is not None:
        assert found.source["embodiment"] == embodiment
    track = arms_of(found)[0]["state"]
    assert ("indices" in track["joints"]) == (names is None)
    if ends is not None:
        assert {end: track["gripper"][end] for end in ("closed", "open")} == ends
    else:
        assert {"right_gripper_closed", "right_gripper_open"} <= asked
    assert (found.trains, found.source.get("split")) == ((False, "test") if robot == "droid" else (True, None))


def test_a_gripper_that_squeezes_tells_which_end_is_closed(tmp_path: Path) -> None:
    states = seven(low=0.02, high=0.97)
    held = [np.concatenate([s[:, :7], np.maximum(s[:, 7:], 0.3)], axis=1) for s in states]
    vectors = {"observation.state": (None, held), "action": (None, states)}
    videos = {"observation.images.front": [pictures(state[:, :7], "still") for state in states]}
    found = look(write_lerobot(tmp_path / "raw", vectors, videos, robot="franka"))
    assert (arms_of(found)[0]["state"]["gripper"]["closed"], found.questions) == (0, [])
    assert "squeezes" in found.evidence["arms", "right", "state", "gripper"]


def test_what_is_unknown_is_refused_by_name_until_it_is_filled_in(tmp_path: Path) -> None:
    vectors = {"observation.state": ([f"motor_{i}" for i in range(8)], seven(low=0.02, high=0.97))}
    videos = {
        "observation.images.front": [pictures(state[:, :7], "still") for state in vectors["observation.state"][1]]
    }
    _, path = init(write_lerobot(tmp_path / "raw", vectors, videos, robot=None), tmp_path)
    said = r"(?s)todo\.embodiment: .*franka_panda.*todo\.right_gripper_closed: .*todo\.right_gripper_open"
    with pytest.raises(ConfigError, match=said):
        PipelineConfig.load(None, path)
    text = path.read_text()
    for name, value in (("embodiment", "franka_panda"), ("right_gripper_closed", "0"), ("right_gripper_open", "1")):
        line = next(line for line in text.splitlines() if line.startswith(f"  {name}: &{name} "))
        text = text.replace(line, f"  {name}: &{name} {value}")
    path.write_text(text)
    counts, _ = run(path, tmp_path)
    assert counts["kept"] == 3


@pytest.mark.parametrize(
    ("cameras", "views"),
    [
        ({"camera_1": "still", "camera_2": "wrist"}, {"camera_1": "head", "camera_2": "right_wrist"}),
        ({"phone": "wrist", "laptop": "still"}, {"laptop": "head", "phone": "right_wrist"}),
        ({"side": "still", "top": "still", "hand_eye": "wrist"}, {"top": "head", "hand_eye": "right_wrist"}),
        ({"wrist": "wrist"}, {"wrist": "head"}),
        ({"exterior_1_left": "still", "wrist_left": "wrist"}, {"exterior_1_left": "head", "wrist_left": "right_wrist"}),
    ],
    ids=["by-motion", "by-motion-turned-round", "by-name", "one", "stereo"],
)
def test_views_by_name_and_by_motion(tmp_path: Path, cameras: dict[str, str], views: dict[str, str]) -> None:
    keyed = {f"observation.images.{name}": kind for name, kind in cameras.items()}
    found = look(write_so101(tmp_path / "raw", cameras=keyed))
    assert found.source["views"] == {f"observation.images.{name}": view for name, view in views.items()}
    assert all("details change" in found.evidence["views", key] for key in found.source["views"])


def test_published_sets(tmp_path: Path) -> None:
    """Galaxea's, RoboCOIN's and DROID's, whose columns, grippers and uses their readers' own configurations state."""
    write_galaxea(tmp_path / "galaxea")
    found = look(tmp_path / "galaxea")
    assert found.source["views"]["observation.images.left_wrist_rgb"] == "left_wrist"
    assert [arm["state"]["joints"]["feature"] for arm in arms_of(found)] == [
        "observation.state.left_arm", "observation.state.right_arm",
    ]  # fmt: skip
    assert [arm["action"]["gripper"]["open"] for arm in arms_of(found)] == [100, 100]
    write_robocoin(tmp_path / "robocoin")
    found = look(tmp_path / "robocoin")
    assert arms_of(found)[0]["state"]["joints"]["columns"] == [f"left_arm_joint_{i}_rad" for i in range(1, 7)]
    assert arms_of(found)[1]["state"]["gripper"] == {
        "feature": "observation.state", "columns": ["right_gripper_open_scale"], "closed": 0, "open": 1,
    }  # fmt: skip
    write_droid(tmp_path / "raw")
    found = look(tmp_path / "raw")
    assert (found.source["embodiment"], found.trains, found.questions) == ("droid_franka", False, [])
    assert arms_of(found)[0]["state"]["gripper"]["closed"] == 1
    assert found.source["success_column"] == "is_episode_successful"


def test_wrist_cameras_over_a_plain_table_are_not_doubted(project_root: Path) -> None:
    for folder in sorted((project_root / "artifacts/shipped/recordings/datasets").iterdir()):
        found = look(folder)
        assert found.source["embodiment"] == folder.name
        assert not any("unusual" in text for text in found.evidence.values()), folder.name
        assert {arm["state"]["gripper"]["closed"] for arm in arms_of(found)} == {0}


def test_a_camera_whose_picture_contradicts_its_name_is_doubted(tmp_path: Path) -> None:
    cameras = {"observation.images.front": "still", "observation.images.wrist": "still"}
    found = look(write_so101(tmp_path / "raw", cameras=cameras))
    assert "unusual" in found.evidence["views", "observation.images.wrist"]
    assert "unusual" not in found.evidence["views", "observation.images.front"]


def test_an_action_that_is_no_joint_position_is_left_out(tmp_path: Path) -> None:
    states = so101_states()
    actions = [np.diff(state, axis=0, prepend=state[:1]) * 0.1 for state in states]
    found = look(write_so101(tmp_path / "raw", states=states, actions=actions))
    assert "action" not in arms_of(found)[0]
    assert "no joint position" in found.evidence["arms",]


def test_texts_of_others_are_no_yaml_and_no_escapes(tmp_path: Path) -> None:
    names = ["a: {b\n# c", "\x1b[31mred", "*elbow", "joint\u202e4", "- q", "gripper.pos"]
    write_so101(
        tmp_path / "raw",
        names=names,
        robot="so101\n  evil: true\x1b]0;x",
        cameras={"observation.images.fr\nont: x": "still"},
    )
    found, path = init(tmp_path / "raw", tmp_path)
    assert "\x1b" not in path.read_text()
    assert "\u202e" not in path.read_text()
    source = PipelineConfig.load(None, path).curate.sources[0]
    assert source.views == {"observation.images.fr\nont: x": "head"}  # type: ignore[union-attr]
    assert found.source["arms"][0]["state"]["joints"]["indices"] == [
        0,
        1,
        2,
        3,
        4,
    ]  # a name with a pattern's characters


def test_a_calibration_file_lets_controls_be_drawn(tmp_path: Path) -> None:
    write_so101(tmp_path / "raw", cameras={"observation.images.front": "still"})
    view = "{width: 64, height: 48, K: [[50, 0, 32], [0, 50, 24], [0, 0, 1]], maps: camera_to_base, axes: opencv, T: [[1, 0, 0, 0.4], [0, -1, 0, 0], [0, 0, -1, 0.8], [0, 0, 0, 1]]}"
    (tmp_path / "raw/meta/calibration.yaml").write_text(f"views: {{head: {view}}}\n")
    (tmp_path / "raw/README.md").write_text("---\nlicense: apache-2.0\n---\nlicense: nonsense\n")
    found, path = init(tmp_path / "raw", tmp_path)
    config = PipelineConfig.load(None, path)
    assert found.calibrated
    assert config.render_actions is not None
    assert config.train_stage2.native_size is None
    assert config.curate.sources[0].license == "Apache-2.0"


def test_a_collection_names_the_datasets_that_differ(tmp_path: Path) -> None:
    for name, fps in (("a", 30), ("b", 30), ("c", 15)):
        write_so101(tmp_path / "raw" / name, fps=fps)
    found, _ = init(tmp_path / "raw", tmp_path)
    assert found.source["collection"] is True
    assert any("source of their own: c" in note for note in found.notes)
    (tmp_path / "one").mkdir()
    (tmp_path / "raw/a").rename(tmp_path / "one/a")
    assert look(tmp_path / "one").source["path"] == str(tmp_path / "one/a")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda f: f["observation.state"].update(shape=[8], names=None), "fewer columns than the dataset says"),
        (lambda f: f.pop("observation.state"), "has no joints"),
        (lambda f: [f[key].update(info={"is_depth_map": True}) for key in list(f) if "images" in key], "no camera in colour"),
    ],
)  # fmt: skip
def test_metadata_that_contradict_the_files_are_named(tmp_path: Path, change: Any, said: str) -> None:
    write_so101(tmp_path / "raw")
    info = json.loads((tmp_path / "raw/meta/info.json").read_text())
    change(info["features"])
    (tmp_path / "raw/meta/info.json").write_text(json.dumps(info))
    with pytest.raises(DataError, match=said):
        look(tmp_path / "raw")


@pytest.mark.parametrize(
    ("frames", "fps", "note"),
    [
        ([np.tile(state[:1], (60, 1)) for state in so101_states()], 30, "No joint moves"),
        ([state[:2] for state in so101_states()], 30, "No joint moves"),
        ([np.where(np.arange(6) == 2, np.nan, state) for state in so101_states()], 30, None),
        ([np.where(np.arange(60)[:, None] == 7, np.inf, state) for state in so101_states()], 30, None),
    ],
    ids=["still", "two-frames", "nan", "inf"],
)
def test_odd_recordings_are_looked_at(tmp_path: Path, frames: list[np.ndarray], fps: int, note: str | None) -> None:
    finite = [np.nan_to_num(state, posinf=0.0) for state in frames]
    videos = {"observation.images.front": [pictures(state[:, :5], "still") for state in finite]}
    found = look(write_lerobot(tmp_path / "raw", {"observation.state": (SO_NAMES, frames)}, videos, fps=fps))
    assert found.source["embodiment"] == "so101"
    assert note is None or any(re.search(note, text) for text in found.notes)


def test_a_rate_that_the_time_stamps_contradict_is_said(tmp_path: Path) -> None:
    write_so101(tmp_path / "raw")
    path = tmp_path / "raw/meta/info.json"
    path.write_text(path.read_text().replace('"fps": 30', '"fps": 15'))
    assert any("15 fps, the time stamps 30" in note for note in look(tmp_path / "raw").notes)


def test_never_over_a_file_and_damaged_sets_are_one_error(tmp_path: Path) -> None:
    write_so101(tmp_path / "raw")
    init(tmp_path / "raw", tmp_path)
    with pytest.raises(ConfigError, match=r"(?s)there already.*my\.yaml.*--output"):
        init(tmp_path / "raw", tmp_path)
    for path in (tmp_path / "raw/data").rglob("*.parquet"):
        path.write_bytes(b"PAR1 no parquet")
    with pytest.raises(DataError, match="No episode of the dataset can be read"):
        discover(tmp_path / "raw")
    (tmp_path / "raw/meta/info.json").write_text("{")
    with pytest.raises(DataError, match=r"not valid JSON"):
        look(tmp_path / "raw")
