"""MCAP files of our own come back; recordings of distorting lenses become those of pinholes, in images, masks and K."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from mcap_ros2.reader import read_ros2_messages
from scipy.spatial.transform import Rotation

from tests.data.conftest import make_sample
from tests.data.curating import rejected, run
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.episodes.source import LoadedEpisode
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.mcap import exported
from worldline_core.data.mcap.exported import Encoding, read_exported_episode, write_episode_mcap, write_rollout_mcap
from worldline_core.data.mcap.file import McapFile
from worldline_core.data.sources.open import undistorted
from worldline_core.errors import DataError
from worldline_core.geometry.lens import Distortion


def tools() -> np.ndarray:
    """(9, 2, 4, 4) poses with rotations all over SO(3), half turns among them."""
    rng = np.random.default_rng(3)
    poses = np.tile(np.eye(4), (18, 1, 1))
    poses[:, :3, :3] = Rotation.random(18, random_state=3).as_matrix()
    poses[:2, :3, :3] = np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, -1.0, 1.0])
    poses[:, :3, 3] = rng.normal(size=(18, 3))
    return poses.reshape(9, 2, 4, 4)


def decoded(image: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]  # pyright: ignore[reportOptionalSubscript]


@pytest.mark.parametrize("encoding", ["protobuf", "ros2"])
def test_an_episode_comes_back_as_it_was(tmp_path: Path, encoding: Encoding) -> None:
    gripper = np.linspace(0, 1, 18).reshape(9, 2)
    episode, frames, masks = make_sample(0, T_base_ee=tools(), gripper=gripper, conventions={"layout": "x", "n": 3})
    for name in ("a.mcap", "b.mcap"):
        write_episode_mcap(tmp_path / name, episode, frames, robot_masks=masks, encoding=encoding)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    read = read_exported_episode(McapFile(tmp_path / "a.mcap"))
    for view, images in frames.items():
        assert np.array_equal(read.frames(view), images)  # png is exact
        assert np.array_equal(read.robot_masks(view), masks[view])  # pyright: ignore[reportArgumentType]
        found, expected = read.episode.cameras[view], episode.cameras[view]
        assert np.abs(found.K - expected.K).max() < 1e-9
        assert found.moving == expected.moving
        assert np.abs(found.T_base_camera - expected.T_base_camera).max() < 1e-9
    assert np.abs(read.episode.timestamps - episode.timestamps).max() <= 1e-9
    assert np.array_equal(read.episode.state, episode.state)
    assert np.array_equal(read.episode.action, episode.action)
    assert read.episode.T_base_ee is not None
    assert np.abs(read.episode.T_base_ee - episode.T_base_ee).max() < 1e-9
    assert np.array_equal(read.episode.gripper, gripper)  # pyright: ignore[reportArgumentType]
    for name in ("episode_id", "scene", "instruction", "outcome", "split", "fps", "state_names", "conventions", "bank"):
        assert getattr(read.episode, name) == getattr(episode, name)


def test_ros_2_decoders_read_the_export(tmp_path: Path) -> None:
    """Read by the decoder of mcap-ros2-support alone; `fixed` is a camera that stays."""
    episode, frames, masks = make_sample(0, T_base_ee=tools(), gripper=np.zeros((9, 2)))
    fixed = replace(episode.cameras["head"], T_base_camera=episode.cameras["head"].T_base_camera[:1])
    episode = replace(episode, cameras={**episode.cameras, "head": fixed})
    write_episode_mcap(tmp_path / "a.mcap", episode, frames, masks, encoding="ros2")
    found: dict[str, list] = {}
    schemas = {}
    for message in read_ros2_messages(str(tmp_path / "a.mcap")):
        found.setdefault(message.channel.topic, []).append(message.ros_msg)
        schemas[message.channel.topic] = message.schema.name
    images = {f"/{view}/{kind}" for view in frames for kind in ("image", "robot_mask")}
    assert schemas == {
        **dict.fromkeys(images, "sensor_msgs/msg/CompressedImage"),
        **{f"/{view}/calibration": "sensor_msgs/msg/CameraInfo" for view in frames},
        **dict.fromkeys(("/tf", "/tf_static"), "tf2_msgs/msg/TFMessage"),
        **dict.fromkeys(("/joint_states", "/joint_commands"), "sensor_msgs/msg/JointState"),
    }
    for number, (states, image) in enumerate(zip(found["/joint_states"], found["/head/image"], strict=True)):
        assert states.name == list(episode.state_names)
        assert np.array_equal(np.float32(states.position), episode.state[number])
        assert (image.format, image.header.frame_id) == ("png", "head_camera")
        assert image.header.stamp.sec + 1e-9 * image.header.stamp.nanosec == pytest.approx(episode.timestamps[number])
        assert np.array_equal(decoded(image.data), frames["head"][number])
    (info,), (static,) = found["/head/calibration"], found["/tf_static"]
    assert (info.height, info.width) == frames["head"].shape[1:3]
    assert np.array_equal(np.reshape(info.k, (3, 3)), fixed.K)
    assert np.array_equal(np.reshape(info.p, (3, 4))[:, :3], fixed.K)
    (transform,) = static.transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("base", "head_camera")
    place, turn = transform.transform.translation, transform.transform.rotation
    assert np.allclose([place.x, place.y, place.z], fixed.T_base_camera[0, :3, 3])
    assert np.allclose(Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix(), fixed.T_base_camera[0, :3, :3])


def test_protobuf_decoders_read_the_export(tmp_path: Path) -> None:
    """Read by the decoder of mcap-protobuf-support, and by the classes that Foxglove publishes."""
    episode, frames, _ = make_sample(0, T_base_ee=tools(), gripper=np.zeros((9, 2)))
    write_episode_mcap(tmp_path / "a.mcap", episode, frames)
    found: dict[str, list] = {}
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, message, content in reader.iter_decoded_messages():
            name = schema.name.removeprefix("foxglove.")
            published = getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)
            assert published.FromString(message.data).SerializeToString() == message.data
            found.setdefault(channel.topic, []).append(content)
    assert [joint.name for joint in found["/joint_states"][3].joints] == list(episode.state_names)
    assert np.array_equal(np.float32([j.position for j in found["/joint_states"][3].joints]), episode.state[3])  # pyright: ignore[reportArgumentType]
    assert np.array_equal(np.reshape(found["/head/calibration"][0].K, (3, 3)), episode.cameras["head"].K)
    assert found["/head/image"][2].timestamp.ToNanoseconds() == round(episode.timestamps[2] * 1e9)
    assert np.array_equal(decoded(found["/head/image"][2].data), frames["head"][2])
    tool = next(each for each in found["/tf"] if each.child_frame_id == "right_tool")
    assert np.allclose([tool.translation.x, tool.translation.y, tool.translation.z], tools()[0, 1, :3, 3])


def test_a_rollout_is_exported(tmp_path: Path) -> None:
    episode, frames, _ = make_sample(0)
    about = {"metadata": {"method": "stage2", "seed": "42"}, "cameras": episode.cameras, "T_base_ee": tools()}
    write_rollout_mcap(tmp_path / "a.mcap", frames, 8.0, **about)  # type: ignore[arg-type]
    with (tmp_path / "a.mcap").open("rb") as stream:
        messages = list(make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    read = np.stack([decoded(m.data) for _, channel, _, m in messages if channel.topic == "/head/image"])
    assert 0 < np.abs(read.astype(int) - frames["head"]).mean() < 4
    with pytest.raises(DataError, match="no episode of a known layout"):
        read_exported_episode(McapFile(tmp_path / "a.mcap"))
    with pytest.raises(DataError, match="differ in length"):
        write_rollout_mcap(tmp_path / "c.mcap", {"head": frames["head"], "left_wrist": frames["left_wrist"][:3]}, 8.0)


HEIGHT, WIDTH = 120, 160
K = np.array([[95.0, 0.0, 80.3], [0.0, 97.0, 58.9], [0.0, 0.0, 1.0]])
LENSES = {
    "plumb_bob": Distortion("radtan", (-0.25, 0.06, 0.001, -0.002, 0.003)),
    "rational_polynomial": Distortion("radtan", (5.2, 3.1, 0.0003, -0.0002, 0.2, 5.5, 4.6, 0.9)),
    "kannala_brandt": Distortion("fisheye", (0.02, -0.01, 0.003, -0.001)),
}


def scene(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Picture at depth 1: smooth colours, float (..., 3) in 0..255."""
    return 127 + 90 * np.stack([np.sin(6 * x + 1), np.cos(5 * y), np.sin(4 * x + 3 * y)], axis=-1)


