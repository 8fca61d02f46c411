"""The training loop alone, on a model of a few numbers: what it saves and keeps, and what ends it."""

from __future__ import annotations

import json
import os
import resource
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from pydantic import ValidationError
from safetensors import safe_open
from safetensors.torch import load_file
from torch import Tensor, nn

from worldline_core.errors import ArtifactError, ConfigError, StoppedError, TrainingError
from worldline_core.store.store import ArtifactStore
from worldline_core.training import processes
from worldline_core.training.processes import BatchPlan
from worldline_core.training.trainer import Objective, ParameterGroup, TrainingResult, train
from worldline_core.training.training_config import SavingConfig, TrainerConfig
from worldline_core.training.training_state import ExponentialAverage, TrainingStates, identity_digests, newest_state

STATES = Path("run") / "training_state"


@dataclass(frozen=True)
class Numbers:
    names: tuple[str, ...]
    values: Tensor


class Mean(Objective[Numbers]):
    """Squared distance of a vector to the batch."""

    def __init__(self, weight: nn.Parameter, at: Callable[[int], float] = lambda _: 1.0) -> None:
        self.weight = weight
        self.at = at

    def loss(self, batch: Numbers, generator: torch.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        noise = torch.randn(batch.values.shape, generator=generator)
        return ((self.weight - batch.values - 0.1 * noise) ** 2).mean() * self.at(step), {}


def load(index: int) -> Numbers:
    generator = torch.Generator().manual_seed(index)
    return Numbers((f"episode-{index}",), torch.randn(2, 3000, generator=generator))


def run(
    output: Path,
    steps: int = 12,
    *,
    at: Callable[[int], float] = lambda _: 1.0,
    validate: Callable[[], dict[str, float]] | None = None,
    **changes: Any,
) -> TrainingResult:
    values: dict[str, Any] = {"save_every_seconds": 1000, "save_every_steps": 4, "log_every": 2, "precision": "fp32"}
    config = TrainerConfig.model_validate({"steps": steps, "optimizer": {"warmup_steps": 0}, **values, **changes})
    weight = nn.Parameter(torch.zeros(3000))
    return train(
        config,
        groups=[ParameterGroup("vector", {"weight": weight})],
        objective=Mean(weight, at),
        load=load,
        validate=validate,
        output=output,
        identity={"config": config.model_dump(mode="json", exclude={"steps"})},
        title="vector",
    )


def saved(output: Path) -> list[int]:
    return sorted(json.loads(path.read_text())["step"] for path in output.glob(f"{STATES}/*/state.json"))


def test_a_loss_that_is_not_finite_keeps_its_batch_and_the_state_before(tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="loss is not finite") as ended:
        run(tmp_path, at=lambda step: float("nan") if step == 6 else 1.0)
    (replay,) = (tmp_path / "run" / "replay").iterdir()
    message = str(ended.value)
    assert "vector, step 6, clips episode-6" in message
    assert str(replay) in message
    assert f"last good state is {tmp_path / STATES / 'step-000000004'}" in message
    assert saved(tmp_path) == [4]
    with safe_open(replay, framework="pt") as stored:
        assert torch.equal(stored.get_tensor("values"), load(6).values)
        facts = json.loads(stored.metadata()["facts"])
    assert (facts["step"], facts["micro_batch"], facts["seed"]) == (6, 6, 0)
    # The run goes on from there once the cause is gone.
    assert torch.equal(run(tmp_path).average["weight"], run(tmp_path / "whole").average["weight"])


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_held_out_loss_that_is_not_finite_ends_the_run_with_valid_json(tmp_path: Path, value: float) -> None:
    scores = iter([0.5, value])
    with pytest.raises(TrainingError, match="held-out loss is not finite") as ended:
        run(tmp_path, validate=lambda: {"loss": next(scores)}, validate_every=4)
    assert "step 8, validation/loss" in str(ended.value)
    assert "step-000000004" in str(ended.value)
    assert saved(tmp_path) == [4]
    rows = [
        json.loads(line, parse_constant=pytest.fail)
        for line in (tmp_path / "metrics.jsonl").read_text().split("\n")[:-1]
    ]
    assert [row["validation/loss"] for row in rows if "validation/loss" in row] == [0.5, None]


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """The disk is full for files beyond this size."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_ends_the_run_and_keeps_the_state_before(tmp_path: Path) -> None:
    run(tmp_path, steps=4)
    with files_of_at_most(20_000), pytest.raises(TrainingError, match="state could not be written") as ended:
        run(tmp_path)
    assert "File too large" in str(ended.value)
    assert "free some space, then give the same command again" in str(ended.value)
    assert f"last good state is {tmp_path / STATES / 'step-000000004'}" in str(ended.value)
    assert [path.name for path in (tmp_path / STATES).iterdir()] == ["step-000000004"]
    assert torch.equal(run(tmp_path).average["weight"], run(tmp_path / "whole").average["weight"])


def test_a_state_that_another_process_left_unfinished_is_not_blamed_on_the_disk(tmp_path: Path) -> None:
    weight = {"weight": nn.Parameter(torch.zeros(3))}
    states = TrainingStates(
        tmp_path, SavingConfig(), weight, ExponentialAverage(weight, 0.5), torch.optim.SGD(weight.values())
    )
    gone = RuntimeError("[gloo/transport/tcp/pair.cc:544] Connection closed by peer [127.0.0.1]:2345")
    for error in (gone, None):
        message = str(states.failed(error))
        assert "every process to write its part" in message
        assert "space" not in message


def test_a_stopped_run_saves_its_state_and_goes_on_with_the_same_bytes(tmp_path: Path) -> None:
    def stop(step: int) -> float:
        if step == 5:
            os.kill(os.getpid(), signal.SIGTERM)
        return 1.0

    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(StoppedError, match=r"after step 6, 50 %[\s\S]*the same command continues"):
        run(tmp_path / "stopped", at=stop)
    assert signal.getsignal(signal.SIGTERM) == before
    assert saved(tmp_path / "stopped") == [6]
    run(tmp_path / "stopped")
    run(tmp_path / "whole")
    assert (tmp_path / "stopped" / "metrics.jsonl").read_bytes() == (tmp_path / "whole" / "metrics.jsonl").read_bytes()
    stopped, whole = (
        load_file(next((tmp_path / name / STATES / "step-000000012").glob("*.safetensors")))
        for name in ("stopped", "whole")
    )
    assert stopped.keys() == whole.keys() >= {"weight/vector/weight", "exp_avg/vector/weight", "step/vector/weight"}
    assert all(torch.equal(stopped[name], whole[name]) for name in whole)


def test_the_latest_states_and_the_best_one_stay(tmp_path: Path) -> None:
    losses = iter([0.9, 0.2, 0.8, 0.7, 0.6, 0.5])
    saving = {"keep": 2, "best": "loss"}
    run(
        tmp_path, steps=12, validate=lambda: {"loss": next(losses)}, validate_every=2, saving=saving, save_every_steps=2
    )
    assert saved(tmp_path) == [4, 10, 12]
    facts = newest_state(tmp_path)
    assert facts["step"] == 12


@pytest.mark.parametrize(("share", "states"), [(1e-9, [1, 30]), (1.0, None)])
def test_saving_takes_a_share_of_the_time(tmp_path: Path, share: float, states: list[int] | None) -> None:
    def slow_enough(step: int) -> float:
        """Steps last as long as a state takes, on a slow disk too, until there are four of them."""
        before, began = len(saved(tmp_path)), time.monotonic()
        while states is None and before == len(saved(tmp_path)) <= 3 and time.monotonic() - began < 0.5:
            time.sleep(0.01)
        return 1.0

    saving = {"share": share, "keep": 100}
    run(tmp_path, steps=30, at=slow_enough, save_every_seconds=0, save_every_steps=0, saving=saving)
    if states is None:
        assert len(saved(tmp_path)) > 3
    else:
        assert saved(tmp_path) == states


@pytest.mark.parametrize("damage", ["cut", "gone", "index"])
def test_a_damaged_state_is_named(tmp_path: Path, damage: str) -> None:
    run(tmp_path, steps=4)
    folder = tmp_path / STATES / "step-000000004"
    (part,) = folder.glob("*.safetensors")
    if damage == "cut":
        part.write_bytes(part.read_bytes()[:1000])
    elif damage == "gone":
        part.unlink()
    else:
        (folder / "state.json").write_text("{")
    message = {"cut": "1000 bytes, not", "gone": "no such file", "index": "damaged"}
    with pytest.raises(ArtifactError, match=message[damage]):
        run(tmp_path)


def test_what_a_kill_left_of_a_state_is_no_state(tmp_path: Path) -> None:
    run(tmp_path, steps=4)
    half = tmp_path / STATES / "step-000000008"
    half.mkdir()
    (half / "shard-00001-model-00001-of-00001.safetensors").write_bytes(b"half")
    assert torch.equal(run(tmp_path).average["weight"], run(tmp_path / "whole").average["weight"])
    assert saved(tmp_path) == [12]


def test_a_state_holds_no_pickle(tmp_path: Path) -> None:
    run(tmp_path, steps=4)
    names = [path.name for path in (tmp_path / STATES / "step-000000004").iterdir()]
    assert sorted(names) == ["shard-00001-model-00001-of-00001.safetensors", "state.json"]


class Turns(Mean):
    """Two vectors take turns: the second in every third step."""

    def __init__(self, first: nn.Parameter, second: nn.Parameter) -> None:
        super().__init__(first)
        self.second = second

    def trained_group(self, step: int) -> str:
        return "second" if step % 3 == 2 else "first"

    def loss(self, batch: Numbers, generator: torch.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        name = self.trained_group(step)
        weight = self.second if name == "second" else self.weight
        return ((weight - batch.values) ** 2).mean(), {name: float(step)}


def test_the_average_and_the_metrics_follow_the_group_whose_turn_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Weights that did not change do not enter their average again; a metric is the mean of the steps that report it."""
    averages: list[tuple[int, Tensor]] = []
    update = ExponentialAverage.update

    def watched(average: ExponentialAverage) -> None:
        averages.append((average.updates, average.parameters["second/weight"].detach().clone()))
        update(average)

    monkeypatch.setattr(ExponentialAverage, "update", watched)

    def turns(output: Path, steps: int) -> TrainingResult:
        values = {"steps": steps, "precision": "fp32", "log_every": 9, "optimizer": {"warmup_steps": 0}}
        first, second = (nn.Parameter(torch.zeros(3000)) for _ in range(2))
        return train(
            TrainerConfig.model_validate(values),
            groups=[
                ParameterGroup("first", {"weight": first}, averaged=False),
                ParameterGroup("second", {"weight": second}),
            ],
            objective=Turns(first, second),
            load=load,
            output=output,
            identity={},
            title="turns",
        )

    whole = turns(tmp_path / "whole", 9)
    assert [number for number, _ in averages] == [0, 1, 2]
    expected = torch.zeros(3000)
    for number, weight in averages:
        expected.lerp_(weight, 1 - (1 + number) / (10 + number))
    assert torch.equal(whole.average["weight"], expected)
    assert whole.metrics["first"] == pytest.approx((0 + 1 + 3 + 4 + 6 + 7) / 6)
    assert whole.metrics["second"] == pytest.approx((2 + 5 + 8) / 3)
    turns(tmp_path / "parts", 4)
    parts = turns(tmp_path / "parts", 9)
    assert torch.equal(parts.average["weight"], expected)


def test_a_run_of_minutes_goes_on_with_the_time_that_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr("worldline_core.training.trainer.time.monotonic", lambda: clock[0])

    def two_seconds(stop_at: int = -1) -> Callable[[int], float]:
        def at(step: int) -> float:
            clock[0] += 2.0
            if step == stop_at:
                os.kill(os.getpid(), signal.SIGTERM)
            return 1.0

        return at

    values: dict[str, Any] = {"steps": None, "minutes": 0.5, "optimizer": {"warmup_steps": 0, "decay": 0.5}}
    with pytest.raises(StoppedError, match=r"after step 5, 33\.3 %"):
        run(tmp_path, at=two_seconds(stop_at=4), **values)
    clock[0] += 1000.0  # while it was gone
    result = run(tmp_path, at=two_seconds(), **values)
    assert result.steps == 15
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    # A plateau over the first half of the time, then a line to 0.
    rates = {row["step"]: row["learning_rate"] for row in rows}
    assert rates[8] == pytest.approx(1e-3)
    assert rates[12] == pytest.approx(1e-3 * (1 - 22 / 30) / 0.5)
    assert saved(tmp_path)[-1] == 15
    with pytest.raises(ValidationError, match="steps or minutes"):
        TrainerConfig(steps=3, minutes=1.0)
    with pytest.raises(ValidationError, match="steps or minutes"):
        TrainerConfig()


SHARED = {"sharding": {"shards": 2}, "saving": {"keep": 3}}


def test_how_a_run_is_shared_and_saved_does_not_name_it(tmp_path: Path) -> None:
    plain, shared = (
        identity_digests({"config": TrainerConfig.model_validate({"steps": 1, **rest}).model_dump(mode="json")})
        for rest in ({}, SHARED)
    )
    assert plain == shared
    store = ArtifactStore(tmp_path)
    keys = {store.key("train", 1, TrainerConfig.model_validate({"steps": 1, **rest}), {}) for rest in ({}, SHARED)}
    assert len(keys) == 1
    assert plain != identity_digests({"config": TrainerConfig(steps=2).model_dump(mode="json")})


def test_batches_that_cannot_be_shared_out_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "processes", lambda: (1, 4))
    with pytest.raises(ConfigError, match=r"divides 6 micro-batches: 1, 2, 3, 6[\s\S]*got: 4 processes"):
        BatchPlan.of(6)
    plan = BatchPlan.of(8)
    assert (plan.accumulation, plan.number(3), plan.drawn(3)) == (2, 13, (3, 1))
    with pytest.raises(ValidationError, match=r"global_batch \(10\) must be a multiple of batch_size \(4\)"):
        TrainerConfig(steps=1, batch_size=4, global_batch=10)
    with pytest.raises(ValidationError, match="give one of the two"):
        TrainerConfig(steps=1, batch_size=4, global_batch=8, accumulation=2)
