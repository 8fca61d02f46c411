"""Arrays, arms and images of HDF5 files that others wrote: every fault is the rejection of an episode.

A file may point outside of itself (links, external storage, virtual datasets), which is refused. Views of such a recording
are stored as one encoded image per frame, or as pixels.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np

from worldline_core.data.episodes.source import GripperRange, joint_names
from worldline_core.data.guards.plain_files import decode_image
from worldline_core.data.guards.rejection import (
    Reason,
    RejectedInputError,
    check_columns,
    check_finite,
    check_image_size,
    check_shape,
    unreadable,
)
from worldline_core.data.guards.source_paths import AnyPath, regular_file
from worldline_core.errors import needing

_DAMAGED = (OSError, RuntimeError, KeyError, ValueError, TypeError, OverflowError)
# Images are read a block at a time: a compressed chunk is unpacked once, and little is in memory.
_BLOCK_IMAGES = 16
_BLOCK_BYTES = 64 << 20
_JUMP_RAD = 0.2
_IMAGE_MARKS = b"\xff\xd8", b"\x89PNG"


def require_h5py() -> Any:
    """The module h5py.

    Raises: UnavailableError where it is not installed.
    """
    with needing("hdf5", "h5py"):
        return importlib.import_module("h5py")


@dataclass(frozen=True)
class Columns:
    """Some columns of a dataset, whose name may hold `{track}`; `widths` are the numbers of columns that it may have."""

    dataset: str
    chosen: slice = slice(None)
    widths: tuple[int, ...] = ()


@dataclass(frozen=True)
class ArmPlace:
    """Columns of one arm's joints and of its gripper; None for a robot without one, or with a hand of several joints."""

    name: Literal["left", "right"]
    joints: Columns
    gripper: Columns | None


class Arms(NamedTuple):
    """Arms in the contract's layout: values (N, J) and their names, openings (N, A), and how many readings were clipped."""

    values: np.ndarray
    names: tuple[str, ...]
    openings: np.ndarray
    overshoot: int


