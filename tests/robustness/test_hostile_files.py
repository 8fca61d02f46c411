"""Files of others that claim too much, break off or are something else; and sound ones that look unusual."""

from __future__ import annotations

import io
import json
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

h5py = pytest.importorskip("h5py", reason="the extra `hdf5` is not installed")

from tests.data.curating import rejected
from tools.corrupted.attacks import ATTACKS, Attack, ending, jpeg_of_scans
from worldline_core.data.episodes.source import GripperRange
from worldline_core.data.guards.plain_files import (
    decode_image,
    image_size,
    read_image,
    read_json,
    read_json_lines,
    read_npy,
    read_table,
)
from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.lerobot.dataset import numeric_column
from worldline_core.data.sources.hdf5 import ArmPlace, Columns, open_hdf5
from worldline_core.data.video.clip import VideoClip, read_clip

PICTURE = np.random.default_rng(0).integers(0, 255, (30, 50, 3), dtype=np.uint8)


HEAVY = (
    "a heap without end", "a chunk of 2 GB in a frame of 8 MB", "3 * 10^8 equal rows",
)  # fmt: skip
"""Attacks of the same kinds as others here, which take seconds to run out of memory."""


@pytest.mark.parametrize(
    "attack",
    [
        pytest.param(attack, id=f"{attack.layout}: {attack.name}", marks=[pytest.mark.slow] * (attack.name in HEAVY))
        for attack in ATTACKS
    ],
)
def test_an_attack_ends_in_time_in_a_recording_or_its_true_reason(
    layouts: dict[str, dict[str, Any]], tmp_path: Path, attack: Attack
) -> None:
    assert ending(attack, layouts[attack.layout], tmp_path / "attacked") in attack.endings


def encoded(kind: str, **settings: object) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(PICTURE).save(stream, kind, **settings)
    return stream.getvalue()


def array(path: Path) -> object:
    return read_npy(path, (None,))


PNG, JPEG = encoded("PNG"), encoded("JPEG", quality=95)
DAMAGED = {
    array: [
        (b"", "where"),
        (b"PK\x03\x04", "where"),
        (b"\x93NUMPY\x01\x00\xff\xff{", "where"),
        (b"\x93NUMPY\x09\x00", "where"),
        (b"\x93NUMPY\x01\x00\x10\x00" + b"(" * 16, "where"),
        (b"\x93NUMPY\x01\x00\x76\x00{'descr': '<f8', 'fortran_order': False, 'shape': (8,), }".ljust(128) + bytes(63), "where"),
    ],
    read_json: [
        (b'{"a": 1, "a": 2}', "'a' is given twice"),
        (b"[" * 500_000, "recursion"),
        (b'{"a":' * 500_000, "recursion"),
        (b"[" + b"9" * 5_000 + b"]", "4300"),
        (b'{"a": "\xff\xfe"}', "0xff"),
        (b'{"a": 1', "char 7"),
        (b"", "char 0"),
    ],
    read_image: [
        (content, "where")
        for content in (
            b"", b"GIF89a", b"\xff\xd8\xff", JPEG[:20], b"\xff\xd8\xff" + b"\xff" * 99,
            *(image[: int(len(image) * share)] for image in (PNG, JPEG) for share in (0.3, 0.6, 0.95)),
        )
    ],
}  # fmt: skip


@pytest.mark.parametrize(("read", "content", "what"), [(r, *case) for r, cases in DAMAGED.items() for case in cases])
def test_damage_is_unreadable(tmp_path: Path, read: Callable[[Path], object], content: bytes, what: str) -> None:
    (tmp_path / "b.file").write_bytes(content)
    with rejected("unreadable", rf"(?s)(?=.*b\.file).*{what}"):
        read(tmp_path / "b.file")


def test_an_array_of_objects_is_not_unpickled(tmp_path: Path) -> None:
    class Harm:
        def __reduce__(self) -> tuple[object, ...]:
            return Path.touch, (tmp_path / "harmed",)

    np.save(tmp_path / "a.npy", np.array([Harm()], dtype=object), allow_pickle=True)
    with pytest.raises(RejectedInputError, match=r"a\.npy"):
        read_npy(tmp_path / "a.npy", (None,))
    assert not (tmp_path / "harmed").exists()
    np.load(tmp_path / "a.npy", allow_pickle=True)
    assert (tmp_path / "harmed").exists(), "the file would do harm if it were unpickled"


