"""The robot's own surface as cameras see it, and distances to it."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.formats.mesh import load_mesh
from splatctrl_cli.geometry import invert_transform, pose_at, transform_points
from splatctrl_cli.kernels import Int16
from splatctrl_cli.kernels.points import solid_distance
from splatctrl_cli.kernels.surface_image import (
    BALL,
    BOX,
    CAPSULE,
    CYLINDER,
    SurfaceImage,
    SurfaceMesh,
    SurfaceScene,
    TriangleTree,
    better,
    render_surface,
)
from splatctrl_cli.records import Bool, Box, Float32, Float64, Floats, Intrinsics, SphereSet
from splatctrl_cli.robot.link_meshes import mesh_path, place_mesh
from splatctrl_cli.robot.urdf import Shape, UrdfFile, visual_urdf

KINDS = {"box": BOX, "cylinder": CYLINDER, "sphere": BALL, "capsule": CAPSULE}


@dataclass(frozen=True, kw_only=True)
class RobotSurface:
    """Solids (P) and triangles (F), each fixed to one of `links` (L) [m].

    kinds (P,), sizes (P, 3) as in `kernels.surface_image`; T_link_solid (P, 4, 4); triangles (F, 3, 3) in the frame
    of triangle_links (F,); mesh draws the triangles, trees (by link number) measure them. by_spheres: links whose
    missing geometry spheres replace. notes: replaced visual geometry, and why. fixed: links that no joint moves.
    num_carried: number of carried boxes, whose links are repeated at the end of `links`.
    """

    links: tuple[str, ...]
    kinds: Float64
    sizes: Float64
    T_link_solid: Float64
    solid_links: Int16
    triangles: Float64
    triangle_links: Int16
    mesh: Any
    trees: Mapping[int, TriangleTree] = field(default_factory=dict)
    by_spheres: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    fixed: tuple[str, ...] = ()
    num_carried: int = 0

    @classmethod
    def of(cls, urdf: UrdfFile, spheres: SphereSet, folders: Sequence[Path] = ()) -> "RobotSurface":
        """Build each link from visual geometry, else collision geometry, else spheres.

        folders: for ``package://``. Raises InputError for a mesh in another unit.
        """
        seen = visual_urdf(urdf)
        pieces, unread = _read(seen, folders)
        lost = dict(unread)
        if unread:
            seen = visual_urdf(urdf, without=unread)
            pieces, unread = _read(seen, folders)
        by_spheres = tuple(
            link for link in dict.fromkeys(spheres.links) if link in unread or link not in seen.collision_links
        )
        shapes = [shape for shape in seen.shapes if shape.link not in by_spheres]
        rows = zip(spheres.links, spheres.centers, spheres.radii, strict=True)
        balls = [_ball(link, center, radius) for link, center, radius in rows if link in by_spheres]
        drawn = [(link, corners) for link, corners in pieces if link not in by_spheres]
        bodies = urdf.rigid_bodies()
        children = {joint.child for joint in urdf.joints}
        surface = cls.from_parts(
            [*shapes, *balls],
            drawn,
            by_spheres=by_spheres,
            fixed=tuple(link for link in urdf.links if bodies[link][0] not in children),
        )
        return replace(surface, notes=_notes(by_spheres, {*seen.collision_links} - unread.keys(), lost | unread))

    @classmethod
    def from_parts(
        cls,
        shapes: Sequence[Shape],
        triangles: Sequence[tuple[str, Float64]] = (),
        *,
        by_spheres: tuple[str, ...] = (),
        fixed: tuple[str, ...] = (),
    ) -> "RobotSurface":
        """Build a surface of primitives and triangles (F, 3, 3), each in a link's frame."""
        links = tuple(dict.fromkeys([*(s.link for s in shapes), *(link for link, _ in triangles)]))
        number = {link: index for index, link in enumerate(links)}
        corners = np.concatenate([np.zeros((0, 3, 3)), *(part for _, part in triangles)])
        owners = np.repeat([number[link] for link, _ in triangles], [len(part) for _, part in triangles])
        return cls(
            links=links,
            kinds=np.array([KINDS[s.kind] for s in shapes], np.float64),
            sizes=np.array([_sizes(s) for s in shapes], np.float64).reshape(-1, 3),
            T_link_solid=np.array([s.T_link_shape for s in shapes], np.float64).reshape(-1, 4, 4),
            solid_links=np.array([number[s.link] for s in shapes], np.int16),
            triangles=corners,
            triangle_links=owners.astype(np.int16),
            mesh=SurfaceMesh(corners, owners.astype(np.int16)),
            trees={int(k): TriangleTree(corners[owners == k]) for k in np.unique(owners)},
            by_spheres=by_spheres,
            fixed=fixed,
        )

    @classmethod
    def from_balls(cls, centers_world: Float64, radii: Float64) -> "RobotSurface":
        """Build a surface of balls (S, 3), (S,) [m]; the link's frame is the world."""
        balls = [_ball("spheres", c, r) for c, r in zip(centers_world, radii, strict=True)]
        return cls.from_parts(balls, by_spheres=("spheres",))

    def add_boxes(self, boxes: Sequence[tuple[str, Box]]) -> "RobotSurface":
        """Surface with carried boxes, each in the frame of its link."""
        shapes = [
            Shape(
                link=link,
                kind="box",
                size=tuple(box.upper - box.lower),
                T_link_shape=pose_at((box.lower + box.upper) / 2),
            )
            for link, box in boxes
        ]
        return replace(
            self,
            links=(*self.links, *(s.link for s in shapes)),
            kinds=np.append(self.kinds, [BOX] * len(shapes)),
            sizes=np.concatenate([self.sizes, np.array([_sizes(s) for s in shapes]).reshape(-1, 3)]),
            T_link_solid=np.concatenate(
                [self.T_link_solid, np.array([s.T_link_shape for s in shapes]).reshape(-1, 4, 4)]
            ),
            solid_links=np.append(self.solid_links, len(self.links) + np.arange(len(shapes))).astype(np.int16),
            num_carried=len(shapes),
        )

    def joined(self, pieces: Sequence[tuple[str, Float64]]) -> "RobotSurface":
        """Surface with more triangles (F, 3, 3) [m], in frames of `links`."""
        added = [np.full(len(part), self.links.index(link), np.int16) for link, part in pieces]
        triangles, owners = np.concatenate([self.triangles, *(p for _, p in pieces)]), self.triangle_links
        owners = np.concatenate([owners, *added])
        trees = {int(k): TriangleTree(triangles[owners == k]) for k in np.unique(np.concatenate([[], *added]))}
        mesh, trees = SurfaceMesh(triangles, owners), {**self.trees, **trees}
        return replace(self, triangles=triangles, triangle_links=owners, mesh=mesh, trees=trees)

    @property
    def vague(self) -> list[int]:
        """Numbers of the links whose solids only enclose the body: spheres and carried boxes."""
        first = len(self.links) - self.num_carried
        return [k for k, name in enumerate(self.links) if k >= first or name in self.by_spheres]

    @property
    def is_drawn(self) -> bool:
        """True if visual meshes cover every link, so that all inside is robot."""
        return bool(self.trees) and not self.notes and not self.vague

    def poses(self, T_world_link: Mapping[str, Float64]) -> Float64:
        """Poses (L, 4, 4) of `links`, from poses by name."""
        return np.array([T_world_link[link] for link in self.links], np.float64).reshape(-1, 4, 4)

    def extents(self, T_world_link: Float64) -> dict[str, list[float]]:
        """Box corners (lower, upper) [m] and area [m^2] by link, at T_world_link (L, 4, 4)."""
        T = T_world_link[self.solid_links] @ self.T_link_solid
        half, areas = _half_extents(self.kinds, self.sizes, T[:, :3, :3]), _areas(self.kinds, self.sizes)
        T_link = T_world_link[self.triangle_links]
        corners = np.einsum("fij,fkj->fki", T_link[:, :3, :3], self.triangles) + T_link[:, None, :3, 3]
        sides = np.diff(corners, axis=1)
        areas = np.append(areas, 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1))
        lower = np.concatenate([T[:, :3, 3] - half, corners.min(axis=1)])
        upper = np.concatenate([T[:, :3, 3] + half, corners.max(axis=1)])
        number = np.append(self.solid_links, self.triangle_links)
        return {
            link: [*lower[number == k].min(axis=0), *upper[number == k].max(axis=0), areas[number == k].sum()]
            for k, link in enumerate(self.links)
        }

    def render(
        self,
        T_world_link: Float64,
        intrinsics: Intrinsics,
        T_world_camera: Float64,
        measured: Float32,
        *,
        tolerance: float = 0.0,
        quadratic: float = 0.0,
    ) -> SurfaceImage:
        """Render the robot alone, and mark points of `measured` (H, W) float32 [m] inside it.

        T_world_link (L, 4, 4); see `kernels.surface_image.render_surface`.
        """
        k = intrinsics
        T_camera_link = invert_transform(T_world_camera) @ T_world_link
        T_solid_camera = np.linalg.inv(T_camera_link[self.solid_links] @ self.T_link_solid)
        scene = SurfaceScene(
            solids=self._solids(T_solid_camera),
            solid_links=self.solid_links,
            mesh=self.mesh,
            link_poses=np.ascontiguousarray(T_camera_link[:, :3]),
        )
        packed = np.array([k.fx, k.fy, k.cx, k.cy, k.width, k.height], np.float64)
        return render_surface(
            scene, packed, np.ascontiguousarray(measured, np.float32), tolerance=tolerance, quadratic=quadratic
        )

    def distance(
        self,
        T_world_link: Float64,
        points_world: Floats,
        *,
        without: Sequence[str] = (),
        within: Floats | float = np.inf,
        enough: Floats | float = -np.inf,
        outside: Bool | None = None,
        num_threads: int = 1,
    ) -> Float64:
        """Signed distances (Q,) [m] of points (Q, 3), negative inside.

        Triangles beyond `within` (Q,) [m] are infinitely far. With `enough` (Q,) [m] >= 0, the result only lies on
        the true side of `within` and `enough`. Points `outside` (Q,) skip the inside test.
        """
        T_solid_world = np.linalg.inv(T_world_link[self.solid_links] @ self.T_link_solid)
        counts = np.array([link not in without for link in self.links], bool)
        least = solid_distance(points_world, self._solids(T_solid_world)[counts[self.solid_links]], num_threads)
        trees = {number: tree for number, tree in self.trees.items() if counts[number]}
        poses = [invert_transform(T_world_link[number]) for number in trees]
        better(
            least, points_world, list(trees.values()), poses, within=within, enough=enough, outside=outside,
            num_threads=num_threads,
        )  # fmt: skip
        return least

    def distance_to(
        self, link: str, points: Float64, outside: Bool | None = None, *, within: float = np.inf
    ) -> Float64:
        """Signed distances (Q,) [m] of points (Q, 3), link frame, to one link.

        Carried boxes count. outside (Q,), within [m]: as in `distance`.
        """
        still, others = np.tile(np.eye(4), (len(self.links), 1, 1)), [name for name in self.links if name != link]
        return self.distance(still, points, without=others, within=within, outside=outside)

    def gaps(self, link: str, T_world_link: Float64, centers: Floats, radii: Floats) -> Float64:
        """A link's signed gap (T,) [m] to the nearest ball; infinite without balls.

        Carried boxes count. Balls: centers (N, 3), radii (N,) [m], world. T_world_link (T, 4, 4).
        """
        numbers = [number for number, name in enumerate(self.links) if name == link]
        to_link = np.asarray(np.linalg.inv(T_world_link), np.float64)
        gaps = [self.trees[number].gaps(to_link, centers, radii)[0] for number in numbers if number in self.trees]
        own = np.isin(self.solid_links, numbers)
        if own.any():
            solids = self._solids(np.linalg.inv(self.T_link_solid))[own]
            away = [solid_distance(transform_points(T, centers), solids) - radii for T in to_link]
            gaps.append(np.array([gap.min(initial=np.inf) for gap in away]))
        return np.asarray(np.min(gaps, axis=0))

    def _solids(self, T_solid: Floats) -> Float64:
        return np.column_stack([self.kinds, T_solid[:, :3, :3].reshape(-1, 9), T_solid[:, :3, 3], self.sizes])


