"""Shared by all pages of the report: configuration, inputs, names of methods, video scores, and the writing of pages."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from markupsafe import Markup
from pydantic import Field

from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.evaluation.metric_registry import METRICS, Metric
from worldline_core.evaluation.paired import Series, collect_metrics, read_scores
from worldline_core.evaluation.scores import SUMMARY_FILE, TRUE_METHOD, Interval
from worldline_core.pages.page import render, render_macro
from worldline_core.pictures import Picture, jpeg_bytes
from worldline_core.rollout.rollout_set import RolloutSet
from worldline_core.store.artifact_files import JsonObject, read_json, read_rows
from worldline_core.store.atomic import write_bytes_atomic

KINDS = {
    TRUE_METHOD: ("recorded videos (ceiling)", "c2"),
    "stage2": ("Stage II", "c0"),
    "causal": ("causal", "c1"),
    "stage2_zero": ("Stage II, no actions", "c4"),
    "stage2_shuffled": ("Stage II, shuffled actions", "c3"),
    "causal_zero": ("causal, no actions", "c4"),
    "causal_shuffled": ("causal, shuffled actions", "c3"),
    "stage1": ("Stage I, text, no actions", "c7"),
    "backbone": ("backbone, text, no actions", "c6"),
    "copy": ("copy first frame", "c5"),
    "other": ("", "c6"),
}
"""Label and colour of each kind of method, in the report's order."""
GROUPS = {TRUE_METHOD: "", "shipped": "long-trained", "run": "this run", "baseline": ""}
"""Origin of a method's weights, in the report's order."""
SPLIT_LABELS = {
    "test": "held-out recordings",
    "ood_test": "held-out embodiment",
    "validation": "validation",
    "train": "training recordings",
    "bank": "candidate banks",
}
"""Labels of the splits, in the report's order."""
TOOL_ERROR = "end_effector_error_px"
HEADLINES = ("robot_iou_exact", "robot_iou", TOOL_ERROR)
"""Metrics that head the report, the most trustworthy first: IoU with exact masks, with the segmenter's own masks of the truth; for
robots that no segmenter knows, the distance of the predicted tools from the true ones."""


class ReportConfig(StrictModel):
    """``tile_height``: of one video in a side-by-side video, pixels."""

    tile_height: int = Field(default=256, ge=32, le=1080)


class Method(NamedTuple):
    """A method as the report shows it: model and controls (`kind`), and the origin of its weights (`group`)."""

    name: str
    kind: str
    group: str
    label: str

    @property
    def long_label(self) -> str:
        """Label with the group, for tables that mix weights of several origins."""
        return f"{self.label} ({GROUPS[self.group]})" if GROUPS[self.group] else self.label

    @property
    def colour(self) -> str:
        return KINDS[self.kind][1]


def method(name: str) -> Method:
    """The method of a name: `shipped_stage2_shuffled`, `causal`, `stage2.zero`, `copy_first_frame`, `true`, ..."""
    words = set(re.split(r"[._-]+", name))
    kind, group = "other", "shipped" if "shipped" in words else "run"
    if name == TRUE_METHOD:
        kind, group = TRUE_METHOD, TRUE_METHOD
    elif "copy" in words:
        kind, group = "copy", "baseline"
    elif "steps" in words:  # another number of steps is another method
        if steps := re.fullmatch(r"(?:shipped_)?(stage2|causal)_(\d+)_steps", name):
            return Method(name, kind, group, f"{KINDS[steps[1]][0]}, {steps[2]} steps")
    elif found := words & {"stage1", "backbone"}:
        kind, group = found.pop(), "baseline"
    elif base := next((word for word in ("causal", "stage2") if word in words), None):
        kind = base + ("_zero" if words & {"zero", "no"} else "_shuffled" if "shuffled" in words else "")
    return Method(name, kind, group, KINDS[kind][0] or name.replace("_", " "))


def in_order(names: Iterable[str]) -> list[Method]:
    """Recorded videos, long-trained weights, this run's, then baselines without actions."""
    kinds, groups = [*KINDS], [*GROUPS]
    return sorted(map(method, names), key=lambda m: (groups.index(m.group), kinds.index(m.kind), m.name))


def predicting(names: Iterable[str]) -> list[Method]:
    """All methods but the recorded videos, in the report's order."""
    return [m for m in in_order(names) if m.name != TRUE_METHOD]


def share_interval(measured: JsonObject) -> JsonObject:
    """A mean share with its interval; where all cases agree, a bootstrap sees no spread: the exact bound of n equal cases."""
    if measured["low"] < measured["high"] or measured["mean"] not in (0, 1):
        return measured
    unseen = 1 - 0.025 ** (1 / measured["count"])
    return {**measured, "low": max(0.0, measured["low"] - unseen), "high": min(1.0, measured["high"] + unseen)}


def headline_metrics(step: str, folder: Path) -> Iterator[tuple[str, str, str, str, Interval]]:
    """(what, group, method, metric, value) of a finished evaluation: of whole splits, and of the most candidates."""
    metrics = collect_metrics({step: folder})
    most = max((int(name.split("/")[1][2:]) for name in metrics if name.startswith("planning/")), default=0)
    for name, value in metrics.items():
        what, group, method, metric = name.split("/", 3)
        if group in (*SPLIT_LABELS, "all", f"N={most}"):
            yield what, group, method, metric, value


