"""Section "Action maps": where the controls fall in each view, over the frames and as the model sees them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from worldline_core.actions.overlay_views import overlay_sheet
from worldline_core.actions.overlays import SIGMA_PX_REFERENCE, OverlayStyle, heat_picture
from worldline_core.errors import DataError
from worldline_core.pictures.contact_sheet import SheetRow, contact_sheet, evenly_spaced
from worldline_core.report.context import ReportContext, Section
from worldline_core.report.markup import Column, Html, element, figure, join, notice, number, table
from worldline_core.store.artifact_files import read_json

if TYPE_CHECKING:
    from worldline_core.actions.episode_tracks import ActionTracks, EpisodeTracks
    from worldline_core.data.episodes.episode_set import EpisodeSet

TITLE = "Action maps"
LATENT_PIXELS = 8
CAUSES = ("valid", "behind_camera", "outside_image", "invalid_calibration")
CHANNEL_LABELS = ("heat", "depth", "rot 1", "rot 2", "rot 3", "rot 4", "rot 5", "rot 6", "gripper")


def actions_section(context: ReportContext) -> Section:
    """Overlays of a few episodes in three views."""
    from worldline_core.actions.episode_tracks import ActionTracks

    folder = context.inputs.get("render_actions")
    if folder is None:
        return Section("actions", TITLE, missing="no ActionTracks were given (input render_actions).")
    episodes = context.episodes
    if episodes is None:
        return Section(
            "actions", TITLE, missing="the episodes of the ActionTracks were not given (inputs filter or curate)."
        )
    tracks = ActionTracks.open(folder)
    cards: list[Html] = []
    for index in one_an_embodiment(context):
        row = episodes.rows[index]
        if row.episode_id not in tracks:
            continue
        try:
            picture = episode_overlay(episodes, index, tracks.tracks(row.episode_id), sigma_of(context))
        except DataError as error:
            cards.append(notice(f"No overlay of {row.episode_id}: {error.what}"))
            continue
        image = context.picture(f"actions_{len(cards)}", picture, alt=f"Action maps over {row.episode_id}", photo=True)
        caption = join(element("strong", row.embodiment), f" · {row.instruction} · {row.episode_id}")
        cards.append(figure(image, caption, class_="wide"))
    lead = (
        "The commanded tool poses, projected into every view with the recorded calibration. The heat is the Gaussian that carries"
        " all nine channels (orange: left arm, blue: right arm); the ring's radius shows the gripper's opening, the triad the"
        " tool's axes. Maps depend on controls, kinematics and calibration only, never on a future picture."
    )
    body = join(cards, channels_figure(context, tracks)) if cards else notice("The set holds no episode with tracks.")
    return Section("actions", TITLE, lead, join(body, masked_table(folder)))


def masked_table(folder: Path) -> Html:
    """How many samples (frame, view, arm) are valid, and why the others are masked to zero."""
    counts = read_json(folder / "summary.json").get("by_embodiment", {})
    causes = [cause for cause in CAUSES if any(cause in numbers for numbers in counts.values())]
    if not causes:
        return Html("")
    rows = []
    for name, numbers in sorted(counts.items()):
        total = sum(numbers.get(cause, 0) for cause in causes) or 1
        shown = [
            join(
                number(numbers.get(c, 0)),
                element("span", f"{100 * numbers.get(c, 0) / total:.0f}\u202f%", class_="interval"),
            )
            for c in causes
        ]
        rows.append([name, numbers.get("episodes"), *shown])
    columns = [Column("Embodiment"), Column("Episodes", numeric=True)]
    columns += [Column(cause.replace("_", " ").capitalize(), numeric=True) for cause in causes]
    return table(
        columns,
        rows,
        caption="Samples (one a frame, view and arm). Only valid ones are drawn; the others are masked to zero and counted.",
    )


def sigma_of(context: ReportContext) -> float:
    """Sigma on the reference canvas with which the tracks' previews were drawn."""
    config = context.inputs.manifest("render_actions").get("config") or {}
    return float(config.get("sigma_px_ref", SIGMA_PX_REFERENCE))


def channels_figure(context: ReportContext, tracks: ActionTracks) -> Html:
    """The nine channels of one moment in each view, on the latent grid: what the model is given."""
    from worldline_core.actions.action_maps import CHANNELS, render_action_maps
    from worldline_core.actions.episode_tracks import collate_tracks

    episodes = context.episodes
    chosen = [i for i in one_an_embodiment(context) if episodes is not None and episodes.rows[i].episode_id in tracks]
    if episodes is None or not chosen:
        return Html("")
    row = episodes.rows[chosen[0]]
    found = tracks.tracks(row.episode_id)
    moment = found.num_frames // 2
    height, width = found.image_size
    grid = (max(1, height // LATENT_PIXELS), max(1, width // LATENT_PIXELS))
    maps = render_action_maps(collate_tracks([found.clip([moment])]), found.image_size, grid, sigma_of(context))[
        0, :, :, 0
    ].numpy()
    rows = [
        SheetRow(
            view.replace("_", " "), np.stack([heat_picture(maps[v, c], tile_height=96) for c in range(len(CHANNELS))])
        )
        for v, view in enumerate(found.views)
    ]
    picture = contact_sheet(rows, tile_height=96, column_titles=CHANNEL_LABELS, upscale="nearest")
    image = context.picture("action_channels", picture, alt="The nine channels of an action map")
    caption = (
        f"What the model is given: the nine channels at frame {moment} of {row.episode_id}, on a latent grid of {grid[0]} by {grid[1]} cells"
        " (red positive, blue negative, each channel on its own scale)."
    )
    return figure(image, caption, class_="wide")


def one_an_embodiment(context: ReportContext) -> list[int]:
    """The first episode of each embodiment with several views, held-out scenes preferred."""
    episodes = context.episodes
    if episodes is None:
        return []
    order = sorted(
        range(len(episodes)),
        key=lambda i: (episodes.rows[i].split not in ("test", "ood_test"), episodes.rows[i].episode_id),
    )
    chosen: dict[str, int] = {}
    for index in order:
        row = episodes.rows[index]
        if row.bank is None and len(row.views) > 1:
            chosen.setdefault(row.embodiment, index)
    return [chosen[name] for name in sorted(chosen)][: context.config.overlay_episodes]


def episode_overlay(
    episodes: EpisodeSet, index: int, tracks: EpisodeTracks, sigma_px_ref: float = SIGMA_PX_REFERENCE
) -> NDArray[np.uint8]:
    """Four moments of an episode in every view, with what the tracks say drawn over them.

    Raises:
        DataError: the episode has no view with a track, or its frames cannot be decoded.
    """
    row = episodes.rows[index]
    moments = evenly_spaced(min(tracks.num_frames, row.video_frames), 4)
    frames = {view: np.asarray(episodes.frames(index, view, moments)) for view in tracks.views if view in row.views}
    return overlay_sheet(frames, tracks, moments, style=OverlayStyle(sigma_px_ref))
