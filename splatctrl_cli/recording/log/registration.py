"""The tf tree over time, depth registered to the colour camera, and lens undistortion."""

import re
from array import array
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config.fixed import (
    FARTHEST_RAY,
    REGISTERED_SHARE,
    TF_GAP_NS,
    TF_STILL_POSITION,
    TF_STILL_ROTATION,
    WIDEST_RAY,
)
from splatctrl_cli.errors import refuse_if
from splatctrl_cli.files.spilled_rows import RowFile
from splatctrl_cli.geometry import (
    back_project,
    interpolate_transform,
    invert_transform,
    transform_from,
    transform_points,
)
from splatctrl_cli.recording.source_options import NUM_COEFFICIENTS
from splatctrl_cli.records import Bool, Float32, Float64, Intrinsics

STILL_SAMPLES = 1000  # of a transform, by which it counts as still
_Pixel = TypeVar("_Pixel", np.uint8, np.float32)


class _Edge:
    """T_parent_child over time; `numbers` index rows (4, 4) of `transforms`."""

    def __init__(self, parent: str, transforms: RowFile) -> None:
        self.parent = parent
        self.stamps, self.numbers = array("q"), array("q")
        self.static: dict[int, Float64] = {}  # by the stamp [ns] from which on each is valid, ascending
        self.holds = False
        self._transforms = transforms
        self._is_sorted = True

    def add(self, stamp_ns: int, T: Float64) -> None:
        self._is_sorted = self._is_sorted and (not self.stamps or stamp_ns >= self.stamps[-1])
        self.stamps.append(stamp_ns)
        self.numbers.append(len(self._transforms))
        self._transforms.append(T[None])

    def at(self, stamp_ns: int, tolerance_ns: int) -> Float64 | None:
        if self.static:
            since = [stamp for stamp in self.static if stamp <= stamp_ns]
            return self.static[since[-1] if since else next(iter(self.static))]
        if self.holds and len(self.stamps) == 1:
            return self._at(0)
        if not self._is_sorted:
            order = np.argsort(np.frombuffer(self.stamps, dtype=np.int64), kind="stable")
            self.stamps = array("q", np.frombuffer(self.stamps, dtype=np.int64)[order].tobytes())
            self.numbers = array("q", np.frombuffer(self.numbers, dtype=np.int64)[order].tobytes())
            self._is_sorted = True
        after = bisect_left(self.stamps, stamp_ns)
        if after == len(self.stamps):
            return self._at(-1) if stamp_ns - self.stamps[-1] <= tolerance_ns else None
        if self.stamps[after] == stamp_ns:
            return self._at(after)
        if after == 0:
            return self._at(0) if self.stamps[0] - stamp_ns <= tolerance_ns else None
        gap = self.stamps[after] - self.stamps[after - 1]
        T_before, T_after = self._at(after - 1), self._at(after)
        if gap > TF_GAP_NS and not _is_still(T_before, T_after):
            return None
        return interpolate_transform(T_before, T_after, (stamp_ns - self.stamps[after - 1]) / gap)

    def still(self) -> Float64 | None:
        """T_parent_child (4, 4) if it never changes, else None."""
        step = max(1, len(self.stamps) // STILL_SAMPLES)
        poses = iter(self.static.values()) if self.static else map(self._at, range(0, len(self.stamps), step))
        first = next(poses)
        return first if all(_is_still(first, T) for T in poses) else None

    def _at(self, sample: int) -> Float64:
        number = self.numbers[sample]
        return np.asarray(self._transforms.read(number, number + 1)[0])


def _is_still(T_a: Float64, T_b: Float64) -> bool:
    change = np.abs(T_a - T_b)
    return bool(change[:3, 3].max() <= TF_STILL_POSITION and change[:3, :3].max() <= TF_STILL_ROTATION)


class TfTree:
    """Frames by parent; moving edges are interpolated, static ones always valid."""

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}
        self._transforms = RowFile((4, 4))
        self.notes: list[str] = []

    def add(
        self,
        parent: str,
        child: str,
        stamp_ns: int,
        position: Float64,
        quat_xyzw: Float64,
        *,
        static: bool,
        holds: bool = False,
    ) -> None:
        """Add T_parent_child at a stamp.

        holds: valid at any time while its edge has no other. A frame keeps its first parent; edges that would close a
        loop are left out. Differing static transforms are valid from their stamps on, the first also before. These
        cases are noted. Raises ValueError if not rigid (a zero quaternion, NaN).
        """
        parent, child = parent.strip("/"), child.strip("/")
        refuse_if(
            not (np.isfinite(position).all() and 0.5 < float(np.linalg.norm(quat_xyzw)) < 2.0),
            f"transform {parent} -> {child} is not a rigid transform",
            error=ValueError,
        )
        if child not in self._edges and child in self._ancestors(parent):
            self.note(f"tf: {parent} -> {child} would close a loop, as {child} is above {parent}; it is left out")
            return
        edge = self._edges.setdefault(child, _Edge(parent, self._transforms))
        if edge.parent != parent:
            self.note(f"tf: frame {child} has parents {edge.parent} and {parent}; {edge.parent} is kept")
            return
        T = transform_from(position, quat_xyzw)
        edge.holds = edge.holds or holds
        if not static:
            edge.add(stamp_ns, T)
        else:
            before = edge.at(stamp_ns, 0) if edge.static else None
            if before is not None and _is_still(before, T):
                return  # said again
            if before is not None:
                self.note(f"tf: {parent} -> {child} is static and changes; each holds from its stamp on")
            edge.static = dict(sorted((edge.static | {stamp_ns: T}).items()))
        if edge.static and edge.stamps:
            self.note(f"tf: {parent} -> {child} is both static and moving; the static one holds")

    def note(self, note: str) -> None:
        if note not in self.notes:
            self.notes.append(note)

    @property
    def frames(self) -> tuple[str, ...]:
        return tuple(sorted(set(self._edges) | {edge.parent for edge in self._edges.values()}))

    @property
    def roots(self) -> tuple[str, ...]:
        """Frames without a parent, sorted."""
        return tuple(frame for frame in self.frames if frame not in self._edges)

    def root_of(self, frame: str) -> str:
        return self._ancestors(frame)[-1]

    def span_ns(self, frame: str) -> tuple[int, int] | None:
        """Stamps [ns] between which all moving edges above `frame` are known; None if none moves."""
        moving = [edge.stamps for edge in [self._edges[f] for f in self._ancestors(frame)[:-1]] if not edge.static]
        return (max(min(s) for s in moving), min(max(s) for s in moving)) if moving else None

    def connects(self, target: str, source: str) -> bool:
        return self.root_of(target.strip("/")) == self.root_of(source.strip("/"))

    def lookup(self, target: str, source: str, stamp_ns: int, tolerance_ns: int = 0) -> Float64 | None:
        """T_target_source (4, 4) at a time; None if unconnected or unknown then."""
        return self._pose(target.strip("/"), source.strip("/"), lambda edge: edge.at(stamp_ns, tolerance_ns))

    def still_frames(self, target: str) -> dict[str, Float64 | None]:
        """T_target_frame (4, 4) by connected frame; None if it changes."""
        still = cache(_Edge.still)
        return {frame: self._pose(target, frame, still) for frame in self.frames if self.connects(target, frame)}

    def _pose(self, target: str, source: str, of_edge: Callable[[_Edge], Float64 | None]) -> Float64 | None:
        up_target, up_source = self._ancestors(target), self._ancestors(source)
        common = next((frame for frame in up_source if frame in up_target), None)
        if common is None:
            return None
        T_common_source = self._chain(up_source, common, of_edge)
        T_common_target = self._chain(up_target, common, of_edge)
        if T_common_source is None or T_common_target is None:
            return None
        return invert_transform(T_common_target) @ T_common_source

    def _chain(self, ancestors: list[str], top: str, of_edge: Callable[[_Edge], Float64 | None]) -> Float64 | None:
        T = np.eye(4)
        for frame in ancestors[: ancestors.index(top)]:
            T_parent_frame = of_edge(self._edges[frame])
            if T_parent_frame is None:
                return None
            T = T_parent_frame @ T
        return T

    def _ancestors(self, frame: str) -> list[str]:
        chain = [frame]
        while chain[-1] in self._edges and self._edges[chain[-1]].parent not in chain:
            chain.append(self._edges[chain[-1]].parent)
        return chain


