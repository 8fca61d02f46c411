"""Texts of strangers on pages, in messages, in logs and on pictures; credentials in all of them."""

from __future__ import annotations

import json
import logging
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from markdown_it import MarkdownIt
from safetensors import SafetensorError

from tasks.execution.command_line import exit_with_clear_errors, log_to_stderr
from tasks.execution.run_page import write_progress_page
from tests.data.conftest import make_sample  # pyright: ignore[reportMissingImports]
from worldline_core.calibration.check import CalibrationCheck, EpisodeCheck
from worldline_core.calibration.check import page as check_page
from worldline_core.calibration.diagnosis import Diagnosis
from worldline_core.config import ConfigError, load_config
from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode_index import read_quarantine
from worldline_core.data.episodes.source import LoadedEpisode
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.sources.video_folder import VideoFolderSourceConfig
from worldline_core.errors import DataError
from worldline_core.evaluation.evaluation_config import VLMConfig
from worldline_core.pages.page import Table, environment
from worldline_core.pictures import fit_text, text_width_px
from worldline_core.report.data import markdown_table, plain
from worldline_core.store.remote import parse_location
from worldline_core.untrusted_text import LONGEST, shown, visible, without_credentials

HOSTILE = {
    "script": "<script>alert(1)</script>",
    "attribute": '"><img src=x onerror=alert(1)>',
    "quote": "' onmouseover='alert(1)",
    "template": "{{7*7}} {% raw %} ${7*7}",
    "style": "</style></title></script><svg onload=alert(1)>",
    "entity": "&lt;script&gt;alert(1)&lt;/script&gt; &#x3c;script>",
    "link": "[x](javascript:alert(1)) ![x](http://a.example/x.png) <http://a.example> `</code>`",
    "formula": "=cmd|'/C calc'!A0",
    "direction": "lift \u202egnp.exe\u2066 \u200f\u061c",
    "control": "lift\x00\x1b]0;owned\x07\x1b[2J\x9b31m\x7f\r",
    "surrogate": "lift \ud800",
    "long": "lift the block " * 7000,
}

URL_SECRETS = (
    "s3://AKIAIOSFODNN7EXAMPLE:wJalrXUtnFEMIsecret@bucket/set", "https://user:pa55word-secret@host/v1",
    "https://tok3n-secret@host/v1", "https://host/x?X-Amz-Credential=a-secret&X-Amz-Signature=b-secret",
    "https://host/v1?api_key=abc-secret", "simplecache::sftp://me:pw-secret@host/x", "https://host/x#access_token=abc-secret",
)  # fmt: skip


class _Page(HTMLParser):
    def __init__(self, html: str) -> None:
        super().__init__()
        self.found: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [tag, *(name for name, _ in attrs if name.startswith("on") or name == "src")]


def same_elements(hostile: str, harmless: str) -> None:
    assert _Page(hostile).found == _Page(harmless).found
    assert visible(hostile) == hostile, "control or direction characters reach the page"
    assert len(hostile) < 60_000 + len(harmless)


def progress(name: str, folder: Path) -> str:
    return write_progress_page(folder, [], [name], [name], 1.0, failed=name).read_text()


def checked(name: str, folder: Path) -> str:
    unread = Diagnosis(verdict="unreadable", notes=(name,))
    return check_page(CalibrationCheck((EpisodeCheck(name, name, unread, reason=name),), (), folder))


MARKDOWN = MarkdownIt("commonmark").enable("table").render


def card(name: str, _: Path) -> str:
    return MARKDOWN(markdown_table(Table((name, "b"), [(name, name)])) + f"\n\n# {plain(name)}\n")


@pytest.mark.parametrize("text", HOSTILE.values(), ids=HOSTILE)
def test_pages_and_cells_keep_their_elements_whatever_ids_and_reasons_say(text: str, tmp_path: Path) -> None:
    for make in (progress, checked, card):
        same_elements(make(text, tmp_path), make("harmless", tmp_path))
    table = markdown_table(Table(("Instruction", "Episodes"), [(text, 1)]))
    assert len(table.splitlines()) == 3
    assert set(re.findall(r"<(\w+)", MARKDOWN(table))) == {"table", "thead", "tbody", "tr", "th", "td"}


