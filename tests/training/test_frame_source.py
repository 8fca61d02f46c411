from __future__ import annotations

import dataclasses
import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ArtifactError, ConfigError, DataError, UnavailableError
from worldline_core.model.video_tokenizer import frames_to_video
from worldline_core.training.clip_config import (
    ClipSampling,
    EncodeLatentsConfig,
    FrameInput,
    LatentInput,
    ReadingConfig,
)
from worldline_core.training.clip_loader import ClipLoader, ClipReader, SkipLog
from worldline_core.training.clip_sampler import ClipSampler
from worldline_core.training.clip_source import Clip, ClipBatch, training_rows
from worldline_core.training.encode_latents import encode_latents
from worldline_core.training.frame_source import FrameSource, frame_rows
from worldline_core.training.latent_store import LatentStore

VIEWS = ("head", "left_wrist", "right_wrist")


def open_source(episodes: EpisodeSet | Path, tokenizer: Path, **changes: Any) -> FrameSource:
    values = {"image_size": [32, 32], **changes}
    primary_alone = values.pop("primary_alone", False)
    return FrameSource.open(
        EpisodeSet.open(episodes) if isinstance(episodes, Path) else episodes,
        tokenizer,
        FrameInput.model_validate(values),
        views=VIEWS,
        primary_alone=primary_alone,
        device="cpu",
    )


def frames_of(source: FrameSource, clip: Clip, views: tuple[str, ...] = VIEWS) -> np.ndarray:
    out = np.empty((len(views), *source.shape(clip.num_frames)), np.uint8)
    source.read(clip, views, out)
    return out


@pytest.mark.parametrize("decoder", ["auto", "pyav"])
def test_frames_are_those_of_the_episode_set(world: Any, tokenizer: Path, decoder: str) -> None:
    episodes = EpisodeSet.open(world.episodes)
    source = open_source(episodes, tokenizer, decoder=decoder)
    for clip in (Clip("episode-003", 0, 17, 1), Clip("episode-005", 3, 5, 3), Clip("episode-000", 7, 9, 1)):
        frames = frames_of(source, clip, VIEWS)
        position = episodes.position(clip.episode_id)
        for view, pictures in zip(VIEWS, frames, strict=True):
            assert np.array_equal(pictures, episodes.frames(position, view, list(clip.frames)))
    source.close()


def test_segments_and_frames_without_images_are_respected(world: Any, tokenizer: Path) -> None:
    whole = EpisodeSet.open(world.episodes)
    rows = [
        dataclasses.replace(row, start=4, stop=17, num_frames=13, video_frames=13 if number else 9)
        for number, row in enumerate(whole.rows)
    ]
    cut = open_source(EpisodeSet(world.episodes, rows), tokenizer)
    plain = open_source(whole, tokenizer)
    clip = Clip("episode-002", 3, 9, 1)
    assert np.array_equal(frames_of(cut, clip, VIEWS), frames_of(plain, dataclasses.replace(clip, start=7), VIEWS))
    config = ClipSampling(lengths=(9, 13))
    sampler = ClipSampler(cut, config, splits=["train", "validation"], batch_size=4, seed=0)
    drawn = [clip for index in range(100) for clip in sampler.clips(index).clips]
    assert {clip.start for clip in drawn if clip.episode_id == "episode-000"} == {0}
    assert not any(clip.episode_id == "episode-000" and clip.num_frames == 13 for clip in drawn)
    assert {clip.start for clip in drawn if clip.num_frames == 9} == {0, 1, 2, 3, 4}
    with pytest.raises(DataError, match="outside of the clip"):
        frames_of(cut, Clip("episode-002", 9, 5, 1), VIEWS)


def test_rows_fit_the_stage_and_its_views(world: Any, tokenizer: Path) -> None:
    whole = EpisodeSet.open(world.episodes)
    rows = list(whole.rows)
    rows[2] = dataclasses.replace(rows[2], views=("head",))
    rows[3] = dataclasses.replace(rows[3], stage2_ok=False)
    rows[4] = dataclasses.replace(rows[4], stage1_ok=False)
    rows[5] = dataclasses.replace(rows[5], views=("left_wrist",))
    episodes = EpisodeSet(world.episodes, rows)
    joint, primary = open_source(episodes, tokenizer), open_source(episodes, tokenizer, primary_alone=True)
    names = {row.episode_id: number for number, row in enumerate(rows)}

    def numbers(source: FrameSource, stage: Any) -> set[int]:
        return {names[row.episode_id] for row in training_rows(source, episodes, stage=stage)}

    assert numbers(joint, 2) == {0, 1, 4, 6, 7}
    assert numbers(joint, 1) == {0, 1, 3, 6, 7}
    assert numbers(primary, 1) == {0, 1, 2, 3, 6, 7}
    with pytest.raises(DataError, match="No episode has the views"):
        frame_rows(episodes, ("top",), primary_alone=False)
    with pytest.raises(ArtifactError, match="does not hold this episode"):
        joint.row("episode-002")