def _half_extents(kinds: Float64, sizes: Float64, R: Float64) -> Float64:
    radius, length = sizes[:, :1], np.abs(R[:, :, 2]) * sizes[:, 1:2]
    is_flat = np.isin(kinds, [CYLINDER])[:, None]
    across = radius * np.where(is_flat, np.sqrt(np.maximum(1 - np.square(R[:, :, 2]), 0.0)), 1.0)
    of_box = np.einsum("pij,pj->pi", np.abs(R), sizes)
    return np.where((kinds == BOX)[:, None], of_box, np.where((kinds == BALL)[:, None], radius, across + length))


def _areas(kinds: Float64, sizes: Float64) -> Float64:
    a, b, c = sizes.T
    of_box, round_part, ends = 8 * (a * b + b * c + c * a), 4 * np.pi * a * b, np.pi * a * a
    choices = [of_box, round_part + 2 * ends, 4 * ends, round_part + 4 * ends]
    return np.select([kinds == kind for kind in (BOX, CYLINDER, BALL, CAPSULE)], choices)


def _read(urdf: UrdfFile, folders: Sequence[Path]) -> tuple[list[tuple[str, Float64]], dict[str, str]]:
    pieces, unread = [], {link: f"{urdf.path}: <{tag}> cannot be read" for link, tag in urdf.other_shapes}
    for mesh in urdf.meshes:
        try:
            loaded = load_mesh(mesh_path(urdf.path, mesh, folders))
        except InputError as error:
            unread.setdefault(mesh.link, error.message)
        else:
            pieces.append((mesh.link, place_mesh(mesh, loaded).corners))
    return [(link, corners) for link, corners in pieces if link not in unread], unread


def _notes(by_spheres: Sequence[str], solid: Collection[str], unread: Mapping[str, str]) -> tuple[str, ...]:
    groups: dict[tuple[str, bool], list[str]] = {}
    for link in dict.fromkeys([*by_spheres, *unread]):
        rest = "collision geometry stands" if link in solid else "nothing stands"
        groups.setdefault(("spheres stand" if link in by_spheres else rest, link in unread), []).append(link)
    return tuple(
        f"{what} for {', '.join(links)}: {unread.get(links[0], 'no visual or collision geometry in the URDF')}"
        for (what, _), links in groups.items()
    )


def _sizes(shape: Shape) -> tuple[float, float, float]:
    if shape.kind == "box":
        x, y, z = shape.size
        return x / 2, y / 2, z / 2
    return shape.size[0], 0.0 if shape.kind == "sphere" else shape.size[1] / 2, 0.0


def _ball(link: str, center: Float64, radius: float) -> Shape:
    return Shape(link=link, kind="sphere", size=(float(radius),), T_link_shape=pose_at(center))
