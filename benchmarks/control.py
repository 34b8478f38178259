"""One step of the controller, and the audit of logged states."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import cycle

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.measure import Limit, Options, Result, medians
from benchmarks.scenes import sample_fitter, sample_robot, sample_states
from splatctrl_cli.config import Config
from splatctrl_cli.control.audit import audit
from splatctrl_cli.control.step import QpIkController
from splatctrl_cli.field.clusters import Spheres, field_splats
from splatctrl_cli.field.distance import field_over
from splatctrl_cli.field.grid_cells import GridField
from splatctrl_cli.field.slabs import bake
from splatctrl_cli.records import DistanceField, Float64, SplatSet

NUM_STEPS = 200
CLEAR = 0.04  # [m]
SOLVERS = ("clarabel", "daqp")


def run(options: Options) -> Result:
    """Time steps from the sample log's states towards the last state's pose, and the states' audit."""
    config, model = Config(), sample_robot()
    splats = _scene()
    analytic = field_over(Spheres.of(splats.centers, splats.radii), config.field)
    grid = GridField(bake(splats, model.reach_box, config.field))
    fields: dict[str, DistanceField] = {"grid": grid, "analytic": analytic}
    steps = {f"{name}_{solver}": _step(field, solver) for name, field in fields.items() for solver in SOLVERS}
    points = np.ascontiguousarray(model.sphere_centers(sample_states()[0].position))
    queries = {f"{name}_query": partial(field.query, points) for name, field in fields.items()}
    times = medians(steps | queries, options.rounds(NUM_STEPS))
    audits = medians({name: _audit(field) for name, field in fields.items()}, options.rounds(4))
    names = {"grid": "baked grid, 2 cm", "analytic": f"analytic field, {len(splats)} splats"}
    num_states = len(sample_states())
    return Result(
        title=f"control: an arm of {len(model.joint_names)} joints and {len(points)} spheres",
        columns=("field", "solver", "QP-IK step [ms]", "steps/s", "of it one field query [ms]", "audit [states/s]"),
        rows=[
            [title, solver, f"{1e3 * times[f'{name}_{solver}']:.2f}", f"{1 / times[f'{name}_{solver}']:.0f}",
             f"{1e3 * times[f'{name}_query']:.2f}", f"{num_states / audits[name]:.0f}"]
            for name, title in names.items() for solver in SOLVERS
        ],
        figures={
            **{f"{key}_steps_per_s": 1 / times[key] for key in steps},
            **{f"{name}_query_ms": 1e3 * times[f"{name}_query"] for name in names},
            **{f"{name}_audit_states_per_s": num_states / audits[name] for name in names},
        },
        ratios={f"{name}_daqp_over_clarabel": times[f"{name}_clarabel"] / times[f"{name}_daqp"] for name in names},
        limits=[
            Limit(figure="grid_daqp_steps_per_s", bound=1000.0, is_least=True),
            Limit(figure="grid_clarabel_steps_per_s", bound=400.0, is_least=True),
            Limit(figure="analytic_clarabel_steps_per_s", bound=300.0, is_least=True),
        ],
        notes=["a step: kinematics, one query for the rows, the QP, one query or more that checks the promise"],
    )  # fmt: skip


def _scene() -> SplatSet:
    """The sample log's map without the arm: no splat within 4 cm of the arm at any logged state."""
    model, splats = sample_robot(), field_splats(sample_fitter().splats())
    centers = model.sphere_centers_batch(np.array([state.position for state in sample_states()]))
    is_free = np.ones(len(splats), dtype=np.bool_)
    for sphere, radius in enumerate(model.sphere_set.radii):
        distance = cKDTree(centers[:, sphere]).query(splats.centers)[0]
        is_free &= distance - radius - splats.radii > CLEAR
    return splats.select(is_free)


def _step(field: DistanceField, solver: str) -> Callable[[], object]:
    """The next logged state's step, each time it is called."""
    model, states = sample_robot(), sample_states()
    frame = model.frame_names[-1]
    goal = model.frame_pose(states[-1].position, frame)
    controller = QpIkController(model, replace(Config().control, solver=solver), field, frame=frame)
    chosen = cycle(states[:: max(len(states) // NUM_STEPS, 1)])
    return lambda: controller.step(next(chosen).position, goal)


def _audit(field: DistanceField) -> Callable[[], object]:
    def distance(points: Float64) -> Float64:
        return field.query(points)[0]

    distances, states = {"field": distance}, sample_states()
    stamps, positions = (np.array([getattr(s, name) for s in states]) for name in ("stamp_ns", "position"))
    return lambda: audit(sample_robot(), stamps, positions, lambda stamp_ns: distances)
