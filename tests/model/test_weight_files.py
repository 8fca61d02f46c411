"""Weights in several files: the same tensors, and every way in which they can be incomplete is named."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from worldline_core.errors import CheckpointError
from worldline_core.model import checkpoint
from worldline_core.model.checkpoint import (
    load_checkpoint,
    read_checkpoint_info,
    read_weights,
    save_checkpoint,
    write_weights,
)
from worldline_core.model.world_model import WorldModel

INDEX = "model.safetensors.index.json"


@pytest.fixture
def folder(tmp_path: Path, make_model: Callable[..., WorldModel], monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(checkpoint, "MAX_SHARD_BYTES", 8_000)
    save_checkpoint(tmp_path / "c", make_model(), kind="base", action_contract=None)
    return tmp_path / "c"


def shards(folder: Path) -> list[Path]:
    return sorted(folder.glob("model-*.safetensors"))


def test_several_files_hold_what_one_would(
    folder: Path, tmp_path: Path, make_model: Callable[..., WorldModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert len(shards(folder)) > 2
    assert not (folder / "model.safetensors").exists()
    index = json.loads((folder / INDEX).read_text())
    assert set(index["weight_map"]) == set(make_model().state_dict())
    for tensors in map(load_file, shards(folder)):
        assert len(tensors) == 1 or sum(tensor.nbytes for tensor in tensors.values()) <= 8_000
    save_checkpoint(tmp_path / "again", make_model(), kind="base", action_contract=None)
    for path in folder.iterdir():
        assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes()
    monkeypatch.undo()
    save_checkpoint(tmp_path / "one", make_model(), kind="base", action_contract=None)
    assert [path.name for path in (tmp_path / "one").iterdir() if path.suffix == ".safetensors"] == [
        "model.safetensors"
    ]
    whole, sharded = (load_checkpoint(path)[0].state_dict() for path in (tmp_path / "one", folder))
    assert all(torch.equal(whole[name], sharded[name]) for name in whole)
    assert read_checkpoint_info(folder).weights_sha256 == hashlib.sha256((folder / INDEX).read_bytes()).hexdigest()


def test_a_smaller_write_leaves_no_file_of_a_larger_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tensors = {name: torch.full((8,), float(number)) for number, name in enumerate("abc")}
    for most, files in ((40, 4), (96, 1), (80, 3)):
        monkeypatch.setattr(checkpoint, "MAX_SHARD_BYTES", most)
        write_weights(tmp_path / "w.safetensors", tensors, torch.float32)
        assert len(list(tmp_path.iterdir())) == files
    assert read_weights(tmp_path / "w.safetensors", None)["c"].tolist() == [2.0] * 8


def test_a_truncated_or_missing_file_is_named(folder: Path) -> None:
    path = shards(folder)[1]
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(CheckpointError, match=rf"(?s)not those that are described.*{path.name}"):
        load_checkpoint(folder)
    path.unlink()
    with pytest.raises(
        CheckpointError, match=rf"(?s)weight file is missing.*{shards(folder)[0].name[:5]}.*fetch the folder"
    ):
        load_checkpoint(folder)


@pytest.mark.parametrize("kept", [0, 7, 100, -1])
def test_a_truncated_file_whose_digest_nobody_states_is_named(kept: int, tmp_path: Path) -> None:
    """As other projects write them: their index says which tensor is where, and no digest."""
    save_file({"a": torch.ones(64)}, tmp_path / "w-1.safetensors")
    (tmp_path / "w.safetensors.index.json").write_text(json.dumps({"weight_map": {"a": "w-1.safetensors"}}))
    assert read_weights(tmp_path / "w.safetensors", None)["a"].sum() == 64
    content = (tmp_path / "w-1.safetensors").read_bytes()
    (tmp_path / "w-1.safetensors").write_bytes(content[:kept])
    with pytest.raises(CheckpointError, match=r"(?s)weights file is damaged.*w-1"):
        read_weights(tmp_path / "w.safetensors", None)


@pytest.mark.parametrize(
    "name",
    ["../secret.safetensors", "/etc/secret.safetensors", "a/b.safetensors", "..", "", "a\\b.safetensors", "model.bin"],
)
def test_an_index_that_names_files_outside_of_the_folder_is_refused(name: str, tmp_path: Path) -> None:
    save_file({"a": torch.ones(2)}, tmp_path / "secret.safetensors")
    root = tmp_path / "w"
    root.mkdir()
    (root / "w.safetensors.index.json").write_text(json.dumps({"weight_map": {"a": name}}))
    with pytest.raises(CheckpointError, match="something else than a file of its folder"):
        read_weights(root / "w.safetensors", None)


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"weight_map": []}', '{"weight_map": {}, "metadata": 3}', "[" * 100_000]
)
def test_a_damaged_index_is_named(text: str, tmp_path: Path) -> None:
    (tmp_path / "w.safetensors.index.json").write_text(text)
    with pytest.raises(CheckpointError, match="index of weights is damaged"):
        read_weights(tmp_path / "w.safetensors", None)


def test_an_index_that_disagrees_with_its_files_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint, "MAX_SHARD_BYTES", 40)
    write_weights(tmp_path / "w.safetensors", {name: torch.ones(8) for name in "ab"}, torch.float32)
    index = tmp_path / "w.safetensors.index.json"
    content = json.loads(index.read_text())
    content["weight_map"]["c"] = content["weight_map"].pop("a")
    index.write_text(json.dumps(content))
    with pytest.raises(CheckpointError, match=r"(?s)disagree.*missing \['c'\], others \['a'\]"):
        read_weights(tmp_path / "w.safetensors", None)


def test_an_index_that_was_changed_is_noticed(folder: Path) -> None:
    first, second = shards(folder)[:2]
    tensors = load_file(second)
    save_file({name: tensor + 1 for name, tensor in tensors.items()}, second)
    content = json.loads((folder / INDEX).read_text())
    content["metadata"]["sha256"][second.name] = hashlib.sha256(second.read_bytes()).hexdigest()
    (folder / INDEX).write_text(json.dumps(content))
    assert first.is_file()
    with pytest.raises(CheckpointError, match=rf"(?s)not those that are described.*{INDEX}"):
        load_checkpoint(folder)
