"""Section "Predicted videos": truth and predictions side by side, in each view, with recordings to open in 3-D."""

from __future__ import annotations

import logging

import numpy as np

from worldline_core.data.episodes.episode import VIEWS
from worldline_core.errors import DataError
from worldline_core.pictures.side_by_side import SideBySide, write_side_by_side
from worldline_core.report.context import ReportContext, Section
from worldline_core.report.markup import Html, element, figure, join, notice, paragraph
from worldline_core.report.methods import Method, in_order
from worldline_core.report.selection import ChosenEpisode, choose_episodes

logger = logging.getLogger(__name__)

TITLE = "Predicted videos"


def chosen_episodes(context: ReportContext) -> list[ChosenEpisode]:
    """The episodes shown in video, the same for every section."""
    episodes = context.episodes
    if episodes is None:
        return []
    known = {row.episode_id for row in episodes.rows}
    predicted = sorted({name for rollout in context.rollouts.values() for name in rollout.episode_ids if name in known})
    return choose_episodes(context.video_scores, context.config.primary_method, predicted)


def rollouts_section(context: ReportContext) -> Section:
    """A card for each chosen episode."""
    if not context.inputs.variants("rollout"):
        return Section("videos", TITLE, missing="no RolloutSet was given (inputs rollout.<method>).")
    if context.episodes is None:
        return Section("videos", TITLE, missing="the recorded episodes were not given (inputs filter or curate).")
    chosen = chosen_episodes(context)
    if not chosen:
        return Section("videos", TITLE, missing="no RolloutSet holds an episode of the given EpisodeSet.")
    ranked = any(item.score is not None for item in chosen)
    lead = join(
        "Every column starts from the same first frame; from there on a model sees only the controls. ",
        "The episodes are not chosen by hand: they are the median, the best and the worst by the robot IoU of the first"
        " model's prediction."
        if ranked
        else None,
    )
    slow = element("button", "Slow motion", type="button", data_speed="slow", aria_pressed="false")
    cards = [card(context, item, number) for number, item in enumerate(chosen)]
    return Section("videos", TITLE, lead, join(slow, cards))


def card(context: ReportContext, item: ChosenEpisode, number: int) -> Html:
    """One episode: what it is, a tab a view, and the recordings beside it."""
    episodes = context.episodes
    if episodes is None:
        return Html("")
    row = episodes.rows[episodes.position(item.episode_id)]
    tags = [row.embodiment, row.scene, row.task_family.replace("_", " ")]
    outcome = {"success": "good", "failure": "bad"}.get(row.outcome, "")
    score = "" if item.score is None else f" (robot IoU {item.score:.2f})"
    head = element(
        "div",
        element("h3", row.instruction or row.episode_id),
        [element("span", tag, class_="tag") for tag in tags],
        element("span", f"recorded outcome: {row.outcome}", class_=f"tag {outcome}".strip()),
        class_="cardhead",
    )
    panels: list[tuple[str, Html]] = []
    for view in [v for v in VIEWS if v in row.views]:
        made = [
            found for group in ("shipped", "run") if (found := video(context, item, view, group, number)) is not None
        ]
        if made:
            widest = max(piece.width for piece, _ in made)
            panels.append((view, join(video_figure(piece, widest, caption) for piece, caption in made)))
    buttons = [
        element("button", view.replace("_", " "), type="button", role="tab", data_panel=f"e{number}_{view}")
        for view, _ in panels
    ]
    tabs = element("div", buttons, class_="tabs", role="tablist", aria_label="Views")
    bodies = [element("div", body, id=f"e{number}_{view}", role="tabpanel") for view, body in panels]
    note = paragraph(f"Shown as the {item.reason}{score}. ", element("code", item.episode_id), class_="muted")
    shown_tabs = tabs if len(panels) > 1 else None
    return element(
        "article",
        head,
        note,
        shown_tabs,
        bodies,
        player(),
        downloads(context, item, number),
        class_="card",
        data_player=True,
    )