@pytest.mark.parametrize("layout", ["groups", "clips"])
def test_a_clip_has_the_same_latents_cached_and_encoded_on_the_way(
    world: Any, tokenizer: Path, tmp_path: Path, layout: str
) -> None:
    settings = {"image_size": [32, 32], "strides": [1, 2], "layout": layout}
    config = EncodeLatentsConfig.model_validate(settings)
    encode_latents(config, {"episodes": world.episodes, "tokenizer": tokenizer}, tmp_path)
    store = LatentStore.open(tmp_path)
    source = open_source(world.episodes, tokenizer)
    assert source.description["tokenizer"] == store.description["tokenizer"]
    assert source.latent_shape == store.latent_shape
    batches = (
        ClipBatch((Clip("episode-003", 0, 17, 1), Clip("episode-006", 0, 17, 1)), None),
        ClipBatch((Clip("episode-001", 4, 5, 2), Clip("episode-007", 8, 5, 2)), None),
        ClipBatch((Clip("episode-004", 8, 9, 1),), "left_wrist"),
        ClipBatch((Clip("episode-004", 4, 13, 1),), "primary"),
    )
    for batch in batches:
        cached, online = (ClipLoader(kind, views=VIEWS).load(batch) for kind in (store, source))
        assert cached.views == online.views
        assert cached.latents.shape == online.latents.shape
        assert cached.latents.std() > 0.05
        # Half precision: eleven bits.
        torch.testing.assert_close(online.latents, cached.latents, rtol=2**-10, atol=2**-12)
        assert cached.frames is None
        assert online.frames is not None


