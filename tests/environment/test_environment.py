"""The simulator as a Gymnasium environment."""

import threading
import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import SyncVectorEnv

from worldline_core import WorldLine
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.environment import ENVIRONMENT
from worldline_core.environment.environment import (
    RobotSpaces,
    SideBySide,
    WorldLineEnv,
    WorldLineVectorEnv,
    shipped_segmenter,
)
from worldline_core.errors import ConfigError, DataError
from worldline_core.evaluation.policy.measured_judge import soft_score
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.rollout.recorded_starts import RecordedStarts

ROBOT = "ur5e_silver"
SHORT = {"embodiment": ROBOT, "success": None}


def commands(starts, seeds, count):
    """Recorded commands of the starts that these seeds choose, ``(count, envs, j)``, the second moved a little."""
    recorded = (starts.commands(seed % len(starts)).astype(np.float32) for seed in seeds)
    return np.stack([rows[np.minimum(np.arange(count), len(rows) - 1)] for rows in recorded], axis=1)


@pytest.mark.slow
def test_gymnasiums_checker_finds_nothing(small_world):
    environment = gymnasium.make(ENVIRONMENT, model=small_world, observe_every=2, episode_frames=5, **SHORT).unwrapped
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        check_env(environment)
    # Joints have limits in radians, which are neither symmetric nor 1.
    assert not [one for one in found if "symmetric and normalized space" not in str(one.message)]
    assert environment.metadata["render_fps"] == 8


def test_episodes_are_simulations_of_recorded_starts(small_world, starts):
    """Block by block: pictures are new when a block is full, the state at every step; the end is that of a simulation."""
    environment = WorldLineEnv(model=small_world, render_mode="rgb_array", episode_frames=6, **SHORT)
    observed, info = environment.reset(seed=1)
    start = starts[1]
    assert info == {"is_success": False, "episode_id": start.episode_id, "task": start.instruction}
    assert observed["pixels"]["head"].shape == (64, 96, 3)
    simulation = small_world.start(start.images, start.cameras, embodiment=ROBOT, state=start.state, seed=1)
    assert np.array_equal(observed["pixels"]["head"], simulation.pictures[0]["head"])
    driven = commands(starts, [1], 6)[:, 0]
    first, block = observed["pixels"]["head"], simulation.step(driven[:4])[0]["head"]
    for number, command in enumerate(driven, start=1):
        observed, reward, terminated, truncated, info = environment.step(command)
        if number < 6:
            assert np.array_equal(observed["pixels"]["head"], first if number < 4 else block[-1])
        if number <= 4:
            np.testing.assert_allclose(observed["agent_pos"], simulation.states[0, number - 1], atol=1e-6)
        assert (reward, terminated, truncated) == (0.0, False, number == 6)
    # What was commanded until the end, the last command held.
    ended = simulation.step(np.concatenate((driven[4:], np.repeat(driven[-1:], 2, axis=0))))[0]["head"][1]
    assert np.array_equal(observed["pixels"]["head"], ended)
    assert np.array_equal(environment.render()[:, :96], ended)
    with pytest.raises(DataError, match=r"(?s)episode has ended.*call reset first"):
        environment.step(driven[0])


def test_pictures_may_be_asked_for_more_often(small_world, starts):
    start, driven = starts[0], commands(starts, [0], 4)[:, 0]
    simulation = small_world.start(start.images, start.cameras, embodiment=ROBOT, state=start.state, seed=0)
    environment = WorldLineEnv(model=small_world, observe_every=2, episode_frames=4, **SHORT)
    environment.reset(seed=0)
    seen = [environment.step(command)[0]["pixels"]["head"] for command in driven]
    foreseen = simulation.copy().step(np.concatenate((driven[:2], np.repeat(driven[1:2], 2, axis=0))))[0]["head"]
    assert np.array_equal(seen[1], foreseen[1])
    assert np.array_equal(seen[0], simulation.pictures[0]["head"])
    assert np.array_equal(seen[2], seen[1])
    assert np.array_equal(seen[3], simulation.step(driven)[0]["head"][-1])


