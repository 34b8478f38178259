"""A fixed budget of splat slots; dead slots stay transparent until reused."""

from dataclasses import dataclass

import numpy as np

from splatctrl_cli.config.fixed import DEAD_LOGIT
from splatctrl_cli.kernels.raster import Moments, unpack_parameters
from splatctrl_cli.records import (
    Bool,
    Columns,
    Float32,
    Float64,
    Floats,
    Index,
    Label,
    SplatSet,
    UInt8,
    UInt16,
    Values,
)

BACKDROP = 0b11  # one more label: a slot that is only rendered
CENTER, LOG_RADIUS, COLOR, LOGIT = slice(0, 3), 3, slice(4, 7), 7


@dataclass(frozen=True, kw_only=True)
class Seeds(Columns):
    """New splats: centers (K, 3) [m] world, radii (K,) [m], colors (K, 3) in [0, 1].

    A candidate's radius is its pixel's size D/f [m].
    """

    centers: Float32
    radii: Float32
    colors: Float32


@dataclass(frozen=True, kw_only=True)
class Filled:
    """Seeds that got a fresh slot, a reused slot, or none."""

    added: int = 0
    relocated: int = 0
    unmet: int = 0

    def __add__(self, other: "Filled") -> "Filled":
        return Filled(
            added=self.added + other.added, relocated=self.relocated + other.relocated, unmet=self.unmet + other.unmet
        )


class SplatBuffer:
    """M slots; arrays change in place and never grow."""

    def __init__(self, max_splats: int) -> None:
        self.parameters: Float32 = np.zeros((max_splats, 8), np.float32)
        self.parameters[:, LOGIT] = DEAD_LOGIT
        self.moments = Moments(
            first=np.zeros((max_splats, 8), np.float32),
            second=np.zeros((max_splats, 8), np.float32),
            num_steps=np.zeros(max_splats, np.uint32),
        )
        self.is_alive: Bool = np.zeros(max_splats, bool)
        self.was_used: Bool = np.zeros(max_splats, bool)
        self.labels: UInt8 = np.zeros(max_splats, np.uint8)
        self.num_uncertain: UInt16 = np.zeros(max_splats, np.uint16)

    @property
    def centers(self) -> Float32:
        """(M, 3) [m], world; a view."""
        return self.parameters[:, CENTER]

    @property
    def opacities(self) -> Float32:
        """(M,) in (0, 1)."""
        return np.asarray(1.0 / (1.0 + np.exp(-self.parameters[:, LOGIT])), np.float32)

    @property
    def radii(self) -> Float32:
        """(M,) [m]."""
        return np.asarray(np.exp(self.parameters[:, LOG_RADIUS]), np.float32)

    def kill(self, slots: Bool) -> int:
        """Make slots of a mask (M,) dead and reusable; return their number."""
        self.is_alive[slots] = False
        self.parameters[slots, LOGIT] = DEAD_LOGIT
        self.labels[slots] = Label.OBJECT
        self._reset(np.flatnonzero(slots))
        return int(np.count_nonzero(slots))

    def set_radius(self, slots: Index, radius: Floats | float) -> None:
        """Set radii (K,) [m] of slots (K,)."""
        self.parameters[slots, LOG_RADIUS] = np.log(radius)

    def fill(self, seeds: Seeds, opacity: float, keep_free: int = 0, label: int = Label.OBJECT) -> Filled:
        """Put seeds into dead slots, in slot order, with `opacity` and `label`.

        The last `keep_free` dead slots stay free. Seeds without a slot are unmet.
        """
        dead = np.flatnonzero(~self.is_alive)
        slots = dead[: max(min(len(seeds), len(dead) - keep_free), 0)]
        count = len(slots)
        self.parameters[slots, CENTER] = seeds.centers[:count]
        self.parameters[slots, LOG_RADIUS] = np.log(seeds.radii[:count])
        self.parameters[slots, COLOR] = seeds.colors[:count]
        self.parameters[slots, LOGIT] = np.log(opacity / (1.0 - opacity))
        num_reused = int(self.was_used[slots].sum())
        self.is_alive[slots] = True
        self.was_used[slots] = True
        self.labels[slots] = label
        self._reset(slots)
        return Filled(added=count - num_reused, relocated=num_reused, unmet=len(seeds) - count)

    def copy(self, sources: Index, opacities: Float64, radii: Float64) -> int:
        """Copy slots `sources` (K,), with repetitions, into available dead slots; return their number.

        opacities (M,), radii (M,) [m]: new ones of sources and copies. Labels are copied; moments restart.
        """
        slots = np.flatnonzero(~self.is_alive)[: len(sources)]
        sources = sources[: len(slots)]
        changed = np.unique(sources)
        self.parameters[changed, LOG_RADIUS] = np.log(radii[changed])
        self.parameters[changed, LOGIT] = np.log(opacities[changed] / (1.0 - opacities[changed]))
        self.parameters[slots] = self.parameters[sources]
        self.labels[slots] = self.labels[sources]
        self.is_alive[slots] = True
        self.was_used[slots] = True
        self._reset(np.concatenate([changed, slots]))
        return len(slots)

    def _reset(self, slots: Index) -> None:
        self.moments.first[slots] = 0.0
        self.moments.second[slots] = 0.0
        self.moments.num_steps[slots] = 0
        self.num_uncertain[slots] = 0

    @property
    def is_mapped(self) -> Bool:
        """Live slots (M,), without the backdrop."""
        return np.asarray(self.is_alive & (self.labels != BACKDROP))

    def splats(self, num_threads: int, slots: Bool | None = None) -> SplatSet:
        """Splats of `slots` (M,), by default `is_mapped`, in slot order."""
        centers, radii, colors, opacities = unpack_parameters(self.parameters, num_threads)
        alive = self.is_mapped if slots is None else slots
        return SplatSet(
            centers=centers[alive],
            radii=radii[alive],
            colors=colors[alive],
            opacities=opacities[alive],
            labels=self.labels[alive],
            density=np.zeros(int(alive.sum()), np.float32),
        )

    def arrays(self) -> dict[str, Values]:
        return {
            "parameters": self.parameters,
            "first_moment": self.moments.first,
            "second_moment": self.moments.second,
            "num_steps": self.moments.num_steps,
            "is_alive": self.is_alive,
            "was_used": self.was_used,
            "labels": self.labels,
            "num_uncertain": self.num_uncertain,
        }
