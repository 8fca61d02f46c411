"""End-effectors seen by cameras: where each tool is in each view, and why a sample is masked.

Axis legend: n frames (any number of leading axes), v views, a arms; a sample is one frame, view and arm. Frames of
reference: base, tool (between the fingertips, +z out of the gripper), camera (OpenCV axes). Units: metres, pixels
(centre of the first pixel is 0), gripper opening 0 closed .. 1 open.

A sample that is not valid has exactly one cause, the first in this order that applies:

1. `invalid_calibration`: K is no pinhole matrix, T_base_camera is not rigid, or the control itself is unknown (a tool
   pose or an opening that is not finite);
2. `behind_camera`: depth <= MIN_DEPTH_M, so a depth of 0 and of exactly MIN_DEPTH_M too;
3. `outside_image`: not on a pixel, that is not -0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5.

The counts of the four causes add up to the number of samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from einops import rearrange
from jaxtyping import Bool, Float, Int
from torch import Tensor

from worldline_core.geometry.cameras import MIN_DEPTH_M, inside_image
from worldline_core.geometry.tensor_transforms import is_rigid, rot6d_from_rotation, valid_intrinsics

CAUSES = ("valid", "behind_camera", "outside_image", "invalid_calibration")
"""Names of the values of `Projection.cause`; 0 is valid."""
FRAMES_AT_ONCE = 2048
"""On a CPU, longer recordings are projected in pieces whose temporary arrays stay in the cache; the bits are the same."""
_VALID, _BEHIND, _OUTSIDE, _INVALID = range(len(CAUSES))


@dataclass(frozen=True)
class Projection:
    """End-effectors seen by cameras. Where `valid` is false, the values are finite: what is known of them, or 0."""

    uv: Float[Tensor, "*n v a 2"]
    depth: Float[Tensor, "*n v a"]
    rot6d: Float[Tensor, "*n v a 6"]
    gripper: Float[Tensor, "*n v a"]
    valid: Bool[Tensor, "*n v a"]
    cause: Int[Tensor, "*n v a"]


def project_tools(
    T_base_tool: Float[Tensor, "*n a 4 4"],
    gripper: Float[Tensor, "*n a"],
    K: Float[Tensor, "*#n v 3 3"],
    T_base_camera: Float[Tensor, "*#n v 4 4"],
    image_size: tuple[int, int],
) -> Projection:
    """Project every arm's tool into every view, in float64 (paper, "Cross-Embodiment Spatial Action Conditioning").

    uv is the pixel of the tool's origin, depth [m] its distance along the camera's axis, rot6d its orientation in the
    camera frame (first two columns), gripper the opening clipped to 0..1. Differentiable in every input; the gradient
    of a masked sample is finite.

    Args:
        T_base_tool: maps tool points to base [m].
        gripper: opening, not clipped.
        K: pixels at image_size.
        T_base_camera: maps camera points (OpenCV axes) to base [m].
        image_size: (height, width).
    """
    frames = T_base_tool.shape[0]
    if T_base_tool.ndim != 4 or frames <= FRAMES_AT_ONCE or T_base_tool.device.type != "cpu":
        return _project(T_base_tool, gripper, K, T_base_camera, image_size)
    parts = []
    for start in range(0, frames, FRAMES_AT_ONCE):
        piece = slice(start, start + FRAMES_AT_ONCE)
        # What is given once, for all frames, has no frame axis or one of length 1.
        cut_K, cut_cameras = (x[piece] if x.ndim == 4 and len(x) == frames else x for x in (K, T_base_camera))
        parts.append(_project(T_base_tool[piece], gripper[piece], cut_K, cut_cameras, image_size))
    return Projection(**{f.name: torch.cat([getattr(part, f.name) for part in parts]) for f in fields(Projection)})


def _project(
    T_base_tool: Tensor, gripper: Tensor, K: Tensor, T_base_camera: Tensor, image_size: tuple[int, int]
) -> Projection:
    tools, cameras, intrinsics = T_base_tool.double(), T_base_camera.double(), K.double()
    eye = torch.eye(4, dtype=torch.float64, device=tools.device)
    calibrated = valid_intrinsics(intrinsics) & is_rigid(cameras)
    posed = torch.isfinite(tools).flatten(-2).all(-1)
    # What is not known is replaced before any arithmetic, so that neither a value nor a gradient becomes NaN.
    tools = torch.where(posed[..., None, None], tools, eye)
    cameras = torch.where(calibrated[..., None, None], cameras, eye)
    intrinsics = torch.where(calibrated[..., None, None], intrinsics, eye[:3, :3])

    # One product per frame turns the x axis, the y axis and the origin of all tools into all cameras: rows are those of
    # R_camera_base of each view, columns those of each tool. The third axis and the last row are never needed.
    R_base_camera, origin = cameras[..., :3, :3], cameras[..., :3, 3]
    turns = rearrange(R_base_camera, "... v j i -> ... (v i) j")
    columns = rearrange(torch.cat([tools[..., :3, :2], tools[..., :3, 3:]], -1), "... a j c -> ... j (a c)")
    turned = rearrange(turns @ columns, "... (v i) (a c) -> ... v a c i", i=3, c=3)
    x, y, depth = (turned[..., 2, :] - (R_base_camera.mT @ origin[..., None]).mT).unbind(-1)

    in_front = depth > MIN_DEPTH_M
    divisor = torch.where(in_front, depth, 1.0)
    x, y = x / divisor, y / divisor
    (fx, skew, cx), (skew_y, fy, cy) = (row[..., None, :].unbind(-1) for row in intrinsics[..., :2, :].unbind(-2))
    uv = torch.stack([fx * x + skew * y + cx, skew_y * x + fy * y + cy], dim=-1)

    opening = gripper.double()
    located = calibrated[..., None] & posed[..., None, :]
    known = located & torch.isfinite(opening)[..., None, :]
    cause = torch.where(inside_image(uv, image_size), _VALID, _OUTSIDE)
    cause = torch.where(in_front, cause, _BEHIND)
    cause = torch.where(known, cause, _INVALID)
    return Projection(
        uv=torch.where((located & in_front)[..., None], uv, 0.0),
        depth=torch.where(located, depth, 0.0),
        rot6d=torch.where(located[..., None], rot6d_from_rotation(turned[..., :2, :].mT), 0.0),
        gripper=torch.nan_to_num(opening).clamp(0.0, 1.0)[..., None, :].expand(depth.shape),
        valid=cause == _VALID,
        cause=cause,
    )


def count_samples(
    cause: Int[Tensor, "n v a"], opening: Float[Tensor, "n a"], outside_joint_limits: int
) -> dict[str, int]:
    """Counts of one episode: valid + behind_camera + outside_image + invalid_calibration = samples.

    A sample is one frame, view and arm. `gripper_clipped` counts frames and arms, `outside_joint_limits` frames and joints.

    Args:
        cause: of the views that the episode has.
        opening: gripper opening before it is clipped.
    """
    by_cause = torch.bincount(cause.flatten(), minlength=len(CAUSES)).tolist()
    return {
        "episodes": 1,
        "samples": cause.numel(),
        **dict(zip(CAUSES, by_cause, strict=True)),
        "outside_joint_limits": outside_joint_limits,
        "gripper_clipped": int(((opening < 0) | (opening > 1)).sum()),
    }


def add_counts(parts: Sequence[dict[str, int]]) -> dict[str, int]:
    """Counts of several episodes together."""
    return {name: sum(part[name] for part in parts) for name in parts[0]}
