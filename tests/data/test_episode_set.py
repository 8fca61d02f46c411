from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.data.conftest import make_sample
from tests.data.curating import files_of
from worldline_core.data.episodes.episode import ARRAYS, EpisodeDescription
from worldline_core.data.episodes.episode_index import read_index, write_index
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.data.episodes.episode_set_writer import part_name
from worldline_core.data.episodes.sidecar import Sidecar
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.video.frames import packed_images, unpacked_images
from worldline_core.errors import DataError


def write(root: Path, samples: list[tuple]) -> EpisodeSet:
    with EpisodeSetWriter(root, video_crf=10) as writer:
        for episode, frames, masks in samples:
            writer.add(episode, frames, masks)
        writer.quarantine("broken", "synthetic", "nan_state", "state is not finite", {"frame": 3})
    return EpisodeSet.open(root)


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    samples = [make_sample(number) for number in range(3)]
    stored = write(tmp_path / "set", samples)
    assert len(stored) == 3
    for i, (episode, frames, masks) in enumerate(samples):
        read = stored.episode(i)
        assert np.array_equal(read.state, episode.state)
        assert np.array_equal(read.action, episode.action)
        assert np.abs(read.timestamps - episode.timestamps).max() < 1e-12
        for name in ("episode_id", "source", "embodiment", "scene", "task_family", "instruction", "outcome", "split"):
            assert getattr(read, name) == getattr(episode, name)
        assert read.state_names == episode.state_names
        for view, camera in episode.cameras.items():
            assert np.array_equal(read.cameras[view].K, camera.K)
            assert np.array_equal(read.cameras[view].T_base_camera, camera.T_base_camera)
            assert np.abs(stored.frames(i, view).astype(int) - frames[view]).mean() < 6
            mask = stored.robot_masks(i, view)
            assert mask is not None
            assert np.array_equal(mask, masks[view])
    assert np.array_equal(stored.frames(1, "head", [7, 0]), stored.frames(1, "head")[[7, 0]])
    (rejected,) = stored.quarantine()
    assert (rejected.episode_id, rejected.reason, rejected.numbers) == ("broken", "nan_state", {"frame": 3})


def test_bytes_depend_on_the_episodes_alone(tmp_path: Path) -> None:
    samples = [make_sample(number) for number in range(3)]
    write(tmp_path / "a", samples)
    write(tmp_path / "b", samples[::-1])
    assert files_of(tmp_path / "a") == files_of(tmp_path / "b")
    write(tmp_path / "c", [make_sample(0), make_sample(1), make_sample(7)])
    assert files_of(tmp_path / "a") != files_of(tmp_path / "c")


def test_a_killed_writer_continues_to_the_same_bytes(tmp_path: Path) -> None:
    samples = [make_sample(number) for number in range(3)]
    write(tmp_path / "undisturbed", samples)
    EpisodeSetWriter(tmp_path / "killed", video_crf=10).add(*samples[1])
    parts = tmp_path / "killed/run/episodes/parts"
    (parts / ".abc.1").mkdir()
    (parts / ".abc.1/head.mp4").write_bytes(b"half")
    again = EpisodeSetWriter(tmp_path / "killed", video_crf=10)
    assert again.has("episode-001")
    assert not again.has("episode-000")
    # The work of a container with the same process ids is left alone.
    others = parts / f".{part_name('episode-000')}.{os.getpid()}"
    others.mkdir()
    again.add(*samples[0])
    assert others.is_dir()
    write(tmp_path / "killed", [samples[2]])
    assert files_of(tmp_path / "killed") == files_of(tmp_path / "undisturbed")
    with pytest.raises(DataError, match="already holds a finished EpisodeSet"):
        EpisodeSetWriter(tmp_path / "killed")


