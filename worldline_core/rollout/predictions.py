"""The plan of a rollout: its episodes, their views, lengths and controls, and a reason for every episode left out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from worldline_core.actions.episode_tracks import ActionTracks
from worldline_core.data.episodes.episode_index import EpisodeRow, QuarantineRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import ConfigError, DataError
from worldline_core.model.world_model_config import match_views
from worldline_core.rollout.rollout_config import RolloutConfig


class Predictor(Protocol):
    """A model, server or baseline; the first of its views is in every prediction, which has 1 + k ``frames_per_unit`` frames.

    ``view_sets``: views that it predicts together, the largest set first; None: any of ``views``, each by itself.
    ``takes_maps``: drawn through the cameras of the views; ``vector_robots``: robots of which it takes control vectors in views
    without a camera, None: it needs no cameras at all.
    """

    views: tuple[str, ...]
    frames_per_unit: int
    takes_maps: bool
    vector_robots: tuple[str, ...] | None

    @property
    def view_sets(self) -> tuple[tuple[str, ...], ...] | None: ...

    def unit(self, frames: int) -> int: ...


@dataclass(frozen=True)
class Prediction:
    """Videos of an episode under the controls of one; frames after ``frames``, up to ``sampled``, are not kept."""

    position: int
    episode_id: str
    controls_of: str
    seed: int
    frames: int
    sampled: int
    views: tuple[str, ...]


def choose_episodes(config: RolloutConfig, episodes: EpisodeSet) -> list[int]:
    """Positions of the episodes to predict, in the order of the set. Raises: DataError when none matches."""
    counts: Counter[str] = Counter()
    chosen: list[int] = []
    limit = config.max_episodes_per_embodiment
    for position in episodes.select(split=config.splits):
        row = episodes.rows[position]
        if config.banks is not None and row.bank not in config.banks:
            continue
        if config.embodiments is not None and row.embodiment not in config.embodiments:
            continue
        counts[row.embodiment] += 1
        if limit is None or counts[row.embodiment] <= limit:
            chosen.append(position)
    if not chosen:
        raise DataError(
            "No episode to predict",
            where=episodes.root,
            expected=f"splits {config.splits}, banks {config.banks}, embodiments {config.embodiments}",
            got=sorted({row.split for row in episodes.rows}),
        )
    return chosen


def plan_predictions(
    config: RolloutConfig,
    episodes: EpisodeSet,
    tracks: ActionTracks | None,
    chosen: Sequence[int],
    predictor: Predictor,
    fps: float,
) -> tuple[list[Prediction], list[QuarantineRow]]:
    """Every prediction to make, and the chosen episodes of which none can be made, each with its reason.

    Args:
        tracks: None for a predictor that no controls drive.
        fps: rate that recordings must have.

    Raises:
        ConfigError: the predictor knows no such views, or its first one is not among them.
        DataError: the model was not trained on these views together, or no episode can be predicted.
    """
    if config.views != "all_present":
        if predictor.view_sets is not None:
            match_views(predictor.view_sets, config.views, "rollout.views")
        elif not {predictor.views[0]} <= set(config.views) <= set(predictor.views):
            raise ConfigError(
                "A rollout is of views that the predictor knows",
                where="rollout.views",
                expected=f"{predictor.views[0]}, and any of {predictor.views[1:]}",
                got=config.views,
            )
    fitting: dict[int, tuple[str, ...]] = {}
    left_out: list[QuarantineRow] = []
    for position in chosen:
        row = episodes.rows[position]
        views, problem = _views(config, row, tracks, predictor)
        problem = problem or _misfit(config, row, predictor.frames_per_unit, fps)
        if problem is None:
            fitting[position] = views
        else:
            left_out.append(QuarantineRow(row.episode_id, row.source, *problem))
    if not fitting:
        counts = Counter(row.reason for row in left_out)
        raise DataError(
            "No episode can be predicted",
            where=episodes.root,
            expected="views that the model was trained on together, their cameras and action tracks, its rate, one unit of frames",
            got=f"{len(left_out)} left out {dict(counts)}; the first, {left_out[0].episode_id}: {left_out[0].detail}",
            next_step="see quarantine.parquet of render_actions and filter, or choose other episodes",
        )
    partners = {episodes.rows[position].episode_id: episodes.rows[position].episode_id for position in fitting}
    if config.actions == "shuffled":
        embodiment_of = {row.episode_id: row.embodiment for row in episodes.rows}
        pool = list(partners) if tracks is None else tracks.episode_ids
        partners = shuffled_partners(list(partners), embodiment_of, pool, config.seeds[0])
    planned: list[Prediction] = []
    for position, views in fitting.items():
        row = episodes.rows[position]
        frames = _length(config, row, predictor.frames_per_unit)
        unit = predictor.unit(frames)
        sampled = 1 + -(-(frames - 1) // unit) * unit
        partner = partners[row.episode_id]
        planned += [
            Prediction(position, row.episode_id, partner, seed, frames, sampled, views) for seed in config.seeds
        ]
    return planned, left_out


def _views(
    config: RolloutConfig, row: EpisodeRow, tracks: ActionTracks | None, predictor: Predictor
) -> tuple[tuple[str, ...], tuple[str, str] | None]:
    """The views to predict of an episode, or a reason and what is the matter."""
    if tracks is not None and row.episode_id not in tracks:
        return (), ("missing_actions", "no action tracks of this episode")
    recorded = tuple(view for view in predictor.views if view in row.views)
    robots = predictor.vector_robots
    drawn = tracks.calibrated_views(row.episode_id) if tracks and predictor.takes_maps and config.cameras else ()
    # Of a model of vectors alone that is what an evaluation asks: what they are worth on a robot that it has not seen (the paper's
    # ablation). A session or a policy is refused there.
    free = tracks is None or robots is None or row.embodiment in robots or not predictor.takes_maps
    views = tuple(view for view in recorded if free or view in drawn)
    sets = predictor.view_sets or (views, predictor.views[:1])
    if config.views != "all_present":
        sets = (tuple(view for view in predictor.views if view in config.views),)
    fitting = [wanted for wanted in sets if predictor.views[0] in wanted and set(wanted) <= set(views)]
    if fitting:
        return fitting[0], None
    if robots and not free and set(sets[-1]) <= set(recorded):
        known = ", ".join(robots)
        return (), ("unknown_embodiment", f"without cameras the model knows {known}, and not {row.embodiment}")
    reason, present, what = "missing_view", recorded, "no video of"
    if set(sets[-1]) <= set(recorded):
        reason, present, what = "missing_calibration", views, "no camera of"
    absent = [view for view in sets[-1] if view not in present]
    return (), (reason, f"{what} {', '.join(absent)}; there are {', '.join(present) or 'none'}")


def _misfit(config: RolloutConfig, row: EpisodeRow, unit: int, fps: float) -> tuple[str, str] | None:
    if row.fps != fps:
        return "wrong_fps", f"the recording has {row.fps} frames per second, the model knows {fps}"
    if _length(config, row, unit) < (2 if config.num_frames == "whole" else 1 + unit):
        return "too_short", f"too short to predict: {row.num_frames} frames, a unit of {unit} is asked for"
    return None


def _length(config: RolloutConfig, row: EpisodeRow, unit: int) -> int:
    """Frames of a prediction: of the whole recording, or 1 + k units of the length that is asked for."""
    available = 1 + (row.num_frames - 1) // config.stride
    if config.num_frames == "whole":
        return available
    return 1 + (min(config.num_frames, available) - 1) // unit * unit


def batches(planned: Sequence[Prediction], size: int) -> Iterator[list[Prediction]]:
    """Predictions of equal length and equal views together, in a fixed order."""
    for key in sorted({(item.sampled, item.views) for item in planned}):
        same = [item for item in planned if (item.sampled, item.views) == key]
        for start in range(0, len(same), size):
            yield same[start : start + size]


def shuffled_partners(
    episodes: Sequence[str], embodiment_of: Mapping[str, str], pool: Sequence[str], seed: int
) -> dict[str, str]:
    """For every episode another of the same embodiment, no one its own, as far as possible no two the same.

    Episodes of an embodiment are arranged in a random circle (a function of ``seed`` and the ids only) and each takes
    its successor's controls. An embodiment with a single chosen episode draws its partner from ``pool``.

    Raises:
        DataError: an episode has no other of its embodiment.
    """
    partners: dict[str, str] = {}
    for embodiment in sorted({embodiment_of[episode] for episode in episodes}):
        members = sorted(episode for episode in episodes if embodiment_of[episode] == embodiment)
        generator = np.random.default_rng([seed, *embodiment.encode()])
        if len(members) == 1:
            others = sorted(e for e in pool if embodiment_of.get(e) == embodiment and e not in members)
            if not others:
                raise DataError(
                    "No other episode of this embodiment to take controls from",
                    where=members[0],
                    expected="at least two episodes with tracks",
                    got=embodiment,
                )
            partners[members[0]] = others[int(generator.integers(len(others)))]
            continue
        circle = [members[int(i)] for i in generator.permutation(len(members))]
        partners.update(zip(circle, [*circle[1:], circle[0]], strict=True))
    return partners
