"""A full optimiser iteration: unpack, project and bin, forward, loss, backward, Adam and noise."""

import statistics
import time
from collections import defaultdict

import numpy as np
import torch

from benchmarks.measure import Limit, Options, Result, seconds
from benchmarks.plain_torch import TorchIteration
from benchmarks.scenes import FitProblem, sample_problem, wall_problem
from splatctrl_cli.config import SceneConfig
from splatctrl_cli.kernels.raster import (
    ImageLoss,
    Moments,
    OptimiserSettings,
    Rasteriser,
    empty_planes,
    optimiser_step,
    unpack_parameters,
)
from splatctrl_cli.records import Float32
from splatctrl_cli.scene.render import loss_weights

STAGES = ("unpack", "bin", "forward", "loss", "backward", "adam")
# Between the planes of kernels and reference, or they did not do the same work. An alpha within rounding of 1 / 255
# may fall on either side of the cut, so that a few values may differ by as much.
DIFFERENCE, LARGEST_DIFFERENCE, LARGEST_SHARE = 1e-4, 1.2 / 255, 1e-4
WEIGHTS = loss_weights(SceneConfig())
ROUNDS, TORCH_ROUNDS = 40, 5


class KernelIteration:
    """`SceneFitter`'s iteration, always from the same parameters, so that every run does the same work."""

    def __init__(self, problem: FitProblem, threads: int) -> None:
        count = len(problem.parameters)
        self.problem, self.threads = problem, threads
        self.parameters = problem.parameters.copy()
        self.moments = Moments(
            first=np.zeros_like(self.parameters),
            second=np.zeros_like(self.parameters),
            num_steps=np.zeros(count, np.uint32),
        )
        self.raster, self.loss = Rasteriser(threads), ImageLoss(threads)
        self.gradients = np.empty((count, 10), np.float32)
        self.planes: Float32 = empty_planes(*problem.target.depth.shape)
        self.plane_gradients = empty_planes(*problem.target.depth.shape)

    def run(self) -> dict[str, float]:
        """Seconds by stage."""
        self.parameters[:] = self.problem.parameters
        marks = [time.perf_counter()]
        centers, radii, colors, opacities = unpack_parameters(self.parameters, self.threads)
        marks.append(time.perf_counter())
        self.raster.prepare(self.problem.camera, centers, radii, opacities, colors)
        marks.append(time.perf_counter())
        self.raster.forward(self.planes)
        marks.append(time.perf_counter())
        self.loss.evaluate(self.planes, self.problem.target, WEIGHTS, self.plane_gradients)
        marks.append(time.perf_counter())
        self.raster.backward(self.planes, self.plane_gradients, self.gradients)
        marks.append(time.perf_counter())
        optimiser_step(self.raster, self.gradients, self.parameters, self.moments, settings(len(radii)), 1)
        marks.append(time.perf_counter())
        return dict(zip(STAGES, np.diff(marks).tolist(), strict=True))


def settings(num_splats: int) -> OptimiserSettings:
    """Those of the configuration."""
    c = SceneConfig()
    return OptimiserSettings(
        lr_center=c.lr_center,
        lr_log_radius=c.lr_log_radius,
        lr_color=c.lr_color,
        lr_logit_opacity=c.lr_logit_opacity,
        regulariser=c.lambda_reg / num_splats,
        noise=c.noise,
        min_opacity=c.min_opacity,
        min_radius=c.min_radius,
        max_radius=c.max_radius,
        radius_depth=0.0,
    )


