"""The type checker of the tests: shapes and types of arrays are checked wherever an annotation states them."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Sequence
from typing import Any

import jaxtyping
from beartype import beartype

_SHAPE = re.compile(r"\b(Float|Int|Bool|UInt8)\[|\bjaxtyping\b")


def checked[Function: Callable[..., object]](function: Function) -> Function:
    """The function, called with those of its arguments and results checked whose annotation is one of jaxtyping's.

    Other annotations are left to the static checker: tests hand in doubles of models and readers.
    """
    shaped = _shaped(function)
    if not shaped:
        return function
    function.__annotations__ = shaped
    return beartype(function)


def check_shapes_of(packages: Sequence[str]) -> None:
    """Check the functions of these packages, which must not be imported yet.

    jaxtyping would bind the arguments of every function at every call; here only of those that state a shape.
    """
    original = jaxtyping.jaxtyped

    def jaxtyped(*, typechecker: Any) -> Callable[[Any], Any]:
        decorate = original(typechecker=typechecker)
        return lambda item: item if inspect.isfunction(item) and not _shaped(item) else decorate(item)

    jaxtyping.jaxtyped = jaxtyped
    jaxtyping.install_import_hook(list(packages), f"{checked.__module__}.{checked.__name__}")


def _shaped(function: Callable[..., object]) -> dict[str, Any]:
    return {k: v for k, v in getattr(function, "__annotations__", {}).items() if _SHAPE.search(str(v))}
