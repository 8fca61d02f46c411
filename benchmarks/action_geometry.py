"""Speed of forward kinematics, tool projection and action maps, each beside what one would write without the library.

    python benchmarks/action_geometry.py [--threads 1] [--device cpu] [--embodiment franka_panda] [--pair ur5e_pair]

All methods get the same input; the largest difference of their results is printed. The ratios carry over to other
machines, the figures do not.

- *Kinematics*: tool poses of one arm at one frame (float64), against 4 x 4 products frame by frame and `mj_kinematics`.
- *Projection* of two arms into three views after kinematics, against a NumPy loop over samples; then whole episodes with
  robot capsules.
- *Action maps*: 3 views, 2 arms, 33 latent frames on 30 x 40 cells, against two ways to draw them with OpenCV. *GE-Sim's
  way* draws a disc and three axes in colour, three channels in all, written anew from the description of that method;
  *nine channels drawn* are ours with the Gaussian as circles of falling intensity. Both are drawn at the size of the
  video and reduced to the grid, and again on the cells themselves, which is too coarse to be useful (a disc's radius is
  three cells) but the lower bound of what drawing can cost. The floor is filling the memory of the maps with zeros.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import cv2
import mujoco
import numpy as np
import torch

from benchmarks.harness import best_seconds, command_line, print_table
from worldline_core.actions.action_maps import latent_frame_indices, render_action_maps
from worldline_core.actions.action_tracks import compute_tracks
from worldline_core.actions.episode_tracks import TrackBatch
from worldline_core.actions.robot_masks import kinematic_robot_masks, robot_capsules
from worldline_core.actions.tool_projection import project_tools
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.geometry.embodiment import Embodiment, load_embodiment
from worldline_core.geometry.embodiment_report import random_states
from worldline_core.geometry.kinematic_tree import TreeBody
from worldline_core.geometry.kinematics import ArmKinematics

IMAGE, GRID, VIEWS, ARMS = (480, 640), (30, 40), 3, 2
K = np.array([[430.0, 0, 319.5], [0, 430.0, 239.5], [0, 0, 1]])
HEAD = np.array([[0.0, 0, -1, 2], [1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1]])
SIGMA_OF_WIDTH, DISC_OF_WIDTH = 10 / 512, 50 / 640
AXIS_COLOURS = (((0, 0, 255), (255, 255, 0), (0, 255, 255)), ((255, 0, 255), (255, 0, 0), (0, 255, 0)))
OPENING_COLOURS = np.stack([np.stack([255 - np.arange(256), np.full(256, 160), np.arange(256)], -1)] * ARMS)


# Kinematics


def frame_by_frame(kinematics: ArmKinematics) -> Callable[[np.ndarray], np.ndarray]:
    """4 x 4 products in NumPy along each arm, one frame after the other."""
    embodiment = kinematics.embodiment
    chains = {arm.name: path_to(kinematics.tree, arm.end_effector_link) for arm in embodiment.arms}
    base = np.eye(4)
    for body in path_to(kinematics.tree, embodiment.base_link):
        if body.joints:
            raise SystemExit("the base moves: choose another embodiment")
        base = base @ body.T_parent_body
    base = np.linalg.inv(base)

    def poses(states: np.ndarray) -> np.ndarray:
        result = np.zeros((len(states), len(embodiment.arms), 4, 4))
        for n, state in enumerate(states):
            for a, arm in enumerate(embodiment.arms):
                values = dict(zip(arm.joints, state[embodiment.joint_columns(arm)], strict=True)) | embodiment.posture
                T = base
                for body in chains[arm.name]:
                    T = T @ body.T_parent_body
                    for joint in body.joints:
                        T = T @ turn(joint.axis, values.get(joint.name, 0.0))
                result[n, a] = T @ arm.T_link_tool.matrix()
        return result

    return poses


def path_to(tree: TreeBody, name: str) -> list[TreeBody]:
    """Bodies from the root to a link."""
    if tree.name == name:
        return [tree]
    return next(([tree, *path] for child in tree.children if (path := path_to(child, name))), [])


def turn(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation about a unit axis through the origin."""
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    T = np.eye(4)
    T[:3, :3] += np.sin(angle) * skew + (1 - np.cos(angle)) * (skew @ skew)
    return T


