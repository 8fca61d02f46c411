import itertools

import numpy as np
import pytest

from worldline_core.evaluation.policy.evidence import (
    GraspEvidence,
    LiftEvidence,
    MotionEvidence,
    Reconciliation,
    StateChangeEvidence,
    establishes_success,
    overturns,
    route,
)
from worldline_core.evaluation.policy.judge import (
    Extracted,
    first_pass_indices,
    judge_trajectory,
    motion_indices,
    verification_indices,
)
from worldline_core.evaluation.recordings import Trajectory
from worldline_core.evaluation.vlm import parse_answer

FACTS = (True, False, None)


@pytest.mark.parametrize(("held", "wrong"), itertools.product(FACTS, FACTS))
def test_grasp_truth_table(held, wrong):
    evidence = GraspEvidence(target_held_for_two_late_steps=held, wrong_object_or_drop=wrong)
    assert establishes_success(evidence) == ((held, wrong) == (True, False))


@pytest.mark.parametrize(("moved", "held", "on_support", "wrong"), itertools.product(FACTS, repeat=4))
def test_lift_truth_table(moved, held, on_support, wrong):
    evidence = LiftEvidence(
        head_view_confirms_target_displacement=moved,
        target_held_for_two_late_steps=held,
        target_on_original_support_at_end=on_support,
        wrong_object_or_drop=wrong,
    )
    assert establishes_success(evidence) == ((moved, held, on_support, wrong) == (True, True, False, False))


@pytest.mark.parametrize(("done", "wrong"), itertools.product(FACTS, FACTS))
def test_state_change_truth_tables_of_all_passes(done, wrong):
    evidence = StateChangeEvidence(required_final_state_visible=done, wrong_object_or_drop=wrong)
    assert establishes_success(evidence) == ((done, wrong) == (True, False))
    assert overturns(done, evidence) == (done is True and wrong is not True)


@pytest.mark.parametrize(
    ("instruction", "family"),
    [
        ("lift the red cube", "lift"),
        ("Pick up the cup", "lift"),
        ("pick up the cup and place it on the tray", "state_change"),
        ("place the blue cube on the green pad", "state_change"),
        ("push the yellow drawer closed", "state_change"),
        ("attempt to grasp the bottle", "grasp"),
        ("grasp the bottle and lift it", "lift"),
        ("press the bell", "state_change"),
        ("folding the towel", "state_change"),
        ("do something", "state_change"),
    ],
)
def test_routing(instruction, family):
    assert route(instruction) == family


WELL_FORMED = (
    '{"target_held_for_two_late_steps": true, "wrong_object_or_drop": false, "observations": "x", "confidence": 80}'
)


@pytest.mark.parametrize(
    "answer",
    [
        WELL_FORMED,
        f"Here is the evidence:\n```json\n{WELL_FORMED}\n```\nThat is all.",
        f'{{"note": "first thoughts"}} {WELL_FORMED}',
        WELL_FORMED[:-1] + ', "verdict": "success"}',
        WELL_FORMED.replace("80", '"high"').replace('"x"', "null"),
    ],
)
def test_answers_are_found_in_what_surrounds_them(answer):
    evidence, well_formed = parse_answer(GraspEvidence, answer)
    assert well_formed
    assert evidence.target_held_for_two_late_steps is True


@pytest.mark.parametrize(
    "answer",
    [
        "",
        "The object is held.",
        "{",
        '{"target_held_for_two_late_steps": "true", "wrong_object_or_drop": false}',
        '{"target_held_for_two_late_steps": 1, "wrong_object_or_drop": false}',
        '{"required_final_state_visible": true, "wrong_object_or_drop": false}',
        '["target_held_for_two_late_steps", true]',
        WELL_FORMED[:40],
        "{" * 5000,
    ],
)
def test_malformed_answers_become_null_evidence(answer):
    evidence, well_formed = parse_answer(GraspEvidence, answer)
    assert not well_formed
    assert evidence == GraspEvidence()
    assert not establishes_success(evidence)


