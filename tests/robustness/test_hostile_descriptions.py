"""Configurations (YAML) and robots (URDF, MJCF) that a stranger wrote: refused by name, in little time and memory."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from worldline_core.config import apply_overrides, load_config, read_yaml
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.errors import ConfigError, DataError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematic_tree import read_mjcf, read_urdf
from worldline_core.geometry.kinematics import ArmKinematics


def bomb(levels: int, one: Callable[[str], str]) -> str:
    lines = ["a0: &a0 [lol, lol]"] + [f"a{i}: &a{i} {one(f'*a{i - 1}')}" for i in range(1, levels)]
    return "\n".join([*lines, f"curate: {{sources: *a{levels - 1}}}\n"])


YAML = {
    "aliases": bomb(12, lambda name: "[" + ", ".join([name] * 10) + "]"),
    "aliases in mappings": bomb(12, lambda name: "{" + ", ".join(f"k{i}: {name}" for i in range(10)) + "}"),
    "an alias of itself": "a: &a [*a]\n", "deep lists": "a: " + "[" * 600 + "]" * 600,
    "deep mappings": "a: " + "{a: " * 600 + "1" + "}" * 600, "a key twice": "a: 1\na: 2\n",
    "a python object": "a: !!python/object/apply:os.system ['touch harmed']\n", "no date": "a: 2001-99-99\n",
    "no integer": "a: !!int x\n", "no number": "a: !!float x\n", "no time": "a: !!timestamp x\n", "no truth": "a: !!bool maybe\n",
    "an integer of 5000 digits": "a: " + "9" * 5000 + "\n", "a list as a key": "? [a]\n: 1\n",
    "a mapping as a key": "? {a: 1}\n: 1\n", "other bytes": "a: \udcff\udcfe\n", "a null byte": "a: \0\n",
}  # fmt: skip


@pytest.mark.parametrize("text", YAML.values(), ids=YAML)
def test_hostile_yaml_is_refused_by_name(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "x.yaml"
    path.write_bytes(os.fsencode(text))
    for read in (lambda: load_config(CurateConfig, path=path, section="curate"), lambda: load_embodiment(path)):
        began = time.monotonic()
        with pytest.raises(ConfigError, match=r"Not valid YAML|given twice"):
            read()
        assert time.monotonic() - began < 30
    assert not (tmp_path / "harmed").exists()


def test_aliases_and_merges_are_still_yaml(tmp_path: Path) -> None:
    (tmp_path / "x.yaml").write_text("a: &a {x: 1}\nb: *a\nc: {<<: *a, y: 2}\n")
    assert read_yaml(tmp_path / "x.yaml") == {"a": {"x": 1}, "b": {"x": 1}, "c": {"x": 1, "y": 2}}


@pytest.mark.parametrize("value", ["2001-99-99", "!!int x", "[\n" * 5000, "9" * 5000, "&x [*x]"])
def test_hostile_overrides_are_refused(value: str) -> None:
    with pytest.raises(ConfigError, match="not valid YAML"):
        apply_overrides({}, [f"a={value}"])


def test_a_mistake_in_a_long_file_is_told_in_few_words(tmp_path: Path) -> None:
    text = f"sources: [{', '.join(['{kind: nothing}'] * 400)}]\nname: {'x' * 10**6}"
    (tmp_path / "x.yaml").write_text(text)
    with pytest.raises(ConfigError, match=r"and \d+ more|characters") as caught:
        load_config(CurateConfig, path=tmp_path / "x.yaml")
    assert len(str(caught.value)) < 6000


def chain(links: int) -> str:
    parts = "".join(f"<link name='l{i}'/>" for i in range(links))
    joint = "<joint name='j{0}' type='revolute'><parent link='l{0}'/><child link='l{1}'/></joint>"
    return f"<robot name='x'>{parts}{''.join(joint.format(i, i + 1) for i in range(links - 1))}</robot>"


def urdf(inside: str) -> str:
    return f"<robot name='x'><link name='a'/><link name='b'/>{inside}</robot>"


_ENTITIES = "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 12))
URDF = {
    "entities": f"<!DOCTYPE r [<!ENTITY a0 'lol'>{_ENTITIES}]>" + urdf("<x y='&a11;'/>"),
    "a file as an entity": '<!DOCTYPE r [<!ENTITY a SYSTEM "file:///etc/passwd">]>' + urdf("&a;"),
    "a chain of 300 links": chain(300),
    "links without end": "<robot name='x'>" + "<link name='l'/>" * 100_000 + "</robot>",
    "one name for two joints": chain(3).replace("'j1'", "'j0'"),
    "an unknown encoding": "<?xml version='1.0' encoding='klingon'?>" + chain(2),
    "half a character": chain(2).replace("l1", "\ud800"),
    "a link that is not there": chain(5000).replace("<parent link='l0'/>", "<parent link='z'/>"),
    "a name of a million letters": urdf(f"<joint name='{'x' * 10**6}' type='odd'><parent link='a'/><child link='b'/></joint>"),
}  # fmt: skip
MJCF = {
    "bodies within bodies": "<worldbody>" + "<body>" * 20_000 + "</body>" * 20_000 + "</worldbody>",
    "defaults within defaults": "<worldbody/>" + "<default>" * 20_000 + "</default>" * 20_000,
    "bodies without end": "<worldbody>" + "<body/>" * 100_000 + "</worldbody>",
    "an unknown axis": "<compiler eulerseq='xqz'/><worldbody><body euler='1 2 3'/></worldbody>",
    "no number": "<worldbody><body><joint ref='x'/></body></worldbody>",
    "one name for two joints": "<worldbody><body><joint name='j'/></body><body><joint name='j'/></body></worldbody>",
}


@pytest.mark.parametrize(
    ("read", "text"),
    [(read_urdf, text) for text in URDF.values()] + [(read_mjcf, f"<mujoco>{text}</mujoco>") for text in MJCF.values()],
    ids=[*URDF, *MJCF],
)
def test_hostile_robots_are_refused_by_name(read: Callable[[str, str], object], text: str) -> None:
    began = time.monotonic()
    with pytest.raises(DataError, match=r"robot\.file") as caught:
        read(text, "robot.file")
    assert time.monotonic() - began < 10
    assert len(str(caught.value)) < 10_000


@pytest.mark.parametrize("inside", ['SYSTEM "file:///etc/passwd"', '[<!ENTITY % a SYSTEM "file:///etc/passwd"> %a;]'])
def test_entities_of_files_are_not_read(inside: str) -> None:
    assert [body.name for body in read_urdf(f"<!DOCTYPE r {inside}>" + chain(2), "x").walk()] == ["l0", "l1"]


def test_a_description_of_gigabytes_is_not_read(tmp_path: Path) -> None:
    large = tmp_path / "large.xml"
    with large.open("wb") as stream:
        stream.truncate(1 << 33)
    with pytest.raises(DataError, match="too large"):
        ArmKinematics(load_embodiment("ur5e_pair", large))
    large.write_bytes(b"<robot>\xff</robot>")
    with pytest.raises(DataError, match="not UTF-8"):
        ArmKinematics(load_embodiment("ur5e_pair", large))
