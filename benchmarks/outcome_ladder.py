"""How well an outcome can be known from ever less: an information ladder for recorded worlds.

    python benchmarks/outcome_ladder.py configs/recording/small_world.yaml [--train 1200] [--test 400] [--seeds 3]

Draws episodes as `worldline record` does for the configuration's training groups, in training and in
test scenes, executes them, and renders no more than their first frames. On each rung a small
network, trained on the training scenes, predicts success; its area under the curve is measured in the test scenes,
within each task, with a bootstrap interval over episodes:

    (a)  start places of the things, and the tools' poses at every frame (all that decides the outcome)
    (b)  the same at the frames of the latents only, every fourth
    (c)  what the model is given: first frames of three views, and action maps on the latent grid at those frames
    (c4) the same with the maps of every frame

The upper rungs (d) to (f), true latents, noised and restored latents, and samples, are told by the judge:
benchmarks/judge_recordings.py.

The colours that the instruction names are given to (c) as pictures of where they are, so that it need not learn to read.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from worldline_core.actions.action_maps import latent_frame_indices, render_action_maps
from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.actions.episode_tracks import collate_tracks
from worldline_core.config import load_config
from worldline_core.evaluation.segmenters.coloured_things import colour_share, named_things
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.recorder.record import EMBODIMENT_STREAM, SPLIT_STREAM, RecordConfig, open_recorder
from worldline_core.recorder.rendering import prepare_rendering
from worldline_core.recorder.simulate import EpisodeRecorder
from worldline_core.recorder.things import DRAWER_TRAVEL, Layout

IMAGE, GRID, SIGMA_PX_REF = (64, 96), (8, 12), 36.0
VIEWS = ("head", "left_wrist", "right_wrist")
RUNGS = ("a", "b", "c", "c4")


@dataclass(frozen=True)
class Samples:
    """Arrays over episodes: tasks, outcomes, and what each rung sees.

    Attributes:
        pixels: (n, 2) pixels of the thing in the head view and in the acting arm's wrist view, at model resolution.
        paths: (n, t, 19) acting tool, then the other, against the thing and its destination [dm], cos and sin of its
            turn, opening; time.
        pictures: (n, v, 5, h, w) float16: first frames and where the two named colours are, 0..1.
        maps: (n, v, t, 9, rows, columns) float16 action maps of every frame.
    """

    tasks: np.ndarray
    success: np.ndarray
    pixels: np.ndarray
    paths: np.ndarray
    pictures: np.ndarray
    maps: np.ndarray

    def chosen(self, which: np.ndarray) -> Samples:
        return Samples(**{name: value[which] for name, value in vars(self).items()})


def anchors(layout: Layout) -> np.ndarray:
    """(2, 3) where the thing of the task stands at the start, and where it should go; base frame [m]."""
    thing = np.array([*layout.target.xy, 0.0])
    if layout.family == "close":
        return np.stack([thing - [DRAWER_TRAVEL, 0, 0], thing])
    return np.stack([thing, thing if layout.goal is None else np.array([*layout.goal.xy, 0.0])])


def draw_samples(recorder: EpisodeRecorder, families: Sequence[str], split: str, stream: int, count: int) -> Samples:
    """``count`` episodes of one embodiment, families in turn."""
    kinematics = ArmKinematics(load_embodiment(recorder.scene.robot.name))
    columns: dict[str, list[np.ndarray]] = {name: [] for name in Samples.__dataclass_fields__}
    for number in tqdm(range(count), desc=recorder.scene.robot.name, disable=None):
        family = families[number % len(families)]
        layout, motion, scene, random = recorder.draw(
            episode_id="drawn",
            split=split,
            family=family,
            entropy=(77, stream, SPLIT_STREAM[split], number),
            num_frames=33,
        )
        first = replace(motion, qpos=motion.qpos[:1], state=motion.state[:1], action=motion.action[:1])
        filmed = recorder.film(layout, first, episode_id="e", scene_id=scene, split="train", jitter=random)
        frames = len(motion.action)
        cameras = {
            view: camera if view == "head" else replace(camera, T_base_camera=camera.T_base_camera.repeat(frames, 0))
            for view, camera in filmed.episode.cameras.items()
        }
        episode = replace(
            filmed.episode, state=motion.state, action=motion.action, timestamps=np.arange(frames) / 8, cameras=cameras
        )
        tracks, _ = compute_tracks(episode, kinematics)
        maps = render_action_maps(collate_tracks([tracks], VIEWS), tracks.image_size, GRID, SIGMA_PX_REF)[0]
        pictures = np.zeros((len(VIEWS), 5, *IMAGE), np.float16)
        for slot, view in enumerate(VIEWS):
            if view in filmed.frames:
                small = cv2.resize(filmed.frames[view][0], IMAGE[::-1], interpolation=cv2.INTER_AREA)
                pictures[slot, :3] = small.transpose(2, 0, 1) / 255.0
                for place, thing in enumerate(named_things(layout.instruction)[:2]):
                    pictures[slot, 3 + place] = colour_share(small[None], thing.colour)[0]
        places = anchors(layout)
        pixels = [(pictures[slot, 3] > 0.5).sum() for slot in (0, 1 + layout.arm)]
        path = np.linspace(-1, 1, frames)[:, None]
        for arm in (layout.arm, 1 - layout.arm):
            tool = tracks.T_base_tool[:, arm]
            beside = (tool[:, None, :3, 3] - places[None]).reshape(frames, 6) * 10
            path = np.concatenate([path, beside, tool[:, :2, 1], tracks.gripper[:, 0, arm, None]], axis=1)
        columns["pixels"].append(np.array(pixels))
        columns["tasks"].append(np.array(family))
        columns["success"].append(np.array(motion.outcome == "success"))
        columns["paths"].append(path.astype(np.float32))
        columns["pictures"].append(pictures)
        columns["maps"].append(maps.permute(0, 2, 1, 3, 4).numpy().astype(np.float16))
    return Samples(**{name: np.stack(values) for name, values in columns.items()})


class PathNet(nn.Module):
    """Rungs (a) and (b): convolutions over time, the maximum and the mean of what they find."""

    def __init__(self, channels: int, tasks: int, width: int = 64) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv1d(channels + tasks, width, 3, padding=1), nn.GELU(),
            nn.Conv1d(width, width, 3, padding=1), nn.GELU(),
            nn.Conv1d(width, width, 3, padding=1), nn.GELU(),
        )  # fmt: skip
        self.head = nn.Sequential(nn.Dropout(0.2), nn.Linear(2 * width, width), nn.GELU(), nn.Linear(width, 1))

    def forward(self, task: Tensor, path: Tensor) -> Tensor:
        """Logits (n,) for tasks one-hot (n, k) and paths (n, t, c)."""
        words = task[:, None].expand(-1, path.shape[1], -1)
        found = self.body(torch.cat([path, words], dim=2).transpose(1, 2))
        return self.head(torch.cat([found.amax(2), found.mean(2)], dim=1))[:, 0]


class MapNet(nn.Module):
    """Rung (c): in each view the first frame's features and the maps of all frames, convolved together and pooled."""

    def __init__(self, frames: int, tasks: int, width: int = 48) -> None:
        super().__init__()
        self.picture = nn.Sequential(nn.Conv2d(5, 24, 4, 4), nn.GELU(), nn.Conv2d(24, width, 3, 2, 1))
        self.maps = nn.Conv2d(9 * frames, width, 1)
        self.words = nn.Linear(tasks + len(VIEWS), width)
        self.body = nn.Sequential(
            nn.GELU(),
            nn.Conv2d(width, width, 3, padding=1),
            nn.GELU(),
            nn.Conv2d(width, width, 3, padding=1),
            nn.GELU(),
        )
        self.head = nn.Sequential(nn.Dropout(0.2), nn.Linear(4 * width, width), nn.GELU(), nn.Linear(width, 1))

    def forward(self, task: Tensor, pictures: Tensor, maps: Tensor) -> Tensor:
        """Logits (n,) for tasks (n, k), pictures (n, v, 5, h, w), maps (n, v, t, 9, rows, columns)."""
        pooled = []
        for view in range(len(VIEWS)):
            which = torch.zeros(len(task), len(VIEWS))
            which[:, view] = 1
            words = self.words(torch.cat([task, which], dim=1))[..., None, None]
            found = self.body(self.picture(pictures[:, view]) + self.maps(maps[:, view].flatten(1, 2)) + words)
            pooled.append(torch.cat([found.amax((2, 3)), found.mean((2, 3))], dim=1))
        wrists = torch.stack(pooled[1:]).amax(0)
        return self.head(torch.cat([pooled[0], wrists], dim=1))[:, 0]


