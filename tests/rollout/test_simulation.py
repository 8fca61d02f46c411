"""Simulations that are stepped: what they predict, how they branch, and where the robot is beside the pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from worldline_core import Camera, WorldLine
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.model.tokenizers import PatchTokenizer
from worldline_core.rollout.recorded_starts import RecordedStarts
from worldline_core.rollout.robot import CommandedRobot
from worldline_core.rollout.simulation import Simulation

ROBOT = "ur5e_silver"


@dataclass
class Start:
    """The first frames of a held-out recording, and what was commanded then."""

    images: dict[str, np.ndarray]
    cameras: dict[str, Camera]
    controls: np.ndarray

    def begin(self, world: WorldLine, **options: object) -> Simulation:
        return world.start(
            self.images, self.cameras, **{"embodiment": ROBOT, "state": self.controls[0], "limits": False, **options}
        )  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def recordings(project_root: Path) -> EpisodeSet:
    return EpisodeSet.open(project_root / "artifacts" / "shipped" / "recordings")


@pytest.fixture(scope="module")
def starts(recordings: EpisodeSet) -> list[Start]:
    found = []
    for position, row in enumerate(recordings.rows):
        if row.embodiment == ROBOT and row.split == "test" and len(found) < 2:
            episode = recordings.episode(position)
            cameras = {view: Camera(camera.K, camera.T_base_camera[0]) for view, camera in episode.cameras.items()}
            images = {view: recordings.frames(position, view, [0])[0] for view in cameras}
            found.append(Start(images, cameras, episode.action[:33]))
    return found


@pytest.fixture(scope="module")
def causal(project_root: Path) -> WorldLine:
    return WorldLine.from_pretrained(project_root / "artifacts" / "shipped" / "models" / "causal")


def videos(simulation: Simulation, controls: np.ndarray) -> list[dict[str, np.ndarray]]:
    """All pictures of a simulation that is at its start, driven by ``(b, 1 + steps, j)``; row 0 belongs to the start."""
    pieces = [[{view: picture[None] for view, picture in clip.items()} for clip in simulation.pictures]]
    unit = simulation.frames_per_step
    pieces += [simulation.step(controls[:, begin : begin + unit]) for begin in range(1, controls.shape[1], unit)]
    return [
        {view: np.concatenate([piece[clip][view] for piece in pieces]) for view in simulation.views}
        for clip in range(len(simulation))
    ]


def equal(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> bool:
    return list(one) == list(other) and all(np.array_equal(one[view], other[view]) for view in one)


def test_steps_give_the_bytes_of_a_prediction(causal: WorldLine, starts: list[Start]) -> None:
    """With mounts that the file knows and ones solved at the start."""
    start = starts[0]
    mounts = {**start.cameras, **{view: Camera(start.cameras[view].K) for view in ("left_wrist", "right_wrist")}}
    for cameras in (mounts, start.cameras):
        given = replace(start, cameras=cameras)
        predicted = causal.predict(given.images, start.controls, given.cameras, embodiment=ROBOT)
        simulation = given.begin(causal)
        assert equal(videos(simulation, start.controls[None])[0], predicted)
        assert (simulation.num_frames, simulation.frames_per_step, simulation.fps) == (33, 16, 8.0)
        assert equal(simulation.pictures[0], {view: video[-1] for view, video in predicted.items()})
    # Limits change nothing of commands within them.
    assert equal(videos(given.begin(causal, limits=True), start.controls[None])[0], predicted)


def test_a_simulation_begins_in_the_middle_of_a_recording(causal: WorldLine, recordings: EpisodeSet) -> None:
    """The robot is where the earlier commands led it; wrist cameras, known at the first frame, have moved with their arms."""
    recorded = RecordedStarts(recordings.root, view_sets=[VIEWS], fps=8.0, embodiment=ROBOT, splits=("test",))
    arms = load_embodiment(ROBOT)
    grippers = [arms.gripper_column(arm) for arm in arms.arms]
    row = recorded.rows[1]
    episode = recordings.episode(recordings.position(row.episode_id))
    frame = int(np.abs(np.diff(episode.action[:, grippers], axis=0)).max(axis=1).argmax()) + 1  # a gripper is moving
    start = recorded.at(row.episode_id, frame)
    assert np.array_equal(
        start.images["head"], recordings.frames(recordings.position(row.episode_id), "head", [frame])[0]
    )
    begun = {"embodiment": ROBOT, "state": start.state, "earlier": [start.earlier]}
    simulation = causal.start(start.images, start.cameras, **begun)
    begins = episode.action[:1].astype(np.float64)
    robot, _, states = CommandedRobot(simulation._starts.kinematics, 8.0, begins, limits=False).follow(
        episode.action[None, 1 : frame + 1].astype(np.float64)
    )
    assert np.array_equal(simulation.state, states[:, -1])
    assert np.array_equal(simulation.commands[:, -1], robot.command)
    assert np.abs(simulation.state - robot.command)[:, grippers].max() > 0.05
    mounted = causal.start(start.images, {view: Camera(camera.K, None if view != "head" else camera.T_base_camera)
                                          for view, camera in start.cameras.items()}, **begun)  # fmt: skip
    unknown = ArmKinematics(
        arms.model_copy(update={"arms": tuple(arm.model_copy(update={"wrist_camera": None}) for arm in arms.arms)})
    )
    solved = causal.start(start.images, start.cameras, **begun | {"embodiment": unknown})
    for one in (simulation, solved):
        np.testing.assert_allclose(one.tracks[0].uv, mounted.tracks[0].uv, atol=0.2)
    driven = episode.action[frame + 1 : frame + 17]
    driven = np.concatenate((driven, np.repeat(driven[-1:], 16 - len(driven), axis=0)))
    assert equal(simulation.step(driven)[0], mounted.step(driven)[0])
    branch = causal.start([start.images] * 2, [start.cameras] * 2, embodiment=ROBOT, state=start.state,
                          earlier=[start.earlier[:0], start.earlier])  # fmt: skip
    assert np.array_equal(branch.state, np.stack((start.state, states[0, -1])))
    for wrong, said in (([start.earlier] * 2, "do not fit together"), ([start.earlier[:, 1:]], "wrong length"),
                        ([np.full_like(start.earlier, 90.0)], "limit")):  # fmt: skip
        with pytest.raises(DataError, match=said):
            causal.start(start.images, start.cameras, **begun | {"earlier": wrong})


def test_stage2_is_stepped_clip_by_clip(project_root: Path, starts: list[Start]) -> None:
    folder = project_root / "artifacts" / "shipped" / "models" / "stage2"
    world = WorldLine.from_pretrained(folder, steps=1, clip_frames=17)
    start = starts[0]
    predicted = world.predict(start.images, start.controls, start.cameras, embodiment=ROBOT)
    simulation = start.begin(world)
    simulation.step(start.controls[None, 1:17])
    branches = simulation.fork(2)
    simulation.step(start.controls[None, 17:])
    assert equal(simulation.pictures[0], {view: video[-1] for view, video in predicted.items()})
    branches.step(np.stack((start.controls[17:], start.controls[17:] + 0.05)))
    assert equal(branches.pictures[0], simulation.pictures[0])
    assert not equal(branches.pictures[1], simulation.pictures[0])
    assert WorldLine.from_pretrained(folder, steps=1).start(
        start.images, start.cameras, embodiment=ROBOT, state=start.controls[0]
    ).frames_per_step == 32  # fmt: skip


def test_clips_of_a_batch_are_those_of_single_simulations(causal: WorldLine, starts: list[Start]) -> None:
    controls = np.stack([start.controls[:17] for start in starts])
    batch = causal.start(
        [start.images for start in starts], [start.cameras for start in starts],
        embodiment=ROBOT, state=controls[:, 0], seed=[1, 2],
    )  # fmt: skip
    together = videos(batch, controls)
    for clip, start in enumerate(starts):
        alone = start.begin(causal, seed=clip + 1)
        assert equal(videos(alone, controls[clip : clip + 1])[0], together[clip])
        assert np.array_equal(batch.tool_poses[clip], alone.tool_poses[0])


@pytest.mark.slow
def test_branches_share_their_history_and_equal_separate_rollouts(causal: WorldLine, starts: list[Start]) -> None:
    start = starts[0]
    shared, own = start.controls[None, 1:17], start.controls[17:33]
    ways = np.stack([own, own[:1] + 0 * own, own + 0.1 * np.linspace(0, 1, 16)[:, None]])
    simulation = start.begin(causal)
    simulation.step(shared)
    snapshot = simulation.copy()
    branches = simulation.fork(3)
    cache = branches._session._sampler.cache  # type: ignore[attr-defined]
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
    again = [chosen.copy().step(later)[0], chosen.step(later)[0]]
    assert equal(*again)
    assert not equal(branches.fork(1, seeds=[7, 8, 9]).step(ways)[2], branches.fork(1, seeds=[7, 8, 1]).step(ways)[2])


def test_commands_are_held_within_the_robots_limits(causal: WorldLine, starts: list[Start]) -> None:
    start = starts[0]
    arms = load_embodiment(ROBOT)
    elbow, gripper = arms.joint_columns(arms.arms[0]).start + 2, arms.gripper_column(arms.arms[0])
    wild = np.repeat(start.controls[:1].astype(np.float64), 16, axis=0)
    wild[:, elbow], wild[:, gripper] = 9.0, -0.5
    simulation = start.begin(causal, limits=True)
    simulation.step(wild)
    # pi rad/s at 8 frames per second, up to the limit of pi rad; an opening of 0..1 within 0.4 s of closing.
    begun = start.controls[0].astype(np.float64)
    expected = np.minimum(begun[elbow] + np.pi / 8 * np.arange(1, 17), 3.14159)
    np.testing.assert_allclose(simulation.commands[0, :, elbow], expected)
    assert (simulation.commands[0, :, gripper] == 0).all()
    closing = np.maximum(begun[gripper] - 1 / (0.4 * 8) * np.arange(1, 17), 0)
    np.testing.assert_allclose(simulation.states[0, :, gripper], closing, atol=1e-12)
    others = np.delete(np.arange(arms.state_size), [elbow, gripper])
    assert np.array_equal(simulation.commands[0][:, others], wild[:, others])
    tools = ArmKinematics(arms).tool_poses(simulation.commands[0, -1:])[0].numpy()
    np.testing.assert_allclose(simulation.tool_poses[0], tools, atol=1e-6)
    free = start.begin(causal)
    free.step(wild)
    assert np.array_equal(free.commands[0], wild)
    assert not equal(free.pictures[0], simulation.pictures[0])
    assert simulation.tracks[0].num_frames == 16


def test_a_limit_never_moves_a_robot_that_began_beyond_it() -> None:
    kinematics = ArmKinematics(load_embodiment("so101"))
    start = np.zeros((1, 6))
    start[0, 1] = 9.0
    robot, executed, _ = CommandedRobot(kinematics, 8.0, start, limits=True).follow(start[:, None] + 0)
    assert np.array_equal(executed[:, 0], start)
    assert np.array_equal(robot.state, start)


def test_maps_show_the_states_where_the_model_was_trained_on_them(
    inputs: dict[str, Path], make_contract: Callable, starts: list[Start], causal: WorldLine
) -> None:
    world = WorldLine.from_pretrained(inputs["checkpoint"])
    tokenizer = PatchTokenizer.load(inputs["tokenizer"])
    world.contract = make_contract(grid_size=(4, 6), tokenizer=tokenizer.encoder_digest[:16], controls="state")
    start = starts[0]
    arms = load_embodiment(ROBOT)
    closed = np.repeat(start.controls[:1].astype(np.float64), 16, axis=0)
    closed[:, [arms.gripper_column(arm) for arm in arms.arms]] = 0.0
    simulation = start.begin(world)
    simulation.step(closed)
    shown = simulation.tracks[0].gripper[:, 0]
    np.testing.assert_allclose(
        shown, simulation.states[0][:, [arms.gripper_column(arm) for arm in arms.arms]], atol=1e-6
    )
    assert shown[0].max() > 0.4  # the command is 0


def test_misuse_is_refused_and_changes_nothing(causal: WorldLine, starts: list[Start]) -> None:
    start = starts[0]
    simulation = start.begin(causal)
    rows = start.controls[None, 1:17].astype(np.float64)
    broken = rows.copy()
    broken[0, 3, 2] = np.nan
    for controls, message in (
        (rows[:, :15], r"(?s)another shape.*frames 1 to 16.*\(1, 16, 14\).*got: \(1, 15, 14\)"),
        (rows[:, :, :13], r"(?s)another shape.*\(1, 16, 13\)"),
        (np.repeat(rows, 2, axis=0), r"(?s)another shape.*\(2, 16, 14\)"),
        (broken, r"(?s)not finite.*clip 0, row 3, left/elbow_joint"),
    ):
        with pytest.raises(DataError, match=message):
            simulation.step(controls)
    assert (simulation.num_frames, simulation.states.shape) == (1, (1, 1, 14))
    for clips, seeds, message in (
        ([1], None, r"(?s)No such clips.*0\.\.0"), ([], None, "No such clips"), ([0], [1, 2], "One seed for each clip"),
    ):  # fmt: skip
        with pytest.raises(DataError, match=message):
            simulation.select(clips, seeds)
    with pytest.raises(DataError, match="No such clips"):
        simulation.fork(0)
    with pytest.raises(DataError, match=r"(?s)do not fit together.*'seeds': 2"):
        start.begin(causal, seed=[1, 2])
    with pytest.raises(DataError, match="wrong length for this embodiment"):
        start.begin(causal, state=np.zeros(7))
    arms = load_embodiment(ROBOT)
    for column, value, message in (
        (0, 45.0, r"(?s)beyond its limit.*state at the start.*left/.*got: 45;"),  # degrees
        (arms.gripper_column(arms.arms[1]), 80.0, r"(?s)gripper is far beyond.*row 0, arm right.*opening of 80"),
    ):
        state = start.controls[0].astype(np.float64)
        state[column] = value
        with pytest.raises(DataError, match=message):
            start.begin(causal, state=state)
    state = start.controls[0].astype(np.float64)
    for changes, message in (
        ({"state": state + (np.arange(14) == arms.gripper_column(arms.arms[0])) * (2.0 - state)}, "opening of 2"),
        ({"state": state.astype(complex)}, "array of numbers"),
        ({"state": np.ma.masked_greater(state, 0.0)}, "masked values"),
        ({"state": [str(value) for value in state]}, "array of numbers"),
        ({"seed": 1.5}, r"(?s)Not a seed.*1\.5"), ({"seed": True}, "Not a seed"), ({"seed": [-1]}, "Not a seed"),
    ):  # fmt: skip
        with pytest.raises(DataError, match=message):
            start.begin(causal, **changes)
    with pytest.raises(DataError, match="Not a seed"):
        simulation.fork(2, seeds=[1, False])
    for commands in (np.degrees(rows + 0.2), rows * 100, rows.astype(complex), np.ma.masked_greater(rows, 0.0)):
        with pytest.raises(DataError, match=r"beyond its|array of numbers"):
            simulation.step(commands)
    assert simulation.num_frames == 1
    small = replace(start, images={view: image[:104] for view, image in start.images.items()})
    with pytest.raises(DataError, match="same views at one size"):
        causal.start([start.images, small.images], start.cameras, embodiment=ROBOT, state=start.controls[0])
