"""Choosing among predicted videos, what commands alone would choose, and planning in closed loop on the shipped causal model."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

from tests.rollout.conftest import ROBOT
from worldline_core import WorldLine
from worldline_core.errors import ConfigError, DataError
from worldline_core.evaluation import shortcuts
from worldline_core.evaluation.planning import bracket
from worldline_core.evaluation.planning.closed_loop import ClosedLoopPlanner, Situation, judged, recorded
from worldline_core.evaluation.recordings import Trajectory
from worldline_core.evaluation.segmenters.learned import LearnedSegmenter
from worldline_core.rollout.simulation import CommandedRobot


def load(candidate):
    """The candidate's number is all that its video shows."""
    return bracket.CandidateVideo({"head": np.full((1, 1, 1, 3), candidate, np.uint8)}, (0,), 8.0, 1)


class PerfectSelector:
    """Knows how good every candidate is."""

    name = "perfect"

    def __init__(self, quality, ties=False):
        self.quality, self.ties = quality, ties
        self.shown = []

    def _of(self, candidate):
        return self.quality[int(candidate.frames["head"][0, 0, 0, 0])]

    def compare(self, instruction, candidates, select_count):
        self.shown.append(tuple(int(c.frames["head"][0, 0, 0, 0]) for c in candidates.values()))
        ranked = sorted(candidates, key=lambda letter: self._of(candidates[letter]), reverse=True)
        return tuple(ranked[:select_count]), True

    def score(self, instruction, candidate):
        return 50.0 if self.ties else float(self._of(candidate)), True


def pick(selector, candidates, *, scene="s", seed=0):
    return bracket.choose(selector, "task", candidates, load, scene=scene, seed=seed)


ROUNDS = {1: [1], 2: [2], 3: [3], 4: [4], 5: [5], 8: [8, 4], 16: [16, 8, 4], 24: [24, 12, 6, 4], 32: [32, 16, 8, 4]}


@pytest.mark.parametrize("count", ROUNDS)
@pytest.mark.parametrize("ties", [False, True])
def test_a_perfect_selector_wins_after_rounds_that_halve(count, ties):
    quality = np.random.default_rng(count).permutation(100)[:count]
    choice = pick(PerfectSelector(quality, ties), range(count))
    assert choice.candidate == int(np.argmax(quality))
    if count >= 4 and count != 5:
        assert [len(members) for members in choice.rounds] == ROUNDS[count]
        assert len(choice.scores) == 4


def test_groups_of_four_and_the_order_depends_on_scene_and_seed_only():
    selector = PerfectSelector(np.arange(16))
    pick(selector, range(16), scene="kitchen", seed=3)
    assert [len(group) for group in selector.shown] == [4, 4, 4, 4, 4, 4]
    assert [c for group in selector.shown[:4] for c in group] == bracket.shown_order(range(16), "kitchen", 3)
    assert bracket.shown_order([3, 1, 2, 0], "kitchen", 3) == bracket.shown_order(range(4), "kitchen", 3)
    orders = [bracket.shown_order(range(16), *key) for key in (("kitchen", 3), ("garage", 3), ("kitchen", 4))]
    assert all(one != other for one, other in itertools.combinations([*orders, list(range(16))], 2))


def test_answers_that_name_nobody_are_counted_and_filled_up():
    class Silent(PerfectSelector):
        def compare(self, instruction, candidates, select_count):
            return ("Z", "A", "A"), True

    choice = pick(Silent(np.zeros(8)), range(8))
    # Two comparisons name one valid letter each; the tie-break names A, which is valid.
    assert (choice.malformed_answers, choice.answers) == (2, 7)
    assert choice.candidate == bracket.shown_order(range(8), "s", 0)[0]
    for candidates in ([], [1, 1]):
        with pytest.raises(DataError, match="distinct"):
            pick(PerfectSelector(np.arange(4)), candidates)


def test_sixteen_frames_ten_over_the_whole_and_six_late():
    indices = bracket.planning_indices(129)
    assert (len(indices), indices[0], indices[-1]) == (16, 0, 128)
    whole = {round(p * 128) for p in np.linspace(0, 1, 10)}
    assert whole <= set(indices)
    assert all(index >= 0.6 * 128 for index in set(indices) - whole)
    assert len(bracket.planning_indices(33)) == 16
    assert bracket.planning_indices(5) == (0, 1, 2, 3, 4)


class ScriptedModel:
    name = "scripted"

    def __init__(self, text):
        self.text, self.parts = text, []

    def answer(self, parts):
        self.parts.append(parts)
        return self.text


