"""The robot as the cameras see it: where its links are at a time, and how far depth lies from their surface."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.calibration.unknowns import twist_between
from splatctrl_cli.calibration.views import bend, surface_normals, tiles_of
from splatctrl_cli.config import fixed
from splatctrl_cli.geometry import back_project, invert_transform, transform_points
from splatctrl_cli.logs.state_columns import StateColumns
from splatctrl_cli.records import Bool, Float32, Float64, Index, Intrinsics
from splatctrl_cli.robot.model import RobotModel

REMEMBERED = 1024  # times, at which the links' poses are kept: the rounds after the clock is found ask for the same
STEP_NS = 10_000_000  # [ns] before and after, from which a velocity is taken: less than the time between two states


@dataclass(frozen=True, kw_only=True)
class ArmRows:
    """Distances of M measured points from the robot's surface: residual (M,) [m], positive outside; jacobian (M, 6)
    by a turn and a move of the camera in its own frame; clock (M,) [m/s], the derivative by the clock; points and
    normals (M, 3), in the camera's frame; links, tiles (M,). num_seen: pixels that should show the robot's surface;
    num_hidden: of these, those that show something by more than `width` before it.
    """

    residual: Float64
    jacobian: Float64
    clock: Float64
    points: Float64
    normals: Float64
    links: NDArray[np.int64]
    tiles: Index
    num_seen: int
    num_hidden: int


class Arm:
    """A robot with the joint states of a recording, in the model's order of joints."""

    def __init__(self, model: RobotModel, states: StateColumns) -> None:
        self.model = model
        self.surface = model.surface
        self._posture = states.postures(fixed.STATES_CLOSE_NS)
        self._vague = np.array(sorted(self.surface.vague), dtype=np.int64)
        self.surface_poses = lru_cache(maxsize=REMEMBERED)(self._surface_poses)

    def is_posed(self, stamp_ns: int) -> bool:
        """Whether joint states are near a time [ns]."""
        return self._posture(stamp_ns) is not None

    def link_pose(self, link: str, stamp_ns: int) -> Float64 | None:
        """T_world_link (4, 4) at a time of the joint states; None where they are too far away."""
        q = self._posture(stamp_ns)
        return None if q is None else self.model.frame_pose(q, link)

    def _surface_poses(self, stamp_ns: int) -> Float64 | None:
        """T_world_link (L, 4, 4) of the surface's links, likewise."""
        q = self._posture(stamp_ns)
        if q is None:
            return None
        return self.surface.poses({link: self.model.frame_pose(q, link) for link in self.surface.links})

    def rows(
        self,
        depth: Float32,
        lens: Intrinsics,
        T_world_camera: Float64,
        camera_twist: Float64,
        stamp_ns: int,
        width: float,
    ) -> ArmRows | None:
        """Of the pixels (H, W) [m] that show the robot as it was at a time [ns] of the joint states, no farther than
        `width` [m] from its rendered surface; None where its joints are not known then.

        camera_twist (6,) [1/s]: how the camera moves with the clock, in its own frame. Pixels at the border of a
        link, and links that spheres or boxes stand for, do not count.
        """
        poses, before, after = (self.surface_poses(stamp_ns + step) for step in (0, -STEP_NS, STEP_NS))
        if poses is None:
            return None
        shown = self.surface.render(poses, lens, T_world_camera, depth)
        part, corner = _around(shown.link >= 0)
        near, links, depths = shown.depth[part], shown.link[part], depth[part]
        cut = replace(lens, cx=lens.cx - corner[1], cy=lens.cy - corner[0], width=near.shape[1], height=near.shape[0])
        surface = back_project(cut, near)
        normals = surface_normals(surface)
        is_used = _inside_links(links, near) & np.any(normals != 0, axis=-1) & (depths > 0)
        is_used &= ~np.isin(links, self._vague)
        facing = -np.einsum("hwi,hwi->hw", normals, surface)
        is_used &= facing > fixed.CALIBRATION_FACING * np.linalg.norm(surface, axis=-1)
        v, u = np.nonzero(is_used & (np.abs(depths - near) < width))
        normal, seen, link = normals[v, u], surface[v, u], links[v, u].astype(np.int64)
        points = seen * (depths[v, u] / near[v, u].astype(np.float64))[:, None]
        jacobian = np.hstack([np.cross(points, normal), normal])
        moving = np.zeros(len(points))
        if before is not None and after is not None:
            velocity = _velocities(before, after, poses, T_world_camera)  # of the links, in the camera's frame
            speed = np.einsum("kij,kj->ki", velocity[link][:, :3, :3], seen) + velocity[link][:, :3, 3]
            moving = np.einsum("ki,ki->k", normal, speed)  # a later clock takes an earlier surface
        return ArmRows(
            residual=np.einsum("ki,ki->k", normal, points - seen),
            jacobian=jacobian,
            clock=moving + jacobian @ camera_twist,
            points=points,
            normals=normal,
            links=link,
            tiles=tiles_of((v + corner[0]) * depth.shape[1] + u + corner[1], depth.shape),
            num_seen=int(is_used.sum()),
            num_hidden=int(np.count_nonzero(is_used & (depths < near - width))),
        )

    def mount_of(self, poses: list[tuple[int, Float64]]) -> tuple[str, Float64] | None:
        """The link that a camera with these stamps [ns] and recorded T_world_camera rides on, and T_link_camera; None
        where it rides on none.
        """
        for link in reversed(self.model.frame_names):
            mounted = [(self.link_pose(link, stamp), T) for stamp, T in poses]
            offsets = np.array([invert_transform(at) @ T for at, T in mounted if at is not None])
            if len(offsets) < max(2, len(poses) // 2):
                continue
            middle = offsets[len(offsets) // 2]
            if np.abs(offsets - middle).max() < fixed.CALIBRATION_MOUNT:
                return link, middle
        return None

    def travel(self, stamps: list[int]) -> float:
        """How far [m] any of the robot's links is from where it is first, at some of these times."""
        places = []
        for stamp in stamps:
            poses = self.surface_poses(stamp)
            if poses is not None:
                places.append(np.concatenate([poses[:, :3, 3], transform_points_each(poses, 0.1 * np.eye(3))]))
        if len(places) < 2:
            return 0.0
        return float(np.linalg.norm(np.array(places) - places[0], axis=2).max())


def transform_points_each(T: Float64, points: Float64) -> Float64:
    """Points (K, 3) moved by each of L transforms (L, 4, 4): (L K, 3)."""
    return np.concatenate([transform_points(one, points) for one in T])


def _velocities(before: Float64, after: Float64, poses: Float64, T_world_camera: Float64) -> Float64:
    """(L, 4, 4): what a point fixed to a link moves by in a second, in the camera's frame."""
    T_camera_world = invert_transform(T_world_camera)
    moved = [T_camera_world @ at @ np.linalg.inv(poses) @ T_world_camera for at in (before, after)]
    return np.asarray((moved[1] - moved[0]) / (2e-9 * STEP_NS))


def _around(shows: Bool) -> tuple[tuple[slice, slice], tuple[int, int]]:
    """The part (rows, columns) of an image that shows something, with a border of one pixel, and its corner."""
    rows, columns = (np.flatnonzero(shows.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return (slice(0, 3), slice(0, 3)), (0, 0)
    v, u = max(int(rows[0]) - 1, 0), max(int(columns[0]) - 1, 0)
    return (slice(v, int(rows[-1]) + 2), slice(u, int(columns[-1]) + 2)), (v, u)


def _inside_links(link: NDArray[np.int16], depth: Float32) -> Bool:
    """Pixels whose four neighbours show the same link, and no edge of it between them."""
    inside = np.zeros(link.shape, np.bool_)
    middle = link[1:-1, 1:-1]
    around = (link[1:-1, 2:], link[1:-1, :-2], link[2:, 1:-1], link[:-2, 1:-1])
    is_same = np.logical_and.reduce([middle == other for other in around])
    inside[1:-1, 1:-1] = (middle >= 0) & is_same
    return np.asarray(inside & (bend(depth) < fixed.CALIBRATION_BEND * depth))


def twist_by_clock(T_before: Float64, T_after: Float64) -> Float64:
    """How a camera moves with the clock (6,) [1/s], from where it is a step before and after: a later clock takes an
    earlier pose.
    """
    return np.asarray(twist_between(T_after, T_before) / (2e-9 * STEP_NS))
