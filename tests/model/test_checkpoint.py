"""Checkpoints are written reproducibly and read strictly, in one file or in several; none is copied as it is read."""

import hashlib
import json

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch.profiler import ProfilerActivity, profile

from worldline_core.errors import CheckpointError
from worldline_core.model import checkpoint
from worldline_core.model.checkpoint import (
    load_checkpoint,
    read_checkpoint_info,
    read_weights,
    save_checkpoint,
    write_weights,
)
from worldline_core.model.networks import build_world_model
from worldline_core.model.world_model_config import MixtureConfig


def build(**changes):
    values = {
        "latent_channels": 4, "hidden_size": 12, "num_layers": 2, "num_heads": 2, "num_kv_heads": 1, "head_dim": 12,
        "intermediate_size": 16, "rope_sections": (2, 2, 2), "vocab_size": 7,
    }  # fmt: skip
    model = build_world_model(MixtureConfig.model_validate(values | changes))
    model.initialise(torch.Generator().manual_seed(0))
    return model


@pytest.fixture
def contract(make_contract):
    return make_contract()


@pytest.fixture
def folder(tmp_path, contract):
    save_checkpoint(tmp_path / "c", build(), kind="stage2", action_contract=contract, metadata={"step": 3})
    return tmp_path / "c"


def test_a_checkpoint_comes_back_as_it_was_and_equal_models_give_equal_bytes(folder, contract, tmp_path):
    model, info = load_checkpoint(folder, expect_kind="stage2")
    for name, tensor in build().state_dict().items():
        assert torch.equal(model.state_dict()[name], tensor.half().float()), name
    assert (info.kind, info.metadata, info.action_contract) == ("stage2", {"step": 3}, contract)
    assert info.config == build().config
    save_checkpoint(tmp_path / "d", build(), kind="stage2", action_contract=contract, metadata={"step": 3})
    for name in ("model.safetensors", "checkpoint.json"):
        assert (folder / name).read_bytes() == (tmp_path / "d" / name).read_bytes()


def test_averaged_weights_may_be_stored_in_their_place(tmp_path):
    model = build()
    average = {name: tensor + 1.0 for name, tensor in model.state_dict().items()}
    save_checkpoint(tmp_path, model, kind="base", action_contract=None, state_dict=average, dtype=torch.float32)
    loaded, info = load_checkpoint(tmp_path)
    assert info.action_contract is None
    torch.testing.assert_close(loaded.proj_out.bias, average["proj_out.bias"])


def test_the_generation_tower_is_taken_out_of_a_checkpoint_with_both(folder, contract, tmp_path):
    model, info = load_checkpoint(folder, towers="generation")
    assert (model.config.towers, info.config.towers) == ("generation", "both")
    assert not any("to_q" in name for name in model.state_dict())
    save_checkpoint(tmp_path / "g", model, kind="stage2", action_contract=contract)
    with pytest.raises(CheckpointError, match="no understanding tower"):
        load_checkpoint(tmp_path / "g", towers="both")


def test_what_does_not_fit_the_caller_is_refused(folder, contract, make_spec, tmp_path):
    save_checkpoint(tmp_path / "k", build(), kind="causal", action_contract=contract, causal=make_spec())
    causal = "(?s)got: causal.*--input causal=.*block_causal"
    for path, kind, message in (
        (folder, "causal", "(?s)wrong kind.*expected: causal.*got: stage2.*task distill"),
        (tmp_path / "k", ("base", "stage1", "stage2"), causal), (tmp_path / "k", "stage2", causal),
        (tmp_path, None, "No checkpoint here"),
    ):  # fmt: skip
        with pytest.raises(CheckpointError, match=message):
            load_checkpoint(path, expect_kind=kind)
    with pytest.raises(CheckpointError, match=r"(?s)contract differs.*tracks: fps.*expected:.*8\.0.*got:.*10\.0"):
        contract.require(where="tracks", fps=10.0, controls="action")
    for kind, given, message in (
        ("final", None, "kind: Input should be"), ("stage2", None, "action_contract: a checkpoint of kind stage2 needs one"),
        ("causal", contract, "causal: needed by the kind causal"),
    ):  # fmt: skip
        with pytest.raises(CheckpointError, match=message):
            save_checkpoint(tmp_path, build(), kind=kind, action_contract=given)


def taking(frames):
    return lambda config: config.model_copy(update={"action_frames": frames})


