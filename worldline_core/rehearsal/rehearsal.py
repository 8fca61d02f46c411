"""A preset at small size: the same file with sizes changed, each change listed, over small models, and over shipped
recordings at the rate and length of real ones, with three views and with two."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from worldline_core.config import load_config
from worldline_core.data.episodes.episode import CameraTrack, Episode
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.data.episodes.episode_set_writer import EpisodeSetWriter
from worldline_core.geometry.rotations import nearest_rotation
from worldline_core.pipeline.ablations import choose_variants, variant_config
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.rehearsal.outside_models import write_outside_models
from worldline_core.shipped import shipped_folder
from worldline_core.store.atomic import atomic_path
from worldline_core.training.clip_config import ClipInput, FrameInput, LatentInput

CHANGES_FILE = "changes.md"
RECORDINGS, TWO_VIEW_RECORDINGS = "recordings", "recordings_two_views"

WEIGHTS = "weights"
_LPIPS, _SAM3 = f"{WEIGHTS}/lpips", f"{WEIGHTS}/sam3"
_SMALL = "its small version"
SIZES: tuple[tuple[str, Any, str], ...] = (
    (
        "curate.sources",
        [{"kind": "episode_set", "path": name, "name": name} for name in (RECORDINGS, TWO_VIEW_RECORDINGS)],
        "small recordings of three views, and of two for evaluation",
    ),
    ("models.tokenizer", f"{WEIGHTS}/Cosmos3-Nano/vae", _SMALL),
    ("models.base", f"{WEIGHTS}/base", _SMALL),
    ("models.teacher", f"{WEIGHTS}/vjepa2-vitg-fpc64-384", _SMALL),
    ("*.text.path", f"{WEIGHTS}/Cosmos3-Nano/text_tokenizer", _SMALL),
    ("*.lpips_weights", _LPIPS, _SMALL),
    ("*.sam3_weights", _SAM3, _SMALL),
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
    ("rollouts.*.timed_blocks", 10, "past the window of the cache"),
    ("runner.steps_at_once", 2, "two cores"),
)
"""Pattern of a dotted key, its small value, and why; the first that fits holds. What no pattern names stays as it is."""


ABLATION_SIZES: tuple[tuple[str, Any, str], ...] = (
    ("rollouts.*.seeds", [42], "six models are evaluated"),
    ("rollouts.*.num_frames", 33, "six models are evaluated"),
)
"""What the ablations change besides."""

OTHER_INPUT_SIZES: tuple[tuple[str, Any, str], ...] = (("distill.clips.lengths", [33], "two blocks"),)
"""What the second distillation changes besides: see :func:`other_input`."""

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
        """As it is given to ``--set``."""
        return f"{self.key}={json.dumps(self.rehearsed)}"


def changes_of(
    preset: str | None, path: Path | None, overrides: Sequence[str], sizes: Sequence[tuple[str, Any, str]] = SIZES
) -> list[Change]:
    """The values that a rehearsal of this configuration changes.

    Raises:
        ConfigError: the configuration is not valid, or not with its changes.
    """
    config = load_config(PipelineConfig, preset=preset, path=path, overrides=overrides)
    before = dict(_leaves(config.model_dump(mode="json")))
    small: list[Change] = []
    for key, value in before.items():
        fitting = next((size for size in sizes if fnmatchcase(key, size[0])), None)
        if fitting is not None and (key in ALWAYS or _larger(value, fitting[1])):
            small.append(Change(key, value, *fitting[1:]))
    changed = [*overrides, *(change.override for change in small)]
    after = dict(
        _leaves(load_config(PipelineConfig, preset=preset, path=path, overrides=changed).model_dump(mode="json"))
    )
    return [change for change in small if after[change.key] != change.published]


def other_input(preset: str | None, path: Path | None, overrides: Sequence[str]) -> list[Change]:
    """What a second distillation changes: it reads its clips the other way, cached latents or frames that are encoded when
    they are needed, because a laboratory chooses by what its disks hold. Its clips are shorter.

    Args:
        overrides: those of the rehearsal.
    """
    config = load_config(PipelineConfig, preset=preset, path=path, overrides=overrides)
    mine, stage2 = config.distill.input, config.train_stage2.input
    other: ClipInput = LatentInput()
    if not isinstance(mine, FrameInput):
        other = stage2 if isinstance(stage2, FrameInput) else FrameInput(image_size=config.encode_latents.image_size)
    read = Change("distill.input", mine.model_dump(), other.model_dump(), "the other way to read clips")
    return [read, *changes_of(preset, path, overrides, OTHER_INPUT_SIZES)]


def _larger(value: Any, small: Any) -> bool:
    """Whether a rehearsal makes it smaller."""
    if isinstance(value, int) and isinstance(small, int):
        return value > small
    if isinstance(value, list) and isinstance(small, list):
        return len(value) > len(small) or (
            len(value) == len(small) and any(v > s for v, s in zip(value, small, strict=True))
        )
    return value is not None and value != small


def _leaves(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def table(changes: Sequence[Change]) -> str:
    """The changes as a table in Markdown."""
    rows = [("key", "preset", "rehearsal", "why"), ("---",) * 4]
    rows += [(c.key, _shown(c.published), _shown(c.rehearsed), c.why) for c in changes]
    widths = [max(len(row[column]) for row in rows) for column in range(4)]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |" for row in rows
    ]
    return "\n".join(lines)


def _shown(value: Any) -> str:
    """A value as JSON; of recordings their folders alone."""
    sources = isinstance(value, list) and all(isinstance(item, Mapping) and "path" in item for item in value)
    return json.dumps([item["path"] for item in value] if sources else value)


def prepare(
    folder: Path, preset: str | None, path: Path | None, overrides: Sequence[str], *, ablations: bool = True
) -> tuple[list[Change], list[Change], list[Change]]:
    """Write outside models, recordings and the list of changes into ``folder``; what is there already is kept.

    Returns the changes, those that the second distillation makes besides, and those that the ablations make.

    Raises:
        ConfigError: the configuration is not valid, or not with its changes, or has nothing to ablate.
        UnavailableError: an outside model cannot be made small; the message names it.
    """
    changes = changes_of(preset, path, overrides)
    changed = [*overrides, *(change.override for change in changes)]
    again = other_input(preset, path, changed)
    besides = changes_of(preset, path, changed, ABLATION_SIZES) if ablations else []
    if ablations:  # what is wrong with them is said now, not at the end

        def load(more: Sequence[str]) -> PipelineConfig:
            return load_config(PipelineConfig, preset=preset, path=path, overrides=[*changed, *more])

        for variant in choose_variants().values():
            variant_config(load, variant)
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_path(folder / CHANGES_FILE) as temporary:
        temporary.write_text(
            f"# {preset or path}\n\nWhat the rehearsal changes; all else is as the file says.\n\n{table(changes)}\n"
            f"\nBesides, in the second distillation:\n\n{table(again)}\n"
            + (f"\nBesides, in the ablations:\n\n{table(besides)}\n" if ablations else "")
        )
    if not (folder / WEIGHTS).is_dir():
        shutil.rmtree(folder / f"{WEIGHTS}.partial", ignore_errors=True)
        write_outside_models(folder / f"{WEIGHTS}.partial")
        (folder / f"{WEIGHTS}.partial").rename(folder / WEIGHTS)
    for name, episodes, split in ((RECORDINGS, THREE_VIEWS, None), (TWO_VIEW_RECORDINGS, TWO_VIEWS, "test")):
        if not (folder / name / "index.parquet").is_file():
            write_recordings(folder / name, episodes, split=split)
    return changes, again, besides


FPS, FRAMES = 30.0, 129
THREE_VIEWS = tuple(
    f"ur5e_silver-{name}"
    for name in ("train-s1-00003", "train-s1-00004", "validation-s1-00000", "test-s1-00001", "test-s1-00004")
)
"""One body: successes and failures to train on, one to validate, and of one task a success and a failure to test."""
TWO_VIEWS = ("xarm7_single-train-s1-00000", "xarm7_single-train-s1-00001")
"""A head and a wrist camera, a failure and a success; here they are for evaluation alone."""


def write_recordings(folder: Path, episodes: Sequence[str], *, split: str | None = None) -> None:
    """Write shipped recordings as an EpisodeSet of 30 frames a second and 129 frames, the same bytes every time.

    States, commands, camera poses and pictures between two recorded moments are interpolated; the movement takes a twentieth
    longer than it did.

    Args:
        split: given to all of them; by default each keeps its own.
    """
    shipped = EpisodeSet.open(shipped_folder() / "recordings")
    with EpisodeSetWriter(folder, fps=FPS, video_crf=10, video_preset="ultrafast") as writer:
        for name in episodes:
            position = shipped.position(name)
            episode = shipped.episode(position)
            moments = np.linspace(0, episode.num_frames - 1, FRAMES)
            frames = {view: _between(shipped.frames(position, view), moments) for view in shipped.rows[position].views}
            changed = resampled(episode, moments)
            writer.add(
                replace(changed, split=split or episode.split),
                {view: np.rint(values).astype(np.uint8) for view, values in frames.items()},
            )


def resampled(episode: Episode, moments: np.ndarray) -> Episode:
    """The episode at 30 frames a second, one for each of ``moments`` (frame numbers with fractions)."""
    return replace(
        episode,
        fps=FPS,
        timestamps=np.arange(len(moments)) / FPS,
        video_frames=None,
        cameras={view: _moved(camera, moments) for view, camera in episode.cameras.items()},
        **{name: _poses(values, moments) if name == "T_base_ee" else _between(values, moments)
           for name, values in episode.arrays().items()},
    )  # fmt: skip


def _moved(camera: CameraTrack, moments: np.ndarray) -> CameraTrack:
    return replace(camera, T_base_camera=_poses(camera.T_base_camera, moments)) if camera.moving else camera


def _poses(poses: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """Poses (..., 4, 4) between recorded ones: positions linearly, rotations as the nearest to the mixed matrices."""
    mixed = _between(poses, moments)
    mixed[..., :3, :3] = nearest_rotation(mixed[..., :3, :3])
    return mixed


def _between(values: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """Rows of ``values`` at frame numbers with fractions, linearly."""
    before = np.floor(moments).astype(int)
    after = np.minimum(before + 1, len(values) - 1)
    share = (moments - before).reshape(-1, *[1] * (values.ndim - 1))
    return values[before] * (1 - share) + values[after] * share
