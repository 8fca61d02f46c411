"""The whole distill step on random weights: its result, its resumption after kills, its refusals; from frames, and without a view."""

import json
from dataclasses import dataclass
from functools import partialmethod
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import torch
from pydantic import ValidationError

from flows.pipeline import chain
from tasks.execution.chain import outline
from tests.distillation.conftest import SIGMA, trainer
from tests.rollout.conftest import SIZE, mixed_views, small_model
from tests.training.conftest import FRAME_INPUT, Killed, stage1, stage2, write_tokenizer
from worldline_core.actions.episode_tracks import ActionTracks, write_index
from worldline_core.config import load_config
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.distillation import trajectory_regression
from worldline_core.distillation.causal_teacher_forcing import TeacherForcingObjective
from worldline_core.distillation.distill import distill
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.distillation.distribution_matching import DistributionMatchingObjective
from worldline_core.distillation.trajectory_regression import (
    TrajectoryObjective,
    TrajectoryStore,
    robot_masks,
    substep_sigmas,
    write_trajectories,
)
from worldline_core.errors import ArtifactError, CheckpointError, DataError
from worldline_core.model.checkpoint import load_checkpoint, read_checkpoint_info, save_checkpoint, write_weights
from worldline_core.model.networks import build_world_model
from worldline_core.model.tokenizers import load_tokenizer
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import TrainedClips, WanConfig
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.rollout.samplers import BlockCausalSimulator, Noise
from worldline_core.rollout.worldline import WorldLine
from worldline_core.store.artifact_files import digest_folder, read_json_lines
from worldline_core.training.clip_config import EncodeLatentsConfig
from worldline_core.training.clip_loader import ClipLoader
from worldline_core.training.clip_sampler import Clip, ClipBatch
from worldline_core.training.clip_source import FrameSource, LatentStore
from worldline_core.training.encode_latents import encode_latents
from worldline_core.training.stage1 import train_stage1
from worldline_core.training.stage2 import train_stage2

SAVING = {"save_every_steps": 2}


def config(**changes):
    forcing = {"history_noise": 0.1, "view_weights": {"joint": 1.0, "head": 1.0}, "single_view_factor": 2}
    trajectories = {"clips": 4, "clips_per_shard": 2, "substeps": [1, 1, 1, 2]}
    return DistillConfig.model_validate({
        "clips": {"lengths": [17]}, "block_size": 2, "teacher_forcing": {"trainer": trainer(3, **SAVING), **forcing},
        "trajectory_regression": {"trainer": trainer(3, **SAVING), "trajectories": trajectories},
        "distribution_matching": {"trainer": trainer(6, **SAVING)}, **changes,
    })  # fmt: skip


TRAJECTORIES = {"clips": 2, "clips_per_shard": 2, "substeps": [1, 1, 1, 1]}
QUICK = {"trajectory_regression": {"trainer": trainer(1), "trajectories": TRAJECTORIES}}
"""For tests of the first step, or of what all steps begin with."""


@dataclass(frozen=True)
class Finished:
    """A distillation that nothing disturbed."""

    inputs: dict[str, Path]
    output: Path
    counts: dict[str, object]


@pytest.fixture(scope="module")
def finished(tmp_path_factory, written):
    output = tmp_path_factory.mktemp("finished") / "out"
    return Finished(written, output, distill(config(), written, output))


