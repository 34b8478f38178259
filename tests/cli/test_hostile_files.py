"""Files made to take memory or time, to reach outside, or that never end: each is refused in one line, at once."""

import io
import json
import os
import pickle
import socket
import struct
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from splatctrl_cli.cli.main import main
from splatctrl_cli.formats.arrays import npy_of
from splatctrl_cli.formats.splat.splats import FORMATS
from splatctrl_cli.robot.link_meshes import mesh_path
from splatctrl_cli.robot.urdf import MeshShape
from tests.formats.make_npz import write_zeros
from tests.formats.splat.test_gaussian_ply import gaussian_set
from tests.recording.folder.make_layout import make_tum
from tests.recording.log.make_log import LogRecipe, make_log
from tests.refused import expect_refusal
from tests.robot.shapes import written

CAMERA = "[camera]\nwidth = 8\nheight = 6\nfx = 10\nfy = 10\ncx = 4.0\ncy = 3.0\n"
LAUGHS = "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 12))
HUGE = (1 << 40,)
BIG, MANY = (1 << 14, 1 << 9, 1 << 9), (1 << 9, 1 << 9, 1 << 10)  # voxels; the latter are 1.75 GiB


def npy(shape: tuple[int, ...], dtype: str = "<f4", data: bytes = bytes(64)) -> bytes:
    """A .npy file whose header announces any shape."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": dtype, "fortran_order": False, "shape": shape})
    return stream.getvalue() + data


def npz(path: Path, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return path


def png(width: int, height: int) -> bytes:
    def part(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    head = part(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + part(b"IDAT", zlib.compress(bytes(1 << 20))) + part(b"IEND", b"")


def xml(folder: Path, text: str) -> list[str]:
    return ["robot", "info", "--urdf", str(written(folder, text, "x.urdf"))]


def images(folder: Path, name: str, depth: bytes) -> list[str]:
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir()
    (folder / "rgb/0.png").write_bytes(png(8, 6))
    (folder / f"depth/0.{name}").write_bytes(depth)
    (folder / "t.log").write_text("0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    frames = f'[frames]\ncolor = "rgb/*.png"\ndepth = "depth/*.{name}"\n[depth]\nscale = 1e-3\n'
    poses = '[poses]\nformat = "trajectory-log"\nfile = "t.log"\n'
    described = written(folder, f'root = "."\n{CAMERA}{frames}{poses}', "x.toml")
    return ["ingest", str(described), "-o", str(folder / "x.capture")]


def saved(path: Path, data: bytes) -> list[str]:
    path.write_bytes(data)
    return ["info", str(path)]


def scene(folder: Path, **zeros: tuple[tuple[int, ...], str]) -> list[str]:
    """A scene with an occupancy of really packed zeros."""
    (folder / "splats.ply").write_bytes(PLY)
    shape = next(iter(zeros.values()))[0]
    write_zeros(folder / "occupancy.npz", zeros, header=json.dumps({"shape": shape, "origin": [0, 0, 0], "voxel": 1}))
    return ["info", str(folder)]


def states(folder: Path, shape: tuple[int, ...]) -> list[str]:
    """A table of joint states of really packed zeros."""
    write_zeros(folder / "x.npz", {"t": ((shape[0],), "<f8"), "q": (shape, "<f8")})
    table = '[states]\nfile = "x.npz"\njoints = ["a", "b"]\ntime = "t"\nposition = "q"\n'
    return ["check", str(written(folder, table, "x.toml"))]


BLOATED = (  # a header of no pixels, then a chunk that announces 0x77000000 bytes
    b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR" + bytes(22) + b"\x77" + bytes(13) + b"\xc6H\xb72\xdb\x84\0\0\0IEND\xaeB`\x82"
)
BARE = bytes.fromhex(  # its only chunk beside the first and last is of a kind that there is not
    "89504e470d0a1a0a0000000d49484452000000080000000610000000008bfe5c6400000042494441444154081d05c131"
    "01c2001000b1fe9f86aa40052aba62000f9582900c48410ac91cc74a5692397f495692797c939564cdf393ac246bae3b"
    "2bc9cabc5f594956feeef223b7b430db84000049454e44ae426082"
)
PLY = b"ply\nformat binary_little_endian 1.0\nelement vertex 99999999999\nproperty float x\nend_header\n"
CASES: dict[str, Callable[[Path], list[str]]] = {
    "billion laughs": lambda d: xml(d, f'<!DOCTYPE robot [<!ENTITY a0 "ha">{LAUGHS}]><robot name="&a11;"/>'),
    "outer entity": lambda d: xml(d, '<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]><robot name="&x;"/>'),
    "info of laughs": lambda d: ["info", xml(d, f'<!DOCTYPE r [<!ENTITY a0 "h">{LAUGHS}]><robot name="&a11;"/>')[3]],
    "depth announced": lambda d: images(d, "npy", npy(HUGE)),
    "depth of objects": lambda d: images(d, "npy", npy((4,), "|O", pickle.dumps([1]))),
    "depth of a thousand million pixels": lambda d: images(d, "png", png(32767, 32767)),
    "a chunk of 2 GiB in a PNG": lambda d: saved(d / "x.png", BLOATED),
    "a PNG without pixels": lambda d: saved(d / "x.png", BARE),
    "image": lambda d: saved(d / "x.png", png(32767, 32767)),
    "array announced": lambda d: saved(d / "x.npy", npy(HUGE)),
    "pickled array": lambda d: saved(d / "x.npy", npy((4,), "|O", pickle.dumps([1]))),
    "text announced": lambda d: ["info", str(npz(d / "x.npz", header=npy((), f"<U{1 << 28}")))],
    "grid announced": lambda d: ["info", str(npz(d / "x.npz", header=npy((), "<U2"), sdf=npy((1 << 13,) * 3)))],
    "deep JSON": lambda d: saved(d / "x.json", b"[" * 100_000),
    "deep YAML": lambda d: saved(d / "x.yaml", b"[" * 100_000),
    "deep TOML": lambda d: saved(d / "x.toml", b"a = " + b"[" * 100_000),
    "occupancy of 28 GiB": lambda d: scene(d, log_odds=(BIG, "<f4"), num_updates=(BIG, "<u2"), entity=(BIG, "|u1")),
    "occupancy of as many voxels as may be": lambda d: scene(
        d, log_odds=(MANY, "<f4"), num_updates=(MANY, "<u2"), entity=(MANY, "|u1")
    ),
    "states of 16 GiB": lambda d: states(d, (1 << 30, 2)),
    "splats announced": lambda d: saved(d / "x.ply", PLY),
}

CODES = {"grid announced": {0, 4}, "splats announced": {0, 4}, "states of 16 GiB": {1}}  # 1: a finding of check

RUN = """
import json, os, resource, signal, sys
from splatctrl_cli.cli.main import main
import splatctrl_cli.cli.check, cv2, numpy, splatctrl_cli.recording.source
for line in sys.stdin:
    child = os.fork()
    if child == 0:
        words, said = json.loads(line)
        signal.alarm(60)
        pages = int(open("/proc/self/statm").read().split()[0])
        limit = pages * resource.getpagesize() + 2**30
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        for stream in (1, 2):
            os.dup2(os.open(said, os.O_WRONLY | os.O_CREAT | os.O_APPEND), stream)
        code = main(words)
        sys.stdout.flush()
        os._exit(code)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


