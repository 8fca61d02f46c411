"""The rollout step end to end on small random models, and sets of predicted videos."""

import json
import math

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from pydantic import ValidationError

from tests.rollout.conftest import NAMES, SIZE, SPEC, recorded, rolled, write_recordings
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.errors import ArtifactError, CheckpointError, ConfigError, DataError, UnavailableError
from worldline_core.model.checkpoint import load_checkpoint, save_checkpoint
from worldline_core.model.small_decoder import SmallDecoder, SmallDecoderConfig
from worldline_core.model.tokenizers import load_tokenizer, tokenizer_fingerprint
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
from worldline_core.rollout.worldline import WorldLine
from worldline_core.store.artifact_files import digest_folder
from worldline_core.store.store import ArtifactStore
from worldline_core.training.processes import join_processes

CONFIG = RolloutConfig(method="causal", batch_size=2, seeds=(42, 43), num_frames=17)
N = CONFIG.num_frames


@pytest.fixture(scope="module")
def predicted(inputs, tmp_path_factory):
    return rolled(CONFIG, inputs, tmp_path_factory.mktemp("predicted"))


def model(inputs, name):
    return inputs | {"checkpoint": inputs["checkpoint"].parent / name}


def test_every_chosen_episode_is_predicted_in_every_view_and_seed(predicted):
    rollouts, summary = predicted
    assert summary == {
        "method": "causal", "episodes": 4, "predictions": 8, "frames": 8 * N, "checkpoint_kind": "causal", "steps": 4,
        "found": 5, "kept": 4, "left_out": {"in other splits": 1},
    }  # fmt: skip
    assert (rollouts.method, rollouts.episode_ids) == ("causal", sorted(NAMES.keys() - {"a-0"}))
    assert (rollouts.seeds("b-1"), set(rollouts.views("b-1"))) == ([42, 43], set(VIEWS))
    one, other = (rollouts.frames("b/0 x", "left_wrist", seed) for seed in (42, 43))
    assert one.shape == (N, *SIZE, 3) and not np.array_equal(one, other)
    with pytest.raises(DataError, match="No such prediction"):
        rollouts.frames("b-1", "head", seed=7)


def speed_of(output):
    return json.loads((output / "run" / "speed.json").read_text())


@pytest.mark.slow
def test_times_lie_beside_the_predictions_and_outside_their_digest(inputs, predicted, tmp_path):
    output = predicted[0].root
    speed, dtype = speed_of(output), "bfloat16" if CONFIG.bfloat16 else "float32"
    # The first of four batches of two warms up.
    assert speed.items() >= {"steps": 4, "batch_size": 2, "frames": 6 * N, "dtype": dtype}.items()
    assert speed["seconds_per_frame"] > 0
    rolled(CONFIG, inputs, tmp_path)
    assert digest_folder(tmp_path) == digest_folder(output)
    rollout(CONFIG, inputs, output)  # nothing is left to predict
    assert speed_of(output) == speed
    # Interrupted, it ends with the same bytes and predicts only what is missing.
    (tmp_path / "index.parquet").unlink()
    (tmp_path / video_path("b-1", 43, "head")).unlink()
    kept = tmp_path / video_path("a-1", 42, "head")
    before = kept.stat().st_mtime_ns
    rollout(CONFIG, inputs, tmp_path)
    assert digest_folder(tmp_path) == digest_folder(output)
    assert kept.stat().st_mtime_ns == before


