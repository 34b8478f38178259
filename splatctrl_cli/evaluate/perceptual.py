"""LPIPS (Zhang et al. 2018), in NumPy, from weights that a person gives. None come with this program.

A file of weights is what the package lpips of its authors holds, as plain arrays:

    import lpips, numpy
    model = lpips.LPIPS(net="alex")  # or "vgg"
    numpy.savez("lpips_alex.npz", **{name: value.numpy() for name, value in model.state_dict().items()})
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatctrl_cli.errors import InputError
from splatctrl_cli.records import Float32, Float64

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
            squared = np.square(_unit(one) - _unit(other))
            total += float(np.tensordot(linear, squared, axes=(0, 0)).mean())
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
            f"{path}: expected LPIPS weights as .npz, got: {error}", remedy="docs/score.md says how to make them"
        ) from None


def _array(path: Path, weights: dict[str, Float32], name: str) -> Float32:
    if name not in weights:
        raise InputError(
            f"{path}: expected LPIPS weights of alex or vgg, got none called {name}",
            remedy="docs/score.md says how to make them",
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
