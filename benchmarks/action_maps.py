"""Speed of the nine-channel action maps beside drawing them frame by frame with OpenCV.

Run: `python benchmarks/action_maps.py [--threads 1] [--device cpu]`. All figures come from one run on one machine; the
ratios are what carries over. On one CPU thread the clock is the process's CPU time, so other programs disturb little.

What is compared, all for the same tracks (3 views, 2 arms, 33 latent frames) and with 30 x 40 cells as the result:

- *GE-Sim's way*: frame by frame and view by view a colour picture at the size of the video, a filled disc for each
  tool in a colour of its opening, three thick lines for its axes, scaled to 0..1; here reduced to the grid. Three
  channels; written anew from the description of that method, colours looked up instead of computed.
- *nine channels drawn*: the same nine channels as ours, with the Gaussian as OpenCV circles of falling intensity at
  the size of the video, reduced to the grid.
- both again drawn directly on 30 x 40 cells, which nobody does (a disc then has a radius of three cells and its centre
  is rounded to one), as the lower bound of what drawing can cost.

The floor: a map is written once, 9 x 30 x 40 float32 = 43,200 bytes a view and frame, with 2 x 9 x 30 x 40 x arms
= 43,200 floating-point operations for two arms. Filling the same memory with zeros is measured beside it.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
import torch

from worldline_core.actions.action_maps import latent_frame_indices, render_action_maps
from worldline_core.actions.episode_tracks import TrackBatch

IMAGE, GRID, NUM_FRAMES, VIEWS, ARMS = (480, 640), (30, 40), 129, 3, 2
SIGMA_OF_WIDTH = 10 / 512
DISC_OF_WIDTH = 50 / 640
AXIS_COLOURS = (((0, 0, 255), (255, 255, 0), (0, 255, 255)), ((255, 0, 255), (255, 0, 0), (0, 255, 0)))
OPENING_COLOURS = np.stack([np.stack([255 - np.arange(256), np.full(256, 160), np.arange(256)], -1)] * ARMS)
BYTES, FLOPS = 4 * 9 * GRID[0] * GRID[1], 2 * 9 * GRID[0] * GRID[1] * ARMS


def seconds(call: Callable[[], object], at_least: float = 1.0) -> float:
    """Best time of one call, over at least `at_least` seconds of calls."""
    clock = time.process_time if torch.get_num_threads() == 1 and not torch.cuda.is_available() else time.perf_counter
    call()
    best, spent = float("inf"), 0.0
    while spent < at_least:
        start = clock()
        call()
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        best = min(best, clock() - start)
        spent += clock() - start
    return best


def random_tracks(num_frames: int) -> TrackBatch:
    generator = torch.Generator().manual_seed(0)
    shape = (1, num_frames, VIEWS, ARMS)
    return TrackBatch(
        uv=torch.rand(*shape, 2, generator=generator, dtype=torch.float64) * torch.tensor([640.0, 480.0]) - 0.5,
        depth=torch.rand(*shape, generator=generator) + 0.3,
        rot6d=torch.rand(*shape, 6, generator=generator) * 2 - 1,
        gripper=torch.rand(*shape, generator=generator),
        valid=torch.ones(shape, dtype=torch.bool),
    )


def on_canvas(tracks: TrackBatch, canvas: tuple[int, int]) -> np.ndarray:
    """uv of the first clip in pixels of a canvas: (t, v, a, 2)."""
    scale = np.array([canvas[1] / IMAGE[1], canvas[0] / IMAGE[0]])
    return (tracks.uv[0].numpy() + 0.5) * scale - 0.5


def drawn_as_gesim(tracks: TrackBatch, canvas: tuple[int, int]) -> torch.Tensor:
    """Discs and axes in colour, one picture a frame and view, reduced to the grid: (3, v, t, h, w)."""
    uv, opening, rot6d = on_canvas(tracks, canvas), tracks.gripper[0].numpy(), tracks.rot6d[0].numpy()
    radius, thickness = max(1, round(DISC_OF_WIDTH * canvas[1])), max(1, round(canvas[1] / 80))
    reach = 0.1 * canvas[1]
    third = np.cross(rot6d[..., :3], rot6d[..., 3:])
    tips = uv[..., None, :] + reach * np.stack([rot6d[..., :2], rot6d[..., 3:5], third[..., :2]], axis=-2)
    bases, tips = uv.round().astype(int), tips.round().astype(int)
    colours = OPENING_COLOURS[np.arange(ARMS), (opening * 255).astype(int)]
    views = []
    for v in range(VIEWS):
        frames = []
        for t in range(len(uv)):
            picture = np.full((*canvas, 3), 50, np.uint8)
            for a in range(ARMS):
                cv2.circle(picture, bases[t, v, a].tolist(), radius, colours[t, v, a].tolist(), -1)
            for a in range(ARMS):
                base = bases[t, v, a].tolist()
                for axis in range(3):
                    cv2.line(picture, base, tips[t, v, a, axis].tolist(), AXIS_COLOURS[a][axis], thickness)
            if canvas != GRID:
                picture = cv2.resize(picture, GRID[::-1], interpolation=cv2.INTER_AREA)
            frames.append(picture / 255.0)
        views.append(np.stack(frames))
    return torch.from_numpy(np.stack(views)).permute(4, 0, 1, 2, 3).float()


def nine_channels_drawn(tracks: TrackBatch, canvas: tuple[int, int]) -> torch.Tensor:
    """Circles of falling intensity, outermost first, reduced to the grid, times the nine values: (v, 9, t, h, w)."""
    uv, (depth, rot6d, opening) = (
        on_canvas(tracks, canvas),
        (x[0].numpy() for x in (tracks.depth, tracks.rot6d, tracks.gripper)),
    )
    maps = np.zeros((VIEWS, 9, len(uv), *GRID), np.float32)
    sigma = SIGMA_OF_WIDTH * canvas[1]
    # One circle a pixel, but at least eight; positions in sixteenths of a pixel.
    radii = np.linspace(3 * sigma, 0, max(8, round(3 * sigma)), endpoint=False)
    levels = np.exp(-0.5 * (radii / sigma) ** 2).tolist()
    sixteenths = np.maximum(1, (radii * 16).round()).astype(int).tolist()
    for t in range(len(uv)):
        for v in range(VIEWS):
            for a in range(ARMS):
                heat = np.zeros(canvas, np.float32)
                centre = (uv[t, v, a] * 16).round().astype(int).tolist()
                for radius, level in zip(sixteenths, levels, strict=True):
                    cv2.circle(heat, centre, radius, level, -1, shift=4)
                if canvas != GRID:
                    heat = cv2.resize(heat, GRID[::-1], interpolation=cv2.INTER_AREA)
                values = np.array([1.0, depth[t, v, a], *rot6d[t, v, a], opening[t, v, a]], np.float32)
                maps[v, :, t] += values[:, None, None] * heat
    return torch.from_numpy(maps)


def clip_by_clip(tracks: TrackBatch, length: int) -> None:
    """Render a long recording as a loader does, one clip after the other."""
    pieces = [x.split(length, dim=1) for x in (tracks.uv, tracks.depth, tracks.rot6d, tracks.gripper, tracks.valid)]
    for piece in zip(*pieces, strict=True):
        render_action_maps(TrackBatch(*piece), IMAGE, GRID)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(arguments.threads)

    length = len(latent_frame_indices(NUM_FRAMES))
    clip = random_tracks(length)
    there = clip.to(arguments.device)
    maps = length * VIEWS
    ours = seconds(lambda: render_action_maps(there, IMAGE, GRID)) / maps
    buffer = render_action_maps(there, IMAGE, GRID)
    fill = seconds(buffer.zero_) / maps
    print(
        f"device {arguments.device}, {arguments.threads} thread(s), {VIEWS} views, {ARMS} arms, {length} latent frames"
    )
    print("| 30 x 40 maps | channels | us a map | maps/s | ours is faster by |\n|---|---:|---:|---:|---:|")
    print(f"| ours | 9 | {1e6 * ours:.2f} | {1 / ours:,.0f} | 1 |")
    for what, channels, draw, canvas in (
        ("GE-Sim's way, at 480 x 640, reduced", 3, drawn_as_gesim, IMAGE),
        ("nine channels drawn at 480 x 640, reduced", 9, nine_channels_drawn, IMAGE),
        ("GE-Sim's way, on the 30 x 40 cells", 3, drawn_as_gesim, GRID),
        ("nine channels drawn on the 30 x 40 cells", 9, nine_channels_drawn, GRID),
    ):
        drawn = seconds(partial(draw, clip, canvas)) / maps
        print(f"| {what} | {channels} | {1e6 * drawn:.2f} | {1 / drawn:,.0f} | {drawn / ours:,.0f} |")
    print(f"| the floor: filling the memory with zeros | 9 | {1e6 * fill:.2f} | {1 / fill:,.0f} | {fill / ours:.2f} |")
    print(
        f"a map: {BYTES:,} bytes, {FLOPS:,} FLOP; ours: {BYTES / ours / 1e9:.1f} GB/s, {FLOPS / ours / 1e9:.1f} GFLOP/s"
    )
    exact = render_action_maps(clip, IMAGE, GRID)[0]
    for canvas in (IMAGE, GRID):
        apart = (nine_channels_drawn(clip, canvas) - exact).abs().max()
        print(f"nine channels drawn at {canvas[0]} x {canvas[1]} differ from the equation by up to {float(apart):.3f}")
    print("\n| latent frames, clip by clip | seconds | frames/s (3 views) |\n|---:|---:|---:|")
    for frames in (1_000, 10_000, 100_000):
        spent = seconds(partial(clip_by_clip, random_tracks(frames).to(arguments.device), length), at_least=0.5)
        print(f"| {frames:,} | {spent:.3f} | {frames / spent:,.0f} |")


if __name__ == "__main__":
    main()
