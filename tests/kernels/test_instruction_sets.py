"""The kernels for AVX2 and for AVX-512 give the same bytes: who checks a result may have another processor."""

import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest

from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.kernels import arithmetic, native, num_threads
from splatctrl_cli.kernels import field as fields
from splatctrl_cli.kernels.raster import (
    ImageLoss,
    LossWeights,
    OptimiserSettings,
    Rasteriser,
    TargetView,
    empty_planes,
    optimiser_step,
)
from tests.field.scenes import cloud, queries
from tests.kernels.scenes import camera, moments, points_bytes, splats


def fit_bytes(width: int, height: int) -> bytes:
    """What an iteration of the fit computes."""
    view, count, rng = camera(width, height), 500, np.random.default_rng(3)
    centers, radii, opacities, colors = splats(count, seed=5)
    raster = Rasteriser(2)
    raster.prepare(view, centers, radii, opacities, colors)
    planes, by_planes = raster.forward(), empty_planes(height, width)
    target = TargetView(
        color=rng.integers(0, 256, (3, height, width), np.uint8),
        depth=rng.uniform(0.0, 2.0, (height, width)).astype(np.float32),
        counted=rng.integers(0, 2, (height, width), np.uint8),
    )
    weights = LossWeights(dssim=0.2, color=1.0, depth=0.5, opacity=0.1, normalised=True, background=(0.1, 0.2, 0.3))
    terms = ImageLoss(2).evaluate(planes, target, weights, by_planes)
    gradients = raster.backward(planes, by_planes)
    parameters = np.column_stack([centers, np.log(radii), colors, np.log(opacities / (1 - opacities))])
    state = moments(count)
    settings = OptimiserSettings(
        lr_center=2e-4, lr_log_radius=6e-3, lr_color=1e-2, lr_logit_opacity=5e-2, regulariser=1e-6, noise=5e5,
        min_opacity=0.1, min_radius=1e-3, max_radius=0.1, radius_depth=0.8,
    )  # fmt: skip
    moved = np.ascontiguousarray(parameters, np.float32)
    optimiser_step(raster, gradients, moved, state, settings, 7)
    arrays = planes, by_planes, gradients, moved, state.first, state.second
    return b"".join(array.tobytes() for array in arrays) + repr(terms).encode()


def field_bytes() -> bytes:
    """Scores and gradients of the fields."""
    centers, radii = cloud(700)
    points, at = Spheres.of(centers, np.zeros(len(centers))), queries()
    relative, offsets = points.relative(at), points.offsets(radii)
    laid_out = points.lay_out(radii, spare=0.0).astype(np.float32)
    results = [
        *fields.nearest(points.clusters, offsets, relative),
        *fields.matern(points.clusters, offsets, None, 0.02, 1e-3, relative),
        *fields.gaussian(points.clusters, offsets, laid_out, None, 0.0, 0.02, 1e-5, relative),
    ]
    return b"".join(np.ascontiguousarray(result).tobytes() for result in results)


def digests() -> list[str]:
    parts = [arithmetic().encode(), fit_bytes(45, 37), fit_bytes(160, 128), field_bytes(), points_bytes()]
    return [hashlib.sha256(part).hexdigest() for part in parts]


@pytest.mark.skipif(native.x86_64_level() < 4, reason="this processor has no AVX-512")
def test_avx2_and_avx512_give_the_same_bytes() -> None:
    here = [sys.executable, "-c", f"from {__name__} import digests; print(digests())"]
    of = {
        kernels: subprocess.run(
            here, env=os.environ | {"SPLATCTRL_KERNELS": kernels}, capture_output=True, text=True, check=True
        ).stdout
        for kernels in ("v3", "auto")
    }
    assert of["v3"] == of["auto"]
    assert len(of["v3"].split()) == 5


@pytest.mark.parametrize(
    ("processors", "requested", "given"),
    [(2, 0, 2), (2, 1, 1), (2, 16, 16), (2, 9999, 16), (64, 0, 64), (64, 9999, 64)],
)
def test_threads_are_at_most_16_or_one_per_processor(
    monkeypatch: pytest.MonkeyPatch, processors: int, requested: int, given: int
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(processors)))
    assert num_threads(requested) == given
