"""Clips from cached latents, resident latents and frames are the same clips; what cannot be read is named."""

import dataclasses
import pickle
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from einops import rearrange
from safetensors.torch import save_file

from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.config import read_config
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ArtifactError, ConfigError, DataError
from worldline_core.model.tokenizers import frames_to_video
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.training.clip_config import ClipSampling, EncodeLatentsConfig, FrameInput
from worldline_core.training.clip_loader import ClipLoader
from worldline_core.training.clip_sampler import Clip, ClipBatch, ClipRow, ClipSampler, longest_clip
from worldline_core.training.clip_source import FrameSource, LatentStore, ResidentLatents, training_rows
from worldline_core.training.encode_latents import (
    choose_layout,
    encode_clip,
    encode_episode,
    encode_latents,
    stored_latent_frames,
)


class Memoryless:
    """Latent frame j sums its own four frames; the first frame alone is its own latent."""

    def encode(self, video):
        first = video[:, :, :1] * 4
        groups = rearrange(video[:, :, 1:], "b c (t k) h w -> b c t k h w", k=4).sum(3)
        return torch.cat([first, groups], 2)


class Remembering(Memoryless):
    """Every latent frame also holds the sum of all before it."""

    def encode(self, video):
        return super().encode(video).cumsum(2)


def read(source, clip, views=VIEWS):
    return source.read_batch(ClipBatch((clip,), views))[0].numpy()


@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("start_step", [3, 4])
@pytest.mark.parametrize(
    ("tokenizer", "clip_frames"), [(Memoryless(), None), (Remembering(), None), (Remembering(), 13)]
)
def test_a_clip_of_the_store_equals_direct_encoding(tmp_path, tokenizer, clip_frames, start_step, stride):
    # White and black, -1 and 1, whose sums are exact.
    generator = torch.Generator().manual_seed(0)
    video = 255 * torch.randint(0, 2, (2, 3, 30, 2, 2), generator=generator, dtype=torch.uint8)
    config = EncodeLatentsConfig(start_step=start_step, strides=(stride,), views=("a", "b"), clip_frames=clip_frames)
    layout = choose_layout(tokenizer, video[0], config)
    assert layout == ("clips" if isinstance(tokenizer, Remembering) else "groups")
    tensors = encode_episode(tokenizer, "e", list(video), layout, config)
    assert sum(tensor.shape[2] for tensor in tensors.values()) == stored_latent_frames(30, layout, config)
    save_file(tensors, tmp_path / "s.safetensors")
    video = video / 127.5 - 1
    row = ClipRow("e", 30, ("a", "b"), "s", "r", "train", "", "a", "s.safetensors")
    description = {"layout": layout, "start_step": start_step, "strides": [stride], "latent_shape": [3, 2, 2]}
    description |= {"image_size": [2, 2], "clip_frames": clip_frames}
    store = LatentStore(tmp_path, description, [row])
    resident = ResidentLatents(store, "cpu")
    checked = 0
    for start in range(0, 30, start_step):
        longest = longest_clip(row.num_frames, start, stride)
        if clip_frames and longest > clip_frames:
            with pytest.raises(ArtifactError, match=rf"at most {clip_frames} of 30 frames"):
                read(store, Clip("e", start, longest, stride), ("a",))
        for length in range(1, min(longest, clip_frames or longest) + 1, 4):
            clip = Clip("e", start, length, stride)
            expected = tokenizer.encode(video[:, :, list(clip.frames)])
            assert np.array_equal(read(store, clip, ("a", "b")), expected)
            numbers = torch.from_numpy(read(resident, clip, ("b", "a")))
            assert torch.equal(resident.latents(numbers[None], "cpu")[0], expected[[1, 0]])
            checked += 1
    assert checked > 15


def test_clips_longer_than_those_encoded_are_refused_before_training(world):
    store = LatentStore.open(world.latents)
    store.clip_frames = 13
    sampler = ClipSampler(store.rows, ClipSampling(lengths=(9, 17)), views=VIEWS, start_step=4, batch_size=1, seed=0)
    with pytest.raises(ConfigError, match=r"clips.lengths[\s\S]*encode_latents.clip_frames to 17"):
        ClipLoader(store, views=VIEWS).batches(sampler)
    section = {"encode_latents": {"clip_frames": 29}}
    with pytest.raises(ValueError, match=r"train_stage1.clips.lengths: 33 frames, encode_latents.clip_frames: 29"):
        PipelineConfig.model_validate(read_config("tiny", None) | section)


