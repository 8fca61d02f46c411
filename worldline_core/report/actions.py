"""Page "Action maps": where the controls fall in each view, over the frames and as the model sees them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from markupsafe import Markup

from worldline_core.actions.action_maps import render_action_maps
from worldline_core.actions.episode_tracks import ActionTracks, collate_tracks
from worldline_core.actions.overlays import heat_picture
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError
from worldline_core.pages.page import Table, number, percent, with_note, words
from worldline_core.pictures import SheetRow, contact_sheet
from worldline_core.report.context import ReportContext, Section
from worldline_core.report.episode_sheet import episode_overlay
from worldline_core.store.artifact_files import read_json

TITLE = "Action maps"
LATENT_PIXELS = 8
CAUSES = ("valid", "behind_camera", "outside_image", "invalid_calibration")
CHANNEL_LABELS = ("heat", "depth", "rot 1", "rot 2", "rot 3", "rot 4", "rot 5", "rot 6", "gripper")


def actions_section(context: ReportContext) -> Section:
    """Overlays of a few episodes in three views, and the nine channels of one moment."""
    folder = context.inputs.get("render_actions")
    if folder is None:
        return Section("actions", TITLE, missing="no ActionTracks were given (input render_actions).")
    episodes = context.episodes
    if episodes is None:
        return Section(
            "actions", TITLE, missing="the episodes of the ActionTracks were not given (inputs filter or curate)."
        )
    tracks = ActionTracks.open(folder)
    chosen = [i for i in first_per_embodiment(context, episodes) if episodes.rows[i].episode_id in tracks]
    overlays, unreadable = [], []
    for index in chosen:
        row = episodes.rows[index]
        try:
            picture = episode_overlay(episodes, index, tracks.tracks(row.episode_id), tracks.sigma_px_ref)
        except DataError as error:
            unreadable.append(f"No overlay of {row.episode_id}: {error.what}")
            continue
        name = f"actions_{len(overlays)}"
        overlays.append((context.picture(name, picture, alt=f"Action maps over {row.episode_id}", photo=True), row))
    lead = (
        "The commanded tool poses, projected into every view with the recorded calibration. The heat is the Gaussian that carries"
        " all nine channels (orange: left arm, blue: right arm); the ring's radius shows the gripper's opening, the triad the"
        " tool's axes. Maps depend on controls, kinematics and calibration only, never on a future picture."
    )
    channels = channels_picture(context, episodes, tracks, chosen[0]) if chosen else None
    return context.section(
        "actions", TITLE, lead, overlays=overlays, unreadable=unreadable, channels=channels, counts=sample_table(folder)
    )


def sample_table(folder: Path) -> Table | None:
    """How many samples (frame, view, arm) are valid, and why the others are masked to zero."""
    counts = read_json(folder / "summary.json").get("by_embodiment", {})
    causes = [cause for cause in CAUSES if any(cause in numbers for numbers in counts.values())]
    rows = []
    for name, numbers in sorted(counts.items()):
        total = sum(numbers.get(cause, 0) for cause in causes) or 1
        found = [numbers.get(cause, 0) for cause in causes]
        shares = [with_note(number(count), percent(count / total)) for count in found]
        rows.append([name, numbers.get("episodes"), *shares])
    headings = ["Embodiment", "Episodes", *[words(cause).capitalize() for cause in causes]]
    caption = (
        "Samples (one per frame, view and arm). Only valid ones are drawn; the others are masked to zero and counted."
    )
    return Table(headings, rows, range(1, len(headings)), caption) if causes else None


def channels_picture(
    context: ReportContext, episodes: EpisodeSet, tracks: ActionTracks, index: int
) -> tuple[Markup, str]:
    """The nine channels of one moment in each view, on the latent grid: what the model is given; and its caption."""
    name = episodes.rows[index].episode_id
    found = tracks.tracks(name)
    moment = found.num_frames // 2
    grid = (max(1, found.image_size[0] // LATENT_PIXELS), max(1, found.image_size[1] // LATENT_PIXELS))
    clip = collate_tracks([found.clip([moment])])
    maps = render_action_maps(clip, found.image_size, grid, tracks.sigma_px_ref)[0, :, :, 0].numpy()
    rows = [
        SheetRow(words(view), np.stack([heat_picture(channel, tile_height=96) for channel in maps[v]]))
        for v, view in enumerate(found.views)
    ]
    picture = contact_sheet(rows, tile_height=96, column_titles=CHANNEL_LABELS, upscale="nearest")
    caption = (
        f"What the model is given: the nine channels at frame {moment} of {name}, on a latent grid of {grid[0]} by {grid[1]}"
        " cells (red positive, blue negative, each channel on its own scale)."
    )
    return context.picture("action_channels", picture, alt="The nine channels of an action map"), caption


def first_per_embodiment(context: ReportContext, episodes: EpisodeSet) -> list[int]:
    """The first episode of each embodiment with several views, held-out scenes preferred."""
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
