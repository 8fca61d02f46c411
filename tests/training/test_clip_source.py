"""Clips from cached latents, resident latents and frames are the same clips; what cannot be read is named."""

from __future__ import annotations

import dataclasses
import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from einops import rearrange
from safetensors.torch import load_file, save_file

from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ArtifactError, ConfigError, DataError
from worldline_core.model.tokenizers import frames_to_video
from worldline_core.training.clip_config import ClipSampling, EncodeLatentsConfig, FrameInput
from worldline_core.training.clip_loader import ClipLoader
from worldline_core.training.clip_sampler import Clip, ClipBatch, ClipSampler, latent_frame_count, longest_clip
from worldline_core.training.clip_source import (
    ClipSource,
    FrameSource,
    LatentRow,
    LatentStore,
    ResidentLatents,
    training_rows,
)
from worldline_core.training.encode_latents import choose_layout, encode_episode, encode_latents

VIEWS = ("head", "left_wrist", "right_wrist")


class Memoryless:
    """Latent frame j sums its own four frames; the first frame alone is its own latent."""

    def encode(self, video: torch.Tensor) -> torch.Tensor:
        first = video[:, :, :1] * 4
        groups = rearrange(video[:, :, 1:], "b c (t k) h w -> b c t k h w", k=4).sum(3)
        return torch.cat([first, groups], 2)


class Remembering(Memoryless):
    """Every latent frame also holds the sum of all before it."""

    def encode(self, video: torch.Tensor) -> torch.Tensor:
        return super().encode(video).cumsum(2)


def read(source: ClipSource, clip: Clip, views: tuple[str, ...] = VIEWS) -> np.ndarray:
    return source.read(clip, views).numpy()


@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("start_step", [2, 3, 4])
@pytest.mark.parametrize("tokenizer", [Memoryless(), Remembering()])
def test_a_clip_of_the_store_equals_direct_encoding(
    tmp_path: Path, tokenizer: Memoryless, start_step: int, stride: int
) -> None:
    # White and black, -1 and 1, whose sums are exact.
    generator = torch.Generator().manual_seed(0)
    video = 255 * torch.randint(0, 2, (2, 3, 30, 2, 2), generator=generator, dtype=torch.uint8)
    config = EncodeLatentsConfig(start_step=start_step, strides=(stride,), views=("a", "b"))
    layout = choose_layout(tokenizer, video[0], config)
    assert layout == ("clips" if isinstance(tokenizer, Remembering) else "groups")
    save_file(encode_episode(tokenizer, "e", list(video), layout, config), tmp_path / "s.safetensors")
    video = video / 127.5 - 1
    row = LatentRow("e", 30, ("a", "b"), "s", "r", "train", "", "a", "s.safetensors")
    description = {"layout": layout, "start_step": start_step, "strides": [stride], "latent_shape": [3, 2, 2]}
    store = LatentStore(tmp_path, description | {"image_size": [2, 2]}, [row])
    resident = ResidentLatents(store, "cpu")
    checked = 0
    for start in range(0, 30, start_step):
        for length in range(1, longest_clip(row.num_frames, start, stride) + 1, 4):
            clip = Clip("e", start, length, stride)
            expected = tokenizer.encode(video[:, :, list(clip.frames)])
            assert np.array_equal(read(store, clip, ("a", "b")), expected)
            numbers = torch.from_numpy(read(resident, clip, ("b", "a")))
            assert torch.equal(resident.latents(numbers[None], "cpu")[0], expected[[1, 0]])
            checked += 1
    assert checked > 15