def mujoco_poses(embodiment: Embodiment) -> Callable[[np.ndarray], np.ndarray]:
    """`mj_kinematics` for each frame; it computes every body of the description."""
    model = mujoco.MjModel.from_xml_path(str(embodiment.description_path))
    data = mujoco.MjData(model)
    address = [int(model.joint(j).qposadr[0]) for arm in embodiment.arms for j in arm.joints]
    columns = np.concatenate([np.r_[embodiment.joint_columns(arm)] for arm in embodiment.arms])
    links = [model.body(arm.end_effector_link).id for arm in embodiment.arms]
    base = model.body(embodiment.base_link).id
    tools = np.stack([arm.T_link_tool.matrix() for arm in embodiment.arms])

    def poses(states: np.ndarray) -> np.ndarray:
        flange = np.tile(np.eye(4), (len(states), len(links), 1, 1))
        root = np.tile(np.eye(4), (len(states), 1, 1, 1))
        for n, joints in enumerate(states[:, columns]):
            data.qpos[address] = joints
            mujoco.mj_kinematics(model, data)
            flange[n, :, :3, :3] = data.xmat[links].reshape(-1, 3, 3)
            flange[n, :, :3, 3] = data.xpos[links]
            root[n, 0, :3, :3], root[n, 0, :3, 3] = data.xmat[base].reshape(3, 3), data.xpos[base]
        return np.linalg.inv(root) @ flange @ tools

    return poses


def measure_kinematics(name: str) -> None:
    embodiment = load_embodiment(name)
    kinematics = ArmKinematics(embodiment)
    states = random_states(embodiment, 4096)
    few = states[:256]
    by_hand, by_mujoco = frame_by_frame(kinematics), mujoco_poses(embodiment)
    reference = kinematics.tool_poses(states).numpy()
    difference = max(np.abs(by_mujoco(states) - reference).max(), np.abs(by_hand(few) - reference[: len(few)]).max())
    print(f"\n{name}: largest difference {difference:.1e}")
    seconds = {
        "batched": best_seconds(lambda: kinematics.tool_poses(states)) / len(states),
        "the same, one frame a call": best_seconds(lambda: [kinematics.tool_poses(s[None]) for s in few]) / len(few),
        "4 x 4 products frame by frame": best_seconds(lambda: by_hand(few)) / len(few),
        "MuJoCo mj_kinematics frame by frame": best_seconds(lambda: by_mujoco(states)) / len(states),
    }
    rows = ((what, len(embodiment.arms) / each, each / seconds["batched"]) for what, each in seconds.items())
    print_table(("method", "tool poses/s", "batched is faster by"), rows)


# Projection


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
    """Projection in NumPy, sample by sample with 4 x 4 matrices."""
    samples = []
    for n in range(len(tools)):
        for v in range(cameras.shape[1]):
            T_camera_base = np.linalg.inv(cameras[n, v])
            for a in range(tools.shape[1]):
                T = T_camera_base @ tools[n, a]
                pixel = K @ T[:3, 3]
                samples.append([*(pixel[:2] / pixel[2]), T[2, 3], *T[:3, 0], *T[:3, 1], min(max(opening[n, a], 0), 1)])
    return samples


def measure_projection(name: str) -> None:
    kinematics = ArmKinematics(load_embodiment(name))
    rng = np.random.default_rng(0)
    # A random walk near the middle of the joints' ranges.
    action = 0.3 * np.sin(np.cumsum(rng.normal(0, 0.05, (1024, kinematics.embodiment.state_size)), axis=0))
    links = kinematics.link_poses(action)
    wrists = kinematics.wrist_cameras_of(links)
    cameras = torch.stack([torch.from_numpy(HEAD).expand(len(action), 4, 4), *wrists.values()], dim=1)
    tools, opening = kinematics.tools_of(links), kinematics.gripper(action)
    intrinsics = torch.from_numpy(K).expand(cameras.shape[1], 3, 3)
    views = cameras.shape[1]

    ours = best_seconds(lambda: project_tools(tools, opening, intrinsics, cameras, IMAGE)) / len(action)
    arrays = tools.numpy(), opening.numpy(), cameras.numpy()
    loop = best_seconds(lambda: projected_one_by_one(*arrays)) / len(action)
    episode = episode_of(kinematics, action)
    capsules, radii = robot_capsules(kinematics, {link: pose[:33] for link, pose in links.items()})
    batch = (capsules[None].float(), radii[None].float(), intrinsics[None].float(), cameras[None, :33].float())
    seconds = {
        f"projection after kinematics, {views} views, {tools.shape[1]} arms": ours,
        "the same in NumPy, one by one": loop,
        "compute_tracks: all of it": best_seconds(lambda: compute_tracks(episode, kinematics)) / len(action),
        "of which kinematics of every link": best_seconds(lambda: kinematics.link_poses(action)) / len(action),
        f"of which {len(radii)} capsules": best_seconds(lambda: robot_capsules(kinematics, links)) / len(action),
        "robot masks from tracks, 30 x 40, a view": best_seconds(lambda: kinematic_robot_masks(*batch, IMAGE, GRID))
        / (33 * views),
    }
    print(f"\n{name}: projection is faster than the loop by {loop / ours:.0f}")
    print_table(("", "us a frame", "frames/s"), ((what, 1e6 * each, 1 / each) for what, each in seconds.items()))


