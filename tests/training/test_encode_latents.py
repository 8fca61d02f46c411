"""The same latents, whatever encodes them, in whatever order, and however often it was killed."""

import pytest
import torch

from tasks.execution.shard_mapper import PrefectMapper, shard_mapper
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ArtifactError, ConfigError
from worldline_core.scale.account import read_account
from worldline_core.scale.mapping import RunnerConfig, SerialMapper, Shard
from worldline_core.store.artifact_files import digest_folder
from worldline_core.training import encode_latents as encoding
from worldline_core.training.clip_config import EncodeLatentsConfig
from worldline_core.training.encode_latents import SHARD_FILE, EncodeWork, claim_device, encode_latents

CONFIG = EncodeLatentsConfig(image_size=(32, 32), episodes_per_shard=2)


@pytest.fixture(scope="module")
def inputs(world, tokenizer):
    return {"episodes": world.episodes, "tokenizer": tokenizer}


@pytest.fixture(scope="module")
def undisturbed(inputs, tmp_path_factory):
    output = tmp_path_factory.mktemp("undisturbed")
    counts = encode_latents(CONFIG, inputs, output)
    return digest_folder(output), counts


class KilledMapper(SerialMapper):
    """Begins with the last shard and is killed after two."""

    def run(self, shards, *, one_at_a_time=False):
        yield from super().run(list(reversed(shards))[:2], one_at_a_time=one_at_a_time)
        raise KeyboardInterrupt


def test_killed_and_resumed_in_another_order_with_other_threads(inputs, undisturbed, tmp_path, monkeypatch):
    with pytest.raises(KeyboardInterrupt):
        encode_latents(CONFIG, inputs, tmp_path, KilledMapper())
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
        counts = encode_latents(CONFIG, inputs, tmp_path)
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


@pytest.mark.slow
@pytest.mark.usefixtures("prefect_server")
def test_processes_encode_the_same(inputs, undisturbed, tmp_path):
    mapper = shard_mapper(RunnerConfig(kind="processes", workers=2))
    assert (encode_latents(CONFIG, inputs, tmp_path, mapper), digest_folder(tmp_path)) == undisturbed[::-1]


def test_what_cannot_be_encoded_ends_the_step_at_once(inputs, tmp_path, monkeypatch):
    calls = []

    def full(_tokenizer, episode_id, *_rest):
        calls.append(episode_id)
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(encoding, "encode_episode", full)
    with pytest.raises(ArtifactError, match=r"could not be encoded(?s:.)*episode-000(?s:.)*CUDA out of memory"):
        encode_latents(CONFIG, inputs, tmp_path)
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
        config = CONFIG.model_copy(update={"device": device})
        work = EncodeWork(tmp_path, inputs["episodes"], config, inputs["tokenizer"], "groups")
        workers[device] = mapper._workers([Shard(work, 0, (0,))])
    assert workers == {"cpu": 16, "cuda": 2, "cuda:1": 1}
