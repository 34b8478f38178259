"""A baked grid: against brute force, in slabs of any size, what memory it takes, and what its statistics count."""

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.config import FieldConfig, OccupancyConfig
from splatctrl_cli.errors import NotEvaluableError, UsageError
from splatctrl_cli.field import grid_cells as layout_module
from splatctrl_cli.field import slabs as slabs_module
from splatctrl_cli.field.baker import Baker
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import GpdfField, SeField, SphereField
from splatctrl_cli.field.grid_cells import GridLayout, bounding_box
from splatctrl_cli.field.slabs import (
    UnknownSpace,
    bake,
    bake_planes,
    bytes_per_cell,
    check_slab_memory,
    grid_statistics,
    slabs,
)
from splatctrl_cli.formats.grid.npz_grid import write_npz
from splatctrl_cli.records import Box, DistanceGrid, Float64, Label
from splatctrl_cli.voxels import SWEPT, OccupancyGrid
from tests.field.scenes import cloud, splat_set
from tests.plain import plain_grid
from tests.reference import field as reference
from tests.reference.unknown import apply_unknown
from tests.refused import expect_refusal

BOX = Box(lower=np.array([-0.41, -0.37, -0.2]), upper=np.array([0.35, 0.4, 0.33]))
CONFIG = FieldConfig(voxel=0.03)


def cell_centers(grid: DistanceGrid) -> Float64:
    shape = grid.channels["sdf"].shape
    return grid.origin + grid.voxel * np.stack(np.unravel_index(np.arange(np.prod(shape)), shape), axis=1)


@pytest.mark.parametrize("length", [1e-9, 0.001, 0.02, 0.3])
def test_culled_bake_equals_brute_force(length: float) -> None:
    centers, radii = cloud()
    grid = bake(
        splat_set(centers, radii),
        BOX,
        replace(CONFIG, length_scale=length),
        channels=("sdf", "hard", "se", "gpdf", "bound"),
    )
    np.testing.assert_array_equal(grid.channels["sdf"], np.minimum(grid.channels["hard"], grid.channels["se"]))
    points = cell_centers(grid)[::3]
    found = {name: values.ravel()[::3] for name, values in grid.channels.items()}
    hard = reference.hard(points, centers, radii)
    np.testing.assert_allclose(found["hard"], hard, atol=2e-7)
    error = found["gpdf"] - reference.gpdf(points, centers, radii, length, CONFIG.noise)
    assert np.abs(error).max() < CONFIG.truncation + 4e-7 + 2e-6 * length
    if length > 1e-6:  # below, which of two centres is nearer is beyond float32
        smooth, _ = reference.se(points, centers, radii, length, CONFIG.noise)
        error = found["se"] - np.where(np.isnan(smooth), hard, smooth)
        rounding = 2e-6 + 2e-8 / length + 6e-5 * length  # of exponents where l is small, of a small root where large
        assert -rounding < error.min() and error.max() < CONFIG.truncation + rounding
    half_diagonal = 0.5 * np.sqrt(3) * grid.voxel
    assert grid.header["bound_margin"] == pytest.approx(half_diagonal, abs=1e-5)
    assert (found["bound"] <= hard - half_diagonal).all() and (found["bound"] > hard - half_diagonal - 5e-6).all()


@pytest.mark.parametrize(("length", "voxel"), [(0.02, 0.01), (0.01, 0.02), (0.1, 0.005)])
def test_merged_spheres_and_parabolas_keep_to_the_truncation(length: float, voxel: float) -> None:
    centers, radii = cloud(3000)
    box = Box(
        lower=np.array([-0.1, -0.1, 0.1]), upper=np.array([0.06, 0.06, 1.1])
    )  # from near to far, above the sheet
    config = replace(CONFIG, voxel=voxel, length_scale=length, distance="gpdf")
    grid = bake(splat_set(centers, radii), box, config, channels=("sdf", "gradient"))
    cells = np.random.default_rng(0).integers(0, grid.channels["sdf"].shape, (3000, 3))
    exact, gradient = GpdfField(Spheres.of(centers, radii), FieldConfig(length_scale=length, truncation=1e-8)).query(
        grid.origin + voxel * cells
    )
    error = grid.channels["sdf"][tuple(cells.T)] - exact
    assert np.abs(error).max() < config.truncation
    assert np.abs(error).max() > 1e-6  # they are taken: float32 alone does better
    np.testing.assert_allclose(grid.channels["gradient"][tuple(cells.T)], gradient, atol=2e-3)


