"""The steps of a rehearsal that a run takes outside of its flow: the import of the backbone, and training in processes."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import tasks
import worldline_core
from flows.pipeline import chain
from tasks.execution.chain import find_artifacts, outline, ready_inputs
from tasks.import_backbone import import_backbone
from worldline_core.errors import TrainingError
from worldline_core.model.world_model_config import ImportBackboneConfig
from worldline_core.pipeline.pipeline_config import PipelineConfig, check_weights
from worldline_core.store.store import ArtifactStore


def import_base(config: PipelineConfig, store: ArtifactStore) -> None:
    """Import the backbone beside its autoencoder and link it to the folder that the configuration names, as a user does."""
    if config.models.base is None or config.models.base.exists():
        return
    source = cast("Path", config.models.tokenizer).parent
    settings = config.import_backbone or ImportBackboneConfig.model_validate({})
    imported = import_backbone.run(store, settings, {"diffusers": source})
    config.models.base.parent.mkdir(parents=True, exist_ok=True)
    config.models.base.unlink(missing_ok=True)  # a link to an artifact that is gone
    config.models.base.symlink_to(imported.path.resolve(), target_is_directory=True)


def train_in_processes(
    preset: str | None, path: Path | None, overrides: Sequence[str], artifacts: Path, processes: int
) -> None:
    """Every node up to the last training, in the working folder: trainings through torchrun, the others in this process.

    Raises:
        UnavailableError: a folder of weights is missing.
        TrainingError: the processes of a training ended with an error, which they have printed.
    """
    config = PipelineConfig.load(preset, path, overrides)
    chosen = ["--config", str(path)] if path else ["--preset", str(preset)]
    chosen += [argument for override in overrides for argument in ("--set", override)]
    store = ArtifactStore(artifacts, config.runner.verify)
    import_base(config, store)
    check_weights(config, Path.cwd())
    calls = outline(chain, config)
    last = max(number for number, call in enumerate(calls.values()) if call.task.distributed)
    for call in list(calls.values())[: last + 1]:
        if not call.task.distributed or call.name in find_artifacts(calls, store):
            call.task.run(store, call.config, ready_inputs(call, calls, store))
            continue
        launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={processes}"]
        step = ["-m", f"tasks.{call.task.name}", *chosen, "--artifacts", str(store.root), "--name", call.name]
        code = [str(Path(str(package.__file__)).parents[1]) for package in (tasks, worldline_core)]
        search = os.pathsep.join([*code, *filter(None, [os.environ.get("PYTHONPATH")])])
        ended = subprocess.run([*launcher, *step], env={**os.environ, "PYTHONPATH": search}, check=False)  # noqa: S603
        if ended.returncode:
            raise TrainingError(
                "A training ended with an error", where=call.name, got=f"exit status {ended.returncode}; see above"
            )
