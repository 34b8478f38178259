"""The controller's view of a robot: the one seam between control and kinematics."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.kernels.chain import Chain
from splatctrl_cli.records import Bool, Float64, SphereSet


class ArmModel(Protocol):
    """A kinematic chain with collision spheres, such as `splatctrl_cli.robot.model.RobotModel`.

    J joints, S spheres; positions [m] and poses in world. sphere_deficit (S,) [m]: largest distance of the sphere's
    body's surface outside the spheres, NaN if not measured. lever_arms (S, J): bound on a sphere's travel [m] per
    radian (or metre). self_allowance (P,) [m]: margin shortfall of each of `self_pairs`. surface_gaps: clearance (T,)
    [m] of meshed links at postures (T, J). link_distances: of meshed links, signed distance (Q,) [m] of points (Q,
    3), link frame, some (Q,) known to be outside. chain: for the kernels, None if only methods know.
    """

    @property
    def chain(self) -> Chain | None: ...

    @property
    def joint_names(self) -> Sequence[str]: ...

    @property
    def lower(self) -> Float64: ...

    @property
    def upper(self) -> Float64: ...

    @property
    def velocity_limit(self) -> Float64: ...

    @property
    def sphere_set(self) -> SphereSet: ...

    @property
    def moving_spheres(self) -> Bool: ...

    @property
    def sphere_deficit(self) -> Float64: ...

    @property
    def self_allowance(self) -> Float64: ...

    @property
    def middle(self) -> Float64: ...

    @property
    def base_position(self) -> Float64: ...

    def sphere_centers(self, q: Float64) -> Float64: ...

    def sphere_centers_batch(self, q: Float64) -> Float64: ...

    def spheres_at(self, q: Float64) -> tuple[Float64, Float64]: ...

    def frame_pose(self, q: Float64, frame: str) -> Float64: ...

    def frame_jacobian(self, q: Float64, frame: str) -> Float64: ...

    def lever_arms(self) -> Float64: ...

    def self_pairs(self) -> NDArray[np.integer]: ...

    def surface_gaps(
        self,
        positions: Float64,
        centers: NDArray[np.floating],
        radii: NDArray[np.floating],
        links: Collection[str] | None = None,
    ) -> Mapping[str, Float64]: ...

    @property
    def link_distances(self) -> Mapping[str, Callable[[Float64, Bool | None], Float64]]: ...

    def reach(self) -> float: ...


def sphere_names(spheres: SphereSet) -> tuple[str, ...]:
    """Return each sphere's link and number within it: ``panda_hand[2]``."""
    seen: dict[str, int] = {}
    names = []
    for link in spheres.links:
        seen[link] = seen.get(link, -1) + 1
        names.append(f"{link}[{seen[link]}]")
    return tuple(names)
