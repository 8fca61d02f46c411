"""The dataset card against the tables that it is made from, and against what the hub and browsers make of it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from worldline_core.config import validate
from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.episode_index import read_index
from worldline_core.data.episodes.episode_set import EpisodeSetWriter
from worldline_core.filters.filter import filter_episodes
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.pages.page import markdown
from worldline_core.report.data import DatasetFacts, write_card

HOSTILE = "<script>alert('x')</script> | *lift* `it`"


def recorded(number: int, name: str, room: int, **changes: Any) -> tuple[Episode, dict[str, np.ndarray]]:
    """Two dots that follow the joints, before the wall of a room."""
    rng, time = np.random.default_rng(number), np.arange(40) / 8
    state = np.stack([0.9 * np.sin(rng.uniform(0.5, 1.5) * time + rng.uniform(0, 6)) for _ in range(14)], 1)
    state[:, [6, 13]] = np.abs(state[:, [6, 13]])
    wall = np.random.default_rng(room).uniform(30, 170, (8, 12, 3)).astype(np.float32)
    frames = []
    for row in state:
        picture = cv2.resize(wall, (96, 64), interpolation=cv2.INTER_NEAREST)
        cv2.circle(picture, (int(48 + 45 * row[0]), int(32 + 30 * row[1])), 9, (250, 220, 220), -1)
        frames.append(picture.astype(np.uint8))
    values: dict[str, Any] = {
        "episode_id": name, "source": "made", "embodiment": "ur5e_pair", "scene": f"room {room}", "task_family": "lift",
        "instruction": "Lift the block.", "outcome": "success", "split": "train", "fps": 8.0,
        "state": state.astype(np.float32), "action": state.astype(np.float32), "timestamps": time,
        "state_names": tuple(f"{a}/{n}" for a in ("left", "right") for n in (*(f"j{i}" for i in range(6)), "gripper")),
    }  # fmt: skip
    return Episode(**(values | changes)), {"head": np.stack(frames)}


@pytest.fixture(scope="module")
def curated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sources: a duplicate, a broken episode, a leaking scene, a hostile instruction."""
    root = tmp_path_factory.mktemp("card")
    bad, frames = recorded(5, "bad", 1)
    bad.state[3, 2] = np.nan
    moved = recorded(8, "", 0)[0].state
    sources = {
        "kitchen": [recorded(n, f"k{n}", n % 2, outcome=("success", "failure")[n % 2]) for n in range(4)],
        "lab": [
            recorded(1, "copy", 1), (bad, frames), recorded(7, "hostile", 7, instruction=HOSTILE),
            recorded(0, "tested", 0, split="test", scene="hall", state=moved, action=moved),
        ],
    }  # fmt: skip
    listed = []
    for name, samples in sources.items():
        with EpisodeSetWriter(root / name, video_crf=8) as writer:
            for episode, images in samples:
                writer.add(episode, images)
        listed.append({"kind": "episode_set", "path": str(root / name), "name": name})
    listed[0] |= {"license": "CC-BY-4.0", "redistribution": "yes"}
    curate(validate(CurateConfig, {"sources": listed}, where="test"), {}, root / "curated")
    return root / "curated"


def table(text: str, heading: str) -> list[list[str]]:
    """Rows of the first Markdown table below a heading."""
    below = text.split(f"## {heading}\n", 1)[1]
    lines = re.findall(r"^\| (.*) \|$", below.split("\n\n## ")[0], flags=re.MULTILINE)
    return [re.split(r" (?<!\\)\| ", line) for line in lines if not set(line) <= set("-: |")]


