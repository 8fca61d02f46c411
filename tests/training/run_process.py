"""One of several training processes, for test_processes: `python run_process.py REQUEST.json`.

A request is a list of runs: step, config, inputs, output, and what the test wants to happen in it. Every process writes
the weights it ends with to `<output>.rank<N>.safetensors`.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file

from worldline_core.training import trainer
from worldline_core.training.flow_matching import FlowMatchingObjective, add_noise, flow_matching_loss
from worldline_core.training.stage import Stage
from worldline_core.training.stage1 import Stage1Config, train_stage1
from worldline_core.training.stage2 import Stage2Config, train_stage2

STEPS = {"train_stage1": (Stage1Config, train_stage1), "train_stage2": (Stage2Config, train_stage2)}
RANK = int(os.environ.get("RANK", "0"))


def loss_by_clip(self: FlowMatchingObjective, batch: Any, generator: torch.Generator, step: int) -> Any:
    """Flow matching whose noise depends on each clip alone, not on who draws it: a batch may be cut anywhere."""
    sigma, noise = [], []
    for clip, latents in zip(batch.clips, batch.latents, strict=True):
        own = torch.Generator().manual_seed(int(clip.episode_id[-3:]) * 1000 + clip.start)
        sigma.append(torch.rand((), generator=own) * 0.8 + 0.1)
        noise.append(torch.randn(latents.shape, generator=own))
    sigmas, noises = torch.stack(sigma), torch.stack(noise)
    noisy = add_noise(batch.latents, noises, sigmas)
    output = self.model(noisy, sigmas, action_maps=batch.action_maps, views=batch.views)
    return flow_matching_loss(output.velocity, batch.latents, noises, sigmas, self.weighting), {}


def kill_before(step: int) -> None:
    """The second process kills itself when it comes to a step."""
    inner = trainer._step

    def stepping(config: Any, objective: Any, load: Any, optimizer: Any, parameters: Any, at: int, *rest: Any) -> Any:
        if RANK == 1 and at == step:
            os.kill(os.getpid(), signal.SIGKILL)
        return inner(config, objective, load, optimizer, parameters, at, *rest)

    trainer._step = stepping


def keep_weights(path: Path) -> None:
    """Every process writes its own weights when the run is done."""
    inner = Stage.save

    def save(self: Stage, *arguments: Any, **named: Any) -> Any:
        save_file({name: value.contiguous() for name, value in self.model.state_dict().items()}, path)
        return inner(self, *arguments, **named)

    Stage.save = save


def main() -> None:
    torch.set_num_threads(1)
    originals = trainer._step, Stage.save, FlowMatchingObjective.loss
    for run in json.loads(Path(sys.argv[1]).read_text()):
        trainer._step, Stage.save, FlowMatchingObjective.loss = originals
        if run.get("by_clip"):
            FlowMatchingObjective.loss = loss_by_clip
        if "kill_before" in run:
            kill_before(run["kill_before"])
        output = Path(run["output"])
        keep_weights(output.with_name(f"{output.name}.rank{RANK}.safetensors"))
        config, step = STEPS[run["step"]]
        inputs = {name: Path(path) for name, path in run["inputs"].items()}
        step(config.model_validate(run["config"]), inputs, output)  # type: ignore[operator]


if __name__ == "__main__":
    main()
