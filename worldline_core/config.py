"""One strict YAML loader: safe, refuses duplicate keys, and names the file and dotted path of a mistake.

The base of every configuration model.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from functools import cache, lru_cache
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, TypeAliasType, Union, cast, get_args, get_origin

import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator
from yaml.constructor import ConstructorError

from worldline_core.errors import ConfigError
from worldline_core.untrusted_text import cut, unusable_text

_PACKAGE = Path(__file__).resolve().parent
# An installed package carries the presets and embodiments inside of it.
CONFIG_ROOT = _PACKAGE / "configs" if (_PACKAGE / "configs").is_dir() else _PACKAGE.parent / "configs"


MAX_VALUES = 200_000
"""Limit of one file with its aliases expanded: some lines of aliases can expand to more values than memory holds."""
Side = Annotated[int, Field(ge=1, le=16_384)]
MAX_PIXELS = 40_000_000
"""One image; 8K video has 33 million pixels."""


def _decodable(size: tuple[int, int]) -> tuple[int, int]:
    if size[0] * size[1] > MAX_PIXELS:
        raise ValueError(f"{size[0]} x {size[1]} pixels are more than {MAX_PIXELS:,}")
    return size


ImageSize = Annotated[tuple[Side, Side], AfterValidator(_decodable)]
"""(height, width) in pixels."""
FrameRate = Annotated[float, Field(ge=0.01, le=10_000)]
"""Frames per second; at others, times or numbers of frames are no usable numbers."""
_LONGEST_INPUT = 200
_MOST_MISTAKES = 30


class _StrictLoader(yaml.SafeLoader):
    """SafeLoader that refuses a key given twice (plain YAML silently keeps the last one) and more than MAX_VALUES."""

    def get_single_node(self) -> yaml.Node | None:
        node = super().get_single_node()
        if node is not None and _count(node, {}) > MAX_VALUES:
            raise ConstructorError(None, None, f"more than {MAX_VALUES:,} values, aliases counted", node.start_mark)
        return node

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        try:
            return super().construct_object(node, deep)
        except (ValueError, TypeError, KeyError, AttributeError) as error:  # of PyYAML's own readers of values
            raise ConstructorError(None, None, f"no {node.tag.rpartition(':')[2]}: {error}", node.start_mark) from error

    def construct_scalar(self, node: yaml.ScalarNode | yaml.MappingNode) -> Any:
        value = super().construct_scalar(node)
        if (found := unusable_text(value)) is not None:
            raise ConstructorError(None, None, f"text with half of a surrogate pair: {found}", node.start_mark)
        return value


def _count(node: yaml.Node, known: dict[int, int]) -> int:
    """Values below a node, an alias as often as it is used; one that contains itself is without end."""
    if isinstance(node, yaml.ScalarNode):
        return 1
    if id(node) not in known:
        known[id(node)] = MAX_VALUES + 1  # found again below itself
        parts = [part for pair in node.value for part in pair] if isinstance(node, yaml.MappingNode) else node.value
        known[id(node)] = 1 + sum(_count(part, known) for part in parts)
    return known[id(node)]


@lru_cache(maxsize=128)  # more than there are robots: a dataset is compared with all of them
def _parsed(text: str, name: str) -> Any:
    loader = _StrictLoader(text)  # derives from SafeLoader: no object construction
    loader.name = name
    return loader.get_single_data()


def _read(text: str, name: str = "<text>") -> Any:
    """A YAML value; the same text is parsed once, which takes up to a tenth of a second.

    Raises: yaml.YAMLError for whatever is no YAML.
    """
    try:
        return deepcopy(_parsed(text, name))
    except RecursionError:
        raise yaml.YAMLError("nested too deeply") from None


def _construct_mapping(loader: _StrictLoader, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
    seen: set[object] = set()
    for key_node, _ in node.value:
        if key_node.tag == "tag:yaml.org,2002:merge":
            continue
        key = loader.construct_object(key_node, deep=True)
        if key in seen:
            raise ConfigError(
                "A key is given twice",
                where=f"{key_node.start_mark.name}, line {key_node.start_mark.line + 1}",
                got=key,
                next_step="keep one of the two",
            )
        seen.add(key)
    return yaml.SafeLoader.construct_mapping(loader, node, deep=deep)


_StrictLoader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _construct_mapping)
# Of the words that YAML 1.1 takes for booleans only true and false: `off`, `yes` and `no` name choices here.
# Numbers have no colons: 1:30 is 90 in YAML 1.1 (base 60), which is a mistake here.
_BOOLEAN = "tag:yaml.org,2002:bool"
_BASE_60 = re.compile(r"[-+]?[0-9][0-9_]*(?::[0-5]?[0-9])+(?:\.[0-9_]*)?")


class _WithoutBase60:
    """An implicit resolver's pattern, which does not match numbers of base 60."""

    def __init__(self, pattern: re.Pattern[str]) -> None:
        self._pattern = pattern

    def match(self, text: str) -> re.Match[str] | None:
        return None if _BASE_60.fullmatch(text) else self._pattern.match(text)


