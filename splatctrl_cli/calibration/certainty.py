"""Certainty of a calibration: its covariance, and names of unobserved directions."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.calibration.adjustment import Adjustment, Widths
from splatctrl_cli.calibration.evidence import POSE, Estimate, Unknowns
from splatctrl_cli.calibration.views import DepthView
from splatctrl_cli.config import fixed
from splatctrl_cli.errors import NotEvaluableError, refuse_if
from splatctrl_cli.records import Float64

AXES = ("x", "y", "z")


@dataclass(frozen=True, kw_only=True)
class Certainty:
    """Covariance (P, P) of the unknowns; `reach` (P, P) maps them to displacements [m] in view."""

    unknowns: Unknowns
    covariance: Float64
    reach: Float64

    def slice_covariance(self, camera: str) -> Float64:
        """Covariance (6, 6) of a camera's rotation and translation, own frame; 0 if fixed."""
        columns = self.unknowns.columns(camera)[:POSE]
        return np.zeros((POSE, POSE)) if columns[0] < 0 else self.covariance[np.ix_(columns, columns)]

    def displacement(self, camera: str) -> Float64:
        """Covariance (6, 6) [m^2] of displacements in view: of the rim by rotation, then of the middle."""
        columns = self.unknowns.columns(camera)[:POSE]
        if columns[0] < 0:
            return np.zeros((POSE, POSE))
        block = self.reach[np.ix_(columns, columns)]
        return np.asarray(block @ self.slice_covariance(camera) @ block.T)

    def sigma_depth(self, camera: str) -> tuple[float, float]:
        """Sigma of scale and bias [m]; 0 if fixed."""
        scale, bias = (
            0.0 if at < 0 else float(np.sqrt(self.covariance[at, at])) for at in self.unknowns.columns(camera)[POSE:]
        )
        return scale, bias

    @property
    def is_full(self) -> bool:
        """True if all directions of all cameras are known within `CALIBRATION_SIGMA`."""
        spreads = [np.linalg.eigvalsh(self.displacement(camera))[-1] for camera in self.unknowns.poses]
        return max(spreads, default=0.0) <= fixed.CALIBRATION_SIGMA**2

    @property
    def sigma_clock(self) -> float:
        """Sigma [s]; 0 if fixed."""
        return float(np.sqrt(self.covariance[-1, -1])) if self.unknowns.has_clock else 0.0


def certainty_of(adjustment: Adjustment, estimate: Estimate, widths: Widths) -> Certainty:
    """The certainty of a solved estimate.

    The covariance is ``A^-1 M A^-T`` (the sandwich of White, 1980). M sums products of clusters' gradients, to count
    correlated errors. A is the gradient's derivative. Between views it is a difference with points projected anew,
    which cancels noise that tilts normals. Raises NotEvaluableError if no view shares a surface with another view or
    the robot.
    """
    whole, scores = adjustment.normal(estimate, widths), adjustment.scores(estimate, widths)
    refuse_if(
        not len(scores),
        "calibrate: the cameras measure no surface in common, and none of the robot's",
        remedy="record a scene or a robot that they see at a finer resolution, or begin nearer (--camera-pose)",
        error=NotEvaluableError,
    )
    between = adjustment.normal(estimate, widths, with_robot=False)
    reach = _reach(adjustment, estimate)
    back = np.linalg.inv(reach)
    H, H_robot = back.T @ whole.H @ back, back.T @ (whole.H - between.H) @ back
    num = len(scores)
    scores = scores @ back * np.sqrt(num / max(num - len(H), 1))
    M = scores.T @ scores
    floor = 1e-9 * float(np.trace(H)) / len(H)
    first = np.linalg.inv(H + floor * np.eye(len(H)))
    variance, axes = np.linalg.eigh(first @ M @ first)
    steps = np.clip(10 * np.sqrt(np.maximum(variance, 0.0)), *fixed.CALIBRATION_PROBE)
    changes = []
    for axis, step in zip(axes.T, steps, strict=True):
        twist = back @ axis * step
        ahead, behind = (
            adjustment.normal(adjustment.unknowns.moved(estimate, sign * twist), widths, with_robot=False).g
            for sign in (1.0, -1.0)
        )
        changes.append(back.T @ (ahead - behind) / (2 * step))
    A = H_robot + np.column_stack(changes) @ axes.T
    values, vectors = np.linalg.eigh(0.5 * (A + A.T))
    error = np.sqrt(np.maximum(np.einsum("pk,pq,qk->k", vectors, M, vectors), 0.0))
    inverse = vectors / np.maximum(values, np.maximum(error / fixed.CALIBRATION_UNKNOWN, floor)) @ vectors.T
    covariance = fixed.CALIBRATION_INFLATION**2 * back @ inverse @ M @ inverse @ back.T
    return Certainty(unknowns=adjustment.unknowns, covariance=0.5 * (covariance + covariance.T), reach=reach)