def player() -> Html:
    """One set of controls for all videos of a card; the page's script brings it to life."""
    icon = element("svg", element("path", d="M4 2l9 6-9 6z"), viewBox="0 0 16 16", aria_hidden="true")
    button = element("button", icon, type="button", aria_label="Play")
    slider = element("input", type="range", min=0, max=1, step=0.01, value=0, aria_label="Time")
    return element("div", button, slider, element("output", ""), class_="player", hidden=True)


def columns_of_group(context: ReportContext, episode_id: str, group: str) -> list[Method]:
    """Methods with a prediction of this episode: those with the group's weights, then baselines without any."""
    names = [name for name, rollout in context.rollouts.items() if episode_id in rollout.episode_ids]
    methods = in_order(names)
    own = [m for m in methods if m.group == group]
    return [*own, *[m for m in methods if m.group == "baseline"]][: context.config.max_columns - 1] if own else []


def predicted_frames(context: ReportContext, name: str, episode_id: str, view: str) -> np.ndarray:
    """The first seed's prediction of a view, `n h w 3`."""
    rollout = context.rollouts[name]
    return np.asarray(rollout.frames(episode_id, view, rollout.seeds(episode_id)[0]))


def video(
    context: ReportContext, item: ChosenEpisode, view: str, group: str, number: int
) -> tuple[SideBySide, Html] | None:
    """Truth and one group's predictions of one view, with a caption; None when the group has none."""
    episodes = context.episodes
    methods = columns_of_group(context, item.episode_id, group)
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
    path = context.media / f"episode{number}_{group}_{view}.mp4"
    made = write_side_by_side(
        path, columns, episodes.rows[index].fps, tile_height=context.config.tile_height, upscale=context.config.upscale
    )
    text = {
        "shipped": "Long-trained: the checkpoints that ship with the project",
        "run": "This run: what its own minutes of training reached",
    }[group]
    caption = join(
        f"{text} ({view.replace('_', ' ')} view, {made.num_frames} frames).", [notice(line) for line in unreadable]
    )
    return made, caption


def video_figure(made: SideBySide, widest: int, caption: Html) -> Html:
    """A silent looping video; columns are equally wide in all videos of a panel."""
    share = made.width / widest
    shown = element(
        "video", src=f"media/{made.video.name}", poster=f"media/{made.poster.name}", width=made.width, height=made.height,
        muted=True, loop=True, playsinline=True, controls=True, preload="auto", style=f"--width: {100 * share:.3f}%; --share: {share:.4f}",
    )  # fmt: skip
    return figure(shown, caption, class_="row")


def downloads(context: ReportContext, item: ChosenEpisode, number: int) -> Html:
    """Writes the Rerun and MCAP recordings of an episode and links them."""
    formats = [name for name, wanted in (("rrd", context.config.rerun), ("mcap", context.config.mcap)) if wanted]
    if not formats:
        return Html("")
    written = recordings(context, item, number, formats)
    if not written:
        return Html("")
    links = [join(element("a", name, href=f"run/recordings/{name}", download=True), "  ") for name in written]
    return element(
        "details",
        element("summary", "Open in 3-D: cameras, tool poses, action maps, joint signals"),
        paragraph(
            "A Rerun recording (",
            element("code", "rerun <file>"),
            ") and an MCAP file a method (for Foxglove): ",
            links,
        ),
    )


def recordings(context: ReportContext, item: ChosenEpisode, number: int, formats: list[str]) -> list[str]:
    """Names of the files written below run/recordings (a Rerun recording's bytes are not reproducible)."""
    from worldline_core.actions.episode_tracks import ActionTracks
    from worldline_core.exports.rollout import export_rollout

    episodes = context.episodes
    if episodes is None:
        return []
    folder = context.inputs.get("render_actions")
    predictions = {
        m.name: context.rollouts[m.name]
        for group in ("shipped", "run")
        for m in columns_of_group(context, item.episode_id, group)
    }
    written = export_rollout(
        predictions,
        episodes,
        ActionTracks.open(folder) if folder is not None else None,
        item.episode_id,
        context.output / "run" / "recordings",
        formats=tuple(formats),
        name=f"episode{number}",
    )
    return [path.name for path in written]