DISTORTION_MODELS = ("plumb_bob", "rational_polynomial", "equidistant")
_SEPARATORS = re.compile("[^a-z0-9]")
_SAME_MODELS = {  # other programs' names, in lower case, letters and digits only
    **dict.fromkeys(("plumbbob", "brownconrady", "radtan", "opencv"), "plumb_bob"),
    **dict.fromkeys(("rationalpolynomial", "rational"), "rational_polynomial"),
    **dict.fromkeys(("equidistant", "equi", "fisheye", "opencvfisheye"), "equidistant"),
    **dict.fromkeys(("kannalabrandt", "kannalabrandt4"), "equidistant"),
}
_PINHOLES = ("", "none", "pinhole", "perspective", "rectilinear", "inversebrownconrady", "modifiedbrownconrady")
"""Further models that are pinholes where all coefficients are zero."""


def lens_model(name: str) -> str:
    """One of `DISTORTION_MODELS` for a driver's name; unknown names are unchanged."""
    return _SAME_MODELS.get(_SEPARATORS.sub("", name.lower()), name)


def is_distorted(model: str, coefficients: Float64) -> bool:
    """False for a pinhole; equidistant and unknown models always distort."""
    is_radial = lens_model(model) in DISTORTION_MODELS[:2] or _SEPARATORS.sub("", model.lower()) in _PINHOLES
    return not is_radial or bool(np.any(np.abs(coefficients) > 1e-9))