def run(options: Options) -> Result:
    """5,000 and 10,000 splats at 640x480, random and of the sample log, compared with plain torch on one thread."""
    counts = (5000,) if options.is_quick else (5000, 10000)
    problems = {f"wall_{count}": wall_problem(count) for count in counts}
    problems |= {f"sample_{count}": sample_problem(count) for count in counts}
    cases = {(key, threads): KernelIteration(p, threads) for key, p in problems.items() for threads in (1, 2)}
    times, torch_times = _measured(cases, problems, options)
    rows: list[list[str]] = []
    figures: dict[str, float] = {}
    ratios: dict[str, float] = {}
    for (key, threads), case in cases.items():
        stages = {stage: statistics.median(row[stage] for row in times[key, threads]) for stage in STAGES}
        total = statistics.median(sum(row.values()) for row in times[key, threads])
        opacity, per_tile = float(case.planes[4].mean()), float(case.raster.native.splats_per_tile())
        name = f"{key}_threads_{threads}"
        figures |= {f"{name}_{stage}_ms": 1e3 * value for stage, value in stages.items()}
        figures |= {f"{name}_ms": 1e3 * total, f"{name}_per_s": 1 / total, f"{key}_opacity": opacity}
        figures[f"{key}_splats_per_tile"] = per_tile
        reference = "-"
        if (key, threads) in torch_times:
            plain = statistics.median(torch_times[key, threads])
            figures[f"{name}_torch_ms"] = 1e3 * plain
            ratios[f"{name}_over_torch"] = plain / total
            reference = f"{1e3 * plain:.0f} ({plain / total:.0f}x)"
        rows.append(
            [problems[key].name, str(threads), *(f"{1e3 * stages[stage]:.2f}" for stage in STAGES),
             f"{1e3 * total:.1f}", f"{1 / total:.1f}", f"{opacity:.3f}", f"{per_tile:.0f}", reference]
        )  # fmt: skip
    return Result(
        title="iteration: one optimiser iteration [ms]",
        columns=("map", "threads", *STAGES, "total", "it/s", "opacity", "per tile", "torch"),
        rows=rows,
        figures=figures,
        ratios=ratios,
        limits=[
            *(Limit(figure=f"{key}_threads_2_per_s", bound=_least_rate(key), is_least=True) for key in problems),
            *(Limit(figure=f"{key}_opacity", bound=0.95, is_least=True) for key in problems),
        ],
        notes=["torch: the whole iteration in plain torch operations on one thread (autograd, padded tile lists)"],
    )


def _least_rate(key: str) -> float:
    """[1/s] on two threads, with AVX-512."""
    return 100.0 if key.endswith("_5000") else 85.0


Times = dict[tuple[str, int], list[dict[str, float]]]
TorchTimes = dict[tuple[str, int], list[float]]


def _measured(
    cases: dict[tuple[str, int], KernelIteration], problems: dict[str, FitProblem], options: Options
) -> tuple[Times, TorchTimes]:
    """Every case in turn, round by round, with the reference in between."""
    torch.set_num_threads(1)  # on two, its barriers take seconds whenever another process has one of the cores
    references = {key: TorchIteration(p, WEIGHTS, settings(len(p.parameters))) for key, p in problems.items()}
    times: Times = defaultdict(list)
    torch_times: TorchTimes = defaultdict(list)
    for case in cases.values():
        case.run()
    for key, reference in references.items():
        _check_same(cases[key, 2], reference)
    rounds = options.rounds(ROUNDS)
    for index in range(rounds):
        for name, case in cases.items():
            times[name].append(case.run())
        if index % (rounds // TORCH_ROUNDS) == 0 and len(next(iter(torch_times.values()), [])) < TORCH_ROUNDS:
            for key, reference in references.items():
                torch_times[key, 1].append(seconds(reference.run))
    return times, torch_times


def _check_same(case: KernelIteration, reference: TorchIteration) -> None:
    """Raise if kernels and reference render different images, because their times would not be comparable."""
    difference = np.abs(case.planes - reference.run()[0].numpy())
    share = float(np.mean(difference > DIFFERENCE))
    if difference.max() > LARGEST_DIFFERENCE or share > LARGEST_SHARE:
        raise AssertionError(
            f"plain torch renders another image: {share:.2g} of the values differ by more than {DIFFERENCE:g}, "
            f"at most by {difference.max():.2g}"
        )
