"""The steps of tokenizers: trained from scratch or for another one's latents; and the same latents, whatever encodes them."""

import json

import pytest
import torch

from tasks.execution.shard_mapper import PrefectMapper, shard_mapper
from tasks.train_tokenizer import train_tokenizer as tokenizer_task
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ArtifactError, ConfigError
from worldline_core.model.small_decoder import SmallDecoder
from worldline_core.model.tokenizers import PatchTokenizer
from worldline_core.rehearsal.outside_models import small_wan_autoencoder
from worldline_core.scale.account import read_account
from worldline_core.scale.mapping import RunnerConfig, SerialMapper, Shard
from worldline_core.store.artifact_files import digest_folder, read_json_lines
from worldline_core.training import encode_latents as encoding
from worldline_core.training.clip_config import EncodeLatentsConfig
from worldline_core.training.clip_sampler import Clip
from worldline_core.training.clip_source import LatentStore
from worldline_core.training.encode_latents import (
    SHARD_FILE,
    EncodeWork,
    claim_device,
    encode_latents,
    stored_latent_frames,
)
from worldline_core.training.train_tokenizer import edge_strength, train_tokenizer
from worldline_core.training.training_config import TokenizerConfig

CONFIG = TokenizerConfig(
    image_size=(32, 32), channels=8, refinement_width=4, refinement_depth=1, held_out_episodes=1, clip_frames=9,
    fit_clips=6, steps=3, checkpoint_every=1, batch_size=1,
)  # fmt: skip


@pytest.fixture(scope="module")
def trained(world, tmp_path_factory):
    folder = tmp_path_factory.mktemp("trained")
    train_tokenizer(CONFIG, {"episodes": world.episodes}, folder)
    return folder


def test_the_step_writes_a_tokenizer_its_losses_and_its_metrics(trained):
    metrics = json.loads((trained / "metrics.json").read_text())
    assert (metrics["training_episodes"], metrics["training_views"]) == (6, 18)
    assert metrics["held_out"]["psnr/decoded"] > 10
    assert read_json_lines(trained / "metrics.jsonl")[-1]["step"] == 3
    assert PatchTokenizer.load(trained).latent_channels == 8


def test_a_killed_training_ends_with_the_same_bytes(world, trained, tmp_path, killed_after):
    with killed_after(2):
        train_tokenizer(CONFIG, {"episodes": world.episodes}, tmp_path)
    train_tokenizer(CONFIG, {"episodes": world.episodes}, tmp_path)
    assert digest_folder(tmp_path) == digest_folder(trained)


def test_without_steps_only_the_bases_are_fitted(world, tmp_path):
    changes = {"steps": 0, "max_episodes": 2}
    counts = train_tokenizer(CONFIG.model_copy(update=changes), {"episodes": world.episodes}, tmp_path)
    assert not (tmp_path / "metrics.jsonl").exists()
    # Every episode is accounted for: the line that ends the step says so.
    assert (counts["found"], counts["kept"]) == (8, 2)
    assert counts["left_out"] == {"in other splits": 2, "beyond max_episodes": 4, "shorter than 5 frames": 0}
    assert PatchTokenizer.load(tmp_path).latent_channels == 8


def test_a_small_decoder_is_trained_for_the_latents_of_an_existing_tokenizer(world, trained, tmp_path):
    inputs = {"episodes": world.episodes, "encoder": trained}
    tokenizer_task.check_inputs(inputs)
    before = digest_folder(trained)
    found = [
        train_tokenizer(CONFIG.model_copy(update={"steps": steps}), inputs, tmp_path / str(steps)) for steps in (0, 4)
    ]
    assert found[1]["held_out"] != found[0]["held_out"]
    assert all(metrics["held_out"]["psnr/decoded"] > metrics["own_decoder"]["psnr/linear"] for metrics in found)
    assert found[0]["own_decoder"] == found[1]["own_decoder"]
    assert found[0]["own_decoder"]["psnr/decoded"] > 10
    assert digest_folder(trained) == before
    tokenizer = PatchTokenizer.load(trained)
    assert SmallDecoder.load(tmp_path / "4", tokenizer, tokenizer.encoder_digest[:16]).config.width == 4
    assert not (tmp_path / "4" / "tokenizer.json").exists()


