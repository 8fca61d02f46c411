"""Stage I and Stage II: what they train, refuse and save; on clips from frames and from caches, here and in loader processes."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from pydantic import ValidationError

from tests.training.conftest import FRAME_INPUT, VIEWS, losses, stage1, stage2, trainer
from worldline_core.errors import ArtifactError, CheckpointError, ConfigError, DataError
from worldline_core.model.checkpoint import load_checkpoint, read_checkpoint_info, save_checkpoint
from worldline_core.model.networks import build_world_model
from worldline_core.model.world_model_config import NativeVectors
from worldline_core.store.artifact_files import digest_folder, read_json_lines
from worldline_core.training import stage as stage_module
from worldline_core.training.clip_config import EncodeLatentsConfig
from worldline_core.training.clip_sampler import Clip
from worldline_core.training.clip_source import training_rows
from worldline_core.training.encode_latents import encode_latents
from worldline_core.training.flow_matching import FlowMatchingObjective
from worldline_core.training.relational import TeacherSimilarities, similarity_matrices
from worldline_core.training.stage1 import stage1_groups, train_stage1
from worldline_core.training.stage2 import stage2_groups, train_stage2
from worldline_core.training.training_config import RelationalConfig
from worldline_core.training.video_teacher import load_teacher

TRAINER = trainer(4, batch_size=2, log_every=1, save_every_steps=1)


def short_stage1(**changes):
    clips = {"lengths": [9, 13], "view_weights": {"primary": 1}}
    return stage1(**{"trainer": TRAINER, "clips": clips, **changes})


def short_stage2(**changes):
    return stage2(4, **{"trainer": TRAINER, "clips": {"lengths": [9, 13, 17]}, "action_dropout": 0.0, **changes})


@pytest.fixture(scope="module")
def recorded(world, tokenizer):
    return {"episodes": world.episodes, "tokenizer": tokenizer}


@pytest.fixture(scope="module")
def latents(recorded, tmp_path_factory):
    folder = tmp_path_factory.mktemp("latents")
    encode_latents(EncodeLatentsConfig(image_size=(32, 32)), recorded, folder)
    return folder


@pytest.fixture(scope="module")
def first_stage(recorded, tmp_path_factory):
    folder = tmp_path_factory.mktemp("stage1")
    train_stage1(short_stage1(input=FRAME_INPUT), recorded, folder)
    return folder


@pytest.fixture(scope="module")
def inputs(world, first_stage):
    """Inputs of Stage II, with a Stage I checkpoint of a few steps."""
    return {**world.inputs, "stage1": first_stage}


def fresh(model_config, **changes):
    model = build_world_model(model_config(**changes))
    model.initialise(torch.Generator().manual_seed(0))
    return model


def rewritten(folder, copy, column, change):
    """A copy of an artifact whose index has other values in one column."""
    table = pq.read_table(shutil.copytree(folder, copy) / "index.parquet")
    values = pa.array([change(value) for value in table[column].to_pylist()])
    pq.write_table(table.set_column(table.column_names.index(column), column, values), copy / "index.parquet")
    return copy


def test_a_state_of_another_run_or_other_episodes_is_refused(inputs, tmp_path, monkeypatch):
    train_stage2(stage2(2), inputs, tmp_path)
    with pytest.raises(ArtifactError, match="give it the config"):
        train_stage2(stage2(3), inputs, tmp_path)
    monkeypatch.setattr(stage_module, "training_rows", lambda *args, **kwargs: list(training_rows(*args, **kwargs))[1:])
    with pytest.raises(ArtifactError, match="give it the episodes"):
        train_stage2(stage2(2), inputs, tmp_path)


def test_training_learns_and_the_controls_matter(world, model_config, tmp_path):
    save_checkpoint(tmp_path / "base", fresh(model_config), kind="base", action_contract=None)
    values = trainer(45, batch_size=8, ema_decay=0.95, save_every_steps=0)
    config = stage2(45, trainer=values, weighting={"kind": "sample"}, action_dropout=0.0)
    result = train_stage2(config, {**world.inputs, "stage1": tmp_path / "base"}, tmp_path / "run")
    found = losses(tmp_path / "run")
    assert found[-1] < 0.4 * found[0]
    assert result["validation/sample_error"] < 0.8 * result["validation/sample_error_shuffled_actions"]
    info = load_checkpoint(tmp_path / "run", expect_kind="stage2")[1]
    assert (info.contract.sigma_px_ref, info.metadata["step"]) == (60.0, 45)


def test_stage1_trains_both_towers_on_text_and_leaves_the_action_branch(inputs, model_config):
    model, info = load_checkpoint(inputs["stage1"], expect_kind="stage1", towers="both")
    before = dict(fresh(model_config).named_parameters())
    changed = {name for name, value in model.named_parameters() if not torch.allclose(value, before[name], atol=2e-3)}
    for part, trained in ((".to_k.", True), (".add_q_proj.", True), ("action_encoder", False)):
        assert any(part in name for name in changed) is trained
    assert info.metadata["sources"] == {"synthetic": 6}


def test_what_stage2_trains(model_config):
    model = build_world_model(model_config())
    generation, action = stage2_groups(model, 66.0)
    everything, names = {name for name, _ in model.named_parameters()}, set(generation.parameters)
    assert action.multiplier == 66.0
    assert set(action.parameters) == {name for name in everything if name.startswith("action_encoder.")}
    # Filtering by "moe_gen" alone would leave the generation tower's attention frozen.
    for part in (
        "add_q_proj", "add_k_proj", "add_v_proj", "to_add_out", "norm_added_q", "norm_added_k", "mlp_moe_gen",
        "time_embedder", "proj_in", "proj_out", "norm_moe_gen",
    ):  # fmt: skip
        assert any(part in name for name in names), part
    for frozen in ("embed_tokens", ".to_q.", ".to_k.", ".to_v.", ".to_out.", ".mlp.", "action_encoder"):
        assert not any(frozen in name for name in names), frozen
    assert set.union(*(set(group.parameters) for group in (*stage1_groups(model), action))) == everything


def test_native_control_vectors_take_the_place_of_maps(inputs, tmp_path):
    """The paper's ablation: a Stage I model with maps becomes a Stage II model with FiLM, driven by its own vectors."""
    alone = {"native_size": 3, "vector_share": 1.0, "action_dropout": 0.0}
    result = train_stage2(stage2(4, **alone), inputs, tmp_path / "film")
    model, info = load_checkpoint(tmp_path / "film", expect_kind="stage2")
    assert (info.config.native_size, info.config.takes_maps, model.action_encoder) == (3, False, None)
    assert info.vectors == NativeVectors(embodiments=("square",), share=1.0)
    assert all(layer.weight.abs().max() > 0 for layer in model.action_film.proj)
    assert result["validation/loss"] != result["validation/loss_shuffled_actions"]
    film = inputs | {"stage1": tmp_path / "film"}
    train_stage2(stage2(2, **alone), film, tmp_path / "on")
    without = {name: folder for name, folder in inputs.items() if name != "tracks"}
    bare = train_stage2(stage2(4, **alone | {"vector_share": 0.3}), without, tmp_path / "bare")
    assert not load_checkpoint(tmp_path / "bare")[1].config.takes_maps  # nothing can be drawn
    assert bare["validation/loss"] == result["validation/loss"]  # vectors are the same, with cameras or without
    for changes, given, error, message in (
        ({}, without, ConfigError, "drawn from action tracks.*run render_actions"),
        ({"native_size": 1}, inputs, DataError, "driven by control vectors.*up to 1 numbers.*got: 2"),
        ({"native_size": 4}, film, ConfigError, "vectors of another size.*expected: 3.*got: 4"),
    ):
        with pytest.raises(error, match=f"(?s){message}"):
            train_stage2(stage2(2, **changes), given, tmp_path / "refused")


