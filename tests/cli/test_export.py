"""``splatctrl export`` as a process and as a function."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.cli import export, export_check
from splatctrl_cli.cli.main import main
from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.records import Float64, Intrinsics, Label, SplatSet
from splatctrl_cli.scene.render import Rendering
from splatctrl_cli.splat_files.gaussian_ply import write_gaussian_ply
from splatctrl_cli.splat_files.isotropic import as_gaussians
from splatctrl_cli.splat_files.splat_formats import FORMATS
from splatctrl_cli.splat_files.splats import read_ply, write_ply
from tests.cli import here
from tests.splat_files.test_gaussian_ply import gaussian_set


def ball(num: int = 400) -> SplatSet:
    directions = np.random.default_rng(0).normal(size=(num, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return SplatSet(
        centers=(0.3 * directions + [0.5, 0.0, 0.2]).astype(np.float32),
        radii=np.full(num, 0.02, np.float32),
        colors=(0.5 + 0.4 * directions).astype(np.float32),
        opacities=np.linspace(0.2, 1.0, num).astype(np.float32),
        labels=(np.arange(num) % 3).astype(np.uint8),
        density=np.zeros(num, np.float32),
    )


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    folder = tmp_path / "scene"
    folder.mkdir()
    write_ply(folder / "splats.ply", ball(), {"scene": "ball"})
    return folder


def run(*arguments: object) -> int:
    return main(["export", *map(str, arguments)])


def test_a_scene_is_exported_and_renders_the_same(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = scene.parent / "out.ply"
    assert run(scene, "-o", out, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["largest_pixel_difference"] <= 3 / 255
    assert result["covered_share"] > 0.1
    assert result["num_splats"] == 400
    assert result["bytes"] == out.stat().st_size
    splats, comments = read_ply(out)
    assert len(splats) == 400
    assert comments["scene"] == "ball"
    assert comments["exported_from"].startswith("splats.ply sha256 ")


@pytest.mark.parametrize(("place", "given"), [("elsewhere", "../scene"), ("scene", "."), ("scene/below", "..")])
def test_without_out_the_file_lies_beside_the_scene(
    scene: Path, monkeypatch: pytest.MonkeyPatch, place: str, given: str
) -> None:
    (scene.parent / place).mkdir(parents=True, exist_ok=True)
    monkeypatch.chdir(scene.parent / place)
    assert run(given) == 0
    assert len(read_ply(scene.parent / "scene.ply")[0]) == 400


def test_without_out_a_splat_file_is_not_written_over_itself(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(scene / "splats.ply") == 2
    assert "is the input itself; give another --out" in capsys.readouterr().err


def test_labels_choose_splats(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = scene.parent / "out.ply"
    assert run(scene / "splats.ply", "--labels", "object,human", "-o", out) == 0
    assert set(read_ply(out)[0].labels) == {Label.OBJECT, Label.HUMAN}
    assert "267 splats, 133 left out by label" in capsys.readouterr().out


@pytest.mark.parametrize("value", [-1e37, -1e6, 2e4, 1e37])
@pytest.mark.parametrize("is_round", [True, False])
def test_a_colour_that_no_picture_has_is_the_fault_of_the_input(
    scene: Path, capsys: pytest.CaptureFixture[str], value: float, is_round: bool
) -> None:
    file, splats = scene / "splats.ply", ball(20)
    splats.colors[3, 1] = value
    if is_round:
        write_ply(file, splats, {})
    else:
        gaussians = as_gaussians(ball(20))
        gaussians.scales[:, 0] *= 2
        gaussians.harmonics[3, 0, 1] = value
        write_gaussian_ply(file, gaussians, {})
    assert run(scene, "-o", scene.parent / "out.ply", "--isotropic") == 4
    assert "splat 3: colour: expected at most 10000" in capsys.readouterr().err
    assert not (scene.parent / "out.ply").exists()


def test_the_same_scene_gives_the_same_bytes(scene: Path) -> None:
    for name in ("a.ply", "b.ply"):
        assert run(scene, "-o", scene.parent / name) == 0
    assert (scene.parent / "a.ply").read_bytes() == (scene.parent / "b.ply").read_bytes()


def test_a_file_that_renders_differently_is_not_left_behind(
    scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def write_darker(path: Path, splats: SplatSet, comments: dict[str, str]) -> None:
        write_ply(path, replace(splats, colors=splats.colors * np.float32(0.999)), comments)

    monkeypatch.setattr(export, "write_ply", write_darker)
    assert run(scene, "-o", scene.parent / "out.ply") == 6
    assert "out.ply: is not its source: color 0.000" in capsys.readouterr().err
    assert not list(scene.parent.glob("out.ply*"))


def test_an_exact_format_whose_rendering_differs_is_not_left_behind(
    scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    render, calls = export_check._render, []

    def darker_every_second_time(splats: SplatSet, intrinsics: Intrinsics, T_world_camera: Float64) -> Rendering:
        calls.append(1)
        seen = render(splats, intrinsics, T_world_camera)
        return seen if len(calls) % 2 else replace(seen, color=seen.color * np.float32(0.9995))

    monkeypatch.setattr(export_check, "_render", darker_every_second_time)
    assert run(scene, "-o", scene.parent / "out.glb") == 6
    assert "does not render as its source: PSNR " in capsys.readouterr().err
    assert not list(scene.parent.glob("out.*"))


@pytest.fixture(params=FORMATS)
def suffix(request: pytest.FixtureRequest) -> str:
    """The suffix of each format whose library is installed."""
    found: str = request.param
    try:
        FORMATS[found].check()
    except UsageError as error:
        pytest.skip(str(error))
    return found


@pytest.fixture
def gaussians(tmp_path: Path) -> Path:
    """A scene folder of anisotropic Gaussians: a ball of discs that look different from every side."""
    folder, splats, rng = tmp_path / "discs", ball(), np.random.default_rng(1)
    folder.mkdir()
    flat = as_gaussians(replace(splats, labels=np.zeros(len(splats), np.uint8)))
    harmonics = np.concatenate([flat.harmonics, rng.uniform(-0.1, 0.1, (len(splats), 8, 3))], axis=1)
    quats = rng.normal(size=(len(splats), 4))
    discs = replace(
        flat,
        scales=flat.scales * np.array([1.5, 1.0, 0.3], np.float32),
        quats_wxyz=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        harmonics=harmonics.astype(np.float32),
    )
    write_gaussian_ply(folder / "splats.ply", discs, {"method": "3dgs"})
    return folder


def exported(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    assert run(*arguments, "--json") == 0
    result: dict[str, Any] = json.loads(capsys.readouterr().out)
    return result


def test_isotropic_splats_go_to_every_format_and_from_there_back_to_ply(
    scene: Path, suffix: str, capsys: pytest.CaptureFixture[str]
) -> None:
    kind, source = FORMATS[suffix], as_gaussians(ball())
    bound = kind.bound(source)
    there = exported(capsys, scene, "-o", scene.parent / f"there{suffix}")
    assert there["num_outside"] == 0
    assert all(there["differences"][name] <= there["allowed"][name] for name in there["allowed"])
    assert there["psnr"] is None or there["psnr"] > (35 if kind.is_rounded else 100)
    assert there["not_kept"] == ([] if kind.held(source).labels.any() else ["labels"])
    exported(capsys, scene.parent / f"there{suffix}", "-o", scene.parent / "back.ply")
    back = read_ply(scene.parent / "back.ply")[0]
    np.testing.assert_allclose(back.centers, ball().centers, atol=bound.center)
    np.testing.assert_allclose(back.radii, ball().radii, rtol=bound.sigma + 1e-5)


def test_anisotropic_gaussians_go_to_every_format(
    gaussians: Path, suffix: str, capsys: pytest.CaptureFixture[str]
) -> None:
    kind = FORMATS[suffix]
    result = exported(capsys, gaussians, "-o", gaussians.parent / f"out{suffix}")
    assert result["covered_share"] > 0.1
    assert result["not_kept"] == ([] if kind.held(gaussian_set()).harmonics[:, 1:].any() else ["colour by side"])
    if kind.is_rounded:
        assert 25 < result["psnr"] < 60
    else:
        assert result["psnr"] is None or result["psnr"] > 100
        assert result["largest_pixel_difference"] <= 3 / 255


def test_the_full_layout_has_the_62_properties_and_says_what_it_leaves_out(
    scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = scene.parent / "out.ply"
    write_ply(scene / "splats.ply", replace(ball(), density=np.ones(400, np.float32)), {})
    assert run(scene, "-o", out, "--layout", "full") == 0
    assert "not kept: labels, density" in capsys.readouterr().out
    header = out.read_bytes().split(b"end_header")[0].decode()
    assert header.count("property float") == header.count("property ") == 62
    assert "comment exported_from: splats.ply sha256 " in header
    assert "comment splat: anisotropic" in header, "the comments on the source's layout are left out"


def test_what_a_format_has_no_room_for_is_counted(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bright = ball()
    bright.colors[:7] = 1.8
    write_ply(scene / "splats.ply", bright, {})
    assert run(scene, "-o", scene.parent / "out.splat") == 0
    assert "7 splats have a size or colour beyond the format's range: put at its edge" in capsys.readouterr().out


def test_anisotropic_gaussians_are_made_isotropic_on_request_alone(
    gaussians: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = gaussians.parent / "out.ply"
    assert run(gaussians, "-o", out, "--layout", "short") == 2
    assert "expected isotropic splats" in capsys.readouterr().err
    assert run(gaussians, "-o", out) == 0
    with pytest.raises(InputError, match=r"got 400 of 400 whose scales differ; .*--isotropic"):
        read_ply(out)
    capsys.readouterr()
    result = exported(capsys, gaussians, "-o", out, "--isotropic", "--force")
    assert 15 < result["isotropic_psnr"] < 60
    np.testing.assert_allclose(read_ply(out)[0].radii, 0.02 * 0.45 ** (1 / 3), rtol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["none"], 4, "none: no such scene"),
        (["empty"], 4, "empty: has no splats.ply"),
        (["scene", "--labels", "cat"], 2, "unknown label 'cat'; known here: object, robot, human"),
        (["scene", "-o", "scene/splats.ply", "--force"], 2, "is the input itself"),
        (["scene", "-o", "out.stl"], 2, "out.stl: expected a suffix of .ply, .splat, .spz, .glb, .usda, .usdc"),
        (["scene", "-o", "out.spz", "--layout", "full"], 2, "--layout full: out.spz is no PLY"),
        (["notes.txt"], 4, "notes.txt: expected a suffix of .ply, .splat, .spz"),
        (["scene", "-o", "taken.ply"], 2, "taken.ply: already exists; give --force"),
        (["cut.ply"], 4, "cut.ply: cut short: expected"),
        (["robot.ply", "--labels", "human"], 5, "no splat to write among 3"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    scene: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], code: int, message: str
) -> None:
    folder = scene.parent
    monkeypatch.chdir(folder)
    (folder / "empty").mkdir()
    (folder / "taken.ply").write_text("taken")
    (folder / "notes.txt").write_text("notes")
    (folder / "cut.ply").write_bytes((scene / "splats.ply").read_bytes()[:-5])
    robot = ball(3)
    write_ply(folder / "robot.ply", replace(robot, labels=np.full(3, Label.ROBOT, np.uint8)), {})
    if "-o" not in arguments:
        arguments = [*arguments, "-o", "out.ply"]
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    done = here.splatctrl("export", *arguments)
    assert done.returncode == code
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert done.stdout == ""
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
