"""Reading arrays of HDF5 files that are not to be trusted: every fault is the rejection of an episode.

A file may point outside of itself (external links, external storage, virtual datasets) or declare a huge array in a few
bytes; both are refused before anything is read.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from worldline_core.data.rejection import RejectedInputError
from worldline_core.errors import UnavailableError

MAX_ARRAY_BYTES = 1 << 30
"""An hour at 30 Hz of 100 float64 columns is 0.1 GB; what declares more than 1 GB is damaged or hostile."""
_DAMAGED = (OSError, RuntimeError, KeyError, ValueError)


def require_h5py() -> Any:
    """The module h5py.

    Raises: UnavailableError where it is not installed.
    """
    if importlib.util.find_spec("h5py") is None:
        raise UnavailableError(
            "Sources of HDF5 files need h5py, which is not installed",
            expected="the extra `hdf5`",
            next_step="uv sync --extra hdf5 (or pip install 'worldline[hdf5]')",
        )
    return importlib.import_module("h5py")


class Hdf5File:
    """An open file; made by `open_hdf5`."""

    def __init__(self, path: Path, handle: Any) -> None:
        self._h5py = require_h5py()
        self._path = path
        self._handle = handle

    def names(self, group: str) -> list[str]:
        """Names in a group, sorted; empty where there is no such group.

        Raises: RejectedInputError (unreadable, path_traversal).
        """
        with self._reading(group):
            node = self._node(group)
            return sorted(node) if isinstance(node, self._h5py.Group) else []

    def has(self, key: str) -> bool:
        """Whether `key` is a dataset that holds something: recorders write unused fields as empty ones.

        Raises: RejectedInputError (unreadable, path_traversal).
        """
        with self._reading(key):
            node = self._node(key)
            return isinstance(node, self._h5py.Dataset) and bool(node.size)

    def array(self, key: str, shape: Sequence[int | None]) -> np.ndarray:
        """A numeric dataset as float64.

        Args:
            shape: wanted sizes; None for any (but not 0).

        Raises: RejectedInputError: missing_column (no such dataset), length_mismatch (another shape), nan_state (values
            that are not finite), unreadable (damaged, not numeric, or too large), path_traversal.
        """
        dataset = self._dataset(key)
        if dataset.dtype.kind not in "fiu":
            raise self._rejected("unreadable", "Dataset is not numeric", key, "numbers", dataset.dtype)
        self._check_shape(key, dataset.shape, shape)
        with self._reading(key):
            values = np.asarray(dataset[()], dtype=np.float64)
        bad = ~np.isfinite(values)
        if bad.any():
            raise RejectedInputError(
                "nan_state",
                "Dataset holds values that are not finite",
                where=f"{self._path}, {key}",
                expected="finite numbers",
                got=f"{int(bad.sum())} that are not",
                evidence={"track": key, "first_frame": int(np.argwhere(bad)[0][0]), "values": int(bad.sum())},
            )
        return values

    def times_ns(self, key: str, length: int) -> np.ndarray:
        """A dataset (length,) of nanoseconds as seconds from its first entry.

        The difference is taken before the conversion: float64 rounds nanoseconds since 1970 to 256.

        Raises: as `array`.
        """
        seconds = 1e-9 * self.array(key, (length,))
        raw = self._dataset(key)[()]
        exact = raw.dtype.kind != "f"
        return 1e-9 * (raw.astype(np.int64) - np.int64(raw[0])) if exact else seconds - seconds[0]

    def encoded_images(self, key: str, length: int, stop: int | None = None) -> list[bytes]:
        """The first `stop` (default: all) of a dataset (length,) of encoded images, as bytes each.

        Raises: RejectedInputError: missing_column, length_mismatch, unreadable, path_traversal.
        """
        dataset = self._dataset(key)
        fixed = dataset.dtype.kind == "S"
        variable = self._h5py.check_vlen_dtype(dataset.dtype) == np.dtype(np.uint8)
        if dataset.ndim != 1 or not (fixed or variable):
            raise self._rejected(
                "unreadable", "Images are not stored as encoded bytes", key, "(N,) byte strings", dataset.dtype
            )
        self._check_shape(key, dataset.shape, (length,))
        with self._reading(key):
            return [bytes(item) for item in dataset[:stop]]

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
        with self._reading(key):
            node = self._node(key)
            if not isinstance(node, self._h5py.Dataset):
                got = ", ".join(self._handle) or "nothing"
                raise self._rejected("missing_column", "File lacks a dataset", key, key, f"top level: {got}")
            if node.external or node.is_virtual:
                raise self._rejected(
                    "path_traversal", "Dataset lies in other files", key, "data in this file", "external storage"
                )
            if node.nbytes > MAX_ARRAY_BYTES:
                raise self._rejected(
                    "unreadable", "Dataset is too large", key, f"at most {MAX_ARRAY_BYTES} bytes", node.nbytes
                )
            return node

    def _check_shape(self, key: str, found: tuple[int, ...], wanted: Sequence[int | None]) -> None:
        fits = len(found) == len(wanted) and all(
            size > 0 if want is None else size == want for size, want in zip(found, wanted, strict=True)
        )
        if not fits:
            raise RejectedInputError(
                "length_mismatch",
                "Dataset has a wrong shape",
                where=f"{self._path}, {key}",
                expected=tuple("N" if want is None else want for want in wanted),
                got=found,
                evidence={"dataset": key, "shape": list(found)},
            )

    def _rejected(self, reason: Any, what: str, key: str, expected: object, got: object) -> RejectedInputError:
        return RejectedInputError(reason, what, where=f"{self._path}, {key}", expected=expected, got=got)

    @contextmanager
    def _reading(self, key: str) -> Iterator[None]:
        try:
            yield
        except _DAMAGED as error:
            raise self._rejected("unreadable", "Dataset cannot be read", key, "an intact file", str(error)) from error


@contextmanager
def open_hdf5(path: Path) -> Iterator[Hdf5File]:
    """A file, open for reading while the context lasts.

    Raises: RejectedInputError (missing_file, unreadable); UnavailableError without h5py.
    """
    h5py = require_h5py()
    if not path.is_file():
        raise RejectedInputError("missing_file", "File is missing", where=str(path))
    try:
        handle = h5py.File(path, "r", locking=False)
    except _DAMAGED as error:
        raise RejectedInputError(
            "unreadable",
            "HDF5 file cannot be opened",
            where=str(path),
            expected="a complete HDF5 file",
            got=str(error),
            next_step="copy the file again; it may be truncated",
        ) from error
    with handle:
        yield Hdf5File(path, handle)
