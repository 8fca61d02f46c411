"""Simulations that are stepped: what they predict, how they branch, and where the robot is beside the pictures."""

from dataclasses import replace

import numpy as np
import pytest

from tests.rollout.conftest import ROBOT
from worldline_core import Camera, WorldLine
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.rollout.recorded_starts import RecordedStarts
from worldline_core.rollout.robot import CommandedRobot

ARMS = load_embodiment(ROBOT)
GRIPPERS = [ARMS.gripper_column(arm) for arm in ARMS.arms]


@pytest.fixture(scope="module")
def shipped(project_root):
    return project_root / "artifacts" / "shipped"


@pytest.fixture(scope="module")
def recordings(shipped):
    return EpisodeSet.open(shipped / "recordings")


@pytest.fixture
def start(held_out):
    return held_out[0]


@pytest.fixture(scope="module")
def causal(shipped):
    return WorldLine.from_pretrained(shipped / "models" / "causal")


def videos(simulation, controls):
    """All pictures of a simulation that is at its start, driven by ``(b, 1 + steps, j)``; row 0 belongs to the start."""
    pieces = [[{view: picture[None] for view, picture in clip.items()} for clip in simulation.pictures]]
    unit = simulation.frames_per_step
    pieces += [simulation.step(controls[:, begin : begin + unit]) for begin in range(1, controls.shape[1], unit)]
    return [
        {view: np.concatenate([piece[clip][view] for piece in pieces]) for view in simulation.views}
        for clip in range(len(simulation))
    ]


def equal(one, other):
    return list(one) == list(other) and all(np.array_equal(one[view], other[view]) for view in one)


def last(predicted):
    return {view: video[-1] for view, video in predicted.items()}


def test_steps_give_the_bytes_of_a_prediction(causal, start):
    """With mounts that the file knows and ones solved at the start."""
    wrists = {view: Camera(start.cameras[view].K) for view in ("left_wrist", "right_wrist")}
    for given in (replace(start, cameras=start.cameras | wrists), start):
        predicted = causal.predict(given.images, start.controls, given.cameras, embodiment=ROBOT)
        simulation = given.begin(causal)
        assert equal(videos(simulation, start.controls[None])[0], predicted)
        assert (simulation.num_frames, simulation.frames_per_step, simulation.fps) == (33, 16, 8.0)
        assert equal(simulation.pictures[0], last(predicted))
    # Limits change nothing of commands within them.
    assert equal(videos(start.begin(causal, limits=True), start.controls[None])[0], predicted)


def test_a_simulation_begins_in_the_middle_of_a_recording(causal, recordings):
    """The robot is where the earlier commands led it; wrist cameras, known at the first frame, have moved with their arms."""
    recorded = RecordedStarts(recordings.root, view_sets=[VIEWS], fps=8.0, embodiment=ROBOT, splits=("test",))
    name = recorded.rows[1].episode_id
    position = recordings.position(name)
    commands = recordings.episode(position).action.astype(np.float64)
    frame = int(np.abs(np.diff(commands[:, GRIPPERS], axis=0)).max(axis=1).argmax()) + 1  # a gripper is moving
    start = recorded.at(name, frame)
    assert np.array_equal(start.images["head"], recordings.frames(position, "head", [frame])[0])
    begun = {"embodiment": ROBOT, "state": start.state, "earlier": [start.earlier]}
    simulation = causal.start(start.images, start.cameras, **begun)
    followed = CommandedRobot(simulation._starts.kinematics, 8.0, commands[:1], limits=False)
    robot, _, states = followed.follow(commands[None, 1 : frame + 1])
    assert np.array_equal(simulation.state, states[:, -1])
    assert np.array_equal(simulation.commands[:, -1], robot.command)
    assert np.abs(simulation.state - robot.command)[:, GRIPPERS].max() > 0.05
    wrists = {view: Camera(camera.K) for view, camera in start.cameras.items() if view != "head"}
    mounted = causal.start(start.images, start.cameras | wrists, **begun)
    bare = [arm.model_copy(update={"wrist_camera": None}) for arm in ARMS.arms]
    unknown = ArmKinematics(ARMS.model_copy(update={"arms": tuple(bare)}))
    solved = causal.start(start.images, start.cameras, **begun | {"embodiment": unknown})
    for one in (simulation, solved):
        np.testing.assert_allclose(one.tracks[0].uv, mounted.tracks[0].uv, atol=0.2)
    driven = commands[frame + 1 : frame + 17]
    driven = np.concatenate((driven, np.repeat(driven[-1:], 16 - len(driven), axis=0)))
    assert equal(simulation.step(driven)[0], mounted.step(driven)[0])
    earlier = {"earlier": [start.earlier[:0], start.earlier]}
    branch = causal.start([start.images] * 2, [start.cameras] * 2, **begun | earlier)
    assert np.array_equal(branch.state, np.stack((start.state, states[0, -1])))
    for wrong, said in (
        ([start.earlier] * 2, "do not fit together"), ([start.earlier[:, 1:]], "wrong length"),
        ([np.full_like(start.earlier, 90.0)], "limit"),
    ):  # fmt: skip
        with pytest.raises(DataError, match=said):
            causal.start(start.images, start.cameras, **begun | {"earlier": wrong})


