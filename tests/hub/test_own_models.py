"""A model of one's own, trained by the pipeline's tasks: loaded by its folder, driven and published."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from flows.command_line import main
from flows.pipeline import chain
from tasks.execution.chain import outline
from worldline_core import WorldLine
from worldline_core.errors import CheckpointError
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.store.store import ArtifactStore

pytestmark = pytest.mark.slow

SMALL = (
    "models.tokenizer=null", "models.base=null", "models.teacher=null", "models.segmenter=null",
    "train_tokenizer={channels: 8, steps: 2, fit_clips: 2, refinement_width: 8, refinement_depth: 1, batch_size: 2}",
    "train_stage1.model={latent_channels: 8, hidden_size: 32, num_heads: 2, num_layers: 2}", "train_stage2.relational=null",
    "distill.clips={lengths: [17]}", "distill.distribution_matching.trainer.steps=2",
    "distill.distribution_matching.trainer.log_every=2",
    "curate.sources=[{kind: episode_set, path: artifacts/shipped/recordings, name: shipped, include: ["
    "ur5e_silver-test-s1-00000, ur5e_silver-train-s1-00000]}]",
)  # fmt: skip
WANTED = (
    "curate", "filter", "render_actions", "train_tokenizer", "encode_latents", "train_stage1", "train_stage2", "distill",
)  # fmt: skip


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
        assert WorldLine.from_pretrained(folder).info.kind in ("causal", "stage2")
    moved = tmp_path / "moved"
    shutil.copytree(store, moved, ignore=shutil.ignore_patterns("encode_latents"))
    WorldLine.from_pretrained(only(moved, "train_stage2"))  # without the artifact that names the tokenizer
    shutil.rmtree(moved / "train_tokenizer")
    with pytest.raises(CheckpointError, match=r"(?s)tokenizer [0-9a-f]{16} at.*tokenizer=\.\.\."):
        WorldLine.from_pretrained(only(moved, "distill"))


def test_a_published_model_carries_its_tokenizer(store: Path, tmp_path: Path) -> None:
    own, options = only(store, "distill"), ["--format", "model", "--output"]
    main(["export", str(own), *options, str(tmp_path)])
    there, here = WorldLine.from_pretrained(tmp_path / "model"), WorldLine.from_pretrained(own)
    assert there.info == here.info
    assert "WorldLine causal" in (tmp_path / "model" / "README.md").read_text()
    with pytest.raises(SystemExit):
        main(["export", str(only(store, "train_stage1")), *options, str(tmp_path / "other")])
    WorldLine.from_pretrained(own, tokenizer=tmp_path / "model" / "tokenizer")


def test_an_own_model_is_a_gymnasium_environment(store: Path) -> None:
    gymnasium = pytest.importorskip("gymnasium")
    from worldline_core.environment import ENVIRONMENT

    environment = gymnasium.make(ENVIRONMENT, model=only(store, "distill"), embodiment="ur5e_silver", success=None)
    first, _ = environment.reset(seed=0)
    seen = environment.step(environment.action_space.sample())[0]
    assert first.keys() == seen.keys()
