"""Every configuration key with value and source, as TOML for ``--config``."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from splatctrl_cli.config import Config, load_config, sources_of
from splatctrl_cli.config.ranges import Declared

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
    sources = sources_of(path, assignments)
    settings = []
    for section in fields(Config):
        kind = getattr(default, section.name)
        for key, declared in kind.declared.items():
            settings.append(
                Setting(
                    section=section.name,
                    key=key,
                    value=getattr(getattr(used, section.name), key),
                    default=getattr(kind, key),
                    source=sources.get(f"{section.name}.{key}", DEFAULT),
                    declared=declared,
                )
            )
    return tuple(settings)


def toml_of(settings: Sequence[Setting]) -> Iterator[str]:
    """TOML lines of every key; changed ones with source and default."""
    for section, setting in _with_sections(settings):
        yield from section
        changed = f"  # {setting.source} (default: {toml_value(setting.default)})"
        yield f"{setting.key} = {toml_value(setting.value)}" + ("" if setting.source == DEFAULT else changed)


def template_of(settings: Sequence[Setting]) -> Iterator[str]:
    """TOML lines of every default as a comment, with meaning and range."""
    for section, setting in _with_sections(settings):
        yield from section
        yield f"# {setting.declared.reason}; {setting.declared.expected}"
        yield f"# {setting.key} = {toml_value(setting.default)}"


def toml_value(value: Value) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(repr, value))}]"
    return json.dumps(value) if isinstance(value, str) else repr(value)


def _with_sections(settings: Sequence[Setting]) -> Iterator[tuple[list[str], Setting]]:
    before = ""
    for setting in settings:
        blank = [""] if before else []
        yield ([*blank, f"[{setting.section}]"] if setting.section != before else []), setting
        before = setting.section
