"""Forward kinematics: from `observation.state` (or `action`) to tool, link and wrist camera poses, in batches.

The chains are `pytorch_kinematics` chains in float64, built from the trees that `kinematic_tree` reads; all poses are
float64. Axis legend: n frames, a arms, j state columns, l links.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property, lru_cache
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
    first: Frame | None = None
    last: Frame | None = None
    for name, (T_offset, joint) in zip(names, steps, strict=True):
        frame = Frame(
            name, Link(name, Transform3d(matrix=torch.from_numpy(T_offset)[None], dtype=torch.float64)), joint, None
        )
        if last is not None:
            last.add_child(frame)
        first, last = first or frame, frame
    if first is None or last is None:
        raise DataError("A body without a frame", where=body.name)
    for child in body.children:
        last.add_child(_frame(child))
    return first
