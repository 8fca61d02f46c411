"""Page "Cost": time per frame, and whether every block of a long rollout costs the same."""

from __future__ import annotations

from statistics import median

from markupsafe import Markup

from worldline_core.pages.charts import Series, line_chart
from worldline_core.pages.page import Table, number, render
from worldline_core.report.context import ReportContext, Section
from worldline_core.report.methods import method
from worldline_core.store.artifact_files import JsonObject, read_json

TITLE = "Cost"
EDGE_BLOCKS = 5


def timings(context: ReportContext) -> dict[str, JsonObject]:
    """What each rollout step recorded about time, by method."""
    read = {n: read_json(path / "run" / "speed.json") for n, path in context.inputs.variants("rollout").items()}
    return {name: content for name, content in read.items() if content.get("seconds_per_frame") is not None}


def cost_section(context: ReportContext) -> Section:
    """Times differ between runs, so they are filled in from run/run.js when the page opens."""
    found = timings(context)
    if not found:
        return Section("cost", TITLE, missing="no rollout recorded its times (run/speed.json).")
    lead = (
        "Wall time of predicting, decoding included, writing to disk not. Times differ from run to run, so they are kept"
        " outside the reproducible page."
    )
    devices = sorted({str(content["device_name"]) for content in found.values() if content.get("device_name")})
    body = render("report/cost.html", devices=devices, table=cost_table(found), **block_chart(found))
    return Section("cost", TITLE, lead, context.slot("cost", body))


def blocks_of(content: JsonObject) -> list[float]:
    """Seconds of each block: of the long rollout made to measure it, else of the predictions themselves.

    Processor seconds where they were recorded: other programs do not stretch them. Empty for a model that predicts the
    whole clip at once.
    """
    long = content.get("long_rollout") or {}
    values = long.get("block_processor_seconds") or long.get("block_seconds") or content.get("block_seconds") or []
    return [float(value) for value in values]


def block_ratio(blocks: list[float]) -> float | None:
    """Cost of the last blocks over that of the first (medians of five each); None for fewer than ten blocks."""
    if len(blocks) < 2 * EDGE_BLOCKS:
        return None
    return median(blocks[-EDGE_BLOCKS:]) / median(blocks[:EDGE_BLOCKS])


def block_chart(found: dict[str, JsonObject]) -> dict[str, object]:
    """Time of every block of the longest block-causal rollouts, and what it shows in words."""
    by_method = {name: blocks for name, content in found.items() if len(blocks := blocks_of(content)) > 1}
    longest = max((len(blocks) for blocks in by_method.values()), default=0)
    shown = {name: blocks for name, blocks in by_method.items() if len(blocks) == longest}
    by_processor = any("block_processor_seconds" in (found[name].get("long_rollout") or {}) for name in shown)
    series = [
        Series(
            label(name), [float(i + 1) for i in range(longest)], [1000 * seconds for seconds in blocks],
            colour=method(name).colour, dashed=method(name).group == "run", markers=longest <= 8,
        )
        for name, blocks in sorted(shown.items(), key=lambda item: method(item[0]).rank)
    ]  # fmt: skip
    chart = line_chart(
        series, title=f"Time of each block, from the first to number {longest}", x_label="block (16 frames of every view)",
        y_label="processor ms" if by_processor else "ms per trajectory",
        y_range=(0.0, 1.15 * max((v for s in series for v in s.y), default=1.0)),
    )  # fmt: skip
    words = [block_words(label(name), blocks) for name, blocks in shown.items()]
    return {"chart": chart if shown else None, "words": words, "by_processor": by_processor}


def block_words(name: str, blocks: list[float]) -> Markup:
    """First, median and last block of one rollout, and the ratio of its ends."""
    ratio = block_ratio(blocks)
    first, middle, last = (f"{1000 * seconds:.0f}\u202fms" for seconds in (blocks[0], median(blocks), blocks[-1]))
    times = f"block 1 {first}, median {middle}, block {len(blocks)} {last}."
    if ratio is None:
        return Markup("<strong>{}</strong>: {}").format(name, times)
    ends = f"from the first to the last blocks (medians of {EDGE_BLOCKS} each);"
    return Markup("<strong>{}: {:.2f}\u202f\u00d7</strong> {} {}").format(name, ratio, ends, times)


def label(name: str) -> str:
    """A method's label; rollouts of candidate banks say so."""
    shown = method(name.removeprefix("banks_")).long_label
    return f"{shown}, candidate banks" if name.startswith("banks_") else shown


def cost_table(found: dict[str, JsonObject]) -> Table:
    """Time per frame, and the ratio of last to first block, by method."""
    rows = []
    order = sorted(found.items(), key=lambda item: (item[0].startswith("banks_"), method(item[0]).rank))
    for name, content in order:
        blocks = blocks_of(content)
        ratio = block_ratio(blocks)
        rows.append(
            [
                label(name),
                *[content.get(key) for key in ("steps", "dtype", "batch_size", "frames")],
                number(1000 * float(content["seconds_per_frame"]), 1),
                len(blocks) or None,
                number(1000 * median(blocks), 0) if blocks else None,
                None if ratio is None else number(ratio, 2),
            ]
        )
    headings = ["Method", "Steps", "Precision", "Batch", "Frames", "ms per frame", "Blocks", "ms per block"]
    caption = "A frame here is one instant in all views. Steps: of a whole clip, or of a block for causal models."
    return Table([*headings, "Last to first block"], rows, range(1, 9), caption)


def constant_cost(context: ReportContext) -> Markup:
    """One line about the constant cost of blocks, for the overview."""
    found = {name: blocks_of(content) for name, content in timings(context).items()}
    longest = max((len(blocks) for blocks in found.values()), default=0)
    ratios = [ratio for blocks in found.values() if len(blocks) == longest and (ratio := block_ratio(blocks))]
    if not ratios:
        return Markup("")
    text = f"Cost of the last of {longest} causal blocks over the first: ratio {max(ratios):.2f}."
    return Markup('<p class="muted">{}</p>').format(text)
