"""What an episode must have for a convention to say anything about it."""

from __future__ import annotations

from collections.abc import Iterable

from worldline_core.data.episodes.episode import Episode
from worldline_core.data.guards.rejection import RejectedInputError

_NEEDS = {
    **dict.fromkeys(("extrinsics", "camera_axes", "extrinsics_unit", "intrinsics_size"), "a calibrated camera"),
    "camera_lag_frames": "a calibrated camera that moves",
    **dict.fromkeys(("pose_unit", "quaternion", "euler", "tool_offset_z_m"), "recorded tool poses"),
    "angle_unit": "joint positions in the state",
    "arms": "two arms with equal state blocks, each ending with its gripper",
    "image_lag_frames": "anything",
    "gripper": "state columns whose names end with gripper",
}


def arm_blocks(episode: Episode) -> tuple[tuple[int, ...], ...]:
    """State columns of each arm: a block ends with its gripper. Empty where the state is not named like that."""
    names = episode.state_names or ()
    ends = [i + 1 for i, name in enumerate(names) if name.endswith("gripper")]
    if not ends or ends[-1] != len(names):
        return ()
    return tuple(tuple(range(start, end)) for start, end in zip([0, *ends[:-1]], ends, strict=True))


def check_applicable(episode: Episode, fields: Iterable[str]) -> None:
    """Raises: RejectedInputError (convention_not_applicable) for the first field that says nothing about the episode."""
    for field in fields:
        if not applicable(episode, field):
            raise RejectedInputError(
                "convention_not_applicable",
                "The episode has nothing that a declared convention speaks of",
                where=f"episode {episode.episode_id}, conventions.{field}",
                expected=_NEEDS[field],
                got=f"state {episode.state_kind}, {len(episode.cameras)} cameras, "
                + ("tool poses" if episode.T_base_ee is not None else "no tool poses"),
                next_step="remove the line, or give these episodes a source of their own",
                evidence={"field": field},
            )


def applicable(episode: Episode, field: str) -> bool:
    """Whether the episode has what a field of `RecordedConventions` speaks of."""
    need = _NEEDS[field]
    if need == "a calibrated camera":
        return bool(episode.cameras)
    if need == "a calibrated camera that moves":
        return any(camera.moving for camera in episode.cameras.values())
    if need == "recorded tool poses":
        return episode.T_base_ee is not None
    if field == "angle_unit":
        return episode.state_kind == "joints"
    blocks = arm_blocks(episode)
    if field == "arms":
        equal = len(blocks) == 2 and len(blocks[0]) == len(blocks[1])
        return equal and (episode.T_base_ee is None or episode.T_base_ee.shape[1] == 2)
    return field == "image_lag_frames" or bool(blocks)
