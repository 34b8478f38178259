"""What a job says while it works."""

import sys
from typing import Protocol


class Progress(Protocol):
    """Takes log lines; `is_quiet` where nobody reads them, so that no bar is drawn."""

    is_quiet: bool

    def log(self, line: str) -> None:
        """One line."""
        ...


class Silent:
    """Says nothing."""

    is_quiet = True

    def log(self, line: str) -> None:
        """Drop the line."""


class Lines:
    """Prints on stderr."""

    is_quiet = False

    def log(self, line: str) -> None:
        """One line."""
        sys.stderr.write(line + "\n")
        sys.stderr.flush()


SILENT = Silent()
