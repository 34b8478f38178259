"""Each method's knowledge of the scene after the cameras' frames: a distance to plan in.

Q points, world frame, metres. A distance is a lower bound of a 1-Lipschitz one, so that a planner's proof for an edge
is valid.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from experiments.gaussian_fitter import GaussianFitter
from experiments.problems import Problem, Step, Views
from experiments.solids import OnlyDistance
from experiments.ways import (
    Surroundings,
    Ways,
    beside_the_start,
    is_beside_the_start,
    yielded,
)
from splatctrl_cli import Box, Config, Label, NotEvaluableError
from splatctrl_cli.blocks import (
    ROUNDING,
    Baker,
    Balls,
    Certified,
    DistanceField,
    DistanceFunction,
    DistanceGrid,
    Float32,
    Float64,
    GridField,
    GridLayout,
    HasDistance,
    KnownScene,
    PixelKind,
    RgbdFrame,
    RobotPosture,
    SceneFitter,
    SphereField,
    Spheres,
    SplatSet,
    VoxelState,
    field_splats,
    known_space,
    nearest_splats,
    obstacle_spheres,
    of_extra,
    posture_of,
    seen_of,
    self_mask,
    self_mask_metrics,
    splat_fields,
)

TSDF_BLOCKS = 20_000  # of 8 voxels along each edge, to begin with
TSDF_VOXEL, TSDF_BAND = 0.01, 0.04  # [m] edge of a voxel, and how far from a surface the TSDF reaches


@dataclass(frozen=True, kw_only=True)
class Map:
    """scene: distance to the method's obstacles. ways: where a planner may go, None for everywhere outside obstacles.
    known: a verdict's input, or None. barrier: a controller's field, or None. num_parts: number of splats, voxels or
    triangles. things: the map's balls for pictures, centers (N, 3) and radii (N,) [m]; None without a map.
    """

    scene: HasDistance
    ways: Ways | None = None
    known: KnownScene | None = None
    barrier: Callable[[], DistanceField] | None = None
    num_parts: int = 0
    things: tuple[Float32, Float32] | None = None


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """A reconstruction of views: its fitter and the residuals of its self-mask."""

    fitter: SceneFitter
    figures: dict[str, object]


def fitted(problem: Problem, views: Views, config: Config, threads: int) -> Fitted:
    """The map after all time steps, the arm at the start in each."""
    fitter = SceneFitter(config.scene, config.occupancy, workspace_of(problem), seed=problem.number, threads=threads)
    rows = [fitter.step(step, _posture(problem, step)) for step in views.steps]
    return Fitted(fitter=fitter, figures={"voxel": config.occupancy.voxel, **self_mask_metrics(rows)})


def workspace_of(problem: Problem) -> Box:
    """What the arm reaches around its base."""
    reach, base = problem.model.reach(), problem.model.base_position
    return Box(lower=base - reach, upper=base + reach)


def splat_map(problem: Problem, made: Fitted, config: Config, threads: int) -> Map:
    """Our map: the exact distance to splats and to occupied voxels without splats, and never-seen space.

    The planner's scene is without those that reach into the arm where it stands: what is there is the arm, and a few
    of its pixels that were taken for something else. The verdict's has them. Where a planner may go, lost edges of
    surfaces count, too.
    """
    fitter = made.fitter
    fields, voxels = splat_fields(fitter.splats(), config, threads, fitter.unrepresented), fitter.known_voxels()
    seen = seen_of(voxels.seen)
    known = KnownScene(
        at=lambda stamp_ns: fields,
        observed=known_space(voxels.grid),
        seen_at=lambda stamp_ns: seen,
        has_seen_times=False,  # nothing moves in a study: how old depth is decides nothing
        figures=lambda: made.figures,
        first_ns=None,
        cameras=None,
        digests={},
    )
    spheres, edges = obstacle_spheres(fitter.splats(), fitter.unrepresented).splats, voxels.edges
    centers, radii = beside_the_start(problem, spheres.centers, spheres.radii)
    edge_centers, edge_radii = beside_the_start(problem, edges.centers, edges.radii)
    surroundings = Surroundings(
        problem=problem,
        centers=np.concatenate([centers, edge_centers]),
        radii=np.concatenate([radii, edge_radii]),
        num_known=len(radii),
        grid=voxels.grid,
        config=config,
        threads=threads,
    )
    return Map(
        scene=Certified(distance=_less_rounding(SphereField(Spheres.of(centers, radii), threads=threads))),
        ways=surroundings.ways,
        known=known,
        barrier=lambda: barrier_of(problem, spheres, config, threads),
        num_parts=len(fitter.splats()),
        things=(centers, radii),
    )


def _less_rounding(field: SphereField) -> DistanceFunction:
    return lambda points: field.query(points)[0] - ROUNDING


def barrier_of(problem: Problem, spheres: SplatSet, config: Config, threads: int) -> DistanceField:
    """A controller's field over the map's spheres, without spheres that overlap the arm at its start. Spheres near
    the start and the goal shrink, here at most to their centres.
    """
    kept = spheres.select(is_beside_the_start(problem, spheres.centers, spheres.radii))
    radii = yielded(problem, kept.centers, kept.radii, config.control.margin)
    return splat_fields(replace(kept, radii=np.maximum(radii, np.float32(0))), config, threads).barrier


def printed_map(problem: Problem, made: Fitted, config: Config, threads: int) -> Map:
    """The map of IV-B: the splats' kernel distance on a grid, interpolated; space is free if above 0."""
    fitter = made.fitter
    layout = GridLayout.over(workspace_of(problem), config.field.voxel)
    splats = field_splats(fitter.splats())
    baker = Baker(splats, layout, config.field, channels=("sdf",), threads=threads)
    planes = baker.allocate(layout.shape[0])
    baker.bake(0, layout.shape[0], planes)
    grid = DistanceGrid(origin=layout.origin, voxel=layout.voxel, channels=planes, header={})
    scene = OnlyDistance(field=GridField(grid))
    return Map(scene=scene, num_parts=len(splats), things=(splats.centers, splats.radii))


