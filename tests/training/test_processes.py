"""Training on several processes (gloo): one model in parts, one writer, the same weights on any number of them."""

import json
import os
import shutil
import socket
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
from safetensors.torch import load_file

from tests.training import conftest
from tests.training.conftest import TINY_MODEL, losses
from worldline_core.model.checkpoint import save_checkpoint
from worldline_core.store.artifact_files import digest_folder, read_json_lines


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture(scope="module")
def run_processes(project_root):
    """Runs requests on processes that find each other as torchrun's do; their exit codes, None for one that hangs.

    Of the function:
        alone_at_most: seconds that the others may go on after the last one.
    """
    command = [sys.executable, str(Path(__file__).with_name("run_process.py"))]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(project_root)}
    with subprocess.Popen(
        command, cwd=project_root, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as starting:
        requests, answers = starting.stdin, starting.stdout
        assert requests is not None

        def run(folder, runs, count=2, *, alone_at_most=200):
            address = {"WORLD_SIZE": str(count), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port())}
            request = {"count": count, "environment": address, "log": folder / "log", "runs": runs}
            print(json.dumps(request | {"alone_at_most": alone_at_most}, default=str), file=requests, flush=True)
            return json.loads(answers.readline())

        yield run


def difference(first, second):
    """The largest difference between the weights of two runs."""
    one, other = (load_file(output.with_name(f"{output.name}.safetensors")) for output in (first, second))
    assert one.keys() == other.keys()
    return max(float((one[name] - other[name]).abs().max()) for name in one)


def trainer(steps, batch_size, **changes):
    optimizer = {"learning_rate": 1e-3, "warmup_steps": 2}
    return conftest.trainer(
        steps, batch_size=batch_size, log_every=2, save_every_steps=5, optimizer=optimizer, **changes
    )


@pytest.fixture(scope="module")
def inputs(world, base, teacher, make_model, tmp_path_factory):
    wan = tmp_path_factory.mktemp("wan")
    save_checkpoint(
        wan, make_model(network="wan"), kind="base", action_contract=None
    )  # with a prompt among its weights
    return {**world.inputs, "stage1": base, "teacher": teacher}, {**world.inputs, "stage1": wan}


def stage2(output, inputs, name, *, steps=20, relational=None, **changes):
    """A run of Stage II, four clips a step whatever the number of processes."""
    run = {key: changes.pop(key) for key in ("kill_before",) if key in changes}
    config = {
        "trainer": trainer(steps, **{"batch_size": 2, "global_batch": 4, **changes}),
        "clips": {"lengths": [9, 17], "view_weights": {"joint": 1.0, "head": 1.0}},
        "action_multiplier": 3.0,
        "relational": relational,
    }
    return {"step": "train_stage2", "config": config, "inputs": inputs, "output": output / name, **run}


def stage1(output, inputs, name):
    """A run of Stage I in which some micro-batches read their text and others do not."""
    config = {
        "model": TINY_MODEL, "text_dropout": 0.5, "clips": {"lengths": [9], "view_weights": {"primary": 1}},
        "trainer": trainer(20, 2, global_batch=4),
    }  # fmt: skip
    return {"step": "train_stage1", "config": config, "inputs": inputs, "output": output / name}


@dataclass(frozen=True)
class Runs:
    """Folder of all runs, and output and exit codes of their processes."""

    folder: Path
    log: str
    codes: list[int | None]

    def __truediv__(self, name):
        return self.folder / name


@pytest.fixture(scope="module")
def runs(inputs, run_processes, tmp_path_factory):
    """Every run that the tests below compare: starting processes costs more than the runs."""
    (inputs, wan), folder = inputs, tmp_path_factory.mktemp("runs")
    one, two, four = folder / "one", folder / "two", folder / "four"
    for path in (one, two, four):
        path.mkdir()
    # One process: whole runs, and one that is stopped half-way.
    terms = {"ramp_steps": 2}
    alone = [
        stage1(one, inputs, "text"),
        stage2(one, inputs, "plain"),
        stage2(one, inputs, "terms", relational=terms),
        stage2(one, wan, "wan"),
    ]
    assert run_processes(one, alone, count=1) == [0], (one / "log").read_text()[-3000:]
    assert run_processes(one, [stage2(one, inputs, "half", kill_before=11)], count=1) == [-9]
    # Two processes: the same, with blocks computed again; the last run loses its second process.
    shared = [
        stage1(two, inputs, "text"),
        stage2(two, inputs, "plain"),
        stage2(two, inputs, "terms", relational=terms),
        stage2(two, wan, "wan"),
        stage2(two, inputs, "again", sharding={"checkpointing": "block", "reduce_every_micro_step": True}),
        stage2(two, inputs, "killed", kill_before=11),
    ]
    codes = run_processes(two, shared, alone_at_most=60)
    # Two go on from one, one goes on from two, two from two.
    shutil.copytree(one / "half", two / "half")
    shutil.copytree(two / "killed", one / "killed")
    resumed = [stage2(two, inputs, "killed"), stage2(two, inputs, "half")]
    log = (two / "log").read_text()
    assert run_processes(two, resumed) == [0, 0], (two / "log").read_text()[-3000:]
    assert run_processes(one, [stage2(one, inputs, "killed")], count=1) == [0]
    # Four processes, two copies of two parts.
    copies = stage2(four, inputs, "plain", batch_size=1, sharding={"shards": 2})
    assert run_processes(four, [copies], count=4) == [0] * 4, (four / "log").read_text()[-3000:]
    single = stage2(four, inputs, "single", batch_size=1)
    assert run_processes(four, [single], count=1) == [0]
    return Runs(folder, log, codes)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first", "second"),
    [
        pytest.param("one/plain", "two/plain", id="two"),
        pytest.param("one/text", "two/text", id="two, text"),
        pytest.param("one/terms", "two/terms", id="two, relational terms"),
        pytest.param("one/wan", "two/wan", id="two, Wan"),
        pytest.param("one/plain", "two/again", id="two, blocks again"),
        pytest.param("one/plain", "one/killed", id="two, then one"),
        pytest.param("one/plain", "two/half", id="one, then two"),
        pytest.param("four/single", "four/plain", id="two copies of two parts"),
    ],
)
def test_another_number_of_processes_learns_the_same(runs, first, second):
    assert losses(runs / second) == pytest.approx(losses(runs / first), rel=1e-6)
    # Every term and scale is the mean over the same clips and pairs.
    logged = [read_json_lines(runs / name / "metrics.jsonl") for name in (first, second)]
    assert logged[1] == [pytest.approx(row, rel=1e-5, abs=1e-9) for row in logged[0]]
    # Sums of another order differ in the last digit, and Adam moves a weight by 1e-3 a step also where its gradient is
    # rounding. One digit in the gradients of a single process moves a weight by up to 3e-7 here, with relational terms by 3e-6.
    assert difference(runs / first, runs / second) <= (1e-5 if first == "one/terms" else 1e-6)
    # One writer: every line of the log once.
    assert [row["step"] for row in logged[1] if "loss" in row] == [*range(2, 21, 2)]


@pytest.mark.slow
def test_processes_that_were_killed_end_with_the_same_bytes_and_one_left_alone_says_so(runs):
    assert digest_folder(runs / "two/killed") == digest_folder(runs / "two/plain")
    assert runs.codes == [1, -9]
    assert "Another process of this training has ended or cannot be reached" in runs.log
