from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from worldline_core.errors import ArtifactError, CheckpointError, ConfigError, DataError
from worldline_core.model.checkpoint import load_checkpoint, read_checkpoint_info, save_checkpoint
from worldline_core.model.world_model import WorldModel, WorldModelConfig
from worldline_core.model.world_model_config import ActionContract, CausalSpec, NativeVectors
from worldline_core.store.artifact_files import read_json_lines
from worldline_core.training import stage as stage_module
from worldline_core.training.clip_source import training_rows
from worldline_core.training.flow_matching import FlowMatchingObjective
from worldline_core.training.stage1 import stage1_groups, train_stage1
from worldline_core.training.stage2 import stage2_groups, train_stage2
from worldline_core.training.training_config import Stage1Config, Stage2Config, TeacherConfig
from worldline_core.training.video_teacher import train_teacher

MakeConfig = Callable[..., WorldModelConfig]


def trainer_values(steps: int, **changes: Any) -> dict[str, Any]:
    values = {
        "steps": steps,
        "batch_size": 4,
        "precision": "fp32",
        "log_every": 3,
        "validation_batches": 1,
        "save_every_seconds": 1000.0,
        "save_every_steps": 4,
        "optimizer": {"learning_rate": 3e-3, "warmup_steps": 2},
    }
    return values | changes


def stage2(steps: int, **changes: Any) -> Stage2Config:
    values = {
        "trainer": trainer_values(steps),
        "clips": {"lengths": [9, 17]},
        "action_multiplier": 3.0,
        "action_dropout": 0.1,
        "relational": None,
    }
    return Stage2Config.model_validate(values | changes)