def test_a_decoder_is_trained_further_for_the_same_codes(world, trained, tmp_path):
    inputs = {"episodes": world.episodes, "start": trained}
    tokenizer_task.check_inputs(inputs)
    config = CONFIG.model_copy(update={"channels": 12, "refinement_width": 8})  # those of `start` stay
    train_tokenizer(config, inputs, tmp_path)
    before, after = PatchTokenizer.load(trained), PatchTokenizer.load(tmp_path)
    assert (after.config, after.encoder_digest) == (before.config, before.encoder_digest)
    assert not torch.equal(after.refinement.leave.weight, before.refinement.leave.weight)
    with pytest.raises(ConfigError, match="encoder"):
        train_tokenizer(CONFIG, {**inputs, "encoder": trained}, tmp_path / "both")


def test_blurred_edges_are_weaker_and_dots_are_no_edges_but_colours_of_equal_grey_are():
    step = torch.zeros(1, 3, 2, 32, 32)
    step[..., 14:] = 1.0
    blurred = torch.nn.functional.avg_pool3d(step, (1, 5, 5), stride=1, padding=(0, 2, 2), count_include_pad=False)
    dots = 0.2 * (-1.0) ** (torch.arange(32)[:, None] + torch.arange(32))
    strongest = edge_strength(step).max()
    assert edge_strength(blurred).max() < 0.8 * strongest
    # Patterns that alternate from pixel to pixel would be the cheapest way to look sharp.
    torch.testing.assert_close(edge_strength(step + dots), edge_strength(step), rtol=0, atol=1e-5)
    coloured = step * torch.tensor([1.0, -1.0, 0.0]).view(1, 3, 1, 1, 1)
    torch.testing.assert_close(edge_strength(coloured).max(), strongest)


def test_a_wan_autoencoder_gets_one_too(world, tmp_path):
    torch.manual_seed(0)
    small_wan_autoencoder().save_pretrained(tmp_path / "wan" / "vae")
    inputs = {"episodes": world.episodes, "encoder": tmp_path / "wan"}
    changes = {"steps": 1, "max_episodes": 1}
    metrics = train_tokenizer(CONFIG.model_copy(update=changes), inputs, tmp_path / "decoder")
    assert metrics["held_out"].keys() == metrics["own_decoder"].keys()
    assert json.loads((tmp_path / "decoder" / "decoder.json").read_text())["config"]["spatial_compression"] == 16


ENCODING = EncodeLatentsConfig(image_size=(32, 32), episodes_per_shard=2)


@pytest.fixture(scope="module")
def inputs(world, tokenizer):
    return {"episodes": world.episodes, "tokenizer": tokenizer}


@pytest.fixture(scope="module")
def undisturbed(inputs, tmp_path_factory):
    output = tmp_path_factory.mktemp("undisturbed")
    counts = encode_latents(ENCODING, inputs, output)
    return digest_folder(output), counts


class KilledMapper(SerialMapper):
    """Begins with the last shard and is killed after two."""

    def run(self, shards, *, one_at_a_time=False):
        yield from super().run(list(reversed(shards))[:2], one_at_a_time=one_at_a_time)
        raise KeyboardInterrupt


