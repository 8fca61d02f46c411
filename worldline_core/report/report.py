"""The step report: one static page from whatever artifacts are finished, with its media beside it.

The page and its media are reproducible. What is not (wall times, device, versions, costs) is written to
`run/run.js` and put into the page when it is opened; recordings for viewers lie in `run/recordings/`.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from worldline_core.report.config import ReportConfig
from worldline_core.store.atomic import remove_unfinished, write_bytes_atomic

__all__ = ["ReportConfig", "report"]

logger = logging.getLogger(__name__)


def report(config: ReportConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Write `output/index.html` and its media.

    Inputs: any finished artifacts by the name of their step (`curate`, `rollout.<method>`, `evaluate_video`, ...);
    a section whose artifacts are not there says so.

    Raises:
        WorldLineError: an artifact that is there cannot be read.
    """
    from tqdm import tqdm

    from worldline_core.report.context import ReportContext, ReportInputs
    from worldline_core.report.page import render_page, run_script
    from worldline_core.report.sections.actions import actions_section
    from worldline_core.report.sections.data import data_section
    from worldline_core.report.sections.efficiency import efficiency_section
    from worldline_core.report.sections.filters import filters_section
    from worldline_core.report.sections.models import models_section
    from worldline_core.report.sections.planning import planning_section
    from worldline_core.report.sections.policy import policy_section
    from worldline_core.report.sections.provenance import provenance_section
    from worldline_core.report.sections.rollouts import rollouts_section
    from worldline_core.report.sections.summary import summary_section
    from worldline_core.report.sections.training import training_section
    from worldline_core.report.sections.trend import trend_section
    from worldline_core.report.sections.video import video_section

    # The page is made anew: nothing that an earlier, killed call left behind may enter the digest.
    shutil.rmtree(output / "media", ignore_errors=True)
    remove_unfinished(output)
    makers = [
        summary_section, rollouts_section, video_section, policy_section, planning_section, efficiency_section,
        data_section, filters_section, actions_section, training_section, models_section, provenance_section,
    ]  # fmt: skip
    context = ReportContext(config, ReportInputs({name: Path(path) for name, path in inputs.items()}), output)
    if context.inputs.get("history") is not None:
        makers.insert(1, trend_section)
    sections = [make(context) for make in tqdm(makers, desc="report", unit="section", disable=None)]
    page = render_page(config.title, config.subtitle, None, sections)
    write_bytes_atomic(output / "run" / "run.js", run_script(context.run_parts).encode())
    write_bytes_atomic(output / "index.html", page.encode())
    missing = [section.anchor for section in sections if section.missing]
    logger.info("report: %d sections, missing: %s", len(sections) - len(missing), ", ".join(missing) or "none")
    media = sorted(path.name for path in (output / "media").iterdir()) if (output / "media").is_dir() else []
    return {"sections": len(sections) - len(missing), "missing": missing, "media": len(media)}
