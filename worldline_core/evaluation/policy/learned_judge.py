"""The learned judge, a small network on a few frames of all views, and the step train_judge, which fits it to recorded outcomes.

It sees pictures and the instruction alone: the first frame and late ones, for every pixel how much of it is of the two things that the
instruction names by colour, and the other words. It gives the probability that the task was done. Where that lies within a band
around one half it is undecided; the band is fitted on validation recordings. Training frames are augmented to look like unseen
scenes and like predicted frames, and mirrored together with their views.
"""

from __future__ import annotations

import logging
import math
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from einops import rearrange, repeat
from jaxtyping import Float
from numpy.typing import NDArray
from pydantic import BaseModel, Field
from safetensors.torch import save
from scipy.optimize import minimize
from torch import Tensor, nn
from torch.nn import functional

from worldline_core.config import ImageSize
from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_index import EpisodeRow
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.video.frames import VideoFrames
from worldline_core.errors import ArtifactError, DataError
from worldline_core.evaluation.augmentation import change_colours, degrade, mix_ghosts, move, uniform
from worldline_core.evaluation.evaluation_config import JudgeConfig
from worldline_core.evaluation.policy.judge import Judgement, route
from worldline_core.evaluation.recordings import HEAD, Pictures, Trajectory
from worldline_core.evaluation.segmenters.coloured_things import HUES_DEG, own_colour, thing_share
from worldline_core.evaluation.small_network import WEIGHTS_FILE, load_network
from worldline_core.model.tokenizers import (
    VideoTokenizer,
    frames_to_video,
    load_tokenizer,
    resized_frames,
    video_to_frames,
)
from worldline_core.progress import with_progress
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic
from worldline_core.training.train_tokenizer import disturb
from worldline_core.training.trainer import Objective, ParameterGroup, step_generator, train

logger = logging.getLogger(__name__)

DESCRIPTION_FILE = "judge.json"
POSITIONS = (0.0, 0.75, 0.9, 1.0)
"""Frames that it sees, 0 the first, 1 the last."""
_THINGS = 2
_CHANNELS = 3 + _THINGS
_GROUPS = 8
_WORDS = 64
"""Length of the vector that an instruction and a view become."""
_CONTRAST = 4.0
"""Factor on differences of colours: most are small."""
_MIRRORED = [VIEWS.index(view) for view in ("head", "right_wrist", "left_wrist")]
_OUTCOMES = ("success", "failure")
_FORGET = 0.03
"""Share of a task's running loss that each of its videos renews."""
_LEAST_LOSS = 0.1
"""Added to the loss of every task: one that is always judged rightly is still drawn."""


def instruction_words(instruction: str) -> tuple[str, ...]:
    """Words of an instruction in order, without those of colours: these the pictures show."""
    return tuple(word for word in re.findall(r"[a-z]+", instruction.lower()) if word not in HUES_DEG)


def named_colours(instruction: str) -> list[str]:
    """The first colours that the instruction names."""
    return [word for word in re.findall(r"[a-z]+", instruction.lower()) if word in HUES_DEG][:_THINGS]


@dataclass(frozen=True)
class ViewPictures:
    """Pictures of one video, as the network takes them.

    Attributes:
        pictures: uint8 (views, frames, 5, h, w), zeros of views that are not there; channels are RGB and the shares of two things.
        shown: bool (views,).
    """

    pictures: np.ndarray
    shown: np.ndarray


def look_at(instruction: str, frames: Mapping[str, np.ndarray]) -> ViewPictures:
    """Frames at `POSITIONS` by view, uint8 (frames, h, w, 3), and in them the things that the instruction names by colour."""
    height, width = next(iter(frames.values())).shape[1:3]
    pictures = np.zeros((len(VIEWS), len(POSITIONS), _CHANNELS, height, width), np.uint8)
    first = frames.get(HEAD, next(iter(frames.values())))[:1]
    things = [(colour, own_colour(first, colour)) for colour in named_colours(instruction)]
    for number, view in enumerate(VIEWS):
        if view in frames:
            pictures[number, :, :3] = rearrange(frames[view], "t h w c -> t c h w")
            for channel, (colour, own) in enumerate(things, start=3):
                pictures[number, :, channel] = np.round(255 * thing_share(frames[view], colour, own))
    return ViewPictures(pictures, np.array([view in frames for view in VIEWS]))


