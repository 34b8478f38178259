"""Robots of other tools: URDF, meshes, sphere files."""

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from tests.cases.case import Case, Run, expect_result

SIZE = (0.1, 0.2, 0.3)  # [m] of the mesh

LIMIT = '<limit lower="-3" upper="3" velocity="2" effort="5"/>'


def urdf_of(mesh: str, joint: str = '<axis xyz="0 0 1"/>', kind: str = "revolute", scale: str = "") -> str:
    """A box, and a mesh that turns on top of it."""
    shape = f'<mesh filename="package://pkg/meshes/{mesh}"{scale}/>'
    return (
        '<robot name="r"><link name="base"><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision>'
        "</link>"
        f'<link name="l1"><collision><geometry>{shape}</geometry></collision></link><joint name="j" type="{kind}">'
        f'<parent link="base"/><child link="l1"/><origin xyz="0 0 0.3"/>{joint}{LIMIT}</joint></robot>'
    )


def stl(scale: float = 1.0, head: bytes = b"", tail: bytes = b"") -> bytes:
    """A binary STL of a box."""
    rows = np.zeros(12, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    rows["corners"] = scale * trimesh.creation.box(SIZE).triangles
    return head.ljust(80, b" ")[:80] + struct.pack("<I", 12) + rows.tobytes() + tail


def dae(unit: str, up: str = "Z_UP", extra: str = "", place: str = "") -> str:
    """A COLLADA file of a box of 10 x 20 x 30 units."""
    box = trimesh.creation.box([10, 20, 30])
    positions = " ".join(f"{value:g}" for value in box.vertices.ravel())
    corners = " ".join(map(str, box.faces.ravel()))
    dates = "<created>2020-01-01T00:00:00</created><modified>2020-01-01T00:00:00</modified>"
    return f"""<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><contributor/>{dates}{unit}<up_axis>{up}</up_axis></asset><library_geometries><geometry id="g"><mesh>
<source id="s"><float_array id="a" count="24">{positions}</float_array><technique_common>
<accessor source="#a" count="8" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#s"/></vertices>
<triangles count="12"><input semantic="VERTEX" source="#v" offset="0"/><p>{corners}</p></triangles>
</mesh></geometry></library_geometries><library_visual_scenes>{extra.format(dates=dates)}<visual_scene id="e">
<node id="n">{place}<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#e"/></scene></COLLADA>"""


def written(folder: Path, robots: Mapping[str, str], meshes: Mapping[str, str | bytes]) -> None:
    """URDFs in a folder, and their meshes in its package."""
    (folder / "pkg" / "meshes").mkdir(parents=True)
    for name, text in robots.items():
        (folder / name).write_text(text)
    for name, content in meshes.items():
        (folder / "pkg" / "meshes" / name).write_bytes(content.encode() if isinstance(content, str) else content)


ANY = ("--require", "max_deficit<=9")  # however little they cover


def areas(run: Run, urdf: Path, out: Path) -> dict[str, float]:
    """[cm2] of each link, as `robot check` measures it with a sphere on each, whether they cover it or not."""
    spheres = out / "areas.yaml"
    spheres.write_text(json.dumps({"collision_spheres": {link: [SMALL] for link in ("base", "l1")}}))
    words = ["robot", "check", "--urdf", urdf, "--packages", urdf.parent, "--spheres", spheres, "--json"]
    links = json.loads(expect_result(run, [*words, *ANY]).out)["links"]
    return {link["link"]: round(1e4 * link["area"], 3) for link in links}


def _zero_axis(folder: Path) -> None:
    robots = {"07-plain-stl.urdf": urdf_of("plain.stl"), "27-axis0.urdf": urdf_of("plain.stl", '<axis xyz="0 0 0"/>')}
    written(folder, robots, {"plain.stl": stl()})


def _examine_zero_axis(folder: Path, out: Path, run: Run) -> None:
    expect_result(run, ["robot", "info", "--urdf", folder / "07-plain-stl.urdf"])
    sentence = "joint 'j': axis: expected a direction, got '0 0 0': link 'l1' would never move"
    for words in (["info"], ["check"], ["spheres", "-o", out / "s.yaml"]):
        expect_result(run, ["robot", words[0], "--urdf", folder / "27-axis0.urdf", *words[1:]], sentence, code=4)


AXES = {
    "continuous": ("continuous", '<axis xyz="0 0 0"/>', "expected a direction, got '0 0 0'"),
    "prismatic": ("prismatic", '<axis xyz="0.0 -0 0e3"/>', "expected a direction"),
    "nan": ("revolute", '<axis xyz="nan 0 1"/>', "joint 'j': axis: expected 3 numbers, got 'nan 0 1'"),
    "empty": ("revolute", "<axis/>", "joint 'j': axis: expected 3 numbers, got None"),
    "mimic": ("revolute", '<axis xyz="0 0 0"/><mimic joint="k"/>', "expected a direction"),
    "long": ("revolute", '<axis xyz="0 0 2"/>', ""),
    "missing": ("revolute", "", ""),
}


def _axes(folder: Path) -> None:
    fixed = '<link name="l2"/><joint name="f" type="fixed"><parent link="l1"/><child link="l2"/><axis xyz="0 0 0"/>'
    for name, (kind, axis, _) in AXES.items():
        text = urdf_of("none.stl", axis, kind).replace('<mesh filename="package://pkg/meshes/none.stl"/>', BALL)
        (folder / f"{name}.urdf").write_text(text.replace("</robot>", f"{fixed}</joint></robot>"))


BALL = '<sphere radius="0.05"/>'


def _examine_axes(folder: Path, out: Path, run: Run) -> None:
    for name, (_, _, sentence) in AXES.items():
        expect_result(run, ["robot", "info", "--urdf", folder / f"{name}.urdf"], sentence, code=4 if sentence else 0)


def _examine_dae(folder: Path, out: Path, run: Run) -> None:
    assert areas(run, folder / "07-cm-dae.urdf", out) == {"base": 600.0, "l1": 2200.0}


def _other_meshes(folder: Path) -> None:
    nested = '<asset>{dates}<unit meter="1"/><up_axis>X_UP</up_axis></asset>'
    centimetre = '<unit name="centimeter" meter="0.01"/>'
    text = trimesh.creation.box(SIZE).export(file_type="stl_ascii")
    meshes = {
        "y_up.dae": dae(centimetre, "Y_UP"),
        "nested.dae": dae(centimetre, extra=nested),
        "moved.dae": dae(centimetre, place="<translate>100 0 0</translate>"),
        "no_unit.dae": dae(""),
        "tail.stl": stl(tail=b"\xffcolour" * 9),
        "tail50.stl": stl(tail=bytes(50)),
        "solid.stl": stl(head=b"solid facet of another tool"),
        "solid_tail.stl": stl(head=b"solid facet of another tool", tail=b"x"),
        "latin.stl": text.replace("solid", "solid R\xfcckwand", 1).encode("latin-1"),
        "millimetres.stl": stl(1000.0),
        "cut.stl": stl()[:-60],
    }
    scaled = {"scaled.urdf": urdf_of("millimetres.stl", scale=' scale="0.001 0.001 0.001"')}
    written(folder, {f"{Path(name).stem}.urdf": urdf_of(name) for name in meshes} | scaled, meshes)


def _examine_other_meshes(folder: Path, out: Path, run: Run) -> None:
    for name in ("y_up", "nested", "moved", "tail", "tail50", "solid", "solid_tail", "latin", "scaled"):
        assert areas(run, folder / f"{name}.urdf", out) == {"base": 600.0, "l1": 2200.0}, name
    words = ["--packages", folder, "--spheres", out / "areas.yaml", *ANY]
    for name, bytes_ in (("tail", 63), ("tail50", 50), ("solid_tail", 1)):
        sentence = f"{name}.stl: {bytes_} bytes after its 12 faces are ignored"
        expect_result(run, ["robot", "check", "--urdf", folder / f"{name}.urdf", *words], sentence)
    sentences = {
        "millimetres": "expected a length of 1 mm to 10 m, got 300 m; looks like millimetres: scale=",
        "no_unit": "expected a length of 1 mm to 10 m, got 30 m; looks like millimetres: scale=",
        "cut": "cut.stl: expected 684 bytes for 12 faces, got 624; copy or write the file again",
    }
    for name, sentence in sentences.items():
        for command in (["check", *words], ["spheres", *words[:2], "-o", out / "other.yaml"]):
            expect_result(
                run, ["robot", command[0], "--urdf", folder / f"{name}.urdf", *command[1:]], sentence, code=4
            )


SPHERES = {"base": [{"center": [0, 0, 0], "radius": 0.08}], "l1": [{"center": [0, 0, 0], "radius": 0.04}]}


def _sphere_files(folder: Path) -> None:
    urdf = urdf_of("none.stl").replace('<mesh filename="package://pkg/meshes/none.stl"/>', BALL)
    (folder / "robot.urdf").write_text(urdf)
    lula = {"api_version": 1.0, "cspace": ["j"], "collision_spheres": [{link: s} for link, s in SPHERES.items()]}
    twice = {"collision_spheres": [{"l1": SPHERES["l1"]}, {"base": SPHERES["base"]}, {"l1": SPHERES["l1"]}]}
    groups: dict[str, Any] = {"near": {"spheres": SPHERES}, "far": {"spheres": {"l1": SPHERES["l1"]}}}
    xrdf = {"format": "xrdf", "format_version": 1.0, "geometry": groups}
    collision = {"geometry": "near", "buffer_distance": {"l1": 0.02}}
    files = {
        "lula.yaml": lula,
        "twice.yaml": twice,
        "robot.xrdf": xrdf | {"collision": collision},
        "two.xrdf": xrdf | {"format_version": 2.0, "world_collision": {"geometry": "near"}},
        "unnamed.xrdf": xrdf,
        "other.xrdf": xrdf | {"collision": {"geometry": "none"}},
        "far.xrdf": xrdf | {"collision": {"geometry": "far", "buffer_distance": {"l1": -0.03}}},
    }
    for name, tree in files.items():
        (folder / name).write_text(json.dumps(tree))


def _examine_sphere_files(folder: Path, out: Path, run: Run) -> None:
    def checked(name: str, *more: str, code: int = 0, says: str = "") -> dict[str, Any]:
        words = ["robot", "check", "--urdf", folder / "robot.urdf", "--spheres", folder / name, *more, "--json"]
        found: dict[str, Any] = json.loads(expect_result(run, words, says, code=code).out)
        return found

    wanted = {"lula.yaml": (2, 10.0), "twice.yaml": (3, 10.0), "robot.xrdf": (2, 6.603), "two.xrdf": (2, 10.0)}
    for name, (num, deficit) in wanted.items():
        found = checked(name)
        assert found["metrics"]["num_spheres"] == num
        assert abs(1e3 * found["metrics"]["max_deficit"] - deficit) < 0.05, found["metrics"]
        assert found["layout"] == ("XRDF" if name.endswith("xrdf") else "Lula YAML")
    checked("unnamed.xrdf", code=4, says="got groups near, far")
    checked("other.xrdf", code=4, says="spheres in the group 'none'")
    checked("far.xrdf", code=1, says="coverage: l1 is up to 40.0 mm outside: 1 of 2 links, allowed 20 mm")
    checked("far.xrdf", "--require", "num_spheres>=1", code=1)
    for name, spheres in (
        ("base", {"base": SPHERES["base"]}),
        ("tip", {"l1": [SMALL]}),
        ("both", {**SPHERES, "l1": [SMALL]}),
    ):
        (folder / f"{name}.yaml").write_text(json.dumps({"collision_spheres": spheres}))
        checked(f"{name}.yaml", code=1, says="l1 moves and has no sphere" if name == "base" else "")
    checked("both.yaml", "--require", "max_deficit<=0.045")


SMALL = {"center": [0, 0, 0], "radius": 0.01}

CASES: tuple[Case, ...] = (
    Case(name="11-urdf-zero-axis", make=_zero_axis, examine=_examine_zero_axis, has_shared=True),
    Case(name="urdf-axes-of-other-kinds", make=_axes, examine=_examine_axes),
    Case(
        name="15-dae-unit",
        make=lambda folder: written(
            folder, {"07-cm-dae.urdf": urdf_of("cm.dae")}, {"cm.dae": dae('<unit name="u" meter="0.01"/>')}
        ),
        examine=_examine_dae,
        has_shared=True,
    ),
    Case(name="meshes-of-other-units-and-tails", make=_other_meshes, examine=_examine_other_meshes),
    Case(name="sphere-files-of-other-tools", make=_sphere_files, examine=_examine_sphere_files),
)
