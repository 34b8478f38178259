"""Two 640x480 cameras, a few iterations per time step: does the map keep up with them?

`python -m benchmarks.streaming FILE` is the measured process; it writes its figures to FILE.
"""

import json
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.measure import SAMPLE, Limit, Options, Result, measured
from benchmarks.scenes import enlarged, sample_robot
from splatctrl_cli.config import load_config
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.records import RgbdFrame
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.time_steps import time_steps

CAMERAS = ("cam0", "cam1")
SETTINGS = ("scene.iterations_per_step=5",)
LARGEST_STEP, LARGEST_MEMORY = 0.2, 600.0  # [s] for five frames a second of each camera, [MiB] beside the frames


def run(options: Options) -> Result:
    """`SceneFitter.step` on the sample log's first two cameras, enlarged to 640x480, on all processors."""
    seconds, frames_mib, peak_mib = _measured(6 if options.is_quick else 1000)
    step, slowest = statistics.median(seconds[1:]), max(seconds[1:])
    memory = peak_mib - frames_mib
    row = [f"{seconds[0]:.1f}", f"{1e3 * step:.0f}", f"{1e3 * slowest:.0f}", f"{1 / step:.1f}", f"{memory:.0f}"]
    return Result(
        title="streaming: two cameras of 640x480, 5 iterations per time step of both",
        columns=("time steps", "first [s]", "median [ms]", "slowest [ms]", "frames/s of each", "memory [MiB]"),
        rows=[[str(len(seconds)), *row]],
        figures={
            "first_s": seconds[0],
            "step_s": step,
            "slowest_s": slowest,
            "frames_per_s": 1 / step,
            "memory_mib": memory,
        },
        limits=[Limit(figure="step_s", bound=LARGEST_STEP), Limit(figure="memory_mib", bound=LARGEST_MEMORY)],
        notes=[
            "occupancy, removal and seeding included; the frames are decoded before",
            f"memory: the peak of the process without the {frames_mib:.0f} MiB of decoded frames",
        ],
    )


def _measured(num_steps: int) -> tuple[list[float], float, float]:
    """Seconds of each time step, and [MiB]: of the decoded frames, and of the peak of a separate process."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "streaming.json"
        spent = measured([sys.executable, "-m", "benchmarks.streaming", str(out), str(num_steps)])
        assert spent.code == 0
        found = json.loads(out.read_text(encoding="utf-8"))
    return found["seconds"], found["frames_mib"], spent.mebibytes


def _stream(out: Path, num_steps: int) -> None:
    config, robot = load_config(None, SETTINGS), sample_robot()
    fitter = SceneFitter(config.scene, config.occupancy, robot.reach_box)
    steps = _decoded(num_steps)
    seconds = []
    for frames in steps:
        start = time.perf_counter()
        fitter.step(frames)
        seconds.append(time.perf_counter() - start)
    num_bytes = sum(frame.color.nbytes + frame.depth.nbytes for frames in steps for frame in frames)
    out.write_text(json.dumps({"seconds": seconds, "frames_mib": num_bytes / 2**20}), encoding="utf-8")


def _decoded(num_steps: int) -> list[Sequence[RgbdFrame]]:
    source = open_source(SAMPLE / "log.mcap")
    steps: list[Sequence[RgbdFrame]] = []
    for step in time_steps(source.records(), CAMERAS, has_clock=source.has_clock):
        steps.append([enlarged(frame) for frame in step.frames])
        if len(steps) == num_steps:
            break
    return steps


if __name__ == "__main__":
    _stream(Path(sys.argv[1]), int(sys.argv[2]))
