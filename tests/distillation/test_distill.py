"""The whole distill step on random weights and latents: its result, its resumption after kills, its refusals."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import torch
from pydantic import ValidationError

from tests.distillation.conftest import write_inputs  # pyright: ignore[reportMissingImports]
from worldline_core.actions.episode_tracks import ActionTracks, write_index
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.distillation import teacher_trajectories
from worldline_core.distillation.causal_teacher_forcing import TeacherForcingObjective
from worldline_core.distillation.distill import distill
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.distillation.distribution_matching import DistributionMatchingObjective
from worldline_core.distillation.teacher_trajectories import (
    TrajectoryStore,
    robot_masks,
    substep_sigmas,
    write_trajectories,
)
from worldline_core.distillation.trajectory_regression import TrajectoryObjective
from worldline_core.errors import ArtifactError, CheckpointError, DataError
from worldline_core.model.block_causal_attention import KVCache
from worldline_core.model.checkpoint import load_checkpoint, read_checkpoint_info, save_checkpoint
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import TrainedClips
from worldline_core.rollout.rollout import long_rollout
from worldline_core.rollout.worldline import WorldLine
from worldline_core.store.artifact_files import digest_file, folder_files
from worldline_core.training.clip_loader import ClipLoader
from worldline_core.training.clip_sampler import Clip, ClipBatch
from worldline_core.training.clip_source import LatentStore


def trainer(steps: int, **changes: object) -> dict[str, object]:
    return {
        "steps": steps,
        "batch_size": 2,
        "precision": "fp32",
        "log_every": 6,
        "validation_batches": 1,
        "save_every_seconds": 3600,
        "save_every_steps": 2,
        "optimizer": {"learning_rate": 1e-3, "warmup_steps": 2},
        **changes,
    }


def config() -> DistillConfig:
    return DistillConfig.model_validate(
        {
            "clips": {"lengths": [17]},
            "block_size": 2,
            "teacher_forcing": {
                "trainer": trainer(3),
                "history_noise": 0.1,
                "view_weights": {"joint": 1.0, "head": 1.0},
                "single_view_factor": 2,
            },
            "trajectory_regression": {
                "trainer": trainer(3),
                "trajectories": {"clips": 4, "clips_per_shard": 2, "substeps": [1, 1, 1, 2]},
            },
            "distribution_matching": {"trainer": trainer(12)},
        }
    )


def digests(folder: Path) -> dict[str, str]:
    return {path.relative_to(folder).as_posix(): digest_file(path) for path in folder_files(folder)}


@dataclass(frozen=True)
class Finished:
    """A distillation that nothing disturbed."""

    inputs: dict[str, Path]
    output: Path
    counts: dict[str, object]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, make_model: Callable, make_contract: Callable) -> Finished:
    inputs = write_inputs(tmp_path_factory.mktemp("inputs"), make_model, make_contract)
    output = tmp_path_factory.mktemp("finished") / "out"
    return Finished(inputs, output, distill(config(), inputs, output))


def test_three_steps_give_a_causal_checkpoint(finished: Finished) -> None:
    inputs, output, counts = finished.inputs, finished.output, finished.counts
    model, info = load_checkpoint(output, expect_kind="causal")
    assert info.metadata["distillation"] == "distribution_matching"
    assert info.contract == read_checkpoint_info(inputs["stage2"]).contract
    assert info.causal == config().spec
    assert info.causal.sigmas == pytest.approx([1, 15 / 16, 5 / 6, 5 / 8, 0])
    assert counts["lpips"] == info.metadata["lpips"] == "off: no LPIPS weights configured"
    assert counts["episodes"] == 2
    json.dumps(counts, allow_nan=False)
    start, _ = load_checkpoint(inputs["stage2"])
    changed = [not torch.equal(a, b) for a, b in zip(model.parameters(), start.parameters(), strict=True)]
    assert all(changed)
    for step in ("teacher_forcing", "trajectory_regression", "distribution_matching"):
        rows = [json.loads(line) for line in (output / step / "metrics.jsonl").read_text().splitlines()]
        assert rows[-1]["validation/rollout_error"] > 0
        assert f"{step}/validation/rollout_error" in counts
        if step != "distribution_matching":
            load_checkpoint(output / step, expect_kind="causal")
    losses = [row for row in rows if "fake_score" in row]
    assert {"distribution_matching", "robot", "robot_motion", "anchor", "boundary"} <= set(losses[-1])
    index = json.loads((output / "trajectory_regression" / "trajectories.json").read_text())
    assert len(index["shards"]) == 2


def test_blocks_window_and_nodes_of_the_config_are_those_of_training_and_of_the_result(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Blocks of two latent frames, no recent block, nodes of two steps: distilled, saved, rolled out and timed so."""
    small = DistillConfig.model_validate(
        config().model_dump()
        | {
            "window": {"sink_blocks": 1, "recent_blocks": 0},
            "sigmas": (1.0, 0.6, 0.0),
            "trajectory_regression": {
                "trainer": trainer(2),
                "trajectories": {"clips": 2, "clips_per_shard": 2, "substeps": [1, 2]},
            },
        }
    )
    passes: list[tuple[int, int, float]] = []
    forward = WorldModel.forward_block

    def watch(model: WorldModel, noisy: torch.Tensor, sigma: float, cache: KVCache, **rest: object) -> torch.Tensor:
        passes.append((noisy.shape[3], cache.frames, float(sigma)))
        return forward(model, noisy, sigma, cache, **rest)  # type: ignore[arg-type]

    monkeypatch.setattr(WorldModel, "forward_block", watch)
    distill(small, inputs, tmp_path / "out")
    assert {(size, held) for size, held, _ in passes} == {(2, 1)}
    # The nodes, and the sub-step of the teacher between 0.6 and 0.
    between = substep_sigmas(0.6, 0.0, 2)[1]
    assert {sigma for _, _, sigma in passes} == {1.0, 0.6, between}
    for folder in (tmp_path / "out" / "teacher_forcing", tmp_path / "out"):
        model, info = load_checkpoint(folder)
        assert info.causal == small.spec
        assert info.causal.recent_blocks == 0

    class Codec:
        latent_channels, spatial_compression, temporal_compression = 4, 8, 4

    world = WorldLine(model, info, Codec(), bfloat16=False)  # type: ignore[arg-type]
    assert (world.steps, world.frames_per_unit) == (2, 8)
    passes.clear()
    first, maps = torch.randn(1, 3, 4, 4, 4), torch.randn(1, 3, 9, 5, 4, 4)
    times = long_rollout(partial(world.simulator, [42]), first, maps, blocks=4)
    assert len(times["block_seconds"]) == 4
    assert set(passes) == {(2, 1, 1.0), (2, 1, 0.6)}


