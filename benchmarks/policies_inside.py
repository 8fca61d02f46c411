"""Does success inside the simulator say which policy is better? The same policies, from the same starts, in MuJoCo and inside.

    python benchmarks/policies_inside.py --recordings recordings/drawer_starts --output FOLDER \
        --policies act/checkpoints/*/pretrained_model

Learned policies are folders of LeRobot checkpoints; they act in closed loop in both worlds, on what they see there. The scripted
policies that recorded the starts look at nothing: how they ended is recorded, and the simulator is given their commands. In
MuJoCo success is read from the simulated things, inside the measured judge says it of the predicted video. Pictures are equally rare
in both.

Why both differ is measured step by step: the judge says it of the true video (`judged`: what differs is the judge's), of what the
simulator predicts from the very commands that were given in MuJoCo (`same_commands`: the model's), and of what it predicts while
the policy acts on its pictures (`simulator`: the closed loop's). `target` is where the thing that is to be moved was in the end.

Each finished attempt is a line of FOLDER/attempts.jsonl; the same command goes on where it was stopped, and prints rates, causes and agreement as JSON.
Needs the extra `sim`, and LeRobot for learned policies.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from itertools import batched
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv

from benchmarks.harness import command_line
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.environment.environment import MeasuredSuccess, WorldLineVectorEnv
from worldline_core.environment.mujoco_world import MujocoEnv
from worldline_core.evaluation.paired import paired_tests
from worldline_core.evaluation.policy.evaluate_policy import policy_agreement
from worldline_core.evaluation.recordings import Trajectory
from worldline_core.model.tokenizers import resize_frame

FRAMES = 32
RESAMPLES = 2000
WORLDS = ("mujoco", "judged", "same_commands", "simulator")
"""From what happens to what is predicted: each adds one cause to the one before it."""
CAUSES = ("the judge", "the model", "the closed loop")

Act = Callable[[dict[str, Any]], np.ndarray]
"""Commands ``(b, j)`` for an observation of a batch of episodes."""


class LearnedPolicy:
    """A checkpoint of LeRobot, with its own normalisation; ``begin`` forgets what was planned."""

    def __init__(self, folder: Path) -> None:
        from lerobot.configs.policies import PreTrainedConfig
        from lerobot.envs.utils import preprocess_observation
        from lerobot.policies.factory import get_policy_class, make_pre_post_processors

        config = PreTrainedConfig.from_pretrained(folder)
        config.device = "cpu"
        self.name = f"{config.type}_{folder.parent.name if folder.name == 'pretrained_model' else folder.name}"
        self._policy = get_policy_class(config.type).from_pretrained(folder, config=config).eval()
        self._before, self._after = make_pre_post_processors(
            config, pretrained_path=str(folder), preprocessor_overrides={"device_processor": {"device": "cpu"}}
        )
        self._tensors = preprocess_observation

    def begin(self) -> Act:
        self._policy.reset()
        return self._act

    @torch.no_grad()
    def _act(self, observed: dict[str, Any]) -> np.ndarray:
        batch = self._before(self._tensors(observed) | {"task": [""] * len(observed["agent_pos"])})
        return self._after(self._policy.select_action(batch)).numpy()


class Attempts(NamedTuple):
    """A batch that has ended: success of each, its commands ``(b, n, j)``, and pictures by view ``(b, n + 1, H, W, 3)``."""

    success: list[bool]
    commands: np.ndarray
    pictures: dict[str, np.ndarray]


def attempt(env: VectorEnv, numbers: Sequence[int], act: Act, *, hold: int = 1) -> Attempts:
    """Episodes from the starts of these numbers; the policy is shown new pictures every ``hold`` steps."""
    seeds: Any = [int(number) for number in numbers]  # a seed for each; the base class's annotation knows of one
    observed, _ = env.reset(seed=seeds)
    ended = np.zeros(len(numbers), dtype=bool)
    seen, commands = [observed["pixels"]], []
    for step in range(FRAMES):
        shown = seen[step - step % hold]
        commands.append(np.array(act({**observed, "pixels": shown})))
        observed, _, ended, _, _ = env.step(commands[-1])
        seen.append(observed["pixels"])
    pictures = {view: np.stack([one[view] for one in seen], axis=1) for view in seen[0]}
    return Attempts([bool(success) for success in ended], np.stack(commands, axis=1), pictures)


def replay(commands: np.ndarray) -> Act:
    """The given commands ``(b, n, j)``, whatever is seen."""
    rows = iter(np.moveaxis(commands, 1, 0))
    return lambda _: next(rows)


class Starts:
    """The starts of recordings, in the order of the environments, and what each recorded policy did at them."""

    def __init__(self, recordings: Path, env: MujocoEnv, count: int | None) -> None:
        self.episodes = EpisodeSet.open(recordings)
        self.names = [row.bank or row.episode_id for row in env.starts.rows[:count]]
        self.recorded: dict[str, dict[str, int]] = {}
        for position, row in enumerate(self.episodes.rows):
            if row.bank in self.names:
                self.recorded.setdefault(row.source, {})[row.bank] = position

    def attempts(self, policy: str, number: int, size: tuple[int, int]) -> Attempts:
        """Rollout of a recorded policy from a start, with pictures of a size (H, W)."""
        position = self.recorded[policy][self.names[number]]
        row = self.episodes.rows[position]
        videos: dict[str, np.ndarray] = {}
        for view in row.views:
            frames = self.episodes.frames(position, view, range(FRAMES + 1))
            videos[view] = np.empty((1, len(frames), *size, 3), np.uint8)
            for frame, out in zip(frames, videos[view][0], strict=True):
                resize_frame(frame, size, out=out)
        commands = self.episodes.episode(position).action[1 : FRAMES + 1]
        return Attempts([row.outcome == "success"], commands[None], videos)


class Worlds:
    """Both worlds at the same starts, and the judge."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.inside = WorldLineVectorEnv(
            options.batch, model=options.model, recordings=options.recordings, embodiment=options.embodiment,
            episode_frames=FRAMES, observe_every=options.observe_every, autoreset=False,
            steps=options.steps,
        )  # fmt: skip
        self.size = self.inside.world.image_size
        world = MujocoEnv(
            options.recordings, embodiment=options.embodiment, image_size=self.size, episode_frames=FRAMES
        )
        self.physics = SyncVectorEnv([lambda: world], autoreset_mode=AutoresetMode.DISABLED)
        self.starts = Starts(options.recordings, world, options.starts)
        self._target, self._instruction = world.target, lambda number: world.starts[number].instruction
        self._judge = MeasuredSuccess()

    def attempts(self, name: str, learned: LearnedPolicy | None, missing: list[int]) -> Iterator[dict[str, Any]]:
        """One policy at the starts that are missing, as many at a time as the simulator holds."""
        for numbers in batched(missing, self.inside.num_envs):
            rows = [self._real(name, learned, number) for number in numbers]
            # A batch has one size: the last one is filled up with starts that are tried twice.
            more = self.inside.num_envs - len(numbers)
            filled = [*numbers, *([numbers[0]] * more)]
            commands = np.concatenate([attempts.commands for attempts, _ in [*rows, *([rows[0]] * more)]])
            same = predicted = attempt(self.inside, filled, replay(commands)).success
            if learned is not None:
                predicted = attempt(self.inside, filled, learned.begin()).success
            for (_, row), one, other in zip(rows, same, predicted, strict=False):
                yield {**row, "same_commands": one, "simulator": other}

    def _real(self, name: str, learned: LearnedPolicy | None, number: int) -> tuple[Attempts, dict[str, Any]]:
        """An attempt in MuJoCo, recorded or made now, and what the judge says of its video."""
        if learned is None:
            found, target = self.starts.attempts(name, number, self.size), None
        else:
            found = attempt(self.physics, [number], learned.begin(), hold=self.inside.observe_every)
            target = self._target().tolist()
        video = {view: pictures[0] for view, pictures in found.pictures.items() if view in self.inside.views}
        seen = self._judge(Trajectory(self._instruction(number), video, self.inside.world.contract.fps))
        return found, {
            "policy": name, "learned": learned is not None, "start": self.starts.names[number],
            "mujoco": found.success[0], "judged": bool(seen), "target": target,
        }  # fmt: skip