@pytest.mark.slow
def test_a_model_of_maps_also_learns_vectors_and_says_whose(inputs, tmp_path, monkeypatch):
    """Views of one batch take one or the other; a view without a camera always the vector, a model of maps alone never shows it."""
    seen, loss = [], FlowMatchingObjective.loss

    def watched(objective, batch, *rest):
        seen.append(batch.action_maps.unflatten(2, (4, -1)).abs().amax(dim=(2, 4, 5, 6)))  # b v channels
        return loss(objective, batch, *rest)

    def trained(config, name, **given):
        seen.clear()
        train_stage2(config, inputs | given, tmp_path / name)
        return torch.cat(seen)

    monkeypatch.setattr(FlowMatchingObjective, "loss", watched)

    def either(steps):
        return stage2(steps, native_size=3, vector_share=0.4, action_dropout=0.0, action_frames=4)

    shown = trained(either(14), "both")
    info = read_checkpoint_info(tmp_path / "both")
    assert info.config.action_conditioning == "either"
    assert info.vectors == NativeVectors(embodiments=("square",), share=0.4)
    given, drawn = (shown[:, :, part].amax(dim=2) > 0 for part in (slice(-1, None), slice(9)))
    assert bool((given != drawn).all())
    assert 0.25 < float(given.float().mean()) < 0.55
    maps = stage2(2, action_frames=4)
    assert bool((trained(maps, "maps").amax(dim=2) > 0).all())  # a model of maps alone is never given nothing
    trained(either(2), "on", stage1=tmp_path / "both")
    trained(stage2(2, native_size=3, action_frames=4), "gained", stage1=tmp_path / "maps")
    assert read_checkpoint_info(tmp_path / "gained").config.action_conditioning == "either"
    tracks = rewritten(
        inputs["tracks"], tmp_path / "tracks", "camera_motion", lambda _: ["static", "absent", "kinematics"]
    )
    left = trained(either(4), "partly", tracks=tracks)[:, 1]
    assert bool((left[:, -1] == 1).all()) and not left[:, :9].any()
    trained(maps, "two_views", tracks=tracks)
    assert read_checkpoint_info(tmp_path / "two_views").view_sets == (("head", "right_wrist"),)


