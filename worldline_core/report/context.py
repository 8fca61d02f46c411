"""What every section of the report is given, and what it gives back."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

from markupsafe import Markup
from pydantic import Field

from worldline_core.config import StrictModel
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.pages.page import render, render_macro
from worldline_core.pictures import Picture, jpeg_bytes, png_bytes
from worldline_core.report.video_scores import VideoScores
from worldline_core.rollout.rollout_set import RolloutSet
from worldline_core.store.artifact_files import JsonObject, read_json
from worldline_core.store.atomic import write_bytes_atomic


class ReportConfig(StrictModel):
    """What the report shows."""

    title: str = Field(default="WorldLine: from robot recordings to an action-driven simulator", min_length=1)
    subtitle: str = (
        "What was recorded, kept, trained, predicted and chosen in this run, and how well: measured, with intervals."
    )
    primary_method: str | None = Field(
        default=None,
        description="the method whose numbers head the page; none: the long-trained Stage II, else this run's",
    )
    tile_height: int = Field(
        default=256, ge=32, le=1080, description="height of one video in a side-by-side video, pixels"
    )
    upscale: Literal["lanczos", "nearest"] = "lanczos"
    max_columns: int = Field(
        default=6, ge=2, le=12, description="columns of a side-by-side video, the truth among them"
    )
    contact_sheet_rows: int = Field(default=12, ge=1, le=64)
    overlay_episodes: int = Field(default=4, ge=1, le=32)
    rerun: bool = Field(default=True, description="write a Rerun recording of every episode shown")
    mcap: bool = Field(default=True, description="write MCAP files of every episode shown")


@dataclass(frozen=True)
class Section:
    """One page of the report: its name, title, a sentence of introduction, and its content; or why it is missing."""

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
    """The configuration, the inputs, and the folder that pages and media go to.

    Attributes:
        inputs: artifact folders by name: a step (`curate`), or a step and a variant (`rollout.stage2`).
        run_parts: what is not reproducible (times, devices, versions). It is written to `run/run.js`, outside of the
            digested pages, and put into their slots when they are opened.
    """

    config: ReportConfig
    inputs: Mapping[str, Path]
    output: Path
    run_parts: dict[str, Markup] = field(default_factory=dict)

    def variants(self, step: str) -> dict[str, Path]:
        """All folders of a step: variant -> folder; the plain name has the variant ""."""
        found = {name.partition("."): path for name, path in sorted(self.inputs.items())}
        return {variant: path for (name, _, variant), path in found.items() if name == step}

    def manifest(self, name: str) -> JsonObject:
        """An artifact's manifest, or an empty object for a folder without one."""
        return read_json(self.inputs[name] / "manifest.json") if name in self.inputs else {}

    @cached_property
    def media(self) -> Path:
        folder = self.output / "media"
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    @cached_property
    def video_scores(self) -> VideoScores:
        """Scores of every video evaluation."""
        return VideoScores.read(self.variants("evaluate_video").values())

    def summaries(self, step: str) -> list[JsonObject]:
        """Summaries of every evaluation of a step that has a method in it."""
        found = [read_json(folder / "summary.json") for folder in self.variants(step).values()]
        return [summary for summary in found if summary.get("methods")]

    @cached_property
    def rollouts(self) -> dict[str, RolloutSet]:
        """Predicted videos by method, those of candidate banks apart."""
        return {name: RolloutSet.open(path) for name, path in self.variants("rollout").items()}

    @cached_property
    def episodes(self) -> EpisodeSet | None:
        """The filtered episodes, or the curated ones when there are no filtered ones."""
        folder = self.inputs.get("filter") or self.inputs.get("curate") or self.inputs.get("episodes")
        return None if folder is None else EpisodeSet.open(folder)

    def picture(self, name: str, picture: Picture, *, alt: str, photo: bool = False) -> Markup:
        """Write a picture and return the element that shows it; photographs become JPEG, drawings PNG."""
        path = self.media / f"{name}.{'jpg' if photo else 'png'}"
        write_bytes_atomic(path, jpeg_bytes(picture) if photo else png_bytes(picture))
        height, width = picture.shape[:2]
        file = f"media/{path.name}"
        return render_macro("pages/parts.html", "picture", file=file, alt=alt, width=width, height=height)

    def slot(self, name: str, content: Markup | str, fallback: str = "", *, inline: bool = False) -> Markup:
        """A place in a page, or in a line of it, that is filled from `run/run.js`; `fallback` stands there until then."""
        self.run_parts[name] = Markup.escape(content)
        tag = "span" if inline else "div"
        return render_macro("pages/parts.html", "slot", name=name, fallback=fallback, tag=tag)

    def section(self, anchor: str, title: str, lead: str = "", /, **values: object) -> Section:
        """A section whose content is the template of its name, filled with values."""
        return Section(anchor, title, lead, render(f"report/{anchor}.html", **values))

    def write_pages(self, home: Markup, sections: Sequence[Section]) -> None:
        """Write `index.html`, one page per section, and what is filled in when they are opened."""
        for section, following in zip(sections, [*sections[1:], None], strict=True):
            page = render("report/page.html", title=section.title, section=section, sections=sections, next=following)
            write_bytes_atomic(self.output / section.file, page.encode())
        # `</` would end a script element if this text were ever put into one.
        parts = json.dumps({name: str(part) for name, part in sorted(self.run_parts.items())}, indent=1)
        script = "window.WORLDLINE_RUN = " + parts.replace("</", "<\\/") + ";\n"
        write_bytes_atomic(self.output / "run" / "run.js", script.encode())
        write_bytes_atomic(self.output / "index.html", home.encode())