def frame_numbers(available: Sequence[int], num_frames: int) -> list[int]:
    """Places in ``available`` (frames of a video, by number) of those nearest to `POSITIONS`."""
    numbers = np.asarray(available)
    return [int(np.argmin(np.abs(numbers - position * (num_frames - 1)))) for position in POSITIONS]


class OutcomeNetwork(nn.Module):
    """Convolutions on the frames of one view at a time, stacked; the instruction and the view scale and shift the features.

    ``widths`` are channels at half, quarter, ... resolution, multiples of 8; ``words`` is the size of the vocabulary.
    """

    def __init__(self, widths: tuple[int, ...], words: int) -> None:
        super().__init__()
        self.condition = nn.Linear(words + len(VIEWS), _WORDS)
        stacked = len(POSITIONS) * (_CHANNELS + 1) + 3 * (len(POSITIONS) - 1) + 2
        self.blocks = nn.ModuleList(
            _Block(cin, cout) for cin, cout in zip((stacked, *widths[:-1]), widths, strict=True)
        )
        self.view = nn.Linear(2 * sum(widths), 2 * _WORDS)
        self.head = nn.Sequential(
            nn.Linear(len(VIEWS) * 2 * _WORDS + len(VIEWS) + words, 2 * _WORDS),
            nn.SiLU(),
            nn.Linear(2 * _WORDS, 1),
        )

    def forward(
        self,
        pictures: Float[Tensor, "b views frames 5 h w"],
        shown: Float[Tensor, "b views"],
        words: Float[Tensor, "b words"],
    ) -> Float[Tensor, " b"]:
        """Logits of success; pictures in [0, 1]."""
        batch, views, _, _, height, width = pictures.shape
        features = rearrange(self._contrasts(pictures), "b views c h w -> (b views) c h w")
        rows, columns = torch.linspace(-1, 1, height), torch.linspace(-1, 1, width)
        places = torch.stack([repeat(rows, "h -> h w", w=width), repeat(columns, "w -> h w", h=height)])
        places = repeat(places.to(features), "c h w -> n c h w", n=len(features))
        features = torch.cat([features, places], dim=1)
        which = repeat(torch.eye(views).to(words), "v w -> (b v) w", b=batch)
        condition = functional.silu(self.condition(torch.cat([repeat(words, "b w -> (b v) w", v=views), which], dim=1)))
        pooled: list[Tensor] = []
        for block in self.blocks:
            features = block(features, condition)
            pooled += [features.mean(dim=(2, 3)), features.amax(dim=(2, 3))]
        seen = (
            rearrange(functional.silu(self.view(torch.cat(pooled, dim=1))), "(b v) c -> b v c", v=views)
            * shown[..., None]
        )
        return self.head(torch.cat([rearrange(seen, "b v c -> b (v c)"), shown, words], dim=1))[:, 0]

    @staticmethod
    def _contrasts(pictures: Float[Tensor, "b views frames 5 h w"]) -> Float[Tensor, "b views c h w"]:
        """Colours and paleness less their means, shares, and changes since the first frame: they stand out before a table of any colour."""
        colours, shares = pictures[:, :, :, :3], pictures[:, :, :, 3:]
        pale = colours.amin(dim=3, keepdim=True)
        seen = torch.cat([colours, pale], dim=3)
        seen = _CONTRAST * (seen - seen.mean(dim=(4, 5), keepdim=True))
        changes = _CONTRAST * (colours[:, :, 1:] - colours[:, :, :1])
        parts = (seen, 2 * shares - 1, changes)
        return torch.cat([rearrange(part, "b views frames c h w -> b views (frames c) h w") for part in parts], dim=2)


