"""What flows where, as data: the nodes of a run and the artifacts that feed each of them.

The flow runs the nodes as Prefect tasks, a standalone task finds its inputs here; both therefore meet in the store.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

from worldline_core.config import StrictModel
from worldline_core.distillation.distill_config import DistillConfig
from worldline_core.errors import ArtifactError, ConfigError
from worldline_core.evaluation.evaluation_config import VideoEvaluationConfig
from worldline_core.pipeline.pipeline_config import PipelineConfig, RolloutRun, source_inputs
from worldline_core.pipeline.steps import get_step, run_step
from worldline_core.scale.mapping import ShardMapper
from worldline_core.shipped import project_path
from worldline_core.store.store import Artifact, ArtifactStore
from worldline_core.training.clip_config import FrameInput
from worldline_core.training.training_config import StageConfig


@dataclass(frozen=True)
class Node:
    """One step of a run. ``inputs`` maps the step's input names to other nodes (str) or to folders (Path)."""

    name: str
    step: str
    config: StrictModel
    inputs: Mapping[str, str | Path]


def plan(config: PipelineConfig, project: Path) -> list[Node]:
    """The nodes of a run, each after those it needs. Relative folders are taken from ``project``."""
    return list(_nodes(config, project))


def _nodes(config: PipelineConfig, project: Path) -> Iterator[Node]:
    models = {
        name: project_path(project, path) for name, path in config.models.model_dump().items() if path is not None
    }
    yield Node("curate", "curate", config.curate, source_inputs(config.curate, project))
    yield Node("filter", "filter", config.filter, {"episodes": "curate"})
    yield Node("render_actions", "render_actions", config.render_actions, {"episodes": "filter"})
    if caches_latents(config):
        encoded: dict[str, str | Path] = {"episodes": "filter", "tokenizer": models["tokenizer"]}
        yield Node("encode_latents", "encode_latents", config.encode_latents, encoded)

    def clips(stage: StageConfig | DistillConfig) -> dict[str, str | Path]:
        """A stage's episodes, and what makes latents of their clips: the cache, or the tokenizer itself."""
        if isinstance(stage.input, FrameInput):
            return {"episodes": "filter", "tokenizer": models["tokenizer"]}
        return {"episodes": "filter", "latents": "encode_latents"}

    base: dict[str, str | Path] = {"base": models["base"]} if "base" in models else {}
    if config.train_stage1 is not None:
        yield Node("train_stage1", "train_stage1", config.train_stage1, {**clips(config.train_stage1), **base})
    start = models["base"] if config.train_stage1 is None else "train_stage1"
    teacher: dict[str, str | Path] = {"teacher": models["teacher"]} if "teacher" in models else {}
    yield Node(
        "train_stage2",
        "train_stage2",
        config.train_stage2,
        {**clips(config.train_stage2), "tracks": "render_actions", "stage1": start, **teacher},
    )
    yield Node(
        "distill",
        "distill",
        config.distill,
        {
            **clips(config.distill),
            "tracks": "render_actions",
            "stage2": "train_stage2",
            "tokenizer": models["tokenizer"],
        },
    )
    if config.curate_banks is not None:
        yield Node("curate.banks", "curate", config.curate_banks, source_inputs(config.curate_banks, project))
        yield Node("render_actions.banks", "render_actions", config.render_actions, {"episodes": "curate.banks"})
    for name, run in config.rollouts.items():
        yield _rollout_node(name, run, models, project)
    yield from _evaluation_nodes(config, models, project)


def caches_latents(config: PipelineConfig) -> bool:
    """Whether a step reads latents that were made before it."""
    stages = (config.train_stage1, config.train_stage2, config.distill)
    return any(stage is not None and not isinstance(stage.input, FrameInput) for stage in stages)


def _rollout_node(name: str, run: RolloutRun, models: Mapping[str, Path], project: Path) -> Node:
    banks = run.episodes == "banks"
    if run.imported is not None and run.videos is not None:
        episodes = "curate.banks" if banks else "filter"
        videos = project_path(project, run.videos)
        return Node(f"rollout.{name}", "import_rollouts", run.imported, {"episodes": episodes, "videos": videos})
    checkpoints: dict[str, str | Path] = {
        "stage1": "train_stage1",
        "stage2": "train_stage2",
        "causal": "distill",
        **{f"shipped_{kind}": models[kind] for kind in ("stage2", "causal") if kind in models},
        **{name: path for name, path in models.items() if name == "base"},
    }
    inputs: dict[str, str | Path] = {
        "episodes": "curate.banks" if banks else "filter",
        "tracks": "render_actions.banks" if banks else "render_actions",
        "tokenizer": models["tokenizer"],
    }
    if run.checkpoint is not None:
        inputs["checkpoint"] = checkpoints[run.checkpoint]
    return Node(f"rollout.{name}", "rollout", cast("StrictModel", run.config), inputs)