@dataclass(frozen=True, kw_only=True, eq=False)
class Lens:
    """Corrections of a camera's images.

    intrinsics: of the corrected image. maps (H, W): column and row in the recorded image by pixel, None if images
    stay as recorded. valid (H, W): False where the lens saw nothing (colour is black, depth and labels 0), None if it
    saw all. depth_lens, T_color_depth (4, 4): of depth's own camera, None for depth on colour's pixels.
    """

    intrinsics: Intrinsics
    maps: tuple[Float32, Float32] | None = None
    valid: Bool | None = None
    depth_lens: "Lens | None" = None
    T_color_depth: Float64 | None = None

    def remap(self, image: NDArray[_Pixel], interpolation: int = cv2.INTER_NEAREST) -> NDArray[_Pixel]:
        """Undistort colour (H, W, 3), labels or depth (H, W)."""
        if self.maps is None:
            return image
        return np.asarray(cv2.remap(image, *self.maps, interpolation), dtype=image.dtype)

    def depth(self, image: Float32) -> Float32:
        """Map recorded depth [m] to colour's pixels (H, W)."""
        if self.depth_lens is None or self.T_color_depth is None:
            return self.remap(image)
        return warp_depth(
            self.depth_lens.remap(image), self.depth_lens.intrinsics, self.intrinsics, self.T_color_depth
        )


def warp_depth(depth: Float32, own: Intrinsics, target: Intrinsics, T_color_depth: Float64) -> Float32:
    """Warp depth (H', W') [m] of camera `own` to colour camera `target`, (H, W) [m], 0 = none.

    Each depth pixel fills its square as `target` sees it, so that finer colour pixels get no holes; the nearest depth
    counts.
    """
    x, y, z = transform_points(T_color_depth, back_project(own, depth)[depth > 0]).T
    front = z > 0
    z = z[front]
    u = target.fx * x[front] / z + target.cx
    v = target.fy * y[front] / z + target.cy
    half_u, half_v = 0.5 * max(1.0, target.fx / own.fx), 0.5 * max(1.0, target.fy / own.fy)
    first_u, first_v = np.ceil(u - half_u), np.ceil(v - half_v)
    nearest, depths = np.full(target.height * target.width, np.inf, dtype=np.float32), z.astype(np.float32)
    for dv in range(int(np.floor(2 * half_v)) + 1):
        row = first_v + dv
        is_row = (row < v + half_v) & (row >= 0) & (row < target.height)
        for du in range(int(np.floor(2 * half_u)) + 1):
            column = first_u + du
            lands = is_row & (column < u + half_u) & (column >= 0) & (column < target.width)
            np.minimum.at(nearest, (row[lands] * target.width + column[lands]).astype(np.int64), depths[lands])
    nearest[np.isinf(nearest)] = 0.0
    return nearest.reshape(target.height, target.width)


