"""An export as a function, and what the command prints of it."""

import json
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.errors import UsageError, WriteError
from splatctrl_cli.evaluate.verdict import Result
from splatctrl_cli.formats.splat.gaussian_ply import Differences, write_gaussian_ply
from splatctrl_cli.formats.splat.splats import FORMATS, as_gaussians, read_ply, write_ply
from splatctrl_cli.jobs.export import export as job
from splatctrl_cli.jobs.export.export import ExportRequest
from splatctrl_cli.records import Float64, Intrinsics, Label, SplatSet
from splatctrl_cli.scene.render import Rendering
from tests.jobs.export.test_export_run import ball, written
from tests.refused import expect_refusal


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return written(tmp_path / "scene", ball())


def export(scene: Path, name: str, **options: Any) -> Result:
    return job.export(ExportRequest(scene=scene, out=scene.parent / name, **options))


def test_scene_is_exported_and_renders_the_same(scene: Path) -> None:
    result = export(scene, "out.ply")
    assert export(scene, "again.ply").out.read_bytes() == result.out.read_bytes()
    assert result.metrics["largest_pixel_difference"] <= 3 / 255 and result.metrics["covered_share"] > 0.1
    splats, comments = read_ply(scene.parent / "out.ply")
    assert len(splats) == result.metrics["num_splats"] == 400
    assert comments["scene"] == "ball" and comments["exported_from"].startswith("splats.ply sha256 ")


@pytest.mark.parametrize(("place", "given"), [("elsewhere", "../scene"), ("scene", "."), ("scene/below", "..")])
def test_without_out_the_file_lies_beside_the_scene(
    scene: Path, monkeypatch: pytest.MonkeyPatch, place: str, given: str
) -> None:
    (scene.parent / place).mkdir(parents=True, exist_ok=True)
    monkeypatch.chdir(scene.parent / place)
    job.export(ExportRequest(scene=Path(given)))
    assert len(read_ply(scene.parent / "scene.ply")[0]) == 400


@pytest.mark.parametrize("value", [-1e37, -1e6, 2e4, 1e37])
@pytest.mark.parametrize("is_round", [True, False])
def test_a_colour_that_no_picture_has_is_the_fault_of_the_input(scene: Path, value: float, is_round: bool) -> None:
    splats, gaussians = ball(20), as_gaussians(ball(20))
    splats.colors[3, 1] = gaussians.harmonics[3, 0, 1] = value
    gaussians.scales[:, 0] *= 2
    if is_round:
        write_ply(scene / "splats.ply", splats, {})
    else:
        write_gaussian_ply(scene / "splats.ply", gaussians, {})
    expect_refusal("splat 3: colour: expected at most 10000", export, scene, "out.ply", isotropic=True)
    assert not (scene.parent / "out.ply").exists()


