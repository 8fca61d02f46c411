"""How often the calibration check names a mistake, and how large a camera error it sees: both injected into healthy recordings.

    python benchmarks/calibration.py mistakes [--splits test,ood_test] [--every 1]
    python benchmarks/calibration.py cameras [--every 2] [--seeds 0,1]

Recordings with an injected defect (injected_defects.json) are left out.

- `mistakes`: every usual mistake, one at a time. Quaternion, Euler, pose unit and tool offset are injected into the same
  episodes rewritten as tool poses by forward kinematics.
- `cameras`: one view at a time with an error of growing size, in a direction that the seed chooses, the same in all
  episodes of a seed. For single episodes and for sources of 20: errors found, the kind they were named by, and the
  error that could have gone unseen (median bound). The first rows are false alarms on healthy recordings.
"""

from __future__ import annotations

import json
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.harness import RECORDINGS, command_line, print_table
from tools.corrupted.conventions import corrupt, corrupted_image_frames
from worldline_core.calibration.calibration_doctor import diagnose
from worldline_core.calibration.camera_errors import (
    ERROR_KINDS,
    PARAMETERS,
    CameraError,
    combine,
    estimate_camera_errors,
    moved_camera,
    significant,
)
from worldline_core.calibration.diagnosis import Conclusion, Diagnosis
from worldline_core.calibration.evidence import MIN_IMAGE_PAIRS
from worldline_core.calibration.observation import Observation, observe, read, small_gray
from worldline_core.data.episodes.conventions import RecordedConventions, applicable
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.transforms import quaternion_xyzw_from_rotation

LAGS = (-4, -3, -2, -1, 1, 2, 3, 4)
OFFSETS_M = (-0.1, -0.06, -0.03, 0.03, 0.06, 0.1, 0.15)
SCALES = (0.5, 0.67, 0.8, 1.25, 1.5, 2.0, 3.33)
CASES = {
    "head": (("rotation", (1, 2, 3, 5, 10)), ("focal length", (3, 5, 10, 15)), ("translation", (30, 60))),
    "wrist": (("rotation", (5, 10)), ("focal length", (15,))),
}
TOGETHER, DRAWS = 20, 10


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
    images = corrupted_image_frames(base.num_frames, conventions)
    gray = {view: values[images] for view, values in episode.gray.items()}
    return diagnose(corrupt(base, conventions), gray, episode.kinematics, quick=quick)


def named(diagnosis: Conclusion) -> str:
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


def spoiled(observation: Observation, view: str, theta: np.ndarray) -> Observation:
    """The same pictures with one camera's calibration changed."""
    episode = observation.episode
    cameras = {**episode.cameras, view: moved_camera(episode.cameras[view], theta)}
    gray = {view: observation.gray[view]}
    return replace(observation, episode=replace(episode, cameras=cameras), gray=gray)


def errors(seed: int, view: str) -> Iterator[tuple[str, float, np.ndarray]]:
    """(kind, size in its unit, parameters): of each case one direction."""
    random = np.random.default_rng([seed, len(view)])
    for name, sizes in CASES["wrist" if view.endswith("wrist") else view]:
        kind = ERROR_KINDS[name]
        direction = random.normal(size=kind.parameters.stop - kind.parameters.start)
        for size in sizes:
            theta = np.zeros(PARAMETERS)
            theta[kind.parameters] = direction / np.linalg.norm(direction) * size / kind.scale
            yield name, size, theta


def measure_cameras(items: Sequence[Healthy], seeds: Sequence[int]) -> None:
    observations = [observe(item.joints, item.gray, item.kinematics) for item in items]

    def estimated(observed: Observation) -> tuple[CameraError, ...]:
        reading = read(observed, RecordedConventions())
        return () if reading is None else estimate_camera_errors(observed, reading)

    def rows() -> Iterator[tuple[str, ...]]:
        clean = [estimated(observed) for observed in observations]
        for view in ("head", "left_wrist"):
            shown = [i for i, observed in enumerate(observations) if view in observed.gray]
            of_view = [tuple(r for r in clean[i] if r.view == view) for i in shown]
            for kind in ("rotation", "focal length"):
                yield row(f"{view}: healthy, {kind}", kind, [of_view])
            found: dict[tuple[str, str], list[list[tuple[CameraError, ...]]]] = defaultdict(list)
            for seed in seeds:
                for kind, size, theta in errors(seed, view):
                    name = f"{view}: {kind} {size:g} {ERROR_KINDS[kind].unit}"
                    found[name, kind].append([estimated(spoiled(observations[i], view, theta)) for i in shown])
            yield from (row(name, kind, of_seeds) for (name, kind), of_seeds in found.items())

    columns = ("error", "found in one episode", "unseen up to", "found in 20", "unseen up to", "named")
    print_table(columns, rows())


def row(name: str, kind: str, of_seeds: Sequence[Sequence[tuple[CameraError, ...]]]) -> tuple[str, ...]:
    """Errors found in single episodes, and in sources drawn from those of each seed."""
    single = [estimates for episodes in of_seeds for estimates in episodes]
    sources = []
    for seed, episodes in enumerate(of_seeds):
        random = np.random.default_rng(seed)
        for _ in range(DRAWS):
            drawn = random.choice(len(episodes), min(TOGETHER, len(episodes)), replace=False)
            sources.append(combine([episodes[i] for i in drawn]))
    off = [significant(estimates, together=True) for estimates in sources]
    kinds = Counter(error.kind for errors in off for error in errors)
    alone = [bool(significant(estimates)) for estimates in single]
    unseen = [np.median([e.bound for group in groups for e in group if e.kind == kind]) for groups in (single, sources)]
    return (
        name,
        f"{100 * np.mean(alone):.0f} % of {len(single)}",
        f"{unseen[0]:.1f}",
        f"{100 * np.mean([bool(errors) for errors in off]):.0f} % of {len(off)}",
        f"{unseen[1]:.1f}",
        ", ".join(f"{kind} {number}" for kind, number in kinds.most_common()),
    )


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("what", choices=("mistakes", "cameras"))
    parser.add_argument("--recordings", type=Path, default=RECORDINGS)
    parser.add_argument("--splits", default="test,ood_test")
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--seeds", default="0,1", help="cameras: directions of the errors")
    arguments = parser.parse_args()
    shipped = healthy(arguments.recordings, set(arguments.splits.split(",")), arguments.every)
    if arguments.what == "mistakes":
        measure_mistakes(shipped)
        return
    measure_cameras(list(shipped), [int(seed) for seed in arguments.seeds.split(",")])


if __name__ == "__main__":
    main()
