"""Fingerprint of an episode: a digest of its exact content, and hashes that survive re-encoding, resizing and trimming.

Three kinds of evidence, all small enough to be kept for every episode (about 1 kB):

- frames: a perceptual hash (signs of low DCT frequencies; Zauner 2010) of moments spread over the episode, by view;
- first: a finer hash of the first image alone, by which two names of one scene are found;
- motion: a MinHash (Broder 1997) of the set of state cells that the episode visits. Two copies share nearly all cells
  whatever was trimmed; two demonstrations of one task share few.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from worldline_core.data.episodes.episode import Episode
from worldline_core.errors import DataError

if TYPE_CHECKING:
    from worldline_core.data.video.thumbnails import ViewThumbnails

MOMENTS = 16
MINHASHES = 30
# A few cells are the home pose alone, which all episodes of a robot share.
MIN_CELLS = 8
_ANGLE_STEP = 0.05
_POSITION_STEP_M = 0.01
_HASH_SIDE = 8
_FIRST_SIDE = 16
_DCT_SIDE = 32


@dataclass(frozen=True)
class ViewPrint:
    """Hashes of one view: `frames` (MOMENTS,) uint64; `first` (4,) uint64, 256 bits of the first image."""

    frames: np.ndarray
    first: np.ndarray


@dataclass(frozen=True)
class Fingerprint:
    """Attributes:
    digest: of states, actions and thumbnails, exactly as recorded.
    layout: kind and number of state columns; motions of different layouts cannot be compared.
    motion: (MINHASHES,) uint32, or None where the robot hardly moves.
    """

    digest: str
    layout: str
    motion: np.ndarray | None
    views: Mapping[str, ViewPrint]

    def as_json(self) -> dict[str, Any]:
        views = {
            view: {name: words.tolist() for name, words in vars(seen).items()}
            for view, seen in sorted(self.views.items())
        }
        return vars(self) | {"motion": None if self.motion is None else self.motion.tolist(), "views": views}

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Fingerprint:
        """The reverse of `as_json`."""
        views = {
            view: ViewPrint(**{name: np.array(words, np.uint64) for name, words in seen.items()})
            for view, seen in stored["views"].items()
        }
        motion = None if stored["motion"] is None else np.array(stored["motion"], np.uint32)
        return cls(**{**stored, "motion": motion, "views": views})


def fingerprint(episode: Episode, thumbnails: Mapping[str, ViewThumbnails]) -> dict[str, Any]:
    """The fingerprint as JSON, for part.json.

    Args:
        thumbnails: by view, gray uint8 (n, h, w).

    Raises: DataError for a view without images.
    """
    digest = hashlib.sha256()
    arrays = [episode.state, episode.action, *(thumbnails[view].gray for view in sorted(thumbnails))]
    for array in arrays:
        digest.update(str((array.shape, array.dtype.str)).encode())
        digest.update(memoryview(np.ascontiguousarray(array)).cast("B") if array.size else b"")
    if any(len(images.gray) == 0 for images in thumbnails.values()):
        raise DataError("View has no images", where=f"episode {episode.episode_id}")
    return Fingerprint(
        digest.hexdigest(),
        f"{episode.state_kind}/{episode.state.shape[1]}",
        motion_hashes(episode),
        {view: view_print(images.gray) for view, images in thumbnails.items()},
    ).as_json()


def view_print(gray: UInt8[np.ndarray, "n h w"]) -> ViewPrint:
    """Hashes of one view."""
    middles = (np.arange(MOMENTS) + 0.5) / MOMENTS * len(gray)
    chosen = gray[np.minimum(middles.astype(int), len(gray) - 1)]
    frames = [_words_of(_low_frequency_signs(image.astype(np.float32), _HASH_SIDE)) for image in chosen]
    first = _words_of(_low_frequency_signs(gray[0].astype(np.float32), _FIRST_SIDE))
    return ViewPrint(np.concatenate(frames), first)


def _low_frequency_signs(image: Float[np.ndarray, "h w"], side: int) -> np.ndarray:
    """Signs (side, side) of the lowest DCT frequencies against their median; the mean brightness is left out."""
    small = cv2.resize(image, (_DCT_SIDE, _DCT_SIDE), interpolation=cv2.INTER_AREA)
    low = cv2.dct(small)[: side + 1, : side + 1].reshape(-1)[1 : side * side + 1].reshape(side, side)
    return low > np.median(np.asarray(low, np.float32))


def _words_of(bits: np.ndarray) -> np.ndarray:
    return np.packbits(bits.reshape(-1)).view(">u8").astype(np.uint64)


def motion_hashes(episode: Episode) -> np.ndarray | None:
    """(MINHASHES,) uint32 MinHash of the visited state cells; None below MIN_CELLS cells."""
    if episode.state.shape[1] == 0:
        return None
    steps = np.full(episode.state.shape[1], _ANGLE_STEP)
    if episode.state_kind == "ee_pose":
        # Each arm is xyz, quaternion, gripper; metres need finer cells than radians.
        steps[np.arange(len(steps)) % 8 < 3] = _POSITION_STEP_M
    # Rounded to the nearest: readings that rest at 0 or 1 then stay off the borders of cells.
    state = episode.state[np.isfinite(episode.state).all(axis=1)].astype(np.float64)
    cells = np.unique(np.rint(state / steps).astype(np.int64), axis=0)
    if len(cells) < MIN_CELLS:
        return None
    with np.errstate(over="ignore"):
        keys = np.zeros(len(cells), np.uint64)
        for column in cells.T.astype(np.uint64):
            keys = _mixed(keys ^ (column + np.uint64(0x9E3779B97F4A7C15)))
        seeds = _mixed(np.arange(1, MINHASHES + 1, dtype=np.uint64))
        smallest = np.array([_mixed(keys ^ seed).min() for seed in seeds])
    return (smallest >> np.uint64(32)).astype(np.uint32)


def _mixed(values: np.ndarray) -> np.ndarray:
    """splitmix64's finaliser: equal on every machine, spread over 64 bits."""
    values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return values ^ (values >> np.uint64(31))
