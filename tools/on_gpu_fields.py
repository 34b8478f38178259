"""Distance fields on an NVIDIA card, compared with the same machine's processor: ``python -m tools.on_gpu_fields``.

Tables of docs/gpu.md: grids of 256^3 cells, 100,000 points and the spheres of 20,544 states; 5,000 and 50,000 splats.
"""

import argparse
import hashlib
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.scenes import surface_splats
from splatctrl_cli.config import FieldConfig
from splatctrl_cli.field.baker import Baker
from splatctrl_cli.field.clusters import Spheres
from splatctrl_cli.field.distance import OnDevice, field_over
from splatctrl_cli.field.grid_cells import GridLayout
from splatctrl_cli.formats.splat.splats import write_ply
from splatctrl_cli.kernels.cuda.card import CudaDevice
from splatctrl_cli.kernels.cuda.field import Answers
from splatctrl_cli.kernels.cuda.memory import FIELD
from splatctrl_cli.records import Box, Float64

COUNTS = (5_000, 50_000)
CELLS, VOXEL = 256, 0.01
POINTS, STATES, SPHERES = 100_000, 20_544, 64
CHANNELS = ("sdf", "bound", "gradient")
DISTANCES = ("hard", "safe", "safe_gpdf")
ROUNDS = 5
PATH = os.pathsep.join([str(Path(__file__).parent.parent), os.environ.get("PYTHONPATH", "")])


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("-o", "--out", type=Path, help="Markdown")
    parser.add_argument("--small", action="store_true", help="little of it, once: for compute-sanitizer")
    parser.add_argument("--only", choices=("commands", "grids", "points"))
    given = parser.parse_args()
    device = CudaDevice(source=FIELD)
    if given.small:
        return small(device)
    lines = [f"{device.name}, {os.cpu_count()} cores beside it"]
    parts: dict[str, Callable[[], list[str]]] = {
        "commands": commands,
        "grids": lambda: grids(device),
        "points": lambda: points(device),
    }
    for name, part in parts.items():
        if given.only not in (None, name):
            continue
        rows = part()
        print("\n".join(["", *rows]), flush=True)
        lines += ["", *rows]
        if given.out:
            given.out.write_text("\n".join(lines) + "\n")


def layout(cells: int = CELLS, voxel: float = VOXEL) -> GridLayout:
    """A cube of cells around the scene's middle."""
    half, center = 0.5 * (cells - 0.5) * voxel, np.array([0.0, 0.0, 0.3])
    return GridLayout.over(Box(lower=center - half, upper=center + half), voxel)


def baker(count: int, distance: str, device: CudaDevice | None, cells: int = CELLS) -> Baker:
    config = FieldConfig(voxel=VOXEL, distance=distance)
    return Baker(surface_splats(count), layout(cells), config, channels=CHANNELS, device=device)


def commands() -> list[str]:
    """Rows for whole commands, each a new process: seconds, and whether auto writes what its chosen device writes."""
    rows = [
        "Whole commands [s].",
        "",
        "| command | splats | cpu | cuda | auto | it takes | and writes |",
        "|---|---|---|---|---|---|---|",
    ]
    lower, upper = layout().box.lower, layout().box.upper
    bake = ["sdf-bake", "--box=" + ",".join(map(str, (*lower, *upper))), "--voxel", str(VOXEL), "--formats", "npz"]
    asked = {
        f"sdf-bake {CELLS}^3 safe": (5_000, [*bake, "--no-report"], "S.ply"),
        f"sdf-bake {CELLS}^3 safe_gpdf": (50_000, [*bake, "--no-report", "--distance", "safe_gpdf"], "S.ply"),
        "query of 100,000 points": (5_000, ["query"], "S.ply 100000.csv"),
        "query of 600,000 points": (50_000, ["query"], "S.ply 600000.csv"),
    }
    with tempfile.TemporaryDirectory() as folder:
        for num in (100_000, 600_000):
            np.savetxt(Path(folder) / f"{num}.csv", arms(num), fmt="%.6f", delimiter=",")
        for what, (count, begins, files) in asked.items():
            write_ply(Path(folder) / "S.ply", surface_splats(count), {})
            words = [*begins, *files.split()]
            made = {name: command(folder, words, name) for name in ("cpu", "cuda", "auto")}
            took = made["auto"][1].partition("computes on ")[2].partition(" ")[0].strip(":\n") or "-"
            beside = made.get(took.partition(":")[0], (0.0, "", ""))
            same = "the same" if made["auto"][2] == beside[2] else f"ELSE {made['auto'][2]}"
            cells = [what, str(count), *(f"{made[name][0]:.1f}" for name in made), took, same]
            rows.append(f"| {' | '.join(cells)} |")
    return rows


def command(folder: str, words: Sequence[str], device: str) -> tuple[float, str, str]:
    """Seconds of a command, its output, and the digest of its result."""
    whole = [sys.executable, "-m", "splatctrl_cli", *words, "-o", words[0], "--force", "--device", device]
    begin = time.perf_counter()
    done = subprocess.run(
        whole, cwd=folder, env={**os.environ, "PYTHONPATH": PATH}, capture_output=True, text=True, check=False
    )
    seconds, answer = time.perf_counter() - begin, Path(folder) / words[0]
    if done.returncode:
        return seconds, done.stderr[-300:], f"exit {done.returncode}: {done.stderr[-300:]}"
    file = answer / "field.npz" if answer.is_dir() else answer
    return seconds, done.stderr, hashlib.sha256(file.read_bytes()).hexdigest()