class _Block(nn.Module):
    """Halve the resolution, then a residual pair of convolutions that the condition modulates; at first the pair adds nothing.

    One norm: on a CPU it takes longer than a convolution.
    """

    def __init__(self, cin: int, cout: int) -> None:
        super().__init__()
        self.down = nn.Conv2d(cin, cout, 3, stride=2, padding=1)
        self.first = nn.Conv2d(cout, cout, 3, padding=1)
        self.second = nn.Conv2d(cout, cout, 3, padding=1)
        self.norm = nn.GroupNorm(_GROUPS, cout)
        self.modulation = nn.Linear(_WORDS, 2 * cout)
        for convolution in (self.down, self.first):
            nn.init.kaiming_normal_(convolution.weight, nonlinearity="relu")
        nn.init.zeros_(self.second.weight)

    def forward(self, features: Tensor, condition: Tensor) -> Tensor:
        features = functional.silu(self.norm(self.down(features)))
        scale, shift = self.modulation(condition)[..., None, None].chunk(2, dim=1)
        inner = functional.silu(self.first(features) * (1 + scale) + shift)
        return features + self.second(inner)


class _Described(BaseModel):
    widths: tuple[Annotated[int, Field(ge=_GROUPS, le=1 << 12, multiple_of=_GROUPS)], ...] = Field(
        min_length=1, max_length=8
    )
    image_size: ImageSize
    words: tuple[str, ...] = Field(max_length=1 << 16)
    verbs: tuple[str, ...]
    scale: float = Field(gt=0, lt=1e6)
    bias: float = Field(gt=-1e6, lt=1e6)
    margin: float = Field(ge=0, le=0.5)


class LearnedJudge:
    """A trained network, calibrated; a verdict is decided where its probability is farther than ``margin`` from one half."""

    name = "learned"

    def __init__(self, network: OutcomeNetwork, described: _Described) -> None:
        self.network = network.eval().requires_grad_(False)
        self.described = described

    def knows(self, instruction: str) -> bool:
        """False where no word of it is a verb of the training instructions: then its words say nothing about the task."""
        return not {*self.described.verbs}.isdisjoint(instruction_words(instruction))

    def probability(
        self, instruction: str, frames: Mapping[str, Pictures | NDArray[Any]], available: Sequence[int], num_frames: int
    ) -> float:
        """Probability of success.

        Args:
            frames: by view, the ``available`` frames of the video, by number; only those that are looked at are decoded.

        Raises: DataError for an instruction of which it knows no verb.
        """
        if not self.knows(instruction):
            raise DataError(
                "The learned judge does not know this task", got=repr(instruction),
                expected="one of the verbs " + ", ".join(self.described.verbs),
                next_step="train a judge on recordings of it (train_judge), or choose another judge",
            )  # fmt: skip
        chosen = frame_numbers(available, num_frames)
        small = {
            view: resized_frames(np.asarray(video[chosen]), self.described.image_size) for view, video in frames.items()
        }
        look = look_at(instruction, small)
        with torch.no_grad():
            logit = self.network(
                torch.from_numpy(look.pictures)[None] / 255.0,
                torch.from_numpy(look.shown)[None].float(),
                multi_hot(instruction, self.described.words)[None],
            )
        return float(torch.sigmoid(self.described.scale * logit + self.described.bias))

    def judge(self, trajectory: Trajectory) -> Judgement:
        """The nearer side, undecided within the band; of a task that it does not know, undecided failure."""
        count, family = trajectory.num_frames, route(trajectory.instruction)
        if not self.knows(trajectory.instruction):
            stated = {"pass": "learned", "confidence": 0.5, "observations": "no verb of the instruction is known"}
            return Judgement(False, family, "learned", 0, 1, [stated], undecided=True)
        value = self.probability(trajectory.instruction, trajectory.frames, range(count), count)
        stated = {"pass": "learned", "confidence": max(value, 1.0 - value), "probability": value}
        undecided = abs(value - 0.5) <= self.described.margin
        return Judgement(value > 0.5, family, "learned", 0, 1, [stated], undecided=undecided)

    @classmethod
    def load(cls, folder: Path) -> LearnedJudge:
        """Open a trained judge. Raises: ArtifactError, as `load_network`."""
        network, described = load_network(
            folder, DESCRIPTION_FILE, _Described, lambda found: OutcomeNetwork(found.widths, len(found.words)), noun="judge",
            next_step="run train_judge",
        )  # fmt: skip
        return cls(network, described)


