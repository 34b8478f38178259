"""The robot's self-model: parts that move with its links beyond the URDF."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Self

import numpy as np

from splatctrl_cli.errors import refuse_if
from splatctrl_cli.records import Array, Float32, Float64, UInt8
from splatctrl_cli.robot.coverage import areas
from splatctrl_cli.robot.surface import RobotSurface

ALWAYS = (int(np.iinfo(np.int64).min), int(np.iinfo(np.int64).max))  # [ns]
BOUNDS = ("start_ns", "end_ns", "first_ns")  # missing from files of earlier versions


@dataclass(frozen=True, kw_only=True)
class LearnedLink:
    """A link's parts beyond its visual surface: permanent, or a grasped object.

    They last from start_ns to end_ns [ns], `ALWAYS` if unbounded. origin (3,) [m], link frame: first cell's centre;
    voxel [m]; distance (X, Y, Z) float32 [m], NaN if unknown; configurations (X, Y, Z) uint8: number with a surface;
    triangles (F, 3, 3) [m], link frame: the parts' closed surfaces. outside_95, outside_most [m]: protrusion of 95 %
    of their cells, and the largest, at place (3,) [m]; since [s]: from the first frame until they were knowable.
    Without parts, protrusions are 0, place and since NaN. first_ns [ns]: first frame.
    """

    link: str
    origin: Float64
    voxel: float
    distance: Float32
    configurations: UInt8
    triangles: Float64
    outside_95: float
    outside_most: float
    place: Float64
    since: float
    num_pixels: int
    num_configurations: int
    start_ns: int = ALWAYS[0]
    end_ns: int = ALWAYS[1]
    first_ns: int = 0

    def words(self, first_ns: int) -> str:
        """Link's part, its times [s] after a stamp [ns] and protrusion, in words."""
        start, end = (f"{1e-9 * (stamp - first_ns):.2f}" for stamp in (self.start_ns, self.end_ns))
        until = f" until {end} s" if self.end_ns != ALWAYS[1] else ""
        if self.start_ns != ALWAYS[0]:
            until = f" from {start} to {end} s" if until else f" from {start} s on"
        what = "has a part" if self.is_always else "holds an object"
        return f"{self.link} {what}{until} that protrudes by {1e3 * self.outside_most:.0f} mm"

    @property
    def is_always(self) -> bool:
        return (self.start_ns, self.end_ns) == ALWAYS

    @property
    def area(self) -> float:
        """Area [m^2] of the triangles."""
        return float(areas(self.triangles).sum())


@dataclass(frozen=True, kw_only=True)
class SelfModel:
    """The robot's links, digest of its visual geometry, and learned parts.

    unknown: links not learned, and why.
    """

    links: tuple[str, ...]
    digest: str
    learned: tuple[LearnedLink, ...]
    unknown: Mapping[str, str]

    def pieces(self) -> list[tuple[str, Float64]]:
        """Links and triangles (F, 3, 3) [m], link frame, of permanent parts."""
        return [(part.link, part.triangles) for part in self.learned if part.is_always and len(part.triangles)]

    @property
    def temporary(self) -> list[LearnedLink]:
        return [part for part in self.learned if not part.is_always and len(part.triangles)]

    def held_at(self, stamp_ns: int) -> list[tuple[str, Float64]]:
        """Temporary parts at a stamp [ns]."""
        return [(part.link, part.triangles) for part in self.temporary if part.start_ns <= stamp_ns < part.end_ns]

    @property
    def parts(self) -> list[LearnedLink]:
        return [part for part in self.learned if len(part.triangles)]

    def changes(self) -> list[int]:
        """Stamps [ns], in order, at which `held_at` may change."""
        return sorted({stamp for part in self.temporary for stamp in (part.start_ns, part.end_ns)} - set(ALWAYS))

    def arrays(self) -> dict[str, Array]:
        """All fields by name, for a file."""
        keys = [f"{part.link} {number}" for number, part in enumerate(self.learned)]
        rows = zip(keys, self.learned, strict=True)
        return {
            "links": np.array(self.links),
            "digest": np.array(self.digest),
            "learned": np.array(keys, dtype=np.str_),
            "unknown": np.array(list(self.unknown.items()), dtype=np.str_).reshape(-1, 2),
            **{f"{key}.{f.name}": np.array(getattr(part, f.name)) for key, part in rows for f in fields(part)},
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Any]) -> Self:
        """Read `arrays`. Raises KeyError, TypeError or ValueError for other arrays."""
        names = [field.name for field in fields(LearnedLink)]
        rows = [
            {name: arrays[f"{key}.{name}"] for name in names if f"{key}.{name}" in arrays or name not in BOUNDS}
            for key in arrays["learned"]
        ]
        learned = [LearnedLink(**{k: v if v.ndim else v.item() for k, v in row.items()}) for row in rows]
        for part in learned:
            refuse_if(
                part.triangles.shape[1:] != (3, 3) or not np.isfinite(part.triangles).all(),
                f"triangles of {part.link}: expected finite (F, 3, 3), got {part.triangles.shape}",
                error=ValueError,
            )
        links, unknown = tuple(map(str, arrays["links"])), {str(link): str(why) for link, why in arrays["unknown"]}
        return cls(links=links, digest=str(arrays["digest"]), learned=tuple(learned), unknown=unknown)

    def check_robot(self, surface: RobotSurface, links: Sequence[str], path: Path) -> None:
        """Raise InputError if file `path` belongs to a robot with other links or visual surface."""
        other = ", ".join(sorted(set(self.links) ^ set(links))[:4])
        difference = f"one of the two lacks {other}" if other else "its visual geometry differs"
        refuse_if(
            other or self.digest != surface_digest(surface),
            f"{path}: self-model of another robot: {difference}",
            remedy="learn it again with this URDF, or give the robot that it was learned for",
        )


def surface_digest(surface: RobotSurface) -> str:
    """Sha256 of the links' geometry, except links that spheres replace."""
    digest = hashlib.sha256()
    for number, link in enumerate(surface.links):
        if link not in surface.by_spheres:
            solids = [a[surface.solid_links == number] for a in (surface.kinds, surface.sizes, surface.T_link_solid)]
            parts = [*solids, surface.triangles[surface.triangle_links == number]]
            digest.update(link.encode() + b"".join(np.round(part, 7).tobytes() for part in parts))
    return digest.hexdigest()
