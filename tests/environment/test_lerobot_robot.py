"""The simulator as a robot of LeRobot, and recorded commands as its teleoperator, without LeRobot's commands."""

import importlib
import logging

import numpy as np
import pytest
import yaml
from PIL import Image

pytest.importorskip("lerobot")
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from worldline_core.config import read_yaml
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.sources.calibration_file import read_calibration
from worldline_core.errors import ConfigError, DataError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics

ROBOT = "ur5e_silver"


@pytest.fixture(scope="module")
def plugin(project_root):
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(project_root / "packaging" / "lerobot_robot_worldline")
        yield importlib.import_module("lerobot_robot_worldline")


@pytest.fixture
def robot(plugin, small_world, tmp_path, monkeypatch):
    monkeypatch.setattr(plugin.robot.WorldLine, "from_pretrained", lambda *_, **__: small_world)
    made = plugin.WorldLineRobot(plugin.WorldLineRobotConfig(calibration_dir=tmp_path))
    yield made
    if made.is_connected:
        made.disconnect()


@pytest.fixture
def replay(plugin, tmp_path):
    made = plugin.WorldLineReplay(plugin.WorldLineReplayConfig(calibration_dir=tmp_path))
    made.connect()
    yield made
    made.disconnect()


def begun(world, starts, seed):
    start = starts[seed]
    return world.start(start.images, start.cameras, embodiment=ROBOT, state=start.state, seed=seed)


@pytest.fixture
def announcements():
    """Messages of every level reach the robot, as LeRobot's commands let them."""
    root = logging.getLogger()
    level = root.level
    root.setLevel(logging.NOTSET)
    yield
    root.setLevel(level)


def test_a_robot_is_driven_as_a_simulation(robot, replay, small_world, starts):
    assert robot.action_features == replay.action_features
    assert list(robot.action_features)[:2] == ["left_shoulder_pan_joint.pos", "left_shoulder_lift_joint.pos"]
    pictures = dict.fromkeys(VIEWS, (64, 96, 3))
    assert robot.observation_features == {**dict.fromkeys(robot.action_features, float), **pictures}
    robot.connect()
    simulation = begun(small_world, starts, 0)
    before, block = simulation.pictures[0]["head"], starts.commands(0)[:4]
    after = simulation.step(block)[0]["head"][-1]
    for number, command in enumerate(block):
        observation = robot.get_observation()
        assert list(observation) == list(robot.observation_features)
        assert np.array_equal(observation["head"], before)
        assert all(type(observation[name]) is float for name in robot.action_features)
        action = replay.get_action()
        np.testing.assert_array_equal(list(action.values()), command)
        sent = robot.send_action(action)
        np.testing.assert_array_equal(list(sent.values()), simulation.commands[0, number])
        state = [robot.get_observation()[name] for name in robot.action_features]
        np.testing.assert_array_equal(state, simulation.states[0, number])
    assert np.array_equal(robot.get_observation()["head"], after)


def test_a_robot_is_connected_or_not(robot):
    for call in (robot.get_observation, robot.disconnect, lambda: robot.send_action({})):
        with pytest.raises(DeviceNotConnectedError, match="not connected"):
            call()
    robot.connect()
    assert robot.is_connected and robot.is_calibrated
    handlers = len(logging.getLogger().handlers)
    with pytest.raises(DeviceAlreadyConnectedError, match="already connected"):
        robot.connect()
    robot.disconnect()
    assert not robot.is_connected and len(logging.getLogger().handlers) == handlers - 1


def test_pictures_are_predicted_when_they_are_looked_at(robot, replay):
    """LeRobot sends robots home by hundreds of commands, whose pictures nobody sees."""
    robot.connect()
    for _ in range(10):
        robot.send_action(replay.get_action())
    assert robot._running.simulation.num_frames == 1
    robot.get_observation()
    assert robot._running.simulation.num_frames == 9
    assert len(robot._running.commands) == 2


def test_pictures_may_be_observed_more_often(plugin, robot, small_world, starts):
    robot.config.observe_every = 2
    robot.connect()
    commands = starts.commands(0)
    for command in commands[:2]:
        robot.send_action(robot._columns.named(command))
    held = commands[[0, 1, 1, 1]]
    assert np.array_equal(robot.get_observation()["head"], begun(small_world, starts, 0).step(held)[0]["head"][1])
    robot.disconnect()
    robot.config.observe_every = 3
    with pytest.raises(ConfigError, match=r"(?s)observe_every.*divisor of the model's 4 .*got: 3"):
        robot.connect()
    assert not robot.is_connected


def test_actions_of_other_robots_are_refused(robot, replay):
    robot.connect()
    action = replay.get_action()
    with pytest.raises(DataError, match=r"missing: left_elbow_joint.pos; unknown: shoulder_pan.pos"):
        robot.send_action({k: v for k, v in action.items() if k != "left_elbow_joint.pos"} | {"shoulder_pan.pos": 0.0})
    with pytest.raises(DataError, match=r"(?s)not finite.*left_gripper.pos.*nan"):
        robot.send_action(action | {"left_gripper.pos": float("nan")})
    # A command beyond what a joint reaches in a frame is executed as far as it can be.
    was = robot.get_observation()["left_elbow_joint.pos"]
    sent = robot.send_action(action | {"left_elbow_joint.pos": was + 3.0, "left_gripper.pos": 7.0})
    assert sent["left_elbow_joint.pos"] == pytest.approx(was + np.pi / 8)
    assert sent["left_gripper.pos"] == 1.0
    assert robot.get_observation()["left_elbow_joint.pos"] == sent["left_elbow_joint.pos"]


