"""Rules by which 3D Gaussian splatting adds and removes Gaussians (Kerbl et al. 2023, section 5).

Each function returns new arrays, longer or shorter. New Gaussians start without moments.
"""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from experiments.gaussian_step import (
    CENTER,
    GRADIENT_SUM,
    LOG_SCALE,
    LOGIT,
    NUM_PARAMETERS,
    NUM_VIEWS,
    QUAT,
    SCREEN_RADIUS,
    GaussianArrays,
)
from splatctrl_cli.blocks import Bool, Float32, Float64

SPLIT_PARTS = 2  # Gaussians that a split one becomes


@dataclass(frozen=True, kw_only=True)
class GaussianSettings:
    """The numbers of 3D Gaussian splatting. Shares are of `iterations`, of which the original has 30,000."""

    iterations: int = 3000
    max_gaussians: int = 500_000  # which the original does not limit
    max_degree: int = 3  # of the spherical harmonics
    degree_every: float = 1 / 30  # share of the iterations until the degree rises by one
    initial_opacity: float = 0.1
    lr_center: float = 1.6e-4  # times the extent of the scene
    lr_center_final: float = 1.6e-6  # the same at the end, reached exponentially
    lr_log_scale: float = 5e-3
    lr_quat: float = 1e-3
    lr_color: float = 2.5e-3  # of the constant harmonic
    lr_harmonics: float = 1.25e-4  # of the others
    lr_logit_opacity: float = 5e-2
    densify_from: int = 500  # iterations before the first adding and removing, or half of densify_until
    densify_until: float = 0.5  # share of the iterations after which their number is fixed
    densify_every: int = 100  # iterations between such rounds
    densify_gradient: float = 2e-4  # mean screen gradient [half images] from which a Gaussian is cloned or split
    dense_share: float = 0.01  # of the extent: larger are split, others cloned
    split_shrink: float = 1.6  # sigmas of a split Gaussian's parts are divided by this
    min_opacity: float = 0.005  # fainter Gaussians are removed
    max_screen_radius: float = 20.0  # [px] larger are removed once opacities were reset
    max_size_share: float = 0.1  # of the extent: Gaussians with a larger sigma are removed then, too
    reset_every: float = 0.0  # share of the iterations between resets of opacity; 0: none (0.1 cost over 1 dB)
    reset_opacity: float = 0.01  # after a reset


@dataclass(frozen=True, kw_only=True)
class Densified:
    """Result of one round: numbers of Gaussians cloned, split (each into two), without room, and removed by reason.

    Reasons: broken (not finite), opacity, screen (too large in an image), size (too large in the world).
    """

    cloned: int
    split: int
    unmet: int
    pruned: dict[str, int]


def fresh(parameters: Float32) -> GaussianArrays:
    """Arrays of Gaussians that have not been optimised yet, from parameters (N, 59)."""
    count = len(parameters)
    return GaussianArrays(
        parameters=parameters,
        first=np.zeros((count, NUM_PARAMETERS), np.float32),
        second=np.zeros((count, NUM_PARAMETERS), np.float32),
        num_steps=np.zeros(count, np.uint32),
        growth=np.zeros((count, 3), np.float32),
    )


def densify(
    arrays: GaussianArrays, settings: GaussianSettings, extent: float, rng: np.random.Generator, *, prunes_large: bool
) -> tuple[GaussianArrays, Densified]:
    """One round: clone, split, prune; growth statistics start again.

    A Gaussian whose mean screen gradient reaches `densify_gradient` is cloned if its largest sigma is at most
    `dense_share` of the scene's `extent` [m], else split. If `max_gaussians` leaves too little room, the largest
    gradients take precedence.
    """
    wanted, num_unmet = _wanted(arrays, settings)
    is_small = _largest_sigma(arrays.parameters) <= settings.dense_share * extent
    is_cloned, is_split = wanted & is_small, wanted & ~is_small
    born = [arrays.parameters[is_cloned], split_parts(arrays.parameters[is_split], settings.split_shrink, rng)]
    grown = _joined(_selected(arrays, ~is_split), fresh(np.concatenate(born)))
    reasons = prune_reasons(grown, settings, extent, prunes_large=prunes_large)
    kept = _selected(grown, ~np.any(list(reasons.values()), axis=0))
    kept.growth[:] = 0.0
    done = Densified(
        cloned=int(is_cloned.sum()),
        split=int(is_split.sum()),
        unmet=num_unmet,
        pruned={name: int(mask.sum()) for name, mask in reasons.items()},
    )
    return kept, done


