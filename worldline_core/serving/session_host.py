"""Many running simulations behind one worker: requests in, replies out, with limits on everything.

One thread computes, one request after another in the order of their arrival, so a session gives the bytes that it would give
alone. Sessions belong to the connection that started them, and end with it.
"""

from __future__ import annotations

import asyncio
import secrets
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from worldline_core.errors import DataError, UnavailableError, WorldLineError
from worldline_core.geometry.embodiment import check_embodiment_name
from worldline_core.geometry.kinematics import KinematicsByName
from worldline_core.rollout.observation import Camera
from worldline_core.rollout.recorded_starts import RecordedStarts
from worldline_core.rollout.simulation import USUAL_CLIP_FRAMES, Simulation
from worldline_core.rollout.worldline import WorldLine
from worldline_core.serving.serve_config import PROTOCOL, ServeConfig
from worldline_core.untrusted_text import shown

Seed = Annotated[int, Field(ge=0, lt=2**63)]


def _numbers(values: np.ndarray) -> np.ndarray:
    if values.dtype.kind not in "fiu":
        raise ValueError(f"an array of numbers wanted, got {values.dtype}")
    return values


def _picture(values: np.ndarray) -> np.ndarray:
    if values.dtype != np.uint8 or values.ndim != 3 or not values.size:
        raise ValueError(f"a picture uint8 (H, W, 3) wanted, got {values.dtype} {values.shape}")
    return values


Numbers = Annotated[np.ndarray, AfterValidator(_numbers)]


class _Request(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, arbitrary_types_allowed=True)


class _CameraMessage(_Request):
    K: Numbers
    T_base_camera: Numbers | None = None


class StartRequest(_Request):
    """Begin a session at a recording of the server, or at images, state, embodiment and cameras (of the views that the model needs
    them of); a clip for each seed.
    """

    op: Literal["start"]
    episode: str | None = None
    images: dict[str, Annotated[np.ndarray, AfterValidator(_picture)]] | None = None
    cameras: dict[str, _CameraMessage] | None = None
    embodiment: str | None = None
    state: Numbers | None = None
    seeds: list[Seed] = Field(default=[42], min_length=1)


class StepRequest(_Request):
    """Predict the next frames of a session under controls ``(clips, frames_per_step, state size)``."""

    op: Literal["step"]
    session: str
    controls: Numbers


class ForkRequest(_Request):
    """Begin a session with these clips of another one, in the state that they are in; one may be named several times."""

    op: Literal["fork"]
    session: str
    clips: list[int] = Field(min_length=1)
    seeds: list[Seed] | None = None


class SessionRequest(_Request):
    """Bring a session back to its start, or close it."""

    op: Literal["reset", "close"]
    session: str


Request = StartRequest | StepRequest | ForkRequest | SessionRequest
_REQUEST: TypeAdapter[Request] = TypeAdapter(Annotated[Request, Field(discriminator="op")])


@dataclass
class _Running:
    owner: object
    start: Simulation
    simulation: Simulation


