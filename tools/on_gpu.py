"""What needs an NVIDIA card: ``python -m tools.on_gpu -o FILE.md [--probe FILE.cu]``, the tables of docs/gpu.md.

Runs tests marked `gpu` and compute-sanitizer; compares hashes of two runs; measures iterations a second and each
kernel's time. A CUDA C++ program runs on the same card and prints its own figures. Missing tools are reported.
"""

import argparse
import csv
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

from splatctrl_cli.kernels import Float32, Float64
from splatctrl_cli.kernels.cuda.card import CudaDevice
from splatctrl_cli.kernels.cuda.fit import TILE, DeviceFit
from splatctrl_cli.kernels.cuda.memory import Graph
from splatctrl_cli.kernels.raster import LossWeights, Moments, OptimiserSettings, TargetView, pack_camera

ROOT = Path(__file__).parent.parent
WIDTH, HEIGHT, FOCAL = 640, 480, 600.0
COUNTS = (5_000, 10_000, 20_000, 100_000)
WEIGHTS = LossWeights(dssim=0.2, color=1.0, depth=1.0, opacity=0.0, normalised=True)
SETTINGS = OptimiserSettings(
    lr_center=2e-4, lr_log_radius=5e-3, lr_color=1e-2, lr_logit_opacity=5e-2, regulariser=1e-6, noise=5e5,
    min_opacity=0.05, min_radius=1e-4, max_radius=1.0, radius_depth=0.0,
)  # fmt: skip
METRICS = {  # of Nsight Compute, and the words for them
    "gpu__time_duration.sum": "ns",
    "smsp__inst_executed.sum": "instructions",
    "smsp__issue_active.avg.pct_of_peak_sustained_active": "% of issue slots",
    "sm__warps_active.avg.pct_of_peak_sustained_active": "% of warps",
    "lts__t_bytes.sum": "L2 bytes",
    "dram__bytes.sum": "DRAM bytes",
}
ITERATIONS, WARM, ROUNDS = 400, 40, 5
START = """
import time
begin = time.perf_counter()
from splatctrl_cli.kernels.cuda.card import CudaDevice
imported = time.perf_counter()
CudaDevice()
print(f"imports {imported - begin:.2f} s, device and kernels {time.perf_counter() - imported:.2f} s")
"""


