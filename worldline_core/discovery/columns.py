"""Columns of recorded vectors that are joints and gripper of each arm, by their names and by the usual layouts."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from worldline_core.discovery.findings import named

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


USUAL_ARMS: dict[int, tuple[int, ...]] = {6: (5,), 7: (6,), 8: (7,), 14: (6, 6), 16: (7, 7)}
"""Width of a state without names -> joints of each arm, each followed by its gripper."""


@dataclass(frozen=True)
class Column:
    """One column of a feature; `name` is empty where the dataset gives it none of its own."""

    feature: str
    index: int
    name: str
    words: tuple[str, ...]

    @property
    def label(self) -> str:
        return self.name or f"{self.feature}[{self.index}]"


@dataclass
class ArmColumns:
    """Columns of one arm."""

    side: Side
    joints: list[Column] = field(default_factory=list)
    gripper: Column | None = None
    fingers: list[Column] = field(default_factory=list)

    @property
    def joint_words(self) -> list[tuple[str, ...]]:
        return [plain(column.words) for column in self.joints]


def columns_of(feature: str, names: Sequence[str], width: int, prefix: str) -> list[Column]:
    """Columns of a vector. The end of the feature's name counts, where sides have features of their own."""
    own = words_of(feature.removeprefix(prefix))
    unique = len(names) == width and len(set(names)) == width
    return [
        Column(feature, i, names[i] if unique else "", (*own, *(words_of(names[i]) if unique else (str(i),))))
        for i in range(width)
    ]


def find_arms(columns: Sequence[Column], *, commanded: bool = False) -> tuple[list[ArmColumns], str]:
    """Arms, left before right, and the evidence; none where nothing looks like joints.

    Args:
        commanded: take the columns of a leader where there are both, otherwise those of the follower.
    """
    columns = _of_one_robot(columns, commanded=commanded)
    kept = [column for column in columns if part_of(column.words) != "other"]
    sided = any(side_of(column.words) for column in kept)
    if sided:
        kept = [column for column in kept if side_of(column.words) is not None]
    kept = [column for column in kept if not (sided and belongs_to_body(column.words))]
    if kept and not any(_says_something(column) for column in kept):
        return _by_width(kept)
    arms: dict[Side, ArmColumns] = {}
    for column in kept:
        arm = arms.setdefault(side_of(column.words) or "right", ArmColumns(side_of(column.words) or "right"))
        part = part_of(column.words)
        if part == "joint":
            arm.joints.append(column)
        elif part == "finger":
            arm.fingers.append(column)
        elif arm.gripper is None:
            arm.gripper = column
    found = [arms[side] for side in ("left", "right") if side in arms and arms[side].joints]
    if len(found) == 1:
        found[0].side = "right"  # a single arm is the right one
    left_out = [column.label for column in columns if column not in kept]
    said = "; ".join(
        f"{len(arm.joints)} joints"
        + (
            f" and the gripper {named([arm.gripper.label])}"
            if arm.gripper
            else f" and {len(arm.fingers)} fingers"
            if arm.fingers
            else ""
        )
        + (f" of the {arm.side} arm" if len(found) > 1 else "")
        for arm in found
    )
    return found, f"by their names: {said}" + (f"; left out: {named(left_out, 4)}" if left_out else "")


def _of_one_robot(columns: Sequence[Column], *, commanded: bool) -> list[Column]:
    """Without the leader's columns, or without the follower's, where a vector has those of both."""
    leading = [column for column in columns if set(column.words) & LEADERS]
    following = [column for column in columns if set(column.words) & FOLLOWERS]
    if not leading or not following:
        return list(columns)
    return [column for column in columns if column not in (following if commanded else leading)]


def _says_something(column: Column) -> bool:
    """False for names such as `motor_3`, `state_3` or 3."""
    return (
        part_of(column.words) != "joint"
        or "joint" in column.words
        or any(not word.isdigit() for word in plain(column.words))
    )


def _by_width(columns: Sequence[Column]) -> tuple[list[ArmColumns], str]:
    """The usual layout of a vector of this width, whose names say nothing."""
    width = len(columns)
    if width not in USUAL_ARMS:
        return [], f"{width} columns, whose names say nothing"
    joints = USUAL_ARMS[width]
    sides: tuple[Side, ...] = ("left", "right") if len(joints) == 2 else ("right",)
    arms, start = [], 0
    for side, count in zip(sides, joints, strict=True):
        block = columns[start : start + count + 1]
        arms.append(ArmColumns(side, list(block[:-1]), block[-1]))
        start += count + 1
    layout = " and ".join(f"{count} joints with a gripper behind them" for count in joints)
    return arms, f"{width} columns whose names say nothing: {layout} is usual"
