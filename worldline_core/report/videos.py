"""Page "Predicted videos": truth and predictions side by side, in each view.

Episodes are never picked by hand: shown are the best, the median and the worst by a stated score.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.video.frames import VideoFrames
from worldline_core.errors import DataError
from worldline_core.evaluation.recordings import stride_of
from worldline_core.pages.page import words
from worldline_core.pictures import SheetRow, WrittenVideo, evenly_spaced, write_side_by_side
from worldline_core.report.context import GROUPS, SPLIT_LABELS, Method, ReportContext, Section, VideoScores, in_order
from worldline_core.rollout.rollout_set import RolloutSet

TITLE = "Predicted videos"
MOST_COLUMNS, IN_A_LINE = 6, 3
"""Width of one video: a phone shows three columns beside each other."""
MOMENTS = 6


class ChosenEpisode(NamedTuple):
    """An episode, the reason why it is shown, and its score."""

    episode_id: str
    reason: str
    score: float | None = None


def best_median_worst(values: Mapping[str, float], *, lower_is_better: bool = False) -> list[tuple[str, str, float]]:
    """(label, episode, value) of the median, best and worst of a score; ties by name."""
    ranked = sorted(values.items(), key=lambda item: (-item[1] if lower_is_better else item[1], item[0]))
    chosen: dict[tuple[str, float], str] = {}
    for label, place in (("median", (len(ranked) - 1) // 2), ("best", -1), ("worst", 0)) if ranked else ():
        chosen.setdefault(ranked[place], label)
    return [(label, *item) for item, label in chosen.items()]


def choose_episodes(scores: VideoScores, available: Sequence[str]) -> list[ChosenEpisode]:
    """Median, best and worst by the main method's headline of the first held-out group, and the median of every further one.

    ``available`` have predicted videos; without scores the first, middle and last of them are taken.
    """
    chosen: list[ChosenEpisode] = []
    for group in scores.groups:
        first = scores.primary(group)
        metric = first and scores.headline(group, first.name)
        if first is None or metric is None or group == "train":
            continue
        values = scores.series.get(f"video/{group}/{first.name}/{metric.name}@head", {})
        shown = {name: value for name, value in values.items() if name in available}
        ranked = best_median_worst(shown, lower_is_better=metric.lower_is_better)[: 1 if chosen else 3]
        where = f"of {len(values)} on {SPLIT_LABELS[group]}"
        chosen += [ChosenEpisode(episode, f"{label} {where}", value) for label, episode, value in ranked]
    ordered = sorted(available)
    return chosen or [
        ChosenEpisode(ordered[i], f"number {i + 1} of {len(ordered)} by name (no scores)")
        for i in evenly_spaced(len(ordered), 3)
    ]


def videos_section(context: ReportContext) -> Section:
    """A card for each chosen episode."""
    episodes, predicted = context.episodes, {n for rollout in context.rollouts.values() for n in rollout.episode_ids}
    known = predicted & {row.episode_id for row in episodes.rows} if episodes else set[str]()
    chosen = choose_episodes(context.video_scores, sorted(known)) if known else []
    if episodes is None or not chosen:
        missing = "no prediction of a given episode was given (inputs rollout.<method>, and filter or curate)."
        return Section("videos", TITLE, missing=missing)
    lead = "Every column starts from the same first frame; from there on a model sees only the controls."
    if any(item.score is not None for item in chosen):
        lead += (
            " The episodes are not chosen by hand: they are the median, the best and the worst by the first model's prediction of"
            " the robot."
        )
    cards = [card(context, episodes, *item) for item in enumerate(chosen)]
    context.first_card = next((found for found in cards if found["panels"]), None)
    return context.section("videos", TITLE, lead, cards=cards)


def methods_of_group(context: ReportContext, episode_id: str, group: str) -> list[Method]:
    """Methods with a prediction of this episode: those with the group's weights, then baselines without any."""
    methods = in_order([name for name, rollout in context.rollouts.items() if episode_id in rollout.episode_ids])
    own = [m for m in methods if m.group == group]
    return [*own, *[m for m in methods if m.group == "baseline"]][: MOST_COLUMNS - 1] if own else []


def card(context: ReportContext, episodes: EpisodeSet, number: int, item: ChosenEpisode) -> dict[str, Any]:
    """One episode: its description, and by view the truth beside each group's predictions."""
    name, position = item.episode_id, episodes.position(item.episode_id)
    row = episodes.rows[position]

    def panel(view: str) -> tuple[str, list[tuple[WrittenVideo, str]]]:
        written: list[tuple[WrittenVideo, str]] = []
        for group in ("shipped", "run"):
            shown = [(m.label, context.rollouts[m.name]) for m in methods_of_group(context, name, group)]
            columns = {
                label: VideoFrames(videos.clip(name, view)) for label, videos in shown if view in videos.views(name)
            }
            if columns:
                columns = {"true": VideoFrames(episodes.clip(position, view)), **columns}
                path, height = context.media / f"episode{number}_{group}_{view}.mp4", context.config.tile_height
                made = write_side_by_side(path, columns, row.fps, tile_height=height, most=IN_A_LINE)
                written.append((made, f"{GROUPS[group].capitalize()} ({words(view)} view, {made.num_frames} frames)."))
        return view, written

    # The report runs last and alone; encoder and resizing let go of the interpreter, so threads use the other cores.
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        panels = [found for found in pool.map(panel, [view for view in VIEWS if view in row.views]) if found[1]]
    return {"item": item, "row": row, "number": number, "panels": panels}


def compared_rows(rollout: RolloutSet, episodes: EpisodeSet, episode_id: str, views: Sequence[str]) -> list[SheetRow]:
    """Moments of an episode in some views, recorded above predicted, for a contact sheet.

    Raises: DataError when the set has no prediction of this episode.
    """
    if episode_id not in rollout.episode_ids:
        raise DataError("No prediction of this episode", where=rollout.root, got=episode_id)
    position, rows = episodes.position(episode_id), list[SheetRow]()
    stride = stride_of(rollout, episodes.rows[position])
    for view in views:
        predicted = VideoFrames(rollout.clip(episode_id, view))
        moments = evenly_spaced(len(predicted), MOMENTS)
        recorded = np.asarray(episodes.frames(position, view, [stride * moment for moment in moments]))
        rows.append(SheetRow(f"{words(view)}, recorded", recorded))
        rows.append(SheetRow(f"{words(view)}, predicted by {rollout.method}", predicted[moments]))
    return rows
