"""Curation: recordings of several formats in, one EpisodeSet out; every input is kept or quarantined with a reason."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from worldline_core.data.curate_config import CurateConfig
from worldline_core.data.curate_episode import check_episode, prepare_episode
from worldline_core.data.episode_index import read_index, read_quarantine
from worldline_core.data.episode_parts import part_name
from worldline_core.data.episode_set_writer import EpisodeSetWriter
from worldline_core.data.rejection import RejectedInputError
from worldline_core.data.sources.base import EpisodeSource
from worldline_core.data.sources.open import open_source
from worldline_core.errors import CalibrationError, DataError
from worldline_core.store.atomic import write_bytes_atomic


@dataclass(frozen=True)
class _Input:
    """One listed episode: the id it gets in the set, and where it is read from."""

    identity: str
    source: EpisodeSource
    label: str
    root: Path
    listed_id: str
    repeated: bool


def curate(config: CurateConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Read all sources into an EpisodeSet at `output`.

    Args:
        inputs: "source.<n>" -> folder of sources[n]; a source that is not named is read from its configured path.

    Returns:
        {"found", "kept", "quarantined", "reasons", "splits"}; kept + quarantined = found.

    Raises: DataError when a source cannot be opened, nothing is kept, or a scene is both in training and in test;
        ConfigError when recordings for evaluation only are assigned to training.
    """
    listed = _list_inputs(config, inputs)
    if EpisodeSetWriter.finished(output):
        return _counts(output, len(listed))
    writer = EpisodeSetWriter(
        output,
        fps=config.fps,
        image_size=config.image_size,
        video_crf=config.video_crf,
        video_preset=config.video_preset,
        pixel_format=config.pixel_format,
    )
    for item in tqdm(listed, desc="curate", unit="episode", disable=None):
        if not writer.has(item.identity):
            _process(config, item, writer, output)
    _quarantine_duplicates(listed, writer, output)
    _check_scenes_disjoint(writer)
    writer.close()
    return _counts(output, len(listed))


def _list_inputs(config: CurateConfig, inputs: Mapping[str, Path]) -> list[_Input]:
    listed: list[_Input] = []
    seen: set[str] = set()
    for number, source_config in enumerate(config.sources):
        root = inputs.get(f"source.{number}", source_config.path)
        source = open_source(source_config, root)
        for episode_id in filter(source_config.includes, source.episode_ids()):
            repeated = episode_id in seen
            identity = f"{episode_id}#source.{number}" if repeated else episode_id
            seen.add(identity)
            listed.append(_Input(identity, source, source_config.label, root, episode_id, repeated))
    return listed


def _process(config: CurateConfig, item: _Input, writer: EpisodeSetWriter, output: Path) -> None:
    """Keep or quarantine one episode."""
    try:
        if item.repeated:
            raise RejectedInputError(
                "duplicate_id", "Another source has an episode of this id", where=item.label, got=item.listed_id
            )
        loaded = item.source.load(item.listed_id)
        check_episode(config, loaded)
        prepared = prepare_episode(config, loaded)
        write_bytes_atomic(_fingerprint_path(output, item.identity), prepared.fingerprint.encode())
        writer.add(prepared.episode, prepared.frames, prepared.masks or None)
    except RejectedInputError as error:
        writer.quarantine(item.identity, item.label, error.reason, _portable(error, item), error.evidence)
    except CalibrationError as error:
        writer.quarantine(item.identity, item.label, "invalid_extrinsics", _portable(error, item), {})
    except DataError as error:
        writer.quarantine(item.identity, item.label, "unreadable", _portable(error, item), {})


def _portable(error: DataError, item: _Input) -> str:
    """The message with paths counted from the source's folder: a set must not depend on where its sources lay."""
    text = str(error)
    for root in (item.root.resolve(), item.root):
        text = text.replace(f"{root}/", "").replace(str(root), item.label)
    return text


def _fingerprint_path(output: Path, identity: str) -> Path:
    return output / "run" / "fingerprints" / f"{part_name(identity)}.txt"


def _quarantine_duplicates(listed: list[_Input], writer: EpisodeSetWriter, output: Path) -> None:
    """Of episodes with the same content the first listed is kept."""
    kept_ids = {part["episode_id"] for part in writer.kept()}
    first: dict[str, str] = {}
    for item in listed:
        if item.identity not in kept_ids:
            continue
        original = first.setdefault(_fingerprint_path(output, item.identity).read_text(), item.identity)
        if original != item.identity:
            writer.quarantine(
                item.identity,
                item.label,
                "duplicate",
                f"Same frames, states and actions as episode {original}",
                {"duplicate_of": original},
            )
            writer.discard(item.identity)


def _check_scenes_disjoint(writer: EpisodeSetWriter) -> None:
    """Raises: DataError when a scene that is trained or validated on is also tested on."""
    scenes: dict[str, set[str]] = {}
    for part in writer.kept():
        scenes.setdefault(part["split"], set()).add(part["scene"])
    for learning in ("train", "validation"):
        for testing in ("test", "ood_test"):
            shared = sorted(scenes.get(learning, set()) & scenes.get(testing, set()))
            if shared:
                raise DataError(
                    f"Scenes are both in {learning} and in {testing}",
                    where="curate.splits",
                    expected="disjoint scenes",
                    got=", ".join(shared[:10]) + (" ..." if len(shared) > 10 else ""),
                    next_step="give each scene one split",
                )


def _counts(output: Path, found: int) -> dict[str, Any]:
    rows, rejected = read_index(output), read_quarantine(output)
    if len(rows) + len(rejected) != found:
        raise DataError(
            "Inputs were lost between sources and set",
            where=str(output),
            expected=f"kept + quarantined = {found}",
            got=f"{len(rows)} + {len(rejected)}",
            next_step="remove the unfinished folder and curate again",
        )
    reasons: dict[str, int] = {}
    for rejection in rejected:
        reasons[rejection.reason] = reasons.get(rejection.reason, 0) + 1
    splits: dict[str, int] = {}
    for row in rows:
        splits[row.split] = splits.get(row.split, 0) + 1
    return {
        "found": found,
        "kept": len(rows),
        "quarantined": len(rejected),
        "reasons": dict(sorted(reasons.items())),
        "splits": dict(sorted(splits.items())),
    }