def _reach(adjustment: Adjustment, estimate: Estimate) -> Float64:
    """Matrix (P, P) from unknowns to displacements [m] in view."""
    unknowns = adjustment.unknowns
    reach = np.eye(unknowns.size)
    for camera in unknowns.cameras:
        middle, radius = middle_of(adjustment, camera)
        columns = unknowns.columns(camera)
        pose, depth = columns[:POSE], columns[POSE:]
        if pose[0] >= 0:
            block = np.eye(POSE)
            block[:3, :3] *= radius
            block[3:, :3] = np.cross(middle, np.eye(3))  # -[middle]x
            reach[np.ix_(pose, pose)] = block
        if depth[0] >= 0:
            reach[depth[0], depth[0]] = np.linalg.norm(middle)
    if unknowns.has_clock:
        reach[-1, -1] = fixed.CALIBRATION_SPEED
    return reach


def middle_of(adjustment: Adjustment, camera: str) -> tuple[Float64, float]:
    """Middle (3,) [m] of a camera's points, in its frame, and their radius [m]."""
    cloud = np.concatenate(
        [*(view.points for view in adjustment.evidence.views if view.camera == camera), np.zeros((0, 3))]
    )
    if not len(cloud):
        return np.array([0.0, 0.0, 1.0]), 0.3
    middle = np.median(cloud, axis=0)
    return middle, max(float(np.median(np.linalg.norm(cloud - middle, axis=1))), 0.05)


Plane = tuple[str, Float64]  # name, and unit normal (3,), world


def plane_of(view: DepthView, T_world_camera: Float64) -> Plane | None:
    """The largest plane in a view; None if under a quarter of normals fit."""
    normals = view.normals.reshape(-1, 3)
    normals = normals[np.any(normals != 0, axis=1)] @ T_world_camera[:3, :3].T
    if len(normals) < 100:
        return None
    few = normals[:: max(1, len(normals) // 300)]
    shares = np.mean(few @ normals.T > np.cos(np.radians(15)), axis=1)
    best = int(np.argmax(shares))
    if shares[best] < 0.25:
        return None
    near = normals[normals @ few[best] > np.cos(np.radians(15))]
    normal = near.mean(axis=0) / np.linalg.norm(near.mean(axis=0))
    return "table" if abs(normal[2]) > 0.9 else "wall", normal


def unobserved(certainty: Certainty, camera: str, T_world_camera: Float64, plane: Plane | None) -> tuple[str, ...]:
    """Names of a camera's directions not known within `CALIBRATION_SIGMA`."""
    values, vectors = np.linalg.eigh(certainty.displacement(camera))
    unknown = vectors[:, values > fixed.CALIBRATION_SIGMA**2]
    if not unknown.shape[1]:
        return ()
    names = dict.fromkeys(
        name
        for name, direction in _named_directions(plane)
        if _share(unknown, np.concatenate([direction[0], direction[1]]), T_world_camera) > 0.5
    )
    return tuple(names) or ("a turn and a move together",)


def _share(unknown: Float64, direction: Float64, T_world_camera: Float64) -> float:
    """Share of a direction (6,), world, that lies in `unknown` directions (6, K), camera frame."""
    R = T_world_camera[:3, :3].T
    return float(np.sum(np.square(unknown.T @ np.concatenate([R @ direction[:3], R @ direction[3:]]))))


def _named_directions(plane: Plane | None) -> Sequence[tuple[str, tuple[Float64, Float64]]]:
    zero = np.zeros(3)
    if plane is None:
        return [
            *(
                (f"translation along {name} of the world", (zero, axis))
                for name, axis in zip(AXES, np.eye(3), strict=True)
            ),
            *(
                (f"rotation about {name} of the world", (axis, zero))
                for name, axis in zip(AXES, np.eye(3), strict=True)
            ),
        ]
    name, normal = plane
    first = np.eye(3)[int(np.argmin(np.abs(normal)))]
    first = first - normal * (first @ normal)
    first /= np.linalg.norm(first)
    within = (first, np.cross(normal, first))
    return [
        (f"translation along the {name}'s normal", (zero, normal)),
        *((f"translation in the {name}'s plane", (zero, axis)) for axis in within),
        (f"rotation about the {name}'s normal", (normal, zero)),
        *((f"rotation about axes in the {name}'s plane", (axis, zero)) for axis in within),
    ]