def open_learned_judge(folder: Path | None) -> LearnedJudge:
    """Raises: ArtifactError without a folder, or as `LearnedJudge.load`."""
    if folder is None:
        raise ArtifactError(
            "The learned judge has no weights", expected="an input named judge",
            next_step="give the folder of a judge, run train_judge, or choose the measured one",
        )  # fmt: skip
    return LearnedJudge.load(folder)


def multi_hot(instruction: str, vocabulary: Sequence[str]) -> Float[Tensor, " words"]:
    """1 for each word of the vocabulary that the instruction has; others are dropped."""
    own = {*instruction_words(instruction)}
    return torch.tensor([float(word in own) for word in vocabulary])


@dataclass(frozen=True)
class JudgedVideo:
    """Pictures of a recording as they are and, with a tokenizer, as that gives them back."""

    name: str
    instruction: str
    success: bool
    looks: tuple[ViewPictures, ...]


@dataclass(frozen=True)
class OutcomeBatch:
    """Arguments of `OutcomeNetwork.forward`, 1 for success, and the number of each video's task."""

    names: tuple[str, ...]
    pictures: Float[Tensor, "b views frames 5 h w"]
    shown: Float[Tensor, "b views"]
    words: Float[Tensor, "b words"]
    success: Float[Tensor, " b"]
    tasks: tuple[int, ...] = ()


