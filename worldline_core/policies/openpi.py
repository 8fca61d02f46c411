"""Messages and websockets as openpi's servers and clients speak them, and a client of openpi's policy servers.

Messages of numbers, texts and NumPy arrays are msgpack. An array is the map ``{b"__ndarray__": True, b"data": bytes, b"dtype": "<f4",
b"shape": [2, 3]}`` (row order), a NumPy scalar ``{b"__npgeneric__": True, b"data": number, b"dtype": "<f4"}`` (openpi,
``openpi_client/msgpack_numpy.py``). Booleans, integers, reals and texts of fixed width are the only array types: nothing that is
read can run code. How much a message may hold is bounded before it is built.

The policy protocol (openpi, ``serving/websocket_policy_server.py``): on connection the server sends its metadata; every request is
one observation, every reply a map with ``actions`` of shape (horizon, size). An error arrives as a text, and then the server closes
with code 1011. There is no reset message.
"""

from __future__ import annotations

import logging
import math
import os
import re
import socket
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
from pydantic import Field

from worldline_core.config import StrictModel
from worldline_core.errors import ConfigError, DataError, UnavailableError, needing
from worldline_core.http_exchange import within
from worldline_core.untrusted_text import without_secret

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
    with needing("serve", "msgpack"):
        import msgpack
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


CLOSE_S = 1.5
_silent = logging.getLogger(f"{__name__}.protocol")
_silent.setLevel(logging.CRITICAL + 1)  # websockets logs a traceback of what it raises as well


class MessageSocket:
    """A connection to a server of array messages, for one thread at a time.

    After a deadline or a broken message the connection is closed: a late reply would be taken for that of the next request.

    Args:
        url: ``ws://host:port/path`` or ``wss://...``; reached directly, without a proxy.
        headers: sent with the connection request; the last word of each is a secret, hidden where the server repeats it.
        deadline_s: for connecting, name resolution included, and for each request with its reply.
        max_bytes: of one reply.

    Raises:
        ConfigError: a header cannot be sent.
        UnavailableError: no server answers, or it refuses the request.
    """

    def __init__(
        self,
        url: str,
        *,
        headers: Mapping[str, str] | None = None,
        deadline_s: float = 30.0,
        max_bytes: int = MAX_MESSAGE_BYTES,
    ) -> None:
        from websockets.exceptions import InvalidStatus, WebSocketException
        from websockets.sync.client import connect

        self.url, self.deadline_s, self.max_bytes = url, deadline_s, max_bytes
        given = {name: value.strip() for name, value in (headers or {}).items()}
        if wrong := [name for name, value in given.items() if not (value.isascii() and value.isprintable())]:
            raise ConfigError(
                f"The header {wrong[0]} cannot be sent", where=url,
                expected="a key or token of letters, digits and signs of ASCII on one line",
            )  # fmt: skip
        self._secrets = [value.split()[-1] for value in given.values() if value]
        try:
            # The library's own deadline begins when the name is resolved.
            self._connection = within(
                deadline_s,
                lambda: connect(
                    url, additional_headers=given, compression=None, max_size=max_bytes, open_timeout=deadline_s,
                    close_timeout=1.0, proxy=None, logger=_silent,
                ),
                discard=lambda late: late.close(),
            )  # fmt: skip
        except InvalidStatus as error:
            status = error.response.status_code
            raise UnavailableError(
                "The server refuses the connection", where=url, expected="status 101", got=status,
                next_step="give its API key or token" if status in (401, 403) else None,
            ) from error  # fmt: skip
        # ValueError: a malformed address; AssertionError: websockets', where a server speaks first and hangs up.
        except (OSError, WebSocketException, EOFError, ValueError, AssertionError) as error:
            raise UnavailableError(
                "No server answers", where=url,
                got=f"{type(error).__name__}: {str(error) or f'no connection within {deadline_s:g} s'}",
                next_step="start it, or correct the address (ws://HOST:PORT)",
            ) from error  # fmt: skip

    def request(self, message: object) -> dict[str, Any]:
        """Send one message and return the reply, a map.

        Raises:
            UnavailableError: the server is gone, reports an error (a text frame), or does not answer in time.
            DataError: the request cannot be packed, or the reply is no message or too large.
        """
        content, begin = pack(message), time.monotonic()
        with self._connected():
            within(self.deadline_s, lambda: self._connection.send(content))
        return self.receive(begin)

    def receive(self, begin: float | None = None) -> dict[str, Any]:
        """The next message of the server, within the deadline from ``begin`` (monotonic) on; raises as :meth:`request`."""
        waited = 0.0 if begin is None else time.monotonic() - begin
        with self._connected():
            reply = self._connection.recv(timeout=max(0.0, self.deadline_s - waited))
        if isinstance(reply, str):
            self.close()
            for secret in self._secrets:
                reply = without_secret(reply, secret)
            raise UnavailableError("The server reports an error", where=self.url, got=reply)
        try:
            found = unpack(reply, self.url)
            if not isinstance(found, dict):
                raise DataError("A message is no map", where=self.url, expected="a map", got=type(found).__name__)
        except DataError:
            self.close()
            raise
        return found

    @contextmanager
    def _connected(self) -> Iterator[None]:
        from websockets.exceptions import ConnectionClosed

        try:
            yield
        except TimeoutError as error:
            self.close()
            raise UnavailableError(
                "The server did not answer in time", where=self.url, expected=f"a reply within {self.deadline_s:g} s",
                next_step="connect again; allow more time where the server needs it",
            ) from error  # fmt: skip
        except ConnectionClosed as error:
            if error.sent is not None and error.sent.code == 1009 and not error.rcvd_then_sent:
                most = f"at most {self.max_bytes:,} bytes"
                raise DataError("A reply is too large", where=self.url, expected=most) from error
            raise UnavailableError(
                "The server closed the connection", where=self.url, got=str(error), next_step="connect again"
            ) from error

    def close(self) -> None:
        """End the connection; that of a server which takes nothing any more is cut."""
        with suppress(TimeoutError):
            within(CLOSE_S, self._connection.close)
        with suppress(OSError):
            self._connection.socket.shutdown(socket.SHUT_RDWR)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