def test_three_steps_give_a_causal_checkpoint(finished, monkeypatch):
    output, counts = finished.output, finished.counts
    model, info = load_checkpoint(output, expect_kind="causal")
    start, before = load_checkpoint(finished.inputs["stage2"])
    assert (info.metadata["distillation"], info.contract) == ("distribution_matching", before.contract)
    assert info.causal == config().spec
    assert info.causal.sigmas == pytest.approx([1, 15 / 16, 5 / 6, 5 / 8, 0])
    assert counts["lpips"] == info.metadata["lpips"] == "off: no LPIPS weights configured"
    assert counts["episodes"] == 2
    json.dumps(counts, allow_nan=False)
    assert not any(torch.equal(a, b) for a, b in zip(model.parameters(), start.parameters(), strict=True))
    for step in ("teacher_forcing", "trajectory_regression", "distribution_matching"):
        rows = read_json_lines(output / step / "metrics.jsonl")
        assert rows[-1]["validation/rollout_error"] > 0
        assert f"{step}/validation/rollout_error" in counts
        if step != "distribution_matching":
            load_checkpoint(output / step, expect_kind="causal")
    # Scaled by their share of the iterations: the mean over a cycle is the mean of the updates that report them.
    weights = {
        "fake_score": 5, "distribution_matching": 1, "anchor": 0.005, "boundary": 0.05, "robot": 0.005, "robot_motion": 0.1,
    }  # fmt: skip
    assert rows[0]["loss"] == pytest.approx(
        sum(rows[0][name] * weight for name, weight in weights.items()) / 6, rel=1e-4
    )
    index = json.loads((output / "trajectory_regression" / "trajectories.json").read_text())
    assert len(index["shards"]) == 2
    monkeypatch.setattr("worldline_core.distillation.distill.train", None)  # a finished run is read, not repeated
    assert distill(config(), finished.inputs, output) == counts


@pytest.mark.parametrize("last", ["teacher_forcing", "trajectory_regression"])
def test_the_last_step_gives_the_result(finished, tmp_path, last):
    """The same model as in a whole distillation; what comes after it is not done."""
    unread = {"lpips_weights": tmp_path / "missing"} if last == "teacher_forcing" else {}  # no step of it uses them
    counts = distill(config(last_step=last, **unread), finished.inputs, tmp_path)
    assert counts["lpips"].startswith("off")
    found, whole = read_checkpoint_info(tmp_path), read_checkpoint_info(finished.output / last)
    assert (found.metadata["distillation"], found.weights_sha256) == (last, whole.weights_sha256)
    assert list(counts["steps"])[-1] == last and not (tmp_path / last / "checkpoint.json").exists()
    assert read_json_lines(tmp_path / last / "metrics.jsonl")[-1]["validation/rollout_error"] > 0
    assert (tmp_path / "run" / "trajectories").exists() == (last == "trajectory_regression")
    assert not (tmp_path / "distribution_matching").exists()


def test_blocks_window_and_nodes_of_the_config_are_those_of_training_and_of_the_result(inputs, tmp_path, monkeypatch):
    """Blocks of two latent frames, no recent block, nodes of two steps: distilled, saved and rolled out so."""
    trajectories = {"clips": 2, "clips_per_shard": 2, "substeps": [1, 2]}
    regression = {"trainer": trainer(2), "trajectories": trajectories}
    window = {"sink_blocks": 1, "recent_blocks": 0}
    small = config(window=window, sigmas=(1.0, 0.6, 0.0), trajectory_regression=regression)
    passes, forward = [], WorldModel.forward_block

    def watch(model, noisy, sigma, cache, **rest):
        passes.append((noisy.shape[3], cache.frames, float(sigma)))
        return forward(model, noisy, sigma, cache, **rest)

    monkeypatch.setattr(WorldModel, "forward_block", watch)
    distill(small, inputs, tmp_path / "out")
    # The nodes, and the sub-step of the teacher between 0.6 and 0.
    levels = (1.0, 0.6, substep_sigmas(0.6, 0.0, 2)[1])
    assert set(passes) == {(2, 1, level) for level in levels}
    for folder in (tmp_path / "out" / "teacher_forcing", tmp_path / "out"):
        model, info = load_checkpoint(folder)
        assert info.causal == small.spec and info.causal.recent_blocks == 0

    class Codec:
        latent_channels, spatial_compression, temporal_compression = 4, 8, 4

    world = WorldLine(model, info, Codec(), bfloat16=False)
    assert (world.steps, world.frames_per_unit) == (2, 8)
    passes.clear()
    first, maps = torch.randn(1, 3, 4, 4, 4), torch.randn(1, 3, 9, 5, 4, 4)
    simulator = BlockCausalSimulator(world.model, world.causal, noise=Noise([42]))
    simulator.start(first, maps[:, :, :, :1])
    for _ in range(4):
        simulator.step(maps[:, :, :, 3:])
    assert set(passes) == {(2, 1, 1.0), (2, 1, 0.6)}


