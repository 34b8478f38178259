"""What a path may name to be read: a file, a folder, or a pipe that the shell made; never a device or a FIFO."""

import errno
import os
import stat
import sys
from functools import cache

_BY_THE_SHELL = ("/dev/stdin", "/dev/fd/", "/proc/self/fd/")  # as in --config <(...)
_EMPTY = ("/dev/null", os.devnull)
_WRITES = os.O_WRONLY | os.O_RDWR
_NEVER_END = {"FIFO": stat.S_ISFIFO, "socket": stat.S_ISSOCK, "device": stat.S_ISCHR, "disk": stat.S_ISBLK}


@cache
def refuse_endless_files() -> None:
    """From now on, opening what is no file to read it raises OSError, wherever in the program that is.

    A FIFO in a folder of images would wait for its writer, a link to /dev/zero would fill the memory. Folders hold
    millions of files and are read in many places, so it is the interpreter that looks, once for each file it opens.
    """
    sys.addaudithook(_look)


def _look(event: str, arguments: tuple[object, ...]) -> None:
    if event != "open":
        return
    path, flags = arguments[0], arguments[2]
    if not isinstance(path, str | bytes) or (isinstance(flags, int) and flags & _WRITES):
        return
    name = os.fsdecode(path)
    if name.startswith(_BY_THE_SHELL) or name in _EMPTY:
        return
    try:
        mode = os.stat(name).st_mode  # noqa: PTH116  (also called while Path itself is imported)
    except (OSError, ValueError):
        return
    kind = next((kind for kind, is_one in _NEVER_END.items() if is_one(mode)), None)
    if kind is not None:
        raise OSError(errno.EINVAL, f"is a {kind}, expected a file", name)
