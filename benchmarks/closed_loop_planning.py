"""Planning in closed loop against choosing once, at equal numbers of model calls, in the recorder's MuJoCo world.

    python benchmarks/closed_loop_planning.py --output FOLDER [--count 1] [--margin 0.2]

A start is a task, a body, a test scene and things on the table; an episode has 49 frames (three chunks of the causal model), 16 more
than the recordings that the models were trained on, so that a second attempt fits. Proposals are the scripted controllers of the
candidate banks with the same kinds of error: at the start whole plans; later what is left of a newly drawn plan from where the
robot is, or, while there is time for one, a new attempt at the thing where it is then (`Attempts`). What is chosen is executed in
MuJoCo, which also says how it ended.

    open           best of N by the measured judge, chosen once
    closed         N/2 candidates at each of three decisions (3 + 2 + 1 chunks predicted: as many model calls)
    random         a proposal taken blindly, once or after every chunk (`closed_random`)

FOLDER/attempts.json has every attempt. Needs the extra `sim`.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.harness import command_line
from worldline_core import Camera, WorldLine
from worldline_core.evaluation.planning.bracket import MeasuredSelector
from worldline_core.evaluation.planning.closed_loop import ClosedLoopPlanner, Plan, Situation, judged
from worldline_core.evaluation.scores import bootstrap_mean, paired_difference
from worldline_core.evaluation.segmenters.learned import LearnedSegmenter
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.recorder.attempts import BankGrid, BankSpec
from worldline_core.recorder.controllers import (
    TASK_SECONDS,
    ArmSolver,
    Waypoint,
    plan_waypoints,
    sample_waypoints,
    tool_rotation,
)
from worldline_core.recorder.looks import TEST_SCENES, look_of
from worldline_core.recorder.record import SPLIT_STREAM
from worldline_core.recorder.rendering import prepare_rendering
from worldline_core.recorder.scene import FRAME_RATE, Layout, sample_layout
from worldline_core.recorder.simulate import REACH_TOLERANCE_M, EpisodeRecorder, ExecutedMotion

SHIPPED = Path("artifacts/shipped")
SEED = 83
CHUNK, CHUNKS = 16, 3
# A new attempt is begun while this much is left of the episode [s]: the slowest task takes it.
ATTEMPT_SECONDS = 3.5
BODIES = ("viperx_graphite", "ur5e_silver", "xarm7_white", "viperx_pearl", "ur5e_slate", "xarm7_bronze")
BLIND_RUNS = 4
CANDIDATES = 12
ARMS = ("random", "closed_random", "open", "closed")


class World:
    """One episode in MuJoCo: executed so far, and what would come of more."""

    def __init__(self, recorder: EpisodeRecorder, kinematics: ArmKinematics, layout: Layout, spec: BankSpec) -> None:
        self.recorder, self.kinematics, self.layout, self.spec = recorder, kinematics, layout, spec
        first = recorder.follow([[self._first(arm)] for arm in range(len(layout.start))], 1)
        if first is None:
            raise ValueError("the start is out of reach")
        self.actions = first.astype(np.float64)

    def _first(self, arm: int) -> Waypoint:
        x, y, z, yaw, opening = self.layout.start[arm]
        return Waypoint(0.0, (x, y, z), yaw, opening)

    @property
    def frame(self) -> int:
        return len(self.actions) - 1

    def again(self) -> World:
        """The same start once more."""
        return World(self.recorder, self.kinematics, self.layout, self.spec)

    def ended(self, controls: np.ndarray) -> ExecutedMotion:
        """Returns the outcome of more controls."""
        return self.recorder.replay(self.layout, np.concatenate((self.actions, controls)).astype(np.float32))

    def execute(self, controls: np.ndarray) -> None:
        self.actions = np.concatenate((self.actions, controls))

    def layout_at(self, frame: int) -> Layout:
        """The layout with tools, and what the task moves, where they were at a frame."""
        if frame == 0:
            return self.layout
        motion = self.ended(self.actions[:0])
        target, model = self.layout.target, self.recorder.scene.model
        if target.kind in ("block", "can", "tray"):
            address = int(model.joint(f"{target.kind}_0").qposadr[0])
            x, y, _, w, _, _, z = motion.qpos[frame, address : address + 7]
            yaw = (2 * np.arctan2(z, w) + np.pi / 2) % np.pi - np.pi / 2
            target = replace(target, x=float(x), y=float(y), yaw=float(yaw))
        return replace(self.layout, start=self.tools(frame), target=target)

    def tools(self, frame: int) -> np.ndarray:
        """(arms, 5): x, y, z, yaw, opening of each arm as it was commanded."""
        command = self.actions[frame]
        poses = self.kinematics.tool_poses(command[None])[0].numpy()
        embodiment = self.kinematics.embodiment
        openings = [command[embodiment.gripper_column(arm)] for arm in embodiment.arms]
        yaws = np.arctan2(-poses[:, 0, 1], poses[:, 1, 1])
        return np.column_stack((poses[:, :3, 3], yaws, openings))

    def film(self, since: int) -> tuple[dict[str, np.ndarray], dict[str, Camera]]:
        """Pictures of the executed frames from ``since`` on, and the cameras at the first of them."""
        motion = self.ended(self.actions[:0])
        shown = replace(motion, state=motion.state[since:], action=motion.action[since:], qpos=motion.qpos[since:])
        recording = self.recorder.film(
            self.layout, shown, episode_id="planned", scene_id=self.spec.scene, split="test",
            jitter=np.random.default_rng((SEED, self.spec.layout)),
        )  # fmt: skip
        cameras = {view: Camera(c.K, c.T_base_camera[0]) for view, c in recording.episode.cameras.items()}
        return recording.frames, cameras


class Attempts:
    """Proposals: attempts of the banks' controllers that are under way, or begin now."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.solver = ArmSolver(world.recorder.scene)

    def __call__(self, situation: Situation, count: int, random: np.random.Generator) -> np.ndarray:
        now = self.world.frame
        last = CHUNK * CHUNKS - round(ATTEMPT_SECONDS * FRAME_RATE)
        begun = [frame for frame in range(now, -1, -CHUNK) if frame <= last]
        layouts = {frame: self.world.layout_at(frame) for frame in begun}
        found: list[np.ndarray] = []
        for _ in range(20 * count):
            frame = begun[len(found) % len(begun)]
            plans = plan_waypoints(self.world.recorder.scene.robot, layouts[frame], random, TASK_SECONDS)
            controls = self.follow(plans, (now - frame) / FRAME_RATE, situation.frames)
            if controls is not None:
                found.append(controls)
            if len(found) == count:
                return np.stack(found)
        raise ValueError(f"{len(found)} of {count} proposals are within reach")

    def follow(self, plans: list[list[Waypoint]], elapsed: float, frames: int) -> np.ndarray | None:
        """Controls along what is left of the waypoints, from where the arms are; None beyond their reach."""
        command, columns = self.world.actions[-1], []
        times = np.arange(1, frames + 1) / FRAME_RATE
        for arm, (points, tool) in enumerate(zip(plans, self.world.tools(self.world.frame), strict=True)):
            now = Waypoint(0.0, tuple(tool[:3]), float(tool[3]), float(tool[4]))
            left = [now, *(replace(p, time=p.time - elapsed) for p in points if p.time > elapsed)]
            positions, yaws, openings = sample_waypoints(left, times)
            embodiment = self.world.kinematics.embodiment
            joints = command[embodiment.joint_columns(embodiment.arms[arm])]
            for position, yaw, opening in zip(positions, yaws, openings, strict=True):
                joints, error = self.solver.solve(arm, joints, position, tool_rotation(yaw), 80)
                if error > REACH_TOLERANCE_M:
                    return None
                columns.append((*joints, opening))
        rows = np.array(columns).reshape(len(plans), frames, -1)
        return np.concatenate(list(rows), axis=1)