@pytest.mark.slow
def test_the_head_alone_is_distilled_and_said(inputs, tmp_path):
    model, info = load_checkpoint(inputs["stage2"])
    head = TrainedClips(view_sets=(("head",),), strides=(1,))
    save_checkpoint(tmp_path / "head", model, kind="stage2", action_contract=info.contract, trained=head)
    given, alone = inputs | {"stage2": tmp_path / "head"}, config(**QUICK).model_copy(update={"views": ["head"]})
    for settings, wrong in ((config(), given), (alone, inputs)):
        with pytest.raises(DataError, match=r"(?s)not trained on these views together.*distill\.views"):
            distill(settings, wrong, tmp_path / "refused")
    distill(alone, given, tmp_path / "out")
    found = read_checkpoint_info(tmp_path / "out")
    assert (found.trained, found.views) == (head, ("head",))


@pytest.mark.slow
def test_a_causal_model_goes_on_beside_its_teacher(finished, tmp_path, make_model):
    """With other nodes, on blocks of generated history, part of them the teacher's."""
    given = finished.inputs | {"causal": finished.output}
    forcing = {"trainer": trainer(3), "history": "generated", "teacher_share": 0.5}
    other = config(teacher_forcing=forcing, **QUICK).model_copy(update={"sigmas": (1.0, 0.9, 0.8, 0.6, 0.0)})
    distill(other, given, tmp_path / "out")
    begun, forced = (load_checkpoint(root)[0] for root in (finished.output, tmp_path / "out" / "teacher_forcing"))
    assert not torch.equal(next(begun.parameters()), next(forced.parameters()))
    assert read_json_lines(tmp_path / "out/teacher_forcing/metrics.jsonl")[-1]["validation/rollout_error"] > 0
    before, after = read_checkpoint_info(finished.output), read_checkpoint_info(tmp_path / "out" / "teacher_forcing")
    assert after.metadata["start"] == {"kind": "causal", "weights_sha256": before.weights_sha256}
    assert after.causal == other.spec != before.causal
    meant = before.contract.model_copy(update={"fps": 5.0})
    for kind, changes, contract, message in (
        (
            "causal",
            {"intermediate_size": 40},
            before.contract,
            "Stage II model of its own form.*intermediate_size.*got: .*40",
        ),
        ("causal", {}, meant, r"contract differs.*fps.*expected: .*5\.0.*got: .*8\.0"),
        ("stage2", {}, before.contract, "wrong kind.*causal.*stage2"),
    ):
        model, causal = make_model(0, **changes), before.causal if kind == "causal" else None
        save_checkpoint(tmp_path / "wrong", model, kind=kind, action_contract=contract, causal=causal)
        with pytest.raises(CheckpointError, match=f"(?s){message}"):
            distill(config(), given | {"causal": tmp_path / "wrong"}, tmp_path / "no")


def killing(function, at_call):
    """The function, but its call number `at_call` raises, as a kill at this moment would end it."""
    calls = iter(range(1, 1000))

    def wrapped(*args, **kwargs):
        if next(calls) == at_call:
            raise Killed("killed")
        return function(*args, **kwargs)

    return wrapped


@pytest.mark.slow
def test_a_run_killed_anywhere_ends_with_the_same_bytes(finished, tmp_path, monkeypatch):
    for owner, name, call in (
        (TeacherForcingObjective, "loss", 3), (trajectory_regression, "write_bytes_atomic", 2),
        (TrajectoryObjective, "loss", 3), (DistributionMatchingObjective, "loss", 4),
    ):  # fmt: skip
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, killing(getattr(owner, name), call))
            with pytest.raises(Killed, match="killed"):
                distill(config(), finished.inputs, tmp_path)
    distill(config(), finished.inputs, tmp_path)
    assert digest_folder(tmp_path) == digest_folder(finished.output)


def test_exit_steps_do_not_depend_on_the_rank_and_cover_the_schedule(make_model):
    model = make_model(0)
    objective = DistributionMatchingObjective(model, make_model(1), make_model(2), config(), None)
    steps = [objective.exit_step(step) for step in range(60)]
    assert steps == [objective.exit_step(step) for step in range(60)]
    assert set(steps) == {0, 1, 2, 3}