def _evaluation_nodes(config: PipelineConfig, models: Mapping[str, Path], project: Path) -> Iterator[Node]:
    segmenter: dict[str, str | Path] = {"segmenter": models["segmenter"]} if "segmenter" in models else {}

    def rollouts(episodes: str) -> dict[str, str | Path]:
        return {
            f"rollouts.{name}": f"rollout.{name}" for name, run in config.rollouts.items() if run.episodes == episodes
        }

    recordings = rollouts("recordings")
    scores: dict[str, str | Path] = {}
    if recordings:
        shared: dict[str, str | Path] = {"episodes": "filter", "tracks": "render_actions", **segmenter}
        if config.evaluate_video is not None:
            video = config.evaluate_video.of_methods([name.removeprefix("rollouts.") for name in recordings])
            yield Node("evaluate_video", "evaluate_video", video, {**shared, **recordings})
            scores["evaluate_video"] = "evaluate_video"
        if config.evaluate_policy is not None:
            yield Node("evaluate_policy", "evaluate_policy", config.evaluate_policy, {**shared, **recordings})
            scores["evaluate_policy"] = "evaluate_policy"
    if config.evaluate_planning is not None and (banks := rollouts("banks")):
        inputs: dict[str, str | Path] = {
            "banks": "curate.banks",
            "tracks": "render_actions.banks",
            **segmenter,
            **banks,
        }
        # Outcomes stay with the recordings and are opened after the choice: curation never sees them.
        if config.curate_banks is not None:
            inputs["sealed"] = source_inputs(config.curate_banks, project)["source.0"]
        yield Node("evaluate_planning", "evaluate_planning", config.evaluate_planning, inputs)
        scores["evaluate_planning"] = "evaluate_planning"
    trained = ("curate", "filter", "render_actions", "encode_latents", "train_stage1", "train_stage2", "distill")
    left_out = {"train_stage1"} if config.train_stage1 is None else set[str]()
    left_out |= set[str]() if caches_latents(config) else {"encode_latents"}
    report: dict[str, str | Path] = {name: name for name in trained if name not in left_out}
    report |= {f"rollout.{name}": f"rollout.{name}" for name in config.rollouts}
    report |= {f"models.{name}": path for name, path in models.items()}
    yield Node("report", "report", config.report, {**report, **scores})


def find_artifacts(nodes: list[Node], store: ArtifactStore) -> dict[str, Artifact]:
    """The finished artifacts among ``nodes`` (a node whose inputs are unfinished cannot be found)."""
    found: dict[str, Artifact] = {}
    for node in nodes:
        inputs = _resolve(node, found)
        if inputs is None or not all(path.is_dir() for path in inputs.values()):
            continue
        digests = {name: store.input_digest(path) for name, path in sorted(inputs.items())}
        step = get_step(node.step)
        artifact = store.find(step.name, store.key(step.name, step.version, node.config, digests))
        if artifact is not None:
            found[node.name] = artifact
    return found


def choose_node(step: str, name: str | None, nodes: list[Node]) -> str:
    """The node of a step: the named one, or the only one.

    Raises: ConfigError when there is no such node, or several and none is named.
    """
    candidates = [node.name for node in nodes if node.step == step]
    chosen = name or (step if step in candidates or not candidates else "")
    if not chosen:
        raise ConfigError(f"{step} occurs more than once in this run", expected=f"--node with one of {candidates}")
    if chosen not in candidates:
        raise ConfigError(f"This run has no such node of {step}", expected=f"one of {candidates}", got=chosen)
    return chosen


def ready_node(
    name: str, nodes: list[Node], store: ArtifactStore, given: Mapping[str, Path] | None = None
) -> tuple[Node, dict[str, Path]]:
    """A node, and the folders of its inputs: the finished artifacts of the nodes before it.

    Args:
        given: folders by input name, taken instead of the artifacts that the run would use.

    Raises:
        ConfigError: there is no such node.
        ArtifactError: an artifact that it needs is not finished; the message names the step to run first.
    """
    by_name = {node.name: node for node in nodes}
    if name not in by_name:
        raise ConfigError("Unknown node", expected=f"one of {', '.join(by_name)}", got=name)
    found = find_artifacts(nodes[: list(by_name).index(name)], store)
    node = replace(by_name[name], inputs={**by_name[name].inputs, **(given or {})})
    inputs = _resolve(node, found)
    if inputs is None:
        missing = [source for source in node.inputs.values() if isinstance(source, str) and source not in found]
        raise ArtifactError(
            f"{name} needs artifacts that are not finished",
            where=store.root,
            got=f"missing: {', '.join(missing)}",
            next_step=f"run `{_command(by_name[missing[0]])}` with the same preset first, or `worldline pipeline`",
        )
    return node, inputs


def run_node(
    name: str,
    nodes: list[Node],
    store: ArtifactStore,
    mapper: ShardMapper | None = None,
    given: Mapping[str, Path] | None = None,
) -> Artifact:
    """Run one node on the finished artifacts of those before it; arguments and errors as of :func:`ready_node`."""
    node, inputs = ready_node(name, nodes, store, given)
    return run_step(store, node.step, node.config, inputs, mapper)


def _command(node: Node) -> str:
    return f"worldline task {node.step}" + ("" if node.name == node.step else f" --node {node.name}")


def _resolve(node: Node, found: Mapping[str, Artifact]) -> dict[str, Path] | None:
    inputs: dict[str, Path] = {}
    for name, source in node.inputs.items():
        if not isinstance(source, str):
            inputs[name] = source
        elif source in found:
            inputs[name] = found[source].path
        else:
            return None
    return inputs


def without_training(nodes: list[Node]) -> list[Node]:
    """The nodes that evaluate existing checkpoints: whatever depends on a training step is left out."""
    dropped = {
        node.name for node in nodes if node.step in ("encode_latents", "train_stage1", "train_stage2", "distill")
    }
    kept: list[Node] = []
    for node in nodes:
        needed = {name: source for name, source in node.inputs.items() if source not in dropped}
        evaluates = node.step in ("evaluate_video", "evaluate_policy", "evaluate_planning")
        without_videos = evaluates and not any(name.startswith("rollouts.") for name in needed)
        without_input = len(needed) < len(node.inputs) and not evaluates and node.step != "report"
        if node.name in dropped or without_videos or without_input:
            dropped.add(node.name)
            continue
        settings = node.config
        if isinstance(settings, VideoEvaluationConfig):
            settings = settings.of_methods({name.removeprefix("rollouts.") for name in needed})
        kept.append(Node(node.name, node.step, settings, needed))
    return kept
