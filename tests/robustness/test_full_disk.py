"""A disk without space: a small file system of its own under the store, where one may be mounted."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tasks.execution.artifact_task import find_task
from tasks.execution.command_line import exit_with_clear_errors
from tests.evaluation.conftest import _write as write_world
from worldline_core.config import StrictModel
from worldline_core.evaluation.evaluation_config import PlanningConfig, PolicyEvaluationConfig, VideoEvaluationConfig
from worldline_core.evaluation.planning.evaluate_planning import SEALED_FILE
from worldline_core.report.report import ReportConfig
from worldline_core.rollout.rollout_config import CopyFirstFrameConfig, RolloutConfig
from worldline_core.shipped import shipped_folder
from worldline_core.store.store import Artifact, ArtifactStore

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


def test_a_video_is_whole_or_an_error_however_little_space_is_left(
    disk: Path, tmp_path: Path, project_root: Path
) -> None:
    """FFmpeg crashed where not even the header could be written."""
    ended = subprocess.run(
        [sys.executable, "-c", "import os\nfrom pathlib import Path\n" + inspect.getsource(leave) + textwrap.dedent(ENCODE), str(disk), str(tmp_path / "part.mp4")], cwd=project_root,
        env=os.environ | {"PYTHONPATH": str(project_root)}, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    said = ended.stdout.splitlines()
    assert set(said) == {"whole True", "full 28"}
    assert said[0] == "full 28"
    assert len(said) > 30


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Path]]:
    """What each of the later steps reads, all of it on a disk with space."""
    root = tmp_path_factory.mktemp("world")
    recordings = write_world(root / "recordings", {"ep-0": True, "ep-1": False}, split="test", bank=None).inputs
    bank = write_world(root / "bank", {"c-0": True, "c-1": False}, split="bank", bank="bank-0")
    table = pa.table({"episode_id": list(bank.outcomes), "outcome": list(bank.outcomes.values())})
    pq.write_table(table, bank.inputs["banks"] / SEALED_FILE)
    scores = find_task("evaluate_video").run(ArtifactStore(root), CONFIGS["evaluate_video"], recordings).path
    tokenizer = shipped_folder() / "models" / "tokenizer"
    return {
        "rollout": {"episodes": recordings["episodes"], "tracks": recordings["tracks"], "tokenizer": tokenizer},
        "evaluate_video": recordings,
        "evaluate_policy": recordings,
        "evaluate_planning": bank.inputs,
        "report": {"evaluate_video": scores, "rollout.good": recordings["rollouts.good"]},
    }


CONFIGS: dict[str, StrictModel] = {
    "rollout": RolloutConfig(method="copy", sampler=CopyFirstFrameConfig(), num_frames=17),
    "evaluate_video": VideoEvaluationConfig(segmenters=("colour",), resamples=100),
    "evaluate_policy": PolicyEvaluationConfig(segmenter="colour", splits=("test",), resamples=100),
    "evaluate_planning": PlanningConfig(segmenter="colour", budgets=(2,), runs=1, resamples=100),
    "report": ReportConfig(),
}


@pytest.mark.slow
@pytest.mark.parametrize("step", CONFIGS)
def test_the_later_steps_end_with_one_message_and_the_same_command_continues(
    step: str, disk: Path, tmp_path: Path, inputs: dict[str, dict[str, Path]], capsys: pytest.CaptureFixture[str]
) -> None:
    def run(root: Path) -> Artifact:
        return find_task(step).run(ArtifactStore(root), CONFIGS[step], inputs[step])

    whole = run(tmp_path / "elsewhere")
    (disk / step).mkdir()
    capsys.readouterr()
    for free in (0, 4096, sum(path.stat().st_size for path in whole.path.rglob("*") if path.is_file()) // 2):
        leave(disk, free)
        with pytest.raises(SystemExit):
            exit_with_clear_errors(lambda: run(disk))
        said = capsys.readouterr().err
        assert "error: No space left" in said
        assert "Traceback" not in said
        assert not list((disk / step).glob("*/manifest.json"))
    (disk / "fill").unlink()
    assert run(disk).digest == whole.digest