MAX_HORIZON = 1024
"""Longest chunk of actions: policies of this field plan some ten to hundred steps ahead."""


class OpenpiPolicy(MessageSocket):
    """A connected policy.

    Args:
        url: ``ws://host:port``.
        api_key: sent as ``Authorization: Api-Key ...``.
        deadline_s: for connecting, and for each chunk.
        max_bytes: of one reply.

    Attributes:
        metadata: the server's description of its policy.

    Raises:
        UnavailableError: no server answers, or it refuses the key.
        DataError: the metadata are no map.
        ConfigError: the key cannot be sent.
    """

    def __init__(
        self, url: str, *, api_key: str | None = None, deadline_s: float = 30.0, max_bytes: int = MAX_MESSAGE_BYTES
    ) -> None:
        headers = {} if api_key is None else {"Authorization": f"Api-Key {api_key}"}
        super().__init__(url, headers=headers, deadline_s=deadline_s, max_bytes=max_bytes)
        try:
            self.metadata: Mapping[str, Any] = self.receive()
        except BaseException:
            self.close()
            raise

    def infer(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        """The reply to an observation: ``actions`` as float64 ``(horizon, size)``, and whatever else the server adds
        (``server_timing``).

        Args:
            observation: texts, numbers and arrays under the names that this policy expects.

        Raises:
            UnavailableError: the policy failed (with its own error text), is gone, or does not answer in time.
            DataError: the observation cannot be sent, or the reply has no finite numbers as actions.
        """
        reply = self.request(observation)
        actions: Any = reply.get("actions")
        array = isinstance(actions, np.ndarray)
        numbers = array and actions.dtype.kind in "fiu" and actions.ndim == 2 and actions.size
        if not numbers or len(actions) > MAX_HORIZON:
            raise DataError(
                "The policy's actions are no chunk", where=self.url,
                expected=f"numbers (horizon 1 to {MAX_HORIZON}, size >= 1)",
                got=f"{actions.dtype} {actions.shape}" if array else type(actions).__name__,
            )  # fmt: skip
        actions = actions.astype(np.float64)
        if not np.isfinite(actions).all():
            step, column = np.argwhere(~np.isfinite(actions))[0]
            raise DataError("An action is not finite", where=f"{self.url}, step {step}, column {column}")
        return {**reply, "actions": actions}

    def chunk(self, observation: Mapping[str, Any], *, rows: int, columns: int) -> np.ndarray:
        """Actions ``(at least rows, columns)``.

        Raises:
            UnavailableError, DataError: as :meth:`infer`; DataError also for fewer rows, or other columns.
        """
        actions: np.ndarray = self.infer(observation)["actions"]
        if actions.shape[1] != columns or len(actions) < rows:
            raise DataError(
                "The policy's actions do not fit the robot", where=self.url,
                expected=f"at least {rows} rows of {columns} columns", got=actions.shape,
            )  # fmt: skip
        return actions


class PolicyConfig(StrictModel):
    """An openpi policy server, and how it expects an observation.

    Attributes:
        url: ws://host:port.
        api_key_variable: environment variable that holds its API key.
        form: ``flat``: pictures (H, W, 3) beside the state; ``aloha``: pictures (3, H, W) in a map ``images``, as policies of
            openpi's ALOHA and of RoboTwin take them.
        image_keys: by view. A dot or a slash is part of the name.
        deadline_s: for one chunk of actions.
    """

    url: str = Field(pattern=r"^wss?://")
    api_key_variable: str | None = None
    form: Literal["flat", "aloha"] = "flat"
    image_keys: dict[str, str] = Field(
        default_factory=lambda: {view: f"observation.images.{view}" for view in ("head", "left_wrist", "right_wrist")}
    )
    state_key: str = "observation.state"
    prompt_key: str = "prompt"
    deadline_s: float = Field(10.0, gt=0)

    def connect(self) -> OpenpiPolicy:
        """Raises: as `OpenpiPolicy`."""
        key = None if self.api_key_variable is None else os.environ.get(self.api_key_variable)
        return OpenpiPolicy(self.url, api_key=key, deadline_s=self.deadline_s)

    def observation(self, pictures: Mapping[str, np.ndarray], state: np.ndarray, prompt: str) -> dict[str, Any]:
        """Observation for the policy: pictures ``uint8 (H, W, 3)`` of the views that it names, a state ``(j)``, an instruction."""
        images = {self.image_keys[view]: picture for view, picture in pictures.items() if view in self.image_keys}
        if self.form == "aloha":
            images = {
                "images": {name: np.ascontiguousarray(image.transpose(2, 0, 1)) for name, image in images.items()}
            }
        return {**images, self.state_key: state.astype(np.float32), self.prompt_key: prompt}
