"""An external process that answers line by line, with named faults and bounded resources."""

import os
import selectors
import signal
import subprocess
import time
from collections.abc import Sequence
from contextlib import suppress
from enum import StrEnum

MAX_LINE = 1 << 20  # bytes
LEAVE_LIMIT = 20.0  # [s] from closed stdout to the process's end: a busy machine takes seconds
TAIL = 4096  # bytes of stderr to keep


class Fault(StrEnum):
    LATE = "late"
    HUNG = "hung"
    OUT_OF_TIME = "out of time"
    CRASHED = "crashed"
    ENDED = "ended"
    NOT_JSON = "not JSON"
    NOT_MSGPACK = "not msgpack"
    ENDLESS_LINE = "endless line"
    OUT_OF_TURN = "out of turn"
    OTHER_PROTOCOL = "other protocol"
    WRONG_LENGTH = "wrong length"
    NOT_FINITE = "not finite"
    TOO_FAST = "too fast"
    DIFFERS = "differs"


class Misbehaved(Exception):  # noqa: N818  (a result, kept by name)
    """A controller's fault, in a sentence."""

    def __init__(self, fault: Fault, sentence: str) -> None:
        super().__init__(f"{fault}: {sentence}")
        self.fault, self.sentence = fault, sentence


class LineProcess:
    """A process that answers line by line, with bounded lines and stored stderr."""

    def __init__(self, command: Sequence[str]) -> None:
        """Raises OSError if it cannot start."""
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(
            command, stdin=pipe, stdout=pipe, stderr=pipe, bufsize=0, start_new_session=True
        )
        streams = (self._process.stdin, self._process.stdout, self._process.stderr)
        self._stdin, self._stdout, self._stderr = (stream.fileno() for stream in streams if stream is not None)
        self._unsent, self._received, self._tail = bytearray(), bytearray(), b""
        self._selector = selectors.DefaultSelector()
        for number in (self._stdin, self._stdout, self._stderr):
            os.set_blocking(number, False)
        for number in (self._stdout, self._stderr):
            self._selector.register(number, selectors.EVENT_READ)

    def exchange(self, line: bytes, limit: float) -> bytes:
        """Send a line and return the next one.

        Raises Misbehaved without a line within `limit` [s], for an endless line, or if the process ends.
        """
        deadline = time.monotonic() + limit
        if not self._unsent:
            self._selector.register(self._stdin, selectors.EVENT_WRITE)
        self._unsent += line
        while (end := self._received.find(b"\n")) < 0:
            if len(self._received) > MAX_LINE:
                raise Misbehaved(Fault.ENDLESS_LINE, f"printed more than {MAX_LINE >> 20} MiB without an end of line")
            left = deadline - time.monotonic()
            if left <= 0:
                raise Misbehaved(Fault.HUNG, f"no answer within {limit:g} s{self.last_words()}")
            self._transfer(left)
        answer = bytes(self._received[:end])
        del self._received[: end + 1]
        return answer

    def last_words(self) -> str:
        """Last stderr line to append to a sentence, or nothing."""
        lines = [line.strip() for line in self._tail.decode("utf-8", "replace").splitlines() if line.strip()]
        return f": {shown(lines[-1])}" if lines else ""

    def close(self) -> None:
        """End the process and its children."""
        self._selector.close()
        for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
            if stream is not None:
                with suppress(OSError):
                    stream.close()
        self._has_left(0.2)  # by itself, after the end of its input
        self._kill()

    def _has_left(self, seconds: float) -> bool:
        """True if the process ends in time. It is not reaped: its number stays reserved."""
        deadline, how = time.monotonic() + seconds, os.WEXITED | os.WNOWAIT | os.WNOHANG
        while self._process.returncode is None and os.waitid(os.P_PID, self._process.pid, how) is None:
            if time.monotonic() > deadline:
                return False
            time.sleep(0.005)
        return True

    def _kill(self) -> None:
        if self._process.returncode is None:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()

    def _transfer(self, timeout: float) -> None:
        for key, _ in self._selector.select(timeout):
            if key.fd == self._stdin:
                self._send()
            elif key.fd == self._stderr:
                if not self._keep_tail():
                    self._selector.unregister(self._stderr)
            elif not (part := os.read(self._stdout, 1 << 16)):
                raise self._ended()
            else:
                self._received += part

    def _send(self) -> None:
        try:
            del self._unsent[: os.write(self._stdin, self._unsent)]
        except BrokenPipeError:  # its last words or its exit status are still to come
            self._unsent.clear()
        if not self._unsent:
            self._selector.unregister(self._stdin)

    def _keep_tail(self) -> bool:
        """Read available stderr; False at its end."""
        part = os.read(self._stderr, 1 << 16)
        self._tail = (self._tail + part)[-TAIL:]
        return bool(part)

    def _ended(self) -> Misbehaved:
        has_left = self._has_left(LEAVE_LIMIT)
        self._kill()
        with suppress(BlockingIOError):
            while self._keep_tail():
                pass
        status = self._process.returncode
        if not has_left or status == 0:
            return Misbehaved(Fault.ENDED, ("exit status 0" if has_left else "closed its stdout") + self.last_words())
        how = f"exit status {status}" if status > 0 else f"killed by signal {-status} ({signal.strsignal(-status)})"
        return Misbehaved(Fault.CRASHED, f"{how}{self.last_words()}")


def shown(text: str) -> str:
    """Output of a program, as one short line without terminal controls."""
    printable = "".join(c if c.isprintable() else "?" for c in text[:120])
    return f"{printable} ..." if len(text) > 120 else printable
