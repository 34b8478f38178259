"""Closed loops over random tables, each reconstructed from its own simulated cameras and judged by the truth.

    python -m benchmarks.tabletop --scenes 100 --csv bench_output/tabletop.csv

The margin is 2 cm, plus what the robot's spheres leave uncovered, plus what the controller's field over-estimates at
most on other scenes (`--calibration` of them). Beside the controller alone stands the one that asks the planner for a
way out where it stalls, and the planner's path followed in joint space. Every trial is a row of the CSV.
"""

import argparse
import csv
import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.scenes import sample_robot
from benchmarks.tabletop_scenes import FRAME, STAMP_NS, TableScene, reconstructed, table_scene
from splatctrl_cli.cli.common import table
from splatctrl_cli.config import Config
from splatctrl_cli.control.fallbacks import Rung
from splatctrl_cli.control.replay import ReplayTask, ReplayTrace, closed_loop
from splatctrl_cli.errors import SplatCtrlError
from splatctrl_cli.field.distance import SphereField, make_field
from splatctrl_cli.field.obstacles import field_splats
from splatctrl_cli.planner.comparison import Motion, MotionFigures, Yardstick
from splatctrl_cli.planner.planned import planned_detours, planned_path
from splatctrl_cli.records import DistanceField, Float64
from splatctrl_cli.robot.coverage import coverage_deficit

EPSILON = 0.02  # [m] of the paper
BAR = 0.015  # [m] of true clearance to what a camera saw
LEAST_REACHED = 0.95  # of the goals, where ways out are planned
FIRST_CALIBRATION = 10_000  # seeds of the calibration scenes; the trials' begin at 0
NEAR = 0.08  # [m] of clearance by the field, below which the field's over-estimate counts
DETOURS = 3
METHODS = ("controller", "controller, ways out planned", "planner, in joint space", "no barriers")


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One method on one table; clearances [m], NaN without a motion. needs_avoiding: without barriers the same
    controller comes nearer than EPSILON to something.
    """

    seed: int
    method: str
    num_things: int
    needs_avoiding: bool
    outcome: str
    success: bool
    duration_s: float
    joint_path_rad: float
    effector_path_m: float
    effector_path_deg: float
    min_proxy: float
    min_exact: float
    min_proved: float
    min_true: float
    min_seen: float
    largest_over: float
    num_interventions: int
    num_relaxed: int
    num_held: int
    num_detours: int
    seconds: float


@dataclass(frozen=True, kw_only=True)
class Known:
    """The map's distances: `barrier` for the controller, `exact`, which is 1-Lipschitz, for the planner."""

    barrier: DistanceField
    exact: SphereField

    def distance(self, points: Float64) -> Float64:
        """The exact distance (Q,) [m], less its rounding."""
        return self.exact.query(points)[0] - 1e-6


