"""Section "Cost": seconds a frame, and whether every block of a long rollout costs the same."""

from __future__ import annotations

from statistics import median

from worldline_core.report.artifacts import JsonObject, read_json
from worldline_core.report.charts import Series, line_chart
from worldline_core.report.context import ReportContext, Section
from worldline_core.report.markup import Column, Html, element, join, number, table
from worldline_core.report.methods import method

TITLE = "Cost"
SPEED_FILE = "speed.json"
EDGE_BLOCKS = 5


def timings(context: ReportContext) -> dict[str, JsonObject]:
    """What each rollout step recorded about time, by method."""
    found: dict[str, JsonObject] = {}
    for name, folder in context.inputs.variants("rollout").items():
        content = read_json(folder / "run" / SPEED_FILE)
        if content.get("seconds_per_frame") is not None:
            found[name] = content | {
                "steps": context.inputs.manifest(f"rollout.{name}" if name else "rollout")
                .get("metrics", {})
                .get("steps")
            }
    return found


def efficiency_section(context: ReportContext) -> Section:
    """Times differ between runs, so they are filled in from run/run.js when the page opens."""
    found = timings(context)
    if not found:
        return Section("cost", TITLE, missing="no rollout recorded its times (run/speed.json).")
    lead = "Wall time on this machine, decoding included, writing to disk not. Times differ from run to run, so they are kept outside the reproducible page."
    return Section("cost", TITLE, lead, context.slot("cost", join(cost_table(found), block_chart(found))))


def blocks_of(content: JsonObject) -> list[float]:
    """Seconds of each block of a rollout; empty for a model that predicts the whole clip at once."""
    values = content.get("block_seconds") or []
    return [float(v) for v in values if isinstance(v, (int, float))]


def block_ratio(blocks: list[float]) -> float | None:
    """Cost of the last blocks over that of the first (medians of five); None for fewer than two blocks."""
    if len(blocks) < 2:
        return None
    edge = min(EDGE_BLOCKS, len(blocks) // 2)
    return median(blocks[-edge:]) / median(blocks[:edge])


def block_chart(found: dict[str, JsonObject]) -> Html:
    """Seconds of every block of the block-causal rollouts."""
    series = [
        Series(
            method(name).long_label,
            [float(i + 1) for i in range(len(blocks))],
            blocks,
            colour=method(name).colour,
            dashed=method(name).group == "run",
        )
        for name, content in found.items()
        if len(blocks := blocks_of(content)) > 1
    ]
    if not series:
        return Html("")
    top = 1.15 * max(v for s in series for v in s.y)
    return line_chart(
        series, title="Cost of each block of a long rollout", x_label="block", y_label="seconds", y_range=(0.0, top)
    )


def cost_table(found: dict[str, JsonObject]) -> Html:
    """Seconds a frame and the ratio of last to first block, by method."""
    rows = []
    for name, content in sorted(found.items(), key=lambda item: method(item[0]).rank):
        ratio = block_ratio(blocks_of(content))
        per_frame = content.get("seconds_per_frame")
        shown = number(float(per_frame), 3) if isinstance(per_frame, (int, float)) else None
        steps = content.get("steps")
        blocks = len(blocks_of(content)) or None
        rows.append(
            [
                name.replace("_", " "),
                steps,
                content.get("frames"),
                shown,
                blocks,
                None if ratio is None else number(ratio, 2),
            ]
        )
    headings = ("Steps", "Frames", "Seconds a frame", "Blocks", "Last to first block")
    return table(
        [Column("Method"), *[Column(heading, numeric=True) for heading in headings]],
        rows,
        caption="A frame here is one instant in all views",
    )


def efficiency_tile(context: ReportContext) -> Html:
    """One line about the constant cost of blocks, for the summary."""
    ratios = [r for content in timings(context).values() if (r := block_ratio(blocks_of(content))) is not None]
    if not ratios:
        return Html("")
    return element(
        "p",
        f"Cost of a causal block from the first to the last: ratio {max(ratios):.2f} (worst method).",
        class_="muted",
    )