def disc(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return (x - 0.45) ** 2 + (y - 0.3) ** 2 < 0.2**2


def seen_through(lens: Distortion | None, camera: CameraTrack) -> tuple[np.ndarray, np.ndarray]:
    """Rays' (x, y) of every pixel, by OpenCV's own inverse."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float64)
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-12)
    if lens is None:
        found = cv2.undistortPoints(pixels, camera.K, np.zeros(5))
    elif lens.model == "fisheye":
        found = cv2.fisheye.undistortPoints(pixels, camera.K, np.array(lens.coefficients), criteria=criteria)
    else:
        found = cv2.undistortPointsIter(pixels, camera.K, np.array(lens.coefficients), None, None, criteria)  # type: ignore[call-overload]
    x, y = found.reshape(camera.height, camera.width, 2).transpose(2, 0, 1)
    return x, y


def distorted_sample(lens: Distortion | None) -> tuple:
    """The sample episode whose head camera looks at the scene through the lens."""
    episode, frames, masks = make_sample(0, height=HEIGHT, width=WIDTH)
    head = replace(episode.cameras["head"], K=K)
    x, y = seen_through(lens, head)
    frames["head"] = np.repeat(scene(x, y).round().astype(np.uint8)[None], len(frames["head"]), axis=0)
    masks["head"] = np.repeat(disc(x, y)[None], len(masks["head"]), axis=0)
    return replace(episode, cameras={**episode.cameras, "head": head}), frames, masks


def write_mcap_of_lens(path: Path, episode: Episode, *content: Any, lens: Distortion | dict[str, Any]) -> None:
    """A file whose head camera states a lens; this project's own recordings have none."""
    stated: Any = lens
    if isinstance(lens, Distortion):
        names = {"radtan": "plumb_bob", "fisheye": "kannala_brandt"}
        model = "rational_polynomial" if len(lens.coefficients) > 5 else names[lens.model]
        stated = {"distortion_model": model, "D": list(lens.coefficients)}
    of_pinhole = exported._calibration
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exported, "_calibration", lambda c: of_pinhole(c) | (stated if c.view == "head" else {}))
        exported.write_episode_mcap(path, episode, *content)