def main(argv: Sequence[str] | None = None) -> int:
    """Run all trials; 1 where a bar is missed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.tabletop", description=__doc__)
    parser.add_argument("--scenes", type=int, default=100, metavar="N")
    parser.add_argument("--first", type=int, default=0, metavar="SEED")
    parser.add_argument("--calibration", type=int, default=20, metavar="N", help="scenes that set the margin")
    parser.add_argument("--margin", type=float, metavar="M", help="instead of calibrating")
    parser.add_argument("--csv", type=Path, default=Path("bench_output/tabletop.csv"), metavar="FILE")
    args = parser.parse_args(argv)
    config, model = Config(), sample_robot()
    config = replace(config, control=replace(config.control, solver="daqp"))
    deficit = max(coverage_deficit(model.urdf, model.sphere_set).max_deficit or 0.0, 0.0)
    margin = args.margin
    if margin is None:
        config = with_margin(config, EPSILON + deficit)
        seeds = range(FIRST_CALIBRATION, FIRST_CALIBRATION + args.calibration)
        trials = [trial for seed in seeds for trial in trials_of(seed, config, METHODS[:1])]
        over = max(trial.largest_over for trial in trials if np.isfinite(trial.largest_over))
        margin = EPSILON + deficit + over
        print(f"coverage deficit {1e3 * deficit:.1f} mm, largest over-estimate {1e3 * over:.1f} mm: ", end="")
    print(f"margin {1e3 * margin:.1f} mm", flush=True)
    config, rows = with_margin(config, margin), []
    args.csv.parent.mkdir(parents=True, exist_ok=True)
    with args.csv.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(Trial.__dataclass_fields__))
        writer.writeheader()
        for seed in range(args.first, args.first + args.scenes):
            for trial in trials_of(seed, config, METHODS):
                rows.append(trial)
                writer.writerow(asdict(trial))
            file.flush()
            print(f"{seed}: {json.dumps([row.outcome for row in rows[-len(METHODS) :]])}", flush=True)
    _report(rows)
    return int(_is_missed(rows))


def with_margin(config: Config, margin: float) -> Config:
    """The configuration with another margin [m] to the scene."""
    return replace(config, control=replace(config.control, margin=margin))


def trials_of(seed: int, config: Config, methods: Sequence[str]) -> list[Trial]:
    """The trials of one scene."""
    scene = table_scene(seed)
    splats = field_splats(reconstructed(scene, config))
    known = Known(
        barrier=make_field(splats.centers, splats.radii, config.field),
        exact=SphereField(splats.centers, splats.radii),
    )
    free = _driven(scene, config, _nothing(), None)
    assert isinstance(free, ReplayTrace)
    needs = float(np.min(_clearances(scene, free.position)[0])) < EPSILON
    return [_trial(scene, config, known, method, free, needs=needs) for method in methods]


def _trial(scene: TableScene, config: Config, known: Known, method: str, free: ReplayTrace, *, needs: bool) -> Trial:
    model, task, start = sample_robot(), _replay_task(scene), time.perf_counter()
    trace: ReplayTrace | str | None = None
    position, outcome = None, ""
    if method == METHODS[2]:
        plan = planned_path(model, known, task, config.planner, config.control)
        outcome = plan.outcome
        if plan.path is not None:
            period = config.control.period
            position = plan.path.at(period * np.arange(int(np.ceil(plan.path.duration / period)) + 1))[0]
    else:
        trace = (
            free
            if method == METHODS[3]
            else _driven(scene, config, known.barrier, known if method == METHODS[1] else None)
        )
        outcome = trace if isinstance(trace, str) else trace.outcome.value
        position = None if isinstance(trace, str) else trace.position
    seconds = time.perf_counter() - start
    steps = trace.steps if isinstance(trace, ReplayTrace) else ()
    figures = None if position is None else _figures(scene, config, known, position)
    seen, over = (np.nan, np.nan) if position is None else _seen(scene, known, position)
    nan = np.nan
    return Trial(
        seed=scene.seed,
        method=method,
        num_things=len(scene.primitives) - 5,
        needs_avoiding=needs,
        outcome=outcome,
        success=figures is not None and figures.has_arrived,
        duration_s=figures.duration if figures else nan,
        joint_path_rad=figures.joint_path if figures else nan,
        effector_path_m=figures.effector_path if figures else nan,
        effector_path_deg=figures.effector_turn if figures else nan,
        min_proxy=figures.clearance["barrier"] if figures else nan,
        min_exact=figures.clearance["exact"] if figures else nan,
        min_proved=figures.proved if figures else nan,
        min_true=figures.true_clearance or nan if figures else nan,
        min_seen=seen,
        largest_over=over,
        num_interventions=sum(bool(step.interventions) for step in steps),
        num_relaxed=sum(step.rung is Rung.RELAXED for step in steps),
        num_held=sum(step.rung is Rung.HOLD for step in steps),
        num_detours=len(trace.detours) if isinstance(trace, ReplayTrace) else 0,
        seconds=seconds,
    )


def _driven(scene: TableScene, config: Config, field: DistanceField, planned_in: Known | None) -> ReplayTrace | str:
    """The closed loop, or the words in which it was refused."""
    model = sample_robot()
    control, plan_detour = config.control, None
    if planned_in is not None:
        control = replace(control, max_detours=DETOURS)
        plan_detour = planned_detours(model, lambda stamp: planned_in, FRAME, config.planner, control)
    try:
        return closed_loop(model, control, _replay_task(scene), lambda stamp: field, plan_detour=plan_detour)
    except SplatCtrlError as error:
        return str(error)


def _replay_task(scene: TableScene) -> ReplayTask:
    return ReplayTask(start=scene.task.start, T_world_goal=scene.task.T_world_goal, frame=FRAME, stamp_ns=STAMP_NS)


def _nothing() -> SphereField:
    """A field with nothing within reach."""
    return SphereField(np.array([[50.0, 0.0, 0.0]], np.float32), np.array([0.01], np.float32))


def _figures(scene: TableScene, config: Config, known: Known, position: Float64) -> MotionFigures:
    stamps = STAMP_NS + np.round(np.arange(len(position)) * config.control.period * 1e9).astype(np.int64)
    yardstick = Yardstick(
        model=sample_robot(),
        frame=FRAME,
        T_world_goal=scene.task.T_world_goal,
        config=config.control,
        distances_at=lambda stamp: {
            "barrier": lambda points: known.barrier.query(points)[0],
            "exact": lambda points: known.exact.query(points)[0],
        },
        certified_at=lambda stamp: known.distance,
        truth=lambda points, stamp: scene.distance(points),
    )
    return yardstick.figures(Motion(stamp_ns=stamps, position=position))


def _clearances(scene: TableScene, position: Float64) -> tuple[Float64, Float64, Float64]:
    """True clearance (K,) [m] of every moving sphere at every posture (T, J), the centres (K, 3), the radii (K,)."""
    model = sample_robot()
    moving = np.flatnonzero(model.moving_spheres)
    centers = np.ascontiguousarray(model.sphere_centers_batch(position)[:, moving].reshape(-1, 3))
    radii = np.tile(model.sphere_set.radii[moving], len(position))
    return scene.distance(centers) - radii, centers, radii


def _seen(scene: TableScene, known: Known, position: Float64) -> tuple[float, float]:
    """Least clearance [m] to what a camera saw, and the largest over-estimate of the controller's field near it."""
    clearance, centers, radii = _clearances(scene, position)
    near = np.flatnonzero(clearance < 2 * NEAR)
    if not len(near):
        return float(np.min(clearance)), np.nan
    seen = scene.distance_to_seen(centers[near])
    field = known.barrier.query(np.ascontiguousarray(centers[near]))[0]
    counts = field - radii[near] < NEAR
    over = float(np.max((field - seen)[counts])) if counts.any() else np.nan
    return float(np.min(seen - radii[near])), over