def test_segments_cut_every_array(tmp_path: Path) -> None:
    samples = [make_sample(number) for number in range(2)]
    stored = write(tmp_path / "curated", samples)
    linked = {"start": 2, "stop": 7, "num_frames": 5, "video_frames": 5, "dataset": "../curated/datasets/ur5e_pair"}
    write_index(tmp_path / "filtered", [replace(stored.rows[1], **linked)])
    segment = EpisodeSet.open(tmp_path / "filtered")
    episode = segment.episode(0)
    assert episode.num_frames == 5
    assert np.array_equal(episode.state, samples[1][0].state[2:7])
    assert episode.timestamps[0] == 0
    wrist = samples[1][0].cameras["left_wrist"].T_base_camera
    assert np.array_equal(episode.cameras["left_wrist"].T_base_camera, wrist[2:7])
    assert np.array_equal(segment.frames(0, "head"), stored.frames(1, "head")[2:7])
    assert np.array_equal(segment.frames(0, "head", [4]), stored.frames(1, "head")[6:7])
    mask = segment.robot_masks(0, "head")
    assert mask is not None
    assert np.array_equal(mask, samples[1][2]["head"][2:7])
    with pytest.raises(DataError, match="outside of the episode"):
        segment.frames(0, "head", [5])
    (tmp_path / "elsewhere").mkdir()
    for name in ("curated", "filtered"):  # both together may be moved
        shutil.move(tmp_path / name, tmp_path / "elsewhere" / name)
    assert EpisodeSet.open(tmp_path / "elsewhere/filtered").frames(0, "head").shape == (5, 32, 48, 3)


def test_foreign_index_rows_cannot_leave_the_folder(tmp_path: Path) -> None:
    write(tmp_path / "set", [make_sample(0)])
    rows = read_index(tmp_path / "set")
    for path, message in (("../../etc", "outside of the dataset folder"), (os.fspath(tmp_path), "absolute path")):
        write_index(tmp_path / "set", [replace(rows[0], dataset=path)])
        with pytest.raises(DataError, match=message):
            EpisodeSet.open(tmp_path / "set", allow_linked=False).episode(0)


def test_states_without_images_are_kept_and_the_record_is_stored_whole(tmp_path: Path) -> None:
    """Every field that the record declares comes back; a field that is added to it is stored without another line."""
    poses = np.tile(np.eye(4), (9, 2, 1, 1))
    poses[:, :, 0, 3] = np.arange(18).reshape(9, 2) / 7
    episode, frames, _ = make_sample(
        0, T_base_ee=poses, gripper=np.linspace(0, 1, 18).reshape(9, 2), video_frames=4, bank="b", candidate=3,
        primary_view="left_wrist", conventions={"layout": "x", "n": 3},
    )  # fmt: skip
    with EpisodeSetWriter(tmp_path / "set", video_crf=10) as writer:
        writer.add(episode, {view: images[:4] for view, images in frames.items()})
    stored = EpisodeSet.open(tmp_path / "set")
    read = stored.episode(0)
    assert (read.num_frames, read.video_frames, stored.rows[0].video_frames) == (9, 4, 4)
    assert read.described() == episode.described()
    assert set(ARRAYS) == {"state", "action", "T_base_ee", "gripper"} == set(read.arrays())
    for name, values in episode.arrays().items():
        assert getattr(read, name).dtype == ARRAYS[name].dtype
        assert np.array_equal(getattr(read, name), values)
    assert stored.frames(0, "head").shape[0] == 4
    with pytest.raises(DataError, match="0 <= index < 4"):
        stored.frames(0, "head", [4])


