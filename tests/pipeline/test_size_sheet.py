"""`worldline plan`: every stage of a preset, its memory, and the setting that would fit."""

from __future__ import annotations

from pathlib import Path

import pytest

from flows.command_line import main
from worldline_core.config import load_config
from worldline_core.errors import ConfigError
from worldline_core.pipeline.memory_estimate import Estimate
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.pipeline.size_sheet import Machine, SizeSheet
from worldline_core.rollout.rollout_config import RolloutConfig

PROJECT = Path(__file__).parents[2]
STAGES = ["stage I", "stage II", "distill: teacher forcing", "distill: trajectory regression"]


def sheet(preset: str, *overrides: str, memory: str = "16GB", devices: int = 1) -> SizeSheet:
    config = load_config(PipelineConfig, preset=preset, overrides=overrides)
    return SizeSheet(config, PROJECT, Machine.model_validate({"devices": devices, "memory": memory}))


@pytest.mark.slow
def test_every_stage_of_a_small_preset_fits() -> None:
    rows = list(sheet("smoke").rows())
    assert [row.title for row, _ in rows if row.title in STAGES] == STAGES
    assert not any(setting for _, setting in rows)
    second = next(row for row, _ in rows if row.title == "stage II")
    assert second.parts["weights"] == 4 * second.parameters


def test_what_does_not_fit_ends_with_status_one_and_the_setting(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    need = Estimate("stage II", 7, {"weights": 3e9, "activations": 1e9})
    monkeypatch.setattr(SizeSheet, "rows", lambda _: iter([(need, "shorter clips")]))
    with pytest.raises(SystemExit, match="1"):
        main(["plan", "--preset", "smoke", "--gpus", "1", "--memory", "4GB"])
    printed = capsys.readouterr().out
    assert "| stage II | 0.0 M | 4.0 | weights 3.0, activations 1.0 | 0 | 0 |  | no: set shorter clips |" in printed


@pytest.mark.parametrize(
    "option", [["--card", "H900"], ["--memory", "much"], ["--gpus", "0"], ["--utilisation", "1.5"]]
)
def test_nonsense_is_refused(option: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises((ConfigError, SystemExit)) as error:
        main(["plan", "--preset", "smoke", *option])
    assert option[0].lstrip("-").replace("gpus", "devices") in f"{error.value}{capsys.readouterr().err}"


def test_distillation_from_frames_of_another_size_than_stage2s_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"\[64, 96\][\s\S]*\[480, 640\][\s\S]*distill\.input\.image_size"):
        load_config(PipelineConfig, preset="cosmos3-nano", overrides=["distill.input.kind=frames"])
    same = "distill.input={kind: frames, image_size: [480, 640]}"
    load_config(PipelineConfig, preset="cosmos3-nano", overrides=[same])


def test_a_rollout_that_does_not_fit_names_what_can_be_smaller() -> None:
    config = RolloutConfig.model_validate({"sampler": {"kind": "full_clip"}, "num_frames": 5})
    assert "num_frames" in sheet("smoke", memory="0.001GB").rollout("stage2", config)[1]


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("title", "parameters"),
    # Both towers of Cosmos3-Nano; student and fake score of the video tower, which takes most memory.
    [("stage I", (14e9, 15e9)), ("distill: distribution matching", (13.5e9, 14.5e9))],
)
def test_the_full_size_fits_cards_of_80_gb(title: str, parameters: tuple[float, float]) -> None:
    (training,) = (one for one in sheet("cosmos3-nano", devices=8).trainings() if one.title == title)
    need = training.estimate(8)
    assert parameters[0] < need.parameters < parameters[1]
    assert need.fits(80e9), need.describe_parts()
    assert training.estimate(64).total < need.total
