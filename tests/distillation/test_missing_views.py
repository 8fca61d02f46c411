"""Distillation on recordings that lack a view: clips of the same views together, and nothing else changes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.rollout.conftest import SIZE, recorded, write_recordings  # pyright: ignore[reportMissingImports]
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.distillation.causal_objective import CausalObjective
from worldline_core.distillation.causal_teacher_forcing import TeacherForcingObjective
from worldline_core.distillation.distill import distill
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.distillation.distribution_matching import DistributionMatchingObjective
from worldline_core.distillation.teacher_trajectories import TrajectoryStore
from worldline_core.distillation.trajectory_regression import TrajectoryObjective
from worldline_core.errors import DataError
from worldline_core.model.checkpoint import load_checkpoint, read_checkpoint_info, save_checkpoint
from worldline_core.model.tokenizers import fit_patch_tokenizer
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import TrainedClips, WorldModelConfig
from worldline_core.training.clip_config import EncodeLatentsConfig
from worldline_core.training.clip_loader import Batch
from worldline_core.training.encode_latents import encode_latents

HEAD, RIGHT = ("head",), ("head", "right_wrist")
EPISODES = tuple(
    (f"{name}-{number}", split, 17, views, views)
    for name, split, views in (("three", "train", VIEWS), ("two", "validation", RIGHT), ("one", "test", HEAD))
    for number in range(2)
)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory, make_contract: Callable) -> dict[str, Path]:
    """Recordings of three sets of views, each a split of its own, their latents, and a Stage II model of random weights."""
    root = tmp_path_factory.mktemp("missing_views")
    made = {**write_recordings(root, EPISODES), "tokenizer": root / "tokenizer"}
    video = torch.stack([torch.from_numpy(recorded(s)) for s in range(4)]).permute(0, 4, 1, 2, 3).float() / 127.5 - 1
    tokenizer = fit_patch_tokenizer([video], channels=8, refinement_width=4, refinement_depth=1)
    tokenizer.save(root / "tokenizer")
    encode_latents(EncodeLatentsConfig(image_size=SIZE), made, root / "latents")
    model = WorldModel(
        WorldModelConfig(
            latent_channels=8, hidden_size=24, num_layers=1, num_heads=2, num_kv_heads=1, head_dim=12,
            intermediate_size=32, rope_sections=(2, 2, 2), towers="generation",
        )
    )  # fmt: skip
    model.initialise(torch.Generator().manual_seed(0))
    contract = make_contract(grid_size=(4, 6), tokenizer=tokenizer.encoder_digest[:16], sigma_px_ref=40.0)
    trained = TrainedClips(view_sets=(VIEWS, RIGHT, HEAD), strides=(1,))
    save_checkpoint(root / "stage2", model, kind="stage2", action_contract=contract, trained=trained)
    return {**made, "latents": root / "latents", "stage2": root / "stage2"}


def config(kind: str, splits: list[str], **clips: Any) -> DistillConfig:
    trainer = {"batch_size": 1, "precision": "fp32", "log_every": 6, "validation_batches": 1}
    source = {"kind": kind} | ({"image_size": SIZE} if kind == "frames" else {})
    return DistillConfig.model_validate(
        {
            "input": source, "clips": {"lengths": [17], **clips}, "splits": splits,
            "validation_splits": splits[-1:], "block_size": 2,
            "teacher_forcing": {"trainer": {**trainer, "steps": 16}},
            "trajectory_regression": {
                "trainer": {**trainer, "steps": 16},
                "trajectories": {"clips": 16, "clips_per_shard": 1, "substeps": [1, 1, 1, 1]},
            },
            "distribution_matching": {"trainer": {**trainer, "steps": 18}},
        }
    )  # fmt: skip


@pytest.mark.parametrize("kind", ["latents", "frames"])
@pytest.mark.slow
def test_every_step_sees_every_set_of_views(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    seen: dict[str, list[Batch]] = {}

    def watch(objective: type[CausalObjective[Any]]) -> None:
        loss = objective.loss

        def watched(self: CausalObjective[Any], batch: Batch, *rest: Any) -> Any:
            seen.setdefault(objective.__name__, []).append(batch)
            return loss(self, batch, *rest)

        monkeypatch.setattr(objective, "loss", watched)

    for objective in (TeacherForcingObjective, TrajectoryObjective, DistributionMatchingObjective):
        watch(objective)
    counts = distill(config(kind, ["train", "validation", "test"]), inputs, tmp_path)
    assert counts["kept"] == 6
    for batches in seen.values():
        assert {batch.views for batch in batches} == {VIEWS, RIGHT, HEAD}
        for batch in batches:
            number = len(batch.views)
            assert batch.latents.shape[1] == number
            assert batch.clips[0].episode_id[:3] == {3: "thr", 2: "two", 1: "one"}[number]
    for batch in seen["TrajectoryObjective"]:
        assert batch.nodes.shape[2] == batch.mask.shape[1] == len(batch.views)  # type: ignore[attr-defined]
    assert read_checkpoint_info(tmp_path).view_sets == (VIEWS, RIGHT, HEAD)
    assert "validation/rollout_error" in " ".join(counts)


@pytest.mark.slow
def test_subsets_of_complete_recordings_are_distilled_and_known(inputs: dict[str, Path], tmp_path: Path) -> None:
    model, info = load_checkpoint(inputs["stage2"])
    sets = (VIEWS, ("head", "left_wrist"), RIGHT, HEAD)
    trained = TrainedClips(view_sets=sets, strides=(1,))
    save_checkpoint(tmp_path / "all", model, kind="stage2", action_contract=info.contract, trained=trained)
    made = inputs | {"stage2": tmp_path / "all"}
    weights = {"joint": 0.4, "subset": 0.6}
    distill(config("latents", ["train"], view_weights=weights), made, tmp_path / "out")
    assert read_checkpoint_info(tmp_path / "out").view_sets == sets
    store = TrajectoryStore.open(tmp_path / "out" / "run" / "trajectories")
    assert len(set(store.views)) > 2
    with pytest.raises(
        DataError, match=r"(?s)not trained on these views together.*expected: head \+ left_wrist \+ right_wrist or"
    ):
        distill(config("latents", ["train"], view_weights=weights), inputs, tmp_path / "refused")


def test_a_model_that_saw_no_left_wrist_says_so(inputs: dict[str, Path], tmp_path: Path) -> None:
    distill(config("latents", ["validation"]), inputs, tmp_path)
    assert read_checkpoint_info(tmp_path).trained == TrainedClips(view_sets=(RIGHT,), strides=(1,))
