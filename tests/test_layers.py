"""Imports go down only: a room imports lower rooms, never its neighbours."""

import ast
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "splatctrl_cli"
ROOMS = [  # a room imports those of the rows above its own
    ["records", "geometry", "config", "errors", "kernels", "libraries", "voxels"],
    ["files"],
    ["formats"],
    ["robot"],
    ["report"],
    ["scene", "field", "control", "simulate", "evaluate", "calibration"],
    ["recording", "planner"],
    ["checks"],
    ["jobs"],
    ["api"],
    ["cli"],
]
INSIDE = {  # of a room, its folders and the modules beside them, likewise
    "jobs": [
        ["running"],
        ["robot", "batch", "simulate", "ingest"],
        ["check", "runs"],
        ["calibrate", "recordings", "bake", "sweep"],
        ["reconstruct", "query"],
        ["score", "replay"],
        ["compare"],
        ["report"],
        ["export", "render"],
        ["audit", "demo"],
    ],
    "formats": [["unpacking", "mesh"], ["arrays", "image_file", "ply"], ["splat", "grid"], ["scene"]],
    "recording": [
        ["source_options"],
        ["container"],
        ["log"],
        ["capture"],
        ["folder"],
        ["describe_file", "calibrated"],
        ["source"],
        ["state"],
    ],
}


def ranks(floors: list[list[str]]) -> dict[str, int]:
    return {name: rank for rank, names in enumerate(floors) for name in names}


RANK = ranks(ROOMS)
HOMES = {
    "torch": {"scene"},
    "pinocchio": {"robot"},
    "coal": {"robot"},
    "clarabel": {"control"},
    "daqp": {"control"},
    "rosbags": {"recording"},
    "mcap": {"recording"},
    "google": {"recording"},
    "pxr": {"formats"},
    "matplotlib": {"libraries"},
}


@cache
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


@pytest.mark.parametrize("room", INSIDE)
def test_the_folders_of_a_room_import_lower_ones_only(room: str) -> None:
    rank, offences = ranks(INSIDE[room]), []
    for path in (PACKAGE / room).rglob("*.py"):
        here = path.relative_to(PACKAGE / room).parts[0].removesuffix(".py")
        for name in imports(path):
            parts = name.split(".")
            is_own = parts[:2] == ["splatctrl_cli", room] and len(parts) > 2
            if is_own and parts[2] != here and rank[parts[2]] >= rank[here]:
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
