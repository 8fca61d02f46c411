"""How many near duplicates curation finds, how many different episodes it takes for one, and what the search costs.

Run: `python benchmarks/near_duplicates.py [--recordings artifacts/shipped/recordings] [--scale 100000]`. Three minutes of processor time.

- *Copies*: every shipped recording is copied in twelve ways, as people's uploads are. Copies come back as MPEG files
  (yuv420p) where the name says so. A copy counts as found when the search over originals and copies of one kind names its
  own original. Both rules are measured: with the states, and from the images alone (states hidden).
- *Different episodes*: the recordings among themselves, and the shipped candidate banks, in which 32 candidates start
  from one state and differ only by the noise of their controllers: the hardest negatives there are.
- *Cost*: synthetic fingerprints, 5 % of them copies, the others in scenes of 200 that share their background and a
  tenth of their state cells. Processor time of the search.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from tools.thumbnails import view_thumbnails
from worldline_core.data.curation.near_duplicates import NearDuplicateConfig, find_near_duplicates
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.episodes.fingerprint import MINHASHES, MOMENTS, Fingerprint, ViewPrint, fingerprint
from worldline_core.data.video.encoder import encode_video
from worldline_core.data.video.frame_decoder import decode_video
from worldline_core.pictures import SheetRow, contact_sheet, evenly_spaced, jpeg_bytes
from worldline_core.store.atomic import write_bytes_atomic

Frames = Mapping[str, np.ndarray]
Change = Callable[[Episode, Frames], tuple[Episode, Frames]]


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


def resized(factor: float) -> Change:
    def one(image: np.ndarray) -> np.ndarray:
        size = [2 * round(factor * side / 2) for side in image.shape[1::-1]]
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA)

    return lambda episode, frames: (episode, {v: np.stack([one(i) for i in x]) for v, x in frames.items()})


def brightened(gain: float, offset: float) -> Change:
    def one(images: np.ndarray) -> np.ndarray:
        return np.clip(images.astype(np.float32) * gain + offset, 0, 255).astype(np.uint8)

    return lambda episode, frames: (episode, {view: one(images) for view, images in frames.items()})


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


def without_states(seen: Fingerprint) -> Fingerprint:
    return replace(seen, motion=None)


def measure_copies(root: Path) -> None:
    episodes = EpisodeSet.open(root)
    originals: list[Fingerprint] = []
    copies: dict[str, list[Fingerprint]] = {name: [] for name in CHANGES}
    for i, row in enumerate(episodes.rows):
        episode, frames = episodes.episode(i), {view: episodes.frames(i, view) for view in row.views}
        originals.append(printed(episode, frames))
        for name, change in CHANGES.items():
            copies[name].append(printed(*change(episode, frames)))
    config = NearDuplicateConfig()
    print(f"{'copies of ' + str(len(originals)) + ' recordings':44s} {'with states':>12s} {'images alone':>13s}")
    every = {False: 0, True: 0}
    for name, changed in copies.items():
        shares: list[str] = []
        for hidden in (False, True):
            seen = [*originals, *changed]
            found = find_near_duplicates([without_states(s) for s in seen] if hidden else seen, config)
            right = sum(f.position == f.original + len(originals) for f in found)
            every[hidden] += right
            shares.append(f"{100 * right / len(changed):.1f} %")
        print(f"{name:44s} {shares[0]:>12s} {shares[1]:>13s}")
    total = len(originals) * len(CHANGES)
    print(f"{'all':44s} {100 * every[False] / total:10.1f} % {100 * every[True] / total:11.1f} %\n")


def measure_different(root: Path) -> None:
    episodes = EpisodeSet.open(root)
    seen = [
        printed(episodes.episode(i), {view: episodes.frames(i, view) for view in row.views})
        for i, row in enumerate(episodes.rows)
    ]
    config = NearDuplicateConfig()
    pairs = len(seen) * (len(seen) - 1) // 2
    for name, prints in (("with states", seen), ("images alone", [without_states(s) for s in seen])):
        found = len(find_near_duplicates(prints, config))
        print(f"{root.name:12s} {len(seen)} different episodes, {pairs} pairs, {name}: {found} taken for duplicates")


def flipped(words: np.ndarray, most: int, random: np.random.Generator) -> np.ndarray:
    result = words.copy()
    for place in range(len(result)):
        for bit in random.integers(0, 64, random.integers(0, most + 1)):
            result[place] ^= np.uint64(1) << np.uint64(bit)
    return result


def synthetic(count: int, random: np.random.Generator, *, states: bool) -> tuple[list[Fingerprint], dict[int, int]]:
    views = ("head", "left_wrist", "right_wrist")
    scenes = random.integers(0, 2**63, (max(1, count // 200), len(views)), dtype=np.uint64)
    shared = random.integers(0, 2**32, MINHASHES, dtype=np.uint32)
    prints: list[Fingerprint] = []
    copy_of: dict[int, int] = {}
    for position in range(count):
        original = int(random.integers(0, position + 1))
        if random.random() < 0.05 and original != position and original not in copy_of:
            seen, copy_of[position] = prints[original], original
            other = random.integers(0, 2**32, MINHASHES, dtype=np.uint32)
            motion = None if seen.motion is None else np.where(random.random(MINHASHES) < 0.2, other, seen.motion)
            looks = {
                view: ViewPrint(flipped(v.frames, 4, random), flipped(v.moving, 1, random), v.first)
                for view, v in seen.views.items()
            }
            seconds = seen.seconds + random.uniform(-0.5, 0.5)
            prints.append(Fingerprint(f"copy {position}", seconds, seen.layout, motion, looks))
            continue
        scene = scenes[random.integers(len(scenes))]
        motion = random.integers(0, 2**32, MINHASHES, dtype=np.uint32)
        motion = np.where(random.random(MINHASHES) < 0.1, shared, motion)
        moving = random.integers(0, 2**63, (2, len(views), MOMENTS), dtype=np.uint64)
        looks = {
            view: ViewPrint(
                flipped(np.repeat(scene[k], MOMENTS), 8, random), moving[0, k] & moving[1, k], np.repeat(scene[k], 4)
            )
            for k, view in enumerate(views)
        }
        seconds = float(random.gamma(9, 2))
        prints.append(Fingerprint(f"{position}", seconds, "joints/14", motion if states else None, looks))
    return prints, copy_of


def measure_cost(counts: list[int]) -> None:
    config = NearDuplicateConfig()
    for states in (True, False):
        for count in counts:
            prints, copy_of = synthetic(count, np.random.default_rng(0), states=states)
            clock = time.process_time()
            found = find_near_duplicates(prints, config)
            seconds = time.process_time() - clock
            right = sum(copy_of.get(f.position) == f.original for f in found)
            print(
                f"{count:7d} fingerprints, {'with states' if states else 'images alone':12s}: {seconds:5.2f} s,"
                f" {right} of {len(copy_of)} copies found, {len(found) - right} others"
            )


def draw(root: Path, path: Path, first: str, second: str) -> None:
    """An episode, a copy of it, and a different episode that looks the same, with what the search compares."""
    episodes = EpisodeSet.open(root)
    chosen = [episodes.position(name) for name in (first, second)]
    loaded = [(episodes.episode(i), {v: episodes.frames(i, v) for v in episodes.rows[i].views}) for i in chosen]
    name = "3/4, crf 28, brighter, 2 + 1 frames cut"
    shown = [loaded[0], CHANGES[name](*loaded[0]), loaded[1]]
    prints = [printed(*each) for each in shown]
    rows: list[SheetRow] = []
    titles = ("an episode", f"a copy of it: {name}", "another episode: the same start, another run of the controller")
    for title, (_, frames), seen in zip(titles, shown, prints, strict=True):
        images = frames["head"]
        note = "head view"
        if seen is not prints[0]:
            strict = find_near_duplicates([prints[0], seen], NearDuplicateConfig())
            share = np.mean(prints[0].motion == seen.motion)
            bits = np.mean(
                [np.bitwise_count(v.frames ^ prints[0].views[k].frames).mean() for k, v in seen.views.items()]
            )
            note = f"share of common state cells: {share:.2f};  differing bits of 64: {bits:.1f};  "
            note += "near duplicate, taken out" if strict else "kept"
        rows.append(SheetRow(title, images[evenly_spaced(len(images), 6)], note))
    write_bytes_atomic(path, jpeg_bytes(contact_sheet(rows, tile_height=128)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=Path, default=Path("artifacts/shipped/recordings"))
    parser.add_argument("--banks", type=Path, default=Path("artifacts/shipped/banks"))
    parser.add_argument("--scale", type=int, default=100_000, help="largest number of synthetic fingerprints")
    parser.add_argument("--picture", type=Path, help="draw a copy and a look-alike of the banks instead of measuring")
    arguments = parser.parse_args()
    if arguments.picture is not None:
        draw(arguments.banks, arguments.picture, "bank_lift_viperx-007", "bank_lift_viperx-029")
        return
    measure_copies(arguments.recordings)
    measure_different(arguments.recordings)
    measure_different(arguments.banks)
    print()
    measure_cost([arguments.scale // 10, arguments.scale])


if __name__ == "__main__":
    main()
