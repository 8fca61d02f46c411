"""Several attempts from one initial state: candidate banks for planning, and policies to be compared.

A start (body, scene, camera, things, instruction) is one bank of the EpisodeSet, an attempt one of its candidates. Of a
candidate bank the outcomes go to ``sealed_outcomes.parquet`` only, so that whatever chooses among candidates cannot read them
from the index; with them, where there are any, the facts measured in contact tasks and the sizes of misses. A compared policy is the source of its episodes.
"""

from __future__ import annotations

import importlib.metadata
import json
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Self, cast

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import Field, model_validator

from worldline_core.config import StrictModel, load_config, read_yaml
from worldline_core.data.episodes.episode_set import EpisodeSetWriter
from worldline_core.errors import DataError
from worldline_core.progress import Progress
from worldline_core.recorder.bodies import Robot
from worldline_core.recorder.controllers import ScriptedPolicy, miss_of
from worldline_core.recorder.looks import SCENE_PATTERN, look_of
from worldline_core.recorder.record import (
    SPLIT_STREAM,
    Embodiment,
    RecordConfig,
    check_recorded,
    record,
    run_in_processes,
)
from worldline_core.recorder.rendering import prepare_rendering
from worldline_core.recorder.scene import CONTACT, Family, Layout
from worldline_core.recorder.simulate import EpisodeRecorder, ExecutedMotion, draw_layout
from worldline_core.store.artifact_files import MANIFEST_NAME, write_manifest
from worldline_core.store.atomic import atomic_path, remove_unfinished
from worldline_core.store.store import describe_environment, folder_lock

SEALED_FILE = "sealed_outcomes.parquet"
PolicyName = Annotated[str, Field(pattern="^[a-z][a-z0-9_]{0,39}$")]


class BankSpec(StrictModel):
    """One start; ``layout`` numbers its initial state."""

    name: str = Field(min_length=1)
    embodiment: Embodiment
    family: Family
    scene: str = Field(pattern=SCENE_PATTERN)
    layout: int = Field(ge=0)


class BankGrid(StrictModel):
    """``count`` starts of every task with every embodiment, each with its own initial state; scenes take turns."""

    embodiments: tuple[Embodiment, ...] = Field(min_length=1)
    families: tuple[Family, ...] = Field(min_length=1)
    scenes: tuple[str, ...] = Field(min_length=1)
    count: int = Field(default=5, ge=1, le=10_000)

    @model_validator(mode="after")
    def _named_once(self) -> BankGrid:
        if any(len(set(names)) < len(names) for names in (self.embodiments, self.families)):
            raise ValueError("an embodiment or a task twice: banks would share their names")
        return self

    def specs(self) -> list[BankSpec]:
        """One spec per start, named ``bank_<family>_<embodiment>_<number>``."""
        cells: list[tuple[Family, Embodiment, int]] = [
            (f, e, number) for number in range(self.count) for e in self.embodiments for f in self.families
        ]
        return [
            BankSpec(
                name=f"bank_{family}_{embodiment}_{number}",
                embodiment=embodiment,
                family=family,
                # Shifted from one number to the next, so that each cell sees several scenes.
                scene=self.scenes[(layout + number) % len(self.scenes)],
                layout=layout,
            )
            for layout, (family, embodiment, number) in enumerate(cells)
        ]


class _AttemptsConfig(StrictModel):
    """Settings of all attempts; ``workers`` are processes, each of which records whole starts."""

    seed: int = Field(default=0, ge=0)
    num_frames: int = Field(default=33, ge=17, le=400)
    workers: int = Field(default=2, ge=1, le=64)
    video_crf: int = Field(default=18, ge=0, le=51)

    def layouts(self, robot: Robot, start: BankSpec, split: str) -> Iterator[tuple[tuple[int, ...], Layout]]:
        """Twenty initial states to try, each with the seed of its attempts."""
        for trial in range(20):
            entropy = (self.seed, robot.stream, SPLIT_STREAM[split], start.layout, trial)
            yield entropy, draw_layout(robot, start.family, np.random.default_rng(entropy), look_of(start.scene))

    def camera_draws(self, start: BankSpec) -> np.random.Generator:
        """Draws of the same small camera shift for all attempts: they share the first picture."""
        return np.random.default_rng((self.seed, start.layout))


