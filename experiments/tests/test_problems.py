"""Problems by their name: drawn ones by their seed, and an archive's, of this robot and whole."""

import re
import tarfile
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from experiments.problems import ARCHIVE, ROBOT, read_problem
from splatctrl_cli.errors import InputError
from splatctrl_cli.simulate.arm import arm_urdf

SCENE = """
world:
  collision_objects:
  - id: can
    primitives: [{type: cylinder, dimensions: [0.3, 0.05]}]
    primitive_poses: [{position: [0.5, 0.1, 0.2], orientation: [0, 0, 0, 1]}]
"""
REQUEST = """
start_state:
  joint_state: {{name: [{names}], position: [{start}]}}
goal_constraints:
- joint_constraints: [{goal}]
"""


def archive(folder: Path, names: list[str], scene: str = SCENE) -> Path:
    """A folder with one problem of a family, whose joints have these names."""
    goal = ", ".join(f"{{joint_name: {name}, position: {0.1 * k}}}" for k, name in enumerate(names))
    request = REQUEST.format(names=", ".join(names), start=", ".join("0.2" for _ in names), goal=goal)
    with tarfile.open(folder / ARCHIVE, "w:bz2") as file:
        for name, text in (("scene0001", scene), ("request0001", request)):
            member = tarfile.TarInfo(f"problems/cage_panda/{name}.yaml")
            member.size = len(text)
            file.addfile(member, BytesIO(text.encode()))
    (folder / ROBOT).write_text(_with_spheres(), encoding="utf-8")
    return folder


def _with_spheres() -> str:
    """The simulated arm with a ball for each link."""
    ball = '<collision><geometry><sphere radius="0.05"/></geometry></collision>'
    return re.sub(r'(<link name="\w+">).*?</link>', rf"\1{ball}</link>", arm_urdf(), flags=re.DOTALL)


def test_a_drawn_problem_is_that_of_its_seed() -> None:
    problem, again = read_problem("tabletop-0003", None), read_problem("tabletop-0003", None)
    assert (problem.number, problem.name) == (3, "tabletop-0003")
    assert problem.start.tolist() == again.start.tolist()
    assert {p.name for p in problem.primitives} > {p.name for p in problem.things}  # it stands in a room


def test_an_archive_gives_postures_in_the_robots_order_and_moveits_cylinders(tmp_path: Path) -> None:
    names = [f"joint{k}" for k in range(7, 0, -1)]
    problem = read_problem("cage-0001", archive(tmp_path, names))
    np.testing.assert_allclose(problem.start, 0.2)
    np.testing.assert_allclose(problem.goal, 0.1 * np.arange(6, -1, -1))
    (can,) = problem.things
    assert (can.kind, can.size) == ("cylinder", (0.05, 0.3))  # MoveIt: height, then radius


@pytest.mark.parametrize(
    ("name", "joints", "scene", "said"),
    [
        ("garden-0001", [f"joint{k}" for k in range(1, 8)], SCENE, "expected ENVIRONMENT-NUMBER"),
        ("cage-0002", [f"joint{k}" for k in range(1, 8)], SCENE, "has no cage-0002"),
        ("cage-0001", [f"ur_joint{k}" for k in range(1, 7)], SCENE, "cage-0001: is of another robot: expected joint"),
        ("cage-0001", [f"joint{k}" for k in range(1, 8)], "world: 3", "cage-0001: damaged"),
    ],
)
def test_what_is_not_a_problem_of_this_robot_is_refused_by_name(
    tmp_path: Path, name: str, joints: list[str], scene: str, said: str
) -> None:
    folder = archive(tmp_path, joints, scene)
    with pytest.raises(InputError, match=said):
        read_problem(name, folder)


def test_an_archive_that_is_cut_off_is_refused(tmp_path: Path) -> None:
    folder = archive(tmp_path, [f"joint{k}" for k in range(1, 8)])
    (folder / ARCHIVE).write_bytes((folder / ARCHIVE).read_bytes()[:60])
    with pytest.raises(InputError, match=f"{ARCHIVE}: cannot be read"):
        read_problem("cage-0001", folder)
