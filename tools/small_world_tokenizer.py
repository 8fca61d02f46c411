"""The small world's tokenizer: bases fitted to recordings, and a decoder trained on them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from einops import rearrange
from torch import Tensor

from tools.small_world_data import SHORT, VIEWS, Recorded
from tools.small_world_measures import Facts
from tools.small_world_memory import recorded_files
from tools.small_world_runs import TokenizerSettings
from tools.small_world_steps import VIEW_SHARES, Step, trained
from worldline_core.model.tokenizers import PatchTokenizer, Refinement, fit_patch_tokenizer
from worldline_core.store.atomic import write_json_atomic
from worldline_core.training.train_tokenizer import (
    DecoderBatch,
    DecoderObjective,
    disturb,
    reconstruction_metrics,
    to_video,
)
from worldline_core.training.trainer import ParameterGroup, step_generator


def train_tokenizer(folder: Path, output: Path, settings: TokenizerSettings, device: str) -> None:
    """Fit the bases, train the decoder, save both with what they measure on validation recordings."""
    files: list[Recorded] = []
    for name in recorded_files(folder):
        if sum(len(file.facts) for file in files) < settings.episodes and (file := Recorded.read(folder / name)).short:
            files.append(file)
    stack = torch.from_numpy(np.concatenate([file.frames for file in files if file.split == "train"])).to(device)
    shares = torch.tensor(VIEW_SHARES)
    chosen = np.random.default_rng(0)

    def fitted() -> Tensor:
        clip = stack[int(chosen.integers(len(stack))), int(chosen.choice(len(VIEWS), p=VIEW_SHARES))]
        return to_video(rearrange(clip.cpu(), "f h w c -> 1 c f h w"))

    tokenizer = fit_patch_tokenizer(
        (fitted() for _ in range(600)),
        channels=settings.channels,
        refinement_width=settings.width,
        refinement_depth=settings.depth,
    )

    def load(index: int) -> DecoderBatch:
        draws = step_generator(50, index, "cpu")
        rows = torch.randint(len(stack), (settings.batch,), generator=draws)
        views = torch.multinomial(shares, settings.batch, replacement=True, generator=draws)
        # The first frame and three of the eight groups of four frames after it.
        groups = torch.randint(8, (settings.batch, 3), generator=draws).sort(dim=1).values
        frames = 1 + (groups[:, :, None] * 4 + torch.arange(4)).flatten(1)
        frames = torch.cat((torch.zeros_like(frames[:, :1]), frames), dim=1)
        video = to_video(rearrange(stack[rows[:, None], views[:, None], frames], "b f h w c -> b c f h w"))
        with torch.no_grad():
            codes = disturb(tokenizer.encode(video), 0.3, step_generator(51, index, device))
            coarse = tokenizer.decode_linear(codes)
        dropped = float(torch.rand((), generator=draws)) < 0.1
        return DecoderBatch(("",) * settings.batch, video, coarse, None if dropped else video[:, :, 0])

    def make() -> Step:
        torch.manual_seed(0)
        tokenizer.refinement = Refinement(tokenizer.temporal_compression, settings.width, settings.depth)
        decoder = tokenizer.to(device).refinement.train().requires_grad_(True)
        groups = [ParameterGroup("decoder", dict(decoder.named_parameters()))]
        return Step(DecoderObjective(tokenizer.refine), groups, load)

    identity: Facts = {"settings": settings.model_dump(mode="json"), "encoder": tokenizer.encoder_digest}
    result, counts, _ = trained(settings, 0, device, "tokenizer", output, identity, make)
    tokenizer.refinement.load_state_dict(result.average)
    tokenizer.refinement.eval().requires_grad_(False)
    facts: Facts = {**counts, "training_episodes": len(stack), "width": settings.width, "depth": settings.depth}
    tokenizer.save(output, facts)
    held = [file.frames[:5] for file in files if file.split == "validation"][:4]
    if held:
        shown = [
            torch.from_numpy(view).permute(3, 0, 1, 2) for part in held for view in part.reshape(-1, *part.shape[2:])
        ]
        facts["held_out"] = reconstruction_metrics(PatchTokenizer.load(output), shown[:30], SHORT)
    write_json_atomic(output / "figures.json", facts)
    print("tokenizer", json.dumps(facts), flush=True)
