"""Model cards from the run's own artifacts: what the model is, and what evaluations of its rollouts measured."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from flows.command_line import main
from tests.report.conftest import write_planning_scores, write_video_scores  # pyright: ignore[reportMissingImports]
from worldline_core.errors import CheckpointError
from worldline_core.model.checkpoint import save_checkpoint
from worldline_core.model.model_card import model_facts
from worldline_core.report.report import ReportConfig, report
from worldline_core.report.results import evaluations_of_store, measurements
from worldline_core.store.artifact_files import read_manifest, write_manifest

KEY = "0123456789abcdef"


@pytest.fixture
def store(tmp_path: Path, make_model: Callable[..., Any], make_contract: Callable[..., Any]) -> Path:
    """A Stage II model, rollouts of it and of another one, and evaluations of both."""
    model = tmp_path / "train_stage2" / KEY
    facts = {
        "episodes": 53,
        "sources": {"shipped": 53},
        "step": 16,
        "seed": 0,
        "metrics": {"validation/loss": 0.94, "scale": 7},
    }
    save_checkpoint(model, make_model(), kind="stage2", action_contract=make_contract(), metadata=facts)
    write_manifest(model, {"step": "train_stage2", "key": KEY})
    digest = read_manifest(model)["digest"]
    for name, checkpoint in (
        ("stage2", digest),
        ("stage2_shuffled", digest),
        ("banks_shipped_causal", digest),
        ("causal", "0"),
    ):
        (tmp_path / "rollout" / name).mkdir(parents=True)
        inputs = {"checkpoint": {"path": f"train_stage2/{KEY}", "digest": checkpoint}}
        write_manifest(tmp_path / "rollout" / name, {"step": "rollout", "key": name, "inputs": inputs})
    for step, write in (("evaluate_video", write_video_scores), ("evaluate_planning", write_planning_scores)):
        folder = tmp_path / step / KEY
        folder.mkdir(parents=True)
        write(folder)
        inputs = {
            f"rollouts.{path.name}": {"path": f"rollout/{path.name}", "digest": "1"}
            for path in (tmp_path / "rollout").iterdir()
        }
        write_manifest(folder, {"step": step, "key": KEY, "inputs": inputs, "finished_at": "2026-11-26T00:00:00Z"})
    return tmp_path


def test_a_model_is_described_by_its_files(store: Path, project_root: Path) -> None:
    facts = model_facts(store / "train_stage2" / KEY)
    assert (facts["training recordings"], facts["steps"], facts["frames a second"]) == ("53", "16", "8")
    shipped = project_root / "artifacts" / "shipped" / "models"
    found = {name: model_facts(shipped / name) for name in ("causal", "tokenizer", "segmenter", "teacher")}
    assert found["causal"]["parameters"] == "3.59 M"
    assert found["causal"]["pixels"].split() == ["64", "x", "96"]
    assert (found["causal"]["steps of a block"], found["tokenizer"]["parameters"]) == ("1", "0.26 M")
    with pytest.raises(CheckpointError, match=r"(?s)No model here.*checkpoint\.json"):
        model_facts(store)


def test_figures_are_those_of_the_model_s_own_rollouts(store: Path) -> None:
    model, summary = (
        store / "train_stage2" / KEY,
        json.loads((store / f"evaluate_video/{KEY}/summary.json").read_text()),
    )
    found = {(m.what, m.recordings): m for m in measurements(model, evaluations_of_store(store))}
    exact = summary["metrics"]["test"]["stage2"][
        "robot_iou_exact@head"
    ]  # neither causal's nor that of shuffled actions
    iou = found["Robot IoU, exact, head view", "held-out scenes"]
    assert (iou.mean, iou.low, iou.high, iou.count) == tuple(exact[key] for key in ("mean", "low", "high", "count"))
    assert iou.source == f"evaluate_video/{KEY}"
    assert found["plans that succeed, best of 32", "candidate banks"].mean == pytest.approx(0.8)
    assert measurements(store / "rollout" / "stage2", evaluations_of_store(store)) == []


def test_the_command_and_the_report_write_the_same_card(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from huggingface_hub import ModelCard

    model = store / "train_stage2" / KEY
    main(["card", str(model), "--artifacts", str(store), "--license", "apache-2.0"])
    path = model / "run" / "card" / "README.md"
    assert str(path) in capsys.readouterr().out
    card = ModelCard.load(path)
    assert {
        r.metric_type
        for r in card.data.eval_results  # pyright: ignore[reportAttributeAccessIssue]
    } >= {"Robot IoU, exact, head view", "SSIM, head view"}
    assert "validation/loss: 0.94" in card.text
    assert "scale" not in card.text
    inputs = {"train_stage2": model, "evaluate_video": store / "evaluate_video" / KEY}
    report(ReportConfig(), inputs, tmp_path / "report")
    written = (tmp_path / "report" / "cards" / "train_stage2.md").read_text()
    row = next(
        line for line in card.text.splitlines() if line.startswith("| Robot IoU, exact, head view | held-out scenes")
    )
    assert row in written
    page = (tmp_path / "report" / "provenance.html").read_text()
    assert "Parameters" in page
    assert "Frames a second" in page