@pytest.mark.parametrize(
    ("text", "score"),
    [
        ('{"task_completed": true, "score": 85, "final_state": "up", "failure_reason": ""}', 85.0),
        *((text, None) for text in ("no idea", '{"score": "85"}', '{"score": 850}', '{"score": true}')),
    ],
)
def test_vlm_selector_reads_labels_and_scores_and_malformed_ones_are_zero(text, score):
    assert bracket.VLMSelector(ScriptedModel(text)).score("lift it", load(0)) == (score or 0.0, score is not None)
    videos = {letter: load(index) for index, letter in enumerate("ABCD")}
    model = ScriptedModel('Sure: {"selected_labels": ["b", "D"], "reason": "held"}')
    assert bracket.VLMSelector(model).compare("lift it", videos, 2) == (("B", "D"), True)
    assert "exactly 2 candidate" in model.parts[0][-1].text


THING, PLACE = np.array([0.4, 0.1, 0.0]), np.array([0.4, -0.1, 0.0])
FRAMES, CLOSED = 17, 8


def facts(instruction, targets, ends, *things, opens=FRAMES):
    """Candidates whose tool goes to its target from above in 8 frames, closes there, and goes on to its end; it opens at ``opens``."""
    time = np.arange(FRAMES)[None, :, None] / CLOSED
    start, there, on = targets + np.array([0.0, 0.0, 0.2]), np.minimum(time, 1.0), np.maximum(time - 1.0, 0.0)
    paths = start[:, None] + there * (targets - start)[:, None] + on * (ends - targets)[:, None]
    gripper = np.ones((len(targets), FRAMES, 1))
    gripper[:, CLOSED:opens] = 0.0
    return shortcuts.BankFacts(instruction, paths, shortcuts.Reach(paths[:, :, None], gripper, things or (THING,)))


def near(*offsets, place=THING):
    return place + np.array(offsets)


RISEN = near((0, 0, 0.2))


def test_the_medoid_is_the_sequence_most_like_the_others_shown():
    targets = near((0.3, 0, 0), (0, 0, 0), (0.02, 0, 0), (-0.02, 0, 0), (-0.4, 0, 0))
    chosen = shortcuts.medoid(facts("lift the red cube", targets, targets + np.array([0, 0, 0.2])))
    assert chosen(range(5)) == 1
    assert chosen([0, 1, 2]) == 2


@pytest.mark.parametrize(
    ("bank", "best"),
    [
        (facts("lift the red cube", near((0.2, 0, 0), (0.01, 0, 0), (0, 0.1, 0)), np.repeat(RISEN, 3, axis=0)), 1),
        (facts("lift the red cube", near((0, 0, 0), (0.01, 0, 0)), near((0, 0, 0.01), (0.01, 0, 0.2))), 1),
        (
            facts(
                "place the red cube on the blue pad", near(*[(0, 0, 0)] * 3), near((0.1, 0, 0), (0, 0, 0), (0, 0, 0.1), place=PLACE),
                THING, PLACE, opens=16,
            ),
            1,
        ),
        (facts("push the red drawer closed", near(*[(0, 0, 0)] * 4), near((0.05, 0, 0), (0.15, 0, 0), (0.14, 0, 0), (0.12, 0.12, 0))), 1),
        (facts("press the red button", near((0, 0, 0.05), (0.05, 0, 0), (0, 0, 0)), np.repeat(RISEN, 3, axis=0)), 2),
    ],
    ids=["grasp at the thing", "rise with it", "let go at the destination", "push far and straight", "come down on it"],
)  # fmt: skip
def test_the_rule_written_by_hand(bank, best):
    assert int(np.argmax(np.asarray(shortcuts.hand_rule(bank)))) == best


def test_without_tracks_or_a_named_thing_only_commands_choose():
    blind = shortcuts.BankFacts("lift it", facts("lift it", near((0, 0, 0)), RISEN).commands, None)
    assert shortcuts.nearest_hand(blind) is shortcuts.hand_rule(blind) is None
    assert {name for name, make in shortcuts.FEATURES.items() if make(blind) is not None} == {
        "trees_commands", "trees_commands_less_mean",
    }  # fmt: skip


