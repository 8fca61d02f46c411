"""Speed of action rendering: maps against drawing frame by frame, forward kinematics, tracks, robot masks.

Run: `python benchmarks/action_maps.py [--threads 1] [--device cpu]`. All figures come from one run on one machine; the
ratio is what carries over. The frame-by-frame method draws each end-effector as OpenCV circles of falling intensity
at image resolution, as trajectory maps are usually drawn, resizes that to the latent grid, and fills the nine channels.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import cv2
import numpy as np
import torch

from worldline_core.actions.action_maps import latent_frame_indices, render_action_maps
from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.actions.episode_tracks import TrackBatch, project_tools
from worldline_core.actions.robot_masks import kinematic_robot_masks, robot_capsules
from worldline_core.data.episode import CameraTrack, Episode
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics

IMAGE, GRID, NUM_FRAMES, VIEWS, ARMS = (480, 640), (30, 40), 129, 3, 2
SIGMA_IMAGE_PX = 10 * IMAGE[1] / 512


def seconds(call: Callable[[], object], at_least: float = 1.0) -> float:
    """Best time of one call, over at least `at_least` seconds of calls."""
    call()
    best, spent = float("inf"), 0.0
    while spent < at_least:
        start = time.perf_counter()
        call()
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        best = min(best, time.perf_counter() - start)
        spent += time.perf_counter() - start
    return best


def tracks_of_a_clip() -> TrackBatch:
    generator = torch.Generator().manual_seed(0)
    shape = (1, len(latent_frame_indices(NUM_FRAMES)), VIEWS, ARMS)
    return TrackBatch(
        uv=torch.rand(*shape, 2, generator=generator) * torch.tensor([640.0, 480.0]),
        depth=torch.rand(*shape, generator=generator) + 0.3,
        rot6d=torch.rand(*shape, 6, generator=generator) * 2 - 1,
        gripper=torch.rand(*shape, generator=generator),
        valid=torch.ones(shape, dtype=torch.bool),
    )


def drawn_frame_by_frame(tracks: TrackBatch) -> np.ndarray:
    """Circles at image resolution, outermost first, resized to the grid: (v, 9, t, h, w)."""
    uv, depth, rot6d, gripper = (x[0].numpy() for x in (tracks.uv, tracks.depth, tracks.rot6d, tracks.gripper))
    num_frames, num_views, num_arms = depth.shape
    maps = np.zeros((num_views, 9, num_frames, *GRID), np.float32)
    radii = np.arange(int(3 * SIGMA_IMAGE_PX), 0, -1)
    for t in range(num_frames):
        for v in range(num_views):
            for a in range(num_arms):
                heat = np.zeros(IMAGE, np.float32)
                centre = (round(float(uv[t, v, a, 0])), round(float(uv[t, v, a, 1])))
                for radius in radii:
                    level = float(np.exp(-0.5 * (radius / SIGMA_IMAGE_PX) ** 2))
                    cv2.circle(heat, centre, int(radius), level, -1)
                small = cv2.resize(heat, GRID[::-1], interpolation=cv2.INTER_AREA)
                values = [1.0, depth[t, v, a], *rot6d[t, v, a], gripper[t, v, a]]
                for channel, value in enumerate(values):
                    maps[v, channel, t] += small * value
    return maps


def episode_of(kinematics: ArmKinematics, num_frames: int) -> Episode:
    rng = np.random.default_rng(0)
    action = np.cumsum(rng.normal(0, 0.005, (num_frames, kinematics.embodiment.state_size)), axis=0)
    K = np.array([[430.0, 0, 319.5], [0, 430.0, 239.5], [0, 0, 1]])
    head = np.array([[0.0, 0, -1, 2], [1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1]])
    cameras = {"head": CameraTrack("head", K, head[None], 640, 480)}
    for view, poses in kinematics.wrist_camera_poses(action).items():
        cameras[view] = CameraTrack(view, K, poses.numpy(), 640, 480)
    text = {"source": "benchmark", "scene": "s", "task_family": "lift", "instruction": "", "outcome": "unknown"}
    return Episode(
        episode_id="benchmark",
        embodiment=kinematics.embodiment.name,
        split="train",
        fps=30.0,
        state=action.astype(np.float32),
        action=action.astype(np.float32),
        timestamps=np.arange(num_frames) / 30,
        cameras=cameras,
        **text,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--embodiment", default="ur5e_pair")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(arguments.threads)

    clip = tracks_of_a_clip()
    on_device = clip.to(arguments.device)
    ours = seconds(lambda: render_action_maps(on_device, IMAGE, GRID))
    drawn = seconds(lambda: drawn_frame_by_frame(clip))
    frames = clip.depth.shape[1] * VIEWS
    kinematics = ArmKinematics(load_embodiment(arguments.embodiment))
    episode = episode_of(kinematics, 1024)
    state = episode.action.astype(np.float64)
    fk = seconds(lambda: kinematics.tool_poses(state))
    tracks = seconds(lambda: compute_tracks(episode, kinematics))
    tools, gripper = kinematics.tool_poses(state), kinematics.gripper(state)
    cameras = tools[:, :1].expand(-1, VIEWS, 4, 4).contiguous()
    K = torch.from_numpy(episode.cameras["head"].K).expand(VIEWS, 3, 3)
    projection = seconds(lambda: project_tools(tools, gripper, K, cameras, IMAGE))
    capsules, radii = robot_capsules(kinematics, kinematics.link_poses(state[:33]))
    masks = seconds(
        lambda: kinematic_robot_masks(
            capsules[None].float(), radii[None].float(), K[None].float(), cameras[None, :33].float(), IMAGE, GRID
        )
    )

    print(f"device {arguments.device}, {arguments.threads} thread(s), embodiment {arguments.embodiment}")
    rows = [
        ("action maps, 30x40, view-frames/s", frames / ours),
        ("drawn with OpenCV, view-frames/s", frames / drawn),
        ("ratio", drawn / ours),
        ("kinematics, joint vectors/s", len(state) / fk),
        ("kinematics, tool poses/s (all arms)", len(state) * len(kinematics.embodiment.arms) / fk),
        ("projection alone, samples/s", len(state) * VIEWS * len(kinematics.embodiment.arms) / projection),
        ("tracks with capsules, frames/s", len(state) / tracks),
        ("robot masks, 30x40, RGB view-frames/s", 33 * VIEWS / masks),
    ]
    print("| what | figure |\n|---|---:|")
    for what, figure in rows:
        print(f"| {what} | {figure:,.0f} |")


if __name__ == "__main__":
    main()
