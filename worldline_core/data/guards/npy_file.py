"""NumPy arrays in .npy files that are not to be trusted: what the header declares must be what the file holds."""

from __future__ import annotations

import math
import tokenize

import numpy as np
from numpy.lib import format as npy

from worldline_core.data.guards.limits import MAX_ARRAY_BYTES, regular_file, too_large
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath


def read_npy(path: AnyPath) -> np.ndarray:
    """The array of a .npy file; never unpickles.

    Raises: RejectedInputError: missing_file, special_file, too_large, unreadable (damaged, of objects, or cut off).
    """
    file = regular_file(path)
    try:
        size = file.stat().st_size
        with file.open("rb") as stream:
            version = npy.read_magic(stream)
            if version not in ((1, 0), (2, 0)):
                raise ValueError(f"format version {version}")
            read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
            shape, fortran_order, dtype = read_header(stream)
            if dtype.hasobject:
                raise ValueError("an array of Python objects")
            declared = math.prod(shape) * dtype.itemsize
            if declared > MAX_ARRAY_BYTES:
                raise too_large(
                    "Array is too large", where=str(path), limit=MAX_ARRAY_BYTES, got=declared, unit="bytes"
                )
            if declared != size - stream.tell():
                raise ValueError(f"{size - stream.tell()} bytes of data where the header declares {declared}")
            values = np.frombuffer(stream.read(declared), dtype=dtype)
            return values.reshape(shape, order="F" if fortran_order else "C").copy()
    except (ValueError, TypeError, SyntaxError, EOFError, OSError, OverflowError, tokenize.TokenError) as error:
        raise RejectedInputError("unreadable", "Array cannot be read", where=str(path), got=str(error)) from error
