"""Training on two processes (gloo): one model, the batch shared out, one writer, and the same bytes after a kill."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from worldline_core.model.checkpoint import save_checkpoint
from worldline_core.model.world_model import WorldModel, WorldModelConfig
from worldline_core.store.artifact_files import digest_folder, read_json_lines


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def run_processes(project: Path, folder: Path, runs: list[dict[str, Any]], count: int = 2) -> list[int]:
    """Run requests on processes that find each other as torchrun's do; their exit codes."""
    request = folder / f"request-{len(list(folder.glob('request-*')))}.json"
    request.write_text(json.dumps(runs, default=str))
    shared = {"WORLD_SIZE": str(count), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port()),
              "OMP_NUM_THREADS": "1", "PYTHONPATH": str(project)}  # fmt: skip
    command = [sys.executable, str(Path(__file__).with_name("run_process.py")), str(request)]
    with (folder / "log").open("ab") as log:
        processes = [
            subprocess.Popen(
                command, cwd=project, env={**os.environ, **shared, "RANK": str(rank)}, stdout=log, stderr=log
            )
            for rank in range(count)
        ]
        last = processes[-1].wait(timeout=280)
        if last != 0:
            # What torchrun does: when one process is gone, it ends the others.
            for process in processes:
                process.kill()
        return [process.wait(timeout=280) for process in processes[:-1]] + [last]


def weights(output: Path, rank: int) -> dict[str, torch.Tensor]:
    return load_file(output.with_name(f"{output.name}.rank{rank}.safetensors"))


def trainer(steps: int, batch_size: int, **changes: Any) -> dict[str, Any]:
    values: dict[str, Any] = {
        "steps": steps,
        "batch_size": batch_size,
        "precision": "fp32",
        "log_every": 2,
        "validation_batches": 1,
        "save_every_seconds": 1000.0,
        "save_every_steps": 2,
        "optimizer": {"learning_rate": 3e-3, "warmup_steps": 2},
    }
    return values | changes


@pytest.fixture(scope="module")
def inputs(world: Any, tiny_model: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    model = WorldModel(WorldModelConfig.model_validate(tiny_model))
    model.initialise(torch.Generator().manual_seed(0))
    folder = tmp_path_factory.mktemp("base")
    save_checkpoint(folder, model, kind="base", action_contract=None)
    return {**world.inputs, "stage1": folder}


def stage2(output: Path, inputs: dict[str, Path], batch_size: int, **run: Any) -> dict[str, Any]:
    config = {
        "trainer": trainer(6, batch_size),
        "clips": {"lengths": [9, 17], "view_weights": {"joint": 1.0, "head": 1.0}},
        "action_multiplier": 3.0,
        "relational": None,
    }
    return {"step": "train_stage2", "config": config, "inputs": inputs, "output": output, **run}


@pytest.mark.slow
def test_two_processes_train_one_model(
    world: Any, inputs: dict[str, Path], tiny_model: dict[str, Any], project_root: Path, tmp_path: Path
) -> None:
    text_run = {
        "step": "train_stage1",
        "config": {
            "model": tiny_model,
            # Each process draws for itself whether it reads the text, so often only one of them uses the text tower.
            "text_dropout": 0.5,
            "clips": {"lengths": [9], "view_weights": {"primary": 1}},
            "trainer": trainer(6, 2),
        },
        "inputs": world.inputs,
        "output": tmp_path / "text",
    }
    shared, twice = tmp_path / "shared", tmp_path / "twice"
    runs = [stage2(shared, inputs, 2, by_clip=True), stage2(tmp_path / "drawn", inputs, 2), text_run]
    assert run_processes(project_root, tmp_path, runs) == [0, 0], (tmp_path / "log").read_text()[-3000:]
    assert run_processes(project_root, tmp_path, [stage2(twice, inputs, 4, by_clip=True)], count=1) == [0]

    # Two processes with two clips each take the step of one process with four (but for the order of sums).
    together, alone = weights(shared, 0), weights(twice, 0)
    assert max(float((together[name] - alone[name]).abs().max()) for name in alone) < 2e-4
    start = dict(load_file(inputs["stage1"] / "model.safetensors"))
    moved = max(float((alone[name] - start[name].float()).abs().max()) for name in alone if name in start)
    assert moved > 5e-3
    losses = [
        [row["loss"] for row in read_json_lines(run / "metrics.jsonl") if "loss" in row] for run in (shared, twice)
    ]
    assert losses[0] == pytest.approx(losses[1], rel=1e-4)

    for run in (shared, tmp_path / "drawn", tmp_path / "text"):
        first, second = weights(run, 0), weights(run, 1)
        assert all(torch.equal(first[name], second[name]) for name in first)
        # One writer: every line of the log once.
        steps = [row["step"] for row in read_json_lines(run / "metrics.jsonl") if "loss" in row]
        assert steps == [2, 4, 6]


@pytest.mark.slow
def test_processes_that_were_killed_end_with_the_same_bytes(
    inputs: dict[str, Path], project_root: Path, tmp_path: Path
) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert run_processes(project_root, tmp_path, [stage2(whole, inputs, 2)]) == [0, 0]
    killed = run_processes(project_root, tmp_path, [stage2(parts, inputs, 2, kill_before=5)])
    assert killed == [-9, -9]
    assert not (parts / "checkpoint.json").exists()
    assert run_processes(project_root, tmp_path, [stage2(parts, inputs, 2)]) == [0, 0]
    assert digest_folder(parts) == digest_folder(whole)
    # A state of two processes is not one of a single process: the batches differ.
    assert run_processes(project_root, tmp_path, [stage2(parts, inputs, 2)], count=1) != [0]
    assert "The training state belongs to another run" in (tmp_path / "log").read_text()


def test_gradients_and_values_of_a_single_process_are_left_alone(make_model: Callable[..., WorldModel]) -> None:
    from worldline_core.training.trainer import (
        average_gradients,
        average_values,
        join_processes,
        processes,
        wait_for_all,
    )

    join_processes("cpu")
    assert processes() == (0, 1)
    wait_for_all()
    model = make_model()
    parameters = list(model.parameters())
    parameters[0].grad = torch.ones_like(parameters[0])
    average_gradients(parameters)
    assert parameters[1].grad is None
    assert float(parameters[0].grad.mean()) == 1.0
    assert average_values({"loss": 2.5}) == {"loss": 2.5}
