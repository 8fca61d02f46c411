"""Small grey pictures of a view and its sharpness: all that filters and fingerprints look at.

They come from the luma plane of the decoded video; no colour picture is made for them. Curation leaves them in the set's
`run/thumbnails`, so that filtering need not decode the same videos again. That folder belongs to no digest: without it
everything is computed from the stored videos, to the same bytes. A damaged file, or one of another video, is not used.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.store.artifact_files import digest_file

GRAY_WIDTH = 96
SHARPNESS_PERIOD_S = 0.25
# Luma of limited range (ITU-R BT.601, 16 black .. 235 white) as the full 0 .. 255.
_EXPANSION = 255.0 / 219.0
_EXPANDED = np.clip(np.rint((np.arange(256) - 16.0) * _EXPANSION), 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class ViewThumbnails:
    """One view of an episode, frame by frame.

    Attributes:
        gray: uint8 (n, h, 96), luma in 0 black .. 255 white, area averages; the aspect is that of the images.
        sharpness: float32 (n,), variance of the Laplacian of the luma (Pech-Pacheco et al. 2000) at the image's own size, or
            at the recorded one where it was enlarged; measured about every 0.25 s and held until the next measurement.
    """

    gray: np.ndarray
    sharpness: np.ndarray

    def __len__(self) -> int:
        return len(self.gray)

    def cut(self, start: int, stop: int, step: int = 1) -> ViewThumbnails:
        """Frames start..stop (exclusive), every `step`-th."""
        return ViewThumbnails(self.gray[start:stop:step], self.sharpness[start:stop:step])


class ThumbnailMaker:
    """Collects the thumbnails of a view picture by picture.

    Args:
        fps: rate of the pictures.
        recorded_size: (height, width) of the recording of pictures that were enlarged: sharpness is that of the recording.
    """

    def __init__(self, fps: float, recorded_size: tuple[int, int] | None = None) -> None:
        self._recorded_size = recorded_size
        self._every = max(1, round(SHARPNESS_PERIOD_S * fps))
        self._gray: list[np.ndarray] = []
        self._sharpness: list[float] = []

    def add(self, luma: np.ndarray, *, full_range: bool) -> None:
        """The next picture.

        Args:
            luma: uint8 (H, W).
            full_range: whether its black is 0 and its white 255, instead of 16 and 235.

        Raises: RejectedInputError (unreadable) when its shape differs from the pictures before it.
        """
        if len(self._gray) % self._every == 0:
            recorded = luma if self._recorded_size is None else _before_enlarging(luma, self._recorded_size)
            self._sharpness.append(_sharpness(recorded) * (1.0 if full_range else _EXPANSION**2))
        small = shrunk(luma)
        gray = small if full_range else cv2.LUT(small, _EXPANDED)
        if self._gray and gray.shape != self._gray[0].shape:
            raise RejectedInputError(
                "unreadable",
                "Pictures of a view change their shape",
                expected=f"thumbnails of {self._gray[0].shape}",
                got=f"{gray.shape} at picture {len(self._gray)}",
            )
        self._gray.append(gray)

    def thumbnails(self) -> ViewThumbnails:
        """Thumbnails of all pictures added.

        Raises: RejectedInputError (truncated_video) when there were none.
        """
        if not self._gray:
            raise RejectedInputError("truncated_video", "View has no pictures", expected="at least one", got="none")
        sharpness = np.repeat(np.asarray(self._sharpness, dtype=np.float32), self._every)
        return ViewThumbnails(np.stack(self._gray), sharpness[: len(self._gray)])


def shrunk(luma: np.ndarray) -> np.ndarray:
    """uint8 (H, W) at 96 pixels of width.

    Halved by area averages as often as that leaves whole pixels, then brought to the width: by less than a half
    bilinearly, which still sees every pixel, by more as an area average. A tenth of the time of one area average by a
    broken factor.
    """
    height = max(2, round(luma.shape[0] * GRAY_WIDTH / luma.shape[1]))
    while luma.shape[1] % 2 == 0 and luma.shape[0] % 2 == 0 and luma.shape[1] >= 2 * GRAY_WIDTH:
        luma = cv2.resize(luma, (luma.shape[1] // 2, luma.shape[0] // 2), interpolation=cv2.INTER_AREA)
    if luma.shape == (height, GRAY_WIDTH):
        return luma.copy()  # the plane belongs to the decoder
    # The exact variant gives the same bytes on every processor.
    gentle = luma.shape[1] < 2 * GRAY_WIDTH
    return cv2.resize(luma, (GRAY_WIDTH, height), interpolation=cv2.INTER_LINEAR_EXACT if gentle else cv2.INTER_AREA)


def _before_enlarging(luma: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """uint8 at (height, width), of sides no longer than they are: the picture that gives this one when it is enlarged.

    Iterative back-projection (Irani and Peleg 1991). A mere reduction of a picture that was enlarged linearly has lost half
    of the recording's sharpness or more; four rounds bring back nine tenths.
    """
    height, width = (min(side, longest) for side, longest in zip(size, luma.shape, strict=True))
    if (height, width) == luma.shape:
        return luma
    enlarged = luma.astype(np.float32)
    found = cv2.resize(enlarged, (width, height), interpolation=cv2.INTER_AREA)
    for _ in range(4):
        again = cv2.resize(found, luma.shape[::-1], interpolation=cv2.INTER_LINEAR)
        missing = cv2.subtract(enlarged, again)
        found = cv2.add(found, cv2.resize(missing, (width, height), interpolation=cv2.INTER_AREA))
    return np.clip(np.rint(found), 0, 255).astype(np.uint8)


def _sharpness(luma: np.ndarray) -> float:
    laplacian = cv2.Laplacian(luma, cv2.CV_16S)
    # E[x^2] - E[x]^2 of whole numbers: exact, and faster than the standard deviation.
    mean = cv2.sumElems(laplacian)[0] / laplacian.size
    return cv2.norm(laplacian, cv2.NORM_L2SQR) / laplacian.size - mean**2


_VERSION = "2"
"""Raised whenever thumbnails of the same video come out differently."""


def cache_path(set_root: Path, video: Path) -> Path:
    """File of the thumbnails of one of the set's videos."""
    return (set_root / "run" / "thumbnails" / video.relative_to(set_root)).with_suffix(".npz")


def write_thumbnails(path: Path, video: Path, thumbnails: ViewThumbnails) -> None:
    """Note the thumbnails of a whole video file."""
    with path.open("wb") as stream:
        np.savez(
            stream,
            video=np.array([_VERSION, digest_file(video)]),
            gray=thumbnails.gray,
            sharpness=thumbnails.sharpness,
        )


def read_thumbnails(path: Path, video: Path) -> ViewThumbnails | None:
    """The thumbnails of a video file; None where there are none, none that are whole, or not of this very file."""
    try:
        with np.load(path, allow_pickle=False) as noted:  # zip's checksums show damage
            if noted["video"].tolist() != [_VERSION, digest_file(video)]:
                return None
            return ViewThumbnails(noted["gray"], noted["sharpness"])
    except (OSError, EOFError, KeyError, ValueError, RuntimeError, zipfile.BadZipFile):
        return None