_StrictLoader.yaml_implicit_resolvers = {
    first: [(tag, _WithoutBase60(pattern)) for tag, pattern in resolvers if tag != _BOOLEAN]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_StrictLoader.add_implicit_resolver(_BOOLEAN, re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$"), list("tTfF"))


def read_yaml(path: Path) -> dict[str, Any]:
    """Read one YAML mapping.

    Raises: ConfigError: the file is missing, is not YAML, repeats a key, or does not hold a mapping.
    """
    if not path.is_file() and path.parts[:1] == ("configs",):
        # The documents name the project's own files so; an installed package has them elsewhere.
        path = CONFIG_ROOT.joinpath(*path.parts[1:])
    if not path.is_file():
        raise ConfigError("No such configuration file", where=path, next_step="check the path")
    try:
        content = _read(path.read_text(encoding="utf-8"), str(path))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError("Not valid YAML", where=path, got=str(error)) from error
    if not isinstance(content, dict):
        raise ConfigError(
            "A configuration file holds one mapping",
            where=path,
            expected="key: value lines",
            got=type(content).__name__,
        )
    return content


def preset_names() -> list[str]:
    """Names of the presets that ship with the project (files directly in ``configs/``)."""
    return sorted(path.stem for path in CONFIG_ROOT.glob("*.yaml"))


def preset_path(name: str) -> Path:
    """The file of a preset.

    Raises: ConfigError: there is no preset of that name; the message lists those there are.
    """
    if name not in preset_names():
        close = difflib.get_close_matches(name, preset_names(), n=1)
        raise ConfigError(
            "Unknown preset",
            expected=f"one of {', '.join(preset_names())}",
            got=name,
            next_step=f"did you mean {close[0]!r}?" if close else "use --config FILE for a file of your own",
        )
    return CONFIG_ROOT / f"{name}.yaml"


def apply_overrides(values: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """Apply ``a.b=value`` overrides (the value is read as YAML) to a copy of ``values``.

    Raises: ConfigError: an override is not of the form ``a.b=value``, or goes through something that is not a mapping.
    """
    result = _copy_mapping(values)
    for override in overrides:
        dotted, separator, text = override.partition("=")
        keys = dotted.strip().split(".")
        if not separator or not all(keys):
            raise ConfigError("An override has the form a.b=value", got=override)
        node: dict[str, Any] = result
        for depth, key in enumerate(keys[:-1]):
            child = node.setdefault(key, {})
            if not isinstance(child, dict):
                raise ConfigError(
                    "An override goes through a value that is not a mapping",
                    where=".".join(keys[: depth + 1]),
                    got=override,
                )
            node = child
        try:
            node[keys[-1]] = _read(text)
        except yaml.YAMLError as error:
            raise ConfigError("The value of an override is not valid YAML", where=dotted, got=text) from error
    return result


def _copy_mapping(values: Mapping[str, Any]) -> dict[str, Any]:
    """A copy in which no mapping is another one's alias."""
    return {key: _copy_mapping(value) if isinstance(value, Mapping) else value for key, value in values.items()}


def validate[Model: BaseModel](model: type[Model], values: Mapping[str, Any], *, where: object) -> Model:
    """Build ``model`` from ``values``; every mistake is reported with its dotted path.

    Raises: ConfigError: a key is unknown (the message suggests the nearest one), missing, or has a bad value.
    """
    try:
        return model.model_validate(dict(values))
    except ValidationError as error:
        lines = []
        problems = error.errors()
        for problem in problems:
            place = problem["loc"]
            if problem["type"] == "default_factory_not_called":
                continue  # it depends on a value that is a mistake itself
            if problem["type"] == "too_short" and any(p["loc"][: len(place)] == place != p["loc"] for p in problems):
                continue  # pydantic counts the valid ones alone
            dotted = ".".join(str(part) for part in problem["loc"])
            if problem["type"] == "extra_forbidden":
                known = _known_keys(model, problem["loc"][:-1])
                close = difflib.get_close_matches(str(problem["loc"][-1]), known, n=1)
                hint = f"; did you mean {close[0]!r}?" if close else f"; known keys: {', '.join(known)}"
                lines.append(f"{dotted}: unknown key{_place_above(model, place, problem['input']) or hint}")
            else:
                hint = _place_above(model, place, problem.get("input"))
                lines.append(
                    f"{dotted}: {problem['msg']} (got {cut(repr(problem.get('input')), _LONGEST_INPUT)}){hint}"
                )
        if len(lines) > _MOST_MISTAKES:
            lines[_MOST_MISTAKES:] = [f"and {len(lines) - _MOST_MISTAKES} more"]
        raise ConfigError("The configuration is not valid", where=where, got="\n    " + "\n    ".join(lines)) from error


def _take_away(values: dict[str, Any], given: Mapping[str, Any], keys: Sequence[str]) -> None:
    """Remove a key that is null now, where it was given; anything else is a mistake that validation names."""
    for key in keys[:-1]:
        inner, given = values.get(key), given.get(key) or {}
        if not isinstance(given, Mapping) or not isinstance(inner, dict):
            return  # a later override has taken away what this one was in
        values = inner
    if keys[-1] in given and values.get(keys[-1], ...) is None:
        del values[keys[-1]]


def _known_keys(model: type[BaseModel], location: Sequence[int | str]) -> list[str]:
    """The keys that a place in the configuration takes."""
    return sorted({key for current in _types_at(model, location) for key in getattr(current, "model_fields", {})})


def _place_above(model: type[BaseModel], location: Sequence[int | str], value: object) -> str:
    """Says where a key belongs that a model further up has, and for which this value is right; else nothing."""
    place, key = list(location[:-1]), location[-1] if location else ""
    while place:
        place.pop()
        if place and isinstance(place[-1], int):  # another kind of the same list
            continue
        for current in _types_at(model, place):
            field = getattr(current, "model_fields", {}).get(key)
            with suppress(ValidationError):
                if field is not None:
                    TypeAdapter(field.annotation).validate_python(value)
                    return f"; {key} belongs further up, beside {'.'.join(map(str, location[: len(place) + 1]))}"
    return ""


def _types_at(model: type[BaseModel], location: Sequence[int | str]) -> list[Any]:
    """Types that are valid at a place of the configuration, through lists, mappings and unions."""
    types: list[Any] = [model]
    for part in location:
        found: list[Any] = []
        for current in types:
            field = getattr(current, "model_fields", {}).get(part)
            if field is not None:
                found += _alternatives(field.annotation)
            elif issubclass(get_origin(current) or object, list | tuple | Mapping):
                found += [member for item in get_args(current) if item is not ... for member in _alternatives(item)]
        # No field, no item: the tag that says which member of a union was meant.
        types = found or [current for current in types if part in _tags(current)] or types
    return types


def _alternatives(annotation: Any) -> list[Any]:
    """The members of a union, or what is annotated, by itself."""
    origin = get_origin(annotation)
    if origin is Annotated:
        return _alternatives(get_args(annotation)[0])
    if isinstance(annotation, TypeAliasType):
        return _alternatives(annotation.__value__)
    if origin in (Union, UnionType):
        return [member for item in get_args(annotation) for member in _alternatives(item)]
    return [annotation]


def _tags(model: Any) -> set[str]:
    """Names of a model in a union: its own, and the literals of its fields (`kind`)."""
    fields = getattr(model, "model_fields", {}).values()
    literals = {str(value) for f in fields if get_origin(f.annotation) is Literal for value in get_args(f.annotation)}
    return literals | {getattr(model, "__name__", "")}


def load_config[Model: BaseModel](
    model: type[Model],
    *,
    preset: str | None = None,
    path: Path | None = None,
    overrides: Sequence[str] = (),
    section: str | None = None,
    prune: Callable[[dict[str, Any], Mapping[str, Any]], None] | None = None,
) -> Model:
    """Load a preset or a file, apply overrides, and validate.

    A file may begin with ``extends: PRESET``: it then states only what differs from that preset. Null takes a key
    of the preset or file away (one of its rollouts), in a file that extends it and in an override, unless null is one of its values.
    Values that still begin with TODO, as `worldline init` writes them, are refused, whichever section is loaded.

    Args:
        section: one top-level mapping of the file; overrides are still written from the top (``train_stage2.steps=10``).
        prune: changes the values before they are validated, given the file and the overrides without the preset.

    Raises: ConfigError: anything that is not right with it.
    """
    given = read_config(preset, path)
    source = preset_path(preset) if preset is not None else path
    values = _answered(given, apply_overrides(given, overrides), source)
    for override in overrides:
        keys = override.partition("=")[0].strip().split(".")
        within = keys if section is None else keys[1:]
        if section in (None, keys[0]) and within and type(None) not in _types_at(model, within):
            _take_away(values, given, keys)
    if prune is not None:
        prune(values, apply_overrides({} if path is None else read_yaml(path), overrides))
    if section is not None:
        values = values.get(section) or {}
        if not isinstance(values, Mapping):
            raise ConfigError("A section is a mapping", where=f"{source}: {section}", got=type(values).__name__)
    places = [str(source) if section is None else f"{source}: {section}", *(f"--set {text}" for text in overrides)]
    return validate(model, values, where=", ".join(places))


TODO = "TODO"
"""Beginning of a value that the user has to fill in; the rest says how."""
QUESTIONS = "todo"
"""Section with such values, to which the others refer as YAML aliases: `fps: &fps TODO ...`, and `fps: *fps` where it belongs."""


def _answered(given: Mapping[str, Any], values: dict[str, Any], source: object) -> dict[str, Any]:
    """The values without the section of questions; overrides of it (`--set todo.fps=30`) answer where it is referred to.

    Raises: ConfigError naming everything that is still to be filled in.
    """
    asked, answers = given.get(QUESTIONS) or {}, values.pop(QUESTIONS, None) or {}
    if not isinstance(asked, Mapping) or not isinstance(answers, Mapping):
        raise ConfigError("A section is a mapping", where=f"{source}: {QUESTIONS}", got=type(answers).__name__)
    names = {text: f"{QUESTIONS}.{name}" for name, text in asked.items() if _is_todo(text)}
    replaced = {text: answers[name] for name, text in asked.items() if _is_todo(text) and not _is_todo(answers[name])}
    values, open_places = _filled_in(values, replaced, "")
    if open_places:
        lines = dict.fromkeys(f"{names.get(text, place)}: {text}" for place, text in open_places)
        raise ConfigError(
            "The configuration is not filled in yet",
            where=source,
            got="\n    " + "\n    ".join(lines),
            next_step="write each value into the file (or --set NAME=VALUE)",
        )
    return values


def _is_todo(value: object) -> bool:
    return isinstance(value, str) and (value == TODO or value.startswith(f"{TODO} "))


def _filled_in(value: Any, answers: Mapping[str, Any], place: str) -> tuple[Any, list[tuple[str, str]]]:
    """A value with the answers in it, and the places and texts of what is still open."""
    if isinstance(value, Mapping | list):
        pairs = list(value.items() if isinstance(value, Mapping) else enumerate(value))
        parts = [(key, *_filled_in(part, answers, f"{place}.{key}" if place else str(key))) for key, part in pairs]
        still = [each for _, _, found in parts for each in found]
        return ({k: v for k, v, _ in parts} if isinstance(value, Mapping) else [v for _, v, _ in parts]), still
    if not _is_todo(value):
        return value, []
    return (answers[value], []) if value in answers else (value, [(place, value)])


def read_config(preset: str | None, path: Path | None) -> dict[str, Any]:
    """The values of a preset or a file, with those of the preset that it extends."""
    if (preset is None) == (path is None):
        raise ConfigError("Give either a preset or a configuration file", got=f"preset={preset}, config={path}")
    return _with_extended(preset_path(preset) if preset is not None else cast("Path", path))


def _with_extended(source: Path) -> dict[str, Any]:
    """The values of a file over those of the preset that it extends. Mappings are merged; null takes away a key that the preset has."""
    values = read_yaml(source)
    if "extends" not in values:
        return values
    base = preset_path(str(values.pop("extends")))
    if base.resolve() == source.resolve():
        raise ConfigError("A preset cannot extend itself", where=source, got=f"extends: {base.stem}")
    return merged(_with_extended(base), values)


def merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of nested `base` with the leaves of `changes` in it; null takes a key away."""
    result = dict(base)
    for key, change in changes.items():
        below = result.get(key)
        if change is None and key in result:
            result.pop(key)
        elif isinstance(change, Mapping) and isinstance(below, Mapping):
            result[key] = merged(below, change)
        else:
            result[key] = change
    return result


def value_at(values: Any, *keys: str) -> Any:
    """The value below some keys of nested mappings; None where there is none."""
    for key in keys:
        values = None if values is None else values.get(key)
    return values


def _holds_boolean(value: Any) -> bool:
    if isinstance(value, Mapping):
        value = list(value.values())
    return isinstance(value, bool) or (isinstance(value, list | tuple) and any(map(_holds_boolean, value)))


def _holds_numbers_alone(annotation: Any) -> bool:
    """True for numbers, texts and choices, and tuples and mappings of these; not for models, which check their own values."""
    parts = [part for member in _alternatives(annotation) for part in (get_args(member) or [member])]
    if parts != [annotation]:
        return all(map(_holds_numbers_alone, parts))
    return annotation in (int, float, str, type(None), ...) or (
        isinstance(annotation, str | int | float) and not isinstance(annotation, bool)
    )


@cache
def _number_fields(model: type[BaseModel]) -> frozenset[str]:
    return frozenset(name for name, field in model.model_fields.items() if _holds_numbers_alone(field.annotation))


class StrictModel(BaseModel):
    """Frozen; an unknown key is an error, never ignored."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, hide_input_in_errors=True)

    @model_validator(mode="before")
    @classmethod
    def _strict_values(cls, values: Any) -> Any:
        """A boolean is no number (pydantic takes true for 1), and a text must be storable."""
        if isinstance(values, Mapping):
            for name, value in values.items():
                if (found := unusable_text((name, value))) is not None:
                    raise ValueError(f"{name!a} has half of a surrogate pair: {found}")
                if name in _number_fields(cls) and _holds_boolean(value):
                    raise ValueError(f"{name}: true and false are no numbers (got {value!r})")
        return values

    def weights_read(self) -> Mapping[str, Path | None]:
        """Files and folders (weights, a text tokenizer) that a step with this configuration reads and that are no input of it:
        their content counts in its key."""
        return {}


NEVER_RELEVANT = ("sharding", "saving", "workers")


def cache_relevant_config(config: Any) -> Any:
    """The part of a JSON config that enters cache keys and a training's identity: all but ``sharding``, ``saving`` and ``workers``."""
    if isinstance(config, Mapping):
        return {name: cache_relevant_config(part) for name, part in config.items() if name not in NEVER_RELEVANT}
    return [cache_relevant_config(part) for part in config] if isinstance(config, list | tuple) else config
