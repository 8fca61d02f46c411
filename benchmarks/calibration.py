"""How often the calibration check names a mistake, and how large a camera error it sees: both injected into healthy recordings.

    python benchmarks/calibration.py mistakes [--splits test,ood_test] [--every 1] [--imperfect] [--without-mounts]
    python benchmarks/calibration.py cameras [--every 2] [--seeds 0,1] [--imperfect]

Recordings with an injected defect (injected_defects.json) are left out.

- `mistakes`: every usual mistake, one at a time. Quaternion, Euler, pose unit and tool offset are injected into the same
  episodes rewritten as tool poses by forward kinematics. `--without-mounts` withholds the wrist cameras' stated mounts;
  `--imperfect` disturbs the recordings as careful calibration would; `--typical` prints what healthy episodes reach, the
  origin of the typical values of `CalibrationDoctorConfig` (use it on the training split only).
- `cameras`: one view at a time with an error of growing size, in a direction that the seed chooses, the same in all
  episodes of a seed. For single episodes and for sources of 20: errors found, the kind they were named by, and the
  error that could have gone unseen (median bound). The first rows are false alarms on healthy recordings.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
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
from worldline_core.calibration.diagnosis import Conclusion, Diagnosis, diagnose_source
from worldline_core.calibration.doctor_config import CalibrationDoctorConfig
from worldline_core.calibration.evidence import MIN_IMAGE_PAIRS
from worldline_core.calibration.observation import Observation, observe, read, small_gray
from worldline_core.data.episodes.conventions import RecordedConventions, applicable
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.filters.filter_config import FilterDoctorConfig
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.geometry.transforms import pose_from_euler_fixed_xyz, quaternion_xyzw_from_rotation

LAGS = (-4, -3, -2, -1, 1, 2, 3, 4)
OFFSETS_M = (-0.1, -0.06, -0.03, 0.03, 0.06, 0.1, 0.15)
SCALES = (0.5, 0.67, 0.8, 1.25, 1.5, 2.0, 3.33)
NUMBERED = ("tool_offset_z_m", "intrinsics_size", "camera_lag_frames", "image_lag_frames")
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


def without_mounts(kinematics: ArmKinematics) -> ArmKinematics:
    """The robot without the mounts of its wrist cameras."""
    embodiment = kinematics.embodiment
    arms = tuple(
        arm.model_copy(update={"wrist_camera": arm.wrist_camera and arm.wrist_camera.model_copy(update={"link": ""})})
        for arm in embodiment.arms
    )
    stripped = object.__new__(ArmKinematics)
    stripped.__dict__.update(kinematics.__dict__)
    stripped.embodiment = embodiment.model_copy(update={"arms": arms})
    return stripped


def imperfect(episode: Episode, seed: int) -> Episode:
    """The episode calibrated to millimetres, as a careful laboratory would have it.

    Camera mounts off by 5 mm and 1 degree and unsteady by 1 mm and 0.2 degrees, fixed cameras off by 10 mm and 1 degree,
    focal lengths by 1.5 %, principal points by 1 % of the image, joints noisy by 0.002 rad (standard deviations).
    """
    random = np.random.default_rng(seed)

    def disturbed(poses: np.ndarray, metres: float, degrees: float, count: int) -> np.ndarray:
        angles = random.normal(0, np.radians(degrees) / np.sqrt(3), (count, 3))
        return poses @ pose_from_euler_fixed_xyz(random.normal(0, metres / np.sqrt(3), (count, 3)), angles)

    cameras = {}
    for view, camera in episode.cameras.items():
        poses = disturbed(camera.T_base_camera, *((0.005, 1.0) if camera.moving else (0.01, 1.0)), 1)
        if camera.moving:
            poses = disturbed(poses, 0.001, 0.2, len(poses))
        K = camera.K.copy()
        K[[0, 1], [0, 1]] *= 1 + random.normal(0, 0.015)
        K[:2, 2] += random.normal(0, 0.01, 2) * (camera.width, camera.height)
        cameras[view] = replace(camera, K=K, T_base_camera=poses)
    state = episode.state + random.normal(0, 0.002, episode.state.shape).astype(np.float32)
    return replace(episode, cameras=cameras, state=state)


def healthy(root: Path, splits: set[str], every: int, disturb: bool) -> Iterator[Healthy]:
    episodes = EpisodeSet.open(root)
    defects = json.loads((root / "injected_defects.json").read_text())
    chosen = [i for i, row in enumerate(episodes.rows) if row.split in splits and row.episode_id not in defects]
    kinematics: dict[str, ArmKinematics] = {}
    for i in chosen[::every]:
        episode = imperfect(episodes.episode(i), i) if disturb else episodes.episode(i)
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


def examine(
    episode: Healthy, base: Episode, conventions: RecordedConventions, config: CalibrationDoctorConfig, mounts: bool
) -> Diagnosis:
    """Diagnosis of a healthy episode, `base` as joints or tool poses, after these conventions have spoiled it."""
    images = corrupted_image_frames(base.num_frames, conventions)
    gray = {view: values[images] for view, values in episode.gray.items()}
    return diagnose(
        corrupt(base, conventions), gray, episode.kinematics if mounts else without_mounts(episode.kinematics), config
    )


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


def measure_mistakes(items: Iterator[Healthy], arguments: argparse.Namespace) -> None:
    config = CalibrationDoctorConfig()
    wanted = {name for name in arguments.mistakes.split(",") if name}
    confusion: dict[str, Counter[str]] = defaultdict(Counter)
    correct: dict[str, list[bool]] = defaultdict(list)
    sets: dict[tuple[str, str], list[Diagnosis]] = defaultdict(list)
    truth: dict[tuple[str, str], RecordedConventions] = {}
    lag_errors: dict[str, list[float]] = defaultdict(list)
    healthy_values: dict[str, list[float]] = defaultdict(list)
    spent, count = 0.0, 0
    unobservable: Counter[str] = Counter()
    for number, episode in enumerate(items):
        for name, base, conventions in injected(episode, number):
            if wanted and name not in wanted:
                continue
            start = time.process_time()
            diagnosis = examine(episode, base, conventions, config, not arguments.without_mounts)
            spent, count = spent + time.process_time() - start, count + 1
            found = named(diagnosis)
            if not observable(name, episode, diagnosis):
                unobservable[f"{name}: {found}"] += 1
                continue
            confusion[name][found] += 1
            correct[name].append(right(name, conventions, found, diagnosis.best.conventions))
            if found == name and name.endswith("lag_frames"):
                lag_errors[name].append(getattr(diagnosis.best.conventions, name) - getattr(conventions, name))
            if arguments.typical and name.startswith("none"):
                collect_typical(name, diagnosis, healthy_values)
            if not (conventions.departures and conventions.departures[0] in NUMBERED):
                # Numbered mistakes vary over episodes here, while a source has one value.
                sets[name, episode.joints.embodiment].append(diagnosis)
                truth[name, episode.joints.embodiment] = conventions
    set_correct: dict[str, list[bool]] = defaultdict(list)
    for (name, embodiment), diagnoses in sets.items():
        summed = diagnose_source(embodiment, diagnoses, config)
        set_correct[name].append(right(name, truth[name, embodiment], named(summed), summed.best.conventions))
    report(confusion, correct, set_correct, lag_errors)
    for case, times in unobservable.items():
        print(f"not observable in the recording, not counted: {case} ({times})")
    print(f"{count} diagnoses, {spent / max(count, 1) * 1e3:.0f} ms of CPU each")
    for name, values in healthy_values.items():
        low, middle, high = np.percentile(values, [5, 50, 95])
        print(f"{name}: 5 % {low:.2f}, median {middle:.2f}, 95 % {high:.2f}, max {max(values):.2f} (n = {len(values)})")


def collect_typical(name: str, diagnosis: Diagnosis, values: dict[str, list[float]]) -> None:
    """Margins of the rival readings of a healthy episode, and the flow of each view."""
    for mistake, score in {e.mistake: e.score for e in reversed(diagnosis.ranked)}.items():
        values[f"{name}: margin of {mistake}"].append(score - diagnosis.as_recorded.score)
    for view, measures in diagnosis.measures.items():
        if "flow" in measures:
            values[f"{name}: {'wrist' if view.endswith('wrist') else 'fixed'} flow"].append(measures["flow"])


def report(
    confusion: dict[str, Counter[str]],
    correct: dict[str, list[bool]],
    set_correct: dict[str, list[bool]],
    lag_errors: dict[str, list[float]],
) -> None:
    rows = []
    for name, found in confusion.items():
        sources = f"{100 * np.mean(set_correct[name]):.0f} %" if set_correct.get(name) else ""
        accepted = {name} if not name.startswith("none") else {"consistent", "too_little_evidence"}
        others = ", ".join(f"{k} {v}" for k, v in found.most_common() if k not in accepted)
        rows.append((name, found.total(), f"{100 * np.mean(correct[name]):.1f} %", sources, others))
    print_table(("injected", "episodes", "right", "right over sources", "found instead"), rows)
    mistakes = [value for name, values in correct.items() if not name.startswith("none") for value in values]
    clean = [value for name, values in correct.items() if name.startswith("none") for value in values]
    if mistakes:
        print(f"mistakes named correctly: {100 * np.mean(mistakes):.2f} % of {len(mistakes)}")
    if clean:
        print(f"false alarms: {100 * (1 - np.mean(clean)):.2f} % of {len(clean)}")
    for name, errors in lag_errors.items():
        print(
            f"{name}: {100 * np.mean(np.abs(errors) <= 1):.1f} % within one frame, largest error {np.abs(errors).max()}"
        )


# Errors of one camera


@dataclass
class Tally:
    """Results of one case: of single episodes and of sources."""

    alone: list[bool] = field(default_factory=list)
    together: list[bool] = field(default_factory=list)
    named: Counter[str] = field(default_factory=Counter)
    unseen_alone: list[float] = field(default_factory=list)
    unseen_together: list[float] = field(default_factory=list)


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


def count(
    tally: Tally, kind: str, episodes: Sequence[tuple[CameraError, ...]], config: CalibrationDoctorConfig, seed: int
) -> None:
    """Add what is found in single episodes, and in sources drawn from them."""
    for residuals in episodes:
        tally.alone.append(bool(significant(residuals, config.off_alone)))
        tally.unseen_alone += [r.bound for r in residuals if r.kind == kind]
    random = np.random.default_rng(seed)
    for _ in range(DRAWS):
        drawn = random.choice(len(episodes), min(TOGETHER, len(episodes)), replace=False)
        residuals = combine([episodes[i] for i in drawn])
        off = significant(residuals, config.off_together)
        tally.together.append(bool(off))
        tally.named.update(residual.kind for residual in off)
        tally.unseen_together += [r.bound for r in residuals if r.kind == kind]


def measure_cameras(items: Sequence[Healthy], seeds: Sequence[int]) -> None:
    config = CalibrationDoctorConfig()
    observations = [observe(item.joints, item.gray, item.kinematics) for item in items]

    def estimated(observed: Observation) -> tuple[CameraError, ...]:
        reading = read(observed, RecordedConventions())
        return () if reading is None else estimate_camera_errors(observed, reading)

    start = time.process_time()
    clean = [estimated(observed) for observed in observations]
    print(f"{(time.process_time() - start) / len(items) * 1e3:.0f} ms of CPU an episode", flush=True)

    def rows() -> Iterator[tuple[str, ...]]:
        for view in ("head", "left_wrist"):
            shown = [i for i, observed in enumerate(observations) if view in observed.gray]
            of_view = [tuple(r for r in clean[i] if r.view == view) for i in shown]
            for kind in ("rotation", "focal length"):
                tally = Tally()
                count(tally, kind, of_view, config, 0)
                yield row(f"{view}: healthy, {kind}", tally)
            tallies: dict[str, Tally] = defaultdict(Tally)
            for seed in seeds:
                for kind, size, theta in errors(seed, view):
                    found = [estimated(spoiled(observations[i], view, theta)) for i in shown]
                    count(tallies[f"{view}: {kind} {size:g} {ERROR_KINDS[kind].unit}"], kind, found, config, seed)
            yield from (row(name, tally) for name, tally in tallies.items())
        yield exchanged_wrist_videos(items)

    columns = ("error", "found in one episode", "unseen up to", "found in 20", "unseen up to", "named")
    print_table(columns, rows())


def exchanged_wrist_videos(items: Sequence[Healthy]) -> tuple[str, ...]:
    """Row of exchanged wrist videos, examined as the filter does."""
    found = []
    for item in items:
        views = [arm.camera_view for arm in item.kinematics.embodiment.arms]
        if len(views) == 2:
            gray = item.gray | {one: item.gray[two] for one, two in (views, views[::-1])}
            found.append(diagnose(item.joints, gray, item.kinematics, FilterDoctorConfig()))
    alone = np.mean([diagnosis.best.mistake == "wrist_videos" for diagnosis in found])
    together = diagnose_source("exchanged", found).best.mistake
    return "wrist videos exchanged", f"{100 * alone:.0f} % of {len(found)}", "", f"all together: {together}", "", ""


def row(name: str, tally: Tally) -> tuple[str, ...]:
    kinds = ", ".join(f"{kind} {number}" for kind, number in tally.named.most_common())
    return (
        name,
        f"{100 * np.mean(tally.alone):.0f} % of {len(tally.alone)}",
        f"{np.median(tally.unseen_alone):.1f}",
        f"{100 * np.mean(tally.together):.0f} % of {len(tally.together)}",
        f"{np.median(tally.unseen_together):.1f}",
        kinds,
    )


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("what", choices=("mistakes", "cameras"))
    parser.add_argument("--recordings", type=Path, default=RECORDINGS)
    parser.add_argument("--splits", default="test,ood_test")
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--imperfect", action="store_true", help="disturb the healthy calibration by millimetres first")
    parser.add_argument("--seeds", default="0,1", help="cameras: directions of the errors")
    parser.add_argument("--mistakes", default="", help="mistakes: these only, comma-separated")
    parser.add_argument("--without-mounts", action="store_true", help="mistakes: without stated wrist camera mounts")
    parser.add_argument("--typical", action="store_true", help="mistakes: print what healthy episodes reach")
    arguments = parser.parse_args()
    shipped = healthy(arguments.recordings, set(arguments.splits.split(",")), arguments.every, arguments.imperfect)
    if arguments.what == "mistakes":
        measure_mistakes(shipped, arguments)
        return
    measure_cameras(list(shipped), [int(seed) for seed in arguments.seeds.split(",")])


if __name__ == "__main__":
    main()
