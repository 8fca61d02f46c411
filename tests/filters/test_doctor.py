"""The calibration doctor as a detector of the filters."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tools.corrupted.conventions import corrupt
from worldline_core.data.episodes.conventions import RecordedConventions
from worldline_core.data.episodes.episode import Episode
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.video.thumbnails import ViewThumbnails
from worldline_core.errors import CalibrationError
from worldline_core.filters import filter as filter_module
from worldline_core.filters.calibration import detect_mistake, kinematics_of
from worldline_core.filters.filter import inspect
from worldline_core.filters.filter_config import FilterConfig, FilterDoctorConfig
from worldline_core.filters.signals import Signals, measure
from worldline_core.filters.verdict import Finding

CONFIG = FilterDoctorConfig()
Recording = tuple[Episode, dict[str, ViewThumbnails], Signals]


@pytest.fixture(scope="module")
def recording(project_root: Path) -> Recording:
    episodes = EpisodeSet.open(project_root / "artifacts" / "shipped" / "recordings")
    i = episodes.position("xarm7_white-test-s1-00001")
    thumbnails = {view: episodes.thumbnails(i, view) for view in episodes.rows[i].views}
    return episodes.episode(i), thumbnails, measure(episodes.episode(i), thumbnails)


@pytest.mark.slow
def test_frames_that_are_dropped_anyway_do_not_count(recording: Recording) -> None:
    episode, _, signals = recording
    head, bad = signals.gray["head"].copy(), np.arange(episode.num_frames) >= 9
    head[bad] = np.random.default_rng(0).integers(0, 255, head[bad].shape)
    noisy = {**signals.gray, "head": head}
    spoilt = detect_mistake(episode, noisy, bad & False, CONFIG)
    assert (spoilt.passed, spoilt.reason) == (False, "calibration_unexplained")
    assert "flow head" in str(spoilt.numbers["bad"])
    assert detect_mistake(episode, noisy, bad, CONFIG).passed
    nothing_left = detect_mistake(episode, noisy, bad | True, CONFIG)
    assert (nothing_left.passed, nothing_left.numbers["verdict"]) == (True, "too_little_evidence")


@pytest.mark.slow
def test_an_explanation_comes_before_what_it_explains(recording: Recording) -> None:
    episode, thumbnails, signals = recording
    wrong = corrupt(episode, RecordedConventions(extrinsics="base_to_camera"))
    failed = [finding for finding in inspect(FilterConfig(), measure(wrong, thumbnails)) if not finding.verdict.passed]
    assert (failed[0].detector, failed[0].verdict.reason) == ("doctor", "calibration")
    assert failed[0].verdict.numbers["config"] == "curate.sources[].conventions.extrinsics: base_to_camera"
    assert {"hand_eye", "projection"} & {finding.detector for finding in failed}
    clean = inspect(FilterConfig(), signals)
    assert all(finding.verdict.passed for finding in clean)
    assert clean[-1].detector == "doctor"


def test_an_inverted_gripper_is_named_and_bars_nothing(project_root: Path) -> None:
    """Fingers of one episode are a weak sign: the evidence has the line, and sends the user to the whole source."""
    episodes = EpisodeSet.open(project_root / "artifacts" / "shipped" / "recordings")
    i = episodes.position("panda_ivory-ood_test-s1-00000")
    signals = measure(episodes.episode(i), {view: episodes.thumbnails(i, view) for view in episodes.rows[i].views})
    inverted = corrupt(signals.episode, RecordedConventions(gripper="inverted"))
    found = detect_mistake(inverted, signals.gray, np.zeros(inverted.num_frames, dtype=bool), CONFIG)
    assert (found.passed, found.numbers["mistake"]) == (True, "gripper")
    assert found.numbers["config"] == "curate.sources[].conventions.gripper: inverted"
    assert "worldline calibrate check" in str(found.numbers["warning"])


def test_kinematics_that_do_not_fit_are_not_used(recording: Recording) -> None:
    episode = recording[0]
    assert kinematics_of(episode) is kinematics_of(episode)
    assert kinematics_of(replace(episode, embodiment="no_such_robot")) is None
    three = np.tile(np.eye(4), (episode.num_frames, 3, 1, 1))
    assert kinematics_of(replace(episode, T_base_ee=three)) is None


@pytest.mark.parametrize(
    "error",
    [ValueError("no"), np.linalg.LinAlgError("no"), CalibrationError("no"), cv2.error("no"), TypeError("a mistake")],
)
def test_a_judgement_that_fails_does_not_cost_the_episode(recording, error, monkeypatch):
    def fails(*_: object) -> list[Finding]:
        raise error

    fails.__name__ = "find_mistake"
    for name in ("JUDGEMENTS", "DETECTORS"):
        monkeypatch.setattr(filter_module, name, (*getattr(filter_module, name)[:-1], fails))
    if isinstance(error, TypeError):  # of the code
        with pytest.raises(TypeError, match="a mistake"):
            inspect(FilterConfig(), recording[2])
        return
    *others, failed = inspect(FilterConfig(), recording[2])
    assert len(others) > 5
    assert (failed.stage, failed.verdict.passed, failed.verdict.numbers["verdict"]) == (2, True, "not_judged")
    assert "no" in str(failed.verdict.numbers["message"])
