"""The paper's ablations: what each variant changes, what all share, and the table beside the paper's numbers."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from flows.ablations import compare_variants
from tasks.execution.artifact_task import TaskCall
from tasks.execution.chain import outline
from worldline_core.config import CONFIG_ROOT, load_config
from worldline_core.errors import ArtifactError, ConfigError
from worldline_core.evaluation.scores import Score, summarise, write_scores
from worldline_core.pipeline.ablations import choose_variants, matched_length, tokens_a_step, variant_config
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.report.ablation_table import AblationTableConfig, Variant, ablation_table, load_variants
from worldline_core.store.atomic import write_json_atomic

VARIANTS = ("no_action_free", "head_only", "success_only", "native_film", "no_regularization")


def load(changes: Sequence[str] = (), preset: str = "smoke") -> PipelineConfig:
    return load_config(PipelineConfig, preset=preset, overrides=list(changes))


def variants_outline(*variants: str, **options: Any) -> dict[str, TaskCall]:
    return outline(compare_variants, partial(load, **options), choose_variants(variants or None))


@pytest.fixture(scope="module")
def calls() -> dict[str, TaskCall]:
    return variants_outline()


def test_what_variants_share_is_one_call(calls: dict[str, TaskCall]) -> None:
    trained = ["train_stage2", *(f"train_stage2.{name}" for name in VARIANTS)]
    assert [name for name in calls if name.startswith("train_stage2")] == trained
    shared = {
        "curate",
        "filter",
        "render_actions",
        "encode_latents",
        "train_stage1",
        "curate.banks",
        "render_actions.banks",
    }
    assert {name for name, call in calls.items() if call.task.name in {n.partition(".")[0] for n in shared}} == shared
    assert not any(name.startswith(("distill", "evaluate_policy", "report")) for name in calls)
    names = {f"{step}.{name}.0" for step in ("evaluate_video", "evaluate_planning") for name in ("full", *VARIANTS)}
    assert set(calls["ablation_table"].inputs) == names


def test_each_variant_changes_what_it_says_and_nothing_else(calls: dict[str, TaskCall]) -> None:
    full = calls["train_stage2"]

    def changed(variant: str) -> dict[str, object]:
        own, before = calls[f"train_stage2.{variant}"].config.model_dump(), full.config.model_dump()
        return {key: own.get(key) for key in own.keys() | before.keys() if own.get(key) != before.get(key)}

    assert changed("success_only") == {"outcomes": ("success",)}
    assert changed("native_film") == {"native_size": 32, "vector_share": 1.0}
    assert changed("no_regularization") == {"relational": None}
    assert changed("head_only") == {"clips": {**full.config.model_dump()["clips"], "view_weights": {"head": 1.0}}}
    assert set(changed("no_action_free")) == {"trainer"}
    # 2 steps of Stage I on one view beside 2 steps of Stage II on three: two thirds of a step more.
    assert changed("no_action_free")["trainer"]["steps"] == 3  # type: ignore[index]
    base = calls["train_stage2.no_action_free"].inputs["stage1"]
    assert isinstance(base, Path)
    assert base.name == "base"
    assert all(calls[f"train_stage2.{name}"].inputs["stage1"] is calls["train_stage1"] for name in VARIANTS[1:])
    assert calls["rollout.stage2.head_only"].config.model_dump()["views"] == ("head",)
    assert calls["evaluate_video.head_only"].config.model_dump()["views"] == ("head",)
    assert calls["rollout.stage2.native_film"].config == calls["rollout.stage2"].config


def test_start_models_are_compared_from_the_seeds_of_every_stage(project_root: Path) -> None:
    """Stage I is what the variant from nothing adds, and what the others do not have."""
    source = "curate.sources=[{kind: video_folder, path: x}]"
    variants = choose_variants(file=project_root / "configs/variants/start.yaml")
    found = {
        name: variant_config(lambda changes: PipelineConfig.load("my_robot", None, [source, *changes]), variant, 3)
        for name, variant in variants.items()
    }
    bases = {name: None if c.models.base is None else c.models.base.name for name, c in found.items()}
    assert bases == {"full": "stage2", "base": "base", "scratch": None}
    assert {name: c.train_stage2.trainer.seed for name, c in found.items()} == dict.fromkeys(found, 3)
    first = found.pop("scratch")
    assert first.train_stage1 is not None and (first.train_stage1.kind, first.train_stage1.trainer.seed) == ("base", 3)
    minutes = (first.train_stage1.trainer.minutes or 0) + (first.train_stage2.trainer.minutes or 0)
    assert {c.train_stage2.trainer.minutes for c in found.values()} == {minutes}
    assert all(c.train_stage1 is None for c in found.values())


def test_compute_is_matched_by_video_tokens() -> None:
    mixed = load(["train_stage2.clips={lengths: [17, 33], view_weights: {joint: 1, head: 1}, single_view_factor: 2}",
                  "train_stage1.trainer.steps=300", "train_stage2.trainer.steps=100"])  # fmt: skip
    assert mixed.train_stage1 is not None
    assert tokens_a_step(mixed.train_stage1, 3) == 2 * 9  # two clips of 9 latent frames
    assert tokens_a_step(mixed.train_stage2, 3) == 2 * 7 * 2.5  # of 5 or 9; three views, or twice as many clips of one
    assert matched_length(mixed) == f"steps={100 + round(300 * 18 / 35)}"


@pytest.mark.parametrize("preset", ["demo", "tiny", "cosmos3-nano"])
def test_every_preset_has_ablations(preset: str) -> None:
    expected = {f"{step}.{variant}" for step in ("train_stage2", "evaluate_video") for variant in VARIANTS}
    assert expected <= set(variants_outline(preset=preset))


def test_mistakes_are_named() -> None:
    with pytest.raises(ConfigError, match=r"(?s)Unknown ablation.*no_regularization.*got.*no_actions"):
        choose_variants(["no_actions"])
    with pytest.raises(ConfigError, match="predicts nothing with its own"):
        variant_config(lambda changes: load([*changes, "rollouts.stage2.checkpoint=causal"]), load_variants()["full"])
    with pytest.raises(ConfigError, match=r"train_stage1: without it Stage II starts from models\.base"):
        load(["train_stage1=null", "models.base=null"])


def test_the_paper_s_numbers_are_those_of_its_table(project_root: Path) -> None:
    file = Path(os.environ.get("WORLDLINE_SHARED", project_root.parent / "shared")) / "paper" / "results.json"
    if not file.is_file():
        pytest.skip(f"the paper's tables are not here (looked in {file})")
    table = json.loads(file.read_text())["ablations"]
    columns = ("held_out_lpips", "held_out_robot_iou", "ood_lpips", "ood_robot_iou", "success_pi05", "success_lingbot")
    for name, variant in load_variants().items():
        assert [variant.paper.get(column) for column in columns] == table[name], name
        for policy, direct in (("pi05", 58.9), ("lingbot", 41.0)):  # gains are over direct execution
            assert variant.paper[f"gain_{policy}"] == pytest.approx(variant.paper[f"success_{policy}"] - direct)


def evaluation(folder: Path, values: dict[str, float]) -> Path:
    scores = [Score("stage2", name, "arm", "test", "head", 42, "robot_iou", value) for name, value in values.items()]
    write_scores(folder, scores)
    summary = summarise(scores, resamples=200, seed=0)
    unavailable = {"lpips": "no folder configured"}
    write_json_atomic(folder / "summary.json", summary | {"methods": ["stage2"], "unavailable": unavailable})
    return folder


def table_rows(table: Path) -> dict[tuple[str, str], dict[str, Any]]:
    return {(row["variant"], row["column"]): row for row in pq.read_table(table).to_pylist()}


def test_the_table_shows_numbers_counts_intervals_and_reasons(tmp_path: Path) -> None:
    variants = {name: load_variants()[name] for name in ("full", "head_only", "success_only")}
    config = AblationTableConfig(variants=variants, resamples=200)
    good = {"a": 0.6, "b": 0.8, "c": 0.7}
    inputs = {
        "evaluate_video.full.0": evaluation(tmp_path / "full", good),
        "evaluate_video.head_only.0": evaluation(tmp_path / "head", {k: v - 0.1 for k, v in good.items()}),
        "evaluate_video.success_only.0": evaluation(tmp_path / "success", {"a": 0.5}),
    }
    planned = {"banks_stage2": {"budgets": {"8": {}, "32": {"banks": {"x": 1.0, "y": 0.5}}}}}
    banks = {"x": {"direct_success": 0.8}, "y": {"direct_success": 0.2}}
    write_json_atomic(tmp_path / "plan/summary.json", {"methods": planned, "banks": banks})
    counts = ablation_table(config, inputs | {"evaluate_planning.full.0": tmp_path / "plan"}, tmp_path / "out")
    assert (counts["cells"], counts["measured"]) == (24, 5)
    rows = table_rows(tmp_path / "out/table.parquet")
    full, head = rows["full", "held_out_robot_iou"], rows["head_only", "held_out_robot_iou"]
    assert (full["mean"], full["count"], full["paper"], full["difference"]) == (pytest.approx(0.7), 3, "0.5622", None)
    assert full["low"] < full["mean"] < full["high"]
    assert [head[key] for key in ("difference", "difference_low", "difference_high")] == pytest.approx([-0.1] * 3)
    assert rows["success_only", "held_out_robot_iou"]["difference"] == pytest.approx(-0.1)  # of the one in common
    assert {cell: rows[cell]["reason"] for cell in REASONS} == REASONS
    assert (rows["full", "success"]["mean"], rows["full", "success"]["paper"]) == (75.0, "78 / 62.4")
    assert rows["full", "gain"]["mean"] == pytest.approx(25.0)
    text = (tmp_path / "out/table.md").read_text()
    for part in ("| not measured (0.1804) | 0.700 [", "n=3 (0.5622)", "0.4348", "less the full model -0.100"):
        assert part in text
    with pytest.raises(ArtifactError, match=r"(?s)not those of the variants.*evaluate_video\.head_only"):
        ablation_table(config, {"evaluate_video.full.0": inputs["evaluate_video.full.0"]}, tmp_path / "few")


REASONS = {
    ("full", "held_out_lpips"): "no folder configured",
    ("head_only", "held_out_lpips"): "does not compare with the other rows",
    ("full", "ood_robot_iou"): "no recordings of the split ood_test",
    ("head_only", "gain"): "this run plans over no banks",
}


def test_every_variant_is_trained_with_every_seed_on_the_same_data(tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text("full: {label: all}\nnoise: {label: noise, changes: [train_stage2.sigma.shift=9]}\n")
    calls = outline(compare_variants, load, choose_variants(file=own), (3, 4))
    trainings = {name: call.config for name, call in calls.items() if call.task.name == "train_stage2"}
    assert {name: (c.trainer.seed, c.sigma.shift) for name, c in trainings.items()} == {
        "train_stage2.seed_3": (3, 1), "train_stage2.noise.seed_3": (3, 9),
        "train_stage2.seed_4": (4, 1), "train_stage2.noise.seed_4": (4, 9),
    }  # fmt: skip
    assert [name for name in calls if name.startswith("curate")] == ["curate.seed_3", "curate.banks.seed_3"]
    table = calls["ablation_table"]
    assert table.config.seeds == (3, 4)
    assert {"evaluate_video.full.3", "evaluate_video.noise.4"} <= set(table.inputs)
    own.write_text("noise: {label: noise}\n")
    with pytest.raises(ConfigError, match=r"(?s)own\.yaml.*full: first"):
        choose_variants(file=own)


def test_the_variants_of_one_card_train_what_they_say() -> None:
    calls = outline(compare_variants, load, choose_variants(file=CONFIG_ROOT / "variants" / "one_card.yaml"))
    trainings = [call.config for name, call in calls.items() if call.task.name == "train_stage2"]
    forms = [(c.lora and c.lora.rank, c.trainer.optimizer.moments, c.trainer.weights) for c in trainings]
    assert forms == [
        (None, "fp32", "fp32"), (16, "fp32", "fp32"), (64, "fp32", "fp32"), (16, "fp32", "fp32"), (None, "8bit", "fp32"), (None, "8bit", "bf16")
    ]  # fmt: skip


def test_an_interval_over_seeds_and_recordings_is_wider_than_over_recordings(tmp_path: Path) -> None:
    variants = {"full": Variant(label="all"), "less": Variant(label="less")}
    config = AblationTableConfig(variants=variants, seeds=(1, 2), resamples=400)
    inputs = {}
    for name, seed in product(variants, config.seeds):
        more = 0.1 * seed * (name == "full")
        values = {"a": 0.4 + more, "b": 0.5 + more, "c": 0.6 + more}
        inputs[f"evaluate_video.{name}.{seed}"] = evaluation(tmp_path / f"{name}{seed}", values)
    ablation_table(config, inputs, tmp_path / "out")
    rows = table_rows(tmp_path / "out/table.parquet")
    assert rows["full", "held_out_robot_iou"]["mean"] == pytest.approx(0.65)
    less = rows["less", "held_out_robot_iou"]
    # Differences are equal in all recordings: what is left is between the two seeds.
    found = (less["difference"], less["difference_low"], less["difference_high"])
    assert found == pytest.approx((-0.15, -0.2, -0.1))


@pytest.mark.slow
def test_all_five_run_on_the_smallest_preset(project_root: Path, tmp_path: Path) -> None:
    run = subprocess.run(
        [sys.executable, "-m", "flows.command_line", "ablations", "--preset", "smoke", "--artifacts", tmp_path],
        cwd=project_root, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stdout + run.stderr
    # Heading, rule and the full model besides.
    assert sum(line.startswith("| ") for line in run.stdout.splitlines()) == 3 + len(VARIANTS)
    for stage, count in (("train_stage2", 1 + len(VARIANTS)), ("train_stage1", 1)):
        assert len(list((tmp_path / stage).glob("*/checkpoint.json"))) == count
    (table,) = (tmp_path / "ablation_table").glob("*/table.parquet")
    rows = table_rows(table)
    for variant in ("full", *VARIANTS):
        assert rows[variant, "held_out_robot_iou"]["count"] == 2
        assert rows[variant, "success"]["count"] == 1
    assert rows["native_film", "held_out_robot_iou"]["difference"] is not None
