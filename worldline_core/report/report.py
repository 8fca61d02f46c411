"""The step report: static pages from whatever artifacts are finished, with their media beside them.

Pages and media are reproducible. What is not (wall times, device, versions, costs) is written to `run/run.js` and put
into the pages when they are opened; recordings for viewers lie in `run/recordings/`.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from worldline_core.progress import with_progress
from worldline_core.report.actions import actions_section
from worldline_core.report.context import ReportConfig, ReportContext
from worldline_core.report.cost import cost_section
from worldline_core.report.dataset_card import data_section
from worldline_core.report.decisions import planning_section, policy_section
from worldline_core.report.filters import filters_section
from worldline_core.report.provenance import models_section, provenance_section
from worldline_core.report.quality import quality_section
from worldline_core.report.summary import overview
from worldline_core.report.training import training_section
from worldline_core.report.videos import videos_section
from worldline_core.store.atomic import remove_unfinished

__all__ = ["ReportConfig", "report"]

logger = logging.getLogger(__name__)

SECTIONS = (
    videos_section, quality_section, policy_section, planning_section, cost_section, data_section, filters_section,
    actions_section, training_section, models_section, provenance_section,
)  # fmt: skip


def report(config: ReportConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Write `output/index.html`, one page per section, and their media.

    Inputs: any finished artifacts by the name of their step (`curate`, `rollout.<method>`, `evaluate_video`, ...);
    a page whose artifacts are not there says so.

    Raises:
        WorldLineError: an artifact that is there cannot be read.
    """
    # The pages are made anew: nothing that an earlier, killed call left behind may enter the digest.
    shutil.rmtree(output / "media", ignore_errors=True)
    remove_unfinished(output)
    context = ReportContext(config, dict(inputs), output)
    sections = [make(context) for make in with_progress(SECTIONS, "report", "section")]
    context.write_pages(overview(context, sections), sections)
    missing = [section.anchor for section in sections if section.missing]
    pages = len(sections) + 1 - len(missing)
    logger.info("report: %d pages, missing: %s", pages, ", ".join(missing) or "none")
    return {"sections": pages, "missing": missing, "media": len(list((output / "media").glob("*")))}
