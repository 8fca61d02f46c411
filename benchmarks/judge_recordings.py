"""Accuracy of the measured judge: on true videos, on these through a tokenizer, and on predictions.

    python benchmarks/judge_recordings.py RECORDINGS [--tokenizer FOLDER | --rollouts FOLDER | --model FOLDER --level 0.75]
        [--segmenter FOLDER] [--split train validation] [--every 3]

RECORDINGS is an EpisodeSet of `worldline record` (episodes, or banks with their sealed outcomes). By default the robot masks
that the judge needs are the exact ones of the recording, so that nothing but the judge (and the tokenizer, or the
prediction) is measured; with a segmenter, they are its masks of what is shown. These are the upper rungs of the ladder in
docs/recorded_worlds.md: (d) true latents, `--tokenizer`; (e) true latents noised to a level and denoised by a Stage II
model under the recording's own controls, `--model` with `--level` (and `--steps`); (f) samples, level 1 or `--rollouts`.
Per task the area under the curve of the
judge's score, the same within banks with its 95 % interval over banks, and the shares of outcomes that its rules tell rightly, of
failures that they call done, and of successes that they call failed.
"""

from __future__ import annotations

import json
from collections import defaultdict
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import torch
from tqdm import tqdm

from benchmarks.harness import command_line
from worldline_core.actions.action_maps import latent_frame_indices
from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.evaluation.planning.bracket import planning_indices
from worldline_core.evaluation.policy.judge import establishes_success, route
from worldline_core.evaluation.policy.measured_judge import UNSEEN_SCORE, facts, measure
from worldline_core.evaluation.scores import area_under_curve, bootstrap_mean
from worldline_core.evaluation.segmenters.learned import LearnedSegmenter
from worldline_core.evaluation.segmenters.segmenter import MaskStream, Segmenter
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.model.tokenizers import VideoTokenizer, frames_to_video, load_tokenizer, video_to_frames
from worldline_core.recorder.attempts import SEALED_FILE
from worldline_core.rollout.rollout_set import RolloutSet
from worldline_core.rollout.samplers import Noise, integrate, shifted_sigmas
from worldline_core.rollout.worldline import WorldLine

IMAGE = (64, 96)
SHIFT = 5.0
"""Shift of the model's noise levels towards noise."""


@dataclass(frozen=True)
class KnownMasks:
    """A segmenter that gives the recording's own masks (n, h, w) of the frames that the judge sees."""

    masks: np.ndarray
    name: str = "recorded"
    description: str = "the recording's exact masks"
    follows: bool = True

    def segment(self, video: np.ndarray, points: np.ndarray | None) -> np.ndarray:
        return self.masks

    def stream(self) -> MaskStream:
        return self.segment


def shrunk(images: np.ndarray) -> np.ndarray:
    """Images (n, h, w, 3) at the model's resolution."""
    return np.stack([cv2.resize(image, IMAGE[::-1], interpolation=cv2.INTER_AREA) for image in images])


