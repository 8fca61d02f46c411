"""One person at the page: ticks of wishes in, blocks of pictures out, with a tree of moments to go back to.

Every tick is one frame at the model's rate. When as many commands are there as a block takes, the block is predicted while the
next ticks come in; one block may wait, then ticks are refused until the pictures catch up. While nothing else is computed, the next
block is computed ahead for wishes that go on as they are, and used if they did. Every block is a node of a tree: to go back is
to choose a node, and whatever follows there is a branch of its own.

Of a long session little stays in memory: pictures go to a temporary file, and only some nodes keep their simulation; others are
computed again, which gives the same bytes.
"""

from __future__ import annotations

import asyncio
import json
import os
import tempfile
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from starlette.websockets import WebSocketDisconnect

from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set_writer import EpisodeSetWriter
from worldline_core.data.episodes.view_recording import ViewImages
from worldline_core.data.guards.source_paths import safe_stem
from worldline_core.data.video.frames import Frames, MadeFrames
from worldline_core.errors import DataError, UnavailableError, WorldLineError
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.transforms import nearest_rotation
from worldline_core.pictures import jpeg_bytes
from worldline_core.policies.openpi import OpenpiPolicy
from worldline_core.rollout.observation import image_size, project_controls
from worldline_core.rollout.recorded_starts import RecordedStart
from worldline_core.rollout.simulation import Simulation
from worldline_core.serving.session_host import Seed, SessionHost, error_message
from worldline_core.serving.teleoperation import ArmInput, Teleoperation, frame_marks

BY_HAND = "by hand"
JPEG_QUALITY = 93
KEPT_EVERY, KEPT_LAST = 16, 4
"""Nodes that keep their simulation: by depth in the tree, and the last ones used."""


