"""Arms of recorded vectors: their columns of joints and grippers, the units of these, and the described robot that has them.

They are recognised by names, counts, usual layouts, ranges, steps of the encoders, and the limits of the robots.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from worldline_core.data.sources.lerobot import AngleUnit
from worldline_core.discovery.findings import named
from worldline_core.geometry.embodiment import Arm, embodiment_files, load_embodiment

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

    def arrange(self, wanted: Sequence[tuple[str, ...]]) -> None:
        """Bring the joints into an order by their words; they stay as they come where the words differ or repeat."""
        own = self.joint_words
        if sorted(own) == sorted(wanted) and len(set(own)) == len(own):
            self.joints = [self.joints[own.index(words)] for words in wanted]


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
    said = []
    for arm in found:
        fingers = f" and {len(arm.fingers)} fingers" if arm.fingers else ""
        hand = f" and the gripper {named([arm.gripper.label])}" if arm.gripper else fingers
        said.append(f"{len(arm.joints)} joints{hand}" + (f" of the {arm.side} arm" if len(found) > 1 else ""))
    return found, f"by their names: {'; '.join(said)}" + (f"; left out: {named(left_out, 4)}" if left_out else "")


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


MOST_RADIANS = 6.5
"""A joint that turns once, and a little; larger readings are degrees or a share of the range."""
_TICK_DEG = 360 / 4095
"""Step of the motors of LeRobot's own arms: readings in degrees are multiples of it, those of a range are not."""
_ON_GRID, _OFF_GRID = 0.97, 0.6
RANGES: tuple[tuple[float, float], ...] = (
    (0, 1),
    (0, 100),
    (0, 0.04),
    (0, 0.08),
    (0, 0.044),
    (0, 850),
    (0, 1000),
    (0, 255),
    (-1, 1),
)
"""Usual readings of grippers: shares, per cent, metres of a finger or between both, steps of some makers."""


def joint_unit(
    values: np.ndarray, names: Sequence[Sequence[str]], usual: AngleUnit | None
) -> tuple[AngleUnit, str, bool]:
    """The unit of joint readings (N, J), the evidence, and whether another one would fit as well.

    Args:
        names: words of each column.
        usual: what LeRobot records by default of this arm, where it is one of its own: degrees, or -100..100 of each range.
    """
    words = {word for name in names for word in name}
    most = float(np.abs(values).max())
    if "rad" in words:
        return "rad", f"the names say rad; readings to {most:.3g}", False
    if "deg" in words:
        return "deg", f"the names say deg; readings to {most:.4g}", False
    if most <= MOST_RADIANS:
        return "rad", f"no reading is above {most:.3g}, which in degrees would hardly be a motion", False
    if usual is None:
        return "deg", f"readings to {most:.4g}: more than a turn of a joint in radians", False
    if most > 100.5:
        return "deg", f"readings to {most:.4g}: beyond -100..100, LeRobot's other unit", False
    share = _share_on_ticks(values)
    if share >= _ON_GRID:
        return "deg", f"{share:.0%} of the steps are whole ticks of 360/4095 degrees, as the motors count", False
    ends = int((np.abs(values) >= 99.9995).any(axis=0).sum())
    if ends and most <= 100.0005:
        return "range_m100_100", f"{ends} joints stop at exactly 100 or -100, where LeRobot cuts its ranges off", False
    if 0 < share < _OFF_GRID and _is_quantised(values):
        said = f"only {share:.0%} of the steps are ticks of a motor in degrees, and all readings are within -100..100"
        return "range_m100_100", said, False
    said = f"readings to {most:.4g}: deg and range_m100_100 both fit; LeRobot's default for this arm is taken"
    return usual, said, True


def _steps(values: np.ndarray) -> np.ndarray:
    """Differences between neighbouring readings that changed."""
    steps = np.abs(np.diff(values, axis=0)).ravel()
    return steps[steps > 1e-4]


def _share_on_ticks(values: np.ndarray) -> float:
    steps = _steps(values) / _TICK_DEG
    return float((np.abs(steps - steps.round()) < 0.02).mean()) if len(steps) >= 20 else 0.0


