"""Shortcuts: choices among candidates, and verdicts on attempts, without any predicted video, which a world model has to beat to be needed.

They see what there is before anything is predicted: the commands, where the tools come to be in the head view, and the first picture.
Trees also know how the candidates of other banks ended, or attempts from other starts.

Axis legend: c candidates of a bank, n frames, a arms, f features. Points are metres in the base frame.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float

from worldline_core.actions.episode_tracks import HEAD_VIEW, ActionTracks, EpisodeTracks
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.evaluation.segmenters.coloured_things import named_things, own_colour, thing_share

SAMPLED_FRAMES = 9
"""Frames of a command sequence that the medoid and the trees see, evenly spaced."""
FOLDS = 10
"""Banks are judged by trees that were grown on the banks of the other folds."""
_TREES, _DEPTH, _SEED = 100, 8, 42
_RISE_M = 0.05  # a thing that is still held counts as lifted
_PRESS, _PUSH = re.compile(r"\bpress"), re.compile(r"\b(clos|shut|push|slid)")

Scores = Float[np.ndarray, " c"]


@dataclass(frozen=True)
class Reach:
    """Paths of the hands, and the things that they could reach for.

    Attributes:
        tools: (c, n, a, 3); gripper: (c, n, a), 0 closed .. 1 open.
        things: (3) places of the things that the instruction names, in its order: where the rays through them in the first picture of
            the head view meet the height of the lowest tools.
    """

    tools: np.ndarray
    gripper: np.ndarray
    things: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class BankFacts:
    """Facts about the candidates of a bank that need no prediction.

    Attributes:
        commands: (c, n, j), in the units of the recording.
        reach: None without tracks, a camera of the head, or a thing that the first picture shows.
    """

    instruction: str
    commands: np.ndarray
    reach: Reach | None


def bank_facts(episodes: EpisodeSet, tracks: ActionTracks | None, rows: Sequence[EpisodeRow]) -> BankFacts:
    """Facts of one bank; sequences are cut to the shortest."""
    count = min(row.num_frames for row in rows)
    commands = []
    for row in rows:
        episode = episodes.episode(episodes.position(row.episode_id))
        given = episode.state if episode.action is None else episode.action
        commands.append(np.asarray(given, dtype=np.float64)[:count])
    reach = None
    if tracks is not None and HEAD_VIEW in rows[0].views:
        picture = episodes.frames(episodes.position(rows[0].episode_id), HEAD_VIEW, [0])
        reach = _reach([tracks.tracks(row.episode_id) for row in rows], rows[0].instruction, picture, count)
    return BankFacts(rows[0].instruction, np.stack(commands), reach)


def _reach(drawn: Sequence[EpisodeTracks], instruction: str, picture: np.ndarray, count: int) -> Reach | None:
    first, column = drawn[0], drawn[0].views.index(HEAD_VIEW)
    tools = np.stack([one.T_base_tool[:count, :, :3, 3] for one in drawn]).astype(np.float64)
    gripper = np.stack([one.gripper[:count, column] for one in drawn])
    if first.camera_motion[column] == "absent":
        return None
    height = float(np.median(tools[..., 2].min(axis=(1, 2))))
    things = named_places(
        instruction, picture, height, first.K[column], first.T_base_camera[0, column], first.image_size
    )
    return Reach(tools, gripper, things) if things else None


def named_places(
    instruction: str,
    picture: np.ndarray,
    height: float,
    K: np.ndarray,
    T_base_camera: np.ndarray,
    image_size: tuple[int, ...],
) -> tuple[np.ndarray, ...]:
    """Places (3) of the things that an instruction names, where rays through them in a picture (1, H, W, 3) meet a height; up to the first
    that is not seen. K is of images of image_size (h, w)."""
    things = []
    for thing in named_things(instruction):
        share = thing_share(picture, thing.colour, own_colour(picture, thing.colour))[0]
        if share.sum() < 1.0:
            break
        grid = np.mgrid[: share.shape[0], : share.shape[1]][::-1]
        pixel = (grid * share).sum(axis=(1, 2)) / share.sum()
        pixel = (pixel + 0.5) * np.array(image_size[::-1]) / np.array(share.shape[::-1]) - 0.5
        pose = T_base_camera.astype(np.float64)
        ray = pose[:3, :3] @ np.linalg.solve(K.astype(np.float64), [*pixel, 1.0])
        things.append(pose[:3, 3] + ray * (height - pose[2, 3]) / ray[2])
    return tuple(things)


def sampled_commands(facts: BankFacts) -> Float[np.ndarray, "c f"]:
    """A few frames of the commands, each column in units of its spread in this bank."""
    index = np.linspace(0, facts.commands.shape[1] - 1, SAMPLED_FRAMES).round().astype(int)
    spread = facts.commands.std(axis=(0, 1))
    chosen = facts.commands[:, index] / np.where(spread > 1e-6, spread, 1.0)
    return chosen.reshape(len(chosen), -1)


def medoid(facts: BankFacts) -> Callable[[Sequence[int]], int]:
    """Choice of the sequence that is most like the others shown."""
    features = sampled_commands(facts)
    distances = np.linalg.norm(features[:, None] - features[None], axis=2)
    return lambda shown: shown[int(np.argmin(distances[np.ix_(shown, shown)].sum(axis=1)))]


def nearest_hand(facts: BankFacts) -> Scores | None:
    """Minus the least distance of any tool to the thing that the instruction names first."""
    if facts.reach is None:
        return None
    return -np.linalg.norm(facts.reach.tools - facts.reach.things[0], axis=-1).min(axis=(1, 2))


def hand_rule(facts: BankFacts) -> Scores | None:
    """A hand-written heuristic, given the places of the named things in the first picture.

    A thing to be pressed: come down on it. To be closed or pushed: get far beyond its first place. Else close the gripper at the thing
    (both, where the instruction says so); then open it at the destination, or where none is named, hold on and rise.
    """
    if facts.reach is None:
        return None
    tools, gripper, things = facts.reach.tools, facts.reach.gripper, facts.reach.things
    words = facts.instruction.lower()
    if len(things) == 1 and _PRESS.search(words):
        return _press(tools, things[0])
    if len(things) == 1 and _PUSH.search(words):
        return _push(tools, things[0])
    hands = 2 if "both" in words else 1
    return np.array([_grasp(*path, hands, things) for path in zip(tools, gripper, strict=True)])


def _press(tools: Float[np.ndarray, "c n a 3"], thing: np.ndarray) -> Scores:
    miss = np.linalg.norm((tools - thing)[..., :2], axis=-1)
    return -(miss + np.abs(tools[..., 2] - tools[..., 2].min())).min(axis=(1, 2))


def _push(tools: Float[np.ndarray, "c n a 3"], thing: np.ndarray) -> Scores:
    """Distance that a tool gets beyond the thing's first place, along the candidates' way of approach."""
    away = tools - thing
    distances = np.linalg.norm(away, axis=-1)
    each = np.arange(len(tools))
    frame, arm = np.unravel_index(distances.reshape(len(tools), -1).argmin(axis=1), distances.shape[1:])
    before, after = np.maximum(frame - 2, 0), np.minimum(frame + 2, tools.shape[1] - 1)
    way = (away[each, after, arm] - away[each, before, arm]).mean(axis=0)[:2]
    way /= max(float(np.linalg.norm(way)), 1e-9)
    along = away[..., :2] @ way
    beside = np.linalg.norm(away[..., :2] - along[..., None] * way, axis=-1)
    return (along - beside - np.abs(away[..., 2])).max(axis=(1, 2))


def _grasp(
    tools: Float[np.ndarray, "n a 3"], gripper: Float[np.ndarray, "n a"], hands: int, things: tuple[np.ndarray, ...]
) -> float:
    thing, *destination = things
    grasps: list[tuple[np.ndarray, np.ndarray, bool]] = []
    for arm in range(tools.shape[1]):
        is_open = gripper[:, arm] > 0.5
        for closed in np.flatnonzero(is_open[:-1] & ~is_open[1:]) + 1:
            opens = np.flatnonzero(is_open[closed:])
            opened = closed + int(opens[0]) if len(opens) else len(tools) - 1
            lifts = bool(tools[-1, arm, 2] - tools[closed, arm, 2] > _RISE_M)
            done = len(opens) > 0 if destination else lifts and not len(opens)
            grasps.append((tools[closed, arm], tools[opened, arm], done))
    if len(grasps) < hands:
        return -np.inf
    chosen = sorted(grasps, key=lambda grasp: float(np.linalg.norm(grasp[0] - thing)))[:hands]
    miss = float(np.linalg.norm(np.mean([at for at, _, _ in chosen], axis=0) - thing))
    if destination:
        miss += float(np.linalg.norm(np.mean([left for _, left, _ in chosen], axis=0) - destination[0]))
    return -miss - (0.0 if all(done for *_, done in chosen) else 1.0)


def placed_paths(facts: BankFacts) -> Float[np.ndarray, "c f"] | None:
    """The tools' paths from the named things (a destination that is not named: the first one), and the grippers."""
    if facts.reach is None:
        return None
    tools, gripper, things = facts.reach.tools, facts.reach.gripper, facts.reach.things
    index = np.linspace(0, tools.shape[1] - 1, SAMPLED_FRAMES).round().astype(int)
    paths = [tools[:, index] - things[min(which, len(things) - 1)] for which in range(2)]
    return np.concatenate([part.reshape(len(tools), -1) for part in (*paths, gripper[:, index])], axis=1)


