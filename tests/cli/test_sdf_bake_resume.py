"""``splatctrl sdf-bake --resume``: whatever stops a bake, the rest of it ends in the same bytes."""

import json
import shutil
import signal
import subprocess
import sys
from collections import namedtuple
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.cli import bake_run
from splatctrl_cli.cli.main import main
from splatctrl_cli.errors import UsageError
from splatctrl_cli.field import slabs
from splatctrl_cli.field.baker import Baker
from splatctrl_cli.field.layout import GridLayout
from splatctrl_cli.grid_files.grid_formats import FORMATS
from splatctrl_cli.grid_files.grid_slabs import GridSlabs
from splatctrl_cli.splat_files.splats import write_ply
from tests.field.scenes import cloud, splat_set

OPTIONS = ["--voxel", "0.03", "--set", "field.max_loss=1", "--channels", "gradient,bound,observed,label,se", "-q"]


@pytest.fixture
def small_slabs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slabs, "SLAB_BYTES", 1)  # a block's planes


@pytest.fixture(scope="module")
def splats(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("splats") / "splats.ply"
    centers, radii = cloud()
    write_ply(path, splat_set(centers, radii + 0.001), {})
    return path


@pytest.fixture(scope="module")
def whole(splats: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What a bake in one slab gives."""
    out = tmp_path_factory.mktemp("whole") / "field"
    assert main(["sdf-bake", str(splats), "-o", str(out), *OPTIONS]) == 0
    return contents(out)


def contents(folder: Path) -> dict[str, Any]:
    """Bytes by name, of run.json all but the timings and the command line."""
    found: dict[str, Any] = {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    run = json.loads(found["run.json"])
    del run["seconds"], run["arguments"]
    return found | {"run.json": run}


def bake(splats: Path, out: Path, *more: str) -> int:
    return main(["sdf-bake", str(splats), "-o", str(out), *OPTIONS, *more])


def stopped(monkeypatch: pytest.MonkeyPatch, error: BaseException, after: int) -> None:
    """The slab number `after` raises instead of being written."""
    real, calls = GridSlabs.write, []

    def write(self: GridSlabs, slab: Any) -> None:
        calls.append(1)
        if len(calls) == after:
            raise error
        real(self, slab)

    monkeypatch.setattr(GridSlabs, "write", write)


@pytest.mark.usefixtures("small_slabs")
def test_slabs_do_not_change_a_bit(splats: Path, whole: dict[str, Any], tmp_path: Path) -> None:
    assert bake(splats, tmp_path / "field") == 0
    assert contents(tmp_path / "field") == whole
    assert [path.name for path in tmp_path.iterdir()] == ["field"]


@pytest.mark.usefixtures("small_slabs")
@pytest.mark.parametrize("after", [1, 2, 4])
def test_an_interrupted_bake_says_how_to_go_on_and_does(
    splats: Path, whole: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str], after: int
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        stopped(patch, KeyboardInterrupt(), after)
        assert bake(splats, tmp_path / "field") == 130
    assert "field.partial is kept; go on with the same command and --resume" in capsys.readouterr().err
    assert bake(splats, tmp_path / "field", "--resume", "--threads", "1") == 0
    assert contents(tmp_path / "field") == whole


@pytest.mark.usefixtures("small_slabs")
def test_a_bake_stopped_while_it_writes_files_goes_on(
    splats: Path, whole: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(FORMATS, "vti", replace(FORMATS["vti"], write=interrupted_write))
        assert bake(splats, tmp_path / "field") == 130
    assert (tmp_path / "field.partial" / "left over").is_file()
    monkeypatch.setattr(Baker, "bake", None)  # nothing is left to bake
    assert bake(splats, tmp_path / "field", "--resume") == 0
    assert contents(tmp_path / "field") == whole


def interrupted_write(path: Path, grid: object) -> None:
    (path.parent / "left over").write_text("half a file")
    raise KeyboardInterrupt


def test_a_killed_process_goes_on_to_the_same_bytes(
    splats: Path, whole: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    program = """
import os, signal, sys
from splatctrl_cli.cli.main import main
from splatctrl_cli.errors import UsageError
from splatctrl_cli.field import layout, slabs
from splatctrl_cli.field.layout import GridLayout
from splatctrl_cli.grid_files.grid_slabs import GridSlabs
slabs.SLAB_BYTES, real, calls = 1, GridSlabs.write, []
def write(self, slab):
    real(self, slab)
    calls.append(1)
    if len(calls) == 2:
        os.kill(os.getpid(), signal.SIGKILL)
GridSlabs.write = write
sys.exit(main(sys.argv[1:]))
"""
    given = ["sdf-bake", str(splats), "-o", str(tmp_path / "field"), *OPTIONS]
    for threads in ("1", "2"):
        words = [sys.executable, "-c", program, *given, "--resume", "--threads", threads]
        assert subprocess.run(words, capture_output=True, check=False).returncode == -signal.SIGKILL
    progress = json.loads((tmp_path / "field.partial" / "channels" / "progress.json").read_text())
    assert progress["num_layers"] == 32, "two slabs of each of both runs"
    assert main([part for part in given if part != "-q"] + ["--resume"]) == 0
    assert "goes on after 32 of" in capsys.readouterr().err
    assert contents(tmp_path / "field") == whole


@pytest.mark.usefixtures("small_slabs")
@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--length-scale", "0.03"], "field.length_scale was 0.02, is 0.03"),
        (["--include", "none"], "labels was 'human,object', is 'object'"),
        (["--channels", "sdf,bound"], "channels was ["),
        (["--voxel", "0.04"], "voxel was 0.03, is 0.04"),
    ],
)
def test_what_was_baked_otherwise_is_not_gone_on_with(
    splats: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], words: str
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        stopped(patch, KeyboardInterrupt(), 3)
        assert bake(splats, tmp_path / "field") == 130
    capsys.readouterr()
    assert bake(splats, tmp_path / "field", *more, "--resume") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert "bake without --resume" in line
    assert (tmp_path / "field.partial" / "channels" / "sdf.npy").is_file()


@pytest.mark.usefixtures("small_slabs")
def test_other_splats_are_not_gone_on_with(splats: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mine = tmp_path / "splats.ply"
    shutil.copy(splats, mine)
    with pytest.MonkeyPatch.context() as patch:
        stopped(patch, KeyboardInterrupt(), 3)
        assert bake(mine, tmp_path / "field") == 130
    capsys.readouterr()
    centers, radii = cloud()
    radii[3] *= 1.5
    write_ply(mine, splat_set(centers, radii + 0.001), {})
    assert bake(mine, tmp_path / "field", "--resume") == 2
    assert "sha256 of splats.ply was" in capsys.readouterr().err


def test_without_resume_an_interrupted_bake_is_replaced_with_a_warning(
    splats: Path, whole: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        stopped(patch, KeyboardInterrupt(), 1)
        assert bake(splats, tmp_path / "field") == 130
    capsys.readouterr()
    assert main(["sdf-bake", str(splats), "-o", str(tmp_path / "field"), *OPTIONS[:-1]]) == 0
    assert "an interrupted bake is replaced; --resume would have gone on with it" in capsys.readouterr().err
    assert contents(tmp_path / "field") == whole


def test_a_full_disk_is_told_before_anything_is_baked(
    splats: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(bake_run.shutil, "disk_usage", lambda path: usage(0, 0, 3 * 2**20))
    assert bake(splats, tmp_path / "field") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "of disk" in line and "0.0 GiB (3145728 bytes) is free at" in line and "fewer --channels" in line
    assert not list(tmp_path.iterdir())


def test_openvdb_that_does_not_fit_the_memory_is_told_before_anything_is_baked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    grid = GridLayout(origin=np.zeros(3), voxel=0.1, shape=(100, 100, 100))
    monkeypatch.setattr(bake_run, "available_memory", lambda: 27 * 10**6)
    bake_run.check_vdb(grid, ["sdf"], ["npz"])
    with pytest.raises(UsageError, match=r"format vdb: needs 0.0 GiB of memory.*leave it out of --formats"):
        bake_run.check_vdb(grid, ["sdf"], ["npz", "vdb"])
    monkeypatch.setattr(bake_run, "available_memory", lambda: 28 * 10**6)
    bake_run.check_vdb(grid, ["sdf"], ["npz", "vdb"])


@pytest.mark.usefixtures("small_slabs")
def test_a_disk_that_fills_up_is_exit_code_6_and_goes_on(
    splats: Path, whole: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    full = OSError(28, "No space left on device", str(tmp_path / "field.partial" / "channels" / "sdf.npy"))
    with pytest.MonkeyPatch.context() as patch:
        stopped(patch, full, 3)
        assert bake(splats, tmp_path / "field") == 6
    assert "--resume" in capsys.readouterr().err
    assert bake(splats, tmp_path / "field", "--resume") == 0
    assert contents(tmp_path / "field") == whole
