"""Pictures that are stored turned or mirrored, with a note of how they are shown: EXIF of images, display matrix of videos."""

from __future__ import annotations

import numpy as np

from worldline_core.data.guards.rejection import RejectedInputError

UPRIGHT = 1
QUARTER_TURNS = (5, 6, 7, 8)
"""Orientations in which height and width change places."""

# By the signs of a display matrix ((a, b), (c, d)): a stored point (x, y) is shown at (a x + c y, b x + d y).
_ORIENTATIONS = {
    ((1, 0), (0, 1)): UPRIGHT,
    ((-1, 0), (0, 1)): 2,
    ((-1, 0), (0, -1)): 3,
    ((1, 0), (0, -1)): 4,
    ((0, 1), (1, 0)): 5,
    ((0, 1), (-1, 0)): 6,
    ((0, -1), (-1, 0)): 7,
    ((0, -1), (1, 0)): 8,
}


def orientation_of(matrix: tuple[tuple[int, int], tuple[int, int]]) -> int:
    """EXIF's orientation (1..8) of a display matrix.

    Raises: RejectedInputError (unreadable) for a matrix that does not turn by whole quarters.
    """
    values = np.asarray(matrix, dtype=np.float64)
    values /= abs(values).max() or 1.0
    (a, b), (c, d) = np.rint(values).astype(int).tolist()
    whole = np.abs(values - np.rint(values)).max() < np.sin(np.deg2rad(1.0))
    found = _ORIENTATIONS.get(((a, b), (c, d))) if whole else None
    if found is None:
        raise RejectedInputError(
            "unreadable",
            "Video is shown turned by no whole quarter",
            expected="a display matrix of 0, 90, 180 or 270 degrees",
            got=matrix,
            next_step="write the video upright: ffmpeg -i in.mp4 out.mp4",
        )
    return found


def upright(image: np.ndarray, orientation: int) -> np.ndarray:
    """The image (H, W, ...) as it is shown."""
    if orientation == UPRIGHT:
        return image
    if orientation in QUARTER_TURNS:
        image = image.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    return np.ascontiguousarray(image)


def turned_view(where: object, orientation: int) -> RejectedInputError:
    """The rejection of a view whose K is of the stored picture, or of the shown one: the recording does not say which."""
    return RejectedInputError(
        "missing_calibration",
        "Pictures are stored turned or mirrored, and the view has a camera",
        where=where,
        expected="upright pictures, to which K belongs",
        got=f"orientation {orientation} (as EXIF counts; of a video by its display matrix)",
        next_step="write the pictures upright (ffmpeg -i in.mp4 out.mp4) and give K of those, or take the camera out",
    )
