"""Splat sets with known distances."""

import numpy as np

from splatctrl_cli.records import Float64, Label, SplatSet


def cloud(num: int = 600, seed: int = 0) -> tuple[Float64, Float64]:
    """A wavy sheet of spheres: centers (N, 3), radii (N,), a few of them zero."""
    rng = np.random.default_rng(seed)
    centers = rng.uniform(-0.3, 0.3, (num, 3))
    centers[:, 2] = 0.05 * np.sin(9 * centers[:, 0])
    radii = rng.uniform(0.002, 0.012, num)
    radii[::50] = 0.0
    return centers.astype(np.float32).astype(np.float64), radii.astype(np.float32).astype(np.float64)


def queries(num: int = 300, seed: int = 1, extent: float = 0.5) -> Float64:
    """Points (Q, 3) around `cloud`."""
    return np.random.default_rng(seed).uniform(-extent, extent, (num, 3))


def splat_set(centers: Float64, radii: Float64, label: Label = Label.OBJECT) -> SplatSet:
    """Grey splats of one label."""
    num = len(radii)
    return SplatSet(
        centers=centers.astype(np.float32),
        radii=radii.astype(np.float32),
        colors=np.full((num, 3), 0.5, np.float32),
        opacities=np.full(num, 0.8, np.float32),
        labels=np.full(num, int(label), np.uint8),
        density=np.zeros(num, np.float32),
    )