def _is_quantised(values: np.ndarray) -> bool:
    """True where most joints only have readings a whole number of steps apart, as encoders give them."""
    return sum(map(_has_steps, values.T)) > values.shape[1] / 2


def _has_steps(column: np.ndarray) -> bool:
    gaps = np.diff(np.unique(column))
    gaps = gaps[gaps > 1e-4]
    if len(gaps) < 10:
        return False
    multiples = gaps / gaps.min()
    return float((np.abs(multiples - multiples.round()) < 0.05).mean()) >= 0.9


@dataclass(frozen=True)
class GripperReadings:
    """Readings at the two ends; None where they cannot be known."""

    ends: tuple[float, float]
    evidence: str
    open_is_high: bool | None


def gripper_readings(
    state: np.ndarray, command: np.ndarray | None, words: Sequence[str], *, open_is_high: bool | None, why: str
) -> GripperReadings:
    """Ends of a gripper's readings, and which is open.

    Args:
        state: readings of several episodes; `command` of the same frames.
        open_is_high, why: what the robot's makers state, where they do.
    """
    low, high = float(state.min()), float(state.max())
    span = high - low
    known = next(
        ((a, b) for a, b in RANGES if a - 0.1 * (b - a) <= low and high <= b + 0.1 * (b - a) and span >= 0.3 * (b - a)),
        None,
    )
    if ("rad" in words and known is None) or known is None:
        known = (float(np.percentile(state, 1)), float(np.percentile(state, 99)))
        if known[0] == known[1]:
            known = (low, high) if low != high else (low, low + 1)
        ends = f"readings {low:.4g} to {high:.4g}, whose ends are taken"
    else:
        ends = f"readings {low:.4g} to {high:.4g}: {known[0]:g} to {known[1]:g}"
    if open_is_high is not None:
        return GripperReadings(known, f"{ends}; {why}", open_is_high)
    if "open" in words or "opening" in words or "width" in words:
        return GripperReadings(known, f"{ends}; the name says that it opens upwards", True)
    if "close" in words or "closed" in words or "closure" in words:
        return GripperReadings(known, f"{ends}; the name says that it closes upwards", False)
    if command is not None and span > 0 and (found := _squeeze(state, command, span)) is not None:
        closes_down, share = found
        side = "below" if closes_down else "above"
        said = f"{ends}; at rest the command stays {side} the reading in {share:.0%} of the frames: it squeezes"
        return GripperReadings(known, said, closes_down)
    return GripperReadings(known, ends, None)


def _squeeze(state: np.ndarray, command: np.ndarray, span: float) -> tuple[bool, float] | None:
    """True where grippers close towards low readings: a gripper that holds a thing cannot follow its command."""
    resting = np.abs(np.gradient(state)) < 0.01 * span
    gap = (command - state)[resting] / span
    far = gap[np.abs(gap) > 0.08]
    if len(far) < 10 or len(far) < 0.03 * len(gap):
        return None
    below = float((far < 0).mean())
    return (below > 0.5, max(below, 1 - below)) if max(below, 1 - below) > 0.9 else None


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
        within = "within its limits with joints of the other sign" if signs else "all joints within its limits"
        reasons.append(within if fits else "joints beyond its limits, look at units and zeros")
        fitting.append((score, Match(name, "; ".join(reasons), signs, fits)))
    if not fitting and stranger:
        return None, [], f"there is no description of a {named([robot_type])}"
    if not fitting:
        count = "+".join(str(len(arm.joints)) for arm in arms)
        said = f"none of {considered} described robots with {count} joints has limits that hold these readings"
        return None, [], said
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


def follow_robot(arms: Sequence[ArmColumns], name: str) -> None:
    """Give the arms the sides, and their joints the order, of a described robot."""
    for arm, described in zip(arms, load_embodiment(name).arms, strict=True):
        arm.arrange([plain(words_of(joint)) for joint in described.joints])
        arm.side = described.name  # type: ignore[assignment]


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
