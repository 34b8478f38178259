"""Splat sets with known distances."""

import numpy as np

from splatctrl_cli.records import Float64, Label, SplatSet
from tests.plain import plain_splats


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
    return plain_splats(centers, radii, colors=0.5, opacities=0.8, labels=label)


def plane(radius: float = 0.0, spacing: float = 0.005, half: float = 0.4) -> tuple[Float64, Float64]:
    """A square of spheres at z = 0: centers (N, 3), radii (N,)."""
    x, y = np.meshgrid(np.arange(-half, half, spacing), np.arange(-half, half, spacing))
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1), np.full(x.size, radius)
