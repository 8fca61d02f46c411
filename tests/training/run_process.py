"""Training processes for test_processes: each line of the input is a request, answered with their exit codes.

A request has a count of processes, an address, a log and runs: step, config, inputs, output, and what the test wants to
happen in it. The weights that a run ends with are written to `<output>.safetensors`. The processes are forked from this
one, which imports what they need once.
"""

import json
import multiprocessing
import os
import signal
import sys
import time
from pathlib import Path

import torch
from safetensors.torch import save_file

from worldline_core.training.processes import gathered
from worldline_core.training.stage import Stage
from worldline_core.training.stage1 import train_stage1
from worldline_core.training.stage2 import train_stage2
from worldline_core.training.trainer import TrainingRun
from worldline_core.training.training_config import Stage1Config, Stage2Config

STEPS = {"train_stage1": (Stage1Config, train_stage1), "train_stage2": (Stage2Config, train_stage2)}


def kill_before(step):
    """The last process kills itself when it comes to a step, once the states before are on the disk."""
    inner = TrainingRun.step

    def stepping(run, at):
        if int(os.environ["WORLD_SIZE"]) - 1 == int(os.environ["RANK"]) and at == step:
            while any(not (path / "state.json").is_file() for path in run.output.glob("run/training_state/step-*")):
                time.sleep(0.01)
            os.kill(os.getpid(), signal.SIGKILL)
        return inner(run, at)

    TrainingRun.step = stepping


def keep_weights(path):
    """The first process writes the weights that the run ends with, in full precision."""
    inner = Stage.save

    def save(self, *arguments, **named):
        weights = gathered(self.model.state_dict())
        if os.environ["RANK"] == "0":
            save_file({name: value.contiguous() for name, value in weights.items()}, path)
        return inner(self, *arguments, **named)

    Stage.save = save


def work(rank, request):
    with Path(request["log"]).open("ab") as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    os.environ.update(request["environment"] | {"RANK": str(rank)})
    torch.set_num_threads(1)
    originals = TrainingRun.step, Stage.save
    for run in request["runs"]:
        TrainingRun.step, Stage.save = originals
        if "kill_before" in run:
            kill_before(run["kill_before"])
        output = Path(run["output"])
        keep_weights(output.with_name(f"{output.name}.safetensors"))
        config, step = STEPS[run["step"]]
        inputs = {name: Path(path) for name, path in run["inputs"].items()}
        step(config.model_validate(run["config"]), inputs, output)  # type: ignore[operator]


def main():
    context = multiprocessing.get_context("fork")
    for line in sys.stdin:
        request = json.loads(line)
        processes = [context.Process(target=work, args=(rank, request)) for rank in range(request["count"])]
        for process in processes:
            process.start()
        processes[-1].join(400)
        for process in processes:
            process.join(request["alone_at_most"])  # where one process is gone, the others must end by themselves
        print(json.dumps([process.exitcode for process in processes]), flush=True)
        for process in processes:
            process.kill()


if __name__ == "__main__":
    main()
