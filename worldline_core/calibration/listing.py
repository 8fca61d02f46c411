"""The episodes that a calibration check looks at, and the configuration line that repairs what is found of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from worldline_core.calibration.diagnosis import Explanation
from worldline_core.config.loader import apply_overrides, read_yaml, validate
from worldline_core.data.episodes.conventions import RecordedConventions
from worldline_core.data.sources.base import LoadedEpisode
from worldline_core.errors import ConfigError, DataError

CONVENTIONS_KEY = "curate.sources[].conventions"
ADDING = ("tool_offset_z_m", "camera_lag_frames", "image_lag_frames")
UNDOING = ("extrinsics", "camera_axes", "arms", "gripper")


@dataclass(frozen=True)
class ListedEpisode:
    """An episode to check: where it comes from, and what its source's configuration declares already."""

    episode_id: str
    source: str
    load: Callable[[], LoadedEpisode]
    config_prefix: str = CONVENTIONS_KEY
    declared: RecordedConventions = field(default_factory=RecordedConventions)


def combined_conventions(declared: RecordedConventions, found: RecordedConventions) -> RecordedConventions:
    """What a source must declare when `found` was seen on episodes that were read with `declared`.

    Lengths and lags add up; what undoes itself when done twice, found again, turns back to the contract.

    Raises:
        ConfigError: no single declaration says both, for example because they speak of different views.
    """
    if not declared.departures:
        return found
    if found.departures and declared.views != found.views:
        raise ConfigError(
            "What is declared and what was found speak of different views",
            expected=f"views {declared.views}",
            got=f"views {found.views}",
            next_step="remove the declared conventions and check again",
        )
    default, values = RecordedConventions(), declared.model_dump()
    for name in found.departures:
        was, now, contract = (getattr(item, name) for item in (declared, found, default))
        if was == contract:
            values[name] = now
        elif name in ADDING:
            values[name] = was + now
        elif name in UNDOING and was == now:
            values[name] = contract
        else:
            raise ConfigError(
                "What was found cannot be declared on top of what is declared",
                where=f"conventions.{name}",
                expected=str(contract),
                got=f"{was} is declared, and {now} was found",
                next_step="remove the declared conventions and check again",
            )
    return RecordedConventions.model_validate(values)


def repairing_lines(item: ListedEpisode, explanation: Explanation) -> tuple[str, ...]:
    """What the source's configuration must say if the explanation holds; nothing for the recording as written.

    Lines of an explanation that are no conventions (of an embodiment's file) are handed on as they are.

    Raises:
        ConfigError: as `combined_conventions`.
    """
    declared_here = [line for line in explanation.config_lines if line.startswith(f"{CONVENTIONS_KEY}.")]
    elsewhere = tuple(line for line in explanation.config_lines if line not in declared_here)
    if not declared_here:
        return elsewhere
    names = {line.removeprefix(f"{CONVENTIONS_KEY}.").split(":")[0] for line in declared_here}
    found = RecordedConventions(**{name: getattr(explanation.conventions, name) for name in names})
    lines = combined_conventions(item.declared, found).config_lines(item.config_prefix)
    return (*(lines or (f"remove {item.config_prefix}",)), *elsewhere)


def episodes_of_config(path: Path, overrides: Sequence[str]) -> tuple[list[ListedEpisode], dict[str, str]]:
    """The episodes of every source in a file's `curate` section, and its kinematic descriptions by embodiment.

    Raises:
        ConfigError: the file has no such section, or a mistake in it.
        DataError: a source cannot be opened.
    """
    from worldline_core.data.curation.config import CurateConfig
    from worldline_core.data.sources.open import open_source

    values = apply_overrides(read_yaml(path), overrides)
    if not values.get("curate"):
        raise ConfigError("The file configures no source", where=path, expected="a section `curate` with `sources`")
    config = validate(CurateConfig, values["curate"], where=f"{path}: curate")
    rendering = values.get("render_actions") or {}
    descriptions = rendering.get("description_paths") or {}
    listed: list[ListedEpisode] = []
    for number, source_config in enumerate(config.sources):
        source = open_source(source_config, source_config.path)
        prefix = f"curate.sources[{number}].conventions"
        for episode_id in filter(source_config.includes, source.episode_ids()):
            load = _loader(source.load, episode_id)
            listed.append(ListedEpisode(episode_id, source_config.label, load, prefix, source_config.conventions))
    return listed, {str(name): str(file) for name, file in descriptions.items()}


def _loader(load: Callable[[str], LoadedEpisode], episode_id: str) -> Callable[[], LoadedEpisode]:
    return lambda: load(episode_id)


def episodes_of_artifact(folder: Path) -> list[ListedEpisode]:
    """The episodes of an EpisodeSet.

    Raises:
        DataError: the folder holds no readable index.
    """
    from worldline_core.data.episodes.episode_set import EpisodeSet

    episodes = EpisodeSet.open(folder)

    def load(position: int) -> LoadedEpisode:
        return LoadedEpisode(
            episodes.episode(position),
            tuple(episodes.rows[position].views),
            lambda view: episodes.frames(position, view),
            lambda view: episodes.robot_masks(position, view),
        )

    def loader(position: int) -> Callable[[], LoadedEpisode]:
        return lambda: load(position)

    return [ListedEpisode(row.episode_id, row.source, loader(i)) for i, row in enumerate(episodes.rows)]


def chosen_episodes(listed: Sequence[ListedEpisode], wanted: Sequence[str]) -> list[ListedEpisode]:
    """The episodes with these ids; all of them when none is named.

    Raises:
        DataError: an id is not there.
    """
    known = {item.episode_id for item in listed}
    for name in wanted:
        if name not in known:
            raise DataError(
                "No such episode",
                expected=f"one of {len(known)} ids, such as {', '.join(sorted(known)[:3])}",
                got=name,
            )
    return [item for item in listed if not wanted or item.episode_id in wanted]
