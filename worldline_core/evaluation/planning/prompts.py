"""Prompts P1 and P2 of the paper's appendix "Embodied Planning"; their content is kept as printed."""

from __future__ import annotations

_COMPARE = """\
Compare these candidates and select the {select_count} most likely to actually complete the task. Prioritize correct \
final object state, then valid grasp/contact and placement. Reject partial progress, drops, and physical \
inconsistencies. Ignore visual quality unless it prevents judging. You must return exactly {select_count} candidate \
label(s), even if every candidate appears to fail; in that case choose the least unsuccessful. Reply only as JSON using \
the displayed letter labels:
{{"selected_labels": ["A"], "reason": "<brief comparative reason>"}}"""

_SCORE = """\
Judge this candidate independently. Determine whether the predicted trajectory ends with the task actually completed. \
Check the initial and final object state, valid grasp/contact, correct placement, drops, and physical inconsistencies. \
Mere contact or partial progress is not completion. Ignore visual quality unless it prevents judging. Give a 0-100 \
task-success score. Reply only as JSON:
{"task_completed": <true or false>, "score": <integer>,
 "final_state": "<brief description>", "failure_reason": "<brief reason or empty>"}"""


def compare_prompt(select_count: int) -> str:
    """P1, the part after the videos."""
    return _COMPARE.format(select_count=select_count)


def score_prompt() -> str:
    """P2, the part after the video."""
    return _SCORE