def test_tables_come_whole_or_by_column(tmp_path: Path) -> None:
    table = pa.table({"a": [1, 2, 3], "b": ["x", None, "z"], "c": [[1.0], [2.0], [3.0]], "d": [["p"], [], ["q", "r"]]})
    pq.write_table(table, tmp_path / "t.parquet", row_group_size=2)
    assert read_table(tmp_path / "t.parquet").equals(table)
    assert read_table(tmp_path / "t.parquet", ["d", "a"]).select(["d", "a"]).equals(table.select(["d", "a"]))
    assert read_table(tmp_path / "t.parquet", lambda names: names[1:3]).column_names == ["b", "c"]
    with rejected("missing_column", r"t\.parquet"):
        read_table(tmp_path / "t.parquet", ["a", "e"])


def test_json_is_read_as_it_is(tmp_path: Path) -> None:
    value = {"a": [1, 2.5, None, True], "ü": {"b": "c"}}
    (tmp_path / "a.json").write_text(json.dumps(value, ensure_ascii=False), encoding="utf-8")
    assert read_json(tmp_path / "a.json") == value
    (tmp_path / "b.jsonl").write_text('{"a": 1}\n\n{"a": NaN}\n')
    first, second = read_json_lines(tmp_path / "b.jsonl")
    assert first == {"a": 1}
    assert np.isnan(second["a"])
    (tmp_path / "b.jsonl").write_text('{"a": 1}\n{"a" 2}\n')
    with pytest.raises(RejectedInputError, match="line 2"):
        list(read_json_lines(tmp_path / "b.jsonl"))


@pytest.mark.parametrize("settings", [{}, {"chunks": (2,)}, {"chunks": (3,), "compression": "gzip", "shuffle": True}])
def test_entries_of_variable_length_are_read(tmp_path: Path, settings: dict[str, object]) -> None:
    contents = [bytes([n]) * (40 + n) for n in range(5)]
    with h5py.File(tmp_path / "a.h5", "w") as file:
        images = file.create_dataset("images", (5,), dtype=h5py.vlen_dtype(np.uint8), **settings)
        for number, content in enumerate(contents):
            images[number] = np.frombuffer(content, np.uint8)
        file["text"] = ["pick"]
    with open_hdf5(tmp_path / "a.h5") as file:
        assert list(file.image_files("images", 5)) == contents
        assert file.text("text") == "pick"


