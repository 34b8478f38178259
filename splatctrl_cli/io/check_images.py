"""What images hold: whether they decode, their encodings and sizes, how much depth and how far."""

from collections import Counter
from dataclasses import dataclass, replace

import cv2
import numpy as np

from splatctrl_cli.io.finding import Finding, Thinned, error, note, warning
from splatctrl_cli.io.shot import PLAUSIBLE_DEPTH
from splatctrl_cli.records import Float32, Intrinsics, UInt8

ROWS = 240  # that a kept depth image has at most
NUM_KEPT = 8  # depth images of a camera
COLUMNS = 64  # of a thumbnail, as motion is judged by (state_motion)
NUM_THUMBNAILS = 300
LITTLE_DEPTH, SOME_DEPTH = 0.10, 0.5  # of the pixels
SCALES = (1e-3, 1e-4, 1.0, 1e-2, 2e-4, 1e-5, 1e-6)
TABLE_DEPTH = (0.15, 8.0)  # [m] between which a median is no surprise


@dataclass(frozen=True, kw_only=True)
class KeptDepth:
    """Every `stride`-th pixel of a depth image (h, w) [m]."""

    stamp_ns: int
    depth: Float32
    stride: int


@dataclass(frozen=True, kw_only=True)
class Thumbnail:
    """An image of `COLUMNS` columns: depth (h, w) [m] or colour (h, w, 3)."""

    stamp_ns: int
    depth: Float32 | None = None
    color: UInt8 | None = None