def test_resident_batches_are_those_of_the_store(world: Any) -> None:
    store, tracks = LatentStore.open(world.latents), ActionTracks.open(world.tracks)
    resident = ResidentLatents(store, "cpu")
    config = ClipSampling(lengths=(5, 9, 17), view_weights={"joint": 1.0, "left_wrist": 1.0})
    sampler = ClipSampler(store.rows, config, views=VIEWS, splits=["train"], start_step=4, batch_size=3, seed=0)
    for action_frames in (1, 4):
        options: Any = {"views": VIEWS, "action_frames": action_frames}
        loaders = [ClipLoader(source, tracks=tracks, **options) for source in (store, resident)]
        for index in range(8):
            read_, kept = (vars(loader.load(sampler.clips(index))) for loader in loaders)
            for name, value in read_.items():
                assert torch.equal(kept[name], value) if isinstance(value, torch.Tensor) else kept[name] == value


def test_bad_requests_and_bad_values_are_named(world: Any, tmp_path: Path) -> None:
    root = tmp_path / "latents"
    shutil.copytree(world.latents, root)
    assert latent_frame_count(33) == 9
    with pytest.raises(DataError, match="32"):
        latent_frame_count(32)
    for source in (LatentStore.open(root), ResidentLatents(LatentStore.open(root), "cpu")):
        with pytest.raises(DataError, match="start 4, 17 frames, stride 1"):
            read(source, Clip("episode-000", 4, 17, 1))
        with pytest.raises(ArtifactError, match=r"\(1,\)[\s\S]*got: 2"):
            read(source, Clip("episode-000", 0, 5, 2))
        with pytest.raises(ArtifactError, match="nobody"):
            read(source, Clip("nobody", 0, 5, 1))
        with pytest.raises(ArtifactError, match="top"):
            read(source, Clip("episode-000", 0, 5, 1), ("top",))
    tensors = load_file(root / "00000.safetensors")
    tensors["episode-000/groups/1/1"][0, 0, 0, 0, 0] = float("nan")
    save_file(tensors, root / "00000.safetensors")
    with pytest.raises(DataError, match=r"not finite[\s\S]*episode-000"):
        read(LatentStore.open(root), Clip("episode-000", 0, 17, 1))
    with pytest.raises(DataError, match=r"not finite[\s\S]*episode-000"):
        ResidentLatents(LatentStore.open(root), "cpu")
    with pytest.raises(ArtifactError, match="not a Latents artifact"):
        LatentStore.open(tmp_path)


