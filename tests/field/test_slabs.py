import tracemalloc

import numpy as np
import pytest

from splatctrl_cli.config import FieldConfig, OccupancyConfig
from splatctrl_cli.errors import NotEvaluableError, UsageError
from splatctrl_cli.field import grid_cells as layout_module
from splatctrl_cli.field import slabs as slabs_module
from splatctrl_cli.field.baker import CHANNELS, Baker
from splatctrl_cli.field.grid_cells import GridLayout
from splatctrl_cli.field.report import grid_statistics
from splatctrl_cli.field.slabs import UnknownSpace, baked_planes, bytes_per_cell, check_slab_memory, slabs
from splatctrl_cli.field.unknown import apply_unknown
from splatctrl_cli.records import DistanceGrid
from splatctrl_cli.voxels import OccupancyGrid
from tests.field.scenes import cloud, splat_set
from tests.plain import plain_grid

LAYOUT = GridLayout(origin=np.array([-0.5, -0.5, -0.2]), voxel=0.02, shape=(51, 40, 21))


def test_bytes_of_a_cell_are_those_of_its_channels() -> None:
    assert bytes_per_cell(["sdf", "gradient", "observed"]) == 17
    assert bytes_per_cell(CHANNELS) == sum(
        np.dtype(dtype).itemsize * components for dtype, components in CHANNELS.values()
    )


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
    with pytest.raises(UsageError, match=r"slab of 8 x 40 x 21 cells: needs .* larger --voxel"):
        check_slab_memory(LAYOUT, ["sdf"])
    monkeypatch.setattr(layout_module, "available_memory", lambda: 8 * 40 * 21 * 68)
    check_slab_memory(LAYOUT, ["sdf"])


def test_memory_is_that_of_a_slab_however_long_the_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slabs_module, "SLAB_BYTES", 1)
    splats, peaks = splat_set(*cloud(50)), []
    for length in (32, 320):
        layout = GridLayout(origin=LAYOUT.origin, voxel=0.02, shape=(length, 40, 40))
        baker = Baker(splats, layout, FieldConfig())
        tracemalloc.start()
        for first, last in slabs(layout, baker.channels):
            baked_planes(baker, first, last)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    cells = 8 * 40 * 40
    assert max(peaks) < cells * (bytes_per_cell(baker.channels) + 64) * 1.5
    assert peaks[1] < 1.1 * peaks[0] + 10_000


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
    assert (found.num_cells, found.num_blank, found.num_inside) == (12, 4, 1)
    assert (found.lowest, found.highest) == (pytest.approx(-0.1), 0.5)
    assert found.observed == {"never_seen": 8, "free": 4, "occupied": 0, "uncertain": 0, "swept_by_robot": 0}
    assert found.never_seen_share == pytest.approx(2 / 3)
    assert found.hard_share == pytest.approx(1 / 12)
    assert found.excess["se"].count == 1
    assert found.excess["se"].largest == pytest.approx(0.25)
    assert found.gradient is not None
    histogram = {index: count for index, count in enumerate(found.gradient.histogram) if count}
    assert histogram == {10: 1, 20: 6, 40: 1}, "lengths 0.49, 1, and 7 in the last"
    assert found.gradient.largest == 7.0
    assert found.gradient.mean == pytest.approx((0.49 + 6 + 7) / 8)
    assert found.gradient.share_near_one == pytest.approx(6 / 8)


def test_statistics_of_a_grid_without_a_channel_are_none() -> None:
    blank = np.full((2, 2, 2), np.nan, np.float32)
    found = grid_statistics(DistanceGrid(origin=np.zeros(3), voxel=0.1, channels={"sdf": blank}, header={}))
    assert (found.num_blank, found.lowest, found.observed, found.hard_share, found.gradient) == (8, *[None] * 4)


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
    grid = DistanceGrid(origin=LAYOUT.origin, voxel=LAYOUT.voxel, channels=dict(whole), header=dict(header))
    wanted = apply_unknown(grid, policy)
    unknown = UnknownSpace(LAYOUT, config, half_seen(), OccupancyConfig())
    for first, last in slabs(LAYOUT, channels):
        planes = unknown.apply(baked_planes(baker, first, last), first, last, baker.bound_margin)
        for name, values in planes.items():
            assert values.tobytes() == wanted.channels[name][first:last].tobytes(), name
    assert {**header, **unknown.header()} == wanted.header


def test_unknown_space_needs_somebody_who_looked_and_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    config = FieldConfig(unknown="obstacle")
    with pytest.raises(NotEvaluableError, match="expected a cell that a camera saw, got none of 42840"):
        UnknownSpace(LAYOUT, config, None, OccupancyConfig())
    monkeypatch.setattr(layout_module, "available_memory", lambda: 10**6)
    with pytest.raises(UsageError, match=r"obstacle: needs 0.0 GiB of memory, .* --unknown nan"):
        UnknownSpace(LAYOUT, config, half_seen(), OccupancyConfig())
