"""Readers of a whole episode hold a few of its frames: three times the frames take no more memory."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.data.conftest import FPS, make_sample  # pyright: ignore[reportMissingImports]
from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.data.mcap.exported import read_exported_episode
from worldline_core.data.mcap.file import McapFile
from worldline_core.data.video.clip import Picture
from worldline_core.data.video.frames import VideoFrames, packed_images, pieces, unpacked_images
from worldline_core.evaluation.segmenters.segmenter import ColourSegmenter
from worldline_core.evaluation.video.episode_measurement import EpisodeMeasurement
from worldline_core.exports.export import export, shown_tracks
from worldline_core.pictures import write_side_by_side
from worldline_core.report.inspect import inspect
from worldline_core.rollout.rollout_set import RolloutSet, RolloutSetWriter

SHORT, LONG = 80, 240
HEIGHT, WIDTH = 96, 128
FRAME_BYTES = 3 * HEIGHT * WIDTH


def write_set(root: Path, count: int) -> None:
    """One episode with masks and labels, and a prediction of it that is the recording."""
    time = np.arange(count) / FPS
    poses = np.tile(np.diag([1.0, -1, -1, 1]), (count, 1, 1, 1))
    poses[:, 0, :3, 3] = np.stack([0.2 * np.sin(time), 0.1 * np.cos(time), np.full(count, 0.8)], axis=1)
    state = np.stack([np.sin(time), 0.5 + 0.5 * np.cos(time)], axis=1).astype(np.float32)
    episode, clips, masks = make_sample(
        num_frames=count, height=HEIGHT, width=WIDTH, episode_id="long", embodiment="none", split="test", state=state,
        action=state, state_names=("right/a", "right/gripper"), T_base_ee=poses, gripper=state[:, 1:],
    )  # fmt: skip
    with EpisodeSetWriter(root / "episodes", video_preset="ultrafast", pixel_format="yuv444p") as writer:
        writer.add(episode, clips, {"head": masks["head"]}, None, {"head": masks["head"].astype(np.uint8)})
    predictions = RolloutSetWriter(root / "rollouts", "stage2", FPS)
    predictions.add("long", 0, clips)
    predictions.close()


class Recorded:
    """A set that `write_set` wrote, as the outputs below take it."""

    def __init__(self, root: Path) -> None:
        self.set, self.predictions = root / "episodes", root / "rollouts"
        self.episodes, self.rollouts = EpisodeSet.open(self.set), RolloutSet.open(self.predictions)
        self.tracks_of_episode = shown_tracks(self.episodes.episode(0))
        self.videos = {view: VideoFrames(self.episodes.clip(0, view)) for view in VIEWS}

    def __contains__(self, _: str) -> bool:
        return True

    def tracks(self, _: str) -> Any:
        return self.tracks_of_episode


class Still(ColourSegmenter):
    """Masks every frame by itself, at no cost."""

    def stream(self) -> Callable[[np.ndarray, np.ndarray | None], np.ndarray]:
        return lambda video, _: video[..., 0] < 60


def measured(recorded: Any, _: Path) -> None:
    row = recorded.episodes.rows[0]
    measurement = EpisodeMeasurement(recorded.episodes, recorded, row, ("head",), {"": Still()}, None, {})
    values = measurement.measure({"stage2": recorded.rollouts})["true"]["measured"][0]["frames"]
    assert len(values["robot_iou_exact"]) == len(recorded.videos["head"])


def curated(recorded: Recorded, output: Path) -> None:
    source = {"kind": "episode_set", "name": "again", "path": str(recorded.set)}
    curate(CurateConfig.model_validate({"sources": [source], "image_size": [48, 64]}), {}, output)
    assert EpisodeSet.open(output).robot_masks(0, "head") is not None


def read_mcap(recorded: Recorded, output: Path) -> None:
    (path,) = export(recorded.set, output, ["mcap"])
    exact, read = recorded.episodes.robot_masks(0, "head"), read_exported_episode(McapFile(path)).robot_masks("head")
    assert exact is not None
    assert read is not None
    for one, other in zip(exact, read, strict=True):
        assert np.array_equal(one, other)


WITH_THUMBNAILS = "episode as lerobot"
"""Keeps grey thumbnails of 72 x 96 until the episode is whole, 0.19 of a view's frames each: those of three views, one of them
twice while it is stacked, and what they are packed into: 0.97 when measured."""

OUTPUTS: dict[str, Callable[[Recorded, Path], Any]] = {
    "side by side": lambda r, out: write_side_by_side(
        out / "a.mp4", {"true": r.videos["head"], "again": r.videos["head"]}, FPS, tile_height=96
    ),
    "episode as mcap": read_mcap,
    "episode as rrd": lambda r, out: export(r.set, out, ["rrd"]),
    "episode as lerobot": lambda r, out: export(r.set, out, ["lerobot"]),
    "rollout as mcap and rrd": lambda r, out: export(r.predictions, out, ["mcap", "rrd"], episodes=r.set),
    "worldarena": lambda r, out: export(r.predictions, out, ["worldarena"], episodes=r.set),
    "sheet of a rollout": lambda r, out: inspect(r.predictions, out),
    "inspect": lambda r, out: inspect(r.set, out, episode_id="long"),
    "exact masks": measured,
    "curate": curated,
}


@pytest.fixture(scope="module")
def lengths(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Recorded]:
    root = tmp_path_factory.mktemp("lengths")
    for count in (SHORT, LONG):
        write_set(root / str(count), count)
    return {count: Recorded(root / str(count)) for count in (SHORT, LONG)}


@pytest.mark.slow
@pytest.mark.parametrize("name", OUTPUTS)
def test_memory_does_not_grow_with_the_frames(
    lengths: dict[int, Recorded], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    whole = Picture.rgb.fget
    # Decoded frames lie in FFmpeg's memory, which is not traced; their copies are.
    monkeypatch.setattr(Picture, "rgb", property(lambda picture: np.array(whole(picture))))
    OUTPUTS[name](lengths[SHORT], tmp_path / "first")  # imports, fonts and tables that are read once
    peaks: dict[int, int] = {}
    for count, recorded in lengths.items():
        tracemalloc.start()
        try:
            OUTPUTS[name](recorded, tmp_path / str(count))
            peaks[count] = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
    one_view = (LONG - SHORT) * FRAME_BYTES
    assert peaks[LONG] - peaks[SHORT] < (1.1 * one_view if name == WITH_THUMBNAILS else one_view / 4)


def test_packed_masks_are_those_of_one_piece_and_read_in_pieces() -> None:
    """Pictures of any size: the bits of eight images end with a byte, those of one need not."""
    import zlib

    random = np.random.default_rng(0)
    for count, height, width in ((1, 1, 1), (7, 3, 5), (33, 13, 11), (60, 24, 32)):
        masks = random.random((count, height, width)) < 0.1
        masks[:, : height // 2] = False
        labels = masks.astype(np.uint8) * random.integers(1, 4, (count, 1, 1), dtype=np.uint8)
        for values, dtype, raw in ((masks, bool, np.packbits(masks)), (labels, np.uint8, labels)):
            packed = packed_images(values, dtype, 9).tobytes()
            assert packed == zlib.compress(raw.tobytes(), 9)
            read = unpacked_images(packed, (count, height, width), dtype, "here")
            assert np.array_equal(np.concatenate(list(pieces(read, 10))), values)