def seconds_of(task: Callable[[], object], rounds: int = ROUNDS) -> float:
    """Median time of a call."""
    times = []
    for _ in range(rounds):
        begin = time.perf_counter()
        task()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def grids(device: CudaDevice) -> list[str]:
    """Rows for grids: times of kernels on the card, without and with copying back, and of the processor; hashes of
    two bakes.
    """
    rows = [
        f"{CELLS}^3 cells of {VOXEL:g} m: sdf, bound and gradient.",
        "",
        "| splats | sdf | kernels [ms]: hard, kernel, choice | with the way back [ms] | processor [ms]"
        " | farthest apart [m] | hash |",
        "|---|---|---|---|---|---|---|",
    ]
    for count in COUNTS:
        for distance in DISTANCES:
            mine, theirs = baker(count, distance, device), baker(count, distance, None)
            out, expected = mine.allocate(CELLS), theirs.allocate(CELLS)
            field = mine.on_device
            assert field is not None
            whole = mine.span(0, CELLS)
            hashes = [digest(field.bake(whole, set(CHANNELS), margin=mine.bound_margin)) for _ in range(2)]
            kernels = [1e3 * device.seconds(device.record([one]), 20) for one in field.launches]
            there = seconds_of(lambda mine=mine, out=out: mine.bake(0, CELLS, out), 3)  # type: ignore[misc]
            here = seconds_of(lambda theirs=theirs, expected=expected: theirs.bake(0, CELLS, expected), 3)  # type: ignore[misc]
            apart = float(np.abs(np.asarray(out["sdf"]) - np.asarray(expected["sdf"])).max())
            same = "equal" if hashes[0] == hashes[1] else "DIFFERENT"
            each = ", ".join(f"{t:.2f}" for t in kernels)
            rows.append(
                f"| {count} | {distance} | {sum(kernels):.2f}: {each} | {1e3 * there:.0f} | {1e3 * here:.0f} |"
                f" {apart:.1e} | {hashes[0]} {same} |"
            )
            mine.close()
    return rows


def points(device: CudaDevice) -> list[str]:
    """Rows for points: times of queries of distances and gradients."""
    rows = [
        "Points along arms, with gradients, of states without: all of a query, from NumPy to NumPy.",
        "",
        "| points | splats | field | kernels [ms] | query [ms] | processor [ms] | farthest apart [m] |",
        "|---|---|---|---|---|---|---|",
    ]
    for num, what in ((POINTS, f"{POINTS:,}"), (STATES * SPHERES, f"{STATES:,} states x {SPHERES}")):
        asked = arms(num)
        for count in COUNTS:
            for distance in DISTANCES:
                rows.append(row_of_points(device, asked, what, count, distance))
    return rows


def row_of_points(device: CudaDevice, asked: Float64, what: str, count: int, distance: str) -> str:
    splats, config = surface_splats(count), FieldConfig(distance=distance)
    theirs = field_over(Spheres.of(splats.centers, splats.radii), config, threads=0)
    mine = OnDevice(Spheres.of(splats.centers, splats.radii), config, device)
    query = mine.query if len(asked) == POINTS else mine.distance  # an audit needs no gradient
    found = mine.query(asked)[0]
    query(asked)
    kernels = 1e3 * sum(device.seconds(device.record([one]), 10) for one in mine.field.launches)
    there, here = seconds_of(lambda: query(asked)), seconds_of(lambda: theirs.query(asked), 1)
    apart = float(np.abs(found - theirs.query(asked)[0]).max())
    mine.close()
    return f"| {what} | {count} | {distance} | {kernels:.2f} | {1e3 * there:.1f} | {1e3 * here:.0f} | {apart:.1e} |"


def arms(num: int) -> Float64:
    """Points (num, 3) [m], world: 64 along each of random arms above the table."""
    rng = np.random.default_rng(3)
    base, tip = np.array([-0.5, 0.0, 0.0]), rng.uniform([-0.5, -0.5, 0.0], [0.5, 0.5, 0.8], (-(-num // SPHERES), 3))
    along = np.linspace(0.0, 1.0, SPHERES)[None, :, None]
    return np.ascontiguousarray((base + along * (tip[:, None] - base)).reshape(-1, 3)[:num])


def digest(answers: Answers) -> str:
    """Of the distances, bounds and gradients."""
    arrays = [values for values in (answers.distance, answers.bound, answers.gradient) if values is not None]
    return hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)).hexdigest()[:16]


def small(device: CudaDevice, distances: Sequence[str] = DISTANCES) -> None:
    """Every kernel once, at few cells and points."""
    for distance in distances:
        mine = baker(400, distance, device, cells=20)
        mine.bake(0, 20, mine.allocate(20))
        mine.close()
        splats = surface_splats(400)
        field = OnDevice(Spheres.of(splats.centers, splats.radii), FieldConfig(distance=distance), device)
        field.query(arms(100))
        field.close()


if __name__ == "__main__":
    main()
