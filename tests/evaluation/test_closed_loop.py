"""A planner on the shipped causal model."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from worldline_core import Camera, WorldLine
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ConfigError, DataError
from worldline_core.evaluation.planning.bracket import MeasuredSelector, shown_video
from worldline_core.evaluation.planning.closed_loop import ClosedLoopPlanner, Situation, judged, recorded
from worldline_core.evaluation.recordings import Trajectory
from worldline_core.evaluation.segmenters.learned import LearnedSegmenter
from worldline_core.rollout.robot import CommandedRobot

ROBOT = "ur5e_silver"


@dataclass
class HeldOut:
    """A held-out recording: its pictures, its cameras at the first frame, and its commands."""

    frames: dict[str, np.ndarray]
    cameras: dict[str, Camera]
    poses: dict[str, np.ndarray]
    controls: np.ndarray
    instruction: str

    def now(self) -> dict[str, np.ndarray]:
        return {view: video[0] for view, video in self.frames.items()}

    def around(self, situation: Situation, count: int, random: np.random.Generator) -> np.ndarray:
        """The recorded commands with noise."""
        rows = self.controls[1:][np.minimum(situation.executed + np.arange(situation.frames), 31)]
        return rows + random.normal(0, 0.02, (count, *rows.shape))

    def planner(self, world: WorldLine, **options: object) -> ClosedLoopPlanner:
        usual = {"propose": self.around, "score": lambda video: 0.0, "candidates": 2, "horizon": 1}
        return ClosedLoopPlanner(
            world, self.cameras, embodiment=ROBOT, instruction=self.instruction, **{**usual, **options}
        )  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def shipped(project_root: Path) -> Path:
    return project_root / "artifacts" / "shipped"


@pytest.fixture(scope="module")
def world(shipped: Path) -> WorldLine:
    return WorldLine.from_pretrained(shipped / "models" / "causal")


@pytest.fixture(scope="module")
def start(shipped: Path) -> HeldOut:
    recordings = EpisodeSet.open(shipped / "recordings")
    position = next(i for i, row in enumerate(recordings.rows) if row.embodiment == ROBOT and row.split == "test")
    episode = recordings.episode(position)
    cameras = {view: Camera(camera.K, camera.T_base_camera[0]) for view, camera in episode.cameras.items()}
    return HeldOut(
        {view: recordings.frames(position, view, list(range(17))) for view in cameras}, cameras,
        {view: camera.T_base_camera for view, camera in episode.cameras.items()},
        np.asarray(episode.action[:33], np.float64), episode.instruction,
    )  # fmt: skip


def test_a_horizon_of_the_whole_episode_is_open_loop_best_of_n(world: WorldLine, start: HeldOut, shipped: Path) -> None:
    candidates = np.stack([start.controls[1:], start.controls[1:] + 0.03, start.controls[1:][::-1]])
    selector = MeasuredSelector(LearnedSegmenter.load(shipped / "models" / "segmenter"))
    planner = start.planner(
        world, propose=recorded(candidates), score=judged(selector), candidates=3, batch=2, horizon=2, limits=False
    )
    plan = planner.plan(start.now(), start.controls[0])
    scores = []
    for controls in candidates:
        rows = np.concatenate((start.controls[:1], controls))
        frames = world.predict(start.now(), rows, start.cameras, embodiment=ROBOT)
        shown = shown_video(Trajectory(start.instruction, frames, world.contract.fps))
        scores.append(selector.score(start.instruction, shown).score / 100)
    assert np.array_equal(plan.scores, np.sort(scores)[::-1])
    assert np.array_equal(plan.sequence, candidates[int(np.argmax(scores))])
    assert np.array_equal(plan.controls, plan.sequence[:16])
    assert plan.model_calls == 6


def test_the_next_choice_begins_at_what_was_really_seen(world: WorldLine, start: HeldOut) -> None:
    videos: list[Trajectory] = []

    def watched(video: Trajectory) -> float:
        videos.append(video)
        return 0.0

    planner = start.planner(world, score=watched, candidates=1, horizon=2, limits=False)
    first = planner.plan(start.now(), start.controls[0])
    seen = {view: video[1:] for view, video in start.frames.items()}
    second = planner.plan(seen, start.controls[16], horizon=1)
    # Among equals what is left of the last choice comes first.
    assert np.array_equal(second.sequence, first.sequence[16:])
    assert [video.num_frames for video in videos] == [33, 33]
    shown, shrunk = videos[1].frames["head"], planner._shrunk(start.frames["head"])
    assert np.array_equal(shown[:16], shrunk[:16])
    # The picture that the prediction begins at is shown as the model sees it.
    assert np.abs(shown[16].astype(int) - shrunk[16]).mean() < 6
    assert not np.isnan(videos[1].points[16:]).all()  # type: ignore[index]
    # Wrist cameras were carried along: they are where the recording says.
    cameras = planner._begin({view: video[-1] for view, video in seen.items()}, start.controls[16])._starts.cameras[0]
    for view in ("left_wrist", "right_wrist"):
        moved = np.linalg.norm(start.poses[view][16][:3, 3] - start.poses[view][0][:3, 3])
        apart = np.linalg.norm(cameras[view].T_base_camera[:3, 3] - start.poses[view][16][:3, 3])  # type: ignore[index]
        assert apart < 0.02
        assert moved > 0.1 or view != "right_wrist"


def test_a_planner_stays_within_the_limits_of_the_robot(world: WorldLine, start: HeldOut) -> None:
    def still(video: Trajectory) -> float:
        return -float(np.abs(np.diff(video.frames["head"][[0, 16]].astype(float), axis=0)).mean())

    def far(situation: Situation, count: int, random: np.random.Generator) -> np.ndarray:
        return situation.state + random.normal(0, 1.5, (count, situation.frames, len(situation.state)))

    planner = start.planner(world, propose=far, score=still, candidates=6, batch=4)
    plan = planner.plan(start.now(), start.controls[0])
    assert plan.score == plan.scores.max() == plan.scores[0]
    assert len(plan.scores) == plan.model_calls == 6
    robot = CommandedRobot(planner.kinematics, 8.0, start.controls[:1], limits=True)
    assert np.array_equal(robot.follow(plan.sequence[None])[1][0], plan.sequence)
    assert not np.array_equal(
        robot.follow(start.controls[0] + np.full((1, 16, 14), 3.0))[1][0], start.controls[0] + 3.0
    )


def test_a_planner_carries_on_what_it_chose_unless_something_is_better_by_the_margin(
    world: WorldLine, start: HeldOut
) -> None:
    for margin, score in ((0.2, 0.5), (0.05, 0.6)):
        # The first choice looks for nothing that is kept: its third candidate wins by less than the margin. At the second
        # the first of the three is what is left of it.
        scores: Iterator[float] = iter([0.75, 0.7, 0.8, 0.5, 0.6, 0.1])

        def scored(video: Trajectory, scores: Iterator[float] = scores) -> float:
            return next(scores)

        planner = start.planner(world, candidates=3, margin=margin, score=scored)
        first = planner.plan(start.now(), start.controls[0], horizon=2)
        assert first.score == 0.8
        second = planner.plan(start.now(), first.controls[-1], horizon=1)
        assert second.score == second.scores[0] == score
        assert np.array_equal(second.sequence, first.sequence[16:]) == (score == 0.5)


def test_what_a_planner_cannot_use_is_named(world: WorldLine, start: HeldOut) -> None:
    def proposing(*shape: int) -> Callable:
        return lambda situation, number, random: np.zeros((number, *shape))

    cases = {
        "not a finite number": {"score": lambda video: float("nan")},
        "Proposals do not fit": {"propose": proposing(15, 14)},
    }
    for message, options in cases.items():
        planner = start.planner(world, **options)
        with pytest.raises(DataError, match=message):
            planner.plan(start.now(), start.controls[0])
        assert planner._past == {}
    with pytest.raises(ConfigError, match="horizon"):
        start.planner(world, horizon=0)
    with pytest.raises(ConfigError, match="a margin of at least 0"):
        start.planner(world, margin=float("nan"))


def test_proposals_from_recordings_go_on_where_the_episode_is() -> None:
    rows = np.arange(40.0).reshape(2, 10, 2)
    situation = Situation({}, np.zeros(2), frames=4, executed=8)
    drawn = recorded(rows)(situation, 5, np.random.default_rng(0))
    assert {tuple(found[:, 0]) for found in drawn} == {(16.0, 18.0, 18.0, 18.0), (36.0, 38.0, 38.0, 38.0)}


@pytest.mark.slow
def test_the_example_of_the_documentation_runs(
    project_root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (project_root / "docs" / "planning.md").read_text()
    monkeypatch.chdir(project_root)
    exec(text.split("```python\n")[1].split("```")[0], {})  # noqa: S102
    assert capsys.readouterr().out.count("model calls") == 2
