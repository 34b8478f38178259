"""Solves a calibration from several starts, and rejects it if two solutions fit equally well."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from splatctrl_cli.calibration.adjustment import ROBOT, Adjustment, Widths
from splatctrl_cli.calibration.certainty import Certainty, certainty_of, middle_of
from splatctrl_cli.calibration.evidence import POSE, Estimate, Evidence, Unknowns, twist_between
from splatctrl_cli.config import fixed
from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.records import Float64

WIDE = tuple((reach, np.inf) for reach in fixed.CALIBRATION_REACHES)
FREED = tuple((reach, np.inf) for reach in fixed.CALIBRATION_FREED)


@dataclass(frozen=True, kw_only=True)
class Solution:
    """The estimate, its certainty, and its residuals within `widths`.

    noticed: `CalibratedCamera.depth_noticed` by camera.
    """

    estimate: Estimate
    certainty: Certainty
    adjustment: Adjustment
    widths: Widths
    noticed: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def within_observed(self, start: Estimate) -> "Solution":
        """Solve again from `start`, only in directions known within `CALIBRATION_SIGMA`."""
        adjustment, reach = self.adjustment, self.certainty.reach
        values, vectors = np.linalg.eigh(reach @ self.certainty.covariance @ reach.T)
        known = vectors[:, values <= fixed.CALIBRATION_SIGMA**2]
        some = Adjustment(adjustment.evidence, adjustment.unknowns, np.linalg.solve(reach, known))
        near = some.solved(replace(start, depth=self.estimate.depth, clock=self.estimate.clock), WIDE)
        solution = _solution(some, some.solved(near, [narrow(some, near)]))
        within = np.linalg.solve(reach, known @ known.T @ reach)
        return replace(
            solution,
            noticed=self.noticed,
            certainty=replace(solution.certainty, covariance=within @ solution.certainty.covariance @ within.T),
        )

    @property
    def fixed(self) -> tuple[str, ...]:
        unknowns = self.adjustment.unknowns
        return tuple(camera for camera in unknowns.cameras if camera not in unknowns.poses)


def solved(evidence: Evidence, start: Estimate, anchors: Sequence[str]) -> Solution:
    """Calibrate all cameras but `anchors`.

    Raises NotEvaluableError if cameras share no surface, or two solutions fit equally well.
    """
    cameras = evidence.cameras
    adjustment = Adjustment(
        evidence,
        Unknowns(
            cameras=cameras,
            poses=[camera for camera in cameras if camera not in anchors],
            has_clock=evidence.arm is not None,
        ),
    )
    few = Adjustment(evidence.thinned(), adjustment.unknowns)
    rough = [few.solved(begin, WIDE, rounds=fixed.CALIBRATION_ROUGH) for begin in _starts(adjustment.unknowns, start)]
    costs = _costs(few, rough)
    order = np.argsort(costs, kind="stable").tolist()
    _check_ties(adjustment, rough[order[0]])
    best = _whole(adjustment, rough[order[0]], start)
    near = [rough[i] for i in order[1:] if costs[i] < fixed.CALIBRATION_RIVAL * costs[order[0]]]
    others = [one for one in near if _apart(best, one) > fixed.CALIBRATION_OTHER[0]]
    if not others or not best.certainty.is_full:  # unobserved directions allow other places
        return best
    other = _whole(adjustment, others[0], start)
    return best if _apart(best, other.estimate) < fixed.CALIBRATION_OTHER[0] else _better(best, other)


def _whole(adjustment: Adjustment, rough: Estimate, start: Estimate) -> Solution:
    near = adjustment.solved(rough, [WIDE[-1]], rounds=2)
    solution = _solution(adjustment, adjustment.solved(near, [narrow(adjustment, near)]))
    unknowns = adjustment.unknowns
    if unknowns.has_clock and solution.certainty.sigma_clock > fixed.CALIBRATION_CLOCK:
        fixed_clock = replace(solution.estimate, clock=start.clock)
        still = Adjustment(adjustment.evidence, replace(unknowns, has_clock=False))
        solution = _solution(still, still.solved(fixed_clock, [solution.widths]))
    return _add_depths(solution)


def _costs(adjustment: Adjustment, estimates: Sequence[Estimate]) -> list[float]:
    fits = [adjustment.cost(one, WIDE[-1][0]) for one in estimates]
    most = max(num for _, num in fits)
    return [cost if 2 * num >= most else np.inf for cost, num in fits]


def _better(a: Solution, b: Solution) -> Solution:
    (cost_a, num_a), (cost_b, num_b) = (one.adjustment.cost(one.estimate, WIDE[-1][0]) for one in (a, b))
    if 2 * num_a < num_b or 2 * num_b < num_a:
        return a if num_a > num_b else b
    if abs(cost_a - cost_b) < fixed.CALIBRATION_OTHER[1] * min(cost_a, cost_b):
        apart = 1e3 * _apart(a, b.estimate)
        raise NotEvaluableError(
            f"calibrate: two solutions that place what is seen {apart:.0f} mm apart fit alike",
            remedy="put objects of other shapes in view of all cameras, or give a start nearer to the truth"
            " (--camera-pose)",
        )
    return a if cost_a < cost_b else b


def _solution(adjustment: Adjustment, estimate: Estimate) -> Solution:
    widths = narrow(adjustment, estimate)
    return Solution(
        estimate=estimate, certainty=certainty_of(adjustment, estimate, widths), adjustment=adjustment, widths=widths
    )


def narrow(adjustment: Adjustment, estimate: Estimate) -> Widths:
    """Final widths, with Tukey's cut by the residuals' spread."""
    spread = adjustment.normal(estimate, WIDE[-1]).spread
    return WIDE[-1][0], fixed.CALIBRATION_TUKEY * max(spread, fixed.CALIBRATION_LEAST_SPREAD)


def _starts(unknowns: Unknowns, start: Estimate) -> list[Estimate]:
    rng = np.random.default_rng(0)
    starts, num = [start], POSE * len(unknowns.poses)
    for _ in range(fixed.CALIBRATION_STARTS if num else 0):
        step = np.zeros(unknowns.size)
        step[:num] = np.tile(np.repeat(fixed.CALIBRATION_AROUND, 3), num // POSE) * rng.uniform(-1, 1, num)
        starts.append(unknowns.moved(start, step))
    return starts


def _apart(solution: Solution, other: Estimate) -> float:
    apart = [0.0]
    for camera in solution.adjustment.unknowns.poses:
        middle, radius = middle_of(solution.adjustment, camera)
        twist = twist_between(solution.estimate.corrections[camera], other.corrections[camera])
        apart += [
            float(np.linalg.norm(twist[3:] + np.cross(twist[:3], middle))),
            radius * float(np.linalg.norm(twist[:3])),
        ]
    return max(apart)


def _check_ties(adjustment: Adjustment, estimate: Estimate) -> None:
    evidence = adjustment.evidence
    group = {name: {name} for name in (*evidence.cameras, ROBOT)}
    for (a, b), count in adjustment.normal(estimate, WIDE[-1]).counts.items():
        if count >= fixed.CALIBRATION_FEWEST and group[a] is not group[b]:
            group[a] |= group[b]
            for name in group[b]:
                group[name] = group[a]
    anchored = group[ROBOT] | {name for camera in evidence.moving for name in group[camera]}
    parts = list({id(part): part for name, part in group.items() if name != ROBOT}.values())
    if sum(not part & anchored for part in parts) + bool(anchored - {ROBOT}) < 2:
        return
    names = " | ".join(sorted(", ".join(sorted(part - {ROBOT})) for part in parts))
    robot = "" if evidence.arm is None else ", nor the robot"
    raise NotEvaluableError(
        f"calibrate: cameras that cannot be tied together: {names}: they see no surface in common{robot}",
        remedy="record a scene that neighbouring cameras both see"
        + (", or a robot that all see, with --urdf" if evidence.arm is None else "")
        + ", or keep some with --cameras",
    )


def _add_depths(solution: Solution) -> Solution:
    """Solve again with clearly supported depth scales and biases.

    All are solved together. The least certain is then fixed as recorded, until every free one differs by
    `CALIBRATION_DEPTH_SURE[0]` sigmas.
    """
    unknowns = solution.adjustment.unknowns
    tried = _free_depths(solution, replace(unknowns, scales=unknowns.poses, biases=unknowns.cameras))
    off, covariance, free = _narrow_depths(tried)
    solution = replace(solution, noticed=_find_noticed(tried, free))
    if not any(_is_sure(tried, at, off[at], covariance[at, at]) for at in free):
        return solution
    scales, biases = (
        [camera for camera in some if tried.adjustment.unknowns.columns(camera)[POSE + number] in free]
        for number, some in enumerate((unknowns.poses, unknowns.cameras))
    )
    freed = _free_depths(solution, replace(unknowns, scales=scales, biases=biases))
    most_scale, most_bias = fixed.CALIBRATION_DEPTH_MOST
    depths = map(freed.estimate.depth_of, unknowns.cameras)
    return solution if any(abs(scale - 1) > most_scale or abs(bias) > most_bias for scale, bias in depths) else freed


def _narrow_depths(tried: Solution) -> tuple[Float64, Float64, list[int]]:
    """Offsets (P,) of depth unknowns from 1 or 0, covariance (P, P), and free columns."""
    unknowns, covariance = tried.adjustment.unknowns, tried.certainty.covariance
    off, free, usual = np.zeros(unknowns.size), [], []
    for camera in unknowns.cameras:
        (scale, bias), columns = tried.estimate.depth_of(camera), unknowns.columns(camera)[POSE:]
        for at, value, sigma in zip(columns, (scale - 1, bias), fixed.CALIBRATION_DEPTH_USUAL, strict=True):
            if at >= 0:
                off[at] = value
                free.append(int(at))
                usual.append(sigma)
    gain = np.linalg.solve(covariance[np.ix_(free, free)] + np.diag(np.square(usual)), covariance[free]).T
    off, covariance = off - gain @ off[free], _positive(covariance - gain @ covariance[free])
    while free:
        ratios = [abs(off[at]) / np.sqrt(covariance[at, at]) for at in free]
        least = int(np.argmin(ratios))
        if ratios[least] >= fixed.CALIBRATION_DEPTH_SURE[0]:
            break
        off, covariance = _hold(off, covariance, free.pop(least))
    return off, covariance, free


def _hold(off: Float64, covariance: Float64, at: int) -> tuple[Float64, Float64]:
    """Offsets (P,) and covariance (P, P), with unknown `at` fixed at 0."""
    gain = covariance[:, at] / max(covariance[at, at], np.finfo(float).tiny)
    return off - gain * off[at], _positive(covariance - np.outer(gain, covariance[at]))


def _positive(covariance: Float64) -> Float64:
    np.fill_diagonal(covariance, np.maximum(np.diag(covariance), np.finfo(float).tiny))
    return covariance


def _find_noticed(tried: Solution, free: Sequence[int]) -> dict[str, tuple[float, float]]:
    unknowns = tried.adjustment.unknowns
    columns = [at for at in range(POSE * len(unknowns.poses), unknowns.size - unknowns.has_clock) if at not in free]
    noticed = {}
    for camera in unknowns.cameras:
        least = [np.inf, np.inf]
        for number, at in enumerate(unknowns.columns(camera)[POSE:].tolist()):
            covariance = tried.certainty.covariance
            for other in columns if at >= 0 else ():
                if other != at:
                    covariance = _hold(np.zeros(unknowns.size), covariance, other)[1]
            if at >= 0:
                per_metre = 1.0 if number else max(_far(tried, camera), 1e-3)
                sure = fixed.CALIBRATION_DEPTH_SURE[1] * float(np.sqrt(max(covariance[at, at], 0.0)))
                least[number] = max(sure, fixed.CALIBRATION_DEPTH_LEAST / per_metre)
        noticed[camera] = (least[0], least[1])
    return noticed


def _is_sure(tried: Solution, at: int, off: float, variance: float) -> bool:
    unknowns = tried.adjustment.unknowns
    camera = next(camera for camera in unknowns.cameras if at in unknowns.columns(camera))
    change = off if at == unknowns.columns(camera)[-1] else off * _far(tried, camera)
    is_clear = abs(off) > fixed.CALIBRATION_DEPTH_SURE[1] * np.sqrt(variance)
    return bool(is_clear and abs(change) > fixed.CALIBRATION_DEPTH_LEAST)


def _free_depths(solution: Solution, unknowns: Unknowns) -> Solution:
    evidence = solution.adjustment.evidence
    adjustment, few = Adjustment(evidence, unknowns), Adjustment(evidence.thinned(), unknowns)
    estimates = []
    for scale in fixed.CALIBRATION_SCALES if unknowns.scales else (1.0,):
        depth = {camera: (scale * solution.estimate.depth_of(camera)[0], 0.0) for camera in unknowns.scales}
        estimates.append(few.solved(replace(solution.estimate, depth=depth), FREED, rounds=fixed.CALIBRATION_ROUGH))
    near = estimates[int(np.argmin(_costs(few, estimates)))]
    return replace(
        _solution(adjustment, adjustment.solved(near, [narrow(adjustment, near)])), noticed=solution.noticed
    )


def _far(solution: Solution, camera: str) -> float:
    depths = np.concatenate(
        [view.points[:, 2] for view in solution.adjustment.evidence.views if view.camera == camera]
    )
    return float(np.percentile(depths, 90)) if len(depths) else 0.0
