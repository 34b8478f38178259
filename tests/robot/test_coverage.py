"""Coverage by spheres: proven bounds hold against dense samples, against adversarial points and against formulas."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from splatctrl_cli.config.fixed import DEFICIT_GAP
from splatctrl_cli.geometry import look_at, transform_points
from splatctrl_cli.records import SphereSet
from splatctrl_cli.robot.coverage import largest_deficit, uncovered_area
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.sphere_files import read_spheres
from splatctrl_cli.robot.urdf import read_urdf
from tests.refused import expect_refusal
from tests.robot.shapes import BALL, BOX, arm_of, coverage_deficit, written

CUBE = trimesh.creation.box(extents=(0.2, 0.2, 0.2)).triangles


def phi(points: np.ndarray, centers: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Reference: signed distance to the union of balls, one point and one ball at a time."""
    return np.array([min(np.linalg.norm(p - c) - r for c, r in zip(centers, radii, strict=True)) for p in points])


def samples(triangles: np.ndarray, count: int, seed: int) -> np.ndarray:
    mesh = trimesh.Trimesh(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3), process=False)
    return np.asarray(trimesh.sample.sample_surface(mesh, count, seed=seed)[0])


def test_one_ball_in_a_cube_leaves_corners_by_a_known_distance_and_six_squares_less_discs() -> None:
    found = largest_deficit(CUBE, np.zeros((1, 3)), np.array([0.12]))
    expected = np.sqrt(3) * 0.1 - 0.12
    assert found.lower == pytest.approx(expected, abs=1e-12) and expected <= found.proven <= expected + 1e-5
    np.testing.assert_allclose(np.abs(found.place), 0.1)
    area = 6 * (0.04 - np.pi * (0.12**2 - 0.1**2))
    best, lower, upper = uncovered_area(CUBE, np.zeros((1, 3)), np.array([0.12]))
    assert lower <= area <= upper < lower + 0.03 * 0.24 and best == pytest.approx(area, rel=2e-3)


@pytest.mark.parametrize("seed", range(4))
def test_no_dense_sample_and_no_climb_from_it_beats_the_proven_deficit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    centers, radii = rng.uniform(-0.1, 0.1, (6, 3)), rng.uniform(0.03, 0.11, 6)
    found = largest_deficit(CUBE, centers, radii)
    points = samples(CUBE, 3000, seed)
    value = phi(points, centers, radii)
    assert value.max() <= found.proven and found.proven - found.lower <= 1e-5 + 1e-12
    assert phi(found.place[None], centers, radii)[0] == pytest.approx(found.lower, abs=1e-12)
    best = points[np.argsort(value)[-5:]]  # adversary: walk on the cube's faces from the best samples
    for step in (1e-2, 3e-3, 1e-3, 3e-4, 1e-4):
        tried = best[:, None] + step * rng.normal(size=(5, 60, 3))
        fixed = np.abs(np.abs(best) - 0.1) < 1e-12
        tried = np.clip(np.where(fixed[:, None], best[:, None], tried), -0.1, 0.1)
        climbed = phi(tried.reshape(-1, 3), centers, radii).reshape(5, 60)
        best = np.where(
            (climbed.max(axis=1) > phi(best, centers, radii))[:, None],
            tried[np.arange(5), climbed.argmax(axis=1)],
            best,
        )
        assert phi(best, centers, radii).max() <= found.proven
    assert phi(best, centers, radii).max() >= found.lower - 0.02


@pytest.mark.parametrize("seed", range(3))
def test_bounds_on_the_uncovered_area_hold_a_dense_sample(seed: int) -> None:
    rng = np.random.default_rng(10 + seed)
    centers, radii = rng.uniform(-0.1, 0.1, (5, 3)), rng.uniform(0.05, 0.12, 5)
    best, lower, upper = uncovered_area(CUBE, centers, radii)
    share = np.mean(phi(samples(CUBE, 8000, seed), centers, radii) > 0)
    assert lower - 0.006 <= share * 0.24 <= upper + 0.006 and best == pytest.approx(share * 0.24, abs=0.006)


def test_a_hole_between_two_spheres_that_no_corner_sees_is_found() -> None:
    centers = np.array([[-0.06, 0, 0], [0.06, 0, 0]])
    sheet = np.array([[[-0.1, -0.02, 0], [0.1, -0.02, 0], [0, 0.03, 0]]])
    assert largest_deficit(sheet, centers, np.array([0.0599, 0.0599])).lower > 0
    assert max(phi(sheet[0], centers, np.array([0.0599, 0.0599]))[:2]) < 0


