"""The kernels of the fields, beside those of the processor and the float64 references of the paper's equations."""

from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import FieldConfig
from splatctrl_cli.field.baker import Baker
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import GpdfField, OnDevice, SeField, SphereField, field_over
from splatctrl_cli.field.grid_cells import RESOLUTION, GridField, GridLayout
from splatctrl_cli.field.slabs import bake_planes
from splatctrl_cli.kernels import field as native
from splatctrl_cli.kernels.cuda.field import Choice, DeviceField
from splatctrl_cli.kernels.cuda.memory import Memory
from splatctrl_cli.kernels.field import GridSpan
from splatctrl_cli.records import Box, DistanceGrid, Float64
from tests.field.scenes import cloud, queries, splat_set
from tests.kernels.cuda.emulator import EmulatedDevice
from tests.reference import field as reference

ALL = ("hard", "gradient", "bound", "entry", "se", "gpdf")
KINDS = {"se": SeField, "gpdf": GpdfField}
EXACT = FieldConfig(truncation=1e-9)  # nothing that counts is left out: what is left is rounding
NUM, MEAN_RADIUS = 600, 0.007


def spheres(num: int = NUM, seed: int = 0) -> Spheres:
    return Spheres.of(*cloud(num, seed))


def device_field(
    memory: Memory,
    of: Spheres,
    config: FieldConfig = EXACT,
    kernels: tuple[str, ...] = ("se", "gpdf"),
    **choice: object,
) -> DeviceField:
    chosen: dict[str, object] = {"kernel": kernels[0] if kernels else None, "resolution": RESOLUTION, **choice}
    terms = {name: KINDS[name](of, config).terms() for name in kernels}
    return DeviceField(memory, of.clusters, SphereField(of).radii, terms, Choice(**chosen))  # type: ignore[arg-type]


def span_of(of: Spheres, box: Box, voxel: float, first: int = 0, last: int | None = None) -> tuple[GridSpan, Float64]:
    """Cells that cover a box, and their centres."""
    shape = tuple(int(n) for n in np.ceil((box.upper - box.lower) / voxel))
    last = shape[0] if last is None else last
    span = GridSpan(
        origin=box.lower - of.anchor, voxel=voxel, shape=(shape[0], shape[1], shape[2]), first=first, last=last
    )
    cells = np.stack(np.meshgrid(np.arange(first, last), *map(np.arange, shape[1:]), indexing="ij"), axis=-1)
    return span, (box.lower + voxel * cells).reshape(-1, 3)


NEAR = Box(lower=np.array([-0.17, -0.2, -0.11]), upper=np.array([0.16, 0.05, 0.13]))
FAR = Box(lower=np.array([0.6, 0.5, 0.7]), upper=np.array([0.9, 0.7, 0.9]))
BOXES = {"among the spheres": (NEAR, 0.03), "far from them": (FAR, 0.04), "coarse": (NEAR, 0.06)}


def by_processor(of: Spheres, config: FieldConfig, span: GridSpan, name: str) -> tuple[np.ndarray, np.ndarray]:
    distance = np.zeros(span.shape_of_channel, np.float32)
    gradient = np.zeros((*distance.shape, 3), np.float32)
    if name == "hard":
        native.bake_hard(of.clusters, SphereField(of).radii, span, distance, gradient)
    else:
        KINDS[name](of, config).bake_raw(span, distance, gradient, threads=1)
    return distance, gradient


def away(gradient: np.ndarray, expected: np.ndarray, where: np.ndarray | None = None) -> float:
    """The largest length of the differences."""
    error = np.linalg.norm(gradient.reshape(-1, 3) - expected.reshape(-1, 3), axis=1)
    return float(error.max() if where is None else error[where].max())


