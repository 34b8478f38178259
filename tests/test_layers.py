"""Imports go down only: a room imports lower rooms, never its neighbours."""

import ast
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "splatctrl_cli"
ROOMS = [  # a room imports those of the rows above its own
    ["records", "geometry", "config", "errors", "kernels", "libraries", "mesh_distance", "voxels"],
    ["robot", "files"],
    ["containers", "splat_files", "grid_files", "report"],
    ["logs", "scene_files"],
    ["captures", "scene", "field", "control", "simulate", "evaluate", "calibration"],
    ["datasets", "planner"],
    ["sources"],
    ["states", "checks"],
    ["jobs"],
    ["api"],
    ["cli"],
]
RANK = {room: rank for rank, rooms in enumerate(ROOMS) for room in rooms}
HOMES = {
    "torch": {"scene"},
    "pinocchio": {"robot"},
    "coal": {"robot"},
    "clarabel": {"control"},
    "daqp": {"control"},
    "rosbags": {"containers", "logs"},
    "mcap": {"containers", "logs"},
    "google": {"containers"},
    "pxr": {"splat_files"},
    "matplotlib": {"libraries"},
}


def imports(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return names


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def modules() -> list[Path]:
    return [p for p in PACKAGE.rglob("*.py") if room_of(p) in RANK]


def test_imports_go_down_only() -> None:
    offences = []
    for path in modules():
        here = room_of(path)
        for name in imports(path):
            parts = name.split(".")
            if parts[0] != "splatctrl_cli" or len(parts) < 2 or parts[1] == here:
                continue
            if here == "kernels" or (RANK[parts[1]] >= RANK[here] and RANK[here] > 0):
                offences.append(f"{path.relative_to(PACKAGE)} imports {name}")
    assert not offences, offences


def test_heavy_libraries_stay_in_their_rooms() -> None:
    offences = [
        f"{path.relative_to(PACKAGE)} imports {name}"
        for path in modules()
        for name in imports(path)
        if name.split(".")[0] in HOMES and room_of(path) not in HOMES[name.split(".")[0]]
    ]
    assert not offences, offences