def test_the_head_alone_is_distilled_and_said(inputs: dict[str, Path], tmp_path: Path) -> None:
    model, info = load_checkpoint(inputs["stage2"])
    head = TrainedClips(view_sets=(("head",),), strides=(1,))
    save_checkpoint(tmp_path / "head", model, kind="stage2", action_contract=info.contract, trained=head)
    given = inputs | {"stage2": tmp_path / "head"}
    alone = config().model_copy(update={"views": ["head"]})
    for settings, model in ((config(), given), (alone, inputs)):
        with pytest.raises(DataError, match=r"(?s)not trained on these views together.*distill\.views"):
            distill(settings, model, tmp_path / "refused")
    distill(alone, given, tmp_path / "out")
    assert read_checkpoint_info(tmp_path / "out").trained == head
    assert read_checkpoint_info(tmp_path / "out").views == ("head",)


def test_a_causal_model_goes_on_beside_its_teacher(finished: Finished, tmp_path: Path, make_model: Callable) -> None:
    given = finished.inputs | {"causal": finished.output}
    other = config().model_copy(update={"sigmas": (1.0, 0.9, 0.8, 0.6, 0.0)})
    distill(other, given, tmp_path / "out")
    before, after = read_checkpoint_info(finished.output), read_checkpoint_info(tmp_path / "out" / "teacher_forcing")
    assert after.metadata["start"] == {"kind": "causal", "weights_sha256": before.weights_sha256}
    assert after.causal == other.spec != before.causal
    wider = make_model(0, intermediate_size=40)
    save_checkpoint(tmp_path / "wide", wider, kind="causal", action_contract=before.contract, causal=before.causal)
    with pytest.raises(
        CheckpointError, match=r"(?s)Stage II model of its own form.*wide: intermediate_size.*got: .*40"
    ):
        distill(config(), given | {"causal": tmp_path / "wide"}, tmp_path / "no")
    meant = before.contract.model_copy(update={"fps": 5.0})
    save_checkpoint(tmp_path / "rate", make_model(0), kind="causal", action_contract=meant, causal=before.causal)
    with pytest.raises(CheckpointError, match=r"(?s)contract differs.*fps.*expected: .*5\.0.*got: .*8\.0"):
        distill(config(), given | {"causal": tmp_path / "rate"}, tmp_path / "no")
    save_checkpoint(tmp_path / "two", make_model(0), kind="stage2", action_contract=before.contract)
    with pytest.raises(CheckpointError, match=r"(?s)wrong kind.*causal.*stage2"):
        distill(config(), given | {"causal": tmp_path / "two"}, tmp_path / "no")


