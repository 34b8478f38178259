"""Registries without a list: a room's modules declare what they add, so that an addition is a file of its own."""

from importlib import import_module
from pkgutil import iter_modules
from typing import Protocol, TypeVar


class Ordered(Protocol):
    """An entry of a registry; lists show the lowest `order` first, and things are tried in it."""

    @property
    def order(self) -> int: ...


Entry = TypeVar("Entry", bound=Ordered)


def entries_of(room: str, kind: type[Entry]) -> tuple[Entry, ...]:
    """The `kind` that the modules of the package `room` hold in their ``ENTRIES``, by order, then by module."""
    modules = [import_module(f"{room}.{found.name}") for found in iter_modules(import_module(room).__path__)]
    found = [entry for module in modules for entry in getattr(module, "ENTRIES", ()) if isinstance(entry, kind)]
    return tuple(sorted(found, key=lambda entry: entry.order))
