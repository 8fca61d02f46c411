"""A Python client of `worldline serve`: the simulator of another process or machine, driven like one of this process."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from worldline_core.errors import DataError, UnavailableError
from worldline_core.policies.openpi import MAX_MESSAGE_BYTES, MessageSocket
from worldline_core.serving.serve_config import PROTOCOL


def _finite(kind: str, axes: int, values: np.ndarray) -> np.ndarray:
    if values.dtype.kind != kind or values.ndim != axes or not values.size or not np.isfinite(values).all():
        raise ValueError(f"{axes} axes of finite numbers wanted, got {values.dtype} {values.shape}")
    return values


_Rows = Annotated[np.ndarray, AfterValidator(partial(_finite, "f", 3))]
_Poses = Annotated[np.ndarray, AfterValidator(partial(_finite, "f", 4))]
_Pictures = Annotated[np.ndarray, AfterValidator(partial(_finite, "u", 4))]
_Videos = Annotated[np.ndarray, AfterValidator(partial(_finite, "u", 5))]


class _Reply(BaseModel):
    """State of a session, and what else belongs to some replies: pictures, frames, and the session that begins."""

    model_config = ConfigDict(frozen=True, strict=True, arbitrary_types_allowed=True)

    num_frames: int = Field(ge=1)
    states: _Rows
    commands: _Rows
    tool_poses: _Poses
    pictures: dict[str, _Pictures] = Field({}, min_length=1)
    frames: dict[str, _Videos] = Field({}, min_length=1)
    seconds: float = 0.0
    session: str = ""
    frames_per_step: int = Field(1, ge=1)
    embodiment: str = ""
    state_names: list[str] = []


class SimulatorClient(MessageSocket):
    """A connection to a server; sessions that were started over it end with it.

    Args:
        url: ``ws://host:port``.
        token: of a server that asks for one.

    Attributes:
        metadata: what the server says of itself: views, fps, frames_per_step, image_size, episodes.

    Raises:
        UnavailableError: no server answers, or the token is refused.
        DataError: a server of another kind answers.
    """

    def __init__(
        self, url: str, *, token: str | None = None, deadline_s: float = 60.0, max_bytes: int = MAX_MESSAGE_BYTES
    ) -> None:
        headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        super().__init__(f"{url.rstrip('/')}/v1", headers=headers, deadline_s=deadline_s, max_bytes=max_bytes)
        self.metadata: dict[str, Any] = self.receive()
        if self.metadata.get("protocol") != PROTOCOL:
            self.close()
            raise DataError(
                "Not a server of the simulator", where=url, expected=f"protocol {PROTOCOL} of worldline serve",
                got=", ".join(map(str, self.metadata))[:200] or "no metadata",
            )  # fmt: skip

    def start(
        self,
        episode: str | None = None,
        *,
        images: Mapping[str, np.ndarray] | None = None,
        cameras: Mapping[str, Any] | None = None,
        embodiment: str | None = None,
        state: np.ndarray | None = None,
        seeds: Sequence[int] = (42,),
    ) -> RemoteSimulation:
        """Begin a session at a recording of the server, or at an observation as of ``WorldLine.start``.

        Args:
            cameras: by view, ``Camera`` objects; a model that knows the robot's control vectors (``needs_cameras`` of the metadata is
                false) does without.
            seeds: a clip for each.

        Raises:
            DataError: the start is not usable; UnavailableError: there is no room for it.
        """
        posed = None
        if cameras is not None:
            posed = {
                view: {"K": np.asarray(camera.K), "T_base_camera": camera.T_base_camera}
                for view, camera in cameras.items()
            }
        given = {"episode": episode, "images": images, "cameras": posed, "embodiment": embodiment, "state": state}
        present = {name: value for name, value in given.items() if value is not None}
        return RemoteSimulation(self, self.call({"op": "start", "seeds": list(seeds), **present}))

    def call(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """The reply to one request.

        Raises:
            DataError: the server says what is wrong with it; UnavailableError: the server is busy or gone.
        """
        reply = self.request(request)
        error = reply.get("error")
        if error is not None:
            if not isinstance(error, dict) or not isinstance(error.get("what"), str):
                raise DataError("The server's error is not understood", where=self.url, got=error)
            kind = UnavailableError if error.get("kind") == "UnavailableError" else DataError
            details = {name: error.get(name) for name in ("expected", "got", "next_step")}
            raise kind(error["what"], where=error.get("where", self.url), **details)
        return reply


class RemoteSimulation:
    """A session on a server.

    Attributes:
        pictures: last picture of every view, ``uint8 (H, W, 3)``, of each clip.
        states, commands: ``(b, n, j)`` of the last step's frames, as of ``Simulation``.
        tool_poses: ``(b, a, 4, 4)`` at the last picture.
        frames_per_step: controls that a step takes.
        seconds: that the server took for the last step, its queue included.
    """

    def __init__(self, client: SimulatorClient, opened: Mapping[str, Any]) -> None:
        self._client = client
        reply = self._checked(opened, "session", "frames_per_step", "embodiment", "state_names", "pictures")
        self.session, self.frames_per_step = reply.session, reply.frames_per_step
        self.embodiment, self.state_names = reply.embodiment, reply.state_names
        self.seconds = 0.0
        self._take(reply, len(reply.states))

    def _checked(self, reply: Mapping[str, Any], *needed: str) -> _Reply:
        what, url = "A reply of the server is not understood", self._client.url
        if missing := [name for name in needed if name not in reply]:
            raise DataError(what, where=f"{url}: {missing[0]}", got="nothing")
        try:
            return _Reply.model_validate(reply)
        except ValidationError as error:
            found = error.errors()[0]
            raise DataError(what, where=f"{url}: {'.'.join(map(str, found['loc']))}", got=found["msg"]) from error

    def _take(self, reply: _Reply, clips: int) -> None:
        parts = reply.states, reply.commands, reply.tool_poses, *reply.pictures.values(), *reply.frames.values()
        wanted = {clips}, {self.frames_per_step}
        got = {len(part) for part in parts}, {video.shape[1] for video in reply.frames.values()} or wanted[1]
        if got != wanted:
            raise DataError(
                "A reply of the server does not fit", where=self._client.url,
                expected=f"{clips} clips and steps of {self.frames_per_step} frames", got=f"{got[0]} and {got[1]}",
            )  # fmt: skip
        self.num_frames = reply.num_frames
        self.states, self.commands, self.tool_poses = reply.states, reply.commands, reply.tool_poses
        if reply.pictures:
            self.pictures = _by_clip(reply.pictures)

    @property
    def state(self) -> np.ndarray:
        """``(b, j)``: where the robot is at the last picture."""
        return self.states[:, -1]

    def step(self, controls: np.ndarray) -> list[dict[str, np.ndarray]]:
        """Predict the next frames under controls ``(b, frames_per_step, j)``; of every clip ``uint8 (n, H, W, 3)`` by view."""
        request = {"op": "step", "session": self.session, "controls": np.asarray(controls, np.float64)}
        reply = self._checked(self._client.call(request), "frames")
        self._take(reply, len(self.states))
        self.seconds = reply.seconds
        frames = _by_clip(reply.frames)
        self.pictures = [{view: video[-1] for view, video in clip.items()} for clip in frames]
        return frames

    def fork(self, n: int, seeds: Sequence[int] | None = None) -> RemoteSimulation:
        """``n`` branches of every clip as a session of their own."""
        return self.select([clip for clip in range(len(self.states)) for _ in range(n)], seeds)

    def select(self, clips: Sequence[int], seeds: Sequence[int] | None = None) -> RemoteSimulation:
        """These clips, in the state that they are in, as a session of their own."""
        request = {"op": "fork", "session": self.session, "clips": [int(clip) for clip in clips]}
        request |= {} if seeds is None else {"seeds": list(seeds)}
        return RemoteSimulation(self._client, self._client.call(request))

    def reset(self) -> None:
        reply = self._client.call({"op": "reset", "session": self.session})
        self._take(self._checked(reply, "pictures"), len(self.states))

    def close(self) -> None:
        self._client.call({"op": "close", "session": self.session})


def _by_clip(arrays: Mapping[str, np.ndarray]) -> list[dict[str, np.ndarray]]:
    count = len(next(iter(arrays.values())))
    return [{view: values[clip] for view, values in arrays.items()} for clip in range(count)]