def test_a_hostile_file_is_refused_or_described_within_bounds(tmp_path: Path) -> None:
    """Each by a process of its own, forked from one that has imported the libraries."""
    lines = []
    for number, make in enumerate(CASES.values()):
        folder = tmp_path / str(number)
        folder.mkdir()
        lines.append(json.dumps((make(folder), str(tmp_path / f"{number}.txt"))))
    there = set(tmp_path.rglob("*"))
    environment = os.environ | {"OPENCV_IO_MAX_IMAGE_PIXELS": str(1 << 27), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", RUN], input="\n".join(lines), stdout=-1, text=True, check=True, env=environment
    )
    for number, (name, code) in enumerate(zip(CASES, done.stdout.split(), strict=True)):
        said = (tmp_path / f"{number}.txt").read_text()
        assert int(code) in CODES.get(name, {4}), f"{name}: {code}: {said}"
        assert "Traceback" not in said and "internal error" not in said, f"{name}: {said}"
    assert set(tmp_path.rglob("*")) - there == {tmp_path / f"{number}.txt" for number in range(len(CASES))}


def test_a_package_path_that_leaves_its_package_is_refused(tmp_path: Path) -> None:
    package = tmp_path / "arm" / "urdf"
    package.mkdir(parents=True)
    for file in (tmp_path / "secret.stl", tmp_path / "arm" / "own.stl"):
        file.write_text("solid x")
    mesh = MeshShape(link="a", filename="package://arm/own.stl", scale=(1.0, 1.0, 1.0), T_link_mesh=np.eye(4))
    assert mesh_path(package / "x.urdf", mesh) == tmp_path / "arm" / "own.stl"
    for name in ("package://arm/../secret.stl", "package://../secret.stl", "package:///etc/passwd"):
        expect_refusal("lies outside its package", mesh_path, package / "x.urdf", replace(mesh, filename=name))