def test_a_template_cuts_what_is_long_and_keeps_what_was_rendered() -> None:
    table = Table(("a",), [[f"{i:05d}"] for i in range(2000)])
    html = environment().from_string("{{ text }}{{ table }}").render(text="x" * 100_000, table=table)
    assert "(100,000 characters)" in html
    assert html.count("<tr>") == 2001
    assert "&amp;lt;b&amp;gt;" in MARKDOWN(plain("&lt;b&gt;"))  # entities as they were recorded


def test_labels_of_pictures_take_long_texts() -> None:
    began = time.monotonic()
    label = fit_text("lift " * 20_000, 300, 15)
    assert text_width_px(label, 15) <= 300
    assert label.endswith("...")
    assert time.monotonic() - began < 5
    assert "\x1b" not in fit_text("a\x1b[31mb\nc", 300, 15)


def test_messages_show_control_characters_and_end() -> None:
    message = str(DataError("Bad \x1b[2J", where="a\u202eb", got="x" * 10**6, expected="c\x9b"))
    assert message.startswith("Bad \\x1b[2J\n  where: a\\u202eb\n")
    assert visible(message) == message
    assert len(message) < 2 * LONGEST
    assert "1,000,000 characters" in message
    key = "authorization: bearer "
    text = shown(key + "k" * (2 * LONGEST) + f" \x1b[2J {key}another-key-of-theirs")
    assert visible(text) == text
    assert len(text) < LONGEST
    assert not any(part in text for part in ("kkkk", "another-key"))


