"""prefect.yaml: Prefect ignores misspelt keys silently, so every key, entrypoint and parameter is checked here."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import pytest
from prefect import Flow

from flows.pipeline import chain
from tasks.execution.chain import outline
from worldline_core.config import load_config, preset_names, read_yaml
from worldline_core.pipeline.pipeline_config import PipelineConfig

TOP_KEYS = {"name", "prefect-version", "definitions", "deployments"}
DEPLOYMENT_KEYS = {"name", "description", "entrypoint", "parameters", "schedules", "work_pool", "tags"}
SCHEDULE_KEYS = {"cron", "timezone", "active"}
WORK_POOL_KEYS = {"name", "job_variables"}


@pytest.fixture(scope="module")
def deployments(project_root: Path) -> list[dict[str, Any]]:
    content = read_yaml(project_root / "prefect.yaml")
    assert set(content) <= TOP_KEYS
    return content["deployments"]


def test_names(deployments: list[dict[str, Any]]) -> None:
    """The two flows, and every step of a run of the preset that they run."""
    names = [deployment["name"] for deployment in deployments]
    calls = outline(chain, load_config(PipelineConfig, preset="tiny"))
    assert names == ["pipeline", "nightly-evaluation", *dict.fromkeys(call.task.name for call in calls.values())]


@pytest.mark.parametrize("index", range(14))
def test_keys_entrypoint_and_parameters(deployments: list[dict[str, Any]], index: int) -> None:
    deployment = deployments[index]
    assert len(deployments) == 14
    assert set(deployment) <= DEPLOYMENT_KEYS
    assert set(deployment["work_pool"]) <= WORK_POOL_KEYS
    for schedule in deployment.get("schedules", []):
        assert set(schedule) <= SCHEDULE_KEYS
    path, _, function = deployment["entrypoint"].partition(":")
    flow = getattr(importlib.import_module(path.removesuffix(".py").replace("/", ".")), function)
    assert isinstance(flow, Flow)
    flow.validate_parameters({"config": None, "overrides": (), "artifacts": "artifacts", **deployment["parameters"]})
    assert deployment["parameters"]["preset"] in preset_names()
