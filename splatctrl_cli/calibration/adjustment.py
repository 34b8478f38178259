"""Least squares of a calibration, over distances between views and from the robot's surface.

Gauss-Newton in float64; Tukey's biweight narrows from round to round.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.calibration.evidence import (
    DEPTH,
    FIXED,
    OF_CAMERA,
    POSE,
    Estimate,
    Evidence,
    Unknowns,
    twist_between,
)
from splatctrl_cli.calibration.views import DepthView, depth_sigma, landed, overlap_rows
from splatctrl_cli.config import fixed
from splatctrl_cli.geometry import invert_transform, transform_points
from splatctrl_cli.records import Float64, Index, RgbdFrame

ROBOT = "the robot"


@dataclass(frozen=True, kw_only=True)
class Rows:
    """Residuals (M,) and sigma (M,) [m] of two views, or of a frame and the robot.

    jacobian (M, 17): by the unknowns `columns` (17,) of the two cameras and the clock. clusters (M,): residuals of
    equal number and `alike` have correlated errors. num_laid: points that should lie on the other surface, even
    beyond the reach. num_hidden: points of num_laid that occlude the robot.
    """

    between: tuple[str, str]
    alike: str
    num_laid: int
    residual: Float64
    sigma: Float64
    jacobian: Float64
    columns: Index
    clusters: Index
    num_hidden: int = 0


Widths = tuple[float, float]
"""Limits of residuals that count: reach [m], and cut [sigma]. An infinite cut leaves only the reach."""


@dataclass(kw_only=True)
class Normal:
    """Normal equations H (P, P), g (P,).

    counts: residuals with positive weight, by pair. spread: robust standard deviation [sigma] of all residuals.
    """

    H: Float64
    g: Float64
    counts: Mapping[tuple[str, str], int]
    spread: float


class Adjustment:
    """Residuals of evidence, and the estimate that minimises them."""

    def __init__(self, evidence: Evidence, unknowns: Unknowns, basis: Float64 | None = None) -> None:
        """basis (P, K): allowed directions of steps; None allows all."""
        self.evidence = evidence
        self.unknowns = unknowns
        self._clock = [unknowns.size - 1 if unknowns.has_clock else FIXED]  # its column
        self._basis = np.eye(unknowns.size) if basis is None else basis

    def solved(
        self, estimate: Estimate, schedule: Sequence[Widths], rounds: int = fixed.CALIBRATION_ROUNDS
    ) -> Estimate:
        """The estimate after a round per width, and `rounds` more at most."""
        start, step = estimate, np.zeros(self.unknowns.size)
        for number, widths in enumerate((*schedule, *(schedule[-1],) * rounds)):
            normal = self.normal(estimate, widths)
            step = self._step(normal, estimate, start, fixed.CALIBRATION_HOLD if number < len(schedule) - 1 else 0.0)
            estimate = self.unknowns.moved(estimate, step)
            if number >= len(schedule) and float(np.abs(step).max()) < fixed.CALIBRATION_STILL:
                break
        return estimate

    def _step(self, normal: Normal, estimate: Estimate, start: Estimate, hold: float) -> Float64:
        """The Gauss-Newton step. A prior, strengthened by `hold`, keeps unobserved directions at `start`."""
        weight, offset = self._prior(estimate, start)
        weight = weight + hold * float(np.trace(normal.H)) / len(weight)
        V = self._basis
        step = -V @ np.linalg.solve(V.T @ (normal.H + np.diag(weight)) @ V, V.T @ (normal.g + weight * offset))
        return np.asarray(np.clip(step, -fixed.CALIBRATION_STEP, fixed.CALIBRATION_STEP))

    def _prior(self, estimate: Estimate, start: Estimate) -> tuple[Float64, Float64]:
        """Weight (P,) of a wide prior at `start`, and the estimate's offset (P,) from `start`."""
        sigma, offset = np.ones(self.unknowns.size), np.zeros(self.unknowns.size)
        for camera in self.unknowns.cameras:
            columns = self.unknowns.columns(camera)
            (scale, bias), (scale_0, bias_0) = estimate.depth_of(camera), start.depth_of(camera)
            moved = twist_between(start.corrections[camera], estimate.corrections[camera])
            values = np.concatenate([moved, [scale - scale_0, bias - bias_0]])
            is_fixed = columns < 0
            sigma[columns[~is_fixed]] = np.repeat(fixed.CALIBRATION_PRIOR[:3], (3, 3, DEPTH))[~is_fixed]
            offset[columns[~is_fixed]] = values[~is_fixed]
        if self.unknowns.has_clock:
            sigma[-1], offset[-1] = fixed.CALIBRATION_PRIOR[3], estimate.clock - start.clock
        return 1 / np.square(sigma), offset

    def normal(self, estimate: Estimate, widths: Widths, *, with_robot: bool = True) -> Normal:
        H, g = np.zeros((self.unknowns.size, self.unknowns.size)), np.zeros(self.unknowns.size)
        counts: dict[tuple[str, str], int] = {}
        deviations = [np.zeros(0)]
        for rows, J, weight in self._weighed(estimate, widths, with_robot=with_robot):
            weighed = J * weight[:, None]
            H += weighed.T @ J
            g += (rows.residual / rows.sigma) @ weighed
            counts[rows.between] = counts.get(rows.between, 0) + int((weight > 0).sum())
            deviations.append(np.abs(rows.residual) / rows.sigma)
        every = np.concatenate(deviations)
        return Normal(H=H, g=g, counts=counts, spread=1.4826 * float(np.median(every)) if len(every) else 0.0)

    def scores(self, estimate: Estimate, widths: Widths) -> Float64:
        """Gradient (G, P) of each cluster of residuals with correlated errors."""
        sums: dict[tuple[str, int], Float64] = {}
        for rows, J, weight in self._weighed(estimate, widths, with_robot=True):
            cells, of_cell = np.unique(rows.clusters, return_inverse=True)
            own = np.zeros((len(cells), self.unknowns.size))
            np.add.at(own, of_cell, (rows.residual / rows.sigma * weight)[:, None] * J)
            for cell, score in zip(cells.tolist(), own, strict=True):
                sums[rows.alike, cell] = sums.get((rows.alike, cell), 0.0) + score
        return np.array([*sums.values()]).reshape(-1, self.unknowns.size)

    def _weighed(
        self, estimate: Estimate, widths: Widths, *, with_robot: bool
    ) -> Iterator[tuple[Rows, Float64, Float64]]:
        """Yield non-empty rows, their jacobian (M, P) [sigma] by all unknowns, and weights (M,)."""
        reach, cut = widths
        for rows in self.rows(estimate, reach, with_robot=with_robot):
            if len(rows.residual):
                deviation, width = np.abs(rows.residual) / rows.sigma, np.minimum(reach / rows.sigma, cut)
                weight = np.where(deviation < width, np.square(1 - np.square(deviation / width)), 0.0)
                is_column = rows.columns[:, None] == np.arange(self.unknowns.size)
                yield rows, rows.jacobian / rows.sigma[:, None] @ is_column, weight

    def cost(self, estimate: Estimate, reach: float) -> tuple[float, int]:
        """Misfit, and the number of points that can be compared.

        The misfit averages, over pairs, the mean squared residual [sigma^2]. Residuals are cut at `CALIBRATION_CUT`.
        """
        sums: dict[tuple[str, str], float] = {}
        laid: dict[tuple[str, str], int] = {}
        most = fixed.CALIBRATION_CUT**2
        for rows in self.rows(estimate, reach):
            own = float(np.minimum(np.square(rows.residual / rows.sigma), most).sum())
            own += most * max(0, rows.num_laid - len(rows.residual))
            sums[rows.between] = sums.get(rows.between, 0.0) + own
            laid[rows.between] = laid.get(rows.between, 0) + rows.num_laid
        means = [sums[key] / laid[key] for key in sums if laid[key] >= fixed.CALIBRATION_FEWEST]
        return (float(np.mean(means)) if means else most), sum(laid.values())

    def distance(self, estimate: Estimate) -> float | None:
        """Largest median distance [m] of a pair, cut at the first reach; None with few points.

        Points that occlude the robot do not count.
        """
        reach = fixed.CALIBRATION_REACHES[0]
        between: dict[tuple[str, str], list[Float64]] = {}
        for rows in self.rows(estimate, reach):
            beyond = np.full(max(0, rows.num_laid - rows.num_hidden - len(rows.residual)), reach)
            between.setdefault(rows.between, []).extend([np.abs(rows.residual), beyond])
        laid = [np.concatenate(parts) for parts in between.values()]
        return max((float(np.median(one)) for one in laid if len(one) >= fixed.CALIBRATION_FEWEST), default=None)

    def rows(self, estimate: Estimate, reach: float, *, with_robot: bool = True) -> Iterator[Rows]:
        """All residuals of at most `reach` [m]."""
        views = self.evidence.views
        placed = [self._find_pose(view, estimate) for view in views]
        for i, j in self.evidence.pairs:
            yield self._overlap(views[i], views[j], *placed[i], *placed[j], estimate, reach)
        for frame in self.evidence.frames if with_robot else ():
            yield from filter(None, [self._robot(frame, estimate, reach)])

    def _find_pose(self, item: DepthView | RgbdFrame, estimate: Estimate) -> tuple[Float64, Float64]:
        """T_world_camera (4, 4), and its motion (6,) with the clock, camera frame."""
        T, twist = self.evidence.recorded(item, estimate.clock)
        correction = estimate.corrections[item.camera]
        return T @ correction, _carry(twist, correction)

    def _overlap(
        self,
        a: DepthView,
        b: DepthView,
        T_a: Float64,
        twist_a: Float64,
        T_b: Float64,
        twist_b: Float64,
        estimate: Estimate,
        reach: float,
    ) -> Rows:
        (scale_a, bias_a), (scale_b, bias_b) = estimate.depth_of(a.camera), estimate.depth_of(b.camera)
        points = a.points * (scale_a + bias_a / a.points[:, 2])[:, None]
        T = invert_transform(T_b) @ T_a
        projected = transform_points(T, points)
        lands, recorded, normals = landed(projected, b)
        surface = recorded * (scale_b + bias_b / np.where(lands, recorded[:, 2], 1.0))[:, None]
        behind, turned = projected[:, 2] - surface[:, 2], a.point_normals @ T[:3, :3].T
        lands &= (behind < 3 * reach) & (np.einsum("ki,ki->k", turned, projected) < 0)  # else b cannot see them
        lands &= np.any(normals != 0, axis=1)
        num_laid = int(lands.sum())
        lands &= (behind > -3 * reach) & (np.einsum("ki,ki->k", turned, normals) > fixed.CALIBRATION_ALIKE)
        residual, derivatives = overlap_rows(points, T, lands, surface, normals)
        near = np.abs(residual) < reach
        which = np.flatnonzero(lands)[near]
        residual, (by_a, by_b) = residual[near], np.hsplit(derivatives[near], 2)
        own, other = a.points[which], recorded[which]
        slope_a = np.einsum("ki,ki->k", by_a[:, 3:], own) / own[:, 2]
        slope_b = np.einsum("ki,ki->k", by_b[:, 3:], other) / other[:, 2]
        sigma = np.hypot(slope_a * depth_sigma(own[:, 2]), slope_b * depth_sigma(other[:, 2]))
        return Rows(
            between=(a.camera, b.camera),
            alike="",
            num_laid=num_laid,
            residual=residual,
            sigma=np.hypot(sigma, fixed.CALIBRATION_NOISE[0]),
            jacobian=np.column_stack(
                [
                    by_a,
                    slope_a * own[:, 2],
                    slope_a,
                    by_b,
                    slope_b * other[:, 2],
                    slope_b,
                    by_a @ twist_a + by_b @ twist_b,
                ]
            ),
            columns=np.concatenate([self.unknowns.columns(a.camera), self.unknowns.columns(b.camera), self._clock]),
            clusters=_cells(transform_points(T_b, projected[which]), self.evidence.scale),
        )

    def _robot(self, frame: RgbdFrame, estimate: Estimate, reach: float) -> Rows | None:
        assert self.evidence.arm is not None
        scale, bias = estimate.depth_of(frame.camera)
        depth = np.where(frame.depth > 0, scale * frame.depth + bias, 0.0).astype(np.float32)
        T, twist = self._find_pose(frame, estimate)
        rows = self.evidence.arm.rows(
            depth, frame.intrinsics, T, twist, frame.stamp_ns - round(estimate.clock * 1e9), reach
        )
        if rows is None:
            return None
        step = max(1, len(rows.residual) // fixed.CALIBRATION_ARM_POINTS)
        some = slice(None, None, step)
        z = rows.points[some, 2]
        slope = np.einsum("ki,ki->k", rows.normals[some], rows.points[some]) / z
        jacobian = np.zeros((len(z), 2 * OF_CAMERA + 1))
        jacobian[:, :POSE] = rows.jacobian[some]
        jacobian[:, POSE], jacobian[:, POSE + 1] = slope * (z - bias) / scale, slope
        jacobian[:, -1] = rows.clock[some]
        return Rows(
            between=(frame.camera, ROBOT),
            alike=frame.camera,
            num_laid=rows.num_seen // step,
            residual=rows.residual[some],
            sigma=np.hypot(slope * depth_sigma(z), fixed.CALIBRATION_NOISE[0]),
            jacobian=jacobian,
            columns=np.concatenate([self.unknowns.columns(frame.camera), np.full(OF_CAMERA, -1), self._clock]),
            clusters=rows.links[some] * int(np.prod(fixed.CALIBRATION_TILES)) + rows.tiles[some],
            num_hidden=rows.num_hidden // step,
        )


def _cells(points_world: Float64, depth: float) -> Index:
    """Number (K,) of each point's world cube; errors in one cube correlate. depth [m]: the median."""
    x, y, z = np.floor(points_world / (fixed.CALIBRATION_CELL * depth)).astype(np.int64).T
    return np.asarray((x * 1_000_003 + y) * 1_000_003 + z)


def _carry(twist: Float64, T: Float64) -> Float64:
    if not twist.any():
        return twist
    turn, move = twist[:3], twist[3:]
    R = T[:3, :3].T
    return np.concatenate([R @ turn, R @ (move + np.cross(turn, T[:3, 3]))])
