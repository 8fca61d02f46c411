"""Cards of datasets and models, against the files that they are made from and against what the hub makes of them."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from flows.command_line import main
from tests.report.conftest import write_planning_scores, write_video_scores  # pyright: ignore[reportMissingImports]
from worldline_core.config import validate
from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.episode_index import read_index
from worldline_core.data.episodes.episode_set import EpisodeSetWriter
from worldline_core.errors import CheckpointError
from worldline_core.filters.filter import filter_episodes
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.model.checkpoint import save_checkpoint
from worldline_core.model.model_card import model_facts
from worldline_core.report.data import DatasetFacts, write_card
from worldline_core.report.report import ReportConfig, report
from worldline_core.report.results import evaluations_of_store, measurements
from worldline_core.store.artifact_files import digest_folder, read_manifest, write_manifest

HOSTILE = "<script>alert('x')</script> | *lift* `it`"


def recorded(number: int, name: str, room: int, **changes: Any) -> tuple[Episode, dict[str, np.ndarray]]:
    """Two dots that follow the joints, before the wall of a room."""
    rng, time = np.random.default_rng(number), np.arange(40) / 8
    state = np.stack([0.9 * np.sin(rng.uniform(0.5, 1.5) * time + rng.uniform(0, 6)) for _ in range(14)], 1)
    state[:, [6, 13]] = np.abs(state[:, [6, 13]])
    wall = np.random.default_rng(room).uniform(30, 170, (8, 12, 3)).repeat(8, 0).repeat(8, 1).astype(np.uint8)
    frames = np.tile(wall, (40, 1, 1, 1))
    for frame, row in zip(frames, state, strict=True):
        cv2.circle(frame, (int(48 + 45 * row[0]), int(32 + 30 * row[1])), 9, (250, 220, 220), -1)
    values: dict[str, Any] = {
        "episode_id": name, "source": "made", "embodiment": "ur5e_pair", "scene": f"room {room}", "task_family": "lift",
        "instruction": "Lift the block.", "outcome": "success", "split": "train", "fps": 8.0,
        "state": state.astype(np.float32), "action": state.astype(np.float32), "timestamps": time,
        "state_names": tuple(f"{a}/{n}" for a in ("left", "right") for n in (*(f"j{i}" for i in range(6)), "gripper")),
    }  # fmt: skip
    return Episode(**(values | changes)), {"head": frames}


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
    write_card(curated, tmp_path, title="A set")
    text = (tmp_path / "README.md").read_text()
    assert len(read_index(curated)) == 6
    sources = {row[0]: row[1:] for row in table(text, "Sources and licences")[1:]}
    assert (sources["kitchen"][:3], sources["kitchen"][-2:]) == (["4", "4", "20 s"], ["CC-BY-4.0", "yes"])
    assert (sources["lab"][:2], sources["lab"][-2:]) == (["4", "2"], ["unknown", "unknown"])
    funnel = {tuple(row) for row in table(text, "From recordings to training")}
    assert {("episodes found", "8"), ("kept by curation", "6")} <= funnel
    assert {row[:3] for row in funnel} >= {("curation", "duplicate", "1"), ("curation", "nan_state", "1")}
    splits = {row[0]: row[1:] for row in table(text, "Splits")[1:]}
    assert (splits["train"][:2], splits["train"][3:]) == (["3", "5"], ["3", "2", "0"])
    assert "1 pairs of scenes across the split look alike by their first images (room 0 and hall)" in text


def test_the_hub_reads_the_header_and_recorded_text_cannot_break_the_card(curated: Path, tmp_path: Path) -> None:
    from huggingface_hub import DatasetCard

    write_card(curated, tmp_path, title="A: set")
    card = DatasetCard.load(tmp_path / "README.md")
    header = card.data.to_dict()
    assert header["pretty_name"] == "A: set"
    assert (header["license"], header["license_name"]) == ("other", "cc-by-4.0-and-unknown")
    assert header["tags"] == ["LeRobot", "WorldLine", "robotics", "ur5e_pair"]
    (config,) = header["configs"]
    assert list(curated.glob(config["data_files"]))
    assert not re.search(r"https?://", card.text)


def test_equal_sets_give_equal_bytes_and_the_set_stays_as_it_is(
    curated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = digest_folder(curated)
    for name in ("one", "two"):
        write_card(curated, tmp_path / name, "T")
    main(["card", str(curated), "--title", "T"])
    written = curated / "run" / "card"
    assert f"wrote {written / 'README.md'}" in capsys.readouterr().out
    assert digest_folder(tmp_path / "one") == digest_folder(tmp_path / "two") == digest_folder(written)
    assert digest_folder(curated) == before
    with pytest.raises(SystemExit, match="1"):
        main(["card", str(tmp_path)])


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


KEY = "0123456789abcdef"


@pytest.fixture(scope="module")
def store(
    tmp_path_factory: pytest.TempPathFactory, make_model: Callable[..., Any], make_contract: Callable[..., Any]
) -> Path:
    """A Stage II model, rollouts of it and of another one, and evaluations of both."""
    root = tmp_path_factory.mktemp("store")
    model = root / "train_stage2" / KEY
    metrics = {"validation/loss": 0.94, "scale": 7}
    facts = {"episodes": 53, "sources": {"shipped": 53}, "step": 16, "seed": 0, "metrics": metrics}
    save_checkpoint(model, make_model(), kind="stage2", action_contract=make_contract(), metadata=facts)
    write_manifest(model, {"step": "train_stage2", "key": KEY})
    own = read_manifest(model)["digest"]
    digests = {"stage2": own, "stage2_shuffled": own, "banks_shipped_causal": own, "causal": "0"}
    for name, digest in digests.items():
        (root / "rollout" / name).mkdir(parents=True)
        inputs = {"checkpoint": {"path": f"train_stage2/{KEY}", "digest": digest}}
        write_manifest(root / "rollout" / name, {"step": "rollout", "key": name, "inputs": inputs})
    inputs = {f"rollouts.{name}": {"path": f"rollout/{name}", "digest": "1"} for name in digests}
    for step, write in (("evaluate_video", write_video_scores), ("evaluate_planning", write_planning_scores)):
        folder = root / step / KEY
        folder.mkdir(parents=True)
        write(folder)
        write_manifest(folder, {"step": step, "key": KEY, "inputs": inputs, "finished_at": "2026-11-26T00:00:00Z"})
    return root


def test_a_model_is_described_by_its_files(store: Path, project_root: Path) -> None:
    facts = model_facts(store / "train_stage2" / KEY)
    assert (facts["training recordings"], facts["steps"], facts["frames a second"]) == ("53", "16", "8")
    shipped = project_root / "artifacts" / "shipped" / "models"
    causal, tokenizer, *_ = (model_facts(shipped / name) for name in ("causal", "tokenizer", "segmenter", "teacher"))
    assert (causal["parameters"], causal["steps of a block"], tokenizer["parameters"]) == ("3.59 M", "1", "0.26 M")
    assert causal["pixels"].split() == ["64", "x", "96"]
    with pytest.raises(CheckpointError, match=r"(?s)No model here.*checkpoint\.json"):
        model_facts(store)


def test_figures_are_those_of_the_model_s_own_rollouts(store: Path) -> None:
    summary = json.loads((store / f"evaluate_video/{KEY}/summary.json").read_text())
    exact = summary["metrics"]["test"]["stage2"]["robot_iou_exact@head"]  # neither causal's nor of shuffled actions
    evaluations = evaluations_of_store(store)
    found = {(m.what, m.recordings): m for m in measurements(store / "train_stage2" / KEY, evaluations)}
    iou = found["Robot IoU, exact, head view", "held-out recordings"]
    assert (iou.mean, iou.low, iou.high, iou.count) == tuple(exact[key] for key in ("mean", "low", "high", "count"))
    assert iou.source == f"evaluate_video/{KEY}"
    assert found["plans that succeed, best of 32", "candidate banks"].mean == pytest.approx(0.8)
    assert measurements(store / "rollout" / "stage2", evaluations) == []


def test_the_command_and_the_report_write_the_same_card(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from huggingface_hub import ModelCard

    model = store / "train_stage2" / KEY
    main(["card", str(model), "--artifacts", str(store), "--license", "apache-2.0"])
    path = model / "run" / "card" / "README.md"
    assert str(path) in capsys.readouterr().out
    card = ModelCard.load(path)
    results: Any = card.data.eval_results
    assert {result.metric_type for result in results} >= {"Robot IoU, exact, head view", "SSIM, head view"}
    assert "validation/loss: 0.94" in card.text
    assert "scale" not in card.text
    inputs = {"train_stage2": model, "evaluate_video": store / "evaluate_video" / KEY}
    report(ReportConfig(), inputs, tmp_path / "report")
    written = (tmp_path / "report" / "cards" / "train_stage2.md").read_text()
    (row,) = re.findall(r"(?m)^\| Robot IoU, exact, head view \| held-out recordings.*$", card.text)
    assert row in written
    assert "Parameters" in (tmp_path / "report" / "provenance.html").read_text()