def test_a_damaged_and_a_missing_shard_are_named(world: Any, tmp_path: Path) -> None:
    root = tmp_path / "latents"
    shutil.copytree(world.latents, root)
    shard = root / "00000.safetensors"
    shard.write_bytes(shard.read_bytes()[: shard.stat().st_size // 2])
    with pytest.raises(ArtifactError, match=r"00000\.safetensors"):
        read(LatentStore.open(root), Clip("episode-000", 0, 17, 1))
    shard.unlink()
    with pytest.raises(ArtifactError, match=r"(?s)00000\.safetensors.*encode the latents again"):
        read(LatentStore.open(root), Clip("episode-000", 0, 17, 1))


def open_frames(episodes: EpisodeSet | Path, tokenizer: Path, **changes: Any) -> FrameSource:
    values = {"image_size": [32, 32], **changes}
    episodes = EpisodeSet.open(episodes) if isinstance(episodes, Path) else episodes
    return FrameSource(episodes, tokenizer, FrameInput.model_validate(values))


def test_frames_are_those_of_the_episode_set(world: Any, tokenizer: Path) -> None:
    episodes = EpisodeSet.open(world.episodes)
    source = open_frames(episodes, tokenizer)
    for clip in (Clip("episode-003", 0, 17, 1), Clip("episode-005", 3, 5, 3), Clip("episode-000", 7, 9, 1)):
        position = episodes.position(clip.episode_id)
        for view, pictures in zip(VIEWS, read(source, clip), strict=True):
            assert np.array_equal(pictures, episodes.frames(position, view, list(clip.frames)))


def test_segments_and_frames_without_images_are_respected(world: Any, tokenizer: Path) -> None:
    whole = EpisodeSet.open(world.episodes)
    rows = [
        dataclasses.replace(row, start=4, stop=17, num_frames=13, video_frames=13 if number else 9)
        for number, row in enumerate(whole.rows)
    ]
    cut, plain = open_frames(EpisodeSet(world.episodes, rows), tokenizer), open_frames(whole, tokenizer)
    clip = Clip("episode-002", 3, 9, 1)
    assert np.array_equal(read(cut, clip), read(plain, dataclasses.replace(clip, start=7)))
    splits = ["train", "validation"]
    config = ClipSampling(lengths=(9, 13))
    sampler = ClipSampler(cut.rows, config, views=VIEWS, splits=splits, start_step=1, batch_size=4, seed=0)
    drawn = [clip for index in range(100) for clip in sampler.clips(index).clips]
    assert {clip.start for clip in drawn if clip.episode_id == "episode-000"} == {0}
    assert not any(clip.episode_id == "episode-000" and clip.num_frames == 13 for clip in drawn)
    assert {clip.start for clip in drawn if clip.num_frames == 9} == {0, 1, 2, 3, 4}
    with pytest.raises(DataError, match="outside of the clip"):
        read(cut, Clip("episode-002", 9, 5, 1))


def test_rows_fit_the_stage_and_its_views(world: Any, tokenizer: Path) -> None:
    whole = EpisodeSet.open(world.episodes)
    rows = list(whole.rows)
    rows[2] = dataclasses.replace(rows[2], views=("head",))
    rows[3] = dataclasses.replace(rows[3], stage2_ok=False)
    rows[4] = dataclasses.replace(rows[4], stage1_ok=False)
    rows[5] = dataclasses.replace(rows[5], views=("left_wrist",))
    episodes = EpisodeSet(world.episodes, rows)
    source = open_frames(episodes, tokenizer)
    names = {row.episode_id: number for number, row in enumerate(rows)}

    def numbers(stage: Any, *views: str) -> set[int]:
        return {names[row.episode_id] for row in training_rows(source, episodes, stage=stage, views=views)}

    assert numbers(2, *VIEWS) == {0, 1, 2, 4, 5, 6, 7}  # each in the views that it has
    assert numbers(2, "head") == {0, 1, 2, 4, 6, 7}
    assert numbers(1) == {0, 1, 2, 3, 6, 7}
    with pytest.raises(DataError, match="top"):
        numbers(2, "top")
    with pytest.raises(ArtifactError, match="elsewhere"):
        source.row("elsewhere")


def test_a_clip_has_the_same_latents_cached_and_encoded_on_the_way(world: Any, tokenizer: Path, tmp_path: Path) -> None:
    config = EncodeLatentsConfig(image_size=(32, 32), strides=(1, 2))
    encode_latents(config, {"episodes": world.episodes, "tokenizer": tokenizer}, tmp_path)
    store, source = LatentStore.open(tmp_path), open_frames(world.episodes, tokenizer)
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
        assert cached.frames is None
        assert online.frames is not None


def test_frames_are_resized_as_encode_latents_does(world: Any, tokenizer: Path) -> None:
    episodes = EpisodeSet.open(world.episodes)
    for size in ((16, 24), (48, 64)):
        source = open_frames(episodes, tokenizer, image_size=size)
        frames = read(source, Clip("episode-001", 0, 5, 1), ("head",))[0]
        expected = frames_to_video(episodes.frames(1, "head", range(5)), size)
        assert torch.equal(torch.from_numpy(frames).permute(3, 0, 1, 2).float() / 127.5 - 1.0, expected)
        assert source.latent_shape == (4, size[0] // 8, size[1] // 8)
    with pytest.raises(ConfigError, match="36x32"):
        open_frames(episodes, tokenizer, image_size=(36, 32))


def test_what_is_sent_to_loader_processes_reads_the_same(world: Any, tokenizer: Path) -> None:
    source = open_frames(world.episodes, tokenizer)
    clip = Clip("episode-002", 1, 9, 1)
    first = read(source, clip)
    content = pickle.dumps(source)
    assert len(content) < 40_000
    assert np.array_equal(read(pickle.loads(content), clip), first)  # noqa: S301 - our own
