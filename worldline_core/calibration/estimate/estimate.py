"""`worldline calibrate estimate`: the cameras of a source from its recorded episodes alone.

Writes `cameras.json` (the cameras that are sure, as a calibration file), `estimate.json`, `index.html` and a picture of each
view into one folder. Nothing is changed in the source.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from worldline_core.calibration.check import (
    OUTPUT_ROOT,
    ListedEpisode,
    episode_images,
    episodes_of_config,
    episodes_of_sources,
)
from worldline_core.calibration.estimate.base_pose import place_second_arm, with_base
from worldline_core.calibration.estimate.estimate_config import CAMERAS, ESTIMATE, EstimateConfig
from worldline_core.calibration.estimate.estimate_report import (
    as_json,
    base_text,
    headline,
    mount_line,
    page,
    view_picture,
)
from worldline_core.calibration.estimate.recordings import LoadedViews, MaskRobot, RecordedView, recorded_views
from worldline_core.calibration.estimate.still_camera import estimate_still, refine_with_masks
from worldline_core.calibration.estimate.verdict import (
    SourceEstimate,
    ViewEstimate,
    judge_still,
    judge_wrist,
    too_few,
    too_little,
)
from worldline_core.calibration.estimate.wrist_camera import estimate_wrist
from worldline_core.calibration.observation import arms_of_embodiment
from worldline_core.data.curation.recorded_episode import check_values
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import safe_stem
from worldline_core.errors import DataError
from worldline_core.geometry.embodiment import load_embodiment
from worldline_core.geometry.kinematics import ArmKinematics
from worldline_core.pictures import evenly_spaced, jpeg_bytes
from worldline_core.progress import Progress, with_progress
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic

logger = logging.getLogger(__name__)

MOST_EPISODES = 20
"""More say little that these do not."""
PICTURES = 3


def estimate_views(
    loaded: LoadedViews,
    kinematics: ArmKinematics,
    count: int,
    mask_robot: MaskRobot | None = None,
) -> list[ViewEstimate]:
    """The camera of every view of about `count` episodes, by the images by view (gone through once) and the states alone.

    Args:
        mask_robot: what moves outside of its masks does not count in still views.

    Raises: DataError as `recorded_views`.
    """
    views = recorded_views(loaded, kinematics, count, colour=mask_robot is not None).values()
    return [
        _estimate(view, kinematics, mask_robot) for view in with_progress(views, "calibrate estimate: fitting", "view")
    ]


def _estimate(recorded: RecordedView, kinematics: ArmKinematics, mask_robot: MaskRobot | None) -> ViewEstimate:
    arms = {arm.wrist_view: (i, arm.T_tool_mount) for i, arm in enumerate(arms_of_embodiment(kinematics))}
    arm, mount = arms.get(recorded.view, (None, None))
    reason = too_few(recorded)
    if reason is None and arm is None:
        reason = too_little(recorded)
    if reason is not None:
        count = len(recorded.episodes)
        return ViewEstimate(recorded.view, arm is not None, "unsure", None, reasons=(reason,), episodes=count)
    if arm is not None:
        return judge_wrist(recorded, estimate_wrist(recorded, arm, mount), arm)
    found = estimate_still(recorded)
    if mask_robot is None:
        return judge_still(recorded, found)
    masked = recorded.masked(mask_robot, found.fitted.camera)
    refined = refine_with_masks(masked, found)
    if np.median(refined.agreements) > np.median(found.agreements):
        return judge_still(masked, refined)
    plain = judge_still(recorded, found)
    return replace(plain, notes=(*plain.notes, "the segmenter's masks do not agree with what moves, and are not used"))


def estimate_command(
    config: Path,
    *,
    overrides: Sequence[str] = (),
    views: Sequence[str] = (),
    output: Path | None = None,
    mask_robot: MaskRobot | None = None,
) -> SourceEstimate:
    """Estimate the cameras of a configuration's source: of `views`, or of those that have none (all where all have one).

    Args:
        mask_robot: masks of a segmenter that are used as well.

    Raises:
        ConfigError: the file has a mistake, or configures several sources.
        DataError: the source cannot be opened, has no such view, or an episode cannot be read.
    """
    listed, descriptions = episodes_of_config(config, overrides)
    sources = {item.source for item in listed}
    if len(sources) != 1:
        raise DataError(
            "Cameras are estimated of one source", where=config, expected="one source with episodes",
            got=", ".join(sorted(sources)) or "none", next_step="--set 'curate.sources=[...]' with one of them",
        )  # fmt: skip
    folder = output or OUTPUT_ROOT / f"{config.stem}_estimate"
    return _estimate_source(listed, descriptions, views, folder, mask_robot, known=True)


def estimate_cameras(config: EstimateConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """The same as a task, of the views that have no camera: views and verdicts. Nothing is sure is a result like any other.

    Raises: DataError as `estimate_command`.
    """
    del inputs  # they are in the configuration, and in the cache key
    found = _estimate_source(episodes_of_sources([config.source], config.reader), config.description_paths, (), output)
    verdicts = {view.view: view.verdict for view in found.views}
    said = [
        line
        for view in found.views
        for line in (headline(view), *(f"{view.view}: not sure: {r}" for r in view.reasons))
    ]
    for line in filter(None, (base_text(found), mount_line(found), *said)):
        logger.info("%s", line)
    if not found.sure:
        logger.info(
            "Views without a sure camera take the commands themselves; its page (index.html) shows what was found."
        )
    return {"views": verdicts, "reasons": {view.view: list(view.reasons) for view in found.views if view.reasons}}


def _estimate_source(
    listed: Sequence[ListedEpisode],
    descriptions: Mapping[str, str],
    views: Sequence[str],
    folder: Path,
    mask_robot: MaskRobot | None = None,
    *,
    known: bool = False,
) -> SourceEstimate:
    """Cameras of `views`, or of those that have none; ``known``: of all where all have one."""
    chosen = _readable(listed)
    first = chosen[0].load()
    if unknown := set(views) - set(first.views):
        raise DataError("No such view", expected=", ".join(first.views), got=", ".join(sorted(unknown)))
    wanted = tuple(views) or tuple(v for v in first.views if v not in first.episode.cameras)
    wanted = wanted or (first.views if known else ())

    def loaded(shown: Sequence[str]) -> LoadedViews:
        with Progress("calibrate estimate: reading", len(chosen), "episode") as progress:
            for item in chosen:
                found = item.load()
                yield found.episode, {view: episode_images(found, view) for view in shown if view in found.views}
                progress.advance()

    robot, base = load_embodiment(first.episode.embodiment, descriptions.get(first.episode.embodiment)), None
    if not wanted and robot.description.unknown_mount is None:
        return SourceEstimate(chosen[0].source, (), folder, None)  # also of robots whose description is not here
    if robot.description.unknown_mount is not None:
        robot, base = place_second_arm(loaded(first.views), robot, len(chosen))
    kinematics = ArmKinematics(robot)
    estimates = estimate_views(loaded(wanted), kinematics, len(chosen), mask_robot)
    if base is not None:
        estimates = [with_base(each, base) for each in estimates]
    pictures = dict(_pictures(estimates, chosen, kinematics, folder))
    cameras = folder / CAMERAS if any(each.verdict == "sure" for each in estimates) else None
    found = SourceEstimate(chosen[0].source, tuple(estimates), folder, cameras, base)
    if cameras is not None:
        write_json_atomic(cameras, camera_file(estimates))
    write_json_atomic(folder / ESTIMATE, as_json(found))
    write_bytes_atomic(folder / "index.html", page(found, pictures).encode())
    return found


def _readable(listed: Sequence[ListedEpisode]) -> list[ListedEpisode]:
    """Up to MOST_EPISODES of them, evenly spaced as far as they can be read; curation names the others. Raises: the first one's fault
    where none can.
    """
    chosen: list[ListedEpisode] = []
    faults: list[RejectedInputError | DataError] = []
    for number in dict.fromkeys([*evenly_spaced(len(listed), MOST_EPISODES), *range(len(listed))]):
        try:
            check_values(listed[number].load().episode)
        except (RejectedInputError, DataError) as error:
            faults.append(error)
            continue
        chosen.append(listed[number])
        if len(chosen) == MOST_EPISODES:
            break
    if not chosen:
        raise faults[0]
    if faults:
        logger.warning("%d episodes cannot be read and are left out, the first: %s", len(faults), faults[0])
    return chosen


def _pictures(
    estimates: Sequence[ViewEstimate], chosen: Sequence[ListedEpisode], kinematics: ArmKinematics, folder: Path
) -> Iterator[tuple[str, str]]:
    """Writes a picture of each view that has a camera; yields the view and the picture's name in the folder."""
    for estimate in estimates:
        if estimate.camera is None:
            continue
        shown: list[tuple[Episode, int, np.ndarray]] = []
        for number in evenly_spaced(len(chosen), PICTURES):
            found = chosen[number].load()
            if estimate.view in found.views:
                middle = found.episode.num_video_frames // 2
                image = next(islice(found.each_image(estimate.view), middle, None))
                shown.append((found.episode, middle, image))
        name = f"{safe_stem(estimate.view)}.jpg"
        write_bytes_atomic(folder / name, jpeg_bytes(view_picture(estimate, shown, kinematics)))
        yield estimate.view, name


DIGITS = 6


def camera_file(estimates: Iterable[ViewEstimate]) -> dict[str, Any]:
    """Content of the file: the views whose camera is sure."""
    return {"views": {each.view: _entry(each) for each in estimates if each.verdict == "sure"}}


def _entry(estimate: ViewEstimate) -> dict[str, Any]:
    camera = estimate.camera
    if camera is None:
        raise ValueError(f"a sure estimate without a camera: {estimate.view}")
    pose = camera.T_base_camera[0].round(DIGITS).tolist()
    common = {"width": camera.width, "height": camera.height, "K": camera.K.round(DIGITS).tolist()}
    if estimate.wrist:
        return common | {"T_tool_camera": pose}
    return common | {"maps": "camera_to_base", "axes": "opencv", "T": pose}