@pytest.mark.slow
def test_a_batch_is_its_environments_side_by_side(world, starts):
    """Against Gymnasium's own vector environment, to the end of the episodes and the first frame of the next ones."""
    options = {"model": world, "episode_frames": 18, **SHORT}
    succeeds = {starts[1].instruction}
    assert starts[0].instruction not in succeeds
    options["success"] = lambda video: video.instruction in succeeds
    ours = gymnasium.make_vec(ENVIRONMENT, num_envs=2, **options)
    theirs = SyncVectorEnv([lambda: WorldLineEnv(**options)] * 2)
    assert (ours.action_space, ours.observation_space) == (theirs.action_space, theirs.observation_space)
    assert data_equivalence(ours.reset(seed=[0, 1]), theirs.reset(seed=[0, 1]))
    command, mine = np.zeros(0), ()
    for command in commands(starts, [0, 1], 18):
        mine, other = (environment.step(command.astype(np.float32)) for environment in (ours, theirs))
        assert all(data_equivalence(one, another) for one, another in zip(mine, other, strict=True))
    assert mine[4]["is_success"].tolist() == [False, True]
    assert (mine[1].tolist(), mine[2].tolist(), mine[3].tolist()) == ([0.0, 1.0], [False, True], [True, False])
    assert ours.get_attr("task_description")[0] == starts[0].instruction
    again = ours.step(command)
    assert (again[1].tolist(), again[4]["is_success"].tolist()) == ([0.0, 0.0], [False, False])
    assert not (again[2] | again[3]).any()
    assert ours.call("_max_episode_steps") == (18, 18)
    assert [picture.shape for picture in ours.call("render")] == [(64, 3 * 96, 3)] * 2


def test_a_batch_on_several_threads_is_the_batch_on_one(small_world, starts):
    """Clips keep their places: pictures, states and what a user's function sees of three, in parts of two and one."""
    driven, threads, found = commands(starts, [0, 1, 2], 6), torch.get_num_threads(), []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            videos = []
            environment = WorldLineVectorEnv(
                3, model=small_world, embodiment=ROBOT, episode_frames=6, success=videos.append
            )
            first, _ = environment.reset(seed=0)
            assert [len(running.simulation) for running in environment._running] == [[3], [2, 1]][count - 1]
            *_, (last, _, _, ended, infos) = (environment.step(command) for command in driven)
            assert ended.all()
            assert [video.instruction for video in videos] == [starts[slot].instruction for slot in range(3)]
            shown = [np.asarray(video.frames["right_wrist"]) for video in videos]
            found.append((first["agent_pos"], last["agent_pos"], infos["episode_id"].tolist(), [first, last], shown))
        (*one, pictures, shown), (*other, theirs, seen) = found
        assert data_equivalence(one, other)
        for mine, another in zip(pictures, theirs, strict=True):
            for view in VIEWS:
                np.testing.assert_allclose(mine["pixels"][view].astype(int), another["pixels"][view], atol=1)
        np.testing.assert_allclose(np.array(shown).astype(int), np.array(seen), atol=1)
    finally:
        torch.set_num_threads(threads)


def test_what_cannot_be_seen_is_no_success(small_world, starts):
    for verdict, rewarded in ((None, False), (True, True), (False, False), (np.True_, True)):
        options = SHORT | {"success": lambda _, v=verdict: v}
        environment = WorldLineEnv(model=small_world, episode_frames=1, **options)
        environment.reset(seed=0)
        _, reward, terminated, truncated, info = environment.step(commands(starts, [0], 1)[0][0])
        assert (reward, terminated, truncated) == (float(rewarded), rewarded, not rewarded)
        assert info["is_success"] == rewarded
    environment = WorldLineEnv(model=small_world, episode_frames=1, **SHORT | {"success": lambda _: "no"})
    environment.reset(seed=0)
    with pytest.raises(DataError, match=r"(?s)Not a judgement.*got: no"):
        environment.step(commands(starts, [0], 1)[0][0])


