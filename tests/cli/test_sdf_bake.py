import json
import subprocess
import sys
from pathlib import Path

import pytest

from splatctrl_cli.io.grid import read_npz
from splatctrl_cli.io.splats import write_ply
from tests.field.scenes import cloud, splat_set


def sdf_bake(*arguments: object) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [sys.executable, "-m", "splatctrl_cli", "sdf-bake", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture(scope="module")
def splats(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("splats") / "splats.ply"
    write_ply(path, splat_set(*cloud_without_points()), {})
    return path


def cloud_without_points():  # type: ignore[no-untyped-def]
    centers, radii = cloud()
    return centers, radii + 0.001  # a PLY holds log radii


def test_bakes_both_formats_a_header_and_a_run(tmp_path: Path, splats: Path) -> None:
    out = tmp_path / "field"
    result = sdf_bake(splats, "-o", out, "--json", "--voxel", 0.05, "--require", "num_cells>=1000")
    assert (result.returncode, result.stderr.count("\n")) == (0, 1 + result.stderr.count("warning"))
    assert sorted(path.name for path in out.iterdir()) == ["field.json", "field.npz", "field.vti", "run.json"]
    grid, header = read_npz(out / "field.npz"), json.loads((out / "field.json").read_text())
    assert json.loads(result.stdout)["shape"] == list(grid.channels["sdf"].shape) == header["shape"]
    assert len(header["digests"]["splats.ply"]) == 64
    assert json.loads((out / "run.json").read_text())["config"]["field"]["voxel"] == 0.05


def test_box_voxel_and_formats_are_as_asked(tmp_path: Path, splats: Path) -> None:
    out = tmp_path / "field"
    result = sdf_bake(splats, "-o", out, "--box=-0.1,-0.1,-0.1,0.1,0.1,0.3", "--voxel", 0.1, "--formats", "npz")
    assert result.returncode == 0
    assert read_npz(out / "field.npz").channels["sdf"].shape == (3, 3, 5)
    assert not (out / "field.vti").exists()


def test_a_failed_gate_keeps_the_output(tmp_path: Path, splats: Path) -> None:
    result = sdf_bake(splats, "-o", tmp_path / "field", "--voxel", 0.1, "--require", "num_splats>1000000")
    assert result.returncode == 1
    assert "num_splats is 600, required > 1e+06" in result.stderr
    assert (tmp_path / "field" / "field.npz").exists()


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--box=1,2"], 2, "expected six numbers"),
        (["--box=a,b,c,d,e,f"], 2, "expected six numbers"),
        (["--formats", "obj"], 2, "--formats obj: expected some of: npz, vti"),
        (["--include", "cat"], 2, "--include cat: expected some of: robot, human"),
        (["--voxel", "0.0001"], 2, "is free; give a larger --voxel"),
        (["--voxel", "nan"], 2, "voxel: expected a size above 0"),
        (["--length-scale", "-1"], 2, "length_scale: expected a length above 0"),
        (["--at", "3"], 2, "is one splat set"),
        (["--truth", "truth.json"], 2, "expected both or neither"),
        (["--set", "field.kernel=se"], 2, "field.kernel: expected matern, got se"),
    ],
)
def test_bad_arguments_are_one_line_and_leave_nothing(
    tmp_path: Path, splats: Path, arguments: list[str], code: int, message: str
) -> None:
    result = sdf_bake(splats, "-o", tmp_path / "field", *arguments)
    assert (result.returncode, result.stdout) == (code, "")
    assert message in result.stderr
    assert result.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_missing_scene_is_named(tmp_path: Path) -> None:
    result = sdf_bake(tmp_path / "none", "-o", tmp_path / "field")
    assert result.returncode == 4
    assert "none: no such file or folder; give what reconstruct wrote" in result.stderr
