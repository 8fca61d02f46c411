"""A disk without space: a small file system of its own under the store, where one may be mounted."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

SIZE = 2 << 20


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of two megabytes."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={SIZE}", "none", str(folder)], capture_output=True, text=True, check=False
    )
    if mounted.returncode:
        pytest.skip(f"no small file system may be mounted here: {mounted.stderr.strip()}")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def leave(disk: Path, free: int) -> None:
    """Fill a disk up to so many bytes."""
    fill = disk / "fill"
    fill.unlink(missing_ok=True)
    fill.touch()
    state = os.statvfs(disk)
    fill.write_bytes(b"x" * max(0, state.f_bavail * state.f_frsize - free))


LEAVE = f"import os\nfrom pathlib import Path\n{inspect.getsource(leave)}"


ENCODE = """
import sys
from pathlib import Path
import numpy as np
from worldline_core.data.video.encoder import concatenate_videos, encode_video

disk, part = Path(sys.argv[1]), Path(sys.argv[2])
frames = np.random.default_rng(0).integers(0, 256, (12, 64, 96, 3), dtype=np.uint8)
encode_video(part, frames, 8.0, preset="ultrafast")
for write in (
    lambda path: encode_video(path, frames, 8.0, preset="ultrafast"),
    lambda path: concatenate_videos(path, [(part, 12)], 8.0),
):
    write(part.with_name("whole.mp4"))
    size = part.with_name("whole.mp4").stat().st_size
    for free in [0, *range(1, size + 12000, size // 14)]:
        leave(disk, free)
        try:
            write(disk / "a.mp4")
            print("whole", (disk / "a.mp4").stat().st_size == size)
        except OSError as error:
            print("full", error.errno)
        (disk / "a.mp4").unlink(missing_ok=True)
"""


def python(project_root: Path, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments], cwd=project_root, env=os.environ | {"PYTHONPATH": str(project_root)},
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip


def test_a_video_is_whole_or_an_error_however_little_space_is_left(
    disk: Path, tmp_path: Path, project_root: Path
) -> None:
    """FFmpeg crashed where not even the header could be written."""
    ended = python(project_root, "-c", LEAVE + ENCODE, disk, tmp_path / "part.mp4")
    assert ended.returncode == 0, ended.stderr
    said = ended.stdout.splitlines()
    assert set(said) == {"whole True", "full 28"}
    assert said[0] == "full 28"
    assert len(said) > 30


EXPORT = [
    "export",
    "artifacts/shipped/recordings",
    "--episode",
    "ur5e_silver-test-s1-00000",
    "--output",
    "{disk}/out",
    "--format",
]
SMOKE = ["--preset", "smoke", "--artifacts", "{disk}/store"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "free"),
    [
        ([*EXPORT, "lerobot"], 0),
        ([*EXPORT, "rrd"], 0),
        ([*EXPORT, "rrd"], 60_000),
        ([*EXPORT, "mcap"], 60_000),
        (["inspect", "artifacts/shipped/recordings", "--output", "{disk}/out"], 60_000),
        (["push", "artifacts/shipped/recordings", "{disk}/out"], 60_000),
        (["record", "--output", "{disk}/out"], 60_000),
        (["pipeline", *SMOKE], 300_000),
        (["task", "curate", *SMOKE, "--runner", "processes", "--set", "runner.workers=2", "--set", "runner.episodes_per_shard=4"], 300_000),
    ],
    ids=lambda value: value[0] + " " + value[-1].rpartition("/")[2] if isinstance(value, list) else str(value),
)  # fmt: skip
def test_what_is_written_is_whole_or_one_message(disk: Path, project_root: Path, command: list[str], free: int) -> None:
    leave(disk, free)
    ended = python(project_root, "-m", "flows.command_line", *(part.format(disk=disk) for part in command))
    assert (ended.returncode, "Traceback" in ended.stderr) == (1, False), ended.stderr
    said = [line for line in ended.stderr.splitlines() if line.startswith("error:")]
    assert said == ["error: The store did not finish the push" if command[0] == "push" else "error: No space left"]
    stays = "--preset" in command  # a step keeps what it has begun
    assert ("the same command continues" if stays else "No space left on device") in ended.stderr
    names = ["manifest.json"] if stays else ["manifest.json", "*.rrd", "*.mcap", "info.json"]
    assert not [path for name in names for path in disk.rglob(name)]
