"""One arm with one camera, and with two that nobody calibrated, through every step of a run and into the hands of a policy."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from flows.pipeline import chain
from tasks.execution.chain import outline
from worldline_core import WorldLine
from worldline_core.data.episodes.episode_set import EpisodeSet, EpisodeSetWriter
from worldline_core.model.checkpoint import read_checkpoint_info
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.report.comparison import compare_runs, drawn_and_not
from worldline_core.rollout.rollout_set import RolloutSet
from worldline_core.store.store import ArtifactStore

WITHOUT_BANKS = ("curate_banks=null", "evaluate_planning=null", "rollouts.banks_causal=null", "filter={}")
SPLITS = ("train", "train", "train", "validation", "test", "test")
SUBSETS = tuple(f"{step}.clips.view_weights={{joint: 0.5, subset: 0.5}}" for step in ("train_stage2", "distill"))

VECTORS = ("train_stage2.native_size=9", "train_stage2.vector_share=0.5")
BLIND = ("rollouts.blind={checkpoint: stage2, config: {method: blind, sampler: {kind: full_clip, steps: 2}, num_frames: 17, "
         "splits: [test, ood_test], cameras: false}}")  # fmt: skip


def write_single_arm(project_root: Path, root: Path, views: tuple[str, ...], cameras: tuple[str, ...]) -> Path:
    """Recordings of one arm, in some views, with the cameras of some of these."""
    shipped = EpisodeSet.open(project_root / "artifacts" / "shipped" / "recordings")
    chosen = [number for number, row in enumerate(shipped.rows) if row.embodiment == "xarm7_single"]
    with EpisodeSetWriter(root) as writer:
        for split, number in zip(SPLITS, chosen, strict=True):
            episode = shipped.episode(number)
            known = {view: episode.cameras[view] for view in cameras}
            frames = {view: shipped.frames(number, view, range(episode.num_frames)) for view in views}
            writer.add(replace(episode, split=split, scene=split, cameras=known, primary_view="head"), frames)
    return root


@pytest.mark.slow
@pytest.mark.parametrize(
    ("views", "cameras", "changes"),
    [
        (("head",), ("head",), ()),
        (("head", "right_wrist"), ("head",), (*VECTORS, *SUBSETS, BLIND)),
        (("head", "right_wrist"), (), (*VECTORS, "render_actions=null")),
    ],
)
def test_one_arm_goes_through_every_step(
    project_root: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    views: tuple[str, ...],
    cameras: tuple[str, ...],
    changes: tuple[str, ...],
) -> None:
    made = write_single_arm(project_root, tmp_path / "made", views, cameras)
    monkeypatch.chdir(project_root)
    source = f"curate.sources=[{{kind: episode_set, path: {made}, name: single}}]"
    config = PipelineConfig.load("smoke", None, (*WITHOUT_BANKS, source, *changes))
    store, folders = ArtifactStore(tmp_path / "artifacts"), dict[str, Path]()
    for name, call in outline(chain, config).items():
        inputs = {key: given if isinstance(given, Path) else folders[given.name] for key, given in call.inputs.items()}
        folders[name] = call.task.run(store, call.config, inputs).path

    for step in ("train_stage2", "distill"):
        info = read_checkpoint_info(folders[step])
        assert info.view_sets == ((views, ("head",)) if SUBSETS[0] in changes else (views,))
        assert (info.vectors is None) == (VECTORS[0] not in changes)
    for method in ("stage2", "causal"):
        found = RolloutSet.open(folders[f"rollout.{method}"])
        assert len(found.episode_ids) == 2
        assert {(row.episode_id, row.view) for row in found.rows} == set(product(found.episode_ids, views))
    assert (folders["report"] / "index.html").is_file()
    if BLIND in changes:
        place = str(folders["evaluate_video"])
        assert drawn_and_not(place) == [("stage2", "blind")]
        assert any(row.difference for row in compare_runs(place, place, ("stage2", "blind")))

    gymnasium = pytest.importorskip("gymnasium")
    pytest.importorskip("uvicorn")
    from worldline_core.environment import ENVIRONMENT
    from worldline_core.serving.serve_config import ServeConfig
    from worldline_core.serving.session_host import SessionHost

    world = WorldLine.from_pretrained(folders["distill"])
    environment = gymnasium.make(ENVIRONMENT, model=world, recordings=folders["filter"], success=None)
    first, _ = environment.reset(seed=0)
    assert set(first["pixels"]) == set(views)
    assert environment.step(first["agent_pos"])[0]["agent_pos"].shape == (8,)
    host = SessionHost(world, ServeConfig.model_validate({"episodes": folders["filter"]}))
    simulation = host.simulate(host.starts.rows[0].episode_id, [1, 2])
    frames = simulation.step(np.repeat(simulation.state[:, None], simulation.frames_per_step, 1))
    assert set(frames[0]) == set(views)
    host.shut_down()
