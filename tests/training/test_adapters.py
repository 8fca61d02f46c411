"""LoRA: what is trained, what is saved, and what it merges into."""

import json
import shutil

import pytest
import torch
from safetensors.torch import load_file

from tests.training.conftest import stage2, trainer
from worldline_core.errors import CheckpointError, ConfigError
from worldline_core.model.checkpoint import load_checkpoint
from worldline_core.store.artifact_files import digest_folder
from worldline_core.training.adapters import add_adapters, merge_adapter
from worldline_core.training.processes import hold_weights
from worldline_core.training.stage2 import train_stage2
from worldline_core.training.training_config import LoRAConfig, MergeAdapterConfig

LORA = {"rank": 3, "scale": 0.5}


def adapted(**changes):
    return stage2(6, lora=LORA, trainer=trainer(6, precision="bf16", **changes))


@pytest.fixture(scope="module")
def inputs(world, base):
    return {**world.inputs, "stage1": base}


@pytest.fixture(scope="module")
def trained(inputs, tmp_path_factory):
    folder = tmp_path_factory.mktemp("adapted")
    train_stage2(adapted(), inputs, folder)
    return folder


def merged(adapter, inputs, output):
    merge_adapter(MergeAdapterConfig(), {"adapter": adapter, "start": inputs["stage1"]}, output)
    return output


def test_an_adapter_changes_its_layers_by_a_low_rank_and_merges_to_the_same_bytes(inputs, trained, tmp_path):
    model, info = load_checkpoint(trained, expect_kind="stage2")
    start = load_checkpoint(inputs["stage1"], towers="generation")[0].state_dict()
    changes = {name: value - start[name] for name, value in model.state_dict().items() if "action" not in name}
    ranks = {name: torch.linalg.matrix_rank(value, atol=2e-3).item() for name, value in changes.items() if value.any()}
    assert len(ranks) == 2 * 7 + 1 and set(ranks.values()) <= {2, 3}  # the view embedding has three rows
    assert not any(model.is_text_parameter(name) for name in ranks)
    assert all(value.any() for name, value in model.state_dict().items() if name.startswith("action_encoder"))
    again = merged(trained / "adapter", inputs, tmp_path / "merged")
    for name in ("model.safetensors", "checkpoint.json"):
        assert (again / name).read_bytes() == (trained / name).read_bytes()
    assert info.metadata["start"]["kind"] == "base"


@pytest.mark.parametrize(("network", "adapted"), [("mixture", 7), ("wan", 10)])
def test_attention_and_feed_forward_of_every_network_are_adapted(make_model, network, adapted):
    model = make_model(network=network)
    add_adapters(model, LoRAConfig(**LORA), 0)
    assert sum(name.endswith("lora_A.default.weight") for name, _ in model.named_parameters()) == 2 * adapted


def test_peft_reads_the_adapter(inputs, trained):
    from peft import PeftConfig, inject_adapter_in_model, set_peft_model_state_dict  # seconds, of this test alone

    model = load_checkpoint(inputs["stage1"], towers="generation")[0]
    inject_adapter_in_model(PeftConfig.from_pretrained(trained / "adapter"), model)
    read = set_peft_model_state_dict(model, load_file(trained / "adapter" / "adapter_model.safetensors"))
    assert not read.unexpected_keys
    layer = model.layers[0].mlp_moe_gen.down_proj
    layer.merge()
    wanted = load_checkpoint(trained)[0].layers[0].mlp_moe_gen.down_proj.weight
    torch.testing.assert_close(layer.base_layer.weight, wanted, atol=1e-3, rtol=0)


@pytest.mark.slow
@pytest.mark.parametrize("form", [{}, {"weights": "bf16", "average": "host"}])
def test_a_killed_adapter_goes_on_with_the_same_bytes(inputs, tmp_path, killed_after, form):
    with killed_after(5):
        train_stage2(adapted(**form), inputs, tmp_path / "killed")
    for name in ("killed", "whole"):
        train_stage2(adapted(**form), inputs, tmp_path / name)
        shutil.rmtree(tmp_path / name / "run")
    assert digest_folder(tmp_path / "killed") == digest_folder(tmp_path / "whole")


def test_what_does_not_fit_an_adapter_is_refused(inputs, trained, tmp_path, monkeypatch):
    with pytest.raises(CheckpointError, match="started from other weights"):
        merged(trained / "adapter", inputs | {"stage1": trained}, tmp_path)
    damaged = shutil.copytree(trained / "adapter", tmp_path / "damaged")
    content = json.loads((damaged / "adapter.json").read_text())
    for change, message in (
        ({"lora": {"rank": 4}}, "wrong shape"),
        ({"full": "0"}, "not those that are described"),
        ({"lora": {"rank": 0}}, "not valid"),
    ):
        (damaged / "adapter.json").write_text(json.dumps(content | change))
        with pytest.raises(CheckpointError, match=message):
            merged(damaged, inputs, tmp_path)
    monkeypatch.setattr("worldline_core.training.optimizers.processes", lambda: (0, 2))
    for changes in ({"lora": LORA}, *({"trainer": trainer(1, precision="bf16", **form)} for form in (
        {"weights": "bf16"}, {"average": "host"}, {"optimizer": {"moments": "8bit"}}
    ))):  # fmt: skip
        with pytest.raises(ConfigError, match=r"(?s)saves memory on one card.*2 processes"):
            train_stage2(stage2(1, **changes), inputs, tmp_path)


def test_weights_that_are_not_trained_compute_the_same_in_bfloat16(inputs):
    def velocity(*, frozen):
        model = load_checkpoint(inputs["stage1"], towers="generation")[0]
        model.action_encoder.proj.weight.data.normal_(generator=torch.Generator().manual_seed(1))
        hold_weights(model.requires_grad_(not frozen), "bf16")
        assert {value.dtype for value in model.parameters()} == {torch.float32} | (
            {torch.bfloat16} if frozen else set()
        )
        noise = torch.Generator().manual_seed(2)
        latents, maps = (torch.randn(1, 3, channels, 3, 4, 4, generator=noise) for channels in (4, 9))
        with torch.autocast("cpu", torch.bfloat16), torch.no_grad():
            return model(latents, torch.full((1,), 0.3), action_maps=maps).velocity

    assert torch.equal(velocity(frozen=True), velocity(frozen=False))
