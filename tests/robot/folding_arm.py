"""An arm whose hand is never far from its forearm: a drum turns 22 mm above a block, and its blade folds into it."""

from collections.abc import Iterable
from itertools import product
from pathlib import Path

import numpy as np

from splatctrl_cli.records import SphereSet
from splatctrl_cli.robot.coverage import coverage_of_solids
from splatctrl_cli.robot.link_gaps import SelfSurfaces
from splatctrl_cli.robot.link_meshes import read_solids
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.urdf import read_urdf
from tests.robot.shapes import written

GAP = 0.022  # [m] between block and drum, in every posture
OPEN, FOLDED, CROSSED = np.array([0.5, 1.2]), np.array([0.5, 2.2]), np.array([0.5, 2.4])  # [rad]
NECK = '<origin xyz="0 0 0.01"/><geometry><cylinder radius="0.01" length="0.02"/></geometry>'
DRUM = '<origin rpy="1.5707963267948966 0 0"/><geometry><cylinder radius="0.03" length="0.06"/></geometry>'
BLADE = '<origin xyz="0 0 0.08"/><geometry><box size="0.02 0.05 0.12"/></geometry>'
LIMIT = '<limit lower="-2.4" upper="2.4" velocity="1" effort="1"/>'
URDF = f"""<robot name="folding">
<link name="block"><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
<link name="neck"><collision>{NECK}</collision></link>
<link name="drum"><collision>{DRUM}</collision><collision>{BLADE}</collision></link>
<joint name="turn" type="revolute"><parent link="block"/><child link="neck"/><origin xyz="0 0 0.05"/>
<axis xyz="0 0 1"/>{LIMIT}</joint>
<joint name="fold" type="revolute"><parent link="neck"/><child link="drum"/><origin xyz="0 0 0.052"/>
<axis xyz="0 1 0"/>{LIMIT}</joint></robot>"""


PARTS = ("block", "neck", "drum", "blade")


def covering_spheres(scale: float = 1.0, parts: Iterable[str] = PARTS) -> SphereSet:
    """Spheres about the cells that the parts are cut into, which cover them; radii times a scale."""
    found = [("block", center, 0.0434) for center in product((-0.025, 0.025), repeat=3)]
    found += [("neck", (0.0, 0.0, 0.01), 0.0142)]
    found += [("drum", (0.0, y, 0.0), 0.0336) for y in (-0.015, 0.015)]
    found += [("blade", (0.0, 0.0, z), 0.0309) for z in (0.035, 0.065, 0.095, 0.125)]
    found = [row for row in found if row[0] in parts]
    return SphereSet(
        links=tuple("drum" if part == "blade" else part for part, _, _ in found),
        centers=np.array([center for _, center, _ in found]),
        radii=scale * np.array([radius for _, _, radius in found]),
    )


def folding_arm(folder: Path, spheres: SphereSet, urdf: str = URDF) -> tuple[RobotModel, SelfSurfaces]:
    """The arm with its spheres measured, and its surfaces."""
    file = written(folder, urdf)
    solids = read_solids(read_urdf(file))
    model = RobotModel.from_urdf(file, spheres)
    model = model.with_coverage(coverage_of_solids(model.urdf, solids, model.sphere_set))
    return model, SelfSurfaces(model, solids)
