"""Names of columns and cameras as words: sides, grippers, joints, and what belongs to no arm."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Literal

Side = Literal["left", "right"]
Part = Literal["joint", "gripper", "finger", "other"]

_WORD = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
_SIDES: dict[str, Side] = {"left": "left", "l": "left", "right": "right", "r": "right"}
_GRIPPER = {"gripper", "grippers", "jaw", "claw", "carriage", "eoat"}
_FINGERS = {"pinky", "ring", "middle", "index", "thumb", "little"}
_ELSEWHERE = frozenset(
    """
    eef ee tcp pose cartesian x y z w rx ry rz qx qy qz qw euler quat quaternion rot rotation orientation orient
    xyz rpy vel velocity velocities speed effort efforts torque torques current acc acceleration imu base chassis
    wheel hip knee ankle leg foot remote mobile odom temperature theta stick button timestamp frame done reward
    success delta shadow
    """.split()  # noqa: SIM905
)
_ANGLES = ({"roll"}, {"pitch"}, {"yaw"})
"""Words that alone are of a pose; of a joint they say how it turns (wrist_roll)."""
_BODY = {"waist", "torso", "head", "neck", "spine", "body", "trunk"}
LEADERS, FOLLOWERS = {"leader", "master"}, {"follower", "puppet", "slave"}
_NOISE = frozenset(
    """
    k main pos position positions q qpos rad deg observation state states action actions motor motors hdas arm
    joint joints idx panda actuator scale open
    """.split()  # noqa: SIM905
)


def words_of(name: str) -> tuple[str, ...]:
    """Words of a name in any usual spelling: `kLeftShoulderPitch`, `left_shoulder_pan.pos`, `joint1`."""
    return tuple(word.lower() for word in _WORD.findall(name))


def side_of(words: Sequence[str]) -> Side | None:
    """The side that the words name."""
    return next((_SIDES[word] for word in words if word in _SIDES), None)


def part_of(words: Sequence[str]) -> Part:
    """Quantity that a column of these words measures; bodies count as joints until sides are known (`belongs_to_body`)."""
    found = set(words)
    if found & _FINGERS and found & {"hand", "finger", *_FINGERS - {"index", "ring", "middle"}}:
        return "finger"
    if found & _ELSEWHERE or set(plain(words)) in _ANGLES:
        return "other"
    if found & _GRIPPER or ("finger" in found) or ("hand" in found and "joint" not in found):
        return "gripper"
    return "joint"


def belongs_to_body(words: Sequence[str]) -> bool:
    """True for waist, torso and head where the words name no side."""
    return bool(set(words) & _BODY) and side_of(words) is None


def plain(words: Sequence[str]) -> tuple[str, ...]:
    """The words that tell joints of one arm apart: (shoulder, pan); of `right/joint1` only (1)."""
    kept = tuple(
        word for word in words if word not in _NOISE and word not in _SIDES and word not in LEADERS | FOLLOWERS
    )
    return tuple(str(int(word)) if word.isdigit() else word for word in kept)
