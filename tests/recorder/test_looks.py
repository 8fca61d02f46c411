"""Drawn looks, shifts, and misses of any size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

mujoco = pytest.importorskip("mujoco", reason="the recorder needs MuJoCo (extra: sim)")

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError
from worldline_core.recorder.controllers import MISSES, Miss, ScriptedPolicy, miss_of
from worldline_core.recorder.looks import RANGES, UNSEEN, look_of, scenes, texture, trains
from worldline_core.recorder.record import RecordConfig, RecordGroup, plan_jobs, record
from worldline_core.recorder.scene import sample_layout
from worldline_core.recorder.simulate import EpisodeRecorder


@pytest.mark.parametrize("name", sorted(RANGES))
def test_a_look_is_a_function_of_its_name(name: str) -> None:
    looks = [look_of(f"{name}_{number:04d}") for number in range(20)]
    again = RANGES[name].draw(np.random.default_rng((7100, sorted(RANGES, reverse=True).index(name), 3)))
    assert again == looks[3]
    assert len({look.table for look in looks}) == 20
    low, high = RANGES[name].size
    assert all(low <= look.size <= high for look in looks)


def test_training_and_test_scenes_are_apart() -> None:
    for look in ("plain", "wide"):
        training, test = scenes(look, True), scenes(look, False)
        assert not set(training) & set(test)
        assert all(map(trains, training)) and not any(map(trains, test))
    with pytest.raises(DataError, match="not for training"):
        scenes("unseen", True)
    with pytest.raises(ValidationError, match="unseen looks are for tests"):
        RecordGroup(embodiment="viperx_pearl", count=1, look="unseen")
    for name in ("scene_16", "wide_1", "unseen_00000", "wide_0001\n"):
        with pytest.raises(DataError, match="Unknown scene"):
            look_of(name)
    assert all(texture(name).shape == (128, 128, 3) for name in UNSEEN.textures if name)


@pytest.fixture(scope="module")
def recorder() -> EpisodeRecorder:
    return EpisodeRecorder("xarm7_white")


# Where the outcome turns lies between the two sizes.
@pytest.mark.parametrize(
    ("family", "kind", "hit", "miss"),
    [
        ("lift", "beside", 0.005, 0.095),
        ("lift", "low", 0.11, 0.05),
        ("place", "release_off", 0.01, 0.11),
        ("close", "left_open", 0.12, 0.6),
        ("press", "short", 0.004, 0.07),
        ("carry", "beside", 0.005, 0.09),
    ],
)
def test_the_size_of_a_miss_decides(recorder: EpisodeRecorder, family: str, kind: str, hit: float, miss: float) -> None:
    assert hit < MISSES[family][kind] and miss < MISSES[family][kind]
    for size, outcome in ((hit, "success"), (miss, "failure")):
        random = np.random.default_rng(1)
        layout = sample_layout(recorder.scene.robot, family, random, look_of("wide_8001"))
        policy = ScriptedPolicy(miss=Miss.model_validate({"kind": kind, "size": size}))
        motion = recorder.move(layout, random, 33, policy)
        assert motion is not None and motion.outcome == outcome, size


def test_misses_are_drawn_evenly_and_apart_from_everything_else() -> None:
    group = RecordGroup(embodiment="viperx_pearl", count=200, look="wide")
    jobs = plan_jobs(RecordConfig(groups=(group,), misses=0.5))
    missing = [job.policy.miss for job in jobs if job.policy and job.policy.miss]
    assert 70 < len(missing) < 130
    assert {miss.kind for miss in missing} == {kind for kinds in MISSES.values() for kind in kinds}
    assert miss_of(1.0, "lift", (1, 2)) == miss_of(0.5, "lift", (1, 2)) or miss_of(0.5, "lift", (1, 2)) is None
    plain = plan_jobs(RecordConfig(groups=(group,)))
    assert [job.entropy for job in jobs] == [job.entropy for job in plain]
    assert all(job.policy is None for job in plain)


def test_groups_have_their_own_length() -> None:
    group = RecordGroup(embodiment="viperx_pearl", count=2)
    jobs = plan_jobs(RecordConfig(groups=(group, group.model_copy(update={"num_frames": 65}))))
    assert sorted(job.num_frames for job in jobs) == [33, 33, 65, 65]


@pytest.mark.slow
def test_shifts_are_named_in_the_index(rendering: None, tmp_path: Path) -> None:
    groups = {
        "xarm7_white": {"look": "unseen", "held_out_camera": True}, "panda_ivory": {"look": "wide"},
        "viperx_pearl": {"look": "wide"}, "viperx_graphite": {"held_out_camera": True},
    }  # fmt: skip
    planned = [{"embodiment": name, **group, "split": "ood_test", "count": 1} for name, group in groups.items()]
    record(RecordConfig.model_validate({"groups": planned, "num_frames": 17, "misses": 1.0}), tmp_path)
    episodes = EpisodeSet.open(tmp_path)
    shifts = {row.embodiment: episodes.episode(i).conventions.get("shift") for i, row in enumerate(episodes.rows)}
    assert shifts == {**dict.fromkeys(groups), "xarm7_white": "look+camera", "panda_ivory": "body"}
    assert (tmp_path / "misses.json").read_text().count('"size"') == 4
