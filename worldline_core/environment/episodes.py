"""Episodes that run in an environment: their videos so far, which ones are stepped together, and whether one succeeded."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np

from worldline_core.actions.episode_tracks import EpisodeTracks
from worldline_core.environment.starts import Start
from worldline_core.errors import ConfigError, DataError
from worldline_core.evaluation.policy.judge import confidence_of, judge_trajectory
from worldline_core.evaluation.policy.measured_judge import MeasuredEvidenceJudge
from worldline_core.evaluation.policy.trust import (
    JudgedBy,
    PredictedBy,
    TrustCalibration,
    TrustModel,
    content_digest,
    control_vectors,
    reasons,
    setup_vectors,
)
from worldline_core.evaluation.recordings import Trajectory
from worldline_core.evaluation.segmenters.segmenter import open_segmenter
from worldline_core.geometry.embodiment import LIMIT_TOLERANCE_RAD, Embodiment
from worldline_core.model.pretrained import pretrained_folder
from worldline_core.rollout.samplers import FULL_STEPS
from worldline_core.rollout.simulation import Frames, Simulation
from worldline_core.rollout.worldline import WorldLine
from worldline_core.shipped import shipped_folder

Success = Callable[[Trajectory], bool | None]
"""Whether a video shows that its task was done; None where that cannot be seen."""


class TrustedJudge:
    """Success by the embedded judge, and how far it is to be trusted by a saved calibration.

    Args:
        segmenter: its folder.
        saved: trust.safetensors, or its folder.
        world, checkpoint: the model, and its folder. views, embodiment: of the simulations.

    Raises:
        ArtifactError: there is no such calibration.
        ConfigError: it was made with another judge, robot or checkpoint, or compares the predictions of two models.
    """

    def __init__(
        self, segmenter: Path, saved: Path, world: WorldLine, checkpoint: Path, views: Sequence[str], embodiment: str
    ) -> None:
        opened = open_segmenter("learned", learned=segmenter, sam3=None)
        self._judge = MeasuredEvidenceJudge(opened, states_confidence=True)
        self._saved = TrustModel.read(saved)
        digest = content_digest(segmenter)
        self._saved.require(
            JudgedBy(judge="measured", views=tuple(views), segmenter="learned", segmenter_weights=digest), (embodiment,)
        )
        causal = world.info.causal
        sampler, usual = ("full_clip", FULL_STEPS) if causal is None else ("block_causal", causal.steps)
        asked = PredictedBy(
            checkpoint=content_digest(checkpoint), sampler=sampler, steps=world.steps, shift=world.shift
        )
        either = [asked, asked.model_copy(update={"steps": None})] if world.steps == usual else [asked]
        found = [self._saved.calibration_of(made) for made in either]
        fitting = [calibration for calibration in found if isinstance(calibration, TrustCalibration)]
        if not fitting or "disagreement" in fitting[0].signals:
            raise ConfigError(
                "A saved calibration of trust is not of these simulations", where=saved,
                got=", ".join(fitting[0].signals) + ": disagreement needs a second model" if fitting else found[0],
                next_step="calibrate with rollouts of this checkpoint, without compare_with (docs/evaluation.md)",
            )  # fmt: skip
        self._calibration = fitting[0]
        self._confidence: float | None = None

    def __call__(self, trajectory: Trajectory) -> bool:
        judgement = judge_trajectory(self._judge, trajectory)
        self._confidence = confidence_of(asdict(judgement))
        return judgement.success

    def assess(self, tracks: Sequence[EpisodeTracks]) -> dict[str, Any]:
        """``trust``, the probability that the last verdict is right (NaN where the judge had nothing to judge by), and
        ``do_not_trust``, the reasons not to rely on it ("" where there are none).

        Args:
            tracks: action tracks of the episode so far.
        """
        poses, openings = (
            np.concatenate(rows) for rows in zip(*((t.T_base_tool, t.gripper[:, 0]) for t in tracks), strict=True)
        )
        row = {
            "episode_id": "of a simulation", "disagreement": None,
            "doubt": None if self._confidence is None else 1.0 - self._confidence,
            "new_controls": self._saved.controls.novelty(*control_vectors(poses, openings)),
            "new_setup": self._saved.setups.novelty(*setup_vectors(tracks[0])),
        }  # fmt: skip
        trust = self._calibration.trust([row])
        row["trust"] = None if isinstance(trust, str) else float(trust[0])
        marks = reasons(row, self._saved.least_trust) + (["nothing to judge by"] if row["trust"] is None else [])
        return {"trust": float("nan") if row["trust"] is None else row["trust"], "do_not_trust": ", ".join(marks)}


def judge_of(
    success: Success | Literal["measured"] | None,
    trust: Path | str | None,
    model: Path | str | WorldLine | None,
    world: WorldLine,
    views: Sequence[str],
    embodiment: str,
) -> Success | None:
    """The judge that an environment asks for; the measured one tracks what the instruction names by its colour.

    Raises: ConfigError where trust is asked for in another judge, or in a model without a folder; as of :class:`TrustedJudge`.
    """
    shipped = shipped_folder() / "models"
    if trust is not None:
        if success != "measured" or isinstance(model, WorldLine):
            raise ConfigError(
                "Trust is of the measured judge and of a checkpoint's folder", where="trust",
                got=f"success {success!r}, model {type(model).__name__}",
            )  # fmt: skip
        folder = pretrained_folder(model or shipped / "causal")
        return TrustedJudge(shipped / "segmenter", Path(trust), world, folder, views, embodiment)
    if success != "measured":
        return success
    judge = MeasuredEvidenceJudge(open_segmenter("learned", learned=shipped / "segmenter", sam3=None))
    return lambda trajectory: judge_trajectory(judge, trajectory).success


@dataclass
class RunningEpisode:
    """One running episode: its start, its video so far, the tools in the head view, and the controls' tracks."""

    start: Start
    video: dict[str, list[np.ndarray]]
    points: list[np.ndarray]
    picture: dict[str, np.ndarray]
    state: np.ndarray
    tracks: list[EpisodeTracks]
    success: bool = False
    trust: dict[str, Any] = field(default_factory=dict)

    def trajectory(self, fps: float) -> Trajectory:
        """The video so far, as a judge sees it."""
        video: dict[str, Any] = {view: np.concatenate(pieces) for view, pieces in self.video.items()}
        return Trajectory(self.start.instruction, video, fps, np.concatenate(self.points))


