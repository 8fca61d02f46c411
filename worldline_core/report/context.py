"""What every section of the report is given, and what it gives back."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from markupsafe import Markup

from worldline_core.pages.page import render
from worldline_core.pictures.labels import jpeg_bytes, png_bytes
from worldline_core.report.report_config import ReportConfig
from worldline_core.report.video_scores import VideoScores
from worldline_core.store.artifact_files import JsonObject, read_json
from worldline_core.store.atomic import write_bytes_atomic

if TYPE_CHECKING:
    from worldline_core.data.episodes.episode_set import EpisodeSet
    from worldline_core.pictures.labels import Picture
    from worldline_core.rollout.rollout_set import RolloutSet


@dataclass(frozen=True)
class ReportInputs:
    """Artifact folders by name: a step (`curate`) or a step and a variant (`rollout.stage2`, `curate.banks`)."""

    folders: Mapping[str, Path]

    def get(self, name: str) -> Path | None:
        """The folder of a name, or None."""
        return self.folders.get(name)

    def variants(self, step: str) -> dict[str, Path]:
        """All folders of a step: variant -> folder; the plain name has the variant ""."""
        found = {"": self.folders[step]} if step in self.folders else {}
        prefix = f"{step}."
        return found | {
            name.removeprefix(prefix): path for name, path in sorted(self.folders.items()) if name.startswith(prefix)
        }

    def manifest(self, name: str) -> JsonObject:
        """An artifact's manifest, or an empty object for a folder without one."""
        folder = self.folders.get(name)
        return read_json(folder / "manifest.json") if folder is not None else {}


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
    """The configuration, the inputs, and the folder that media go to.

    `run_parts` collects what is not reproducible (times, devices, versions): it is written to `run/run.js`, outside of
    the digested pages, and put into their slots when they are opened.
    """

    config: ReportConfig
    inputs: ReportInputs
    output: Path
    run_parts: dict[str, Markup] = field(default_factory=dict)

    @cached_property
    def media(self) -> Path:
        folder = self.output / "media"
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    @cached_property
    def video_scores(self) -> VideoScores:
        """Scores of every video evaluation."""
        return VideoScores.read(self.inputs.variants("evaluate_video"))

    def summaries(self, step: str) -> list[JsonObject]:
        """Summaries of every evaluation of a step that has a method in it."""
        found = [read_json(folder / "summary.json") for folder in self.inputs.variants(step).values()]
        return [summary for summary in found if summary.get("methods")]

    @cached_property
    def rollouts(self) -> dict[str, RolloutSet]:
        """Predicted videos by method, those of candidate banks apart."""
        from worldline_core.rollout.rollout_set import RolloutSet

        return {name: RolloutSet.open(path) for name, path in self.inputs.variants("rollout").items()}

    @cached_property
    def episodes(self) -> EpisodeSet | None:
        """The filtered episodes, or the curated ones when there are no filtered ones."""
        from worldline_core.data.episodes.episode_set import EpisodeSet

        folder = self.inputs.get("filter") or self.inputs.get("curate") or self.inputs.get("episodes")
        return None if folder is None else EpisodeSet.open(folder)

    def picture(self, name: str, picture: Picture, *, alt: str, photo: bool = False) -> Markup:
        """Write a picture and return the element that shows it; photographs become JPEG, drawings PNG."""
        path = self.media / f"{name}.{'jpg' if photo else 'png'}"
        write_bytes_atomic(path, jpeg_bytes(picture) if photo else png_bytes(picture))
        height, width = picture.shape[:2]
        return Markup('<img src="media/{}" alt="{}" width="{}" height="{}" loading="lazy">').format(
            path.name, alt, width, height
        )

    def slot(
        self, name: str, content: Markup, fallback: str = "Recorded when the report was made; see run/run.js."
    ) -> Markup:
        """A place in a page that is filled from `run/run.js`."""
        self.run_parts[name] = content
        note = Markup('<p class="muted">{}</p>').format(fallback) if fallback else ""
        return Markup('<div data-run="{}">{}</div>').format(name, note)

    def section(self, anchor: str, title: str, lead: str = "", /, **values: object) -> Section:
        """A section whose content is the template of its name, filled with values."""
        return Section(anchor, title, lead, render(f"report/{anchor}.html", **values))

    def write_pages(self, home: Markup, sections: Sequence[Section]) -> None:
        """Write `index.html`, one page per section, and what is filled in when they are opened."""
        for place, section in enumerate(sections):
            following = sections[place + 1] if place + 1 < len(sections) else None
            page = render("report/page.html", title=section.title, section=section, sections=sections, next=following)
            write_bytes_atomic(self.output / section.file, page.encode())
        # `</` would end a script element if this text were ever put into one.
        parts = json.dumps({name: str(part) for name, part in sorted(self.run_parts.items())}, indent=1)
        script = "window.WORLDLINE_RUN = " + parts.replace("</", "<\\/") + ";\n"
        write_bytes_atomic(self.output / "run" / "run.js", script.encode())
        write_bytes_atomic(self.output / "index.html", home.encode())