def test_trees_learn_from_other_banks_alone():
    generator = np.random.default_rng(3)
    features = {f"bank_{n:02d}": generator.normal(size=(24, 6)) for n in range(12)}
    outcomes = {name: own[:, 0] > 0 for name, own in features.items()}
    scores = shortcuts.tree_scores(features, outcomes)
    assert np.mean([outcomes[name][int(np.argmax(own))] for name, own in scores.items()]) == 1.0
    flipped = shortcuts.tree_scores(features, outcomes | {"bank_03": ~outcomes["bank_03"]})
    assert np.array_equal(flipped["bank_03"], scores["bank_03"])
    assert not np.array_equal(flipped["bank_04"], scores["bank_04"])
    for end in (False, True):
        alike = {name: np.full(24, end) for name in features}
        assert set(shortcuts.tree_scores(features, alike)["bank_00"]) == {float(end)}
    assert shortcuts.tree_scores({"alone": features["bank_00"]}, outcomes | {"alone": outcomes["bank_00"]}) == {}


def test_verdicts_without_video_are_learned_from_other_starts_of_the_task(monkeypatch):
    generator = np.random.default_rng(5)
    misses = {f"bank_{n:02d}": generator.uniform(0.0, 0.1, 6) for n in range(12)}
    made = {
        bank: facts("lift the red cube", near(*[(miss, 0, 0) for miss in own]), np.repeat(RISEN, 6, axis=0))
        for bank, own in misses.items()
    }
    monkeypatch.setattr(shortcuts, "bank_facts", lambda episodes, tracks, rows: made[rows[0].bank])

    def verdicts(flipped=()):
        rows = [
            SimpleNamespace(episode_id=f"{bank}-{n}", bank=bank, outcome=("failure", "success")[(miss < 0.05) != (bank in flipped)])
            for bank, own in misses.items()
            for n, miss in enumerate(own)
        ]  # fmt: skip
        tasks = {row.episode_id: "other" if row.bank == "bank_11" else "lift" for row in rows}
        found = shortcuts.verdicts_without_video(None, None, rows, tasks)["hand_rule"]
        right = {row.episode_id: found[row.episode_id] == (row.outcome == "success") for row in rows}
        return found, right

    found, right = verdicts()
    assert np.mean([right[name] for name in right if not name.startswith("bank_11")]) > 0.9
    assert not any(found[f"bank_11-{n}"] for n in range(6))  # no other start of its task
    own = [f"bank_03-{n}" for n in range(6)]
    by_others = verdicts(flipped=("bank_03",))[0]
    assert [by_others[name] for name in own] == [found[name] for name in own]
    by_own = verdicts(flipped=misses.keys() - {"bank_03"})[0]
    assert [by_own[name] for name in own] != [found[name] for name in own]


@pytest.fixture(scope="module")
def start(held_out):
    return held_out[0]


@pytest.fixture
def planner_of(world, start):
    """Makes planners that propose the recorded commands with noise."""

    def around(situation, count, random):
        rows = start.controls[1:][np.minimum(situation.executed + np.arange(situation.frames), 31)]
        return rows + random.normal(0, 0.02, (count, *rows.shape))

    usual = {
        "embodiment": ROBOT, "instruction": start.episode.instruction, "propose": around, "score": lambda video: 0.0,
        "candidates": 2, "horizon": 1,
    }  # fmt: skip
    return lambda **options: ClosedLoopPlanner(world, start.cameras, **usual | options)


@pytest.fixture(scope="session")
def shipped(project_root):
    return project_root / "artifacts" / "shipped"


@pytest.fixture(scope="module")
def world(shipped):
    return WorldLine.from_pretrained(shipped / "models" / "causal")


@pytest.mark.slow
def test_a_horizon_of_the_whole_episode_is_open_loop_best_of_n(world, start, shipped, planner_of):
    candidates = np.stack([start.controls[1:], start.controls[1:] + 0.03, start.controls[1:][::-1]])
    selector = bracket.measured_selector(LearnedSegmenter.load(shipped / "models" / "segmenter"))
    options = {"propose": recorded(candidates), "score": judged(selector), "candidates": 3, "batch": 2, "horizon": 2}
    planner = planner_of(**options, limits=False)
    plan = planner.plan(start.images, start.controls[0])
    scores = []
    for controls in candidates:
        rows = np.concatenate((start.controls[:1], controls))
        frames = world.predict(start.images, rows, start.cameras, embodiment=ROBOT)
        shown = bracket.shown_video(Trajectory(start.episode.instruction, frames, world.contract.fps))
        scores.append(selector.score(start.episode.instruction, shown)[0] / 100)
    assert np.array_equal(plan.scores, np.sort(scores)[::-1])
    assert np.array_equal(plan.sequence, candidates[int(np.argmax(scores))])
    assert np.array_equal(plan.controls, plan.sequence[:16]) and plan.model_calls == 6


