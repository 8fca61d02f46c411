"""The page: every section, nothing from a network, nothing broken by its content, the same bytes again."""

from __future__ import annotations

import hashlib
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import av
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.report.conftest import EPISODES, write_episode_set  # pyright: ignore[reportMissingImports]
from worldline_core.errors import ArtifactError
from worldline_core.pictures import COLUMN_GAP_PX, LABEL_HEIGHT_PX
from worldline_core.report.context import ReportConfig, ReportContext
from worldline_core.report.data import data_section
from worldline_core.report.report import report
from worldline_core.report.results import block_costs

SECTIONS = ("videos", "quality", "decisions", "data", "training", "provenance")
VOID = {"meta", "img", "input", "br", "hr", "link", "source"}


class Page(HTMLParser):
    """Checks nesting and collects references, ids and text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.references: list[str] = []
        self.identities: list[str] = []
        self.scripts = 0
        self.handlers: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.references += [v for k in ("src", "href", "poster") if (v := values.get(k))]
        self.identities += [v] if (v := values.get("id")) else []
        self.handlers += [name for name in values if name.startswith("on")]
        self.scripts += tag == "script"
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> without a beginning"
        assert self.open.pop() == tag


def digest(folder: Path) -> dict[str, str]:
    files = (
        path for path in sorted(folder.rglob("*")) if path.is_file() and "run" not in path.relative_to(folder).parts
    )
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def pages(folder: Path) -> dict[str, str]:
    """The text of every page by its name."""
    found = {path.stem: path.read_text() for path in sorted(folder.glob("*.html"))}
    assert set(found) >= {"index", *SECTIONS}
    return found


def run_parts(folder: Path) -> dict[str, str]:
    text = (folder / "run" / "run.js").read_text()
    return json.loads(text.removeprefix("window.WORLDLINE_RUN = ").rstrip(";\n"))


def test_pages_are_well_formed_and_complete(full_report: Path) -> None:
    for name, text in pages(full_report).items():
        page = Page(text)
        assert page.open == []
        assert len(page.identities) == len(set(page.identities))
        assert ("summary" if name == "index" else name) in page.identities
        assert "Missing:" not in text
        assert {f"{anchor}.html" for anchor in SECTIONS} <= set(page.references)  # every page leads to every other


def test_nothing_comes_from_a_network(full_report: Path) -> None:
    for text in pages(full_report).values():
        assert [r for r in Page(text).references if re.match(r"^[a-z]+:|^//", r)] == []
        assert not re.search(r"url\(|@import|https?://", text)
        assert "default-src 'none'" in text


def test_every_referenced_file_exists_and_every_medium_is_referenced(full_report: Path) -> None:
    found = {r for text in pages(full_report).values() for r in Page(text).references}
    references = {r for r in found if not r.startswith("#")}
    assert [r for r in references if not (full_report / r).is_file()] == []
    assert {f"media/{path.name}" for path in (full_report / "media").iterdir()} <= references


def test_hostile_text_stays_text(full_report: Path) -> None:
    for text in pages(full_report).values():
        page = Page(text)
        assert page.scripts == 2  # the run's facts and the page's own script
        assert page.handlers == []
        assert "<script>alert" not in text
    shown = [name for name, text in pages(full_report).items() if "&lt;script&gt;alert(" in text]
    assert set(shown) >= {"data", "provenance", "videos"}
    assert "</script>" not in (full_report / "run" / "run.js").read_text()


def test_hostile_names_and_reasons_of_what_was_refused_stay_text(hostile_text: str, tmp_path: Path) -> None:
    inputs = {name: tmp_path / name for name in ("curate", "filter")}
    for folder in inputs.values():
        write_episode_set(folder, EPISODES[:1], name=hostile_text, reason=hostile_text)
    finding = {"episode_id": hostile_text, "detector": hostile_text, "cut_frames": 3}
    pq.write_table(pa.Table.from_pylist([finding]), inputs["filter"] / "findings.parquet")
    section = data_section(ReportContext(ReportConfig(), inputs, tmp_path / "out"))
    page = Page(str(section.body))
    assert (page.scripts, page.handlers, page.open) == (0, [], [])
    assert str(section.body).count("&lt;script&gt;alert(") >= 4
    assert "&lt;b&gt;12&lt;/b&gt; of 33 frames" in str(section.body)


def test_videos_play_in_browsers(full_report: Path) -> None:
    path = full_report / "media" / "episode0_shipped_head.mp4"
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert sum(1 for _ in container.decode(stream)) == 9
        # Truth, Stage II, causal; below them shuffled actions, copy of the first frame: a phone shows three columns.
        assert stream.width == 3 * 96 + 2 * COLUMN_GAP_PX
        assert stream.height == 2 * (64 + LABEL_HEIGHT_PX)
    content = path.read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")  # the index comes first: playable while loading


@pytest.mark.slow
def test_bytes_are_the_same_again(run_artifacts: dict[str, Path], full_report: Path, tmp_path: Path) -> None:
    report(ReportConfig(tile_height=64), run_artifacts, tmp_path)
    again, before = digest(tmp_path), digest(full_report)
    assert again == before
    # A killed call leaves half-written files; they must not enter the digest of the next one.
    (tmp_path / "media" / ".episode0.123.tmp.mp4").write_bytes(b"half")
    (tmp_path / ".index.123.tmp.html").write_bytes(b"half")
    report(ReportConfig(tile_height=64), run_artifacts, tmp_path)
    assert digest(tmp_path) == again


def test_times_and_versions_stay_out_of_the_reproducible_page(full_report: Path) -> None:
    text = "".join(pages(full_report).values())
    run = (full_report / "run" / "run.js").read_text()
    for fact in ("2026-11-21T05:00:00Z", ">12.5<", "torch 2.11"):
        assert fact not in text
        assert fact in run
    parts = run_parts(full_report)
    assert set(parts) == set(re.findall(r'data-run="(\w+)"', text))
    assert Page(parts["cost"]).open == []


def test_cost_shows_the_time_of_a_block_and_the_ratio_of_the_ends(full_report: Path) -> None:
    cost = run_parts(full_report)["cost"]
    assert re.search(r"<td[^>]*>510</td><td[^>]*>1\.04</td>", cost)  # the processor's time
    assert "a slow machine" in cost
    assert block_costs({"long_rollout": {"block_seconds": [1.0] * 9}}) is None
    assert block_costs({"long_rollout": {"block_seconds": [1.0] * 5 + [2.0] * 5}}) == (1.5, 2.0)
    assert block_costs({}) is None


def test_numbers_of_the_scores_are_on_the_pages(full_report: Path) -> None:
    found = pages(full_report)
    assert "+0.21" in found["quality"]  # over shuffled actions
    assert "lpips" in found["quality"]
    assert "no weights in the configured folder" in found["quality"]
    assert "0.930" in found["quality"]  # the segmenter's own accuracy
    assert ", colour</th>" in found["quality"]  # by a second segmenter
    assert "recorded videos (ceiling)" in found["decisions"]
    assert re.search(r"0\.95</span>.*?0\.50.*?</td><td[^>]*>0\.95</td>", found["decisions"])
    for cells in (
        r"<th[^>]*>quick</th><td[^>]*>3</td><td[^>]*>0\.75</td>\s*<td[^>]*>0\.50</td>",  # a policy's rates, the best first
        r"0\.91</span><span[^>]*>\[0\.70, 0\.97\]",
        r"<td[^>]*>10</td><td[^>]*>2</td>\s*<td[^>]*><span[^>]*>0\.61</span><span[^>]*>\[0\.50, 0\.72\]",
        "Not available for videos of Stage II \\(this run\\): too few wrong verdicts",
        "farther from the training recordings than 95",
    ):
        assert re.search(cells, found["decisions"]), cells
    for points in re.findall(r'<polyline points="([^"]*)"', found["decisions"]):
        x = [float(point.partition(",")[0]) for point in points.split()]
        assert x == sorted(x)  # from few candidates to many
    assert "median of 3 on held-out scenes" in found["videos"]
    assert "truncated_video" in found["data"]
    assert "None of the 2 test scenes is among the 1 scenes of training and validation." in found["data"]


def test_missing_parts_are_said_to_be_missing(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    some = {name: run_artifacts[name] for name in ("curate", "train_stage1")}
    metrics = report(ReportConfig(), some, tmp_path)
    found = pages(tmp_path)
    assert [name for name, text in found.items() if Page(text).open] == []
    assert metrics["missing"] == ["videos", "quality", "decisions"]
    for anchor in metrics["missing"]:
        assert "Missing:" in found[anchor]
    assert "6 of 7 episodes were kept; no prediction was measured yet." in found["index"]
    assert "Stage II: action-driven, three views, Distillation" in found["training"]
    assert "filtered EpisodeSet is missing" in found["data"]
    assert "No action tracks were given" in found["data"]


def test_a_report_of_nothing_is_a_page(tmp_path: Path) -> None:
    metrics = report(ReportConfig(), {}, tmp_path)
    assert (metrics["sections"], len(metrics["missing"])) == (1, len(SECTIONS))
    found = pages(tmp_path)
    assert "Nothing was measured yet." in found["index"]
    assert [name for name, text in found.items() if Page(text).open] == []


def test_a_damaged_artifact_is_named(run_artifacts: dict[str, Path], tmp_path: Path) -> None:
    broken = tmp_path / "scores"
    broken.mkdir()
    (broken / "summary.json").write_text("{")
    with pytest.raises(ArtifactError, match=r"(?s)JSON file is damaged.*summary\.json"):
        report(ReportConfig(), {"evaluate_video": broken}, tmp_path / "out")
