"""Splat files of other programs: scored as they are, baked and asked where they are spheres, refused otherwise."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.evaluate.images import psnr
from splatctrl_cli.formats.splat.gaussian_ply import write_gaussian_ply
from splatctrl_cli.formats.splat.splats import FORMATS, as_gaussians
from splatctrl_cli.jobs.bake.request import read_bake_source
from splatctrl_cli.jobs.recordings.open_recording import RecordingRequest
from splatctrl_cli.jobs.score import reference as score_reference
from splatctrl_cli.jobs.score.score import ScoreRequest, ScoreResult, score
from splatctrl_cli.jobs.score.views import CloudSettings
from splatctrl_cli.records import GaussianSet
from splatctrl_cli.scene.gaussians import render_gaussians
from tests.jobs.score.wall import FRAMES, INTRINSICS, SIDE, FakeSource, wall

STRETCHED = np.array([1.0, 0.6, 1.4], np.float32)


@pytest.fixture
def scored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder; every recording is of one view from the side."""
    frames = [frame for frame in FRAMES if frame.camera == "cam3"][:1]
    monkeypatch.setattr(score_reference, "open_source", lambda path, options, **_: FakeSource(frames=frames))
    return tmp_path


def wall_with_harmonics() -> GaussianSet:
    """The wall, its Gaussians stretched and of another colour from each side."""
    round_ones = as_gaussians(wall())
    rng = np.random.default_rng(0)
    shape = (len(round_ones), 3, 3)
    more = rng.uniform(-0.3, 0.3, shape).astype(np.float32)
    return replace(
        round_ones,
        scales=round_ones.scales * STRETCHED,
        harmonics=np.concatenate([round_ones.harmonics, more], axis=1),
    )


def run(file: Path, **changes: object) -> ScoreResult:
    recording = RecordingRequest(path=file.parent / "fake.mcap")
    return score(ScoreRequest(scene=file, recording=recording, **changes))  # type: ignore[arg-type]


def test_stretched_gaussians_with_harmonics_are_scored_as_they_are(scored: Path) -> None:
    gaussians = wall_with_harmonics()
    write_gaussian_ply(scored / "other.ply", gaussians, {})
    result = run(scored / "other.ply", out=scored / "out")
    frame = next(frame for frame in FRAMES if frame.camera == "cam3")
    render = render_gaussians(gaussians, INTRINSICS, SIDE, threads=1).color
    assert result.metrics["psnr_all"] == pytest.approx(psnr(np.clip(render, 0, 1), frame.color / 255.0), abs=0.01)
    assert (scored / "out" / "score.json").is_file()


def test_that_a_view_may_have_trained_is_told_with_a_remedy(scored: Path) -> None:
    write_gaussian_ply(scored / "other.ply", wall_with_harmonics(), {})
    assert "does not say which views trained it" in run(scored / "other.ply").notes[0]
    assert run(scored / "other.ply").metrics["psnr_seen"] is None


@pytest.mark.parametrize("suffix", [".ply", ".splat", ".spz"])
def test_round_splats_of_each_format_are_scored_and_have_distances(scored: Path, suffix: str) -> None:
    file = scored / f"other{suffix}"
    FORMATS[suffix].write(file, as_gaussians(wall()), {})
    assert (run(file).metrics["psnr_all"] or 0) > 35
    found = read_bake_source(file, None).splats
    assert found.centers == pytest.approx(wall().centers, abs=1e-3)
    assert found.radii == pytest.approx(wall().radii, rel=0.04)


@pytest.mark.parametrize("suffix", [".ply", ".spz"])
def test_colour_by_side_costs_no_distance_and_stretch_is_refused(tmp_path: Path, suffix: str) -> None:
    coloured = replace(wall_with_harmonics(), scales=as_gaussians(wall()).scales)
    file = tmp_path / f"other{suffix}"
    FORMATS[suffix].write(file, coloured, {})
    assert len(read_bake_source(file, None).splats) == len(coloured)
    FORMATS[suffix].write(file, wall_with_harmonics(), {})
    with pytest.raises(InputError, match=r"whose scales differ.*'splatctrl export --isotropic' writes the nearest"):
        read_bake_source(file, None)


def test_splats_in_another_unit_are_refused(scored: Path) -> None:
    file = scored / "other.ply"
    write_gaussian_ply(file, wall_with_harmonics(), {"units": "millimetre"})
    with pytest.raises(InputError, match="comment 'units: millimetre': expected m"):
        run(file)


def test_a_surface_cannot_be_looked_at_without_training_views(scored: Path) -> None:
    write_gaussian_ply(scored / "other.ply", wall_with_harmonics(), {})
    with pytest.raises(UsageError, match="--cloud: the surface is looked at from the views that trained, which"):
        run(scored / "other.ply", cloud=CloudSettings(path=scored / "cloud.ply"))
