"""Rerun and MCAP files open again and hold what was put in."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.reader import read_ros2_messages
from PIL import Image

from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.guards.source_paths import safe_stem
from worldline_core.errors import DataError
from worldline_core.exports.export import export_rollout, write_prediction_mcap
from worldline_core.exports.rerun_recording import RecordingContent, write_rerun_recording

COUNT = 5
"""As `conftest` makes the episode."""


@pytest.fixture(scope="module")
def chunks(content: RecordingContent, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list]:
    """Record batches by entity, read by Rerun's own reader."""
    from rerun.chunk import RrdReader

    path = tmp_path_factory.mktemp("rerun") / "episode.rrd"
    write_rerun_recording(path, content)
    reader = RrdReader(path)
    assert len(reader.blueprints()) == 1
    found: dict[str, list] = {}
    for chunk in reader.stream():
        found.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
    return found


def column(batches: list, name: str) -> list:
    return [row for batch in batches if name in batch.schema.names for row in batch.column(name).to_pylist()]


def test_rerun_holds_frames_of_every_view_and_method(chunks: dict[str, list], content: RecordingContent) -> None:
    for view in VIEWS:
        for entity in (f"/world/cameras/{view}/true", f"/world/cameras/{view}/actions", f"/predicted/stage2/{view}"):
            assert len(column(chunks[entity], "EncodedImage:blob")) == COUNT
    blob = column(chunks["/world/cameras/head/true"], "EncodedImage:blob")[2][0]
    with Image.open(io.BytesIO(bytes(blob))) as picture:
        error = np.abs(np.asarray(picture, dtype=int) - content.true_frames["head"][2]).mean()
    assert error < 12  # JPEG of noise


def test_rerun_poses_are_those_of_the_cameras(chunks: dict[str, list], content: RecordingContent) -> None:
    for view, count in (("head", 1), ("left_wrist", COUNT)):
        batches = chunks[f"/world/cameras/{view}"]
        stored = np.array(column(batches, "Transform3D:mat3x3")).reshape(count, 3, 3).transpose(0, 2, 1)  # column-major
        expected = content.episode.cameras[view].T_base_camera
        assert np.allclose(stored, expected[:, :3, :3], atol=1e-6)
        assert np.allclose(
            np.array(column(batches, "Transform3D:translation")).reshape(count, 3), expected[:, :3, 3], atol=1e-6
        )
    pinhole = np.array(column(chunks["/world/cameras/head"], "Pinhole:image_from_camera")).reshape(3, 3).T
    assert pinhole[:2, 2] == pytest.approx([24.0, 16.0])  # counted from the corner, not from the first pixel's centre


def test_rerun_signals_are_named_and_timed(chunks: dict[str, list], content: RecordingContent) -> None:
    values = np.array(column(chunks["/signals/action/right_gripper"], "Scalars:scalars"))[:, 0]
    assert np.allclose(values, content.episode.action[:, 3])
    times = column(chunks["/signals/state/left_a"], "time")
    assert [time.total_seconds() for time in times] == pytest.approx([0, 0.125, 0.25, 0.375, 0.5])


def test_rerun_robot_lies_along_its_capsules(chunks: dict[str, list], content: RecordingContent) -> None:
    tracks = content.tracks
    strips = column(chunks["/world/robot"], "LineStrips3D:strips")
    assert len(strips) == COUNT
    assert np.allclose(strips[2][0], tracks.capsules[2, 0])
    assert column(chunks["/world/robot"], "LineStrips3D:radii")[0] == pytest.approx([0.01])


def test_mcap_holds_images_calibration_and_transforms(content: RecordingContent, tmp_path: Path) -> None:
    path, again, ros2 = (tmp_path / f"{name}.mcap" for name in ("episode", "again", "ros2"))
    for file in (path, again):
        write_prediction_mcap(file, content, "stage2", "protobuf")
    topics: dict[str, int] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream)
        for _, channel, message in reader.iter_messages():
            topics[channel.topic] = topics.get(channel.topic, 0) + 1
            last = message
        facts = next(m.metadata for m in reader.iter_metadata() if m.name == "worldline.rollout")
    assert topics == {f"/{v}/image": COUNT for v in VIEWS} | {f"/{v}/calibration": 1 for v in VIEWS} | {
        "/tf": 1 + 2 * COUNT + 2 * COUNT
    }
    assert last.log_time == round((COUNT - 1) / 8.0 * 1e9)
    assert json.loads(facts["method"]) == "stage2"
    assert again.read_bytes() == path.read_bytes()
    write_prediction_mcap(ros2, content, "stage2", "ros2")
    found = [message.channel.topic for message in read_ros2_messages(str(ros2))]
    assert {topic: found.count(topic) for topic in found} == topics | {"/tf": 4 * COUNT, "/tf_static": 1}


class _Rollouts:
    method = "stage2"
    episode_ids = ("robot/1",)


def test_an_episode_without_a_prediction_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"(?s)robot/2.*stage2"):
        export_rollout({"stage2": _Rollouts()}, None, None, "robot/2", tmp_path, ("mp4",))  # type: ignore[dict-item, arg-type]


def test_file_names_are_safe() -> None:
    assert re.fullmatch(r"a_b_c____d-[0-9a-f]{16}", safe_stem("a/b c:../d"))
    assert len({safe_stem(name) for name in ("run 1", "run_1", "run.1")}) == 3