def test_blocks_learn_from_generated_history_and_stage2_as_well(finished: Finished, tmp_path: Path) -> None:
    plain = config().model_dump(mode="json")
    plain["teacher_forcing"] |= {"history": "generated", "history_noise": 0.0, "teacher_share": 0.5}
    distill(DistillConfig.model_validate(plain), finished.inputs, tmp_path)
    before, after = (load_checkpoint(root / "teacher_forcing")[0] for root in (finished.output, tmp_path))
    assert not torch.equal(next(before.parameters()), next(after.parameters()))
    rows = [json.loads(line) for line in (tmp_path / "teacher_forcing/metrics.jsonl").read_text().splitlines()]
    assert rows[-1]["validation/rollout_error"] > 0


def test_a_finished_run_is_read_not_repeated(finished: Finished, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: object, **kwargs: object) -> None:
        raise RuntimeError("trained again")

    monkeypatch.setattr("worldline_core.distillation.distill.train", refuse)
    assert distill(config(), finished.inputs, finished.output) == finished.counts


class KilledError(Exception):
    pass


def killing(function: Callable, at_call: int) -> Callable:
    """The function, but its call number `at_call` raises, as a kill at this moment would end it."""
    calls = 0

    def wrapped(*args: object, **kwargs: object) -> object:
        nonlocal calls
        calls += 1
        if calls == at_call:
            raise KilledError("killed")
        return function(*args, **kwargs)

    return wrapped


@pytest.mark.slow
def test_a_run_killed_anywhere_ends_with_the_same_bytes(
    finished: Finished, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings, inputs, whole = config(), finished.inputs, finished.output
    kills = [
        (TeacherForcingObjective, "loss", 3),
        (teacher_trajectories, "write_bytes_atomic", 2),
        (TrajectoryObjective, "loss", 3),
        (DistributionMatchingObjective, "loss", 8),
    ]
    for owner, name, call in kills:
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, killing(getattr(owner, name), call))
            with pytest.raises(KilledError, match="killed"):
                distill(settings, inputs, tmp_path / "killed")
    distill(settings, inputs, tmp_path / "killed")
    assert digests(tmp_path / "killed") == digests(whole)


def test_exit_steps_do_not_depend_on_the_rank_and_cover_the_schedule(make_model: Callable) -> None:
    model = make_model(0)
    objective = DistributionMatchingObjective(model, make_model(1), make_model(2), config(), None)
    steps = [objective.exit_step(step) for step in range(60)]
    assert steps == [objective.exit_step(step) for step in range(60)]
    assert set(steps) == {0, 1, 2, 3}


def test_an_iteration_changes_one_of_the_two_models(finished: Finished) -> None:
    rows = (finished.output / "distribution_matching" / "metrics.jsonl").read_text().splitlines()
    first = json.loads(rows[0])
    # Scaled by their share of the iterations: the mean over a cycle is the mean of the updates that report them.
    assert first["loss"] == pytest.approx(
        (
            5 * first["fake_score"]
            + first["distribution_matching"]
            + 0.005 * first["anchor"]
            + 0.05 * first["boundary"]
            + 0.005 * first["robot"]
            + 0.1 * first["robot_motion"]
        )
        / 6,
        rel=1e-4,
    )


def test_masks_follow_the_robot_and_skip_views_without_calibration(inputs: dict[str, Path]) -> None:
    views = ("head", "left_wrist", "right_wrist")
    tracks = ActionTracks.open(inputs["tracks"])
    loader = ClipLoader(LatentStore.open(inputs["latents"]), views=views, tracks=tracks)
    masks = robot_masks(loader, [Clip("a", 0, 17, 1), Clip("b", 4, 17, 1)], views)
    assert masks.shape == (2, 3, 5, 4, 4)
    assert set(masks.unique().tolist()) == {0.0, 1.0}
    assert not bool(masks[:, 2].any())
    columns = torch.arange(4.0)
    centre = [(masks[0, 0, t].amax(0) * columns).sum() / masks[0, 0, t].amax(0).sum() for t in (0, 4)]
    assert centre[1] > centre[0]