def curated_mcap(tmp_path: Path, **changes: Any) -> EpisodeSet:
    source = {"kind": "mcap", "path": str(tmp_path / "mcap")}
    return run(tmp_path, source, **{"image_size": (60, 80), "video_crf": 0, **changes})[1]


def off_from_scene(curated: EpisodeSet) -> float:
    """Mean difference of the curated head image from the scene through its curated K, as a pinhole."""
    camera = curated.episode(0).cameras["head"]
    expected = scene(*seen_through(None, camera))
    return float(np.abs(curated.frames(0, "head")[4] - expected).mean())


@pytest.mark.parametrize("model", LENSES)
def test_a_distorted_mcap_is_curated_into_a_pinhole_recording(tmp_path: Path, model: str) -> None:
    lens = LENSES[model]
    episode, frames, masks = distorted_sample(lens)
    path = tmp_path / "mcap" / "0.mcap"
    write_mcap_of_lens(path, episode, frames, masks, lens=lens)
    assert read_exported_episode(McapFile(path)).distortions == {"head": lens}
    curated = curated_mcap(tmp_path)
    read = curated.episode(0)
    assert off_from_scene(curated) < 1.5
    assert read.conventions["undistorted"] == f"head: {lens.model} {list(lens.coefficients)}"
    mask = curated.robot_masks(0, "head")
    assert mask is not None
    expected = disc(*seen_through(None, read.cameras["head"]))
    assert np.logical_xor(np.asarray(mask)[4], expected).sum() <= 0.1 * expected.sum()
    # The other views had no lens and stay what they were.
    assert np.allclose(read.cameras["left_wrist"].K, episode.cameras["left_wrist"].resized(80, 60).K)