def test_masks_follow_the_robot_and_skip_views_without_calibration(finished):
    tracks = ActionTracks.open(finished.inputs["tracks"])
    loader = ClipLoader(LatentStore.open(finished.inputs["latents"]), views=VIEWS, tracks=tracks)
    masks = robot_masks(loader, [Clip("episode-001", 0, 17, 1), Clip("episode-002", 4, 17, 1)], VIEWS)
    assert masks.shape == (2, 3, 5, 4, 4)
    assert set(masks.unique().tolist()) == {0.0, 1.0}
    assert not bool(masks[:, 2].any())
    columns = [masks[0, 0, t].amax(0) for t in (0, 4)]
    begin, end = ((column * torch.arange(4.0)).sum() / column.sum() for column in columns)
    assert end > begin


@pytest.mark.slow
def test_adapters_train_every_step_and_the_scores_share_their_weights(inputs, tmp_path, monkeypatch):
    scores = []

    def kept(*models):
        scores.extend(models)
        return DistributionMatchingObjective(*models)

    monkeypatch.setattr("worldline_core.distillation.distill.DistributionMatchingObjective", kept)
    saving = {"precision": "bf16", "weights": "bf16", "average": "host"}
    forms = {
        name: {"trainer": trainer(steps, **saving)}
        for name, steps in (("teacher_forcing", 1), ("distribution_matching", 6))
    }
    forms["trajectory_regression"] = {"trainer": trainer(1, **saving), "trajectories": TRAJECTORIES}
    distill(config(lora={"rank": 2}, **forms), inputs, tmp_path / "out")
    _, real, fake, *_ = scores
    trained = {name for name, value in fake.named_parameters() if value.requires_grad}
    assert all("lora" in name or name.startswith("action_encoder") or name == "view_embedding" for name in trained)
    own = {name.replace(".base_layer.", "."): value for name, value in fake.named_parameters()}
    places = {name: (own[name].data_ptr(), value.data_ptr()) for name, value in real.named_parameters()}
    assert {name for name, (ours, theirs) in places.items() if ours != theirs} == {
        n for n in trained if "lora" not in n
    }
    last = read_checkpoint_info(tmp_path / "out" / "trajectory_regression").weights_sha256
    assert json.loads((tmp_path / "out" / "adapter" / "adapter.json").read_text())["start"] == last
    assert load_checkpoint(tmp_path / "out", expect_kind="causal")[0].action_encoder.proj.weight.any()


@pytest.mark.slow
def test_controls_of_whole_intervals_reach_every_step(inputs, tmp_path, make_model, make_contract):
    contract = make_contract(sigma_px_ref=SIGMA, tokenizer="synthetic")
    save_checkpoint(inputs["stage2"], make_model(0, action_frames=4), kind="stage2", action_contract=contract)
    distill(config(), inputs, tmp_path / "out")
    model, info = load_checkpoint(tmp_path / "out", expect_kind="causal")
    assert (info.contract, model.config.control_channels) == (contract, 36)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"clips": {"lengths": [17]}, "block_size": 3},
            r"lengths \[17\]: clips are one observed frame and whole blocks",
        ),
        ({"clips": {"view_weights": {"head": 1.0}}}, "hold all views"),
        ({"distribution_matching": {"sigma_range": [0.9, 0.1]}}, "must rise"),
        ({"sigmas": [1.0, 0.5, 0.0]}, r"one number per interval of sigmas is needed, 2"),
        ({"sigmas": [0.5, 1.0, 0.0]}, "must fall from at most 1 to 0"),
        ({"teacher_forcing": {"history": "generated", "history_noise": 0.1}}, "history_noise is of recorded blocks"),
        (
            {"clips": {"lengths": [33]}, "window": {"anchor_blocks": 4}},
            "anchor_blocks 4: the longest clip has 2 blocks",
        ),
    ],
)
def test_settings_that_contradict_each_other_are_refused(values, message):
    with pytest.raises(ValidationError, match=message):
        DistillConfig.model_validate(values)