class SessionHost:
    """All sessions of a server.

    Attributes:
        world, starts: the model, and the recordings to start from.
    """

    def __init__(self, world: WorldLine, config: ServeConfig) -> None:
        self.world = world
        self.config = config
        self.starts = RecordedStarts(
            config.episodes, view_sets=world.view_sets, fps=world.contract.fps, needs_cameras=world.needs_cameras
        )
        self.kinematics = KinematicsByName({})
        self._running: dict[str, _Running] = {}
        self._players: set[object] = set()
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="simulator")

    def warm_up(self) -> None:
        """Begin one simulation, so that the first client does not wait for what is imported and built once."""
        for row in self.starts.rows[:1]:
            self.simulate(row.episode_id, [0])

    def simulate(self, episode_id: str, seeds: Sequence[int]) -> Simulation:
        """Clips that begin at a recording, one for each seed.

        Raises: DataError when there is no such recording.
        """
        row, start, count = self.starts.row(episode_id), self.starts.at(episode_id), len(seeds)
        return self.world.start(
            [start.images] * count, [start.cameras] * count, embodiment=self.kinematics.get(row.embodiment),
            state=np.repeat(start.state[None], count, axis=0), seed=list(seeds),
        )  # fmt: skip

    def metadata(self) -> dict[str, Any]:
        """Facts that a client needs: views, rate, size of pictures, recordings (unseen bodies and cameras last), policies."""
        world, rows = self.world, sorted(self.starts.rows, key=lambda row: row.split == "ood_test")
        return {
            "protocol": PROTOCOL,
            "views": list(world.views),
            "needs_cameras": world.needs_cameras,
            "view_sets": [list(views) for views in world.view_sets],
            "fps": world.contract.fps,
            "frames_per_step": world.frames_per_unit if world.causal is not None else None,
            "image_size": list(world.image_size),
            "episodes": [
                {"id": r.episode_id, "embodiment": r.embodiment, "task": r.task_family, "instruction": r.instruction}
                for r in rows
            ],
            "policies": list(self.config.policies),
        }

    async def compute[T](self, work: Callable[[], T]) -> T:
        """The result of ``work``, done by the one worker after everything that came before."""
        return await asyncio.get_running_loop().run_in_executor(self._worker, work)

    async def handle(self, owner: object, message: object) -> dict[str, Any]:
        """The reply to one request, with the key ``error`` when it was refused; an owner sends one at a time."""
        try:
            return await self._handle(owner, _parsed(message))
        except WorldLineError as error:
            return {"error": error_message(error)}

    async def _handle(self, owner: object, request: Request) -> dict[str, Any]:
        if isinstance(request, StartRequest):
            self._check_room(owner, len(request.seeds))
            simulation = await self.compute(lambda: self._start(request))
            return self._opened(owner, simulation, simulation.copy())
        running = self._running.get(request.session)
        if running is None or running.owner is not owner:
            raise DataError("There is no such session", got=request.session, next_step="start one")
        simulation = running.simulation
        if isinstance(request, StepRequest):
            begin = time.monotonic()
            frames = await self.compute(lambda: simulation.step(request.controls))
            seconds = time.monotonic() - begin
            shown = {view: np.stack([clip[view] for clip in frames]) for view in simulation.views}
            return {**_state_of(simulation), "frames": shown, "seconds": seconds}
        if isinstance(request, ForkRequest):
            self._check_room(owner, len(request.clips))
            branches = await self.compute(lambda: simulation.select(request.clips, request.seeds))
            return self._opened(owner, branches, running.start.select(request.clips))
        if request.op == "reset":
            running.simulation = running.start.copy()
            return {**_state_of(running.simulation), "pictures": _pictures_of(running.simulation)}
        del self._running[request.session]
        return {"closed": True}

    def _start(self, request: StartRequest) -> Simulation:
        given = ("images", "cameras", "embodiment", "state")
        present = {name for name in (*given, "episode") if getattr(request, name) is not None}
        if present != {"episode"} and present | {"cameras"} != {*given}:  # what lacks a camera, the model says
            raise DataError(
                "A session starts at a recording, or at an observation", expected=f"episode, or {', '.join(given)}",
                got=", ".join(name for name in (*given, "episode") if name in present) or "neither",
            )  # fmt: skip
        if request.episode is not None:
            return self.simulate(request.episode, request.seeds)
        images, cameras, name = request.images or {}, request.cameras or {}, request.embodiment or ""
        check_embodiment_name(name)  # a path would name a file of this machine
        posed = {view: Camera(camera.K, camera.T_base_camera) for view, camera in cameras.items()}
        rows = np.asarray(request.state, np.float64)
        rows = np.repeat(rows[None], len(request.seeds), axis=0) if rows.ndim == 1 else rows
        return self.world.start(
            [images] * len(request.seeds), [posed] * len(request.seeds), embodiment=self.kinematics.get(name),
            state=rows, seed=request.seeds,
        )  # fmt: skip

    def _check_room(self, owner: object, clips: int) -> None:
        """Raises: UnavailableError when so many more clips exceed a limit; DataError when one session's own do."""
        config = self.config
        frames = self.world.unit(USUAL_CLIP_FRAMES)
        size = clips * frames * len(self.world.views) * 3 * int(np.prod(self.world.image_size))
        if size > 0.9 * config.max_message_bytes or clips > config.max_clips:
            raise DataError(
                "Too many clips for one session", expected=f"replies below {config.max_message_bytes:,} bytes, and at most "
                f"{config.max_clips} clips", got=f"{clips} clips of {size // clips:,} bytes a step",
            )  # fmt: skip
        own = sum(running.owner is owner for running in self._running.values())
        if own >= config.max_sessions_per_connection:
            raise UnavailableError(
                "A connection has as many sessions as it may", expected=f"at most {config.max_sessions_per_connection}",
                next_step="close some, put several clips into one session, or set max_sessions_per_connection",
            )  # fmt: skip
        sessions = len(self._running) + len(self._players)
        used = len(self._players) + sum(len(running.simulation) for running in self._running.values())
        if sessions >= config.max_sessions or used + clips > config.max_clips:
            raise UnavailableError(
                "The server has no room for another session",
                expected=f"at most {config.max_sessions} sessions with {config.max_clips} clips",
                got=f"{sessions} sessions with {used} clips, and {clips} more",
                next_step="close sessions, or try again later",
            )

    def admit(self, player: object) -> None:
        """Count a player at the page as a session of one clip, until :meth:`dismiss`.

        Raises: UnavailableError where there is no room.
        """
        if player not in self._players:
            self._check_room(player, 1)
            self._players.add(player)

    @property
    def shared(self) -> bool:
        """True where computing ahead for one session or player would make others wait."""
        return len(self._running) + len(self._players) > 1

    def dismiss(self, player: object) -> None:
        self._players.discard(player)

    def _opened(self, owner: object, simulation: Simulation, start: Simulation) -> dict[str, Any]:
        self._check_room(owner, len(simulation))  # others came while this one was made
        name = secrets.token_urlsafe(12)
        self._running[name] = _Running(owner, start, simulation)
        embodiment = simulation.embodiment
        return {
            **_state_of(simulation),
            "session": name,
            "pictures": _pictures_of(simulation),
            "frames_per_step": simulation.frames_per_step,
            "embodiment": embodiment.name,
            "state_names": list(embodiment.state_names),
        }

    def leave(self, owner: object) -> None:
        self._running = {name: running for name, running in self._running.items() if running.owner is not owner}

    def shut_down(self) -> None:
        self._running.clear()
        self._worker.shutdown(wait=True, cancel_futures=True)


def _parsed(message: object) -> Request:
    try:
        return _REQUEST.validate_python(message)
    except (ValidationError, TypeError) as error:
        found = error.errors()[0] if isinstance(error, ValidationError) else {"loc": (), "msg": str(error)}
        raise DataError(
            "A request is not understood", where=".".join(map(str, found["loc"])) or "op", got=found["msg"]
        ) from error


def _state_of(simulation: Simulation) -> dict[str, Any]:
    return {name: getattr(simulation, name) for name in ("num_frames", "states", "commands", "tool_poses")}


def _pictures_of(simulation: Simulation) -> dict[str, np.ndarray]:
    return {view: np.stack([clip[view] for clip in simulation.pictures]) for view in simulation.views}


def error_message(error: WorldLineError) -> dict[str, Any]:
    """An error as a client gets it."""
    facts = {name: getattr(error, name) for name in ("what", "where", "expected", "got", "next_step")}
    return {"kind": type(error).__name__, **{name: shown(value) for name, value in facts.items() if value is not None}}
