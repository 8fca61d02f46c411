"""Speed of action maps against drawing them with OpenCV.

    python benchmarks/action_geometry.py [--device cpu]

Both sides get the same input and one thread; the largest difference of their results is printed. On a busy machine
the ratio varies by a factor of two. 3 views, 2 arms, 33 latent frames on 30 x 40 cells; OpenCV draws the Gaussian as circles of falling
intensity at the size of the video, and reduces them to the grid.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch

from benchmarks.harness import command_line, print_table, seconds_of
from worldline_core.actions.action_maps import render_action_maps
from worldline_core.actions.episode_tracks import TrackBatch

IMAGE, GRID, LENGTH, VIEWS, ARMS = (480, 640), (30, 40), 33, 3, 2
SIGMA_OF_WIDTH = 10 / 512


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


def drawn(tracks: TrackBatch) -> torch.Tensor:
    """Circles of falling intensity, outermost first, reduced to the grid, times the nine values: (v, 9, t, h, w)."""
    uv = tracks.uv[0].numpy()
    depth, rot6d, opening = (x[0].numpy() for x in (tracks.depth, tracks.rot6d, tracks.gripper))
    maps = np.zeros((VIEWS, 9, len(uv), *GRID), np.float32)
    sigma = SIGMA_OF_WIDTH * IMAGE[1]
    # One circle a pixel, but at least eight; positions in sixteenths of a pixel.
    radii = np.linspace(3 * sigma, 0, max(8, round(3 * sigma)), endpoint=False)
    levels = np.exp(-0.5 * (radii / sigma) ** 2).tolist()
    sixteenths = np.maximum(1, (radii * 16).round()).astype(int).tolist()
    for t, v, a in np.ndindex(len(uv), VIEWS, ARMS):
        heat = np.zeros(IMAGE, np.float32)
        centre = (uv[t, v, a] * 16).round().astype(int).tolist()
        for radius, level in zip(sixteenths, levels, strict=True):
            cv2.circle(heat, centre, radius, level, -1, shift=4)
        heat = cv2.resize(heat, GRID[::-1], interpolation=cv2.INTER_AREA)
        values = np.array([1.0, depth[t, v, a], *rot6d[t, v, a], opening[t, v, a]], np.float32)
        maps[v, :, t] += values[:, None, None] * heat
    return torch.from_numpy(maps)


def measure_maps(device: str) -> None:
    clip = random_tracks(LENGTH)
    there, maps = clip.to(device), LENGTH * VIEWS
    ours = seconds_of(lambda: render_action_maps(there, IMAGE, GRID)) / maps
    by_opencv = seconds_of(lambda: drawn(clip)) / maps
    rows = (("ours", 1e6 * ours, 1.0), ("circles of OpenCV at 480 x 640, reduced", 1e6 * by_opencv, by_opencv / ours))
    print_table(("30 x 40 maps", "us a map", "ours is faster by"), rows)
    apart = float((drawn(clip) - render_action_maps(clip, IMAGE, GRID)[0]).abs().max())
    print(f"the drawing differs from the equation by up to {apart:.3f}")


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--device", default="cpu")
    cv2.setNumThreads(1)
    measure_maps(parser.parse_args().device)


if __name__ == "__main__":
    main()
