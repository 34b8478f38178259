"""Small URDFs and meshes for the tests of collision geometry; and arms with a known answer."""

from collections.abc import Iterable, Sequence
from itertools import product
from pathlib import Path

import numpy as np
import trimesh

from splatctrl_cli.config.fixed import COVERED_EDGE
from splatctrl_cli.records import Float64, SphereSet
from splatctrl_cli.robot.coverage import CoverageReport, coverage_of_solids
from splatctrl_cli.robot.link_meshes import read_solids
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_margins import SelfSurfaces
from splatctrl_cli.robot.self_model import LearnedLink, SelfModel
from splatctrl_cli.robot.urdf import UrdfFile, read_urdf

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


def coverage_deficit(
    urdf: UrdfFile, spheres: SphereSet, *, folders: Sequence[Path] = (), resolution: float = COVERED_EDGE
) -> CoverageReport:
    """How spheres cover the collision geometry of a URDF, read from its folders."""
    return coverage_of_solids(urdf, read_solids(urdf, folders), spheres, resolution=resolution)


def held_part(link: str, triangles: Float64, start_ns: int, end_ns: int) -> SelfModel:
    """A self-model of one link, which holds a closed surface (F, 3, 3) [m] for a time."""
    part = LearnedLink(
        link=link,
        origin=np.zeros(3),
        voxel=0.004,
        distance=np.zeros((1, 1, 1), np.float32),
        configurations=np.zeros((1, 1, 1), np.uint8),
        triangles=triangles,
        outside_95=0.04,
        outside_most=0.05,
        place=triangles[0, 0],
        since=0.0,
        num_pixels=100,
        num_configurations=5,
        start_ns=start_ns,
        end_ns=end_ns,
    )
    return SelfModel(links=(link,), digest="", learned=(part,), unknown={})


def l_shape() -> trimesh.Trimesh:
    """A closed mesh that is not convex: two boxes that share a face, joined."""
    outline = [(0, 0), (0.3, 0), (0.3, 0.1), (0.1, 0.1), (0.1, 0.3), (0, 0.3)]
    vertices = [(x, y, z) for z in (0.0, 0.1) for x, y in outline]
    n = len(outline)
    sides = [f for i in range(n) for j in [(i + 1) % n] for f in ([i, j, j + n], [i, j + n, i + n])]
    cap = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]
    caps = [[a, c, b] for a, b, c in cap] + [[a + n, b + n, c + n] for a, b, c in cap]
    return trimesh.Trimesh(np.array(vertices), np.array(sides + caps), process=False)


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
    model = model.replace_coverage(coverage_of_solids(model.urdf, solids, model.sphere_set))
    return model, SelfSurfaces(model, solids)


A = (0.0, -0.6127, -0.57155, 0.0, 0.0, 0.0)
D = (0.1807, 0.0, 0.0, 0.17415, 0.11985, 0.11655)
ALPHA = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)
HALF = repr(np.pi / 2)
JOINTS = (  # joint, child, origin xyz, rpy, position and velocity limit
    ("shoulder_pan_joint", "shoulder_link", f"0 0 {D[0]}", "0 0 0", 6.2832, 2.0944),
    ("shoulder_lift_joint", "upper_arm_link", "0 0 0", f"{HALF} 0 0", 6.2832, 2.0944),
    ("elbow_joint", "forearm_link", f"{A[1]} 0 0", "0 0 0", 3.1416, 3.1416),
    ("wrist_1_joint", "wrist_1_link", f"{A[2]} 0 {D[3]}", "0 0 0", 6.2832, 3.1416),
    ("wrist_2_joint", "wrist_2_link", f"0 {-D[4]} 0", f"{HALF} 0 0", 6.2832, 3.1416),
    ("wrist_3_joint", "wrist_3_link", f"0 {D[5]} 0", f"{-np.pi / 2!r} 0 0", 6.2832, 3.1416),
)


def ur10e_urdf() -> str:
    """A URDF of links, joints and limits."""
    links = ["base_link", *(joint[1] for joint in JOINTS), "tool0"]
    lines = [f'<link name="{link}"/>' for link in links]
    for (name, child, xyz, rpy, limit, velocity), parent in zip(JOINTS, links, strict=False):
        lines.append(
            f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="0 0 1"/>'
            f'<limit lower="{-limit}" upper="{limit}" velocity="{velocity}" effort="100"/></joint>'
        )
    lines.append('<joint name="flange" type="fixed"><parent link="wrist_3_link"/><child link="tool0"/></joint>')
    return f'<robot name="ur10e">{"".join(lines)}</robot>'


def flange(q: Float64) -> Float64:
    """T_base_flange (4, 4) as the product of the six Denavit-Hartenberg matrices, in UR's base frame."""
    T = np.eye(4)
    for theta, a, d, alpha in zip(q, A, D, ALPHA, strict=True):
        c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        T = T @ np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])
    return T


COLLADA = """<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="meter" meter="1"/><up_axis>Z_UP</up_axis></asset><library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="{count}">{numbers}</float_array><technique_common>
<accessor source="#a" count="{vertices}" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source><vertices id="v"><input semantic="POSITION"
source="#p"/></vertices><triangles count="{faces}"><input semantic="VERTEX" source="#v" offset="0"/><p>{indices}</p>
</triangles></mesh></geometry></library_geometries><library_visual_scenes><visual_scene id="s"><node>
<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes><scene>
<instance_visual_scene url="#s"/></scene></COLLADA>"""


def collada(mesh: trimesh.Trimesh) -> str:
    """The mesh as COLLADA text, in metres."""
    numbers, indices = (" ".join(map(str, values.ravel().tolist())) for values in (mesh.vertices, mesh.faces))
    return COLLADA.format(
        numbers=numbers,
        indices=indices,
        count=mesh.vertices.size,
        vertices=len(mesh.vertices),
        faces=len(mesh.faces),
    )