def test_episodes_begin_at_named_frames_with_what_came_before(small_world, shipped, starts):
    """The state is that of the commands so far, the judge sees the whole video, and the episode goes on as it was recorded."""
    seen = []
    names, frames = [starts.rows[2].episode_id, starts.rows[0].episode_id], [0, 20]
    options = {**SHORT, "model": small_world, "episode_frames": 2, "success": lambda video: seen.append(video)}
    environment = WorldLineVectorEnv(2, **options)
    observed, infos = environment.reset(seed=[3, 4], options={"start": names, "frame": frames})
    assert infos["episode_id"].tolist() == names
    begun = [starts.at(*chosen) for chosen in zip(names, frames, strict=True)]
    simulation = small_world.start(
        [start.images for start in begun], [start.cameras for start in begun], embodiment=ROBOT, seed=[3, 4],
        state=np.stack([start.state for start in begun]), earlier=[start.earlier for start in begun],
    )  # fmt: skip
    np.testing.assert_allclose(observed["agent_pos"], simulation.state, atol=1e-6)
    assert all(np.array_equal(observed["pixels"]["head"][slot], simulation.pictures[slot]["head"]) for slot in (0, 1))
    for _ in range(2):
        *_, ended, _ = environment.step(simulation.state)
    assert ended.all()
    assert [video.num_frames for video in seen] == [3, 23]
    recorded = starts.before(begun[1], small_world.image_size)
    assert all(np.array_equal(seen[1].frames[view][:20], video) for view, video in recorded.items())
    assert seen[1].points is not None and len(seen[1].points) == 23
    assert np.abs(np.diff(seen[1].points, axis=0)).max() < 12  # an arm moves on, it does not jump
    always = WorldLineEnv(**options, start=names[1], frame=20)
    assert data_equivalence(always.reset(seed=4)[0]["agent_pos"], observed["agent_pos"][1])
    assert always.reset(seed=4, options={"frame": 0})[1]["episode_id"] == names[1]
    assert np.allclose(always.reset()[0]["agent_pos"], observed["agent_pos"][1])  # another seed's noise alone
    rows = EpisodeSet.open(shipped / "recordings").rows
    other = next(row.episode_id for row in rows if row.embodiment == ROBOT and row.split == "train")
    for asked, said in (
        ({"start": "nothing"}, r"No recording of this name.*one of ur5e_silver-test.*got: nothing"),
        ({"start": other}, rf"No recording of this name.*got: {other}, of another split"),
        ({"start": 0}, r"No recording of this name"),
        *(({"frame": frame}, rf"No such frame.*0 to 32.*got: {frame}") for frame in (33, -1, 1.5, True, "2")),
        ({"frame": [1, 2, 3]}, r"Not the starts.*where: frame.*one, or 2"),
        ({"start": names[0], "frmae": 3}, r"Unknown options of a reset.*got: frmae"),
    ):
        with pytest.raises(DataError, match=rf"(?s){said}"):
            environment.reset(seed=0, options=asked)
    environment.reset(seed=0, options={"lerobot_new_rollout": True, "reset_mask": None})  # of others
    with pytest.raises(DataError, match="No such frame"):
        WorldLineEnv(**options, start=names[0], frame=33)


@pytest.mark.parametrize("robot", ["ur5e_silver", "so101", "agibot_g1"])
def test_normalised_actions_are_the_robots_limits(robot):
    embodiment = load_embodiment(robot)
    spaces = RobotSpaces(embodiment, ["head"], (4, 6), flat=True, normalised=True)
    limits = np.concatenate([[*arm.limits, sorted((arm.gripper.closed, arm.gripper.open))] for arm in embodiment.arms])
    ones = np.ones((2, embodiment.state_size))
    for action, expected in ((-1, limits[:, 0]), (1, limits[:, 1]), (0, limits.mean(axis=1))):
        np.testing.assert_array_equal(spaces.commands(action * ones, 2), np.stack([expected, expected]))
    assert (spaces.action.low == -1).all() and (spaces.action.high == 1).all()
    drawn = spaces.action.sample()
    np.testing.assert_array_equal(spaces.actions(spaces.commands(drawn)), drawn)
    units = RobotSpaces(embodiment, ["head"], (4, 6), flat=True, normalised=False)
    np.testing.assert_array_equal(units.actions(units.commands(drawn)), drawn)
    with pytest.raises(DataError, match=rf"(?s)out of range.*{embodiment.state_names[0]}.*-1 to 1"):
        spaces.commands(1.01 * ones[0])
    free = embodiment.arms[0].model_copy(update={"limits": ((-np.inf, np.inf), *embodiment.arms[0].limits[1:])})
    turning = embodiment.model_copy(update={"arms": (free, *embodiment.arms[1:])})
    with pytest.raises(ConfigError, match=rf"(?s)without limits.*{embodiment.state_names[0]}"):
        RobotSpaces(turning, ["head"], (4, 6), flat=True, normalised=True)
    RobotSpaces(turning, ["head"], (4, 6), flat=True, normalised=False)