def test_resident_batches_are_those_of_the_store(world):
    store, tracks = LatentStore.open(world.latents), ActionTracks.open(world.tracks)
    resident = ResidentLatents(store, "cpu")
    config = ClipSampling(lengths=(5, 9, 17), view_weights={"joint": 1.0, "left_wrist": 1.0})
    sampler = ClipSampler(store.rows, config, views=VIEWS, start_step=4, batch_size=3, seed=0)
    for action_frames in (1, 4):
        options = {"views": VIEWS, "action_frames": action_frames, "tracks": tracks}
        loaders = [ClipLoader(source, **options) for source in (store, resident)]
        for index in range(8):
            read_, kept = (vars(loader.load(sampler.clips(index))) for loader in loaders)
            for name, value in read_.items():
                assert torch.equal(kept[name], value) if isinstance(value, torch.Tensor) else kept[name] == value


@pytest.mark.parametrize("tokenizer", [Memoryless(), Remembering()])
def test_a_resident_batch_mixes_episodes_views_starts_and_strides(tmp_path, tokenizer):
    generator = torch.Generator().manual_seed(0)
    config = EncodeLatentsConfig(start_step=2, strides=(1, 2))
    layout = choose_layout(tokenizer, torch.zeros(3, 9, 2, 2, dtype=torch.uint8), config)
    rows = []
    for name, count, views in (("a", 30, ("x", "y")), ("b", 17, ("z", "y", "x")), ("c", 22, ("y",))):
        video = torch.randint(0, 256, (len(views), 3, count, 2, 2), generator=generator, dtype=torch.uint8)
        save_file(encode_episode(tokenizer, name, list(video), layout, config), tmp_path / f"{name}.safetensors")
        rows.append(ClipRow(name, count, views, "s", "r", "train", "", views[-1], f"{name}.safetensors"))
    description = {"layout": layout, "start_step": 2, "strides": [1, 2], "latent_shape": [3, 2, 2]}
    store = LatentStore(tmp_path, description | {"image_size": [2, 2], "clip_frames": None}, rows)
    resident = ResidentLatents(store, "cpu")
    for length, strides in ((1, (1, 2)), (5, (2, 1)), (9, (1, 1))):
        clips = tuple(Clip(name, start, length, strides[start % 4 // 2]) for name in "ab" for start in range(0, 9, 2))
        for batch in (
            ClipBatch(clips, ("y", "x")), ClipBatch((*clips, Clip("c", 6, length, 1)), ("head",), primary=True)
        ):  # fmt: skip
            assert torch.equal(resident.read_batch(batch), store.read_batch(batch))
    resident._first["b/single" if layout == "groups" else "b/clips/1/0"] = (0, 0)
    with pytest.raises(ArtifactError, match=r"lack frames[\s\S]*b/(single|clips/1/0)"):
        read(resident, Clip("b", 0, 5, 1), ("x",))


def test_bad_requests_and_bad_values_are_named(world, tmp_path):
    root = shutil.copytree(world.latents, tmp_path / "latents")
    shard, whole = root / "00000.safetensors", Clip("episode-000", 0, 17, 1)
    for source in (LatentStore.open(root), ResidentLatents(LatentStore.open(root), "cpu")):
        for clip, views, message in (
            (dataclasses.replace(whole, start=4), VIEWS, r"at most 17 of 17[\s\S]*frames 4\.\.20"),
            (Clip("episode-000", 0, 5, 2), VIEWS, r"strides \[1\][\s\S]*frames 0\.\.8 by 2"),
            (Clip("unknown", 0, 5, 1), VIEWS, "unknown"),
            (Clip("episode-000", 0, 5, 1), ("top",), "top"),
        ):
            with pytest.raises(ArtifactError, match=message):
                read(source, clip, views)
    with pytest.raises(DataError, match="not finite in half precision"):
        encode_clip(
            SimpleNamespace(encode=lambda video: 1e5 * video), torch.zeros(3, 1, 2, 2, dtype=torch.uint8), "cpu"
        )
    for damage in (lambda: shard.write_bytes(shard.read_bytes()[:2000]), shard.unlink):
        damage()
        with pytest.raises(ArtifactError, match=r"00000\.safetensors"):
            read(LatentStore.open(root), whole)
    with pytest.raises(ArtifactError, match="not a Latents artifact"):
        LatentStore.open(tmp_path)


def open_frames(episodes, tokenizer, image_size=(32, 32)):
    return FrameSource(episodes, tokenizer, FrameInput(kind="frames", image_size=image_size))


@pytest.fixture
def episodes(world):
    return EpisodeSet.open(world.episodes)


def test_frames_are_those_of_the_episode_set(episodes, tokenizer):
    source = open_frames(episodes, tokenizer)
    for clip in (Clip("episode-003", 0, 17, 1), Clip("episode-005", 3, 5, 3), Clip("episode-000", 7, 9, 1)):
        position = episodes.position(clip.episode_id)
        for view, pictures in zip(VIEWS, read(source, clip), strict=True):
            assert np.array_equal(pictures, episodes.frames(position, view, list(clip.frames)))
    content = pickle.dumps(source)  # as it is sent to loader processes
    assert len(content) < 40_000
    assert np.array_equal(read(pickle.loads(content), clip), read(source, clip))  # noqa: S301 - our own


def test_segments_and_frames_without_images_are_respected(episodes, tokenizer):
    rows = [
        dataclasses.replace(row, start=4, stop=17, num_frames=13, video_frames=13 if number else 9)
        for number, row in enumerate(episodes.rows)
    ]
    cut, plain = open_frames(EpisodeSet(episodes.root, rows), tokenizer), open_frames(episodes, tokenizer)
    clip = Clip("episode-002", 3, 9, 1)
    assert np.array_equal(read(cut, clip), read(plain, dataclasses.replace(clip, start=7)))
    options = {"views": VIEWS, "start_step": 1, "batch_size": 4, "seed": 0}
    sampler = ClipSampler(cut.rows, ClipSampling(lengths=(9, 13)), **options)
    drawn = [clip for index in range(100) for clip in sampler.clips(index).clips]
    assert {(clip.start, clip.num_frames) for clip in drawn if clip.episode_id == "episode-000"} == {(0, 9)}
    assert {clip.start for clip in drawn if clip.num_frames == 9} == {0, 1, 2, 3, 4}
    with pytest.raises(DataError, match="outside of the clip"):
        read(cut, Clip("episode-002", 9, 5, 1))


def test_rows_fit_the_stage_and_its_views(episodes, tokenizer):
    changes = {2: {"views": ("head",)}, 3: {"stage2_ok": False}, 4: {"stage1_ok": False}, 5: {"views": ("left_wrist",)}}
    rows = [dataclasses.replace(row, **changes.get(number, {})) for number, row in enumerate(episodes.rows)]
    episodes = EpisodeSet(episodes.root, rows)
    source = open_frames(episodes, tokenizer)

    def numbers(stage, *views):
        return {int(row.episode_id[-3:]) for row in training_rows(source, episodes, stage=stage, views=views)}

    assert numbers(2, *VIEWS) == {0, 1, 2, 4, 5, 6, 7}  # each in the views that it has
    assert numbers(2, "head") == {0, 1, 2, 4, 6, 7}
    assert numbers(1) == {0, 1, 2, 3, 6, 7}
    with pytest.raises(DataError, match="top"):
        numbers(2, "top")
    with pytest.raises(ArtifactError, match="elsewhere"):
        source.row("elsewhere")


def test_a_clip_has_the_same_latents_cached_and_encoded_on_the_way(world, episodes, tokenizer, tmp_path):
    config = EncodeLatentsConfig(image_size=(32, 32), strides=(1, 2))
    encode_latents(config, {"episodes": world.episodes, "tokenizer": tokenizer}, tmp_path)
    store, source = LatentStore.open(tmp_path), open_frames(episodes, tokenizer)
    assert source.description["tokenizer"] == store.description["tokenizer"]
    assert source.latent_shape == store.latent_shape
    batches = (
        ClipBatch((Clip("episode-003", 0, 17, 1), Clip("episode-006", 0, 17, 1)), VIEWS),
        ClipBatch((Clip("episode-001", 4, 5, 2), Clip("episode-007", 8, 5, 2)), VIEWS),
        ClipBatch((Clip("episode-004", 8, 9, 1),), ("left_wrist",)),
        ClipBatch((Clip("episode-004", 4, 13, 1),), ("head",), primary=True),
    )
    for batch in batches:
        cached, online = (ClipLoader(kind, views=VIEWS).load(batch) for kind in (store, source))
        assert cached.views == online.views
        assert cached.latents.std() > 0.05
        # Half precision: eleven bits.
        torch.testing.assert_close(online.latents, cached.latents, rtol=2**-10, atol=2**-12)
        assert cached.frames is None and online.frames is not None


def test_frames_are_resized_as_encode_latents_does(episodes, tokenizer):
    for size in ((16, 24), (48, 64)):
        source = open_frames(episodes, tokenizer, size)
        frames = read(source, Clip("episode-001", 0, 5, 1), ("head",))[0]
        expected = frames_to_video(episodes.frames(1, "head", range(5)), size)
        assert torch.equal(torch.from_numpy(frames).permute(3, 0, 1, 2).float() / 127.5 - 1.0, expected)
        assert source.latent_shape == (4, size[0] // 8, size[1] // 8)
    with pytest.raises(ConfigError, match="36x32"):
        open_frames(episodes, tokenizer, (36, 32))
