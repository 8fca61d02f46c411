"""Accuracy of the calibration check (mistakes named, camera errors measured) and of estimated cameras.

    python -m benchmarks.calibration mistakes [--splits test,ood_test] [--every 1]
    python -m benchmarks.calibration cameras [--foreign FOLDER] [--sources 8] [--episodes 6] [--seed 0]
    python -m benchmarks.calibration bases --hidden FOLDER [--episodes 20]
    python -m benchmarks.calibration estimate [--hidden FOLDER] [--foreign FOLDER] [--episodes 20] [--spoil NAME]

Recordings with an injected defect (injected_defects.json) are left out.

- `mistakes`: every usual mistake, one at a time. Quaternion, Euler, pose unit and tool offset are injected into the same
  episodes rewritten as tool poses by forward kinematics.
- `cameras`: one view of a source at a time with one kind of error of a drawn size, in a direction drawn on the sphere; the
  robots are the shipped ones and those of `benchmarks.foreign_robots`. A row says how often it was found in single episodes
  and in the source, how often the bounds held (of every kind, those without an error included), and how often a line was
  wrong: a kind is named and it is another one, or a mistake is claimed. The first rows are false alarms.
- `estimate`: the cameras of sets of `benchmarks.hidden_cameras` and `benchmarks.foreign_robots`, taken away and estimated.
  `held`: how many of the 95 % intervals (rotation, translation, focal length, lag, place in the picture) hold the truth.
  With `--spoil` the sets are spoiled first, and nothing may be sure but what the spoiling leaves right.
- `bases`: the second arm's base of the sets with two arms, taken away and estimated from the head view.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.harness import RECORDINGS, command_line, print_table
from tools.corrupted.conventions import corrupt, corrupted_image_frames
from worldline_core.calibration.calibration_doctor import diagnose
from worldline_core.calibration.camera_errors import KINDS, LAG, PARAMETERS, SCALE, moved_camera
from worldline_core.calibration.diagnosis import Diagnosis, diagnose_source
from worldline_core.calibration.estimate.base_pose import place_second_arm, with_base
from worldline_core.calibration.estimate.estimate import estimate_views
from worldline_core.calibration.estimate.verdict import ViewEstimate
from worldline_core.calibration.evidence import MIN_IMAGE_PAIRS
from worldline_core.calibration.observation import small_gray
from worldline_core.data.episodes.conventions import RecordedConventions, applicable
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.geometry.cameras import inside_image, project_points
from worldline_core.geometry.embodiment import Embodiment, load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.transforms import quaternion_xyzw_from_rotation, rigid_inverse, rotation_angle_deg

LAGS = (-4, -3, -2, -1, 1, 2, 3, 4)
OFFSETS_M = (-0.1, -0.06, -0.03, 0.03, 0.06, 0.1, 0.15)
SCALES = (0.5, 0.67, 0.8, 1.25, 1.5, 2.0, 3.33)
CASES = {
    "healthy": (0.0,), "rotation": (2.0, 5.0, 10.0), "about the axis": (5.0, 10.0), "orbit": (10.0, 20.0),
    "translation": (30.0, 80.0, 150.0), "focal length": (5.0, 10.0, 15.0), "lag": (1.0, 2.0, 4.0),
}  # fmt: skip
"""Sizes in the units of KINDS; an orbit turns the camera about what it looks at, so it is a rotation and a translation."""
ORBIT_M = 0.9


@dataclass(frozen=True)
class Healthy:
    """A healthy episode with its small grey images, as joints and as tool poses."""

    joints: Episode
    poses: Episode
    gray: dict[str, np.ndarray]
    kinematics: ArmKinematics


def as_tool_poses(episode: Episode, kinematics: ArmKinematics) -> Episode:
    """The episode as recorded in tool poses: xyz, quaternion xyzw, gripper for each arm."""
    arms = kinematics.embodiment.arms
    blocks = []
    for values in (episode.state, episode.action):
        tools = kinematics.tool_poses(values.astype(np.float64)).numpy()
        opening = kinematics.gripper(values.astype(np.float64)).numpy()
        quaternion = quaternion_xyzw_from_rotation(tools[..., :3, :3])
        block = np.concatenate([tools[..., :3, 3], quaternion, opening[..., None]], axis=-1)
        blocks.append((tools, opening, block.reshape(len(values), -1).astype(np.float32)))
    names = tuple(f"{arm.name}/{n}" for arm in arms for n in ("x", "y", "z", "qx", "qy", "qz", "qw", "gripper"))
    return replace(
        episode,
        state=blocks[0][2],
        action=blocks[1][2],
        T_base_ee=blocks[0][0],
        gripper=blocks[0][1],
        state_names=names,
        state_kind="ee_pose",
    )


def healthy(root: Path, splits: set[str], every: int) -> Iterator[Healthy]:
    episodes = EpisodeSet.open(root)
    defects = json.loads((root / "injected_defects.json").read_text())
    chosen = [i for i, row in enumerate(episodes.rows) if row.split in splits and row.episode_id not in defects]
    kinematics: dict[str, ArmKinematics] = {}
    for i in chosen[::every]:
        episode = episodes.episode(i)
        if episode.embodiment not in kinematics:
            kinematics[episode.embodiment] = ArmKinematics(load_embodiment(episode.embodiment))
        robot = kinematics[episode.embodiment]
        gray = {view: small_gray(episodes.frames(i, view)) for view in episodes.rows[i].views}
        yield Healthy(episode, as_tool_poses(episode, robot), gray, robot)


def observable(name: str, episode: Healthy, diagnosis: Diagnosis) -> bool:
    """True if a recording holds anything that this mistake would make recognisably wrong."""
    if name == "image_lag_frames":
        return min(len(images) for images in episode.gray.values()) > MIN_IMAGE_PAIRS
    if name == "tool_offset_z_m":  # a wrist camera whose mount is stated
        return any(arm.wrist_camera is not None for arm in episode.kinematics.embodiment.arms)
    if name == "gripper":  # moves, before a camera or against an object
        return any(term.startswith(("fingers", "stopped")) for term in diagnosis.as_recorded.evidence)
    return True


def injected(episode: Healthy, choice: int) -> Iterator[tuple[str, Episode, RecordedConventions]]:
    """(name, episode to spoil, conventions); numbers vary with `choice`, the same for a whole source."""
    camera, scale = next(iter(episode.joints.cameras.values())), SCALES[choice % len(SCALES)]
    size = (round(camera.height * scale), round(camera.width * scale))
    cases = [
        ("none", episode.joints, RecordedConventions()),
        ("none (tool poses)", episode.poses, RecordedConventions()),
        ("extrinsics", episode.joints, RecordedConventions(extrinsics="base_to_camera")),
        ("camera_axes", episode.joints, RecordedConventions(camera_axes="opengl")),
        ("extrinsics_unit", episode.joints, RecordedConventions(extrinsics_unit="mm")),
        ("pose_unit", episode.poses, RecordedConventions(pose_unit="mm")),
        ("quaternion", episode.poses, RecordedConventions(quaternion="wxyz")),
        ("euler", episode.poses, RecordedConventions(euler="moving_xyz")),
        ("angle_unit", episode.joints, RecordedConventions(angle_unit="deg")),
        ("arms", episode.joints, RecordedConventions(arms="exchanged")),
        ("tool_offset_z_m", episode.poses, RecordedConventions(tool_offset_z_m=OFFSETS_M[choice % len(OFFSETS_M)])),
        ("intrinsics_size", episode.joints, RecordedConventions(intrinsics_size=size)),
        ("camera_lag_frames", episode.joints, RecordedConventions(camera_lag_frames=LAGS[choice % len(LAGS)])),
        ("image_lag_frames", episode.joints, RecordedConventions(image_lag_frames=LAGS[choice % len(LAGS)])),
        ("gripper", episode.joints, RecordedConventions(gripper="inverted")),
    ]
    for name, base, conventions in cases:
        if all(applicable(base, field) for field in conventions.departures):
            yield name, base, conventions


def examine(episode: Healthy, base: Episode, conventions: RecordedConventions, *, quick: bool = False) -> Diagnosis:
    """Diagnosis of a healthy episode, `base` as joints or tool poses, after these conventions have spoiled it."""
    gray = {
        view: values[corrupted_image_frames(base.num_frames, conventions, view)]
        for view, values in episode.gray.items()
    }
    return diagnose(corrupt(base, conventions), gray, episode.kinematics, quick=quick)


def named(diagnosis: Diagnosis) -> str:
    return diagnosis.best.mistake if diagnosis.verdict == "explained" else diagnosis.verdict


def right(name: str, conventions: RecordedConventions, found: str, value: RecordedConventions) -> bool:
    """True if the mistake is named, a lag to within a frame, and a healthy episode is called nothing."""
    if name.startswith("none"):
        return found in ("consistent", "too_little_evidence")
    if found != name:
        return False
    if name.endswith("lag_frames"):
        return abs(getattr(value, name) - getattr(conventions, name)) <= 1
    return True


def measure_mistakes(items: Iterator[Healthy]) -> None:
    confusion: dict[str, Counter[str]] = defaultdict(Counter)
    correct: dict[str, list[bool]] = defaultdict(list)
    unobservable: Counter[str] = Counter()
    start, count = time.process_time(), 0
    for number, episode in enumerate(items):
        for name, base, conventions in injected(episode, number):
            diagnosis, count = examine(episode, base, conventions), count + 1
            found = named(diagnosis)
            if not observable(name, episode, diagnosis):
                unobservable[f"{name}: {found}"] += 1
                continue
            confusion[name][found] += 1
            correct[name].append(right(name, conventions, found, diagnosis.best.conventions))
    rows = []
    for name, found in confusion.items():
        accepted = {name} if not name.startswith("none") else {"consistent", "too_little_evidence"}
        others = ", ".join(f"{k} {v}" for k, v in found.most_common() if k not in accepted)
        rows.append((name, found.total(), f"{100 * np.mean(correct[name]):.1f} %", others))
    print_table(("injected", "episodes", "right", "found instead"), rows)
    for case, times in unobservable.items():
        print(f"not observable in the recording, not counted: {case} ({times})")
    print(f"{count} diagnoses, {(time.process_time() - start) / max(count, 1) * 1e3:.0f} ms of CPU each")


# Errors of one camera


def sources(items: Iterator[Healthy], foreign: Path | None) -> dict[str, list[Healthy]]:
    """Healthy episodes by robot; those that are not ours by source."""
    found: dict[str, list[Healthy]] = defaultdict(list)
    for item in items:
        found[item.joints.embodiment].append(item)
    if foreign is not None:
        from benchmarks.foreign_robots import read_source  # imports mujoco

        for path in sorted(foreign.glob("*.json")):
            embodiment, episodes = read_source(path)
            robot = ArmKinematics(embodiment)
            found[f"{embodiment.name} {path.stem[-1]}"] = [Healthy(e, e, gray, robot) for e, gray in episodes]
    return dict(found)


def error_of(kind: str, size: float, random: np.random.Generator) -> np.ndarray:
    """(8,) parameters of an error in the units of KINDS."""
    theta, direction = np.zeros(PARAMETERS), random.normal(size=3)
    direction /= np.linalg.norm(direction)
    sign = float(random.choice([-1.0, 1.0]))
    if kind == "about the axis":
        theta[2] = sign * size
    elif kind == "orbit":
        across = np.append(direction[:2] / np.linalg.norm(direction[:2]), 0.0)
        turn, ahead = cv2.Rodrigues(across * np.radians(size))[0], np.array([0.0, 0.0, ORBIT_M])
        theta[:3], theta[3:6] = across * size, 1e3 * (ahead - turn @ ahead)
    elif kind in KINDS:
        part, _ = KINDS[kind]
        theta[part] = size * (direction if part.stop - part.start == 3 else sign)
    return theta


def spoiled(item: Healthy, view: str, theta: np.ndarray) -> tuple[Episode, dict[str, np.ndarray]]:
    """An episode whose camera is right once it is changed by theta, and its pictures; the pictures trail by its lag."""
    right, lag = item.joints.cameras[view], round(theta[LAG])
    change = moved_camera(replace(right, T_base_camera=np.eye(4)[None]), theta / SCALE)
    K = right.K.copy()
    K[[0, 1], [0, 1]] /= 1 + theta[LAG - 1] / SCALE[LAG - 1]
    wrong = replace(right, K=K, T_base_camera=right.T_base_camera @ np.linalg.inv(change.T_base_camera))
    gray, count = item.gray[view], len(item.gray[view])
    late = gray[np.clip(np.arange(count) - lag, 0, count - 1)]
    return replace(item.joints, cameras={**item.joints.cameras, view: wrong}), {**item.gray, view: late}


@dataclass
class Row:
    """Counts over the injected errors of one kind and size."""

    alone: list[bool] = field(default_factory=list)
    together: list[bool] = field(default_factory=list)
    held_alone: list[bool] = field(default_factory=list)
    held: list[bool] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    named: Counter[str] = field(default_factory=Counter)
    shown: list[float] = field(default_factory=list)

    def cells(self) -> tuple[str, ...]:
        def share(of: list[bool]) -> str:
            return f"{100 * np.mean(of):.0f} % of {len(of)}" if of else ""

        names = ", ".join(f"{name} {count}" for name, count in self.named.most_common(4))
        return (share(self.alone), share(self.held_alone), share(self.together), share(self.held), names,
                f"{len(self.wrong)} of {len(self.together)}")  # fmt: skip


def holds(diagnosis: Diagnosis, view: str, theta: np.ndarray) -> list[bool]:
    """For each kind, whether the error that was put in is within the interval of the estimate, and below the bound."""
    found = []
    for error in diagnosis.camera_errors:
        true = theta.copy() if error.view == view else np.zeros(PARAMETERS)
        true[LAG] -= diagnosis.best.conventions.image_lag(error.view)  # the estimate is beside this lag
        for each in error.kinds:
            if each.kind in KINDS:
                value = true[KINDS[each.kind][0]]
                inside = float(np.linalg.norm(each.estimate - value)) <= each.half_interval
                found.append(inside and float(np.linalg.norm(value)) <= each.bound)
    return found


def wrong_line(found: Diagnosis, kind: str, view: str, *, others: bool) -> str:
    """A line that names something else than what was put in; empty where none does."""
    true = {"about the axis": {"rotation"}, "orbit": {"rotation", "translation"}, "healthy": set()}.get(kind, {kind})
    if found.verdict == "explained":
        lag = found.best.conventions
        alone = (view,) if others else None
        right = kind == "lag" and found.best.departures == ("image_lag_frames",) and lag.views == alone
        return "" if right else found.best.text
    lines = [error for error in found.off if error.view != view or (error.named and not true & set(error.named))]
    return "; ".join(map(str, lines))


def measure_cameras(by_source: dict[str, list[Healthy]], draws: int, count: int, seed: int) -> None:
    by_robot: dict[str, Row] = defaultdict(Row)
    wrong: list[str] = []

    def rows() -> Iterator[tuple[str, ...]]:
        for kind, size in ((kind, size) for kind, sizes in CASES.items() for size in sizes):
            rows: dict[str, Row] = defaultdict(Row)
            for draw in range(draws * (3 if kind == "healthy" else 1)):
                random = np.random.default_rng([seed, draw, round(10 * size), *map(ord, kind)])
                name = str(random.choice(list(by_source)))
                items = by_source[name]
                views = ["head"] * 2 + [v for v in items[0].gray if v.endswith("wrist")]
                view = str(random.choice(views))
                theta = error_of(kind, size, random)
                chosen = random.choice(len(items), min(count, len(items)), replace=False)
                diagnoses = [diagnose(*spoiled(items[i], view, theta), items[i].kinematics, quick=True) for i in chosen]
                together = diagnose_source(name, diagnoses)
                for each in (rows["wrist" if view.endswith("wrist") else view], by_robot[name.split(" ")[0]]):
                    each.alone += [d.verdict not in ("consistent", "too_little_evidence") for d in diagnoses]
                    each.together.append(together.verdict not in ("consistent", "too_little_evidence"))
                    each.held_alone += [h for d in diagnoses for h in holds(d, view, theta)]
                    each.held += holds(together, view, theta)
                    others = len(items[0].gray) > 1
                    lines = [wrong_line(found, kind, view, others=others) for found in (together, *diagnoses)]
                    each.wrong += [f"{name}: {kind} {size} of {view}: {line}" for line in lines[:1] if line]
                    said = together.best.text if together.verdict == "explained" else together.verdict
                    each.named[" or ".join(together.off[0].named) if together.verdict == "off" else said] += 1
            wrong.extend(line for row in rows.values() for line in row.wrong)
            for view, row in sorted(rows.items()):
                yield f"{view}: {kind}" + (f" {size:g}" if size else ""), *row.cells()

    columns = ("found in one episode", "bounds hold", "found in a source", "bounds hold", "said of the source", "wrong")
    print_table(("error", *columns), rows())
    print_table(("robot, all of these", *columns), ((name, *row.cells()) for name, row in by_robot.items()))
    print("", *(f"wrong: {line}" for line in wrong), sep="\n")


# Estimated cameras

Recorded = list[tuple[Episode, dict[str, np.ndarray]]]


def _moved_half_way(episodes: Recorded) -> Recorded:
    """The pictures of the second half are those of a camera that was turned by 5 degrees: shifted by a tenth."""
    half, found = len(episodes) // 2, []
    for number, (episode, frames) in enumerate(episodes):
        later = {view: np.roll(shown, shown.shape[2] // 10, axis=2) for view, shown in frames.items()}
        found.append((episode, later if number >= half else frames))
    return found


def _with_states_of_others(episodes: Recorded) -> Recorded:
    states = [episode.state for episode, _ in episodes]
    shuffled = []
    for number, (episode, frames) in enumerate(episodes):
        other = states[(number + 1) % len(states)]
        count = min(len(other), episode.num_frames)
        cut = {view: shown[:count] for view, shown in frames.items()}
        shuffled.append(
            (replace(episode, state=other[:count], action=other[:count], timestamps=episode.timestamps[:count]), cut)
        )
    return shuffled


def _late(frames: int) -> Callable[[Recorded], Recorded]:
    def spoil(episodes: Recorded) -> Recorded:
        rows = [np.clip(np.arange(e.num_frames) - frames, 0, None) for e, _ in episodes]
        return [(replace(e, state=e.state[r], action=e.action[r]), f) for r, (e, f) in zip(rows, episodes, strict=True)]

    return spoil


def _still(episodes: Recorded) -> Recorded:
    return [
        (replace(e, state=np.repeat(e.state[:1], e.num_frames, axis=0)), {v: np.repeat(i[:1], len(i), axis=0) for v, i in f.items()})
        for e, f in episodes
    ]  # fmt: skip


ANOTHER_ROBOT = "another robot"
DECLARED_INSTEAD = {"ur5e": "viperx_graphite", "viperx": "ur5e_silver", "xarm7": "panda_ivory", "panda": "xarm7_white"}
"""Robots of two arms with as many joints."""
EXCHANGED = {"left_wrist": "right_wrist", "right_wrist": "left_wrist"}
SPOILED: dict[str, Callable[[Recorded], Recorded]] = {
    "nothing": lambda episodes: episodes,
    "moved half way": _moved_half_way,
    "mirrored": lambda es: [(e, {v: np.ascontiguousarray(i[:, :, ::-1]) for v, i in f.items()}) for e, f in es],
    "other states": _with_states_of_others,
    "states late by 3 frames": _late(3),
    "still": _still,
    "wrists exchanged": lambda es: [(e, {v: f.get(EXCHANGED.get(v, v), i) for v, i in f.items()}) for e, f in es],
    ANOTHER_ROBOT: lambda episodes: episodes,
    "wrist shown as head": lambda es: [(e, {"head": next(i for v, i in f.items() if v != "head")}) for e, f in es],
}


def hidden_sets(
    hidden: Path | None, foreign: Path | None, count: int, described: str | None = None
) -> Iterator[tuple[str, ArmKinematics, Recorded]]:
    for path in sorted(hidden.glob("*.json")) if hidden else ():
        from benchmarks.hidden_cameras import read_set  # imports mujoco

        episodes = read_set(path)[:count]
        yield path.stem, ArmKinematics(load_embodiment(episodes[0][0].embodiment)), episodes
    for path in sorted(foreign.glob("*.json")) if foreign else ():
        from benchmarks.foreign_robots import read_source

        embodiment, episodes = read_source(path)
        if described is not None:
            embodiment = load_embodiment(described)
            episodes = [(replace(episode, embodiment=described), frames) for episode, frames in episodes]
        yield path.stem, ArmKinematics(embodiment), episodes[:count]


def measure_estimates(sets: Iterator[tuple[str, ArmKinematics, Recorded]], spoil: str) -> None:
    held: Counter[str] = Counter()
    ratios: dict[str, list[float]] = defaultdict(list)

    def rows() -> Iterator[tuple[object, ...]]:
        for name, kinematics, episodes in sets:
            start = time.process_time()
            true = episodes[0][0]
            tools = np.concatenate([kinematics.tool_poses(e.state.astype(np.float64)).numpy() for e, _ in episodes])
            mounts = {arm.camera_view: number for number, arm in enumerate(kinematics.embodiment.arms)}
            if spoil == ANOTHER_ROBOT:
                kinematics = ArmKinematics(load_embodiment(DECLARED_INSTEAD[name.split("_")[0]]))
            for found in estimate_views(iter(SPOILED[spoil](episodes)), kinematics, len(episodes)):
                said = found.reasons[0] if found.reasons else "; ".join(found.notes)
                if found.camera is None or found.view not in true.cameras:
                    yield name, found.view, found.verdict, "", "", "", "", "", "", said
                    continue
                camera = true.cameras[found.view]
                arm = mounts.get(found.view) if found.wrist else None
                errors = estimate_errors(found, camera, tools, arm)
                for kind in found.intervals:
                    size = float(np.linalg.norm(errors[kind.kind]))
                    held[f"{kind.kind} {'wrist' if found.wrist else 'still'}"] += size <= kind.half_interval
                    ratios[f"{kind.kind} {'wrist' if found.wrist else 'still'}"].append(size / kind.half_interval)
                interval = [k.half_interval for k in found.intervals if k.kind == "in the picture"]
                columns = [float(np.linalg.norm(errors[k])) for k in ("rotation", "translation", "focal length", "lag")]
                yield (
                    name, found.view, found.verdict, f"{errors['tool']:.2f}", f"{interval[0]:.1f}" if interval else "",
                    *(f"{value:.1f}" for value in columns), f"{found.agreement:.2f} {said}",
                )  # fmt: skip
            print(f"    {name}: {time.process_time() - start:.0f} s of CPU", flush=True)

    columns = (
        "set", "view", "verdict", "tool error, % of the width", "95 %", "deg", "mm", "% focal", "frames", "agreement, reason",
    )  # fmt: skip
    print_table(columns, rows())
    for kind, values in ratios.items():
        worst = f"{np.quantile(values, 0.95):.2f}"
        print(f"{kind}: {held[kind]} of {len(values)} intervals hold; 95 % of the errors are within {worst} intervals")


def measure_bases(sets: Iterator[tuple[str, ArmKinematics, Recorded]]) -> None:
    from benchmarks.hidden_cameras import with_unknown_base

    def rows() -> Iterator[tuple[object, ...]]:
        for name, kinematics, episodes in sets:
            with tempfile.TemporaryDirectory() as folder:
                robot = with_unknown_base(episodes[0][0].embodiment, Path(folder))
                yield name, *_base_errors(kinematics, robot, episodes)

    print_table(("set", "verdict", "deg", "95 %", "mm", "95 %", "second tool, % of the width", "reason"), rows())


def _base_errors(kinematics: ArmKinematics, robot: Embodiment, episodes: Recorded) -> tuple[str, ...]:
    heads = [(e, {"head": f["head"]}) for e, f in episodes]
    states = np.concatenate([e.state.astype(np.float64) for e, _ in episodes])
    found_robot, base = place_second_arm(iter(heads), robot, len(heads))
    placed = ArmKinematics(found_robot)
    (found,) = estimate_views(iter(heads), placed, len(heads))
    true, tools = (each.tool_poses(states).numpy()[:, 1] for each in (kinematics, placed))
    off = true[0] @ rigid_inverse(tools[0])
    there = np.array(base.placed.translation)
    deg, mm = rotation_angle_deg(off[:3, :3]), 1e3 * np.linalg.norm((off @ np.append(there, 1.0))[:3] - there)
    camera = episodes[0][0].cameras["head"]
    a, b = (
        project_points(t[:, :3, 3], c.K / c.width, c.T_base_camera)[0]
        for t, c in ((true, camera), (tools, found.camera or camera))
    )
    shown = (np.abs(a - 0.5) < 0.5).all(axis=1)
    apart = 100 * float(np.median(np.linalg.norm(a - b, axis=1)[shown]))
    reasons = "; ".join([*found.reasons, *([base.reason] if base.reason else [])])
    errors = (f"{deg:.1f}", f"{base.half_interval_deg:.1f}", f"{mm:.0f}", f"{base.half_interval_mm:.0f}")
    return with_base(found, base).verdict, *errors, f"{apart:.2f}", reasons


def estimate_errors(
    found: ViewEstimate, true: CameraTrack, tools: np.ndarray, arm: int | None
) -> dict[str, np.ndarray | float]:
    """Error by kind, in the units of the intervals, and of the projected tools: their median in % of the width."""
    camera = found.camera or true
    right = true.resized(camera.width, camera.height)
    if arm is not None:  # of a wrist camera, in the tool's frame
        right = replace(
            right, T_base_camera=(rigid_inverse(tools[: len(right.T_base_camera), arm]) @ right.T_base_camera)[:1]
        )
        points = np.zeros((1, 3))
    else:
        points = tools[:, :, :3, 3].reshape(-1, 3)
    change = np.linalg.inv(right.T_base_camera[0]) @ camera.T_base_camera[0]
    (a, ahead), (b, _) = (project_points(points, c.K, c.T_base_camera) for c in (right, camera))
    shown = inside_image(a, (right.height, right.width)) & (ahead > 0) if arm is None else ahead > 0
    apart = 100 / right.width * (b - a)[shown]
    return {
        "rotation": np.degrees(cv2.Rodrigues(change[:3, :3])[0][:, 0]),
        "translation": 1e3 * change[:3, 3],
        "focal length": np.array([100 * (camera.K[0, 0] / right.K[0, 0] - 1)]),
        "lag": np.array([found.lag_frames]),
        "in the picture": apart.mean(axis=0) if len(apart) else np.zeros(2),
        "tool": float(np.median(np.linalg.norm(apart, axis=1))) if len(apart) else float("nan"),
    }


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("what", choices=("mistakes", "cameras", "estimate", "bases"))
    parser.add_argument("--recordings", type=Path, default=RECORDINGS)
    parser.add_argument("--splits", default="test,ood_test")
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--foreign", type=Path, help="cameras: what benchmarks.foreign_robots wrote")
    parser.add_argument("--described", help="estimate: read the foreign robots by this shipped description (so101)")
    parser.add_argument("--hidden", type=Path, help="estimate: what benchmarks.hidden_cameras wrote")
    parser.add_argument(
        "--spoil", choices=list(SPOILED), default="nothing", help="estimate: what is done to the sets first"
    )
    parser.add_argument("--sources", type=int, default=8, help="cameras: sources for each kind and size of error")
    parser.add_argument("--episodes", type=int, default=6, help="cameras, estimate: episodes of a source")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.what == "estimate":
        measure_estimates(
            hidden_sets(arguments.hidden, arguments.foreign, arguments.episodes, arguments.described), arguments.spoil
        )
        return
    if arguments.what == "bases":
        measure_bases(
            each
            for each in hidden_sets(arguments.hidden, None, arguments.episodes)
            if len(each[1].embodiment.arms) == 2
        )
        return
    shipped = healthy(arguments.recordings, set(arguments.splits.split(",")), arguments.every)
    if arguments.what == "mistakes":
        measure_mistakes(shipped)
        return
    measure_cameras(sources(shipped, arguments.foreign), arguments.sources, arguments.episodes, arguments.seed)


if __name__ == "__main__":
    main()