def test_frames_are_resized_as_encode_latents_does(world: Any, tokenizer: Path) -> None:
    episodes = EpisodeSet.open(world.episodes)
    for size in ((16, 24), (48, 64)):
        source = open_source(episodes, tokenizer, image_size=size)
        frames = frames_of(source, Clip("episode-001", 0, 5, 1), ("head",))[0]
        expected = frames_to_video(episodes.frames(1, "head", range(5)), size)
        found = torch.from_numpy(frames).permute(3, 0, 1, 2).float() / 127.5 - 1.0
        assert torch.equal(found, expected)
        assert source.latent_shape == (4, size[0] // 8, size[1] // 8)
    with pytest.raises(ConfigError, match="cannot code images of this size"):
        open_source(episodes, tokenizer, image_size=(36, 32))


def test_what_is_sent_to_loader_processes_reads_the_same(world: Any, tokenizer: Path) -> None:
    source = open_source(world.episodes, tokenizer)
    clip = Clip("episode-002", 1, 9, 1)
    first = frames_of(source, clip, VIEWS)
    content = pickle.dumps(source)
    assert len(content) < 40_000
    copy: FrameSource = pickle.loads(content)  # noqa: S301 - our own
    assert np.array_equal(frames_of(copy, clip, VIEWS), first)
    with pytest.raises(ArtifactError, match="without a tokenizer has no latents"):
        copy.latents(torch.from_numpy(first)[None], "cpu")


def damaged(world: Any, folder: Path, view: str = "left_wrist") -> EpisodeSet:
    """The world's episodes, the second half of one view's only video file overwritten."""
    shutil.copytree(world.episodes, folder)
    (video,) = folder.rglob(f"*{view}*/**/*.mp4")
    content = bytearray(video.read_bytes())
    content[len(content) // 2 :] = bytes(len(content) - len(content) // 2)
    video.write_bytes(content)
    return EpisodeSet.open(folder)


@pytest.mark.parametrize("decoder", ["auto", "pyav"])
def test_a_damaged_clip_is_named_or_skipped_and_counted(
    world: Any, tokenizer: Path, tmp_path: Path, decoder: str
) -> None:
    episodes = damaged(world, tmp_path / "set")
    source = open_source(episodes, tokenizer, decoder=decoder)

    faults: dict[str, str] = {}
    for row in episodes.rows:
        try:
            frames_of(source, Clip(row.episode_id, 0, 17, 1), VIEWS)
        except DataError as error:
            faults[row.episode_id] = str(error)
    assert all(f"{name}, frames 0..16, view left_wrist, in" in fault for name, fault in faults.items())
    assert all(".mp4" in fault for fault in faults.values())
    good = {row.episode_id for row in episodes.rows} - set(faults)
    assert 0 < len(good) < 8
    sampler = ClipSampler(source, ClipSampling(lengths=(17,)), splits=["train", "validation"], batch_size=3, seed=1)
    strict = ClipReader(source, sampler, VIEWS)
    with pytest.raises(DataError, match="A clip cannot be read"):
        [strict.read(index) for index in range(10)]
    lenient = ClipReader(source, sampler, VIEWS, ReadingConfig(on_unreadable="skip"))
    log = SkipLog(tmp_path / "run", 0, limit=100)
    skipped = 0
    for index in range(10):
        read = lenient.read(index)
        bad = {clip for clip in sampler.clips(index).clips if clip.episode_id not in good}
        assert {clip.episode_id for clip in read.batch.clips} <= good
        assert bad <= {item.clip for item in read.skipped}
        assert all(item.clip.episode_id in faults for item in read.skipped)
        for clip, frames in zip(read.batch.clips, read.data, strict=True):
            assert np.array_equal(frames.numpy(), frames_of(source, clip, VIEWS))
        log.add(read.skipped)
        skipped += len({(item.index, item.clip) for item in read.skipped})
    assert skipped > 0
    # Steps that are done again after a kill, and a line that the kill cut short, change no count.
    log = SkipLog(tmp_path / "run", 0, limit=100)
    for index in range(10):
        log.add(lenient.read(index).skipped)
    with log.path.open("a") as file:
        file.write('{"index": 3, "cl')
    assert SkipLog.count(tmp_path / "run") == skipped
    assert SkipLog.count(tmp_path / "elsewhere") == 0
    with pytest.raises(DataError, match="Too many clips cannot be read"):
        SkipLog(tmp_path / "run", 0, limit=skipped - 1).add(())


def test_where_nothing_can_be_read_skipping_ends(world: Any, tokenizer: Path, tmp_path: Path) -> None:
    shutil.copytree(world.episodes, tmp_path / "set")
    for video in (tmp_path / "set").rglob("*.mp4"):
        video.write_bytes(b"\0" * 100)
    source = open_source(tmp_path / "set", tokenizer)
    sampler = ClipSampler(source, ClipSampling(lengths=(17,)), splits=["train"], batch_size=1, seed=1)
    with pytest.raises(DataError, match="No readable clip was found"):
        ClipReader(source, sampler, VIEWS, ReadingConfig(on_unreadable="skip")).read(0)


def test_cached_latents_can_be_skipped_too(world: Any, tmp_path: Path) -> None:
    store = LatentStore.open(world.latents)

    class Broken(LatentStore):
        def clip(self, episode_id: str, *arguments: Any) -> Any:
            if episode_id == "episode-004":
                raise DataError("Cached latents hold values that are not finite.", where=episode_id)
            return super().clip(episode_id, *arguments)

    broken = Broken(store.root, store.description, store.rows)
    sampler = ClipSampler(broken, ClipSampling(lengths=(9,)), splits=["train"], batch_size=4, seed=1)
    reader = ClipReader(broken, sampler, VIEWS, LatentInput(on_unreadable="skip"))
    reads = [reader.read(index) for index in range(12)]
    assert sum(len(read.skipped) for read in reads) > 0
    assert all(clip.episode_id != "episode-004" for read in reads for clip in read.batch.clips)
    for read in reads:
        for clip, latents in zip(read.batch.clips, read.data, strict=True):
            assert torch.equal(latents, store.clip(clip.episode_id, clip.start, clip.num_frames, 1, VIEWS))


def test_an_explicit_torchcodec_that_cannot_load_stops_before_training(
    world: Any, tokenizer: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("worldline_core.data.video.frame_decoder.torchcodec_fault", lambda: "OSError: libavcodec.so")
    with pytest.raises(UnavailableError, match="torchcodec cannot be loaded"):
        open_source(world.episodes, tokenizer, decoder="torchcodec")
    assert open_source(world.episodes, tokenizer).description["decoder"].startswith("PyAV")
