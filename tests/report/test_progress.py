"""The page of a run that is not finished: its content, and the finished report that replaces it."""

from __future__ import annotations

import json
from pathlib import Path

from worldline_core.pages.page import duration
from worldline_core.report.progress import FinishedStep, write_finished_page, write_progress_page


def artifact(store: Path, step: str, key: str, seconds: float, finished: str = "2026-01-01", **metrics: object) -> Path:
    folder = store / step / key
    folder.mkdir(parents=True)
    content = {"wall_seconds": seconds, "finished_at": finished, "resumed": False, "metrics": metrics}
    (folder / "manifest.json").write_text(json.dumps(content))
    return folder


def test_the_page_says_what_is_done_running_and_coming(tmp_path: Path, hostile_text: str) -> None:
    curate = artifact(tmp_path, "curate", "k1", 20.0, found=145, kept=142, reasons={"blur": 3})
    tracks = artifact(tmp_path, "render_actions", "k2", 7.0)
    (tracks / "previews").mkdir()
    (tracks / "previews" / "a b.png").write_bytes(b"png")
    done = [FinishedStep("curate", curate, 21.6), FinishedStep("render_actions", tracks, 0.0, cached=True)]
    latest = tmp_path / "report" / "latest"
    page = write_progress_page(latest, done, ["train_stage1"], ["distill", hostile_text], 30.0)
    text = page.read_text()
    assert page == latest / "index.html"
    assert "2 of 5 steps are done after 30 s" in text
    assert "found 145 · kept 142" in text
    assert "found in the store" in text
    assert 'http-equiv="refresh"' in text
    assert 'src="../../render_actions/k2/previews/a%20b.png"' in text
    assert (latest / "../../render_actions/k2/previews/a b.png").resolve().is_file()
    assert hostile_text not in text
    assert "&lt;script&gt;" in text
    assert list(latest.iterdir()) == [page]  # nothing half-written is left beside it


def test_a_failed_run_says_so_and_stops_reloading(tmp_path: Path, hostile_text: str) -> None:
    text = write_progress_page(tmp_path, [], ["curate"], ["filter"], 3.0, failed=hostile_text).read_text()
    assert "This run stopped" in text
    assert "refresh" not in text
    assert hostile_text not in text


def test_the_finished_report_takes_the_place_of_the_page(tmp_path: Path) -> None:
    report = artifact(tmp_path, "report", "0123", 1.0)
    (report / "index.html").write_text("the report")
    latest = tmp_path / "report" / "latest"
    write_progress_page(latest, [], ["curate"], [], 1.0)
    text = write_finished_page(latest, report).read_text()
    assert 'content="0; url=../0123/index.html"' in text
    assert 'href="../0123/index.html"' in text
    assert (latest / "../0123/index.html").resolve().read_text() == "the report"


def test_durations_are_words() -> None:
    assert [duration(s) for s in (3.21, 61, 150, 8000)] == ["3.2 s", "61 s", "2.5 min", "2.2 h"]
