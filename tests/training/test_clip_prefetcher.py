"""Loader processes: the same batches whatever their number, bounded memory, errors that name clips, and a clean end."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from worldline_core.errors import DataError, TrainingError
from worldline_core.training.clip_config import ClipSampling, ReadingConfig
from worldline_core.training.clip_loader import ClipReader
from worldline_core.training.clip_prefetcher import ClipPrefetcher
from worldline_core.training.clip_sampler import ClipSampler
from worldline_core.training.clip_source import Clip
from worldline_core.training.latent_store import LatentStore

VIEWS = ("head", "left_wrist", "right_wrist")


class Scripted(LatentStore):
    """A store that does, for some episodes, what a test asks for. Lives in a module so that processes can import it."""

    behaviour: dict[str, str]

    def read(self, clip: Clip, views: tuple[str, ...], out: np.ndarray) -> None:
        what = self.behaviour.get(clip.episode_id)
        if what == "slow":
            time.sleep(0.15)
        elif what == "damaged":
            raise DataError("A clip cannot be read: truncated", where=str(clip))
        elif what == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        elif what is not None and what.startswith("log:"):
            with Path(what[4:]).open("a") as file:
                file.write(f"{clip}\n")
        super().read(clip, views, out)


def reader(world: Any, behaviour: dict[str, str] | None = None, *, skip: bool = False, **sampling: Any) -> ClipReader:
    plain: Any = LatentStore.open(world.latents)
    store = Scripted(plain.root, plain.description, plain.rows)
    store.behaviour = behaviour or {}
    values = {"lengths": (5, 9, 17), "view_weights": {"joint": 1.0, "primary": 1.0}, "single_view_factor": 2}
    config = ClipSampling.model_validate(values | sampling)
    sampler = ClipSampler(store, config, splits=["train"], batch_size=2, seed=9)
    return ClipReader(store, sampler, VIEWS, ReadingConfig(on_unreadable="skip" if skip else "raise"))


@pytest.fixture(autouse=True)
def _importable(monkeypatch: pytest.MonkeyPatch) -> None:
    # pytest's importlib mode gives this file a name that a spawned process cannot import: give it one that it can.
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    monkeypatch.setattr(Scripted, "__module__", "test_clip_prefetcher")
    monkeypatch.setitem(sys.modules, "test_clip_prefetcher", sys.modules[__name__])


def gone(prefetcher_processes: list[int]) -> bool:
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline:
        if not any(Path(f"/proc/{number}").exists() for number in prefetcher_processes):
            return True
        time.sleep(0.05)
    return False


@pytest.mark.slow
@pytest.mark.usefixtures("forked_loaders")
def test_batches_do_not_depend_on_the_number_of_processes(world: Any) -> None:
    # Two episodes are slow: processes overtake each other.
    plain = reader(world)
    expected = [plain.read(index) for index in range(24)]
    assert {read.batch.view for read in expected} == {None, "primary"}
    slow = reader(world, {"episode-003": "slow", "episode-006": "slow"})
    for workers, prefetch in ((1, 2), (2, 1)):
        with ClipPrefetcher(slow, workers=workers, prefetch=prefetch, stop=24) as ahead:
            for index in range(24):
                read = ahead.read(index)
                assert read.batch == expected[index].batch
                assert torch.equal(read.data, expected[index].data)
            # Back, as after a kill, and on from there; then beyond where reading ahead stops.
            for index in (5, 6, 7, 20, 21, 30):
                read = ahead.read(index)
                assert read.batch == plain.sampler.clips(index)
                assert torch.equal(read.data, plain.read(index).data)


@pytest.mark.slow
@pytest.mark.usefixtures("forked_loaders")
def test_no_more_is_read_ahead_than_there_are_slots(world: Any, tmp_path: Path) -> None:
    log = tmp_path / "read.txt"
    episodes = {f"episode-{number:03d}": f"log:{log}" for number in range(8)}
    counted = reader(world, episodes, view_weights=None, single_view_factor=1)
    with ClipPrefetcher(counted, workers=1, prefetch=5) as ahead:
        for index in range(3):
            ahead.read(index)
        time.sleep(1.0)
        # Micro-steps 0..2 were asked for; 2 is in use, its five successors fill the other slots. Two clips each.
        assert len(log.read_text().splitlines()) == 2 * (3 + 5)


@pytest.mark.slow
@pytest.mark.usefixtures("forked_loaders")
def test_errors_name_their_clips_and_end_cleanly(world: Any) -> None:
    first = next(
        index
        for index in range(50)
        if any(clip.episode_id == "episode-004" for clip in reader(world).sampler.clips(index).clips)
    )
    for what, kind, message in (
        ("damaged", DataError, "cannot be read: truncated[\\s\\S]*episode-004, frames"),
        ("die", TrainingError, "loader process has ended[\\s\\S]*episode-004[\\s\\S]*terminated abruptly"),
    ):
        others = set(multiprocessing.active_children())
        with ClipPrefetcher(reader(world, {"episode-004": what}), workers=1, prefetch=1) as ahead:
            for index in range(first):
                ahead.read(index)
            with pytest.raises(kind, match=message):
                ahead.read(first)
        assert set(multiprocessing.active_children()) <= others
        with pytest.raises(TrainingError, match="loader is closed"):
            ahead.read(first + 1)


@pytest.mark.usefixtures("forked_loaders")
def test_skipped_clips_come_with_the_batch(world: Any) -> None:
    behaviour = {"episode-004": "damaged"}
    here = reader(world, behaviour, skip=True)
    expected = [here.read(index) for index in range(12)]
    assert any(read.skipped for read in expected)
    with ClipPrefetcher(here, workers=1, prefetch=1, stop=12) as ahead:
        for index, single in enumerate(expected):
            read = ahead.read(index)
            assert (read.batch, read.skipped) == (single.batch, single.skipped)
            assert torch.equal(read.data, single.data)


@pytest.mark.slow
def test_processes_end_with_the_training_process(world: Any, tmp_path: Path) -> None:
    """Killed with SIGKILL, it cannot close anything: its loader processes notice and end by themselves."""
    (tmp_path / "reader.pickle").write_bytes(pickle.dumps(reader(world)))
    code = (
        "import multiprocessing, pickle, sys, time\n"
        "from pathlib import Path\n"
        "from worldline_core.training.clip_prefetcher import ClipPrefetcher\n"
        "if __name__ == '__main__':\n"
        "    reader = pickle.loads(Path(sys.argv[1]).read_bytes())\n"
        "    ahead = ClipPrefetcher(reader, workers=1)\n"
        "    ahead.read(0)\n"
        "    print(*[process.pid for process in multiprocessing.active_children()], flush=True)\n"
        "    time.sleep(60)\n"
    )
    (tmp_path / "main.py").write_text(code)
    command = [sys.executable, str(tmp_path / "main.py"), str(tmp_path / "reader.pickle")]
    folders = (Path(__file__).parent, Path(__file__).parents[2])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, folders))}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as training:
        assert training.stdout is not None
        numbers = [int(number) for number in training.stdout.readline().split()]
        assert len(numbers) == 1
        training.kill()
    assert gone(numbers)


@pytest.mark.gpu
def test_batches_for_a_gpu_come_in_page_locked_memory(world: Any) -> None:
    plain = reader(world)
    with ClipPrefetcher(plain, workers=1, stop=6, pinned=True) as ahead:
        for index in range(6):
            data = ahead.read(index).data
            assert data.is_pinned()
            assert torch.equal(data.to("cuda", non_blocking=True).cpu(), plain.read(index).data)