@pytest.mark.parametrize(
    "array",
    [
        np.arange(6, dtype="<f4").reshape(2, 3),
        np.asfortranarray(np.arange(6).reshape(2, 3)),
        np.zeros(0),
    ],
)
def test_a_npy_file_is_read_as_numpy_reads_it_and_no_further(array: NDArray[np.generic]) -> None:
    stream = io.BytesIO()
    np.save(stream, array)
    assert np.array_equal(npy_of(stream.getvalue()), array)
    with pytest.raises(ValueError, match="announces"):
        npy_of(stream.getvalue() + b"x")


@pytest.mark.parametrize(
    ("data", "words"),
    [(npy(HUGE), "announces 4398046511104 bytes, holds 64"), (npy((1,), "|O"), "objects")],
)
def test_a_npy_file_of_more_than_it_holds_or_of_objects_is_not_read(data: bytes, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        npy_of(data)


RUN_LINES = """
import contextlib, io, sys
from splatctrl_cli.cli.main import main
from splatctrl_cli.formats.splat.splats import FORMATS
for line in sys.stdin:
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        code = main(line.split())
    print(code, said.getvalue().strip().splitlines()[-1:], flush=True)
"""
COMMANDS = ("info {}", "check {}", "ingest {} -o out", "export {} -o out.ply")


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
        [sys.executable, "-c", RUN_LINES],
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


@pytest.mark.parametrize(
    ("config", "code", "said"),
    [("<(echo '[occupancy]'; echo 'voxel = -2')", 2, "occupancy.voxel: expected"), (os.devnull, 0, "")],
)
def test_a_pipe_of_the_shell_and_dev_null_are_read(tmp_path: Path, config: str, code: int, said: str) -> None:
    command = ["bash", "-c", f"{Path(sys.executable).with_name('splatctrl')} config {config}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == code and said in done.stderr, done.stderr


def test_a_name_that_is_no_text_is_described_and_not_written_down(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = make_log(tmp_path / "log.mcap", LogRecipe(num_frames=1)).rename(tmp_path / os.fsdecode(b"a\xff\nb.mcap"))
    assert main(["info", str(log), "--json"]) == 0
    assert main(["ingest", str(log), "-o", str(tmp_path / "x.capture")]) == 4
    assert "is not UTF-8 text; give the file another name" in capsys.readouterr().err.splitlines()[-1]
    assert list(tmp_path.iterdir()) == [log]


def test_a_splat_file_of_any_name_is_exported(tmp_path: Path) -> None:
    given = tmp_path / os.fsdecode(b"a\xff\nb.ply")
    FORMATS[".ply"].write(given, gaussian_set(4), {})
    assert main(["export", str(given), "-o", str(tmp_path / "out.ply")]) == 0
    assert r"exported_from: 'a\udcff\nb.ply' sha256" in (tmp_path / "out.ply").read_bytes()[:2000].decode("latin-1")
