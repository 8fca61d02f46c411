"""A preset at small size: the same file with listed changes of size, small models, and shipped recordings at the preset's rate and
with the length of real ones, with three views and with two."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from worldline_core.config import load_config
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.episodes.episode_set_writer import EpisodeSetWriter
from worldline_core.geometry.transforms import nearest_rotation
from worldline_core.pipeline.ablations import choose_variants, variant_config
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.processor import processor_has_bfloat16
from worldline_core.rehearsal.outside_models import write_outside_models
from worldline_core.shipped import shipped_folder
from worldline_core.store.atomic import write_bytes_atomic

CHANGES_FILE = "changes.md"
RECORDINGS, TWO_VIEW_RECORDINGS = "recordings", "recordings_two_views"

WEIGHTS = "weights"
_SMALL = "its small version"
_SLOW = "the processor has no bfloat16"
_IN_FLOAT32: tuple[tuple[str, Any, str], ...] = (
    ("*.precision", "fp32", _SLOW),
    ("*.bfloat16", False, _SLOW),
    ("*.trainer.weights", "fp32", _SLOW),
    ("rollouts.*.weights", "float32", _SLOW),
)
SIZES: tuple[tuple[str, Any, str], ...] = (
    (
        "curate.sources",
        [{"kind": "episode_set", "path": name, "name": name} for name in (RECORDINGS, TWO_VIEW_RECORDINGS)],
        "small recordings of three views, and of two for evaluation",
    ),
    ("models.tokenizer", f"{WEIGHTS}/{{backbone}}/vae", _SMALL),
    ("models.base", f"{WEIGHTS}/base", _SMALL),
    ("models.teacher", f"{WEIGHTS}/vjepa2-vitg-fpc64-384", _SMALL),
    ("*.text.path", f"{WEIGHTS}/{{backbone}}/text_tokenizer", _SMALL),
    ("*.lpips_weights", f"{WEIGHTS}/lpips", _SMALL),
    ("*.sam3_weights", f"{WEIGHTS}/sam3", _SMALL),
    ("evaluate_policy.vlm.weights", f"{WEIGHTS}/Qwen3-VL-8B-Instruct", _SMALL),
    ("*image_size", [64, 96], "pictures of the recordings"),
    ("*device", "cpu", "no accelerator"),
    ("*.workers", 1, "two cores"),
    ("distill.distribution_matching.trainer.steps", 6, "one cycle"),
    ("distill.*.trainer.steps", 2, "long enough for a state and an average"),
    ("*.trainer.steps", 4, "long enough for a log, a state and an average"),
    ("*.trajectories.clips", 2, "one batch a process"),
    ("*.relational.student_layer", 2, "the model has 4 layers where 36 are published"),
    ("encode_latents.start_step", 96, "starts of cached clips"),
    ("rollouts.causal.*.seeds", [42, 43], "enough for a mean over seeds"),
    ("rollouts.*.seeds", [42], "one seed is enough beside them"),
    ("rollouts.*.steps", 4, "Euler steps of a whole clip"),
    ("runner.steps_at_once", 2, "two cores"),
)
"""Pattern of a dotted key, its small value, and why; the first that fits holds. What no pattern names stays as it is."""


ABLATION_SIZES: tuple[tuple[str, Any, str], ...] = (
    ("rollouts.*.seeds", [42], "six models are evaluated"),
    ("rollouts.*.num_frames", 33, "six models are evaluated"),
)

ALWAYS = ("curate.sources", "encode_latents.start_step", "runner.steps_at_once")
"""Changed whatever they are; of the others nothing is made larger, and what is off stays off."""


@dataclass(frozen=True)
class Change:
    """One value of the preset that the rehearsal changes."""

    key: str
    published: Any
    rehearsed: Any
    why: str

    @property
    def override(self) -> str:
        """The change as a value of ``--set``."""
        return f"{self.key}={json.dumps(self.rehearsed)}"


def changes_of(
    preset: str | None, path: Path | None, overrides: Sequence[str], sizes: Sequence[tuple[str, Any, str]] = SIZES
) -> list[Change]:
    """The values that a rehearsal of this configuration changes.

    Raises:
        ConfigError: the configuration is not valid, or not with its changes.
    """

    def values(more: Sequence[str] = ()) -> dict[str, Any]:
        config = PipelineConfig.load(preset, path, [*overrides, *more])
        return dict(_leaves(config.model_dump(mode="json")))

    if not processor_has_bfloat16():
        sizes = (*sizes, *_IN_FLOAT32)
    small: list[Change] = []
    before = values()
    backbone = f"Cosmos3-{before.get('import_backbone.size', 'nano').title()}"
    for key, value in before.items():
        size = next((size for size in sizes if fnmatchcase(key, size[0])), None)
        if size is None or (size[2] == _SMALL and str(value).startswith(f"{WEIGHTS}/")):
            continue  # small versions are where the preset expects the published ones
        rehearsed = size[1].format(backbone=backbone) if size[2] == _SMALL else size[1]
        if key in ALWAYS or _larger(value, rehearsed):
            small.append(Change(key, value, rehearsed, size[2]))
    after = values([change.override for change in small])
    return [change for change in small if after[change.key] != change.published]


def _larger(value: Any, small: Any) -> bool:
    if isinstance(value, int) and isinstance(small, int):
        return value > small
    if isinstance(value, list) and isinstance(small, list):
        equally_long = len(value) == len(small)
        return len(value) > len(small) or (equally_long and any(v > s for v, s in zip(value, small, strict=True)))
    return value is not None and value != small


def _leaves(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def table(changes: Sequence[Change]) -> str:
    """The changes as a table in Markdown."""
    rows = [(c.key, _shown(c.published), _shown(c.rehearsed), c.why) for c in changes]
    lines = [("key", "preset", "rehearsal", "why"), ("---",) * 4, *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _shown(value: Any) -> str:
    """A value as JSON; recordings by their folders alone."""
    sources = isinstance(value, list) and all(isinstance(item, Mapping) and "path" in item for item in value)
    return json.dumps([item["path"] for item in value] if sources else value)


def prepare(
    folder: Path, preset: str | None, path: Path | None, overrides: Sequence[str], *, ablations: bool = True
) -> tuple[list[Change], list[Change]]:
    """Write outside models, recordings and the list of changes into ``folder``; what is there already is kept.

    Returns the changes, and those of the ablations.

    Raises:
        ConfigError: the configuration is not valid, or not with its changes, or has nothing to ablate.
    """
    changes = changes_of(preset, path, overrides)
    changed = [*overrides, *(change.override for change in changes)]
    lists = {"What the rehearsal changes; all else is as the file says": changes}
    ablated: list[Change] = []
    if ablations:  # mistakes in their configuration are reported now, not at the end
        ablated = lists["In the ablations"] = changes_of(preset, path, changed, ABLATION_SIZES)
        load = partial(load_config, PipelineConfig, preset=preset, path=path)
        for variant in choose_variants().values():
            variant_config(lambda more: load(overrides=[*changed, *more]), variant)
    folder.mkdir(parents=True, exist_ok=True)
    text = "\n\n".join(f"{title}:\n\n{table(rows)}" for title, rows in lists.items())
    write_bytes_atomic(folder / CHANGES_FILE, f"# {preset or path}\n\n{text}\n".encode())
    if not (folder / WEIGHTS).is_dir():
        shutil.rmtree(folder / f"{WEIGHTS}.partial", ignore_errors=True)
        write_outside_models(folder / f"{WEIGHTS}.partial")
        (folder / f"{WEIGHTS}.partial").rename(folder / WEIGHTS)
    fps = PipelineConfig.load(preset, path, changed).curate.fps or FPS
    for name, episodes, split in ((RECORDINGS, THREE_VIEWS, None), (TWO_VIEW_RECORDINGS, TWO_VIEWS, "test")):
        if not (folder / name / "index.parquet").is_file():
            write_recordings(folder / name, episodes, fps=fps, split=split)
    return changes, ablated


FPS, FRAMES = 30.0, 129
THREE_VIEWS = tuple(
    f"ur5e_silver-{name}"
    for name in ("train-s1-00003", "train-s1-00004", "validation-s1-00000", "test-s1-00001", "test-s1-00004")
)
"""One body: successes and failures to train on, one to validate, and of one task a success and a failure to test."""
TWO_VIEWS = ("xarm7_single-train-s1-00000", "xarm7_single-train-s1-00001")
"""A head and a wrist camera, a failure and a success; here they are for evaluation alone."""


def write_recordings(folder: Path, episodes: Sequence[str], *, fps: float = FPS, split: str | None = None) -> None:
    """Write shipped recordings as an EpisodeSet of ``fps`` frames a second and 129 frames, the same bytes every time.

    States, commands, camera poses and pictures between two recorded moments are interpolated; the movement takes a twentieth
    longer than it did.

    Args:
        split: given to all of them; by default each keeps its own.
    """
    shipped = EpisodeSet.open(shipped_folder() / "recordings")
    with EpisodeSetWriter(folder, video_crf=10, video_preset="ultrafast") as writer:
        for name in episodes:
            position = shipped.position(name)
            episode = shipped.episode(position)
            moments = np.linspace(0, episode.num_frames - 1, FRAMES)
            frames = {view: _between(shipped.frames(position, view), moments) for view in shipped.rows[position].views}
            changed = resampled(episode, moments, fps)
            writer.add(
                replace(changed, split=split or episode.split),
                {view: np.rint(values).astype(np.uint8) for view, values in frames.items()},
            )


def resampled(episode: Episode, moments: np.ndarray, fps: float = FPS) -> Episode:
    """The episode at ``fps`` frames a second, one for each of ``moments`` (frame numbers with fractions)."""
    return replace(
        episode,
        fps=fps,
        timestamps=np.arange(len(moments)) / fps,
        video_frames=None,
        cameras={view: _moved(camera, moments) for view, camera in episode.cameras.items()},
        **{name: _poses(values, moments) if name == "T_base_ee" else _between(values, moments)
           for name, values in episode.arrays().items()},
    )  # fmt: skip


def _moved(camera: CameraTrack, moments: np.ndarray) -> CameraTrack:
    return replace(camera, T_base_camera=_poses(camera.T_base_camera, moments)) if camera.moving else camera


def _poses(poses: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """Poses ``(..., 4, 4)`` between recorded ones: positions linearly, rotations nearest to the mixed matrices."""
    mixed = _between(poses, moments)
    mixed[..., :3, :3] = nearest_rotation(mixed[..., :3, :3])
    return mixed


def _between(values: np.ndarray, moments: np.ndarray) -> np.ndarray:
    before = np.floor(moments).astype(int)
    after = np.minimum(before + 1, len(values) - 1)
    share = (moments - before).reshape(-1, *[1] * (values.ndim - 1))
    return values[before] * (1 - share) + values[after] * share
