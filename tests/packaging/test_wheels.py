"""The wheels alone, in an empty folder: presets, embodiments and shipped files are found without a checkout."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def installed(project_root: Path, uv: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with both wheels unpacked, as an installation would have them."""
    built = tmp_path_factory.mktemp("wheels")
    for source in (".", "packaging/assets"):
        subprocess.run([uv, "build", "-q", "--wheel", "-o", built, source], cwd=project_root, check=True)
    wheels = sorted(built.glob("*.whl"))
    assert [wheel.name.split("-")[0] for wheel in wheels] == ["worldline", "worldline_assets"]
    site = tmp_path_factory.mktemp("site")
    for wheel in wheels:
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(site)  # built just now
    for name in ("flows", "tasks"):  # a user's packages of these names
        (site / name).mkdir()
        (site / name / "__init__.py").write_text("raise RuntimeError('not of this project')")
    return site


def _worldline(installed: Path, folder: Path, *arguments: str) -> str:
    # -P and the order of PYTHONPATH keep the checkout out of sight.
    code = "import sys; from importlib.metadata import entry_points; entry_points(group='console_scripts')['worldline'].load()()"
    result = subprocess.run(
        [sys.executable, "-P", "-c", code, *arguments],
        cwd=folder, env={**os.environ, "PYTHONPATH": str(installed)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.mark.slow
def test_an_empty_folder_is_enough(installed: Path, tmp_path: Path) -> None:
    assert (installed / "worldline_core" / "py.typed").is_file()
    findings = {row["name"]: row for row in json.loads(_worldline(installed, tmp_path, "doctor", "--json"))}
    assert findings["weights causal"]["found"] == str(installed / "worldline_assets/shipped/models/causal")
    assert "aloha_viperx" in _worldline(installed, tmp_path, "embodiment", "list")
    for step in ("curate", "filter", "render_actions"):
        assert "built" in _worldline(installed, tmp_path, "task", step, "--preset", "smoke")
    made = _worldline(installed, tmp_path, "task", "rollout", "--preset", "smoke", "--name", "rollout.copy_first_frame")
    assert Path(made.split()[0], "manifest.json").is_file()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["artifacts"]
    loaded = "from prefect.flows import load_flow_from_entrypoint as load; print(load('worldline.workflows.flows.pipeline:pipeline').name)"
    for arguments, said in (
        (["-c", loaded], "pipeline"),
        (["-m", "worldline.workflows.tasks.filter", "--help"], "segments"),
    ):
        result = subprocess.run(
            [sys.executable, "-P", *arguments],
            cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(installed)}, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert said in result.stdout, result.stderr
