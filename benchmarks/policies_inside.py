"""Does success inside the simulator say which policy is better? The same policies, from the same starts, in MuJoCo and inside.

    python benchmarks/policies_inside.py --recordings recordings/drawer_starts --output FOLDER \
        --policies act/checkpoints/*/pretrained_model

Learned policies are folders of LeRobot checkpoints; they act in closed loop in both worlds, on what they see there. The scripted
policies that recorded the starts look at nothing: how they ended is recorded, and the simulator is given their commands. In
MuJoCo success is read from the simulated things, inside the measured judge says it of the predicted video. Pictures are equally rare
in both. Each finished attempt is
a line of FOLDER/attempts.jsonl; the same command goes on where it was stopped, and prints the table. Needs the extra `sim`, and
LeRobot for learned policies.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from itertools import batched
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.environment.environment import WorldLineVectorEnv
from worldline_core.environment.mujoco_world import MujocoEnv
from worldline_core.evaluation.policy.agreement import STATISTICS, policy_agreement

FRAMES = 32
RESAMPLES = 2000

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


def attempt(env: VectorEnv, numbers: Sequence[int], act: Act) -> list[bool]:
    """Whether each episode, from the start of that number, ends in success."""
    seeds: Any = [int(number) for number in numbers]  # a seed for each; the base class's annotation knows of one
    observed, _ = env.reset(seed=seeds)
    ended = np.zeros(len(numbers), dtype=bool)
    for _ in range(FRAMES):
        observed, _, ended, _, _ = env.step(act(observed))
    return [bool(success) for success in ended]


class Starts:
    """The starts of recordings, in the order of the environments, and what each recorded policy did at them."""

    def __init__(self, recordings: Path, env: MujocoEnv, count: int | None) -> None:
        self.episodes = EpisodeSet.open(recordings)
        total = len(env.starts)
        rows = [env.starts.row(number) for number in range(total if count is None else min(count, total))]
        self.names = [row.bank or row.episode_id for row in rows]
        self.recorded: dict[str, dict[str, int]] = {}
        for position, row in enumerate(self.episodes.rows):
            if row.bank in self.names:
                self.recorded.setdefault(row.source, {})[row.bank] = position

    def commands(self, policy: str, numbers: Sequence[int]) -> Act:
        """What a recorded policy commanded at these starts, whatever it is shown."""
        positions = [self.recorded[policy][self.names[number]] for number in numbers]
        rows = iter(
            np.stack([self.episodes.episode(position).action[1 : FRAMES + 1] for position in positions], axis=1)
        )
        return lambda _: next(rows)

    def succeeded(self, policy: str, number: int) -> bool:
        return self.episodes.rows[self.recorded[policy][self.names[number]]].outcome == "success"


def attempts_of(
    name: str, learned: LearnedPolicy | None, starts: Starts, physics: VectorEnv, inside: VectorEnv, missing: list[int]
) -> Iterator[dict[str, Any]]:
    """One policy at the starts that are missing, as many at a time as the simulator holds."""
    for numbers in batched(missing, inside.num_envs):
        # A batch has one size: the last one is filled up with starts that are tried twice.
        filled = [*numbers, *([numbers[0]] * (inside.num_envs - len(numbers)))]
        act = starts.commands(name, filled) if learned is None else learned.begin()
        predicted = attempt(inside, filled, act)
        for number, success in zip(numbers, predicted, strict=False):
            real = starts.succeeded(name, number) if learned is None else attempt(physics, [number], learned.begin())[0]
            yield {
                "policy": name,
                "learned": learned is not None,
                "start": starts.names[number],
                "mujoco": real,
                "simulator": success,
            }


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


def printed(found: dict[str, Any]) -> str:
    """The table as Markdown."""
    lines: list[str] = []
    if "all" in found:
        lines += ["| policy | starts | MuJoCo | inside |", "|---|---|---|---|"]
        for name, rates in found["all"]["policies"].items():
            lines.append(f"| {name} | {rates['attempts']} | {rates['recorded']:.2f} | {rates['predicted']:.2f} |")
    lines += ["", f"| policies | {' | '.join(STATISTICS)} | attempts with the same end |", "|---|---|---|---|---|---|"]
    for kind, facts in found.items():
        cells = [f"{kind} ({len(facts['policies'])})"]
        for statistic in STATISTICS:
            value, bounds = facts[statistic]["value"], facts[statistic]["over_starts_and_policies"]
            cells.append(
                "undefined" if None in (value, bounds) else f"{value:.3f} ({bounds[0]:.3f} to {bounds[1]:.3f})"
            )
        lines.append(f"| {' | '.join(cells)} | {facts['same_end']:.2f} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--recordings", type=Path, required=True, help="of one robot, by `worldline record` with policies"
    )
    parser.add_argument("--embodiment", help="of the starts, where recordings are of several robots")
    parser.add_argument("--policies", type=Path, nargs="*", default=[], help="folders of LeRobot checkpoints")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--model", type=Path, help="Stage II or causal checkpoint; by default the shipped causal one")
    parser.add_argument("--observe-every", type=int, help="steps between two predicted pictures; by default the block")
    parser.add_argument("--starts", type=int, help="only so many, the first ones")
    parser.add_argument("--batch", type=int, default=8)
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.output.mkdir(parents=True, exist_ok=True)
    path = options.output / "attempts.jsonl"
    attempts = [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []
    inside = WorldLineVectorEnv(
        options.batch, model=options.model, recordings=options.recordings, embodiment=options.embodiment,
        episode_frames=FRAMES, observe_every=options.observe_every, autoreset_mode=AutoresetMode.DISABLED,
    )  # fmt: skip
    world = MujocoEnv(
        options.recordings,
        embodiment=options.embodiment,
        image_size=inside.world.image_size,
        episode_frames=FRAMES,
        observe_every=inside.observe_every,
    )
    physics = SyncVectorEnv([lambda: world], autoreset_mode=AutoresetMode.DISABLED)
    starts = Starts(options.recordings, world, options.starts)
    policies: dict[str, LearnedPolicy | None] = {one.name: one for one in map(LearnedPolicy, options.policies)}
    policies |= dict.fromkeys(starts.recorded)
    for name, learned in policies.items():
        done = {a["start"] for a in attempts if a["policy"] == name}
        missing = [number for number, start in enumerate(starts.names) if start not in done]
        for one in attempts_of(name, learned, starts, physics, inside, missing):
            attempts.append(one)
            with path.open("a") as file:
                file.write(json.dumps(one) + "\n")
    physics.close()
    found = table(attempts)
    (options.output / "table.json").write_text(json.dumps(found, indent=1))
    print(printed(found))


if __name__ == "__main__":
    main()
