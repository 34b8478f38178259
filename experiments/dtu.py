"""IV-A on a DTU tree: our fit at three budgets and 3D Gaussian splatting, with equal views, losses and iterations."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from experiments import fits
from experiments.densify import GaussianSettings
from experiments.gaussians import reconstruct_gaussians
from experiments.problems import FittedRow, ProblemRequest, named
from experiments.proportions import mean_between
from splatctrl_cli import (
    Config,
    InputError,
    ReconstructRequest,
    RecordingRequest,
    ScoreRequest,
    SplatCtrlError,
    load_config,
    open_to_train,
    reconstruct,
    score,
)
from splatctrl_cli.blocks import SURFACE_SCANS, RecordingOptions, SimulateRequest, Stopwatch, simulate

GIVEN, SIMULATED = "dtu", "simulated"  # scans of a tree, and the scan that `simulate` makes, fitted by several seeds
NUM_SIMULATED = 5
BUDGETS = {"5k": 5_000, "10k": 10_000, "20k": 20_000}
GAUSSIANS = "3dgs"
METHODS = (*BUDGETS, GAUSSIANS)
ITERATIONS, FIRST = 2300, 300
HELD_OUT = "holdout:1,4"  # of the simulated scan's eight views
NAMES = {**{name: f"ours, {count:,} splats" for name, count in BUDGETS.items()}, GAUSSIANS: "3D-GS, densified"}


@dataclass(frozen=True, kw_only=True)
class Fit(FittedRow):
    """A method on a scan: psnr [dB] of held-out views by the protocol (over the mask, if any). psnr_seen [dB] and
    depth [m], the median error: over seen pixels. None: no value.
    """

    psnr_seen: float | None = None
    ssim: float | None = None
    depth: float | None = None
    splats: int | None = None
    seconds: float | None = None
    verdict: str = ""
    true_clearance: float | None = None

    @property
    def is_false_green(self) -> bool:
        """Nothing moves here."""
        return False

    @property
    def success(self) -> bool:
        """Whether it was fitted and scored."""
        return not self.error

    @property
    def cause(self) -> str:
        """Of none."""
        return self.error

    @property
    def label(self) -> str:
        """Which it is."""
        return f"{self.environment}-{self.number:04d}, {NAMES[self.method]}"

    @property
    def told(self) -> str:
        """In a few words."""
        return f"{self.label}: {self.error or f'{self.psnr or 0.0:.2f} dB, {self.splats} splats'}"


def problems(trials: int | None, root: Path | None) -> list[tuple[str, int]]:
    """The scans of a tree by number, those of the published means first; without a tree, the simulated scan by seed.

    Raises InputError for a tree without a scan.
    """
    if root is None:
        return [(SIMULATED, n) for n in range(min(NUM_SIMULATED, trials or NUM_SIMULATED))]
    found = {_number(name) for name in fits.known_scans(root)}
    if not found:
        raise InputError(f"{root}: no scan", remedy="give the root of a DTU tree, in MVSNet's layout or in IDR's")
    wanted = [n for n in SURFACE_SCANS if n in found] or sorted(found)
    return [(GIVEN, n) for n in wanted[:trials]]


def trials_of(request: ProblemRequest, config: Config, stopwatch: Stopwatch) -> Iterator[Fit]:
    """Fits of a scan by all methods. Raises InputError for an unknown name, or one not in the tree."""
    root, (environment, number) = request.problems, named(request.problem, (GIVEN, SIMULATED), "environment")
    if environment == GIVEN and root is None:
        raise InputError(f"--problem {request.problem}: is of a DTU tree", remedy="give its folder with --problems")
    with TemporaryDirectory() as name:
        folder = Path(name)
        if root is None or environment == SIMULATED:
            with stopwatch.stage("recording"):
                simulate(SimulateRequest(out=folder / "scan", options=RecordingOptions(duration_s=0.6), dtu=True))
            scan = RecordingRequest(path=folder / "scan" / "dtu", is_dtu=True, protocol=HELD_OUT)
        else:
            there = [each for each in fits.known_scans(root) if _number(each) == number]
            if not there:
                raise InputError(f"{root}: has no scan {number}", remedy="give the tree that the study began with")
            scan = RecordingRequest(path=root, is_dtu=True, scan=there[0], protocol=fits.PROTOCOL)
        for method in request.methods:
            row = Fit(environment=environment, number=number, method=method)
            with stopwatch.stage(method):
                try:
                    yield _fit(row, scan, folder / method, request.threads)
                except SplatCtrlError as error:
                    yield replace(row, error=str(error))


def _fit(row: Fit, scan: RecordingRequest, out: Path, threads: int) -> Fit:
    settings = [
        *(f"scene.first_iterations={FIRST}", f"scene.refine_iterations={ITERATIONS - FIRST}"),
        f"scene.max_splats={BUDGETS.get(row.method, 10_000)}",
    ]
    request = ReconstructRequest(
        source=open_to_train(scan), out=out, config=load_config(None, settings), seed=row.number, threads=threads
    )
    if row.method == GAUSSIANS:
        made = reconstruct_gaussians(request, GaussianSettings(iterations=ITERATIONS))
    else:
        made = reconstruct(request)
    figures = score(ScoreRequest(scene=out, recording=scan, threads=threads)).metrics
    return replace(
        row,
        psnr=figures.get("psnr_masked", figures.get("psnr_all")),
        psnr_seen=figures.get("psnr_seen"),
        ssim=figures.get("ssim_all"),
        depth=figures.get("depth_median_seen"),
        splats=int(made.metrics["splats"]),
        seconds=round(made.seconds["fit"], 3),
    )


def _number(scan: str) -> int:
    return int("".join(c for c in scan if c.isdigit()) or 0)


HEADER = ("", "scans", "PSNR [dB]", "95 %", "seen [dB]", "SSIM", "depth error [mm]", "splats", "fit [s]")


def sections(trials: Sequence[Fit]) -> Iterator[tuple[str, Sequence[str], Sequence[Sequence[str]]]]:
    """Title, header and rows: means over scans, the paper's figures, and each budget minus the baseline."""
    rows: list[Sequence[str]] = [
        (f"{about.name} (the paper)", "", f"{about.psnr:.2f}", "", "", "", "", about.splats, "")
        for about in fits.METHODS.values()
    ]
    for method in METHODS:
        found = [trial for trial in trials if trial.method == method and not trial.error]
        if found:
            rows.append((NAMES[method], str(len(found)), *_means(found)))
    yield f"Held-out views of {_kind(trials)}", HEADER, rows
    yield "The same scans: a budget less 3D-GS, PSNR [dB]", ("", "scans", "mean", "95 %"), list(_pairs(trials))


