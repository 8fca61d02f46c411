"""Episodes and predictions in formats of other tools: MCAP (Foxglove), Rerun, LeRobotDataset v3, videos, WorldArena."""

from __future__ import annotations

import json
import logging
import re
import shutil
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.actions.actions_config import SIGMA_PX_REFERENCE
from worldline_core.actions.episode_tracks import ActionTracks, EpisodeTracks
from worldline_core.data.curation.source_table import SOURCES_FILE
from worldline_core.data.episodes.episode import VIEWS, Episode
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.episodes.episode_set_writer import EpisodeSetWriter
from worldline_core.data.episodes.recorded_poses import with_rigid_poses
from worldline_core.data.episodes.view_recording import ViewImages
from worldline_core.data.guards.source_paths import safe_stem
from worldline_core.data.lerobot.dataset import LeRobotV3Dataset
from worldline_core.data.mcap.exported import Encoding, write_episode_mcap, write_rollout_mcap
from worldline_core.data.video.clip import VideoClip, check_video_header, video_size
from worldline_core.data.video.encoder import PixelFormat, encode_video
from worldline_core.data.video.frames import MadeFrames, VideoFrames
from worldline_core.errors import ArtifactError, ConfigError, DataError, WorldLineError
from worldline_core.exports.rerun_recording import RecordingContent, write_rerun_recording
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.model.cosmos3 import write_cosmos3
from worldline_core.model.pretrained import write_pretrained
from worldline_core.pictures import png_bytes, write_side_by_side
from worldline_core.rollout.rollout_set import RolloutSet
from worldline_core.store.artifact_files import kind_of, linked_folder, verify_artifact
from worldline_core.store.atomic import atomic_path, write_bytes_atomic, write_json_atomic
from worldline_core.store.store import folder_lock

logger = logging.getLogger(__name__)

HEAD = "head"
MCAP_FORMATS: dict[str, tuple[Encoding, str]] = {"mcap": ("protobuf", ".mcap"), "mcap-ros2": ("ros2", ".ros2.mcap")}
"""Encoding of the messages, and the files' suffix."""
FORMATS = {
    "EpisodeSet": ("lerobot", *MCAP_FORMATS, "rrd"),
    "RolloutSet": ("mp4", "rrd", *MCAP_FORMATS, "worldarena", "worldarena-archive"),
    "Checkpoint": ("model", "diffusers"),
}
_CRF = 10
"""For rows that are encoded again because they do not begin at a key frame; others are copied."""


def export(
    artifact: Path,
    output: Path,
    formats: Sequence[str],
    *,
    episode_ids: Sequence[str] = (),
    outcome: str | None = None,
    episodes: Path | None = None,
    pretrained: Path | None = None,
) -> list[Path]:
    """Write episodes of an EpisodeSet, predictions of a RolloutSet, or a checkpoint with its tokenizer, below a folder.

    The artifact, and those that it refers to, are compared with their manifests first.

    Args:
        formats: for an EpisodeSet `lerobot` (a set of its own: LeRobotDatasets with the sidecar, whole even where the
            artifact refers to another one's), `mcap`, `mcap-ros2` and `rrd` (one file per episode); for a RolloutSet
            these without `lerobot`, `mp4` (truth beside prediction), `worldarena` (`export_worldarena`) and
            `worldarena-archive` (`export_worldarena_archive`); for a checkpoint `model` (a folder with its tokenizer and card, to be published) and `diffusers` (`write_cosmos3`).
        episode_ids: the chosen episodes; default: all.
        outcome: only recordings of an EpisodeSet with this outcome (``success``: demonstrations to train a policy on).
        episodes: the EpisodeSet of predictions; default: the one that their manifest names.
        pretrained: for `diffusers`: the folder of the published weights that the checkpoint came from.

    Returns: the files, or the folder of the new set.

    Raises: ConfigError for a format that the artifact does not have; DataError for an unknown episode; ArtifactError for
        another kind of artifact, a damaged one, or while another command exports into the folder.
    """
    kind = kind_of(artifact)
    if kind not in FORMATS:
        raise ArtifactError("This kind is not exported", where=artifact, expected=" or ".join(FORMATS), got=kind)
    unknown = [wanted for wanted in formats if wanted not in FORMATS[kind]]
    if unknown or not formats:
        raise ConfigError(
            f"Not a format of {kind}", expected=", ".join(FORMATS[kind]), got=", ".join(unknown) or "none"
        )
    if outcome is not None and kind != "EpisodeSet":
        raise ConfigError(
            "Predictions are not chosen by outcome", where=artifact, got=outcome, next_step="name episodes"
        )
    with folder_lock(output):
        verify_artifact(artifact)
        if kind == "Checkpoint":
            if "diffusers" in formats and pretrained is None:
                raise ConfigError(
                    "The format diffusers needs the published folder", next_step="give it as --pretrained"
                )
            folders = [write_pretrained(artifact, output / "model")] if "model" in formats else []
            if pretrained is not None and "diffusers" in formats:
                folders.append(write_cosmos3(artifact, pretrained, output / "diffusers"))
            return folders
        if kind == "EpisodeSet":
            return _export_episodes(EpisodeSet.open(artifact), output, formats, episode_ids, outcome)
        return _export_rollouts(artifact, output, formats, episode_ids, episodes)