@pytest.mark.parametrize(("distance", "kind"), [("safe", SeField), ("safe_gpdf", GpdfField)])
def test_baked_gradient_is_that_of_the_smaller_distance(distance: str, kind: type[SeField] | type[GpdfField]) -> None:
    centers, radii = cloud()
    config = replace(CONFIG, distance=distance)
    kernel = {"safe": "se", "safe_gpdf": "gpdf"}[distance]
    grid = bake(splat_set(centers, radii), BOX, config, channels=("sdf", "gradient", "hard", kernel))
    points, gradient = cell_centers(grid), grid.channels["gradient"].reshape(-1, 3)
    is_exact = (grid.channels["hard"] <= grid.channels[kernel]).ravel()
    exact, smooth = (
        SphereField(Spheres.of(centers, radii)),
        kind(Spheres.of(centers, radii), FieldConfig(length_scale=CONFIG.length_scale, truncation=1e-6)),
    )
    assert is_exact.any() and (~is_exact).any()
    np.testing.assert_allclose(gradient[~is_exact], smooth.query(points[~is_exact])[1], atol=2e-3)
    np.testing.assert_allclose(gradient[is_exact], exact.query(points[is_exact])[1], atol=1e-4)


def test_how_the_planes_are_cut_does_not_change_a_bit() -> None:
    splats = splat_set(*cloud())
    whole = bake(splats, BOX, CONFIG).channels
    layout = GridLayout.over(BOX, CONFIG.voxel)
    baker = Baker(splats, layout, CONFIG)
    for first, last in ((0, 8), (8, 24), (24, layout.shape[0])):
        for name, values in bake_planes(baker, first, last).items():
            np.testing.assert_array_equal(values, whole[name][first:last], err_msg=name)


def test_threads_and_repeats_do_not_change_a_bit(tmp_path: Path) -> None:
    splats = splat_set(*cloud())
    for threads in (1, 2, 3):
        write_npz(tmp_path / f"{threads}.npz", bake(splats, BOX, CONFIG, threads=threads))
    assert len({path.read_bytes() for path in tmp_path.iterdir()}) == 1


def test_grid_covers_its_box_with_cell_centres_and_says_what_its_numbers_mean() -> None:
    assert GridLayout.over(Box(lower=np.zeros(3), upper=np.array([1.0, 0.5, 0.05])), 0.1).shape == (11, 6, 2)
    assert GridLayout.over(Box(lower=np.zeros(3), upper=np.array([0.01, 0.3, 0.31])), 0.1).shape == (2, 4, 5)
    header = bake(splat_set(*cloud()), BOX, CONFIG).header
    wanted = {"sign": "positive outside", "frame": "world", "units": "m", "weights": "rowsum", "distance": "safe"}
    assert header.items() >= wanted.items() and header["truncation_bound"] == CONFIG.truncation


def test_bounding_box_holds_every_sphere() -> None:
    box = bounding_box(splat_set(np.array([[0.0, 0, 0], [1, 1, 1]]), np.array([0.1, 0.2])), padding=0.5)
    np.testing.assert_allclose(box.lower, -0.6, atol=1e-7)
    np.testing.assert_allclose(box.upper, 1.7, atol=1e-7)


def test_robot_splats_are_left_out_unless_asked_for() -> None:
    robot = splat_set(np.array([[0.0, 0, 0]]), np.array([0.01]), Label.ROBOT)
    both = splat_set(np.array([[0.0, 0, 0], [0.3, 0, 0]]), np.full(2, 0.01), Label.ROBOT)
    both.labels[1] = Label.HUMAN
    box = Box(lower=np.full(3, -0.03), upper=np.full(3, 0.03))
    assert bake(both, box, CONFIG, channels=("sdf", "hard")).channels["hard"][1, 1, 1] == pytest.approx(
        0.29, abs=1e-6
    )
    with_robot = bake(both, box, CONFIG, channels=("sdf", "hard", "label"), labels=set(Label))
    assert with_robot.channels["hard"][1, 1, 1] == pytest.approx(-0.01, abs=1e-6)
    assert with_robot.channels["label"][1, 1, 1] == Label.ROBOT
    assert with_robot.header["splats_used"] == {"object": 0, "robot": 1, "human": 1}
    expect_refusal("none of 1 is labelled object, human", bake, robot, box, CONFIG, error=NotEvaluableError)


def test_observed_comes_from_the_occupancy_voxel_of_the_cell() -> None:
    shape = (3, 1, 1)
    occupancy = plain_grid(shape, 0.1, 0.0, log_odds=np.reshape([-2.0, 2.0, 0.0], shape))
    box = Box(lower=np.array([-0.1, 0.0, 0.0]), upper=np.array([0.3, 0.1, 0.1]))
    config = replace(CONFIG, voxel=0.1)
    unseen = replace(occupancy, num_updates=np.zeros(shape, np.uint16))
    swept = replace(unseen, entity=np.array([0, SWEPT, 0], np.uint8).reshape(shape))
    for grid, expected in (
        (occupancy, [0, 1, 2, 3, 0]),
        (unseen, [0] * 5),
        (swept, [0, 0, 4, 0, 0]),
        (None, [0] * 5),
    ):
        observed = bake(splat_set(*cloud(10)), box, config, occupancy=grid).channels["observed"]
        assert observed[:, 0, 0].tolist() == expected and observed.sum() == sum(expected)  # none outside of the grid


