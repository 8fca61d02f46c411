"""Messages of numbers, texts and NumPy arrays as msgpack, in the form that openpi's servers and clients speak.

An array is the map ``{b"__ndarray__": True, b"data": bytes, b"dtype": "<f4", b"shape": [2, 3]}`` (row order), a NumPy scalar
``{b"__npgeneric__": True, b"data": number, b"dtype": "<f4"}`` (openpi, ``openpi_client/msgpack_numpy.py``). Booleans, integers, reals
and texts of fixed width are the only array types: nothing that is read can run code. How much a message may hold is
bounded before it is built.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any

import numpy as np

from worldline_core.errors import DataError, UnavailableError, installing

if TYPE_CHECKING:
    from types import ModuleType

ARRAY_KINDS = "biufSU"
"""`numpy.dtype.kind` of what may be in a message: booleans, integers, reals, texts of fixed width."""
_DTYPE = re.compile(rf"[<>|=]?[{ARRAY_KINDS}][1-9][0-9]{{0,7}}")
_SCALARS = {"b": bool, "i": int, "u": int, "f": int | float, "S": bytes, "U": str}
"""Types that a NumPy scalar is packed as; a number in the place of a text would be taken for its length."""
MAX_MESSAGE_BYTES = 64 << 20
MAX_AXES = 16
MAX_ENTRIES = 65_536
"""Entries of one map or list."""
MAX_VALUES = 1 << 20
"""Entries of all maps and lists of a message: large numbers of values belong into arrays."""


def _msgpack() -> ModuleType:
    try:
        import msgpack
    except ImportError as error:
        raise UnavailableError(
            "Messages of policies and of the server need msgpack", next_step=installing("serve")
        ) from error
    return msgpack


def pack(message: object) -> bytes:
    """One message as bytes.

    Raises:
        DataError: it holds something that has no place in a message (an object, void or complex array, a set).
    """
    try:
        return _msgpack().packb(message, default=_packed_array)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise DataError(
            "This cannot be sent as a message",
            expected="maps, lists, numbers, texts, bytes, and arrays of booleans, integers, reals or texts",
            got=str(error),
        ) from error


def _packed_array(value: object) -> dict[bytes, Any]:
    if not isinstance(value, np.ndarray | np.generic) or value.dtype.kind not in ARRAY_KINDS:
        kind = value.dtype if isinstance(value, np.ndarray | np.generic) else type(value).__name__
        raise TypeError(f"unsupported type {kind}")
    if isinstance(value, np.ndarray):
        data, shape = np.ascontiguousarray(value).tobytes(), value.shape
        return {b"__ndarray__": True, b"data": data, b"dtype": value.dtype.str, b"shape": shape}
    return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}


def unpack(content: bytes, where: object) -> Any:
    """The message that these bytes hold; arrays are copies that may be changed.

    Args:
        where: who sent it, for errors.

    Raises:
        DataError: it is no message, or holds an array that does not fit its own description.
    """
    values = 0

    def counted(found: Any) -> Any:
        nonlocal values
        values += 1 + len(found)
        if values > MAX_VALUES:
            raise ValueError(f"more than {MAX_VALUES:,} values in maps and lists")
        return _array(found) if isinstance(found, dict) else found

    try:
        return _msgpack().unpackb(
            content,
            object_hook=counted,
            list_hook=counted,
            max_array_len=MAX_ENTRIES,
            max_map_len=MAX_ENTRIES,
            max_ext_len=0,
        )
    # msgpack's own errors are ValueErrors; a text that is no UTF-8 and an unknown dtype are ValueError and TypeError.
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise DataError(
            "A message is not understood",
            where=where,
            expected="msgpack with arrays as openpi packs them",
            got=str(error),
        ) from error


def _array(found: dict[Any, Any]) -> Any:
    if b"__ndarray__" in found:
        data, dtype, shape = found[b"data"], _dtype(found[b"dtype"]), found[b"shape"]
        sizes = shape if isinstance(shape, list) and len(shape) <= MAX_AXES else None
        if not isinstance(data, bytes) or sizes is None or any(type(size) is not int or size < 0 for size in sizes):
            raise ValueError("an array without bytes, or without a shape")
        if math.prod(sizes) * dtype.itemsize != len(data):
            raise ValueError(f"an array of shape {sizes} and type {dtype} in {len(data)} bytes")
        return np.frombuffer(data, dtype).reshape(sizes).copy() if data else np.empty(sizes, dtype)
    if b"__npgeneric__" in found:
        data, dtype = found[b"data"], _dtype(found[b"dtype"])
        if not isinstance(data, _SCALARS[dtype.kind]):
            raise ValueError(f"a scalar of type {dtype} that is {type(data).__name__}")
        return dtype.type(data)
    return found


def _dtype(name: object) -> np.dtype[Any]:
    if isinstance(name, bytes):
        name = name.decode("ascii")
    if not isinstance(name, str) or not _DTYPE.fullmatch(name):
        raise ValueError(f"arrays of type {name!r:.40} are refused")
    return np.dtype(name)