def test_outcomes_choose_episodes_and_do_not_reach_the_model(inputs, tmp_path):
    train_stage2(stage2(2, outcomes=["success"]), inputs, tmp_path / "some")
    assert read_checkpoint_info(tmp_path / "some").metadata["episodes"] == 3  # of six
    with pytest.raises(DataError, match=r"(?s)No episode is left.*got: (outcome \w+ \d(, )?)+\n"):
        train_stage2(stage2(2, outcomes=["unknown"]), inputs, tmp_path / "none")
    other = {"success": "failure", "failure": "success"}
    flipped = rewritten(inputs["episodes"], tmp_path / "flipped", "outcome", other.get)
    for name, episodes in (("one", inputs["episodes"]), ("two", flipped)):
        train_stage2(stage2(2), inputs | {"episodes": episodes}, tmp_path / name)
    assert digest_folder(tmp_path / "one") == digest_folder(tmp_path / "two")


@pytest.mark.parametrize(
    ("name", "value", "found"),
    [("sigma_px_ref", 10.0, "60\\.0"), ("tokenizer", "another", "synthetic")],
)
def test_stage2_goes_on_with_latents_and_maps_of_the_same_meaning_only(
    world, model_config, make_contract, tmp_path, name, value, found
):
    other = make_contract(**({"sigma_px_ref": 60.0, "tokenizer": "synthetic"} | {name: value}))
    save_checkpoint(tmp_path / "stage2", fresh(model_config, towers="generation"), kind="stage2", action_contract=other)
    with pytest.raises(CheckpointError, match=rf"(?s)action contract differs.*{name}.*{value}.*{found}"):
        train_stage2(stage2(2), {**world.inputs, "stage1": tmp_path / "stage2"}, tmp_path / "out")