def _export_episodes(
    episodes: EpisodeSet, output: Path, formats: Sequence[str], episode_ids: Sequence[str], outcome: str | None
) -> list[Path]:
    positions = [episodes.position(name) for name in episode_ids] if episode_ids else list(range(len(episodes)))
    positions = [position for position in positions if outcome in (None, episodes.rows[position].outcome)]
    if not positions:
        present = sorted({row.outcome for row in episodes.rows})
        raise DataError("No episode is exported", where=episodes.root, expected=f"an outcome of {present}", got=outcome)
    written: list[Path] = []
    if "lerobot" in formats:
        written.append(_export_lerobot(episodes, output / "lerobot" if len(formats) > 1 else output, positions))
    for position in positions if set(formats) - {"lerobot"} else ():
        row, episode = episodes.rows[position], episodes.episode(position)
        stem = safe_stem(row.episode_id)
        for encoding, suffix in (MCAP_FORMATS[wanted] for wanted in formats if wanted in MCAP_FORMATS):
            frames = {view: VideoFrames(episodes.clip(position, view)) for view in row.views}
            masks = {view: mask for view in row.views if (mask := episodes.robot_masks(position, view)) is not None}
            written.append(output / f"{stem}{suffix}")
            write_episode_mcap(written[-1], episode, frames, masks, encoding=encoding)
        if "rrd" in formats:
            tracks = None
            try:
                tracks = shown_tracks(episode)
            except WorldLineError as error:
                logger.warning("%s.rrd has no tool poses: %s (%s)", stem, error.what, error.where)
            written.append(output / f"{stem}.rrd")
            write_rerun_recording(written[-1], recording_content(episodes, row.episode_id, tracks))
    return written


def shown_tracks(episode: Episode) -> EpisodeTracks:
    """Tracks for pictures: of the commands, which are the controls; else of the recorded tool poses or the measured state.

    Commands are projected where they are recorded and the robot's kinematics are known, as `render_actions` does.

    Raises: DataError, ConfigError, UnavailableError: they cannot be computed.
    """
    kinematics = None
    if episode.state_kind == "joints":
        try:
            kinematics = ArmKinematics(load_embodiment(episode.embodiment))
        except ConfigError:
            if episode.T_base_ee is None:
                raise
    commands = episode.commanded and kinematics is not None
    return compute_tracks(episode, kinematics, controls="action" if commands else "state")[0]


def _export_lerobot(episodes: EpisodeSet, output: Path, positions: Sequence[int]) -> Path:
    """Write rows of a set as a self-contained set; videos are copied where a row begins at a key frame."""
    pixel_format = _pixel_format(episodes, positions)
    with EpisodeSetWriter(output, video_crf=_CRF, pixel_format=pixel_format) as writer:
        for position in positions:
            row = episodes.rows[position]
            if writer.has(row.episode_id):
                continue
            views = {
                view: ViewImages(lambda clip=clip: iter(VideoFrames(clip)), row.video_frames, clip)
                for view in row.views
                for clip in (episodes.clip(position, view),)
            }
            masks = {view: mask for view in row.views if (mask := episodes.robot_masks(position, view)) is not None}
            writer.add(with_rigid_poses(episodes.episode(position)), views, masks or None)
    _copy_sources(episodes, output, positions)
    return output


def _pixel_format(episodes: EpisodeSet, positions: Sequence[int]) -> PixelFormat:
    """The format of the stored videos: encoded and copied ones share a dataset."""
    folders = {episodes.dataset_path(position) for position in positions}
    features = [feature for folder in folders for feature in LeRobotV3Dataset(folder).features.values()]
    found = {
        (feature.get("info") or {}).get("video.pix_fmt") for feature in features if feature.get("dtype") == "video"
    }
    return "yuv420p" if found == {"yuv420p"} else "yuv444p"


