"""Views to score, visibility by training cameras, and similarity of images."""

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d, uniform_filter

from splatctrl_cli.config.fixed import SSIM_BOX, SSIM_BOX_RANGE, SSIM_C1, SSIM_C2, SSIM_SIGMA, SSIM_WINDOW
from splatctrl_cli.geometry import back_project, invert_transform, project, transform_points
from splatctrl_cli.records import Bool, Float32, Float64, Index, RecordSource, RgbdFrame


@dataclass(frozen=True, kw_only=True)
class View:
    """A frame to score, its name, and the training frames known at its time.

    The name is the camera and a count of its views (without a clock, of all frames) or the stamp.
    """

    name: str
    frame: RgbdFrame
    training: tuple[RgbdFrame, ...]


def views_to_score(
    source: RecordSource,
    *,
    scoring: Collection[str],
    training: Collection[str],
    has_clock: bool,
    numbered_by_stamp: bool = False,
    corrected: Callable[[RgbdFrame], RgbdFrame] = lambda frame: frame,
) -> Iterator[View]:
    """The frames of the `scoring` cameras in time order.

    With a clock, each training camera's newest frame up to the view's stamp is known; without, all its frames.
    corrected: gives a frame training's pose, exposure and depth.
    """
    if not has_clock:
        known = tuple(corrected(frame) for frame in frames_of(source) if frame.camera in training)
        for number, frame in enumerate(frames_of(source)):
            if frame.camera in scoring:
                name = _name(frame.camera, frame.stamp_ns if numbered_by_stamp else number)
                yield View(name=name, frame=frame, training=known)
        return
    counts: Counter[str] = Counter()
    newest: dict[str, RgbdFrame] = {}
    for _, recorded in groupby(frames_of(source), key=attrgetter("stamp_ns")):
        moment = [corrected(frame) for frame in recorded]
        newest |= {frame.camera: frame for frame in moment if frame.camera in training}
        for frame in moment:
            if frame.camera in scoring:
                name = _name(frame.camera, counts[frame.camera])
                yield View(name=name, frame=frame, training=tuple(newest.values()))
                counts[frame.camera] += 1


def _name(camera: str, number: int) -> str:
    return f"{camera.strip('/').replace('/', '_')}-{number:04d}"


def frames_of(source: RecordSource) -> Iterator[RgbdFrame]:
    return (record for record in source.records() if isinstance(record, RgbdFrame))


def seen_by(points_world: NDArray[np.floating], frames: Iterable[RgbdFrame], tolerance: float = 0.02) -> Bool:
    """True (Q,) for points (Q, 3) [m] at which a frame measured a surface.

    The nearest pixel's depth agrees within `tolerance` [m]: the point is neither occluded nor in free space.
    """
    seen = np.zeros(len(points_world), dtype=np.bool_)
    for frame in frames:
        unseen = np.flatnonzero(~seen)
        if not len(unseen):
            break
        landing, own, measured = measured_along(points_world[unseen], frame)
        seen[unseen[landing]] = (measured > 0) & (np.abs(measured - own) <= tolerance)
    return seen


def surface_points(frame: RgbdFrame) -> tuple[Float64, Bool]:
    """World points (Q, 3) [m] of pixels with depth, and their mask (H, W)."""
    valid = frame.depth > 0
    return transform_points(frame.T_world_camera, back_project(frame.intrinsics, frame.depth)[valid]), valid


def seen_pixels(frame: RgbdFrame, others: Sequence[RgbdFrame], tolerance: float = 0.02) -> Bool:
    """True (H, W) where one of `others` measured the frame's surface."""
    points_world, seen = surface_points(frame)
    center = frame.T_world_camera[:3, 3]
    nearest = sorted(others, key=lambda other: float(np.linalg.norm(other.T_world_camera[:3, 3] - center)))
    seen[seen] = seen_by(points_world, nearest, tolerance)
    return seen


def measured_along(points_world: NDArray[np.floating], frame: RgbdFrame) -> tuple[Index, Float64, Float32]:
    """Indices (K,) of points (Q, 3) in the image; their depth and the measured one (K,) [m]."""
    points_camera = transform_points(invert_transform(frame.T_world_camera), points_world)
    landing = np.flatnonzero(points_camera[:, 2] > 1e-6)
    pixels = np.floor(project(frame.intrinsics, points_camera[landing]) + 0.5)
    height, width = frame.depth.shape
    inside = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
    u, v = pixels[inside].astype(np.int64).T
    landing = landing[inside]
    return landing, points_camera[landing, 2], frame.depth[v, u]


