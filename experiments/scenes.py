"""The scenes of IV-C as problems, with known paths to a cube and from there to a bowl.

J joints.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.drawn_task import solids_of
from experiments.pick_and_place import HEIGHTS, HELD, HOME, LAYOUTS, PickAndPlace, drawn_scene
from experiments.problems import Problem, named, room, simulated_arm
from splatctrl_cli import InputError
from splatctrl_cli.blocks import (
    Clearance,
    ControlConfig,
    Float64,
    PlannerConfig,
    Primitive,
    RobotModel,
    goal_postures,
    plan,
    random_postures,
)

HAND = "hand"
ROOM = 0.05  # [m] that a way through a scene keeps: 2 cm, and what a map may err by
SPARE = 0.002  # [m] more of its ends
ATTEMPTS = 50  # scenes drawn until one has a way
GUESSES = 24  # random postures that the search for a pose begins with
POSTURES = 6  # at a pose


@dataclass(frozen=True, kw_only=True)
class Scene:
    """The objects, the arm, and postures (J,) [rad] over cube and bowl with a path between them.

    num_refused: scenes of its name that were drawn before it and have none.
    """

    layout: str
    number: int
    drawn: PickAndPlace
    model: RobotModel
    hover: Float64
    place: Float64
    num_refused: int

    @property
    def carrying(self) -> RobotModel:
        """The arm with the cube in its hand."""
        return self.model.carrying([(HAND, HELD)])

    def to_cube(self) -> Problem:
        """The problem from home to over the cube, which is an obstacle."""
        return self._problem(self.model, (*self.drawn.things, self.drawn.cube), np.array(HOME), self.hover)

    def to_bowl(self, start: Float64) -> Problem:
        """The problem from over the cube's place to over the bowl, with the cube as part of the arm."""
        return self._problem(self.carrying, self.drawn.things, start, self.place)

    def _problem(self, model: RobotModel, things: Sequence[Primitive], start: Float64, goal: Float64) -> Problem:
        return Problem(
            environment=self.layout, number=self.number, model=model, things=tuple(things), start=start, goal=goal
        )


def read_scene(name: str) -> Scene:
    """The scene of a name, LAYOUT-NUMBER: the first draw with a path among the true solids.

    Raises InputError for an unknown name.
    """
    layout, number = named(name, LAYOUTS, "layout")
    model = simulated_arm()
    for attempt in range(ATTEMPTS):
        drawn = drawn_scene(layout, number, attempt)
        ends = _ends(drawn, model)
        if ends is not None:
            return Scene(
                layout=layout,
                number=number,
                drawn=drawn,
                model=model,
                hover=ends[0],
                place=ends[1],
                num_refused=attempt,
            )
    raise InputError(f"--problem {name}: none of {ATTEMPTS} scenes has a way", remedy="give another number")


def problems(trials: int | None, archive: Path | None) -> list[tuple[str, int]]:
    """Layout and number of the twelve scenes, or of at most `trials` of each layout."""
    num = len(HEIGHTS) if trials is None else min(trials, len(HEIGHTS))
    return [(layout, number) for layout in LAYOUTS for number in range(num)]


def _ends(drawn: PickAndPlace, model: RobotModel) -> tuple[Float64, Float64] | None:
    """Postures over cube and bowl with a path from home over the cube to the bowl; None without one."""
    carrying, home = model.carrying([(HAND, HELD)]), np.array(HOME)
    before = Clearance.of(model, solids_of([*drawn.things, drawn.cube, *room()]), margin=ROOM)
    after = Clearance.of(carrying, solids_of([*drawn.things, *room()]), margin=ROOM)
    guesses = np.vstack([home, random_postures(model, GUESSES, seed=0)])
    control = ControlConfig()
    hovers = goal_postures(model, HAND, drawn.T_world_hover, guesses, control, at_most=POSTURES)
    places = goal_postures(model, HAND, drawn.T_world_place, guesses, control, at_most=POSTURES)
    hovers, places = _free(hovers, before, after), _free(places, after)
    if not len(hovers) or not len(places) or before.at(home[None])[0] <= 0:
        return None
    reached = plan(before, home, hovers, PlannerConfig())
    if not reached.is_solved:
        return None
    carried = plan(after, reached.waypoints[-1], places, PlannerConfig())
    return (reached.waypoints[-1], carried.waypoints[-1]) if carried.is_solved else None


def _free(postures: Float64, *rooms: Clearance) -> Float64:
    """The postures of (G, J) that are free in all rooms."""
    return postures[[all(room.at(q[None])[0] > SPARE for room in rooms) for q in postures]]
