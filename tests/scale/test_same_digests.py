"""The same set and the same index, whatever did the work, in whatever pieces, and however often it was killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tasks.execution.shard_mapper import shard_mapper
from tests.data.conftest import make_sample  # pyright: ignore[reportMissingImports]
from tests.data.curating import record
from worldline_core.data.curation import curate as curate_step
from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.data.episodes.episode_index import read_index, read_quarantine
from worldline_core.data.episodes.episode_set import EpisodeSetWriter
from worldline_core.filters.filter import filter_episodes
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.scale.account import read_account
from worldline_core.scale.mapping import RunnerConfig, SerialMapper
from worldline_core.store.artifact_files import digest_folder

COUNT = 8


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sources: an episode with a value that is no number, one whose id the other has as well, one that is a copy."""
    root = tmp_path_factory.mktemp("recordings")
    for name, numbers in (("first", range(COUNT - 4)), ("second", range(COUNT - 5, COUNT - 1))):
        with EpisodeSetWriter(root / name, video_crf=8) as writer:
            for number in numbers:
                episode, frames, masks = make_sample(number, num_frames=24)
                if number == 2:
                    episode.state[3, 1] = np.nan
                writer.add(episode, frames, masks)
            if name == "second":
                writer.add(*make_sample(0, num_frames=24, episode_id="a-copy"))
    return root


def config(recordings: Path, *names: str) -> CurateConfig:
    sources = [{"kind": "episode_set", "path": str(recordings / name)} for name in names or ("first", "second")]
    return CurateConfig.model_validate({"sources": sources, "image_size": (16, 24), "fps": 8})


def both_digests(recordings: Path, output: Path, mapper: Any) -> tuple[str, str]:
    """Return the digests of the curated set and of its filtered index."""
    curate(config(recordings), {}, output / "set", mapper)
    # Calibration is not what is tested here: at one frame in four seconds there is too little to search it for mistakes.
    strict = FilterConfig.model_validate({"min_segment_frames": 2, "doctor": {"rate_hz": 0.25}})
    filter_episodes(strict, {"episodes": output / "set"}, output / "index", mapper)
    return digest_folder(output / "set"), digest_folder(output / "index")


@pytest.fixture(scope="module")
def undisturbed(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    output = tmp_path_factory.mktemp("undisturbed")
    digests = both_digests(recordings, output, SerialMapper())
    rows = read_account(output / "set")
    assert len(rows) == COUNT + 1
    rejected = {row.episode_id: row.reason for row in read_quarantine(output / "set")}
    expected = {"episode-002": "nan_state", "episode-003#source.1": "duplicate_id", "a-copy": "duplicate"}
    assert rejected.items() >= expected.items()
    kept = {row.episode_id: None for row in read_index(output / "set")}
    assert {row.episode_id: row.reason for row in rows} == rejected | kept
    assert all(row.seconds is not None and row.seconds > 0 for row in rows)
    assert len(read_account(output / "index")) == len(kept)
    return digests


def runner(kind: str, **settings: Any) -> RunnerConfig:
    return RunnerConfig.model_validate({"kind": kind, "episodes_per_shard": 3, **settings})


@pytest.mark.slow
@pytest.mark.usefixtures("prefect_server")
@pytest.mark.parametrize("kind", ["processes", "dask", "ray"])
def test_other_runners(recordings: Path, undisturbed: tuple[str, str], tmp_path: Path, kind: str) -> None:
    # Asked without importing: what Ray reads at its import is set by the mapper.
    if kind in ("dask", "ray") and find_spec(f"prefect_{kind}") is None:
        pytest.skip(f"prefect_{kind} is not installed")
    assert both_digests(recordings, tmp_path, shard_mapper(runner(kind, workers=2))) == undisturbed


CURATE = """
import sys
from pathlib import Path
from tasks.execution.shard_mapper import shard_mapper
from worldline_core.data.curation.curate import curate
from worldline_core.data.curation.curate_config import CurateConfig
from worldline_core.scale.mapping import RunnerConfig

mapper = shard_mapper(RunnerConfig.model_validate_json(sys.argv[2]))
curate(CurateConfig.model_validate_json(sys.argv[1]), {}, Path(sys.argv[3]), mapper)
"""


@pytest.mark.slow
@pytest.mark.usefixtures("prefect_server")
def test_killed_in_the_middle_and_resumed_elsewhere(
    recordings: Path, undisturbed: tuple[str, str], tmp_path: Path, project_root: Path
) -> None:
    """The whole group of processes is killed when some episodes are done; other shards in this process do the rest."""
    from prefect.settings import PREFECT_API_URL

    output = tmp_path / "set"
    settings = runner("processes", workers=2, episodes_per_shard=2).model_dump_json()
    process = subprocess.Popen(
        [sys.executable, "-c", CURATE, config(recordings).model_dump_json(), settings, str(output)], cwd=project_root,
        env=os.environ | {"PREFECT_API_URL": str(PREFECT_API_URL.value())}, stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    parts = output / "run" / "episodes" / "parts"
    deadline = time.monotonic() + 240
    while not (parts.is_dir() and len([p for p in parts.iterdir() if not p.name.startswith(".")]) >= 2):
        assert process.poll() is None, "ended before it could be killed"
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert not EpisodeSetWriter.finished(output)
    mapper = SerialMapper(RunnerConfig(episodes_per_shard=5))
    assert both_digests(recordings, tmp_path, mapper) == undisturbed
    names = [row.episode_id for row in read_account(output)]
    assert len(names) == len(set(names)) == COUNT + 1


@pytest.mark.usefixtures("reading_in_this_process")
def test_an_unforeseen_error_is_a_quarantined_episode(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record(tmp_path / "first", [make_sample(number, num_frames=24) for number in (0, 4)])
    whole = curate_step.check_episode

    def fails_on_one(configured: CurateConfig, loaded: Any) -> None:
        if loaded.episode.episode_id == "episode-004":
            raise ZeroDivisionError(f"at {tmp_path}/somewhere/x.py, object at 0x7f00deadbeef")
        whole(configured, loaded)

    monkeypatch.setattr(curate_step, "check_episode", fails_on_one)
    counts = curate(config(tmp_path, "first"), {}, tmp_path / "set")
    assert (counts["found"], counts["kept"], counts["quarantined"]) == (2, 1, 1)
    (row,) = read_quarantine(tmp_path / "set")
    evidence = json.loads(row.evidence)
    assert (row.reason, evidence["type"]) == ("crashed", "ZeroDivisionError")
    assert evidence["trace"][-1].endswith("fails_on_one")
    assert any(line.startswith("worldline_core/data/curation/curate.py:") for line in evidence["trace"])
    assert not any(secret in row.evidence + row.detail for secret in (str(tmp_path), "deadbeef"))
