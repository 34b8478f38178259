"""The voxel density against exact row sums: error of the density, of the distance, and time, by number of splats.

    python -m benchmarks.density [--quick] [--json FILE]

A wavy sheet of 1 m x 1 m, l = 2 cm, one core; the distance at 300 points 1 to 20 cm above it, by both weights.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.measure import machine, seconds
from splatctrl_cli.cli.common import table
from splatctrl_cli.config import FieldConfig
from splatctrl_cli.field.clusters import cluster_points
from splatctrl_cli.field.distance import GpdfField, SeField
from splatctrl_cli.field.kernel import Matern12, SquaredExponential
from splatctrl_cli.field.voxel_density import voxel_row_sums
from splatctrl_cli.records import Float64

SIZES = (5_000, 50_000, 500_000)
NUM_QUICK = 2  # sizes of a quick run: the third takes minutes
LENGTH = FieldConfig.length_scale
KINDS = {"Matern": (Matern12(LENGTH), GpdfField), "Gaussian": (SquaredExponential(LENGTH), SeField)}


@dataclass(frozen=True, kw_only=True)
class Row:
    """Relative error of the density, error of the distance [m], seconds, and how many times faster than row sums."""

    num_splats: int
    kernel: str
    density_rms: float
    density_largest: float
    distance_rms: float
    distance_largest: float
    row_sum_seconds: float
    voxel_seconds: float
    ratio: float


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print, write JSON."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.density", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="up to 50,000 splats")
    parser.add_argument("--json", type=Path, default=Path("bench_output/density.json"), metavar="FILE")
    args = parser.parse_args(argv)
    sizes = SIZES[:NUM_QUICK] if args.quick else SIZES
    rows = [measured(num, kernel) for num in sizes for kernel in KINDS]
    head = [
        "splats",
        "kernel",
        "density RMS",
        "largest",
        "distance RMS [mm]",
        "largest",
        "row sums [s]",
        "voxel",
        "ratio",
    ]
    body = [
        [
            *(str(row.num_splats), row.kernel, f"{row.density_rms:.4f}", f"{row.density_largest:.4f}"),
            *(f"{1e3 * row.distance_rms:.3f}", f"{1e3 * row.distance_largest:.3f}"),
            *(f"{row.row_sum_seconds:.3f}", f"{row.voxel_seconds:.3f}", f"{row.ratio:.2f}"),
        ]
        for row in rows
    ]
    print("\n".join(table(head, body)))
    args.json.parent.mkdir(parents=True, exist_ok=True)
    report = {"machine": machine(), "quick": args.quick, "rows": [asdict(row) for row in rows]}
    args.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    print(f"wrote {args.json}")
    return 0


def measured(num: int, name: str) -> Row:
    """One kernel on one sheet; the voxel density is the faster of two runs, as its first one warms the transform."""
    kernel, kind = KINDS[name]
    centers, points = sheet(num)
    clusters = cluster_points(centers)
    found: dict[str, Float64] = {}

    def exact() -> None:
        found["exact"] = np.exp(kernel.log_row_sums(clusters, threads=1))

    def voxel() -> None:
        found["voxel"] = voxel_row_sums(centers, LENGTH, kernel.value)

    row_sum_seconds = seconds(exact)
    voxel_seconds = min(seconds(voxel), seconds(voxel))
    density = found["voxel"] / found["exact"] - 1.0
    radii = np.full(num, 0.005)
    by_weights = [kind(centers, radii, LENGTH, weights=name).query(points)[0] for name in ("rowsum", "voxel")]
    distance = by_weights[1] - by_weights[0]
    return Row(
        num_splats=num,
        kernel=name,
        density_rms=float(np.sqrt(np.mean(density**2))),
        density_largest=float(np.abs(density).max()),
        distance_rms=float(np.sqrt(np.mean(distance**2))),
        distance_largest=float(np.abs(distance).max()),
        row_sum_seconds=row_sum_seconds,
        voxel_seconds=voxel_seconds,
        ratio=row_sum_seconds / voxel_seconds,
    )


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


if __name__ == "__main__":
    raise SystemExit(main())
