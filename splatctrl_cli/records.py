"""Plain records shared by rooms. SI units, world frame, stamps in int nanoseconds.

N splats, Q queries, S spheres, J joints, (X, Y, Z) voxels, (H, W) pixels.
"""

import heapq
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum
from operator import attrgetter
from typing import Any, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config.ranges import MAX_PLACE
from splatctrl_cli.errors import UsageError, refuse_if

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]
UInt16 = NDArray[np.uint16]
Bool = NDArray[np.bool_]
Index = NDArray[np.int64]
Floats = NDArray[np.floating]
Integers = NDArray[np.integer]
Values = NDArray[np.generic]
Array = NDArray[Any]
Stamps = NDArray[np.int64]  # (T,) [ns]
Posture = Callable[[int], Float64 | None]  # joint positions (J,) at a time [ns], or None
SECOND_NS = 1_000_000_000
MILLIMETRE, MILLIMETRES = 0.001, 1000.0  # [m], and [1/m]


class FloatRows(Sized, Iterable[Any], Protocol):
    """Rows (T, ...) of float64 by number, slice or index (K,), in memory or a file."""

    @property
    def shape(self) -> tuple[int, ...]:
        """(T, ...)."""

    def __getitem__(self, which: Any, /) -> Any:
        """A row, or rows of a slice or an index."""


class Label(IntEnum):
    """Two-bit entity labels of a splat or voxel (III-C)."""

    OBJECT = 0b00
    ROBOT = 0b01
    HUMAN = 0b10


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """Pinhole camera; pixel (0, 0) has its centre at u = v = 0 (ROS, OpenCV).

    A camera-frame point (x right, y down, z forward) projects to ``u = fx x / z + cx, v = fy y / z + cy`` [px].
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


@dataclass(frozen=True, kw_only=True)
class RgbdFrame:
    """A colour image with registered depth and pose.

    color (H, W, 3) uint8 RGB. depth (H, W) float32 [m] along the optical axis, 0 = no return. T_world_camera (4, 4)
    float64, of the optical frame (z forward). human (H, W) uint8, nonzero on people, or None. valid (H, W), False
    outside the lens's view, None if all valid. Invalid pixels have no colour; their depth is not drawn or scored.
    """

    stamp_ns: int
    camera: str
    color: UInt8
    depth: Float32
    intrinsics: Intrinsics
    T_world_camera: Float64
    human: UInt8 | None = None
    valid: Bool | None = None

    @property
    def is_in_view(self) -> Bool:
        """`valid` (H, W), True everywhere if None."""
        return np.ones(self.depth.shape, bool) if self.valid is None else self.valid


@dataclass(frozen=True, kw_only=True)
class JointState:
    """Joint positions (J,) float64 [rad or m] and velocities (J,) float64 [1/s], in source order.

    Where logged: commanded_velocity (J,) [1/s], and the robot's own end-effector pose (4, 4), in base or world frame.
    """

    stamp_ns: int
    position: Float64
    velocity: Float64
    commanded_velocity: Float64 | None = None
    T_base_ee: Float64 | None = None
    T_world_ee: Float64 | None = None


Record = RgbdFrame | JointState


Item = TypeVar("Item")


def spread(items: Sequence[Item], most: int) -> list[Item]:
    """Choose `most` items or fewer, in order, evenly spread."""
    return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, min(len(items), most)).astype(int))]


def merge_by_stamp(*streams: Iterable[Item]) -> Iterator[Item]:
    """Merge sorted streams by stamp; at equal stamps, earlier streams come first."""
    return heapq.merge(*streams, key=attrgetter("stamp_ns"))


@dataclass(kw_only=True)
class LossReport:
    """Losses of an input: `damaged` sets exit code 3, the rest is only counted.

    duplicate_images: images of a stamp that their topic had before. dropped_images: images missing from a topic of
    steady rate. invalid_depth: pixels with NaN, infinite, negative or 65535 counts, read as no return.
    differentiated_velocities: states with a velocity from positions. unsorted_states, duplicate_states: states whose
    stamp goes back or repeats. conflicting_states: duplicates with other positions. state_gaps: times without states.
    """

    unpaired_color: int = 0
    unpaired_depth: int = 0
    without_pose: int = 0
    without_intrinsics: int = 0
    duplicate_images: int = 0
    dropped_images: int = 0
    damaged: int = 0
    invalid_depth: int = 0
    differentiated_velocities: int = 0
    unsorted_states: int = 0
    duplicate_states: int = 0
    conflicting_states: int = 0
    state_gaps: int = 0
    notes: list[str] = field(default_factory=list)

    def plus(self, other: "LossReport", notes: list[str], sign: int = 1) -> "LossReport":
        """Sum of both counts (sign -1: the difference), with these notes."""
        names = [column.name for column in fields(self) if column.name != "notes"]
        return LossReport(**{name: getattr(self, name) + sign * getattr(other, name) for name in names}, notes=notes)


class RecordSource(Protocol):
    """A recorded dataset as records in time order."""

    name: str  # of the file or folder
    cameras: tuple[str, ...]
    joint_names: tuple[str, ...]  # in the order of the states
    has_clock: bool  # False for invented stamps (static views)

    @property
    def loss(self) -> LossReport:
        """Complete once `records` is exhausted."""

    def records(self) -> Iterator[Record]:
        """Yield records by stamp; joint states precede frames of the same stamp."""

    def digests(self) -> dict[str, str]:
        """Sha256 of every input file, by name."""


@dataclass(frozen=True, kw_only=True)
class Columns:
    """Arrays with one row per item (N), and numbers for all items.

    The first field is an array.
    """

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    def joined(self, *others: Self) -> Self:
        """Return these items, then the others', with these numbers."""
        names = self._names()
        return replace(self, **{n: np.concatenate([getattr(one, n) for one in (self, *others)]) for n in names})

    def select(self, which: Bool | NDArray[np.integer] | slice) -> Self:
        """Items of a mask (N,), an index (K,) or a slice."""
        return replace(self, **{name: getattr(self, name)[which] for name in self._names()})

    def _names(self) -> list[str]:
        return [column.name for column in fields(self) if np.ndim(getattr(self, column.name))]