def test_the_markdown_says_what_the_tables_say(curated: Path, tmp_path: Path) -> None:
    files = write_card(curated, tmp_path, title="A set")
    text = (tmp_path / "README.md").read_text()
    rows = read_index(curated)
    assert len(rows) == 6
    sources = {row[0]: row[1:] for row in table(text, "Sources and licences")[1:]}
    assert sources["kitchen"][:3] == ["4", "4", "20 s"]
    assert sources["kitchen"][-2:] == ["CC-BY-4.0", "yes"]
    assert sources["lab"][:2] == ["4", "2"]
    assert sources["lab"][-2:] == ["unknown", "unknown"]
    assert ["episodes found", "8"] in table(text, "From recordings to training")
    assert ["kept by curation", "6"] in table(text, "From recordings to training")
    assert {tuple(row[:3]) for row in table(text, "From recordings to training")} >= {
        ("curation", "duplicate", "1"),
        ("curation", "nan_state", "1"),
    }
    assert ["lift the block", "5"] in table(text, "Instructions")
    splits = {row[0]: row[1:] for row in table(text, "Splits")[1:]}
    assert splits["train"][:2] == ["3", "5"]
    assert splits["train"][3:] == ["3", "2", "0"]
    assert "1 pairs of scenes across the split look alike by their first images (room 0 and hall)" in text
    assert [path.name for path in files] == ["README.md", "source_00.jpg", "source_01.jpg"]
    for path in re.findall(r"\]\((\S+)\)", text):
        height, width, _ = cv2.imread(str(tmp_path / path)).shape
        assert height > 128
        assert width > 6 * 96


def test_the_hub_reads_the_header(curated: Path, tmp_path: Path) -> None:
    from huggingface_hub import DatasetCard

    write_card(curated, tmp_path, title="A: set")
    card = DatasetCard.load(tmp_path / "README.md")
    header = card.data.to_dict()
    assert header["pretty_name"] == "A: set"
    assert (header["license"], header["license_name"]) == ("other", "cc-by-4.0-and-unknown")
    assert header["tags"] == ["LeRobot", "WorldLine", "robotics", "ur5e_pair"]
    (config,) = header["configs"]
    assert list(curated.glob(config["data_files"]))


def test_recorded_text_cannot_break_the_card(curated: Path, tmp_path: Path) -> None:
    write_card(curated, tmp_path)
    text = (tmp_path / "README.md").read_text()
    assert "<script" not in markdown(text)
    assert not re.search(r"https?://", text)
    assert "\\<script\\>alert('x')\\</script\\> \\| \\*lift\\* \\`it\\`" in text
    assert all(len(row) == 2 for row in table(text, "Instructions"))


def test_equal_sets_give_equal_bytes_and_the_set_stays_as_it_is(curated: Path, tmp_path: Path) -> None:
    from worldline_core.store.artifact_files import digest_folder

    before = digest_folder(curated)
    write_card(curated, tmp_path / "one", "T")
    write_card(curated, tmp_path / "two", "T")
    assert digest_folder(tmp_path / "one") == digest_folder(tmp_path / "two")
    write_card(curated, curated / "run" / "card", "T")
    assert digest_folder(curated) == before


def test_a_filtered_set_shows_the_whole_way(curated: Path, tmp_path: Path) -> None:
    filtered = tmp_path / "filtered"
    filter_episodes(FilterConfig(), {"episodes": curated}, filtered)
    facts = DatasetFacts.read(filtered)
    funnel = {str(step): count for step, count in facts.funnel.rows}
    assert (funnel["episodes found"], funnel["kept by curation"]) == (8, 6)
    assert funnel["kept by the filters"] == len({row.episode_index for row in facts.rows})
    assert [facts.label for facts in facts.sources] == ["kitchen", "lab"]
    reasons = {(row[0], row[1]) for row in facts.reason_table.rows}
    assert ("curation", "nan_state") in reasons
    assert {("kept for Stage I only", "missing_view"), ("kept for Stage I only", "missing_calibration")} & reasons
    write_card(filtered, tmp_path / "card")
    assert "kept by the filters" in (tmp_path / "card" / "README.md").read_text()


def test_the_command_writes_beside_the_set_and_names_its_files(
    curated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from flows.command_line import main

    main(["card", str(curated), "--title", "T"])
    assert f"wrote {curated / 'run' / 'card' / 'README.md'}" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="1"):
        main(["card", str(tmp_path)])
