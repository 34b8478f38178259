"""Writes everything in sample_data/ anew: ``.venv/bin/python sample_data/make.py``. The same bytes every time.

The robot comes from the package example-robot-data (extra `sim`).
"""

import shutil
import sys
import tempfile
from functools import partial
from importlib.metadata import files
from pathlib import Path
from unittest.mock import patch
from xml.etree import ElementTree

import fast_simplification
import numpy as np
import trimesh
import zstandard

from splatctrl_cli.cli.main import main
from splatctrl_cli.formats.mesh import load_mesh

HERE = Path(__file__).parent
FILES = ("log.mcap", "truth.json", "robot.urdf", "robot_spheres.yaml")
TIP = "panda_hand"  # simulate takes the last link of a URDF as its tip
MAX_FACES = 2000  # of a visual mesh
NUM_SPHERES = 220  # stick out by 14 mm at most; a replay takes twice as long as with 64, which stick out by 25 mm
IMAGES = ("--width", "256", "--height", "192", "--noise", "stereo")
ZSTD_LEVEL = 19  # of the log's chunks: a fifth smaller than by default


def make(destination: Path) -> int:
    """Simulate the Panda, a DTU scan too; keep all but run.json, which holds timings."""
    with tempfile.TemporaryDirectory() as folder:
        out, urdf, spheres = (Path(folder) / name for name in ("simulated", "panda.urdf", "spheres.yaml"))
        write_panda(urdf)
        packed = patch("mcap.writer.zstandard.compress", partial(zstandard.compress, level=ZSTD_LEVEL))
        robot = ("--urdf", str(urdf))
        code = main(["robot", "spheres", *robot, "--max-spheres", str(NUM_SPHERES), "-o", str(spheres), "--quiet"])
        with packed:
            given = (*robot, "--spheres", str(spheres), *IMAGES)
            code = code or main(["simulate", *given, "--out", str(out), "--dtu", "--quiet"])
        if code != 0:
            return code
        (destination / "tabletop").mkdir(parents=True, exist_ok=True)
        for name in FILES:
            shutil.copyfile(out / name, destination / "tabletop" / name)
        shutil.copytree(out / "meshes", destination / "tabletop" / "meshes", dirs_exist_ok=True)
        shutil.rmtree(destination / "dtu", ignore_errors=True)
        shutil.copytree(out / "dtu", destination / "dtu")
    return 0


def write_panda(urdf: Path) -> None:
    """The Panda with its hand: collision meshes as they are, visual meshes of fewer faces, relative paths."""
    (source,) = (Path(str(f.locate())) for f in files("example-robot-data") or () if f.name == "panda.urdf")
    tree = ElementTree.parse(source)
    robot = tree.getroot()
    (hand,) = (link for link in robot.findall("link") if link.get("name") == TIP)
    robot.remove(hand)
    robot.append(hand)
    for mesh in robot.iter("mesh"):
        name = Path(mesh.attrib["filename"].partition("/meshes/")[2])
        copy = urdf.parent / name.with_suffix(".stl")
        copy.parent.mkdir(exist_ok=True)
        _write_fewer_faces(source.parents[1] / "meshes" / name, copy)
        mesh.set("filename", copy.relative_to(urdf.parent).as_posix())
    tree.write(urdf, encoding="utf-8", xml_declaration=True)


def _write_fewer_faces(source: Path, copy: Path) -> None:
    if source.suffix == ".stl":
        shutil.copyfile(source, copy)
        return
    mesh = load_mesh(source)
    vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)
    if len(faces) > MAX_FACES:
        vertices, faces = fast_simplification.simplify(vertices, faces, target_count=MAX_FACES)
    trimesh.Trimesh(vertices, faces, process=False).export(copy)


if __name__ == "__main__":
    sys.exit(make(HERE if len(sys.argv) < 2 else Path(sys.argv[1])))
