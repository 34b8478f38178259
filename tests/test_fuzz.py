"""A short, seeded part of the fuzz campaign and of the kill test; that both see what they look for."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.fuzz import fault_of
from tests.robot.shapes import written

ROOT = Path(__file__).parent.parent


def test_mutated_inputs_of_every_kind_are_read_or_refused() -> None:
    command = [sys.executable, "-m", "benchmarks.fuzz", "--most", "24", "--minutes", "2", "--seed", "7"]
    command += ["--kinds", "mcap-plain", "bag", "db3", "images", "spz", "npz", "urdf", "table"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
    assert "24 inputs" in done.stdout and "0 faults" in done.stdout


@pytest.mark.parametrize(
    ("code", "said", "file", "fault"),
    [
        (0, "fine", "out/x/a.csv", ""),
        (4, "splatctrl: a line", "", ""),
        (70, "splatctrl: internal error", "", "exit code 70"),
        (-signal.SIGSEGV, "", "", "dies of SIGSEGV"),
        (-signal.SIGALRM, "", "", "hangs"),
        (0, "Traceback (most recent call last)", "", "prints a traceback"),
        (0, "", "evil", "writes outside its output"),
        (4, "", "out/x/a.csv", "leaves an output behind"),
        (3, "", "out/x.partial/a.csv", "leaves a partial output behind"),
    ],
)
def test_each_fault_is_seen(tmp_path: Path, code: int, said: str, file: str, fault: str) -> None:
    (tmp_path / "out").mkdir()
    new = {written(tmp_path, "x", file)} if file else set()
    found = fault_of(code, 1.0, said, new, tmp_path)
    assert found.startswith(fault) if fault else found == ""