def notes(trials: Sequence[Fit]) -> Iterator[str]:
    """What else is to be known of the table."""
    if trials and trials[0].environment == SIMULATED:
        yield "No DTU tree was given: the scan that `simulate --dtu` makes, fitted by several seeds."
    yield f"{ITERATIONS} iterations each; the paper names neither scans nor views."
    yield from (f"{trial.label}: {trial.error}" for trial in trials if trial.error)


def _kind(trials: Sequence[Fit]) -> str:
    count = len({trial.number for trial in trials})
    return f"a simulated scan, {count} seeds" if trials[0].environment == SIMULATED else f"{count} scans of DTU"


def _means(found: Sequence[Fit]) -> Sequence[str]:
    mean, low, high = mean_between([row.psnr for row in found if row.psnr is not None])
    cells = [f"{mean:.2f}", _between(low, high, ".2f")]
    for values, form, factor in (
        ([row.psnr_seen for row in found], ".2f", 1.0),
        ([row.ssim for row in found], ".3f", 1.0),
        ([row.depth for row in found], ".1f", 1e3),
        ([row.splats for row in found], ",.0f", 1.0),
        ([row.seconds for row in found], ".1f", 1.0),
    ):
        there = [factor * value for value in values if value is not None]
        cells.append(f"{np.mean(there):{form}}" if there else "-")
    return cells


def _pairs(trials: Sequence[Fit]) -> Iterator[Sequence[str]]:
    baseline = {trial.number: trial.psnr for trial in trials if trial.method == GAUSSIANS}
    for method in BUDGETS:
        pairs = [(t.psnr, baseline.get(t.number)) for t in trials if t.method == method]
        differences = [a - b for a, b in pairs if a is not None and b is not None]
        if differences:
            mean, low, high = mean_between(differences)
            yield NAMES[method], str(len(differences)), f"{mean:+.2f}", _between(low, high, "+.2f")


def _between(low: float, high: float, form: str) -> str:
    return "" if np.isnan(low) else f"{low:{form}} to {high:{form}}"
