"""Speed of the shipped causal model in this tree beside others, in turns, and how alike their pictures are.

    git worktree add ../before COMMIT
    python benchmarks/speed.py ../before [--turns 3] [--blocks 8] [--threads 1]

Each tree computes in a process of its own with its own code and the same weights. Kinds: a block of `worldline play` (inverse
kinematics, pictures and JPEG with it; commands come at the model's rate, and its wall time is from the last command of a block to its
pictures), a step of `worldline serve`, a block of a rollout, and a step of eight Gymnasium environments. Ratios are of processor and wall
time, a median and the range of the turns. Pictures are compared over two blocks, where a
rollout begins anew at its own picture.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Awaitable
from pathlib import Path
from typing import Any

import numpy as np

AS_COMMANDS = {
    "MALLOC_MMAP_MAX_": "0",
    "MALLOC_TRIM_THRESHOLD_": str(2**31 - 1),
    "MALLOC_ARENA_MAX": "1",
    "OMP_WAIT_POLICY": "PASSIVE",
}
"""Environment that the command `worldline` sets up."""
ROBOT, EPISODE, ENVIRONMENTS = "ur5e_silver", "ur5e_silver-test-s1-00000", 8


class Tree:
    """The model of one tree; only names are used that every tree has."""

    waited: float
    """Seconds between the last commands of blocks and their pictures, of the last `play`."""

    def __init__(self) -> None:
        from worldline_core.environment.environment import WorldLineVectorEnv
        from worldline_core.rollout.worldline import WorldLine
        from worldline_core.serving.play_session import PlaySession
        from worldline_core.serving.serve_config import ServeConfig
        from worldline_core.serving.session_host import SessionHost

        self.world = WorldLine.from_pretrained(Path("artifacts/shipped/models/causal"))
        self.host = SessionHost(self.world, ServeConfig.model_validate({}))
        self.block = self.world.frames_per_unit
        self.page, self.environment = PlaySession, WorldLineVectorEnv
        self.loop = asyncio.new_event_loop()

    def play(self, blocks: int) -> int:
        """Blocks driven by hand, with ticks at the model's rate, until the block's pictures are sent."""
        self.waited = 0.0

        async def driven() -> None:
            sent: asyncio.Queue[str | bytes] = asyncio.Queue()

            async def send(message: str | bytes) -> None:
                if isinstance(message, bytes) or json.loads(message)["type"] == "error":
                    await sent.put(message)

            async def pictures() -> None:
                if isinstance(message := await sent.get(), str):
                    raise RuntimeError(message)

            page = self.page(self.host, send)
            await page.receive(json.dumps({"type": "start", "episode": EPISODE}))
            await pictures()
            for number in range(blocks):
                tick = json.dumps({"type": "tick", "arms": [{"move": [0.1 * (-1) ** number, 0, 0]}] * 2})
                begin = 0.0
                for _ in range(self.block):
                    await asyncio.sleep(1 / self.world.contract.fps)
                    begin = time.perf_counter()
                    await page.receive(tick)
                await pictures()
                self.waited += time.perf_counter() - begin
            await page.close()

        self._run(driven())
        return blocks

    def serve(self, blocks: int) -> int:
        """Steps of a session of one clip."""
        self.pictures(blocks)
        return blocks

    def pictures(self, blocks: int) -> list[np.ndarray]:
        """Videos of every step and view."""
        random = np.random.default_rng(0)
        reply = self._asked(op="start", episode=EPISODE, seeds=[0])
        session, videos = reply["session"], []
        for _ in range(blocks):
            wanted = reply["states"][:, -1:] + random.normal(0, 0.02, (1, self.block, reply["states"].shape[2]))
            reply = self._asked(op="step", session=session, controls=wanted)
            videos += [reply["frames"][view] for view in sorted(reply["frames"])]
        self._asked(op="close", session=session)
        return videos

    def rollout(self, blocks: int) -> int:
        """One whole prediction under controls that are known."""
        starts: Any = self.host.starts
        start = starts.at(EPISODE) if hasattr(starts, "at") else starts.read(EPISODE)
        state = start.state if hasattr(start, "state") else start.episode.action[0]
        rows = state + np.cumsum(
            np.random.default_rng(0).normal(0, 0.005, (1 + blocks * self.block, len(state))), axis=0
        )
        rows = np.clip(rows, state - 0.05, state + 0.05)
        self.world.predict(start.images, rows, start.cameras, embodiment=ROBOT, seed=0)
        return blocks

    def environments(self, blocks: int) -> int:
        """Steps of all environments together."""
        if not hasattr(self, "_env"):
            self._env: Any = self.environment(
                ENVIRONMENTS, model=self.world, embodiment=ROBOT, success=None, episode_frames=2 * self.block
            )
        env = self._env
        for _ in range(-(-blocks // 4)):
            observed, _ = env.reset(seed=0)
            for _ in range(2 * self.block):
                observed = env.step(observed["agent_pos"].astype(np.float32))[0]
        return -(-blocks // 4) * 2 * self.block * ENVIRONMENTS

    def _asked(self, **message: Any) -> dict[str, Any]:
        reply = self._run(self.host.handle(self, message))
        if "error" in reply:
            raise RuntimeError(reply["error"])
        return reply

    def _run[T](self, work: Awaitable[T]) -> T:
        return self.loop.run_until_complete(work)


KINDS = ("play", "serve", "rollout", "environments")


def work(threads: int) -> None:
    """Answer the requests of the parent: a kind and a number of blocks; or a file for pictures."""
    import torch

    torch.set_num_threads(threads)
    tree = Tree()
    for kind in KINDS:
        getattr(tree, kind)(1)
    print("ready", flush=True)
    for line in sys.stdin:
        kind, value = line.split()
        if kind == "pictures":
            np.savez(value, *tree.pictures(2))
            print("{}", flush=True)
            continue
        processor, wall = time.process_time(), time.perf_counter()
        done = getattr(tree, kind)(int(value))
        seconds = tree.waited if kind == "play" else time.perf_counter() - wall
        print(json.dumps([(time.process_time() - processor) / done, seconds / done]), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trees", type=Path, nargs="*", help="folders of other commits")
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--blocks", type=int, default=8)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work:
        work(options.threads)
        return
    trees = [*(tree.resolve() for tree in options.trees), Path(__file__).resolve().parents[1]]
    command = [sys.executable, __file__, "--work", "--threads", str(options.threads)]
    processes = [
        subprocess.Popen(command, cwd=tree, env=os.environ | AS_COMMANDS | {"PYTHONPATH": str(tree)}, text=True,
                         stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        for tree in trees
    ]  # fmt: skip

    def answer(process: subprocess.Popen[str], request: str | None) -> str:
        given, reply = process.stdin, process.stdout
        if given is None or reply is None:
            raise RuntimeError("the process has no pipes")
        if request is not None:
            print(request, file=given, flush=True)
        return reply.readline()

    for process in processes:
        answer(process, None)
    for kind in KINDS:
        turns = np.array(
            [[json.loads(answer(each, f"{kind} {options.blocks}")) for each in processes] for _ in range(options.turns)]
        )
        for tree, times in zip(trees, turns.transpose(1, 0, 2), strict=True):
            ratios = times / turns[:, -1]
            text = (
                f"{name} x {np.median(r):.2f} ({r.min():.2f}-{r.max():.2f})"
                for name, r in zip(("processor", "wall"), ratios.T, strict=True)
            )
            print(
                f"{kind:13s}{tree.name:12s}{1e3 * np.median(times[:, 0]):8.1f} ms, {', '.join(text)}",
                flush=True,
            )
    with tempfile.TemporaryDirectory() as folder:
        found = []
        for number, process in enumerate(processes):
            answer(process, f"pictures {folder}/{number}.npz")
            with np.load(f"{folder}/{number}.npz") as file:
                found.append([file[name].astype(float) for name in file.files])
    for tree, videos in zip(trees, found, strict=True):
        errors = [float(np.mean((a - b) ** 2)) for a, b in zip(videos, found[-1], strict=True)]
        print(
            f"{tree.name}: PSNR {10 * np.log10(255**2 / max(np.mean(errors), 1e-9)):.1f} dB, worst video {10 * np.log10(255**2 / max(*errors, 1e-9)):.1f} dB"
        )
    for process in processes:
        process.kill()


if __name__ == "__main__":
    main()
