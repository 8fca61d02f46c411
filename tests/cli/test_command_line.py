"""The console command: quick help, clear errors, exit codes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from flows.command_line import build_parser, main


def test_help_imports_nothing_heavy(project_root: Path) -> None:
    code = (
        "import sys\n"
        "from flows.command_line import build_parser\n"
        "build_parser().format_help()\n"
        "print(sorted({'torch', 'prefect', 'lerobot', 'diffusers', 'transformers', 'cv2', 'numpy'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], cwd=project_root, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_core_works_without_prefect(project_root: Path) -> None:
    code = (
        "import sys, importlib, pkgutil\n"
        "sys.modules['prefect'] = None\n"
        "from worldline_core.pipeline.steps import STEPS\n"
        "for step in STEPS.values():\n"
        "    step.load_function(), step.load_config()\n"
        "print('ok')"
    )
    result = subprocess.run([sys.executable, "-c", code], cwd=project_root, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout.strip()) == (0, "ok"), result.stderr


def test_importing_the_core_does_not_import_torch(project_root: Path) -> None:
    code = "import sys, worldline_core; print('torch' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], cwd=project_root, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "False"


def test_unknown_preset_ends_with_a_clear_error(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="1"):
        main(["task", "curate", "--preset", "tinny"])
    error = capsys.readouterr().err
    assert "Unknown preset" in error
    assert "did you mean 'tiny'" in error
    assert "Traceback" not in error


def test_unknown_override_ends_with_a_clear_error(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="1"):
        main(["task", "curate", "--preset", "tiny", "--set", "curate.image_sice=[64, 96]"])
    assert "curate" in (error := capsys.readouterr().err)
    assert "unknown key" in error


def test_missing_upstream_names_the_step_to_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="1"):
        main(["task", "filter", "--preset", "tiny", "--artifacts", str(tmp_path)])
    error = capsys.readouterr().err
    assert "filter needs artifacts that are not finished" in error
    assert "worldline task curate" in error


def test_wrong_input_name_lists_the_right_ones(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="1"):
        main(["task", "filter", "--preset", "tiny", "--artifacts", str(tmp_path), "--input", f"episode={tmp_path}"])
    assert "The inputs of filter do not fit" in capsys.readouterr().err


def test_every_step_is_a_subcommand_choice() -> None:
    arguments = build_parser().parse_args(["task", "train_stage2", "--set", "train_stage2.steps=3"])
    assert (arguments.step, arguments.overrides) == ("train_stage2", ["train_stage2.steps=3"])
