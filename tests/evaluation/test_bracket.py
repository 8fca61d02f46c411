import numpy as np
import pytest

from worldline_core.errors import DataError
from worldline_core.evaluation.planning.bracket import (
    CandidateScore,
    CandidateVideo,
    Comparison,
    VLMSelector,
    choose,
    planning_indices,
    shown_order,
)


def load(candidate: int) -> CandidateVideo:
    """The candidate's number is all that its video shows."""
    return CandidateVideo({"head": np.full((1, 1, 1, 3), candidate, np.uint8)}, (0,), 8.0, 1)


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
        return Comparison(tuple(ranked[:select_count]))

    def score(self, instruction, candidate):
        return CandidateScore(50.0 if self.ties else float(self._of(candidate)))


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 8, 16, 24, 32])
@pytest.mark.parametrize("ties", [False, True])
def test_a_perfect_selector_wins(count, ties):
    quality = np.random.default_rng(count).permutation(100)[:count]
    choice = choose(PerfectSelector(quality, ties), "task", range(count), load, scene="s", seed=0)
    assert choice.candidate == int(np.argmax(quality))


def test_rounds_halve_down_to_four_finalists():
    sizes = {}
    for count in (4, 8, 16, 24, 32):
        choice = choose(PerfectSelector(np.arange(count)), "task", range(count), load, scene="s", seed=0)
        sizes[count] = [len(members) for members in choice.rounds]
        assert len(choice.scores) == 4
    assert sizes == {4: [4], 8: [8, 4], 16: [16, 8, 4], 24: [24, 12, 6, 4], 32: [32, 16, 8, 4]}


def test_groups_of_four_and_the_order_depends_on_scene_and_seed_only():
    selector = PerfectSelector(np.arange(16))
    choose(selector, "task", range(16), load, scene="kitchen", seed=3)
    assert [len(group) for group in selector.shown] == [4, 4, 4, 4, 4, 4]
    assert [c for group in selector.shown[:4] for c in group] == shown_order(range(16), "kitchen", 3)
    assert shown_order([3, 1, 2, 0], "kitchen", 3) == shown_order(range(4), "kitchen", 3)
    assert shown_order(range(16), "kitchen", 3) != shown_order(range(16), "garage", 3)
    assert shown_order(range(16), "kitchen", 3) != shown_order(range(16), "kitchen", 4)
    assert shown_order(range(16), "kitchen", 3) != list(range(16))


def test_smaller_budgets_are_prefixes():
    quality = np.array([1, 9, 3, 4, 50, 2, 60, 5])
    picks = {n: choose(PerfectSelector(quality), "t", range(n), load, scene="s", seed=0).candidate for n in (2, 4, 8)}
    assert picks == {2: 1, 4: 1, 8: 6}


def test_answers_that_name_nobody_are_counted_and_filled_up():
    class Silent(PerfectSelector):
        def compare(self, instruction, candidates, select_count):
            return Comparison(("Z", "A", "A"), well_formed=True)

    choice = choose(Silent(np.zeros(8)), "t", range(8), load, scene="s", seed=0)
    # Two comparisons name one valid letter each; the tie-break names A, which is valid.
    assert (choice.malformed_answers, choice.answers) == (2, 7)
    first_shown = shown_order(range(8), "s", 0)
    assert choice.candidate == first_shown[0]


def test_no_candidates_or_doubles_are_refused():
    for candidates in ([], [1, 1]):
        with pytest.raises(DataError, match="distinct"):
            choose(PerfectSelector(np.arange(4)), "t", candidates, load, scene="s", seed=0)


def test_sixteen_frames_ten_over_the_whole_and_six_late():
    indices = planning_indices(129)
    assert len(indices) == 16
    assert (indices[0], indices[-1]) == (0, 128)
    whole = {round(p * 128) for p in np.linspace(0, 1, 10)}
    assert whole <= set(indices)
    assert all(index >= 0.6 * 128 for index in set(indices) - whole)
    assert len(planning_indices(33)) == 16
    assert planning_indices(5) == (0, 1, 2, 3, 4)


class ScriptedModel:
    name = "scripted"

    def __init__(self, text):
        self.text, self.parts = text, []

    def answer(self, parts):
        self.parts.append(parts)
        return self.text


def test_vlm_selector_reads_labels_and_scores():
    videos = {letter: load(index) for index, letter in enumerate("ABCD")}
    model = ScriptedModel('Sure: {"selected_labels": ["b", "D"], "reason": "held"}')
    assert VLMSelector(model).compare("lift it", videos, 2) == Comparison(("B", "D"), True)
    assert "exactly 2 candidate" in model.parts[0][-1].text
    answer = VLMSelector(
        ScriptedModel('{"task_completed": true, "score": 85, "final_state": "up", "failure_reason": ""}')
    )
    assert answer.score("lift it", videos["A"]).score == 85.0


@pytest.mark.parametrize("text", ["no idea", '{"score": "85"}', '{"score": 850}', '{"score": true}'])
def test_malformed_scores_are_zero(text):
    score = VLMSelector(ScriptedModel(text)).score("lift it", load(0))
    assert (score.score, score.well_formed) == (0.0, False)