@torch.no_grad()
def test_a_model_that_takes_the_controls_of_whole_intervals_computes_what_it_computed_before(
    tmp_path, make_model, contract
):
    save_checkpoint(tmp_path / "own", make_model(), kind="stage2", action_contract=contract)
    own, interval = (load_checkpoint(tmp_path / "own", adapt=taking(frames))[0] for frames in (1, 4))
    latents, maps, sigma = torch.randn(2, 3, 4, 5, 4, 4), torch.randn(2, 3, 36, 5, 4, 4), torch.tensor([0.3, 0.9])
    before = own(latents, sigma, action_maps=maps[:, :, :9]).velocity
    torch.testing.assert_close(interval(latents, sigma, action_maps=maps).velocity, before)
    with torch.enable_grad():
        interval(latents, sigma, action_maps=maps).velocity.square().sum().backward()
    gradient = interval.action_encoder.proj.weight.grad
    assert bool((gradient.unflatten(1, (4, -1)).abs().amax(dim=(0, 2)) > 0).all())
    save_checkpoint(tmp_path / "all", interval, kind="stage2", action_contract=contract)
    assert read_checkpoint_info(tmp_path / "all").config.control_channels == 36
    with pytest.raises(CheckpointError, match=r"(?s)takes the controls of more frames.*action_frames 4"):
        load_checkpoint(tmp_path / "all", adapt=taking(1))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"proj_in.bias": None}, r"missing: proj_in\.bias"),
        ({"proj_in.bias": torch.zeros(3)}, r"(?s)wrong shape.*proj_in\.bias.*expected: \(12,\).*got: \(3,\)"),
        ({"extra": torch.zeros(1)}, "unexpected: extra"),
    ],
)
def test_missing_unexpected_and_misshapen_weights_are_named(folder, change, message):
    path, description = folder / "model.safetensors", folder / "checkpoint.json"
    tensors = load_file(path) | change
    save_file({name: tensor for name, tensor in tensors.items() if tensor is not None}, path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    description.write_text(json.dumps(json.loads(description.read_text()) | {"weights_sha256": digest}))
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint(folder)


def test_damaged_files_are_refused(folder):
    path, description = folder / "model.safetensors", folder / "checkpoint.json"
    path.write_bytes(path.read_bytes()[:-2])
    with pytest.raises(CheckpointError, match="not those that are described"):
        load_checkpoint(folder)
    path.unlink()
    with pytest.raises(CheckpointError, match="has no weights"):
        load_checkpoint(folder)
    content = json.loads(description.read_text())
    without = {name: value for name, value in content.items() if name != "metadata"}
    for text, message in (
        (json.dumps(content | {"format": "other"}), "Not a checkpoint of this version"),
        (json.dumps(content | {"version": 2}), "Not a checkpoint of this version"),
        (json.dumps(content | {"kind": "other"}), "kind: Input should be"),
        (json.dumps(content | {"config": content["config"] | {"hidden": 3}}), r"config\.mixture\.hidden: Extra inputs"),
        (json.dumps(content | {"config": content["config"] | {"network": ["wan"]}}), "network must be mixture or wan"),
        (json.dumps(without), "metadata: Field required"),
        ("{", "not JSON"),
    ):
        description.write_text(text)
        with pytest.raises(CheckpointError, match=message):
            read_checkpoint_info(folder)


def test_weights_that_are_not_finite_are_not_stored(tmp_path):
    model = build()
    model.proj_in.weight.data[0, 0] = 1e6
    with pytest.raises(CheckpointError, match=r"(?s)not finite.*proj_in\.weight"):
        save_checkpoint(tmp_path, model, kind="base", action_contract=None)
    save_checkpoint(tmp_path, model, kind="base", action_contract=None, dtype=torch.bfloat16)
    assert read_checkpoint_info(tmp_path).dtype == "bfloat16"


INDEX = "model.safetensors.index.json"


def save(folder, model):
    checkpoint.save_checkpoint(folder, model, kind="base", action_contract=None)
    return folder


@pytest.fixture
def sharded(tmp_path, make_model, monkeypatch):
    monkeypatch.setattr(checkpoint, "MAX_SHARD_BYTES", 8_000)
    return save(tmp_path / "c", make_model())


def shards(folder):
    return sorted(folder.glob("model-*.safetensors"))


def test_several_files_hold_what_one_would(sharded, tmp_path, make_model, monkeypatch):
    assert len(shards(sharded)) > 2
    assert not (sharded / "model.safetensors").exists()
    index = (sharded / INDEX).read_bytes()
    assert set(json.loads(index)["weight_map"]) == set(make_model().state_dict())
    assert read_checkpoint_info(sharded).weights_sha256 == hashlib.sha256(index).hexdigest()
    for tensors in map(load_file, shards(sharded)):
        assert len(tensors) == 1 or sum(tensor.nbytes for tensor in tensors.values()) <= 8_000
    again = save(tmp_path / "again", make_model())
    for path in sharded.iterdir():
        assert path.read_bytes() == (again / path.name).read_bytes()
    monkeypatch.undo()
    one = save(tmp_path / "one", make_model())
    assert list(one.glob("*.safetensors")) == [one / "model.safetensors"]
    whole, parts = (load_checkpoint(path)[0].state_dict() for path in (one, sharded))
    assert all(torch.equal(whole[name], parts[name]) for name in whole)


def test_a_smaller_write_leaves_no_file_of_a_larger_one(tmp_path, monkeypatch):
    tensors = {name: torch.full((8,), float(number)) for number, name in enumerate("abc")}
    for most, files in ((40, 4), (96, 1), (80, 3)):
        monkeypatch.setattr(checkpoint, "MAX_SHARD_BYTES", most)
        write_weights(tmp_path / "w.safetensors", tensors, torch.float32)
        assert len(list(tmp_path.iterdir())) == files
    assert read_weights(tmp_path / "w.safetensors", None)["c"].tolist() == [2.0] * 8


def test_a_truncated_or_missing_file_and_a_changed_index_are_named(sharded):
    path = shards(sharded)[1]
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(CheckpointError, match=rf"(?s)not those that are described.*{path.name}"):
        load_checkpoint(sharded)
    path.unlink()
    with pytest.raises(CheckpointError, match=r"(?s)weight file is missing.*model.*fetch the folder"):
        load_checkpoint(sharded)
    content = json.loads((sharded / INDEX).read_text())
    content["metadata"]["sha256"][path.name] = "0" * 64
    (sharded / INDEX).write_text(json.dumps(content))
    with pytest.raises(CheckpointError, match=rf"(?s)not those that are described.*{INDEX}"):
        load_checkpoint(sharded)


@pytest.mark.parametrize("kept", [0, 7, 100, -1])
def test_a_truncated_file_whose_digest_nobody_states_is_named(kept, tmp_path):
    """As other projects write them: their index says which tensor is where, and no digest."""
    save_file({"a": torch.ones(64)}, tmp_path / "w-1.safetensors")
    (tmp_path / "w.safetensors.index.json").write_text(json.dumps({"weight_map": {"a": "w-1.safetensors"}}))
    assert read_weights(tmp_path / "w.safetensors", None)["a"].sum() == 64
    content = (tmp_path / "w-1.safetensors").read_bytes()
    (tmp_path / "w-1.safetensors").write_bytes(content[:kept])
    with pytest.raises(CheckpointError, match=r"(?s)weights file is damaged.*w-1"):
        read_weights(tmp_path / "w.safetensors", None)


OUTSIDE = (
    "../secret.safetensors",
    "/etc/secret.safetensors",
    "a/b.safetensors",
    "..",
    "",
    "a\\b.safetensors",
    "model.bin",
)
DAMAGED = ("", "[]", "{}", '{"weight_map": []}', '{"weight_map": {}, "metadata": 3}', "[" * 100_000)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        *((json.dumps({"weight_map": {"a": name}}), "something else than a file of its folder") for name in OUTSIDE),
        *((text, "index of weights is damaged") for text in DAMAGED),
    ],
)
def test_an_index_that_is_damaged_or_names_files_outside_of_the_folder_is_refused(text, message, tmp_path):
    root = tmp_path / "w"
    root.mkdir()
    save_file({"a": torch.ones(2)}, tmp_path / "secret.safetensors")
    (root / "w.safetensors.index.json").write_text(text)
    with pytest.raises(CheckpointError, match=message):
        read_weights(root / "w.safetensors", None)