class RecordBanksConfig(_AttemptsConfig):
    """Banks of ``candidates`` control sequences each.

    Attributes:
        banks: one by one, or as a grid.
        masks: also store the exact pixels of the robot and of each thing; whoever chooses among videos needs none.
        misses: share of the candidates that miss by any amount, as of `RecordConfig`.
        success_range: the share of a bank's candidates that succeed must be in this range; otherwise the next initial
            state is tried (at most 20).
    """

    banks: Annotated[tuple[BankSpec, ...], Field(min_length=1)] | BankGrid
    candidates: int = Field(default=32, ge=2, le=512)
    video_crf: int = Field(default=22, ge=0, le=51)
    masks: bool = True
    misses: float = Field(default=0.0, ge=0, le=1)
    success_range: tuple[float, float] = (0.25, 0.75)

    def specs(self) -> list[BankSpec]:
        return self.banks.specs() if isinstance(self.banks, BankGrid) else list(self.banks)

    def draw(self, recorder: EpisodeRecorder, spec: BankSpec) -> tuple[Layout, dict[str, ExecutedMotion]]:
        """Layout and executed candidates of a bank.

        Raises: DataError when none of 20 initial states gives a success rate in the wanted range.
        """
        low, high = self.success_range
        for entropy, layout in self.layouts(recorder.scene.robot, spec, "bank"):
            motions: list[ExecutedMotion] = []
            for draw in range(4 * self.candidates):
                policy = miss_of(self.misses, spec.family, (*entropy, draw + 1))
                motion = recorder.move(layout, np.random.default_rng((*entropy, draw + 1)), self.num_frames, policy)
                if motion is not None:
                    motions.append(motion)
                if len(motions) == self.candidates:
                    break
            success = float(np.mean([motion.outcome == "success" for motion in motions])) if motions else 0.0
            if len(motions) == self.candidates and low <= success <= high:
                return layout, {f"{candidate:03d}": motion for candidate, motion in enumerate(motions)}
        raise DataError(
            "No initial state gives the wanted success rate", where=f"bank {spec.name}", expected=str((low, high))
        )


class RecordPoliciesConfig(_AttemptsConfig):
    """Every policy from every start of the grid.

    Attributes:
        policies: by name; their order numbers the candidates.
        starts: ``count`` starts of every task with every embodiment.
    """

    policies: dict[PolicyName, ScriptedPolicy] = Field(min_length=2)
    starts: BankGrid

    def specs(self) -> list[BankSpec]:
        return self.starts.specs()

    def draw(self, recorder: EpisodeRecorder, start: BankSpec) -> tuple[Layout, dict[str, ExecutedMotion]]:
        """The first initial state that every policy can attempt, and the attempts by policy.

        Raises: DataError when 20 initial states hold none.
        """
        for entropy, layout in self.layouts(recorder.scene.robot, start, "test"):
            motions: dict[str, ExecutedMotion] = {}
            for number, (name, policy) in enumerate(self.policies.items()):
                for draw in range(5):
                    random = np.random.default_rng((*entropy, number, draw))
                    motion = recorder.move(layout, random, self.num_frames, policy)
                    if motion is not None:
                        motions[name] = motion
                        break
                else:
                    break
            if len(motions) == len(self.policies):
                return layout, motions
        raise DataError("No initial state is in reach of every policy", where=f"start {start.name}")


def _record_start(
    task: tuple[BankSpec, RecordBanksConfig | RecordPoliciesConfig, Path],
) -> dict[str, tuple[str, dict[str, float]]]:
    """Record the missing attempts of a start in a worker process; outcomes and facts of all of them by name."""
    start, config, output = task
    sealed = isinstance(config, RecordBanksConfig)
    recorder = EpisodeRecorder(start.embodiment, contact=start.family in CONTACT)
    layout, motions = config.draw(recorder, start)
    finished = EpisodeSetWriter.finished(output)
    writer = None if finished else EpisodeSetWriter(output, video_crf=config.video_crf)
    masked = not sealed or config.masks
    for number, (name, motion) in enumerate(motions.items()):
        episode_id = f"{start.name}-{name}"
        if writer is None or writer.has(episode_id):
            continue
        recording = recorder.film(
            layout, replace(motion, outcome="unknown") if sealed else motion, episode_id=episode_id, scene_id=start.scene,
            split="bank" if sealed else "test", jitter=config.camera_draws(start), bank=start.name, candidate=number,
            masked=masked,
        )  # fmt: skip
        writer.add(
            recording.episode if sealed else replace(recording.episode, source=name),
            recording.frames,
            recording.robot_masks,
            thing_labels=recording.thing_labels,
        )
    recorder.close()
    return {name: (motion.outcome, motion.facts) for name, motion in motions.items()}


