"""Surfaces with an exact distance, and splats that cover them: solids made here, and closed meshes from files."""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.measure import ROOT
from benchmarks.surface_samples import SurfaceSamples, inscribed_radii, sample_mesh
from splatctrl_cli.formats.mesh import TriangleMesh, load_mesh
from splatctrl_cli.geometry import invert_transform, pose_at, transform_points
from splatctrl_cli.records import Box, Float64
from splatctrl_cli.robot.link_meshes import MeshDistance
from splatctrl_cli.simulate.primitives import Primitive, Texture, closest_point, normals
from splatctrl_cli.simulate.truth import distance_to

MESHES = (
    *("spot.obj", "rocker-arm.obj", "featuretype.STL", "unit_sphere.STL"),
    *("ycb/YcbBanana.obj", "ycb/YcbMustardBottle.obj", "ycb/YcbPowerDrill.obj"),
)
IN_METRES = "ycb"  # the folder of meshes that are; the others have units of their own
EXTENT = 0.3  # [m] longest side that a mesh without metres is scaled to
PAIRS_PER_CHUNK = 5_000_000  # of the (points x splats) float64 array
CONTACT = 1e-6  # [m] a sample this near to another solid is where the two touch, and no surface


@dataclass(frozen=True, kw_only=True)
class Part:
    """One solid: its samples by (spacing, seed), and the nearest points (Q, 3) of its surface to points (Q, 3)."""

    samples: Callable[[float, int], SurfaceSamples]
    nearest_surface: Callable[[Float64], Float64]


@dataclass(frozen=True, kw_only=True)
class Shape:
    """Solids as one object: the box around it, and the signed distance (Q,) [m] to the union, exact outside."""

    name: str
    box: Box
    signed: Callable[[Float64], Float64]
    parts: tuple[Part, ...]


def splats_on(shape: Shape, spacing: float, *, is_inset: bool, seed: int) -> tuple[Float64, Float64]:
    """Centres (N, 3) and radii (N,) [m] that cover a shape, rounded to float32.

    Centres on the surface with radius 0; or (`is_inset`) inside, with the largest ball up to spacing / sqrt 2 that
    touches the surface from within.
    """
    centers, radii = [], []
    for part in shape.parts:
        samples = part.samples(spacing, seed)
        size = np.zeros(len(samples))
        if is_inset:
            size = inscribed_radii(samples, spacing / np.sqrt(2), part.nearest_surface)
        centers.append(samples.points - size[:, None] * samples.normals)
        radii.append(size)
    return (
        np.concatenate(centers).astype(np.float32).astype(np.float64),
        np.concatenate(radii).astype(np.float32).astype(np.float64),
    )


def shapes(*, with_meshes: bool = True) -> list[Shape]:
    """Box, ball and table, and the meshes in the folder SPLATCTRL_REAL_DATA, if set."""
    made = [
        _of_primitives("box", _box((0.30, 0.20, 0.16), (0.0, 0.0, 0.0))),
        _of_primitives("ball", _solid("sphere", (0.15,), (0.0, 0.0, 0.0))),
        _of_primitives(
            "tabletop",
            _box((0.80, 0.60, 0.04), (0.0, 0.0, -0.02)),
            _box((0.12, 0.16, 0.20), (-0.20, 0.10, 0.10)),
            _solid("cylinder", (0.04, 0.18), (0.12, 0.15, 0.09)),
            _solid("sphere", (0.07,), (0.15, -0.12, 0.07)),
        ),
    ]
    folder = mesh_folder()
    if not with_meshes or not folder.is_dir():
        return made
    return [*made, *(_of_mesh(folder / name) for name in MESHES)]


def mesh_folder() -> Path:
    """Where the meshes lie."""
    return Path(os.environ.get("SPLATCTRL_REAL_DATA", ROOT.parent / "shared" / "data")) / "meshes"


def points_around(shape: Shape, num: int, lower: float, upper: float, *, seed: int) -> tuple[Float64, Float64]:
    """Points (num, 3) uniform in space with true distance in [lower, upper) [m], and their distances (num,)."""
    rng = np.random.default_rng(seed)
    found: list[Float64] = []
    while sum(map(len, found)) < num:
        drawn = rng.uniform(shape.box.lower - upper, shape.box.upper + upper, (num, 3))
        distance = shape.signed(drawn)
        found.append(np.column_stack([drawn, distance])[(distance >= lower) & (distance < upper)])
    chosen = np.concatenate(found)[:num]
    return np.ascontiguousarray(chosen[:, :3]), chosen[:, 3].copy()


def _of_mesh(path: Path) -> Shape:
    mesh = load_mesh(path)
    if path.parent.name != IN_METRES:
        lower, upper = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        mesh = replace(mesh, vertices=(mesh.vertices - 0.5 * (lower + upper)) * (EXTENT / (upper - lower).max()))
    field = MeshDistance(mesh)
    part = Part(
        samples=lambda spacing, seed: sample_mesh(mesh, spacing, seed=seed),
        nearest_surface=lambda points: field.closest(points)[1],
    )
    box = Box(lower=mesh.vertices.min(axis=0), upper=mesh.vertices.max(axis=0))
    return Shape(name=path.stem, box=box, signed=field.signed, parts=(part,))


