"""The 350 Panda problems of MotionBenchMaker, as a study reads them, without a room about them."""

from dataclasses import dataclass
from pathlib import Path

from splatctrl_cli.jobs.simulated_task import solids_of
from splatctrl_cli.jobs.studies.problems import panda as panda_of
from splatctrl_cli.jobs.studies.problems import read_archive
from splatctrl_cli.planner.solid_scene import Solids
from splatctrl_cli.records import Float64
from splatctrl_cli.robot.model import RobotModel

ROBOT = Path("vamp_panda/resources/panda")


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One problem: start and goal (J,) [rad], in the order of the robot's joints."""

    family: str
    number: str
    scene: Solids
    start: Float64
    goal: Float64

    @property
    def name(self) -> str:
        """Family and number."""
        return f"{self.family} {self.number}"


def panda(real_data: Path) -> RobotModel:
    """The Panda with its 59 spheres."""
    return panda_of(real_data / ROBOT)


def read_problems(real_data: Path, model: RobotModel) -> list[Problem]:
    """Every problem of the archive, by family and number."""
    return [
        Problem(
            family=problem.environment,
            number=f"{problem.number:04d}",
            scene=solids_of(problem.things),
            start=problem.start,
            goal=problem.goal,
        )
        for problem in read_archive(real_data / ROBOT, model)
    ]
