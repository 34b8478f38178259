"""How far a rendered image is from a photo, over the pixels that a mask selects: PSNR, SSIM, depth errors, and LPIPS
(Zhang et al. 2018), in NumPy, from weights that a person gives. None come with this program.

A file of weights is what the package lpips of its authors holds, as plain arrays:

    import lpips, numpy
    model = lpips.LPIPS(net="alex")  # or "vgg"
    numpy.savez("lpips_alex.npz", **{name: value.numpy() for name, value in model.state_dict().items()})
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d, uniform_filter

from splatctrl_cli.config.fixed import SSIM_BOX, SSIM_BOX_RANGE, SSIM_C1, SSIM_C2, SSIM_SIGMA, SSIM_WINDOW
from splatctrl_cli.errors import InputError
from splatctrl_cli.records import Bool, Float32, Float64


@dataclass(frozen=True, kw_only=True)
class DepthErrors:
    """Absolute depth errors over `num_pixels` pixels where both images have a depth; nan where there are none.

    median, mean, p90 [m]; within_1cm and within_2cm are shares of those pixels.
    """

    num_pixels: int
    median: float
    mean: float
    p90: float
    within_1cm: float
    within_2cm: float


def psnr(image: NDArray[np.floating], reference: NDArray[np.floating], mask: Bool | None = None) -> float:
    """Peak signal-to-noise ratio [dB] for a peak of 1: ``-10 log10(mean squared error)`` of the masked pixels.

    image, reference (H, W, 3) in [0, 1]; mask (H, W), None = all. Pixels outside the mask count in neither sum nor
    share. Identical images give inf, an empty mask nan.
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
    """Structural similarity (H, W, 3) per pixel and channel of images (H, W, 3) in [0, 1] (Wang et al. 2004).

    Gaussian window 11×11, sigma 1.5, C1 = 0.01², C2 = 0.03², population moments; at the border the image is mirrored
    with its edge pixel repeated, or continued with zeros, as 3D Gaussian splatting has it
    (graphdeco-inria/gaussian-splatting, utils/loss_utils.py), which hides errors there.
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


def ssim(image: NDArray[np.floating], reference: NDArray[np.floating], mask: Bool | None = None) -> float:
    """Mean of `ssim_map` over channels and the masked pixels; nan for an empty mask.

    The mask selects from the map: a window near the mask's border also sees pixels outside it.
    """
    similarity = ssim_map(image, reference)
    selected = similarity if mask is None else similarity[mask]
    return float(selected.mean()) if selected.size else math.nan


def filled(image: NDArray[np.floating], mask: Bool, fill: float) -> Float64:
    """The image (H, W, 3) with `fill` outside the mask (H, W)."""
    return np.where(mask[:, :, None], image, fill).astype(np.float64)


def published_ssim(image: NDArray[np.floating], reference: NDArray[np.floating], mask: Bool, fill: float) -> float:
    """SSIM of images (H, W, 3) in [0, 1] that are `fill` outside the mask (H, W), as NeRF's papers print it.

    They call scikit-image with its defaults (skimage/metrics/_structural_similarity.py before 0.20): box window of
    7 pixels, sample moments, the data range of floats taken as 2, and a border of 3 pixels left out of the mean.
    That range lifts the figure: compare it only with figures of the same kind. nan for images below 7 pixels and for
    an empty mask.
    """
    if min(mask.shape) < SSIM_BOX or not mask.any():
        return math.nan
    x, y = (filled(picture, mask, fill) for picture in (image, reference))
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
) -> DepthErrors:
    """Errors of `depth` (H, W) [m] against `reference` (H, W) [m] where both are above 0 and the mask holds."""
    both = (depth > 0) & (reference > 0)
    if mask is not None:
        both &= mask
    errors = np.abs(depth[both].astype(np.float64) - reference[both])
    if not errors.size:
        return DepthErrors(num_pixels=0, **dict.fromkeys(_DEPTH_FIGURES, math.nan))
    return DepthErrors(
        num_pixels=int(errors.size),
        median=float(np.median(errors)),
        mean=float(errors.mean()),
        p90=float(np.percentile(errors, 90)),
        within_1cm=float(np.mean(errors <= 0.01)),
        within_2cm=float(np.mean(errors <= 0.02)),
    )


_DEPTH_FIGURES = ("median", "mean", "p90", "within_1cm", "within_2cm")


def _window_mean(image: Float64, border: Literal["reflect", "constant"]) -> Float64:
    """The Gaussian-weighted mean of each pixel's window, rows then columns."""
    offsets = np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2
    weights = np.exp(-0.5 * (offsets / SSIM_SIGMA) ** 2)
    weights /= weights.sum()
    rows = correlate1d(image, weights, axis=0, mode=border)
    return np.asarray(correlate1d(rows, weights, axis=1, mode=border))


SHIFT = np.array([-0.030, -0.088, -0.188], np.float32)  # richzhang/PerceptualSimilarity, lpips/lpips.py, ScalingLayer
SCALE = np.array([0.458, 0.448, 0.450], np.float32)
MOST = 1 << 28  # bytes of weights: those of VGG take 59 MB
ROWS = 32  # of the output that are made at a time


