"""How well the measured judge tells success from failure in true videos, and in true videos through a tokenizer.

    python benchmarks/judge_recordings.py RECORDINGS [--tokenizer FOLDER] [--split train validation] [--limit 500]

RECORDINGS is an EpisodeSet of `worldline record` (episodes, or banks with their sealed outcomes). The robot masks that the
judge needs are the exact ones of the recording, so that nothing but the judge (and the tokenizer) is measured: this is
what no prediction can exceed. Per task the area under the curve of the judge's score, the same within banks, and the
share of outcomes that its rules tell rightly.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import torch
from tqdm import tqdm

from benchmarks.outcome_ladder import IMAGE, area
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.evaluation.planning.selectors import planning_indices
from worldline_core.evaluation.policy.evidence import establishes_success, route
from worldline_core.evaluation.policy.measured_judge import UNSEEN_SCORE, facts, measure, score
from worldline_core.model.tokenizers import load_tokenizer
from worldline_core.model.video_tokenizer import VideoTokenizer
from worldline_core.recorder.banks import SEALED_FILE


@dataclass(frozen=True)
class KnownMasks:
    """A segmenter that gives the recording's own masks (n, h, w) of the frames that the judge sees."""

    masks: np.ndarray
    name: str = "recorded"
    description: str = "the recording's exact masks"
    follows: bool = True

    def segment(self, video: np.ndarray, points: np.ndarray | None) -> np.ndarray:
        return self.masks


def shrunk(images: np.ndarray) -> np.ndarray:
    """Images (n, h, w, 3) at the model's resolution."""
    return np.stack([cv2.resize(image, IMAGE[::-1], interpolation=cv2.INTER_AREA) for image in images])


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
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--tokenizer", type=Path)
    parser.add_argument("--split", nargs="+", help="splits; all by default")
    parser.add_argument("--limit", type=int)
    arguments = parser.parse_args()
    episodes = EpisodeSet.open(arguments.recordings)
    sealed = arguments.recordings / SEALED_FILE
    outcomes = (
        {row["episode_id"]: row["outcome"] for row in pq.read_table(sealed).to_pylist()} if sealed.exists() else {}
    )
    tokenizer = None if arguments.tokenizer is None else load_tokenizer(arguments.tokenizer)
    judged: dict[str, list[tuple[float, bool, bool, str | None]]] = defaultdict(list)
    for position in tqdm(episodes.select(split=arguments.split)[: arguments.limit], disable=None):
        row = episodes.rows[position]
        outcome, masks = outcomes.get(row.episode_id, row.outcome), episodes.robot_masks(position, "head")
        if outcome == "unknown" or masks is None:
            continue
        chosen = list(planning_indices(row.num_frames))
        frames = {view: shrunk(episodes.frames(position, view)) for view in row.views}
        if tokenizer is not None:
            frames = {view: through(tokenizer, video) for view, video in frames.items()}
        late = [
            cv2.resize(mask.astype(np.float32), IMAGE[::-1], interpolation=cv2.INTER_AREA) for mask in masks[chosen]
        ]
        family = route(row.instruction)
        shown = {view: video[chosen] for view, video in frames.items()}
        measured = measure(KnownMasks(np.stack(late) >= 0.5), row.instruction, family, shown, None)
        done = establishes_success(facts(measured, row.instruction, family))
        value = UNSEEN_SCORE if measured is None else score(measured)
        judged[task_of(row.instruction)].append((value, done, outcome == "success", row.bank))
    table = {}
    for task, rows in sorted(judged.items()):
        values, done, success = (np.array(column) for column in list(zip(*rows, strict=True))[:3])
        banks = np.array([str(bank) for *_, bank in rows])
        within = [area(values[banks == bank], success[banks == bank]) for bank in np.unique(banks)]
        within = [value for value in within if not np.isnan(value)]
        table[task] = {
            "episodes": len(rows),
            "successes": round(float(success.mean()), 3),
            "area": round(area(values, success), 3),
            "area_within_banks": round(float(np.mean(within)), 3) if within else None,
            "told_rightly": round(float((done == success).mean()), 3),
        }
    print(json.dumps(table, indent=1))


if __name__ == "__main__":
    main()
