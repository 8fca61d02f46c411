"""The filters on labelled clips, one of each kind; benchmarks/filters.py measures them on many."""

from __future__ import annotations

import numpy as np
import pytest

from tools.labelled_clips import FAULTS, HARMLESS, Clip, view_thumbnails
from worldline_core.filters.filter import inspect
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.filters.signals import measure
from worldline_core.filters.verdict import REASONS, Finding


def findings_of(clip: Clip, **doctor: float) -> list[Finding]:
    thumbnails = {view: view_thumbnails(images, clip.episode.fps) for view, images in clip.frames.items()}
    return inspect(FilterConfig.model_validate({"doctor": doctor}), measure(clip.episode, thumbnails))


LATE = ("late_states", "late_pictures")
"""Faults that the doctor finds by a search of about a second; test_filter_episodes has one of them too."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name in LATE else []) for name in FAULTS]
)
def test_every_fault_gets_its_reason(recording: Clip, name: str) -> None:
    clip = FAULTS[name](recording, np.random.default_rng(3))
    assert clip.bad.any()
    doctor = {} if name in LATE else {"rate_hz": 0.5}  # too little to search for mistakes of the calibration
    found = [f for f in findings_of(clip, **doctor) if f.verdict.reason == clip.fault and not f.verdict.clean]
    assert found
    assert clip.fault in REASONS
    if found[0].verdict.bad_frames is not None:
        cut = np.logical_or.reduce([f.verdict.bad_frames for f in found if f.verdict.bad_frames is not None])
        assert (cut & clip.bad).sum() >= 0.7 * clip.bad.sum()
        assert (cut & ~clip.bad).sum() <= 0.3 * cut.sum() + 2


@pytest.mark.parametrize("name", HARMLESS)
def test_nothing_is_dropped_for_a_change_that_is_no_fault(recording: Clip, name: str) -> None:
    clip = HARMLESS[name](recording, np.random.default_rng(3))
    assert any(not np.array_equal(clip.frames[view], recording.frames[view]) for view in clip.frames)
    assert all(finding.verdict.clean for finding in findings_of(clip))
