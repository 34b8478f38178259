"""The margin that each pair of links can keep between its spheres: what is asked for, or less where the spheres stick
out of the links so far, or the links are that near each other, that no controller could keep it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.config.fixed import (
    SELF_KEPT,
    SELF_OFTEN,
    SELF_POSTURES,
    SELF_ROUNDING,
    SELF_SHARE,
    SELF_TOLD,
    SELF_TOUCHING,
)
from splatctrl_cli.records import Float64
from splatctrl_cli.robot.link_gaps import SelfSurfaces
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_collision import fixtures, random_postures


@dataclass(frozen=True, kw_only=True)
class KeptMargin:
    """Two links whose spheres keep `margin` [m] instead of what was asked for.

    margin: below 0 the spheres may overlap by so much; None: they cannot be kept apart at all, and it stays as asked.
    apart: the least gap [m] of their surfaces (of their spheres where these are not known) that is not *near*, below.
    is_fixture: one stands still and carries none, such as a table of the URDF.
    surface_gap: no gap [m] of their surfaces is less in the sampled postures in which their spheres keep the margin,
    negative where they overlap; None where the surfaces are not known.
    """

    links: tuple[str, str]
    margin: float | None
    apart: float
    surface_gap: float | None
    is_fixture: bool = False


def fixture_margins(model: RobotModel, surfaces: SelfSurfaces, margin: float) -> tuple[KeptMargin, ...]:
    """The pairs of a link that moves and one of `fixtures`, which no map has: they keep `margin` [m], or a share of
    the largest gap that they ever have.
    """
    standing = fixtures(model)
    postures, found = random_postures(model, SELF_TOUCHING, seed=0), []
    for pair in (pair for pair in surfaces.pairs if not standing.isdisjoint(pair)):
        apart = min(margin, SELF_SHARE * max(surfaces.gap(q, pair) for q in postures))
        found.append(KeptMargin(links=pair, margin=None, apart=apart, surface_gap=None, is_fixture=True))
    return tuple(found)


def kept_margins(model: RobotModel, margin: float, surfaces: SelfSurfaces | None) -> tuple[KeptMargin, ...]:
    """The pairs of links whose spheres often (SELF_OFTEN of SELF_POSTURES random postures) do not keep `margin` [m],
    and what they keep.

    With their surfaces known: a posture is *near* where the surfaces are nearer than the margin, or than half of the
    largest gap that they ever have, whichever is less. The pair keeps the largest sphere gap of the near postures,
    where most of the others keep more: then its row keeps the arm out of every near posture of the sample. Where the
    spheres are too coarse to tell, and where the surfaces are not known, it keeps what nearly all postures (that are
    not near) do, in the latter case never less than 0: contact of spheres is then the only contact that is seen.
    """
    names = model.sphere_set.links
    owners = [(names[a], names[b]) for a, b in model.self_pairs()]
    if not owners:
        return ()
    postures = random_postures(model, SELF_POSTURES, seed=0)
    centers = model.sphere_centers_batch(postures)
    found = []
    for links in dict.fromkeys(owners):
        gap = sphere_gaps(model, links, postures)
        if np.mean(gap < margin) > SELF_OFTEN:
            surface = None if surfaces is None else surfaces.gaps_of(links, postures, centers, margin)
            if surfaces is not None and surface is not None and surface.max() < margin / SELF_SHARE:
                surface = surfaces.gaps_of(links, postures, centers)  # exact, for their share counts
            found.append(_kept(links, gap, margin, surface))
    return tuple(pair for pair in found if pair.margin is None or pair.margin < margin)


def with_kept_margins(model: RobotModel, margin: float, kept: Sequence[KeptMargin]) -> RobotModel:
    """The same robot, whose pairs of spheres of these links keep so much less than `margin` [m]."""
    less = {frozenset(pair.links): margin - pair.margin for pair in kept if pair.margin is not None}
    names = model.sphere_set.links
    allowance = [less.get(frozenset((names[a], names[b])), 0.0) for a, b in model.self_pairs()]
    return model.with_self_allowance(np.array(allowance, dtype=np.float64))


def least_gap(model: RobotModel, surfaces: SelfSurfaces | None, pair: KeptMargin, postures: Float64) -> float:
    """The least gap [m] of a pair at postures (T, J), exact below `pair.apart` and of what that is of."""
    gaps = None
    if surfaces is not None:
        gaps = surfaces.gaps_of(pair.links, postures, model.sphere_centers_batch(postures), pair.apart)
    return float((sphere_gaps(model, pair.links, postures) if gaps is None else gaps).min())


def sphere_gaps(model: RobotModel, links: tuple[str, str], postures: Float64) -> Float64:
    """The least gap (T,) [m] of those of `self_pairs` that are of two links, at postures (T, J)."""
    names, radii, centers = model.sphere_set.links, model.sphere_set.radii, model.sphere_centers_batch(postures)
    a, b = np.array([(a, b) for a, b in model.self_pairs() if (names[a], names[b]) == links], dtype=np.int64).T
    gaps = np.linalg.norm(centers[:, a] - centers[:, b], axis=2) - radii[a] - radii[b]
    return np.asarray(gaps.min(axis=1))


def _kept(links: tuple[str, str], gap: Float64, margin: float, surface: Float64 | None) -> KeptMargin:
    """What a pair keeps whose spheres and surfaces have these gaps (T,) [m] in the sampled postures."""
    apart = min(margin, SELF_SHARE * float((gap if surface is None else surface).max()))
    if surface is None:
        least = min(margin, float(np.quantile(gap, SELF_KEPT)))
        kept = max(least, 0.0) if gap.max() > 0 else None
        return KeptMargin(links=links, margin=kept, apart=apart, surface_gap=None)
    is_near = surface < apart
    least = min(margin, float(np.quantile(gap[~is_near], SELF_KEPT)))
    excluding = float(gap[is_near].max(initial=-np.inf)) + SELF_ROUNDING
    if np.mean(gap[~is_near] >= excluding) >= SELF_TOLD:
        least = min(margin, max(least, excluding))
    return KeptMargin(links=links, margin=least, apart=apart, surface_gap=float(surface[gap >= least].min()))
