"""The console command: quick help, clear errors, exit codes."""

from __future__ import annotations

import json
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


def test_recordings_and_configurations_are_read_without_torch(project_root: Path) -> None:
    """A process that only curates, or only reads what it is told, is spared a second and a half."""
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "import worldline_core.data.curation.curate, worldline_core.filters.filter_config\n"
        "from worldline_core.pipeline.pipeline_config import PipelineConfig\n"
        "from worldline_core.pipeline.steps import STEPS\n"
        "print(len({step.load_config() for step in STEPS.values()}) == len(STEPS))"
    )
    result = subprocess.run([sys.executable, "-c", code], cwd=project_root, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout.strip()) == (0, "True"), result.stderr


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


@pytest.mark.parametrize(
    ("mistake", "message"),
    [
        (["--preset", "tinny"], "did you mean 'tiny'"),
        (["--set", "train_stage2.trainer.stepz=1"], "unknown key; did you mean 'steps'"),
    ],
)
def test_a_mistake_in_the_configuration_is_reported_before_prefect_starts(
    mistake: list[str], message: str, project_root: Path
) -> None:
    code = f"""
import sys
sys.modules.update(dict.fromkeys(["prefect", "torch"]))
from flows.command_line import main
for command in ("pipeline", "nightly"):
    try:
        main([command, *{mistake}])
    except SystemExit as ended:
        print(command, ended.code)
"""
    result = subprocess.run([sys.executable, "-c", code], cwd=project_root, capture_output=True, text=True, check=False)
    assert result.stdout.split() == ["pipeline", "1", "nightly", "1"], result.stderr
    assert result.stderr.count(message) == 2
    assert "Traceback" not in result.stderr


def test_a_missing_recording_is_named_before_prefect_starts(project_root: Path) -> None:
    code = """
import sys
sys.modules.update(dict.fromkeys(["prefect", "torch"]))
from flows.command_line import main
for command in ("pipeline", "nightly"):
    try:
        main([command, "--set", "curate.sources=[{kind: episode_set, path: nowhere}]"])
    except SystemExit as ended:
        print(command, ended.code)
"""
    result = subprocess.run([sys.executable, "-c", code], cwd=project_root, capture_output=True, text=True, check=False)
    assert result.stdout.split() == ["pipeline", "1", "nightly", "1"], result.stderr
    assert result.stderr.count("got: curate.sources[0].path: nowhere") == 2
    assert "Traceback" not in result.stderr


def test_missing_upstream_names_the_step_to_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="1"):
        main(["task", "filter", "--preset", "tiny", "--artifacts", str(tmp_path)])
    error = capsys.readouterr().err
    assert "filter needs artifacts that are not finished" in error
    assert "worldline task curate" in error


def test_the_named_step_to_run_is_a_command_that_works(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="1"):
        main(["task", "render_actions", "--node", "render_actions.banks", "--artifacts", str(tmp_path)])
    assert "run `worldline task curate --node curate.banks` with" in capsys.readouterr().err


def test_a_node_is_the_one_that_is_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of a step that a run has twice, `--node` chose the first one without a word: banks were never curated."""
    missing = tmp_path / "no_such_banks"
    changed = ["--set", f"curate_banks.sources=[{{kind: episode_set, path: {missing}, name: banks}}]"]
    with pytest.raises(SystemExit, match="1"):
        main(["task", "curate", "--node", "curate.banks", "--artifacts", str(tmp_path), *changed])
    said = capsys.readouterr().err
    assert str(missing) in said
    assert "sources[].path" in said


def test_a_node_of_another_step_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="1"):
        main(["task", "curate", "--node", "filter", "--artifacts", str(tmp_path)])
    error = capsys.readouterr().err
    assert "This run has no such node of curate" in error
    assert "curate.banks" in error


def test_an_input_is_fed_to_the_node_that_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="1"):
        arguments = ["--artifacts", str(tmp_path / "store"), "--input", f"episodes={tmp_path}"]
        main(["task", "render_actions", "--node", "render_actions.banks", *arguments])
    error = capsys.readouterr().err
    assert "not finished" not in error
    assert str(tmp_path) in error


def test_wrong_input_name_lists_the_right_ones(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="1"):
        main(["task", "filter", "--preset", "tiny", "--artifacts", str(tmp_path), "--input", f"episode={tmp_path}"])
    assert "The inputs of filter do not fit" in capsys.readouterr().err


def test_every_step_is_a_subcommand_choice() -> None:
    arguments = build_parser().parse_args(["task", "train_stage2", "--set", "train_stage2.steps=3"])
    assert (arguments.step, arguments.overrides) == ("train_stage2", ["train_stage2.steps=3"])


@pytest.mark.slow
def test_task_and_inspect_answer_scripts_in_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["task", "curate", "--preset", "smoke", "--artifacts", str(tmp_path), "--json"])
    artifact = json.loads(capsys.readouterr().out)
    assert artifact["metrics"]["found"] > 0
    assert (artifact["step"], artifact["cached"]) == ("curate", False)
    main(["inspect", artifact["path"], "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["kind"] == "EpisodeSet"
    assert all(Path(path).is_file() for path in found["written"])


def test_a_reader_that_ends_first_is_no_error(project_root: Path) -> None:
    code = "import sys; from flows.command_line import main; sys.argv[1:] = ['embodiment', 'list', '--json']; main()"
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, cwd=project_root, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None
        run.stdout.close()
        assert run.stderr is not None
        assert run.stderr.read() == ""
    assert run.returncode == 141
