"""Foreign LeRobot datasets, v2.1 and v3.0 (Galaxea, RoboCOIN, DROID's port and many more), without our camera sidecar.

LeRobot states neither the unit of joint angles, nor what a gripper reading means, nor where cameras are, so all three are
declared in the configuration. Without calibration such episodes serve action-free training. RoboCOIN and Galaxea publish
one dataset per task, hundreds of them: a collection reads every dataset below a folder.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from worldline_core.data.episodes.episode import REPEATS_STATE, TRAINING_SPLITS, Episode
from worldline_core.data.episodes.recorded_poses import RecordedCameras
from worldline_core.data.episodes.source import EVALUATION_ONLY, EpisodeSource, LoadedEpisode, says_droid, sorted_views
from worldline_core.data.guards.rejection import RATE_TOLERANCE, RejectedInputError, all_of, check_rate, collect_faults
from worldline_core.data.guards.source_paths import AnyPath, fill_template, find_files, inside, relative_name
from worldline_core.data.lerobot.dataset import LeRobotV3Dataset, LeRobotV21Dataset
from worldline_core.data.lerobot.metadata import DatasetInfo
from worldline_core.data.sources.calibration_file import add_calibrated_view, read_calibration
from worldline_core.data.sources.lerobot_columns import LeRobotSourceConfig, flat_names, state_columns
from worldline_core.data.video.clip import VideoClip, video_size
from worldline_core.errors import ConfigError, DataError

_DROID_VIDEOS = {"observation.images.exterior_1_left", "observation.images.exterior_2_left"}


class LeRobotSource:
    """Reads a LeRobotDataset.

    Raises: DataError when the folder is no such dataset; ConfigError when a declared column or view is unknown, or when
        the dataset is DROID and its split would train or select a model.
    """

    looked_for = "episodes that meta/ lists"

    def __init__(self, config: LeRobotSourceConfig, root: AnyPath, label: str | None = None) -> None:
        self._config = config
        self._root = root
        self._label = label or config.label
        self._dataset = LeRobotV21Dataset(root) if config.kind == "lerobot_v21" else LeRobotV3Dataset(root)
        features = self._dataset.features
        self._evaluation_only = config.evaluation_only or _is_droid(config, root, self._dataset.info)
        if self._evaluation_only and config.split in TRAINING_SPLITS:
            raise ConfigError(
                "DROID is for evaluation only",
                where=str(root),
                expected="split test or ood_test",
                got=config.split,
                next_step="set the source's split, or name datasets that are not DROID otherwise",
            )
        names = flat_names(features.get("observation.state", {}))
        known = {"video key": self._dataset.video_keys, "state column": names, "feature": list(features)}
        columns = [name for name in (config.task_column, config.success_column) if name is not None]
        for what, wanted in (("video key", config.views), ("state column", config.grippers), ("feature", columns)):
            unknown = sorted(set(wanted) - set(known[what]) - {"task_index"})
            if unknown:
                raise ConfigError(
                    f"The dataset has no {what} of this name",
                    where=str(root),
                    expected=", ".join(known[what]),
                    got=", ".join(unknown),
                )
        self._columns = state_columns(config, features, str(root))
        self._calibration = lru_cache(maxsize=1)(lambda name: read_calibration(inside(root, name)))

    def episode_ids(self) -> list[str]:
        return [f"{self._label}-{int(index):06d}" for index in self._dataset.episodes.indices]

    def load(self, episode_id: str) -> LoadedEpisode:
        config, dataset = self._config, self._dataset
        index = int(episode_id.rsplit("-", 1)[1])
        key_of = {view: key for key, view in config.views.items()}

        def clip_of(view: str) -> VideoClip:
            clip = dataset.clip(index, key_of[view])
            rate = video_size(clip.path)[2]
            check_rate(rate, dataset.fps, f"{episode_id}, view {view}", tolerance=RATE_TOLERANCE * dataset.fps)
            return clip

        faults: list[RejectedInputError] = []
        clips, absent = sorted_views(key_of, clip_of, faults)
        with collect_faults(faults):
            times = dataset.column(index, "timestamp").reshape(-1).astype(np.float64)
            cameras = self._cameras(index, {view: key_of[view] for view in clips}, len(times))
            episode = self._episode(episode_id, index, times, cameras)
            if not faults:
                return LoadedEpisode(episode, tuple(clips), distortions=cameras.lenses, clips=clips, absent=absent)
        raise all_of([*faults, *absent.values()], f"episode {episode_id}")

    def _episode(self, episode_id: str, index: int, times: np.ndarray, cameras: RecordedCameras) -> Episode:
        config, dataset = self._config, self._dataset
        state, action, overshoot = self._columns.read(
            lambda feature: dataset.column(index, feature), degrees=config.angle_unit == "deg"
        )
        instruction, tasks = self._instruction(index)
        return Episode(
            **config.declared(self._label),
            episode_id=episode_id,
            embodiment=config.embodiment,
            instruction=instruction,
            outcome=self._outcome(index),
            fps=dataset.fps,
            state=state,
            action=action,
            timestamps=times - times[0],
            cameras=cameras.tracks,
            primary_view=config.primary_view or "head",
            state_names=self._columns.names,
            conventions={
                "layout": f"lerobot {dataset.info.codebase_version}",
                "declared_angle_unit": config.angle_unit,
                "gripper_overshoot": overshoot,
                **({EVALUATION_ONLY: "true"} if self._evaluation_only else {}),
                **({"action": REPEATS_STATE} if not self._columns.action else {}),
                **({"tasks": tasks} if tasks > 1 else {}),
                **cameras.notes(),
            },
        )

    def _instruction(self, index: int) -> tuple[str, int]:
        """The first frame's task, and how many different ones the episode has."""
        values = self._dataset.column(index, self._config.task_column).reshape(-1)
        text = self._dataset.tasks.get(int(values[0]), "")
        separator = self._config.task_separator
        return (text if separator is None else text.rsplit(separator, 1)[-1]).strip(), len(set(values.tolist()))

    def _outcome(self, index: int) -> str:
        if self._config.success_column is None:
            return self._config.outcome
        succeeded = self._dataset.column(index, self._config.success_column).reshape(-1)
        return "success" if bool(succeeded[-1]) else "failure"

    def _cameras(self, index: int, key_of: dict[str, str], length: int) -> RecordedCameras:
        """Calibrated cameras of the views that are there, without those whose pose was never measured."""
        cameras = RecordedCameras()
        if self._config.calibration is None:
            return cameras
        name = fill_template(self._config.calibration, episode_index=index)
        entries = self._calibration(name).views
        where = f"{self._root}, {name}"
        unknown = sorted(set(entries) - set(self._config.views.values()))
        if unknown:
            raise RejectedInputError(
                "missing_view",
                "Calibration names views that are not read",
                where=where,
                expected=", ".join(self._config.views.values()),
                got=", ".join(unknown),
            )
        for view in entries.keys() & key_of.keys():
            add_calibrated_view(
                cameras,
                view,
                entries[view],
                image_size=self._dataset.video_size(index, key_of[view])[:2],
                num_frames=length,
                read_feature=lambda feature: self._dataset.column(index, feature),
                where=where,
            )
        return cameras


