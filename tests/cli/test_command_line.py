"""The console command: quick help, clear errors, exit codes."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from flows.command_line import main


def python(project_root: Path, code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], cwd=project_root, capture_output=True, text=True, check=False)


def test_help_imports_nothing_heavy(project_root: Path) -> None:
    code = """
import sys
from flows.command_line import build_parser
build_parser().format_help()
print(sorted({'torch', 'prefect', 'lerobot', 'diffusers', 'transformers', 'cv2', 'numpy'} & set(sys.modules)))
"""
    assert python(project_root, code).stdout.strip() == "[]"


@pytest.mark.slow
def test_recordings_configurations_and_their_mistakes_are_read_without_torch_and_prefect(project_root: Path) -> None:
    """Curation and the parsing of commands start seconds faster without these modules."""
    mistakes = {
        "did you mean 'tiny'": ["--preset", "tinny"],
        "unknown key; did you mean 'steps'": ["--set", "train_stage2.trainer.stepz=1"],
        "curate.sources[0].path: nowhere": ["--set", "curate.sources=[{kind: episode_set, path: nowhere}]"],
    }
    code = f"""
import sys
sys.modules.update(dict.fromkeys(["prefect", "torch"]))
import worldline_core.data.curation.curate, worldline_core.filters.filter_config
from flows.command_line import main
from tasks.execution.artifact_task import find_task, task_names
print(len({{find_task(name).load_config() for name in task_names()}}) == len(task_names()))
for mistake in {list(mistakes.values())}:
    for command in ("pipeline", "nightly"):
        try:
            main([command, *mistake])
        except SystemExit as ended:
            print(command, ended.code)
"""
    result = python(project_root, code)
    assert result.stdout.split() == ["True", *["pipeline", "1", "nightly", "1"] * 3], result.stderr
    assert {message: result.stderr.count(message) for message in mistakes} == dict.fromkeys(mistakes, 2)
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize(
    ("arguments", "facts"),
    [
        ("curate --preset tinny", ["did you mean 'tiny'"]),
        ("curate --preset tiny --set curate.image_sice=[64,96]", ["unknown key", "curate"]),
        ("filter --preset tiny", ["filter", "worldline task curate"]),
        ("filter --preset tiny --input episode={tmp}", ["filter", "episodes"]),
        # The named step to run is a command that works.
        ("render_actions --name render_actions.banks", ["`worldline task curate --name curate.banks`"]),
        ("curate --name filter", ["filter", "curate.banks"]),
        # An input that is given looks up the others all the same, and a file of one section none.
        ("train_stage1 --preset tiny --input episodes={tmp}", ["encode_latents", "an empty FOLDER"]),
        ("train_stage2 --preset tiny --input episodes={tmp} --input stage1={tmp}", ["render_actions, encode_latents"]),
        ("filter --config {tmp}/own.yaml", ["no sections models, curate", "give --input episodes=FOLDER, or begin"]),
        ("evaluate_video --config {tmp}/own.yaml", ["--input episodes=FOLDER --input rollouts.NAME=FOLDER"]),
        ("filter --name filter --config {tmp}/own.yaml", ["--input episodes=FOLDER and leave --name out"]),
        ("report --name report --config {tmp}/own.yaml", ["next step: leave --name out, or begin"]),
        ("curate", ["--config FILE", "--preset demo"]),
        # `--name` once chose the first of two calls of a step silently: banks were never curated.
        (
            "curate --name curate.banks --set 'curate_banks.sources=[{{kind: episode_set, path: {tmp}/none, name: banks}}]'",
            ["none", "sources[].path"],
        ),
    ],
)  # fmt: skip
def test_a_mistake_ends_with_a_clear_error(
    arguments: str, facts: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "own.yaml").write_text("filter: {min_segment_frames: 9}\n")
    with pytest.raises(SystemExit, match="1"):
        main(["task", *shlex.split(arguments.format(tmp=tmp_path)), "--artifacts", str(tmp_path / "store")])
    error = capsys.readouterr().err
    assert [fact for fact in facts if fact not in error] == []
    assert "Traceback" not in error


@pytest.mark.slow
def test_artifacts_are_listed_by_the_names_of_calls(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = "{kind: episode_set, path: artifacts/shipped/banks, include: [bank_lift_viperx-000]}"
    given = ["--artifacts", str(tmp_path), "--set", f"curate_banks.sources=[{source}]"]
    main(["task", "curate", "--name", "curate.banks", *given])
    capsys.readouterr()
    main(["list", *given])
    listed = {line.split()[0]: line.split()[1:] for line in capsys.readouterr().out.splitlines()}
    assert listed["rollout.shipped_stage2"] == ["not", "finished"]
    place = Path(listed["curate.banks"][0])
    assert place == tmp_path / "curate" / place.name
    assert (tmp_path / "latest" / "curate.banks").resolve() == place.resolve()


def test_a_reader_that_ends_first_is_no_error(project_root: Path) -> None:
    code = "import sys; from flows.command_line import main; sys.argv[1:] = ['embodiment', 'list']; main()"
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, cwd=project_root, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as run:
        run.stdout.close()
        assert run.stderr.read() == ""
    assert run.returncode == 141
