"""The verbs: each step's version, core function, configuration and inputs.

Functions and configs are named, not imported: listing the steps costs nothing, and running one imports only that one.

Freed memory stays with the process.

glibc gives large freed blocks back to the kernel at once; the next tensor of that size has every page mapped and zeroed
anew, which slows models on a CPU.
"""

from __future__ import annotations

import ctypes
import importlib
import logging
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from worldline_core.config import StrictModel
from worldline_core.errors import ArtifactError, ConfigError
from worldline_core.store.artifact_files import read_json
from worldline_core.store.atomic import write_json_atomic
from worldline_core.store.store import Artifact, ArtifactStore

if TYPE_CHECKING:
    from worldline_core.scale.mapping import ShardMapper


logger = logging.getLogger(__name__)

_TRIM_THRESHOLD, _MMAP_MAX, _ARENA_MAX = -1, -4, -8  # malloc.h
_NEVER = 2**31 - 1
_MOST_THREADS = 1024


def keep_freed_memory() -> bool:
    """Tell the C library to keep freed blocks for the next allocation; true where it does.

    Peak memory stays what it is, but is given back only when the process ends. A choice made in the environment
    (MALLOC_..., GLIBC_TUNABLES, another allocator in LD_PRELOAD) is left alone, and other C libraries know no such thing.
    """
    if any(name.startswith("MALLOC_") or name in ("GLIBC_TUNABLES", "LD_PRELOAD") for name in os.environ):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):
        return False
    # Threads share one arena: those of threads are small, and what does not fit into them is mapped and unmapped again.
    settings = ((_MMAP_MAX, 0), (_TRIM_THRESHOLD, _NEVER), (_ARENA_MAX, 1))
    done = [bool(mallopt(parameter, value)) for parameter, value in settings]
    return all(done)


@contextmanager
def same_threads(output: Path) -> Iterator[None]:
    """Work that is continued gets as many threads of linear algebra as it began with: sums in another order round
    otherwise, and its bytes would depend on where it was stopped."""
    torch = sys.modules.get("torch")
    if torch is None:
        yield
        return
    path, now = output / "run" / "threads.json", torch.get_num_threads()
    begun = read_json(path).get("threads")
    if not (begun is None or (type(begun) is int and 0 < begun <= _MOST_THREADS)):
        raise ArtifactError("Not a number of threads", where=path, got=begun, next_step="delete the unfinished folder")
    if begun not in (None, now):
        logger.info("continuing on %d threads, as it began, instead of %d", begun, now)
        torch.set_num_threads(begun)
    elif begun is None:
        write_json_atomic(path, {"threads": now})
    try:
        yield
    finally:
        torch.set_num_threads(now)


@dataclass(frozen=True)
class Step:
    """One verb of the pipeline.

    ``version`` is raised whenever the step's code changes what it produces: it is part of the cache key.
    ``inputs`` are the names it needs; a name ending in ``.*`` stands for any number of inputs (``rollouts.stage2``).
    """

    name: str
    version: int
    module: str
    function: str
    config: str
    inputs: tuple[str, ...]
    optional_inputs: tuple[str, ...] = ()
    summary: str = ""
    distributed: bool = False
    """Whether the processes that torchrun starts share its work."""
    mapped: bool = False
    """Whether its function takes a `mapper` and hands it shards of episodes."""

    def load_function(self) -> Callable[..., dict[str, Any]]:
        return getattr(importlib.import_module(self.module), self.function)

    def load_config(self) -> type[StrictModel]:
        module, _, name = self.config.rpartition(".")
        return getattr(importlib.import_module(f"worldline_core.{module}"), name)

    def check_inputs(self, names: Mapping[str, Any]) -> None:
        """Raises ConfigError for a missing or an unknown input."""
        allowed = self.inputs + self.optional_inputs
        unknown = [name for name in names if not any(_matches(name, pattern) for pattern in allowed)]
        missing = [pattern for pattern in self.inputs if not any(_matches(name, pattern) for name in names)]
        if unknown or missing:
            raise ConfigError(
                f"The inputs of {self.name} do not fit",
                expected=f"{', '.join(self.inputs) or 'none'}"
                + (f"; optional: {', '.join(self.optional_inputs)}" if self.optional_inputs else ""),
                got=f"missing {missing}, unknown {unknown}",
                next_step=f"give each as --input NAME=FOLDER, or run the steps before {self.name} with the same preset",
            )


def _matches(name: str, pattern: str) -> bool:
    return pattern == "*" or (name.startswith(pattern[:-1]) if pattern.endswith(".*") else name == pattern)