def _copy_sources(episodes: EpisodeSet, output: Path, positions: Sequence[int]) -> None:
    """Copy sources and licences along; a filtered set has them beside its datasets."""
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
    tracks_folder = linked_folder(artifact, "tracks")
    for linked in filter(None, (folder, tracks_folder)):
        verify_artifact(linked)
    rollouts, recorded = RolloutSet.open(artifact), EpisodeSet.open(folder)
    tracks = None if tracks_folder is None else ActionTracks.open(tracks_folder)
    names, written = list(episode_ids or rollouts.episode_ids), list[Path]()
    if missing := sorted(set(names) - set(rollouts.episode_ids)):
        raise DataError("No prediction of this episode", where=artifact, got=", ".join(missing))
    if "worldarena" in formats:
        written += export_worldarena(rollouts, recorded, names, output)
    if "worldarena-archive" in formats:
        written += export_worldarena_archive(rollouts, recorded, names, output)
    for name in names:
        drawn, sigma_px = (None, SIGMA_PX_REFERENCE) if tracks is None else (tracks.tracks(name), tracks.sigma_px_ref)
        content, stem = recording_content(recorded, name, drawn, rollouts, sigma_px), safe_stem(name)
        if "mp4" in formats:
            for view, frames in content.true_frames.items():
                predicted = content.predicted_frames.get(view)
                shown = {"true": frames} if predicted is None else {"true": frames, content.method: predicted}
                made = write_side_by_side(output / f"{stem}_{view}.mp4", shown, content.episode.fps)
                written += [made.video, made.poster]
        if "rrd" in formats:
            written.append(output / f"{stem}.rrd")
            write_rerun_recording(written[-1], content)
        for encoding, suffix in (MCAP_FORMATS[wanted] for wanted in formats if wanted in MCAP_FORMATS):
            written.append(output / f"{stem}_{safe_stem(content.method)}{suffix}")
            write_prediction_mcap(written[-1], content, encoding)
    return written


def recording_content(
    episodes: EpisodeSet,
    episode_id: str,
    tracks: EpisodeTracks | None,
    rollouts: RolloutSet | None = None,
    sigma_px_ref: float = SIGMA_PX_REFERENCE,
) -> RecordingContent:
    """Gather the frames, predictions and tracks of one episode."""
    position, predicted = episodes.position(episode_id), dict[str, VideoFrames]()
    views = [view for view in VIEWS if view in episodes.rows[position].views]
    recorded = {view: VideoFrames(episodes.clip(position, view)) for view in views}
    if rollouts is not None:
        there = [view for view in views if view in rollouts.views(episode_id)]
        predicted = {view: VideoFrames(rollouts.clip(episode_id, view)) for view in there}
    method = "" if rollouts is None else rollouts.method
    return RecordingContent(episodes.episode(position), recorded, predicted, method, tracks, sigma_px_ref)


def write_prediction_mcap(path: Path, content: RecordingContent, encoding: Encoding) -> None:
    """Write the predicted views as MCAP with cameras and commanded tool poses.

    Calibration follows the frames' size; poses are cut to the prediction's length.
    """
    episode, views = content.episode, content.predicted_frames
    count = min(len(frames) for frames in views.values())
    facts = {name: getattr(episode, name) for name in ("episode_id", "embodiment", "instruction")}
    write_rollout_mcap(
        path,
        {view: MadeFrames(frames.__iter__, frames.shape, np.uint8)[:count] for view, frames in views.items()},
        episode.fps,
        metadata={key: json.dumps(value) for key, value in ({"method": content.method} | facts).items()},
        cameras={
            view: episode.cameras[view].resized(frames.shape[2], frames.shape[1]).cut(0, count)
            for view, frames in views.items()
            if view in episode.cameras
        },
        T_base_ee=None if content.tracks is None else content.tracks.T_base_tool[:count],
        encoding=encoding,
    )


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
        predicted = output / f"{safe_stem(rollouts.method)}_sort" / f"{stem}.mp4"
        true, first = output / "gt_video" / f"{stem}.mp4", output / "gt_frames" / f"{stem}.png"
        with atomic_path(predicted) as temporary:
            shutil.copyfile(check_video_header(clip.path), temporary)
        frames = VideoFrames(episodes.clip(position, HEAD), stride)
        with atomic_path(true) as temporary:
            shown = islice(frames, clip.num_frames)
            encode_video(temporary, shown, rollouts.fps, crf=8, pixel_format="yuv444p")
        write_bytes_atomic(first, png_bytes(frames[[0]][0]))
        written += [predicted, true, first]
        summary.append({"gt_path": f"{true.resolve()}", "image": f"{first.resolve()}", "prompt": [row.instruction]})
        ids[stem] = name
    for file, content in (("summary.json", summary), ("episodes.json", ids)):
        write_json_atomic(output / file, content)
        written.append(output / file)
    return written