def _is_missed(rows: Sequence[Trial]) -> bool:
    """Whether a controlled motion came nearer than BAR to what was seen, or too few reached the goal."""
    controlled = [row for row in rows if row.method in METHODS[:2]]
    with_ways_out = [row for row in controlled if row.method == METHODS[1]]
    reached = sum(row.success for row in with_ways_out) / len(with_ways_out)
    return reached < LEAST_REACHED or any(row.min_seen < BAR for row in controlled)


def _report(rows: Sequence[Trial]) -> None:
    columns = (
        *("method", "reached", "seen < 15 mm", "hits of seen", "hits of unseen", "least true / seen [mm]"),
        *(
            "proxy / proved [mm], medians",
            "joint path [rad]",
            "effector [m]",
            "[deg]",
            "time [s]",
            "intervened steps",
        ),
        *("relaxed steps", "held steps", "ways out"),
    )
    lines = []
    for method in METHODS:
        of = [row for row in rows if row.method == method]
        moved = [row for row in of if np.isfinite(row.min_true)]
        done = [row for row in moved if row.success]
        lines.append(
            [
                method,
                f"{sum(row.success for row in of)}/{len(of)}",
                str(sum(row.min_seen < BAR for row in moved)),
                str(sum(row.min_seen < 0 for row in moved)),
                str(sum(row.min_true < 0 <= row.min_seen for row in moved)),
                f"{1e3 * min(row.min_true for row in moved):.1f} / {1e3 * min(row.min_seen for row in moved):.1f}",
                f"{_median(moved, 'min_proxy', 1e3):.1f} / {_median(moved, 'min_proved', 1e3):.1f}",
                *(f"{_median(done, name):.2f}" for name in ("joint_path_rad", "effector_path_m")),
                f"{_median(done, 'effector_path_deg'):.0f}",
                f"{_median(done, 'duration_s'):.2f}",
                *(str(sum(getattr(row, name) for row in of)) for name in _COUNTS),
            ]
        )
    print("\n".join(table(columns, lines)))
    first = [row for row in rows if row.method == METHODS[0]]
    print(f"{sum(row.needs_avoiding for row in first)} of {len(first)} tasks need avoiding")
    for row in rows:
        if row.method != METHODS[3] and not (row.success and row.min_seen >= BAR and row.min_true >= 0):
            print(
                f"seed {row.seed}, {row.method}: {row.outcome}; least true clearance {1e3 * row.min_true:.1f} mm,"
                f" to what was seen {1e3 * row.min_seen:.1f} mm"
            )


_COUNTS = ("num_interventions", "num_relaxed", "num_held", "num_detours")


def _median(rows: Sequence[Trial], name: str, scale: float = 1.0) -> float:
    return scale * float(np.median([getattr(row, name) for row in rows])) if rows else np.nan


if __name__ == "__main__":
    raise SystemExit(main())
