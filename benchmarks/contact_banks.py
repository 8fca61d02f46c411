"""Contact tasks: how often drawn plans succeed, and what choices without video make of banks of them (no filming but of first pictures).

    python benchmarks/contact_banks.py --families grip topple --bodies xarm7_white ur5e_silver --banks 8 --output contact.json

A task is accepted where between 0.3 and 0.7 of the careless plans succeed and the best shortcut stays at least 15 points below the choice
by true outcomes. Trees learn from the other banks of the same task, of all bodies.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.harness import command_line
from worldline_core.errors import DataError
from worldline_core.evaluation.planning.evaluate_planning import rule_choosers, rule_scores, tree_scores_by_shortcut
from worldline_core.evaluation.scores import bootstrap_mean
from worldline_core.evaluation.shortcuts import BankFacts, Reach, named_places
from worldline_core.recorder.attempts import BankSpec, RecordBanksConfig
from worldline_core.recorder.controllers import ScriptedPolicy
from worldline_core.recorder.looks import scenes
from worldline_core.recorder.rendering import FRAME_SIZE, prepare_rendering
from worldline_core.recorder.scene import CONTACT, Family, Layout
from worldline_core.recorder.simulate import EpisodeRecorder, ExecutedMotion


def facts_of(recorder: EpisodeRecorder, layout: Layout, motions: list[ExecutedMotion], scene: str) -> BankFacts:
    """Facts about a bank that need no prediction."""
    # Where the commands send the hands: how far fingers really closed tells what they hold.
    tools, gripper = [], []
    for motion in motions:
        sent = motion.qpos.copy()
        for arm in recorder.scene.arms:
            sent[:, arm.qpos] = motion.action[:, arm.columns]
        tools.append([recorder.tool_positions(arm, sent) for arm in range(len(recorder.scene.arms))])
        gripper.append(motion.action[:, [arm.gripper for arm in recorder.scene.arms]])
    tools = np.array(tools).transpose(0, 2, 1, 3)
    first = motions[0]
    still = replace(first, qpos=first.qpos[:1], state=first.state[:1], action=first.action[:1])
    filmed = recorder.film(
        layout, still, episode_id="first", scene_id=scene, split="bank", jitter=np.random.default_rng(len(motions))
    )
    camera = filmed.episode.cameras["head"]
    height = float(np.median(tools[..., 2].min(axis=(1, 2))))
    things = named_places(
        layout.instruction, filmed.frames["head"], height, camera.K, camera.T_base_camera[0], FRAME_SIZE
    )
    reach = Reach(tools, np.array(gripper, dtype=np.float64), things) if things else None
    return BankFacts(layout.instruction, np.stack([m.action for m in motions]).astype(np.float64), reach)


def interval(successes: list[bool]) -> list[float]:
    """Mean, and its 95 % bootstrap interval over banks."""
    found = bootstrap_mean(successes)
    return [round(value, 3) for value in (found.mean, found.low, found.high)]


def measure(
    family: Family, recorders: dict[str, EpisodeRecorder], banks: int, candidates: int, seed: int
) -> dict[str, object]:
    """Figures of one task."""
    facts: dict[str, BankFacts] = {}
    ends: dict[str, list[bool]] = {}
    scene_ids = scenes("wide", training=False)
    shares: dict[str, list[float]] = {"careless": [], "knowing": []}
    for body, recorder in recorders.items():
        for number in range(banks):
            name = f"{family}_{body}_{number}"
            spec = BankSpec(name=name, embodiment=body, family=family, scene=scene_ids[number], layout=number)
            config = RecordBanksConfig(banks=(spec,), candidates=candidates, seed=seed, success_range=(0.1, 0.9))
            try:
                layout, motions = config.draw(recorder, spec)
            except DataError as error:
                print(error)
                continue
            facts[name] = facts_of(recorder, layout, list(motions.values()), spec.scene)
            ends[name] = [motion.outcome == "success" for motion in motions.values()]
            shares["careless"].append(float(np.mean(ends[name])))
            random = np.random.default_rng((seed, number))
            good = [recorder.move(layout, random, config.num_frames, ScriptedPolicy()) for _ in range(2)]
            shares["knowing"] += [float(motion.outcome == "success") for motion in good if motion is not None]
    everyone, chosen = list(range(candidates)), {}
    for name, own in facts.items():
        for rule, chooser in rule_choosers(own, rule_scores(own)).items():
            chosen.setdefault(rule, []).append(ends[name][chooser(everyone)] if chooser else False)
    for rule, scores in tree_scores_by_shortcut(facts, ends).items():
        chosen[rule] = [ends[name][int(np.argmax(own))] for name, own in scores.items()]
    figures = {rule: interval(successes) for rule, successes in chosen.items() if successes}
    return {
        "banks": len(facts),
        "success_careless": interval_of(shares["careless"]),
        "success_knowing": round(float(np.mean(shares["knowing"])), 3),
        "seen_things": sum(own.reach is not None for own in facts.values()),
        "shortcuts": figures,
        "best_shortcut": max(figures.items(), key=lambda item: item[1][0]),
    }


def interval_of(shares: list[float]) -> list[float]:
    """Mean, least and greatest."""
    return [round(float(v), 3) for v in (np.mean(shares), np.min(shares), np.max(shares))]


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--families", nargs="+", default=list(CONTACT), choices=CONTACT)
    parser.add_argument("--bodies", nargs="+", default=["viperx_pearl", "ur5e_silver", "xarm7_white"])
    parser.add_argument("--banks", type=int, default=8, help="of each task with each body")
    parser.add_argument("--candidates", type=int, default=32)
    parser.add_argument("--seed", type=int, default=36900)
    parser.add_argument("--output", type=Path, required=True)
    options = parser.parse_args()
    prepare_rendering()
    recorders = {body: EpisodeRecorder(body, contact=True) for body in options.bodies}
    found = {}
    for family in options.families:
        found[family] = measure(family, recorders, options.banks, options.candidates, options.seed)
        print(family, json.dumps(found[family]), flush=True)
        options.output.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
