"""Curate in a process of its own, to be killed: `curate_command.py CONFIG.json RUNNER.json OUTPUT`."""

from __future__ import annotations

import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[2]))
    from tasks.execution.shard_mapper import shard_mapper
    from worldline_core.data.curation.curate import curate
    from worldline_core.data.curation.curate_config import CurateConfig
    from worldline_core.scale.mapping import RunnerConfig

    configured, runner, output = (Path(argument) for argument in sys.argv[1:])
    mapper = shard_mapper(RunnerConfig.model_validate_json(runner.read_text()))
    curate(CurateConfig.model_validate_json(configured.read_text()), {}, output, mapper)