@pytest.fixture(scope="module")
def teacher(world: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("teacher")
    shape = {"image_size": [32, 32], "patch": 8, "hidden_size": 16, "num_layers": 4, "num_heads": 2}
    config = TeacherConfig.model_validate(
        {"shape": shape, "trainer": trainer_values(6), "clip_frames": 9, "held_out_episodes": 1}
    )
    counts = train_teacher(config, {"episodes": world.episodes}, folder)
    assert counts["found"] == counts["kept"] + sum(counts["left_out"].values()) == 8
    assert counts["left_out"]["held out to measure on"] == 1
    assert counts["left_out"]["in other splits"] == 2
    return folder


@pytest.fixture(scope="module")
def stage1_folder(world: Any, tiny_model: dict[str, object], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stage1")
    config = Stage1Config.model_validate(
        {"model": tiny_model, "trainer": trainer_values(6), "clips": {"lengths": [9], "view_weights": {"primary": 1}}}
    )
    train_stage1(config, world.inputs, folder)
    return folder


def digested(folder: Path) -> dict[str, bytes]:
    """Everything that belongs to the artifact: all but run/."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.relative_to(folder).parts[0] != "run"
    }


def test_a_state_of_another_run_or_other_episodes_is_refused(
    world: Any, stage1_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inputs = {**world.inputs, "stage1": stage1_folder}
    train_stage2(stage2(2), inputs, tmp_path)
    with pytest.raises(ArtifactError, match="give it the config"):
        train_stage2(stage2(3), inputs, tmp_path)
    monkeypatch.setattr(stage_module, "training_rows", lambda *args, **kwargs: list(training_rows(*args, **kwargs))[1:])
    with pytest.raises(ArtifactError, match="give it the episodes"):
        train_stage2(stage2(2), inputs, tmp_path)


def test_training_learns_and_the_controls_matter(world: Any, model_config: MakeConfig, tmp_path: Path) -> None:
    base = WorldModel(model_config())
    base.initialise(torch.Generator().manual_seed(0))
    save_checkpoint(tmp_path / "base", base, kind="base", action_contract=None)
    config = stage2(
        60, trainer=trainer_values(60, batch_size=8, ema_decay=0.95), weighting={"kind": "sample"}, action_dropout=0.0
    )
    result = train_stage2(config, {**world.inputs, "stage1": tmp_path / "base"}, tmp_path / "run")
    losses = [row["loss"] for row in read_json_lines(tmp_path / "run" / "metrics.jsonl") if "loss" in row]
    assert losses[-1] < 0.4 * losses[0]
    assert result["validation/sample_error"] < 0.8 * result["validation/sample_error_shuffled_actions"]
    _, info = load_checkpoint(tmp_path / "run", expect_kind="stage2")
    assert info.contract.sigma_px_ref == 60.0
    assert info.metadata["step"] == 60


def test_stage1_trains_both_towers_on_text_and_leaves_the_action_branch(stage1_folder: Path) -> None:
    model, info = load_checkpoint(stage1_folder, expect_kind="stage1", towers="both")
    fresh = WorldModel(model.config)
    fresh.initialise(torch.Generator().manual_seed(0))
    before = dict(fresh.named_parameters())
    changed = {name for name, value in model.named_parameters() if not torch.allclose(value, before[name], atol=2e-3)}
    assert any(".to_k." in name for name in changed)
    assert any(".add_q_proj." in name for name in changed)
    assert not any(name.startswith("action_encoder") for name in changed)
    assert info.metadata["sources"] == {"synthetic": 6}


def test_what_stage2_trains(model_config: MakeConfig) -> None:
    model = WorldModel(model_config())
    generation, action = stage2_groups(model, 66.0)
    assert action.multiplier == 66.0
    assert set(action.parameters) == {
        name for name, _ in model.named_parameters() if name.startswith("action_encoder.")
    }
    names = set(generation.parameters)
    # Filtering by "moe_gen" alone would leave the generation tower's attention frozen.
    for part in ("add_q_proj", "add_k_proj", "add_v_proj", "to_add_out", "norm_added_q", "norm_added_k", "mlp_moe_gen"):
        assert any(part in name for name in names), part
    for part in ("time_embedder", "proj_in", "proj_out", "norm_moe_gen"):
        assert any(name.startswith(part) for name in names), part
    for frozen in ("embed_tokens", ".to_q.", ".to_k.", ".to_v.", ".to_out.", ".mlp.", "action_encoder"):
        assert not any(frozen in name for name in names), frozen
    both = [set(group.parameters) for group in stage1_groups(model)]
    assert both[0] | both[1] | set(action.parameters) == {name for name, _ in model.named_parameters()}


def test_native_control_vectors_take_the_place_of_maps(world: Any, stage1_folder: Path, tmp_path: Path) -> None:
    """The paper's ablation: a Stage I model with maps becomes a Stage II model with FiLM, driven by its own vectors."""
    inputs = {**world.inputs, "stage1": stage1_folder}
    alone = {"native_size": 3, "vector_share": 1.0, "action_dropout": 0.0}
    result = train_stage2(stage2(30, **alone), inputs, tmp_path / "film")
    model, info = load_checkpoint(tmp_path / "film", expect_kind="stage2")
    assert (info.config.native_size, info.config.takes_maps, model.action_encoder) == (3, False, None)
    assert info.vectors == NativeVectors(embodiments=("square",), share=1.0)
    assert all(layer.weight.abs().max() > 0 for layer in model.action_film.proj)  # type: ignore[union-attr]
    assert result["validation/loss"] != result["validation/loss_shuffled_actions"]
    train_stage2(stage2(2, **alone), inputs | {"stage1": tmp_path / "film"}, tmp_path / "on")
    without = {name: folder for name, folder in inputs.items() if name != "tracks"}
    bare = train_stage2(stage2(30, **alone | {"vector_share": 0.3}), without, tmp_path / "bare")
    assert not load_checkpoint(tmp_path / "bare")[1].config.takes_maps  # nothing can be drawn
    assert bare["validation/loss"] == result["validation/loss"]  # vectors are the same, with cameras or without
    with pytest.raises(ConfigError, match=r"(?s)drawn from action tracks.*run render_actions"):
        train_stage2(stage2(2), without, tmp_path / "maps")
    with pytest.raises(DataError, match=r"(?s)driven by control vectors.*up to 1 numbers.*got: 2"):
        train_stage2(stage2(2, native_size=1), inputs, tmp_path / "small")
    with pytest.raises(CheckpointError, match=r"(?s)driven otherwise.*vectors, native_size 3.*maps, native_size None"):
        train_stage2(stage2(2), inputs | {"stage1": tmp_path / "film"}, tmp_path / "maps")


@pytest.mark.parametrize("action_frames", [1, 4])
def test_a_model_of_maps_also_learns_vectors_and_says_whose(
    world: Any, stage1_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, action_frames: int
) -> None:
    """Views of one batch take one or the other; a view without a camera always the vector, a model of maps alone never shows it."""
    seen: list[torch.Tensor] = []
    loss = FlowMatchingObjective.loss

    def watched(objective: FlowMatchingObjective, batch: Any, *rest: Any) -> Any:
        seen.append(batch.action_maps.unflatten(2, (action_frames, -1)).abs().amax(dim=(2, 4, 5, 6)))  # b v channels
        return loss(objective, batch, *rest)

    monkeypatch.setattr(FlowMatchingObjective, "loss", watched)
    inputs = {**world.inputs, "stage1": stage1_folder}
    config = stage2(20, native_size=3, vector_share=0.4, action_dropout=0.0, action_frames=action_frames)
    train_stage2(config, inputs, tmp_path / "both")
    info = load_checkpoint(tmp_path / "both")[1]
    assert (info.config.action_conditioning, info.vectors) == (
        "either", NativeVectors(embodiments=("square",), share=0.4),
    )  # fmt: skip
    given, drawn = (torch.cat(seen)[:, :, part].amax(dim=2) > 0 for part in (slice(-1, None), slice(9)))
    assert bool((given != drawn).all())
    assert 0.25 < float(given.float().mean()) < 0.55
    train_stage2(config, inputs | {"stage1": tmp_path / "both"}, tmp_path / "on")
    gained = stage2(2, native_size=3, action_frames=action_frames)
    seen.clear()
    train_stage2(stage2(6, action_frames=action_frames), inputs, tmp_path / "maps")
    assert bool((torch.cat(seen).amax(dim=2) > 0).all())  # a model of maps alone is never given nothing
    train_stage2(gained, inputs | {"stage1": tmp_path / "maps"}, tmp_path / "gained")
    assert load_checkpoint(tmp_path / "gained")[1].config.action_conditioning == "either"

    index = pq.read_table(inputs["tracks"] / "index.parquet")
    motion = [["static", "absent", "kinematics"]] * len(index)
    shutil.copytree(inputs["tracks"], tmp_path / "tracks")
    column = index.column_names.index("camera_motion")
    pq.write_table(index.set_column(column, "camera_motion", pa.array(motion)), tmp_path / "tracks" / "index.parquet")
    seen.clear()
    made = inputs | {"tracks": tmp_path / "tracks"}
    train_stage2(config, made, tmp_path / "partly")
    assert bool((torch.cat(seen)[:, 1, -1] == 1).all())
    assert not torch.cat(seen)[:, 1, :9].any()
    train_stage2(stage2(2, action_frames=action_frames), made, tmp_path / "two_views")
    assert read_checkpoint_info(tmp_path / "two_views").view_sets == (("head", "right_wrist"),)


def test_only_episodes_of_some_outcomes_can_be_trained_on(world: Any, stage1_folder: Path, tmp_path: Path) -> None:
    inputs = {**world.inputs, "stage1": stage1_folder}
    train_stage2(stage2(2, outcomes=["success"]), inputs, tmp_path / "out")
    assert load_checkpoint(tmp_path / "out")[1].metadata["episodes"] == 3  # of six
    with pytest.raises(DataError, match=r"(?s)No episode is left.*got: (outcome \w+ \d(, )?)+\n"):
        train_stage2(stage2(2, outcomes=["unknown"]), inputs, tmp_path / "none")


def test_outcomes_do_not_reach_the_model(world: Any, stage1_folder: Path, tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    flipped = tmp_path / "flipped"
    shutil.copytree(world.episodes, flipped)
    table = pq.read_table(flipped / "index.parquet")
    column = table.column_names.index("outcome")
    outcomes = ["failure" if value == "success" else "success" for value in table["outcome"].to_pylist()]
    pq.write_table(table.set_column(column, "outcome", pa.array(outcomes)), flipped / "index.parquet")
    inputs = {**world.inputs, "stage1": stage1_folder}
    train_stage2(stage2(2), inputs, tmp_path / "one")
    train_stage2(stage2(2), inputs | {"episodes": flipped}, tmp_path / "two")
    assert digested(tmp_path / "one") == digested(tmp_path / "two")


@pytest.mark.parametrize(
    ("name", "value", "found"),
    [("sigma_px_ref", 10.0, "60\\.0"), ("controls", "state", "action"), ("fps", 30.0, "8\\.0")],
)
def test_stage2_goes_on_with_maps_of_the_same_meaning_only(
    world: Any,
    model_config: MakeConfig,
    make_contract: Callable[..., ActionContract],
    tmp_path: Path,
    name: str,
    value: Any,
    found: str,
) -> None:
    model = WorldModel(model_config(towers="generation"))
    model.initialise(torch.Generator().manual_seed(0))
    other = make_contract(**({"sigma_px_ref": 60.0, "tokenizer": "synthetic"} | {name: value}))
    save_checkpoint(tmp_path / "stage2", model, kind="stage2", action_contract=other)
    with pytest.raises(CheckpointError, match=rf"(?s)action contract differs.*{name}.*{value}.*{found}"):
        train_stage2(stage2(2), {**world.inputs, "stage1": tmp_path / "stage2"}, tmp_path / "out")


@pytest.mark.parametrize(
    ("known", "told"),
    [
        (None, r"does not say which embodiments it saw; it now learns ['square']"),
        ({"ur5e": 2}, "saw ['ur5e']; it now learns ['square']"),
        ({"square": 1, "ur5e": 2}, None),
    ],
)
def test_stage2_goes_on_with_another_robot_and_says_so(
    world: Any,
    model_config: MakeConfig,
    make_contract: Callable[..., ActionContract],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    known: dict[str, int] | None,
    told: str | None,
) -> None:
    model = WorldModel(model_config(towers="generation"))
    model.initialise(torch.Generator().manual_seed(0))
    facts = {} if known is None else {"embodiments": known}
    contract = make_contract(sigma_px_ref=60.0, tokenizer="synthetic", grid_size=(4, 4))
    save_checkpoint(tmp_path / "before", model, kind="stage2", action_contract=contract, metadata=facts)
    train_stage2(stage2(2), {**world.inputs, "stage1": tmp_path / "before"}, tmp_path / "after")
    after = load_checkpoint(tmp_path / "after")[1]
    assert after.metadata["start"]["kind"] == "stage2"
    assert set(after.metadata["embodiments"]) == {"square"}
    assert ("it now learns" in caplog.text) is (told is not None)
    assert told is None or told in caplog.text


def test_controls_of_whole_intervals_reach_the_model_from_a_checkpoint_that_knew_none(
    world: Any, stage1_folder: Path, tmp_path: Path
) -> None:
    inputs = {**world.inputs, "stage1": stage1_folder}
    train_stage2(stage2(2), inputs, tmp_path / "own")
    train_stage2(stage2(2, action_frames=4), {**inputs, "stage1": tmp_path / "own"}, tmp_path / "all")
    model, info = load_checkpoint(tmp_path / "all")
    assert info.config.action_frames == 4
    assert bool((model.action_encoder.proj.weight[:, model.action_encoder.proj.in_features // 4 :] != 0).any())
    with pytest.raises(CheckpointError, match=r"(?s)takes the controls of more frames.*action_frames 4"):
        train_stage2(stage2(2), {**inputs, "stage1": tmp_path / "all"}, tmp_path / "back")


def test_wrong_checkpoint_and_missing_teacher_are_named(
    world: Any,
    model_config: MakeConfig,
    stage1_folder: Path,
    make_contract: Callable[..., ActionContract],
    make_spec: Callable[..., CausalSpec],
    tmp_path: Path,
) -> None:
    model = WorldModel(model_config(towers="generation"))
    model.initialise(torch.Generator().manual_seed(0))
    save_checkpoint(tmp_path / "causal", model, kind="causal", action_contract=make_contract(), causal=make_spec())
    with pytest.raises(CheckpointError, match="wrong kind"):
        train_stage2(stage2(2), {**world.inputs, "stage1": tmp_path / "causal"}, tmp_path / "out")
    with pytest.raises(ConfigError, match="need a teacher"):
        train_stage2(stage2(2, relational={}), {**world.inputs, "stage1": stage1_folder}, tmp_path / "out")
    with pytest.raises(CheckpointError, match="holds no relational teacher"):
        inputs = {**world.inputs, "stage1": stage1_folder, "teacher": tmp_path}
        train_stage2(stage2(2, relational={}), inputs, tmp_path / "out")


def test_a_teacher_is_trained_and_frozen(world: Any, teacher: Path) -> None:
    from worldline_core.training.clip_sampler import Clip
    from worldline_core.training.relational import TeacherSimilarities, similarity_matrices
    from worldline_core.training.training_config import RelationalConfig
    from worldline_core.training.video_teacher import load_teacher

    description = json.loads((teacher / "teacher.json").read_text())
    assert description["metrics"]["validation/loss"] > 0
    loaded = load_teacher(teacher)
    source = TeacherSimilarities(loaded, world.episodes, RelationalConfig(cached_clips=1))
    clip, views = Clip("episode-003", 0, 9, 1), ("head", "left_wrist")
    first = source.similarities((clip,), views, (3, 2, 2))
    assert (first.shape, first.intra.shape, first.cross.shape) == ((3, 2, 2), (1, 2, 2, 4, 4), (1, 1, 3, 4, 4))
    assert source.similarities((clip,), views, (3, 2, 2)).intra is not first.intra
    assert torch.equal(source.similarities((clip,), views, (3, 2, 2)).intra, first.intra)
    later = source.similarities((replace(clip, start=8),), views, (3, 2, 2))
    assert not torch.equal(later.intra, first.intra)
    # What is kept is what the unpooled features, in half precision, give.
    position = source.episodes.position("episode-003")
    frames = torch.from_numpy(np.stack([source.episodes.frames(position, view, list(clip.frames)) for view in views]))
    features = loaded.features((frames.float() / 255).permute(0, 4, 1, 2, 3)).half().float()
    assert torch.equal(similarity_matrices(features[None], (3, 2, 2)).cross, first.cross)
    assert not any(parameter.requires_grad for parameter in loaded.parameters())  # type: ignore[attr-defined]
