"""The described robot that has these arms: by the dataset's name for it, by joint names, counts and limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from worldline_core.discovery.columns import ArmColumns, plain, words_of
from worldline_core.discovery.findings import named
from worldline_core.geometry.embodiment import Arm, Embodiment, embodiment_files, load_embodiment

LEROBOT_ARMS = ("so100", "so101", "so", "koch", "omx", "lekiwi")
"""Arms of LeRobot's own motors, which it records in degrees or as -100..100; grippers are 0 closed .. 100 open."""
_MOTORS = {("shoulder", "pan"), ("shoulder", "lift"), ("elbow", "flex"), ("wrist", "flex"), ("wrist", "roll")}
_SAME = {
    "agilex": "piper_pair", "cobotmagic": "piper_pair", "so100": "so101", "so": "so101", "panda": "franka_panda", "franka": "franka_panda", "fr3": "franka_panda",
}  # fmt: skip
"""Name in a dataset -> the description that stands for it where there is none of that name itself."""
STRANGERS = ("koch", "omx")
"""Arms with the joint names of an SO-101 and other links: only a description of that name will do. LeRobot records them in -100..100
by default, the others in degrees (its 0.6)."""
TOLERANCE_RAD = 0.2


@dataclass(frozen=True)
class Match:
    """A described robot, and how it fits; `signs` by arm where joints have to be turned for that."""

    name: str
    evidence: str
    signs: dict[str, tuple[int, ...]]
    fits: bool


def is_lerobot_arm(robot_type: str, arms: Sequence[ArmColumns]) -> bool:
    """True for an arm of LeRobot's own motors, by its type or its joints."""
    said = "".join(words_of(robot_type))
    return any(arm in said for arm in LEROBOT_ARMS if arm != "so") or any(
        set(arm.joint_words) >= _MOTORS for arm in arms
    )


def match_robot(
    robot_type: str, arms: Sequence[ArmColumns], angles: Sequence[np.ndarray]
) -> tuple[Match | None, list[str], str]:
    """The described robot, other names that fit as well as nothing decides between them, and a sentence.

    Args:
        angles: (N, J) joints of each arm in radians; without a column's sign where that is turned.
    """
    fitting: list[tuple[float, Match]] = []
    considered = 0
    stranger = any(name in "".join(words_of(robot_type)) for name in STRANGERS)
    for name, path in sorted(embodiment_files().items()):
        robot = load_embodiment(path)
        if [len(arm.joints) for arm in robot.arms] != [len(arm.joints) for arm in arms]:
            continue
        considered += 1
        named_alike = _called(robot_type, name)
        if stranger and not named_alike:
            continue
        words_alike = _joint_names_agree(arms, robot.arms)
        fits, signs = _within_limits(robot.arms, arms, angles)
        if (not fits and not named_alike) or (signs and not named_alike and not words_alike):
            continue
        score = (
            1.0 * (name.replace("_", "") == "".join(words_of(robot_type)))
            + 4.0 * named_alike
            + 2.0 * words_alike
            - 1.0 * bool(signs)
            - 3.0 * (not fits)
        )
        reasons = [f"{'+'.join(str(len(a.joints)) for a in arms)} joints"]
        reasons += [f"the dataset calls the robot {named([robot_type])}"] if named_alike else []
        reasons += ["the joint names agree"] if words_alike else []
        reasons += [
            "all joints within its limits"
            if fits and not signs
            else "joints beyond its limits, look at units and zeros"
            if not fits
            else "within its limits with joints of the other sign"
        ]
        fitting.append((score, Match(name, "; ".join(reasons), signs, fits)))
    if not fitting and stranger:
        return None, [], f"there is no description of a {named([robot_type])}"
    if not fitting:
        count = "+".join(str(len(arm.joints)) for arm in arms)
        return (
            None,
            [],
            f"none of {considered} described robots with {count} joints has limits that hold these readings",
        )
    fitting.sort(key=lambda found: (-found[0], _variant(found[1].name), found[1].name))
    score, best = fitting[0]
    ties = [match.name for other, match in fitting[1:] if other == score and not _is_variant(best.name, match.name)]
    if score <= 0 or (ties and score < 2):
        names = named([match.name for _, match in fitting])
        return None, [best.name, *ties], f"{len(fitting)} described robots have such joints and limits: {names}"
    also = f"; {named(ties)} would fit as well" if ties else ""
    return replace(best, evidence=best.evidence + also), ties, ""


_COLOURS = {"ivory", "graphite", "pearl", "silver", "slate", "bronze", "white"}


def _variant(name: str) -> int:
    """0 for a robot, 1 for one of the shipped recordings' coloured or rearranged ones."""
    return int(bool(set(name.split("_")) & (_COLOURS | {"viperx"})))


def _is_variant(name: str, other: str) -> bool:
    """True if the other is the same robot in another colour or with another name of its arm (xarm7, xarm7_single)."""
    strip = _COLOURS | {"pair", "single", "viperx", "aloha"}
    return [w for w in name.split("_") if w not in strip] == [w for w in other.split("_") if w not in strip]


def _called(robot_type: str, name: str) -> bool:
    said, wanted = "".join(words_of(robot_type)), name.replace("_", "")
    if not said:
        return False
    names = {wanted, *(each.replace("_", "") for each in (name.rsplit("_", 1)[0],) if "_" in name and len(each) > 3)}
    if any(each in said or (len(said) > 3 and each.startswith(said)) for each in names):
        return True
    return any(
        short in words_of(robot_type) or short in said
        for short, described in _SAME.items()
        if described == name and short != "so"
    ) or (name == "so101" and words_of(robot_type)[:1] == ("so",))


def _joint_names_agree(arms: Sequence[ArmColumns], described: Sequence[Arm]) -> bool:
    """True if the joints of every arm have the same words; those that are only numbered say nothing."""
    for arm, robot in zip(arms, described, strict=True):
        theirs = [plain(words_of(joint)) for joint in robot.joints]
        if sorted(arm.joint_words) != sorted(theirs) or not any(not w.isdigit() for words in theirs for w in words):
            return False
    return True


def joint_order(arm: ArmColumns, robot: Embodiment, number: int) -> list[int]:
    """Places of the robot's joints among the arm's columns: by name where all agree, otherwise as they come."""
    theirs = [plain(words_of(joint)) for joint in robot.arms[number].joints]
    own = arm.joint_words
    return (
        [own.index(joint) for joint in theirs]
        if sorted(own) == sorted(theirs) and len(set(own)) == len(own)
        else list(range(len(own)))
    )


def _within_limits(
    described: Sequence[Arm], arms: Sequence[ArmColumns], angles: Sequence[np.ndarray]
) -> tuple[bool, dict[str, tuple[int, ...]]]:
    """True if the joints are within the limits; and signs by arm where some have to be inverted for that."""
    signs: dict[str, tuple[int, ...]] = {}
    for robot, arm, values in zip(described, arms, angles, strict=True):
        low, high = np.array(robot.limits).T
        outside, turned = (
            ((each < low - TOLERANCE_RAD) | (each > high + TOLERANCE_RAD)).mean(axis=0) for each in (values, -values)
        )
        flip = (outside > 0.5) & (turned < 0.01)
        if ((outside > 0.01) & ~flip).any():
            return False, {}
        if flip.any():
            signs[arm.side] = tuple(-1 if turn else 1 for turn in flip)
    return True, signs
