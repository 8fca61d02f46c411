"""`worldline init` on LeRobot datasets: columns, arms, units, grippers, robots and cameras, and the file that is written."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.data.published_lerobot import write_droid, write_galaxea, write_robocoin
from tests.discovery.recorded_sets import (
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
from worldline_core.discovery.arms import columns_of, find_arms
from worldline_core.discovery.findings import Discovery, write_config
from worldline_core.discovery.look import discover, look
from worldline_core.errors import ConfigError, DataError
from worldline_core.filters.filter import filter_episodes
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.pipeline.pipeline_config import PipelineConfig


def init(tmp_path: Path) -> tuple[Discovery, Path]:
    """Look at the recordings in ``raw`` and write the file beside it."""
    found = look(tmp_path / "raw")
    write_config(found, tmp_path / "my.yaml", str(tmp_path / "raw"))
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
    found, path = init(tmp_path)
    assert (found.source["angle_unit"], found.source["embodiment"], found.questions) == ("deg", "so101", [])
    assert found.views == ["head", "right_wrist"]
    config = PipelineConfig.load(None, path)
    assert (config.render_actions, config.train_stage2.native_size) == (None, 6)
    if version != "v3.0":
        return
    counts, curated = run(path, tmp_path)
    assert (counts["found"], counts["kept"]) == (4, 4)
    assert {row.fps for row in curated.rows} == {30.0}  # two seconds: every frame is kept for a clip
    assert {row.split for row in EpisodeSet.open(tmp_path / "curated").rows} == {"train", "validation", "test"}
    first = next(i for i, row in enumerate(curated.rows) if row.episode_id.endswith("000000"))
    state, expected = curated.episode(first).state, so101_states()[0]
    expected = np.column_stack([np.deg2rad(expected[:, :5]), expected[:, 5] / 100])
    assert any(np.allclose(expected[i : i + len(state)], state, atol=1e-5) for i in range(61 - len(state)))


def test_an_aloha_of_two_arms_and_three_cameras(tmp_path: Path) -> None:
    write_aloha(tmp_path / "raw")
    found, path = init(tmp_path)
    assert (found.source["embodiment"], found.source["angle_unit"]) == ("aloha", "rad")
    assert found.source["views"] == {
        f"observation.images.cam_{name}": view
        for name, view in (("high", "head"), ("left_wrist", "left_wrist"), ("right_wrist", "right_wrist"))
    }
    assert PipelineConfig.load(None, path).curate.stride == 2  # 80 frames: not every sixth, as 8 a second would be
    assert run(path, tmp_path)[0]["kept"] == 4


def arms_of(found: Discovery) -> list[dict[str, Any]]:
    return found.source["arms"]


@pytest.mark.parametrize(
    ("prepare", "size", "robot", "unit", "doubtful"),
    [
        (np.asarray, 80, "so101_follower", "deg", True),
        (np.asarray, 80, "koch_follower", "range_m100_100", True),
        (lambda state: state.clip(-100, 100), 400, "so101_follower", "range_m100_100", False),
        (np.round, 50, "koch_follower", "range_m100_100", False),
        (np.asarray, 200, "so100_follower", "deg", False),
        (np.asarray, 1, "so101_follower", "rad", False),
    ],
    ids=["simulated", "simulated-koch", "cut-off", "coarse", "beyond-100", "radians"],
)
def test_units_of_lerobots_own_arms(tmp_path, prepare, size, robot, unit, doubtful):
    states = [np.column_stack([prepare(motion(5, 60, seed, size=size)), gripper(60)]) for seed in range(3)]
    found = look(write_so101(tmp_path / "raw", states=states, robot=robot))
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
    found, path = init(tmp_path)
    assert arms_of(found)[0]["state"]["joints"]["zeros"] == [0, 90, 90, 0, 0]
    curate(PipelineConfig.load(None, path).curate, {}, tmp_path / "curated")
    curated = EpisodeSet.open(tmp_path / "curated")
    states = np.concatenate([curated.episode(i).state[:, 1] for i in range(len(curated.rows))])
    lift = np.deg2rad(np.concatenate(new)[:, 1])
    assert (states.min(), states.max()) == pytest.approx((lift.min(), lift.max()), abs=0.05)


def test_leader_and_follower_sides_and_mirrored_joints_are_told_apart_by_their_names(tmp_path: Path) -> None:
    both = [np.concatenate([state, state + 1], axis=1) for state in so101_states()]
    videos = {"observation.images.top": [pictures(state[:, :5], "still") for state in both]}

    def found(name: str, prefixes: tuple[str, str], robot: str, **vectors: Any) -> list[dict[str, Any]]:
        names = [f"{prefix}_{name}" for prefix in prefixes for name in SO_NAMES]
        vectors = {"observation.state": (names, both)} | vectors
        return arms_of(look(write_lerobot(tmp_path / name, vectors, videos, robot=robot)))

    action = [f"leader_{name}" for name in SO_NAMES], [state[:, :6] for state in both]
    (only,) = found("roles", ("leader", "follower"), "so101_follower", action=action)
    assert only["state"]["joints"]["columns"][0] == "follower_shoulder_pan.pos"
    assert only["action"]["joints"]["columns"][0] == "leader_shoulder_pan.pos"
    # One side alone is a single arm; of two sides the left comes first, whatever the order of columns.
    arms = found("sides", ("right", "left"), "bi_so_follower")
    assert [each["name"] for each in arms] == ["left", "right"]
    assert arms[0]["state"]["joints"]["columns"][0] == "left_shoulder_pan.pos"
    # A mirrored ViperX: its elbow is beyond the limits unless it counts the other way.
    names = [f"{side}_{name}" for side in ("left", "right") for name in (*ALOHA, "gripper")]
    turned = [np.tile(np.column_stack([motion(6, 60, s, size=0.1), gripper(60, 0, 1)]), 2) for s in range(3)]
    for state in turned:  # the right arm's wrist_angle
        state[:, 11] = -load_embodiment("aloha").arms[0].limits[4][1] + 0.05 * motion(1, 60)[:, 0]
    arms = found("mirrored", ("left", "right"), "aloha", **{"observation.state": (names, turned)})
    assert "signs" not in arms[0]["state"]["joints"]
    assert arms[1]["state"]["joints"]["signs"] == [1, 1, 1, 1, -1, 1]


def seven(root: Path, names: list[str] | None, robot: str | None, *, squeezed: bool = False) -> Path:
    """Seven joints and a gripper before one camera; squeezed: the fingers stop at a thing, the command goes on."""
    pose = np.array([0.0, -0.3, 0.0, -2.0, 0.0, 2.0, 0.5])
    states = [np.column_stack([pose + motion(7, 60, seed, size=0.3), gripper(60, 0.02, 0.97)]) for seed in range(3)]
    vectors: dict[str, Any] = {"observation.state": (names, states)}
    if squeezed:
        held = [np.column_stack([state[:, :7], np.maximum(state[:, 7], 0.3)]) for state in states]
        vectors = {"observation.state": (names, held), "action": (names, states)}
    videos = {"observation.images.front": [pictures(state[:, :7], "still") for state in states]}
    return write_lerobot(root, vectors, videos, robot=robot)


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
def test_robots_are_matched_and_what_nothing_says_is_asked(tmp_path, names, robot, embodiment, ends):
    found = look(seven(tmp_path / "raw", names, robot))
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
    found = look(seven(tmp_path / "raw", None, "franka", squeezed=True))
    assert (arms_of(found)[0]["state"]["gripper"]["closed"], found.questions) == (0, [])
    assert "squeezes" in found.evidence["arms", "right", "state", "gripper"]


def test_what_is_unknown_is_refused_by_name_until_it_is_filled_in(tmp_path: Path) -> None:
    seven(tmp_path / "raw", [f"motor_{i}" for i in range(8)], None)
    _, path = init(tmp_path)
    said = r"(?s)todo\.embodiment: .*franka_panda.*todo\.right_gripper_closed: .*todo\.right_gripper_open"
    with pytest.raises(ConfigError, match=said):
        PipelineConfig.load(None, path)
    text = path.read_text()
    for name, value in (("embodiment", "franka_panda"), ("right_gripper_closed", "0"), ("right_gripper_open", "1")):
        text = re.sub(rf"(?m)^(  {name}: &{name}) .*", rf"\1 {value}", text)
    path.write_text(text)
    assert run(path, tmp_path)[0]["kept"] == 3


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
    for write in (write_galaxea, write_robocoin, write_droid):
        write(tmp_path / write.__name__)
    galaxea, robocoin, droid = (look(tmp_path / f"write_{name}") for name in ("galaxea", "robocoin", "droid"))
    assert galaxea.source["views"]["observation.images.left_wrist_rgb"] == "left_wrist"
    features = [arm["state"]["joints"]["feature"] for arm in arms_of(galaxea)]
    assert features == ["observation.state.left_arm", "observation.state.right_arm"]
    assert [arm["action"]["gripper"]["open"] for arm in arms_of(galaxea)] == [100, 100]
    assert arms_of(robocoin)[0]["state"]["joints"]["columns"] == [f"left_arm_joint_{i}_rad" for i in range(1, 7)]
    assert arms_of(robocoin)[1]["state"]["gripper"] == {
        "feature": "observation.state", "columns": ["right_gripper_open_scale"], "closed": 0, "open": 1,
    }  # fmt: skip
    assert (droid.source["embodiment"], droid.trains, droid.questions) == ("droid_franka", False, [])
    assert arms_of(droid)[0]["state"]["gripper"]["closed"] == 1
    assert droid.source["success_column"] == "is_episode_successful"


def test_wrist_cameras_over_a_plain_table_are_not_doubted(project_root: Path) -> None:
    for folder in sorted((project_root / "artifacts/shipped/recordings/datasets").iterdir())[::2]:
        found = look(folder)
        assert found.source["embodiment"] == folder.name
        assert not any("unusual" in text for text in found.evidence.values()), folder.name
        assert {arm["state"]["gripper"]["closed"] for arm in arms_of(found)} == {0}


def test_texts_of_others_are_no_yaml_and_no_escapes(tmp_path: Path) -> None:
    names = ["a: {b\n# c", "\x1b[31mred", "*elbow", "joint\u202e4", "- q", "gripper.pos"]
    key = "observation.images.fr\nont: x"
    write_so101(tmp_path / "raw", names=names, robot="so101\n  evil: true\x1b]0;x", cameras={key: "still"})
    found, path = init(tmp_path)
    assert not {"\x1b", "\u202e"} & set(path.read_text())
    assert PipelineConfig.load(None, path).curate.sources[0].views == {key: "head"}  # type: ignore[union-attr]
    assert arms_of(found)[0]["state"]["joints"]["indices"] == [0, 1, 2, 3, 4]  # a name with a pattern's characters


@pytest.mark.parametrize("wrist", [False, True], ids=["every view", "one of two views"])
def test_a_calibration_file_lets_controls_be_drawn(tmp_path: Path, wrist: bool) -> None:
    cameras = {"observation.images.front": "still"} | ({"observation.images.wrist": "wrist"} if wrist else {})
    write_so101(tmp_path / "raw", cameras=cameras)
    view = {"width": 64, "height": 48, "K": [[50, 0, 32], [0, 50, 24], [0, 0, 1]], "maps": "camera_to_base"}
    view |= {"axes": "opencv", "T": [[1, 0, 0, 0.4], [0, -1, 0, 0], [0, 0, -1, 0.8], [0, 0, 0, 1]]}
    (tmp_path / "raw/meta/calibration.yaml").write_text(json.dumps({"views": {"head": view}}))
    (tmp_path / "raw/README.md").write_text("---\nlicense: apache-2.0\n---\nlicense: nonsense\n")
    found, path = init(tmp_path)
    config = PipelineConfig.load(None, path)
    assert (found.cameras, found.head_camera) == ("some" if wrist else "all", True)
    assert config.render_actions is not None
    assert config.train_stage2.native_size == (6 if wrist else None)  # the view without a camera takes the vectors
    assert config.curate.sources[0].license == "Apache-2.0"


def test_a_collection_names_the_datasets_that_differ(tmp_path: Path) -> None:
    for name, fps in (("a", 30), ("b", 30), ("c", 15)):
        write_so101(tmp_path / "raw" / name, fps=fps)
    found, _ = init(tmp_path)
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
    ("states", "note"),
    [
        ([np.tile(state[:1], (60, 1)) for state in so101_states()], "No joint moves"),
        ([state[:2] for state in so101_states()], "No joint moves"),
        ([np.where(np.arange(6) == 2, np.nan, state) for state in so101_states()], ""),
        ([np.where(np.arange(60)[:, None] == 7, np.inf, state) for state in so101_states()], ""),
    ],
    ids=["still", "two-frames", "nan", "inf"],
)
def test_odd_recordings_are_looked_at(tmp_path: Path, states: list[np.ndarray], note: str) -> None:
    videos = {"observation.images.front": [pictures(np.nan_to_num(s[:, :5], posinf=0.0), "still") for s in states]}
    found = look(write_lerobot(tmp_path / "raw", {"observation.state": (SO_NAMES, states)}, videos))
    assert found.source["embodiment"] == "so101"
    assert not note or any(note in text for text in found.notes)


def test_contradictions_are_said(tmp_path: Path) -> None:
    """Between a camera's name and its picture, an action and the joints, the rate and the time stamps."""
    states = so101_states()
    steps = [0.1 * np.diff(state, axis=0, prepend=state[:1]) for state in states]
    cameras = {"observation.images.front": "still", "observation.images.wrist": "still"}
    write_so101(tmp_path / "raw", states=states, actions=steps, cameras=cameras)
    found = look(tmp_path / "raw")
    assert "unusual" in found.evidence["views", "observation.images.wrist"]
    assert "unusual" not in found.evidence["views", "observation.images.front"]
    assert "action" not in arms_of(found)[0]
    assert "no joint position" in found.evidence["arms",]
    path = tmp_path / "raw/meta/info.json"
    path.write_text(path.read_text().replace('"fps": 30', '"fps": 15'))
    assert any("15 fps, the time stamps 30" in note for note in look(tmp_path / "raw").notes)


