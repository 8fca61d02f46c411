"""The page of a run that is not finished yet: what is done, what is running, what is coming and for how long.

It is written anew after every node and reloads itself; the finished report takes its place.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from worldline_core.pages.page import duration, number, render
from worldline_core.store.artifact_files import read_json
from worldline_core.store.atomic import write_bytes_atomic

RELOAD_SECONDS = 5
MOST_FACTS = 6
PICTURES = ("previews/*.png", "previews/*.jpg", "media/*.jpg")
SHARES: Mapping[str, float] = {
    "curate": 17, "curate.banks": 20, "filter": 16, "render_actions": 8, "encode_latents": 3, "train_stage1": 7,
    "train_stage2": 17, "distill": 27, "rollout": 5, "rollout.shipped_causal": 14, "rollout.shipped_stage2_4_steps": 10,
    "rollout.banks_shipped_stage2": 41, "rollout.banks_shipped_causal": 76, "evaluate_video": 83, "evaluate_policy": 13,
    "evaluate_planning": 33, "report": 19,
}  # fmt: skip
"""Seconds of each step's nodes in the demo on one of two busy cores, and of those that take longer than the others of
their step: only their ratios are used, until something was measured."""
_UNKNOWN_SHARE = 30.0


def share(node: str) -> float:
    """The share of a node, `step` or `step.variant`, in the demo's time."""
    return SHARES.get(node, SHARES.get(node.partition(".")[0], _UNKNOWN_SHARE))


@dataclass(frozen=True)
class DoneNode:
    """A finished node: its name in the plan, its artifact, and the seconds that it took in this run (0 when cached)."""

    name: str
    folder: Path
    seconds: float
    cached: bool = False


@dataclass(frozen=True)
class Estimate:
    """Seconds left, and what they are estimated from."""

    seconds: float
    basis: str


def recorded_seconds(artifacts: Path, step: str) -> float | None:
    """Wall seconds of the step's latest finished artifact in a store; None where there is none."""
    manifests = [read_json(path) for path in sorted((artifacts / step).glob("*/manifest.json"))]
    timed = [m for m in manifests if isinstance(m.get("wall_seconds"), (int, float)) and not m.get("resumed")]
    return float(max(timed, key=lambda m: str(m.get("finished_at")))["wall_seconds"]) if timed else None


def estimate_left(
    artifacts: Path,
    done: Sequence[DoneNode],
    running: Sequence[str],
    to_come: Sequence[str],
    seconds_of_running: float = 0.0,
    at_once: int = 1,
) -> Estimate:
    """Time left: what each step took the last time in this store, else its share of the demo at this machine's pace.

    Of a step with several nodes it is not known which one was recorded: as soon as this run has a pace, shares count.

    Args:
        artifacts: the root of the store.
        running, to_come: names of nodes, `step` or `step.variant`.
        seconds_of_running: how long the running nodes have been at it.
        at_once: nodes that run side by side.
    """
    names = (*running, *to_come)
    nodes_of = Counter(name.partition(".")[0] for name in names)
    worked = [node for node in done if not node.cached]
    expected = sum(share(node.name) for node in worked)
    pace = sum(node.seconds for node in worked) / expected if expected else 1.0
    recorded = {
        step: recorded_seconds(artifacts, step) if count == 1 or not worked else None
        for step, count in nodes_of.items()
    }
    seconds, without = 0.0, 0
    for name in names:
        known = recorded[name.partition(".")[0]]
        without += known is None
        seconds += known if known is not None else pace * share(name)
    if not without:
        basis = "from the time that the same steps took before in this store"
    elif worked:
        basis = f"rough: {without} of {len(names)} steps have no record of their own in this store; taken from the demo's shares at this machine's pace"
    else:
        basis = f"rough: {without} of {len(names)} steps never ran in this store; taken from the demo on two cores"
    return Estimate(max(0.0, seconds - seconds_of_running) / at_once, basis)


def write_progress_page(
    folder: Path,
    done: Sequence[DoneNode],
    running: Sequence[str],
    to_come: Sequence[str],
    seconds_so_far: float,
    estimate: Estimate | None = None,
    failed: str = "",
) -> Path:
    """Write `folder/index.html` (`artifacts/report/latest`), which reloads itself until the report replaces it.

    Args:
        failed: the error that ended the run, which the page then shows instead of reloading.
    """
    page = render(
        "report/progress.html", title="WorldLine: this run", done=[_shown(folder, node) for node in done],
        running=list(running), to_come=list(to_come), elapsed=seconds_so_far, estimate=estimate, failed=failed,
        reload=0 if failed else RELOAD_SECONDS,
    )  # fmt: skip
    write_bytes_atomic(folder / "index.html", page.encode())
    return folder / "index.html"


def write_finished_page(folder: Path, report: Path) -> Path:
    """Let `folder/index.html` lead to a finished report: a page that redirects, which works from any file system."""
    target = _address(folder, report / "index.html")
    page = render("report/redirect.html", title="WorldLine: the report", target=target, key=report.name)
    write_bytes_atomic(folder / "index.html", page.encode())
    return folder / "index.html"


def _shown(folder: Path, node: DoneNode) -> dict[str, Any]:
    pictures = [path for pattern in PICTURES for path in sorted(node.folder.glob(pattern))]
    metrics = read_json(node.folder / "manifest.json").get("metrics") or {}
    numbers = [
        f"{name.replace('_', ' ')} {number(value, 3)}"
        for name, value in metrics.items()
        if isinstance(value, (int, float)) and not isinstance(value, bool)
    ]
    return {
        "name": node.name,
        "time": "found in the store" if node.cached else duration(node.seconds),
        "folder": _address(folder, node.folder),
        "facts": " · ".join(numbers[:MOST_FACTS]),
        "picture": _address(folder, pictures[0]) if pictures else None,
    }


def _address(folder: Path, target: Path) -> str:
    """A relative address that a browser follows from a page in `folder`."""
    return quote(os.path.relpath(target.resolve(), folder.resolve()).replace(os.sep, "/"))
