"""Solvers on functions with a known optimum, and a planner on the shipped causal model."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from worldline_core import Camera, WorldLine
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ConfigError, DataError
from worldline_core.evaluation.planning.bracket import MeasuredSelector, shown_video
from worldline_core.evaluation.planning.closed_loop import (
    SOLVERS,
    ClosedLoopPlanner,
    GoalPicture,
    SearchResult,
    SearchSpace,
    Situation,
    coloured_noise,
    drawn_around,
    judged,
    recorded,
    search,
)
from worldline_core.evaluation.recordings import Trajectory
from worldline_core.evaluation.segmenters.learned import LearnedSegmenter
from worldline_core.rollout.robot import CommandedRobot
from worldline_core.training.video_teacher import load_teacher

ROBOT = "ur5e_silver"
GOAL = 0.6 * np.sin(np.linspace(0, 2, 6))[:, None] * np.array([1.0, -1.0])


def quadratic(sequences: np.ndarray) -> np.ndarray:
    return -np.square(sequences - GOAL).mean(axis=(1, 2))


def solved(
    solver: str, seed: int = 0, candidates: int = 400, kept: np.ndarray = GOAL[None, :0], **options
) -> SearchResult:
    random = np.random.default_rng(seed)
    space = SearchSpace(
        lambda number: coloured_noise(random, (number, *GOAL.shape), 2.0),
        lambda sequences: np.clip(sequences, -1.0, 1.0),
        np.zeros((0, *GOAL.shape)) if kept.shape[1] == 0 else kept,
        random,
    )
    return search(SOLVERS[solver](space, candidates), options.pop("evaluate", quadratic), batch=16, **options)


@pytest.mark.parametrize(("solver", "tolerance"), [("best_of_n", 0.4), ("icem", 0.15)])
def test_each_solver_finds_the_optimum_of_a_quadratic(solver: str, tolerance: float) -> None:
    found = solved(solver)
    assert np.sqrt(-found.scores[0]) < tolerance
    assert len(found.scores) == 400
    assert found.stopped == "candidates"
    assert np.array_equal(found.scores, np.sort(found.scores)[::-1])
    assert np.abs(found.sequences).max() <= 1.0
    again = solved(solver)
    assert np.array_equal(again.sequences, found.sequences)
    assert not np.array_equal(solved(solver, seed=1).sequences, found.sequences)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("candidates", [1, 2, 5, 7])
def test_few_candidates_are_all_used_and_what_is_kept_is_among_them(solver: str, candidates: int) -> None:
    found = solved(solver, candidates=candidates, kept=np.stack((GOAL, GOAL + 1)))
    assert len(found.scores) == candidates
    assert np.array_equal(found.sequences[0], GOAL)


def test_no_batch_is_begun_that_would_end_too_late() -> None:
    now = [0.0]

    def slow(sequences: np.ndarray) -> np.ndarray:
        now[0] += 1.0
        return quadratic(sequences)

    for seconds, batches in ((3.9, 3), (4.0, 4), (0.1, 1)):
        now[0] = 0.0
        found = solved("icem", evaluate=slow, seconds=seconds, clock=lambda: now[0])
        assert len(found.scores) == 16 * batches
        assert (found.stopped, found.seconds) == ("time", float(batches))


def test_the_search_ends_when_it_is_certain() -> None:
    found = solved("best_of_n", certain=-0.5)
    assert found.stopped == "certain"
    assert found.scores[0] >= -0.5
    assert len(found.scores) < 400
    assert solved("best_of_n", certain=0.1).stopped == "candidates"


def test_the_first_candidate_is_chosen_unless_another_is_better_by_the_margin() -> None:
    kept = GOAL[None] + 0.5  # scores -0.25
    nothing = solved("best_of_n", kept=kept)
    best = float(nothing.scores[0])
    assert best > -0.25
    carried = solved("best_of_n", kept=kept, margin=best + 0.26)
    assert np.array_equal(carried.sequences[0], np.clip(kept[0], -1, 1))
    assert carried.scores[0] == pytest.approx(quadratic(carried.sequences[:1])[0])
    assert np.array_equal(carried.sequences[1], nothing.sequences[0])
    assert np.array_equal(carried.scores[1:], np.sort(carried.scores[1:])[::-1])
    assert np.array_equal(solved("best_of_n", kept=kept, margin=0.01).sequences, nothing.sequences)


def test_a_score_that_is_no_number_is_refused() -> None:
    with pytest.raises(DataError, match="not a finite number"):
        solved("icem", evaluate=lambda sequences: np.full(len(sequences), np.nan))
    with pytest.raises(DataError, match="not a finite number"):
        solved("icem", evaluate=lambda sequences: np.zeros((len(sequences), 2)))


def test_noise_has_unit_variance_and_is_smooth_where_asked_for() -> None:
    for colour in (0.0, 1.0, 2.0):
        noise = coloured_noise(np.random.default_rng(0), (4000, 16, 1), colour)
        assert noise.std() == pytest.approx(1.0, abs=0.03)
        neighbours = float((noise[:, 1:] * noise[:, :-1]).mean())
        assert neighbours == pytest.approx({0.0: 0.0, 1.0: 0.45, 2.0: 0.75}[colour], abs=0.2)


@dataclass
class Start:
    """A held-out recording: its pictures, its cameras at the first frame, and its commands."""

    frames: dict[str, np.ndarray]
    cameras: dict[str, Camera]
    poses: dict[str, np.ndarray]
    controls: np.ndarray
    instruction: str

    def now(self) -> dict[str, np.ndarray]:
        return {view: video[0] for view, video in self.frames.items()}

    def planner(self, world: WorldLine, **options: object) -> ClosedLoopPlanner:
        around = drawn_around(0.02, self.controls[1:])
        usual = {"propose": around, "score": lambda video: 0.0, "solver": "best_of_n", "candidates": 2, "horizon": 1}
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
def start(shipped: Path) -> Start:
    recordings = EpisodeSet.open(shipped / "recordings")
    position = next(i for i, row in enumerate(recordings.rows) if row.embodiment == ROBOT and row.split == "test")
    episode = recordings.episode(position)
    cameras = {view: Camera(camera.K, camera.T_base_camera[0]) for view, camera in episode.cameras.items()}
    return Start(
        {view: recordings.frames(position, view, list(range(17))) for view in cameras}, cameras,
        {view: camera.T_base_camera for view, camera in episode.cameras.items()},
        np.asarray(episode.action[:33], np.float64), episode.instruction,
    )  # fmt: skip


@pytest.fixture(scope="module")
def head(start: Start) -> Start:
    return Start(
        {"head": start.frames["head"]}, {"head": start.cameras["head"]}, start.poses, start.controls, start.instruction
    )


def test_a_horizon_of_the_whole_episode_is_open_loop_best_of_n(world: WorldLine, head: Start, shipped: Path) -> None:
    candidates = np.stack([head.controls[1:], head.controls[1:] + 0.03, head.controls[1:][::-1]])
    selector = MeasuredSelector(LearnedSegmenter.load(shipped / "models" / "segmenter"))
    planner = head.planner(
        world, propose=recorded(candidates), score=judged(selector), candidates=3, batch=2, horizon=2, limits=False
    )
    plan = planner.plan(head.now(), head.controls[0])
    scores = []
    for controls in candidates:
        rows = np.concatenate((head.controls[:1], controls))
        frames = world.predict(head.now(), rows, head.cameras, embodiment=ROBOT)
        shown = shown_video(Trajectory(head.instruction, frames, world.contract.fps))
        scores.append(selector.score(head.instruction, shown).score / 100)
    assert np.array_equal(plan.scores, np.sort(scores)[::-1])
    assert np.array_equal(plan.sequence, candidates[int(np.argmax(scores))])
    assert np.array_equal(plan.controls, plan.sequence[:16])
    assert (plan.model_calls, plan.stopped) == (6, "candidates")


def test_the_next_choice_begins_at_what_was_really_seen(world: WorldLine, start: Start) -> None:
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


def test_a_planner_stays_within_the_limits_of_the_robot(world: WorldLine, head: Start) -> None:
    def still(video: Trajectory) -> float:
        return -float(np.abs(np.diff(video.frames["head"][[0, 16]].astype(float), axis=0)).mean())

    planner = head.planner(world, propose=drawn_around(1.5), score=still, solver="icem", candidates=6)
    plan = planner.plan(head.now(), head.controls[0])
    assert plan.score == plan.scores.max() == plan.scores[0]
    assert len(plan.scores) == plan.model_calls == 6
    robot = CommandedRobot(planner.kinematics, 8.0, head.controls[:1], limits=True)
    assert np.array_equal(robot.follow(plan.sequence[None])[1][0], plan.sequence)
    assert not np.array_equal(robot.follow(head.controls[0] + np.full((1, 16, 14), 3.0))[1][0], head.controls[0] + 3.0)


def test_a_planner_obeys_its_time_and_stops_when_certain(world: WorldLine, head: Start) -> None:
    now = [0.0]

    def slow(video: Trajectory) -> float:
        now[0] += 2.0
        return 0.0

    planner = head.planner(world, candidates=9, batch=1, seconds=7.0, score=slow, clock=lambda: now[0])
    plan = planner.plan(head.now(), head.controls[0])
    assert (plan.stopped, len(plan.scores), plan.seconds) == ("time", 3, 6.0)
    scores: Iterator[float] = iter([0.2, 0.9, 0.1])
    certain = head.planner(world, candidates=9, batch=1, certain=0.8, score=lambda video: next(scores))
    plan = certain.plan(head.now(), head.controls[0])
    assert (plan.stopped, plan.score, len(plan.scores)) == ("certain", 0.9, 2)


def test_a_planner_carries_on_what_it_chose_unless_something_is_better_by_the_margin(
    world: WorldLine, head: Start
) -> None:
    for margin, score in ((0.2, 0.5), (0.05, 0.6)):
        # The first choice looks for nothing that is kept: its third candidate wins by less than the margin. At the second
        # the first of the three is what is left of it.
        scores: Iterator[float] = iter([0.75, 0.7, 0.8, 0.5, 0.6, 0.1])

        def scored(video: Trajectory, scores: Iterator[float] = scores) -> float:
            return next(scores)

        planner = head.planner(world, candidates=3, margin=margin, score=scored)
        first = planner.plan(head.now(), head.controls[0], horizon=2)
        assert first.score == 0.8
        second = planner.plan(head.now(), first.controls[-1], horizon=1)
        assert second.score == second.scores[0] == score
        assert np.array_equal(second.sequence, first.sequence[16:]) == (score == 0.5)


def test_what_a_planner_cannot_use_is_named(world: WorldLine, head: Start) -> None:
    def broken(video: Trajectory) -> float:
        raise KeyError("no cup")

    def proposing(*shape: int) -> Callable:
        return lambda situation, number, random: np.zeros((number, *shape))

    cases = {
        "score function of a planner failed": {"score": broken},
        "not a finite number": {"score": lambda video: float("nan")},
        "Proposals do not fit": {"propose": proposing(15, 14)},
    }
    for message, options in cases.items():
        planner = head.planner(world, **options)
        with pytest.raises(DataError, match=message):
            planner.plan(head.now(), head.controls[0])
        assert planner._past == {}
    with pytest.raises(ConfigError, match="no such solver"):
        head.planner(world, solver="adam")
    with pytest.raises(ConfigError, match="horizon"):
        head.planner(world, horizon=0)
    with pytest.raises(ConfigError, match="a margin of at least 0"):
        head.planner(world, margin=float("nan"))


def test_proposals_from_recordings_go_on_where_the_episode_is() -> None:
    rows = np.arange(40.0).reshape(2, 10, 2)
    situation = Situation({}, np.zeros(2), frames=4, executed=8)
    drawn = recorded(rows)(situation, 5, np.random.default_rng(0))
    assert {tuple(found[:, 0]) for found in drawn} == {(16.0, 18.0, 18.0, 18.0), (36.0, 38.0, 38.0, 38.0)}
    held = drawn_around(0.0)(situation, 3, np.random.default_rng(0))
    assert np.array_equal(held, np.zeros((3, 4, 2)))


def test_a_goal_picture_is_nearest_to_itself(shipped: Path, start: Start) -> None:
    encoder = load_teacher(shipped / "models" / "teacher")
    score = GoalPicture(encoder, {"head": start.frames["head"][16]})
    frames = partial(Trajectory, start.instruction, fps=8.0)
    reached, begun = (frames(frames={"head": start.frames["head"][:n]}) for n in (17, 1))
    assert score(reached) == pytest.approx(1.0, abs=1e-5)
    assert score(begun) < 0.99
    with pytest.raises(DataError, match="view of the goal is not predicted"):
        GoalPicture(encoder, {"left_wrist": start.frames["head"][0]})(reached)
    with pytest.raises(DataError, match="at least one view"):
        GoalPicture(encoder, {})


@pytest.mark.slow
def test_the_example_of_the_documentation_runs(
    project_root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (project_root / "docs" / "planning.md").read_text()
    monkeypatch.chdir(project_root)
    exec(text.split("```python\n")[1].split("```")[0], {})  # noqa: S102
    assert capsys.readouterr().out.count("stopped by") == 2
