"""Helpers of the data tests: curation in one call, its results, damaged HDF5 files, and videos as other programs write them."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from fractions import Fraction
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any

import av
import h5py
import numpy as np
import pytest
import yaml

from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.video.encoder import encode_video

ROOT = Path(__file__).resolve().parents[2]


def run(tmp_path: Path, *sources: dict[str, Any], **changes: Any) -> tuple[dict[str, Any], EpisodeSet]:
    """Curate into `tmp_path / "out"`; returns the counts and the set."""
    counts = curate(CurateConfig.model_validate({"sources": sources, **changes}), {}, tmp_path / "out")
    assert counts["kept"] + counts["quarantined"] == counts["found"]
    return counts, EpisodeSet.open(tmp_path / "out")


@contextmanager
def rejected(reason: str, match: str) -> Iterator[pytest.ExceptionInfo[RejectedInputError]]:
    with pytest.raises(RejectedInputError, match=match) as caught:
        yield caught
    assert caught.value.reason == reason


def reasons(curated: EpisodeSet) -> dict[str, str]:
    return {row.episode_id: row.reason for row in curated.quarantine()}


def preset(preset: str, path: Path, **changes: Any) -> dict[str, Any]:
    """The source of a shipped configuration, pointed at a folder."""
    content = yaml.safe_load((ROOT / f"configs/sources/{preset}.yaml").read_text())
    return {**content["curate"]["sources"][0], "path": str(path), "name": preset, **changes}


def record(root: Path, samples: Iterable[tuple], crf: int = 8) -> Path:
    with EpisodeSetWriter(root, video_crf=crf) as writer:
        for sample in samples:
            writer.add(*sample)
    return root


def files_of(root: Path) -> dict[str, bytes]:
    """Contents by path, without what belongs to no digest."""
    paths = {path.relative_to(root): path for path in sorted(root.rglob("*")) if path.is_file()}
    return {str(name): path.read_bytes() for name, path in paths.items() if name.parts[0] != "run"}


def packets(path: Path) -> list[bytes]:
    with av.open(str(path)) as container:
        return [bytes(packet) for packet in container.demux(video=0) if packet.size]


def plain_frames(path: Path) -> np.ndarray:
    """Every frame as FFmpeg shows it, with nothing of this project."""
    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


def write_video(
    path: Path,
    frames: np.ndarray,
    *,
    rate: int = 8,
    codec: str = "libx264",
    options: dict[str, str] | None = None,
    times: Iterable[int] | None = None,
    tick: Fraction | None = None,
    pixel_format: str = "yuv420p",
) -> Path:
    """As another program would; `times` in ticks, by default one tick a frame. The same pictures are encoded once."""
    path.parent.mkdir(parents=True, exist_ok=True)
    ticks, chosen = tuple(times or range(len(frames))), tuple((options or {}).items())
    given = (frames.tobytes(), frames.shape, rate, codec, chosen, ticks, tick or Fraction(1, rate), pixel_format)
    path.write_bytes(_encoded(*given))
    return path


@lru_cache(maxsize=64)
def _encoded(
    pictures: bytes,
    shape: tuple[int, ...],
    rate: int,
    codec: str,
    options: tuple[tuple[str, str], ...],
    times: tuple[int, ...],
    tick: Fraction,
    pixel_format: str,
) -> bytes:
    with BytesIO() as file:
        with av.open(file, "w", format="mp4") as out:
            stream: Any = out.add_stream(codec, rate=rate, options=dict(options))
            stream.height, stream.width, stream.pix_fmt = *shape[1:3], pixel_format
            stream.codec_context.thread_count = 1
            stream.codec_context.time_base = tick
            for time, image in zip(times, np.frombuffer(pictures, np.uint8).reshape(shape), strict=True):
                frame = av.VideoFrame.from_ndarray(image, format="rgb24")
                frame.pts, frame.time_base = time, tick
                out.mux(stream.encode(frame))
            out.mux(stream.encode(None))
        return file.getvalue()


PATCHES = np.array(
    [[(200, 30, 40), (30, 180, 60), (40, 60, 210)], [(230, 220, 40), (120, 120, 120), (20, 200, 220)]], np.uint8
)


def enlarged(patches: np.ndarray, side: int) -> np.ndarray:
    return patches.repeat(side, 0).repeat(side, 1)


def off(frames: np.ndarray, patches: np.ndarray = PATCHES) -> int:
    """Largest difference from the patches in their middle, where nothing is smeared."""
    height, width = frames.shape[-3] // patches.shape[0], frames.shape[-2] // patches.shape[1]
    centres = frames[..., height // 2 :: height, width // 2 :: width, :]
    assert centres.shape[-3:] == patches.shape
    return int(np.abs(centres.astype(int) - patches).max())


def by_ffmpeg(path: Path, height: int, width: int) -> np.ndarray | None:
    """Every frame as the command shows it; None where there is none."""
    if shutil.which("ffmpeg") is None:
        return None
    command = ["ffmpeg", "-v", "error", "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(command, capture_output=True, check=True).stdout
    return np.frombuffer(raw, np.uint8).reshape(-1, height, width, 3)


Damage = Callable[[Path], object]


def edit(change: Callable[[Any], object]) -> Damage:
    def apply(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            change(file)

    return apply


def replaced(key: str, make: Callable[[np.ndarray], Any]) -> Damage:
    def change(file: Any) -> None:
        values = make(file[key][()])
        del file[key]
        file[key] = values

    return edit(change)


def without(key: str) -> Damage:
    return edit(lambda file: file.__delitem__(key))


def with_nan(values: np.ndarray) -> np.ndarray:
    values = values.astype(float)
    values[2] = np.nan
    return values


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def moved_out(path: Path) -> None:
    """The file is beside the recordings' folder `raw`, and a link leads there."""
    outside = next(parent for parent in path.parents if parent.name == "raw").parent / path.name
    path.symlink_to(path.rename(outside))


def black_video(path: Path, num_frames: int, fps: float) -> None:
    encode_video(path, np.zeros((num_frames, 48, 64, 3), np.uint8), fps, preset="ultrafast")


def check_faults(
    root: Path, settings: dict[str, Any], write: Callable[[Path, int], Path], faults: Mapping[str, tuple[Damage, str]]
) -> None:
    """One recording a fault and a sound one, whose ids end with their numbers: each fault has its reason, and no other is lost."""
    for number, (damage, _) in enumerate(faults.values()):
        damage(write(root, number))
    write(root, len(faults))
    _, curated = run(root.parent, {**settings, "path": str(root)})
    numbers = {int(re.findall(r"\d+$", name)[0]): reason for name, reason in reasons(curated).items()}
    assert {name: numbers.get(number) for number, name in enumerate(faults)} == {n: r for n, (_, r) in faults.items()}
    assert len(curated.rows) == 1