def fit_and_score(
    model: nn.Module, train: list[Tensor], labels: Tensor, test: list[Tensor], epochs: int, rate: float
) -> np.ndarray:
    """Train with a cosine schedule; scores (n,) of the test samples."""
    optimizer = torch.optim.AdamW(model.parameters(), lr=rate, weight_decay=0.02)
    batch, count = 32, len(labels)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, total_steps=epochs * -(-count // batch))
    model.train()
    for _ in range(epochs):
        for chosen in torch.randperm(count).split(batch):
            loss = nn.functional.binary_cross_entropy_with_logits(
                model(*(value[chosen].float() for value in train)), labels[chosen]
            )
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    model.eval()
    with torch.no_grad():
        parts = [model(*(v.float() for v in values)) for values in zip(*(t.split(64) for t in test), strict=True)]
    return torch.cat(parts).numpy()


def area(scores: np.ndarray, success: np.ndarray) -> float:
    """Share of pairs (success, failure) in which the success has the higher score; ties count half."""
    wins, losses = scores[success], scores[~success]
    if not len(wins) or not len(losses):
        return float("nan")
    return float((wins[:, None] > losses).mean() + 0.5 * (wins[:, None] == losses).mean())


def interval(scores: np.ndarray, success: np.ndarray, draws: int = 1000) -> tuple[float, float]:
    """95 % bootstrap interval of the area over episodes."""
    random = np.random.default_rng(0)
    areas = [area(scores[i], success[i]) for i in random.integers(0, len(scores), (draws, len(scores)))]
    low, high = np.nanquantile(areas, [0.025, 0.975])
    return float(low), float(high)


def ladder(train: Samples, test: Samples, seeds: int, chosen: Sequence[str]) -> dict[str, dict[str, dict[str, float]]]:
    """Area per rung and task; scores are averaged over seeds."""
    names = sorted(set(train.tasks))

    def tensors(samples: Samples, *values: np.ndarray) -> list[Tensor]:
        one_hot = torch.tensor(samples.tasks[:, None] == np.array(names)).float()
        return [one_hot, *(torch.from_numpy(value) for value in values)]

    latent = latent_frame_indices(train.paths.shape[1])
    labels = torch.tensor(train.success).float()
    rungs = {
        "a": lambda s: tensors(s, s.paths),
        "b": lambda s: tensors(s, s.paths[:, latent]),
        "c": lambda s: tensors(s, s.pictures, s.maps[:, :, latent]),
        "c4": lambda s: tensors(s, s.pictures, s.maps),
    }
    table: dict[str, dict[str, dict[str, float]]] = {}
    for rung in chosen:
        inputs = rungs[rung]
        start, seen, unseen, scores = time.process_time(), inputs(train), inputs(test), []
        for seed in range(seeds):
            torch.manual_seed(seed)
            if rung[0] in "ab":
                scores.append(fit_and_score(PathNet(19, len(names)), seen, labels, unseen, 50, 3e-3))
            else:
                scores.append(fit_and_score(MapNet(seen[2].shape[2], len(names)), seen, labels, unseen, 20, 3e-3))
        mean = np.mean(scores, axis=0)
        for task in names:
            of = test.tasks == task
            low, high = interval(mean[of], test.success[of])
            value = area(mean[of], test.success[of])
            table.setdefault(rung, {})[task] = {"area": round(value, 3), "low": round(low, 3), "high": round(high, 3)}
        print(rung, json.dumps(table[rung]), f"{time.process_time() - start:.0f} s", flush=True)
    return table


def main() -> None:
    """Draw, train, measure; print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("config", type=Path)
    parser.add_argument("--train", type=int, default=1200, help="episodes of all embodiments together")
    parser.add_argument("--test", type=int, default=400)
    parser.add_argument("--rungs", nargs="+", choices=RUNGS, default=RUNGS)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--output", type=Path, help="write the table as JSON")
    arguments = parser.parse_args()
    prepare_rendering()
    config = load_config(RecordConfig, path=arguments.config)
    groups = {group.embodiment: group for group in config.groups if group.split == "train"}
    parts: dict[str, list[Samples]] = {"train": [], "test": []}
    for embodiment, group in groups.items():
        recorder = open_recorder(embodiment)
        for split, count in (("train", arguments.train), ("test", arguments.test)):
            stream, share = EMBODIMENT_STREAM[embodiment], count // len(groups)
            parts[split].append(draw_samples(recorder, group.families, split, stream, share))
        recorder.close()
    merged = {
        split: Samples(**{n: np.concatenate([getattr(s, n) for s in some]) for n in Samples.__dataclass_fields__})
        for split, some in parts.items()
    }
    facts = {}
    for task in sorted(set(merged["train"].tasks)):
        of = merged["train"].tasks == task
        head, wrist = np.median(merged["train"].pixels[of], axis=0)
        successes = round(float(merged["train"].success[of].mean()), 3)
        facts[str(task)] = {"successes": successes, "head_px": float(head), "wrist_px": float(wrist)}
    print(json.dumps(facts), flush=True)
    table = ladder(merged["train"], merged["test"], arguments.seeds, arguments.rungs)
    if arguments.output:
        arguments.output.write_text(json.dumps({"tasks": facts, "areas": table}, indent=1))


if __name__ == "__main__":
    main()