def occupancy_map(made: Fitted, config: Config, threads: int) -> Map:
    """Only an occupancy grid: a ball around each occupied voxel without the robot's voxels."""
    grid = made.fitter.occupancy.grid()
    states = grid.states(config.occupancy.free_below, config.occupancy.occupied_above)
    is_thing = (states == VoxelState.OCCUPIED) & (grid.entity & Label.ROBOT == 0)
    centers = grid.origin + grid.voxel * np.argwhere(is_thing)
    if not len(centers):
        raise NotEvaluableError("occupancy grid: no voxel is occupied")
    balls = Balls.from_voxels(centers.astype(np.float32), grid.voxel, np.zeros(len(centers), np.uint8))
    radii = np.full(len(balls), balls.radius, np.float32)
    field = SphereField(Spheres.of(balls.centers, radii), threads=threads)
    scene = Certified(distance=_less_rounding(field))
    return Map(scene=scene, num_parts=len(balls), things=(balls.centers, radii))


def gaussian_map(problem: Problem, views: Views, config: Config, threads: int) -> Map:
    """3D-GS, densified as in IV-A, of the frames without the arm's pixels: the distance to balls of its Gaussians'
    volume. Balls that overlap the arm at its start are omitted, as in our map.
    """
    fitter = GaussianFitter(
        config, workspace_of(problem), without_robot(problem, views, config), seed=problem.number, threads=threads
    )
    fitter.fit()
    splats = nearest_splats(fitter.gaussians())
    centers, radii = beside_the_start(problem, splats.centers, splats.radii)
    if not len(radii):
        raise NotEvaluableError("3D-GS: no Gaussian is left")
    field = SphereField(Spheres.of(centers, radii), threads=threads)
    return Map(scene=Certified(distance=_less_rounding(field)), num_parts=len(splats), things=(centers, radii))


def tsdf_map(problem: Problem, views: Views, config: Config) -> Map:
    """Open3D's TSDF of the frames without the arm's pixels: the distance to its mesh. Raises UsageError without the
    extra.
    """
    o3d = of_extra("open3d", "open3d", "a TSDF")
    tensor, far, band = o3d.core.Tensor, config.occupancy.max_range, TSDF_BAND / TSDF_VOXEL
    volume = o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight"),
        attr_dtypes=(o3d.core.float32, o3d.core.float32),
        attr_channels=((1), (1)),
        voxel_size=TSDF_VOXEL,
        block_resolution=8,
        block_count=TSDF_BLOCKS,
    )
    for frame in without_robot(problem, views, config):
        k = frame.intrinsics
        pinhole = tensor(np.array([[k.fx, 0.0, k.cx], [0.0, k.fy, k.cy], [0.0, 0.0, 1.0]]))
        pose = tensor(np.linalg.inv(frame.T_world_camera))
        depth = o3d.t.geometry.Image(tensor(np.ascontiguousarray(frame.depth[..., None], np.float32)))
        blocks = volume.compute_unique_block_coordinates(depth, pinhole, pose, 1.0, far, band)
        volume.integrate(blocks, depth, pinhole, pose, 1.0, far, band)
    mesh = volume.extract_triangle_mesh()
    num_triangles = len(mesh.triangle.indices) if "indices" in mesh.triangle else 0
    if not num_triangles:
        raise NotEvaluableError("TSDF: no surface was found")
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(mesh)

    def distance(points: Float64) -> Float64:
        asked = tensor(np.ascontiguousarray(points, np.float32))
        return np.asarray(scene.compute_distance(asked).numpy(), np.float64) - ROUNDING

    corners = mesh.vertex.positions.numpy()
    radii = np.full(len(corners), 0.5 * TSDF_VOXEL, np.float32)
    return Map(scene=Certified(distance=distance), num_parts=num_triangles, things=(corners, radii))


def without_robot(problem: Problem, views: Views, config: Config) -> list[RgbdFrame]:
    """Every frame with neither depth nor valid colour on the arm's pixels."""
    return [_without_robot(frame, _posture(problem, step), config) for step in views.steps for frame in step]


def _without_robot(frame: RgbdFrame, robot: RobotPosture, config: Config) -> RgbdFrame:
    mask = self_mask(frame, robot, config.occupancy)
    is_thing = mask.kinds == PixelKind.OBJECT
    depth = np.where(is_thing, frame.depth, np.float32(0))
    is_valid = is_thing | ((mask.kinds == PixelKind.NOTHING) & (mask.robot_depth == 0))
    return replace(frame, depth=depth, valid=is_valid if frame.valid is None else is_valid & frame.valid)


def _posture(problem: Problem, step: Step) -> RobotPosture:
    return posture_of(problem.model, problem.start, {frame.stamp_ns: problem.start for frame in step})
