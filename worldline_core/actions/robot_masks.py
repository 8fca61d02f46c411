"""Kinematic robot masks for the robot-focused losses (paper, Stage III).

Robot parts (links, gripper branches, end-effectors) are capsules between the origins of consecutive links, from
forward kinematics. A capsule is drawn into a view as the hull of the discs that its two end spheres project to. The
mask of a latent frame is the union over its RGB frames and a few neighbours, dilated on the latent grid.

Axis legend: b clips, n RGB frames, t latent frames, v views, s capsules, h and w rows and columns.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from einops import rearrange
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.errors import ConfigError
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.tensor_transforms import invert, transform_points

NEAR_PLANE_M = 0.02
TOUCH_MARGIN_CELLS = 0.6
"""Between a cell's half width and its half diagonal: a centre this near to a capsule means that the cell is touched."""
DILATION_ROWS = 30
TOOL_LENGTH_M, TOOL_RADIUS_M = 0.15, 0.05


def robot_capsules(
    kinematics: ArmKinematics, links: Mapping[str, Float[Tensor, "n 4 4"]]
) -> tuple[Float[Tensor, "n s 2 3"], Float[Tensor, " s"]]:
    """Capsules of all arms in the base frame, and their radii [m], from what `link_poses` gave.

    For each arm: consecutive links from the arm's own base to the end-effector (link radius), the hand from the
    end-effector to the roots of the gripper branches (hand radius), and these branches out to the tool's depth
    (gripper radius).
    """
    tools = kinematics.tools_of(links)
    parents = kinematics.link_parents
    roots = {kinematics.embodiment.base_link, *(name for name in kinematics.links if name not in parents)}
    # Pairs of points, gathered in one copy at the end: a stack for each capsule costs more than the kinematics.
    ends: list[Tensor] = []
    radii: list[float] = []
    for index, arm in enumerate(kinematics.embodiment.arms):
        link = arm.end_effector_link
        while link in parents and parents[link] not in roots:
            ends += [links[parents[link]][:, :3, 3], links[link][:, :3, 3]]
            radii.append(arm.link_radius)
            link = parents[link]
        hand, tool = links[arm.end_effector_link][:, :3, 3], tools[:, index, :3, 3]
        tool_z = tools[:, index, :3, 2]
        hand_radius = arm.hand_radius or arm.gripper_radius
        branches = _below(arm.end_effector_link, parents)
        tips = [name for name in branches if name not in parents.values()]
        if len(tips) < 2:
            # Between two fingers there is air, or the object; a hand without them is drawn up to the tool.
            ends += [hand, tool]
            radii.append(hand_radius)
        for name in branches:
            origin = links[name][:, :3, 3]
            ends += [links[parents[name]][:, :3, 3], origin]
            radii.append(hand_radius)
            if name in tips:
                # A finger's link lies at its root: its tip is as far along the tool's axis as the tool centre.
                reach = ((tool - origin) * tool_z).sum(-1, keepdim=True)
                ends += [origin, origin + reach * tool_z]
                radii.append(arm.gripper_radius)
    capsules = rearrange(torch.stack(ends, dim=1), "n (s ends) xyz -> n s ends xyz", ends=2)
    return capsules, torch.tensor(radii, dtype=torch.float64)


def _below(link: str, parents: dict[str, str]) -> list[str]:
    """Links under a link, nearest first."""
    below: list[str] = []
    front = {link}
    while front:
        front = {name for name, parent in parents.items() if parent in front}
        below += sorted(front)
    return below


def tool_capsules(T_base_tool: Float[Tensor, "n a 4 4"]) -> tuple[Float[Tensor, "n s 2 3"], Float[Tensor, " s"]]:
    """One capsule per arm, from the tool back along its z axis: all that a source without joints tells."""
    tip = T_base_tool[..., :3, 3]
    back = tip - TOOL_LENGTH_M * T_base_tool[..., :3, 2]
    return torch.stack([back, tip], dim=-2), torch.full((T_base_tool.shape[1],), TOOL_RADIUS_M, dtype=torch.float64)


