"""Views of an HDF5 recording that are stored as one encoded image a frame."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np

from worldline_core.data.guards.hdf5 import open_hdf5
from worldline_core.data.guards.images import decode_image
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath

Channels = Literal["as_written", "standard"]
"""`standard`: usual JPEG and PNG files. `as_written`: a recorder handed OpenCV its RGB arrays, which takes them for BGR, so
the files show red as blue, and OpenCV's own reading gives RGB back."""


def hdf5_images(path: AnyPath, key: str, length: int, channels: Channels) -> Iterator[np.ndarray]:
    """uint8 (H, W, 3) RGB, frame by frame.

    Raises: RejectedInputError, while it is iterated: missing_file, missing_column, length_mismatch, too_large (by the
        image's own header, before it is decoded), unreadable, path_traversal.
    """
    first: tuple[int, ...] | None = None
    with open_hdf5(path) as file:
        for number, content in enumerate(file.image_files(key, length)):
            where = f"{path}, {key}, frame {number}"
            image = decode_image(content, where, channels="bgr" if channels == "as_written" else "rgb")
            first = first or image.shape
            if image.shape != first:
                raise RejectedInputError(
                    "unreadable",
                    "Images differ in size",
                    where=where,
                    expected=f"{first[1]}x{first[0]}",
                    got=f"{image.shape[1]}x{image.shape[0]}",
                    evidence={"frame": number, "first": list(first[:2]), "found": list(image.shape[:2])},
                )
            yield image
