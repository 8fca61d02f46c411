"""A client of openpi's policy servers: observations in, chunks of actions out.

The protocol (openpi, ``serving/websocket_policy_server.py``): on connection the server sends its metadata; every request is one
observation, every reply a map with ``actions`` of shape (horizon, size). An error arrives as a text, and then the server
closes with code 1011. There is no reset message.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from pydantic import Field

from worldline_core.config import StrictModel
from worldline_core.errors import DataError
from worldline_core.policies.messages import MAX_MESSAGE_BYTES, MessageSocket

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

    def infer(self, observation: Mapping[str, Any], *, deadline_s: float | None = None) -> dict[str, Any]:
        """The reply to an observation: ``actions`` as float64 ``(horizon, size)``, and whatever else the server adds
        (``server_timing``).

        Args:
            observation: texts, numbers and arrays under the names that this policy expects.

        Raises:
            UnavailableError: the policy failed (with its own error text), is gone, or does not answer in time.
            DataError: the observation cannot be sent, or the reply has no finite numbers as actions.
        """
        reply = self.request(observation, deadline_s=deadline_s)
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
