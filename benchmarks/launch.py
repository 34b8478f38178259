"""`launch.py COMMAND...`: run a command and print its wall time [s], peak memory [KiB] and exit code.

A process of its own, and a small one: on Linux a child's peak memory starts at that of the process that forked it.
"""

import os
import subprocess
import sys
import time


def main() -> None:
    """Run what the arguments say, without its output."""
    start = time.perf_counter()
    process = subprocess.Popen(sys.argv[1:], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    print(time.perf_counter() - start, usage.ru_maxrss, os.waitstatus_to_exitcode(status))


if __name__ == "__main__":
    main()
