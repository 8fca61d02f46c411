"""Pictures of a night: the recordings that lost most, recorded above predicted."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.video.frames import VideoFrames
from worldline_core.evaluation.recordings import HEAD, stride_of
from worldline_core.pictures.contact_sheet import SheetRow, contact_sheet, evenly_spaced
from worldline_core.pictures.labels import jpeg_bytes
from worldline_core.report.night_changes import NightlyComparison
from worldline_core.rollout.rollout_set import RolloutSet
from worldline_core.store.artifact_files import digest_value
from worldline_core.store.atomic import write_bytes_atomic

FOLDER = "pictures"
MOST_PICTURES = 4
MOMENTS = 6


def write_night_pictures(history: Path, compared: NightlyComparison, artifacts: Mapping[str, Path]) -> dict[str, str]:
    """Head views of the recordings that lost most, or of the first recording of each method when none did.

    Args:
        artifacts: ``filter`` (the episodes) and ``rollout.<method>``; without them there are no pictures.

    Returns:
        files below ``history`` by what they show; those of the night before are removed.
    """
    shutil.rmtree(history / FOLDER, ignore_errors=True)
    rollouts = {
        name.partition(".")[2]: RolloutSet.open(path) for name, path in artifacts.items() if name.startswith("rollout.")
    }
    if "filter" not in artifacts or not rollouts:
        return {}
    episodes = EpisodeSet.open(artifacts["filter"])
    recorded = {row.episode_id for row in episodes.rows}
    written: dict[str, str] = {}
    for method, recording in _wanted(compared, rollouts):
        rollout = rollouts.get(method)
        what = f"{recording}, {method}"
        if rollout is None or recording not in recorded or what in written or len(written) == MOST_PICTURES:
            continue
        if HEAD not in rollout.views(recording):
            continue
        predicted, position = VideoFrames(rollout.clip(recording, HEAD)), episodes.position(recording)
        moments = evenly_spaced(len(predicted), MOMENTS)
        stride = stride_of(rollout, episodes.rows[position])
        true = episodes.frames(position, HEAD, [stride * moment for moment in moments])
        rows = [SheetRow("recorded", true), SheetRow(f"predicted by {method}", predicted[moments])]
        file = f"{FOLDER}/{digest_value([compared.night, what])[:16]}.jpg"
        write_bytes_atomic(history / file, jpeg_bytes(contact_sheet(rows, title=f"{compared.night}: {recording}")))
        written[what] = file
    return written


def _wanted(compared: NightlyComparison, rollouts: Mapping[str, RolloutSet]) -> Iterator[tuple[str, str]]:
    """(method, recording) in the order of interest."""
    lost = [(change.metric.split("/")[2], recording) for change in compared.worse for recording, _ in change.worst]
    yield from lost or [(method, rollout.episode_ids[0]) for method, rollout in rollouts.items()]
