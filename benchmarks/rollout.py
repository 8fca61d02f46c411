"""Seconds a frame of the whole-clip and the causal sampler, and the cost of a block from the first to the fiftieth.

    python benchmarks/rollout.py [--checkpoint FOLDER] [--tokenizer FOLDER] [--device cuda] [--blocks 50]

Without folders the models have random weights: speed does not depend on them. Decoding is included, writing is not.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch
from einops import rearrange

from benchmarks.harness import command_line
from worldline_core.model.checkpoint import load_checkpoint
from worldline_core.model.tokenizers import PatchTokenizer, VideoTokenizer, load_tokenizer
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import CAUSAL_SIGMAS, CausalSpec, WorldModelConfig
from worldline_core.rollout.samplers import BlockCausalSimulator, Noise, rollout_full_clip

GRID = (8, 12)


def timed(work: Callable[[], object], device: str, *, processor: bool = False) -> float:
    """Wall seconds; or, on request and on a CPU, processor seconds, which a busy machine does not stretch."""
    clock = time.process_time if processor and device == "cpu" else time.perf_counter
    if device.startswith("cuda"):
        torch.cuda.synchronize()
    start = clock()
    work()
    if device.startswith("cuda"):
        torch.cuda.synchronize()
    return clock() - start


@torch.no_grad()
def measure(
    model: WorldModel, spec: CausalSpec, tokenizer: VideoTokenizer, options: argparse.Namespace
) -> dict[str, object]:
    device, views = options.device, model.config.views
    channels, frames = model.config.latent_channels, 1 + 4 * spec.block_size * 2
    latent_frames = 1 + (frames - 1) // 4
    first = torch.randn(1, len(views), channels, *GRID, device=device)
    maps = torch.randn(1, len(views), model.config.map_channels, latent_frames, *GRID, device=device)

    def decode(latents: torch.Tensor) -> torch.Tensor:
        with torch.autocast(device.split(":")[0], torch.bfloat16):
            return tokenizer.decode(rearrange(latents, "b v c t h w -> (b v) c t h w"))

    def full() -> None:
        decode(rollout_full_clip(model, first, maps, noise=Noise([42]), steps=35, views=views, bfloat16=True))

    def causal(blocks: int = 2, *, processor: bool = False) -> list[float]:
        simulator = BlockCausalSimulator(model, spec, noise=Noise([42]), views=views, bfloat16=True)
        simulator.start(first, maps[:, :, :, :1])
        controls = maps[:, :, :, 1 : 1 + spec.block_size]
        return [
            timed(
                lambda: decode(torch.cat((first[:, :, :, None], simulator.step(controls)), dim=3)),
                device,
                processor=processor,
            )
            for _ in range(blocks)
        ]

    full(), causal()
    full_seconds = statistics.median(timed(full, device) for _ in range(options.repeats))
    causal_seconds = statistics.median(sum(causal()) for _ in range(options.repeats))
    blocks = [causal(options.blocks, processor=True) for _ in range(options.repeats)]
    by_block = [statistics.median(times) for times in zip(*blocks, strict=True)]
    # The first blocks run on a window that is not yet full.
    settled = by_block[1 + spec.recent_blocks]
    ends = (statistics.median(by_block[1 + spec.recent_blocks :][:8]), statistics.median(by_block[-8:]))
    return {
        "frames": frames,
        "full_clip_seconds_per_frame": full_seconds / frames,
        "causal_seconds_per_frame": causal_seconds / frames,
        "speed_up": full_seconds / causal_seconds,
        "block_processor_seconds" if device == "cpu" else "block_seconds": {
            "first": by_block[0],
            "settled": settled,
            "last": by_block[-1],
        },
        "last_eight_over_first_eight_settled": ends[1] / ends[0],
    }


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--tokenizer", type=Path)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--blocks", type=int, default=50)
    parser.add_argument("--recent-blocks", type=int, help="by default as the checkpoint says, or 3")
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    spec = CausalSpec(block_size=4, sink_blocks=1, recent_blocks=3, sigmas=CAUSAL_SIGMAS)
    if options.checkpoint is None:
        model = WorldModel(WorldModelConfig(towers="generation"))
        model.initialise(torch.Generator().manual_seed(0))
    else:
        model, info = load_checkpoint(options.checkpoint, towers="generation")
        spec = info.causal or spec
    if options.recent_blocks is not None:
        spec = spec.model_copy(update={"recent_blocks": options.recent_blocks})
    tokenizer: VideoTokenizer = PatchTokenizer() if options.tokenizer is None else load_tokenizer(options.tokenizer)
    if isinstance(tokenizer, torch.nn.Module):
        tokenizer.to(options.device).eval().requires_grad_(False)
    figures = measure(model.to(options.device).eval(), spec, tokenizer, options)
    print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