class Hdf5File:
    """An open file; made by `open_hdf5`.

    Raises: RejectedInputError from every method: missing_column (no such dataset), length_mismatch (another shape),
        nan_state (values that are not finite), path_traversal (data outside of the file), unreadable (damaged, of another
        type, or never written), too_large, out_of_memory.
    """

    def __init__(self, path: AnyPath, handle: Any) -> None:
        self._h5py = require_h5py()
        self._path = path
        self._handle = handle

    def names(self, group: str) -> list[str]:
        """Names in a group, sorted; empty where there is no such group."""
        with self._reading(group):
            node = self._node(group)
            return sorted(node) if isinstance(node, self._h5py.Group) else []

    def cameras(self, group: str, views: Mapping[str, str]) -> tuple[dict[str, str], dict[str, RejectedInputError]]:
        """The views whose camera a group holds, and the rejection (missing_view) of each of the others."""
        names = self.names(group)
        absent = {
            view: self._rejected("missing_view", "File lacks a camera", group, camera, ", ".join(names) or "none")
            for view, camera in views.items()
            if camera not in names
        }
        return {view: camera for view, camera in views.items() if view not in absent}, absent

    def has(self, key: str) -> bool:
        """True if `key` is a dataset that holds something: recorders write unused fields as empty ones."""
        with self._reading(key):
            node = self._node(key)
            return isinstance(node, self._h5py.Dataset) and bool(node.size)

    def array(self, key: str, shape: Sequence[int | None]) -> np.ndarray:
        """A numeric dataset as float64.

        Args:
            shape: wanted sizes; None for any (but not 0).
        """
        dataset = self._dataset(key)
        if dataset.dtype.kind not in "fiu":
            raise self._rejected("unreadable", "Dataset is not numeric", key, "numbers", dataset.dtype)
        check_shape("Dataset", f"{self._path}, {key}", dataset.shape, shape)
        check_columns(math.prod(dataset.shape[1:]), f"{self._path}, {key}")
        with self._reading(key):
            values = np.asarray(dataset[()], dtype=np.float64)
        check_finite(key, values, self._path)
        return values

    def times_ns(self, key: str, length: int) -> np.ndarray:
        """A dataset (length,) of nanoseconds as seconds from its first entry.

        The difference is taken before the conversion: float64 rounds nanoseconds since 1970 to 256.
        """
        self.array(key, (length,))
        raw = self._dataset(key)[()].astype(np.int64)
        return 1e-9 * (raw - raw[0])

    def arms(
        self, places: Sequence[ArmPlace], gripper: GripperRange | None, *, track: str = "", length: int | None = None
    ) -> Arms:
        """The arms in one track, each with its gripper behind its joints.

        Args:
            length: number of frames; None: as many as there are.

        Raises: RejectedInputError: length_mismatch or invalid_gripper for a dataset of another width; unreadable where no
            joint of a frame was written (HDF5 fills the gaps).
        """
        written: np.ndarray = np.zeros(0, bool)
        blocks: list[np.ndarray] = []
        openings: list[np.ndarray] = []
        names: list[str] = []
        overshoot = 0
        for arm in places:
            joints = self.columns(arm.joints, length, "length_mismatch", track)
            length = len(joints)
            fill = self._dataset(arm.joints.dataset.format(track=track)).fillvalue
            own = np.array([bool((row != fill).any()) for row in joints])
            written = written | own if blocks else own
            blocks.append(joints)
            names += joint_names({arm.name: joints.shape[1]}, gripper=arm.gripper is not None)
            if arm.gripper is not None and gripper is not None:
                opening, outside = gripper.opening(self.columns(arm.gripper, length, "invalid_gripper", track))
                overshoot += outside
                blocks.append(opening)
                openings.append(opening)
        values = np.hstack(blocks)
        # A robot may be at the fill value, zero; it does not jump there and back.
        jumps = (np.abs(np.diff(values, axis=0)) > _JUMP_RAD).any(axis=1) & (np.diff(written.astype(int)) != 0)
        if jumps.any() or not written.any():
            got = f"fill values in {int((~written).sum())} of {len(written)} rows"
            key = places[0].joints.dataset.format(track=track)
            raise self._rejected("unreadable", "Joints were not written", key, "joints in every row", got)
        return Arms(values, tuple(names), np.hstack(openings or [blocks[0][:, :0]]), overshoot)

    def columns(self, columns: Columns, length: int | None, reason: Reason, track: str = "") -> np.ndarray:
        """Columns of a numeric dataset (length, D), or (length,) with D = 1, as float64 (length, len(chosen)).

        Raises: RejectedInputError with `reason` for a dataset of another width than declared.
        """
        key = columns.dataset.format(track=track)
        values = self.array(key, (length,) if self._dataset(key).ndim == 1 else (length, None))
        values = values.reshape(len(values), -1)
        if columns.widths and values.shape[1] not in columns.widths:
            expected = f"{' or '.join(map(str, columns.widths))} columns; hands of several joints are not read"
            raise self._rejected(reason, "Dataset is not of this robot", key, expected, values.shape[1])
        return values[:, columns.chosen]

    def text(self, key: str) -> str | None:
        """A text stored as a dataset of one entry; None where there is none."""
        if not self.has(key):
            return None
        dataset = self._dataset(key)
        if dataset.size != 1:
            raise self._rejected("unreadable", "Dataset is no single text", key, "one entry", dataset.shape)
        with self._reading(key):
            value = dataset[()] if dataset.shape == () else dataset[(0,) * dataset.ndim]
        return self._as_text(value, key)

    def attribute(self, group: str, name: str) -> str | None:
        """An attribute of a group ("/" for the file's own) as text; None where there is none."""
        with self._reading(f"{group}, attribute {name}"):
            node = self._handle if group == "/" else self._node(group)
            value = None if node is None else node.attrs.get(name)
        return None if value is None else self._as_text(value, f"{group}, attribute {name}")

    def _as_text(self, value: Any, where: str) -> str:
        if isinstance(value, np.ndarray) and value.size == 1:
            value = value.reshape(-1)[0]
        if isinstance(value, bytes):
            value = value.decode("utf-8", "replace")
        if not isinstance(value, str | int | float | np.number | np.bool_):
            raise self._rejected("unreadable", "Entry is no text", where, "a text or a number", type(value).__name__)
        return str(value)

    def image_files(self, key: str, length: int) -> Iterator[bytes]:
        """Encoded images, as bytes each, a few in memory at a time; ALOHA pads all of them to the longest, (length, L)."""
        dataset = self._dataset(key)
        fixed = dataset.dtype.kind == "S"
        variable = self._h5py.check_vlen_dtype(dataset.dtype) == np.dtype(np.uint8)
        padded = dataset.dtype == np.uint8 and dataset.ndim == 2
        if not padded and (dataset.ndim != 1 or not (fixed or variable)):
            expected, got = "(N,) byte strings, or (N, L) of uint8", f"{dataset.shape} of {dataset.dtype}"
            raise self._rejected("unreadable", "Images are not stored as encoded bytes", key, expected, got)
        check_shape("Dataset", f"{self._path}, {key}", dataset.shape, (length, None) if padded else (length,))
        size = dataset.dtype.itemsize if fixed else 0  # h5py takes the zeros off the end
        return (bytes(row).ljust(size, b"\0") for row in self._rows(dataset, key))

    def holds_pixels(self, key: str) -> bool:
        """True if images are stored as pixels, not encoded."""
        return self._dataset(key).ndim > 2

    def pixels(self, key: str, length: int) -> Iterator[np.ndarray]:
        """A dataset (length, H, W, 3) of uint8 pixels, as images (H, W, 3) with their channels as stored."""
        dataset = self._dataset(key)
        if dataset.dtype != np.uint8 or dataset.ndim != 4 or dataset.shape[-1] != 3:
            got = f"{dataset.shape} of {dataset.dtype}"
            raise self._rejected("unreadable", "Images are not stored as pixels", key, "(N, H, W, 3) of uint8", got)
        check_shape("Dataset", f"{self._path}, {key}", dataset.shape, (length, None, None, 3))
        check_image_size(dataset.shape[2], dataset.shape[1], f"{self._path}, {key}")
        return self._rows(dataset, key)

    def _rows(self, dataset: Any, key: str) -> Iterator[Any]:
        row_bytes = dataset.dtype.itemsize * math.prod(dataset.shape[1:])
        rows = dataset.chunks[0] if dataset.chunks else _BLOCK_IMAGES
        rows = max(1, min(rows, _BLOCK_BYTES // max(row_bytes, 1)))
        for start in range(0, len(dataset), rows):
            with self._reading(key):
                block = dataset[start : start + rows]
            yield from block

    def _node(self, key: str) -> Any:
        """The object at `key`, or None. Links are refused unfollowed: a soft one may lead to one out of the file."""
        node: Any = self._handle
        for part in key.strip("/").split("/"):
            if not isinstance(node, self._h5py.Group) or not node.id.links.exists(part.encode()):
                return None
            if node.id.links.get_info(part.encode()).type != self._h5py.h5l.TYPE_HARD:
                raise self._rejected("path_traversal", "Entry is a link", key, "data in this file", f"a link at {part}")
            node = node[part]
        return node

    def _dataset(self, key: str) -> Any:
        """The dataset at `key`, written as a whole: HDF5 makes up what was not."""
        with self._reading(key):
            node = self._node(key)
            if not isinstance(node, self._h5py.Dataset):
                got = ", ".join(self._handle) or "nothing"
                raise self._rejected("missing_column", "File lacks a dataset", key, key, f"top level: {got}")
            if node.external or node.is_virtual:
                raise self._rejected(
                    "path_traversal", "Dataset is stored in other files", key, "data in this file", "external storage"
                )
            wanted, found = 1, int(node.id.get_storage_size() > 0)
            if node.chunks:
                wanted = math.prod(-(-size // chunk) for size, chunk in zip(node.shape, node.chunks, strict=True))
                found = node.id.get_num_chunks()
            if node.size and found < wanted:
                raise self._rejected("unreadable", "Dataset was not written", key, f"{wanted} chunks", f"{found}")
            _ = node.dtype, node.fillvalue  # a damaged description shows itself here
            return node

    def _rejected(self, reason: Reason, what: str, key: str, expected: object, got: object) -> RejectedInputError:
        return RejectedInputError(reason, what, where=f"{self._path}, {key}", expected=expected, got=got)

    def _reading(self, key: str) -> AbstractContextManager[None]:
        return unreadable("Dataset cannot be read", f"{self._path}, {key}", _DAMAGED)


@contextmanager
def open_hdf5(path: AnyPath) -> Iterator[Hdf5File]:
    """A file, open for reading while the context lasts.

    Raises: RejectedInputError (missing_file, special_file, unreadable); UnavailableError without h5py.
    """
    h5py = require_h5py()
    local = regular_file(path)
    with unreadable("HDF5 file cannot be opened", path, _DAMAGED):
        handle = h5py.File(local, "r", locking=False)
    with handle:
        yield Hdf5File(path, handle)


Channels = Literal["as_written", "standard"]
"""`standard`: usual JPEG and PNG files, or pixels as OpenCV has them, blue first. `as_written`: a recorder handed OpenCV its
RGB arrays, which takes them for BGR, so files show red as blue, and OpenCV's own reading (or the pixels) gives RGB back."""


def hdf5_images(
    path: AnyPath,
    key: str,
    length: int,
    channels: Channels,
    *,
    calibrated: bool = False,
    raw_sizes: Mapping[int, tuple[int, int]] = MappingProxyType({}),
) -> Iterator[np.ndarray]:
    """uint8 (H, W, 3) RGB, frame by frame; `calibrated` as in `decode_image`.

    Args:
        raw_sizes: number of bytes -> (H, W) of frames that are pixels without a header.

    Raises: RejectedInputError, while it is iterated: missing_file, missing_column, length_mismatch, too_large (by the
        image's own header, before it is decoded), unreadable, path_traversal.
    """
    standard = channels == "standard"
    first: tuple[int, ...] | None = None
    with open_hdf5(path) as file:
        if file.holds_pixels(key):
            for image in file.pixels(key, length):
                yield np.ascontiguousarray(image[..., ::-1]) if standard else image
            return
        for number, content in enumerate(file.image_files(key, length)):
            where = f"{path}, {key}, frame {number}"
            size = None if content.startswith(_IMAGE_MARKS) else raw_sizes.get(len(content))
            if size is None:
                image = decode_image(content, where, channels="rgb" if standard else "bgr", calibrated=calibrated)
            else:
                image = np.frombuffer(content, np.uint8).reshape(*size, 3)[..., :: -1 if standard else 1]
            first = first or image.shape
            if image.shape != first:
                raise RejectedInputError(
                    "unreadable",
                    "Images differ in size",
                    where=where,
                    expected=f"{first[1]}x{first[0]}",
                    got=f"{image.shape[1]}x{image.shape[0]}",
                )
            yield np.ascontiguousarray(image)