def test_a_dataset_that_was_written_in_part_is_unreadable(tmp_path: Path) -> None:
    """The library fills in zeros, which look like a robot that stands still."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("state", (6, 2), chunks=(2, 2), dtype="f4")[:4] = 1
        file.create_dataset("nothing", (6, 2), dtype="f4")
    with open_hdf5(tmp_path / "a.h5") as file:
        for key in ("state", "nothing"):
            with rejected("unreadable", f"h5, {key}"):
                file.array(key, (None, 2))


def one_arm(key: str) -> tuple[ArmPlace]:
    return (ArmPlace("right", Columns(key, slice(0, 6), (7,)), Columns(key, slice(6, 7), (7,))),)


@pytest.mark.parametrize("rows", [slice(40, 50), slice(0, 5), slice(20, 22), slice(0, 50)])
@pytest.mark.parametrize("fill", [0.0, -1.0])
def test_joints_that_hold_fill_values_were_never_written(tmp_path: Path, rows: slice, fill: float) -> None:
    values = 0.5 + 0.3 * np.sin(np.arange(50)[:, None] / 10 + np.arange(7))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        sound = file.create_dataset("sound", data=values, fillvalue=fill, chunks=(50, 7))
        file.create_dataset("state", data=sound, fillvalue=fill, chunks=(50, 7))[rows] = fill
    with open_hdf5(tmp_path / "a.h5") as file:
        assert len(file.arms(one_arm("sound"), GripperRange(closed=-1, open=1)).values) == 50
        with rejected("unreadable", r"state\n.*\n.*fill values in"):
            file.arms(one_arm("state"), GripperRange(closed=-1, open=1))


def test_a_robot_may_come_to_its_zero(tmp_path: Path) -> None:
    values = np.clip(np.linspace(0.5, -0.5, 50), 0, 1)[:, None] * np.ones(7)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["state"] = values
    with open_hdf5(tmp_path / "a.h5") as file:
        assert np.array_equal(file.arms(one_arm("state"), GripperRange(closed=0, open=1)).values, values)


@pytest.mark.parametrize("shape", [(3, 100_000), (3, 1001), (3, 10, 101)])
def test_states_of_more_columns_than_a_robot_has_are_refused(tmp_path: Path, shape: tuple[int, ...]) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("state", shape, "f4", compression="gzip", data=np.zeros(shape, np.float32))
    with open_hdf5(tmp_path / "a.h5") as file, rejected("too_large", "more columns than a robot"):
        file.array("state", [None] * len(shape))
    with rejected("too_large", "more columns than a robot"):
        numeric_column(pa.chunked_array([pa.array([np.zeros(int(np.prod(shape[1:])))] * 3)]), 3, "data")


def test_png_and_jpeg_come_as_rgb() -> None:
    assert np.array_equal(decode_image(PNG, "x"), PICTURE)
    assert np.array_equal(decode_image(PNG, "x", channels="bgr"), PICTURE[..., ::-1])
    for content in (JPEG, JPEG + b"\0" * 999):
        pixels = np.asarray(Image.open(io.BytesIO(JPEG)))
        assert np.abs(decode_image(content, "x").astype(int) - pixels).max() <= 3
    assert np.array_equal(decode_image(PNG + b"\0" * 999, "x"), PICTURE)


@pytest.mark.parametrize(
    "settings", [{}, {"progressive": True}, {"restart_marker_rows": 1}, {"comment": b"\xff\xc0\x00" * 9}]
)
def test_the_size_is_found_among_other_segments(settings: dict[str, object]) -> None:
    assert image_size(encoded("JPEG", **settings), "x") == (30, 50)
    exif = Image.Exif()
    exif[0x010E] = encoded("JPEG").decode("latin-1")[:400]  # a description that is itself the beginning of a JPEG file
    assert image_size(encoded("JPEG", exif=exif, **settings), "x") == (30, 50)


def test_a_jpeg_that_claims_gigapixels_is_refused_undecoded() -> None:
    frame = JPEG.index(b"\xff\xc0")
    end = frame + 2 + struct.unpack(">H", JPEG[frame + 2 : frame + 4])[0]
    large = JPEG[frame : frame + 5] + struct.pack(">HH", 65_500, 65_500) + JPEG[frame + 9 : end]
    with rejected("too_large", "bomb"):
        decode_image(JPEG[:frame] + large + JPEG[end:], "bomb.jpg")
    for before, after in ((JPEG[:frame], JPEG[frame:]), (JPEG[:end], JPEG[end:])):
        with pytest.raises(RejectedInputError, match="bomb"):  # two frames, one of them that large
            decode_image(before + large + after, "bomb.jpg")


def test_a_progressive_jpeg_of_usual_scans_is_read() -> None:
    assert decode_image(jpeg_of_scans(1), "x").shape == (6000, 6000, 3)


def test_special_files_are_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "zero.png").symlink_to("/dev/zero")
    for name in ("pipe.png", "folder.png", "zero.png"):
        for read in (read_image, lambda path: list(read_clip(VideoClip.whole_file(path, 9, 8.0)))):
            with rejected("special_file", name):
                read(tmp_path / name)
    (tmp_path / "sound.png").write_bytes(PNG)
    assert np.array_equal(read_image(tmp_path / "sound.png"), PICTURE)


def test_videos_that_break_off_or_lie_about_their_boxes_end(video: Path) -> None:
    """A box of length 0 runs to the end of the file; shorter than its own header it would never get on."""
    content = video.read_bytes()
    moov = content.index(b"moov") - 4

    def ended(changed: bytes) -> int | str:
        video.write_bytes(changed)
        try:
            return sum(1 for _ in read_clip(VideoClip.whole_file(video, 9, 8.0)))
        except RejectedInputError as error:
            return error.reason

    assert ended(content) == 9
    for length in (0, 1, 7, 8, 11, 40, 300):
        assert ended(content[:length]) in ("truncated_video", "unreadable")
    lies = [content[:moov] + struct.pack(">I", n) + content[moov + 4 :] for n in (1, 4, 7, 2**32 - 1)]
    many = struct.pack(">I4s8s", 16, b"ftyp", b"isom\0\0\0\0") + struct.pack(">I4s", 8, b"free") * 100_001
    for changed in (*lies, many):
        assert ended(changed) in (9, "truncated_video", "unreadable")