@dataclass(frozen=True, kw_only=True)
class SplatSet(Columns):
    """Isotropic 3D Gaussians (III-B).

    centers (N, 3) float32 [m], world; radii (N,) float32 [m] (sigma); colors (N, 3) float32 in [0, 1]; opacities (N,)
    float32 in (0, 1); labels (N,) uint8 (`Label`); density (N,) float32, rho of III-D (0 if not computed).
    """

    centers: Float32
    radii: Float32
    colors: Float32
    opacities: Float32
    labels: UInt8
    density: Float32


@dataclass(frozen=True, kw_only=True)
class GaussianSet(Columns):
    """Anisotropic 3D Gaussians with view-dependent colour, as in 3D Gaussian splatting.

    centers (N, 3) float32 [m], world; scales (N, 3) float32 [m], sigmas along own axes; quats_wxyz (N, 4) float32,
    unit, own axes to world; opacities (N,) float32 in (0, 1); harmonics (N, K, 3) float32, real spherical harmonics
    of RGB, degree 0 to 3 (K = 1, 4, 9, 16; colour is 0.5 + their sum); labels (N,) uint8 (`Label`).
    """

    centers: Float32
    scales: Float32
    quats_wxyz: Float32
    opacities: Float32
    harmonics: Float32
    labels: UInt8


@dataclass(frozen=True, kw_only=True)
class PointCloud(Columns):
    """Coloured points: points (K, 3) float32 [m], world; colors (K, 3) float32 in [0, 1]."""

    points: Float32
    colors: Float32


@dataclass(frozen=True, kw_only=True)
class Box:
    """Axis-aligned box: lower, upper (3,) float64 [m], world."""

    lower: Float64
    upper: Float64

    @classmethod
    def from_text(cls, text: str) -> "Box":
        """Parse ``x0,y0,z0,x1,y1,z1``. Raises UsageError unless within 1000 km, lower below upper."""
        try:
            values = np.array([float(part) for part in text.split(",")])
        except ValueError:
            values = np.empty(0)
        refuse_if(
            values.shape != (6,) or not (np.abs(values) <= MAX_PLACE).all() or not np.all(values[:3] < values[3:]),
            f"--box {text}: expected finite x0,y0,z0,x1,y1,z1 [m] with x0 < x1, y0 < y1, z0 < z1, within 1e6",
            error=UsageError,
        )
        return cls(lower=values[:3], upper=values[3:])

    def contains(self, points_world: NDArray[np.floating]) -> Bool:
        """True (...,) for points (..., 3) inside, borders included."""
        inside = np.ones(points_world.shape[:-1], bool)
        for axis in range(3):  # a reduction over an axis of three is slow
            inside &= (points_world[..., axis] >= self.lower[axis]) & (points_world[..., axis] <= self.upper[axis])
        return inside


@dataclass(frozen=True, kw_only=True)
class SphereSet:
    """Collision spheres: centers (S, 3) [m] in the frame of links[s], radii (S,) [m]."""

    links: tuple[str, ...]
    centers: Float64
    radii: Float64


class DistanceField(Protocol):
    """Signed distance to the scene, positive outside."""

    def query(self, points: Float64) -> tuple[Float64, Float64]:
        """Distance (Q,) [m] at points (Q, 3) [m], world, and its gradient (Q, 3).

        The gradient is not normalised.
        """


@dataclass(frozen=True, kw_only=True)
class DistanceGrid:
    """A baked field; cell (i, j, k) is centred at ``origin + voxel * (i, j, k)``, world [m].

    channels: `sdf` (X, Y, Z) float32 [m]; `hard` (X, Y, Z) float32 [m], exact distance to the spheres; `gpdf` (X, Y,
    Z) float32 [m]; `gradient` (X, Y, Z, 3) float32; `observed` (X, Y, Z) uint8 (`VoxelState`). header: sign, frame,
    units, kernel, length scale, digests.
    """

    origin: Float64
    voxel: float
    channels: dict[str, NDArray[np.generic]]
    header: dict[str, object]
