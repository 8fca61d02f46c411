"""`tasks.distill` under torchrun: two processes, one artifact; the same bytes after a kill."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from tests.distillation.conftest import trainer
from worldline_core.model.checkpoint import load_checkpoint
from worldline_core.store.artifact_files import digest_folder

ALONE = {"batch_size": 1, "validation_batches": 0, "save_every_steps": 1}
TRAJECTORIES = {"clips": 2, "clips_per_shard": 2, "substeps": [1, 1, 1, 1]}
CONFIG = {
    "clips": {"lengths": [17]}, "block_size": 2, "teacher_forcing": {"trainer": trainer(3, **ALONE)},
    "trajectory_regression": {"trainer": trainer(3, **ALONE), "trajectories": TRAJECTORIES},
    "distribution_matching": {"trainer": trainer(12, **ALONE)},
}  # fmt: skip


def start(project, inputs, artifacts, log):
    config = artifacts.parent / "distill.yaml"
    config.write_text(yaml.safe_dump({"distill": CONFIG}))
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m",
               "tasks.distill", "--config", str(config), "--artifacts", str(artifacts)]  # fmt: skip
    for name in ("latents", "tracks", "episodes", "stage2", "tokenizer"):
        command += ["--input", f"{name}={inputs[name]}"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(project)}
    with log.open("ab") as stream:
        return subprocess.Popen(command, cwd=project, env=environment, stdout=stream, stderr=subprocess.STDOUT)


def finish(process, log, seconds=400):
    assert process.wait(timeout=seconds) == 0, log.read_text()[-3000:]
    return log.read_text()


def kill_once_there(process, folder, pattern, seconds=300):
    """Kill torchrun alone, as soon as a file that fits the pattern is there: its processes end with it."""
    until = time.monotonic() + seconds
    while not any(folder.glob(pattern)):
        assert process.poll() is None, "it ended before it could be killed"
        assert time.monotonic() < until
        time.sleep(0.02)
    workers = children(process.pid)
    started = [*workers, *(child for worker in workers for child in children(worker))]
    assert len(started) == 4  # torchrun starts two commands, in sessions of their own; each works in a child
    process.kill()
    process.wait()
    until = time.monotonic() + 60
    while any(map(is_running, started)):
        assert time.monotonic() < until, "processes live on without torchrun"
        time.sleep(0.1)


def children(process):
    return [int(child) for child in Path(f"/proc/{process}/task/{process}/children").read_text().split()]


def is_running(process):
    try:
        return not Path(f"/proc/{process}/stat").read_text().rpartition(") ")[2].startswith("Z")
    except FileNotFoundError:
        return False


@pytest.mark.slow
def test_two_processes_distill_one_artifact_and_go_on_after_a_kill(inputs, project_root, tmp_path):
    whole, parts, log = tmp_path / "whole" / "artifacts", tmp_path / "parts" / "artifacts", tmp_path / "log"
    for folder in (whole, parts):
        folder.mkdir(parents=True)
    inputs["tokenizer"].mkdir()  # read only for the perceptual term, which is off
    text = finish(start(project_root, inputs, whole, log), log)
    (artifact,) = [path for path in (whole / "distill").iterdir() if path.is_dir()]
    assert (artifact / "manifest.json").is_file()
    assert sum(line.startswith(str(artifact)) for line in text.splitlines()) == 2  # both processes say where it is
    assert not list((whole / "distill").glob(".*.workers"))
    manifest = json.loads((artifact / "manifest.json").read_text())
    assert manifest["environment"]["processes"] == 2
    model, info = load_checkpoint(artifact, expect_kind="causal")
    assert info.metadata["distillation"] == "distribution_matching"
    assert all(parameter.isfinite().all() for parameter in model.parameters())

    kill_once_there(
        start(project_root, inputs, parts, log), parts, "distill/*.partial/run/teacher_forcing/run/*/step-*/state.*"
    )
    (partial,) = (parts / "distill").glob("*.partial")
    assert not (partial / "checkpoint.json").exists()
    finish(start(project_root, inputs, parts, log), log)
    again = parts / "distill" / artifact.name
    assert json.loads((again / "manifest.json").read_text())["resumed"] is True
    assert digest_folder(again) == digest_folder(artifact) == manifest["digest"]

    text = finish(start(project_root, inputs, whole, tmp_path / "cached.log"), tmp_path / "cached.log")
    assert text.count("cached") >= 2
