"""Models from a folder and from a hub: the same model, safetensors and JSON alone, clear words where there is none."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from flows.command_line import main
from tests.hub.conftest import Hub, Repository, files_of
from worldline_core import WorldLine
from worldline_core.errors import CheckpointError, UnavailableError
from worldline_core.model.checkpoint import load_checkpoint, save_checkpoint
from worldline_core.model.pretrained import pretrained_folder
from worldline_core.store.artifact_files import write_manifest


@pytest.fixture
def folder(tmp_path: Path, make_model: Callable[..., Any], make_contract: Callable[..., Any]) -> Path:
    facts = {"episodes": 3, "sources": {"agibot": 2, "galaxea": 1}, "step": 20, "seed": 0, "metrics": {"loss": 0.25}}
    path = tmp_path / "model"
    save_checkpoint(path, make_model(), kind="stage2", action_contract=make_contract(), metadata=facts)
    return path


def publish(hub: Hub, folder: Path, name: str = "ORG/NAME") -> Repository:
    hub.repositories[name] = Repository(private=True, files=files_of(folder))
    return hub.repositories[name]


@pytest.mark.parametrize("absolute", [False, True])
def test_the_card_reads_nothing_outside_of_the_store(tmp_path: Path, folder: Path, absolute: bool) -> None:
    outside, trained = tmp_path / "outside", tmp_path / "store" / "train_stage2" / "0"
    outside.mkdir()
    (outside / "sources.json").write_text(
        '[{"label": "private", "kind": "lerobot_v3", "license": "secret", "redistribution": "no", "names": ["private"],'
        ' "found": 2, "kept": 2, "reasons": {}, "image_size": null, "fps": null, "stride": null, "conventions": {}}]'
    )
    trained.parent.mkdir(parents=True)
    folder.rename(trained)
    place = str(outside) if absolute else "../outside"
    write_manifest(trained, {"step": "train_stage2", "inputs": {"episodes": {"path": place, "digest": "1"}}})
    main(["card", str(trained)])
    assert "private" not in (trained / "run" / "card" / "README.md").read_text()


def test_the_hub_gives_the_same_model_and_nothing_that_could_run(hub: Hub, folder: Path) -> None:
    (folder / "pytorch_model.bin").write_bytes(b"\x80\x04cos\nsystem\n")
    (folder / "modeling.py").write_text("raise SystemExit")
    publish(hub, folder)
    found = pretrained_folder("ORG/NAME")
    assert sorted(path.name for path in found.iterdir()) == ["checkpoint.json", "model.safetensors"]
    model, here = load_checkpoint(found)[0], load_checkpoint(folder)[0]
    assert all(torch.equal(value, here.state_dict()[name]) for name, value in model.state_dict().items())
    assert hub.tokens == {"hf_test"}
    assert not any(path.endswith((".bin", ".py")) for _, path in hub.requests if "resolve" in path)
    with pytest.raises(CheckpointError, match="tokenizer is not here"):
        WorldLine.from_pretrained("ORG/NAME")


def test_a_repository_with_its_tokenizer_predicts(hub: Hub, project_root: Path) -> None:
    models = project_root / "artifacts" / "shipped" / "models"
    causal = {
        name: ((models / "causal" / name).read_bytes(), True) for name in ("checkpoint.json", "model.safetensors")
    }
    tokenizer = {f"tokenizer/{name}": file for name, file in files_of(models / "tokenizer", lfs=True).items()}
    hub.repositories["ORG/NAME"] = Repository(private=False, files=causal | tokenizer)
    world, here = WorldLine.from_pretrained("ORG/NAME"), WorldLine.from_pretrained(models / "causal")
    assert (world.info, world.causal) == (here.info, here.causal)


def test_without_the_hub_the_cache_serves(
    hub: Hub, folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    publish(hub, folder)
    with pytest.raises(UnavailableError, match=r"(?s)ORG/OTHER.*check the name"):
        pretrained_folder("ORG/OTHER")
    pretrained_folder("ORG/NAME")
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    pretrained_folder("ORG/NAME")  # of the local cache
    with pytest.raises(UnavailableError, match=r"(?s)ORG/UNSEEN.*offline"):
        pretrained_folder("ORG/UNSEEN")
    for name in (tmp_path / "nothing", "three/part/name"):
        with pytest.raises(CheckpointError, match="No model here"):
            pretrained_folder(name)
