"""Errors that a user can act on: what happened, where, what was expected, what was found, what to do next."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from worldline_core.untrusted_text import shown


class WorldLineError(Exception):
    """Base of every error raised on purpose. Its message hides credentials and control characters, and is cut where
    a file put too much text into it.

    ``what`` is wrong, ``where`` (episode, file, key or field), what was ``expected``, what was there instead, and what the reader can do.
    """

    def __init__(
        self,
        what: str,
        *,
        where: object | None = None,
        expected: object | None = None,
        got: object | None = None,
        next_step: str | None = None,
    ) -> None:
        self.what = what
        self.where = where
        self.expected = expected
        self.got = got
        self.next_step = next_step
        details = (("where", where), ("expected", expected), ("got", got), ("next step", next_step))
        super().__init__(
            "\n".join([shown(what), *(f"  {name}: {shown(value)}" for name, value in details if value is not None)])
        )

    def __reduce__(self) -> tuple[object, ...]:
        # Keyword-only fields are lost by the default reduction, and errors cross process boundaries.
        return _restored, (type(self), self.args, vars(self))


def _restored(kind: type[WorldLineError], args: tuple[object, ...], fields: dict[str, object]) -> WorldLineError:
    error = kind.__new__(kind, *args)
    vars(error).update(fields)
    return error


class ConfigError(WorldLineError):
    """A configuration value, file, preset or override is not usable."""


class DataError(WorldLineError):
    """A recording, or something read from one, is not usable."""


class CalibrationError(DataError):
    """Camera or kinematic calibration is invalid."""


class ArtifactError(WorldLineError):
    """A stored artifact is missing, damaged, or of another kind."""


class CheckpointError(ArtifactError):
    """A model checkpoint does not fit what was asked of it."""


class TrainingError(WorldLineError):
    """Training cannot go on (for example, a loss that is not finite)."""


class StoppedError(WorldLineError):
    """A training was asked to stop, and its state is saved."""


class RegressionError(WorldLineError):
    """An evaluation found models worse than they were."""


class UnavailableError(WorldLineError):
    """Something optional (weights, an extra, a device, a server) is needed but not there."""


def installing(extra: str) -> str:
    """Next step of a message: the command that installs an extra of this package."""
    return f"pip install 'worldline[{extra}]' (in a checkout: uv sync --extra {extra})"


@contextmanager
def needing(extra: str, library: str, *, where: str | None = None, otherwise: str = "") -> Iterator[None]:
    """Around the imports of an optional library, for which the setting ``where`` asks; ``otherwise``: what can be done without it.

    Raises: UnavailableError where it is not installed.
    """
    try:
        yield
    except ImportError as error:
        raise UnavailableError(
            f"{library} is not installed", where=where, expected=f"the extra `{extra}`", got=str(error),
            next_step=", or ".join(filter(None, [installing(extra), otherwise])),
        ) from error  # fmt: skip
