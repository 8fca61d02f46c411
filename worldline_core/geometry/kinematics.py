"""Forward kinematics, from `observation.state` (or `action`) to tool, link and wrist camera poses in batches, and inverse
kinematics, from poses of the tools to joint positions within their limits.

The chains are `pytorch_kinematics` chains in float64, built from the trees that `kinematic_tree` reads; all poses are
float64. Axis legend: n frames, a arms, j state columns, d joints of an arm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from worldline_core.errors import ConfigError, DataError, UnavailableError, WorldLineError
from worldline_core.geometry.embodiment import Embodiment, load_embodiment
from worldline_core.geometry.kinematic_tree import TreeBody, read_tree
from worldline_core.geometry.link_surfaces import COARSE, FINE, link_surfaces
from worldline_core.geometry.tensor_transforms import invert

if TYPE_CHECKING:  # imports a plotting library: seconds that most commands and processes need not wait
    from pytorch_kinematics.chain import Chain
    from pytorch_kinematics.frame import Frame, Joint


class ArmKinematics:
    """Kinematics of all arms of an embodiment.

    Attributes:
        tree, chain: of the description; links, joints: their names.
        revolute: names of the joints that turn (the others slide).

    Raises:
        UnavailableError: the kinematic description is not there.
        DataError: the kinematic description cannot be read.
        ConfigError: the embodiment names a joint or link that the description does not have.
    """

    def __init__(self, embodiment: Embodiment) -> None:
        self.embodiment = embodiment
        self.tree = read_tree(embodiment)
        self.chain: Chain = chain_from_tree(self.tree)
        self.links: tuple[str, ...] = tuple(self.chain.get_frame_names(exclude_fixed=False))
        self.joints: tuple[str, ...] = tuple(self.chain.get_joint_parameter_names())
        kinds = {joint.name: joint.kind for body in self.tree.walk() for joint in body.joints}
        self.revolute = {name for name, kind in kinds.items() if kind == "revolute"}
        self._check_names()

    def _check_names(self) -> None:
        embodiment = self.embodiment
        wanted_links = [embodiment.base_link]
        wanted_joints = list(embodiment.posture)
        for arm in embodiment.arms:
            wanted_links.append(arm.end_effector_link)
            wanted_links += [arm.wrist_camera.link] if arm.wrist_camera is not None else []
            wanted_joints += [*arm.joints, *(finger.name for finger in arm.gripper.finger_joints)]
        for what, wanted, known in (("link", wanted_links, self.links), ("joint", wanted_joints, self.joints)):
            unknown = sorted(set(wanted) - set(known))
            if unknown:
                raise ConfigError(
                    f"The kinematic description has no {what} of this name",
                    where=f"embodiment {embodiment.name}, {embodiment.description_path}",
                    expected=f"one of {', '.join(known)}",
                    got=", ".join(unknown),
                )

    def _joint_positions(self, state: np.ndarray | Tensor, posture: Mapping[str, np.ndarray | float] | None) -> Tensor:
        """Positions [rad or m] of the chain's joints (n, joints): state, posture, fingers; anything else at zero."""
        embodiment = self.embodiment
        values = torch.as_tensor(state, dtype=torch.float64)
        embodiment.check_state(values.detach().cpu().numpy(), "state")
        columns: dict[str, Tensor] = {
            name: torch.full_like(values[:, 0], value) for name, value in embodiment.posture.items()
        }
        for name, track in (posture or {}).items():
            if name not in self.joints:
                raise DataError(
                    "Unknown posture joint", where=embodiment.name, expected=", ".join(self.joints), got=name
                )
            columns[name] = torch.as_tensor(track, dtype=torch.float64).to(values.device).expand(len(values))
        opening = self.gripper(values)
        for index, arm in enumerate(embodiment.arms):
            start = embodiment.joint_columns(arm).start
            columns.update({name: values[:, start + i] for i, name in enumerate(arm.joints)})
            for finger in arm.gripper.finger_joints:
                columns[finger.name] = finger.closed + opening[:, index].clamp(0, 1) * (finger.open - finger.closed)
        zero = torch.zeros_like(values[:, 0])
        return torch.stack([columns.get(name, zero) for name in self.joints], dim=-1)

    def link_poses(
        self, state: np.ndarray | Tensor, posture: Mapping[str, np.ndarray | float] | None = None
    ) -> dict[str, Float[Tensor, "n 4 4"]]:
        """T_base_link of every link (body, site) by name, float64.

        Args:
            state: (n, j) observation.state or action.
            posture: positions [rad, m] of joints outside the state, (n,) or one number each; the
                embodiment's own posture where not given.

        Raises:
            DataError: the joint vector has a wrong length or is not finite.
        """
        positions = self._joint_positions(state, posture)
        T_root_link = self.chain.forward_kinematics_tensor(positions)
        root = self.tree
        at_root = self.embodiment.base_link == root.name and not root.joints
        if at_root and bool((root.T_parent_body == np.eye(4)).all()):
            return {name: T_root_link[self.chain.frame_to_idx[name]] for name in self.links}
        T_base_root = invert(T_root_link[self.chain.frame_to_idx[self.embodiment.base_link]])
        return {name: T_base_root @ T_root_link[self.chain.frame_to_idx[name]] for name in self.links}

    def tool_poses(
        self, state: np.ndarray | Tensor, posture: Mapping[str, np.ndarray | float] | None = None
    ) -> Float[Tensor, "n a 4 4"]:
        """T_base_tool: frame between the fingertips, +z out of the gripper."""
        return self.tools_of(self.link_poses(state, posture))

    def tools_of(self, links: Mapping[str, Tensor]) -> Float[Tensor, "n a 4 4"]:
        """T_base_tool from what `link_poses` gave."""
        pairs = [(links[arm.end_effector_link], arm.T_link_tool.matrix()) for arm in self.embodiment.arms]
        return torch.stack([link @ torch.from_numpy(offset).to(link) for link, offset in pairs], dim=1)

    def wrist_camera_poses(self, state: np.ndarray | Tensor) -> dict[str, Float[Tensor, "n 4 4"]]:
        """T_base_camera by view, for the arms whose camera mount is known: from controls, never from a recording."""
        return self.wrist_cameras_of(self.link_poses(state))

    def wrist_cameras_of(self, links: Mapping[str, Tensor]) -> dict[str, Float[Tensor, "n 4 4"]]:
        """T_base_camera by view from what `link_poses` gave."""
        return {
            arm.camera_view: links[mount.link]
            @ torch.tensor(mount.T_link_camera, dtype=torch.float64).to(links[mount.link])
            for arm in self.embodiment.arms
            if (mount := arm.wrist_camera) is not None
        }

    def gripper(self, state: np.ndarray | Tensor) -> Float[Tensor, "n a"]:
        """Gripper opening, 0 closed .. 1 open, not clipped."""
        values = torch.as_tensor(state, dtype=torch.float64)
        openings = []
        for arm in self.embodiment.arms:
            raw = values[:, self.embodiment.gripper_column(arm)]
            openings.append((raw - arm.gripper.closed) / (arm.gripper.open - arm.gripper.closed))
        return torch.stack(openings, dim=1)

    @cached_property
    def surfaces(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Points (p, 3) in the link's frame and radii (p,) [m] of the links whose shapes the description has."""
        return {name: of for name, of in link_surfaces(self.embodiment, COARSE).items() if name in self.links}

    @cached_property
    def fine_surfaces(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """`surfaces` in more and smaller points."""
        return {name: of for name, of in link_surfaces(self.embodiment, FINE).items() if name in self.links}

    @cached_property
    def link_parents(self) -> dict[str, str]:
        """Parent link of every link but the root."""
        parents: dict[str, str] = {}
        for name in self.links:
            path = [self.chain.idx_to_frame[int(i)] for i in self.chain.parents_indices[self.chain.frame_to_idx[name]]]
            if len(path) > 1:
                parents[name] = path[-2]
        return parents


class KinematicsByName:
    """Kinematics of each embodiment, built once; a failure is remembered, not repeated.

    Args:
        description_paths: by embodiment, a kinematic description that is the user's own file.
    """

    def __init__(self, description_paths: Mapping[str, str]) -> None:
        self._description_paths = description_paths
        self._built: dict[str, ArmKinematics | WorldLineError] = {}

    def get(self, name: str) -> ArmKinematics:
        """Kinematics of an embodiment.

        Raises: ConfigError, DataError or UnavailableError, as `load_embodiment` and `ArmKinematics`.
        """
        if name not in self._built:
            try:
                self._built[name] = ArmKinematics(load_embodiment(name, self._description_paths.get(name)))
            except (ConfigError, DataError, UnavailableError) as error:
                self._built[name] = error
        result = self._built[name]
        if isinstance(result, WorldLineError):
            raise result
        return result


@lru_cache(maxsize=64)
def chain_from_tree(tree: TreeBody) -> Chain:
    """A `pytorch_kinematics` chain whose frames are the bodies and sites of the tree, the same for the same tree.

    MuJoCo turns a body about each of its joints in order, at the joint's position: T_body J1 J2 ..., with
    J = Trans(p) R(axis, q) Trans(-p). A chain frame has one joint, so a body gets one frame per joint, and a last
    fixed one where a joint lies off the body's origin; the last frame has the body's name.
    """
    from pytorch_kinematics.chain import Chain

    return Chain(_frame(tree), dtype=torch.float64)


def _frame(body: TreeBody) -> Frame:
    from pytorch_kinematics.frame import Frame, Joint, Link
    from pytorch_kinematics.transforms import Transform3d

    steps: list[tuple[np.ndarray, Joint]] = []
    offset = body.T_parent_body
    for joint in body.joints:
        before, after = np.eye(4), np.eye(4)
        before[:3, 3], after[:3, 3] = joint.position, -joint.position
        steps.append(
            (offset @ before, Joint(joint.name, None, joint.kind, torch.from_numpy(joint.axis), torch.float64))
        )
        offset = after
    if not steps or np.any(offset[:3, 3] != 0.0):
        steps.append((offset, Joint(f"{body.name}_fixed", dtype=torch.float64)))
    names = [f"{body.name}#{i}" for i in range(len(steps) - 1)] + [body.name]
    frames = [
        Frame(name, Link(name, Transform3d(matrix=torch.from_numpy(T)[None], dtype=torch.float64)), joint, None)
        for name, (T, joint) in zip(names, steps, strict=True)
    ]
    for frame, following in pairwise(frames):
        frame.add_child(following)
    for child in body.children:
        frames[-1].add_child(_frame(child))
    return frames[0]


ROTATION_WEIGHT_M = 0.3
"""A rotation error of 1 rad counts as much as a position error of this many metres."""
LARGEST_STEP_M, LARGEST_TURN_RAD = 0.1, 0.5
"""Largest correction of one step: beyond it the linear model of the arm says little."""
POSITION_TOLERANCE_M, ROTATION_TOLERANCE_RAD = 1e-4, 1e-3
_DAMPING = 1e-5


@dataclass(frozen=True)
class Reached:
    """Result of the solver.

    Attributes:
        state: (j,) within the limits; gripper columns as they were given.
        position_error_m, rotation_error_rad: (a,) between the wanted tool poses and those of ``state``.
    """

    state: np.ndarray
    position_error_m: np.ndarray
    rotation_error_rad: np.ndarray


class InverseKinematics:
    """Solver for all arms of an embodiment at once.

    Damped least squares with a damping that falls with the error (Sugihara, "Solvability-unconcerned inverse kinematics
    by the Levenberg-Marquardt method", 2011): quadratic convergence near a reachable pose, and a steady nearest pose
    where it is out of reach. A joint that is at its limit and would pass it takes no part in a step, so that the others
    do its work.
    """

    def __init__(self, kinematics: ArmKinematics) -> None:
        self.kinematics = kinematics
        embodiment = kinematics.embodiment
        self._columns = [
            np.arange(*embodiment.joint_columns(arm).indices(embodiment.state_size)) for arm in embodiment.arms
        ]
        self._limits = [np.asarray(arm.limits, np.float64) for arm in embodiment.arms]
        # Where each joint turns: the link that it moves, and its axis there.
        found = {
            joint.name: (f"{body.name}#{i}" if i < len(body.joints) - 1 or joint.position.any() else body.name, joint)
            for body in kinematics.tree.walk()
            for i, joint in enumerate(body.joints)
        }
        self._joints = [[found[name] for name in arm.joints] for arm in embodiment.arms]

    def jacobians(self, state: Float[np.ndarray, " j"]) -> tuple[np.ndarray, list[Float[np.ndarray, "6 d"]]]:
        """Tool poses (a, 4, 4) and the Jacobians of a state, by arm: metres (first three rows) and radians of its tool in the
        base frame per rad or m of each of its joints."""
        links = {name: pose[0].numpy() for name, pose in self.kinematics.link_poses(state[None]).items()}
        jacobians, tools = [], []
        for arm, joints in zip(self.kinematics.embodiment.arms, self._joints, strict=True):
            tool = links[arm.end_effector_link] @ arm.T_link_tool.matrix()
            axes = np.stack([links[link][:3, :3] @ joint.axis for link, joint in joints])
            levers = tool[:3, 3] - np.stack([links[link][:3, 3] for link, _ in joints])
            turns = np.array([joint.kind == "revolute" for _, joint in joints])[:, None]
            columns = np.where(turns, np.cross(axes, levers), axes), np.where(turns, axes, 0.0)
            jacobians.append(np.ascontiguousarray(np.concatenate(columns, axis=1).T))
            tools.append(tool)
        return np.stack(tools), jacobians

    def solve(
        self, start: Float[np.ndarray, " j"], T_base_tool: Float[np.ndarray, "a 4 4"], *, iterations: int = 30
    ) -> Reached:
        """The state nearest to the wanted tool poses that is found from ``start``.

        Args:
            start: where the arms are; joints beyond their limits are first brought back to them.
            T_base_tool: wanted poses of the tools, arms in the embodiment's order.

        Raises:
            DataError: a shape does not fit, or a number is not finite.
        """
        wanted = np.asarray(T_base_tool, np.float64)
        arms = len(self._columns)
        if wanted.shape != (arms, 4, 4) or not np.isfinite(wanted).all():
            raise DataError(
                "Wanted tool poses do not fit the robot", where=self.kinematics.embodiment.name,
                expected=f"finite ({arms}, 4, 4)", got=wanted.shape,
            )  # fmt: skip
        state = np.array(start, np.float64)
        self.kinematics.embodiment.check_state(state[None], "start of inverse kinematics")
        for columns, limits in zip(self._columns, self._limits, strict=True):
            state[columns] = np.clip(state[columns], *limits.T)
        from scipy.spatial.transform import Rotation  # forward kinematics need not wait for it

        best = state.copy()
        least, errors = np.full(arms, np.inf), np.zeros((arms, 2))
        for _ in range(iterations + 1):
            tools, jacobians = self.jacobians(state)
            shift = wanted[:, :3, 3] - tools[:, :3, 3]
            turn = Rotation.from_matrix(wanted[:, :3, :3] @ tools[:, :3, :3].swapaxes(1, 2)).as_rotvec()
            size = np.stack([np.linalg.norm(shift, axis=1), np.linalg.norm(turn, axis=1)], axis=1)
            total = size[:, 0] ** 2 + (ROTATION_WEIGHT_M * size[:, 1]) ** 2
            for arm in np.flatnonzero(total < least):
                best[self._columns[arm]], least[arm], errors[arm] = state[self._columns[arm]], total[arm], size[arm]
            far = (errors > (POSITION_TOLERANCE_M, ROTATION_TOLERANCE_RAD)).any(axis=1)
            if not far.any():
                break
            for arm in np.flatnonzero(far):
                columns = self._columns[arm]
                # Both by one factor, so that a step goes down the error that is compared.
                part = min(1.0, *((LARGEST_STEP_M, LARGEST_TURN_RAD) / np.maximum(size[arm], 1e-12)))
                error = part * np.concatenate([shift[arm], ROTATION_WEIGHT_M * turn[arm]])
                weighted = jacobians[arm] * np.array([1.0] * 3 + [ROTATION_WEIGHT_M] * 3)[:, None]
                state[columns] = _step(state[columns], self._limits[arm], weighted, error)
        return Reached(best, errors[:, 0], errors[:, 1])


def _step(joints: np.ndarray, limits: np.ndarray, jacobian: np.ndarray, error: np.ndarray) -> np.ndarray:
    """One damped step; joints that would pass a limit go to it, and the others make up for what is missing."""
    free = np.ones(len(joints), bool)
    target = joints.copy()
    left = error
    for _ in range(len(joints)):
        part = jacobian[:, free]
        damping = (_DAMPING + 0.1 * float(error @ error)) * np.eye(6)
        move = part.T @ np.linalg.solve(part @ part.T + damping, left)
        reached = joints[free] + move
        clipped = np.clip(reached, *limits[free].T)
        passed = clipped != reached
        if not passed.any():
            target[free] = reached
            return target
        held = np.flatnonzero(free)[passed]
        target[held] = clipped[passed]
        free[held] = False
        left = error - jacobian[:, ~free] @ (target - joints)[~free]
        if not free.any():
            break
    return target