def _of_primitives(name: str, *solids: Primitive) -> Shape:
    reach = [solid.T_world_shape[:3, :3] @ np.array(_half_size(solid)) for solid in solids]
    middles = [solid.T_world_shape[:3, 3] for solid in solids]
    return Shape(
        name=name,
        box=Box(
            lower=np.min([m - r for m, r in zip(middles, reach, strict=True)], axis=0),
            upper=np.max([m + r for m, r in zip(middles, reach, strict=True)], axis=0),
        ),
        signed=lambda points: distance_to(solids, points, 0),
        parts=tuple(_part(solid, [other for other in solids if other is not solid]) for solid in solids),
    )


def _part(solid: Primitive, others: list[Primitive]) -> Part:
    return Part(
        samples=lambda spacing, seed: _samples(solid, others, spacing, seed),
        nearest_surface=lambda points: closest_point(solid, points)[1],
    )


def _samples(solid: Primitive, others: list[Primitive], spacing: float, seed: int) -> SurfaceSamples:
    """Samples of the solid's fine mesh, moved onto the solid, without samples where another solid touches it."""
    drawn = sample_mesh(_mesh_of(solid), spacing, seed=seed)
    points = closest_point(solid, transform_points(solid.T_world_shape, drawn.points))[1]
    if others:
        is_free = distance_to(others, points, 0) > CONTACT
        points = points[is_free]
    in_shape = transform_points(invert_transform(solid.T_world_shape), points)
    return SurfaceSamples(points=points, normals=normals(solid, in_shape) @ solid.T_world_shape[:3, :3].T)


def _mesh_of(solid: Primitive) -> TriangleMesh:
    import trimesh

    if solid.kind == "box":
        made = trimesh.creation.box(extents=solid.size)
    elif solid.kind == "sphere":
        made = trimesh.creation.icosphere(subdivisions=5, radius=solid.size[0])
    else:
        made = trimesh.creation.cylinder(radius=solid.size[0], height=solid.size[1], sections=256)
    return TriangleMesh(vertices=np.array(made.vertices), faces=np.array(made.faces), is_closed=True)


def _half_size(solid: Primitive) -> tuple[float, float, float]:
    if solid.kind == "box":
        return (solid.size[0] / 2, solid.size[1] / 2, solid.size[2] / 2)
    radius = solid.size[0]
    return (radius, radius, solid.size[1] / 2 if solid.kind == "cylinder" else radius)


def _box(size: tuple[float, float, float], middle: tuple[float, float, float]) -> Primitive:
    return _solid("box", size, middle)


def _solid(kind: str, size: tuple[float, ...], middle: tuple[float, float, float]) -> Primitive:
    T = pose_at(middle)
    grey = Texture(pattern="noise", feature=0.05, dark=(0.5, 0.5, 0.5), bright=(0.5, 0.5, 0.5))
    return Primitive(name=kind, kind=kind, size=size, T_world_shape=T, texture=grey)


@dataclass(frozen=True, kw_only=True)
class LoneSplat:
    """A splat before a wall [m]: its distance from the wall, the wall's spacing, the radius of all, and the kernel's
    l.
    """

    wall: float
    spacing: float
    radius: float
    length: float


LONE_SPLATS = tuple(
    LoneSplat(wall=wall, length=length, spacing=spacing, radius=radius)
    for wall, length, spacing, radius in (
        (0.02, 0.01, 0.005, 0.0),
        (0.03, 0.01, 0.005, 0.003),
        (0.02, 0.02, 0.010, 0.0),
        (0.03, 0.02, 0.010, 0.005),
        (0.04, 0.02, 0.010, 0.0),
        (0.04, 0.02, 0.010, 0.007),
        (0.04, 0.02, 0.005, 0.0035),
        (0.06, 0.02, 0.010, 0.0),
        (0.08, 0.02, 0.005, 0.0),
        (0.03, 0.04, 0.010, 0.0),
        (0.04, 0.04, 0.010, 0.007),
    )
)


def lone_splat(distance: float, *, wall_spacing: float, radius: float) -> tuple[Float64, Float64]:
    """One splat at the origin and a wall of splats, a square of 40 cm at x = -`distance` [m]: centres, radii.

    Row sums weight the splat as if it had neighbours, because the wall lies within its kernel.
    """
    axis = np.arange(-0.2, 0.2 + 0.5 * wall_spacing, wall_spacing)
    y, z = np.meshgrid(axis, axis, indexing="ij")
    wall = np.stack([np.full(y.size, -distance), y.ravel(), z.ravel()], axis=1)
    centers = np.concatenate([np.zeros((1, 3)), wall]).astype(np.float32).astype(np.float64)
    return centers, np.full(len(centers), radius, np.float32).astype(np.float64)


def random_balls(num: int, *, seed: int) -> tuple[Float64, Float64]:
    """Balls in a cube of 2 m with log-uniform radii from 1 mm to 30 cm: centres (N, 3), radii (N,)."""
    rng = np.random.default_rng(seed)
    centers = rng.uniform(-1.0, 1.0, (num, 3)).astype(np.float32).astype(np.float64)
    radii = 10.0 ** rng.uniform(-3.0, np.log10(0.3), num)
    return centers, radii.astype(np.float32).astype(np.float64)


def exact_distance(points: Float64, centers: Float64, radii: Float64) -> Float64:
    """``min_i |x - p_i| - r_i`` (Q,) [m] in float64, of every pair."""
    from scipy.spatial.distance import cdist

    parts = np.array_split(points, -(-len(points) * len(radii) // PAIRS_PER_CHUNK))
    return np.concatenate([(cdist(part, centers) - radii).min(axis=1) for part in parts])
