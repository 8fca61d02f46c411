"""The type checker of the tests: shapes and types of arrays are checked wherever an annotation states them."""

from __future__ import annotations

import re
from collections.abc import Callable

from beartype import beartype

_SHAPE = re.compile(r"\b(Float|Int|Bool|UInt8)\[|\bjaxtyping\b")


def checked[Function: Callable[..., object]](function: Function) -> Function:
    """The function, called with those of its arguments and results checked whose annotation is one of jaxtyping's.

    Other annotations are left to the static checker: tests hand in doubles of models and readers.
    """
    shaped = {k: v for k, v in getattr(function, "__annotations__", {}).items() if _SHAPE.search(str(v))}
    if not shaped:
        return function
    function.__annotations__ = shaped
    return beartype(function)
