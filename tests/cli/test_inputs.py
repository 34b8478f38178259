"""What is no file is not read: a FIFO would wait for ever, a device never end, a link to itself lead nowhere."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.splat_files.splat_formats import FORMATS
from tests.datasets.make_layout import make_tum
from tests.logs.make_log import LogRecipe, make_log
from tests.splat_files.test_gaussian_ply import gaussian_set

RUN = """
import contextlib, io, sys
from splatctrl_cli.cli.main import main
from splatctrl_cli.splat_files.splat_formats import FORMATS
for line in sys.stdin:
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        code = main(line.split())
    print(code, said.getvalue().strip().splitlines()[-1:], flush=True)
"""
COMMANDS = ("info {}", "check {}", "ingest {} -o out", "export {} -o out.ply", "capture unpack {}")


def odd_files(folder: Path) -> list[Path]:
    """A FIFO without a writer, a link to an endless device, a socket, a link to itself."""
    os.mkfifo(folder / "fifo")
    (folder / "zero").symlink_to("/dev/zero")
    (folder / "loop").symlink_to("loop")
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(os.path.relpath(folder / "socket"))  # an absolute path may be too long for it
    return [folder / name for name in ("fifo", "zero", "loop", "socket")]


def test_what_is_no_file_is_refused_by_every_command_at_once(tmp_path: Path) -> None:
    folder = make_tum(tmp_path / "rgbd_dataset_freiburg3_x")
    image = next((folder / "depth").iterdir())
    image.unlink()
    os.mkfifo(image)
    odd = [*odd_files(tmp_path), *(tmp_path / name for name in ("fifo.toml", "fifo.mcap", "fifo.ply"))]
    for path in odd[4:]:
        os.mkfifo(path)
    lines = [command.format(path) for command in COMMANDS for path in odd]
    before = set(tmp_path.rglob("*"))
    done = subprocess.run(
        [sys.executable, "-c", RUN],
        input="\n".join([*lines, f"ingest {folder} -o {tmp_path / 'a.capture'}"]),
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
        cwd=tmp_path,
    )
    said = done.stdout.splitlines()
    for line, answer in zip(lines, said, strict=False):
        assert answer.startswith("4 ["), f"{line}: {answer}"
    assert said[-1].startswith("0 "), "an image that is a FIFO counts as missing"
    assert {path for path in set(tmp_path.rglob("*")) - before if path.parts[-2] == tmp_path.name} == {
        tmp_path / "a.capture"
    }


def test_a_pipe_of_the_shell_and_dev_null_are_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = make_log(tmp_path / "log.mcap", LogRecipe(num_frames=1))
    read, write = os.pipe()
    os.write(write, b"[occupancy]\nvoxel = 0.02\n")
    os.close(write)
    assert main(["info", str(log)]) == 0
    assert Path(f"/dev/fd/{read}").read_text() == "[occupancy]\nvoxel = 0.02\n"
    os.close(read)
    assert Path(os.devnull).read_text() == ""
    assert capsys.readouterr().err == ""


def test_a_name_that_is_no_text_is_described_and_not_written_down(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = make_log(tmp_path / "log.mcap", LogRecipe(num_frames=1)).rename(tmp_path / os.fsdecode(b"a\xff\nb.mcap"))
    assert main(["info", str(log), "--json"]) == 0
    assert main(["ingest", str(log), "-o", str(tmp_path / "x.capture")]) == 4
    assert "is no UTF-8 text; give the file another name" in capsys.readouterr().err.splitlines()[-1]
    assert list(tmp_path.iterdir()) == [log]


def test_a_splat_file_of_any_name_is_exported(tmp_path: Path) -> None:
    given = tmp_path / os.fsdecode(b"a\xff\nb.ply")
    FORMATS[".ply"].write(given, gaussian_set(4), {})
    assert main(["export", str(given), "-o", str(tmp_path / "out.ply")]) == 0
    assert r"exported_from: 'a\udcff\nb.ply' sha256" in (tmp_path / "out.ply").read_bytes()[:2000].decode("latin-1")
