"""Search for a better controller inside the simulator, and see in MuJoCo whether it is better.

A scripted controller misses because its aim is off. The cross-entropy method (CEM) looks for the shift of its tool, (x, y, z) in the
base frame, with the largest mean soft score of the judge over some starts, inside; success is then counted in MuJoCo, at other
starts. The same search in MuJoCo, by true success, tells how many physical episodes it would take there.

Needs the extras `sim` and `gym`, and recordings of the controller:
    worldline record --config configs/recording/biased_controllers.yaml --output recordings/biased
    python examples/practice_inside.py --recordings recordings/biased --task close --seed 0
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from worldline_core import WorldLine
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.environment.environment import WorldLineVectorEnv
from worldline_core.environment.mujoco_world import MujocoEnv
from worldline_core.errors import DataError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics, InverseKinematics

FRAMES = 32
REACH_FRAMES = 6
"""The shift grows to its full size over this many commands: the arms begin where they stand."""
ELITES = 4
FIRST_DEVIATION_M = (0.04, 0.04, 0.01)
LEAST_DEVIATION_M = 0.003


class ShiftedController:
    """The recorded commands of a controller at its starts, with the tools of all arms shifted."""

    def __init__(self, recordings: Path, policy: str, task: str, embodiment: str) -> None:
        episodes = EpisodeSet.open(recordings)
        self.commands = {
            row.episode_id: episodes.episode(position).action[: FRAMES + 1].astype(np.float64)
            for position, row in enumerate(episodes.rows)
            if (row.source, row.embodiment) == (policy, embodiment) and f"_{task}_" in (row.bank or "")
        }
        if not self.commands:
            raise DataError(
                "No attempts of this controller", where=recordings, expected=f"a policy {policy} at starts of {task}",
                got=sorted({f"{row.source} at {row.bank}" for row in episodes.rows})[:3],
                next_step="choose --task, --policy and --embodiment among those recorded",
            )  # fmt: skip
        self._kinematics = ArmKinematics(load_embodiment(embodiment))
        self._solver = InverseKinematics(self._kinematics)
        robot = self._kinematics.embodiment
        self._grippers = [robot.gripper_column(arm) for arm in robot.arms]

    def shifted(self, start: str, shift_m: np.ndarray) -> np.ndarray:
        """Commands (frames, j) after the first picture."""
        commands = self.commands[start]
        tools = self._kinematics.tool_poses(commands).numpy()
        tools[:, :, :3, 3] += np.minimum(np.arange(len(tools)) / REACH_FRAMES, 1.0)[:, None, None] * shift_m
        moved = commands.copy()
        for number, wanted in enumerate(tools[1:], start=1):
            start_state = moved[number - 1].copy()
            start_state[self._grippers] = commands[number, self._grippers]
            moved[number] = self._solver.solve(start_state, wanted).state
        return moved[1:]


Try = Callable[[Sequence[tuple[str, np.ndarray]]], list[float]]
"""Scores of attempts, each a start and the commands that are given there."""


def inside(recordings: Path, embodiment: str, model: Path | None, members: Sequence[Path], batch: int) -> Try:
    """The judge's soft score of predicted videos, with further models, in one step each, the lowest of all."""
    others = [WorldLine.from_pretrained(folder, steps=1) for folder in members]
    env = WorldLineVectorEnv(
        batch, model=model, members=others, recordings=recordings, embodiment=embodiment, episode_frames=FRAMES, success=None,
        reward="soft", autoreset=False,
    )  # fmt: skip

    def scores(attempts: Sequence[tuple[str, np.ndarray]]) -> list[float]:
        found: list[float] = []
        for first in range(0, len(attempts), batch):
            some = list(attempts[first : first + batch])
            filled = some + [some[-1]] * (batch - len(some))
            _, infos = env.reset(seed=[0] * batch, options={"start": [start for start, _ in filled]})
            for commands in np.stack([commands for _, commands in filled], axis=1):
                _, _, _, _, infos = env.step(commands)
            found += infos["score"][: len(some)].tolist()
        return found

    return scores


