"""The robot's surface and spheres in the scene, and its splats' motion."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from splatctrl_cli.config.fixed import ROBOT_REACH
from splatctrl_cli.records import Bool, Box, Float32, Float64, Floats
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.surface import RobotSurface


@dataclass(frozen=True, kw_only=True)
class RobotPosture:
    """The robot's spheres and surface.

    centers (S, 3) [m], world; radii (S,) [m]; T_world_link (S, 4, 4). surface: None if only spheres are known.
    surfaces: by frame stamp [ns], where different from `surface`. T_world_surface: link poses (L, 4, 4) by stamp.
    """

    centers: Float64
    radii: Float64
    T_world_link: Float64
    surface: RobotSurface | None = None
    surfaces: Mapping[int, RobotSurface] = field(default_factory=dict)
    T_world_surface: Mapping[int, Float64] = field(default_factory=dict)
    num_threads: int = 1

    def seen_at(self, stamp_ns: int) -> tuple[RobotSurface, Float64]:
        """Surface at a stamp (else the spheres), and poses (L, 4, 4) of its links."""
        if self.surface is None:
            return RobotSurface.from_balls(self.centers, self.radii), np.eye(4)[None]
        return self.surfaces.get(stamp_ns, self.surface), self.T_world_surface[stamp_ns]

    def distance(
        self,
        points_world: Floats,
        *,
        to_moving: bool = False,
        within: Floats | float = ROBOT_REACH,
        enough: Floats | float = -np.inf,
    ) -> Float64:
        """Signed distance (N,) [m] of points (N, 3) to the robot at the newest stamp, negative inside.

        to_moving: only to links that joints move. within, enough: as in `RobotSurface.distance`.
        """
        surface, T = self.seen_at(max(self.T_world_surface, default=0))
        without = surface.fixed if to_moving else ()
        return surface.distance(
            T, points_world, without=without, within=within, enough=enough, num_threads=self.num_threads
        )

    def is_within(self, points_world: Floats, reach: Floats | float, *, to_moving: bool = False) -> Bool:
        """True for points (N, 3) at a signed distance of at most `reach` (N,) [m]; faster than `distance`."""
        distance = self.distance(points_world, to_moving=to_moving, within=np.maximum(reach, 0.0), enough=reach)
        return np.asarray(distance <= reach)

    def holds(self, points_world: Floats, depth: float) -> Bool:
        """True for points (N, 3) at least `depth` [m] inside a fully drawn robot, where no object is."""
        if self.surface is None or not self.surface.is_drawn:
            return np.zeros(len(points_world), bool)
        return self.is_within(points_world, -depth)


def posture_of(
    robot: RobotModel, q: Float64, at_frames: Mapping[int, Float64], carried: Sequence[tuple[str, Box]] = ()
) -> RobotPosture:
    """The robot at joint positions q (J,).

    at_frames: joint positions (J,) by frame stamp [ns]; carried: boxes in link frames.
    """
    spheres, surface = robot.sphere_set, robot.surface.add_boxes(carried) if carried else robot.surface
    surfaces = {stamp: robot.surface_at(stamp) for stamp in at_frames} if robot.changes else {}
    pose = {link: robot.frame_pose(q, link) for link in set(spheres.links)}
    return RobotPosture(
        centers=robot.sphere_centers(q),
        radii=spheres.radii,
        T_world_link=np.array([pose[link] for link in spheres.links]),
        surface=surface,
        surfaces={stamp: its.add_boxes(carried) if carried else its for stamp, its in surfaces.items()},
        T_world_surface={
            stamp_ns: surface.poses({link: robot.frame_pose(q_frame, link) for link in surface.links})
            for stamp_ns, q_frame in at_frames.items()
        },
    )


POSTURE_NAMES = ("centers", "radii", "T_world_link")  # kept for the next time step


def carry_splats(points: Float32, before: RobotPosture, after: RobotPosture) -> Float32:
    """Move points (N, 3) [m], world, with the link of the nearest sphere surface.

    The paper does not move them.
    """
    gap = np.linalg.norm(points[:, None] - before.centers[None], axis=2) - before.radii
    sphere = np.argmin(np.abs(gap), axis=1)
    T = after.T_world_link @ np.linalg.inv(before.T_world_link)
    return np.asarray(np.einsum("nij,nj->ni", T[sphere, :3, :3], points) + T[sphere, :3, 3], np.float32)