def undistort_lens(
    result: Intrinsics,
    model: str,
    coefficients: Float64,
    *,
    recorded: Intrinsics | None = None,
    R: Float64 | None = None,
) -> Lens:
    """A lens without its distortion, shown with intrinsics `result`. Raises InputError for an impossible lens.

    recorded: intrinsics of the distorted image, by default `result`. R (3, 3): the lens's axes to the result's.
    """
    R = np.eye(3) if R is None else R
    counts = (4,) if model == "equidistant" else NUM_COEFFICIENTS
    refuse_if(
        len(coefficients) not in counts and not (len(coefficients) > 4 and not np.any(coefficients[4:])),
        f"distortion model {model}: expected {', '.join(map(str, counts))} coefficients, got {len(coefficients)}",
        remedy="calibrate again, or fill up with zeros",
    )
    map_u, map_v = _maps(recorded or result, model, coefficients, R, result)
    is_seen = (map_u >= 0) & (map_u <= result.width - 1) & (map_v >= 0) & (map_v <= result.height - 1)
    x, y, z = np.moveaxis(back_project(result, np.ones((result.height, result.width))) @ R, 2, 0)
    radii = np.where(z > 0, np.hypot(x, y) / np.maximum(z, 1e-9), np.inf)  # (H, W) from the axis, at a depth of one
    r, bent = _bent(model, coefficients)
    folds = np.flatnonzero(np.diff(bent) <= 0)  # beyond the first, the lens would show things twice
    is_seen &= radii < (r[folds[0]] if folds.size else np.inf)
    refuse_if(
        is_seen.mean() < REGISTERED_SHARE,
        f"distortion {model} {np.round(coefficients, 6).tolist()}: the camera saw {is_seen.mean():.0%} of the"
        f" pinhole's image, expected at least {REGISTERED_SHARE:.0%}",
        remedy="correct the calibration, or undistort the images first",
    )
    map_u[~is_seen] = -10.0  # folded back into the image, or outside of it
    return Lens(intrinsics=result, maps=(map_u, map_v), valid=None if is_seen.all() else is_seen)


def _maps(
    lens: Intrinsics, model: str, coefficients: Float64, R: Float64, result: Intrinsics
) -> tuple[Float32, Float32]:
    K, P = (np.array([[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]], dtype=np.float64) for k in (lens, result))
    size = (result.width, result.height)
    maps = (
        cv2.fisheye.initUndistortRectifyMap(K, coefficients[:4], R, P, size, cv2.CV_32FC1)
        if model == "equidistant"
        else cv2.initUndistortRectifyMap(K, coefficients, R, P, size, cv2.CV_32FC1)
    )
    return np.asarray(maps[0]), np.asarray(maps[1])


def _bent(model: str, coefficients: Float64) -> tuple[Float64, Float64]:
    """Undistorted and distorted radii at depth one, in focal lengths."""
    r = np.linspace(0.0, FARTHEST_RAY, 20001)
    k = np.zeros(8)
    k[: min(len(coefficients), 8)] = coefficients[:8]
    if model == "equidistant":
        a = np.arctan(r)
        return r, a * (1 + k[0] * a**2 + k[1] * a**4 + k[2] * a**6 + k[3] * a**8)
    return r, np.asarray(
        r * (1 + k[0] * r**2 + k[1] * r**4 + k[4] * r**6) / (1 + k[5] * r**2 + k[6] * r**4 + k[7] * r**6)
    )


def correct_lens(lens: Intrinsics, model: str, coefficients: Float64, valid: Bool | None = None) -> Lens:
    """A lens's corrections; a pinhole has none but the mask `valid`.

    Focal lengths stay; an equidistant lens's shrink to show its whole image, up to `WIDEST_RAY`. Raises InputError
    for an impossible lens.
    """
    if not is_distorted(model, coefficients):
        return Lens(intrinsics=lens, valid=valid)
    model = lens_model(model)
    refuse_if(
        model not in DISTORTION_MODELS,
        f"distortion model {model!r} is unknown",
        remedy="rectify the images first, or give --intrinsics NAME=FX,FY,CX,CY if they are;"
        f" known models: {', '.join(DISTORTION_MODELS)}",
    )
    if model != "equidistant" or len(coefficients) < 4:
        return undistort_lens(lens, model, coefficients)
    r, bent = _bent(model, coefficients)
    edges = np.array([lens.cx / lens.fx, lens.cy / lens.fy])
    edges = np.append(edges, [(lens.width - 1) / lens.fx - edges[0], (lens.height - 1) / lens.fy - edges[1]])
    grows = slice(1 + int(np.argmax(bent)))
    seen = np.minimum(np.maximum(np.interp(edges, bent[grows], r[grows]), 1e-9), WIDEST_RAY)
    share = min(1.0, float((edges / seen).min()))
    return undistort_lens(replace(lens, fx=share * lens.fx, fy=share * lens.fy), model, coefficients, recorded=lens)