@pytest.mark.parametrize(
    ("facts", "told"),
    [
        ({}, "robots that it does not name; it now learns square"),
        ({"embodiments": {"ur5e": 2}}, "learned from ur5e; it now learns square"),
        pytest.param({"embodiments": {"square": 1, "ur5e": 2}}, None, marks=pytest.mark.slow),
    ],
)
def test_stage2_goes_on_with_another_robot_rate_and_controls_and_says_so(
    world, model_config, make_contract, tmp_path, caplog, facts, told
):
    """A user's robot: another frame rate, commands instead of measured states, vectors instead of maps."""
    caplog.set_level("INFO")
    other = make_contract(sigma_px_ref=60.0, tokenizer="synthetic", controls="state", fps=7.5)
    model = fresh(model_config, towers="generation")
    save_checkpoint(tmp_path / "before", model, kind="stage2", action_contract=other, metadata=facts)
    vectors = stage2(2, native_size=3, vector_share=1.0, action_dropout=0.0)
    train_stage2(vectors, {**world.inputs, "stage1": tmp_path / "before"}, tmp_path / "after")
    after = read_checkpoint_info(tmp_path / "after")
    assert (after.metadata["start"]["kind"], set(after.metadata["embodiments"])) == ("stage2", {"square"})
    assert ("it now learns" in caplog.text) is (told is not None)
    contract = after.action_contract
    assert (contract.controls, contract.fps, contract.sigma_px_ref) == ("action", 8.0, None)
    for change in (
        told or "", "controls action, previously state", "frames per second 8.0, previously 7.5",
        "conditioning vectors, previously maps",
    ):  # fmt: skip
        assert change in caplog.text


def test_wrong_checkpoint_and_missing_teacher_are_named(inputs, model_config, make_contract, make_spec, tmp_path):
    model = fresh(model_config, towers="generation")
    save_checkpoint(tmp_path / "causal", model, kind="causal", action_contract=make_contract(), causal=make_spec())
    for changes, given, error, message in (
        ({}, {"stage1": tmp_path / "causal"}, CheckpointError, "wrong kind"),
        ({"relational": {}}, {}, ConfigError, "need a teacher"),
        ({"relational": {}}, {"teacher": tmp_path}, CheckpointError, "holds no relational teacher"),
    ):
        with pytest.raises(error, match=message):
            train_stage2(stage2(2, **changes), inputs | given, tmp_path / "out")


def test_a_teacher_is_trained_and_frozen(world, teacher):
    assert json.loads((teacher / "teacher.json").read_text())["metrics"]["validation/loss"] > 0
    loaded = load_teacher(teacher)
    source = TeacherSimilarities(loaded, world.episodes, RelationalConfig(cached_clips=1))
    clip, views = Clip("episode-003", 0, 9, 1), VIEWS[:2]
    first, again = (source.similarities((clip,), views, (3, 2, 2)) for _ in range(2))
    assert (first.shape, first.intra.shape, first.cross.shape) == ((3, 2, 2), (1, 2, 2, 4, 4), (1, 1, 3, 4, 4))
    assert again.intra is not first.intra and torch.equal(again.intra, first.intra)
    assert not torch.equal(source.similarities((replace(clip, start=8),), views, (3, 2, 2)).intra, first.intra)
    # What is kept is what the unpooled features, in half precision, give.
    position = source.episodes.position("episode-003")
    frames = torch.from_numpy(np.stack([source.episodes.frames(position, view, list(clip.frames)) for view in views]))
    features = loaded.features((frames.float() / 255).permute(0, 4, 1, 2, 3)).half().float()
    assert torch.equal(similarity_matrices(features[None], (3, 2, 2)).cross, first.cross)
    assert not any(parameter.requires_grad for parameter in loaded.parameters())


def test_stage1_learns_the_same_from_frames_as_from_their_cached_latents(world, latents, first_stage, tmp_path):
    train_stage1(short_stage1(), {"episodes": world.episodes, "latents": latents}, tmp_path)
    # The same clips in the same order: the losses differ by the rounding of half precision alone.
    assert losses(first_stage) == pytest.approx(losses(tmp_path), rel=1e-3)
    cached, online = (read_checkpoint_info(folder).metadata for folder in (tmp_path, first_stage))
    assert "input" not in cached
    assert online["input"]["kind"] == "frames" and online["input"]["decoder"].startswith("PyAV")
    assert online["tokenizer"] == cached["tokenizer"]


