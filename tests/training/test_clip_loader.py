"""Batches by their micro-step: the same whatever reads them, from any step on, and errors that name clips."""

import multiprocessing
import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from worldline_core.data.episodes.episode import VIEWS
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import DataError, TrainingError
from worldline_core.training.clip_config import ClipSampling, FrameInput
from worldline_core.training.clip_loader import ClipLoader
from worldline_core.training.clip_sampler import ClipSampler
from worldline_core.training.clip_source import FrameSource, LatentStore


class Scripted(LatentStore):
    """A store that does, for some episodes, what a test asks for. Lives in a module so that processes can import it."""

    behaviour: dict[str, str]

    def read(self, clip, views):
        what = self.behaviour.get(clip.episode_id)
        if what == "slow":
            time.sleep(0.15)
        elif what == "damaged":
            raise DataError("A clip cannot be read: truncated", where=str(clip))
        elif what == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        return super().read(clip, views)


def scripted(world, behaviour=None):
    plain = LatentStore.open(world.latents)
    store = Scripted(plain.root, plain.description, plain.rows)
    store.behaviour = behaviour or {}
    return store


def sampler_of(source, **changes):
    values = {"lengths": (5, 9, 17), "view_weights": {"joint": 1.0, "primary": 1.0}, "single_view_factor": 2}
    config = ClipSampling.model_validate(changes or values)
    rows = [row for row in source.rows if row.split == "train"]
    return ClipSampler(rows, config, views=VIEWS, start_step=source.start_step, batch_size=2, seed=9)


def same(one, other):
    return (one.clips, one.views) == (other.clips, other.views) and torch.equal(one.latents, other.latents)


@pytest.fixture(autouse=True)
def _importable(monkeypatch):
    # pytest's importlib mode gives this file a name that a spawned process cannot import: give it one that it can.
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    monkeypatch.setattr(Scripted, "__module__", "test_clip_loader")
    monkeypatch.setitem(sys.modules, "test_clip_loader", sys.modules[__name__])


@pytest.mark.slow
@pytest.mark.usefixtures("forked_loaders")
def test_batches_do_not_depend_on_who_reads_them_and_when(world):
    plain = ClipLoader(scripted(world), views=VIEWS)
    sampler = sampler_of(plain.source)
    expected = [plain.load(sampler.clips(index)) for index in range(24)]
    assert {len(batch.views) for batch in expected} == {1, 3}
    # Two episodes are slow: processes overtake each other.
    slow = ClipLoader(scripted(world, {"episode-003": "slow", "episode-006": "slow"}), views=VIEWS)
    state = torch.get_rng_state()
    for workers in (0, 1, 2):
        load = slow.batches(sampler, workers)
        for index in (*range(20), 5, 6, 7, 20, 21):  # in order, and back as after a kill
            assert same(load(index), expected[index])
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.slow
@pytest.mark.usefixtures("forked_loaders")
def test_errors_name_their_clips_and_leave_no_process(world):
    sampler = sampler_of(scripted(world))
    first = next(index for index in range(50) if "episode-004" in {c.episode_id for c in sampler.clips(index).clips})
    for what, kind, message in (
        ("damaged", DataError, r"cannot be read: truncated[\s\S]*episode-004, frames"),
        ("die", TrainingError, r"loader process has ended[\s\S]*episode-004[\s\S]*exited unexpectedly"),
    ):
        loader = ClipLoader(scripted(world, {"episode-004": what}), views=VIEWS)
        load = loader.batches(sampler, 1)
        for index in range(first):
            load(index)
        with pytest.raises(kind, match=message):
            load(first)
        del load
        deadline = time.monotonic() + 20
        while multiprocessing.active_children() and time.monotonic() < deadline:
            time.sleep(0.05)
        assert not multiprocessing.active_children()


KILLED = """
import multiprocessing, pickle, sys, time
from pathlib import Path
from test_clip_loader import VIEWS, ClipLoader, sampler_of
if __name__ == "__main__":
    source = pickle.loads(Path(sys.argv[1]).read_bytes())
    load = ClipLoader(source, views=VIEWS).batches(sampler_of(source), 1)
    load(0)
    print(*[process.pid for process in multiprocessing.active_children()], flush=True)
    time.sleep(60)
"""


@pytest.mark.slow
def test_processes_end_with_the_training_process(world, tmp_path):
    """Killed with SIGKILL, it cannot close anything: its loader processes notice and end by themselves."""
    (tmp_path / "source.pickle").write_bytes(pickle.dumps(scripted(world)))
    (tmp_path / "main.py").write_text(KILLED)
    command = [sys.executable, str(tmp_path / "main.py"), str(tmp_path / "source.pickle")]
    folders = (Path(__file__).parent, Path(__file__).parents[2])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, folders))}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as training:
        (number,) = (int(number) for number in training.stdout.readline().split())
        training.kill()
    deadline = time.monotonic() + 20
    while Path(f"/proc/{number}").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not Path(f"/proc/{number}").exists()


@pytest.mark.gpu
def test_batches_reach_a_gpu(world):
    source = scripted(world)
    load = ClipLoader(source, views=VIEWS, device="cuda").batches(sampler_of(source), 1)
    plain = ClipLoader(source, views=VIEWS)
    for index in range(6):
        assert torch.equal(load(index).latents.cpu(), plain.load(sampler_of(source).clips(index)).latents)


def test_a_damaged_clip_is_named(world, tokenizer, tmp_path):
    episodes = EpisodeSet.open(shutil.copytree(world.episodes, tmp_path / "set"))
    (video,) = episodes.root.rglob("*left_wrist*/**/*.mp4")
    half = video.stat().st_size // 2
    video.write_bytes(video.read_bytes()[:half] + bytes(half))
    source = FrameSource(episodes, tokenizer, FrameInput(image_size=(32, 32)))
    load = ClipLoader(source, views=VIEWS).batches(sampler_of(source, lengths=(17,)))
    with pytest.raises(DataError, match=r"cannot be read[\s\S]*episode-\d+, frames 0\.\.16, view left_wrist, in .*mp4"):
        for index in range(10):
            load(index)
