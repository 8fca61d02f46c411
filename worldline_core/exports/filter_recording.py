"""A Rerun recording of what the filters did with one episode: frames, kept and dropped stretches, every detector's curve.

Entities:

    views/<view>                        recorded frames
    segments/<kept or reason>           a coloured dot per frame, one row per reason: the episode's timeline
    curves/<detector>/<view>/<name>     what a detector measured, over its threshold: above or below 1 decides
    verdict                             what was found, as text
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from worldline_core.exports.rerun_recording import log_frames, timeline
from worldline_core.pictures import KEPT_COLOUR, reason_colour
from worldline_core.store.atomic import atomic_path

if TYPE_CHECKING:
    from worldline_core.data.video.frames import Frames
    from worldline_core.filters.verdict import Finding

_LARGEST_RATIO = 5.0
"""Curves are clipped there, or one outlier would flatten all others."""


def write_filter_recording(
    path: Path,
    frames: Mapping[str, Frames],
    dropped: Mapping[str, NDArray[np.bool_]],
    findings: Sequence[Finding],
    fps: float,
    summary: str,
) -> None:
    """Write one `.rrd` with a blueprint; opens with `rerun <file>`.

    Args:
        frames: by view, (n, H, W, 3).
        dropped: by reason, bool (n,) frames that were dropped for it.
        findings: of the detectors, with their curves.
        summary: Markdown.
    """
    stream = rr.RecordingStream("worldline_filters", send_properties=False)
    with atomic_path(path) as temporary:
        stream.save(temporary, default_blueprint=_blueprint(list(frames), _shown_curves(findings), fps))
        for view, images in frames.items():
            log_frames(stream, f"views/{view}", images, fps)
        _log_segments(stream, dropped, len(next(iter(frames.values()))), fps)
        for finding in findings:
            _log_curves(stream, finding, fps)
        stream.log("verdict", rr.TextDocument(summary, media_type=rr.MediaType.MARKDOWN), static=True)
        stream.disconnect()


def _log_segments(stream: rr.RecordingStream, dropped: Mapping[str, NDArray[np.bool_]], count: int, fps: float) -> None:
    lost = np.logical_or.reduce([*dropped.values(), np.zeros(count, dtype=bool)])
    rows = [("kept", ~lost, KEPT_COLOUR), *[(r, flags, reason_colour(r)) for r, flags in dropped.items()]]
    for height, (name, flags, colour) in enumerate(rows):
        at = np.flatnonzero(flags)
        if len(at) == 0:
            continue
        entity = f"segments/{name}"
        stream.log(
            entity, rr.SeriesPoints(colors=[colour], markers=["square"], marker_sizes=[5], names=[name]), static=True
        )
        times = [rr.TimeColumn("frame", sequence=at), rr.TimeColumn("time", duration=at / fps)]
        stream.send_columns(entity, times, rr.Scalars.columns(scalars=np.full(len(at), -float(height))))


def _log_curves(stream: rr.RecordingStream, finding: Finding, fps: float) -> None:
    for name, curve in finding.verdict.curves.items():
        if curve.threshold <= 0:
            continue
        entity = f"curves/{finding.detector}/{finding.view or 'all'}/{name}"
        label = f"{finding.detector}, {finding.view or 'all'}: {name.replace('_', ' ')} / {curve.threshold:g}"
        colour = reason_colour(finding.verdict.reason)
        stream.log(entity, rr.SeriesLines(colors=[colour], names=[label], widths=[1.5]), static=True)
        ratio = np.clip(curve.values / curve.threshold, -_LARGEST_RATIO, _LARGEST_RATIO)
        stream.send_columns(entity, timeline(len(ratio), fps), rr.Scalars.columns(scalars=ratio))


def _shown_curves(findings: Sequence[Finding]) -> list[str]:
    """Curves of the detectors that found something; of all where none did. The others can be switched on."""
    telling = [f for f in findings if not f.verdict.clean and f.verdict.curves] or findings
    return [f"curves/{f.detector}/{f.view or 'all'}/**" for f in telling if f.verdict.curves]


def _blueprint(views: Sequence[str], curves: Sequence[str], fps: float) -> rrb.Blueprint:
    pictures = [rrb.Spatial2DView(origin=f"views/{view}", name=view.replace("_", " ")) for view in views]
    series = rrb.Vertical(
        rrb.TimeSeriesView(origin="segments", name="kept and dropped frames"),
        rrb.TimeSeriesView(
            origin="curves", contents=[f"+ /{name}" for name in curves], name="detectors: measured over threshold"
        ),
        row_shares=[1, 3],
    )
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(*pictures, rrb.TextDocumentView(origin="verdict", name="verdict")), series, row_shares=[2, 3]
        ),
        rrb.TimePanel(timeline="frame", fps=fps, state="collapsed"),
        collapse_panels=True,
    )
