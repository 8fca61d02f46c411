"""Speed of action tracks: projection after forward kinematics, and what a whole episode costs, robot masks included.

Run: `python benchmarks/action_tracks.py [--threads 1] [--embodiment ur5e_pair]`. A frame is 3 views x 2 arms = 6 samples.
On one CPU thread the clock is the process's CPU time, so other programs disturb little.

The floor of the projection: a frame reads 2 + 3 poses of 128 bytes and 2 openings, and writes 6 samples of 89 bytes
(uv, depth, Rot6D and opening in float64, validity, cause): 1,190 bytes; a sample takes 9 products of 3 terms and 8
further operations, 59 floating-point operations, 354 a frame. Copying as many bytes is measured beside it.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
import torch

from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.actions.robot_masks import kinematic_robot_masks, robot_capsules
from worldline_core.actions.tool_projection import project_tools
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics

IMAGE, GRID = (480, 640), (30, 40)
K = np.array([[430.0, 0, 319.5], [0, 430.0, 239.5], [0, 0, 1]])
HEAD = np.array([[0.0, 0, -1, 2], [1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1]])
BYTES_A_FRAME = 5 * 128 + 2 * 8 + 6 * 89


def seconds(call: Callable[[], object], at_least: float = 1.0) -> float:
    """Best time of one call, over at least `at_least` seconds of calls."""
    clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
    call()
    best, spent = float("inf"), 0.0
    while spent < at_least:
        start = clock()
        call()
        best = min(best, clock() - start)
        spent += clock() - start
    return best


def controls_of(kinematics: ArmKinematics, num_frames: int) -> np.ndarray:
    """A random walk that stays near the middle of the joints' ranges: (n, j)."""
    rng = np.random.default_rng(0)
    return 0.3 * np.sin(np.cumsum(rng.normal(0, 0.05, (num_frames, kinematics.embodiment.state_size)), axis=0))


def episode_of(kinematics: ArmKinematics, action: np.ndarray) -> Episode:
    cameras = {"head": CameraTrack("head", K, HEAD[None], IMAGE[1], IMAGE[0])}
    for view, poses in kinematics.wrist_camera_poses(action).items():
        cameras[view] = CameraTrack(view, K, poses.numpy(), IMAGE[1], IMAGE[0])
    text = {"source": "benchmark", "scene": "s", "task_family": "lift", "instruction": "", "outcome": "unknown"}
    return Episode(
        episode_id="benchmark",
        embodiment=kinematics.embodiment.name,
        split="train",
        fps=30.0,
        state=action.astype(np.float32),
        action=action.astype(np.float32),
        timestamps=np.arange(len(action)) / 30,
        cameras=cameras,
        **text,
    )


def projected_one_by_one(tools: np.ndarray, opening: np.ndarray, cameras: np.ndarray) -> list[list[float]]:
    """The same in NumPy, sample by sample with 4 x 4 matrices, as projections are usually written."""
    samples = []
    for n in range(len(tools)):
        for v in range(cameras.shape[1]):
            T_camera_base = np.linalg.inv(cameras[n, v])
            for a in range(tools.shape[1]):
                T = T_camera_base @ tools[n, a]
                pixel = K @ T[:3, 3]
                samples.append([*(pixel[:2] / pixel[2]), T[2, 3], *T[:3, 0], *T[:3, 1], min(max(opening[n, a], 0), 1)])
    return samples


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--embodiment", default="ur5e_pair")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)

    kinematics = ArmKinematics(load_embodiment(arguments.embodiment))
    action = controls_of(kinematics, 1024)
    links = kinematics.link_poses(action)
    wrists = kinematics.wrist_cameras_of(links)
    cameras = torch.stack([torch.from_numpy(HEAD).expand(len(action), 4, 4), *wrists.values()], dim=1)
    tools, opening = kinematics.tools_of(links), kinematics.gripper(action)
    intrinsics = torch.from_numpy(K).expand(cameras.shape[1], 3, 3)
    views, arms = cameras.shape[1], tools.shape[1]

    print(f"{arguments.embodiment}: {views} views, {arms} arms, {arguments.threads} thread(s)")
    print("| projection after kinematics, frames | seconds | frames/s |\n|---:|---:|---:|")
    for frames in (1_000, 10_000, 100_000):
        index = torch.arange(frames) % len(action)
        inputs = tools[index], opening[index], intrinsics, cameras[index]
        spent = seconds(lambda inputs=inputs: project_tools(*inputs, IMAGE))
        print(f"| {frames:,} | {spent:.4f} | {frames / spent:,.0f} |")
    ours = seconds(lambda: project_tools(tools, opening, intrinsics, cameras, IMAGE)) / len(action)
    arrays = tools.numpy(), opening.numpy(), cameras.numpy()
    loop = seconds(lambda: projected_one_by_one(*arrays)) / len(action)
    memory = torch.zeros(2, len(action) * BYTES_A_FRAME // 2, dtype=torch.uint8)
    copied = seconds(lambda: memory[0].copy_(memory[1])) / len(action)
    print(f"one by one in NumPy: {1 / loop:,.0f} frames/s, ours is faster by {loop / ours:,.0f}")
    print(f"floor: copying {BYTES_A_FRAME:,} bytes a frame: {1 / copied:,.0f} frames/s")

    episode = episode_of(kinematics, action)
    capsules, radii = robot_capsules(kinematics, {name: pose[:33] for name, pose in links.items()})
    batch = (capsules[None].float(), radii[None].float(), intrinsics[None].float(), cameras[None, :33].float())
    whole = seconds(lambda: compute_tracks(episode, kinematics))
    kinematic = seconds(lambda: kinematics.link_poses(action))
    print(f"\n| an episode of {len(action)} frames | us a frame | frames/s |\n|---|---:|---:|")
    for what, spent, count in (
        ("compute_tracks: all of it", whole, len(action)),
        ("of which kinematics of every link", kinematic, len(action)),
        ("the rest: projection, capsules, counts, arrays", whole - kinematic, len(action)),
        ("of which projection", ours * len(action), len(action)),
        (f"of which {len(radii)} capsules", seconds(lambda: robot_capsules(kinematics, links)), len(action)),
        (
            "robot masks from tracks, 30 x 40, a view",
            seconds(lambda: kinematic_robot_masks(*batch, IMAGE, GRID)),
            33 * views,
        ),
    ):
        print(f"| {what} | {1e6 * spent / count:.2f} | {count / spent:,.0f} |")


if __name__ == "__main__":
    main()