class OutcomeObjective(Objective[OutcomeBatch]):
    """Cross entropy; keeps the running mean of it for each task, by which tasks are drawn."""

    def __init__(self, network: OutcomeNetwork, tasks: int) -> None:
        self.network = network
        self.losses = [math.log(2)] * tasks

    def loss(self, batch: OutcomeBatch, generator: torch.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        del generator, step
        logits = self.network(batch.pictures, batch.shown, batch.words).float()
        losses = functional.binary_cross_entropy_with_logits(logits, batch.success, reduction="none")
        for task, value in zip(batch.tasks, losses.tolist(), strict=True):
            self.losses[task] += _FORGET * (value - self.losses[task])
        return losses.mean(), {}

    def state(self) -> dict[str, Any]:
        return {"losses": self.losses}

    def load_state(self, state: dict[str, Any]) -> None:
        self.losses = state["losses"]


Drawing = Sequence[Sequence[Sequence[JudgedVideo]]]
"""By task, successes and failures, those that there are."""


def by_task(videos: Sequence[JudgedVideo]) -> Drawing:
    """Videos of each task, an instruction without its colours."""
    tasks: dict[tuple[str, ...], tuple[list[JudgedVideo], list[JudgedVideo]]] = defaultdict(lambda: ([], []))
    for video in videos:
        tasks[instruction_words(video.instruction)][not video.success].append(video)
    return [[end for end in ends if end] for _, ends in sorted(tasks.items())]


def outcome_batch(
    drawing: Drawing, losses: Sequence[float], vocabulary: Sequence[str], config: JudgeConfig, index: int
) -> OutcomeBatch:
    """Augmented videos of one step, evenly over outcomes: a pure function of the seed, the step and the losses.

    Tasks that are still judged wrongly are drawn more often, in proportion to their loss: most are learned within a tenth of the steps that
    the hardest takes.
    """
    random = np.random.default_rng([config.seed, index])
    weights = np.array(losses) + _LEAST_LOSS
    tasks = random.choice(len(drawing), config.batch_size, p=weights / weights.sum()).tolist()
    chosen: list[JudgedVideo] = []
    for task in tasks:
        end = drawing[task][int(random.integers(len(drawing[task])))]
        chosen.append(end[int(random.integers(len(end)))])
    looks = [video.looks[int(random.integers(len(video.looks)))] for video in chosen]
    batch = _batch(chosen, looks, vocabulary)
    pictures, shown = augment(batch.pictures, batch.shown, step_generator(config.seed, index, "cpu"))
    return replace(batch, pictures=pictures, shown=shown, tasks=tuple(tasks))


def _batch(videos: Sequence[JudgedVideo], looks: Sequence[ViewPictures], vocabulary: Sequence[str]) -> OutcomeBatch:
    return OutcomeBatch(
        tuple(video.name for video in videos),
        torch.from_numpy(np.stack([look.pictures for look in looks])) / 255.0,
        torch.from_numpy(np.stack([look.shown for look in looks])).float(),
        torch.stack([multi_hot(video.instruction, vocabulary) for video in videos]),
        torch.tensor([float(video.success) for video in videos]),
    )


def augment(
    pictures: Float[Tensor, "b views frames 5 h w"], shown: Float[Tensor, "b views"], generator: torch.Generator
) -> tuple[Float[Tensor, "b views frames 5 h w"], Float[Tensor, "b views"]]:
    """Half of the videos mirrored, left and right wrist with them; half with each view moved; a quarter degraded after the first frame, as
    predictions are; a third with the colours of another scene; a few wrist views hidden. Many stay sharp: thin things decide."""
    batch, views, frames = pictures.shape[:3]
    mirrored = torch.rand(batch, generator=generator) < 0.5
    pictures, shown = pictures.clone(), shown.clone()
    pictures[mirrored], shown[mirrored] = pictures[mirrored][:, _MIRRORED].flip(-1), shown[mirrored][:, _MIRRORED]
    elsewhere = torch.rand(batch, generator=generator) < 1 / 2
    if elsewhere.any():
        stacked = rearrange(pictures[elsewhere], "b v t c h w -> (b v) (t c) h w")
        stacked = move(stacked, generator, mirror=False)
        pictures[elsewhere] = rearrange(stacked, "(b v) (t c) h w -> b v t c h w", v=views, t=frames)
    worse = torch.rand(batch, generator=generator) < 1 / 4
    if worse.any():
        sharp = pictures[worse, :, 1:]
        late, ghosts = (rearrange(part, "b v t c h w -> (b v t) c h w") for part in (sharp, sharp.roll(1, dims=2)))
        late = degrade(mix_ghosts(late, ghosts, generator), generator).clamp(0, 1)
        pictures[worse, :, 1:] = rearrange(late, "(b v t) c h w -> b v t c h w", v=views, t=frames - 1)
    other = torch.rand(batch, generator=generator) < 1 / 3
    if other.any():
        scenes = rearrange(pictures[other, :, :, :3], "b v t c h w -> b c (v t h) w")
        scenes = change_colours(scenes, generator)
        scenes = scenes + torch.randn(scenes.shape, generator=generator) * uniform(scenes, 0.0, 0.03, generator)
        pictures[other, :, :, :3] = rearrange(scenes.clamp(0, 1), "b c (v t h) w -> b v t c h w", v=views, t=frames)
    hidden = torch.rand(batch, views, generator=generator) < torch.tensor([0.0, 0.05, 0.05])
    shown = shown * ~hidden
    return pictures * shown[:, :, None, None, None, None], shown


@torch.no_grad()
def logits_of(
    network: OutcomeNetwork, videos: Sequence[JudgedVideo], vocabulary: Sequence[str]
) -> tuple[Tensor, Tensor]:
    """Logits (n,) of all looks at the videos, and 1 where the video is a success."""
    shown = [(video, look) for video in videos for look in video.looks]
    logits, success = [], []
    for start in range(0, len(shown), 32):
        pairs = shown[start : start + 32]
        batch = _batch([video for video, _ in pairs], [look for _, look in pairs], vocabulary)
        logits.append(network(batch.pictures, batch.shown, batch.words).float())
        success.append(batch.success)
    return torch.cat(logits), torch.cat(success)


def calibrate(logits: np.ndarray, success: np.ndarray) -> tuple[float, float]:
    """Scale and bias of the logits under which outcomes are likeliest (Platt 1999)."""

    def loss(values: np.ndarray) -> float:
        shifted = np.exp(values[0]) * logits + values[1]
        return float(np.logaddexp(0.0, np.where(success > 0.5, -shifted, shifted)).mean() + 1e-3 * (values**2).sum())

    scale, bias = minimize(loss, np.zeros(2)).x
    return float(np.exp(scale)), float(bias)


def undecided_margin(probability: np.ndarray, success: np.ndarray, least_right: float) -> float:
    """The smallest distance from one half beyond which ``least_right`` of the verdicts are right; 0.5, all undecided, without any."""
    distance = np.abs(probability - 0.5)
    order = np.argsort(-distance, kind="stable")
    right = ((probability > 0.5) == (success > 0.5))[order].cumsum() / np.arange(1, len(order) + 1)
    good = np.flatnonzero(right >= least_right)
    if not len(good):
        return 0.5
    last = int(good[-1])
    return 0.0 if last == len(order) - 1 else float(distance[order[last + 1]])


def train_judge(config: JudgeConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Train on the outcomes of the training split, calibrate on the validation split.

    Inputs: episodes; tokenizer, with which half of the videos are seen as it gives them back. Output: model.safetensors, judge.json
    (what it knows, its calibration and its undecided band), metrics.jsonl (losses).

    Raises: DataError when a split has no recorded outcomes of both kinds.
    """
    episodes = EpisodeSet.open(inputs["episodes"])
    tokenizer = load_tokenizer(inputs["tokenizer"]) if "tokenizer" in inputs else None
    rows = {split: [episodes.rows[n] for n in episodes.select(split=split)] for split in ("train", "validation")}
    ended = {split: [row for row in own if judgeable(row)] for split, own in rows.items()}
    for split, own in ended.items():
        if {row.outcome for row in own} != {*_OUTCOMES}:
            raise DataError(
                f"The split {split} does not have both outcomes", where=episodes.root,
                expected="recordings that ended in success, and others that ended in failure",
                got=f"{len(rows[split])} recordings, outcomes {sorted({row.outcome for row in own}) or 'unknown'}",
                next_step="draw splits over scenes (curate.splits: {by: scene, validation: 0.1}), or set train_judge to null",
            )  # fmt: skip
    videos = {
        split: [
            load_video(episodes, row, config, tokenizer)
            for row in with_progress(own, f"train_judge {split}", "episode")
        ]
        for split, own in ended.items()
    }
    return fit_judge(config, videos["train"], videos["validation"], output) | {
        "found": len(episodes),
        "kept": len(videos["train"]) + len(videos["validation"]),
        "left_out": {
            "in other splits": len(episodes) - sum(map(len, rows.values())),
            f"without a recorded success or failure, an instruction, or {len(POSITIONS)} frames": sum(
                map(len, rows.values())
            )
            - sum(map(len, ended.values())),
        },
    }


def judgeable(row: EpisodeRow) -> bool:
    """True for a recording with an outcome, an instruction and as many pictures as are looked at."""
    long_enough = row.video_frames >= len(POSITIONS)
    return row.outcome in _OUTCOMES and bool(instruction_words(row.instruction)) and long_enough


def fit_judge(
    config: JudgeConfig, training: Sequence[JudgedVideo], validation: Sequence[JudgedVideo], output: Path
) -> dict[str, Any]:
    """Train and calibrate on loaded videos; writes the judge."""
    vocabulary = sorted({word for video in training for word in instruction_words(video.instruction)})
    verbs = sorted({instruction_words(video.instruction)[0] for video in training})
    torch.manual_seed(config.seed)
    network = OutcomeNetwork(config.widths, len(vocabulary))
    drawing = by_task(training)
    objective = OutcomeObjective(network, len(drawing))

    def validate() -> dict[str, float]:
        logits, success = logits_of(network, validation, vocabulary)
        loss = functional.binary_cross_entropy_with_logits(logits, success)
        return {"loss": float(loss), "accuracy": float(((logits > 0) == (success > 0.5)).float().mean())}

    result = train(
        config.trainer,
        groups=[ParameterGroup("judge", dict(network.named_parameters()))],
        objective=objective,
        load=lambda index: outcome_batch(drawing, objective.losses, vocabulary, config, index),
        validate=validate,
        output=output,
        identity={"config": config.model_dump(mode="json"), "episodes": [video.name for video in training]},
        title="judge",
        schedule=config.schedule,
    )
    # Calibrated as it is written: in half precision.
    halves = {name: value.detach().cpu().to(torch.float16).contiguous() for name, value in result.average.items()}
    network.load_state_dict({name: value.float() for name, value in halves.items()})
    logits, success = (values.double().numpy() for values in logits_of(network.eval(), validation, vocabulary))
    scale, bias = calibrate(logits, success)
    probability = 1.0 / (1.0 + np.exp(-(scale * logits + bias)))
    margin = undecided_margin(probability, success, config.least_right)
    right, decided = (probability > 0.5) == (success > 0.5), np.abs(probability - 0.5) > margin
    if not decided.any():
        logger.warning("The judge is undecided about every validation recording: train it longer, or on more")
    metrics = {
        "videos": len(training),
        "steps": config.steps,
        "validation": {
            "videos": len(validation),
            "accuracy": float(right.mean()),
            "decided": float(decided.mean()),
            "accuracy_of_decided": float(right[decided].mean()) if decided.any() else None,
        },
    }
    write_bytes_atomic(output / WEIGHTS_FILE, save(halves))
    described = _Described(
        widths=config.widths, image_size=config.image_size, words=tuple(vocabulary), verbs=tuple(verbs),
        scale=scale, bias=bias, margin=margin,
    )  # fmt: skip
    facts = {"kind": "learned_judge", **described.model_dump(mode="json"), "training": config.model_dump(mode="json")}
    write_json_atomic(output / DESCRIPTION_FILE, facts | metrics)
    return metrics


def load_video(
    episodes: EpisodeSet, row: EpisodeRow, config: JudgeConfig, tokenizer: VideoTokenizer | None
) -> JudgedVideo:
    """Pictures of a recording."""
    index = episodes.position(row.episode_id)
    videos = {view: VideoFrames(episodes.clip(index, view)) for view in VIEWS if view in row.views}
    count = min(len(video) for video in videos.values())
    chosen = frame_numbers(range(count), count)
    frames: dict[str, np.ndarray] = {}
    again: dict[str, np.ndarray] = {}
    generator = step_generator(config.seed, index, "cpu")
    for view, video in videos.items():
        if tokenizer is None:
            frames[view] = resized_frames(video[chosen], config.image_size)
            continue
        whole = resized_frames(np.stack(list(video)), config.image_size)
        frames[view] = whole[chosen]
        again[view] = tokenized(tokenizer, whole[:count], chosen, config.disturbance, generator)
    looks = [look_at(row.instruction, own) for own in (frames, again) if own]
    return JudgedVideo(row.episode_id, row.instruction, row.outcome == "success", tuple(looks))


@torch.no_grad()
def tokenized(
    tokenizer: VideoTokenizer, frames: np.ndarray, chosen: Sequence[int], disturbance: float, generator: torch.Generator
) -> np.ndarray:
    """The chosen frames as the tokenizer gives them back from disturbed codes, the first one as it is: uint8 (n, h, w, 3).

    Only the first frame and groups of frames about the chosen ones are coded.
    """
    group = tokenizer.temporal_compression
    ends = torch.randint(0, group, (len(chosen) - 1,), generator=generator).tolist()
    lasts = [min(len(frames) - 1, number + later) for number, later in zip(chosen[1:], ends, strict=True)]
    numbers = [max(1, last - group + 1 + k) for last in lasts for k in range(group)]
    video = frames_to_video(frames[[0, *numbers]])[None]
    again = tokenizer.decode(disturb(tokenizer.encode(video), disturbance, generator), video[:, :, 0])
    decoded = video_to_frames(again[0])
    slots = [1 + n * group + numbers[n * group : (n + 1) * group].index(number) for n, number in enumerate(chosen[1:])]
    return np.concatenate([frames[:1], decoded[slots]])