class PlanningStart:
    """One start, and what the arms make of it."""

    def __init__(self, spec: BankSpec, margin: float, model: WorldLine, selector: MeasuredSelector) -> None:
        self.spec, self.margin = spec, margin
        self.model, self.selector = model, selector
        self.kinematics = ArmKinematics(load_embodiment(spec.embodiment))

    def drawn(self, recorder: EpisodeRecorder) -> World:
        """The first initial state that all of the first proposals can reach."""
        for trial in range(20):
            entropy = (SEED, recorder.scene.robot.stream, SPLIT_STREAM["test"], self.spec.layout, trial)
            random = np.random.default_rng(entropy)
            layout = sample_layout(recorder.scene.robot, self.spec.family, random, look_of(self.spec.scene))
            try:
                world = World(recorder, self.kinematics, layout, self.spec)
                self.first_proposals(world)
            except ValueError:
                continue
            return world
        raise ValueError(f"{self.spec.name}: no start within reach in 20 draws")

    def first_proposals(self, world: World) -> np.ndarray:
        """(N, 48, J), those of `open`."""
        situation = Situation({}, world.actions[-1], CHUNK * CHUNKS, 0)
        return Attempts(world)(situation, CANDIDATES, np.random.default_rng(SEED))

    def run(self, arm: str, start: World) -> tuple[float, list[Plan]]:
        """Success (a mean where the arm is one of chance), and the plans of a planner."""
        if arm == "random":
            outcomes = [start.ended(controls).outcome == "success" for controls in self.first_proposals(start)]
            return float(np.mean(outcomes)), []
        if arm == "closed_random":
            runs = [self.blindly(start.again(), np.random.default_rng((SEED, run))) for run in range(BLIND_RUNS)]
            return float(np.mean(runs)), []
        return self.planned(start.again(), once=arm == "open")

    def blindly(self, world: World, random: np.random.Generator) -> bool:
        """Success of a blind choice after every chunk, among as many candidates as the planner has."""
        kept = np.empty((0, CHUNK * CHUNKS, len(world.actions[0])))
        for chunk in range(CHUNKS):
            situation = Situation({}, world.actions[-1], CHUNK * (CHUNKS - chunk), world.frame)
            fresh = Attempts(world)(situation, CANDIDATES // 2 - len(kept), random)
            chosen = random.choice(np.concatenate((kept, fresh)))
            world.execute(chosen[:CHUNK])
            kept = chosen[None, CHUNK:]
        return world.ended(world.actions[:0]).outcome == "success"

    def planned(self, world: World, *, once: bool) -> tuple[float, list[Plan]]:
        """Success of a planner's choices, and its plans."""
        frames, cameras = world.film(0)
        planner = ClosedLoopPlanner(
            self.model, {view: cameras[view] for view in self.model.views}, embodiment=self.kinematics,
            instruction=world.layout.instruction, propose=Attempts(world), score=judged(self.selector),
            candidates=CANDIDATES if once else CANDIDATES // 2, seed=SEED, margin=self.margin,
        )  # fmt: skip
        plans: list[Plan] = []
        while world.frame < CHUNK * CHUNKS:
            seen = {view: frames[view] for view in self.model.views}
            left = CHUNKS - world.frame // CHUNK
            plans.append(planner.plan(seen, world.actions[-1], horizon=left))
            world.execute(plans[-1].sequence if once else plans[-1].controls)
            if world.frame < CHUNK * CHUNKS:
                frames, _ = world.film(world.frame - CHUNK + 1)
        return float(world.ended(world.actions[:0]).outcome == "success"), plans


def table(attempts: list[dict]) -> dict:
    """Success by arm and by task, and differences to choosing once on the starts of both; 95 % bootstrap intervals over starts."""
    by_arm: dict[str, dict[str, float]] = {}
    for attempt in attempts:
        by_arm.setdefault(attempt["arm"], {})[attempt["start"]] = attempt["success"]
    tasks = {attempt["start"]: attempt["task"] for attempt in attempts}

    def shown(found) -> str | None:
        return found and f"{found.mean:.3f} ({found.low:.3f} to {found.high:.3f}), {found.count} starts"

    return {
        arm: {
            "success": shown(bootstrap_mean(list(values.values()))),
            "minus_open": shown(paired_difference(values, by_arm.get("open", {}))),
            "by_task": {
                task: round(float(np.mean([v for name, v in values.items() if tasks[name] == task])), 3)
                for task in sorted({tasks[name] for name in values})
            },
        }
        for arm, values in by_arm.items()
    }


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--count", type=int, default=1, help="starts of every task with every body")
    parser.add_argument("--margin", type=float, default=0.0, help="of the planner")
    options = parser.parse_args()
    torch.set_num_threads(1)
    prepare_rendering()
    options.output.mkdir(parents=True, exist_ok=True)
    families = ("lift", "place", "close", "press", "carry")
    grid = BankGrid(embodiments=BODIES, families=families, scenes=TEST_SCENES, count=options.count)
    model = WorldLine.from_pretrained(SHIPPED / "models" / "causal")
    selector = MeasuredSelector(LearnedSegmenter.load(SHIPPED / "models" / "segmenter"))
    attempts: list[dict] = []
    for spec in grid.specs():
        recorder = EpisodeRecorder(spec.embodiment)
        start = PlanningStart(spec, options.margin, model, selector)
        world = start.drawn(recorder)
        for arm in ARMS:
            success, plans = start.run(arm, world)
            attempts.append({"start": spec.name, "task": spec.family, "arm": arm, "success": success})
            attempts[-1]["scores"] = [plan.score for plan in plans]
        recorder.close()
        (options.output / "attempts.json").write_text(json.dumps(attempts, indent=1))
    print(json.dumps(table(attempts), indent=1))


if __name__ == "__main__":
    main()