def less_mean(facts: BankFacts) -> Float[np.ndarray, "c f"]:
    """Sampled commands less the mean of the bank."""
    features = sampled_commands(facts)
    return features - features.mean(axis=0)


RULES: Mapping[str, Callable[[BankFacts], Scores | None]] = {"nearest_hand": nearest_hand, "hand_rule": hand_rule}
"""Scores without labels, by the shortcut's name; beside them the `medoid`, which depends on who else is shown."""
FEATURES: Mapping[str, Callable[[BankFacts], np.ndarray | None]] = {
    "trees_commands": sampled_commands,
    "trees_commands_less_mean": less_mean,
    "trees_placed_paths": placed_paths,
}
"""Features of the trees, by the shortcut's name."""


def tree_scores(
    features: Mapping[str, Float[np.ndarray, "c f"]],
    outcomes: Mapping[str, Bool[np.ndarray, " c"]],
    tasks: Mapping[str, str] | None = None,
) -> dict[str, Scores]:
    """Expected success of the candidates of each bank, by random trees grown on the banks of the other folds.

    Banks of other sizes of features (another robot), and of another of the `tasks`, never share a fold's trees. A bank without any other to
    learn from is left out.
    """
    scores: dict[str, Scores] = {}
    kinds = {name: (own.shape[1], tasks[name] if tasks else "") for name, own in features.items()}
    for fold in range(FOLDS):
        fold_names = sorted(features)[fold::FOLDS]
        for kind in sorted({kinds[name] for name in fold_names}):
            held_out = [name for name in fold_names if kinds[name] == kind]
            known = sorted(name for name in features if name not in fold_names and kinds[name] == kind)
            if not known:
                continue
            x = np.concatenate([features[name] for name in known]).astype(np.float32)
            y = np.concatenate([outcomes[name] for name in known]).astype(np.float32)
            if (y == y[0]).all():  # which OpenCV's trees refuse
                scores |= {name: np.full(len(features[name]), float(y[0])) for name in held_out}
                continue
            trees = cv2.ml.RTrees.create()
            trees.setMaxDepth(_DEPTH)
            trees.setTermCriteria((cv2.TERM_CRITERIA_MAX_ITER, _TREES, 0.0))
            cv2.setRNGSeed(_SEED)
            trees.train(x, cv2.ml.ROW_SAMPLE, y)
            for name in held_out:
                scores[name] = trees.predict(features[name].astype(np.float32))[1][:, 0]
    return scores


