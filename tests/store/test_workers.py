"""Several processes of one launch on one step: one owner, helpers that neither wait for its lock nor work alone."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Mapping
from multiprocessing.queues import Queue
from pathlib import Path
from typing import Any

import pytest

from worldline_core.config import StrictModel
from worldline_core.store.store import ArtifactStore, helper_lock

CONTEXT = multiprocessing.get_context("fork")


class WorkConfig(StrictModel):
    seconds: float = 0.0


def work(config: WorkConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """The first process writes the content; every process notes that it took part."""
    rank = os.environ["RANK"]
    (output / "run").mkdir(exist_ok=True)
    (output / "run" / f"rank-{rank}").touch()
    time.sleep(config.seconds)
    if rank == "0":
        (output / "content").write_text("made")
    return {}


def process(root: Path, rank: int, *, distributed: bool, results: Queue[Any]) -> None:
    os.environ.update(WORLD_SIZE="2", RANK=str(rank), MASTER_PORT="29500")
    artifact = ArtifactStore(root).run("work", 1, work, WorkConfig(seconds=1.0), {}, distributed=distributed)
    results.put((rank, str(artifact.path), artifact.digest, artifact.cached))
    results.close()
    results.join_thread()
    # Without the clean-up that a fork inherits from tests that ran before: servers, clients and pools of the parent.
    os._exit(0)


def launch(root: Path, *, distributed: bool) -> list[tuple[int, str, str, bool]]:
    results: Queue[Any] = CONTEXT.Queue()
    options = {"distributed": distributed, "results": results}
    # The helper comes first: it has to wait for the owner to begin.
    processes = [CONTEXT.Process(target=process, args=(root, rank), kwargs=options) for rank in (1, 0)]
    for one in processes:
        one.start()
        time.sleep(0.3)
    found = [results.get(timeout=30) for _ in processes]
    for one in processes:
        one.join(timeout=30)
        assert one.exitcode == 0
    return sorted(found)


@pytest.mark.slow
@pytest.mark.parametrize("distributed", [True, False])
def test_one_process_owns_the_artifact(tmp_path: Path, distributed: bool) -> None:
    first, second = launch(tmp_path, distributed=distributed)
    assert first[1:3] == second[1:3]
    folder = Path(first[1])
    took_part = sorted(path.name for path in (folder / "run").iterdir())
    assert took_part == ([".writers", "rank-0", "rank-1"] if distributed else ["rank-0"])
    assert (folder / "content").read_text() == "made"
    assert [path.suffix for path in folder.parent.iterdir() if path.is_file()] == [".lock"]  # no announcement is left
    assert [cached for *_, cached in launch(tmp_path, distributed=distributed)] == [True, True]


def straggle(folder: Path, begun: Any) -> None:
    """A worker of a command that was killed: it does not know yet."""
    with helper_lock(folder):
        begun.set()
        time.sleep(0.2)
        (folder / "late").write_text("by a worker whose command is gone")


def test_work_is_taken_over_when_the_last_worker_of_a_killed_command_has_ended(tmp_path: Path) -> None:
    store = ArtifactStore(tmp_path)
    partial = tmp_path / "work" / f"{store.key('work', 1, WorkConfig(), {})}.partial"
    begun = CONTEXT.Event()
    worker = CONTEXT.Process(target=straggle, args=(partial, begun))
    worker.start()
    assert begun.wait(30)
    there: list[bool] = []

    def look(config: WorkConfig, inputs: Any, output: Path) -> dict[str, Any]:
        there.append((output / "late").exists())
        (output / "content").write_text("made")
        return {}

    store.run("work", 1, look, WorkConfig(), {})
    worker.join(timeout=30)
    assert there == [True]
