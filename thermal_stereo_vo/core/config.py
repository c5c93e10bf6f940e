"""One-source settings: frozen dataclasses whose fields carry default, unit, range and a sentence.

From these come the YAML file, the ROS parameters, the check at start and the README table.

>>> @dataclasses.dataclass(frozen=True)
... class Example:
...     rate_hz: float = setting(30.0, "Frames a second.", unit="Hz", minimum=1.0, maximum=60.0)
>>> from_mapping(Example, {"rate_hz": 25}).rate_hz
25.0
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import yaml

from thermal_stereo_vo.core.errors import ConfigError

Config = TypeVar("Config")
Scalar = bool | int | float | str


@dataclass(frozen=True)
class SettingInfo:
    """All that is known of one setting.  ``path`` is dotted, as in ``odometry.window``."""

    path: str
    kind: type
    default: Any
    doc: str
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()
    optional: bool = False


def setting(
    default: Any,
    doc: str,
    *,
    unit: str = "",
    minimum: float | None = None,
    maximum: float | None = None,
    choices: Sequence[str] = (),
) -> Any:
    """Declare a field of a settings dataclass; a list default becomes a tuple field."""
    metadata = {
        "doc": doc,
        "unit": unit,
        "minimum": minimum,
        "maximum": maximum,
        "choices": tuple(choices),
    }
    return dataclasses.field(default=default, metadata=metadata)


def group(cls: type, doc: str) -> Any:
    """Declare a nested group of settings."""
    return dataclasses.field(default_factory=cls, metadata={"doc": doc, "group": True})


def settings_of(cls: type, prefix: str = "") -> Iterator[SettingInfo]:
    """Every setting below ``cls``, depth first, in the order of declaration."""
    hints = typing.get_type_hints(cls)
    for item in dataclasses.fields(cls):
        path = f"{prefix}{item.name}"
        if item.metadata.get("group"):
            yield from settings_of(hints[item.name], f"{path}.")
            continue
        kind, optional = _unwrap(hints[item.name])
        yield SettingInfo(
            path=path,
            kind=kind,
            default=item.default,
            doc=item.metadata["doc"],
            unit=item.metadata["unit"],
            minimum=item.metadata["minimum"],
            maximum=item.metadata["maximum"],
            choices=item.metadata["choices"],
            optional=optional,
        )


def flatten(config: Any) -> dict[str, Any]:
    """Dotted path -> value."""
    return {info.path: get(config, info.path) for info in settings_of(type(config))}


def get(config: Any, path: str) -> Any:
    """The value at a dotted path."""
    for name in path.split("."):
        config = getattr(config, name)
    return config


def from_mapping(
    cls: type[Config], mapping: Mapping[str, Any], *, base: Config | None = None
) -> Config:
    """Build ``cls`` from nested (or dotted) keys on top of ``base`` (default: the defaults).

    Raises ConfigError that lists every unknown key (with the nearest known one), every value of
    the wrong type and every value out of range.
    """
    known = {info.path: info for info in settings_of(cls)}
    groups = {
        path.rsplit(".", depth)[0] for path in known for depth in range(1, path.count(".") + 1)
    }
    errors: list[str] = []
    values: dict[str, Any] = flatten(base if base is not None else cls())
    for path, value in _walk(mapping, groups):
        if path in groups:
            if value is not None:  # a group without content changes nothing
                errors.append(f"{path} is a group of settings, got {value!r}")
            continue
        info = known.get(path)
        if info is None:
            errors.append(_unknown(path, [*known, *groups]))
            continue
        try:
            values[path] = _checked(info, value)
        except ConfigError as error:
            errors.append(str(error))
    if errors:
        raise ConfigError("; ".join(errors))
    return _build(cls, values, "")


def with_overrides(config: Config, assignments: Sequence[str]) -> Config:
    """Apply ``key=value`` texts (values in YAML notation), as given to ``--set``."""
    mapping: dict[str, Any] = {}
    for text in assignments:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise ConfigError(f"--set takes key=value, got '{text}'")
        try:
            mapping[key.strip()] = yaml.safe_load(value)
        except yaml.YAMLError:
            raise ConfigError(f"--set {text}: '{value}' is not a YAML value") from None
    return from_mapping(type(config), mapping, base=config)


def load_yaml(cls: type[Config], text: str, *, origin: str, base: Config | None = None) -> Config:
    """Read a YAML document.  ``origin`` names the file in messages."""
    try:
        mapping = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"{origin} is not valid YAML: {' '.join(str(error).split())}") from None
    if mapping is None:
        mapping = {}
    if not isinstance(mapping, dict):
        raise ConfigError(f"{origin} must hold keys and values, not a {type(mapping).__name__}")
    # A ROS parameter file holds the same keys below "node name: ros__parameters:".
    for value in mapping.values():
        if isinstance(value, dict) and "ros__parameters" in value:
            mapping = value["ros__parameters"] or {}
            break
    try:
        return from_mapping(cls, mapping, base=base)
    except ConfigError as error:
        raise ConfigError(f"{origin}: {error}") from None


def dump_yaml(config: Any) -> str:
    """A commented YAML document that ``load_yaml`` reads back to an equal object."""
    return "\n".join(_dump_lines(config, 0)) + "\n"


def _dump_lines(config: Any, depth: int) -> Iterator[str]:
    indent = "  " * depth
    infos = {info.path: info for info in settings_of(type(config))}
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if item.metadata.get("group"):
            yield f"{indent}# {item.metadata['doc']}"
            yield f"{indent}{item.name}:"
            yield from _dump_lines(value, depth + 1)
        else:
            yield f"{indent}# {describe(infos[item.name])}"
            yield f"{indent}{item.name}: {_yaml_scalar(value)}"


def markdown_table(cls: type) -> str:
    """Every setting below ``cls`` as a row: path, default, unit and range, sentence."""
    lines = ["| Setting | Default | Unit, range | Meaning |", "|---|---|---|---|"]
    for info in settings_of(cls):
        default = "" if info.default is None else f"`{_yaml_scalar(info.default)}`"
        notes = ", ".join(_notes(info)).replace("|", "/")
        lines.append(f"| `{info.path}` | {default} | {notes} | {info.doc} |")
    return "\n".join(lines) + "\n"


def describe(info: SettingInfo) -> str:
    """Sentence, unit and range or choices on one line."""
    notes = _notes(info)
    return f"{info.doc} [{', '.join(notes)}]" if notes else info.doc


def _notes(info: SettingInfo) -> list[str]:
    notes = []
    if info.unit:
        notes.append(info.unit)
    if info.choices:
        notes.append(" | ".join(info.choices))
    if info.minimum is not None or info.maximum is not None:
        low = "" if info.minimum is None else f"{info.minimum:g}"
        high = "" if info.maximum is None else f"{info.maximum:g}"
        notes.append(f"{low}..{high}")
    return notes


def _yaml_scalar(value: Any) -> str:
    if isinstance(value, tuple):
        value = list(value)
    return yaml.safe_dump(value, default_flow_style=True, width=10_000).split("\n...")[0].strip()


def _walk(
    mapping: Mapping[str, Any], groups: set[str], prefix: str = ""
) -> Iterator[tuple[str, Any]]:
    for key, value in mapping.items():
        path = f"{prefix}{key}"
        if isinstance(value, Mapping) and path in groups:
            yield from _walk(value, groups, f"{path}.")
        else:
            yield path, value


def _unknown(path: str, known: Sequence[str]) -> str:
    near = difflib.get_close_matches(path, known, n=1, cutoff=0.5)
    hint = f": did you mean '{near[0]}'?" if near else ": see dump-config for the known ones"
    return f"unknown setting '{path}'{hint}"


def _unwrap(hint: Any) -> tuple[type, bool]:
    """(plain type, may be None) of an annotation such as ``float | None``."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        inner = [arg for arg in typing.get_args(hint) if arg is not type(None)]
        return _unwrap(inner[0])[0], True
    origin = typing.get_origin(hint)
    return (origin or hint), False