def test_normalised_actions_and_flat_observations_change_the_form_alone(small_world, starts):
    plain = WorldLineEnv(model=small_world, episode_frames=2, **SHORT)
    flat = WorldLineEnv(model=small_world, episode_frames=2, flat_observation=True, normalised_actions=True, **SHORT)
    for one in (plain, flat):
        one.reset(seed=0)
    for command in commands(starts, [0], 2)[:, 0]:
        observed, given = plain.step(command)[0], flat.step(flat.spaces.actions(command))[0]
    assert list(given) == [*observed["pixels"], "agent_pos"]
    assert flat.observation_space.contains(given)
    np.testing.assert_allclose(given["agent_pos"], observed["agent_pos"], atol=1e-5)
    for view, picture in observed["pixels"].items():  # float32 shows the last digit of the commands
        np.testing.assert_allclose(given[view].astype(int), picture, rtol=0, atol=0 if small_world.bfloat16 else 1)


def test_the_soft_reward_is_what_a_new_picture_adds_to_the_score(world, starts):
    numbers = [0, 3, 4]  # a drawer that is closed, a button that is pressed, one that is not lifted
    environment = WorldLineVectorEnv(3, model=world, episode_frames=32, reward="soft", **SHORT)
    _, infos = environment.reset(seed=numbers)
    scores, sums = [infos["score"]], np.zeros(3)
    assert set(environment.infos()[1]["task_state"]) == {"growth"}
    for number, command in enumerate(commands(starts, numbers, 32), start=1):
        _, rewards, _, _, infos = environment.step(command)
        assert rewards.any() == (number % 16 == 0)
        np.testing.assert_allclose(rewards, infos["score"] - scores[-1])
        scores.append(infos["score"])
        sums += rewards
    np.testing.assert_allclose(sums, scores[-1] - scores[0])
    assert (scores[0] < 0.1).all()
    assert [starts.rows[number].outcome for number in numbers] == ["success", "success", "failure"]
    assert (sums > 0.8).tolist() == [True, True, False]
    later = environment.reset(seed=numbers, options={"frame": 30})[1]
    assert (later["score"] > 0.8).tolist() == [True, True, False]
    segmenter = shipped_segmenter()
    video = environment._episodes[0].video
    dark = {view: np.concatenate([frames[:20], 0 * frames[:11]]) for view, frames in video.frames.items()}
    for instruction in ("lift the green drawer", "place the green drawer on the blue pad"):  # hiding gains nothing
        score, facts = soft_score(segmenter, replace(video, instruction=instruction, frames=dark, points=None))
        assert score < 0.1
        assert np.isnan(list(facts.values())).any()
    with pytest.raises(DataError, match=r"(?s)no soft score.*named by its colour.*got: 'tidy up'"):
        soft_score(segmenter, replace(video, instruction="tidy up"))


def test_clips_are_worked_on_side_by_side():
    before, both = torch.get_num_threads(), threading.Barrier(2, timeout=10)
    torch.set_num_threads(4)
    try:
        found = SideBySide(2)(lambda one: (one, torch.get_num_threads(), both.wait() < 2), range(2))
        assert found == [(0, 2, True), (1, 2, True)]
        assert torch.get_num_threads() == 4
    finally:
        torch.set_num_threads(before)


