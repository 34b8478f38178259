"""Growth of processor time with the views of a still scene, the messages of a log, and splats.

The exponent is the slope of log time over log size.
"""

import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.iteration import KernelIteration
from benchmarks.long_log import NAMES, write_log
from benchmarks.measure import Limit, Options, Result, medians
from benchmarks.scenes import wall_problem
from splatctrl_cli.config import Config
from splatctrl_cli.geometry import look_at
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.recording.state.state_source import open_states
from splatctrl_cli.records import Box, RgbdFrame
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.simulate.render import Renderer
from splatctrl_cli.simulate.tabletop import cameras, furniture, objects
from tests.plain import plain_frame

NUM_VIEWS = (8, 16, 31)
LOG_SECONDS = (20, 40, 80)  # of a thousand messages each
NUM_SPLATS = (5000, 10000, 20000, 40000)
WORKSPACE = Box(lower=np.array([-0.5, -0.9, -0.1]), upper=np.array([1.1, 0.9, 0.6]))
LARGEST_EXPONENT, LARGEST_RATIO = 1.1, 4.2  # of 31 views over 8, a little more than their ratio
ROUNDS = 3


def run(options: Options) -> Result:
    """Time, on all processors: a whole fit, reading a log of joint states, and an iteration at 640x480."""
    rounds = options.rounds(ROUNDS)
    with tempfile.TemporaryDirectory() as folder:
        times = {
            "views": _times(_views(NUM_VIEWS, options), 1, num_untimed=0),
            "messages": _times(_logs(Path(folder), LOG_SECONDS), rounds),
            "splats": _times(_iterations(NUM_SPLATS), 4 * rounds),
        }
    exponents = {name: exponent(of) for name, of in times.items()}
    figures = {f"{name}_exponent": value for name, value in exponents.items()}
    figures |= {f"{name}_{size}_s": seconds for name, of in times.items() for size, seconds in of.items()}
    figures["views_31_over_8"] = times["views"][31] / times["views"][8]
    return Result(
        title="growth: processor time [s] and its exponent",
        columns=("of", "sizes", "seconds", "exponent"),
        rows=[
            [
                name,
                ", ".join(map(str, of)),
                ", ".join(f"{value:.3g}" for value in of.values()),
                f"{exponents[name]:.2f}",
            ]
            for name, of in times.items()
        ],
        figures=figures,
        limits=[
            *(Limit(figure=f"{name}_exponent", bound=LARGEST_EXPONENT) for name in times),
            Limit(figure="views_31_over_8", bound=LARGEST_RATIO),
        ],
        notes=["views of 320x240 on a circle, 10,000 splats; joint states in MCAP; a wall of splats"],
    )


def exponent(times: Mapping[int, float]) -> float:
    """Slope of log seconds over log size, by least squares."""
    return float(np.polyfit(np.log(list(times)), np.log(list(times.values())), 1)[0])


def _times(tasks: Mapping[int, Callable[[], object]], rounds: int, num_untimed: int = 1) -> dict[int, float]:
    named = {str(size): task for size, task in tasks.items()}
    times = medians(named, rounds, num_untimed=num_untimed, clock=time.process_time)
    return {int(size): value for size, value in times.items()}


def views_on_a_circle(num_views: int) -> list[RgbdFrame]:
    """Frames of 320x240 from a circle above the sample's table, looking at its middle."""
    frames = []
    for index in range(num_views):
        angle = 2 * np.pi * index / num_views
        eye = (0.5 + 0.9 * np.cos(angle), 0.9 * np.sin(angle), 0.8)
        camera = replace(cameras(320, 240)[0], T_world_camera=look_at(eye, (0.5, 0.0, 0.0)))
        color, depth = Renderer(camera, [*furniture(), *objects()], color_rays=0).image([])
        place: dict[str, Any] = {"stamp_ns": index, "camera": f"{index:03d}", "color": color}
        frames.append(plain_frame(depth, camera.intrinsics, camera.T_world_camera, **place))
    return frames


def _views(sizes: tuple[int, ...], options: Options) -> dict[int, Callable[[], object]]:
    def fit(frames: list[RgbdFrame]) -> None:
        config = Config()
        scene = replace(config.scene, max_splats=10_000, window=len(frames))
        fitter = SceneFitter(scene, config.occupancy, WORKSPACE)
        fitter.step(frames)
        fitter.refine(scene.refine_iterations // (10 if options.is_quick else 1))

    frames = {size: views_on_a_circle(size) for size in sizes}
    return {size: lambda frames=frames[size]: fit(frames) for size in sizes}


def _logs(folder: Path, sizes: tuple[int, ...]) -> dict[int, Callable[[], object]]:
    logs = {seconds: write_log(folder, seconds, "mcap") for seconds in sizes}
    return {
        1000 * seconds: lambda log=log: sum(1 for _ in open_states(log, SourceOptions(), NAMES).records())
        for seconds, log in logs.items()
    }


def _iterations(sizes: tuple[int, ...]) -> dict[int, Callable[[], object]]:
    return {size: KernelIteration(wall_problem(size), 2).run for size in sizes}