def test_free_memory_is_what_the_machine_and_the_container_leave(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(layout_module, "PROC", tmp_path)
    monkeypatch.setattr(layout_module, "CGROUP", tmp_path)
    (tmp_path / "meminfo").write_text("MemTotal: 9 kB\nMemAvailable:    5000 kB\n")
    assert layout_module.available_memory() == 5000 * 1024
    (tmp_path / "memory.max").write_text("3000\n")
    (tmp_path / "memory.current").write_text("1000\n")
    assert layout_module.available_memory() == 2000
    (tmp_path / "memory.max").write_text("max\n")
    assert layout_module.available_memory() == 5000 * 1024
    (tmp_path / "meminfo").write_text("MemTotal: 9 kB\n")
    expect_refusal("no MemAvailable line", layout_module.available_memory, error=UsageError)


@pytest.mark.parametrize(
    ("box", "voxel", "memory", "words"),
    [
        (Box(lower=np.zeros(3), upper=np.array([1.0, 0.0, 1.0])), 0.03, 10**10, "lower < upper"),
        (BOX, 0.03, 10**5, r"27 x 27 x 19 cells: needs 0.0 GiB.*larger --voxel"),
    ],
)
def test_bad_boxes_and_voxels_and_grids_beyond_the_memory_are_refused(
    box: Box, voxel: float, memory: int, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(layout_module, "available_memory", lambda: memory)
    expect_refusal(words, bake, splat_set(*cloud(10)), box, FieldConfig(voxel=voxel), error=UsageError)


def test_cells_are_counted_where_a_kernel_field_alone_over_estimates_or_has_no_value() -> None:
    centers, radii = cloud()
    grid = bake(
        splat_set(centers, radii), BOX, replace(CONFIG, length_scale=0.1), channels=("sdf", "hard", "se", "gpdf")
    )
    points, hard = cell_centers(grid), grid.channels["hard"].ravel()
    counts = {}
    for name, kind in (("se", SeField), ("gpdf", GpdfField)):
        alone = kind(Spheres.of(centers, radii), FieldConfig(length_scale=0.1)).query_raw(points)[0]
        counts[f"{name}_without_value"] = np.isnan(alone).sum()
        counts[f"{name}_over_estimates"] = (alone > hard + 2e-6).sum()
    baked = grid.header["kernel_counts"]
    assert baked.keys() == counts.keys() and baked["se_without_value"] > 100 and baked["gpdf_without_value"] == 0
    for name, count in counts.items():  # a cell on the edge may fall on either side of it
        assert abs(baked[name] - count) <= 3, name


LAYOUT = GridLayout(origin=np.array([-0.5, -0.5, -0.2]), voxel=0.02, shape=(51, 40, 21))


@pytest.mark.parametrize(("size", "step"), [(1, 8), (40 * 21 * 4 * 17, 16), (10**9, 51)])
def test_slabs_are_whole_blocks_that_cover_every_plane(monkeypatch: pytest.MonkeyPatch, size: int, step: int) -> None:
    monkeypatch.setattr(slabs_module, "SLAB_BYTES", size)
    ranges = list(slabs(LAYOUT, ["sdf"]))
    assert ranges[0] == (0, min(step, 51))
    assert [first for first, _ in ranges[1:]] == [last for _, last in ranges[:-1]]
    assert ranges[-1][1] == 51
    assert list(slabs(LAYOUT, ["sdf"], ranges[0][1])) == ranges[1:]


def test_a_slab_beyond_the_memory_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    check_slab_memory(LAYOUT, ["sdf"])
    monkeypatch.setattr(layout_module, "available_memory", lambda: 8 * 40 * 21 * 68 - 1)
    expect_refusal(
        r"slab of 8 x 40 x 21 cells: needs .* larger --voxel", check_slab_memory, LAYOUT, ["sdf"], error=UsageError
    )
    monkeypatch.setattr(layout_module, "available_memory", lambda: 8 * 40 * 21 * 68)
    check_slab_memory(LAYOUT, ["sdf"])


def test_memory_is_that_of_a_slab_however_long_the_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slabs_module, "SLAB_BYTES", 1)
    splats, peaks = splat_set(*cloud(50)), []
    for length in (32, 160):
        layout = GridLayout(origin=LAYOUT.origin, voxel=0.02, shape=(length, 40, 40))
        baker = Baker(splats, layout, FieldConfig())
        tracemalloc.start()
        for first, last in slabs(layout, baker.channels):
            bake_planes(baker, first, last)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    cells = 8 * 40 * 40
    assert max(peaks) < cells * (bytes_per_cell(baker.channels) + 64) * 1.5 and peaks[1] < 1.1 * peaks[0] + 10_000


def test_statistics_count_what_the_grid_holds() -> None:
    shape = (3, 2, 2)
    sdf = np.full(shape, 0.5, np.float32)
    sdf[0], sdf[1, 0, 0] = np.nan, -0.1
    gradient = np.zeros((*shape, 3), np.float32)
    gradient[..., 2] = np.where(np.isnan(sdf), np.nan, 1.0)
    gradient[2, 0, 0] = (0.0, 0.294, 0.392)
    gradient[2, 0, 1] = (0.0, 0.0, 7.0)
    observed = np.zeros(shape, np.uint8)
    observed[1] = 1
    hard = np.where(np.isnan(sdf), 0.2, sdf + np.float32(0.1)).astype(np.float32)
    hard[1, 0, 0] = -0.1
    se = hard.copy()
    se[2, 1, 1] += np.float32(0.25)
    channels = {"sdf": sdf, "gradient": gradient, "observed": observed, "hard": hard, "se": se}
    found = grid_statistics(DistanceGrid(origin=np.zeros(3), voxel=0.1, channels=channels, header={}))
    names = ("num_cells", "num_blank", "num_inside", "lowest", "highest", "never_seen_share", "hard_share")
    assert [found[name] for name in names] == [
        12,
        4,
        1,
        pytest.approx(-0.1),
        0.5,
        pytest.approx(2 / 3),
        pytest.approx(1 / 12),
    ]
    assert found["observed"] == {"never_seen": 8, "free": 4, "occupied": 0, "uncertain": 0, "swept_by_robot": 0}
    assert (found["excess"]["se"]["count"], found["excess"]["se"]["largest"]) == (1, pytest.approx(0.25))
    histogram = {index: count for index, count in enumerate(found["gradient"]["histogram"]) if count}
    assert histogram == {10: 1, 20: 6, 40: 1}, "lengths 0.49, 1, and 7 in the last"
    lengths = [found["gradient"][name] for name in ("largest", "mean", "share_near_one")]
    assert lengths == [7.0, pytest.approx((0.49 + 6 + 7) / 8), pytest.approx(6 / 8)]
    found = grid_statistics(
        DistanceGrid(
            origin=np.zeros(3), voxel=0.1, channels={"sdf": np.full((2, 2, 2), np.nan, np.float32)}, header={}
        )
    )
    assert [found[name] for name in ("num_blank", "lowest", "observed", "hard_share", "gradient")] == [8, *[None] * 4]


def half_seen() -> OccupancyGrid:
    """Voxels of 20 cm that cover the layout, free where x < 0 and never seen beyond."""
    return plain_grid((8, 8, 8), 0.2, -0.7, num_updates=np.repeat([1, 0], 4)[:, None, None])


@pytest.mark.parametrize("policy", ["nan", "obstacle"])
def test_unknown_space_in_slabs_is_that_of_the_whole_grid(policy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slabs_module, "SLAB_BYTES", 1)
    splats, config = splat_set(*cloud(100)), FieldConfig(voxel=LAYOUT.voxel, unknown=policy)
    channels = ("sdf", "gradient", "bound", "observed", "probability")
    baker = Baker(splats, LAYOUT, config, channels=channels, occupancy=half_seen())
    whole = baker.allocate(LAYOUT.shape[0])
    baker.bake(0, LAYOUT.shape[0], whole)
    header = {"bound_margin": baker.bound_margin}
    wanted = apply_unknown(
        DistanceGrid(origin=LAYOUT.origin, voxel=LAYOUT.voxel, channels=dict(whole), header=dict(header)), policy
    )
    unknown = UnknownSpace(LAYOUT, config, half_seen(), OccupancyConfig())
    for first, last in slabs(LAYOUT, channels):
        for name, values in unknown.apply(bake_planes(baker, first, last), first, last, baker.bound_margin).items():
            assert values.tobytes() == wanted.channels[name][first:last].tobytes(), name
    assert {**header, **unknown.header()} == wanted.header


def test_unknown_space_needs_somebody_who_looked_and_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    config = FieldConfig(unknown="obstacle")
    expect_refusal(
        "expected a cell that a camera saw, got none of 42840",
        UnknownSpace,
        LAYOUT,
        config,
        None,
        OccupancyConfig(),
        error=NotEvaluableError,
    )
    monkeypatch.setattr(layout_module, "available_memory", lambda: 10**6)
    expect_refusal(
        r"obstacle: needs 0.0 GiB of memory, .* --unknown nan",
        UnknownSpace,
        LAYOUT,
        config,
        half_seen(),
        OccupancyConfig(),
        error=UsageError,
    )