def project_capsules(
    capsules: Float[Tensor, "b n s 2 3"],
    radii: Float[Tensor, "b s"],
    K: Float[Tensor, "b v 3 3"],
    T_base_camera: Float[Tensor, "b n v 4 4"],
    image_size: tuple[int, int],
    grid_size: tuple[int, int],
    margin_cells: float = 0.0,
) -> Bool[Tensor, "b v n h w"]:
    """Mask of the grid cells whose centre is inside a capsule, or within a margin of it.

    Args:
        radii: [m]; radius 0 leaves a capsule out.
        K: pixels at image_size (height, width).
        margin_cells: widens every capsule, in cells of the grid.
    """
    T_camera_base = invert(T_base_camera)
    near, far = _in_front(
        *(transform_points(T_camera_base[:, :, :, None], capsules[:, :, None, :, end]) for end in (0, 1))
    )
    alive = (far[..., 2] >= NEAR_PLANE_M) & (radii[:, None, None] > 0)
    scale = torch.tensor([grid_size[1] / image_size[1], grid_size[0] / image_size[0]]).to(K)
    focal = torch.stack([K[..., 0, 0], K[..., 1, 1]], dim=-1)[:, None, :, None] * scale
    ends, sizes = [], []
    for point in (near, far):
        depth = point[..., 2].clamp_min(NEAR_PLANE_M)
        uv = torch.einsum("bvij,bnvsj->bnvsi", K[..., :2, :], point / depth[..., None])
        ends.append((uv + 0.5) * scale - 0.5)
        sizes.append(focal * (radii[:, None, None] / depth)[..., None] + margin_cells)
    # Distances are measured in units of the larger disc, whose half axes differ where pixels are not square.
    unit = torch.maximum(*sizes)
    (x0, y0), (x1, y1) = ((end / unit).unbind(-1) for end in ends)
    r0, r1 = (size[..., 0] / unit[..., 0] for size in sizes)
    columns = torch.arange(grid_size[1]).to(K) / unit[..., 0, None]
    rows = torch.arange(grid_size[0]).to(K) / unit[..., 1, None]
    covered = torch.zeros(*alive.shape[:3], *grid_size, dtype=torch.bool, device=K.device)
    for s in range(alive.shape[3]):
        x = columns[..., s, None, :] - x0[..., s, None, None]
        y = rows[..., s, :, None] - y0[..., s, None, None]
        along_x, along_y = (x1 - x0)[..., s, None, None], (y1 - y0)[..., s, None, None]
        length2 = (along_x**2 + along_y**2).clamp_min(1e-12)
        position = ((x * along_x + y * along_y) / length2).clamp(0, 1)
        radius = r0[..., s, None, None] + position * (r1 - r0)[..., s, None, None]
        inside = (x - position * along_x) ** 2 + (y - position * along_y) ** 2 <= radius**2
        covered |= inside & alive[..., s, None, None]
    return rearrange(covered, "b n v h w -> b v n h w")


def _in_front(start: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
    """The part of segments in front of the near plane, the nearer end first."""
    swap = (start[..., 2] > end[..., 2])[..., None]
    near, far = torch.where(swap, end, start), torch.where(swap, start, end)
    span = (far[..., 2] - near[..., 2]).clamp_min(1e-9)
    cut = ((NEAR_PLANE_M - near[..., 2]) / span).clamp(0, 1)
    return near + cut[..., None] * (far - near), far


def kinematic_robot_masks(
    capsules: Float[Tensor, "b n s 2 3"],
    radii: Float[Tensor, "b s"],
    K: Float[Tensor, "b v 3 3"],
    T_base_camera: Float[Tensor, "b n v 4 4"],
    image_size: tuple[int, int],
    grid_size: tuple[int, int],
    *,
    neighbour_frames: int = 1,
    dilation: int | None = None,
) -> Float[Tensor, "b v t h w"]:
    """Masks (0 or 1) at latent resolution, n = 1 + 4 (t - 1) RGB frames.

    A latent cell belongs to the robot when a capsule touches it in one of the latent frame's RGB frames (frame 0;
    4j-3 .. 4j), widened by `neighbour_frames` on both sides; the result is dilated by `dilation` cells. By
    default that is one cell in 30 rows (the paper's grid), so none on a grid so coarse that a cell is a hand wide.

    Raises: ConfigError when the number of frames does not fit.
    """
    num_frames = capsules.shape[1]
    if (num_frames - 1) % TEMPORAL_FACTOR:
        expected = f"1 + a multiple of {TEMPORAL_FACTOR}"
        raise ConfigError("Frames do not fit the tokenizer", expected=expected, got=num_frames)
    covered = project_capsules(
        capsules, radii, K, T_base_camera, image_size, grid_size, margin_cells=TOUCH_MARGIN_CELLS
    )
    clips = covered.shape[0]
    cells = rearrange(covered.to(K.dtype), "b v n h w -> (b v) n h w")
    dilation = round(grid_size[0] / DILATION_ROWS) if dilation is None else dilation
    if dilation:
        cells = functional.max_pool2d(cells, 2 * dilation + 1, stride=1, padding=dilation)
    frames = []
    for last in range(0, num_frames, TEMPORAL_FACTOR):
        first = max(0, last - TEMPORAL_FACTOR + 1 - neighbour_frames)
        frames.append(cells[:, first : last + 1 + neighbour_frames].amax(dim=1))
    return rearrange(torch.stack(frames, dim=1), "(b v) t h w -> b v t h w", b=clips)