def test_stage2_is_stepped_clip_by_clip(shipped, start):
    folder = shipped / "models" / "stage2"
    world = WorldLine.from_pretrained(folder, steps=1, clip_frames=17)
    predicted = world.predict(start.images, start.controls, start.cameras, embodiment=ROBOT)
    simulation = start.begin(world)
    simulation.step(start.controls[None, 1:17])
    branches = simulation.fork(2)
    simulation.step(start.controls[None, 17:])
    assert equal(simulation.pictures[0], last(predicted))
    branches.step(np.stack((start.controls[17:], start.controls[17:] + 0.05)))
    assert [equal(found, simulation.pictures[0]) for found in branches.pictures] == [True, False]
    assert start.begin(WorldLine.from_pretrained(folder, steps=1)).frames_per_step == 32


def test_clips_of_a_batch_are_those_of_single_simulations(causal, held_out):
    controls = np.stack([start.controls[:17] for start in held_out])
    images, cameras = ([getattr(start, name) for start in held_out] for name in ("images", "cameras"))
    batch = causal.start(images, cameras, embodiment=ROBOT, state=controls[:, 0], seed=[1, 2])
    together = videos(batch, controls)
    for clip, start in enumerate(held_out):
        alone = start.begin(causal, seed=clip + 1)
        assert equal(videos(alone, controls[clip : clip + 1])[0], together[clip])
        assert np.array_equal(batch.tool_poses[clip], alone.tool_poses[0])


@pytest.mark.slow
def test_branches_share_their_history_and_equal_separate_rollouts(causal, start):
    shared, own = start.controls[None, 1:17], start.controls[17:33]
    ways = np.stack([own, own[:1] + 0 * own, own + 0.1 * np.linspace(0, 1, 16)[:, None]])
    simulation = start.begin(causal)
    simulation.step(shared)
    snapshot, branches = simulation.copy(), simulation.fork(3)
    cache = branches._session._sampler.cache
    assert {len(keys) for block in cache.window.blocks for keys, _ in block.layers.values()} == {1}
    forked = branches.step(ways)
    for clip, controls in enumerate(ways):
        separate = start.begin(causal)
        separate.step(shared)
        assert equal(separate.step(controls[None])[0], forked[clip])
    # What was forked and what was kept go on by themselves, and so do branches that are chosen.
    assert equal(simulation.step(ways[:1])[0], forked[0])
    assert equal(snapshot.step(ways[2:])[0], forked[2])
    chosen = branches.select([2, 0])
    assert equal(chosen.pictures[0], branches.pictures[2])
    assert np.array_equal(chosen.state, branches.state[[2, 0]])
    later = np.repeat(ways[[2, 0], -1:], 16, axis=1)
    assert equal(chosen.copy().step(later)[0], chosen.step(later)[0])
    seeded = [branches.fork(1, seeds=seeds).step(ways)[2] for seeds in ([7, 8, 9], [7, 8, 1])]
    assert not equal(*seeded)


def test_commands_are_held_within_the_robots_limits(causal, start):
    elbow, gripper = ARMS.joint_columns(ARMS.arms[0]).start + 2, GRIPPERS[0]
    wild, begun = start.held({elbow: 9.0, gripper: -0.5}), start.controls[0]
    simulation, free = start.begin(causal, limits=True), start.begin(causal)
    for one in (simulation, free):
        one.step(wild)
    # pi rad/s at 8 frames per second, up to the limit of pi rad; an opening of 0..1 within 0.4 s of closing.
    expected = wild.copy()
    expected[:, elbow] = np.minimum(begun[elbow] + np.pi / 8 * np.arange(1, 17), 3.14159)
    expected[:, gripper] = 0
    np.testing.assert_allclose(simulation.commands[0], expected)
    closing = np.maximum(begun[gripper] - 1 / (0.4 * 8) * np.arange(1, 17), 0)
    np.testing.assert_allclose(simulation.states[0, :, gripper], closing, atol=1e-12)
    tools = ArmKinematics(ARMS).tool_poses(simulation.commands[0, -1:])[0].numpy()
    np.testing.assert_allclose(simulation.tool_poses[0], tools, atol=1e-6)
    assert np.array_equal(free.commands[0], wild)
    assert not equal(free.pictures[0], simulation.pictures[0])
    assert simulation.tracks[0].num_frames == 16