def table(attempts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Rates of each policy in both worlds, and how they agree over learned, scripted and all policies."""
    ends = ("failure", "success")
    rows = [
        {
            "method": "simulator", "policy": a["policy"], "start": a["start"], "task": "all", "episode_id": a["start"],
            "outcome": ends[a["mujoco"]], "predicted": ends[a["simulator"]], "learned": a["learned"],
        }
        for a in attempts
    ]  # fmt: skip
    kinds = {"learned": (True,), "scripted": (False,), "all": (True, False)}
    found: dict[str, Any] = {}
    for kind, wanted in kinds.items():
        chosen = [row for row in rows if row["learned"] in wanted]
        if len({row["policy"] for row in chosen}) > 2:
            found[kind] = policy_agreement(chosen, resamples=RESAMPLES, seed=0)["simulator"]["all"]
            found[kind]["same_end"] = float(np.mean([row["outcome"] == row["predicted"] for row in chosen]))
    return found


def causes(attempts: Sequence[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Contribution of each cause to the rate of success: its mean, and its interval over starts, by kind of policy."""
    found: dict[str, dict[str, Any]] = {}
    for kind, learned in (("learned", True), ("scripted", False)):
        chosen = [a for a in attempts if a["learned"] == learned]
        starts = sorted({a["start"] for a in chosen})
        series = {
            cause: {
                start: float(np.mean([a[after] - a[before] for a in chosen if a["start"] == start])) for start in starts
            }
            for cause, before, after in zip(CAUSES, WORLDS, WORLDS[1:], strict=False)
        }
        tests = paired_tests(series)
        found[kind] = {cause: [test.mean, test.low, test.high] for cause, test in tests.items()}
    return {kind: parts for kind, parts in found.items() if parts}


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument(
        "--recordings", type=Path, required=True, help="of one robot, by `worldline record` with policies"
    )
    parser.add_argument("--embodiment", help="of the starts, where recordings are of several robots")
    parser.add_argument("--starts", type=int, help="only so many, the first ones")
    parser.add_argument("--policies", type=Path, nargs="*", default=[], help="folders of LeRobot checkpoints")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--model", type=Path, help="Stage II or causal checkpoint; by default the shipped causal one")
    parser.add_argument("--steps", type=int, help="Euler steps of the model; by default its own")
    parser.add_argument("--observe-every", type=int, help="steps between two predicted pictures; by default the block")
    parser.add_argument("--batch", type=int, default=8)
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.output.mkdir(parents=True, exist_ok=True)
    path = options.output / "attempts.jsonl"
    attempts = [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []
    worlds = Worlds(options)
    starts = worlds.starts
    policies: dict[str, LearnedPolicy | None] = {one.name: one for one in map(LearnedPolicy, options.policies)}
    policies |= dict.fromkeys(starts.recorded)
    for name, learned in policies.items():
        done = {a["start"] for a in attempts if a["policy"] == name}
        missing = [number for number, start in enumerate(starts.names) if start not in done]
        for one in worlds.attempts(name, learned, missing):
            attempts.append(one)
            with path.open("a") as file:
                file.write(json.dumps(one) + "\n")
    worlds.physics.close()
    rates = {
        name: {world: float(np.mean([a[world] for a in attempts if a["policy"] == name])) for world in WORLDS}
        for name in policies
    }
    print(json.dumps({"rates": rates, "causes": causes(attempts), "agreement": table(attempts)}, indent=1))


if __name__ == "__main__":
    main()
