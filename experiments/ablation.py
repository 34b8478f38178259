"""Ablation: recordings with known truth, with each mechanism off in turn, and the table of the changes."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from experiments.problems import FittedRow, ProblemRequest, named
from experiments.proportions import mean_between
from splatctrl_cli import (
    Config,
    ReconstructRequest,
    RecordingRequest,
    ReplayRequest,
    ReplayResult,
    ScoreRequest,
    SourceOptions,
    SplatCtrlError,
    load_config,
    open_to_train,
    reconstruct,
    replay,
    score,
)
from splatctrl_cli.blocks import RecordingOptions, SimulateRequest, Stopwatch, simulate, verdict_of

TABLE, SCAN = "table", "scan"
NUM_PROBLEMS = {TABLE: 20, SCAN: 5}  # motions past a visitor whose place is drawn; fits of the still scan by seed
ALL = "all"
OFF: Mapping[str, tuple[str, ...]] = {  # the settings that take a mechanism out
    ALL: (),
    "occupancy-rule": ("occupancy.rule=literal",),
    "seen-through": ("occupancy.see_through=1e9",),
    "uncertain": ("occupancy.uncertain_patience=1000000",),
    "gap-filling": ("scene.max_gap=1e9",),
    "hole-term": ("scene.hole_opacity=0",),
    "add-thresholds": ("scene.min_depth_error=0", "scene.max_depth_error=1e9"),
    "contact-splats": ("scene.contact_radius=0.02",),
    "depth-normalisation": ("scene.depth_loss=printed",),
    "opacity-term": ("scene.lambda_opacity=0",),
    "low-regulariser": ("scene.lambda_reg=0.02",),
    "noise": ("scene.noise=0",),
    "background": ("scene.background=black",),
    "shell": ("scene.shell=0",),
    "scale": ("scene.scale=1",),
    "idle-detail": ("scene.when_idle=leave",),
    "end-depth": ("scene.refine_depth=1",),
    "least-range": ("occupancy.min_range=0",),
    "safe-minimum": ("field.distance=gpdf",),
    "distance-rate": ("control.distance_rate=none",),
    "barrier-gain": ("control.barrier_gain=1",),
    "second-look": ("control.max_cuts=0",),
    "reduced-program": ("control.program=printed", "control.max_cuts=0"),
}
STILL_ALONE = ("scale", "idle-detail", "end-depth")  # of fits without a clock, or without a robot
OF_MOTION = ("safe-minimum", "distance-rate", "barrier-gain", "second-look", "reduced-program")  # the same map
TRAINING, SCORED = ("cam0", "cam1", "cam2"), ("cam3",)
HELD_OUT = "holdout:1,4"
START_S = 1.6  # of the closed loop, before the visitor comes
SAFE = "safe"
TOLERATED = 0.005  # [m] below the margin that is no false green


@dataclass(frozen=True, kw_only=True)
class Measured(FittedRow):
    """A recording without a mechanism; what does not apply is None. psnr [dB], depth [m], in_front: of held-out
    pixels that a training view saw; fit_s [s]. audit, loop: labels of the map's verdicts on the recorded and on the
    driven motion. true_clearance, loop_clearance [m]: their least true clearances. margin [m].
    """

    depth: float | None = None
    in_front: float | None = None
    splats: int | None = None
    fit_s: float | None = None
    audit: str = ""
    map_clearance: float | None = None
    true_clearance: float | None = None
    loop: str = ""
    reached: bool | None = None
    loop_clearance: float | None = None
    loop_s: float | None = None
    margin: float = 0.0

    @property
    def verdict(self) -> str:
        """Of the audit."""
        return self.audit

    def false_greens(self) -> int:
        """Number of the two motions that were called safe, though nearer to something than the margin."""
        judged = ((self.audit, self.true_clearance), (self.loop, self.loop_clearance))
        return sum(word == SAFE and d is not None and d < self.margin - TOLERATED for word, d in judged)

    def false_collisions(self) -> int:
        """Number of the two motions that were called contact or too near, though they kept the margin."""
        judged = ((self.audit, self.true_clearance), (self.loop, self.loop_clearance))
        return sum(word in ("contact", "margin broken") and d is not None and d >= self.margin for word, d in judged)

    @property
    def is_false_green(self) -> bool:
        """True for a false green with every mechanism on. With one off, the study looks for false greens."""
        return self.method == ALL and self.false_greens() > 0

    @property
    def success(self) -> bool:
        """True if it ran, and its closed loop, if any, reached the goal without contact."""
        touched = self.loop_clearance is not None and self.loop_clearance < 0.0
        return not self.error and self.reached is not False and not touched

    @property
    def cause(self) -> str:
        """Of no success."""
        return "" if self.success else self.error or ("collision" if self.reached else "goal not reached")

    @property
    def label(self) -> str:
        """Which it is."""
        return f"{self.environment}-{self.number:04d}, without {self.method}"

    @property
    def told(self) -> str:
        """In a few words."""
        if self.error:
            return f"{self.label}: {self.error}"
        words = f"audit {self.audit}, loop {self.loop}" if self.audit else "no robot"
        return f"{self.label}: {self.psnr or 0.0:.2f} dB, {words}"


def problems(trials: int | None, archive: Path | None) -> list[tuple[str, int]]:
    """Environment and number of all problems, or of at most `trials` of each environment."""
    return [(name, n) for name, most in NUM_PROBLEMS.items() for n in range(min(most, trials or most))]


def measured(request: ProblemRequest, config: Config, stopwatch: Stopwatch) -> Iterator[Measured]:
    """Results on the named recording with each mechanism off in turn. Raises InputError for an unknown name."""
    environment, number = named(request.problem, NUM_PROBLEMS, "environment")
    elsewhere = OF_MOTION if environment == SCAN else STILL_ALONE
    with TemporaryDirectory() as name:
        folder = Path(name)
        with stopwatch.stage("recording"):
            _record(folder / "recording", environment, number, request.width)
        for method in (name for name in request.methods if name not in elsewhere):
            config = load_config(None, OFF[method])
            row = Measured(environment=environment, number=number, method=method, margin=config.control.margin)
            with stopwatch.stage(method):
                try:
                    yield _run(row, folder, config, request.threads)
                except SplatCtrlError as error:
                    yield replace(row, error=str(error))


def _record(out: Path, environment: str, number: int, width: int) -> None:
    """Record a table with a visitor at a place and time drawn from `number`, or a scan."""
    options = RecordingOptions(width=width, height=width * 3 // 4, seed=number)
    if environment == SCAN:
        simulate(SimulateRequest(out=out, options=replace(options, duration_s=0.6), dtu=True))
        return
    rng = np.random.default_rng([number, 19])
    place = (float(rng.uniform(0.34, 0.5)), float(rng.uniform(-0.15, 0.2)), float(rng.uniform(0.03, 0.07)))
    simulate(SimulateRequest(out=out, options=replace(options, visitor=place)))


def _run(row: Measured, folder: Path, config: Config, threads: int) -> Measured:
    """Reconstruct, score, audit and drive as `row` says."""
    given, scene = folder / "recording", folder / (ALL if row.method in OF_MOTION else row.method)
    is_scan = row.environment == SCAN
    urdf, spheres = (None, None) if is_scan else (given / "robot.urdf", given / "robot_spheres.yaml")
    if is_scan:
        seen = held_out = RecordingRequest(path=given / "dtu", is_dtu=True, protocol=HELD_OUT)
    else:
        seen = RecordingRequest(path=given / "log.mcap", options=SourceOptions(cameras=TRAINING))
        held_out = replace(seen, options=SourceOptions(cameras=SCORED))
    if not scene.exists():
        made = reconstruct(
            ReconstructRequest(
                source=open_to_train(seen),
                out=scene,
                config=config,
                seed=row.number,
                threads=threads,
                urdf=urdf,
                spheres=spheres,
            )
        )
        figures = score(ScoreRequest(scene=scene, recording=held_out, threads=threads)).metrics
        row = replace(
            row,
            psnr=figures.get("psnr_seen"),
            depth=figures.get("depth_median_seen"),
            in_front=figures.get("in_front_seen"),
            splats=int(made.metrics["splats"]),
            fit_s=round(made.seconds["fit"], 3),
        )
    if is_scan:
        return row
    asked = ReplayRequest(
        log=given / "log.mcap", scene=scene, truth=given / "truth.json", out=folder / f"{row.method}-audit",
        config=config, threads=threads, worst_frames=0, urdf=urdf, spheres=spheres,
    )  # fmt: skip
    audit = replay(asked)
    driven = replay(replace(asked, out=folder / f"{row.method}-loop", mode="closed-loop", start_time=START_S))
    return replace(
        row,
        audit=_by_the_map(audit),
        map_clearance=audit.metrics["min_clearance"],
        true_clearance=audit.metrics["min_clearance_true"],
        loop=_by_the_map(driven),
        reached=bool(driven.metrics["goal_reached"]),
        loop_clearance=driven.metrics["min_clearance_true"],
        loop_s=driven.metrics["duration_s"],
    )


def _by_the_map(result: ReplayResult) -> str:
    """The label of the verdict without what it knows of the truth."""
    reasons = [reason for reason in result.verdict.reasons if not reason.criterion.startswith("true ")]
    return verdict_of("replay", reasons, passed=SAFE).label


TITLES = {TABLE: "A motion past a visitor", SCAN: "Held-out views of a still scan"}
HEADER = ("without", "runs", "dB", "depth error [mm]", "in front [%]", "fit [times]")
OF_TABLE = ("audit: false collisions", "false greens", "loop: reached", "loop time [s]", "least true clearance [mm]")
NOTHING = 0.5  # of an effect's own interval: what includes zero and moves no verdict is no effect

Rows = Sequence[Sequence[str]]
Value = Callable[[Measured], float | None]


def sections(trials: Sequence[Measured]) -> Iterator[tuple[str, Sequence[str], Rows]]:
    """Title, header and rows for each kind of recording: figures with every mechanism on, then differences."""
    for environment, title in TITLES.items():
        of = [trial for trial in trials if trial.environment == environment]
        if of:
            count = len({trial.number for trial in of})
            header = (*HEADER, *(OF_TABLE if environment == TABLE else ()))
            yield (
                f"{title} ({count} of {NUM_PROBLEMS[environment]}); differences to all of it",
                header,
                list(_rows(of)),
            )


def notes(trials: Sequence[Measured]) -> Iterator[str]:
    """How to read it, and what gives nothing."""
    yield "In brackets: 95 % intervals of the mean difference, over the same recordings (Student's t)."
    yield "False greens and collisions: of the audit and the closed loop, by the map alone, against the truth."
    without = sorted({trial.method for trial in trials} - {ALL}, key=list(OFF).index)
    idle = [method for method in without if not _gives(trials, method)]
    if idle:
        yield f"Nothing changes beyond chance without: {', '.join(idle)}."
    failed = [trial for trial in trials if trial.error]
    yield from (f"{trial.label}: {trial.error}" for trial in failed[:5])


def _rows(trials: Sequence[Measured]) -> Iterator[Sequence[str]]:
    by_method = {m: {t.number: t for t in trials if t.method == m} for m in OFF}
    everything = by_method.pop(ALL)
    if everything:
        yield _row(ALL, list(everything.values()), None)
    yield from (_row(method, list(found.values()), everything) for method, found in by_method.items() if found)


def _row(method: str, found: Sequence[Measured], beside: Mapping[int, Measured] | None) -> Sequence[str]:
    has_fit = method not in OF_MOTION
    cells = [
        _cell(found, beside, lambda t: t.psnr, ".2f") if has_fit else "",
        _cell(found, beside, lambda t: _mm(t.depth), ".2f") if has_fit else "",
        _cell(found, beside, lambda t: None if t.in_front is None else 100 * t.in_front, ".1f") if has_fit else "",
        _times(found, beside) if has_fit else "",
    ]
    if found[0].environment == TABLE:
        cells += [
            str(sum(t.false_collisions() for t in found)),
            str(sum(t.false_greens() for t in found)),
            f"{sum(t.success for t in found)}",
            _cell(found, beside, lambda t: t.loop_s, ".2f"),
            _cell(found, beside, lambda t: _mm(t.loop_clearance), ".1f"),
        ]
    return (method, str(len(found)), *cells)


def _cell(found: Sequence[Measured], beside: Mapping[int, Measured] | None, value: Value, form: str) -> str:
    """The mean, or the mean difference with its interval."""
    if beside is None:
        values = [v for v in map(value, found) if v is not None]
        return f"{np.mean(values):{form}}" if values else "-"
    mean, low, high = mean_between(_differences(found, beside, value))
    if np.isnan(mean):
        return "-"
    return f"{mean:+{form}}" if np.isnan(low) else f"{mean:+{form}} [{low:+{form}}, {high:+{form}}]"


def _differences(found: Sequence[Measured], beside: Mapping[int, Measured], value: Value) -> list[float]:
    pairs = [(value(t), value(beside[t.number])) for t in found if t.number in beside]
    return [a - b for a, b in pairs if a is not None and b is not None]


def _times(found: Sequence[Measured], beside: Mapping[int, Measured] | None) -> str:
    """Seconds of the fit, or how many times as long it takes."""
    if beside is None:
        values = [t.fit_s for t in found if t.fit_s is not None]
        return f"{np.median(values):.1f} s" if values else "-"
    pairs = [(t.fit_s, beside[t.number].fit_s) for t in found if t.number in beside]
    ratios = [a / b for a, b in pairs if a and b]
    return f"{np.median(ratios):.2f}" if ratios else "-"


def _gives(trials: Sequence[Measured], method: str) -> bool:
    """True if a figure other than fit time differs without `method`, beyond chance, on any recording."""
    values: tuple[Value, ...] = (lambda t: t.psnr, lambda t: t.depth, lambda t: t.in_front, lambda t: t.loop_s)
    for environment in TITLES:
        beside = {t.number: t for t in trials if t.environment == environment and t.method == ALL}
        found = [t for t in trials if t.environment == environment and t.method == method and t.number in beside]
        same = [beside[t.number] for t in found]
        if any(_faults(t) != _faults(s) for t, s in zip(found, same, strict=True)):
            return True
        for value in values:
            mean, low, high = mean_between(_differences(found, beside, value))
            if not np.isnan(mean) and (low > 0 or high < 0):
                return True
    return False


def _faults(trial: Measured) -> tuple[int, int, bool]:
    return trial.false_collisions(), trial.false_greens(), trial.success


def _mm(length: float | None) -> float | None:
    return None if length is None else 1e3 * length
