"""The rollout step end to end on small random models, and sets of predicted videos."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from pydantic import ValidationError

from tests.rollout.conftest import NAMES, SIZE, SPEC, N, digests, recorded, write_recordings
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.errors import ArtifactError, CheckpointError, ConfigError, DataError, UnavailableError
from worldline_core.model.block_causal_attention import KVCache
from worldline_core.model.checkpoint import load_checkpoint, save_checkpoint
from worldline_core.model.tokenizers import load_tokenizer
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import TextConfig
from worldline_core.rollout.predictions import shuffled_partners
from worldline_core.rollout.rollout import rollout
from worldline_core.rollout.rollout_config import (
    BlockCausalConfig,
    CopyFirstFrameConfig,
    FullClipConfig,
    RolloutConfig,
    TextToVideoConfig,
)
from worldline_core.rollout.rollout_set import RolloutSet, RolloutSetWriter, video_path
from worldline_core.store.artifact_files import digest_folder
from worldline_core.training.processes import join_processes

CONFIG = RolloutConfig(method="causal", batch_size=2, seeds=(42, 43))


@pytest.fixture(scope="module")
def predicted(inputs: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    output = tmp_path_factory.mktemp("predicted")
    return output, rollout(CONFIG, inputs, output)


def test_every_chosen_episode_is_predicted_in_every_view_and_seed(predicted: tuple[Path, dict]) -> None:
    output, summary = predicted
    assert summary == {
        "method": "causal", "episodes": 4, "predictions": 8, "frames": 8 * N, "checkpoint_kind": "causal", "steps": 4,
        "found": 5, "kept": 4, "left_out": {"in other splits": 1},
    }  # fmt: skip
    rollouts = RolloutSet.open(output)
    assert rollouts.method == "causal"
    assert rollouts.episode_ids == sorted(NAMES.keys() - {"a-0"})
    assert rollouts.seeds("b-1") == [42, 43]
    assert set(rollouts.views("b-1")) == set(VIEWS)
    frames = rollouts.frames("b/0 x", "left_wrist", 43)
    assert frames.shape == (N, *SIZE, 3)
    assert not np.array_equal(frames, rollouts.frames("b/0 x", "left_wrist", 42))
    with pytest.raises(DataError, match="No such prediction"):
        rollouts.frames("b-1", "head", seed=7)


def test_times_lie_beside_the_predictions_and_outside_their_digest(
    inputs: dict[str, Path], predicted: tuple[Path, dict], tmp_path: Path
) -> None:
    output, _ = predicted
    speed = json.loads((output / "run" / "speed.json").read_text())
    assert {name: speed[name] for name in ("steps", "batch_size", "device", "dtype")} == {
        "steps": 4, "batch_size": 2, "device": "cpu", "dtype": "bfloat16",
    }  # fmt: skip
    assert speed["frames"] == 6 * N  # the first of four batches of two warms up
    assert speed["seconds_per_frame"] == speed["seconds"] / speed["frames"] > 0
    assert "long_rollout" not in speed
    rollout(CONFIG.model_copy(update={"sampler": BlockCausalConfig(timed_blocks=6)}), inputs, tmp_path)
    long = json.loads((tmp_path / "run" / "speed.json").read_text())["long_rollout"]
    assert [len(long[name]) for name in ("block_seconds", "block_processor_seconds")] == [6, 6]
    assert min(long["block_seconds"]) > 0
    assert digests(tmp_path) == digests(output)
    assert digest_folder(tmp_path) == digest_folder(output)
    before = (output / "run" / "speed.json").read_bytes()
    rollout(CONFIG, inputs, output)  # nothing is left to predict
    assert (output / "run" / "speed.json").read_bytes() == before


def test_a_model_of_other_blocks_is_rolled_out_and_timed_with_them(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Blocks of two latent frames, a window of one recent block, two Euler steps: as the checkpoint says."""
    frames, held, levels = [], [], []
    forward = WorldModel.forward_block

    def watch(model: WorldModel, noisy: torch.Tensor, sigma: float, cache: KVCache, **rest: object) -> torch.Tensor:
        frames.append(noisy.shape[3])
        held.append(cache.frames)
        levels.append(sigma)
        return forward(model, noisy, sigma, cache, **rest)  # type: ignore[arg-type]

    monkeypatch.setattr(WorldModel, "forward_block", watch)
    timed = BlockCausalConfig(timed_blocks=3)
    config = CONFIG.model_copy(update={"sampler": timed, "seeds": (42,), "embodiments": ("ur5e_pair",)})
    given = inputs | {"checkpoint": inputs["checkpoint"].parent / "small_blocks"}
    summary = rollout(config.model_copy(update={"num_frames": 31}), given, tmp_path)
    assert (summary["steps"], summary["frames"]) == (2, 25)
    assert set(frames) == {2}
    assert max(held) == 1 + 2
    assert levels == [1.0, 0.5] * (len(levels) // 2)
    speed = json.loads((tmp_path / "run" / "speed.json").read_text())
    assert speed["steps"] == 2
    assert len(speed["long_rollout"]["block_seconds"]) == 3
    # Other steps can be asked for.
    other = config.model_copy(update={"sampler": BlockCausalConfig(steps=1)})
    assert rollout(other, given, tmp_path / "other")["steps"] == 1


def test_interrupted_rollouts_end_with_the_same_bytes(
    inputs: dict[str, Path], predicted: tuple[Path, dict], tmp_path: Path
) -> None:
    whole, _ = predicted
    rollout(CONFIG, inputs, tmp_path)
    (tmp_path / "index.parquet").unlink()
    (tmp_path / video_path("b-1", 43, "head")).unlink()
    before = (tmp_path / video_path("a-1", 42, "head")).stat().st_mtime_ns
    rollout(CONFIG, inputs, tmp_path)
    assert digests(tmp_path) == digests(whole)
    assert (tmp_path / video_path("a-1", 42, "head")).stat().st_mtime_ns == before


def test_controls_matter_and_zero_differs_from_shuffled(
    inputs: dict[str, Path], predicted: tuple[Path, dict], tmp_path: Path
) -> None:
    with pytest.raises(DataError, match="too short"):
        rollout(CONFIG.model_copy(update={"num_frames": 16}), inputs, tmp_path / "short")
    seen = [RolloutSet.open(predicted[0]).frames("b-1", "head", 42)]
    for actions in ("zero", "shuffled"):
        config = CONFIG.model_copy(update={"actions": actions, "seeds": (42,), "num_frames": 17})
        rollout(config, inputs, tmp_path / actions)
        seen.append(RolloutSet.open(tmp_path / actions).frames("b-1", "head"))
    assert seen[1].shape == (17, *SIZE, 3)
    assert len({video[:17].tobytes() for video in seen}) == 3


def test_copying_needs_no_checkpoint_and_repeats_the_first_frame(inputs: dict[str, Path], tmp_path: Path) -> None:
    config = RolloutConfig(method="copy", sampler=CopyFirstFrameConfig(), max_episodes_per_embodiment=1)
    given = {name: path for name, path in inputs.items() if name != "checkpoint"}
    assert rollout(config, given, tmp_path)["checkpoint_kind"] is None
    frames = RolloutSet.open(tmp_path).frames("a-1", "head").astype(int)
    assert np.abs(frames - recorded(1)[0].astype(int)).mean() < 4
    assert np.abs(frames[-1] - frames[0]).max() <= 2
    assert RolloutSet.open(tmp_path).episode_ids == ["a-1", "b-1"]


def test_the_whole_clip_sampler_takes_stage2_checkpoints_only(inputs: dict[str, Path], tmp_path: Path) -> None:
    config = RolloutConfig(method="stage2", sampler=FullClipConfig(steps=2), embodiments=("ur5e_pair",))
    with pytest.raises(CheckpointError, match="wrong kind"):
        rollout(config, inputs, tmp_path)
    stage2 = inputs | {"checkpoint": inputs["checkpoint"].parent / "stage2"}
    assert rollout(config, stage2, tmp_path)["frames"] == N
    with pytest.raises(ConfigError, match="lacks inputs"):
        rollout(config, {"episodes": inputs["episodes"]}, tmp_path)


def test_a_model_with_film_is_driven_by_the_control_vectors_of_the_recording(
    inputs: dict[str, Path], tmp_path: Path
) -> None:
    config = RolloutConfig(method="film", sampler=FullClipConfig(steps=2), num_frames=5, embodiments=("aloha_viperx",))
    film = inputs | {"checkpoint": inputs["checkpoint"].parent / "film"}
    seen = []
    for actions in ("true", "zero", "shuffled"):
        rollout(config.model_copy(update={"actions": actions}), film, tmp_path / actions)
        seen.append(RolloutSet.open(tmp_path / actions).frames("b-1", "head").tobytes())
    assert len(set(seen)) == 3


@pytest.mark.parametrize("kind", ["copy_first_frame", "text_to_video", "stage1", "film"])
def test_what_no_camera_is_needed_for_is_predicted_without_tracks(
    inputs: dict[str, Path], tmp_path: Path, kind: str
) -> None:
    """Recordings without cameras have no action tracks."""
    models = inputs["checkpoint"].parent
    made = write_recordings(tmp_path, [("a", "test", N, VIEWS, ()), ("b", "test", N, VIEWS, ())])
    given = {"episodes": made["episodes"], "tokenizer": inputs["tokenizer"]}
    sampler: Any = {"kind": "full_clip", "steps": 1} if kind == "film" else {"kind": "text_to_video", "steps": 1}
    if kind == "copy_first_frame":
        sampler, given = {"kind": kind}, {"episodes": made["episodes"]}
    elif kind == "stage1":
        model, info = load_checkpoint(models / "base")
        given["checkpoint"] = tmp_path / "stage1"
        save_checkpoint(given["checkpoint"], model, kind="stage1", action_contract=None, metadata=info.metadata)
    else:
        given["checkpoint"] = models / {"text_to_video": "base"}.get(kind, kind)
    config = RolloutConfig.model_validate({"sampler": sampler, "num_frames": 9, "bfloat16": False})
    assert rollout(config, given, tmp_path / "out")["predictions"] == 2
    if kind == "film":
        for actions in ("shuffled", "delayed"):
            changed = config.model_copy(update={"actions": actions})
            rollout(changed, given, tmp_path / actions)
            pair = [RolloutSet.open(tmp_path / name).frames("b", "head") for name in ("out", actions)]
            assert not np.array_equal(*pair)
        maps = given | {"checkpoint": models / "stage2"}
        with pytest.raises(ConfigError, match=r"(?s)drawn from action tracks.*run render_actions"):
            rollout(config, maps, tmp_path / "maps")


def test_a_model_without_actions_predicts_every_view_from_its_image_and_the_text(
    inputs: dict[str, Path], tmp_path: Path
) -> None:
    """The paper's first rows: the pretrained backbone, and Stage I."""
    models = inputs["checkpoint"].parent
    config = RolloutConfig(
        method="base", sampler=TextToVideoConfig(steps=2), num_frames=7, embodiments=("aloha_viperx",), bfloat16=False
    )
    base = inputs | {"checkpoint": models / "base"}
    summary = rollout(config, base, tmp_path / "base")
    assert (summary["checkpoint_kind"], summary["steps"], summary["frames"]) == ("base", 2, 3 * 5)
    found = RolloutSet.open(tmp_path / "base")
    assert set(found.views("b-1")) == set(VIEWS)
    assert found.frames("b-1", "head").shape == (5, *SIZE, 3)
    # A prediction does not depend on those beside it, but on its text and seed; controls reach nothing.
    changes = {
        "alone": {"batch_size": 1},
        "cut": {"sampler": TextToVideoConfig(steps=2, text=TextConfig(max_length=2))},
        "seed": {"seeds": (7,)},
    }
    frames = {}
    for name, change in changes.items():
        rollout(config.model_copy(update=change), base, tmp_path / name)
        frames[name] = RolloutSet.open(tmp_path / name).frames("b-1", "head").astype(int)
    reference = found.frames("b-1", "head")
    assert np.abs(frames["alone"] - reference).max() <= 2
    assert np.abs(frames["cut"] - reference).max() > 2
    assert np.abs(frames["seed"] - reference).max() > 2
    for folder, message in (
        ("stage2", "wrong kind"),
        ("silent", "how this model reads text"),
        ("foreign", "another tokenizer"),
    ):
        with pytest.raises((CheckpointError, ConfigError), match=message):
            rollout(config, inputs | {"checkpoint": models / folder}, tmp_path / folder)
    with pytest.raises(ValidationError, match="text_to_video cannot be driven by zero ones"):
        RolloutConfig(sampler=TextToVideoConfig(), actions="zero")


def test_a_gpu_that_is_not_there_is_named_before_work_begins(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for ask in (
        lambda: rollout(CONFIG.model_copy(update={"device": "cuda:1"}), inputs, tmp_path),
        lambda: load_tokenizer(inputs["tokenizer"], "cuda"),
        lambda: join_processes("cuda"),
    ):
        with pytest.raises(UnavailableError, match=r"(?s)No GPU that torch can use.*device=cpu"):
            ask()


def test_another_frame_rate_or_an_empty_choice_is_refused(inputs: dict[str, Path], tmp_path: Path) -> None:
    model, info = load_checkpoint(inputs["checkpoint"])
    for name, value in (
        ("fps", 10.0),
        ("tokenizer", "0123456789abcdef"),
        ("sigma_px_ref", 10.0),
        ("controls", "state"),
    ):
        contract = info.contract.model_copy(update={name: value})
        save_checkpoint(tmp_path / name, model, kind="causal", action_contract=contract, causal=SPEC)
        with pytest.raises(CheckpointError, match=rf"(?s)action contract differs.*: {name}.*expected:.*{value}"):
            rollout(CONFIG, inputs | {"checkpoint": tmp_path / name}, tmp_path / "out")
    with pytest.raises(DataError, match="No episode to predict"):
        rollout(CONFIG.model_copy(update={"splits": ("bank",)}), inputs, tmp_path / "out")


def test_shuffled_partners_are_a_derangement_within_each_embodiment() -> None:
    names = list(NAMES)
    partners = shuffled_partners(names, NAMES, names, seed=42)
    assert all(partners[name] != name and NAMES[partners[name]] == NAMES[name] for name in names)
    assert sorted(partners.values()) == sorted(names)
    assert partners == shuffled_partners(names[::-1], NAMES, names, seed=42)
    assert shuffled_partners(["a-0"], NAMES, names, seed=0) == {"a-0": "a-1"}
    with pytest.raises(DataError, match="No other episode of this embodiment"):
        shuffled_partners(["a-0"], NAMES, ["a-0", "b-1"], seed=0)


def test_sets_of_rollouts_are_read_strictly(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match="Not a set of rollouts"):
        RolloutSet.open(tmp_path)
    writer = RolloutSetWriter(tmp_path, "m", 8.0)
    writer.add("e", 0, {"head": recorded(0)[:5]})
    writer.register("../../e", 0, "head", 5, SIZE)
    writer.close()
    assert RolloutSet.open(tmp_path).frames("e", "head", 0).shape == (5, *SIZE, 3)
    assert not video_path("../../e", 0, "head").startswith(".")
    table = pq.read_table(tmp_path / "index.parquet")
    outside = table.set_column(4, "path", [["../../etc/passwd"] * table.num_rows])
    pq.write_table(outside, tmp_path / "index.parquet")
    with pytest.raises(ArtifactError, match="is outside"):
        RolloutSet.open(tmp_path).frames("e", "head", 0)
    pq.write_table(table.set_column(1, "method", [["m", "n"]]), tmp_path / "index.parquet")
    with pytest.raises(ArtifactError, match="holds one method"):
        RolloutSet.open(tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        lambda rows: [*rows, {**rows[0], "path": "another.mp4"}],  # the last one was taken
        lambda rows: [{**row, "fps": float(number + 1)} for number, row in enumerate(rows)],
        *(lambda rows, fps=fps: [{**row, "fps": fps} for row in rows] for fps in (0.0, math.nan, None)),
        *(lambda rows, count=count: [{**row, "num_frames": count} for row in rows] for count in (0, "many")),
        lambda rows: [{**row, "episode_id": None} for row in rows],
        lambda rows: [{**row, "method": f"m{number}"} for number, row in enumerate(rows)],
        lambda rows: [{"episode_id": row["episode_id"]} for row in rows],
        lambda rows: [],
        lambda rows: None,
    ],
)
def test_an_index_that_lies_is_refused(tmp_path: Path, change: Callable[[list[dict]], list[dict] | None]) -> None:
    writer = RolloutSetWriter(tmp_path, "m", 8.0)
    for name in ("a", "b"):
        writer.register(name, 0, "head", 9, (16, 16))
    writer.close()
    assert len(RolloutSet.open(tmp_path).rows) == 2
    path = tmp_path / "index.parquet"
    rows = change(pq.read_table(path).to_pylist())
    path.write_bytes(b"PAR1") if rows is None else pq.write_table(pa.Table.from_pylist(rows), path)
    with pytest.raises(ArtifactError, match=r"index of the rollouts|holds one method|Parquet file is damaged"):
        RolloutSet.open(tmp_path)
