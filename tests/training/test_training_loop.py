"""The training loop alone, on a model of a few numbers: what it saves and keeps, and what ends it."""

import json
import os
import resource
import signal
import time
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from pydantic import ValidationError
from safetensors import safe_open
from safetensors.torch import load_file
from torch import Tensor, nn

from worldline_core.errors import ArtifactError, ConfigError, StoppedError, TrainingError
from worldline_core.store.store import ArtifactStore
from worldline_core.training import processes, training_state
from worldline_core.training.optimizers import make_optimizer
from worldline_core.training.processes import BatchPlan
from worldline_core.training.trainer import Objective, ParameterGroup, train
from worldline_core.training.training_config import SavingConfig, TrainerConfig
from worldline_core.training.training_state import ExponentialAverage, TrainingStates, identity_digests, newest_state

STATES = Path("run") / "training_state"
FOURTH = STATES / "step-000000004"


@dataclass(frozen=True)
class Numbers:
    names: tuple[str, ...]
    values: Tensor


class Mean(Objective):
    """Squared distance of a vector to the batch."""

    def __init__(self, weight, at=lambda _: 1.0):
        self.weight, self.at = weight, at

    def loss(self, batch, generator, step):
        noise = torch.randn(batch.values.shape, generator=generator)
        return ((self.weight - batch.values - 0.1 * noise) ** 2).mean() * self.at(step), {}


def load(index):
    return Numbers((f"episode-{index}",), torch.randn(2, 3000, generator=torch.Generator().manual_seed(index)))


def run(output, steps=12, *, at=lambda _: 1.0, validate=None, **changes):
    values = {"save_every_seconds": 1000, "save_every_steps": 4, "log_every": 2, "precision": "fp32"}
    config = TrainerConfig.model_validate({"steps": steps, "optimizer": {"warmup_steps": 0}, **values, **changes})
    weight = nn.Parameter(torch.zeros(3000))
    return train(
        config, groups=[ParameterGroup("vector", {"weight": weight})], objective=Mean(weight, at), load=load,
        validate=validate, output=output, identity={"config": config.model_dump(mode="json", exclude={"steps"})},
        title="vector",
    )  # fmt: skip


def saved(output):
    return sorted(json.loads(path.read_text())["step"] for path in output.glob(f"{STATES}/*/state.json"))


def goes_on(output):
    """The run continues where it ended, and ends as one that nothing disturbed."""
    return torch.equal(run(output).average["weight"], run(output / "whole").average["weight"])


def test_a_loss_that_is_not_finite_keeps_its_batch_and_the_state_before(tmp_path):
    with pytest.raises(TrainingError, match="loss is not finite") as ended:
        run(tmp_path, at=lambda step: float("nan") if step == 6 else 1.0)
    (replay,) = (tmp_path / "run" / "replay").iterdir()
    for fact in ("vector, step 6, clips episode-6", str(replay), f"last good state is {tmp_path / FOURTH}"):
        assert fact in str(ended.value)
    assert saved(tmp_path) == [4]
    with safe_open(replay, framework="pt") as stored:
        assert torch.equal(stored.get_tensor("values"), load(6).values)
        facts = json.loads(stored.metadata()["facts"])
    assert (facts["step"], facts["micro_batch"], facts["seed"]) == (6, 6, 0)
    assert goes_on(tmp_path)  # once the cause is gone


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_held_out_loss_that_is_not_finite_ends_the_run_with_valid_json(tmp_path, value):
    scores = iter([0.5, value])
    with pytest.raises(TrainingError, match=r"(?s)held-out loss is not finite.*step 8, validation/loss.*000000004"):
        run(tmp_path, validate=lambda: {"loss": next(scores)}, validate_every=4)
    assert saved(tmp_path) == [4]
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    rows = [json.loads(line, parse_constant=pytest.fail) for line in lines]
    assert [row["validation/loss"] for row in rows if "validation/loss" in row] == [0.5, None]