def changed_json(path, change):
    path.write_text(json.dumps(change(json.loads(path.read_text()))))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda inputs: inputs.update(stage2=inputs["stage1"]), "wrong kind"),
        (
            lambda inputs: changed_json(inputs["latents"] / "store.json", lambda found: found | {"tokenizer": "other"}),
            "action contract differs.*tokenizer.*synthetic.*other",
        ),
        (
            lambda inputs: write_index(
                inputs["tracks"], pq.read_table(inputs["tracks"] / "index.parquet").to_pylist(), sigma_px_ref=10.0
            ),
            r"action contract differs.*tracks: sigma_px_ref.*40\.0.*10\.0",
        ),
        (
            lambda inputs: changed_json(
                inputs["stage2"] / "checkpoint.json",
                lambda found: found | {"action_contract": found["action_contract"] | {"controls": "state"}},
            ),
            "contract differs.*episode episode-.*: controls.*expected: .*state.*got: .*action",
        ),
    ],
    ids=["a Stage I checkpoint", "other latents", "tracks of another width", "measured joints, tracks of commands"],
)
def test_inputs_of_another_meaning_are_refused_before_the_first_step(inputs, tmp_path, change, message):
    change(inputs)
    with pytest.raises(CheckpointError, match=f"(?s){message}"):
        distill(config(), inputs, tmp_path / "out")


def test_trajectories_are_read_as_written_and_refused_when_other(tmp_path):
    nodes = torch.randn(2, 5, 3, 4, 4, 2, 2, generator=torch.Generator().manual_seed(0))

    def make(number):
        clips = (Clip("a", number, 17, 1), Clip("b", number, 17, 1, ("head",)))
        return ClipBatch(clips, VIEWS), {"nodes": nodes + number, "mask": torch.ones(2, 3, 5, 2, 2)}

    with pytest.raises(ArtifactError, match="Not a folder of finished"):
        TrajectoryStore.open(tmp_path)
    write_trajectories(tmp_path, 2, make, {"seed": 1})
    store = TrajectoryStore.open(tmp_path)
    assert store.views == [VIEWS] * len(store) == [VIEWS] * 4
    assert store.clips([3, 0]) == (Clip("b", 1, 17, 1, ("head",)), Clip("a", 0, 17, 1))
    torch.testing.assert_close(store.read("nodes", [3, 0]), torch.stack((nodes[1] + 1, nodes[0])), rtol=2e-3, atol=2e-3)
    assert store.read("mask", [1]).dtype == torch.float32
    with pytest.raises(ArtifactError, match=r"(?s)lacks a tensor.*shard-00000.*latents"):
        store.read("latents", [1])
    with pytest.raises(ArtifactError, match="other settings"):
        write_trajectories(tmp_path, 2, make, {"seed": 2})


HEAD, RIGHT = ("head",), ("head", "right_wrist")


@pytest.fixture(scope="module")
def mixed(tmp_path_factory, make_contract):
    """Recordings of three sets of views, each a split of its own, their latents, and a Stage II model of random weights."""
    root = tmp_path_factory.mktemp("missing_views")
    made, _ = mixed_views(root, {"three": "train", "two": "validation", "one": "test"})
    tokenizer = load_tokenizer(root / "tokenizer")
    contract = make_contract(grid_size=(4, 6), tokenizer=tokenizer.encoder_digest[:16], sigma_px_ref=40.0)
    trained = TrainedClips(view_sets=(VIEWS, RIGHT, HEAD), strides=(1,))
    save_checkpoint(root / "stage2", small_model(), kind="stage2", action_contract=contract, trained=trained)
    return {**made, "stage2": root / "stage2"}


def views_config(kind, splits, steps=16, **clips):
    trajectories = {"clips": steps, "clips_per_shard": 1, "substeps": [1, 1, 1, 1]}
    return config(
        input={"kind": kind} | ({"image_size": SIZE} if kind == "frames" else {}), clips={"lengths": [17], **clips},
        splits=splits, validation_splits=splits[-1:], teacher_forcing={"trainer": trainer(steps, batch_size=1)},
        trajectory_regression={"trainer": trainer(steps, batch_size=1), "trajectories": trajectories},
        distribution_matching={"trainer": trainer(steps + 2, batch_size=1)},
    )  # fmt: skip


