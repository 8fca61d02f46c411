"""A policy of openpi's protocol drives the simulator: what it is sent, how its chunks are used, and what it cannot command."""

import math

import numpy as np
import pyarrow.parquet as pq
import pytest

pytest.importorskip("msgpack")

from tests.policies.test_openpi import policy_server
from tests.rollout.conftest import SIZE, N
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError, UnavailableError
from worldline_core.rollout.policy_rollout import rollout_policy
from worldline_core.rollout.rollout_config import PolicyRolloutConfig
from worldline_core.rollout.rollout_set import RolloutSet


def run(inputs, output, act, **changes):
    aloha = {"form": "aloha", "image_keys": {"head": "cam_high"}, "state_key": "state"}
    with policy_server(act) as url:
        values = {"method": "mine_10data", "policy": {"url": url, **aloha}, "bfloat16": False, "steps": 1, **changes}
        return rollout_policy(PolicyRolloutConfig.model_validate(values), inputs, output)


def actions(observation, rows=80):
    """A chunk that starts at the robot's state and moves on a little with every action."""
    return {"actions": observation["state"][None] + 0.002 * np.arange(1, rows + 1)[:, None] * (np.arange(14) % 7 < 6)}


def test_chunks_are_thinned_queued_and_asked_for_again(inputs, tmp_path):
    asked = []

    def act(observation):
        asked.append(observation)
        return actions(observation, 40)

    inputs = inputs | {"checkpoint": inputs["checkpoint"].parent / "small_blocks"}
    options = {"down_sample": 2, "length_scale": 1.5}
    done = run(inputs, tmp_path / "a", act, **options)
    episodes, found = EpisodeSet.open(inputs["episodes"]), RolloutSet.open(tmp_path / "a")
    tests = [row.episode_id for row in episodes.rows if row.split == "test"]
    length = math.ceil(len(range(0, N, 2)) * 1.5)
    used = 16  # of 20 queued actions, which are two steps of 8 and a rest
    chunks = math.ceil((length - 1) / used)
    assert (done["episodes"], done["frames"], done["asked"]) == (4, 4 * length, 4 * chunks)
    assert sorted(found.episode_ids) == sorted(tests)
    assert len(asked) == 4 * chunks
    assert asked[0]["images"]["cam_high"].shape == (3, *SIZE)
    assert asked[0]["images"].keys() == {"cam_high"}
    episode = episodes.episode(episodes.position(tests[0]))
    assert np.allclose(asked[0]["state"], episode.action[0], atol=1e-6)
    assert asked[0]["prompt"] == episode.instruction
    moved = 0.002 * (2 * used - 1) * (np.arange(14) % 7 < 6)
    assert np.allclose(asked[1]["state"] - asked[0]["state"], moved, atol=1e-5)
    frames = found.frames(tests[0], "right_wrist")
    assert frames.shape == (length, *SIZE, 3)
    again = run(inputs, tmp_path / "a", lambda _: {}, **options)  # finished videos are kept
    assert (again["frames"], again["asked"]) == (4 * length, 0)


def test_what_no_robot_can_do_costs_its_recording_alone(inputs, tmp_path):
    count = [0]

    def act(observation):
        count[0] += 1
        return {"actions": actions(observation)["actions"] + (50 if count[0] == 1 else 0)}

    done = run(inputs, tmp_path, act, length_scale=0.5)
    assert (done["episodes"], done["left_out"]["invalid_controls"]) == (3, 1)
    (row,) = pq.read_table(tmp_path / "quarantine.parquet").to_pylist()
    assert row["reason"] == "invalid_controls"
    assert row["episode_id"] not in RolloutSet.open(tmp_path).episode_ids


@pytest.mark.parametrize(
    ("act", "error", "match"),
    [
        (lambda seen: actions(seen, 3), DataError, r"(?s)do not fit the robot.*expected: at least 16 rows"),
        (lambda _: {"actions": np.zeros((80, 7))}, DataError, r"(?s)do not fit the robot.*14 columns.*\(80, 7\)"),
        (lambda _: None, UnavailableError, "closed the connection"),
        (lambda _: {"actions": np.full((80, 14), 100.0)}, DataError, "drove no recording"),
    ],
)
def test_a_policy_that_cannot_be_used_ends_the_step(inputs, tmp_path, act, error, match):
    with pytest.raises(error, match=match):
        run(inputs, tmp_path, act)