def test_first_pass_is_denser_towards_the_end():
    indices = first_pass_indices(129)
    assert len(indices) == 12
    assert (indices[0], indices[-1]) == (0, 128)
    assert indices[1] == round(np.sqrt(1 / 11) * 128)
    assert np.all(np.diff(np.diff(indices)) <= 1)
    assert verification_indices(101) == (0, 65, 78, 88, 95, 100)
    assert len(motion_indices(129)) == 12
    assert first_pass_indices(3) == (0, 1, 2)


class ScriptedJudge:
    """Gives prepared answers and remembers what it was asked."""

    name = "scripted"

    def __init__(self, extracts, reconciliation=None, motion=None):
        self.extracts, self.reconciliation, self.motion = list(extracts), reconciliation, motion
        self.asked = []

    def extract(self, trajectory, family, indices, height_px):
        self.asked.append(("extract", len(indices), height_px))
        return self.extracts.pop(0)

    def reconcile(self, trajectory, selected, first, verification):
        self.asked.append(("reconcile", selected, first, verification))
        return Extracted(Reconciliation(observations_prove_completion=self.reconciliation))

    def inspect_motion(self, trajectory, indices, earlier):
        self.asked.append(("motion", len(indices), earlier))
        return Extracted(MotionEvidence(task_effect_completed=self.motion))


def _trajectory(instruction: str, views=("head", "left_wrist")) -> Trajectory:
    return Trajectory(instruction, {view: np.zeros((129, 8, 8, 3), np.uint8) for view in views}, 8.0)


def _state(done, wrong=False, text="") -> Extracted:
    return Extracted(
        StateChangeEvidence(required_final_state_visible=done, wrong_object_or_drop=wrong, observations=text)
    )


def test_success_of_the_first_pass_asks_nothing_more():
    judge = ScriptedJudge([_state(True)])
    result = judge_trajectory(judge, _trajectory("press the bell"))
    assert (result.success, result.decided_by, len(judge.asked)) == (True, "first_pass", 1)
    assert judge.asked[0] == ("extract", 12, 360)


def test_unsuccessful_state_change_goes_through_every_pass():
    judge = ScriptedJudge([_state(False, text="one"), _state(None, text="two")])
    result = judge_trajectory(judge, _trajectory("press the bell"))
    assert not result.success
    assert [statement["pass"] for statement in result.statements] == [
        "first_pass",
        "verification",
        "reconciliation",
        "motion",
    ]
    assert judge.asked[1:] == [("extract", 6, 480), ("reconcile", "two", "one", "two"), ("motion", 12, "two")]


@pytest.mark.parametrize(
    ("reconciliation", "motion", "decided_by"), [(True, None, "reconciliation"), (None, True, "motion")]
)
def test_later_passes_can_establish_success(reconciliation, motion, decided_by):
    judge = ScriptedJudge([_state(None), _state(None)], reconciliation, motion)
    result = judge_trajectory(judge, _trajectory("press the bell"))
    assert (result.success, result.decided_by) == (True, decided_by)


def test_a_drop_that_was_seen_is_never_overturned():
    judge = ScriptedJudge([_state(False, wrong=True), _state(False, wrong=True)], True, True)
    assert not judge_trajectory(judge, _trajectory("place the cup on the tray")).success


def test_single_view_skips_the_group_verification_and_grasp_skips_the_motion_check():
    judge = ScriptedJudge([_state(None)])
    result = judge_trajectory(judge, _trajectory("press the bell", views=("head",)))
    assert [statement["pass"] for statement in result.statements] == ["first_pass", "reconciliation", "motion"]
    grasp = ScriptedJudge([Extracted(GraspEvidence()), Extracted(GraspEvidence())])
    result = judge_trajectory(grasp, _trajectory("grasp the cup"))
    assert [statement["pass"] for statement in result.statements] == ["first_pass", "verification"]


def test_malformed_answers_are_counted_and_never_successful():
    null = Extracted(LiftEvidence(), well_formed=False)
    result = judge_trajectory(ScriptedJudge([null, null]), _trajectory("lift the cup"))
    assert (result.success, result.malformed_answers, result.answers) == (False, 2, 3)
