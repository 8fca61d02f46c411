"""Prefect artifacts of a finished run: a link to its report, a table of its metrics, and pictures."""

from __future__ import annotations

import base64
import functools
import logging
import mimetypes
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import httpx
from prefect import Flow
from prefect.artifacts import create_image_artifact, create_link_artifact, create_table_artifact

from tasks.execution.chain import outline
from tasks.execution.prefect_run import ArtifactReference, PrefectRun
from tasks.execution.shard_mapper import shorten_errors
from tasks.execution.temporary_server import private_server
from worldline_core.config import StrictModel
from worldline_core.errors import UnavailableError
from worldline_core.evaluation.paired import collect_metrics
from worldline_core.scale.mapping import RunnerConfig
from worldline_core.store.store import clear_full_disk

logger = logging.getLogger(__name__)

STORE = Path("artifacts")
"""Default root of the artifact store."""


def run_flow[R](flow: Flow[..., R], *arguments: Any) -> R:
    """Run a flow; its result counts although Prefect's server ended before it could record it.

    Raises: UnavailableError: the server ended before the flow did.
    """
    done: list[R] = []

    @functools.wraps(flow.fn)
    def body(*values: Any, **named: Any) -> R:
        with clear_full_disk():
            done.append(flow.fn(*values, **named))
        return done[0]

    shorten_errors()
    observed = flow.with_options()
    observed.fn = body
    try:
        with private_server():
            return observed(*arguments)
    except httpx.TransportError as error:
        if not done:
            raise UnavailableError(
                "Prefect's server ended before the run", got=error, next_step="the same command continues"
            ) from error
        logger.warning("the run is finished; Prefect's server ended before it could record it: %s", error)
        return done[0]


def _report_pictures(report: Path) -> dict[str, Path]:
    """Pictures of a report to show: what was recorded, and what was predicted of the first episode."""
    names = {"recorded episodes": "contact_sheet", "recorded beside predicted": "episode0_shipped_head"}
    files = {what: report / "media" / f"{name}.jpg" for what, name in names.items()}
    return {what: file for what, file in files.items() if file.is_file()}


def show_in_prefect(
    page: Path,
    done: Mapping[str, ArtifactReference],
    verdicts: Mapping[str, str] | None = None,
) -> None:
    """Add the artifacts `report`, `metrics` and `pictures` (a link, a table, images) to the flow run that calls this.

    Args:
        page: folder of the report or comparison.
        verdicts: of metrics beside an earlier run, in the order of the table's rows.
    """
    pictures = _report_pictures(done["report"].folder) if "report" in done else {}
    scores = {name: Path(str(artifact.path)) for name, artifact in done.items() if name.startswith("evaluate_")}
    found, verdicts = collect_metrics(scores), verdicts or {}
    rows: list[dict[str, Any]] = []
    for name in dict.fromkeys([*verdicts, *sorted(found)]):
        value, verdict = found.get(name), {"verdict": verdicts.get(name, "")} if verdicts else {}
        means = (
            {}
            if value is None
            else {"mean": value.mean, "95 % from": value.low, "to": value.high, "trajectories": value.count}
        )
        rows.append({"metric": name, **verdict, **means})
    worse = sum(verdict.startswith(("worse", "missing")) for verdict in verdicts.values())
    summary = f"{worse} of {len(verdicts)} metrics became worse or are missing. " if verdicts else ""
    try:
        create_link_artifact((page / "index.html").as_uri(), "Open the report", key="report", description=str(page))
        if rows:
            description = f"{summary}Means with 95 % intervals: what/where/method/metric"
            create_table_artifact(rows, key="metrics", description=description)
        # They travel inside of the artifacts: a page that a browser has over http may not show files.
        for number, (what, picture) in enumerate(pictures.items()):
            key = "picture" if number == 0 else f"picture-{number}"
            data = f"data:{mimetypes.guess_type(picture)[0]};base64,{base64.b64encode(picture.read_bytes()).decode()}"
            create_image_artifact(data, key=key, description=f"{what} ({page / 'index.html'})")
    except httpx.TransportError as error:
        logger.warning("Prefect shows nothing of this run: its server does not answer (%s)", error)


def run_chain[C: StrictModel](
    chain: Callable[[C], object], config: C, runner: RunnerConfig, artifacts: Path
) -> dict[str, ArtifactReference]:
    """Run a whole chain in a flow, with a page that shows how far it is and links in Prefect; returns the artifacts."""
    with PrefectRun(artifacts, runner, page_of=outline(chain, config)) as run:
        chain(config)
    show_in_prefect(run.page_folder, run.artifacts)
    return run.artifacts