@pytest.mark.parametrize(("lengths", "warned"), [([9, 13], True), ([9], False)])
def test_held_out_recordings_shorter_than_the_longest_clips_validate_what_fits(
    recorded, tmp_path, caplog, lengths, warned
):
    """Seventeen frames hold nine at stride 2, but not thirteen."""
    clips = {"lengths": lengths, "strides": [2], "view_weights": {"primary": 1}}
    train_stage1(short_stage1(trainer=TRAINER | {"steps": 1}, clips=clips, input=FRAME_INPUT), recorded, tmp_path)
    rows = read_json_lines(tmp_path / "metrics.jsonl")
    assert any(key.startswith("validation/") for row in rows for key in row)
    assert ("the longest clips span 25" in caplog.text) == warned


@pytest.mark.slow
@pytest.mark.usefixtures("forked_loaders")
def test_stage2_goes_on_with_the_same_bytes(world, recorded, first_stage, teacher, tmp_path, killed_after):
    """Undisturbed in this process; killed twice and continued with a loader process: one checkpoint, to the byte."""
    inputs = recorded | {"tracks": world.tracks, "stage1": first_stage, "teacher": teacher}
    values = TRAINER | {"steps": 14, "log_every": 3, "save_every_steps": 4}
    config = short_stage2(input=FRAME_INPUT, trainer=values, relational={"ramp_steps": 5})
    train_stage2(config, inputs, tmp_path / "whole")
    ahead = config.model_copy(update={"input": config.input.model_copy(update={"workers": 1})})
    for steps in (7, 6):  # the second part begins at the state of step 4: it repeats three steps and their log lines
        with killed_after(steps):
            train_stage2(ahead, inputs, tmp_path / "parts")
    torch.rand(5)
    train_stage2(ahead, inputs, tmp_path / "parts")
    for name in ("model.safetensors", "metrics.jsonl"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes()
    rows = [row for row in read_json_lines(tmp_path / "parts" / "metrics.jsonl") if "loss" in row]
    assert [row["step"] for row in rows] == [3, 6, 9, 12, 14]
    assert all(row["relational_intra"] > 0 for row in rows)


@pytest.mark.slow
def test_the_teacher_is_shown_the_frames_that_were_read(world, tokenizer, latents, first_stage, teacher, tmp_path):
    given = {"episodes": world.episodes, "tracks": world.tracks, "stage1": first_stage, "teacher": teacher}
    found = []
    for values, source in (({}, {"latents": latents}), ({"input": FRAME_INPUT}, {"tokenizer": tokenizer})):
        (output,) = (tmp_path / name for name in source)
        train_stage2(short_stage2(relational={"ramp_steps": 2}, **values), given | source, output)
        rows = [row for row in read_json_lines(output / "metrics.jsonl") if "loss" in row]
        found.append([row[f"relational_{kind}"] for row in rows for kind in ("intra", "cross")])
    assert found[1] == pytest.approx(found[0], rel=5e-3)


@pytest.mark.slow
def test_resident_latents_train_the_same_bytes(world, latents, first_stage, tmp_path):
    inputs = {"episodes": world.episodes, "latents": latents, "tracks": world.tracks, "stage1": first_stage}
    weights = []
    for resident in (False, True):
        output = tmp_path / str(resident)
        train_stage2(short_stage2(input={"kind": "latents", "resident": resident}), inputs, output)
        weights.append((output / "model.safetensors").read_bytes())
    assert weights[0] == weights[1]
    with pytest.raises(ValidationError, match="resident"):
        short_stage2(input={"kind": "latents", "resident": True, "workers": 1})


def test_a_damaged_recording_stops_the_run(recorded, tmp_path):
    inputs = recorded | {"episodes": shutil.copytree(recorded["episodes"], tmp_path / "set")}
    (video,) = inputs["episodes"].rglob("*head*/**/*.mp4")
    half = video.stat().st_size // 2
    video.write_bytes(video.read_bytes()[:half] + bytes(half))
    with pytest.raises(DataError, match="A clip cannot be read"):
        train_stage1(short_stage1(input=FRAME_INPUT), inputs, tmp_path / "strict")


def test_a_stage_is_given_what_it_reads(world, tmp_path):
    for values, name in (({}, "latents"), ({"input": FRAME_INPUT}, "tokenizer")):
        with pytest.raises(ConfigError, match=f"need the input {name}"):
            train_stage1(short_stage1(**values), {"episodes": world.episodes}, tmp_path / name)
