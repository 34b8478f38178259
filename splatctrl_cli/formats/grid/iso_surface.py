"""The zero surface of a baked distance as a triangle mesh: ``.ply``, ``.obj``, ``.stl``.

Marching cubes of scikit-image (Lewiner et al. 2003) by slab, joined at a shared layer of cells.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from skimage.measure import marching_cubes

from splatctrl_cli.errors import NotEvaluableError, refuse_faults, refuse_if
from splatctrl_cli.files.summary import Summary
from splatctrl_cli.formats.grid.grid_format import CHUNK, GridFormat, check_grid
from splatctrl_cli.libraries import trimesh
from splatctrl_cli.records import DistanceGrid, Float32, Float64

SUFFIXES = (".ply", ".obj", ".stl")
STEP = 2.0**-13  # [cells] to which vertices are rounded: float32 has no more in a grid of some hundred layers
FURTHEST = np.float32(1e9)  # [m] in place of unknown distances, whose cubes are skipped


def iso_surface(grid: DistanceGrid) -> Any:
    """Extract the zero set of `sdf`, linear between centres; skip cubes with NaN corners.

    A trimesh: vertices (V, 3) float64 [m], world; faces (F, 3) int64, anticlockwise from larger distances.

    Raises NotEvaluableError if no cube crosses 0.
    """
    shape, values = check_grid(grid), grid.channels["sdf"]
    refuse_if(
        min(shape) < 2,
        f"surface: expected at least 2 cells along each axis, got {shape}",
        remedy="bake a larger --box",
        error=NotEvaluableError,
    )
    step = max(1, CHUNK // max(1, values.nbytes // shape[0]))
    vertices, faces, count = [], [], 0
    lowest, highest = np.inf, -np.inf
    for start in range(0, shape[0] - 1, step):
        slab = np.array(values[start : start + step + 1], np.float32)
        is_known = np.isfinite(slab)
        if not is_known.any():
            continue
        lowest, highest = min(lowest, float(slab[is_known].min())), max(highest, float(slab[is_known].max()))
        part = _marching_cubes(slab, is_known)
        if part is not None:
            vertices.append(part[0] + (start, 0.0, 0.0))
            faces.append(part[1].astype(np.int64) + count)
            count += len(part[0])
    got = f"values from {lowest:.4g} to {highest:.4g} m" if lowest <= highest else "no cell that has a distance"
    refuse_if(
        not vertices,
        f"surface: expected sdf to cross 0 m, got {got}",
        remedy="bake with a smaller voxel",
        error=NotEvaluableError,
    )
    return _join(grid, np.concatenate(vertices), np.concatenate(faces))


def write_surface(path: Path, surface: Any) -> None:
    """Write ``.ply`` and ``.obj`` with vertex normals, ``.stl`` with face normals."""
    options: dict[str, dict[str, object]] = {
        ".ply": {"vertex_normal": True},
        ".obj": {"include_normals": True, "header": None},
        ".stl": {},
    }
    content = surface.export(file_type=path.suffix[1:], **options[path.suffix])
    path.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8"))


def _marching_cubes(slab: Float32, is_known: NDArray[np.bool_]) -> tuple[Float64, NDArray[np.int32]] | None:
    """Vertices [cells] and faces; None if no cube of known corners crosses 0."""
    whole = np.ones([n - 1 for n in slab.shape], bool)
    for corner in np.ndindex(2, 2, 2):
        whole &= is_known[tuple(slice(i, n - 1 + i) for i, n in zip(corner, slab.shape, strict=True))]
    is_all = bool(whole.all())
    is_above = np.where(is_known, slab, FURTHEST) > 0.0
    if is_above.all() or not is_above.any():
        return None
    mask = None
    if not is_all:
        mask = np.zeros(slab.shape, bool)
        mask[1:, 1:, 1:] = whole
        slab = np.where(is_known, slab, FURTHEST)
    try:
        vertices, faces, _, _ = marching_cubes(
            slab, 0.0, mask=mask, gradient_direction="descent", allow_degenerate=True
        )
    except (RuntimeError, ValueError):  # which say that no cube crosses 0
        return None
    return vertices.astype(np.float64), faces


def _join(grid: DistanceGrid, vertices: Float64, faces: NDArray[np.int64]) -> Any:
    unique, index = np.unique(np.round(vertices / STEP), axis=0, return_inverse=True)
    joined = index.reshape(-1)[faces]
    first, second, third = joined.T
    is_triangle = (first != second) & (second != third) & (third != first)
    return trimesh.Trimesh(grid.origin + grid.voxel * STEP * unique, joined[is_triangle], process=False)


def describe_mesh(path: Path, _head: bytes) -> Summary | None:
    if path.suffix.lower() not in {".obj", ".stl"}:
        return None
    with refuse_faults(
        f"{path}: not a readable mesh", Exception, remedy="the file is damaged"
    ):  # whatever its parsers meet
        mesh = trimesh.load_mesh(path, process=False)
        mesh.merge_vertices()  # .stl has three a triangle
        facts = {"vertices": len(mesh.vertices), "faces": len(mesh.faces), "is_watertight": bool(mesh.is_watertight)}
        lower, upper = np.round(mesh.bounds, 6).tolist()
    return Summary(path=str(path), kind="mesh", facts={**facts, "lower": lower, "upper": upper})


_DOCS = """
`ply`, `obj`, `stl` | the surface `sdf = 0`, normals outwards | mesh viewers, trimesh 5.2.0
"""
ENTRIES = tuple(
    GridFormat(
        name=suffix[1:],
        order=order,
        suffix=suffix,
        write=lambda path, grid: write_surface(path, iso_surface(grid)),
        describe=describe_mesh,
        bytes_per_cell=0,
        docs=_DOCS if suffix == SUFFIXES[0] else "",
    )
    for order, suffix in enumerate(SUFFIXES, start=6)
)
