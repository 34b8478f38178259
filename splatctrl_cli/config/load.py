"""The whole configuration: defaults, a TOML file, single assignments; every key with value and source."""

import dataclasses
import json
import math
import tomllib
import types
from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

from splatctrl_cli.config.ranges import Declared, Section, Within, check, copy_unchecked, format_value, shorten
from splatctrl_cli.config.sections import (
    ControlConfig,
    FieldConfig,
    HumanConfig,
    OccupancyConfig,
    PlannerConfig,
    SceneConfig,
    VerdictConfig,
)
from splatctrl_cli.errors import UsageError, did_you_mean, refuse_faults, refuse_if


@dataclass(frozen=True, kw_only=True)
class Config:
    """The whole configuration, one TOML table per section."""

    scene: SceneConfig = dataclasses.field(default_factory=SceneConfig)
    occupancy: OccupancyConfig = dataclasses.field(default_factory=OccupancyConfig)
    human: HumanConfig = dataclasses.field(default_factory=HumanConfig)
    field: FieldConfig = dataclasses.field(default_factory=FieldConfig)
    control: ControlConfig = dataclasses.field(default_factory=ControlConfig)
    planner: PlannerConfig = dataclasses.field(default_factory=PlannerConfig)
    verdict: VerdictConfig = dataclasses.field(default_factory=VerdictConfig)

    def __post_init__(self) -> None:
        check_voxel(self.scene, self.occupancy)

    derived = copy_unchecked

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "paper": {  # the printed form of each departure that docs/paper.md has a setting for
        "scene": {
            "scale": 1.0,
            "lambda_reg": 0.02,
            "lambda_opacity": 0.0,
            "depth_loss": "printed",
            "shell": 0.0,
            "background": "black",
            "hole_opacity": 0.0,
            "min_depth_error": 0.0,
            "max_depth_error": 1e9,
            "max_gap": 1e9,
            "when_idle": "clone",
            "refine_iterations": 0,
            "refine_depth": 1.0,
        },
        "occupancy": {"rule": "literal", "min_range": 0.0, "see_through": 1e9},
        "field": {"distance": "gpdf", "probability": "paper"},
        "control": {
            "program": "printed",
            "barrier_gain": 1.0,
            "posture_weight": 1e-9,
            "max_cuts": 0,
            "distance_rate": "none",
        },
    }
}


def check_voxel(scene: SceneConfig, occupancy: OccupancyConfig) -> None:
    """Raise UsageError for voxels smaller than the largest splat, which III-C excludes."""
    least = scene.max_radius
    check(occupancy.voxel >= least, "occupancy.voxel", f"at least scene.max_radius = {least:g} m", occupancy.voxel)


def load_config(path: Path | None, assignments: Sequence[str]) -> Config:
    """Defaults, then a preset (``preset=NAME`` assigned), the TOML file, each ``section.key=value``.

    Raises UsageError for unknown sections or keys (naming the nearest), wrong types or ranges, contradictions, or
    invalid TOML; InputError for a missing file.
    """
    by_section: dict[str, dict[str, Any]] = {}
    for where, section, values in _tables(path, assignments):
        by_section.setdefault(section, {}).update(_convert(where, section, values))
    default = Config()
    return replace(
        default, **{name: replace(getattr(default, name), **values) for name, values in by_section.items()}
    )


