"""The faults of a run: in sensors, clocks, logs, the robot's model and the settings."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from splatctrl_cli.geometry import rotation_from_quat
from splatctrl_cli.records import Float64, SphereSet
from splatctrl_cli.simulate.arm import JOINTS, SHAPES, Block, Capsule, arm_urdf, covering_spheres

NUM_JOINTS = len(JOINTS)


@dataclass(frozen=True, kw_only=True)
class Fault:
    """All faults, none by default. By camera name: depth_scale and depth_bias [m] of its depth; pose (6,) [m, rad],
    the error of its recorded pose; clock [s], the delay of its stamps.

    lost: (camera, frame) without images. blind: (camera, frame) without depth. lost_states: from, to [s] without
    joint states. dark: share of the target's pixels without depth. speckle: these pixels are scattered, not in blobs.
    max_range [m] of the depth camera. edge [m]: steps of depth next to which edge_share of the pixels are lost.
    latency [s] of the map. order, offset [rad], in_degrees: of logged joint positions. spheres_kept: share of the
    model's spheres. spheres_shrunk [m]. longer: joint, and error [m] of the model's link. max_splats. repeated: frame
    from which every camera's last depth repeats, and its colour, too (repeats_color). beyond [m]: error of the
    target's depth. instead [m]: depth written for missing depth on the target.
    """

    depth_scale: Mapping[str, float] = field(default_factory=dict)
    depth_bias: Mapping[str, float] = field(default_factory=dict)
    pose: Mapping[str, Float64] = field(default_factory=dict)
    clock: Mapping[str, float] = field(default_factory=dict)
    lost: frozenset[tuple[str, int]] = frozenset()
    blind: frozenset[tuple[str, int]] = frozenset()
    lost_states: tuple[float, float] | None = None
    dark: float = 0.0
    speckle: bool = False
    max_range: float = 3.0
    edge: float = 0.10
    edge_share: float = 0.35  # a pixel of these images is a centimetre: most edges run beside its middle
    latency: float = 0.0
    order: tuple[int, ...] = tuple(range(NUM_JOINTS))
    offset: tuple[float, ...] = (0.0,) * NUM_JOINTS
    in_degrees: bool = False
    spheres_kept: float = 1.0
    spheres_shrunk: float = 0.0
    longer: tuple[int, float] | None = None
    max_splats: int | None = None
    repeated: int | None = None
    repeats_color: bool = True
    beyond: float = 0.0
    instead: float | None = None

    def logged(self, q: Float64) -> Float64:
        """What a log says (T, J) of true joint positions (T, J)."""
        said = q[:, list(self.order)] + np.array(self.offset)
        return np.asarray(np.rad2deg(said) if self.in_degrees else said)

    def true_of(self, logged: Float64) -> Float64:
        """The true joint positions (T, J) behind logged ones, or of commands in a log's terms."""
        said = np.deg2rad(logged) if self.in_degrees else logged
        q = np.empty_like(said)
        q[:, list(self.order)] = said - np.array(self.offset)
        return q

    def recorded_pose(self, camera: str, T_world_camera: Float64) -> Float64:
        """The pose (4, 4) that the log has of a camera."""
        if camera not in self.pose:
            return T_world_camera
        error = self.pose[camera]
        angle = float(np.linalg.norm(error[3:]))
        axis = error[3:] / angle if angle > 0 else np.array([0.0, 0.0, 1.0])
        turn = np.eye(4)
        turn[:3, :3] = rotation_from_quat([*(axis * np.sin(angle / 2)), np.cos(angle / 2)])
        T = T_world_camera @ turn
        T[:3, 3] += error[:3]
        return T

    @property
    def is_beyond(self) -> bool:
        """Whether the target is measured behind its place."""
        return self.beyond > 0 or self.instead is not None

    @property
    def is_of_model(self) -> bool:
        """Whether the model or the logged joints lie."""
        return (
            self.longer is not None
            or self.in_degrees
            or any(self.offset)
            or self.order != tuple(range(NUM_JOINTS))
            or self.spheres_kept < 1
            or self.spheres_shrunk > 0
        )

    def urdf(self, visual: Mapping[str, tuple[Capsule | Block, ...]] = SHAPES) -> str:
        """The URDF that the tool is given, of an arm that is seen by `visual` shapes."""
        text = arm_urdf(visual)
        if self.longer is None:
            return text
        joint, by = self.longer
        xyz = np.array(JOINTS[joint][1])
        axis = int(np.argmax(np.abs(xyz)))
        grown = xyz.copy()
        grown[axis] += by * np.sign(xyz[axis])
        old, new = (" ".join(f"{value + 0.0:.12g}" for value in values) for values in (xyz, grown))
        head, name, tail = text.partition(f'<joint name="{JOINTS[joint][0]}"')
        assert f'xyz="{old}"' in tail, (joint, old)
        return head + name + tail.replace(f'xyz="{old}"', f'xyz="{new}"', 1)

    def spheres(self, rng: np.random.Generator) -> SphereSet:
        """The spheres that the tool is given: at least one a link."""
        links: list[str] = []
        centers: list[Float64] = []
        radii: list[float] = []
        for link, shapes in SHAPES.items():
            cover = covering_spheres(shapes)
            kept = rng.random(len(cover)) < self.spheres_kept
            kept[int(rng.integers(len(cover)))] = True
            for (center, radius), is_kept in zip(cover, kept, strict=True):
                if is_kept:
                    links.append(link)
                    centers.append(center)
                    radii.append(max(radius - self.spheres_shrunk, 0.005))
        return SphereSet(links=tuple(links), centers=np.array(centers), radii=np.array(radii))


def spheres_yaml(spheres: SphereSet) -> str:
    """A sphere set in cuRobo's layout."""
    lines = ["collision_spheres:"]
    for link in dict.fromkeys(spheres.links):
        lines.append(f"  {link}:")
        for name, center, radius in zip(spheres.links, spheres.centers, spheres.radii, strict=True):
            if name == link:
                row = ", ".join(f"{value:.4f}" for value in center + 0.0)
                lines.append(f"    - {{center: [{row}], radius: {radius:.4f}}}")
    return "\n".join(lines) + "\n"
