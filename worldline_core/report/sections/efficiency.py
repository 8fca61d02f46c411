"""Section "Cost": time a frame, and whether every block of a long rollout costs the same."""

from __future__ import annotations

from statistics import median

from worldline_core.report.charts import Series, line_chart
from worldline_core.report.context import ReportContext, Section
from worldline_core.report.markup import Column, Html, element, join, number, paragraph, table
from worldline_core.report.methods import method
from worldline_core.store.artifact_files import JsonObject, read_json

TITLE = "Cost"
SPEED_FILE = "speed.json"
EDGE_BLOCKS = 5


def timings(context: ReportContext) -> dict[str, JsonObject]:
    """What each rollout step recorded about time, by method."""
    found: dict[str, JsonObject] = {}
    for name, folder in context.inputs.variants("rollout").items():
        content = read_json(folder / "run" / SPEED_FILE)
        if content.get("seconds_per_frame") is not None:
            found[name] = content
    return found


def efficiency_section(context: ReportContext) -> Section:
    """Times differ between runs, so they are filled in from run/run.js when the page opens."""
    found = timings(context)
    if not found:
        return Section("cost", TITLE, missing="no rollout recorded its times (run/speed.json).")
    lead = (
        "Wall time of predicting, decoding included, writing to disk not. Times differ from run to run, so they are kept"
        " outside the reproducible page."
    )
    body = join(machine_note(found), cost_table(found), block_chart(found))
    return Section("cost", TITLE, lead, context.slot("cost", body))


def machine_note(found: dict[str, JsonObject]) -> Html:
    """What the times were measured on."""
    devices = sorted({str(content["device_name"]) for content in found.values() if content.get("device_name")})
    return paragraph("Measured on: ", "; ".join(devices), ".", class_="muted") if devices else Html("")


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


def block_chart(found: dict[str, JsonObject]) -> Html:
    """Seconds of every block of the longest block-causal rollouts, and what they show in words."""
    by_method = {name: blocks for name, content in found.items() if len(blocks := blocks_of(content)) > 1}
    longest = max((len(blocks) for blocks in by_method.values()), default=0)
    shown = {name: blocks for name, blocks in by_method.items() if len(blocks) == longest}
    if not shown:
        return Html("")
    by_processor = any("block_processor_seconds" in (found[name].get("long_rollout") or {}) for name in shown)
    series = [
        Series(
            label(name),
            [float(i + 1) for i in range(len(blocks))],
            [1000 * seconds for seconds in blocks],
            colour=method(name).colour,
            dashed=method(name).group == "run",
            markers=longest <= 8,
        )
        for name, blocks in sorted(shown.items(), key=lambda item: method(item[0]).rank)
    ]
    top = 1.15 * max(v for s in series for v in s.y)
    chart = line_chart(
        series,
        title=f"Time of each block, from the first to number {longest}",
        x_label="block (16 frames of every view)",
        y_label="processor ms" if by_processor else "ms a trajectory",
        y_range=(0.0, top),
    )
    notes = [paragraph(block_words(label(name), blocks)) for name, blocks in shown.items()]
    aside = element(
        "div",
        notes,
        paragraph(
            "Sampling alone, with the write to the cache; decoding costs every block the same."
            + (" Seconds of all threads, which other programs do not stretch." if by_processor else "")
            + " The first blocks see a window that is still filling.",
            class_="muted",
        ),
        class_="aside",
    )
    return element("div", chart, aside, class_="grid2")


def block_words(name: str, blocks: list[float]) -> Html:
    """First, median and last block of one rollout, and the ratio of its ends."""
    ratio = block_ratio(blocks)
    first, middle, last = (f"{1000 * seconds:.0f}\u202fms" for seconds in (blocks[0], median(blocks), blocks[-1]))
    times = f"block 1 {first}, median {middle}, block {len(blocks)} {last}."
    if ratio is None:
        return join(element("strong", name), ": ", times)
    ends = f" from the first to the last blocks (medians of {EDGE_BLOCKS} each); "
    return join(element("strong", f"{name}: {ratio:.2f}\u202f\u00d7"), ends, times)


def label(name: str) -> str:
    """A method's label; rollouts of candidate banks say so."""
    shown = method(name.removeprefix("banks_")).long_label
    return f"{shown}, candidate banks" if name.startswith("banks_") else shown


def cost_table(found: dict[str, JsonObject]) -> Html:
    """Time a frame, and the ratio of last to first block, by method."""
    rows = []
    order = sorted(found.items(), key=lambda item: (item[0].startswith("banks_"), method(item[0]).rank))
    for name, content in order:
        blocks = blocks_of(content)
        ratio = block_ratio(blocks)
        rows.append(
            [
                label(name),
                content.get("steps"),
                content.get("dtype"),
                content.get("batch_size"),
                content.get("frames"),
                number(1000 * float(content["seconds_per_frame"]), 1),
                len(blocks) or None,
                number(1000 * median(blocks), 0) if blocks else None,
                None if ratio is None else number(ratio, 2),
            ]
        )
    headings = ("Steps", "Precision", "Batch", "Frames", "ms a frame", "Blocks", "ms a block", "Last to first block")
    return table(
        [Column("Method"), *[Column(heading, numeric=True) for heading in headings]],
        rows,
        caption="A frame here is one instant in all views. Steps: of a whole clip, or of a block for causal models.",
    )


def efficiency_tile(context: ReportContext) -> Html:
    """One line about the constant cost of blocks, for the summary."""
    found = {name: blocks_of(content) for name, content in timings(context).items()}
    longest = max((len(blocks) for blocks in found.values()), default=0)
    ratios = [ratio for blocks in found.values() if len(blocks) == longest and (ratio := block_ratio(blocks))]
    if not ratios:
        return Html("")
    return element(
        "p",
        f"Cost of the last of {longest} causal blocks over the first: ratio {max(ratios):.2f}.",
        class_="muted",
    )