def _tables(path: Path | None, assignments: Sequence[str]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for name in [
        text.partition("=")[2].strip() for text in assignments if text.partition("=")[0].strip() == "preset"
    ]:
        _check_known(name, PRESETS, "--preset", "")
        yield from ((f"--preset {name}", section, values) for section, values in PRESETS[name].items())
    with (
        refuse_faults(lambda _: f"{path}: no such file", FileNotFoundError, remedy="give an existing TOML file"),
        refuse_faults(f"{path}: not valid TOML", ValueError, error=UsageError),  # UTF-8 and too long integers, too
    ):
        document = {} if path is None else tomllib.loads(path.read_text(encoding="utf-8"))
    for section, values in document.items():
        _check_known(section, [field.name for field in fields(Config)], str(path), "")
        refuse_if(
            not isinstance(values, dict),
            f"{path}: {section}: expected a table, got {format_value(values)}",
            error=UsageError,
        )
        yield str(path), section, values
    for assignment in assignments:
        if assignment.partition("=")[0].strip() == "preset":
            continue
        key, separator, text = assignment.partition("=")
        section, dot, name = key.strip().partition(".")
        refuse_if(
            not separator or not dot,
            f"--set {assignment}: expected section.key=value",
            remedy="write it like --set scene.max_splats=3000",
            error=UsageError,
        )
        where = f"--set {shorten(assignment)}"
        _check_known(section, [field.name for field in fields(Config)], where, "")
        yield where, section, {name: _parse_value(text.strip())}


def _convert(where: str, section: str, values: dict[str, Any]) -> dict[str, Any]:
    kind = type(getattr(Config(), section))
    assert issubclass(kind, Section)
    hints, declared = get_type_hints(kind), kind.declared
    typed: dict[str, Any] = {}
    for key, value in values.items():
        _check_known(key, declared, where, f"{section}.")
        typed[key] = _has_type(value, hints[key])
        kinds = [get_origin(option) or option for option in _options(hints[key])]
        expected = f"{type_name(hints[key])}, " if isinstance(declared[key], Within) else ""
        refuse_if(
            type(typed[key]) not in kinds,
            f"{where}: {section}.{key}: expected {expected}{declared[key].expected}, got {format_value(value)}",
            error=UsageError,
        )
    return typed


def _check_known(name: str, known: Collection[str], where: str, prefix: str) -> None:
    if name not in known:
        first = ", ".join(list(known)[:8]) + (", ... (splatctrl config --template has all)" if len(known) > 8 else "")
        choices = did_you_mean(name, known, f"known here: {first}", prefix=prefix, cutoff=0.4)
        raise UsageError(f"{where}: unknown key {prefix}{name}", remedy=choices)


def _parse_value(text: str) -> Any:
    try:
        parsed = tomllib.loads(f"value = {text}")
    except ValueError:
        return text
    return parsed["value"] if list(parsed) == ["value"] else text


def type_name(hint: Any) -> str:
    """A key's type in words, such as float or list of float."""
    names = ["list of float" if option == tuple[float, ...] else option.__name__ for option in _options(hint)]
    return " or ".join(names)


def _options(hint: Any) -> tuple[Any, ...]:
    return get_args(hint) if isinstance(hint, types.UnionType) else (hint,)


def _has_type(value: Any, hint: Any) -> Any:
    options = _options(hint)
    if str in options and isinstance(value, float) and math.isnan(value):
        return "nan"  # a word here, which TOML takes for a number
    if isinstance(value, list) and tuple[float, ...] in options:
        numbers = tuple(_has_type(item, float) for item in value)
        return numbers if all(type(number) is float for number in numbers) else value
    is_float = float in options and type(value) is int and abs(value) < 1 << 1023  # what a float holds
    return float(value) if is_float else value


DEFAULT = "default"

Value = int | float | str | tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class Setting:
    """A key with its value; source: `DEFAULT`, preset, file name, or ``--set``."""

    section: str
    key: str
    value: Value
    default: Value
    source: str
    declared: Declared

    @property
    def name(self) -> str:
        return f"{self.section}.{self.key}"

    def as_dict(self) -> dict[str, object]:
        return {
            "value": self.value,
            "default": self.default,
            "source": self.source,
            "expected": self.declared.expected,
            "meaning": self.declared.reason,
        }


def resolved_settings(path: Path | None, assignments: Sequence[str]) -> tuple[Setting, ...]:
    """All keys after defaults, preset, file and assignments. Raises as `load_config`."""
    used, default = load_config(path, assignments), Config()
    sources = {
        f"{section}.{key}": "--set" if where.startswith("--set ") else where
        for where, section, values in _tables(path, assignments)
        for key in values
    }
    return tuple(
        Setting(
            section=section,
            key=key,
            value=getattr(getattr(used, section), key),
            default=getattr(values, key),
            source=sources.get(f"{section}.{key}", DEFAULT),
            declared=declared,
        )
        for section, values in vars(default).items()
        for key, declared in values.declared.items()
    )


def toml_of(settings: Sequence[Setting]) -> Iterator[str]:
    """TOML lines of every key; changed ones with source and default."""
    for section, setting in _add_headers(settings):
        yield from section
        changed = f"  # {setting.source} (default: {toml_value(setting.default)})"
        yield f"{setting.key} = {toml_value(setting.value)}" + ("" if setting.source == DEFAULT else changed)


def template_of(settings: Sequence[Setting]) -> Iterator[str]:
    """TOML lines of every default as a comment, with meaning and range."""
    for section, setting in _add_headers(settings):
        yield from section
        yield f"# {setting.declared.reason}; {setting.declared.expected}"
        yield f"# {setting.key} = {toml_value(setting.default)}"


def toml_value(value: Value) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(repr, value))}]"
    return json.dumps(value) if isinstance(value, str) else repr(value)


def _add_headers(settings: Sequence[Setting]) -> Iterator[tuple[list[str], Setting]]:
    before = ""
    for setting in settings:
        blank = [""] if before else []
        yield ([*blank, f"[{setting.section}]"] if setting.section != before else []), setting
        before = setting.section
