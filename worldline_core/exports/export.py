"""Episodes and predictions in formats of other tools: MCAP (Foxglove), Rerun, LeRobotDataset v3, WorldArena."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.data.curation.source_table import SOURCES_FILE
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.episodes.episode_set_writer import EpisodeSetWriter
from worldline_core.data.episodes.recorded_poses import with_rigid_poses
from worldline_core.data.episodes.view_recording import RecordedView
from worldline_core.data.guards.source_paths import safe_stem
from worldline_core.data.lerobot.dataset import LeRobotV3Dataset
from worldline_core.data.mcap.exported import write_episode_mcap
from worldline_core.data.video.encoder import PixelFormat, encode_video
from worldline_core.data.video.frames import VideoFrames
from worldline_core.data.video.header import check_video_header
from worldline_core.errors import ArtifactError, ConfigError, DataError, WorldLineError
from worldline_core.exports.rerun_recording import RecordingContent, write_rerun_recording
from worldline_core.exports.rollout import FORMATS as ROLLOUT_FORMATS
from worldline_core.exports.rollout import MCAP_FORMATS, export_rollout, mcap_file, shown_tracks
from worldline_core.pictures import png_bytes
from worldline_core.rollout.rollout_set import RolloutSet
from worldline_core.store.artifact_files import kind_of, linked_folder
from worldline_core.store.atomic import atomic_path, write_bytes_atomic, write_json_atomic
from worldline_core.store.store import folder_lock

logger = logging.getLogger(__name__)

WORLDARENA = "worldarena"
EPISODE_FORMATS = ("lerobot", *MCAP_FORMATS, "rrd")
# Stream copies keep the stored videos as they are; this is for what has to be encoded again (a cut not at a key frame).
_CRF, _PRESET = 10, "veryfast"


def export(
    artifact: Path,
    output: Path,
    formats: Sequence[str],
    *,
    episode_ids: Sequence[str] = (),
    outcome: str | None = None,
    episodes: Path | None = None,
) -> list[Path]:
    """Write episodes of an EpisodeSet, or predictions of a RolloutSet, below a folder.

    Args:
        formats: of an EpisodeSet `lerobot` (a set of its own: LeRobotDatasets with the sidecar, whole even where the
            artifact refers to another one's), `mcap`, `mcap-ros2` and
            `rrd` (one file per episode); of a RolloutSet all but `lerobot`, and `mp4` and
            `worldarena` (`export_worldarena`).
        episode_ids: which episodes; none: all.
        outcome: of an EpisodeSet only recordings that ended so (``success``: demonstrations to train a policy on).
        episodes: the EpisodeSet that predictions belong to; default: the one that their manifest names.

    Returns: the files, or the folder of the new set.

    Raises: ConfigError for a format that the artifact does not have; DataError for an unknown episode; ArtifactError for
        another kind of artifact, or while another command exports into the folder.
    """
    kind = kind_of(artifact)
    offered = {"EpisodeSet": EPISODE_FORMATS, "RolloutSet": (*ROLLOUT_FORMATS, WORLDARENA)}.get(kind)
    if offered is None:
        raise ArtifactError("This kind is not exported", where=artifact, expected="EpisodeSet or RolloutSet", got=kind)
    unknown = [wanted for wanted in formats if wanted not in offered]
    if unknown or not formats:
        raise ConfigError(f"Not a format of {kind}", expected=", ".join(offered), got=", ".join(unknown) or "none")
    if outcome is not None and kind != "EpisodeSet":
        raise ConfigError(
            "Predictions are not chosen by outcome", where=artifact, got=outcome, next_step="name episodes"
        )
    with folder_lock(output):
        if kind == "EpisodeSet":
            return _export_episodes(EpisodeSet.open(artifact), output, formats, episode_ids, outcome)
        return _export_rollouts(artifact, output, formats, episode_ids, episodes)


def _export_episodes(
    episodes: EpisodeSet, output: Path, formats: Sequence[str], episode_ids: Sequence[str], outcome: str | None
) -> list[Path]:
    positions = [episodes.position(name) for name in episode_ids] if episode_ids else list(range(len(episodes)))
    positions = [position for position in positions if outcome in (None, episodes.rows[position].outcome)]
    if not positions:
        ended = sorted({row.outcome for row in episodes.rows})
        raise DataError("No episode is exported", where=episodes.root, expected=f"an outcome of {ended}", got=outcome)
    written: list[Path] = []
    if "lerobot" in formats:
        written.append(export_lerobot(episodes, output / "lerobot" if len(formats) > 1 else output, positions))
    output.mkdir(parents=True, exist_ok=True)
    stems = [safe_stem(episodes.rows[position].episode_id) for position in positions]
    if len(set(stems)) != len(stems):
        twice = next(stem for stem in stems if stems.count(stem) > 1)
        raise DataError("Two episodes would get one file name", where=output, got=twice, next_step="export them apart")
    for position in positions if {*MCAP_FORMATS, "rrd"} & set(formats) else ():
        row, episode = episodes.rows[position], episodes.episode(position)
        frames = {view: VideoFrames(episodes.clip(position, view)) for view in row.views}
        stem = safe_stem(row.episode_id)
        for wanted in (each for each in MCAP_FORMATS if each in formats):
            masks = {view: mask for view in row.views if (mask := episodes.robot_masks(position, view)) is not None}
            written.append(mcap_file(output, stem, wanted))
            write_episode_mcap(written[-1], episode, frames, masks, encoding=MCAP_FORMATS[wanted])
        if "rrd" in formats:
            tracks = None
            try:
                tracks = shown_tracks(episode)
            except WorldLineError as error:
                logger.warning("%s.rrd has no tool poses: %s (%s)", stem, error.what, error.where)
            content = RecordingContent(episode, frames, tracks=tracks, joint_names=episode.state_names or ())
            written.append(output / f"{stem}.rrd")
            write_rerun_recording(written[-1], content)
    return written


def export_lerobot(episodes: EpisodeSet, output: Path, positions: Sequence[int]) -> Path:
    """Write rows of a set as a set of its own, whose datasets lie inside of it; a few frames are in memory at a time.

    Videos are copied without encoding where a row begins at a key frame.

    Raises: DataError when the folder holds a finished set.
    """
    pixel_format = _pixel_format(episodes, positions)
    with EpisodeSetWriter(output, video_crf=_CRF, video_preset=_PRESET, pixel_format=pixel_format) as writer:
        for position in positions:
            row = episodes.rows[position]
            if writer.has(row.episode_id):
                continue
            views = {
                view: RecordedView(lambda clip=clip: iter(VideoFrames(clip)), row.video_frames, clip)
                for view in row.views
                for clip in (episodes.clip(position, view),)
            }
            masks = {view: mask for view in row.views if (mask := episodes.robot_masks(position, view)) is not None}
            writer.add(with_rigid_poses(episodes.episode(position)), views, masks or None)
    _copy_sources(episodes, output, positions)
    return output


def _pixel_format(episodes: EpisodeSet, positions: Sequence[int]) -> PixelFormat:
    """That of the stored videos, so that what is encoded again fits into one dataset with what is copied."""
    folders = {episodes.dataset_path(position) for position in positions}
    features = [feature for folder in folders for feature in LeRobotV3Dataset(folder).features.values()]
    found = {
        (feature.get("info") or {}).get("video.pix_fmt") for feature in features if feature.get("dtype") == "video"
    }
    return "yuv420p" if found == {"yuv420p"} else "yuv444p"


def _copy_sources(episodes: EpisodeSet, output: Path, positions: Sequence[int]) -> None:
    """Sources and their licences go with the recordings; a filtered set has them where its datasets lie."""
    roots = {episodes.dataset_path(position).parent.parent for position in positions} | {episodes.root}
    tables = [
        json.loads((root / SOURCES_FILE).read_text()) for root in sorted(roots) if (root / SOURCES_FILE).is_file()
    ]
    rows = {json.dumps(row, sort_keys=True): row for table in tables for row in table}
    if rows:
        write_json_atomic(output / SOURCES_FILE, list(rows.values()))


def _export_rollouts(
    artifact: Path, output: Path, formats: Sequence[str], episode_ids: Sequence[str], episodes: Path | None
) -> list[Path]:
    folder = episodes or linked_folder(artifact, "episodes")
    if folder is None:
        raise ArtifactError(
            "The episodes of these predictions are not known", where=artifact, next_step="name them: --episodes FOLDER"
        )
    rollouts, recorded = RolloutSet.open(artifact), EpisodeSet.open(folder)
    tracks_folder = linked_folder(artifact, "tracks")
    tracks = None if tracks_folder is None else ActionTracks.open(tracks_folder)
    missing = sorted(set(episode_ids) - set(rollouts.episode_ids))
    if missing:
        raise DataError("No prediction of this episode", where=artifact, got=", ".join(missing))
    written: list[Path] = []
    if WORLDARENA in formats:
        written += export_worldarena(rollouts, recorded, episode_ids or rollouts.episode_ids, output)
    others = [wanted for wanted in formats if wanted != WORLDARENA]
    for name in (episode_ids or rollouts.episode_ids) if others else ():
        written += export_rollout(rollouts, recorded, tracks, name, output, others)
    return written


HEAD = "head"


def export_worldarena(rollouts: RolloutSet, episodes: EpisodeSet, names: Sequence[str], output: Path) -> list[Path]:
    """Write the predictions (of the smallest seed) of some episodes in the layout that WorldArena's video evaluation reads
    (arXiv 2602.08971; `video_quality/README.md` of its repository, "Data and Naming Rules"); returns the files.

    ```
    <method>_sort/<task>_episode_<n>.mp4     predicted head views, no subfolders
    gt_video/<task>_episode_<n>.mp4          the recorded ones, as long and at the same rate
    gt_frames/<task>_episode_<n>.png         their first frames
    summary.json                             [{gt_path, image, prompt: [instruction]}, ...]
    episodes.json                            our episode id by their name
    ```

    Its action following compares ``<method>_sort`` with ``<method>_1_sort`` and ``<method>_2_sort``: export the predictions
    under changed controls beside it and rename their folders. The leaderboard asks for RoboTwin's recordings, 121 frames at
    24 fps.

    Raises: DataError for an episode without a predicted head view, whose rate is no whole part of the recording's, or that is longer.
    """
    written: list[Path] = []
    summary, ids = [], {}
    for number, name in enumerate(sorted(names)):
        if HEAD not in rollouts.views(name):
            raise DataError("WorldArena looks at the head view", where=name, got=", ".join(rollouts.views(name)))
        position = episodes.position(name)
        row, clip = episodes.rows[position], rollouts.clip(name, HEAD)
        stride = round(row.fps / rollouts.fps)
        if stride < 1 or abs(row.fps / rollouts.fps - stride) > 1e-3:
            raise DataError("Another rate than the recording's", where=name, expected=row.fps, got=rollouts.fps)
        if stride * (clip.num_frames - 1) >= row.video_frames:
            raise DataError("Longer than its recording", where=name, expected=row.video_frames, got=clip.num_frames)
        stem = f"{safe_stem(row.task_family or 'task')}_episode_{number}"
        predicted, true, first = (
            output / folder / f"{stem}.{suffix}"
            for folder, suffix in (
                (f"{safe_stem(rollouts.method)}_sort", "mp4"),
                ("gt_video", "mp4"),
                ("gt_frames", "png"),
            )
        )
        with atomic_path(predicted) as temporary:
            shutil.copyfile(check_video_header(clip.path), temporary)
        frames = VideoFrames(episodes.clip(position, HEAD), stride)
        with atomic_path(true) as temporary:
            shown = islice(frames, clip.num_frames)
            encode_video(temporary, shown, rollouts.fps, crf=8, preset="veryfast", pixel_format="yuv444p")
        write_bytes_atomic(first, png_bytes(frames[[0]][0]))
        written += [predicted, true, first]
        summary.append({"gt_path": f"{true.resolve()}", "image": f"{first.resolve()}", "prompt": [row.instruction]})
        ids[stem] = name
    for file, content in (("summary.json", summary), ("episodes.json", ids)):
        write_json_atomic(output / file, content)
        written.append(output / file)
    return written