def psnr(image: NDArray[np.floating], reference: NDArray[np.floating], mask: Bool | None = None) -> float:
    """Peak signal-to-noise ratio [dB] for a peak of 1: ``-10 log10(mean squared error)``.

    image, reference (H, W, 3) in [0, 1]; mask (H, W): pixels that count, None = all. inf for identical images, nan
    for an empty mask.
    """
    squared = np.square(image.astype(np.float64) - reference)
    selected = squared if mask is None else squared[mask]
    if not selected.size:
        return math.nan
    error = float(selected.mean())
    return math.inf if error == 0 else -10.0 * math.log10(error)


def ssim_map(
    image: NDArray[np.floating], reference: NDArray[np.floating], *, is_zero_padded: bool = False
) -> Float64:
    """Structural similarity (H, W, 3) of images in [0, 1] (Wang et al. 2004).

    Gaussian window 11×11, sigma 1.5, C1 = 0.01², C2 = 0.03², population moments. The border is mirrored, with its
    edge pixel repeated; zero-padding (graphdeco-inria/gaussian-splatting, utils/loss_utils.py) hides errors there.
    """
    x, y = image.astype(np.float64), np.asarray(reference, dtype=np.float64)
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = (
        _window_mean(picture, "constant" if is_zero_padded else "reflect") for picture in (x, y, x * x, y * y, x * y)
    )
    variance_x, variance_y = mean_xx - mean_x**2, mean_yy - mean_y**2
    covariance = mean_xy - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + SSIM_C1) / (mean_x**2 + mean_y**2 + SSIM_C1)
    structure = (2 * covariance + SSIM_C2) / (variance_x + variance_y + SSIM_C2)
    return np.asarray(luminance * structure)


def published_ssim(image: NDArray[np.floating], reference: NDArray[np.floating], mask: Bool, fill: float) -> float:
    """SSIM of images in [0, 1], `fill` outside the mask, as in NeRF's papers.

    scikit-image's default (skimage/metrics/_structural_similarity.py before 0.20): box window of 7 pixels, sample
    moments, 3 border pixels left out. Its data range of 2 for floats raises the figure: compare it only with such
    figures. nan below 7 pixels, or for an empty mask.
    """
    if min(mask.shape) < SSIM_BOX or not mask.any():
        return math.nan
    x, y = (np.where(mask[:, :, None], picture, fill).astype(np.float64) for picture in (image, reference))
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = (
        uniform_filter(picture, size=(SSIM_BOX, SSIM_BOX, 1)) for picture in (x, y, x * x, y * y, x * y)
    )
    sample = SSIM_BOX**2 / (SSIM_BOX**2 - 1)
    variance_x, variance_y = sample * (mean_xx - mean_x**2), sample * (mean_yy - mean_y**2)
    covariance = sample * (mean_xy - mean_x * mean_y)
    c1, c2 = (0.01 * SSIM_BOX_RANGE) ** 2, (0.03 * SSIM_BOX_RANGE) ** 2
    similarity = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    similarity /= (mean_x**2 + mean_y**2 + c1) * (variance_x + variance_y + c2)
    border = SSIM_BOX // 2
    return float(similarity[border:-border, border:-border].mean())


def depth_errors(
    depth: NDArray[np.floating], reference: NDArray[np.floating], mask: Bool | None = None
) -> dict[str, float]:
    """Absolute errors of `depth` [m] against `reference` [m], where both are above 0 in the mask.

    depth_median, depth_mean, depth_p90 [m]; depth_within_1cm and depth_within_2cm are shares; nan without a pixel.
    """
    both = (depth > 0) & (reference > 0)
    if mask is not None:
        both &= mask
    errors = np.abs(depth[both].astype(np.float64) - reference[both])
    is_empty = not errors.size
    return {
        "depth_pixels": int(errors.size),
        "depth_median": math.nan if is_empty else float(np.median(errors)),
        "depth_mean": math.nan if is_empty else float(errors.mean()),
        "depth_p90": math.nan if is_empty else float(np.percentile(errors, 90)),
        "depth_within_1cm": math.nan if is_empty else float(np.mean(errors <= 0.01)),
        "depth_within_2cm": math.nan if is_empty else float(np.mean(errors <= 0.02)),
    }


def _window_mean(image: Float64, border: Literal["reflect", "constant"]) -> Float64:
    offsets = np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2
    weights = np.exp(-0.5 * (offsets / SSIM_SIGMA) ** 2)
    weights /= weights.sum()
    return np.asarray(correlate1d(correlate1d(image, weights, axis=0, mode=border), weights, axis=1, mode=border))