@pytest.mark.parametrize("kind", ["latents", "frames"])
@pytest.mark.slow
def test_every_step_sees_every_set_of_views(mixed, tmp_path, monkeypatch, kind):
    seen = {}

    def watched(self, batch, *rest, loss):
        seen.setdefault(type(self).__name__, []).append(batch)
        return loss(self, batch, *rest)

    for objective in (TeacherForcingObjective, TrajectoryObjective, DistributionMatchingObjective):
        monkeypatch.setattr(objective, "loss", partialmethod(watched, loss=objective.loss))
    counts = distill(views_config(kind, ["train", "validation", "test"]), mixed, tmp_path)
    assert counts["kept"] == 6
    assert len(seen) == 3
    for batches in seen.values():
        assert {batch.views for batch in batches} == {VIEWS, RIGHT, HEAD}
        for batch in batches:
            assert batch.latents.shape[1] == len(batch.views)
            assert batch.clips[0].episode_id[:3] == ("one", "two", "thr")[len(batch.views) - 1]
    for batch in seen["TrajectoryObjective"]:
        assert batch.nodes.shape[2] == batch.mask.shape[1] == len(batch.views)  # type: ignore[attr-defined]
    assert read_checkpoint_info(tmp_path).view_sets == (VIEWS, RIGHT, HEAD)
    assert "validation/rollout_error" in " ".join(counts)


@pytest.mark.slow
def test_subsets_of_complete_recordings_are_distilled_and_known(mixed, tmp_path):
    model, info = load_checkpoint(mixed["stage2"])
    sets = (VIEWS, ("head", "left_wrist"), RIGHT, HEAD)
    trained = TrainedClips(view_sets=sets, strides=(1,))
    save_checkpoint(tmp_path / "all", model, kind="stage2", action_contract=info.contract, trained=trained)
    made = mixed | {"stage2": tmp_path / "all"}
    weights = {"joint": 0.4, "subset": 0.6}
    distill(views_config("latents", ["train"], view_weights=weights), made, tmp_path / "out")
    assert read_checkpoint_info(tmp_path / "out").view_sets == sets
    store = TrajectoryStore.open(tmp_path / "out" / "run" / "trajectories")
    assert len(set(store.views)) > 2
    assert {clip.episode_id[:3] for clip in store.clips(range(len(store)))} == {"thr"}  # the training split
    with pytest.raises(DataError, match=r"(?s)not trained on these views together.*expected: head \+ left_wrist \+"):
        distill(views_config("latents", ["train"], view_weights=weights), mixed, tmp_path / "refused")


@pytest.fixture
def recorded(inputs, tmp_path, make_model, make_contract):
    """The recordings with a tokenizer, its latents, and a Stage II model of them."""
    folders = inputs | {name: tmp_path / "own" / name for name in ("tokenizer", "latents", "stage2")}
    folders["tokenizer"].mkdir(parents=True)
    write_tokenizer(folders["tokenizer"])
    encode_latents(EncodeLatentsConfig(image_size=(32, 32)), folders, folders["latents"])
    tokenizer = json.loads((folders["latents"] / "store.json").read_text())["tokenizer"]
    contract = make_contract(sigma_px_ref=SIGMA, tokenizer=tokenizer)
    save_checkpoint(folders["stage2"], make_model(0), kind="stage2", action_contract=contract)
    return folders


