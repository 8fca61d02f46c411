"""A recorded episode on its way into a set: it is brought to the wanted length, rate and size, and described as the
configuration asks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from functools import partial
from hashlib import sha256
from itertools import islice

import numpy as np

from worldline_core.data.curation.curate_config import CurateConfig, DrawnSplits
from worldline_core.data.episodes.episode import TRAINING_SPLITS, Episode, Split
from worldline_core.data.episodes.instructions import with_instruction
from worldline_core.data.episodes.source import EVALUATION_LAYOUTS, LoadedEpisode, Masks, for_evaluation_only
from worldline_core.data.episodes.view_recording import ViewImages
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.video.clip import frame_times
from worldline_core.data.video.frames import Frames, MadeFrames
from worldline_core.data.video.thumbnails import ViewThumbnails
from worldline_core.errors import ConfigError
from worldline_core.geometry.cameras import ImageTransform

_KEPT_SPLITS = ("ood_test", "bank")
"""Splits that stay where a source declares them."""
TRIMMED = "trimmed"
"""Noted in the conventions of an episode that `trim` shortened: how many frames states and videos had."""
MAX_TRIMMED_FRAMES = 1
"""Difference that a recorder which stops at once leaves between the last state and the last picture."""


def trimmed(config: CurateConfig, loaded: LoadedEpisode) -> LoadedEpisode:
    """The episode, with `trim: common` cut to the frames that its states and all of its videos have.

    Only where each video is a file of its own, whose frames can be counted, and has one frame more or fewer than there are
    states; `check_lengths` refuses a larger difference. The episode's conventions say what was cut.
    """
    episode = loaded.episode
    files = {view: clip for view, clip in loaded.clips.items() if clip.file_frames is not None}
    if config.trim is None or episode.video_frames is not None or not files:
        return loaded
    counts = {view: len(frame_times(clip.path)) for view, clip in files.items()}
    off = max(abs(count - episode.num_frames) for count in counts.values())
    if not 0 < off <= MAX_TRIMMED_FRAMES:
        return loaded
    common = min(episode.num_frames, *counts.values())
    found = ", ".join(f"{name} {count}" for name, count in {"states": episode.num_frames, **counts}.items())
    cut = episode.cut(0, common)

    def shortened(read: Callable[[str], Masks | None], view: str) -> Masks | None:
        values = read(view)
        return None if values is None else values[:common]

    return replace(
        loaded,
        episode=replace(cut, conventions={**cut.conventions, TRIMMED: f"the first {common} frames of {found}"}),
        images=lambda view: islice(loaded.images(view), common),
        robot_masks=partial(shortened, loaded.robot_masks),
        thing_labels=partial(shortened, loaded.thing_labels),
        clips={
            view: replace(clip, num_frames=common, file_frames=counts.get(view)) for view, clip in loaded.clips.items()
        },
    )


def prepare_episode(
    config: CurateConfig, loaded: LoadedEpisode
) -> tuple[
    Episode,
    dict[str, ViewImages],
    dict[str, Frames],
    Callable[[Mapping[str, ViewThumbnails]], Episode],
    dict[str, Frames],
]:
    """The episode as the set will hold it. No image is decoded yet: that happens once, while the episode is written.

    Returns:
        What `EpisodeSetWriter.add` takes: the episode at the wanted rate and size; its views; bool (N, H, W) masks by view;
        what describes the episode as the configuration asks, given the thumbnails of its views; uint8 (N, H, W) labels of
        things by view.

    Raises: RejectedInputError (too_short, wrong_fps).
    """
    recorded = loaded.episode
    step = config.stride or stride_to(recorded, config.fps)
    views = config.views if isinstance(config.views, tuple) else loaded.views
    episode = recorded if step == 1 else recorded.cut(0, recorded.num_frames, step)
    if episode.num_frames < config.min_frames:
        raise RejectedInputError(
            "too_short",
            "Episode has too few frames",
            where=f"episode {episode.episode_id}",
            expected=f"at least {config.min_frames}",
            got=episode.num_frames,
        )
    frames = {
        view: ViewImages(
            partial(loaded.each_image, view),
            recorded.num_video_frames,
            loaded.clips.get(view),
            step,
            config.image_size,
            config.fit,
            calibrated=view in episode.cameras,
        )
        for view in views
    }
    masks: dict[str, Frames] = {}
    things: dict[str, Frames] = {}
    for view in views:
        mask, labels = loaded.robot_masks(view), loaded.thing_labels(view)
        if mask is not None:
            masks[view] = _fitted(config, mask[::step], ImageTransform.masks, bool)
        if labels is not None:
            things[view] = _fitted(config, labels[::step], ImageTransform.labels, np.uint8)
    cameras = {
        view: camera.transformed(ImageTransform.of((camera.height, camera.width)).fitted(config.image_size, config.fit))
        for view in views
        if (camera := episode.cameras.get(view)) is not None
    }
    prepared = replace(
        episode,
        fps=config.fps or episode.fps,
        timestamps=np.arange(episode.num_frames) / (config.fps or episode.fps),
        cameras=cameras,
    )
    return prepared, frames, masks, partial(described, config, prepared, tuple(views)), things


def _fitted(
    config: CurateConfig, images: Frames, fit: Callable[[ImageTransform, np.ndarray], np.ndarray], dtype: type
) -> Frames:
    """Masks or labels (N, H, W), each brought to the configured size when it is asked for."""
    transform = ImageTransform.of((images.shape[1], images.shape[2])).fitted(config.image_size, config.fit)
    size = len(images), *transform.image_size
    return MadeFrames(lambda: (fit(transform, image[None])[0] for image in images), size, dtype)


def described(
    config: CurateConfig, episode: Episode, views: Sequence[str], thumbnails: Mapping[str, ViewThumbnails]
) -> Episode:
    """The episode as the set describes it: its split, instruction and primary view. None of them depends on its outcome.

    Args:
        views: views that the set keeps. thumbnails: of these.

    Raises: ConfigError when a recording for evaluation only is given a training split.
    """
    primary = with_primary_view(episode, config.primary_view, views, thumbnails)
    normalised = with_instruction(primary) if config.normalise_instructions else primary
    result = with_split(normalised, config.splits)
    check_split(result)
    return result


def with_split(episode: Episode, splits: Mapping[str, Split] | DrawnSplits) -> Episode:
    """The episode in the split that the configuration gives its scene; without a rule its source's."""
    named = _named_split(episode.scene, splits)
    if named is not None:
        return replace(episode, split=named)
    if not isinstance(splits, DrawnSplits) or not is_drawn(episode.scene, episode.split, episode.conventions, splits):
        return episode
    # By episode: once all of them are known (`rules.drawn_episodes`).
    return replace(episode, split=drawn_split(episode.scene, splits) if splits.by == "scene" else "train")


