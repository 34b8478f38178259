"""The closed loop's ways out of local minima, planned in the scene as it was known at the time of the stall."""

from dataclasses import dataclass

from splatctrl_cli.config import Config
from splatctrl_cli.control.audit import DistanceFunction
from splatctrl_cli.control.goals import PlanDetour
from splatctrl_cli.control.replay import ReplayTask
from splatctrl_cli.jobs.replay.known_scene import KnownFields
from splatctrl_cli.jobs.replay.request import ReplayInputs
from splatctrl_cli.planner.planned import planned_detours

ROUNDING = 1e-5  # [m] taken off distances to splats, far above what float32 rounds within 8 m


def planned_ways_out(inputs: ReplayInputs, task: ReplayTask, config: Config) -> PlanDetour | None:
    """What plans the closed loop's ways out of local minima; None where it may take none."""
    if config.control.max_detours == 0:
        return None
    return planned_detours(
        inputs.model,
        lambda stamp_ns: Certified(distance=certified_distance(inputs.scene.at(stamp_ns))),
        task.frame,
        config.planner,
        config.control,
        home=task.home,
    )


@dataclass(frozen=True, kw_only=True)
class Certified:
    """A scene to plan in: a lower bound of the exact distance to the splats."""

    distance: DistanceFunction


def certified_distance(fields: KnownFields) -> DistanceFunction:
    """A lower bound of a 1-Lipschitz distance: of a grid its certified one, of splats the exact one less rounding.

    Both bound the exact distance to the splats, so what is proved of an edge is proved of that. Of the kernel fields
    nothing can be proved from samples: their slope has no useful bound.
    """
    certified = fields.distances.get("certified")
    if certified is not None:
        return certified
    exact = fields.distances["exact"]
    return lambda points: exact(points) - ROUNDING