@pytest.mark.parametrize("fit", ["stretch", "letterbox", "crop"])
def test_undistortion_and_every_fit_agree_with_k(tmp_path: Path, fit: str) -> None:
    lens = LENSES["plumb_bob"]
    episode, frames, masks = distorted_sample(lens)
    path = tmp_path / "mcap" / "0.mcap"
    write_mcap_of_lens(path, episode, frames, masks, lens=lens)
    curated = curated_mcap(tmp_path, image_size=(64, 64), fit=fit)
    camera = curated.episode(0).cameras["head"]
    image = curated.frames(0, "head")[4].astype(float)
    expected = scene(*seen_through(None, camera))
    rows = slice(9, 55) if fit == "letterbox" else slice(0, 64)  # 64 x 48 between black bars
    assert np.abs(image[rows] - expected[rows]).mean() < 1.5
    assert fit != "letterbox" or max(image[:7].max(), image[57:].max()) < 10
    whole, _ = cv2.getOptimalNewCameraMatrix(K, np.array(lens.coefficients), (WIDTH, HEIGHT), 0)
    ratio = whole[0, 0] / whole[1, 1] * (0.75 if fit == "stretch" else 1.0)
    assert camera.K[0, 0] / camera.K[1, 1] == pytest.approx(ratio, rel=0.02)


def test_unusable_lenses_are_quarantined_with_their_numbers(tmp_path: Path) -> None:
    episode, frames, _ = distorted_sample(None)
    folds = Distortion("radtan", (-0.9, 0.1, 0.0, 0.0))
    write_episode_mcap(tmp_path / "mcap" / "0.mcap", episode, frames)
    second = replace(episode, episode_id="folds", state=episode.state + 0.01)
    write_mcap_of_lens(tmp_path / "mcap" / "1.mcap", second, frames, lens=folds)
    third = replace(episode, episode_id="unknown", state=episode.state + 0.02)
    path = tmp_path / "mcap" / "2.mcap"
    write_mcap_of_lens(path, third, frames, lens={"distortion_model": "double_sphere", "D": [0.1]})
    curated = curated_mcap(tmp_path)
    assert [row.episode_id for row in curated.rows] == [episode.episode_id]
    rows = {row.episode_id: row for row in curated.quarantine()}
    assert {row.reason for row in rows.values()} == {"invalid_distortion"}
    assert rows["folds"].numbers == {"view": "head", "model": "radtan", "coefficients": [-0.9, 0.1, 0.0, 0.0]}
    assert "folds back" in rows["folds"].detail
    assert "double_sphere" in rows["unknown"].detail


def loaded(**changes: Any) -> LoadedEpisode:
    episode, frames, masks = distorted_sample(LENSES["plumb_bob"])
    values = {"distortions": {"head": LENSES["plumb_bob"]}, **changes}
    episode = replace(episode, cameras=values.pop("cameras", episode.cameras))
    return LoadedEpisode(episode, tuple(frames), frames.__getitem__, masks.get, **values)


def test_a_lens_needs_a_camera_matrix_of_the_images_own_size() -> None:
    with pytest.raises(RejectedInputError, match=r"lens is stated for a view without a camera matrix[\s\S]*view top"):
        undistorted(loaded(distortions={"top": LENSES["plumb_bob"]}))
    episode = distorted_sample(None)[0]
    smaller = episode.cameras["head"].resized(80, 60)
    wrong = undistorted(loaded(cameras={**episode.cameras, "head": smaller}))
    with pytest.raises(RejectedInputError, match=r"another size than their lens[\s\S]*60x80[\s\S]*120x160"):
        wrong.frames("head")
    singular = replace(episode.cameras["head"], K=np.diag([95.0, 0.0, 1.0]))
    with rejected("singular_intrinsics", "cannot be inverted"):
        undistorted(loaded(cameras={**episode.cameras, "head": singular}))
    untouched = loaded(distortions={})
    assert undistorted(untouched) is untouched