def _named_split(scene: str, splits: Mapping[str, Split] | DrawnSplits) -> Split | None:
    patterns = splits.patterns if isinstance(splits, DrawnSplits) else splits
    return next((split for pattern, split in patterns.items() if fnmatchcase(scene, pattern)), None)


def is_drawn(scene: str, split: str, conventions: Mapping[str, object], splits: DrawnSplits) -> bool:
    """True if the draw decides the split, not a pattern or the source."""
    kept = split in _KEPT_SPLITS or conventions.get("layout") in EVALUATION_LAYOUTS
    return not kept and _named_split(scene, splits) is None


def drawn_split(scene: str, splits: DrawnSplits) -> Split:
    """The split of a scene: a uniform number in [0, 1) from SHA-256 of "seed:scene", against the shares."""
    number = int.from_bytes(sha256(f"{splits.seed}:{scene}".encode()).digest()[:8]) / 2**64
    if number < splits.test:
        return "test"
    return "validation" if number < splits.test + splits.validation else "train"


def with_primary_view(
    episode: Episode, configured: str | None, views: Sequence[str], thumbnails: Mapping[str, ViewThumbnails]
) -> Episode:
    """The episode with the view that represents it in single-view training (Stage I).

    In this order: the configured view, the one that the source declares, the head's, the one that shows most motion (of
    equal ones the last by name). An episode that lacks the configured view stays out of Stage I, as the configuration
    asks.
    """
    if configured is None and episode.primary_view in views:
        return episode
    head = "head" if "head" in views else None
    most_motion = max(views, key=lambda view: (motion(thumbnails[view]), view))
    return replace(episode, primary_view=configured or head or most_motion)


def motion(view: ViewThumbnails) -> float:
    """Mean absolute change between the moments of a view, in grey levels of 255, over at most 64 moments."""
    step = max(1, len(view.gray) // 64)
    moments = view.gray[::step].astype(np.int16)
    return float(np.abs(np.diff(moments, axis=0)).mean()) if len(moments) > 1 else 0.0


def check_split(episode: Episode) -> None:
    """Raises: ConfigError when an episode for evaluation only is given a split that trains or selects a model.

    The layout is noted in the episode, so a set made of such recordings earlier is refused as well.
    """
    kept_out = for_evaluation_only(episode.conventions, episode.source, episode.embodiment)
    if kept_out and episode.split in TRAINING_SPLITS:
        raise ConfigError(
            "Recordings for evaluation only were assigned to training",
            where=f"episode {episode.episode_id}, scene {episode.scene} ({episode.conventions.get('layout')})",
            expected="split test or ood_test",
            got=episode.split,
            next_step="change the source's split or curate.splits; what is not DROID must not be called so",
        )


def stride_to(episode: Episode, fps: float | None) -> int:
    """The stride that brings an episode to the wanted rate.

    Raises: RejectedInputError (wrong_fps) when the recorded rate is no whole multiple of it.
    """
    if fps is None:
        return 1
    ratio = episode.fps / fps
    step = round(ratio)
    if step < 1 or abs(ratio - step) > 1e-2:
        raise RejectedInputError(
            "wrong_fps",
            "Recorded rate is no whole multiple of the wanted one",
            where=f"episode {episode.episode_id}",
            expected=f"a multiple of {fps} fps",
            got=f"{episode.fps} fps",
            next_step="set curate.fps to a divisor of the recorded rate, or to null to keep it",
            evidence={"wanted_fps": float(fps), "recorded_fps": float(episode.fps)},
        )
    return step
