"""Page "Predicted videos": truth and predictions side by side, in each view, with recordings to open in 3-D."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError
from worldline_core.pages.page import words
from worldline_core.pictures.labels import draw_tag
from worldline_core.pictures.side_by_side import compose_side_by_side, write_side_by_side, write_video
from worldline_core.report.context import ReportContext, Section
from worldline_core.report.methods import Method, in_order
from worldline_core.report.video_scores import ChosenEpisode, choose_episodes

TITLE = "Predicted videos"
GROUPS = {
    "shipped": "Long-trained: the checkpoints that ship with the project",
    "run": "This run: what its own short training reached",
}


def chosen_episodes(context: ReportContext) -> list[ChosenEpisode]:
    """The episodes shown in video, the same for every page; the first is the median of the held-out ones."""
    if context.episodes is None:
        return []
    known = {row.episode_id for row in context.episodes.rows}
    predicted = sorted({name for rollout in context.rollouts.values() for name in rollout.episode_ids if name in known})
    return choose_episodes(context.video_scores, context.config.primary_method, predicted)


def videos_section(context: ReportContext) -> Section:
    """A card for each chosen episode."""
    if not context.inputs.variants("rollout"):
        return Section("videos", TITLE, missing="no RolloutSet was given (inputs rollout.<method>).")
    if context.episodes is None:
        return Section("videos", TITLE, missing="the recorded episodes were not given (inputs filter or curate).")
    chosen = chosen_episodes(context)
    if not chosen:
        return Section("videos", TITLE, missing="no RolloutSet holds an episode of the given EpisodeSet.")
    lead = "Every column starts from the same first frame; from there on a model sees only the controls."
    if any(item.score is not None for item in chosen):
        lead += (
            " The episodes are not chosen by hand: they are the median, the best and the worst by the robot IoU of the first"
            " model's prediction."
        )
    return context.section(
        "videos", TITLE, lead, cards=[card(context, context.episodes, item, i) for i, item in enumerate(chosen)]
    )


def card(context: ReportContext, episodes: EpisodeSet, item: ChosenEpisode, number: int) -> dict[str, Any]:
    """One episode: what it is, its videos by view, and the recordings beside it."""
    row = episodes.rows[episodes.position(item.episode_id)]
    views = [view for view in VIEWS if view in row.views]
    wanted = [(view, group) for view in views for group in GROUPS]
    # The report runs last and alone; encoder and resizing let go of the interpreter, so threads use the other cores.
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        videos = list(pool.map(lambda place: video(context, item, place[0], place[1], number), wanted))
    panels = []
    for view in views:
        made = [found for (of, _), found in zip(wanted, videos, strict=True) if of == view and found is not None]
        if made:
            widest = max(found["video"].width for found in made)
            panels.append((view, [{**found, "share": found["video"].width / widest} for found in made]))
    return {
        "item": item, "row": row, "number": number, "panels": panels,
        "tone": {"success": "good", "failure": "bad"}.get(row.outcome, ""), "recordings": recordings(context, item, number),
    }  # fmt: skip


def methods_of_group(context: ReportContext, episode_id: str, group: str) -> list[Method]:
    """Methods with a prediction of this episode: those with the group's weights, then baselines without any."""
    methods = in_order([name for name, rollout in context.rollouts.items() if episode_id in rollout.episode_ids])
    own = [m for m in methods if m.group == group]
    return [*own, *[m for m in methods if m.group == "baseline"]][: context.config.max_columns - 1] if own else []


def predicted_frames(context: ReportContext, name: str, episode_id: str, view: str) -> np.ndarray:
    """The first seed's prediction of a view, `n h w 3`."""
    rollout = context.rollouts[name]
    return np.asarray(rollout.frames(episode_id, view, rollout.seeds(episode_id)[0]))


def video(context: ReportContext, item: ChosenEpisode, view: str, group: str, number: int) -> dict[str, Any] | None:
    """Truth and one group's predictions of one view, with a caption; None when the group has none."""
    episodes = context.episodes
    methods = methods_of_group(context, item.episode_id, group)
    if episodes is None or not methods:
        return None
    index = episodes.position(item.episode_id)
    columns: dict[str, np.ndarray] = {"true": np.asarray(episodes.frames(index, view))}
    unreadable: list[str] = []
    for method in methods:
        try:
            columns[method.label] = predicted_frames(context, method.name, item.episode_id, view)
        except DataError as error:
            unreadable.append(f"{method.label}: {error.what}")
    made = write_side_by_side(
        context.media / f"episode{number}_{group}_{view}.mp4", columns, episodes.rows[index].fps,
        tile_height=context.config.tile_height, upscale=context.config.upscale,
    )  # fmt: skip
    caption = f"{GROUPS[group]} ({words(view)} view, {made.num_frames} frames). Columns: {', '.join(columns)}."
    return {"video": made, "caption": caption, "unreadable": unreadable}


def recordings(context: ReportContext, item: ChosenEpisode, number: int) -> list[str]:
    """Names of the Rerun and MCAP files written below run/recordings (a Rerun recording's bytes are not reproducible)."""
    from worldline_core.actions.episode_tracks import ActionTracks
    from worldline_core.exports.rollout import export_rollout

    formats = [name for name, wanted in (("rrd", context.config.rerun), ("mcap", context.config.mcap)) if wanted]
    shown = {m.name for group in GROUPS for m in methods_of_group(context, item.episode_id, group)}
    if context.episodes is None or not formats:
        return []
    folder = context.inputs.get("render_actions")
    written = export_rollout(
        {name: rollout for name, rollout in context.rollouts.items() if name in shown}, context.episodes,
        None if folder is None else ActionTracks.open(folder), item.episode_id, context.output / "run" / "recordings",
        formats=formats, name=f"episode{number}",
    )  # fmt: skip
    return [path.name for path in written]


def overview_video(context: ReportContext) -> dict[str, Any] | None:
    """Truth beside the first model's prediction, one row per view, of the first chosen episode; None without one."""
    episodes = context.episodes
    if episodes is None or not context.inputs.variants("rollout"):
        return None
    for item in chosen_episodes(context)[:1]:
        methods = [m for group in GROUPS for m in methods_of_group(context, item.episode_id, group)]
        if not methods:
            return None
        method = next((m for m in methods if m.name == context.config.primary_method), methods[0])
        index = episodes.position(item.episode_id)
        row = episodes.rows[index]
        rows = []
        for view in [v for v in VIEWS if v in row.views]:
            true = np.asarray(episodes.frames(index, view))
            predicted = predicted_frames(context, method.name, item.episode_id, view)
            columns = (
                {"recorded": true, f"predicted, {method.label}": predicted} if not rows else {"": true, " ": predicted}
            )
            frames = compose_side_by_side(columns, tile_height=192, labels=not rows)
            rows.append(np.stack([draw_tag(frame, words(view), corner="bottom-left") for frame in frames]))
        count = min(len(frames) for frames in rows)
        made = write_video(context.media / "overview.mp4", np.concatenate([f[:count] for f in rows], axis=1), row.fps)
        return {"video": made, "item": item, "row": row, "method": method}
    return None
