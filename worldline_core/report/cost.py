"""Page "Cost": time per frame, and whether every block of a long rollout costs the same."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import median

from worldline_core.pages.charts import Series, line_chart
from worldline_core.pages.page import Table, number, render
from worldline_core.report.context import ReportContext, Section
from worldline_core.report.video_scores import Method, method
from worldline_core.store.artifact_files import JsonObject, read_json

TITLE = "Cost"
EDGE_BLOCKS = 5


@dataclass(frozen=True)
class Timing:
    """What one rollout step recorded about time (run/speed.json)."""

    name: str
    content: JsonObject

    @property
    def banks(self) -> bool:
        """Whether the rollout is of candidate banks."""
        return self.name.startswith("banks_")

    @property
    def method(self) -> Method:
        return method(self.name.removeprefix("banks_"))

    @property
    def label(self) -> str:
        return f"{self.method.long_label}{', candidate banks' if self.banks else ''}"

    @property
    def by_processor(self) -> bool:
        """Whether processor seconds of blocks were recorded: other programs do not stretch them."""
        return "block_processor_seconds" in (self.content.get("long_rollout") or {})

    @property
    def blocks(self) -> list[float]:
        """Seconds of each block: of the long rollout made to measure it, else of the predictions themselves.

        Processor seconds where they were recorded. Empty for a model that predicts the whole clip at once.
        """
        long = self.content.get("long_rollout") or {}
        values = long.get("block_processor_seconds") or long.get("block_seconds") or self.content.get("block_seconds")
        return [float(value) for value in values or []]

    @property
    def ratio(self) -> float | None:
        """Cost of the last blocks over that of the first (medians of five each); None for fewer than ten blocks."""
        blocks = self.blocks
        if len(blocks) < 2 * EDGE_BLOCKS:
            return None
        return median(blocks[-EDGE_BLOCKS:]) / median(blocks[:EDGE_BLOCKS])


def timings(context: ReportContext) -> list[Timing]:
    """What the rollout steps recorded about time, those of candidate banks last."""
    read = [Timing(n, read_json(path / "run" / "speed.json")) for n, path in context.variants("rollout").items()]
    known = [timing for timing in read if timing.content.get("seconds_per_frame") is not None]
    return sorted(known, key=lambda timing: (timing.banks, timing.method.rank))


def longest(found: list[Timing]) -> list[Timing]:
    """The block-causal rollouts of the most blocks."""
    most = max((len(timing.blocks) for timing in found), default=0)
    return [timing for timing in found if len(timing.blocks) == most > 1]


def cost_section(context: ReportContext) -> Section:
    """Times differ between runs, so they are filled in from run/run.js when the page opens."""
    found = timings(context)
    if not found:
        return Section("cost", TITLE, missing="no rollout recorded its times (run/speed.json).")
    lead = (
        "Wall time of predicting, decoding included, writing to disk not. Times differ from run to run, so they are kept"
        " outside the reproducible page."
    )
    shown = longest(found)
    body = render(
        "report/cost.html",
        devices=sorted({str(t.content["device_name"]) for t in found if t.content.get("device_name")}),
        table=cost_table(found),
        chart=block_chart(shown) if shown else None,
        shown=shown,
        median=median,
        edge=EDGE_BLOCKS,
    )
    fallback = "Recorded when the report was made; see run/run.js."
    return Section("cost", TITLE, lead, context.slot("cost", body, fallback))


def block_chart(shown: list[Timing]) -> object:
    """Time of every block of some rollouts of equally many blocks."""
    count = len(shown[0].blocks)
    series = [
        Series(
            timing.label, [float(i + 1) for i in range(count)], [1000 * seconds for seconds in timing.blocks],
            colour=timing.method.colour, dashed=timing.method.group == "run", markers=count <= 8,
        )
        for timing in shown
    ]  # fmt: skip
    return line_chart(
        series, title=f"Time of each block, from the first to number {count}", x_label="block (16 frames of every view)",
        y_label="processor ms" if any(timing.by_processor for timing in shown) else "ms per trajectory",
        y_range=(0.0, 1.15 * max(v for s in series for v in s.y)),
    )  # fmt: skip


def cost_table(found: list[Timing]) -> Table:
    """Time per frame, and the ratio of last to first block, by method."""
    rows = [
        [
            timing.label,
            *[timing.content.get(key) for key in ("steps", "dtype", "batch_size", "frames")],
            number(1000 * float(timing.content["seconds_per_frame"]), 1),
            len(timing.blocks) or None,
            number(1000 * median(timing.blocks), 0) if timing.blocks else None,
            None if timing.ratio is None else number(timing.ratio, 2),
        ]
        for timing in found
    ]
    headings = ["Method", "Steps", "Precision", "Batch", "Frames", "ms per frame", "Blocks", "ms per block"]
    caption = "A frame here is one instant in all views. Steps: of a whole clip, or of a block for causal models."
    return Table([*headings, "Last to first block"], rows, range(1, 9), caption)


def constant_cost(context: ReportContext) -> str:
    """One line about the constant cost of blocks, for the overview."""
    shown = longest(timings(context))
    ratios = [timing.ratio for timing in shown if timing.ratio is not None]
    if not ratios:
        return ""
    return f"Cost of the last of {len(shown[0].blocks)} causal blocks over the first: ratio {max(ratios):.2f}."
