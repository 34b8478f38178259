"""Modules found by name: lazy libraries, extras, and registry entries of rooms."""

from importlib import import_module
from importlib.util import find_spec
from operator import attrgetter
from pkgutil import iter_modules
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeVar

from splatctrl_cli.errors import UsageError, refuse_faults


class _LoadedLate(ModuleType):
    """A lazy library or submodule."""

    def __getattr__(self, name: str) -> object:
        library = import_module(self.__name__)
        if not hasattr(library, name):
            import_module(f"{self.__name__}.{name}")
        return getattr(library, name)


if TYPE_CHECKING:  # the same names, for type checkers
    import distributed
    import matplotlib as mpl
    import trimesh
    from scipy import io as scipy_io
else:
    mpl, trimesh = _LoadedLate("matplotlib"), _LoadedLate("trimesh")
    distributed, scipy_io = _LoadedLate("distributed"), _LoadedLate("scipy.io")


def is_installed(module: str) -> bool:
    """True if an extra's library is installed; it is not loaded."""
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:
        return False


def import_extra(module: str, extra: str, what: str) -> Any:
    """A library that reads `what`. Raises UsageError if its extra is not installed."""
    remedy = f"pip install 'splatctrl-cli[{extra}]'"
    with refuse_faults(f"{what} need the library {module}", ImportError, remedy=remedy, error=UsageError):
        return import_module(module)


__all__ = ["distributed", "import_extra", "is_installed", "mpl", "scipy_io", "trimesh"]


Entry = TypeVar("Entry")  # of a registry; lists and trials start with the lowest `order`


def entries_of(room: str, kind: type[Entry]) -> tuple[Entry, ...]:
    """Entries of type `kind` in the ``ENTRIES`` of a room's modules, in order."""
    modules = [import_module(f"{room}.{entries.name}") for entries in iter_modules(import_module(room).__path__)]
    entries = [entry for module in modules for entry in getattr(module, "ENTRIES", ()) if isinstance(entry, kind)]
    return tuple(sorted(entries, key=attrgetter("order")))
