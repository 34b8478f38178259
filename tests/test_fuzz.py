"""A short, seeded part of the fuzz campaign and of the kill test; that both see what they look for."""

import json
import random
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.fuzz import fault_of
from benchmarks.fuzz_mutate import mutated
from benchmarks.kill_test import contents, exact, judge

ROOT = Path(__file__).parent.parent


def test_mutated_inputs_of_every_kind_are_read_or_refused() -> None:
    command = [sys.executable, "-m", "benchmarks.fuzz", "--most", "36", "--minutes", "2", "--seed", "7"]
    command += ["--kinds", "mcap-plain", "bag", "db3", "images", "spz", "npz", "urdf", "table"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
    assert "36 inputs" in done.stdout
    assert "0 faults" in done.stdout


def test_a_seed_gives_the_same_input_again_and_another_seed_another() -> None:
    data = bytes(range(256)) * 20
    made = [mutated(data, random.Random(seed)) for seed in (1, 1, 2)]
    assert made[0] == made[1] != made[2]
    assert data not in made


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
    new = set()
    if file:
        path = tmp_path / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("x")
        new = {path}
    found = fault_of(code, 1.0, said, new, tmp_path)
    assert found.startswith(fault) if fault else found == ""


def test_a_half_written_output_is_seen(tmp_path: Path) -> None:
    whole = tmp_path / "whole.csv"
    whole.write_text("a,b\n1,2\n3,4\n")
    target = tmp_path / "out.csv"
    assert judge(target, contents(whole)) == ""
    target.write_text("a,b\n1,2\n")
    assert judge(target, contents(whole)) == "out.csv is there and differs"
    target.write_text(whole.read_text())
    assert judge(target, contents(whole)) == ""
    (tmp_path / "out.csv.partial").write_text("a,b\n1,2\n")
    assert judge(target, contents(whole)) == "", "by its name it is no CSV"


def test_an_output_that_went_on_is_compared_byte_by_byte_but_for_times(tmp_path: Path) -> None:
    for name, seconds in (("whole", 1.0), ("again", 2.0)):
        (tmp_path / name / "color").mkdir(parents=True)
        (tmp_path / name / "color" / "0.png").write_bytes(b"image")
        (tmp_path / name / "run.json").write_text(json.dumps({"seconds": seconds, "metrics": {"frames": 1}}) + "\n")
        (tmp_path / name / "SHA256SUMS").write_text(f"{seconds}  run.json\n1  color/0.png\n")
    whole = exact(tmp_path / "whole")
    assert exact(tmp_path / "again") == whole
    (tmp_path / "again" / "run.json").write_text(json.dumps({"seconds": 2.0, "metrics": {"frames": 2}}) + "\n")
    assert exact(tmp_path / "again") != whole
    (tmp_path / "again" / "run.json").write_text((tmp_path / "whole" / "run.json").read_text())
    (tmp_path / "again" / "color" / "0.png").write_bytes(b"imago")
    assert exact(tmp_path / "again") != whole
