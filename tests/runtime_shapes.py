"""The type checker of the tests: shapes and types of arrays are checked wherever an annotation states them."""

from __future__ import annotations

import functools
import inspect
import re
import types
import typing
from collections.abc import Callable, Sequence
from typing import Any

import jaxtyping
from beartype import beartype

_jaxtyped = jaxtyping.jaxtyped
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

    jaxtyping would bind the arguments of every function at every call and check them twice; here only of functions that
    state a shape, and once. That halves the time that checks take, a third of the tests of calibration.
    """

    def jaxtyped(*, typechecker: Any) -> Callable[[Any], Any]:
        decorate = _jaxtyped(typechecker=typechecker)

        def decorate_once(item: Any) -> Any:
            if isinstance(item, classmethod | staticmethod):
                return type(item)(decorate_once(item.__func__))
            if isinstance(item, property) and item.fget is not None:
                return property(decorate_once(item.fget), item.fset, item.fdel, item.__doc__)
            shaped = _shaped(item.__init__ if inspect.isclass(item) else item)
            if not shaped:
                return item
            # Sizes by the names of arguments ("{size}") need them bound.
            of_arguments = any("{" in str(annotation) for annotation in shaped.values())
            return decorate(item) if of_arguments or not inspect.isfunction(item) else _checked_once(item, shaped)

        return decorate_once

    jaxtyping.jaxtyped = jaxtyped
    jaxtyping.install_import_hook(list(packages), f"{checked.__module__}.{checked.__name__}")


def _checked_once(function: types.FunctionType, shaped: dict[str, Any]) -> Callable[..., Any]:
    """The function, checked in a scope of its own for the names of sizes, unless jaxtyping is switched off."""
    copy = types.FunctionType(
        function.__code__, function.__globals__, function.__name__, function.__defaults__, function.__closure__
    )
    copy.__kwdefaults__, copy.__qualname__ = function.__kwdefaults__, function.__qualname__  # type: ignore[assignment]
    copy.__annotations__ = _resolved(function, shaped)
    strict, scope = beartype(copy), functools.partial(_jaxtyped, "context")

    @functools.wraps(function)
    def in_scope(*arguments: Any, **named: Any) -> Any:
        if jaxtyping.config.jaxtyping_disable:
            return function(*arguments, **named)
        with scope():
            return strict(*arguments, **named)

    return in_scope


def _resolved(function: types.FunctionType, shaped: dict[str, Any]) -> dict[str, Any]:
    """Annotations as objects; one that names what only a static checker imports is not checked."""
    found: dict[str, Any] = {}
    for name, annotation in shaped.items():
        holder = types.SimpleNamespace(__annotations__={name: annotation})
        try:
            found |= typing.get_type_hints(holder, function.__globals__, include_extras=True)
        except NameError:
            continue
    return found


def _shaped(function: Callable[..., object]) -> dict[str, Any]:
    return {k: v for k, v in getattr(function, "__annotations__", {}).items() if _SHAPE.search(str(v))}