def test_damaged_sets_are_one_error(tmp_path: Path) -> None:
    write_so101(tmp_path / "raw")
    for path in (tmp_path / "raw/data").rglob("*.parquet"):
        path.write_bytes(b"PAR1 no parquet")
    with pytest.raises(DataError, match="No episode of the dataset can be read"):
        discover(tmp_path / "raw")
    (tmp_path / "raw/meta/info.json").write_text("{")
    with pytest.raises(DataError, match=r"not valid JSON"):
        look(tmp_path / "raw")


SO = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"]
VIPERX = ["waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate"]
G1_ARM = ["ShoulderPitch", "ShoulderRoll", "ShoulderYaw", "Elbow", "WristRoll", "WristPitch", "WristYaw"]
G1_LEGS = [f"k{side}{joint}.q" for side in ("Left", "Right") for joint in ("HipPitch", "HipYaw", "Knee", "AnklePitch")]


def both(names: list[str], form: str = "{side}_{name}") -> list[str]:
    return [form.format(side=side, Side=side.title(), name=name) for side in ("left", "right") for name in names]


CASES: dict[str, tuple[list[str], list[tuple[int, str | None]]]] = {
    "so101_follower": ([f"{n}.pos" for n in (*SO, "gripper")], [(5, "gripper.pos")]),
    "so100 before PR 777": ([f"main_{n}" for n in (*SO, "gripper")], [(5, "main_gripper")]),
    "bi_so_follower": ([f"{n}.pos" for n in both([*SO, "gripper"])], [(5, "left_gripper.pos"), (5, "right_gripper.pos")]),
    "lekiwi": ([*(f"arm_{n}.pos" for n in (*SO, "gripper")), "x.vel", "y.vel", "theta.vel"], [(5, "arm_gripper.pos")]),
    "aloha": (both([*VIPERX, "gripper"]), [(6, "left_gripper"), (6, "right_gripper")]),
    "trossen stationary": (
        both(["waist", "shoulder", "shoulder_shadow", "elbow", "elbow_shadow", *VIPERX[3:], "gripper"]),
        [(6, "left_gripper"), (6, "right_gripper")],
    ),
    "trossen ai": (
        [f"{n}.pos" for n in both([*(f"joint_{i}" for i in range(6)), "left_carriage_joint"])],
        [(6, "left_left_carriage_joint.pos"), (6, "right_left_carriage_joint.pos")],
    ),
    "unitree_g1 of lerobot": (
        [*G1_LEGS, "kWaistYaw.q", *both(G1_ARM, "k{Side}{name}.q"), "imu.quat.w"],
        [(7, None), (7, None)],
    ),
    "unitree_g1 with dex1": (
        [*both(G1_ARM, "k{Side}{name}"), "kLeftGripper", "kRightGripper"],
        [(7, "kLeftGripper"), (7, "kRightGripper")],
    ),
    "xarm": ([*(f"joint{i}.pos" for i in range(1, 8)), "gripper.pos"], [(7, "gripper.pos")]),
    "droid": ([*(f"joint_{i}" for i in range(7)), "gripper"], [(7, "gripper")]),
    "panda of ROS": ([*(f"panda_joint{i}" for i in range(1, 8)), "panda_finger_joint1", "panda_finger_joint2"], [(7, "panda_finger_joint1")]),
    "openarm": ([f"{n}.pos" for n in both([*(f"joint_{i}" for i in range(1, 8)), "gripper"])], [(7, "left_gripper.pos"), (7, "right_gripper.pos")]),
    "viperx alone": ([*VIPERX, "gripper"], [(6, "gripper")]),
    "left arm alone": ([f"left_{n}" for n in (*VIPERX, "gripper")], [(6, "left_gripper")]),
    "poses alone": (["x", "y", "z", "roll", "pitch", "yaw", "gripper"], []),
    "motor_0 ..": ([f"motor_{i}" for i in range(14)], [(6, "motor_6"), (6, "motor_13")]),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_arms_and_grippers_by_their_names(name: str) -> None:
    names, expected = CASES[name]
    arms, why = find_arms(columns_of("observation.state", names, len(names), "observation.state"))
    found: list[Any] = [(len(arm.joints), arm.gripper and arm.gripper.name) for arm in arms]
    assert found == expected, why
    assert [arm.side for arm in arms] == {0: [], 1: ["right"], 2: ["left", "right"]}[len(arms)]
