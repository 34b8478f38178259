"""One writer of an output at a time: a lock on ``NAME.partial`` itself, which ends with the process that holds it."""

import errno
import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from splatctrl_cli.errors import UsageError

LOCKS = Path("/proc/locks")
_WITHOUT_LOCKS = frozenset({errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EBADF})  # some network file systems


@contextmanager
def held(partial: Path, *, is_folder: bool) -> Iterator[None]:
    """Hold a partial output, which is made if it is not there, for the time of the block.

    The lock goes with the folder or file when that is renamed, and with the process when that is killed; nothing is
    left of it. On a file system without flock(2) nothing is locked. Raises UsageError where another run holds it.
    """
    descriptor = _taken(partial, is_folder=is_folder)
    try:
        yield
    finally:
        os.close(descriptor)


def remove(path: Path) -> None:
    """Remove a file, a link, or a folder with all that is in it; a missing one is no error."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _taken(partial: Path, *, is_folder: bool) -> int:
    """A descriptor of the partial output, locked."""
    while True:
        if partial.is_symlink():
            partial.unlink(missing_ok=True)
        if not partial.exists():
            partial.mkdir(exist_ok=True) if is_folder else partial.touch()
        try:
            descriptor = os.open(partial, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        except FileNotFoundError:
            continue  # its run ended between
        try:
            _lock(descriptor, partial)
            if _is_at(partial, descriptor):  # else it was renamed or removed between, and is another's
                if partial.is_dir() == is_folder:
                    return descriptor
                remove(partial)
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _lock(descriptor: int, partial: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        process = _holder(os.fstat(descriptor).st_ino)
        who = "another run" if process is None else f"another run (process {process})"
        raise UsageError(f"{partial}: {who} writes it", remedy="wait for it to end, or give another --out") from None
    except OSError as error:
        if error.errno not in _WITHOUT_LOCKS:
            raise


def _is_at(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.lstat())
    except FileNotFoundError:
        return False


def _holder(inode: int) -> int | None:
    """The process that holds a lock on an inode, None where the kernel does not tell."""
    try:
        lines = LOCKS.read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    for line in lines:  # 1: FLOCK  ADVISORY  WRITE 4711 08:01:131 0 EOF
        words = line.split()
        if (
            len(words) >= 6
            and words[1] == "FLOCK"
            and words[5].rpartition(":")[2] == str(inode)
            and int(words[4]) > 0
        ):
            return int(words[4])
    return None