@pytest.mark.slow
def test_the_next_choice_begins_at_what_was_really_seen(start, planner_of):
    videos = []

    def watched(video):
        videos.append(video)
        return 0.0

    planner = planner_of(score=watched, candidates=1, horizon=2, limits=False)
    first = planner.plan(start.images, start.controls[0])
    seen = {view: video[1:] for view, video in start.frames.items()}
    second = planner.plan(seen, start.controls[16], horizon=1)
    # Among equals what is left of the last choice comes first.
    assert np.array_equal(second.sequence, first.sequence[16:])
    assert [video.num_frames for video in videos] == [33, 33]
    shown, shrunk = videos[1].frames["head"], planner._shrunk(start.frames["head"])
    assert np.array_equal(shown[:16], shrunk[:16])
    # The picture that the prediction begins at is shown as the model sees it.
    assert np.abs(shown[16].astype(int) - shrunk[16]).mean() < 6
    assert not np.isnan(videos[1].points[16:]).all()
    # Wrist cameras were carried along: they are where the recording says.
    cameras = planner._begin({view: video[-1] for view, video in seen.items()}, start.controls[16])._starts.cameras[0]
    for view in ("left_wrist", "right_wrist"):
        begun, there = (start.episode.cameras[view].T_base_camera[frame][:3, 3] for frame in (0, 16))
        assert np.linalg.norm(cameras[view].T_base_camera[:3, 3] - there) < 0.02
        assert np.linalg.norm(there - begun) > 0.1 or view != "right_wrist"


def test_a_planner_stays_within_the_limits_of_the_robot(start, planner_of):
    def still(video):
        return -float(np.abs(np.diff(video.frames["head"][[0, 16]].astype(float), axis=0)).mean())

    def far(situation, count, random):
        return situation.state + random.normal(0, 1.5, (count, situation.frames, len(situation.state)))

    planner = planner_of(propose=far, score=still, candidates=3, batch=2)
    plan = planner.plan(start.images, start.controls[0])
    assert plan.score == plan.scores.max() == plan.scores[0]
    assert len(plan.scores) == plan.model_calls == 3
    robot = CommandedRobot(planner.kinematics, 8.0, start.controls[:1], limits=True)
    assert np.array_equal(robot.follow(plan.sequence[None])[1][0], plan.sequence)
    wild = start.controls[0] + np.full((1, 16, 14), 3.0)
    assert not np.array_equal(robot.follow(wild)[1], wild)


@pytest.mark.slow
def test_a_planner_carries_on_what_it_chose_unless_something_is_better_by_the_margin(start, planner_of):
    for margin, score in ((0.2, 0.5), (0.05, 0.6)):
        # The first choice looks for nothing that is kept: its second candidate wins. At the second the first of the two is
        # what is left of it, and the other is better by 0.1.
        scores = iter([0.7, 0.8, 0.5, 0.6])

        def scored(video, scores=scores):
            return next(scores)

        planner = planner_of(candidates=2, margin=margin, score=scored)
        first = planner.plan(start.images, start.controls[0], horizon=2)
        assert first.score == 0.8
        second = planner.plan(start.images, first.controls[-1], horizon=1)
        assert second.score == second.scores[0] == score
        assert np.array_equal(second.sequence, first.sequence[16:]) == (score == 0.5)


def test_what_a_planner_cannot_use_is_named(start, planner_of):
    for message, options in (
        ("not a finite number", {"score": lambda video: float("nan")}),
        ("Proposals do not fit", {"propose": lambda situation, number, random: np.zeros((number, 15, 14))}),
    ):
        planner = planner_of(**options)
        with pytest.raises(DataError, match=message):
            planner.plan(start.images, start.controls[0])
        assert planner._past == {}
    for message, options in (("horizon", {"horizon": 0}), ("a margin of at least 0", {"margin": float("nan")})):
        with pytest.raises(ConfigError, match=message):
            planner_of(**options)


def test_proposals_from_recordings_go_on_where_the_episode_is():
    rows = np.arange(40.0).reshape(2, 10, 2)
    situation = Situation({}, np.zeros(2), frames=4, executed=8)
    drawn = recorded(rows)(situation, 5, np.random.default_rng(0))
    assert {tuple(found[:, 0]) for found in drawn} == {(16.0, 18.0, 18.0, 18.0), (36.0, 38.0, 38.0, 38.0)}


@pytest.mark.slow
def test_the_example_of_the_documentation_runs(project_root, monkeypatch, capsys):
    text = (project_root / "docs" / "planning.md").read_text()
    monkeypatch.chdir(project_root)
    exec(text.split("```python\n")[1].split("```")[0], {})  # noqa: S102
    assert capsys.readouterr().out.count("model calls") == 2
