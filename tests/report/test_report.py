"""The page: every section, nothing from a network, nothing broken by its content, the same bytes again."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import av
import pytest

from worldline_core.errors import ArtifactError
from worldline_core.pictures import COLUMN_GAP_PX, LABEL_HEIGHT_PX
from worldline_core.report.context import ReportConfig
from worldline_core.report.report import report

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


def pages(folder: Path) -> dict[str, str]:
    """The text of every page by its name."""
    found = {path.stem: path.read_text() for path in sorted(folder.glob("*.html"))}
    assert set(found) >= {"index", *SECTIONS}
    return found


def test_pages_are_whole_and_need_nothing_else(full_report: Path) -> None:
    references = set()
    for name, text in pages(full_report).items():
        page = Page(text)
        assert page.open == []
        assert len(page.identities) == len(set(page.identities))
        assert ("summary" if name == "index" else name) in page.identities
        assert "Missing:" not in text
        assert {f"{anchor}.html" for anchor in SECTIONS} <= set(page.references)  # every page leads to every other
        assert not re.search(r"url\(|@import|https?://", text)
        assert "default-src 'none'" in text
        references |= {r for r in page.references if not r.startswith("#")}
    assert [r for r in references if not (full_report / r).is_file()] == []
    assert {f"media/{path.name}" for path in (full_report / "media").iterdir()} <= references


def test_hostile_text_stays_text(full_report: Path) -> None:
    found = pages(full_report)
    for text in found.values():
        page = Page(text)
        assert page.scripts == 2  # the run's facts and the page's own script
        assert page.handlers == []
        assert "<script>alert" not in text
    shown = {name: text.count("&lt;script&gt;alert(") for name, text in found.items()}
    assert min(shown[name] for name in ("provenance", "videos")) > 0
    assert shown["data"] >= 3  # names and reasons of what was refused, a detector
    assert "</script>" not in (full_report / "run" / "run.js").read_text()


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
    def content(folder: Path) -> dict[str, bytes]:
        files = {path.relative_to(folder): path for path in folder.rglob("*") if path.is_file()}
        return {str(name): path.read_bytes() for name, path in files.items() if "run" not in name.parts}

    (tmp_path / "media").mkdir()
    # A killed call leaves half-written files.
    (tmp_path / "media" / ".episode0.123.tmp.mp4").write_bytes(b"half")
    (tmp_path / ".index.123.tmp.html").write_bytes(b"half")
    report(ReportConfig(tile_height=64), run_artifacts, tmp_path)
    assert content(tmp_path) == content(full_report)


def test_times_and_versions_stay_out_of_the_reproducible_page(full_report: Path) -> None:
    text = "".join(pages(full_report).values())
    run = (full_report / "run" / "run.js").read_text()
    for fact in ("2026-11-21T05:00:00Z", ">12.5<", "torch 2.11"):
        assert fact not in text
        assert fact in run
    parts = json.loads(run.removeprefix("window.WORLDLINE_RUN = ").rstrip(";\n"))
    assert set(parts) == set(re.findall(r'data-run="(\w+)"', text))
    assert Page(parts["cost"]).open == []
    assert re.search(r"<td[^>]*>bfloat16</td>.*\s*<td[^>]*>100\.0</td>", parts["cost"])  # the time of a frame
    assert "a slow machine" in parts["cost"]


def test_numbers_of_the_scores_are_on_the_pages(full_report: Path) -> None:
    found = pages(full_report)
    assert 'src="media/episode0_shipped_head.mp4"' in found["index"]
    tiles = [found["index"].count(f'class="tile {verdict}"') for verdict in ("better", "worse", "unclear")]
    assert tiles == [3, 0, 0]
    for shown in (
        "+0.21",  # over shuffled actions
        "lpips", "no weights in the configured folder",
        "0.930",  # the segmenter's own accuracy
        ", colour</th>",  # by a second segmenter
    ):  # fmt: skip
        assert shown in found["quality"], shown
    assert "recorded videos (ceiling)" in found["decisions"]
    assert re.search(r"0\.95</span>.*?0\.50.*?</td><td[^>]*>0\.95</td>", found["decisions"])
    for cells in (
        r"<th[^>]*>quick</th><td[^>]*>3</td><td[^>]*>0\.75</td>\s*<td[^>]*>0\.50</td>",  # a policy's rates, the best first
        r"0\.91</span><span[^>]*>\[0\.70, 0\.97\]",
        r"<td[^>]*>10</td><td[^>]*>2</td>\s*<td[^>]*><span[^>]*>0\.61</span><span[^>]*>\[0\.50, 0\.72\]",
        "too few wrong verdicts",
        r"0\.87</span><span[^>]*>\[0\.77, 0\.97\]",  # area under the curve
        r"<td[^>]*>40\u202f%</td><td[^>]*>\d+\u202f%</td>",  # undecided verdicts; right of the others
    ):
        assert re.search(cells, found["decisions"]), cells
    assert "median of 3 on held-out recordings" in found["videos"]
    assert "truncated_video" in found["data"]


@pytest.mark.parametrize(
    ("given", "missing", "says"),
    [
        (
            ("curate", "train_stage1"), ["videos", "quality", "decisions"],
            {
                "index": "6 of 7 episodes were kept; no prediction was measured yet.",
                "data": "No action tracks with previews were given",
            },
        ),
        ((), [*SECTIONS], {"index": "Nothing was measured yet."}),
    ],
)  # fmt: skip
def test_missing_parts_are_said_to_be_missing(
    run_artifacts: dict[str, Path], tmp_path: Path, given: tuple[str, ...], missing: list[str], says: dict[str, str]
) -> None:
    metrics = report(ReportConfig(), {name: run_artifacts[name] for name in given}, tmp_path)
    found = pages(tmp_path)
    assert [name for name, text in found.items() if Page(text).open] == []
    assert (metrics["missing"], metrics["sections"]) == (missing, 1 + len(SECTIONS) - len(missing))
    assert all("Missing:" in found[anchor] for anchor in missing)
    assert all(text in found[name] for name, text in says.items())


def test_a_damaged_artifact_is_named(tmp_path: Path) -> None:
    (tmp_path / "summary.json").write_text("{")
    with pytest.raises(ArtifactError, match=r"(?s)JSON file is damaged.*summary\.json"):
        report(ReportConfig(), {"evaluate_video": tmp_path}, tmp_path / "out")