@dataclass
class Together:
    """Episodes that began together, and the commands since their last finished block."""

    simulation: Simulation
    slots: list[int]
    age: int = 0
    commands: list[np.ndarray] = field(default_factory=list)

    def take(self, commands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """One more command for each episode ``(b, j)``: what is executed of it, and where the robots then are."""
        self.commands.append(commands)
        self.age += 1
        executed, states = self.simulation.follow(np.stack(self.commands, axis=1))
        return executed[:, -1], states[:, -1]

    def predict(self) -> tuple[Simulation, Frames]:
        """The simulation after the commands that are not behind it yet, at most a block of them, and their videos.

        An unfinished block is predicted with the last command held, by a copy: it is predicted again when there are more
        commands. A full one is behind the simulation then.
        """
        frames = self.simulation.frames_per_step
        block = np.stack(self.commands[:frames], axis=1)
        count = block.shape[1]
        simulation = self.simulation if count == frames else self.simulation.copy()
        held = np.repeat(block[:, -1:], frames - count, axis=1)
        clips = simulation.step(np.concatenate((block, held), axis=1))
        if count == frames:
            self.commands = self.commands[frames:]
        return simulation, [{view: video[:count] for view, video in clip.items()} for clip in clips]

    def without(self, slots: Sequence[int]) -> Together | None:
        """The same without the episodes of some slots; None where none is left."""
        kept = [index for index, slot in enumerate(self.slots) if slot not in slots]
        if len(kept) in (0, len(self.slots)):
            return self if kept else None
        commands = [rows[kept] for rows in self.commands]
        return Together(self.simulation.select(kept), [self.slots[index] for index in kept], self.age, commands)


def each_seed(given: int | Sequence[int | None] | None, count: int) -> list[int | None]:
    """A seed for each of ``count`` episodes: those given, or counted up from the one given, or None for each.

    Raises: DataError when ``given`` has another number of seeds, or something that is no seed.
    """
    if isinstance(given, int | np.integer):
        given = [int(given) + number for number in range(count)]
    seeds: list[int | None] = [None] * count if given is None else []
    if isinstance(given, Sequence | np.ndarray):
        seeds = [*given]
    known = [seed for seed in seeds if seed is not None]
    if len(seeds) != count or not all(isinstance(seed, int | np.integer) and 0 <= seed < 2**63 for seed in known):
        raise DataError("Not the seeds of the episodes", expected=f"one, or {count}, from 0 to 2^63 - 1", got=given)
    return seeds


def robot_spaces(
    robot: Embodiment, views: Sequence[str], image_size: tuple[int, int]
) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Dict]:
    """Commands of a robot, and observations of it: pictures ``uint8 (H, W, 3)`` by view, and its state."""
    low, high = (np.full(robot.state_size, bound, np.float32) for bound in (-np.inf, np.inf))
    for arm in robot.arms:
        low[robot.joint_columns(arm)], high[robot.joint_columns(arm)] = np.array(arm.limits, np.float32).T
        column = robot.gripper_column(arm)
        low[column], high[column] = sorted((arm.gripper.closed, arm.gripper.open))
    picture = gymnasium.spaces.Box(0, 255, (*image_size, 3), np.uint8)
    # A recording may begin a little beyond a limit, and stays where it is.
    state = gymnasium.spaces.Box(low - LIMIT_TOLERANCE_RAD, high + LIMIT_TOLERANCE_RAD, dtype=np.float32)
    seen = gymnasium.spaces.Dict({"pixels": gymnasium.spaces.Dict(dict.fromkeys(views, picture)), "agent_pos": state})
    return gymnasium.spaces.Box(low, high, dtype=np.float32), seen


def checked_commands(actions: Any, shape: tuple[int, ...] | None, robot: Embodiment) -> np.ndarray:
    """Commands of one step as float64.

    Raises: DataError: they have another shape or are not finite.
    """
    try:
        given = np.asarray(actions)
    except ValueError:  # rows of different lengths
        given = np.empty(0)
    numbers = given.dtype.kind in "fiu" and given.shape == shape
    if not numbers or not np.isfinite(commands := given.astype(np.float64)).all():
        raise DataError(
            "Not the commands of one step",
            expected=f"finite {shape}: {', '.join(robot.state_names)}",
            got="numbers that are not finite" if numbers else f"{given.dtype} {given.shape}",
        )
    return commands
