"""The one seam between control and kinematics."""

from collections.abc import Callable, Collection, Mapping
from typing import Protocol

from splatctrl_cli.kernels.chain import Chain
from splatctrl_cli.records import Bool, Float64, Floats, Integers, SphereSet


class ArmModel(Protocol):
    """A kinematic chain with collision spheres; `splatctrl_cli.robot.model.RobotModel` documents its members.

    J joints, S spheres; positions [m] and poses in world. chain: None if only the methods know the kinematics.
    """

    joint_names: tuple[str, ...]
    lower: Float64
    upper: Float64
    middle: Float64
    velocity_limit: Float64
    base_position: Float64
    sphere_set: SphereSet
    moving_spheres: Bool
    sphere_deficit: Float64

    @property
    def chain(self) -> Chain | None: ...

    @property
    def self_allowance(self) -> Float64: ...

    def sphere_centers(self, q: Float64) -> Float64: ...

    def sphere_centers_batch(self, q: Float64) -> Float64: ...

    def spheres_at(self, q: Float64) -> tuple[Float64, Float64]: ...

    def frame_pose(self, q: Float64, frame: str) -> Float64: ...

    def frame_jacobian(self, q: Float64, frame: str) -> Float64: ...

    def lever_arms(self) -> Float64: ...

    def self_pairs(self) -> Integers: ...

    def surface_gaps(
        self,
        positions: Float64,
        centers: Floats,
        radii: Floats,
        links: Collection[str] | None = None,
    ) -> Mapping[str, Float64]: ...

    @property
    def link_distances(self) -> Mapping[str, Callable[[Float64, Bool | None], Float64]]: ...

    def reach(self) -> float: ...


def sphere_names(spheres: SphereSet) -> tuple[str, ...]:
    """Return each sphere's link and number on it: ``panda_hand[2]``."""
    seen: dict[str, int] = {}
    names = []
    for link in spheres.links:
        seen[link] = seen.get(link, -1) + 1
        names.append(f"{link}[{seen[link]}]")
    return tuple(names)