def test_a_limit_never_moves_a_robot_that_began_beyond_it():
    begun = np.zeros((1, 6))
    begun[0, 1] = 9.0
    robot = CommandedRobot(ArmKinematics(load_embodiment("so101")), 8.0, begun, limits=True)
    after, executed, _ = robot.follow(begun[:, None] + 0)
    assert np.array_equal(executed[:, 0], begun) and np.array_equal(after.state, begun)


def test_maps_show_the_states_where_the_model_was_trained_on_them(inputs, start):
    world = WorldLine.from_pretrained(inputs["checkpoint"])
    world.contract = world.contract.model_copy(update={"controls": "state"})
    simulation = start.begin(world)
    simulation.step(start.held(dict.fromkeys(GRIPPERS, 0.0)))
    shown = simulation.tracks[0].gripper[:, 0]
    np.testing.assert_allclose(shown, simulation.states[0][:, GRIPPERS], atol=1e-6)
    assert shown[0].max() > 0.4  # the command is 0


def test_misuse_is_refused_and_changes_nothing(causal, start):
    simulation, rows = start.begin(causal), start.controls[None, 1:17]
    state, broken = start.controls[0], rows.copy()
    broken[0, 3, 2] = np.nan

    def begun(column, value):
        return {"state": np.where(np.arange(14) == column, value, state)}

    beyond = "beyond its|array of numbers"
    for controls, message in (
        (rows[:, :15], r"another shape.*frames 1 to 16.*\(1, 16, 14\).*got: \(1, 15, 14\)"),
        (rows[:, :, :13], r"another shape.*\(1, 16, 13\)"), (np.repeat(rows, 2, axis=0), r"another shape.*\(2, 16, 14\)"),
        (broken, "not finite.*clip 0, row 3, left/elbow_joint"), (np.degrees(rows + 0.2), beyond), (rows * 100, beyond),
        (rows.astype(complex), beyond), (np.ma.masked_greater(rows, 0.0), beyond),
    ):  # fmt: skip
        with pytest.raises(DataError, match=f"(?s){message}"):
            simulation.step(controls)
    for clips, seeds, message in (
        ([1], None, r"No such clips.*0\.\.0"), ([], None, "No such clips"), ([0], [1, 2], "One seed for each clip"),
    ):  # fmt: skip
        with pytest.raises(DataError, match=f"(?s){message}"):
            simulation.select(clips, seeds)
    for count, seeds, message in ((0, None, "No such clips"), (2, [1, False], "Not a seed")):
        with pytest.raises(DataError, match=message):
            simulation.fork(count, seeds=seeds)
    for given, message in (
        ({"seed": [1, 2]}, "do not fit together.*'seeds': 2"), ({"seed": 1.5}, r"Not a seed.*1\.5"),
        ({"seed": True}, "Not a seed"), ({"seed": [-1]}, "Not a seed"),
        ({"state": np.zeros(7)}, "wrong length for this embodiment"),
        (begun(0, 45.0), "beyond its limit.*state at the start.*left/.*got: 45;"),  # degrees
        (begun(GRIPPERS[1], 80.0), "gripper is far beyond.*row 0, arm right.*opening of 80"),
        (begun(GRIPPERS[0], 2.0), "opening of 2"), ({"state": state.astype(complex)}, "array of numbers"),
        ({"state": np.ma.masked_greater(state, 0.0)}, "masked values"),
        ({"state": [str(value) for value in state]}, "array of numbers"),
    ):  # fmt: skip
        with pytest.raises(DataError, match=f"(?s){message}"):
            start.begin(causal, **given)
    assert (simulation.num_frames, simulation.states.shape) == (1, (1, 1, 14))
    small = {view: image[:104] for view, image in start.images.items()}
    with pytest.raises(DataError, match="same views at one size"):
        causal.start([start.images, small], start.cameras, embodiment=ROBOT, state=start.controls[0])