@pytest.mark.slow
def test_a_further_model_bounds_what_one_model_promises(world, shipped):
    """Two models side by side are the two alone: the lower score, their difference, and a success that both see."""
    options = {"episode_frames": 32, "embodiment": ROBOT, "reward": "soft", "splits": ("test", "ood_test")}
    stage2 = WorldLine.from_pretrained(shipped / "models" / "stage2", steps=1)
    given = {"model": world, "members": [stage2]}
    alone = [WorldLineVectorEnv(5, model=model, **options) for model in (world, stage2)]
    doubting = WorldLineVectorEnv(5, **given, largest_disagreement=0.05, **options)
    bounded = WorldLineVectorEnv(5, **given, **options)
    environments = [*alone, doubting, bounded]
    found = [environment.reset(seed=0)[1] for environment in environments]
    before, rewards = found[3]["score"], np.zeros((2, 5))
    for command in commands(bounded.starts, list(range(5)), 32):
        steps = [environment.step(command) for environment in environments]
        rewards += [steps[2][1], steps[3][1]]
        found = [step[4] for step in steps]
        doubted = found[2].get("doubted", np.zeros(5, bool))
        assert not steps[2][1][doubted & (rewards[0] != rewards[1])].any()
    scores = np.array([one["score"] for one in found[:2]])
    np.testing.assert_allclose(found[3]["score"], scores.min(axis=0), atol=1e-6)
    np.testing.assert_allclose(found[3]["disagreement"], np.ptp(scores, axis=0), atol=1e-6)
    np.testing.assert_allclose(rewards[1], found[3]["score"] - before, atol=1e-6)
    assert found[3]["is_success"].tolist() == (found[0]["is_success"] & found[1]["is_success"]).tolist()
    assert not found[3]["doubted"].any()


@pytest.mark.slow
def test_the_judge_sees_the_outcomes_of_recorded_commands(world):
    """Replayed in the environment, recorded episodes end as they did: all of five but one at least."""
    environment = WorldLineVectorEnv(5, model=world, episode_frames=32, embodiment=ROBOT, splits=("test", "ood_test"))
    recorded = [row.outcome == "success" for row in environment.starts.rows]
    environment.reset(seed=0)
    for command in commands(environment.starts, list(range(5)), 32):
        *_, infos = environment.step(command)
    assert (infos["is_success"] == recorded).sum() >= 4


def test_misuse_is_refused(small_world, shipped, starts):
    environment = WorldLineVectorEnv(2, model=small_world, **SHORT)
    with pytest.raises(DataError, match="call reset first"):
        environment.step(np.zeros((2, 14)))
    environment.reset(seed=3)
    with pytest.raises(DataError, match=r"(?s)Not the commands of one step.*\(2, 14\): left/shoulder_pan_joint"):
        environment.step(np.zeros((1, 14)))
    with pytest.raises(DataError, match="not finite"):
        environment.step(np.full((2, 14), np.nan))
    texts, unknown = np.full((2, 14), "1"), np.full((2, 14), None)
    for commands in (texts, unknown, np.zeros((2, 14), complex), np.ones((2, 14), bool), [[1], [1, 2]], "x"):
        with pytest.raises(DataError, match="Not the commands of one step"):
            environment.step(commands)
    for seed in (-1, 2**63, 1.5, "ab", [1], [1, 2, 3], []):
        with pytest.raises(DataError, match="Not the seeds"):
            environment.reset(seed=seed)
    for seed in (np.int64(0), np.array([0, 1]), [0, np.int64(1)]):  # a zero of NumPy counted as no seed
        _, infos = environment.reset(seed=seed)
        assert infos["episode_id"].tolist() == [starts[number].episode_id for number in (0, 1)]
    for change in ({"num_envs": -1}, {"episode_frames": 2.5}, {"success": "measurd"}, {"reward": "sotf"}):
        with pytest.raises(ConfigError, match="Not an environment"):
            WorldLineVectorEnv(**{"num_envs": 2, "model": small_world, **SHORT, **change})
    with pytest.raises(ConfigError, match=r"(?s)divisor of 4.*observe_every 5"):
        WorldLineEnv(model=small_world, observe_every=5, **SHORT)
    for fps, reason in ((8.0, "of another split"), (10.0, "of another rate")):
        found = RecordedStarts(shipped / "recordings", view_sets=[VIEWS], fps=fps, splits=("test",))
        with pytest.raises(DataError, match=rf"(?s)of one robot.*left out.*{reason}"):
            _ = found.embodiment