def physics(recordings: Path, embodiment: str) -> Try:
    """1 for a success in MuJoCo, else 0."""
    env = MujocoEnv(recordings, embodiment=embodiment, episode_frames=FRAMES, observe_every=FRAMES, views=["head"])

    def successes(attempts: Sequence[tuple[str, np.ndarray]]) -> list[float]:
        found = []
        for start, commands in attempts:
            env.reset(options={"start": start})
            success = False
            for command in commands:
                _, _, success, _, _ = env.step(command)
            found.append(float(success))
        return found

    return successes


def cross_entropy(
    controller: ShiftedController, starts: Sequence[str], attempt: Try, *, rounds: int, population: int, seed: int
) -> list[np.ndarray]:
    """The mean of the search after every round; the best quarter is what the next round is drawn from."""
    random = np.random.default_rng(seed)
    mean, deviation, means = np.zeros(3), np.array(FIRST_DEVIATION_M), []
    for _ in range(rounds):
        shifts = mean + deviation * random.standard_normal((population, 3))
        attempts = [(start, controller.shifted(start, shift)) for shift in shifts for start in starts]
        scores = np.reshape(attempt(attempts), (population, len(starts))).mean(axis=1)
        # Equal scores, as those of true success often are, are ranked by chance.
        elites = shifts[np.lexsort((random.random(population), -scores))[:ELITES]]
        mean, deviation = elites.mean(axis=0), np.maximum(elites.std(axis=0), LEAST_DEVIATION_M)
        means.append(mean)
        print(
            f"score {scores.mean():.2f}, best {scores.max():.2f}, shift {np.round(1000 * mean).tolist()} mm", flush=True
        )
    return means


def main() -> None:
    """Search in both worlds, and print what each round's controller does in MuJoCo at held-out starts, as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=Path, required=True)
    parser.add_argument("--task", required=True, help="close, press, lift or place")
    parser.add_argument("--policy", default="biased")
    parser.add_argument("--embodiment", default="ur5e_silver")
    parser.add_argument("--model", type=Path, help="a causal or Stage II checkpoint; by default the shipped causal one")
    parser.add_argument(
        "--members", type=Path, nargs="*", default=[], help="further models: the lowest soft score counts"
    )
    parser.add_argument("--starts", type=int, default=6, help="starts of the search; the others are held out")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--population", type=int, default=16)
    parser.add_argument("--batch", type=int, default=16, help="episodes side by side inside")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    controller = ShiftedController(options.recordings, options.policy, options.task, options.embodiment)
    names = sorted(controller.commands)
    order = np.random.default_rng([options.seed, 1]).permutation(len(names))
    practised, held_out = ([names[n] for n in part] for part in (order[: options.starts], order[options.starts :]))
    outside = physics(options.recordings, options.embodiment)

    def success(shift: np.ndarray) -> float:
        return float(np.mean(outside([(start, controller.shifted(start, shift)) for start in held_out])))

    found = {"task": options.task, "seed": options.seed, "held_out": len(held_out), "before": success(np.zeros(3))}
    simulator = inside(options.recordings, options.embodiment, options.model, options.members, options.batch)
    worlds = {"inside": simulator, "mujoco": outside}
    for world, attempt in worlds.items():
        print(world, flush=True)
        means = cross_entropy(
            controller, practised, attempt, rounds=options.rounds, population=options.population, seed=options.seed
        )
        found[world] = {
            "episodes": [options.population * options.starts * (number + 1) for number in range(options.rounds)],
            "success_in_mujoco": [success(mean) for mean in means],
            "shift_m": [np.round(mean, 4).tolist() for mean in means],
        }
    print(json.dumps(found))


if __name__ == "__main__":
    main()
