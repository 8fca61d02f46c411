"""Rerun and MCAP files open again and hold what was put in."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from PIL import Image

from worldline_core.data.episode import VIEWS, CameraTrack, Episode
from worldline_core.errors import ConfigError, DataError
from worldline_core.exports.mcap_recording import write_mcap_recordings
from worldline_core.exports.rerun_recording import RecordingContent, TrackSignals, heat_layer, write_rerun_recording
from worldline_core.exports.rollout import export_rollout, safe_stem

COUNT, HEIGHT, WIDTH = 5, 32, 48


def rotation(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])


def poses(count: int) -> np.ndarray:
    result = np.tile(np.eye(4), (count, 1, 1))
    for i in range(count):
        result[i, :3, :3] = rotation(0.3 + 0.1 * i)
        result[i, :3, 3] = (0.1 * i, 0.2, 0.3)
    return result


@pytest.fixture(scope="module")
def content() -> RecordingContent:
    generator = np.random.default_rng(0)
    K = np.array([[40.0, 0, 23.5], [0, 41.0, 15.5], [0, 0, 1]])
    cameras = {v: CameraTrack(v, K, poses(1 if v == "head" else COUNT), WIDTH, HEIGHT) for v in VIEWS}
    state = generator.random((COUNT, 4)).astype(np.float32)
    episode = Episode(
        episode_id="robot/1", source="synthetic", embodiment="ur5e_pair", scene="s", task_family="lift", instruction="lift <it>",
        outcome="success", split="test", fps=8.0, state=state, action=state + 1, timestamps=np.arange(COUNT) / 8.0, cameras=cameras,
        state_names=("left/a", "left/gripper", "right/a", "right/gripper"),
    )  # fmt: skip
    frames = {v: generator.integers(0, 255, (COUNT, HEIGHT, WIDTH, 3), dtype=np.uint8) for v in VIEWS}
    tracks = TrackSignals(
        uv=np.full((COUNT, 3, 2, 2), 20.0), valid=np.ones((COUNT, 3, 2), bool), gripper=np.ones((COUNT, 2)),
        T_base_tool=np.stack([poses(COUNT)] * 2, axis=1), views=VIEWS, arms=("left", "right"),
    )  # fmt: skip
    return RecordingContent(episode, frames, {"stage2": frames}, tracks, episode.state_names or ())


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


def test_heat_is_transparent_where_nothing_is() -> None:
    layer = heat_layer(
        np.array([[10.0, 10.0], [30.0, 20.0]]), np.array([True, False]), HEIGHT, WIDTH, ("left", "right")
    )
    assert layer[10, 10, 3] > 150
    assert layer[20, 30, 3] == 0


def test_mcap_holds_images_calibration_and_transforms(content: RecordingContent, tmp_path: Path) -> None:
    (path,) = write_mcap_recordings(content, tmp_path, "episode")
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
    (again,) = write_mcap_recordings(content, tmp_path, "again")
    assert again.read_bytes() == path.read_bytes()


class _Rollouts:
    method = "stage2"
    episode_ids = ("robot/1",)


def test_unknown_formats_and_episodes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"(?s)Unknown export format.*gif"):
        export_rollout(_Rollouts(), None, None, "robot/1", tmp_path, ("gif",))  # type: ignore[arg-type]
    with pytest.raises(DataError, match=r"(?s)No prediction of this episode.*robot/2"):
        export_rollout(_Rollouts(), None, None, "robot/2", tmp_path, ("mp4",))  # type: ignore[arg-type]


def test_file_names_are_safe() -> None:
    assert safe_stem("a/b c:../d") == "a_b_c____d"
