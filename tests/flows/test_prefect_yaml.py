"""prefect.yaml: Prefect ignores misspelt keys silently, so every key, entrypoint and parameter is checked here."""

from __future__ import annotations

import importlib
from pathlib import Path

from prefect import Flow

from flows.pipeline import chain
from tasks.execution.chain import outline
from worldline_core.config import preset_names, read_yaml
from worldline_core.pipeline.pipeline_config import PipelineConfig

DEPLOYMENT_KEYS = {"name", "description", "entrypoint", "parameters", "schedules", "work_pool"}


def test_deployments_are_the_flows_and_every_step_with_parameters_that_exist(project_root: Path) -> None:
    content = read_yaml(project_root / "prefect.yaml")
    assert set(content) == {"name", "prefect-version", "definitions", "deployments"}
    deployments = content["deployments"]
    steps = dict.fromkeys(call.task.name for call in outline(chain, PipelineConfig.load("tiny")).values())
    assert [deployment["name"] for deployment in deployments] == ["pipeline", "nightly-evaluation", *steps]
    for deployment in deployments:
        assert set(deployment) <= DEPLOYMENT_KEYS
        assert set(deployment["work_pool"]) == {"name", "job_variables"}
        assert all(set(schedule) == {"cron", "timezone", "active"} for schedule in deployment.get("schedules", ()))
        path, _, function = deployment["entrypoint"].partition(":")
        flow = getattr(importlib.import_module(path.removesuffix(".py").replace("/", ".")), function)
        assert isinstance(flow, Flow)
        parameters = {"config": None, "overrides": (), "artifacts": "artifacts", **deployment["parameters"]}
        flow.validate_parameters(parameters)
        assert deployment["parameters"]["preset"] in preset_names()