@pytest.mark.slow
def test_controls_of_whole_intervals_reach_every_step(
    inputs: dict[str, Path], tmp_path: Path, make_model: Callable[..., WorldModel], make_contract: Callable
) -> None:
    contract = make_contract(sigma_px_ref=40.0)
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
    ],
)
def test_clips_are_whole_blocks_of_all_views(values: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        DistillConfig.model_validate(values)


def test_only_a_stage2_checkpoint_of_the_same_latents_is_distilled(inputs: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="wrong kind"):
        distill(config(), {**inputs, "stage2": inputs["stage1"]}, tmp_path / "out")
    description = json.loads((inputs["latents"] / "store.json").read_text())
    (inputs["latents"] / "store.json").write_text(json.dumps({**description, "tokenizer": "other"}))
    with pytest.raises(CheckpointError, match=r"(?s)action contract differs.*tokenizer.*0123.*other"):
        distill(config(), inputs, tmp_path / "out2")


def test_tracks_of_another_width_are_refused(inputs: dict[str, Path], tmp_path: Path) -> None:
    write_index(inputs["tracks"], pq.read_table(inputs["tracks"] / "index.parquet").to_pylist(), sigma_px_ref=10.0)
    with pytest.raises(CheckpointError, match=r"(?s)action contract differs.*tracks: sigma_px_ref.*40\.0.*10\.0"):
        distill(config(), inputs, tmp_path / "out")


def test_controls_of_another_meaning_are_refused_before_the_first_step(inputs: dict[str, Path], tmp_path: Path) -> None:
    """A Stage II model of measured joints, tracks of commands."""
    path = inputs["stage2"] / "checkpoint.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | {"action_contract": content["action_contract"] | {"controls": "state"}}))
    with pytest.raises(
        CheckpointError, match=r"(?s)contract differs.*episode a: controls.*expected: .*state.*got: .*action"
    ):
        distill(config(), inputs, tmp_path / "out")


def test_noise_levels_of_the_wrong_order_are_refused() -> None:
    with pytest.raises(ValidationError, match="must rise"):
        DistillConfig.model_validate({"distribution_matching": {"sigma_range": [0.9, 0.1]}})
    with pytest.raises(ValidationError, match=r"one number per interval of sigmas is needed, 2"):
        DistillConfig.model_validate({"sigmas": [1.0, 0.5, 0.0]})
    with pytest.raises(ValidationError, match="must fall from at most 1 to 0"):
        DistillConfig.model_validate({"sigmas": [0.5, 1.0, 0.0]})


def test_trajectories_are_read_as_written_and_refused_when_other(tmp_path: Path) -> None:
    nodes = torch.randn(2, 5, 3, 4, 4, 2, 2, generator=torch.Generator().manual_seed(0))
    mask = torch.ones(2, 3, 5, 2, 2)

    def make(number: int) -> tuple[ClipBatch, dict[str, torch.Tensor]]:
        clips = (Clip("a", number, 17, 1), Clip("b", number, 17, 1, ("head",)))
        return ClipBatch(clips, VIEWS), {"nodes": nodes + number, "mask": mask}

    with pytest.raises(ArtifactError, match="Not a folder of finished"):
        TrajectoryStore.open(tmp_path)
    write_trajectories(tmp_path, 2, make, {"seed": 1})
    store = TrajectoryStore.open(tmp_path)
    assert len(store) == 4
    assert store.clips([3, 0]) == (Clip("b", 1, 17, 1, ("head",)), Clip("a", 0, 17, 1))
    assert store.views == [VIEWS] * 4
    torch.testing.assert_close(store.read("nodes", [3, 0]), torch.stack((nodes[1] + 1, nodes[0])), rtol=2e-3, atol=2e-3)
    assert store.read("mask", [1]).dtype == torch.float32
    with pytest.raises(ArtifactError, match=r"(?s)lacks a tensor.*shard-00000.*latents"):
        store.read("latents", [1])
    with pytest.raises(ArtifactError, match="other settings"):
        write_trajectories(tmp_path, 2, make, {"seed": 2})