@pytest.mark.usefixtures("announcements")
def test_episodes_begin_where_lerobot_announces_them(robot, replay, small_world, starts):
    robot.connect()
    assert starts.commands(0)[0].tolist() != starts.commands(1)[0].tolist()
    for episode in (0, 1, 1, 0):
        simulation = begun(small_world, starts, episode)
        logging.info("Recording episode %d", episode)
        observation = robot.get_observation()
        assert np.array_equal(observation["head"], simulation.pictures[0]["head"])
        assert observation["left_elbow_joint.pos"] == simulation.state[0, 2]
        assert list(replay.get_action().values()) == starts.commands(episode)[0].tolist()
        robot.send_action(replay.get_action())
        logging.info("Reset the environment")
        assert robot._running.age == 1
    # After its last command a recording stays there.
    last = [replay.get_action() for _ in range(len(starts.commands(0)))][-1]
    assert list(last.values()) == starts.commands(0)[-1].tolist()


@pytest.mark.usefixtures("announcements")
def test_cameras_of_an_episode_are_written_into_its_dataset(robot, replay, starts, tmp_path):
    recorded = tmp_path / "recorded"
    robot.config.dataset_root = str(recorded)
    robot.connect()
    for episode in (0, 1):
        logging.info("Recording episode %d", episode)
        for _ in range(3):
            robot.get_observation()
            robot.send_action(replay.get_action())
        logging.info("Reset the environment" if episode == 0 else "Stop recording")
        if episode == 0:
            with pytest.raises(DataError, match=r"(?s)No dataset.*folder of --dataset.root"):
                robot.get_observation()
            (recorded / "meta").mkdir(parents=True)
            (recorded / "meta" / "info.json").write_text("{}")
    robot.disconnect()
    camera = read_calibration(recorded, "meta/cameras/000001.json")["head"]
    np.testing.assert_allclose(camera.T, starts[1].cameras["head"].T_base_camera[None], atol=1e-6)
    np.testing.assert_array_equal(camera.K, starts[1].cameras["head"].K)
    source = read_yaml(recorded / "curate.yaml")["curate"]["sources"][0]
    assert source["grippers"]["left_gripper.pos"] == {"closed": 0.0, "open": 1.0}
    assert source["angle_unit"] == "rad"
    assert source["views"] == {f"observation.images.{view}": view for view in VIEWS}


@pytest.mark.parametrize(("interval", "warned"), [(1 / 30, True), (1 / 8, False)])
def test_commands_at_another_rate_are_told(plugin, robot, replay, caplog, monkeypatch, interval, warned):
    robot.connect()
    clock = iter(np.arange(100) * interval)
    monkeypatch.setattr(plugin.robot.time, "perf_counter", lambda: next(clock))
    for _ in range(30):
        robot.send_action(replay.get_action())
    found = [record.getMessage() for record in caplog.records if "--dataset.fps=8" in record.getMessage()]
    assert len(found) == warned
    assert not warned or "at 30 Hz" in found[0]


def test_units_and_names_are_those_of_leader_arms(plugin):
    """LeRobot's SO-101 leader sends these names, degrees, and a gripper of 0 to 100."""
    kinematics = ArmKinematics(load_embodiment("so101"))
    leader = plugin.device.Columns(kinematics, use_degrees=True)
    joints = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
    assert leader.names == [f"{name}.pos" for name in joints]
    row = np.array([0.1, -0.2, 0.3, 0.4, -0.5, 0.25])
    sent = leader.named(row)
    np.testing.assert_allclose(list(sent.values()), [*np.degrees(row[:5]), 25.0])
    np.testing.assert_allclose(leader.values(sent), row)
    np.testing.assert_array_equal(list(plugin.device.Columns(kinematics, use_degrees=False).named(row).values()), row)


def test_a_robot_begins_at_given_pictures(robot, small_world, starts, tmp_path):
    start, folder, entries = starts[1], tmp_path, {}
    for view, camera in start.cameras.items():
        Image.fromarray(start.images[view]).save(folder / f"{view}.png")
        height, width = start.images[view].shape[:2]
        entries[view] = {"width": width, "height": height, "K": camera.K.tolist(), "T": camera.T_base_camera.tolist()}
        entries[view] |= {"maps": "camera_to_base", "axes": "opencv"}
    (folder / "calibration.yaml").write_text(yaml.safe_dump({"views": entries}))
    state = dict(zip(load_embodiment(ROBOT).state_names, start.state.tolist(), strict=True))
    (folder / "state.yaml").write_text(yaml.safe_dump(state))
    robot.config.observation, robot.config.seed = str(folder), 1
    robot.connect()
    simulation = begun(small_world, starts, 1)
    assert np.array_equal(robot.get_observation()["head"], simulation.pictures[0]["head"])
    for command in starts.commands(1)[:4]:
        robot.send_action(robot._columns.named(command))
    assert np.array_equal(robot.get_observation()["head"], simulation.step(starts.commands(1)[:4])[0]["head"][-1])
