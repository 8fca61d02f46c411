"""A simulator behind HTTP in the protocol of GE-Sim 2.0 (github.com/AgibotTech/GE-Sim-V2: docs/adding_world_models.md,
docs/replay.md, and the messages of its server), written against its description; the server itself is another program.

GET /healthz; POST /init gives a ``client_id`` that every later body carries (one session at a time: another client's /init
ends it); /reset, /set_task, /set_camera_params and /close take JSON. /set_episode_data, /set_episode_traj and /step take
sections, each after its length in four bytes, big-endian; the last one is JSON. A frame is one JPEG with the views side by
side; numbers are float32, little-endian. /step takes at most 25 actions, and answers with JSON (``frame_shape``: T 3 V H W;
``state_shape``, or null), T frames, and the state.

Axes: t frames, v views (head, left wrist, right wrist).
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from worldline_core.data.guards.plain_files import decode_image
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.errors import DataError, UnavailableError
from worldline_core.http_exchange import IncompleteResponseError, UnreachableError, exchange
from worldline_core.untrusted_text import cut

CHUNK = 25
"""Actions of a step at most."""
_JPEG_QUALITY = 95
_MAX_JSON_BYTES = 1 << 16
_PATIENCE = 3
"""Refused predictions in a row after which the server is taken to be out of order."""


class RefusedPredictionError(DataError):
    """One prediction cannot be made, and others may be; ``reason`` is its code in the quarantine."""

    reason = "simulator_failed"


class GeSimClient:
    """One session with a server.

    Args:
        url: of the server, without a path.
        timeout_s: for each whole answer.

    Raises:
        UnavailableError: there is no such server.
    """

    def __init__(self, url: str, timeout_s: float) -> None:
        self.url, self.timeout_s = url.rstrip("/"), timeout_s
        self._refused = 0
        self._json("/healthz", None)
        self._client = self._json("/init", {"user_name": "worldline"}).get("client_id")
        if not isinstance(self._client, str):
            raise self._unusable("/init", "no client_id in its answer")

    def begin(self, task: str, K: np.ndarray, T_base_camera: np.ndarray, views: np.ndarray) -> None:
        """Begin an episode.

        Args:
            K: (v, 3, 3), in pixels of ``views``; T_base_camera: (v, 4, 4) at the observed frame.
            views: uint8 (v, H, W, 3), what is observed.

        Raises:
            RefusedPredictionError: the server refuses it.
            UnavailableError: the server is gone.
        """
        self._json("/reset", {})
        self._json("/set_task", {"task": task})
        self._json("/set_camera_params", {"intrinsic": K.tolist(), "extrinsic": T_base_camera.tolist()})
        count, height, width, _ = views.shape
        self._send("/set_episode_data", [encode_frame(views)], {"frame_shape": [3, count, height, width]})

    def condition(self, band: np.ndarray, T_base_camera: np.ndarray) -> None:
        """Say what the coming frames are drawn for: pictures of the tools, and where the cameras are.

        Args:
            band: uint8 (t, v, H, W, 3); T_base_camera: (v, t, 4, 4).
        """
        count, views, height, width, _ = band.shape
        sections = [pack_sections(encode_frame(frame) for frame in band), _floats(T_base_camera)]
        shapes = {"traj_shape": [3, views, count, height, width], "c2w_shape": list(T_base_camera.shape)}
        self._send("/set_episode_traj", sections, shapes)

    def step(self, actions: np.ndarray, size: tuple[int, int], views: int) -> np.ndarray:
        """The frames of the next actions, uint8 (t, v, H, W, 3).

        Args:
            actions: (t, 16), at most ``CHUNK``.

        Raises:
            RefusedPredictionError: the answer is not made of one frame of this size for each action.
        """
        path, shape = "/step", [len(actions), 3, views, *size]
        body = pack_sections([_floats(actions), self._meta({"action_shape": list(actions.shape)})])
        # A JPEG is never much larger than its pixels.
        answer = self._post(path, body, _MAX_JSON_BYTES + 2 * math.prod(shape) + 4 * CHUNK * actions.shape[1])
        try:
            meta, *pictures, state = unpack_sections(answer)
            facts = json.loads(meta)
            found, states = facts["frame_shape"], facts["state_shape"]
            if found != shape or len(pictures) != len(actions):
                raise ValueError(f"frames of {found} in {len(pictures)} sections, not of {shape}")
            if len(state) != (0 if states is None else 4 * math.prod(states)):
                raise ValueError(f"a state of {len(state)} bytes, not of {states} numbers")
            frames = [decode_frame(picture, size, views) for picture in pictures]
        except (ValueError, TypeError, KeyError, RecursionError, RejectedInputError) as error:
            raise self._refusal(path, f"{type(error).__name__}: {error}") from error
        self._refused = 0
        return np.stack(frames)

    def close(self) -> None:
        """End the session, if it still is."""
        try:
            self._json("/close", {})
        except (UnavailableError, RefusedPredictionError):
            return  # what was predicted is whole

    def _send(self, path: str, sections: Sequence[bytes], meta: dict[str, Any]) -> None:
        self._post(path, pack_sections([*sections, self._meta(meta)]), _MAX_JSON_BYTES)

    def _meta(self, meta: dict[str, Any]) -> bytes:
        return json.dumps({"client_id": self._client, **meta}).encode()

    def _json(self, path: str, payload: dict[str, Any] | None) -> dict[str, Any]:
        if payload is not None and path != "/init":
            payload = {"client_id": self._client, **payload}
        answer = self._post(path, None if payload is None else json.dumps(payload).encode(), _MAX_JSON_BYTES)
        try:
            found = json.loads(answer)
        except (ValueError, RecursionError) as error:
            raise self._unusable(path, f"no JSON: {error}") from error
        if not isinstance(found, dict):
            raise self._unusable(path, f"no JSON object: {answer!r}")
        return found

    def _post(self, path: str, body: bytes | None, max_bytes: int) -> bytes:
        """The answer of status 200."""
        kind = "application/json" if body is None or body.startswith(b"{") else "application/octet-stream"
        headers = {"Content-Type": kind, "Accept-Encoding": "identity"}
        try:
            status, answer = exchange(
                self.url + path, body, headers=headers, timeout_s=self.timeout_s, max_bytes=max_bytes
            )
        except (UnreachableError, IncompleteResponseError) as error:
            raise self._unusable(path, str(error)) from error
        if status in (400, 500):  # what it says of a request that it understood
            raise self._refusal(path, f"HTTP {status}: {answer.decode(errors='replace')}")
        if status != 200:
            raise self._unusable(path, f"HTTP {status}: {answer.decode(errors='replace')}")
        if len(answer) > max_bytes:
            raise self._refusal(path, f"an answer of more than {max_bytes:,} bytes")
        return answer

    def _refusal(self, path: str, reason: str) -> RefusedPredictionError | UnavailableError:
        self._refused += 1
        if self._refused >= _PATIENCE:
            return self._unusable(path, f"{_PATIENCE} refusals in a row, the last one: {reason}")
        return RefusedPredictionError("The simulator refused", where=self.url + path, got=cut(reason, 500))

    def _unusable(self, path: str, reason: str) -> UnavailableError:
        return UnavailableError(
            "The simulator's server cannot be used",
            where=self.url + path,
            expected="a server of GE-Sim 2.0's protocol, and no other client of it meanwhile",
            got=cut(reason, 500),
            next_step="start it, check server.url and server.timeout_s, and run again: finished predictions are kept",
        )


def pack_sections(sections: Any) -> bytes:
    """Sections, each after its length."""
    return b"".join(len(section).to_bytes(4, "big") + section for section in sections)


def unpack_sections(content: bytes) -> list[bytes]:
    """Sections of a whole body.

    Raises:
        ValueError: it breaks off.
    """
    sections, position = [], 0
    while position < len(content):
        start = position + 4
        position = start + int.from_bytes(content[position:start], "big")
        if position > len(content) or start > len(content):
            raise ValueError(f"section {len(sections)} breaks off: {position - len(content)} bytes are missing")
        sections.append(content[start:position])
    return sections


def encode_frame(views: np.ndarray) -> bytes:
    """One JPEG of views uint8 (v, H, W, 3), side by side."""
    tiled = np.concatenate(list(views), axis=1)
    return cv2.imencode(".jpg", np.ascontiguousarray(tiled[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[
        1
    ].tobytes()


def decode_frame(content: bytes, size: tuple[int, int], views: int) -> np.ndarray:
    """Views uint8 (v, H, W, 3) of a JPEG that nobody vouches for.

    Raises:
        ValueError: it is of another size; RejectedInputError: it is none.
    """
    expected, picture = (size[0], views * size[1]), decode_image(content, "a frame")
    if (found := picture.shape[:2]) != expected:
        raise ValueError(f"a frame of {found[0]} x {found[1]} pixels, not of {expected[0]} x {expected[1]}")
    return np.stack(np.split(picture, views, axis=1))


def _floats(values: np.ndarray) -> bytes:
    return np.ascontiguousarray(values, "<f4").tobytes()