class _Message(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class StartMessage(_Message):
    """Begin at a recording."""

    type: Literal["start"]
    episode: str
    seed: Seed = 42


class Tick(_Message):
    """Wishes for one frame, by arm."""

    type: Literal["tick"]
    arms: tuple[ArmInput, ...] = Field(max_length=8)


class Go(_Message):
    """Go on from a node; what was commanded and not yet predicted is dropped."""

    type: Literal["go"]
    node: int


class Advance(_Message):
    """Predict the next block under a policy's actions."""

    type: Literal["advance"]
    policy: str


class Save(_Message):
    """Save the way from the start to the current node as an EpisodeSet."""

    type: Literal["save"]


Message = StartMessage | Tick | Go | Advance | Save
_MESSAGE: TypeAdapter[Message] = TypeAdapter(Annotated[Message, Field(discriminator="type")])


@dataclass(frozen=True)
class Node:
    """A moment, and the block that led to it; the first one holds the observed frame.

    Attributes:
        depth: blocks from the start.
        given: (n, j), the controls of the block, before the limits.
        place: of the pictures in the session's file, each view after the other.
        states, commands: (n, j).
    """

    parent: int | None
    depth: int
    given: np.ndarray
    place: int
    states: np.ndarray
    commands: np.ndarray
    driver: str


class Block(NamedTuple):
    """A computed block.

    Attributes:
        hands: after each of the commands that were not there yet.
        simulation: after the block.
    """

    rows: np.ndarray
    hands: Sequence[Teleoperation]
    simulation: Simulation
    frames: dict[str, np.ndarray]


@dataclass(frozen=True)
class Ahead:
    """The next block, computed before its commands are there, for wishes that go on as they are."""

    arms: tuple[ArmInput, ...]
    made: asyncio.Future[Block]

    def hand_after(self, arms: tuple[ArmInput, ...], rows: Sequence[np.ndarray]) -> Teleoperation | None:
        """The hand after these wishes, which follow these commands; None where it is not known."""
        if not self.made.done() or self.made.cancelled() or self.made.exception() or arms != self.arms:
            return None
        block = self.made.result()
        place = len(rows) - len(block.rows) + len(block.hands)
        return block.hands[place].copy() if np.array_equal(block.rows[: len(rows)], rows) else None


class PlaySession:
    """One connection of the page.

    Args:
        send: of texts (JSON) and bytes: the length of a JSON head as four bytes (little endian), the head, then JPEG
            pictures, frame by frame and in each the views in order.
    """

    def __init__(self, host: SessionHost, send: Callable[[str | bytes], Awaitable[None]]) -> None:
        self._host, self._send = host, send
        self._row: EpisodeRow
        self._start: RecordedStart
        self._hand: Teleoperation | None = None
        self._nodes: list[Node] = []
        self._kept: dict[int, Simulation] = {}
        self._file = tempfile.TemporaryFile()  # noqa: SIM115  (until `close`)
        self._current, self._seed = 0, 0
        self._pending: list[np.ndarray] = []
        self._working: asyncio.Task[None] | None = None
        self._ahead: Ahead | None = None
        self._seconds = 0.0  # that a block takes
        self._policies: dict[str, OpenpiPolicy] = {}

    async def greet(self) -> None:
        """Send the page its choices."""
        await self._send(json.dumps({"type": "hello", **self._host.metadata()}))

    async def receive(self, text: str) -> None:
        """Act on one message; the page is sent any error."""
        try:
            try:
                message = _MESSAGE.validate_json(text)
            except ValidationError as error:
                found = error.errors()[0]
                raise DataError("A message is not understood", where=found["loc"], got=found["msg"]) from error
            await self._act(message)
        except WorldLineError as error:
            await self._send(json.dumps({"type": "error", **error_message(error)}))

    async def _act(self, message: Message) -> None:
        if isinstance(message, StartMessage):
            await self._begin(message)
            return
        if self._hand is None:
            raise DataError("Nothing is being played yet", next_step="start at a recording")
        if isinstance(message, Tick):
            await self._tick(self._hand, message)
        elif isinstance(message, Advance):
            if self._working is None:
                self._work(self._advance(message.policy))
        elif isinstance(message, Go):
            await self._settled()
            if not 0 <= message.node < len(self._nodes):
                raise DataError("No such moment", expected=f"0..{len(self._nodes) - 1}", got=message.node)
            self._current = message.node
            self._forget_commands()
            self._hand.take_over(self._nodes[message.node].commands[-1])
            await self._send_marks(self._hand)
        else:
            await self._settled()
            await self._save()

    async def _begin(self, message: StartMessage) -> None:
        begin = time.monotonic()
        self._host.admit(self)
        await self._settled()
        self._hand = None
        seed = message.seed
        recorded = self._host.starts
        self._row, self._start = row, start = await self._host.compute(
            lambda: (recorded.row(message.episode), recorded.at(message.episode))
        )
        simulation = await self._host.compute(lambda: self._host.simulate(message.episode, [seed]))
        kinematics = self._host.kinematics.get(row.embodiment)
        hand = await asyncio.to_thread(Teleoperation, start, kinematics, simulation.fps)
        first = {view: picture[None] for view, picture in simulation.pictures[0].items()}
        self._nodes, self._kept = [], {}
        self._file.truncate(0)
        await self._add(None, simulation, simulation.commands[0], first, "recording")
        self._seed, self._hand = seed, hand
        self._forget_commands()
        arms = [arm.name for arm in kinematics.embodiment.arms]
        await self._send(json.dumps({
            "type": "started", "episode": message.episode, "embodiment": row.embodiment, "arms": arms,
            "instruction": row.instruction, "frames_per_step": simulation.frames_per_step,
            "views": list(first), "seconds": time.monotonic() - begin,
        }))  # fmt: skip
        await self._send_block(first, time.monotonic() - begin, [hand.marks()["views"]])
        await self._send_marks(hand)

    async def _tick(self, hand: Teleoperation, message: Tick) -> None:
        size = self._kept[0].frames_per_step
        if len(self._pending) >= size and self._working is not None:
            await self._send(json.dumps({"type": "behind"}))
            return
        # Milliseconds of inverse kinematics and projection: beside the worker, which may be at a block.
        ahead = self._ahead
        known = None if ahead is None or not self._pending else ahead.hand_after(message.arms, self._pending)
        if known is None:
            await asyncio.to_thread(hand.tick, message.arms)
        else:
            self._hand = hand = known
        self._pending.append(hand.command)
        await self._send_marks(hand)
        if len(self._pending) >= size and self._working is None:
            rows, self._pending = np.stack(self._pending[:size]), self._pending[size:]
            self._work(self._predict(rows, BY_HAND))
        elif self._working is None:
            self._compute_ahead(hand, message.arms, size)

    def _compute_ahead(self, hand: Teleoperation, arms: tuple[ArmInput, ...], size: int) -> None:
        """Compute the block of the commands that are there and of these wishes for the rest, unless it is being computed, or somebody
        would wait for it.
        """
        ahead, parent, left = self._ahead, self._current, size - len(self._pending)
        late = self._seconds > left / self._kept[0].fps
        if late or self._host.shared or (ahead is not None and (ahead.arms == arms or not ahead.made.done())):
            return
        given, now = list(self._pending), hand.copy()

        def computed() -> Block:
            hands: list[Teleoperation] = []
            for _ in range(left):
                now.tick(arms)
                hands.append(now.copy())
            rows = np.stack([*given, *(each.command for each in hands)])
            simulation = self._reached(parent)
            return Block(rows, hands, simulation, simulation.step(rows[None])[0])

        made = asyncio.ensure_future(self._host.compute(computed))
        made.add_done_callback(lambda done: done.cancelled() or done.exception())  # raised again where it is waited for
        self._ahead = Ahead(arms, made)

    def _forget_commands(self) -> None:
        self._pending.clear()
        self._ahead = None

    async def _send_marks(self, hand: Teleoperation) -> None:
        await self._send(json.dumps({"type": "marks", "pending": len(self._pending), **hand.marks()}))

    def _work(self, work: Awaitable[None]) -> None:
        async def reported() -> None:
            try:
                await work
            except WorldLineError as error:
                await self._send(json.dumps({"type": "error", **error_message(error)}))
            finally:
                self._working = None

        def ended(task: asyncio.Task[None]) -> None:
            # A page that is gone, or takes no pictures, ends the session where its messages are read.
            if not task.cancelled() and not isinstance(
                task.exception(), (WebSocketDisconnect, TimeoutError, type(None))
            ):
                task.get_loop().call_exception_handler({"message": "a block failed", "exception": task.exception()})

        self._working = asyncio.create_task(reported())
        self._working.add_done_callback(ended)

    async def _settled(self) -> None:
        """Wait until no block is being made."""
        while (working := self._working) is not None:
            await working

    async def _predict(self, rows: np.ndarray, driver: str) -> None:
        """The next block under these commands, as a child of the current node."""
        if len(self._nodes) > self._host.config.max_blocks:
            raise DataError(
                "This session has as many blocks as it may keep", expected=self._host.config.max_blocks,
                next_step="save it, and start again",
            )  # fmt: skip
        begin, parent = time.monotonic(), self._current

        def predict() -> tuple[Simulation, dict[str, np.ndarray]]:
            simulation = self._reached(parent)
            return simulation, simulation.step(rows[None])[0]

        ahead, self._ahead = self._ahead, None
        if ahead is not None and np.array_equal((made := await ahead.made).rows, rows):
            simulation, frames = made.simulation, made.frames
        else:
            simulation, frames = await self._host.compute(predict)
            self._seconds = time.monotonic() - begin
        seconds = time.monotonic() - begin
        await self._add(parent, simulation, rows, frames, driver)
        tracks = simulation.tracks[0]
        marks = [frame_marks(tracks, frame, list(frames)) for frame in range(len(rows))]
        await self._send_block(frames, seconds, marks)

    async def _add(
        self, parent: int | None, simulation: Simulation, given: np.ndarray, frames: dict[str, np.ndarray], driver: str
    ) -> None:
        """Make a node, and go there."""
        depth, place = 0 if parent is None else self._nodes[parent].depth + 1, self._file.seek(0, os.SEEK_END)
        try:
            await asyncio.to_thread(lambda: self._file.write(b"".join(video.tobytes() for video in frames.values())))
            self._file.flush()
        except OSError as error:
            raise UnavailableError(
                "The pictures of a block could not be kept", where=tempfile.gettempdir(), got=error.strerror,
                next_step="save, make room there (or set TMPDIR), and start again",
            ) from error  # fmt: skip
        self._nodes.append(Node(parent, depth, given, place, simulation.states[0], simulation.commands[0], driver))
        self._current = len(self._nodes) - 1
        self._keep(self._current, simulation)

    def _keep(self, number: int, simulation: Simulation) -> None:
        self._kept.pop(number, None)
        self._kept[number] = simulation  # at the end: the last used
        passing = [kept for kept in self._kept if self._nodes[kept].depth % KEPT_EVERY]
        for kept in passing[:-KEPT_LAST]:
            del self._kept[kept]

    def _reached(self, number: int) -> Simulation:
        """A copy of the simulation at a node, computed again from the nearest one that is kept."""
        way: list[Node] = []
        start = number
        while start not in self._kept:
            way.append(node := self._nodes[start])
            start = node.parent or 0
        simulation = self._kept[start].copy()
        for node in reversed(way):
            simulation.step(node.given[None])
        if way:
            self._keep(number, simulation.copy())
        return simulation

    def _frames(self, node: Node, view: str) -> Iterator[np.ndarray]:
        """The pictures of a node, from the file."""
        height, width = self._kept[0].image_size
        size = height * width * 3
        place = node.place + list(self._kept[0].views).index(view) * len(node.states) * size
        for frame in range(len(node.states)):
            content = os.pread(self._file.fileno(), size, place + frame * size)
            yield np.frombuffer(content, np.uint8).reshape(height, width, 3)

    async def _send_block(self, frames: dict[str, np.ndarray], seconds: float, marks: list[dict[str, Any]]) -> None:
        node = self._nodes[self._current]
        count = len(node.states)
        pictures = await asyncio.to_thread(
            lambda: [jpeg_bytes(video[i], JPEG_QUALITY) for i in range(count) for video in frames.values()]
        )
        head = json.dumps({
            "type": "block", "node": self._current, "parent": node.parent, "driver": node.driver, "frames": count,
            "views": list(frames), "sizes": [len(picture) for picture in pictures], "seconds": seconds, "marks": marks,
        }).encode()  # fmt: skip
        await self._send(len(head).to_bytes(4, "little") + head + b"".join(pictures))

    async def _advance(self, name: str) -> None:
        policy, hand = self._host.config.policies.get(name), self._hand
        if policy is None or hand is None:
            raise DataError(
                "No such policy", expected=list(self._host.config.policies) or "policies in the settings", got=name
            )
        self._forget_commands()
        current = self._current
        simulation = await self._host.compute(lambda: self._reached(current))
        observation = policy.observation(simulation.pictures[0], simulation.state[0], self._row.instruction)
        size, columns = simulation.frames_per_step, simulation.state.shape[1]

        def ask() -> np.ndarray:
            if name not in self._policies:
                self._policies[name] = policy.connect()
            return self._policies[name].chunk(observation, rows=size, columns=columns)

        try:
            actions = await asyncio.to_thread(ask)
        except WorldLineError:
            if (broken := self._policies.pop(name, None)) is not None:
                await asyncio.to_thread(broken.close)
            raise
        await self._predict(actions[:size], name)
        hand.take_over(self._nodes[self._current].commands[-1])
        await self._send_marks(hand)

    async def _save(self) -> None:
        way: list[Node] = []
        number: int | None = self._current
        while number is not None:
            way.insert(0, self._nodes[number])
            number = way[0].parent
        if len(way) < 2:
            raise DataError("There is nothing to save yet", expected="a predicted block", got="the start")
        config = self._host.config
        start = self._kept[0]

        def pictures(view: str) -> Iterator[np.ndarray]:
            for node in way:
                yield from self._frames(node, view)

        shape = (sum(len(node.states) for node in way), *start.image_size, 3)
        frames = {view: MadeFrames(partial(pictures, view), shape, np.uint8) for view in start.views}
        states, commands = (np.concatenate([getattr(node, name) for node in way]) for name in ("states", "commands"))
        notes = {
            "driven_by": ", ".join(dict.fromkeys(node.driver for node in way[1:])), "model": config.model.name,
            "seed": self._seed,
        }  # fmt: skip
        path = await asyncio.to_thread(
            save_played, config.output, self._row, self._start, self._host.kinematics.get(self._row.embodiment), frames,
            states, commands, fps=start.fps, notes=notes,
        )  # fmt: skip
        await self._send(json.dumps({"type": "saved", "path": str(path), "frames": len(states)}))

    async def close(self) -> None:
        """Cancel the running block; free the session's room and the policies."""
        self._host.dismiss(self)
        if self._working is not None:
            self._working.cancel()
        for policy in self._policies.values():
            await asyncio.to_thread(policy.close)
        self._file.close()


def save_played(
    folder: Path,
    recorded: EpisodeRow,
    start: RecordedStart,
    kinematics: ArmKinematics,
    frames: Mapping[str, Frames],
    states: np.ndarray,
    commands: np.ndarray,
    *,
    fps: float,
    notes: Mapping[str, str | int],
) -> Path:
    """Write one played episode as an EpisodeSet below ``folder``, and return where.

    Args:
        frames: by view ``uint8 (n, H, W, 3)``, the observed frame first.
        states, commands: ``(n, j)``.
        notes: conventions of the episode: who drove, the model, the seed.
    """
    embodiment = kinematics.embodiment
    given = image_size(start.images, start.cameras)
    tracks = project_controls(start.cameras, given, kinematics, controls=commands, fps=fps)
    height, width = next(iter(frames.values())).shape[1:3]
    cameras = {}
    for view in start.cameras:
        v = tracks.views.index(view)
        poses = tracks.T_base_camera[:, v].astype(np.float64)
        poses[:, :3, :3] = nearest_rotation(poses[:, :3, :3])
        poses = poses[:1] if tracks.camera_motion[v] == "static" else poses
        track = CameraTrack(view, tracks.K[v].astype(np.float64), poses, given[1], given[0])
        cameras[view] = track.resized(width, height)
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S%f")[:-3]
    name = safe_stem(f"{recorded.episode_id}-played-{stamp}")
    episode = Episode(
        episode_id=name, source="worldline_play", embodiment=embodiment.name, scene=recorded.scene,
        task_family=recorded.task_family, instruction=recorded.instruction, outcome="unknown", split="test", fps=fps,
        state=states.astype(np.float32), action=commands.astype(np.float32), timestamps=np.arange(len(states)) / fps,
        cameras=cameras, state_names=embodiment.state_names, primary_view=next(iter(frames)),
        conventions={"pictures": "predicted", "started_at": recorded.episode_id, **notes},
    )  # fmt: skip
    with EpisodeSetWriter(folder / name, pixel_format="yuv444p") as writer:
        views = {view: ViewImages(pictures.__iter__, len(pictures)) for view, pictures in frames.items()}
        writer.add(episode, views)
    return folder / name