_ARCHIVED = re.compile(r"(?P<model>.+?)_(?:(?:test|val)(?:_[12])?|(?P<policy>(?:10|20|30|50|full)data))")
_ARCHIVE_SIZE, _ARCHIVE_FPS, _TEXT_DRIVEN_FRAMES = (480, 640), 24, 121


def export_worldarena_archive(
    rollouts: RolloutSet, episodes: EpisodeSet, names: Sequence[str], output: Path
) -> list[Path]:
    """Write the head views of predictions (of the smallest seed) of WorldArena's own sets as one folder of the archive that it
    takes; returns the files. The predictions' ``method`` is the folder's name, so that several calls fill one archive.

    ```
    <model>_eval/model_README.md                           written once, to be completed by hand
    <model>_eval/<model>_test/episode<N>.mp4               track 1; _test_1 and _test_2 under two other instructions or actions
    <model>_eval/<model>_10data/fixed_scene_task_episode<N>.mp4    track 2: of five policies, up to <model>_fulldata
    ```

    Sources (tsinghua-fib-lab/WorldArena): `assets/README_submission.md` (archive, README, 640 x 480 or more, 24 frames a second,
    as long as the trajectory, or 121 frames where text drives), `submission_tree.txt` of `embodied_task/worldarena_track2`; for
    the folders of track 1 the dataset's card. Its evaluation of policies takes names by a template; the names of track 1
    are those of published archives.

    Raises: DataError for another method, an episode of another set, and a video that is not as WorldArena asks.
    """
    found = _ARCHIVED.fullmatch(rollouts.method)
    if found is None:
        raise DataError(
            "Predictions for WorldArena are named by its sets", where=rollouts.root, got=rollouts.method,
            expected="MODEL_test, MODEL_test_1, MODEL_test_2; MODEL_10data to MODEL_fulldata",
            next_step="roll out again with such a name as method",
        )  # fmt: skip
    model, task = safe_stem(found["model"]), "fixed_scene_task_" if found["policy"] else ""
    root = output / f"{model}_eval"
    videos: dict[Path, VideoClip] = {}
    for name in sorted(names):
        number = re.search(r"episode(\d+)$", name)
        if number is None or HEAD not in rollouts.views(name):
            raise DataError(
                "Not a prediction of an episode of WorldArena", where=name, expected="...episode<N>, a head view",
                got=", ".join(rollouts.views(name)), next_step="curate its set with kind: worldarena",
            )  # fmt: skip
        path = root / safe_stem(rollouts.method) / f"{task}episode{int(number[1])}.mp4"
        if path in videos:
            raise DataError("Two episodes of one number", where=name, expected=f"one {path.name}")
        videos[path] = _archived_clip(rollouts, episodes, name, driven_by_policy=bool(task))
    for path, clip in videos.items():
        with atomic_path(path) as temporary:
            encode_video(temporary, VideoFrames(clip), _ARCHIVE_FPS, crf=8, pixel_format="yuv420p")
    about = root / "model_README.md"
    if not about.exists():
        lines = {
            "Model name": model, "GitHub repository (optional)": "", "Driver type (action-driven or text-driven)": "",
            "Action space (track 2: joint14 or endpose14)": "", "Release year": "", "Open source (yes or no)": "",
            "Brief description (optional)": "", "Submitted video sets": "",
        }  # fmt: skip
        write_bytes_atomic(about, "".join(f"- **{name}**: {value}\n" for name, value in lines.items()).encode())
    return [*videos, about]


def _archived_clip(rollouts: RolloutSet, episodes: EpisodeSet, name: str, *, driven_by_policy: bool) -> VideoClip:
    """The predicted head view. Raises: DataError for another size or length than WorldArena asks for."""
    clip, (least_height, least_width) = rollouts.clip(name, HEAD), _ARCHIVE_SIZE
    height, width, _ = video_size(check_video_header(clip.path))
    if height < least_height or height * least_width != width * least_height:
        raise DataError(
            "Not the pictures that WorldArena asks for", where=name, got=f"{width} x {height}",
            expected=f"{least_width} x {least_height}, or more in these proportions",
            next_step="predict with a model of this size",
        )  # fmt: skip
    trajectory = episodes.rows[episodes.position(name)].num_frames
    if not driven_by_policy and clip.num_frames not in (trajectory, _TEXT_DRIVEN_FRAMES):
        raise DataError(
            "Not the length that WorldArena asks for", where=name, got=f"{clip.num_frames} frames",
            expected=f"{trajectory} (its trajectory), or {_TEXT_DRIVEN_FRAMES} where text drives",
            next_step="roll out with num_frames: whole",
        )  # fmt: skip
    return clip