def _record_starts(
    config: RecordBanksConfig | RecordPoliciesConfig, output: Path
) -> list[tuple[BankSpec, dict[str, tuple[str, dict[str, float]]]]]:
    """Record all starts; finished episodes survive a kill. Returns outcome and facts of each attempt, by start."""
    prepare_rendering()
    specs, recorded = config.specs(), []
    with Progress("record attempts", len(specs), "start") as progress:
        attempts = run_in_processes(_record_start, [(spec, config, output) for spec in specs], config.workers)
        for spec, found in zip(specs, attempts, strict=True):
            recorded.append((spec, found))
            progress.advance()
    if not EpisodeSetWriter.finished(output):
        EpisodeSetWriter(output, video_crf=config.video_crf).close()
    check_recorded(output, [f"{spec.name}-{name}" for spec, found in recorded for name in found])
    return recorded


def record_banks(config: RecordBanksConfig, output: Path) -> dict[str, Any]:
    """Record candidate banks into ``output`` (an EpisodeSet with sealed outcomes); returns the successes of each bank.

    Raises: UnavailableError without MuJoCo; DataError when a bank cannot be drawn, or the folder holds other episodes.
    """
    recorded = _record_starts(config, output)
    known = any(facts for _, found in recorded for _, facts in found.values())
    rows = [
        {"episode_id": f"{spec.name}-{name}", "outcome": outcome}
        | ({"facts": json.dumps(facts, sort_keys=True)} if known else {})
        for spec, found in recorded
        for name, (outcome, facts) in found.items()
    ]
    with atomic_path(output / SEALED_FILE) as path:
        pq.write_table(pa.Table.from_pylist(sorted(rows, key=lambda row: row["episode_id"])), path)
    counts = {
        spec.name: {"candidates": len(found), "successes": sum(outcome == "success" for outcome, _ in found.values())}
        for spec, found in recorded
    }
    return {"banks": len(recorded), "candidates": len(rows), "successes": counts}


def record_policies(config: RecordPoliciesConfig, output: Path) -> dict[str, Any]:
    """Record every policy's attempts at every start into ``output`` (an EpisodeSet); returns their successes by task.

    Raises: UnavailableError without MuJoCo; DataError when a start cannot be drawn, or the folder holds other episodes.
    """
    recorded = _record_starts(config, output)
    table: dict[str, dict[str, dict[str, int]]] = defaultdict(dict)
    for spec, found in recorded:
        for policy, (outcome, _) in found.items():
            cell = table[policy].setdefault(spec.family, {"attempts": 0, "successes": 0})
            cell["attempts"] += 1
            cell["successes"] += outcome == "success"
    counts = {name: table[name] for name in config.policies}
    return {"starts": len(recorded), "episodes": sum(len(found) for _, found in recorded), "policies": counts}


class RecordingConfig(StrictModel):
    """One of the three kinds of recordings."""

    episodes: RecordConfig | None = None
    banks: RecordBanksConfig | None = None
    policies: RecordPoliciesConfig | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if sum(config is not None for config in (self.episodes, self.banks, self.policies)) != 1:
            raise ValueError("give episodes, banks or policies, one of the three")
        return self

    def record(self, output: Path) -> dict[str, Any]:
        """Record into ``output``, or continue there; returns counts. Raises as `record`, `record_banks`, `record_policies`."""
        if self.episodes is not None:
            return record(self.episodes, output)
        if self.policies is not None:
            return record_policies(self.policies, output)
        return record_banks(cast("RecordBanksConfig", self.banks), output)


def load_recording(path: Path, overrides: Sequence[str] = ()) -> RecordingConfig:
    """Read a file of one recording; its keys say of which kind."""
    keys = read_yaml(path).keys()
    if "policies" in keys:
        return RecordingConfig(policies=load_config(RecordPoliciesConfig, path=path, overrides=overrides))
    if "banks" in keys:
        return RecordingConfig(banks=load_config(RecordBanksConfig, path=path, overrides=overrides))
    return RecordingConfig(episodes=load_config(RecordConfig, path=path, overrides=overrides))


def record_artifact(config: RecordingConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """The step `record`."""
    del inputs
    return config.record(output)


def record_into(config: RecordingConfig, output: Path, version: int) -> dict[str, Any]:
    """Record into a folder outside of a store, or continue a killed recording there; the manifest is written last.

    Args:
        version: of the task `record`, for the manifest.

    Raises:
        DataError: the folder holds a finished recording.
        ArtifactError: another command is recording into it.
    """
    with folder_lock(output):
        if (output / MANIFEST_NAME).exists():
            raise DataError("Folder already holds a recording", where=output, next_step="record into a new folder")
        remove_unfinished(output)
        counts = config.record(output)
        environment = describe_environment()
        packages = {**environment["packages"], "mujoco": importlib.metadata.version("mujoco")}
        facts = {"step": "record", "version": version, "config": config.model_dump(mode="json"), "metrics": counts}
        write_manifest(output, {**facts, "environment": {**environment, "packages": packages}})
        return counts
