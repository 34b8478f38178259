"""Fitted spheres: the cover is complete, proven and sampled; more spheres stick out less; the seed decides all."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import trimesh

from splatctrl_cli.config.fixed import DEFAULT_SPHERES
from splatctrl_cli.errors import UsageError
from splatctrl_cli.records import Float64, SphereSet
from splatctrl_cli.robot import sphere_fit
from splatctrl_cli.robot.coverage import coverage_of_solids
from splatctrl_cli.robot.link_meshes import Solid, read_solids
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.sphere_files import read_spheres, spheres_yaml
from splatctrl_cli.robot.sphere_fit import FitOptions, default_spheres, fit_spheres
from splatctrl_cli.robot.urdf import UrdfFile, read_urdf
from tests.refused import expect_refusal
from tests.robot.shapes import BOX, ROD, arm_of, l_shape, written

Solids = Mapping[str, tuple[Solid, ...]]


def rough(**options: float) -> FitOptions:
    """Options with few patches and candidates: as complete a cover, sooner found."""
    return FitOptions(restarts=2, num_patches=400, num_candidates=300, **options)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def urdf(tmp_path_factory: pytest.TempPathFactory) -> UrdfFile:
    folder = tmp_path_factory.mktemp("ell")
    l_shape().export(folder / "ell.stl")
    return read_urdf(written(folder, arm_of('<mesh filename="ell.stl"/>', ROD)))


@pytest.fixture(scope="module")
def solids(urdf: UrdfFile) -> Solids:
    return read_solids(urdf)


@pytest.fixture(scope="module")
def six(solids: Solids) -> SphereSet:
    return fit_spheres(solids, rough(max_spheres=6))


def test_every_point_of_the_surface_and_of_the_true_cylinder_is_in_a_sphere_of_its_link(
    urdf: UrdfFile, solids: Solids, six: SphereSet, tmp_path: Path
) -> None:
    (tmp_path / "s.yaml").write_text(spheres_yaml(six))
    spheres = read_spheres(tmp_path / "s.yaml")
    np.testing.assert_array_equal(spheres.radii, six.radii)
    report = coverage_of_solids(urdf, solids, spheres)
    assert len(spheres.radii) <= 6
    assert all(link.is_covered for link in report.links)
    assert (report.max_deficit, report.uncovered_share) == (0.0, 0.0)

    def outside(points: Float64, link: str) -> float:
        member = np.array([owner == link for owner in spheres.links])
        away = np.linalg.norm(points[:, None] - spheres.centers[member][None], axis=2) - spheres.radii[member]
        return float(away.min(axis=1).max())

    for link, (solid,) in solids.items():
        mesh = trimesh.Trimesh(solid.surface.vertices, solid.surface.faces, process=False)
        dense = np.asarray(trimesh.sample.sample_surface(mesh, 40_000, seed=3)[0])
        edges = solid.surface.corners.reshape(-1, 3)
        for points in (dense, edges, 0.5 * (edges + np.roll(edges, 1, axis=0))):
            assert outside(points, link) <= -solid.slack
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, 2000), np.linspace(-0.2, 0.2, 41))
    true = np.stack([0.05 * np.cos(angle), 0.05 * np.sin(angle), height], axis=-1).reshape(-1, 3)
    assert outside(true, "tip") <= 0


def test_more_spheres_stick_out_less_and_one_each_is_the_least(
    urdf: UrdfFile, solids: Solids, six: SphereSet
) -> None:
    two, sixteen = (fit_spheres(solids, rough(max_spheres=count)) for count in (2, 16))
    protrusions = []
    for count, spheres in ((2, two), (6, six), (16, sixteen)):
        assert len(spheres.radii) <= count and set(spheres.links) == {"base", "tip"}
        protrusions.append(coverage_of_solids(urdf, solids, spheres).max_protrusion)
    assert protrusions[0] > 1.5 * protrusions[1] > 2 * protrusions[2]


def test_one_ball_around_a_box_is_the_smallest_there_is(tmp_path: Path) -> None:
    spheres = fit_spheres(read_solids(read_urdf(written(tmp_path, arm_of(BOX, BOX)))), rough(max_spheres=2))
    smallest = np.linalg.norm([0.15, 0.1, 0.05])
    assert np.all(spheres.radii >= smallest)
    np.testing.assert_allclose(spheres.radii, smallest, atol=5e-3)


def test_a_protrusion_is_kept_by_few_spheres(urdf: UrdfFile, solids: Solids) -> None:
    spheres = fit_spheres(solids, rough(max_protrusion=0.04))
    report = coverage_of_solids(urdf, solids, spheres)
    assert report.max_protrusion <= 0.04 and report.max_deficit == 0
    assert 3 <= len(spheres.radii) <= 30


def test_an_allowed_deficit_is_used_and_not_exceeded(urdf: UrdfFile, solids: Solids, six: SphereSet) -> None:
    loose = coverage_of_solids(urdf, solids, fit_spheres(solids, rough(max_spheres=6, max_deficit=0.01)))
    assert 0.008 < loose.max_deficit <= 0.01
    assert loose.max_protrusion < coverage_of_solids(urdf, solids, six).max_protrusion - 0.008


def test_the_same_seed_gives_the_same_spheres(solids: Solids, six: SphereSet) -> None:
    again = fit_spheres(solids, rough(max_spheres=6))
    np.testing.assert_array_equal(six.centers, again.centers)
    np.testing.assert_array_equal(six.radii, again.radii)


def test_thin_and_open_shapes_are_covered_too(tmp_path: Path) -> None:
    sheet = trimesh.creation.box(extents=(0.2, 0.1, 0.001))
    trimesh.Trimesh(sheet.vertices, sheet.faces[1:], process=False).export(tmp_path / "open.stl")
    trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], [[0, 1, 2]], process=False).export(tmp_path / "flat.stl")
    urdf = read_urdf(written(tmp_path, arm_of('<mesh filename="open.stl"/>', '<mesh filename="flat.stl"/>')))
    solids = read_solids(urdf)
    report = coverage_of_solids(urdf, solids, fit_spheres(solids, rough(max_spheres=8)))
    assert report.max_deficit == 0 and report.open_links == ("base", "tip")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (FitOptions(), "a number of spheres or a protrusion, not both"),
        (FitOptions(max_spheres=5, max_protrusion=0.1), "not both"),
        (FitOptions(max_protrusion=float("nan")), "largest protrusion: expected 0 m or more, got nan"),
        (FitOptions(max_spheres=5, max_deficit=-1.0), "largest deficit: expected 0 m or more, got -1"),
        (rough(max_spheres=1), "1 spheres for 2 links .*; allow at least 2, one for each"),
        (rough(max_protrusion=0.0001), "link 'base': largest protrusion: expected at least .* mm, got 0.1 mm"),
    ],
)
def test_options_that_make_no_sense_are_refused(solids: Solids, options: FitOptions, message: str) -> None:
    expect_refusal(message, fit_spheres, solids, options, error=UsageError)


def test_a_urdf_without_spheres_is_fitted_once_and_again_if_it_or_a_mesh_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fits = list[int | None]()

    def fit(solids: Solids, options: FitOptions) -> SphereSet:
        fits.append(options.max_spheres)
        return fit_spheres(solids, rough(max_spheres=3))

    monkeypatch.setattr(sphere_fit, "fit_spheres", fit)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    l_shape().export(tmp_path / "ell.stl")
    path = written(tmp_path, arm_of('<mesh filename="ell.stl"/>', ROD))
    first, again = (RobotModel.from_urdf(path).sphere_set for _ in range(2))
    assert fits == [DEFAULT_SPHERES] and first.links == again.links
    np.testing.assert_array_equal(first.centers, again.centers)
    (stored,) = (tmp_path / "cache" / "splatctrl").iterdir()
    stored.write_text("broken: [")
    RobotModel.from_urdf(path)
    l_shape().apply_scale(1.1).export(tmp_path / "ell.stl")
    RobotModel.from_urdf(path)
    written(tmp_path, path.read_text().replace("0 0 0.3", "0 0 0.4"))
    RobotModel.from_urdf(path)
    assert len(fits) == 4
    (tmp_path / "file").touch()
    monkeypatch.chdir(tmp_path)
    for folder in (str(tmp_path / "file"), "here"):  # a relative folder would be another one in each run
        monkeypatch.setenv("XDG_CACHE_HOME", folder)
        assert RobotModel.from_urdf(path).sphere_set.radii.all()
    assert not (tmp_path / "here").exists()
    own = arm_of('<sphere radius="0.1"/>', '<sphere radius="0.2"/>')
    assert default_spheres(read_urdf(written(tmp_path, own))).radii.tolist() == [0.1, 0.2]
    assert len(fits) == 6