@contextmanager
def files_of_at_most(size):
    """The disk is full for files beyond this size."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_ends_the_run_and_keeps_the_state_before(tmp_path):
    run(tmp_path, steps=4)
    with files_of_at_most(20_000), pytest.raises(TrainingError, match="state could not be written") as ended:
        run(tmp_path)
    for fact in ("File too large", "free some space", f"last good state is {tmp_path / FOURTH}"):
        assert fact in str(ended.value)
    assert list((tmp_path / STATES).iterdir()) == [tmp_path / FOURTH]
    assert goes_on(tmp_path)


@pytest.mark.parametrize(
    "form",
    [
        {"optimizer": {"moments": "8bit"}},
        {"weights": "bf16", "precision": "bf16"},
        {"weights": "bf16", "precision": "bf16", "average": "host", "optimizer": {"moments": "8bit"}},
    ],
    ids=["moments", "weights", "all"],
)
def test_forms_that_save_memory_take_small_steps_and_go_on_with_the_same_bytes(tmp_path, form):
    """Each step is a twentieth of what bfloat16 resolves at 1: rounded to the nearest, no weight would ever move."""

    def trained(name, at=lambda _: 1.0):
        dtype = torch.bfloat16 if "weights" in form else torch.float32
        weight, optimizer = nn.Parameter(torch.ones(48, 128, dtype=dtype)), {"warmup_steps": 0, "learning_rate": 2e-4}
        config = TrainerConfig.model_validate(
            {"steps": 12, "save_every_seconds": 1000, **form, "optimizer": optimizer | form.get("optimizer", {})}
        )
        batch = Numbers(("still",), torch.zeros(2, 48, 128))
        averaged = train(
            config, groups=[ParameterGroup("matrix", {"weight": weight})], objective=Mean(weight, at), load=lambda _: batch,
            validate=lambda: {"loss": float((weight.detach().float() - 1).abs().mean())}, output=tmp_path / name,
            identity={}, title="matrix",
        ).average["weight"]  # fmt: skip
        assert (averaged.dtype, weight.dtype) == (torch.float32, dtype)
        return weight.detach().float(), averaged

    with pytest.raises(StoppedError):
        trained("stopped", stop_at(5))
    found, wanted = trained("stopped"), trained("whole")
    assert all(torch.equal(one, other) for one, other in zip(found, wanted, strict=True))
    assert (1 - wanted[0].mean()).item() == pytest.approx(12 * 2e-4, rel=0.15)
    assert 0 < (1 - wanted[1].mean()).item() < 12 * 2e-4


@pytest.mark.parametrize("signed", [True, False])
def test_moments_are_rounded_to_the_nearest_as_torchao_does(signed):
    from torchao.optim.subclass_8bit import OptimState8bit  # seconds, of this test alone

    parameter = nn.Parameter(torch.zeros(64, 256))
    config = TrainerConfig.model_validate({"steps": 1, "optimizer": {"moments": "8bit"}})
    found = make_optimizer(config, [[parameter]])._new_buffer(parameter, signed)
    wanted = OptimState8bit.zeros(parameter.shape, signed, 256, parameter.device)
    values = torch.randn(64, 256, generator=torch.Generator().manual_seed(0)) ** 5
    values = values if signed else values.abs()
    errors = [(moment.copy_(values).dequantize() - values).abs().mean().item() for moment in (found, wanted)]
    assert torch.equal(found.scale, wanted.scale)
    # Those that lie half way between two of the 256 values may go either way.
    assert (found.codes != wanted.codes).float().mean() < 0.01
    assert errors[0] == pytest.approx(errors[1], rel=1e-3)


@pytest.mark.parametrize("error", [RuntimeError("[gloo/transport/tcp/pair.cc:544] Connection closed by peer"), None])
def test_a_state_that_another_process_left_unfinished_is_not_blamed_on_the_disk(tmp_path, error):
    weight = {"weight": nn.Parameter(torch.zeros(3))}
    average, optimizer = ExponentialAverage(weight, 0.5), torch.optim.SGD(weight.values())
    message = str(TrainingStates(tmp_path, SavingConfig(), weight, average, optimizer).failed(error))
    assert "every process to write its part" in message and "space" not in message


def test_an_average_on_the_host_taken_in_slices_is_the_one_on_the_device(monkeypatch):
    half = {
        "half": nn.Parameter(torch.randn(7, 3).bfloat16()),
        "full": nn.Parameter(torch.randn(5)),
        "one": nn.Parameter(torch.ones(())),
    }
    averages = [ExponentialAverage(half, 0.5, on_host=on_host) for on_host in (False, True)]
    for _ in range(3):
        with torch.no_grad():
            for parameter in half.values():
                parameter.mul_(1.5).add_(0.25)
        for average, values in zip(averages, (2**20, 6), strict=True):
            monkeypatch.setattr(training_state, "SLICE_VALUES", values)
            average.update()
    for name, parameter in half.items():
        device, host = (average.average[name] for average in averages)
        assert host.dtype == torch.float32 and torch.equal(device, host) and not torch.equal(host, parameter.float())


def stop_at(stopped):
    """Loses as always, but SIGTERM comes in one step."""

    def at(step):
        if step == stopped:
            os.kill(os.getpid(), signal.SIGTERM)
        return 1.0

    return at


def test_a_stopped_run_saves_its_state_and_goes_on_with_the_same_bytes(tmp_path):
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(StoppedError, match=r"after step 6, 50 %"):
        run(tmp_path / "stopped", at=stop_at(5))
    assert signal.getsignal(signal.SIGTERM) == before
    assert saved(tmp_path / "stopped") == [6]
    for name in ("stopped", "whole"):
        run(tmp_path / name)
    assert (tmp_path / "stopped" / "metrics.jsonl").read_bytes() == (tmp_path / "whole" / "metrics.jsonl").read_bytes()
    folders = [tmp_path / name / STATES / "step-000000012" for name in ("stopped", "whole")]
    stopped, whole = (load_file(next(folder.glob("*.safetensors"))) for folder in folders)
    assert stopped.keys() == whole.keys() >= {"weight/vector/weight", "exp_avg/vector/weight", "step/vector/weight"}
    assert all(torch.equal(stopped[name], whole[name]) for name in whole)


def test_the_latest_states_and_the_best_one_stay(tmp_path):
    losses = iter([0.9, 0.2, 0.8, 0.7, 0.6, 0.5])
    every = {"validate_every": 2, "save_every_steps": 2, "saving": {"keep": 2, "best": "loss"}}
    run(tmp_path, validate=lambda: {"loss": next(losses)}, **every)
    assert saved(tmp_path) == [4, 10, 12]
    assert newest_state(tmp_path)["step"] == 12


@pytest.mark.parametrize(("share", "states"), [(1e-9, [1, 30]), (1.0, None)])
def test_saving_takes_a_share_of_the_time(tmp_path, share, states):
    def slow_enough(step):
        """Steps last as long as a state takes, on a slow disk too, until there are four of them."""
        before, began = len(saved(tmp_path)), time.monotonic()
        while states is None and before == len(saved(tmp_path)) <= 3 and time.monotonic() - began < 0.5:
            time.sleep(0.01)
        return 1.0

    saving = {"share": share, "keep": 100}
    run(tmp_path, steps=30, at=slow_enough, save_every_seconds=0, save_every_steps=0, saving=saving)
    assert len(saved(tmp_path)) > 3 if states is None else saved(tmp_path) == states


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("shard-00001-model-00001-of-00001.safetensors", lambda part: part.write_bytes(part.read_bytes()[:1000]), "1000 bytes"),
        ("shard-00001-model-00001-of-00001.safetensors", Path.unlink, "no such file"),
        ("state.json", lambda index: index.write_text("{"), "damaged"),
    ],
)  # fmt: skip
def test_a_damaged_state_is_named(tmp_path, name, damage, message):
    run(tmp_path, steps=4)
    # Nothing else is in it: a state holds no pickle.
    assert {path.name for path in (tmp_path / FOURTH).iterdir()} >= {name}
    assert {path.suffix for path in (tmp_path / FOURTH).iterdir()} == {".safetensors", ".json"}
    damage(tmp_path / FOURTH / name)
    with pytest.raises(ArtifactError, match=message):
        run(tmp_path)


def test_what_a_kill_left_of_a_state_is_no_state(tmp_path):
    run(tmp_path, steps=4)
    half = tmp_path / STATES / "step-000000008"
    half.mkdir()
    (half / "shard-00001-model-00001-of-00001.safetensors").write_bytes(b"half")
    assert goes_on(tmp_path)
    assert saved(tmp_path) == [12]


class Turns(Mean):
    """Two vectors take turns: the second in every third step."""

    def __init__(self, first, second):
        super().__init__(first)
        self.second = second

    def trained_group(self, step):
        return "second" if step % 3 == 2 else "first"

    def loss(self, batch, generator, step):
        name = self.trained_group(step)
        weight = self.second if name == "second" else self.weight
        return ((weight - batch.values) ** 2).mean(), {name: float(step)}


def test_the_average_and_the_metrics_follow_the_group_whose_turn_it_is(tmp_path, monkeypatch):
    """Weights that did not change do not enter their average again; a metric is the mean of the steps that report it."""
    averages, update = [], ExponentialAverage.update

    def watched(average):
        averages.append((average.updates, average.parameters["second/weight"].detach().clone()))
        update(average)

    monkeypatch.setattr(ExponentialAverage, "update", watched)

    def turns(output, steps):
        values = {"steps": steps, "precision": "fp32", "log_every": 9, "optimizer": {"warmup_steps": 0}}
        first, second = (nn.Parameter(torch.zeros(3000)) for _ in range(2))
        groups = [
            ParameterGroup("first", {"weight": first}, averaged=False),
            ParameterGroup("second", {"weight": second}),
        ]
        return train(
            TrainerConfig.model_validate(values), groups=groups, objective=Turns(first, second), load=load,
            output=output, identity={}, title="turns",
        )  # fmt: skip

    whole = turns(tmp_path / "whole", 9)
    assert [number for number, _ in averages] == [0, 1, 2]
    expected = torch.zeros(3000)
    for number, weight in averages:
        expected.lerp_(weight, 1 - (1 + number) / (10 + number))
    assert torch.equal(whole.average["weight"], expected)
    assert whole.metrics["first"] == pytest.approx((0 + 1 + 3 + 4 + 6 + 7) / 6)
    assert whole.metrics["second"] == pytest.approx((2 + 5 + 8) / 3)
    turns(tmp_path / "parts", 4)
    assert torch.equal(turns(tmp_path / "parts", 9).average["weight"], expected)


def test_a_run_of_minutes_goes_on_with_the_time_that_is_left(tmp_path, monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("worldline_core.training.trainer.time.monotonic", lambda: clock[0])

    def two_seconds(step, at=lambda _: 1.0):
        clock[0] += 2.0
        return at(step)

    values = {"steps": None, "minutes": 0.5, "optimizer": {"warmup_steps": 0, "decay": 0.5}}
    with pytest.raises(StoppedError, match=r"after step 5, 33\.3 %"):
        run(tmp_path, at=lambda step: two_seconds(step, stop_at(4)), **values)
    clock[0] += 1000.0  # while it was gone
    assert run(tmp_path, at=two_seconds, **values).steps == saved(tmp_path)[-1] == 15
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    # A plateau over the first half of the time, then a line to 0.
    rates = {row["step"]: row["learning_rate"] for row in rows}
    assert rates[8] == pytest.approx(1e-3)
    assert rates[12] == pytest.approx(1e-3 * (1 - 22 / 30) / 0.5)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"steps": 3, "minutes": 1.0}, "steps or minutes"),
        ({}, "steps or minutes"),
        ({"steps": 1, "batch_size": 4, "global_batch": 10}, r"global_batch \(10\).*multiple of batch_size \(4\)"),
        ({"steps": 1, "batch_size": 4, "global_batch": 8, "accumulation": 2}, "one of the two"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(values, message):
    with pytest.raises(ValidationError, match=message):
        TrainerConfig(**values)


def test_how_a_run_is_shared_and_saved_does_not_name_it(tmp_path):
    shared = {"sharding": {"shards": 2}, "saving": {"keep": 3}}
    configs = [TrainerConfig.model_validate(values) for values in ({"steps": 1}, {"steps": 1, **shared}, {"steps": 2})]
    plain, same, other = (identity_digests({"config": config.model_dump(mode="json")}) for config in configs)
    assert plain == same != other
    assert len({ArtifactStore(tmp_path).key("train", 1, config, {}) for config in configs[:2]}) == 1


def test_batches_that_cannot_be_shared_out_are_named(monkeypatch):
    monkeypatch.setattr(processes, "processes", lambda: (1, 4))
    with pytest.raises(ConfigError, match=r"divides 6 micro-batches: 1, 2, 3, 6[\s\S]*got: 4 processes"):
        BatchPlan.of(6)
    plan = BatchPlan.of(8)
    assert (plan.accumulation, plan.number(3), plan.drawn(3)) == (2, 13, (3, 1))
