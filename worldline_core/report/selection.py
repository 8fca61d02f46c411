"""Which episodes the report shows in video: the best, the median and the worst by a stated score, never hand-picked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from worldline_core.report.video_scores import SPLIT_LABELS, VideoScores


@dataclass(frozen=True)
class ChosenEpisode:
    """An episode and why it is shown."""

    episode_id: str
    reason: str
    score: float | None = None
    split: str = ""


def best_median_worst(values: Mapping[str, float]) -> list[tuple[str, str, float]]:
    """(label, episode, value) of the median, best and worst of a score where higher is better; ties by name."""
    ranked = sorted(values.items(), key=lambda item: (item[1], item[0]))
    if not ranked:
        return []
    places = [("median", (len(ranked) - 1) // 2), ("best", len(ranked) - 1), ("worst", 0)]
    chosen: list[tuple[str, str, float]] = []
    for label, place in places:
        name, value = ranked[place]
        if name not in {episode for _, episode, _ in chosen}:
            chosen.append((label, name, value))
    return chosen


def choose_episodes(scores: VideoScores, primary: str | None, available: Sequence[str]) -> list[ChosenEpisode]:
    """Median, best and worst of the first held-out group, and the median of every further one.

    Args:
        primary: the method whose robot IoU ranks the episodes.
        available: episodes that have predicted videos; without scores the first, middle and last of them are taken.
    """
    known = set(available)
    chosen: list[ChosenEpisode] = []
    for group in scores.groups:
        first = scores.primary(group, primary)
        metric = scores.iou_metric(group, first.name) if first is not None else None
        if first is None or metric is None or group == "train":
            continue
        values = {k: v for k, v in scores.per_episode(first.name, metric, "head", group).items() if k in known}
        ranked = best_median_worst(values)
        where = SPLIT_LABELS.get(group, group)
        for label, episode, value in ranked if not chosen else ranked[:1]:
            reason = f"{label} of {len(values)} on {where}"
            chosen.append(ChosenEpisode(episode, reason, value, group))
    if chosen or not available:
        return chosen
    ordered = sorted(known)
    places = sorted({0, len(ordered) // 2, len(ordered) - 1})
    return [
        ChosenEpisode(ordered[i], f"number {i + 1} of {len(ordered)} by name (no scores were given)") for i in places
    ]