def test_a_model_of_other_blocks_is_rolled_out_with_them(inputs, tmp_path, monkeypatch):
    """Blocks of two latent frames, a window of one recent block, two Euler steps: as the checkpoint says."""
    passes, forward, joint = [], WorldModel.forward_block, WorldModel.write_and_forward_block

    def watch(model, noisy, sigma, cache, **rest):
        passes.append((noisy.shape[3], cache.frames, sigma))
        return forward(model, noisy, sigma, cache, **rest)

    def watch_joint(model, clean, noisy, sigma, cache, **rest):
        emitted = joint(model, clean, noisy, sigma, cache, **rest)
        passes.append((noisy.shape[3], cache.frames, sigma))
        return emitted

    monkeypatch.setattr(WorldModel, "forward_block", watch)
    monkeypatch.setattr(WorldModel, "write_and_forward_block", watch_joint)
    chosen = {"seeds": (42,), "embodiments": ("ur5e_pair",), "num_frames": 31}
    config, given = CONFIG.model_copy(update=chosen), model(inputs, "small_blocks")
    summary = rollout(config, given, tmp_path)
    assert (summary["steps"], summary["frames"]) == (2, 25)
    frames, held, levels = zip(*passes, strict=True)
    assert set(frames) == {2} and max(held) == 1 + 2
    assert list(levels) == [1.0, 0.5] * (len(levels) // 2)
    assert speed_of(tmp_path)["steps"] == 2
    other = config.model_copy(update={"sampler": BlockCausalConfig(steps=1)})
    assert rollout(other, given, tmp_path / "other")["steps"] == 1


def test_controls_matter_and_zero_differs_from_shuffled(inputs, predicted, tmp_path):
    with pytest.raises(DataError, match="too short"):
        rolled(CONFIG, inputs, tmp_path / "short", num_frames=16)
    seen = {predicted[0].frames("b-1", "head", 42).tobytes()}
    for actions in ("zero", "shuffled"):
        found, _ = rolled(
            CONFIG, inputs, tmp_path / actions, actions=actions, seeds=(42,), embodiments=("aloha_viperx",)
        )
        seen.add(found.frames("b-1", "head").tobytes())
    film = RolloutConfig(method="film", sampler=FullClipConfig(steps=2), num_frames=5, embodiments=("aloha_viperx",))
    for actions in ("true", "zero", "shuffled"):  # a model with FiLM takes the recording's vectors
        found, _ = rolled(film, model(inputs, "film"), tmp_path / f"film_{actions}", actions=actions)
        seen.add(found.frames("b-1", "head").tobytes())
    assert len(seen) == 6


@pytest.mark.slow
def test_compiled_layers_predict_the_same(inputs, tmp_path):
    few = {
        "bfloat16": False,
        "seeds": (42,),
        "embodiments": ("ur5e_pair",),
        "num_frames": 33,
    }  # the second block reads the cache
    plain = rolled(CONFIG, inputs, tmp_path / "plain", **few)[0].frames("a-1", "head", 42).astype(int)
    with torch._dynamo.config.patch(recompile_limit=100):
        compiled = rolled(CONFIG, inputs, tmp_path / "compiled", compile=True, **few)[0].frames("a-1", "head", 42)
        assert torch._dynamo.utils.counters["stats"]["unique_graphs"] > 0
    assert np.abs(compiled - plain).max() <= 2


def test_copying_needs_only_recordings_and_repeats_the_first_frame(inputs, tmp_path):
    config = RolloutConfig(method="copy", sampler=CopyFirstFrameConfig(), max_episodes_per_embodiment=1)
    found, summary = rolled(config, {"episodes": inputs["episodes"]}, tmp_path)
    assert (summary["checkpoint_kind"], found.episode_ids) == (None, ["a-1", "b-1"])
    frames = found.frames("a-1", "head").astype(int)
    assert np.abs(frames - recorded(1)[0].astype(int)).mean() < 4
    assert np.abs(frames[-1] - frames[0]).max() <= 2


def test_vectors_drive_a_rollout_of_recordings_without_tracks(inputs, tmp_path):
    """Recordings without cameras have no action tracks."""
    made = write_recordings(tmp_path, [("a", "test", 9, VIEWS, ()), ("b", "test", 9, VIEWS, ())])
    given = {"episodes": made["episodes"], "tokenizer": inputs["tokenizer"]}
    film, stage2 = (given | {"checkpoint": inputs["checkpoint"].parent / name} for name in ("film", "stage2"))
    config = RolloutConfig(sampler=FullClipConfig(steps=1), num_frames=9, bfloat16=False)
    seen = {rolled(config, film, tmp_path / actions, actions=actions)[0].frames("b", "head").tobytes()
            for actions in ("true", "shuffled", "delayed")}  # fmt: skip
    assert len(seen) == 3
    with pytest.raises(ConfigError, match=r"(?s)drawn from action tracks.*run render_actions"):
        rollout(config, stage2, tmp_path / "maps")


def test_a_model_without_actions_predicts_every_view_from_its_image_and_the_text(inputs, tmp_path):
    """The paper's first rows, the pretrained backbone and Stage I; neither needs tracks."""
    sampler = TextToVideoConfig(steps=2)
    few = {"num_frames": 7, "embodiments": ("aloha_viperx",), "max_episodes_per_embodiment": 2, "bfloat16": False}
    config = RolloutConfig(method="base", sampler=sampler, **few)
    base = {name: folder for name, folder in model(inputs, "base").items() if name != "tracks"}
    found, summary = rolled(config, base, tmp_path / "base")
    assert (summary["checkpoint_kind"], summary["steps"], summary["frames"]) == ("base", 2, 2 * 5)
    reference = found.frames("b-1", "head").astype(int)
    assert (set(found.views("b-1")), reference.shape) == (set(VIEWS), (5, *SIZE, 3))
    # A prediction does not depend on those beside it, but on its text and seed; controls reach nothing.
    for name, same, change in (
        ("alone", True, {"batch_size": 1}), ("seed", False, {"seeds": (7,)}),
        ("cut", False, {"sampler": TextToVideoConfig(steps=2, text=TextConfig(max_length=2))}),
    ):  # fmt: skip
        frames = rolled(config, base, tmp_path / name, **change)[0].frames("b-1", "head")
        assert (np.abs(frames - reference).max() <= 2) == same, name
    backbone, info = load_checkpoint(base["checkpoint"])
    stage1 = base | {"checkpoint": tmp_path / "stage1"}
    save_checkpoint(stage1["checkpoint"], backbone, kind="stage1", action_contract=None, metadata=info.metadata)
    assert np.array_equal(rolled(config, stage1, tmp_path / "one")[0].frames("b-1", "head"), reference)
    for folder, message in (
        ("stage2", "wrong kind"), ("silent", "how this model reads text"), ("foreign", "another tokenizer"),
    ):  # fmt: skip
        with pytest.raises((CheckpointError, ConfigError), match=message):
            rollout(config, model(inputs, folder), tmp_path / folder)
    with pytest.raises(ValidationError, match="text_to_video cannot be driven by zero ones"):
        RolloutConfig(sampler=TextToVideoConfig(), actions="zero")


def test_a_gpu_that_is_not_there_is_named_before_work_begins(inputs, project_root, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for ask in (
        lambda: rolled(CONFIG, inputs, tmp_path, device="cuda:1"),
        lambda: load_tokenizer(inputs["tokenizer"], "cuda"),
        lambda: join_processes("cuda"),
        lambda: WorldLine.from_pretrained(project_root / "artifacts/shipped/models/causal", device="cuda:1"),
    ):
        with pytest.raises(UnavailableError, match=r"(?s)No GPU.*next step: device=cpu"):
            ask()


def test_models_and_choices_that_do_not_fit_are_refused(inputs, tmp_path):
    own, info = load_checkpoint(inputs["checkpoint"])
    changes = {"fps": 10.0, "tokenizer": "0123456789abcdef", "sigma_px_ref": 10.0, "controls": "state"}
    for name, value in changes.items():
        contract = info.contract.model_copy(update={name: value})
        save_checkpoint(tmp_path / name, own, kind="causal", action_contract=contract, causal=SPEC)
        with pytest.raises(CheckpointError, match=rf"(?s)action contract differs.*: {name}.*expected:.*{value}"):
            rollout(CONFIG, inputs | {"checkpoint": tmp_path / name}, tmp_path / "out")
    with pytest.raises(DataError, match="No episode to predict"):
        rolled(CONFIG, inputs, tmp_path / "out", splits=("bank",))
    # The whole-clip sampler takes Stage II checkpoints only.
    config = CONFIG.model_copy(update={"sampler": FullClipConfig(steps=2), "embodiments": ("ur5e_pair",)})
    with pytest.raises(CheckpointError, match="wrong kind"):
        rollout(config, inputs, tmp_path)
    assert rollout(config, model(inputs, "stage2"), tmp_path)["frames"] == 2 * N
    with pytest.raises(ConfigError, match="lacks inputs"):
        rollout(config, {"episodes": inputs["episodes"]}, tmp_path)


def test_shuffled_partners_are_a_derangement_within_each_embodiment():
    names = list(NAMES)
    partners = shuffled_partners(names, NAMES, names, seed=42)
    assert all(partners[name] != name and NAMES[partners[name]] == NAMES[name] for name in names)
    assert sorted(partners.values()) == sorted(names)
    assert partners == shuffled_partners(names[::-1], NAMES, names, seed=42)
    assert shuffled_partners(["a-0"], NAMES, names, seed=0) == {"a-0": "a-1"}
    with pytest.raises(DataError, match="No other episode of this embodiment"):
        shuffled_partners(["a-0"], NAMES, ["a-0", "b-1"], seed=0)


def test_sets_of_rollouts_are_read_strictly(tmp_path):
    with pytest.raises(ArtifactError, match="Not a set of rollouts"):
        RolloutSet.open(tmp_path)
    writer = RolloutSetWriter(tmp_path, "m", 8.0)
    writer.add("e", 0, {"head": recorded(0)[:5]})
    writer.register("../../e", 0, "head", 5, SIZE)
    writer.close()
    assert RolloutSet.open(tmp_path).frames("e", "head", 0).shape == (5, *SIZE, 3)
    assert not video_path("../../e", 0, "head").startswith(".")
    table = pq.read_table(tmp_path / "index.parquet")
    pq.write_table(table.set_column(4, "path", [["../../etc/passwd"] * len(table)]), tmp_path / "index.parquet")
    with pytest.raises(ArtifactError, match="is outside"):
        RolloutSet.open(tmp_path).frames("e", "head", 0)


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
def test_an_index_that_lies_is_refused(tmp_path, change):
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


def test_a_small_decoder_shows_the_same_latents_otherwise(inputs, tmp_path):
    tokenizer, own = load_tokenizer(inputs["tokenizer"]), tmp_path / "own"
    torch.manual_seed(0)
    for name, folder in ((tokenizer_fingerprint(tokenizer, inputs["tokenizer"]), "own"), ("0123", "foreign")):
        SmallDecoder(SmallDecoderConfig.of(tokenizer, name, width=4, depth=1), tokenizer).save(tmp_path / folder)

    def config(sampler):
        return RolloutConfig(num_frames=5 if sampler.steps == 1 else 17, embodiments=("ur5e_pair",), sampler=sampler)

    def video(name, checkpoint, sampler):
        return rolled(config(sampler), model(inputs, checkpoint), tmp_path / name)[0].frames("a-1", "head").tobytes()

    assert video("without", "causal", BlockCausalConfig()) != video("causal", "causal", BlockCausalConfig(decoder=own))
    for checkpoint, sampler in (("stage2", FullClipConfig), ("base", TextToVideoConfig)):
        video(checkpoint, checkpoint, sampler(steps=1, decoder=own))
    for checkpoint, sampler in (("causal", BlockCausalConfig), ("base", TextToVideoConfig)):
        with pytest.raises(CheckpointError, match="trained for another tokenizer"):
            video("refused", checkpoint, sampler(decoder=tmp_path / "foreign"))
        assert not (tmp_path / "refused").exists()
    # Its content is part of the key of a rollout.
    samplers, store = (BlockCausalConfig(), BlockCausalConfig(decoder=own)), ArtifactStore(tmp_path / "store")
    keys = {store.key("rollout", 2, config(sampler), {}) for sampler in samplers}
    weights = own / "decoder.safetensors"
    weights.write_bytes(weights.read_bytes() + b" ")
    assert len({*keys, store.key("rollout", 2, config(samplers[1]), {})}) == 3