@pytest.mark.parametrize("where", BOXES)
def test_exact_distances_of_a_grid_are_those_of_the_processor(where: str, device: Memory) -> None:
    of = spheres()
    span, points = span_of(of, *BOXES[where])
    baked = device_field(device, of, kernels=()).bake(span, ALL, margin=0.01)
    expected, gradient = by_processor(of, EXACT, span, "hard")
    np.testing.assert_allclose(baked.hard, expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(baked.hard.ravel(), reference.hard(points, *cloud(NUM)), rtol=0, atol=1e-6)
    np.testing.assert_array_equal(baked.distance, baked.hard)
    np.testing.assert_array_equal(baked.bound, (baked.hard.astype(np.float64) - 0.01).astype(np.float32))
    centers, radii = (values[of.source[baked.entry.ravel()]] for values in cloud(NUM))
    mine = np.linalg.norm(points - centers, axis=1) - radii
    np.testing.assert_allclose(mine, expected.ravel(), rtol=0, atol=1e-6)  # a tie may go either way
    assert (np.abs(baked.gradient - gradient).max(axis=-1) < 1e-4).mean() > 0.999


@pytest.mark.parametrize("length", [0.005, 0.02, 0.1])
@pytest.mark.parametrize("where", BOXES)
@pytest.mark.parametrize("name", KINDS)
def test_kernel_distances_of_a_grid_are_those_of_the_references(
    name: str, where: str, length: float, device: Memory
) -> None:
    of, config = spheres(), replace(EXACT, length_scale=length)
    span, points = span_of(of, *BOXES[where])
    baked = device_field(device, of, config, (name,), is_single=True).bake(span, ALL)
    if name == "se":
        expected, slope = reference.se(points, *cloud(NUM), length, config.noise)
    else:
        expected = reference.gpdf(points, *cloud(NUM), length, config.noise)
        slope = reference.gpdf_gradient(points, *cloud(NUM), length, config.noise)
    distance, hard = baked.distance.ravel(), reference.hard(points, *cloud(NUM))
    is_clear = ~np.isnan(expected) & (np.abs(distance - hard) > 1e-6)  # the kernel's own
    if name == "se":  # near a root of zero, inside the surface, float32 has less, on either
        is_clear &= np.nan_to_num(expected) + MEAN_RADIUS > 0.3 * length
    assert np.mean(is_clear) > 0.3
    np.testing.assert_allclose(distance[is_clear], expected[is_clear], rtol=1e-5, atol=5e-7)
    by_cpu, cpu_slope = by_processor(of, config, span, name)
    np.testing.assert_allclose(distance[is_clear], by_cpu.ravel()[is_clear], rtol=1e-5, atol=2e-6)
    assert away(baked.gradient, slope, is_clear) < max(1e-4, away(cpu_slope, slope, is_clear))


def test_a_truncation_raises_a_distance_by_no_more(device: Memory) -> None:
    of, config = spheres(), FieldConfig(truncation=1e-3)
    span, _ = span_of(of, NEAR, 0.02)
    for name in KINDS:
        baked = device_field(device, of, config, (name,), is_single=True).bake(span, ())
        error = baked.distance - device_field(device, of, EXACT, (name,), is_single=True).bake(span, ()).distance
        assert error.min() > -2e-6 and error.max() < config.truncation
        assert (error != 0.0).any()  # something is left out


def test_the_smaller_distance_is_taken_with_its_gradient_and_what_was_asked_is_counted(device: Memory) -> None:
    of = spheres()
    span, _ = span_of(of, NEAR, 0.02)
    baked = device_field(device, of).bake(span, ALL)
    hard, slope = by_processor(of, EXACT, span, "hard")
    smooth, smooth_slope = by_processor(of, EXACT, span, "se")
    is_smooth = smooth < hard
    assert 0.1 < is_smooth.mean() < 0.99
    np.testing.assert_array_equal(baked.distance, np.minimum(baked.hard, baked.kernels["se"]))
    clear = (np.abs(np.nan_to_num(smooth, nan=9.0) - hard) > 1e-4) & ~(smooth < 0.0)
    assert np.abs(baked.gradient - np.where(is_smooth[..., None], smooth_slope, slope))[clear].max() < 5e-4
    assert abs(baked.counts["se"][0] - int(np.isnan(smooth).sum())) <= 2
    over = np.nan_to_num(smooth, nan=0.0) > hard + RESOLUTION
    assert abs(baked.counts["se"][1] - int(over.sum())) <= 0.01 * over.size
    assert not any(np.isnan(values).any() for values in baked.kernels.values())


@pytest.mark.parametrize("num", [5, 600, 5000])
def test_points_are_answered_as_by_the_processor(num: int, device: Memory) -> None:
    of, config = spheres(num), replace(EXACT, truncation=1e-7)
    points = np.concatenate([queries(200), 3.0 * queries(40, seed=2), cloud(num)[0][:4]])
    found = device_field(device, of, config).query(points, of.anchor, ALL)
    hard, _ = SphereField(of).query(points)
    np.testing.assert_allclose(found.hard, hard, rtol=1e-5, atol=1e-6)
    assert np.mean(of.source[found.entry] == SphereField(of).nearest(points)) > 0.99
    for name, kind in KINDS.items():
        raw, raw_slope = kind(of, config).query_raw(points)
        raw[np.isnan(raw)] = hard[np.isnan(raw)]
        np.testing.assert_allclose(found.kernels[name], raw, rtol=1e-5, atol=2e-6)
        single = device_field(device, of, config, (name,), is_single=True).query(points, of.anchor)
        clear = np.abs(raw - hard) > 1e-5
        assert away(single.gradient[clear], raw_slope[clear]) < 3e-4


def test_more_spheres_than_a_list_holds_are_worked_off(device: Memory) -> None:
    of = spheres(3000)
    span, points = span_of(of, Box(lower=np.array([-0.1, -0.1, 0.1]), upper=np.array([0.3, 0.2, 0.3])), 0.1)
    for name in KINDS:
        baked = device_field(device, of, replace(EXACT, length_scale=0.1), (name,), is_single=True).bake(span, ALL)
        if name == "se":
            expected, _ = reference.se(points, *cloud(3000), 0.1, EXACT.noise)
        else:
            expected = reference.gpdf(points, *cloud(3000), 0.1, EXACT.noise)
        known = ~np.isnan(expected)
        assert known.mean() > 0.5
        np.testing.assert_allclose(baked.distance.ravel()[known], expected[known], rtol=1e-5, atol=4e-6)


def test_planes_in_parts_have_the_bytes_of_the_whole(device: Memory) -> None:
    of = spheres()
    field = device_field(device, of)
    whole = field.bake(span_of(of, NEAR, 0.02)[0], ALL)
    parts = [field.bake(span_of(of, NEAR, 0.02, *planes)[0], ALL) for planes in ((0, 8), (8, None))]
    for name in ("hard", "distance", "gradient"):
        np.testing.assert_array_equal(np.concatenate([getattr(part, name) for part in parts]), getattr(whole, name))


def test_the_order_of_threads_changes_no_byte() -> None:
    of = spheres(5000)
    points = queries(50)
    answers = []
    for backwards in (False, True):
        field = device_field(EmulatedDevice(backwards=backwards), of)
        answers += [(field.bake(span_of(of, NEAR, 0.03)[0], ALL), field.query(points, of.anchor, ALL))]
    for one, other in zip(*answers, strict=True):
        for name in ("hard", "distance", "gradient", "entry"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        assert one.counts == other.counts


def test_memory_is_given_back() -> None:
    memory, of = EmulatedDevice(), spheres()
    field = device_field(memory, of)
    for num in (10, 30):
        field.query(queries(num), of.anchor)
    field.close()
    assert not memory.held


@pytest.mark.parametrize("distance", ["safe", "safe_gpdf", "se", "gpdf", "hard"])
def test_a_baker_on_a_device_bakes_the_processors_channels(distance: str, device: Memory) -> None:
    splats, config = splat_set(*cloud(NUM)), FieldConfig(voxel=0.02, distance=distance)
    layout = GridLayout.over(NEAR, config.voxel)
    channels = ("sdf", "gradient", "bound", "label", "hard", "se", "observed")
    made = []
    for memory in (device, None):
        baker = Baker(splats, layout, config, channels=channels, device=memory)
        planes = bake_planes(baker, 0, layout.shape[0])
        baker.close()
        made.append((planes, baker.counts))
    (mine, counts), (theirs, expected) = made
    for name in ("sdf", "hard", "bound", "se"):
        difference = np.abs(mine[name].astype(np.float64) - theirs[name].astype(np.float64))
        assert difference.max() < (1e-6 if name in ("hard", "bound") else 2 * config.truncation), name
    for name in ("label", "observed"):
        np.testing.assert_array_equal(mine[name], theirs[name])
    assert np.mean(np.abs(mine["gradient"].astype(float) - theirs["gradient"].astype(float)) < 2e-3) > 0.99
    assert all(abs(counts[name] - expected[name]) <= 0.01 * mine["sdf"].size for name in expected)


def test_a_certified_bound_never_exceeds_the_exact_distance_of_the_processor(device: Memory) -> None:
    splats, config, rng = splat_set(*cloud(NUM)), FieldConfig(voxel=0.03), np.random.default_rng(4)
    layout = GridLayout.over(NEAR, config.voxel)
    planes = bake_planes(Baker(splats, layout, config, channels=("sdf", "bound"), device=device), 0, layout.shape[0])
    field = GridField(DistanceGrid(origin=layout.origin, voxel=layout.voxel, channels=planes, header={}))
    points = rng.uniform(layout.box.lower - 0.1, layout.box.upper + 0.1, (200_000, 3))
    gap = SphereField(Spheres.of(*cloud(NUM)), threads=2).query(points)[0] - field.certified(points)
    assert 0.0 <= gap.min() < 0.01  # it comes near


def test_a_field_on_a_device_answers_as_that_of_the_processor(device: Memory) -> None:
    points, config = queries(100), FieldConfig()
    for distance in ("safe", "hard", "gpdf"):
        named = replace(config, distance=distance)
        field = OnDevice(Spheres.of(*cloud(NUM)), named, device)
        found, expected = field.distance(points), field_over(Spheres.of(*cloud(NUM)), named).query(points)[0]
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=2 * config.truncation)
        np.testing.assert_array_equal(field.nearest(points), SphereField(Spheres.of(*cloud(NUM))).nearest(points))
        np.testing.assert_array_equal(field.query(points)[0], found)
        none = points[:0]
        assert len(field.query(none)[0]) == len(field.distance(none)) == len(field.nearest(none)) == 0
        field.close()
