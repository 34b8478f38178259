"""The voxel density compared with exact row sums: errors of density and distance, and time, by number of splats.

A wavy sheet of 1 m x 1 m, l = 2 cm, one core; the distance at 300 points 1 to 20 cm above it, by both weights.
"""

from dataclasses import replace

import numpy as np

from benchmarks.measure import Options, Result, rms, seconds
from splatctrl_cli.config import FieldConfig
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import GpdfField, SeField
from splatctrl_cli.field.weights import Kernel, log_row_sums, voxel_row_sums
from splatctrl_cli.records import Float64

SIZES = (5_000, 50_000, 500_000)
NUM_QUICK = 2  # sizes of a quick run: the third takes minutes
CONFIG = FieldConfig()
LENGTH = CONFIG.length_scale
KINDS = {
    "Matern": (Kernel(length=LENGTH, is_matern=True), GpdfField),
    "Gaussian": (Kernel(length=LENGTH, is_matern=False), SeField),
}


def run(options: Options) -> Result:
    """Both kernels on every sheet."""
    sizes = SIZES[:NUM_QUICK] if options.is_quick else SIZES
    return Result(
        title="density: voxels beside exact row sums; how many times faster",
        columns=(
            *("splats", "kernel", "density RMS", "largest", "distance RMS [mm]", "largest"),
            *("row sums [s]", "voxel", "ratio"),
        ),
        rows=[measured(num, kernel) for num in sizes for kernel in KINDS],
    )


def measured(num: int, name: str) -> list[str]:
    """One kernel on one sheet. The voxel density's time is that of the faster of two runs, because the first warms
    the transform.
    """
    kernel, kind = KINDS[name]
    centers, points = sheet(num)
    clusters = Spheres.of(centers, np.zeros(len(centers)))
    found: dict[str, Float64] = {}

    def exact() -> None:
        found["exact"] = np.exp(log_row_sums(kernel, clusters, threads=1))

    def voxel() -> None:
        found["voxel"] = voxel_row_sums(centers, LENGTH, kernel.value)

    row_sum_seconds = seconds(exact)
    voxel_seconds = min(seconds(voxel), seconds(voxel))
    density = found["voxel"] / found["exact"] - 1.0
    radii = np.full(num, 0.005)
    by_weights = [
        kind(Spheres.of(centers, radii), replace(CONFIG, weights=name)).query(points)[0]
        for name in ("rowsum", "voxel")
    ]
    distance = by_weights[1] - by_weights[0]
    return [
        *(str(num), name, f"{rms(density):.4f}", f"{np.abs(density).max():.4f}"),
        *(f"{1e3 * rms(distance):.3f}", f"{1e3 * np.abs(distance).max():.3f}"),
        *(f"{row_sum_seconds:.3f}", f"{voxel_seconds:.3f}", f"{row_sum_seconds / voxel_seconds:.2f}"),
    ]


def sheet(num: int) -> tuple[Float64, Float64]:
    """Centres (num, 3) at random on the sheet, and points (300, 3) above it."""
    rng = np.random.default_rng(0)

    def height(at: Float64) -> Float64:
        return np.asarray(0.2 * np.sin(5 * at[:, 0]) * np.cos(4 * at[:, 1]))

    centers = rng.uniform(0.0, 1.0, (num, 3))
    centers[:, 2] = height(centers)
    points = rng.uniform(0.0, 1.0, (300, 3))
    points[:, 2] = height(points) + rng.uniform(0.01, 0.2, 300)
    return centers.astype(np.float32).astype(np.float64), points
