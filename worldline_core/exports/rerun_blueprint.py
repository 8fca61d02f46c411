"""How a recording opens in Rerun: the views in a row, the scene under (or beside) them, time series below."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import rerun.blueprint as rrb

    from worldline_core.exports.rerun_recording import RecordingContent

EYE_DISTANCE_M = 1.0


def eye(content: RecordingContent) -> tuple[list[float], list[float]]:
    """Where the viewer's eye stands and what it looks at [m, base]: the tools, from beside the head camera."""
    target = np.zeros(3)
    if content.tracks is not None:
        target = np.asarray(content.tracks.T_base_tool[..., :3, 3], dtype=np.float64).reshape(-1, 3).mean(axis=0)
    head = content.episode.cameras.get("head")
    away = np.array([1.0, 1.0, 0.8]) if head is None else head.T_base_camera[0, :3, 3] - target
    turn = np.radians(50.0)  # off the head camera's own line of sight, whose frustum would stand in the way
    level = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ away[:2]
    direction = np.array([*level, 0.7 * max(float(np.linalg.norm(level)), 0.5)])
    position = target + EYE_DISTANCE_M * direction / np.linalg.norm(direction)
    return position.tolist(), target.tolist()


def blueprint(content: RecordingContent) -> rrb.Blueprint:
    """Frames of every view (a row a method) beside the 3-D scene, time series below."""
    import rerun.blueprint as rrb

    views = list(content.true_frames)
    rows = [
        rrb.Horizontal(
            *[
                rrb.Spatial2DView(origin=f"world/cameras/{view}", name=f"true, {view.replace('_', ' ')}")
                for view in views
            ]
        )
    ]
    for method, predicted in content.predicted_frames.items():
        names = [(f"predicted/{method}/{view}", f"{method}, {view.replace('_', ' ')}") for view in predicted]
        rows.append(rrb.Horizontal(*[rrb.Spatial2DView(origin=origin, name=name) for origin, name in names]))
    series = rrb.Horizontal(
        rrb.TimeSeriesView(origin="signals/state", name="state", plot_legend=rrb.PlotLegend(visible=False)),
        rrb.TimeSeriesView(origin="signals/action", name="commands", plot_legend=rrb.PlotLegend(visible=False)),
        rrb.TextDocumentView(origin="description", name="episode"),
        column_shares=[2, 2, 1],
    )
    # What is drawn over the frames would float in the scene twice; Rerun's patterns know no wildcard but a last `/**`.
    flat = [f"- $origin/cameras/{view}/{layer}" for view in views for layer in ("actions", "points", "axes")]
    position, target = eye(content)
    scene = rrb.Spatial3DView(
        origin="world",
        name="scene",
        contents=["$origin/**", *flat],
        line_grid=True,
        background=(24, 26, 31),
        eye_controls=rrb.EyeControls3D(position=position, look_target=target, eye_up=(0.0, 0.0, 1.0)),
    )
    alone = len(rows) == 1
    top = (
        rrb.Vertical(*rows, scene, row_shares=[5, 6])
        if alone
        else rrb.Horizontal(rrb.Vertical(*rows), scene, column_shares=[3, 2])
    )
    return rrb.Blueprint(
        rrb.Vertical(top, series, row_shares=[4, 1]),
        rrb.TimePanel(timeline="frame", fps=content.episode.fps, state="collapsed"),
        collapse_panels=True,
    )