class Denoiser:
    """A Stage II model that restores true latents from noise of a level, knowing the first frame and the controls."""

    def __init__(self, checkpoint: Path, level: float, steps: int) -> None:
        self.world = WorldLine.from_pretrained(checkpoint, expect_kind="stage2")
        self.sigmas = [level * sigma for sigma in shifted_sigmas(steps, SHIFT)]

    @torch.no_grad()
    def __call__(self, episode: Episode, frames: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Frames (n, h, w, 3) of each view, restored."""
        world = self.world
        kinematics = ArmKinematics(load_embodiment(str(episode.embodiment)))
        tracks, _ = compute_tracks(episode, kinematics)
        video = torch.stack([frames_to_video(frames[view], world.image_size) for view in world.views])
        maps = world.action_maps([tracks], latent_frame_indices(video.shape[2]), views=world.views)
        clean = world.tokenizer.encode(video)[None]
        noise = Noise([42]).draw(clean.shape[1:])
        first, level = clean[:, :, :, :1], self.sigmas[0]
        state = torch.cat([first, ((1 - level) * clean + level * noise)[:, :, :, 1:]], dim=3)

        def velocity(state: torch.Tensor, sigma: float) -> torch.Tensor:
            return world.model(state, torch.tensor([sigma]), action_maps=maps, views=world.views).velocity

        with torch.autocast("cpu", torch.bfloat16):
            state = integrate(velocity, state, self.sigmas)
            decoded = world.tokenizer.decode(state[0], video[:, :, 0])
        return {view: video_to_frames(decoded[v]) for v, view in enumerate(world.views)}


@torch.no_grad()
def through(tokenizer: VideoTokenizer, video: np.ndarray) -> np.ndarray:
    """uint8 (n, h, w, 3), encoded and decoded with the first frame at hand, as a prediction is."""
    pixels = torch.from_numpy(video).permute(3, 0, 1, 2)[None].float() / 127.5 - 1.0
    decoded = tokenizer.decode(tokenizer.encode(pixels), pixels[:, :, 0])[0]
    return ((decoded.permute(1, 2, 3, 0).clamp(-1, 1) + 1) * 127.5).round().to(torch.uint8).numpy()


def task_of(instruction: str) -> str:
    """lift, place, push, press, or lift with both arms."""
    return instruction.split()[0] + (" with both arms" if "both arms" in instruction else "")


def main() -> None:
    """Judge every chosen recording; print a table."""
    parser = command_line(__doc__)
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--tokenizer", type=Path)
    parser.add_argument("--rollouts", type=Path)
    parser.add_argument("--model", type=Path, help="a Stage II checkpoint")
    parser.add_argument("--level", type=float, default=1.0, help="noise that the model starts from, 0..1")
    parser.add_argument("--steps", type=int, default=1, help="Euler steps of the model")
    parser.add_argument("--segmenter", type=Path)
    parser.add_argument("--split", nargs="+", help="splits; all by default")
    parser.add_argument("--every", type=int, default=1, help="only each so many-th recording")
    arguments = parser.parse_args()
    episodes = EpisodeSet.open(arguments.recordings)
    sealed = arguments.recordings / SEALED_FILE
    outcomes = (
        {row["episode_id"]: row["outcome"] for row in pq.read_table(sealed).to_pylist()} if sealed.exists() else {}
    )
    rollouts = None if arguments.rollouts is None else RolloutSet.open(arguments.rollouts)
    learned = None if arguments.segmenter is None else LearnedSegmenter.load(arguments.segmenter)
    tokenizer = None if arguments.tokenizer is None else load_tokenizer(arguments.tokenizer)
    denoiser = None
    if arguments.model is not None:
        denoiser = Denoiser(arguments.model, arguments.level, arguments.steps)
    judged: dict[str, list[tuple[float, bool, bool, str | None]]] = defaultdict(list)
    for position in tqdm(episodes.select(split=arguments.split)[:: arguments.every], disable=None):
        row = episodes.rows[position]
        outcome = outcomes.get(row.episode_id, row.outcome)
        if outcome == "unknown" or (rollouts is not None and row.episode_id not in rollouts.episode_ids):
            continue
        chosen = list(planning_indices(row.num_frames))
        if rollouts is not None:
            frames = {view: rollouts.frames(row.episode_id, view) for view in row.views}
        else:
            frames = {view: shrunk(episodes.frames(position, view)) for view in row.views}
        if tokenizer is not None:
            frames = {view: through(tokenizer, video) for view, video in frames.items()}
        if denoiser is not None:
            frames = denoiser(episodes.episode(position), frames)
        segmenter: Segmenter | None = learned
        if segmenter is None:
            exact = episodes.robot_masks(position, "head")
            if exact is None:
                continue
            masks = np.asarray(exact)[chosen].astype(np.float32)
            late = [cv2.resize(mask, IMAGE[::-1], interpolation=cv2.INTER_AREA) for mask in masks]
            segmenter = KnownMasks(np.stack(late) >= 0.5)
        family = route(row.instruction)
        shown = {view: video[chosen] for view, video in frames.items()}
        measured = measure(segmenter, row.instruction, family, shown, None)
        done = establishes_success(facts(measured, row.instruction, family))
        value = UNSEEN_SCORE if measured is None else measured.score()
        judged[task_of(row.instruction)].append((value, done, outcome == "success", row.bank))
    table = {}
    for task, rows in sorted(judged.items()):
        values, done, success = (np.array(column) for column in list(zip(*rows, strict=True))[:3])
        banks = np.array([str(bank) for *_, bank in rows])
        within = [area_under_curve(values[banks == bank], success[banks == bank]) for bank in np.unique(banks)]
        within = [value for value in within if not np.isnan(value)]
        table[task] = {
            "episodes": len(rows),
            "successes": round(float(success.mean()), 3),
            "area": round(area_under_curve(values, success), 3),
            "area_within_banks": asdict(bootstrap_mean(within, seed=42)) if within else None,
            "rules_right": round(float((done == success).mean()), 3),
            "failures_called_done": round(float(done[~success].mean()), 3) if not success.all() else None,
            "successes_called_failed": round(float((~done[success]).mean()), 3) if success.any() else None,
        }
    print(json.dumps(table, indent=1))


if __name__ == "__main__":
    main()