@pytest.mark.slow
def test_wan_goes_the_whole_way_from_text_to_a_simulator(recorded, tmp_path):
    """Stage I on stored texts, Stage II on maps, distillation, and both models rolled out."""
    shape = {
        "network": "wan", "latent_channels": 4, "hidden_size": 24, "num_layers": 2, "num_heads": 2, "head_dim": 12,
        "intermediate_size": 32, "text_size": 10, "text_length": 6,
    }  # fmt: skip
    texts = {f"move {number}": torch.randn(2 + number, 10) for number in range(3)}
    write_weights(tmp_path / "texts.safetensors", texts, torch.float32)
    first = stage1(
        model=shape, text={"kind": "stored", "path": str(tmp_path / "texts.safetensors")}, trainer=trainer(8),
        clips={"lengths": [9], "view_weights": {"primary": 1}}, text_dropout=0.5,
    )  # fmt: skip
    train_stage1(first, recorded, tmp_path / "stage1")
    given = recorded | {"stage1": tmp_path / "stage1", "stage2": tmp_path / "stage2"}
    train_stage2(stage2(6, trainer=trainer(6), clips={"lengths": [17]}), given, tmp_path / "stage2")
    distill(config(**QUICK), given, tmp_path / "causal")
    parts = {"attn1", "attn2", "ffn", "time_proj", "text_embedder", "scale_shift_table", "proj_in", "proj_out"}
    before = build_world_model(WanConfig.model_validate(shape))
    before.initialise(torch.Generator().manual_seed(0))
    for kind in ("stage1", "stage2", "causal"):
        model, info = load_checkpoint(tmp_path / kind, expect_kind=kind)
        assert isinstance(info.config, WanConfig)
        changed = {
            name
            for name, new in model.named_parameters()
            if not torch.allclose(new, before.get_parameter(name), atol=1e-4)
        }
        assert all(any(part in name for name in changed) for part in parts)
        assert any("action_encoder.proj" in name for name in changed) is (kind != "stage1")
        before = model
        if kind == "stage1":
            continue
        world = WorldLine.from_pretrained(
            tmp_path / kind, tokenizer=recorded["tokenizer"], bfloat16=False, clip_frames=9
        )
        maps = torch.randn(1, 3, 9, 5, 4, 4)
        session = world.session(torch.zeros(1, 3, 3, 32, 32), [42])
        pictures = [session.step(maps[:, :, :, at : at + 3]) for at in (0, 2)]
        assert all(len(picture[0]["head"]) == 8 for picture in pictures)


def online(**changes):
    return config(input={**FRAME_INPUT, **changes})


@pytest.mark.slow
@pytest.mark.usefixtures("forked_loaders")
def test_frames_on_the_way_are_as_good_as_cached_latents(recorded, tmp_path, monkeypatch):
    distill(config(), recorded, tmp_path / "cached")
    inputs = {name: folder for name, folder in recorded.items() if name != "latents"}
    encoded, inner = [], FrameSource.latents

    def latents(self, read, device):
        encoded.append(len(read))
        return inner(self, read, device)

    monkeypatch.setattr(FrameSource, "latents", latents)
    distill(online(), inputs, tmp_path / "online")
    monkeypatch.undo()
    for step in ("teacher_forcing", "trajectory_regression", "."):
        cached, found = (load_checkpoint(tmp_path / kind / step)[0].state_dict() for kind in ("cached", "online"))
        for name, value in cached.items():
            torch.testing.assert_close(found[name], value, rtol=1e-3, atol=2e-4, msg=f"{step}: {name}")
    # Three steps of teacher forcing, two shards of trajectories, and one held-out batch after each of the three steps.
    assert len(encoded) == 3 + 2 + 3
    assert read_checkpoint_info(tmp_path / "online").metadata["input"]["kind"] == "frames"
    assert "input" not in read_checkpoint_info(tmp_path / "cached").metadata
    distill(online(workers=1), inputs, tmp_path / "ahead")
    weights = [(tmp_path / kind / "model.safetensors").read_bytes() for kind in ("online", "ahead")]
    assert weights[0] == weights[1]


def test_latents_are_encoded_before_where_a_step_reads_them_alone():
    frames = "{kind: frames, image_size: [64, 96]}"
    overrides = [f"{step}.input={frames}" for step in ("train_stage1", "train_stage2")]
    for last, cached in (([], True), ([f"distill.input={frames}"], False)):
        calls = outline(chain, load_config(PipelineConfig, preset="smoke", overrides=[*overrides, *last]))
        assert ("encode_latents" in calls) is ("latents" in calls["distill"].inputs) is cached
        for stage in ("train_stage1", "train_stage2"):
            assert {"latents", "tokenizer"} & calls[stage].inputs.keys() == {"tokenizer"}
