"""Checks of images: encodings, sizes, depth, and registration of depth to colour by edges."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.checks import limits
from splatctrl_cli.checks.check_times import Thinned
from splatctrl_cli.checks.finding import ERROR, NOTE, WARNING, Finding, error, judge, note
from splatctrl_cli.config.fixed import PLAUSIBLE_DEPTH
from splatctrl_cli.records import MILLIMETRE, Float32, Float64, Intrinsics, RgbdFrame, UInt8

SCALES = (1e-3, 1e-4, 1.0, 1e-2, 2e-4, 1e-5, 1e-6)


@dataclass(frozen=True, kw_only=True)
class Thumbnail:
    """Depth (h, w) [m] at every `stride`-th pixel, or colour (h, w, 3) averaged.

    width, height [px]: of the whole image.
    """

    stamp_ns: int
    stride: int
    width: int
    height: int
    pixels: NDArray[Any]


class ImageWatch:
    """Statistics of a topic's or camera's images, in bounded memory.

    The first `limits.DECODED_IMAGES` are decoded, later images ever fewer. thumbnails: stamp [ns] and image of
    `limits.THUMBNAIL_COLUMNS` columns, depth (h, w) [m] or colour (h, w, 3).
    """

    def __init__(self, where: str, scale: float | None = None) -> None:
        self.where, self.scale = where, scale
        self.count = self.num_decoded = self.num_bad = self.num_without_depth = self.num_invalid = 0
        self.num_repeats, self._last_depth = 0, np.zeros((0, 0), np.float32)
        self.constants: Counter[float] = Counter()  # images by their largest depth, where it is suspicious
        self.first_bad_ns: int | None = None
        self.first_bad = ""
        self.encodings: Counter[str] = Counter()
        self.sizes: Counter[tuple[int, int]] = Counter()
        self.medians: Thinned[float] = Thinned(1000)
        self.shares: Thinned[float] = Thinned(1000)
        self.samples: Thinned[Thumbnail] = Thinned(limits.KEPT_IMAGES)
        self.thumbnails: list[tuple[int, NDArray[Any]]] = []
        self._wanted: Thinned[None] = Thinned(limits.DECODED_IMAGES)

    def is_wanted(self) -> bool:
        """True if the next image is to be decoded; call once each."""
        is_next = self._wanted.is_next()
        if is_next:
            self._wanted.add(None)
        return is_next

    def add_bad(self, stamp_ns: int, reason: str) -> None:
        self.count += 1
        self.num_bad += 1
        if self.first_bad_ns is None:
            self.first_bad_ns, self.first_bad = stamp_ns, reason

    def add_color(self, stamp_ns: int, color: UInt8, encoding: str) -> None:
        """Take a colour image (H, W, 3)."""
        height, width = color.shape[:2]
        stride = stride_of(height)
        size = (-(-width // stride), -(-height // stride))
        self._add(stamp_ns, color, encoding, cv2.INTER_AREA)
        if self.samples.is_next():
            self._keep(stamp_ns, color, np.asarray(cv2.resize(color, size, interpolation=cv2.INTER_AREA), np.uint8))

    def add_depth(self, stamp_ns: int, depth: Float32, encoding: str, num_invalid: int = 0) -> None:
        """Take a depth image (H, W) [m], 0 = none."""
        stride = stride_of(depth.shape[0])
        small = depth[::stride, ::stride]
        valid = small[small > 0]
        self._add(stamp_ns, depth, encoding, cv2.INTER_NEAREST)
        self.num_invalid += num_invalid
        self.num_repeats += bool(depth.any()) and np.array_equal(depth, self._last_depth)
        self._last_depth = depth
        self.num_without_depth += valid.size == 0
        self.constants.update(_constant(valid))
        if self.shares.is_next():
            self.shares.add(valid.size / small.size)
        if self.medians.is_next():
            self.medians.add(float(np.median(valid)) if valid.size else 0.0)
        if self.samples.is_next():
            self._keep(stamp_ns, depth, small.copy())

    def _add(self, stamp_ns: int, image: NDArray[Any], encoding: str, interpolation: int) -> None:
        height, width = image.shape[:2]
        self.add_undecoded(encoding, width, height)
        self.num_decoded += 1
        if len(self.thumbnails) < limits.THUMBNAILS:
            self.thumbnails.append(
                (stamp_ns, cv2.resize(image, thumbnail_size(width, height), interpolation=interpolation))
            )

    def _keep(self, stamp_ns: int, image: NDArray[Any], small: NDArray[Any]) -> None:
        height, width = image.shape[:2]
        self.samples.add(
            Thumbnail(stamp_ns=stamp_ns, stride=stride_of(height), width=width, height=height, pixels=small)
        )

    def rescale(self, scale: float) -> None:
        """Set the scale [m per count] of a log that names it."""
        factor = np.float32(scale / (self.unit or 1.0))
        self.scale = scale
        if factor != 1.0:
            self.constants = Counter({float(value * factor): num for value, num in self.constants.items()})
            self.medians[:] = [float(median * factor) for median in self.medians]
            self.samples[:] = [
                replace(k, pixels=k.pixels * factor) if k.pixels.ndim == 2 else k for k in self.samples
            ]
            self.thumbnails = [(ns, image * factor if image.ndim == 2 else image) for ns, image in self.thumbnails]

    @property
    def is_float(self) -> bool:
        """True if most images are 32FC1."""
        return [name for name, _ in self.encodings.most_common(1)] == ["32FC1"]

    @property
    def unit(self) -> float | None:
        """Metres per count of depth; None for depth in metres."""
        return self.scale if self.scale is not None else None if self.is_float else MILLIMETRE

    def add_undecoded(self, encoding: str, width: int, height: int) -> None:
        self.count += 1
        self.encodings[encoding] += 1
        self.sizes[width, height] += 1


def _constant(depth: Float32) -> list[float]:
    values, counts = np.unique(depth, return_counts=True)
    if len(values) < 2 or counts[-1] < limits.CONSTANT_SHARE * depth.size:
        return []
    is_ahead = values[-1] >= limits.CONSTANT_AHEAD * values[-2]
    is_apart = len(values) > limits.CONSTANT_VALUES and counts[-1] > limits.CONSTANT_RATIO * counts[:-1].max()
    return [float(values[-1])] if is_ahead or is_apart else []


def stride_of(height: int) -> int:
    return max(1, -(-height // limits.KEPT_ROWS))


def thumbnail_size(width: int, height: int) -> tuple[int, int]:
    """Width and height [px]."""
    columns = min(limits.THUMBNAIL_COLUMNS, width)
    return columns, max(1, round(height * columns / width))


def thumbnail_lens(lens: Intrinsics) -> Intrinsics:
    width, height = thumbnail_size(lens.width, lens.height)
    across, down = width / lens.width, height / lens.height
    cx, cy = (lens.cx + 0.5) * across - 0.5, (lens.cy + 0.5) * down - 0.5
    return Intrinsics(fx=lens.fx * across, fy=lens.fy * down, cx=cx, cy=cy, width=width, height=height)


def image_findings(images: ImageWatch) -> list[Finding]:
    where, num_bad = images.where, images.num_bad
    most = [(f"{width}x{height}", num) for (width, height), num in images.sizes.most_common(4)]
    sizes, encodings = (
        ", ".join(f"{kind} ({num})" for kind, num in kinds) for kinds in (most, images.encodings.most_common(4))
    )
    return [
        *judge(
            None if not num_bad else ERROR if num_bad == images.count else WARNING,
            "undecodable",
            where,
            f"{num_bad} of {images.count} images do not decode; the first: {images.first_bad}",
            value=num_bad,
            stamp_ns=images.first_bad_ns,
        ),
        *judge(
            WARNING if len(images.sizes) > 1 else None,
            "image-size",
            where,
            f"the size of the images changes: {sizes}",
        ),
        *judge(
            WARNING if len(images.encodings) > 1 else None,
            "encoding",
            where,
            f"the encoding of the images changes: {encodings}",
            "record one encoding",
        ),
    ]


def sample_findings(topics: Sequence[ImageWatch]) -> list[Finding]:
    few = [images for images in topics if images.num_decoded + images.num_bad < images.count and images.num_decoded]
    decoded, count = sum(images.num_decoded for images in few), sum(images.count for images in few)
    return judge(
        NOTE if few else None,
        "sampled",
        "images",
        f"{decoded} of {count} images were decoded, the first {limits.DECODED_IMAGES} of a topic and"
        " fewer and fewer later; of the others only head, closing mark and checksum were read",
        value=decoded / max(count, 1),
    )


def depth_findings(images: ImageWatch) -> list[Finding]:
    where, num, num_empty = images.where, images.num_decoded, images.num_without_depth
    is_empty = 0 < num_empty == num
    findings = judge(
        None if not num_empty else ERROR if is_empty else WARNING,
        "depth-empty",
        where,
        f"{'all' if is_empty else num_empty} of {num} depth images hold no depth at all",
        value=num_empty,
    )
    if is_empty:
        return findings
    share = float(np.median(images.shares))
    ((constant, times),) = images.constants.most_common(1) or [(0.0, 0)]
    is_code = times and times >= limits.CONSTANT_IMAGES * num
    return [
        *findings,
        *judge(
            None if share >= limits.SOME_DEPTH else WARNING if share < limits.LITTLE_DEPTH else NOTE,
            "depth-share",
            where,
            f"{100 * share:.0f} % of the pixels have depth (median of the images)",
            value=share,
        ),
        *judge(
            NOTE if images.num_invalid else None,
            "depth-invalid",
            where,
            f"{images.num_invalid} depth pixels of {num} images are NaN, infinite, negative or 65535"
            " (or a like code): they count as none",
            value=images.num_invalid,
        ),
        *judge(
            WARNING if is_code else None,
            "depth-constant",
            where,
            f"many pixels are exactly {constant:.6g} m, the largest depth of {times} of {num} images: a code for no"
            " return?",
            value=constant,
            unit="m",
        ),
        *judge(
            WARNING if images.num_repeats else None,
            "depth-repeats",
            where,
            f"{images.num_repeats} of {num} depth images equal the one before to the bit",
            value=images.num_repeats,
        ),
        *_scale(images),
    ]


def _scale(images: ImageWatch) -> list[Finding]:
    medians = [median for median in images.medians if median > 0]
    median, used = float(np.median(medians)) if medians else 0.0, images.unit or 1.0
    (low, high), (near, far), counts = PLAUSIBLE_DEPTH, limits.TABLE_DEPTH, median / used
    if not medians or near <= median <= far:
        return []
    if low <= median <= high:
        text = f"median depth {median:.3g} m, read as {used:g} m per count: unusual for a robot's table"
        return [note("depth-scale", images.where, text, "if it is wrong, give --depth-scale", value=median, unit="m")]
    fits = [s for s in SCALES if near <= counts * s <= far]
    is_large, is_small = images.is_float and counts > high, not images.is_float and counts < 20
    guess = "; millimetres stored as floats?" if is_large else "; metres stored as integers?" if is_small else ""
    text = f"median depth {median:.4g} m, read as {used:g} m per count: expected {low:g} to {high:g} m{guess}"
    remedy = f"give --depth-scale {fits[0]:g}" if fits else "give the right --depth-scale [m per count]"
    return [error("depth-scale", images.where, text, remedy, value=median, unit="m")]


def alignment_findings(frames: Sequence[RgbdFrame]) -> list[Finding]:
    edges = {
        camera: [_spectra(f) for f in its[:: max(1, len(its) // limits.EDGE_FRAMES)][: limits.EDGE_FRAMES]]
        for camera in sorted({frame.camera for frame in frames})
        if (its := [frame for frame in frames if frame.camera == camera and frame.color.any()])
    }
    findings: list[Finding] = []
    others: dict[str, tuple[str, float, float]] = {}
    for camera, spectra in edges.items():
        surface = _correlate(spectra)
        dv, du, peak, runner_up = _peak(surface)
        width = surface.shape[1]
        if max(peak, 0.0) >= limits.EDGE_CLEAR and peak >= limits.EDGE_AHEAD * runner_up:
            if max(abs(du), abs(dv)) > max(limits.EDGE_SHIFT * width, limits.EDGE_AROUND):
                share = 100 * max(abs(du), abs(dv)) / width
                findings.append(
                    error(
                        "alignment",
                        f"camera {camera}",
                        f"depth edges lie {-du:+d} px across and {-dv:+d} px down from colour edges in images {width}"
                        f" px wide ({share:.1f} % of the width, correlation {peak:.2f} there): depth is not"
                        " registered to colour",
                        "record depth aligned to colour, or with its own frame and CameraInfo, that ingest may"
                        " register it",
                        value=max(abs(du), abs(dv)),
                        unit="px",
                    )
                )
        elif (other := _other(camera, edges, _extrapolate_to_zero(surface))) is not None:
            others[camera] = other
    for camera, (name, own, peak) in others.items():
        findings += judge(
            ERROR if name in others else WARNING,  # an exchange has two sides
            "alignment",
            f"camera {camera}",
            f"its colour edges meet the depth edges of camera {name} (correlation {peak:.2f}), not its own"
            f" ({own:.2f})",
            "exchange the depth topics, with --camera NAME=COLOR,DEPTH",
            value=own,
        )
    return findings


def _other(
    camera: str, edges: dict[str, list[tuple[Float64, Float64]]], own: float
) -> tuple[str, float, float] | None:
    pairs = {name: list(zip(edges[camera], its, strict=False)) for name, its in edges.items() if name != camera}
    scores = {
        name: _extrapolate_to_zero(_correlate([(a[0], b[1]) for a, b in its]))
        for name, its in pairs.items()
        if all(a[0].shape == b[1].shape for a, b in its)
    }
    best = max(scores, key=lambda name: scores[name], default=None)
    is_clear = best is not None and scores[best] >= max(limits.EDGE_CLEAR, 2 * own)
    return (best, own, scores[best]) if best is not None and is_clear else None


def _spectra(frame: RgbdFrame) -> tuple[Float64, Float64]:
    """Spectra of colour and depth edges, of mean 0 and length 1."""
    gray = cv2.GaussianBlur(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1.0)
    slope = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1))
    slope = np.minimum(slope, np.percentile(slope, 95))
    around = np.ones((5, 5), np.uint8)
    far = cv2.dilate(frame.depth, around)
    near = cv2.erode(np.where(frame.depth > 0, frame.depth, np.float32(1e9)), around)
    is_edge = (far - near > limits.EDGE_STEP * near) & (near < 1e8)
    is_edge[: limits.EDGE_BORDER] = is_edge[-limits.EDGE_BORDER :] = False
    is_edge[:, : limits.EDGE_BORDER] = is_edge[:, -limits.EDGE_BORDER :] = False
    return _transform(slope), _transform(is_edge.astype(np.float32))


def _transform(image: Float32) -> Float64:
    centred = (image - image.mean()) * np.outer(
        np.hanning(image.shape[0]) ** 0.25, np.hanning(image.shape[1]) ** 0.25
    )
    length = float(np.linalg.norm(centred))
    return np.asarray(np.fft.rfft2(centred / length if length > 0 else centred))


def _correlate(edges: Sequence[tuple[Float64, Float64]]) -> Float64:
    surfaces = [np.fft.fftshift(np.fft.irfft2(color * np.conj(depth))) for color, depth in edges]
    return np.asarray(np.mean(surfaces, axis=0))


def _peak(surface: Float64) -> tuple[int, int, float, float]:
    """Best shift [rows], [columns], its correlation, and the best correlation away from it."""
    height, width = surface.shape
    rows, columns = height // limits.EDGE_SEARCHED, width // limits.EDGE_SEARCHED
    near = surface[
        height // 2 - rows : height // 2 + rows + 1, width // 2 - columns : width // 2 + columns + 1
    ].copy()
    v, u = np.unravel_index(int(np.argmax(near)), near.shape)
    peak = float(near[v, u])
    wide = 2 * limits.EDGE_AROUND
    near[max(0, v - wide) : v + wide + 1, max(0, u - wide) : u + wide + 1] = -1.0
    return int(v) - rows, int(u) - columns, peak, float(near.max())


def _extrapolate_to_zero(surface: Float64) -> float:
    v, u, wide = surface.shape[0] // 2, surface.shape[1] // 2, limits.EDGE_AROUND
    return float(surface[v - wide : v + wide + 1, u - wide : u + wide + 1].max())