def test_a_file_that_renders_differently_is_not_left_behind(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def write_darker(path: Path, splats: SplatSet, comments: dict[str, str]) -> None:
        write_ply(path, replace(splats, colors=splats.colors * np.float32(0.999)), comments)

    monkeypatch.setattr(job, "write_ply", write_darker)
    expect_refusal(r"out.ply: differs from its source: color 0.000", export, scene, "out.ply", error=WriteError)
    assert not list(scene.parent.glob("out.ply*"))


def test_an_exact_format_whose_rendering_differs_is_not_left_behind(
    scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    render, calls = job.render_splats, []

    def darker_every_second_time(splats: SplatSet, intrinsics: Intrinsics, T_world_camera: Float64) -> Rendering:
        calls.append(1)
        seen = render(splats, intrinsics, T_world_camera)
        return seen if len(calls) % 2 else replace(seen, color=seen.color * np.float32(0.9995))

    monkeypatch.setattr(job, "render_splats", darker_every_second_time)
    expect_refusal("does not render as its source: PSNR ", export, scene, "out.glb", error=WriteError)
    assert not list(scene.parent.glob("out.*"))


SUFFIXES = [
    pytest.param(
        suffix,
        marks=pytest.mark.skipif(
            suffix.startswith(".usd") and find_spec("pxr") is None, reason="usd-core is not installed: no USD written"
        ),
    )
    for suffix in FORMATS
]
ROUNDED = {".splat", ".spz"}


@pytest.fixture
def gaussians(tmp_path: Path) -> Path:
    """A scene folder of anisotropic Gaussians: a ball of discs that look different from every side."""
    rng, round_ones = np.random.default_rng(1), as_gaussians(replace(ball(), labels=np.zeros(400, np.uint8)))
    harmonics = np.concatenate([round_ones.harmonics, rng.uniform(-0.1, 0.1, (400, 8, 3))], axis=1)
    quats = rng.normal(size=(400, 4))
    discs = replace(
        round_ones,
        scales=round_ones.scales * np.array([1.5, 1.0, 0.3], np.float32),
        quats_wxyz=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        harmonics=harmonics.astype(np.float32),
    )
    (tmp_path / "discs").mkdir()
    write_gaussian_ply(tmp_path / "discs" / "splats.ply", discs, {"method": "3dgs"})
    return tmp_path / "discs"


@pytest.mark.parametrize("suffix", [".spz", ".glb"])
def test_isotropic_splats_go_to_another_format_and_from_there_back_to_ply(scene: Path, suffix: str) -> None:
    there = export(scene, f"there{suffix}")
    assert there.metrics["num_outside"] == 0
    assert not Differences(**there.metrics["differences"]).beyond(Differences(**there.metrics["allowed"]))
    assert there.metrics["psnr"] is None or there.metrics["psnr"] > (35 if suffix in ROUNDED else 100)
    assert there.metrics["not_kept"] == (("labels",) if suffix in ROUNDED else ())
    export(scene.parent / f"there{suffix}", "back.ply")
    back = read_ply(scene.parent / "back.ply")[0]
    np.testing.assert_allclose(back.centers, ball().centers, atol=1.3e-4 if suffix == ".spz" else 0)
    np.testing.assert_allclose(back.radii, ball().radii, rtol=0.033 if suffix == ".spz" else 1e-5)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_anisotropic_gaussians_go_to_every_format(gaussians: Path, suffix: str) -> None:
    result = export(gaussians, f"out{suffix}")
    assert result.metrics["covered_share"] > 0.1
    assert result.metrics["not_kept"] == (("view-dependent colour",) if suffix == ".splat" else ())
    if suffix in ROUNDED:
        assert 25 < result.metrics["psnr"] < 60
    else:
        assert result.metrics["psnr"] is None or result.metrics["psnr"] > 100
        assert result.metrics["largest_pixel_difference"] <= 3 / 255


def test_the_full_layout_has_the_62_properties_and_says_what_it_leaves_out(scene: Path) -> None:
    out = scene.parent / "out.ply"
    write_ply(scene / "splats.ply", replace(ball(), density=np.ones(400, np.float32)), {})
    assert export(scene, "out.ply", layout="full").metrics["not_kept"] == ("labels", "density")
    header = out.read_bytes().split(b"end_header")[0].decode()
    assert header.count("property float") == header.count("property ") == 62
    assert "comment exported_from: splats.ply sha256 " in header and "comment splat: anisotropic" in header


def test_anisotropic_gaussians_are_made_isotropic_on_request_alone(gaussians: Path) -> None:
    out = gaussians.parent / "out.ply"
    expect_refusal("expected isotropic splats", export, gaussians, "out.ply", layout="short", error=UsageError)
    export(gaussians, "out.ply")
    expect_refusal(r"got 400 of 400 whose scales differ; .*--isotropic", read_ply, out)
    result = export(gaussians, "out.ply", isotropic=True, force=True)
    assert any(note.startswith("made isotropic: PSNR") for note in result.notes)
    assert result.metrics["isotropic_psnr"] is not None and 15 < result.metrics["isotropic_psnr"] < 60
    np.testing.assert_allclose(read_ply(out)[0].radii, 0.02 * 0.45 ** (1 / 3), rtol=1e-5)


def run_export(*arguments: object) -> int:
    return main(["export", *map(str, arguments)])


def test_json_has_what_was_written_and_how_it_looks(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = scene.parent / "out.ply"
    assert run_export(scene, "-o", out, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["file"], result["bytes"], result["num_views_compared"]) == (str(out), out.stat().st_size, 4)
    assert result["largest_pixel_difference"] <= 3 / 255


def test_labels_choose_splats(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = scene.parent / "out.ply"
    assert run_export(scene / "splats.ply", "--labels", "object,human", "-o", out) == 0
    assert set(read_ply(out)[0].labels) == {Label.OBJECT, Label.HUMAN}
    assert "267 splats, 133 left out by label" in capsys.readouterr().out


def test_what_a_format_has_no_room_for_is_said(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bright = ball()
    bright.colors[:7] = 1.8
    write_ply(scene / "splats.ply", bright, {})
    assert run_export(scene, "-o", scene.parent / "out.splat") == 0
    said = capsys.readouterr().out
    assert "not kept: labels" in said
    assert "7 splats have a size or colour beyond the format's range: put at its edge" in said