@pytest.mark.parametrize("url", URL_SECRETS)
def test_credentials_in_urls_are_refused_and_never_repeated(url: str, tmp_path: Path) -> None:
    assert "secret" not in str(DataError("x", got=f"failed: {url}, status 403"))
    (tmp_path / "c.yaml").write_text(f"sources: [{{kind: lerobot_v3, path: '{url}'}}]")
    for read in (
        lambda: parse_location(url),
        lambda: load_config(CurateConfig, path=tmp_path / "c.yaml"),
        lambda: VLMConfig(url=url),
    ):
        with pytest.raises((ConfigError, ValueError), match=r"credentials|a password or a key") as caught:
            read()
        assert "secret" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "Authorization: Bearer abcdef-secret", "{'authorization': 'Basic YWJj-secret'}", "x-api-key: abc-secret",
        "Incorrect API key provided: sk-abcdefghijklmnop-secret", "token hf_abcdefghijklmnopqrstuvwxyz0123-secret",
        "cloned with ghs_abcdefghijklmnop_secret", "remote: glpat-abcdefghijkl-secret is no token",
        "invalid_auth: xoxb-123456789012-secret", "key AIzaSyabcdefghijklm_secret not valid",
        "the token is value-of-the-environment-secret.",
    ],
)  # fmt: skip
def test_credentials_of_known_forms_and_of_the_environment_are_hidden(
    text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LAB_JUDGE_TOKEN", "value-of-the-environment-secret")
    assert "secret" not in shown(text)
    assert "***" in without_credentials(text)


@pytest.mark.parametrize(
    "text",
    [
        "s3://bucket/folder/x.mp4", "sftp://me@host/x", "hf://datasets/a/b@main", "token 3 of 12", "sk-learn",
        "https://host/x?page=2", "key: head, a key is given twice", "line one\n\tline two",
    ],
)  # fmt: skip
def test_plain_urls_and_words_stay(text: str) -> None:
    assert shown(text) == text


def test_logs_hide_credentials_for_every_handler_behind(capsys: pytest.CaptureFixture[str]) -> None:
    log_to_stderr()
    kept: list[str] = []
    behind = logging.Handler()
    behind.emit = lambda record: kept.append(record.getMessage())
    logging.getLogger().addHandler(behind)
    try:
        logging.getLogger("worldline_core.x").warning("%s: %s", URL_SECRETS[0], "a\x1b[2J")
    finally:
        logging.getLogger().removeHandler(behind)
        for name in ("worldline_core", "tasks", "flows"):
            logging.getLogger(name).handlers = []
    assert "secret" not in capsys.readouterr().err
    assert kept == ["s3://***@bucket/set: a\\x1b[2J"]


def test_an_unforeseen_error_is_printed_without_credentials() -> None:
    code = (
        "from tasks.execution.command_line import exit_with_clear_errors\n"
        "def fail(): raise RuntimeError('no answer from https://me:pw-secret@host/x, token token-secret-value')\n"
        "exit_with_clear_errors(fail)"
    )
    environment = os.environ | {"MY_TOKEN": "token-secret-value"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 1
    assert "RuntimeError: no answer from https://***@host/x, token ***" in done.stderr


@pytest.mark.parametrize(
    "full",
    [
        *(OSError(number, os.strerror(number), "/data/set.parquet") for number in (28, 122, 27)),
        SafetensorError("Error while serializing /data/set.parquet: No space left on device (os error 28)"),
    ],
    ids=["no space", "quota", "file size", "safetensors"],
)
def test_a_full_disk_ends_a_command_with_one_message(full: Exception, capsys: pytest.CaptureFixture[str]) -> None:
    def fail() -> None:
        raise full

    with pytest.raises(SystemExit):
        exit_with_clear_errors(fail)
    assert re.search(r"(?s)No space left.*/data/set\.parquet.*the same command continues", capsys.readouterr().err)


HALF = "lift \\ud800 the block"
"""Half of a surrogate pair, as JSON and YAML write it."""


def test_text_that_cannot_be_stored_costs_its_own_episode(
    dataset: Callable[[int], tuple[Path, CurateConfig]], video: Path, tmp_path: Path
) -> None:
    root, config = dataset(3)
    listed = root / "meta/episodes.jsonl"  # its texts are not read
    listed.write_text(listed.read_text().replace("lift", HALF.split(" the")[0]))
    with (root / "meta/tasks.jsonl").open("a") as tasks:
        tasks.write(f'{{"task_index": 7, "task": "{HALF}"}}\n')
    path = root / "data/chunk-000/episode_000002.parquet"
    rows = pq.read_table(path)
    pq.write_table(
        rows.set_column(rows.column_names.index("task_index"), "task_index", pa.array([7] * len(rows))), path
    )
    web = tmp_path / "web"
    web.mkdir()
    captions = {"good": b"push", "json": HALF.encode(), "bytes": b"push \xff"}
    for name in captions:
        shutil.copy(video, web / f"{name}.mp4")
    (web / "t.jsonl").write_bytes(
        b"\n".join(b'{"video": "%s.mp4", "caption": "%s"}' % (name.encode(), text) for name, text in captions.items())
    )
    table = {"kind": "video_folder", "path": str(web), "captions": {"file": "t.jsonl"}, "split": "test"}
    sources = [*config.model_dump()["sources"], table]
    counts = curate(CurateConfig.model_validate({"sources": sources}), {}, tmp_path / "out")
    assert counts["found"] == 6
    reasons = {row.episode_id: row.reason for row in read_quarantine(tmp_path / "out") if "duplicate" not in row.reason}
    assert reasons == dict.fromkeys(("set-000002", "web-json", "web-bytes"), "invalid_text")


@pytest.mark.parametrize(
    "field", ["instruction", "scene", "source", "bank", "primary_view", "state_names", "conventions", "views"]
)
def test_every_text_of_an_episode_is_checked_where_it_enters(field: str) -> None:
    half = json.loads(f'"{HALF}"')
    odd = {"state_names": (half,) * 14, "conventions": {"note": half}}.get(field, half)
    episode = make_sample(views=(), **({} if field == "views" else {field: odd}))[0]
    with pytest.raises(RejectedInputError, match=f"Text of {field} cannot be stored") as caught:
        LoadedEpisode(episode, (half,) if field == "views" else ("head",))
    assert (caught.value.reason, caught.value.evidence) == ("invalid_text", {"field": field})


@pytest.mark.parametrize(
    ("text", "match"),
    [
        *(
            (f"sources: [{{kind: video_folder, path: x, {half}}}]", "half of a surrogate pair")
            for half in ('name: "\\ud800"', 'license: "a \\udfff"', '"\\udcff": 1', 'scene: "\\ud83d"')
        ),
        *(
            (f"sources: [{{kind: video_folder, path: x}}]\n{value}", r"no numbers|valid number|valid integer")
            for value in ("fps: 1:30", "fps: true", "fps: 1:30.5", "stride: true", "image_size: [true, 64]", "image_size: [0:50, 64]")
        ),
    ],
)  # fmt: skip
def test_configurations_hold_no_half_characters_and_no_times_for_numbers(tmp_path: Path, text: str, match: str) -> None:
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(ConfigError, match=match):
        load_config(CurateConfig, path=tmp_path / "c.yaml")


def test_sources_hold_no_half_characters() -> None:
    for given in ({"path": "x", "scene": json.loads('"\\ud83d"')}, {"path": os.fsdecode(b"fold\xffer")}):
        with pytest.raises(ValueError, match="half of a surrogate pair"):
            VideoFolderSourceConfig(**given)