def _is_droid(config: LeRobotSourceConfig, root: AnyPath, info: DatasetInfo) -> bool:
    """Whether a dataset is DROID by its name, its robot's name or its cameras' names (its port calls the robot Franka)."""
    names = (config.label, config.embodiment, root.name, str(info.robot_type), str(info.repo_id))
    return says_droid(*names) or set(info.features) >= _DROID_VIDEOS


_OPEN_DATASETS = 8


class LeRobotCollection:
    """Datasets of one layout; each has its own scene unless the configuration names one.

    A dataset that cannot be opened stands in the list as one input, and is quarantined with what is wrong with it; what
    the configuration itself gets wrong of any of them stops the listing.

    Raises: ConfigError as `LeRobotSource`.
    """

    looked_for = (
        "folders with meta/info.json (archives must be unpacked; without `collection` the folder is the dataset)"
    )

    def __init__(self, config: LeRobotSourceConfig, root: AnyPath) -> None:
        self._config = config
        self._roots: dict[str, AnyPath] = {}
        for info in find_files(root, "info.json"):
            place = relative_name(info, root)
            if place.parent.name == "meta":
                self._roots["-".join([config.label, *place.parts[:-2]])] = info.parent.parent
        self._open = lru_cache(maxsize=_OPEN_DATASETS)(self._opened)

    def _opened(self, label: str) -> LeRobotSource:
        return LeRobotSource(self._config, self._roots[label], label)

    def episode_ids(self) -> list[str]:
        listed: list[str] = []
        for label in sorted(self._roots):
            try:
                listed += self._open(label).episode_ids()
            except DataError:
                listed.append(label)
        return listed

    def load(self, episode_id: str) -> LoadedEpisode:
        if episode_id in self._roots:
            self._open(episode_id).episode_ids()  # raises what the listing met
        return self._open(episode_id.rsplit("-", 1)[0]).load(episode_id)


def open_lerobot(config: LeRobotSourceConfig, root: AnyPath) -> EpisodeSource:
    """The dataset, or the collection of datasets, that the configuration names."""
    return LeRobotCollection(config, root) if config.collection else LeRobotSource(config, root)
