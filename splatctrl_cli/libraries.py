"""Libraries that take most of a second to load, each loaded when a name of it is first used."""

from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING


class _LoadedLate(ModuleType):
    """Stands for a library; a name of it may be one of its submodules."""

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

__all__ = ["distributed", "mpl", "scipy_io", "trimesh"]