@dataclass(frozen=True, kw_only=True)
class _Convolution:
    """Number in the network's list, stride, padding; the max-pooling window before it (stride 2), 0 for none."""

    number: int
    stride: int = 1
    padding: int = 1
    pool: int = 0


ALEX = (
    (_Convolution(number=0, stride=4, padding=2),),
    (_Convolution(number=3, padding=2, pool=3),),
    (_Convolution(number=6, pool=3),),
    (_Convolution(number=8),),
    (_Convolution(number=10),),
)  # slices, after whose last ReLU features are compared (lpips/pretrained_networks.py, on torchvision's alexnet)
VGG = (
    (_Convolution(number=0), _Convolution(number=2)),
    (_Convolution(number=5, pool=2), _Convolution(number=7)),
    (_Convolution(number=10, pool=2), _Convolution(number=12), _Convolution(number=14)),
    (_Convolution(number=17, pool=2), _Convolution(number=19), _Convolution(number=21)),
    (_Convolution(number=24, pool=2), _Convolution(number=26), _Convolution(number=28)),
)


class Lpips:
    """LPIPS of two images (H, W, 3) in [0, 1]: 0 for the same, larger for less alike. `name`: ``alex`` or ``vgg``."""

    def __init__(self, path: Path) -> None:
        weights = _read(path)
        self.name = "alex" if "net.slice5.10.weight" in weights else "vgg"
        self._slices = ALEX if self.name == "alex" else VGG
        self._convolutions = [
            [(layer, *_parameters(path, weights, i, layer.number)) for layer in layers]
            for i, layers in enumerate(self._slices, 1)
        ]
        self._linear = [_array(path, weights, f"lin{i}.model.1.weight").reshape(-1) for i in range(len(self._slices))]

    def __call__(self, image: Float64, reference: Float64) -> float:
        """Sum over the slices of the mean over pixels of the weighted squared difference of unit features."""
        one, other = self._start(image), self._start(reference)
        total = 0.0
        for layers, linear in zip(self._convolutions, self._linear, strict=True):
            for layer, weight, bias in layers:
                one, other = (_convolved(x, layer, weight, bias) for x in (one, other))
            total += float(np.tensordot(linear, np.square(_unit(one) - _unit(other)), axes=(0, 0)).mean())
        return total

    def _start(self, image: Float64) -> Float32:
        scaled = (2.0 * image.astype(np.float32) - 1.0 - SHIFT) / SCALE
        return np.ascontiguousarray(scaled.transpose(2, 0, 1), dtype=np.float32)


def _read(path: Path) -> dict[str, Float32]:
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            size = sum(entry.file_size for entry in archive.zip.infolist())
            if size > MOST:
                raise ValueError(f"{size} bytes of arrays, expected at most {MOST}")
            return {name: np.asarray(archive[name], np.float32) for name in archive.files}
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    except Exception as error:  # numpy raises many kinds for a file that is not an archive
        raise InputError(
            f"{path}: expected LPIPS weights as .npz: {error}", remedy="splatctrl help score says how to make them"
        ) from None


def _array(path: Path, weights: dict[str, Float32], name: str) -> Float32:
    if name not in weights:
        raise InputError(
            f"{path}: expected LPIPS weights of alex or vgg, got none called {name}",
            remedy="splatctrl help score says how to make them",
        )
    return weights[name]


def _parameters(path: Path, weights: dict[str, Float32], part: int, number: int) -> tuple[Float32, Float32]:
    return tuple(_array(path, weights, f"net.slice{part}.{number}.{kind}") for kind in ("weight", "bias"))  # type: ignore[return-value]


def _convolved(x: Float32, layer: _Convolution, weight: Float32, bias: Float32) -> Float32:
    """ReLU of the convolution of x (C, H, W), pooled first where the layer says so, with weight (O, C, k, k)."""
    x = _pooled(x, layer.pool) if layer.pool else x
    size, step, pad = weight.shape[-1], layer.stride, layer.padding
    padded = np.pad(x, ((0, 0), (pad, pad), (pad, pad)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, (size, size), axis=(1, 2))[:, ::step, ::step]
    channels, height, width = windows.shape[:3]
    out = np.empty((len(weight), height, width), np.float32)
    flat = weight.reshape(len(weight), -1)
    for top in range(0, height, ROWS):
        part = windows[:, top : top + ROWS]
        columns = part.transpose(0, 3, 4, 1, 2).reshape(channels * size * size, -1)
        out[:, top : top + ROWS] = (flat @ columns + bias[:, None]).reshape(len(weight), -1, width)
    return np.maximum(out, 0)


def _pooled(x: Float32, size: int) -> Float32:
    windows = np.lib.stride_tricks.sliding_window_view(x, (size, size), axis=(1, 2))[:, ::2, ::2]
    return np.ascontiguousarray(windows.max(axis=(3, 4)))


def _unit(x: Float32) -> Float32:
    return np.asarray(x / (np.sqrt(np.sum(np.square(x), axis=0, keepdims=True)) + 1e-10), np.float32)