def test_coverage_moves_rigidly_and_scales() -> None:
    rng = np.random.default_rng(5)
    centers, radii = rng.uniform(-0.1, 0.1, (6, 3)), rng.uniform(0.03, 0.09, 6)
    T = look_at([0.3, 1.0, -2.0], [0, 0, 0.5])
    here = largest_deficit(CUBE, centers, radii)
    assert largest_deficit(transform_points(T, CUBE), transform_points(T, centers), radii).proven == pytest.approx(
        here.proven, abs=2e-4
    )
    order = rng.permutation(6)
    assert largest_deficit(CUBE, centers[order], radii[order]).proven == here.proven
    assert largest_deficit(2 * CUBE, 2 * centers, 2 * radii, tolerance=2 * DEFICIT_GAP).proven == pytest.approx(
        2 * here.proven, rel=1e-12
    )


def spheres(*rows: tuple[str, list[float], float]) -> SphereSet:
    return SphereSet(
        links=tuple(row[0] for row in rows),
        centers=np.array([row[1] for row in rows], dtype=np.float64),
        radii=np.array([row[2] for row in rows], dtype=np.float64),
    )


def test_a_report_says_deficit_share_and_protrusion_of_each_link(tmp_path: Path) -> None:
    urdf = read_urdf(written(tmp_path, arm_of(BOX, BALL)))
    half = np.array([0.15, 0.1, 0.05])
    report = coverage_deficit(urdf, spheres(("base", [0, 0, 0], 0.15), ("tip", [0.01, 0, 0], 0.1)))
    base, tip = report.links
    assert base.deficit.proven == pytest.approx(np.linalg.norm(half) - 0.15, abs=1e-4)
    assert base.protrusion == pytest.approx(0.1) and 0 < base.uncovered_share < 1
    assert (tip.is_covered, tip.uncovered_share, tip.protrusion) == (True, 0.0, pytest.approx(0.1 + 0.01 - 0.08))
    assert report.worst is base
    assert (report.max_protrusion, report.num_spheres, report.stray_spheres) == (base.protrusion, 2, 0)


def test_a_ball_in_its_own_sphere_is_covered_exactly_and_a_link_without_one_has_no_bound(tmp_path: Path) -> None:
    urdf = read_urdf(written(tmp_path, arm_of(BALL, BALL)))
    exact = coverage_deficit(urdf, spheres(("base", [0, 0, 0], 0.08), ("tip", [0, 0, 0], 0.08 - 1e-6)))
    assert ([link.is_covered for link in exact.links], exact.max_deficit) == ([True, False], pytest.approx(1e-6))
    report = coverage_deficit(urdf, spheres(("base", [0, 0, 0], 0.08)))
    assert report.bare_links == ("tip",) and (report.worst, report.max_deficit) == (None, None)
    assert report.uncovered_share == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("name", "share", "deficit"),
    [
        ("robot_spheres/curobo/curobo/content/configs/robot/franka.yml", 0.736, 0.1002),
        ("robot_spheres/robometrics/robometrics/content/robot/franka_spheres.yml", 0.501, 0.0695),
        ("vamp_panda/resources/panda/panda_spherized.urdf", 0.482, 0.0825),
    ],
)
def test_public_panda_sets_leave_much_of_the_collision_hulls_uncovered(
    real_data: Path, name: str, share: float, deficit: float
) -> None:
    report = coverage_deficit(
        read_urdf(real_data / "vamp_panda/resources/panda/panda.urdf"),
        read_spheres(real_data / name),
        resolution=5e-3,
    )
    assert report.uncovered_share == pytest.approx(share, abs=0.005)
    assert report.max_deficit == pytest.approx(deficit, abs=2e-4) and report.open_links == ("panda_link6",)


def test_spheres_of_a_rigid_body_cover_all_of_it_and_its_worst_link_counts_for_them_all(tmp_path: Path) -> None:
    pad = '<link name="pad"><collision><geometry><sphere radius="0.05"/></geometry></collision></link>'
    glue = '<joint name="glue" type="fixed"><parent link="tip"/><child link="pad"/><origin xyz="0 0 0.02"/></joint>'
    path = written(tmp_path, arm_of(BALL, BALL).replace("</robot>", f"{pad}{glue}</robot>"))
    report = coverage_deficit(read_urdf(path), spheres(("base", [0, 0, 0], 0.1), ("tip", [0, 0, 0.02], 0.101)))
    assert report.bare_links == () and all(link.is_covered for link in report.links)
    assert [link.num_spheres for link in report.links] == [1, 1, 0]
    three = spheres(("base", [0, 0, 0], 0.08), ("tip", [0, 0, 0], 0.07), ("pad", [0, 0, 0], 0.05))
    model = RobotModel.from_urdf(path, three)
    assert np.isnan(model.sphere_deficit).all() and "not read" in model.coverage_unknown
    np.testing.assert_allclose(
        model.replace_coverage(coverage_deficit(model.urdf, three)).sphere_deficit, [0.0, 0.01, 0.01], atol=1e-9
    )
    assert np.isnan(model.sphere_deficit).all()
    expect_refusal(
        r"sphere set: link 'wing' is not in .*; links there: base, tip",
        coverage_deficit,
        model.urdf,
        spheres(("wing", [0, 0, 0], 0.1)),
    )