def verdicts_without_video(
    episodes: EpisodeSet, tracks: ActionTracks | None, rows: Sequence[EpisodeRow], tasks: Mapping[str, str]
) -> dict[str, dict[str, bool]]:
    """Success of each attempt, by the shortcut's name: trees that saw attempts of its task from other starts, with commands, placed
    paths, or the score of a rule alone; and `one_verdict`, the commonest outcome, for all. Without any to learn from, an attempt fails.
    """
    starts: dict[str, list[EpisodeRow]] = defaultdict(list)
    for row in rows:
        starts[row.bank or row.episode_id].append(row)
    facts = {start: bank_facts(episodes, tracks, own) for start, own in starts.items()}
    ends = {start: np.array([row.outcome == "success" for row in own]) for start, own in starts.items()}
    of_start = {start: tasks[own[0].episode_id] for start, own in starts.items()}
    makers = {name: make for name, make in FEATURES.items() if make is not less_mean}
    makers |= {name: partial(_as_feature, rule) for name, rule in RULES.items()}
    commonest = 2 * sum(row.outcome == "success" for row in rows) > len(rows)
    found: dict[str, dict[str, bool]] = {"one_verdict": dict.fromkeys((row.episode_id for row in rows), commonest)}
    for name, make in makers.items():
        made = {start: made for start, own in facts.items() if (made := make(own)) is not None}
        scores = tree_scores(made, ends, of_start)
        found[name] = {
            row.episode_id: start in scores and bool(scores[start][place] > 0.5)
            for start, own in starts.items()
            for place, row in enumerate(own)
        }
    return found


def _as_feature(rule: Callable[[BankFacts], Scores | None], facts: BankFacts) -> Float[np.ndarray, "c 1"] | None:
    scores = rule(facts)
    return None if scores is None else np.maximum(scores, -10.0)[:, None]  # trees take finite numbers