@dataclass(frozen=True)
class VideoScores:
    """Scores of an `evaluate_video` artifact; empty without one."""

    folder: Path | None

    @cached_property
    def summary(self) -> JsonObject:
        return {} if self.folder is None else read_json(self.folder / SUMMARY_FILE)

    @cached_property
    def metrics(self) -> JsonObject:
        """Means with intervals by group, method and metric (``psnr``, ``psnr@head``, ``robot_iou[colour]@head``)."""
        return self.summary.get("metrics", {})

    @cached_property
    def series(self) -> Series:
        return {} if self.folder is None else read_scores(self.folder)

    @cached_property
    def by_frame(self) -> Sequence[JsonObject]:
        return [] if self.folder is None else read_rows(self.folder / "by_frame.parquet")

    @property
    def groups(self) -> list[str]:
        """Splits that have scores, the held-out ones first."""
        return [group for group in SPLIT_LABELS if group in self.metrics]

    def methods(self, group: str) -> list[Method]:
        return in_order(self.metrics.get(group, ()))

    def value(self, group: str, method: str, metric: str) -> JsonObject | None:
        """`{"mean", "low", "high", "count"}` of a metric, or None."""
        return self.metrics.get(group, {}).get(method, {}).get(metric)

    def difference(self, group: str, first: str, second: str, metric: str) -> JsonObject | None:
        """Paired difference `first - second` over the trajectories that both have, or None."""
        for row in self.summary.get("differences", {}).get(group, ()):
            if row["metric"] == metric and (row["first"], row["second"]) == (first, second):
                return row
            if row["metric"] == metric and (row["first"], row["second"]) == (second, first):
                return {**row, "mean": -row["mean"], "low": -row["high"], "high": -row["low"]}
        return None

    def headlines(self, group: str, method: str) -> list[Metric]:
        """Those of HEADLINES that were measured of a method in the head view."""
        return [METRICS[name] for name in HEADLINES if self.value(group, method, f"{name}@head")]

    def headline(self, group: str, method: str) -> Metric | None:
        return next(iter(self.headlines(group, method)), None)

    def primary(self, group: str) -> Method | None:
        """The method that heads the page: the first Stage II, long-trained weights before this run's."""
        methods = self.methods(group)
        return next((m for m in methods if m.kind == "stage2"), methods[0] if methods else None)


@dataclass(frozen=True)
class Section:
    """One page: the stem of its file, title, introduction and content; or the reason why it is missing."""

    anchor: str
    title: str
    lead: str = ""
    body: Markup | None = None
    missing: str | None = None

    @property
    def file(self) -> str:
        return f"{self.anchor}.html"


@dataclass
class ReportContext:
    """Configuration, inputs, and the folder of pages and media.

    Attributes:
        inputs: artifact folders by name: a step (`curate`), or a step and a variant (`rollout.stage2`).
        run_parts: times, devices and versions, which are not reproducible: written to `run/run.js`, outside of the digested pages,
            and put into their slots when a page is opened.
        first_card: the first episode with videos, for the first page.
    """

    config: ReportConfig
    inputs: Mapping[str, Path]
    output: Path
    run_parts: dict[str, Markup] = field(default_factory=dict)
    first_card: dict[str, Any] | None = None

    @cached_property
    def video_scores(self) -> VideoScores:
        return VideoScores(self.inputs.get("evaluate_video"))

    def summary(self, step: str) -> JsonObject | None:
        """The summary of an evaluation that has a method in it."""
        found = read_json(self.inputs[step] / SUMMARY_FILE) if step in self.inputs else {}
        return found if found.get("methods") else None

    @cached_property
    def rollouts(self) -> dict[str, RolloutSet]:
        folders = {name.partition("."): path for name, path in sorted(self.inputs.items())}
        return {method: RolloutSet.open(path) for (step, _, method), path in folders.items() if step == "rollout"}

    @cached_property
    def episodes(self) -> EpisodeSet | None:
        """The filtered episodes, or the curated ones when there are no filtered ones."""
        folder = self.inputs.get("filter") or self.inputs.get("curate")
        return None if folder is None else EpisodeSet.open(folder)

    @property
    def media(self) -> Path:
        return self.output / "media"

    def picture(self, name: str, picture: Picture, *, alt: str) -> Markup:
        """Write a picture as JPEG and return the element that shows it."""
        path = self.media / f"{name}.jpg"
        write_bytes_atomic(path, jpeg_bytes(picture))
        height, width = picture.shape[:2]
        return render_macro(
            "pages/parts.html", "picture", file=f"media/{path.name}", alt=alt, width=width, height=height
        )

    def slot(self, name: str, content: Markup | str, fallback: str = "") -> Markup:
        """A place in a page that is filled from `run/run.js` when it is opened."""
        self.run_parts[name] = Markup.escape(content)
        return render_macro("pages/parts.html", "slot", name=name, fallback=fallback)

    def section(self, anchor: str, title: str, lead: str = "", /, **values: object) -> Section:
        """A page made from the template of its name."""
        return Section(anchor, title, lead, render(f"report/{anchor}.html", **values))

    def write_pages(self, home: Markup, sections: Sequence[Section]) -> None:
        """Write `index.html`, one page per section, and `run/run.js`."""
        for section, following in zip(sections, [*sections[1:], None], strict=True):
            page = render("report/page.html", title=section.title, section=section, sections=sections, next=following)
            write_bytes_atomic(self.output / section.file, page.encode())
        # `</` would end a script element if this text were ever put into one.
        parts = json.dumps({name: str(part) for name, part in sorted(self.run_parts.items())}, indent=1)
        script = "window.WORLDLINE_RUN = " + parts.replace("</", "<\\/") + ";\n"
        write_bytes_atomic(self.output / "run" / "run.js", script.encode())
        write_bytes_atomic(self.output / "index.html", home.encode())