def test_different_robots_get_datasets_of_their_own(tmp_path: Path) -> None:
    with EpisodeSetWriter(tmp_path / "set") as writer:
        writer.add(*make_sample(0))
        writer.add(*make_sample(1, embodiment="xarm7_pair"))
        writer.add(*make_sample(2, views=("head", "right_wrist")))
    stored = EpisodeSet.open(tmp_path / "set")
    assert [row.dataset for row in stored.rows] == ["datasets/ur5e_pair", "datasets/xarm7_pair", "datasets/ur5e_pair_2"]
    assert stored.rows[2].views == ("head", "right_wrist")
    assert stored.select(split=["train", "test"]) == [0, 1, 2]
    assert stored.select(split="test") == []
    with pytest.raises(DataError, match=r"(?s)no such view.*head, right_wrist.*left_wrist"):
        stored.frames(2, "left_wrist")
    with pytest.raises(DataError, match="No such episode"):
        stored.position("absent")


def test_labels_of_more_than_a_gigabyte_are_read_image_by_image(tmp_path: Path) -> None:
    """Eight images are written of the 4000 that the table declares: going on beyond them is what is refused."""
    episode, frames, masks = make_sample(0)
    with EpisodeSetWriter(tmp_path / "set") as writer:
        writer.add(episode, frames, masks, thing_labels={"head": masks["head"].astype(np.uint8)})
    (path,) = tmp_path.rglob("thing_labels.parquet")
    labels = np.full((8, 480, 640), 3, np.uint8)
    row = pq.read_table(path).to_pylist()[0] | {
        "shape": [4000, 480, 640],
        "bits": packed_images(labels, np.uint8, 1).tobytes(),
    }
    pq.write_table(pa.Table.from_pylist([row], schema=pq.read_schema(path)), path)
    read = Sidecar(path.parents[2]).things(row["episode_index"], "head")
    assert read.shape == (4000, 480, 640)
    images = iter(read)
    assert all(np.array_equal(next(images), image) for image in labels)
    with pytest.raises(RejectedInputError, match="from image 8 on"):
        next(images)


def test_what_does_not_belong_together_is_refused(tmp_path: Path) -> None:
    writer = EpisodeSetWriter(tmp_path / "set")
    episode, frames, masks = make_sample(0)
    short = masks["head"][:4]
    smaller = replace(episode, cameras={**episode.cameras, "head": episode.cameras["head"].resized(96, 64)})
    for given, message in (
        ((episode, {**frames, "head": frames["head"][:8]}), r"(?s)differ in length.*expected: 9.*got: 8"),
        ((episode, {view: images[..., :2] for view, images in frames.items()}), "wrong size"),
        ((episode, frames, {"head": short}), "Robot masks do not match"),
        ((episode, frames, masks, None, {"head": short.astype(np.uint8)}), "Labels of things do not match"),
        ((smaller, frames), "another image size"),
    ):
        with pytest.raises(DataError, match=message):
            writer.add(*given)
    with pytest.raises(DataError, match="Action and state differ"):
        replace(episode, action=episode.action[:4])
    with pytest.raises(DataError, match="Unknown outcome"):
        replace(episode, outcome="maybe")
    with pytest.raises(DataError, match="No episode was kept"):
        writer.close()


@pytest.mark.parametrize(
    ("field", "value"), [("scene", 3), ("fps", "fast"), ("state_names", "left"), ("candidate", "one")]
)
def test_a_description_of_another_type_is_refused(field: str, value: object) -> None:
    described = make_sample(0)[0].described()
    assert EpisodeDescription.arguments(described)["state_names"] == make_sample(0)[0].state_names
    with pytest.raises(ValueError, match=field):
        EpisodeDescription.arguments({**described, field: value})


def test_masks_of_other_bytes_are_refused_while_they_are_read() -> None:
    packed = packed_images(np.ones((20, 5, 7), bool), bool, 9).tobytes()
    assert all(mask.all() for mask in unpacked_images(packed, (20, 5, 7), bool, "here"))
    for count, content in ((19, packed), (21, packed), (20, packed[:-9]), (20, b"none"), (20, b"")):
        with pytest.raises(RejectedInputError, match=r"(?s)Content has another shape.*here.*packed bits"):
            list(unpacked_images(content, (count, 5, 7), bool, "here"))
