"""What Prefect's pages show of a finished run: a link to its report and a table of what was measured."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from prefect.artifacts import create_link_artifact, create_table_artifact

from tasks.artifact_task import ArtifactReference
from worldline_core.report.nightly import collect_metrics


def show_in_prefect(page: Path, done: Mapping[str, ArtifactReference]) -> None:
    """Add the artifacts `report` and `metrics` to the flow run that calls this.

    Args:
        page: folder of the report or comparison, with `index.html`.
        done: the artifacts of the run by the nodes' names; its evaluations fill the table.
    """
    create_link_artifact((page / "index.html").as_uri(), "Open the report", key="report", description=str(page))
    scores = {name: Path(str(artifact.path)) for name, artifact in done.items() if name.startswith("evaluate_")}
    rows = [
        {"metric": name, "mean": value.mean, "95 % from": value.low, "to": value.high, "trajectories": value.count}
        for name, value in sorted(collect_metrics(scores).items())
    ]
    if rows:
        create_table_artifact(rows, key="metrics", description="Means with 95 % intervals: what/where/method/metric")
