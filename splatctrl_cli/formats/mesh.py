"""Triangle meshes from files."""

from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from defusedxml import ElementTree

from splatctrl_cli.errors import refuse_faults, refuse_if
from splatctrl_cli.libraries import trimesh
from splatctrl_cli.records import Float64, Index

STL_HEADER, STL_FACE = 84, 50  # bytes; the header ends with the number of faces


@dataclass(frozen=True, kw_only=True)
class TriangleMesh:
    """Vertices (V, 3) float64 [m]; faces (F, 3) int64, counter-clockwise from outside.

    is_closed: every edge has two faces in opposite directions. note: ignored parts.
    """

    vertices: Float64
    faces: Index
    is_closed: bool
    note: str = ""

    @property
    def corners(self) -> Float64:
        """The three corners of each face, (F, 3, 3) [m]."""
        return self.vertices[self.faces]


def load_mesh(path: Path) -> TriangleMesh:
    """Load a mesh with trimesh (OBJ, STL, PLY, OFF, GLB, COLLADA), all parts as one.

    Vertices at one place are merged. COLLADA is scaled by its unit; its up axis is ignored, as in RViz. Bytes after a
    binary STL's faces are noted. Raises InputError if unreadable, without triangles, or not finite.
    """
    refuse_if(not path.is_file(), f"{path}: expected a mesh, got no such file")
    kind = path.suffix.lower()
    source, note = _open_mesh(path) if kind in {".stl", ".obj", ".off"} else (path, "")
    with refuse_faults(
        lambda error: f"{path}: expected a mesh, got {type(error).__name__}: {error}",
        Exception,
        remedy="give an OBJ, STL, PLY, GLB or COLLADA file",
    ):  # trimesh raises whatever the reader of the format raises
        loaded = trimesh.load(source, file_type=kind[1:], force="mesh", process=False)
        unit = ElementTree.parse(path).find("{*}asset/{*}unit") if kind == ".dae" else None
        scale = 1.0 if unit is None else float(unit.get("meter", "1"))  # metres per unit
    refuse_if(
        not isinstance(loaded, trimesh.Trimesh) or not len(loaded.faces),
        f"{path}: expected a mesh, got no triangle",
        remedy="give a mesh with faces, not a cloud",
    )
    refuse_if(not np.isfinite(loaded.vertices).all(), f"{path}: expected finite vertices, got some that are not")
    loaded.merge_vertices(merge_tex=True, merge_norm=True)
    loaded.update_faces(loaded.nondegenerate_faces())
    return TriangleMesh(
        vertices=scale * np.array(loaded.vertices, dtype=np.float64),
        faces=np.array(loaded.faces, dtype=np.int64),
        is_closed=bool(loaded.is_watertight and loaded.is_winding_consistent),
        note=note,
    )


def _open_mesh(path: Path) -> tuple[BytesIO | Path, str]:
    content = path.read_bytes()
    num = int.from_bytes(content[STL_HEADER - 4 : STL_HEADER], "little")
    end = STL_HEADER + STL_FACE * num  # of a text: gigabytes
    if path.suffix.lower() == ".stl" and len(content) >= STL_HEADER:
        if end <= len(content):
            rest = len(content) - end
            return BytesIO(content[:end]), (
                f"{path.name}: {rest} bytes after its {num} faces are ignored" if rest else ""
            )
        refuse_if(
            b"facet" not in content.lower(),
            f"{path}: expected {end} bytes for {num} faces, got {len(content)}",
            remedy="copy or write the file again",
        )
    try:
        content.decode()
    except UnicodeDecodeError:
        return BytesIO(content.decode("utf-8", "replace").encode()), ""
    return path, ""
