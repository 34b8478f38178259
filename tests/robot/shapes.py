"""Small URDFs and meshes for the tests of collision geometry."""

from pathlib import Path

import numpy as np
import trimesh

BOX = '<box size="0.3 0.2 0.1"/>'
ROD = '<cylinder radius="0.05" length="0.4"/>'
BALL = '<sphere radius="0.08"/>'


def arm_of(first: str, second: str, *, origin: str = "") -> str:
    """A URDF with one hinge between the links `base` and `tip`, each with one collision shape."""
    return f"""<robot name="r"><link name="base"><collision>{origin}<geometry>{first}</geometry></collision></link>
<link name="tip"><collision><geometry>{second}</geometry></collision></link>
<joint name="hinge" type="revolute"><parent link="base"/><child link="tip"/><origin xyz="0 0 0.3"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>"""


def written(folder: Path, text: str, name: str = "robot.urdf") -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def l_shape() -> trimesh.Trimesh:
    """A closed mesh that is not convex: two boxes that share a face, joined."""
    outline = [(0, 0), (0.3, 0), (0.3, 0.1), (0.1, 0.1), (0.1, 0.3), (0, 0.3)]
    vertices = [(x, y, z) for z in (0.0, 0.1) for x, y in outline]
    n = len(outline)
    sides = [f for i in range(n) for j in [(i + 1) % n] for f in ([i, j, j + n], [i, j + n, i + n])]
    cap = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]
    caps = [[a, c, b] for a, b, c in cap] + [[a + n, b + n, c + n] for a, b, c in cap]
    return trimesh.Trimesh(np.array(vertices), np.array(sides + caps), process=False)