def _checked(info: SettingInfo, value: Any) -> Any:
    if value is None:
        if info.optional:
            return None
        raise ConfigError(f"{info.path} must not be empty")
    if info.kind is tuple:
        if not isinstance(value, (list, tuple)):
            raise ConfigError(f"{info.path} takes a list, got {value!r}")
        return tuple(value)
    if info.kind is bool:
        if not isinstance(value, bool):
            raise ConfigError(f"{info.path} takes true or false, got {value!r}")
        return value
    if info.kind is str:
        value = str(value)
        if info.choices and value not in info.choices:
            choices = ", ".join(info.choices)
            raise ConfigError(f"{info.path} must be one of {choices}, got '{value}'")
        return value
    value = _number(value)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ConfigError(f"{info.path} takes a number, got {value!r}")
    if info.kind is int:
        if not math.isfinite(value) or value != int(value):
            raise ConfigError(f"{info.path} takes a whole number, got {value!r}")
        value = int(value)
    else:
        value = float(value)
    too_low = info.minimum is not None and not value >= info.minimum
    too_high = info.maximum is not None and not value <= info.maximum
    if too_low or too_high:
        raise ConfigError(f"{info.path} = {value:g} is out of range: {describe(info)}")
    return value


def _number(value: Any) -> Any:
    """The float of a text such as ``1e-4``, which YAML 1.1 does not take for a number."""
    if not isinstance(value, str):
        return value
    try:
        return float(value)
    except ValueError:
        return value


def _build(cls: type[Config], values: Mapping[str, Any], prefix: str) -> Config:
    hints = typing.get_type_hints(cls)
    arguments: dict[str, Any] = {}
    for item in dataclasses.fields(cls):  # type: ignore[arg-type]
        path = f"{prefix}{item.name}"
        if item.metadata.get("group"):
            arguments[item.name] = _build(hints[item.name], values, f"{path}.")
        else:
            arguments[item.name] = values[path]
    return cls(**arguments)
