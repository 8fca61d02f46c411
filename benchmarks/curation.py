"""Curation: its speed beside plain decoding, and how well it finds near duplicates.

    python benchmarks/curation.py speed [--episodes 12] [--seconds 10] [--crf 23]
    python benchmarks/curation.py duplicates

- `speed`: curation and filtering of 480 x 640 recordings with three views at 30 fps, made from the shipped ones: enlarged,
  slowed down, given texture and sensor noise, and encoded by libx264 as cameras usually do (preset medium, B-frames);
  states and calibration follow, so that every filter runs. The floor is plain decoding of the same files in the same
  process. Processor time.
- `duplicates`: every shipped recording copied in twelve ways. A copy counts as found when the search names its own
  original. Different episodes must not be found: the recordings among themselves, and the candidate banks, whose 32
  candidates start from one state.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from benchmarks.harness import RECORDINGS, command_line, print_table, timed
from tools.labelled_clips import view_thumbnails
from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.curation.rules import find_near_duplicates
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.data.episodes.fingerprint import Fingerprint, fingerprint
from worldline_core.data.episodes.view_recording import ViewImages
from worldline_core.data.video.clip import VideoClip, decode_video
from worldline_core.data.video.encoder import encode_video
from worldline_core.filters.filter import filter_episodes
from worldline_core.filters.filter_config import FilterConfig

SIZE, FPS, TURNS = (480, 640), 30.0, 3
Frames = Mapping[str, np.ndarray]
Change = Callable[[Episode, Frames], tuple[Episode, Frames]]


# Speed


def slowed(episode: Episode, count: int) -> tuple[Episode, np.ndarray]:
    """The episode with `count` frames at 30 fps, and the position (n,) of each between its own frames."""
    at = np.linspace(0, episode.num_frames - 1, count)

    def between(values: np.ndarray) -> np.ndarray:
        low = np.floor(at).astype(int)
        share = (at - low).reshape(-1, *[1] * (values.ndim - 1))
        return (values[low] * (1 - share) + values[np.minimum(low + 1, len(values) - 1)] * share).astype(values.dtype)

    def poses(track: np.ndarray) -> np.ndarray:
        result = np.tile(np.eye(4), (count, 1, 1))
        result[:, :3, 3] = between(track[:, :3, 3])
        result[:, :3, :3] = Slerp(np.arange(len(track)), Rotation.from_matrix(track[:, :3, :3]))(at).as_matrix()
        return result

    cameras = {}
    for view, camera in episode.cameras.items():
        track = camera.resized(SIZE[1], SIZE[0])
        moved = poses(track.T_base_camera) if track.moving else track.T_base_camera
        cameras[view] = CameraTrack(view, track.K, moved, SIZE[1], SIZE[0])
    return replace(
        episode,
        fps=FPS,
        state=between(episode.state),
        action=between(episode.action),
        timestamps=np.arange(count) / FPS,
        cameras=cameras,
        T_base_ee=None,
        gripper=None,
        video_frames=None,
    ), at


def write_clip(path: Path, frames: np.ndarray, at: np.ndarray, crf: int, seed: int) -> None:
    """The frames at the places `at`, enlarged, with texture and sensor noise, as an ordinary H.264 mp4."""
    generator = np.random.default_rng(seed)
    texture = cv2.GaussianBlur(generator.normal(0, 30, (*SIZE, 1)).astype(np.float32), (0, 0), 1.5)[..., None]
    noise = [
        np.rint(texture + generator.normal(0, 4.5, (*SIZE, 1))).astype(np.int16).repeat(3, axis=2) for _ in range(16)
    ]
    large = [cv2.resize(frame, SIZE[::-1], interpolation=cv2.INTER_CUBIC) for frame in frames]
    with av.open(str(path), "w", format="mp4") as out:
        stream = out.add_stream("libx264", rate=int(FPS))
        stream.height, stream.width, stream.pix_fmt = *SIZE, "yuv420p"
        stream.options = {"crf": str(crf), "preset": "medium", "threads": "1"}
        for number, place in enumerate(at):
            low = int(place)
            blended = cv2.addWeighted(
                large[low], 1 - (place - low), large[min(low + 1, len(large) - 1)], place - low, 0
            )
            image = np.asarray(cv2.add(blended, noise[number % len(noise)], dtype=cv2.CV_8U), dtype=np.uint8)
            out.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        out.mux(stream.encode(None))


def make_corpus(folder: Path, episodes: int, seconds: float, crf: int) -> None:
    """An EpisodeSet whose videos are such clips, one file each."""
    recordings = EpisodeSet.open(RECORDINGS)
    usable = [i for i, row in enumerate(recordings.rows) if len(row.views) == 3 and row.split != "bank"]
    count = round(seconds * FPS)
    clips = folder.with_name(f"{folder.name}.clips")
    clips.mkdir(parents=True, exist_ok=True)
    with EpisodeSetWriter(folder) as writer:
        for number, source in enumerate(usable[:episodes]):
            episode, at = slowed(recordings.episode(source), count)
            views = {}
            for k, view in enumerate(recordings.rows[source].views):
                path = clips / f"{number}.{view}.mp4"
                write_clip(path, recordings.frames(source, view), at, crf, 10 * number + k)
                clip = VideoClip.whole_file(path, count, FPS)
                views[view] = ViewImages(lambda: iter(()), count, clip)
            writer.add(episode, views)
            for view in views:
                (clips / f"{number}.{view}.mp4").unlink()
    clips.rmdir()


def plain_decode(corpus: Path) -> int:
    """Decodes every video of a set; returns the number of frames."""
    count = 0
    for path in sorted(corpus.rglob("*.mp4")):
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            stream.thread_type = "NONE"
            count += sum(1 for _ in container.decode(stream))
    return count


def both_steps(corpus: Path, output: Path) -> None:
    config = {"sources": [{"kind": "episode_set", "path": str(corpus)}]}
    curate(CurateConfig.model_validate(config), {}, output / "curated")
    filter_episodes(FilterConfig(), {"episodes": output / "curated"}, output / "filtered")


def measure_speed(corpus: Path, work: Path) -> None:
    frames = plain_decode(corpus)  # unmeasured: files come from memory in each of the measurements
    both_steps(corpus, work / "warm")  # imports, kinematics, FFmpeg's tables
    floors, totals = [], []
    for turn in range(TURNS):  # in turns, so that a busy machine weighs on both
        floors.append(timed(lambda: plain_decode(corpus))[2])
        totals.append(timed(lambda turn=turn: both_steps(corpus, work / f"turn{turn}"))[2])
    floor, total = sum(floors) / TURNS, sum(totals) / TURNS
    seconds = {"floor: plain decoding": floor, "curate and filter": total}
    print_table(("", "ms a frame", "over the floor"), ((w, 1e3 * s / frames, s / floor) for w, s in seconds.items()))
    recorded = frames / 3 / FPS
    size = sum(path.stat().st_size for path in corpus.rglob("*.mp4"))
    print(f"{size / frames / 1e3:.1f} kB a frame, {frames} frames; decoding is {100 * floor / total:.0f} % of the time")
    print(f"{2 * recorded / total:.1f} times real time on two cores")


# Near duplicates


def printed(episode: Episode, frames: Frames) -> Fingerprint:
    thumbnails = {view: view_thumbnails(images, episode.fps) for view, images in frames.items()}
    return Fingerprint.from_json(fingerprint(episode, thumbnails))


def encoded(crf: int) -> Change:
    def change(episode: Episode, frames: Frames) -> tuple[Episode, Frames]:
        with tempfile.TemporaryDirectory() as folder:
            path, result = Path(folder) / "copy.mp4", {}
            for view, images in frames.items():
                encode_video(path, images, episode.fps, crf=crf, preset="veryfast", pixel_format="yuv420p")
                result[view] = decode_video(path)
        return episode, result

    return change


def on_images(one: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda episode, frames: (episode, {v: np.stack([one(i) for i in x]) for v, x in frames.items()})


def resized(factor: float) -> Change:
    return on_images(lambda image: cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA))


def brightened(gain: float, offset: float) -> Change:
    return on_images(lambda image: np.clip(image.astype(np.float32) * gain + offset, 0, 255).astype(np.uint8))


def trimmed(start: int, end: int) -> Change:
    def change(episode: Episode, frames: Frames) -> tuple[Episode, Frames]:
        stop = episode.num_frames - end
        return episode.cut(start, stop), {view: images[start:stop] for view, images in frames.items()}

    return change


def noisy(radians: float) -> Change:
    def change(episode: Episode, frames: Frames) -> tuple[Episode, Frames]:
        noise = np.random.default_rng(0).normal(0, radians, episode.state.shape)
        return replace(episode, state=episode.state + noise.astype(np.float32)), frames

    return change


def together(*changes: Change) -> Change:
    def change(episode: Episode, frames: Frames) -> tuple[Episode, Frames]:
        for each in changes:
            episode, frames = each(episode, frames)
        return episode, frames

    return change


CHANGES: dict[str, Change] = {
    "encoded again, crf 23": encoded(23),
    "encoded again, crf 32": encoded(32),
    "resized to 3/4": resized(0.75),
    "brighter (1.08 x + 6)": brightened(1.08, 6),
    "darker (0.9 x - 4)": brightened(0.9, -4),
    "2 of 33 frames cut at each end": trimmed(2, 2),
    "3 of 33 frames cut at each end": trimmed(3, 3),
    "4 of 33 frames cut at the start": trimmed(4, 0),
    "4 of 33 frames cut at the end": trimmed(0, 4),
    "states with noise of 1e-4 rad": noisy(1e-4),
    "states with noise of 1e-3 rad": noisy(1e-3),
    "3/4, crf 28, brighter, 2 + 1 frames cut": together(trimmed(2, 1), resized(0.75), encoded(28), brightened(1.08, 6)),
}


def measure_copies(root: Path) -> None:
    episodes = EpisodeSet.open(root)
    originals: list[Fingerprint] = []
    copies: dict[str, list[Fingerprint]] = {name: [] for name in CHANGES}
    for i, row in enumerate(episodes.rows):
        episode, frames = episodes.episode(i), {view: episodes.frames(i, view) for view in row.views}
        originals.append(printed(episode, frames))
        for name, change in CHANGES.items():
            copies[name].append(printed(*change(episode, frames)))

    def share(changed: list[Fingerprint]) -> float:
        found = find_near_duplicates([*originals, *changed])
        return sum(f.position == f.original + len(originals) for f in found) / len(changed)

    shares = {name: share(changed) for name, changed in copies.items()}
    shares["all"] = float(np.mean(list(shares.values())))
    print_table((f"copies of {len(originals)} recordings", "found, %"), ((n, 100 * s) for n, s in shares.items()))


def measure_different(root: Path) -> tuple[str, int, int, int]:
    """Name, episodes, pairs, and how many are taken for duplicates."""
    episodes = EpisodeSet.open(root)
    seen = [
        printed(episodes.episode(i), {view: episodes.frames(i, view) for view in row.views})
        for i, row in enumerate(episodes.rows)
    ]
    return root.name, len(seen), len(seen) * (len(seen) - 1) // 2, len(find_near_duplicates(seen))


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("what", choices=("speed", "duplicates"))
    parser.add_argument("--episodes", type=int, default=12, help="speed: number of recordings")
    parser.add_argument("--seconds", type=float, default=10.0, help="speed: length of an episode")
    parser.add_argument("--crf", type=int, default=23, help="speed: x264's quality; 23 gives 0.7 Mbit/s a view, 16 13")
    arguments = parser.parse_args()
    if arguments.what == "speed":
        cv2.setNumThreads(1)
        with tempfile.TemporaryDirectory() as scratch:
            corpus = Path(scratch) / "corpus"
            make_corpus(corpus, arguments.episodes, arguments.seconds, arguments.crf)
            measure_speed(corpus, Path(scratch))
    else:
        measure_copies(RECORDINGS)
        columns = ("different episodes", "count", "pairs", "taken for duplicates")
        print_table(columns, (measure_different(root) for root in (RECORDINGS, RECORDINGS.with_name("banks"))))


if __name__ == "__main__":
    main()
