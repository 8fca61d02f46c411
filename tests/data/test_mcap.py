from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from mcap_ros2.reader import read_ros2_messages
from scipy.spatial.transform import Rotation

from worldline_core.data.mcap.exported import Encoding, read_exported_episode, write_episode_mcap, write_rollout_mcap
from worldline_core.data.mcap.file import McapFile
from worldline_core.errors import DataError

Make = Callable[..., tuple]


def tools() -> np.ndarray:
    """(9, 2, 4, 4) poses with rotations all over SO(3), half turns among them."""
    rng = np.random.default_rng(3)
    q, _ = np.linalg.qr(rng.normal(size=(18, 3, 3)))
    q[:, :, 0] *= np.linalg.det(q)[:, None]
    poses = np.tile(np.eye(4), (18, 1, 1))
    poses[:, :3, :3] = q
    poses[0, :3, :3] = np.diag([1.0, -1.0, -1.0])
    poses[1, :3, :3] = np.diag([-1.0, -1.0, 1.0])
    poses[:, :3, 3] = rng.normal(size=(18, 3))
    return poses.reshape(9, 2, 4, 4)


@pytest.mark.parametrize("encoding", ["protobuf", "ros2"])
def test_an_episode_comes_back_as_it_was(tmp_path: Path, sample: Make, encoding: Encoding) -> None:
    gripper = np.linspace(0, 1, 18).reshape(9, 2)
    episode, frames, masks = sample(0, T_base_ee=tools(), gripper=gripper, conventions={"layout": "x", "n": 3})
    for name in ("a.mcap", "b.mcap"):
        write_episode_mcap(tmp_path / name, episode, frames, robot_masks=masks, encoding=encoding)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    read = read_exported_episode(McapFile(tmp_path / "a.mcap"))
    for view, images in frames.items():
        assert np.array_equal(read.frames(view), images)  # png is exact
        assert np.array_equal(read.robot_masks(view), masks[view])  # pyright: ignore[reportArgumentType]
        assert np.abs(read.episode.cameras[view].K - episode.cameras[view].K).max() < 1e-9
        assert read.episode.cameras[view].moving == episode.cameras[view].moving
        assert np.abs(read.episode.cameras[view].T_base_camera - episode.cameras[view].T_base_camera).max() < 1e-9
    assert np.abs(read.episode.timestamps - episode.timestamps).max() <= 1e-9
    assert np.array_equal(read.episode.state, episode.state)
    assert np.array_equal(read.episode.action, episode.action)
    assert read.episode.T_base_ee is not None
    assert np.abs(read.episode.T_base_ee - episode.T_base_ee).max() < 1e-9
    assert np.array_equal(read.episode.gripper, gripper)  # pyright: ignore[reportArgumentType]
    for name in ("episode_id", "scene", "instruction", "outcome", "split", "fps", "state_names", "conventions", "bank"):
        assert getattr(read.episode, name) == getattr(episode, name)


def test_ros_2_decoders_read_the_export(tmp_path: Path, sample: Make) -> None:
    """Read by the decoder of mcap-ros2-support alone; `fixed` is a camera that stays."""
    episode, frames, masks = sample(0, T_base_ee=tools(), gripper=np.zeros((9, 2)))
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
        decoded = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR)
        assert np.array_equal(decoded[..., ::-1], frames["head"][number])  # pyright: ignore[reportOptionalSubscript]
    (info,), (static,) = found["/head/calibration"], found["/tf_static"]
    assert (info.height, info.width) == frames["head"].shape[1:3]
    assert np.array_equal(np.reshape(info.k, (3, 3)), fixed.K)
    assert np.array_equal(np.reshape(info.p, (3, 4))[:, :3], fixed.K)
    (transform,) = static.transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("base", "head_camera")
    place, turn = transform.transform.translation, transform.transform.rotation
    assert np.allclose([place.x, place.y, place.z], fixed.T_base_camera[0, :3, 3])
    assert np.allclose(Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix(), fixed.T_base_camera[0, :3, :3])


def test_protobuf_decoders_read_the_export(tmp_path: Path, sample: Make) -> None:
    """Read by the decoder of mcap-protobuf-support, and by the classes that Foxglove publishes."""
    episode, frames, _ = sample(0, T_base_ee=tools(), gripper=np.zeros((9, 2)))
    write_episode_mcap(tmp_path / "a.mcap", episode, frames)
    found: dict[str, list] = {}
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            name = schema.name.removeprefix("foxglove.")
            published = getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)
            assert published.FromString(message.data).SerializeToString() == message.data
            found.setdefault(channel.topic, []).append(decoded)
    assert [joint.name for joint in found["/joint_states"][3].joints] == list(episode.state_names)
    assert np.array_equal(np.float32([j.position for j in found["/joint_states"][3].joints]), episode.state[3])  # pyright: ignore[reportArgumentType]
    assert np.array_equal(np.reshape(found["/head/calibration"][0].K, (3, 3)), episode.cameras["head"].K)
    assert found["/head/image"][2].timestamp.ToNanoseconds() == round(episode.timestamps[2] * 1e9)
    decoded = cv2.imdecode(np.frombuffer(found["/head/image"][2].data, np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(decoded[..., ::-1], frames["head"][2])  # pyright: ignore[reportOptionalSubscript]
    (tool,) = [
        each for each in found["/tf"] if each.child_frame_id == "right_tool" and each.timestamp.ToNanoseconds() == 0
    ]
    assert np.allclose([tool.translation.x, tool.translation.y, tool.translation.z], tools()[0, 1, :3, 3])


def test_a_rollout_is_exported(tmp_path: Path, sample: Make) -> None:
    episode, frames, _ = sample(0)
    for name in ("a.mcap", "b.mcap"):
        write_rollout_mcap(
            tmp_path / name,
            frames,
            8.0,
            metadata={"method": "stage2", "seed": "42"},
            cameras=episode.cameras,
            T_base_ee=tools(),
        )
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    with (tmp_path / "a.mcap").open("rb") as stream:
        messages = list(make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    counts = Counter(channel.topic for _, channel, *_ in messages)
    assert counts["/head/image"] == 9
    assert counts["/tf"] == 9 * 2 + 1 + 2 * 9  # tools, the fixed head camera, two moving wrist cameras
    encoded = [np.frombuffer(m.data, np.uint8) for _, channel, _, m in messages if channel.topic == "/head/image"]
    read = np.stack([cv2.imdecode(image, cv2.IMREAD_COLOR)[..., ::-1] for image in encoded])  # pyright: ignore
    assert 0 < np.abs(read.astype(int) - frames["head"]).mean() < 4
    with pytest.raises(DataError, match="no episode of a known layout"):
        read_exported_episode(McapFile(tmp_path / "a.mcap"))
    with pytest.raises(DataError, match="differ in length"):
        write_rollout_mcap(tmp_path / "c.mcap", {"head": frames["head"], "left_wrist": frames["left_wrist"][:3]}, 8.0)