class ImageWatch:
    """Watches the images of one topic or camera in bounded memory."""

    def __init__(self, where: str, scale: float | None = None) -> None:
        self.where, self.scale = where, scale
        self.count = self.num_bad = self.num_without_depth = self.num_invalid = 0
        self.first_bad_ns: int | None = None
        self.first_bad = ""
        self.encodings: Counter[str] = Counter()
        self.sizes: Counter[tuple[int, int]] = Counter()
        self.medians: Thinned[float] = Thinned(1000)
        self.shares: Thinned[float] = Thinned(1000)
        self.kept: Thinned[KeptDepth] = Thinned(NUM_KEPT)
        self.thumbnails: list[Thumbnail] = []

    def add_bad(self, stamp_ns: int, reason: str) -> None:
        """An image that does not decode."""
        self.count += 1
        self.num_bad += 1
        if self.first_bad_ns is None:
            self.first_bad_ns, self.first_bad = stamp_ns, reason

    def add_color(self, stamp_ns: int, color: UInt8, encoding: str) -> None:
        """A colour image (H, W, 3)."""
        self._add(encoding, color.shape[1], color.shape[0])
        if len(self.thumbnails) < NUM_THUMBNAILS:
            small = cv2.resize(color, thumbnail_size(color.shape[1], color.shape[0]), interpolation=cv2.INTER_AREA)
            self.thumbnails.append(Thumbnail(stamp_ns=stamp_ns, color=np.asarray(small, dtype=np.uint8)))

    def add_depth(self, stamp_ns: int, depth: Float32, encoding: str, num_invalid: int = 0) -> None:
        """A depth image (H, W) [m], 0 = none."""
        self._add(encoding, depth.shape[1], depth.shape[0])
        self.num_invalid += num_invalid
        stride = max(1, -(-depth.shape[0] // ROWS))
        small = depth[::stride, ::stride]
        valid = small[small > 0]
        if self.shares.is_next():
            self.shares.add(valid.size / small.size)
        self.num_without_depth += valid.size == 0
        if self.medians.is_next():
            self.medians.add(float(np.median(valid)) if valid.size else 0.0)
        if self.kept.is_next():
            self.kept.add(KeptDepth(stamp_ns=stamp_ns, depth=small.copy(), stride=stride))
        if len(self.thumbnails) < NUM_THUMBNAILS:
            size = thumbnail_size(depth.shape[1], depth.shape[0])
            thumbnail = np.asarray(cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST), dtype=np.float32)
            self.thumbnails.append(Thumbnail(stamp_ns=stamp_ns, depth=thumbnail))

    def add_other(self, encoding: str, width: int, height: int) -> None:
        """An image of an encoding that is not read."""
        self._add(encoding, width, height)

    def _add(self, encoding: str, width: int, height: int) -> None:
        self.count += 1
        self.encodings[encoding] += 1
        self.sizes[width, height] += 1


def thumbnail_size(width: int, height: int) -> tuple[int, int]:
    """Width and height [px]."""
    columns = min(COLUMNS, width)
    return columns, max(1, round(height * columns / width))


def thumbnail_lens(lens: Intrinsics) -> Intrinsics:
    """The camera of a thumbnail."""
    width, height = thumbnail_size(lens.width, lens.height)
    across, down = width / lens.width, height / lens.height
    cx, cy = (lens.cx + 0.5) * across - 0.5, (lens.cy + 0.5) * down - 0.5
    return Intrinsics(fx=lens.fx * across, fy=lens.fy * down, cx=cx, cy=cy, width=width, height=height)


def strided_lens(lens: Intrinsics, kept: KeptDepth) -> Intrinsics:
    """The camera of a kept depth image: pixel (0, 0) stays where it was."""
    height, width = kept.depth.shape
    s = kept.stride
    strided = replace(lens, fx=lens.fx / s, fy=lens.fy / s, cx=lens.cx / s, cy=lens.cy / s)
    return replace(strided, width=width, height=height)


def image_findings(images: ImageWatch) -> list[Finding]:
    """What is wrong with the images, depth apart."""
    where, found = images.where, []
    if images.num_bad:
        text = f"{images.num_bad} of {images.count} images do not decode; the first: {images.first_bad}"
        severity = error if images.num_bad == images.count else warning
        remedy = "they are left out; copy the file again, or look at the recorder"
        figure = {"value": images.num_bad, "stamp_ns": images.first_bad_ns}
        found.append(severity("undecodable", where, text, remedy, **figure))
    if len(images.sizes) > 1:
        sizes = ", ".join(f"{w}x{h} ({n})" for (w, h), n in images.sizes.most_common(4))
        remedy = "record one size; frames of another than the CameraInfo's are refused"
        found.append(error("image-size", where, f"the size of the images changes: {sizes}", remedy))
    if len(images.encodings) > 1:
        kinds = ", ".join(f"{name} ({n})" for name, n in images.encodings.most_common(4))
        text = f"the encoding of the images changes: {kinds}"
        found.append(warning("encoding", where, text, "record one encoding"))
    return found


def depth_findings(images: ImageWatch) -> list[Finding]:
    """Whether depth is there, and at a plausible distance."""
    where, found = images.where, []
    if images.num_without_depth:
        every = images.num_without_depth == images.count
        text = f"{'all' if every else images.num_without_depth} of {images.count} depth images hold no depth at all"
        severity = error if every else warning
        remedy = "is the projector on, and the scene within its range?"
        found.append(severity("depth-empty", where, text, remedy, value=images.num_without_depth))
        if every:
            return found
    share = float(np.median(list(images.shares)))
    if share < SOME_DEPTH:
        severity = warning if share < LITTLE_DEPTH else note
        text = f"{100 * share:.0f} % of the pixels have depth (median of the images)"
        remedy = "the rest stays unseen: dark or shiny things, too near, or warped depth with holes"
        found.append(severity("depth-share", where, text, remedy, value=share))
    if images.num_invalid:
        text = f"{images.num_invalid} depth pixels are NaN, infinite or negative: they count as none"
        found.append(note("depth-invalid", where, text, value=images.num_invalid))
    return [*found, *_scale(images)]


def _scale(images: ImageWatch) -> list[Finding]:
    medians = [median for median in images.medians if median > 0]
    if not medians:
        return []
    median = float(np.median(medians))
    encoding = images.encodings.most_common(1)[0][0]
    used = images.scale if images.scale is not None else 1.0 if encoding == "32FC1" else 1e-3
    low, high = PLAUSIBLE_DEPTH
    if low <= median <= high:
        near, far = TABLE_DEPTH
        if near <= median <= far:
            return []
        text = f"median depth {median:.3g} m, read as {used:g} m per count: unusual for a robot's table"
        remedy = "if it is wrong, give --depth-scale"
        return [note("depth-scale", images.where, text, remedy, value=median, unit="m")]
    counts = median / used
    fits = [s for s in SCALES if TABLE_DEPTH[0] <= counts * s <= TABLE_DEPTH[1]]
    guess = "millimetres stored as floats" if encoding == "32FC1" and counts > high else ""
    guess = "metres stored as integers" if encoding != "32FC1" and counts < 20 else guess
    text = f"median depth {median:.4g} m, read as {used:g} m per count: expected {low:g} to {high:g} m"
    text += f"; {guess}?" if guess else ""
    remedy = f"give --depth-scale {fits[0]:g}" if fits else "give the right --depth-scale [m per count]"
    return [error("depth-scale", images.where, text, remedy, value=median, unit="m")]
