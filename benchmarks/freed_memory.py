"""What it costs to give freed memory back to the kernel: the shipped tokenizer's decoder, each way in its own process.

Run: `python benchmarks/freed_memory.py [--clips 24] [--threads 2]`. A batch of clips of 33 frames of 64 x 96 is decoded;
seconds are the best of six, by the clock.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

WAYS = ("given back", "kept")


def measure(way: str, clips: int, threads: int) -> dict[str, float]:
    """Seconds of a decode, and page faults of it, in this process."""
    import resource

    import torch

    from worldline_core.model.tokenizers import load_tokenizer
    from worldline_core.pipeline.steps import keep_freed_memory

    if way == "kept" and not keep_freed_memory():
        raise SystemExit("this C library, or a choice in the environment, does not let freed memory be kept")
    torch.set_num_threads(threads)
    tokenizer = load_tokenizer(Path("artifacts/shipped/models/tokenizer"))
    generator = torch.Generator().manual_seed(0)
    latents = 0.5 * torch.randn(clips, 32, 9, 8, 12, generator=generator)
    first = 2 * torch.rand(clips, 3, 64, 96, generator=generator) - 1
    best, faults = float("inf"), 0
    with torch.inference_mode():
        for _ in range(6):
            before, start = resource.getrusage(resource.RUSAGE_SELF).ru_minflt, time.perf_counter()
            tokenizer.decode(latents, first)
            best = min(best, time.perf_counter() - start)
            faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
    return {"seconds": round(best, 3), "page_faults": faults}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", type=int, default=24)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--way", choices=WAYS, help="measure one way in this process")
    arguments = parser.parse_args()
    if arguments.way:
        print(json.dumps(measure(arguments.way, arguments.clips, arguments.threads)))
        return
    command = [sys.executable, __file__, "--clips", str(arguments.clips), "--threads", str(arguments.threads), "--way"]
    environment = {**os.environ, "PYTHONPATH": str(Path.cwd())}
    found = {}
    for way in WAYS:
        done = subprocess.run([*command, way], env=environment, capture_output=True, text=True, check=True)
        found[way] = json.loads(done.stdout)
        print(f"{way}: {found[way]}")
    print(f"ratio of the seconds: {found['given back']['seconds'] / found['kept']['seconds']:.2f}")


if __name__ == "__main__":
    main()
