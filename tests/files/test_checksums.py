"""SHA256SUMS is sorted by name, whatever the folders are called."""

import tempfile
from pathlib import Path

import pytest

from splatctrl_cli.files import checksums
from splatctrl_cli.files.checksums import Checksums


@pytest.mark.parametrize("in_memory", [0, 1, 1 << 16])
def test_lines_are_sorted_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_memory: int) -> None:
    monkeypatch.setattr(checksums, "IN_MEMORY", in_memory)
    sums, expected = Checksums(), set()
    for number in range(12):
        for folder in ("color/cam", "color/cam-b", "color/cam0", "depth/cam"):
            name = f"{folder}/{number:06d}.png"
            sums.add(f"{number:064x}", name)
            expected.add(name)
        sums.add_other("f" * 64, f"valid/cam/{number % 3}.png")
        expected.add(f"valid/cam/{number % 3}.png")
    for name in ("joints.npz", "capture.json", "joint_topics/a.npz", "frames.csv"):
        sums.add_other("0" * 64, name)
        expected.add(name)
    sums.write(tmp_path / "SHA256SUMS")
    lines = (tmp_path / "SHA256SUMS").read_text().splitlines()
    assert [line[66:] for line in lines] == sorted(expected)
    assert next(line for line in lines if line.endswith("color/cam-b/000011.png")).startswith("0" * 63 + "b  ")


def test_lines_lie_in_files_without_a_name(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(checksums, "IN_MEMORY", 1)
    sums = Checksums()
    sums.add("0" * 64, "color/cam/000000.png")
    assert list(tmp_path.iterdir()) == []
    assert sums._folders["color/cam"]._rolled  # type: ignore[attr-defined]
