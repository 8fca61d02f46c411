"""Where kinematic descriptions are looked for: the caller, the environment, a Python package, beside the YAML."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import yaml

from worldline_core.errors import ConfigError, UnavailableError
from worldline_core.geometry.embodiment import load_embodiment, read_description

ARM = {"name": "right", "joints": ["pan"], "limits": [[-1.0, 1.0]], "end_effector_link": "hand"}
FILE = "toy_robots/models/toy.urdf"


def write(folder: Path, **description: object) -> Path:
    path = folder / "toy.yaml"
    values = {"format": "urdf", "package": "toy-robots", "file": FILE, **description}
    path.write_text(yaml.safe_dump({"name": "toy", "description": values, "base_link": "base", "arms": [ARM]}))
    return path


@pytest.fixture
def package(tmp_path, monkeypatch) -> Path:
    """An installed distribution toy-robots 1.2.0 with one description."""
    site = tmp_path / "site"
    (site / "toy_robots" / "models").mkdir(parents=True)
    (site / FILE).write_text("<robot name='packaged'/>")
    info = site / "toy_robots-1.2.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: toy-robots\nVersion: 1.2.0\n")
    monkeypatch.syspath_prepend(str(site))
    return site


@pytest.mark.parametrize("version", [None, ">=1.0,<2"])
def test_description_of_an_installed_package(package, tmp_path, version):
    path = write(tmp_path) if version is None else write(tmp_path, version=version)
    assert read_description(load_embodiment(path)) == "<robot name='packaged'/>"


def test_own_file_and_variable_go_before_the_package(package, tmp_path, monkeypatch):
    path, mine = write(tmp_path), tmp_path / "mine.urdf"
    mine.write_text("<robot name='mine'/>")
    assert "mine" in read_description(load_embodiment(path, mine))
    monkeypatch.setenv("WORLDLINE_DESCRIPTION_TOY", str(mine))
    assert "mine" in read_description(load_embodiment(path))


def test_package_that_is_not_installed_is_named(tmp_path):
    assert not any("toy_robots" in entry for entry in sys.path)
    with pytest.raises(UnavailableError, match=r"not here[\s\S]*pip install 'toy-robots>=1.0'$"):
        read_description(load_embodiment(write(tmp_path, version=">=1.0")))


def test_other_version_of_the_package_is_refused(package, tmp_path):
    with pytest.raises(UnavailableError, match=r"another version[\s\S]*>=2[\s\S]*1\.2\.0[\s\S]*pip install"):
        load_embodiment(write(tmp_path, version=">=2"))


def test_package_without_the_file_is_refused(package, tmp_path):
    with pytest.raises(ConfigError, match=r"no such kinematic description[\s\S]*toy-robots 1\.2\.0[\s\S]*other\.urdf"):
        load_embodiment(write(tmp_path, file="toy_robots/models/other.urdf"))


def test_link_out_of_the_package_is_refused(package, tmp_path):
    (tmp_path / "secret.urdf").write_text("<robot/>")
    (package / "toy_robots" / "models" / "link.urdf").symlink_to(tmp_path / "secret.urdf")
    with pytest.raises(ConfigError, match="outside of its package"):
        load_embodiment(write(tmp_path, file="toy_robots/models/link.urdf"))


@pytest.mark.parametrize("file", ["../secret.urdf", "toy_robots/../../secret.urdf", "/etc/passwd", "toy.urdf"])
def test_path_that_is_not_inside_the_package_is_refused(tmp_path, file):
    with pytest.raises(ConfigError, match="not a path inside the package"):
        load_embodiment(write(tmp_path, file=file))


def test_version_without_package_or_not_a_specifier_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="no version specifier"):
        load_embodiment(write(tmp_path, version="one"))
    with pytest.raises(ConfigError, match="there is no package"):
        load_embodiment(write(tmp_path, package=None, version=">=1"))


def test_unknown_key_of_the_description_is_an_error(tmp_path):
    with pytest.raises(ConfigError, match=r"description\.pakage: unknown key; did you mean 'package'"):
        load_embodiment(write(tmp_path, pakage="toy-robots"))