def split_parts(parameters: Float32, shrink: float, rng: np.random.Generator) -> Float32:
    """Two Gaussians for each of parameters (N, 59): (2N, 59), with centres drawn from the Gaussian and sigmas divided
    by `shrink`.
    """
    parts = np.repeat(parameters, SPLIT_PARTS, axis=0)
    local = rng.standard_normal((len(parts), 3)) * np.exp(parts[:, LOG_SCALE])
    parts[:, CENTER] += np.einsum("nij,nj->ni", rotations(parts[:, QUAT]), local).astype(np.float32)
    parts[:, LOG_SCALE] -= np.float32(np.log(shrink))
    return parts


def prune_reasons(
    arrays: GaussianArrays, settings: GaussianSettings, extent: float, *, prunes_large: bool
) -> dict[str, Bool]:
    """Masks (N,) of Gaussians to remove, by reason; each Gaussian has at most one reason."""
    p = arrays.parameters
    nothing = np.zeros(len(p), bool)
    found = {
        "broken": ~np.isfinite(p).all(axis=1),
        "opacity": p[:, LOGIT] < _logit(settings.min_opacity),
        "screen": arrays.growth[:, SCREEN_RADIUS] > settings.max_screen_radius if prunes_large else nothing,
        "size": _largest_sigma(p) > settings.max_size_share * extent if prunes_large else nothing,
    }
    taken = nothing.copy()
    reasons = {}
    for name, mask in found.items():
        reasons[name] = mask & ~taken
        taken |= mask
    return reasons


def reset_opacity(arrays: GaussianArrays, opacity: float) -> None:
    """Lower every opacity to at most `opacity`, in place, and reset its moments; training raises needed opacities
    again.
    """
    np.minimum(arrays.parameters[:, LOGIT], np.float32(_logit(opacity)), out=arrays.parameters[:, LOGIT])
    arrays.first[:, LOGIT] = 0.0
    arrays.second[:, LOGIT] = 0.0


def rotations(quats_wxyz: NDArray[np.floating]) -> Float64:
    """Rotation matrices (N, 3, 3) of nonzero quaternions (N, 4)."""
    q = quats_wxyz.astype(np.float64)
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1),
        ],
        axis=1,
    )


def _wanted(arrays: GaussianArrays, settings: GaussianSettings) -> tuple[Bool, int]:
    """Mask (N,) of Gaussians to clone or split, and the number without room; each adds one Gaussian."""
    gradient = arrays.growth[:, GRADIENT_SUM] / np.maximum(arrays.growth[:, NUM_VIEWS], 1.0)
    wanted = gradient >= settings.densify_gradient
    room = max(settings.max_gaussians - len(arrays), 0)
    num_unmet = max(int(wanted.sum()) - room, 0)
    if num_unmet:
        by_gradient = np.argsort(np.where(wanted, -gradient, np.inf), kind="stable")
        wanted = np.zeros(len(arrays), bool)
        wanted[by_gradient[:room]] = True
    return wanted, num_unmet


def _largest_sigma(parameters: Float32) -> Float32:
    return np.asarray(np.exp(parameters[:, LOG_SCALE].max(axis=1, initial=-np.inf)), np.float32)


def _selected(arrays: GaussianArrays, keep: Bool) -> GaussianArrays:
    return GaussianArrays(**{field.name: getattr(arrays, field.name)[keep] for field in fields(GaussianArrays)})


def _joined(a: GaussianArrays, b: GaussianArrays) -> GaussianArrays:
    names = [field.name for field in fields(GaussianArrays)]
    return GaussianArrays(**{name: np.concatenate([getattr(a, name), getattr(b, name)]) for name in names})


def _logit(opacity: float) -> float:
    return float(np.log(opacity / (1.0 - opacity)))
