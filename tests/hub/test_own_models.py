"""A model of one's own, trained by the pipeline's tasks: loaded by its folder, served, driven and published."""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from flows.command_line import main
from flows.pipeline import chain
from tasks.execution.chain import outline
from worldline_core import WorldLine
from worldline_core.errors import CheckpointError
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.store.store import ArtifactStore

SMALL = (
    "models.tokenizer=null", "models.base=null", "models.teacher=null", "models.segmenter=null",
    "train_tokenizer={channels: 8, steps: 2, fit_clips: 2, refinement_width: 8, refinement_depth: 1, batch_size: 2}",
    "train_stage1.model={latent_channels: 8, hidden_size: 32, num_heads: 2, num_layers: 2}", "train_stage2.relational=null",
    "distill.clips={lengths: [17]}",
    "curate.sources=[{kind: episode_set, path: artifacts/shipped/recordings, name: shipped, include: ["
    "ur5e_silver-test-s1-00000, ur5e_silver-train-s1-00000, ur5e_silver-train-s1-00001]}]",
)  # fmt: skip
WANTED = [
    "curate",
    "filter",
    "render_actions",
    "train_tokenizer",
    "encode_latents",
    "train_stage1",
    "train_stage2",
    "distill",
]
EPISODE = "ur5e_silver-test-s1-00000"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory, project_root: Path) -> Path:
    """A store with everything that a run makes up to its causal model."""
    root = tmp_path_factory.mktemp("own") / "artifacts"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(project_root)
        made: dict[str, Path] = {}
        for name, call in outline(chain, PipelineConfig.load("smoke", None, SMALL)).items():
            if name in WANTED:
                inputs = {key: s if isinstance(s, Path) else made[s.name] for key, s in call.inputs.items()}
                made[name] = call.task.run(ArtifactStore(root), call.config, inputs).path
    return root


def only(store: Path, step: str) -> Path:
    (folder,) = (path.parent for path in store.glob(f"{step}/*/manifest.json"))
    return folder


def test_a_folder_of_the_store_finds_its_tokenizer(store: Path, tmp_path: Path) -> None:
    own = only(store, "distill")
    for folder in (own, own / "teacher_forcing", only(store, "train_stage2")):
        world = WorldLine.from_pretrained(folder)
        assert world.info.kind in ("causal", "stage2")
    moved = tmp_path / "moved"
    shutil.copytree(store, moved, ignore=shutil.ignore_patterns("encode_latents"))
    WorldLine.from_pretrained(only(moved, "train_stage2"))  # without the artifact that names the tokenizer
    shutil.rmtree(moved / "train_tokenizer")
    with pytest.raises(
        CheckpointError, match=r"(?s)tokenizer is not here.*tokenizer [0-9a-f]{16} at.*tokenizer=\.\.\."
    ):
        WorldLine.from_pretrained(only(moved, "distill"))


def test_a_published_model_carries_its_tokenizer(store: Path, tmp_path: Path) -> None:
    main(["export", str(only(store, "distill")), "--format", "model", "--output", str(tmp_path)])
    there, here = WorldLine.from_pretrained(tmp_path / "model"), WorldLine.from_pretrained(only(store, "distill"))
    assert there.info == here.info
    assert "WorldLine causal" in (tmp_path / "model" / "README.md").read_text()
    with pytest.raises(SystemExit):
        main(["export", str(only(store, "train_stage1")), "--format", "model", "--output", str(tmp_path / "other")])
    WorldLine.from_pretrained(only(store, "distill"), tokenizer=tmp_path / "model" / "tokenizer")


def test_an_own_model_is_a_gymnasium_environment(store: Path) -> None:
    gymnasium = pytest.importorskip("gymnasium")
    from worldline_core.environment import ENVIRONMENT

    environment = gymnasium.make(ENVIRONMENT, model=only(store, "distill"), embodiment="ur5e_silver", success=None)
    first, _ = environment.reset(seed=0)
    seen = environment.step(environment.action_space.sample())[0]
    assert first.keys() == seen.keys()


@contextlib.contextmanager
def command(verb: str, *settings: str) -> Iterator[str]:
    """The address of a server that a console command starts."""
    given = [part for text in ("port=0", *settings) for part in ("--set", text)]
    with subprocess.Popen(
        [sys.executable, "-m", "flows.command_line", verb, *given], stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            address = process.stdout.readline().strip().rpartition(" at ")[2].removesuffix("/v1")
            deadline = time.monotonic() + 30
            while time.monotonic() < deadline:  # the line comes before the first connection is taken
                with contextlib.suppress(httpx.TransportError):
                    httpx.get(f"{address.replace('ws', 'http')}/healthz")
                    break
                time.sleep(0.05)
            yield address
        finally:
            process.terminate()


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["serve", "play"])
def test_an_own_model_is_served(store: Path, verb: str) -> None:
    pytest.importorskip("msgpack")
    pytest.importorskip("uvicorn")
    from worldline_core.serving.client import SimulatorClient

    with command(verb, f"model={only(store, 'distill')}") as address, SimulatorClient(address) as client:
        simulation = client.start(EPISODE, seeds=[1])
        controls = np.repeat(simulation.state[:, None], simulation.frames_per_step, 1)
        (frames,) = simulation.step(controls)
        assert frames["head"].shape == (simulation.frames_per_step, 64, 96, 3)
        assert "<html" in httpx.get(f"{address.replace('ws', 'http')}/play").text
