"""Checkpoints are written reproducibly and read strictly."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from worldline_core.errors import CheckpointError
from worldline_core.model.checkpoint import load_checkpoint, read_checkpoint_info, save_checkpoint
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import ActionContract, CausalSpec, WorldModelConfig

CONTRACT = ActionContract(controls="action", fps=8.0, sigma_px_ref=10.0, grid_size=(8, 12), tokenizer="0123")


def build(**changes: object) -> WorldModel:
    values: dict[str, object] = {
        "latent_channels": 4, "hidden_size": 12, "num_layers": 2, "num_heads": 2, "num_kv_heads": 1, "head_dim": 12,
        "intermediate_size": 16, "rope_sections": (2, 2, 2), "vocab_size": 7,
    }  # fmt: skip
    model = WorldModel(WorldModelConfig.model_validate(values | changes))
    model.initialise(torch.Generator().manual_seed(0))
    return model


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    save_checkpoint(tmp_path / "c", build(), kind="stage2", action_contract=CONTRACT, metadata={"step": 3})
    return tmp_path / "c"


def test_a_checkpoint_comes_back_as_it_was(folder: Path) -> None:
    model, info = load_checkpoint(folder, expect_kind="stage2")
    for name, tensor in build().state_dict().items():
        assert torch.equal(model.state_dict()[name], tensor.half().float()), name
    assert (info.kind, info.metadata, info.action_contract) == ("stage2", {"step": 3}, CONTRACT)
    assert info.config == build().config


def test_equal_models_give_equal_bytes(folder: Path, tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "d", build(), kind="stage2", action_contract=CONTRACT, metadata={"step": 3})
    for name in ("model.safetensors", "checkpoint.json"):
        assert (folder / name).read_bytes() == (tmp_path / "d" / name).read_bytes()


def test_averaged_weights_may_be_stored_in_their_place(tmp_path: Path) -> None:
    model = build()
    average = {name: tensor + 1.0 for name, tensor in model.state_dict().items()}
    save_checkpoint(tmp_path, model, kind="base", action_contract=None, state_dict=average, dtype=torch.float32)
    loaded, info = load_checkpoint(tmp_path)
    assert info.action_contract is None
    torch.testing.assert_close(loaded.proj_out.bias, average["proj_out.bias"])


def test_the_generation_tower_is_taken_out_of_a_checkpoint_with_both(folder: Path, tmp_path: Path) -> None:
    model, info = load_checkpoint(folder, towers="generation")
    assert model.config.towers == "generation"
    assert info.config.towers == "both"
    assert not any("to_q" in name for name in model.state_dict())
    save_checkpoint(tmp_path / "g", model, kind="stage2", action_contract=CONTRACT)
    with pytest.raises(CheckpointError, match="no understanding tower"):
        load_checkpoint(tmp_path / "g", towers="both")


def test_what_does_not_fit_the_caller_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"(?s)wrong kind.*expected: causal.*got: stage2.*task distill"):
        load_checkpoint(folder, expect_kind="causal")
    spec = CausalSpec(block_size=1, sink_blocks=1, recent_blocks=2, anchor_blocks=None, sigmas=(1.0, 0.0))
    save_checkpoint(tmp_path / "k", build(), kind="causal", action_contract=CONTRACT, causal=spec)
    for wanted in (("base", "stage1", "stage2"), "stage2"):  # of Stage II's training, of a rollout of full clips
        with pytest.raises(CheckpointError, match=r"(?s)got: causal.*--input causal=.*block_causal"):
            load_checkpoint(tmp_path / "k", expect_kind=wanted)
    with pytest.raises(CheckpointError, match=r"(?s)contract differs.*tracks: fps.*expected:.*8\.0.*got:.*10\.0"):
        CONTRACT.require(where="tracks", fps=10.0, controls="action")
    with pytest.raises(CheckpointError, match="No checkpoint here"):
        load_checkpoint(tmp_path)
    with pytest.raises(CheckpointError, match="kind: Input should be"):
        save_checkpoint(tmp_path, build(), kind="final", action_contract=None)  # type: ignore[arg-type]
    with pytest.raises(CheckpointError, match="action_contract: a checkpoint of kind stage2 needs one"):
        save_checkpoint(tmp_path, build(), kind="stage2", action_contract=None)
    with pytest.raises(CheckpointError, match="causal: needed by the kind causal"):
        save_checkpoint(tmp_path, build(), kind="causal", action_contract=CONTRACT)


def taking(frames: int) -> Callable[[WorldModelConfig], WorldModelConfig]:
    return lambda config: config.model_copy(update={"action_frames": frames})


@torch.no_grad()
def test_a_model_that_takes_the_controls_of_whole_intervals_computes_what_it_computed_before(
    tmp_path: Path, make_model: Callable[..., WorldModel]
) -> None:
    save_checkpoint(tmp_path / "own", make_model(), kind="stage2", action_contract=CONTRACT)
    own, _ = load_checkpoint(tmp_path / "own")
    interval, _ = load_checkpoint(tmp_path / "own", adapt=taking(4))
    latents, maps = torch.randn(2, 3, 4, 5, 4, 4), torch.randn(2, 3, 36, 5, 4, 4)
    sigma = torch.tensor([0.3, 0.9])
    before = own(latents, sigma, action_maps=maps[:, :, :9]).velocity
    torch.testing.assert_close(interval(latents, sigma, action_maps=maps).velocity, before)
    with torch.enable_grad():
        interval(latents, sigma, action_maps=maps).velocity.square().sum().backward()
    gradient = interval.action_encoder.proj.weight.grad
    assert bool((gradient.unflatten(1, (4, -1)).abs().amax(dim=(0, 2)) > 0).all())
    save_checkpoint(tmp_path / "all", interval, kind="stage2", action_contract=CONTRACT)
    assert load_checkpoint(tmp_path / "all")[1].config.control_channels == 36
    with pytest.raises(CheckpointError, match=r"(?s)takes the controls of more frames.*action_frames 4"):
        load_checkpoint(tmp_path / "all", adapt=taking(1))


def rewrite(folder: Path, change: Callable[[dict[str, torch.Tensor]], None]) -> None:
    """Change the weights and keep the stored digest true."""
    path = folder / "model.safetensors"
    tensors = load_file(path)
    change(tensors)
    save_file(tensors, path)
    description = json.loads((folder / "checkpoint.json").read_text())
    description["weights_sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    (folder / "checkpoint.json").write_text(json.dumps(description))


def test_missing_unexpected_and_misshapen_weights_are_named(folder: Path) -> None:
    rewrite(folder, lambda tensors: tensors.pop("proj_in.bias"))
    with pytest.raises(CheckpointError, match=r"missing: proj_in\.bias"):
        load_checkpoint(folder)
    rewrite(folder, lambda tensors: tensors.update({"proj_in.bias": torch.zeros(3)}))
    with pytest.raises(CheckpointError, match=r"(?s)wrong shape.*proj_in\.bias.*expected: \(12,\).*got: \(3,\)"):
        load_checkpoint(folder)
    rewrite(folder, lambda tensors: tensors.update({"proj_in.bias": torch.zeros(12), "extra": torch.zeros(1)}))
    with pytest.raises(CheckpointError, match="unexpected: extra"):
        load_checkpoint(folder)


def test_damaged_files_are_refused(folder: Path) -> None:
    path = folder / "model.safetensors"
    path.write_bytes(path.read_bytes()[:-2])
    with pytest.raises(CheckpointError, match="not those that are described"):
        load_checkpoint(folder)
    path.unlink()
    with pytest.raises(CheckpointError, match="has no weights"):
        load_checkpoint(folder)
    description = folder / "checkpoint.json"
    content = json.loads(description.read_text())
    for change, message in (
        ({"format": "other"}, "Not a checkpoint of this version"),
        ({"version": 2}, "Not a checkpoint of this version"),
        ({"kind": "other"}, "kind: Input should be"),
        ({"config": content["config"] | {"hidden": 3}}, r"config\.hidden: Extra inputs"),
    ):
        description.write_text(json.dumps(content | change))
        with pytest.raises(CheckpointError, match=message):
            read_checkpoint_info(folder)
    del content["metadata"]
    description.write_text(json.dumps(content))
    with pytest.raises(CheckpointError, match="metadata: Field required"):
        read_checkpoint_info(folder)
    description.write_text("{")
    with pytest.raises(CheckpointError, match="not JSON"):
        read_checkpoint_info(folder)


def test_weights_that_are_not_finite_are_not_stored(tmp_path: Path) -> None:
    model = build()
    model.proj_in.weight.data[0, 0] = 1e6
    with pytest.raises(CheckpointError, match=r"(?s)not finite.*proj_in\.weight"):
        save_checkpoint(tmp_path, model, kind="base", action_contract=None)
    save_checkpoint(tmp_path, model, kind="base", action_contract=None, dtype=torch.bfloat16)
    assert read_checkpoint_info(tmp_path).dtype == "bfloat16"
