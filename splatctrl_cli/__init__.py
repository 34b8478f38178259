"""SplatCtrl: camera recordings of robots as splats, distance fields and replayed controllers.

`splatctrl_cli.api` has the public names.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from splatctrl_cli.api import *  # noqa: F403  (the same names, for type checkers)

__version__ = "0.2.0"


def __getattr__(name: str) -> object:
    if name == "__all__" or not name.startswith("_"):
        api = import_module("splatctrl_cli.api")
        if name in ("__all__", *api.__all__):
            return getattr(api, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *import_module("splatctrl_cli.api").__all__})
