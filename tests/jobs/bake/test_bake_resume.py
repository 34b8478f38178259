"""Bakes that are continued: whatever stops a bake, the rest of it ends in the same bytes."""

import json
import re
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

from splatctrl_cli.errors import UsageError, WriteError
from splatctrl_cli.evaluate.verdict import JudgedResult
from splatctrl_cli.field import grid_cells, slabs
from splatctrl_cli.field.baker import Baker
from splatctrl_cli.field.grid_cells import GridLayout
from splatctrl_cli.formats.grid.grid_format import GridSlabs
from splatctrl_cli.formats.grid.grid_formats import FORMATS
from splatctrl_cli.formats.splat.splats import write_ply
from splatctrl_cli.jobs.bake import bake as bake_slabs
from splatctrl_cli.records import Label
from tests.field.scenes import cloud, splat_set
from tests.jobs.bake.baked import Said, baked
from tests.jobs.stage import contents, failing, patch_json
from tests.refused import expect_refusal

ROOT = Path(__file__).parents[3]
CHANNELS = ("gradient", "bound", "observed", "label", "se")


@pytest.fixture
def small_slabs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slabs, "SLAB_BYTES", 1)  # a block's planes


@pytest.fixture(scope="module")
def whole(splats: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What a bake in one slab gives."""
    out = tmp_path_factory.mktemp("whole") / "field"
    bake(splats, out)
    return contents(out)


def bake(splats: Path, out: Path, **more: Any) -> JudgedResult:
    options: dict[str, Any] = {"voxel": 0.03, "channels": CHANNELS, "formats": ("npz", "vti")}
    return baked(splats, out, **(options | more))


def interrupted(splats: Path, out: Path, after: int, error: BaseException | None = None) -> str:
    """What a person is told whose bake was stopped at that slab."""
    raised = WriteError if isinstance(error, OSError) else KeyboardInterrupt
    with pytest.MonkeyPatch.context() as patch, pytest.raises(raised) as stop:
        patch.setattr(GridSlabs, "write", failing(GridSlabs.write, after, error or KeyboardInterrupt()))
        bake(splats, out)
    return str(stop.value)


FULL = OSError(28, "No space left on device", "field.partial/channels/sdf.npy")


@pytest.mark.usefixtures("small_slabs")
@pytest.mark.parametrize(("after", "error"), [(2, None), (4, None), (3, FULL)], ids=["early", "late", "a full disk"])
def test_an_interrupted_bake_says_how_to_go_on_and_does(
    splats: Path, whole: dict[str, Any], tmp_path: Path, after: int, error: OSError | None
) -> None:
    said = interrupted(splats, tmp_path / "field", after, error)
    assert "--resume" in said
    assert error or "field.partial is kept; continue it with the same command and --resume" in said
    bake(splats, tmp_path / "field", resume=True, threads=1)
    assert contents(tmp_path / "field") == whole


@pytest.mark.usefixtures("small_slabs")
def test_a_bake_stopped_while_it_writes_files_goes_on(
    splats: Path, whole: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setitem(FORMATS, "vti", replace(FORMATS["vti"], write=interrupted_write))
        bake(splats, tmp_path / "field")
    assert (tmp_path / "field.partial" / "left over").is_file()
    monkeypatch.setattr(Baker, "bake", None)  # nothing is left to bake
    bake(splats, tmp_path / "field", resume=True)
    assert contents(tmp_path / "field") == whole


def interrupted_write(path: Path, grid: object) -> None:
    (path.parent / "left over").write_text("half a file")
    raise KeyboardInterrupt


def test_a_killed_process_goes_on_to_the_same_bytes(splats: Path, whole: dict[str, Any], tmp_path: Path) -> None:
    program = """
import os, signal, sys
from pathlib import Path
from splatctrl_cli.field import grid_cells, slabs
from splatctrl_cli.formats.grid.grid_format import GridSlabs
from tests.jobs.bake.test_bake_resume import bake
slabs.SLAB_BYTES, real, calls = 1, GridSlabs.write, []
def write(self, *slab):
    real(self, *slab)
    calls.append(1)
    if len(calls) == 2:
        os.kill(os.getpid(), signal.SIGKILL)
GridSlabs.write = write
bake(Path(sys.argv[1]), Path(sys.argv[2]), resume=True, threads=int(sys.argv[3]))
"""
    out, said = tmp_path / "field", Said()
    for threads in ("1", "2"):
        words = [sys.executable, "-c", program, str(splats), str(out), threads]
        assert subprocess.run(words, cwd=ROOT, capture_output=True, check=False).returncode == -signal.SIGKILL
    progress = json.loads((tmp_path / "field.partial" / "channels" / "progress.json").read_text())
    assert progress["num_layers"] == 32, "two slabs of each of both runs"
    bake(splats, out, resume=True, progress=said)
    assert "continues after 32 of" in said.lines[-1]
    assert contents(out) == whole


@pytest.mark.usefixtures("small_slabs")
@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"field": {"length_scale": 0.03}}, "field.length_scale was 0.02, is 0.03"),
        ({"labels": frozenset({Label.OBJECT})}, "labels was 'human,object', is 'object'"),
        ({"channels": ("sdf", "bound")}, "channels was ["),
        ({"voxel": 0.04}, "voxel was 0.03, is 0.04"),
    ],
)
def test_what_was_baked_otherwise_is_not_gone_on_with(
    splats: Path, tmp_path: Path, more: dict[str, Any], words: str
) -> None:
    interrupted(splats, out := tmp_path / "field", 3)
    said = f"{re.escape(words)}.*bake without --resume"
    expect_refusal(said, bake, splats, out, resume=True, error=UsageError, **more)
    assert (tmp_path / "field.partial" / "channels" / "sdf.npy").is_file()


@pytest.mark.usefixtures("small_slabs")
def test_other_splats_are_not_gone_on_with(splats: Path, tmp_path: Path) -> None:
    mine, (centers, radii) = Path(shutil.copy(splats, tmp_path / "splats.ply")), cloud()
    interrupted(mine, tmp_path / "field", 3)
    radii[3] *= 1.5
    write_ply(mine, splat_set(centers, radii + 0.001), {})
    expect_refusal(r"sha256 of splats\.ply was", bake, mine, tmp_path / "field", resume=True, error=UsageError)


@pytest.mark.usefixtures("small_slabs")
def test_progress_without_counts_is_not_gone_on_with(splats: Path, tmp_path: Path) -> None:
    interrupted(splats, tmp_path / "field", 3)
    file = tmp_path / "field.partial" / "channels" / "progress.json"
    patch_json(file, lambda progress: {name: value for name, value in progress.items() if name != "counts"})
    expect_refusal(r"not readable.*counts.*bake without --resume", bake, splats, tmp_path / "field", resume=True)


def test_without_resume_an_interrupted_bake_is_replaced_with_a_warning(
    splats: Path, whole: dict[str, Any], tmp_path: Path
) -> None:
    interrupted(splats, tmp_path / "field", 1)
    bake(splats, tmp_path / "field", progress=(said := Said()))
    assert "an interrupted bake is replaced; --resume would have continued it" in said.lines[0]
    assert contents(tmp_path / "field") == whole


def test_a_full_disk_is_told_before_anything_is_baked(
    splats: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(bake_slabs.shutil, "disk_usage", lambda path: usage(0, 0, 3 * 2**20))
    said = r"of disk.*0\.0 GiB \(3145728 bytes\) is free at.*fewer --channels"
    expect_refusal(said, bake, splats, tmp_path / "field", error=UsageError)
    assert not list(tmp_path.iterdir())


def test_openvdb_that_does_not_fit_the_memory_is_told_before_anything_is_baked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    grid = GridLayout(origin=np.zeros(3), voxel=0.1, shape=(100, 100, 100))
    monkeypatch.setattr(grid_cells, "available_memory", lambda: 27 * 10**6)
    bake_slabs.check_vdb(grid, ["sdf"], ["npz"])
    expect_refusal(
        r"format vdb: needs 0.0 GiB of memory.*leave it out of --formats",
        bake_slabs.check_vdb,
        grid,
        ["sdf"],
        ["npz", "vdb"],
        error=UsageError,
    )
    monkeypatch.setattr(grid_cells, "available_memory", lambda: 28 * 10**6)
    bake_slabs.check_vdb(grid, ["sdf"], ["npz", "vdb"])
