"""The rendered surface of solids and triangles against one ray at a time; pieces of surface in a depth image."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from splatctrl_cli.geometry import invert_transform, pose_at
from splatctrl_cli.kernels import native
from splatctrl_cli.kernels.surface_image import (
    BALL,
    BOX,
    CAPSULE,
    CYLINDER,
    SurfaceImage,
    SurfaceMesh,
    SurfaceScene,
    render_surface,
)
from splatctrl_cli.records import Bool, Float32, Float64
from tests.reference.surface import is_inside_spans, span, triangle_depth

K = np.array([60.0, 55.0, 24.3, 17.1, 51.0, 37.0])
KINDS = {"box": BOX, "cylinder": CYLINDER, "sphere": BALL, "capsule": CAPSULE}
TOLERANCE = 0.01


def rays() -> Float64:
    """(H, W, 3), one metre along the optical axis."""
    v, u = np.mgrid[: int(K[5]), : int(K[4])]
    return np.stack([(u - K[2]) / K[0], (v - K[3]) / K[1], np.ones(u.shape)], axis=-1)


def random_solids(rng: np.random.Generator) -> list[tuple[str, tuple[float, ...], Float64]]:
    """Kind, size as `span` takes it, T_camera_solid."""
    solids = []
    for kind, count in {"box": 3, "cylinder": 2, "sphere": 1, "capsule": 2}.items():
        for _ in range(3):
            R = Rotation.random(random_state=rng).as_matrix()
            T = pose_at(rng.uniform([-0.3, -0.2, 0.6], [0.3, 0.2, 1.2]), R)
            solids.append((kind, tuple(rng.uniform(0.03, 0.12, count)), T))
    return solids


def scene_of(solids: list[tuple[str, tuple[float, ...], Float64]], triangles: Float64 | None = None) -> SurfaceScene:
    faces = np.zeros((0, 3, 3)) if triangles is None else triangles
    rows = []
    for kind, size, T in solids:
        inverse = invert_transform(T)
        rows.append(
            np.concatenate([[KINDS[kind]], inverse[:3, :3].ravel(), inverse[:3, 3], size, np.zeros(3 - len(size))])
        )
    return SurfaceScene(
        solids=np.array(rows).reshape(-1, 16),
        solid_links=np.arange(len(solids), dtype=np.int16),
        mesh=SurfaceMesh(faces, np.full(len(faces), 7, np.int16)),
        link_poses=np.tile(np.eye(4)[:3], (8, 1, 1)),
    )


def ball_faces(center: Float64, radius: float) -> Float64:
    """A polyhedron (F, 3, 3) of 2,048 faces with its corners on a sphere, counter-clockwise from outside."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    corners = axes[np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])]
    for _ in range(4):
        a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
        ab, bc, ca = ((p + q) / np.linalg.norm(p + q, axis=1, keepdims=True) for p, q in ((a, b), (b, c), (c, a)))
        corners = np.concatenate(
            [np.stack(part, axis=1) for part in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
    return np.ascontiguousarray(center + radius * corners)


def rendered(scene: SurfaceScene, measured: np.ndarray | None = None, threads: int = 1) -> SurfaceImage:
    image = np.zeros((int(K[5]), int(K[4])), np.float32) if measured is None else measured
    return render_surface(scene, K, image, tolerance=TOLERANCE, quadratic=0.0, num_threads=threads)


@pytest.mark.parametrize("seed", range(2))
def test_depth_link_and_inside_are_those_of_one_ray_at_a_time(seed: int) -> None:
    rng = np.random.default_rng(seed)
    solids = random_solids(rng)
    measured = rng.uniform(0.5, 1.3, (int(K[5]), int(K[4]))).astype(np.float32)
    image = rendered(scene_of(solids), measured)
    inverses = [(kind, size, invert_transform(T)) for kind, size, T in solids]
    num_seen = num_inside = 0
    for (v, u), direction in zip(np.ndindex(image.depth.shape), rays().reshape(-1, 3), strict=True):
        spans = [span(kind, size, inverse[:3, 3], inverse[:3, :3] @ direction) for kind, size, inverse in inverses]
        near, far = np.array(spans).T
        if not np.isfinite(near).any():
            assert (image.depth[v, u], image.link[v, u], image.inside[v, u]) == (0, -1, -1)
            continue
        ends = np.sort(near[np.isfinite(near)])
        if np.min(far[np.isfinite(near)] - near[np.isfinite(near)]) < 0.02 or np.min(np.diff(ends), initial=1) < 1e-4:
            continue  # grazing, or two at the same depth: single precision may decide otherwise
        at = float(measured[v, u])
        gaps = np.abs(np.concatenate([at - TOLERANCE - ends, at + TOLERANCE - far[np.isfinite(near)]]))
        num_seen += 1
        assert (image.depth[v, u], image.link[v, u]) == (pytest.approx(near.min(), abs=2e-5), np.argmin(near))
        if gaps.min() > 1e-4:
            inside = is_inside_spans(at, TOLERANCE, spans)
            num_inside += inside
            assert (image.inside[v, u] >= 0) == inside
    assert num_seen > 300
    assert num_inside > 20


def test_triangles_show_what_their_solid_shows() -> None:
    center, radius = np.array([0.05, -0.02, 0.9]), 0.15
    ball = rendered(scene_of([("sphere", (radius,), pose_at(center))]))
    faces = rendered(scene_of([], ball_faces(center, radius)))
    both = (ball.depth > 0) & (faces.depth > 0)
    assert both.sum() > 200
    assert ((ball.depth > 0) != (faces.depth > 0)).sum() < 20
    assert np.abs(ball.depth - faces.depth)[both].mean() < 1e-3 and (faces.link[faces.depth > 0] == 7).all()


def mesh_scene(triangles: Float64, links: Sequence[int]) -> SurfaceScene:
    return replace(scene_of([]), mesh=SurfaceMesh(np.ascontiguousarray(triangles), np.array(links, np.int16)))


def test_the_nearest_triangle_shows_from_whichever_side() -> None:
    rng = np.random.default_rng(0)
    sides = rng.normal(0.0, 0.15, (60, 3, 3))
    triangles = rng.uniform([-0.3, -0.2, 0.6], [0.3, 0.2, 1.2], (60, 1, 3)) + sides
    links = rng.integers(0, 8, 60)
    image = rendered(mesh_scene(triangles, links))
    num_shown = 0
    for (v, u), direction in zip(np.ndindex(image.depth.shape), rays().reshape(-1, 3), strict=True):
        depths = np.array([triangle_depth(corners, direction) for corners in triangles])
        if not np.isfinite(depths).any():
            assert (image.depth[v, u], image.link[v, u]) == (0, -1)
            continue
        num_shown += 1
        assert image.depth[v, u] == pytest.approx(depths.min(), rel=1e-6)
        assert image.link[v, u] == links[depths.argmin()]
    assert num_shown > 300
    assert (image.depth == 0).sum() > 100


@pytest.mark.parametrize("is_first_from_inside", [False, True])
def test_of_two_triangles_in_one_place_the_first_shows(is_first_from_inside: bool) -> None:
    corners = np.array([[-0.2, -0.2, 1.0], [0.2, -0.2, 1.0], [0.0, 0.3, 1.0]])
    both = np.array([corners, corners[::-1]])
    image = rendered(mesh_scene(both[::-1] if is_first_from_inside else both, [3, 5]))
    assert (image.link[image.depth > 0] == 3).all() and (image.depth > 0).sum() > 100


def test_a_triangle_that_reaches_behind_the_camera_hides_none() -> None:
    near = np.array([[-0.2, -0.2, 0.5], [0.2, -0.2, 0.5], [0.0, 0.3, -0.1]])
    far = np.array([[-0.2, -0.2, 1.0], [0.2, -0.2, 1.0], [0.0, 0.3, 1.0]])
    assert set(np.unique(rendered(mesh_scene(np.array([near, far]), [1, 2])).link)) == {-1, 2}


def test_a_mesh_without_poses_for_all_its_links_is_refused() -> None:
    with pytest.raises(ValueError, match="no such link"):
        rendered(mesh_scene(np.ones((1, 3, 3)), [8]))


def test_a_solid_that_holds_the_camera_is_not_seen() -> None:
    assert not rendered(scene_of([("sphere", (0.5,), np.eye(4))])).depth.any()


def test_the_thread_count_does_not_change_a_bit() -> None:
    scene = scene_of(random_solids(np.random.default_rng(9)), ball_faces(np.array([0.1, 0.0, 0.8]), 0.1))
    measured = np.full((int(K[5]), int(K[4])), 0.9, np.float32)
    one, three = rendered(scene, measured, 1), rendered(scene, measured, 3)
    for name in ("depth", "link", "inside"):
        assert getattr(one, name).tobytes() == getattr(three, name).tobytes()


def expected_areas(depth: Float32, steps: Float32, area: Float64, is_object: Bool, asked: Bool) -> Float64:
    """Of every asked pixel the area of its piece; all that is not asked is one pixel more."""
    height, width = depth.shape
    beyond = height * width
    number = np.where(asked, np.arange(beyond).reshape(height, width), beyond)
    pairs = []
    for v, u in np.argwhere(is_object):
        for y, x in ((v, u + 1), (v + 1, u - 1), (v + 1, u), (v + 1, u + 1)):
            if not (y < height and 0 <= x < width and is_object[y, x] and (asked[v, u] or asked[y, x])):
                continue
            if abs(depth[v, u] - depth[y, x]) < min(steps[v, u], steps[y, x]):
                pairs.append((number[v, u], number[y, x]))
    ends = np.array(pairs).reshape(-1, 2).T
    graph = coo_array((np.ones(ends.shape[1]), tuple(ends)), shape=(beyond + 1, beyond + 1))
    piece = connected_components(graph, directed=False)[1]
    total = np.bincount(piece[:-1], np.where(asked, area, 0.0).ravel(), piece.max() + 1)
    total[piece[beyond]] = np.inf
    return np.where(asked, total[piece[:-1]].reshape(height, width), np.inf)


@pytest.mark.parametrize("is_asked_here_and_there", [False, True])
@pytest.mark.parametrize("share", [0.3, 0.9])
def test_a_piece_is_what_small_steps_join(share: float, is_asked_here_and_there: bool) -> None:
    rng = np.random.default_rng(0)
    depth = rng.choice(np.array([1.0, 1.005, 1.01, 1.04], np.float32), (40, 50))
    steps = rng.choice(np.array([0.004, 0.006, 0.02], np.float32), depth.shape)
    area, is_object = rng.random(depth.shape), rng.random(depth.shape) < share
    asked = is_object & ((rng.random(depth.shape) < 0.02) if is_asked_here_and_there else (np.arange(50) < 35))
    total = np.empty(depth.shape)
    native.piece_areas(depth, steps, area, is_object.view(np.uint8), asked.view(np.uint8), total)
    np.testing.assert_array_equal(total, expected_areas(depth, steps, area, is_object, asked))
    assert np.isinf(total[asked]).any() and (is_asked_here_and_there or len(np.unique(total)) > 10)