def test_an_index_that_disagrees_with_its_files_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "MAX_SHARD_BYTES", 40)
    write_weights(tmp_path / "w.safetensors", {name: torch.ones(8) for name in "ab"}, torch.float32)
    index = tmp_path / "w.safetensors.index.json"
    content = json.loads(index.read_text())
    content["weight_map"]["c"] = content["weight_map"].pop("a")
    index.write_text(json.dumps(content))
    with pytest.raises(CheckpointError, match=r"(?s)disagree.*missing \['c'\], others \['a'\]"):
        read_weights(tmp_path / "w.safetensors", None)


def most_bytes(recorded, already=0):
    """Most bytes that the allocator had handed out at once, beside those that it had before."""
    live = most = already
    events = recorded.profiler.kineto_results.events()
    for _, size in sorted((e.start_ns(), e.nbytes()) for e in events if e.name() == "[memory]"):
        live += size
        most = max(most, live)
    return most


def test_bfloat16_weights_are_read_without_a_copy_in_float32(tmp_path, make_model):
    model = make_model(hidden_size=256, intermediate_size=1024, num_layers=4)
    save(tmp_path, model)
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as recorded:
        loaded, _ = load_checkpoint(tmp_path, dtype=torch.bfloat16)
    own = sum(parameter.nbytes for parameter in loaded.parameters())
    largest = max(parameter.numel() for parameter in loaded.parameters())
    mapped = (tmp_path / "model.safetensors").stat().st_size
    # Besides the weights and the mapped file: one weight at a time in float32, and its mask, to see whether it is finite.
    assert own <= most_bytes(recorded) <= own + mapped + 10 * largest
    assert mapped + 10 * largest < 2 * own  # a copy in float32 would not go unseen
    time = loaded.time_embedder.linear_1.weight
    assert (loaded.proj_in.weight.dtype, time.dtype) == (torch.bfloat16, torch.float32)
    assert torch.equal(time, model.time_embedder.linear_1.weight.half().float())
