"""Progress of a job."""

import time
from typing import Protocol, Self


class Progress(Protocol):
    """Receiver of log lines; no bar is drawn if `is_quiet`."""

    is_quiet: bool

    def log(self, line: str) -> None: ...


class Silent:
    """Progress without output."""

    is_quiet = True

    def log(self, line: str) -> None:
        """Drop the line."""


SILENT = Silent()


class Wait:
    """A wait of `total` steps (None: unknown), announced and reported with the time left."""

    def __init__(self, progress: Progress, what: str, unit: str, total: int | None = None) -> None:
        self._progress, self._what, self._unit, self._total = progress, what, unit, total
        self._reported = time.monotonic()
        self._first: tuple[float, int] | None = None  # time and number of the first steps, which take longer
        self._done = 0

    def announce(self) -> Self:
        self._progress.log(self._what + ("" if self._total is None else f": {self._total} {self._unit}"))
        return self

    def step(self) -> None:
        self.at(self._done + 1)

    def at(self, done: int) -> None:
        """Report `done` steps, at most every 10 s."""
        self._done, now = done, time.monotonic()
        self._first = self._first or ((now, done) if done else None)
        if self._total is not None and done > self._total:
            return  # steps beyond the announced total
        if now - self._reported < 10.0:  # [s] between two lines of one wait
            return
        self._reported, left = now, ""
        if self._total is not None and self._first is not None and done > self._first[1]:
            begun, before = self._first
            left = f", about {duration((now - begun) * (self._total - done) / (done - before))} left"
        of = "" if self._total is None else f" of {self._total}"
        self._progress.log(f"{self._what}: {done}{of} {self._unit}{left if done != self._total else ''}")


def duration(seconds: float) -> str:
    """Seconds in words: 40 s, 6 min, 1 h 20 min."""
    minutes = round(seconds / 60)
    if seconds < 90:
        return f"{max(round(seconds), 1)} s"
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"