_STEPS = (
    Step(
        "curate",
        5,
        "worldline_core.data.curation.curate",
        "curate",
        "data.curation.curate_config.CurateConfig",
        (),
        ("source.*",),
        summary="read recordings of any source into one EpisodeSet",
        mapped=True,
    ),
    Step(
        "filter",
        6,
        "worldline_core.filters.filter",
        "filter_episodes",
        "filters.filter_config.FilterConfig",
        ("episodes",),
        summary="drop static, reset, corrupted, moving-base, misaligned and badly calibrated segments",
        mapped=True,
    ),
    Step(
        "render_actions",
        6,
        "worldline_core.actions.render_actions",
        "render_actions",
        "actions.actions_config.RenderActionsConfig",
        ("episodes",),
        summary="project the controls into every view: action tracks and overlay previews",
        mapped=True,
    ),
    Step(
        "encode_latents",
        3,
        "worldline_core.training.encode_latents",
        "encode_latents",
        "training.clip_config.EncodeLatentsConfig",
        ("episodes", "tokenizer"),
        summary="cache the video tokenizer's latents",
        mapped=True,
    ),
    Step(
        "import_backbone",
        2,
        "worldline_core.model.cosmos3",
        "import_backbone",
        "model.world_model_config.ImportBackboneConfig",
        ("diffusers",),
        summary="turn pretrained Cosmos3 weights into the base checkpoint",
    ),
    Step(
        "train_tokenizer",
        3,
        "worldline_core.training.train_tokenizer",
        "train_tokenizer",
        "training.training_config.TokenizerConfig",
        ("episodes",),
        ("start", "encoder", "held_out"),
        summary="fit the small video tokenizer of the embedded default, or a small decoder for any tokenizer's latents",
    ),
    Step(
        "train_teacher",
        2,
        "worldline_core.training.video_teacher",
        "train_teacher",
        "training.training_config.TeacherConfig",
        ("episodes",),
        summary="train the small relational teacher of the embedded default",
    ),
    Step(
        "train_segmenter",
        2,
        "worldline_core.evaluation.segmenters.train_segmenter",
        "train_segmenter",
        "evaluation.evaluation_config.SegmenterConfig",
        ("episodes",),
        ("evaluation",),
        summary="train the small robot segmenter of the embedded default",
    ),
    Step(
        "train_stage1",
        2,
        "worldline_core.training.stage1",
        "train_stage1",
        "training.training_config.Stage1Config",
        ("episodes",),
        ("latents", "tokenizer", "base"),
        summary="Stage I: action-free, text-conditioned video prediction",
        distributed=True,
    ),
    Step(
        "train_stage2",
        3,
        "worldline_core.training.stage2",
        "train_stage2",
        "training.training_config.Stage2Config",
        ("tracks", "episodes", "stage1"),
        ("latents", "tokenizer", "teacher"),
        summary="Stage II: action-driven three-view prediction on successes and failures",
        distributed=True,
    ),
    Step(
        "distill",
        4,
        "worldline_core.distillation.distill",
        "distill",
        "distillation.distill_config.DistillConfig",
        ("tracks", "episodes", "stage2", "tokenizer"),
        ("latents",),
        summary="Stage III: teacher forcing, trajectory regression, distribution matching",
        distributed=True,
    ),
    Step(
        "rollout",
        2,
        "worldline_core.rollout.rollout",
        "rollout",
        "rollout.rollout_config.RolloutConfig",
        ("episodes", "tracks", "tokenizer"),
        ("checkpoint",),
        summary="predict videos from a first observation and controls",
    ),
    Step(
        "import_rollouts",
        1,
        "worldline_core.rollout.import_rollouts",
        "import_rollouts",
        "rollout.rollout_config.ImportRolloutsConfig",
        ("videos", "episodes"),
        summary="any folder of predicted videos as a set of rollouts, every file accounted for",
    ),
    Step(
        "evaluate_video",
        3,
        "worldline_core.evaluation.video.evaluate_video",
        "evaluate_video",
        "evaluation.evaluation_config.VideoEvaluationConfig",
        ("episodes", "tracks", "rollouts.*"),
        ("segmenter",),
        summary="PSNR, SSIM, LPIPS, robot-mask and object IoU",
    ),
    Step(
        "evaluate_policy",
        6,
        "worldline_core.evaluation.policy.evaluate_policy",
        "evaluate_policy",
        "evaluation.evaluation_config.PolicyEvaluationConfig",
        ("episodes", "rollouts.*"),
        ("tracks", "segmenter"),
        summary="evidence, rules, accuracy against the recorded outcome",
    ),
    Step(
        "evaluate_planning",
        5,
        "worldline_core.evaluation.planning.evaluate_planning",
        "evaluate_planning",
        "evaluation.evaluation_config.PlanningConfig",
        ("banks", "rollouts.*"),
        ("tracks", "segmenter", "sealed"),
        summary="bracket selection among candidate controls, success of the choice",
    ),
    Step(
        "ablation_table",
        2,
        "worldline_core.report.ablation_table",
        "ablation_table",
        "report.ablation_table.AblationTableConfig",
        ("evaluate_video.*",),
        ("evaluate_planning.*",),
        summary="the paper's ablations as one table beside the paper's numbers",
    ),
    Step(
        "report",
        15,
        "worldline_core.report.report",
        "report",
        "report.context.ReportConfig",
        (),
        ("*",),
        summary="static pages with tables, plots and videos",
    ),
)
STEPS: dict[str, Step] = {step.name: step for step in _STEPS}


def get_step(name: str) -> Step:
    """Raises ConfigError, listing the steps, for an unknown name."""
    if name not in STEPS:
        raise ConfigError("Unknown step", expected=f"one of {', '.join(STEPS)}", got=name)
    return STEPS[name]


def run_step(
    store: ArtifactStore, name: str, config: StrictModel, inputs: Mapping[str, Path], mapper: ShardMapper | None = None
) -> Artifact:
    """Run one step on the store (or find its finished artifact).

    Args:
        mapper: what works on the episodes of a step that maps them; by default this process.
    """
    step = get_step(name)
    step.check_inputs(inputs)
    keep_freed_memory()
    options = {"mapper": mapper} if step.mapped else {}

    def work(config: StrictModel, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
        function = step.load_function()
        if step.distributed:
            from worldline_core.pipeline.memory_estimate import require_memory

            require_memory(config, inputs)
        with same_threads(output):
            return function(config, inputs, output, **options)

    return store.run(step.name, step.version, work, config, inputs, distributed=step.distributed)