def test_killed_and_resumed_in_another_order_with_other_threads(inputs, undisturbed, tmp_path, monkeypatch):
    with pytest.raises(KeyboardInterrupt):
        encode_latents(ENCODING, inputs, tmp_path, KilledMapper())
    shards = undisturbed[1]["shards"]
    assert {path.name for path in tmp_path.glob("*.safetensors")} == {SHARD_FILE.format(n) for n in range(shards)[-2:]}
    encoded = []
    whole = encoding.encode_episode

    def counted(tokenizer, episode_id, *rest):
        encoded.append(episode_id)
        assert torch.get_num_threads() == 1
        return whole(tokenizer, episode_id, *rest)

    monkeypatch.setattr(encoding, "encode_episode", counted)
    threads = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        counts = encode_latents(ENCODING, inputs, tmp_path)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(threads)
    assert (digest_folder(tmp_path), counts) == undisturbed
    assert len(encoded) == 2 * (shards - 2)  # nothing is encoded twice
    rows = read_account(tmp_path)
    assert [row.episode_id for row in rows] == [row.episode_id for row in EpisodeSet.open(inputs["episodes"]).rows]
    assert all(row.status == "kept" and row.seconds and row.stored_bytes > 0 for row in rows)
    stored = sum(path.stat().st_size for path in tmp_path.glob("*.safetensors"))
    assert 0.9 * stored < sum(row.stored_bytes for row in rows) < stored


def test_fewer_starts_are_stored_on_a_small_disk(inputs, undisturbed, tmp_path):
    rows = EpisodeSet.open(inputs["episodes"]).rows
    need = sum(128 * 3 * stored_latent_frames(row.video_frames, "groups", ENCODING) for row in rows)
    for spare, steps in ((0, 4), (-1, 8)):
        encode_latents(ENCODING.model_copy(update={"disk": need + spare}), inputs, tmp_path / str(steps))
        store = LatentStore.open(tmp_path / str(steps))
        assert store.start_step == steps
        assert store.read(Clip("episode-003", 8, 9, 1), ("head",)).shape == (1, 4, 3, 4, 4)
        stored = sum(row.stored_bytes for row in read_account(tmp_path / str(steps)))
        assert stored == need if not spare else stored < need
    with pytest.raises(ConfigError, match=r"do not fit the disk[\s\S]*clip_frames"):
        encode_latents(ENCODING.model_copy(update={"disk": 1000}), inputs, tmp_path / "none")


@pytest.mark.slow
@pytest.mark.usefixtures("prefect_server")
def test_processes_encode_the_same(inputs, undisturbed, tmp_path):
    mapper = shard_mapper(RunnerConfig(kind="processes", workers=2))
    assert (encode_latents(ENCODING, inputs, tmp_path, mapper), digest_folder(tmp_path)) == undisturbed[::-1]


def test_what_cannot_be_encoded_ends_the_step_at_once(inputs, tmp_path, monkeypatch):
    calls = []

    def full(_tokenizer, episode_id, *_rest):
        calls.append(episode_id)
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(encoding, "encode_episode", full)
    with pytest.raises(ArtifactError, match=r"could not be encoded(?s:.)*episode-000(?s:.)*CUDA out of memory"):
        encode_latents(ENCODING, inputs, tmp_path)
    assert calls == ["episode-000"]


def test_every_process_has_a_device_of_its_own(inputs, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    first, second = (claim_device("cuda", tmp_path) for _ in range(2))
    assert (first[0], second[0]) == ("cuda:0", "cuda:1")
    with pytest.raises(ConfigError, match=r"device of its own(?s:.)*at most 2 processes(?s:.)*runner.workers"):
        claim_device("cuda", tmp_path)
    first[1].close()
    assert claim_device("cuda", tmp_path)[0] == "cuda:0"
    assert claim_device("cpu", tmp_path) == ("cpu", None)

    mapper = PrefectMapper(RunnerConfig(kind="processes", workers=16))
    workers = {}
    for device in ("cpu", "cuda", "cuda:1"):
        config = ENCODING.model_copy(update={"device": device})
        work = EncodeWork(tmp_path, inputs["episodes"], config, inputs["tokenizer"], "groups")
        workers[device] = mapper._workers([Shard(work, 0, (0,))])
    assert workers == {"cpu": 16, "cuda": 2, "cuda:1": 1}