# Action maps


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
    """Pixels (t, v, a, 2) of the first clip on a canvas."""
    scale = np.array([canvas[1] / IMAGE[1], canvas[0] / IMAGE[0]])
    return (tracks.uv[0].numpy() + 0.5) * scale - 0.5


def drawn_as_gesim(tracks: TrackBatch, canvas: tuple[int, int]) -> torch.Tensor:
    """Discs and axes in colour, one picture a frame and view, reduced to the grid: (3, v, t, h, w)."""
    uv, opening, rot6d = on_canvas(tracks, canvas), tracks.gripper[0].numpy(), tracks.rot6d[0].numpy()
    radius, thickness = max(1, round(DISC_OF_WIDTH * canvas[1])), max(1, round(canvas[1] / 80))
    third = np.cross(rot6d[..., :3], rot6d[..., 3:])
    tips = uv[..., None, :] + 0.1 * canvas[1] * np.stack([rot6d[..., :2], rot6d[..., 3:5], third[..., :2]], axis=-2)
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
    uv = on_canvas(tracks, canvas)
    depth, rot6d, opening = (x[0].numpy() for x in (tracks.depth, tracks.rot6d, tracks.gripper))
    maps = np.zeros((VIEWS, 9, len(uv), *GRID), np.float32)
    sigma = SIGMA_OF_WIDTH * canvas[1]
    # One circle a pixel, but at least eight; positions in sixteenths of a pixel.
    radii = np.linspace(3 * sigma, 0, max(8, round(3 * sigma)), endpoint=False)
    levels = np.exp(-0.5 * (radii / sigma) ** 2).tolist()
    sixteenths = np.maximum(1, (radii * 16).round()).astype(int).tolist()
    for t, v, a in np.ndindex(len(uv), VIEWS, ARMS):
        heat = np.zeros(canvas, np.float32)
        centre = (uv[t, v, a] * 16).round().astype(int).tolist()
        for radius, level in zip(sixteenths, levels, strict=True):
            cv2.circle(heat, centre, radius, level, -1, shift=4)
        if canvas != GRID:
            heat = cv2.resize(heat, GRID[::-1], interpolation=cv2.INTER_AREA)
        values = np.array([1.0, depth[t, v, a], *rot6d[t, v, a], opening[t, v, a]], np.float32)
        maps[v, :, t] += values[:, None, None] * heat
    return torch.from_numpy(maps)


def measure_maps(device: str) -> None:
    length = len(latent_frame_indices(129))
    clip = random_tracks(length)
    there, maps = clip.to(device), length * VIEWS
    ours = best_seconds(lambda: render_action_maps(there, IMAGE, GRID)) / maps
    seconds = {("ours", 9): ours}
    for what, channels, draw, canvas in (
        ("GE-Sim's way at 480 x 640, reduced", 3, drawn_as_gesim, IMAGE),
        ("nine channels drawn at 480 x 640, reduced", 9, nine_channels_drawn, IMAGE),
        ("GE-Sim's way on the 30 x 40 cells", 3, drawn_as_gesim, GRID),
        ("nine channels drawn on the 30 x 40 cells", 9, nine_channels_drawn, GRID),
    ):
        seconds[what, channels] = best_seconds(partial(draw, clip, canvas)) / maps
    seconds["floor: filling the memory with zeros", 9] = (
        best_seconds(render_action_maps(there, IMAGE, GRID).zero_) / maps
    )
    rows = ((what, channels, 1e6 * each, each / ours) for (what, channels), each in seconds.items())
    print_table(("30 x 40 maps", "channels", "us a map", "ours is faster by"), rows)
    exact = render_action_maps(clip, IMAGE, GRID)[0]
    for canvas in (IMAGE, GRID):
        apart = (nine_channels_drawn(clip, canvas) - exact).abs().max()
        print(f"nine channels drawn at {canvas[0]} x {canvas[1]} differ from the equation by up to {float(apart):.3f}")


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu", help="of the action maps")
    parser.add_argument("--embodiment", default="franka_panda", help="of the kinematics")
    parser.add_argument("--pair", default="ur5e_pair", help="of the projection")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(arguments.threads)
    measure_kinematics(arguments.embodiment)
    measure_projection(arguments.pair)
    measure_maps(arguments.device)


if __name__ == "__main__":
    main()