def wall(count: int, share: float, width: int = WIDTH, height: int = HEIGHT) -> tuple[Float32, TargetView]:
    """Random splats on a wavy wall that fills the view, and the view. Radii are `share` of the mean spacing."""
    rng = np.random.default_rng(count)
    u, v = rng.uniform(0, width, count), rng.uniform(0, height, count)

    def depth(u: Float64, v: Float64) -> Float64:
        return 0.6 + 0.5 * v / height + 0.05 * np.sin(u / 40)

    z = depth(u, v)
    spacing = np.sqrt(width * height / count)
    p = np.zeros((count, 8), np.float32)
    p[:, :3] = np.column_stack([(u - width / 2) / FOCAL * z, (v - height / 2) / FOCAL * z, z])
    p[:, 3] = np.log(share * spacing * z / FOCAL)
    p[:, 4:7] = rng.uniform(0, 1, (count, 3))
    y, x = np.mgrid[:height, :width].astype(np.float64)
    waves = [0.5 + 0.25 * np.sin(0.031 * (c + 1) * x + 0.017 * y) for c in range(3)]
    tiles = [0.2 * np.where((x // 24 + y // 24 + c) % 2, 1, -1) for c in range(3)]
    color = np.clip(np.rint(255 * (np.array(waves) + tiles)), 0, 255).astype(np.uint8)
    counted = np.ones((height, width), np.uint8)
    return p, TargetView(color=color, depth=depth(x, y).astype(np.float32), counted=counted)


def fitted(device: CudaDevice, p: Float32, target: TargetView) -> DeviceFit:
    count, (height, width) = len(p), target.depth.shape
    fit = DeviceFit(device, count)
    zeros = np.zeros((count, 8), np.float32)
    fit.put(p, Moments(first=zeros, second=zeros, num_steps=np.zeros(count, np.uint32)))
    fit.add_view(pack_camera(FOCAL, FOCAL, width / 2, height / 2, width, height, np.eye(4)), target)
    return fit


def digest(fit: DeviceFit) -> str:
    """Of parameters and Adam's state."""
    n = fit.num_splats
    p, first, second = (np.empty((n, 8), np.float32) for _ in range(3))
    state = Moments(first=first, second=second, num_steps=np.empty(n, np.uint32))
    fit.take(p, state)
    return hashlib.sha256(b"".join(a.tobytes() for a in (p, first, second, state.num_steps))).hexdigest()[:16]


def psnr(fit: DeviceFit, target: TargetView) -> float:
    error = fit.planes(0)[:3] - target.color / np.float32(255)
    return float(-10 * np.log10(np.mean(error.astype(np.float64) ** 2)))


def speeds(device: CudaDevice, share: float, counts: Sequence[int]) -> list[str]:
    """A row for each count: time of an iteration, it/s, time of its kernels, PSNR before and after, two hashes."""
    rows = [
        f"Splats of {share:g} of their spacing, {WIDTH} x {HEIGHT}; median of {ROUNDS} times {ITERATIONS} replays.",
        "Kernels [µs]: what each adds to the graph of those before it. PSNR [dB] before and after 1,000 iterations;",
        "hash of parameters and Adam's state after them, in two runs.",
        "",
        "| splats | µs | it/s | project, blend | ssim | loss | backward | step | a tile's list | PSNR | hash |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for count in counts:
        p, target = wall(count, share)
        hashes = []
        for _ in range(2):
            fit = fitted(device, p, target)
            before = psnr(fit, target)
            fit.run([0] * 1000, WEIGHTS, SETTINGS, 7)
            hashes.append(digest(fit))
            after = psnr(fit, target)
            launches = fit.launches(HEIGHT, WIDTH)
            graphs = [device.record(launches[:k]) for k in range(2, len(launches) + 1)]
            times = [measured(device, fit, graph) for graph in graphs]
            lengths = fit._read(f"num_entries {HEIGHT} {WIDTH}", (-(-HEIGHT // TILE) * -(-WIDTH // TILE),), np.int32)
            fit.close()
        cells = [
            *(f"{count}", f"{1e6 * times[-1]:.1f}", f"{1 / times[-1]:.0f}"),
            *(f"{1e6 * t:.1f}" for t in [times[0], *np.diff(times)]),
            f"{lengths.mean():.0f}, at most {lengths.max()}",
            f"{before:.2f}, {after:.2f}",
            f"{hashes[0]} {'equal' if hashes[0] == hashes[1] else 'DIFFERENT'}",
        ]
        rows.append(f"| {' | '.join(cells)} |")
    return rows


def measured(device: CudaDevice, fit: DeviceFit, graph: Graph) -> float:
    """Median seconds of a replay, at its place in the schedule."""
    times = []
    for _ in range(ROUNDS):
        fit.rewind([0] * (ITERATIONS + WARM), WEIGHTS, SETTINGS)
        graph.run(WARM)
        times.append(device.seconds(graph, ITERATIONS))
    return statistics.median(times)


def shell(*command: str, **variables: str) -> tuple[int, str]:
    """Exit code and output of a process; 127 if the program is missing."""
    try:
        done = subprocess.run(
            command,
            cwd=ROOT,
            env={**os.environ, **variables},
            capture_output=True,
            text=True,
            timeout=240,
            check=False,
        )
    except FileNotFoundError:
        return 127, f"{command[0]}: not there"
    except subprocess.TimeoutExpired:
        return 124, f"{command[0]}: stopped after 240 s"
    return done.returncode, done.stdout + done.stderr


def inner(part: str) -> list[str]:
    """The command that runs a part of this program."""
    return [sys.executable, "-m", "tools.on_gpu", "--only", part]


def sanitized() -> list[str]:
    """Rows by tool of compute-sanitizer, for a few iterations of a small map and every kernel of the fields."""
    rows = ["| compute-sanitizer | of | result | in kernels |", "|---|---|---|---|"]
    programs = {"the fit": inner("small"), "fields": [sys.executable, "-m", "tools.on_gpu_fields", "--small"]}
    for tool in ("memcheck", "racecheck", "initcheck", "synccheck"):
        for name, program in programs.items():
            code, out = shell("compute-sanitizer", "--tool", tool, "--error-exitcode", "9", *program)
            summary = [line.strip("= ") for line in out.splitlines() if "SUMMARY" in line]
            faults = sum(" at " in line and "+0x" in line for line in out.splitlines() if "Saved host" not in line)
            rows.append(f"| {tool} | {name} | {'; '.join(summary) or out[-200:]} (exit {code}) | {faults} |")
    return rows


def start_times() -> list[str]:
    """A new process that compiles, and one that finds the result."""
    with tempfile.TemporaryDirectory() as folder:
        caches = {"XDG_CACHE_HOME": folder, "CUDA_CACHE_PATH": folder}  # cuda-core's, and NVRTC's own
        without, with_ = (shell(sys.executable, "-c", START, **caches)[1].strip() for _ in range(2))
    return [f"- first start: {without}", f"- later starts: {with_}"]


def profile() -> list[str]:
    """Nsight Compute's counters of each kernel of the eleventh iteration at 5,000 splats."""
    code, out = shell(
        *("ncu", "--clock-control", "none", "--cache-control", "none", "--csv"),
        *("--launch-skip", "60", "--launch-count", "6", "--metrics", ",".join(METRICS), *inner("queue")),
    )
    if code:
        return [out[-500:]]
    found: dict[str, dict[str, str]] = {}
    for row in csv.DictReader(line for line in out.splitlines() if line.startswith('"')):
        found.setdefault(row["Kernel Name"], {})[row["Metric Name"]] = row["Metric Value"]
    rows = [f"| kernel | {' | '.join(METRICS.values())} |", "|---" * (len(METRICS) + 1) + "|"]
    return rows + [f"| {name} | {' | '.join(of[metric] for metric in METRICS)} |" for name, of in found.items()]


def beside(probe: Path) -> list[str]:
    """What another program prints on this card."""
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "probe"
        code, out = shell("nvcc", "-O3", "-arch=native", "-o", str(program), str(probe))
        return [out] if code else shell(str(program))[1].splitlines()


def tests() -> list[str]:
    """The last lines of the tests that need a card."""
    _, out = shell(
        sys.executable, "-m", "pytest", "-m", "gpu", "-rfE", "-p", "no:cacheprovider", "tests/kernels/cuda"
    )
    return out.strip().splitlines()[-40:]


def small(device: CudaDevice) -> None:
    """A few iterations of a small map, for the sanitizer."""
    fit = fitted(device, *wall(400, 0.7, 200, 150))
    fit.run([0] * 3, WEIGHTS, SETTINGS, 7)
    fit.close()


def queue(device: CudaDevice) -> None:
    """Kernels one by one, for the profiler."""
    fit = fitted(device, *wall(5_000, 0.7))
    fit.rewind([0] * 20, WEIGHTS, SETTINGS)
    for _ in range(12):
        device.queue(fit.launches(HEIGHT, WIDTH))
    device.wait()


def main() -> None:
    """Run everything, or one of the inner programs."""
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("-o", "--out", type=Path, help="Markdown, written as far as it has come")
    parser.add_argument("--probe", type=Path, help="a CUDA C++ program to run beside")
    parser.add_argument("--only", choices=("speeds", "small", "queue"))
    arguments = parser.parse_args()
    device = CudaDevice()
    if arguments.only in {"small", "queue"}:
        return {"small": small, "queue": queue}[arguments.only](device)
    smi = shell("nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader")[1].strip()
    parts: dict[str, Callable[[], list[str]]] = {
        "Card": lambda: [f"{smi}; compute capability {device.capability}; {time.strftime('%Y-%m-%d')}"],
        "Start": start_times,
        "Tests": tests,
        "Beside": lambda: beside(arguments.probe) if arguments.probe else ["no program given"],
        "Speeds": lambda: speeds(device, 0.7, COUNTS),
        "Speeds, wider splats": lambda: speeds(device, 0.95, COUNTS[:2]),
        "Profile": profile,
        "Sanitizer": sanitized,
    }
    lines: list[str] = []
    for title, part in parts.items():
        if arguments.only and not title.lower().startswith(arguments.only):
            continue
        rows = part()
        print("\n".join(["", title, *rows]), flush=True)
        lines += [f"### {title}", "", *rows, ""]
        if arguments.out:
            arguments.out.write_text("\n".join(lines))


if __name__ == "__main__":
    main()
