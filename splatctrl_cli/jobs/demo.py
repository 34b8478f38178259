"""The main jobs on the sample recording, with pictures."""

import shlex
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from splatctrl_cli.config import Config, SceneConfig
from splatctrl_cli.errors import DAMAGED, InputError, UsageError
from splatctrl_cli.evaluate.verdict import Outcome, Reason, Verdict, verdict_of
from splatctrl_cli.evaluate.views import psnr
from splatctrl_cli.files.output import Stopwatch, output_path, sha256, write_run
from splatctrl_cli.files.summary import Summary
from splatctrl_cli.formats.grid.npz_grid import read_npz
from splatctrl_cli.formats.scene.scene_folder import SceneFolder, open_scene
from splatctrl_cli.jobs.bake.bake import BakeResult, bake
from splatctrl_cli.jobs.bake.request import BakeRequest
from splatctrl_cli.jobs.export.export import ExportRequest, ExportResult, export
from splatctrl_cli.jobs.ingest import IngestRequest, IngestResult, ingest
from splatctrl_cli.jobs.reconstruct.reconstruct import ReconstructResult, reconstruct
from splatctrl_cli.jobs.reconstruct.reconstruction import ReconstructRequest
from splatctrl_cli.jobs.recordings.open_recording import RecordingRequest, open_to_train
from splatctrl_cli.jobs.replay.replay import ReplayResult, replay
from splatctrl_cli.jobs.replay.request import ReplayRequest
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.jobs.running.resume import DECIDING_OPTIONS
from splatctrl_cli.jobs.score.score import ScoreRequest, ScoreResult, score
from splatctrl_cli.jobs.score.views import rendered_with_shell
from splatctrl_cli.jobs.simulate.simulate import SimulateRequest, SimulateResult, simulate
from splatctrl_cli.recording.source import describe, open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import JointState, RgbdFrame
from splatctrl_cli.report.pictures import ComparisonRow, comparison_picture, field_slice_picture
from splatctrl_cli.robot.model import RobotModel

TRAINING, SCORING = ("cam0", "cam1", "cam2"), ("cam3",)
CLOSED_LOOP_START = 1.8  # [s]: the visitor appears ahead of the driven arm; started earlier, right where it is
INPUTS = ("log.mcap", "truth.json", "robot.urdf", "robot_spheres.yaml")
SAMPLE = Path(__file__).parents[2] / "sample_data" / "tabletop"  # of a checkout; an installed package has none
CAPTURE, USING, TRUTH = "{out}/tabletop.capture", "--threads {threads}", "--truth {data}/truth.json"
ROBOT = "--urdf {data}/robot.urdf --spheres {data}/robot_spheres.yaml"
BUDGET = SceneConfig(max_splats=8000)  # 5000 are full when the visitor comes
AGAINST = f"replay {CAPTURE} --scene {{out}}/scene {ROBOT} {TRUTH}"
PICTURES = {
    "renders.png": "photo, render and depth error of each camera",
    "field_slice.png": "a slice of the distance field with the arm's spheres",
    "audit/clearance.png": "clearance of the logged motion over time",
    "closed_loop/clearance.png": "clearance of the controller's motion over time",
}

StepResult = (
    SimulateResult
    | Summary
    | IngestResult
    | ReconstructResult
    | ExportResult
    | BakeResult
    | ScoreResult
    | ReplayResult
)
Told = Callable[[StepResult, Path], None]


@dataclass(frozen=True, kw_only=True)
class DemoRequest:
    """Run on `data`, a folder of `splatctrl simulate`, and write into `out`.

    data: None for the sample recording, simulated into `out` if not installed.
    """

    data: Path | None = None
    out: Path = Path("demo_output")
    threads: int = 0
    force: bool = False


@dataclass(frozen=True, kw_only=True)
class DemoResult:
    """Verdict of the steps, wall time [s], and pictures with descriptions."""

    out: Path
    verdict: Verdict
    seconds: float
    pictures: Mapping[Path, str]


@dataclass(frozen=True, kw_only=True)
class Step:
    """One step: its command-line words, its function, and expected labels joined by "or"."""

    words: Sequence[str]
    run: Callable[[], StepResult]
    expected: str

    @property
    def name(self) -> str:
        return f"{self.words[0]} --mode closed-loop" if "closed-loop" in self.words else self.words[0]


def demo(request: DemoRequest, progress: Progress = SILENT, told: Told = lambda result, folder: None) -> DemoResult:
    """Run all steps, and draw their pictures. Raises InputError if `data` is no recording.

    told: called with each result, and the temporary folder of `out`.
    """
    start, stopwatch, out = time.perf_counter(), Stopwatch(), request.out
    recorded = request.data or (SAMPLE if SAMPLE.is_dir() else None)
    if recorded is not None:
        _refuse_unusable(recorded, out)
    with output_path(out, force=request.force, is_folder=True) as folder:
        data = recorded or folder / "recording"
        with stopwatch.stage("commands"):
            made = Step(  # the same scene, with the arm of primitive shapes
                words=["simulate", "-o", str(data)],
                run=lambda: simulate(SimulateRequest(out=data), progress),
                expected="done",
            )
            steps = [*([] if recorded else [made]), *_steps(data, folder, request.threads, progress)]
            reasons = [_reason(step, request, folder, progress, told) for step in steps]
        with stopwatch.stage("pictures"):
            _draw(data, folder, request.threads)
        verdict = verdict_of("demo", reasons, scope=f"{len(reasons)} steps")
        write_run(
            folder,
            command="demo",
            config={"threads": request.threads},
            inputs={name: sha256(data / name) for name in INPUTS},
            metrics={},
            stopwatch=stopwatch,
            verdict=verdict.as_dict(),
        )
    return DemoResult(
        out=out,
        verdict=verdict,
        seconds=time.perf_counter() - start,
        pictures={out / name: description for name, description in PICTURES.items()},
    )


def _refuse_unusable(data: Path, out: Path) -> None:
    """Raise InputError if `data` is no recording, UsageError if it is the output."""
    if missing := [name for name in INPUTS if not (data / name).is_file()]:
        raise InputError(
            f"{data}: has no {', '.join(missing)}", remedy="make a recording with 'splatctrl simulate -o DIR'"
        )
    if out.resolve() == data.resolve():
        raise UsageError(f"{out}: is the input folder", remedy="give another --out")


def _steps(data: Path, out: Path, threads: int, progress: Progress) -> list[Step]:
    log, truth, urdf, spheres = (data / name for name in INPUTS)
    capture, scene = out / "tabletop.capture", out / "scene"
    training = RecordingRequest(path=capture, options=SourceOptions(cameras=TRAINING))
    scoring = RecordingRequest(path=capture, options=SourceOptions(cameras=SCORING))
    ingested = IngestRequest(paths=(log,), out=capture)
    exported = ExportRequest(scene=scene, out=out / "tabletop.ply")
    measured = BakeRequest(
        scene=scene, out=out / "field", urdf=urdf, spheres=spheres, truth=truth, seen_by=capture, threads=threads
    )
    scored = ScoreRequest(scene=scene, recording=scoring, out=out / "score", threads=threads)
    audited = ReplayRequest(
        log=capture,
        scene=scene,
        urdf=urdf,
        spheres=spheres,
        truth=truth,
        out=out / "audit",
        config=Config(),
        threads=threads,
    )
    driven = replace(audited, out=out / "closed_loop", mode="closed-loop", start_time=CLOSED_LOOP_START)

    def reconstructed() -> ReconstructResult:
        source, options = open_to_train(training), {**DECIDING_OPTIONS, "cameras": ",".join(TRAINING)}
        return reconstruct(
            ReconstructRequest(
                source=source,
                out=scene,
                config=Config(scene=BUDGET),
                urdf=urdf,
                spheres=spheres,
                options=options,
                threads=threads,
            ),
            progress,
        )

    steps: tuple[tuple[str, Callable[[], StepResult], str], ...] = (
        ("info {data}/log.mcap", lambda: describe(log, SourceOptions()), "done"),
        (f"ingest {{data}}/log.mcap -o {CAPTURE}", lambda: ingest(ingested, progress), "done"),
        (
            f"reconstruct {CAPTURE} --cameras {','.join(TRAINING)} --max-splats {BUDGET.max_splats}"
            f" {ROBOT} -o {{out}}/scene {USING}",
            reconstructed,
            "passed",
        ),
        ("export {out}/scene -o {out}/tabletop.ply", lambda: export(exported, progress), "done"),
        (
            f"sdf-bake {{out}}/scene {ROBOT} {TRUTH} --seen-by {CAPTURE} -o {{out}}/field {USING}",
            lambda: bake(measured, progress),
            "passed",
        ),
        (
            f"score {{out}}/scene --reference {CAPTURE} --cameras {SCORING[0]} -o {{out}}/score {USING}",
            lambda: score(scored, progress),
            "passed",
        ),
        (f"{AGAINST} -o {{out}}/audit {USING}", lambda: replay(audited, progress), "safe"),
        (
            f"{AGAINST} --mode closed-loop --start-time {CLOSED_LOOP_START} -o {{out}}/closed_loop {USING}",
            lambda: replay(driven, progress),
            "safe or not evaluable or margin broken",  # it presses on its margin, by a map that errs by mm
        ),
    )
    return [
        Step(
            words=[word.format(data=data, out=out, threads=threads) for word in text.split()],
            run=run,
            expected=expected,
        )
        for text, run, expected in steps
    ]


def _reason(step: Step, request: DemoRequest, folder: Path, progress: Progress, told: Told) -> Reason:
    shown = [word.replace(str(folder), str(request.out)) for word in step.words]
    progress.log(f"\n$ splatctrl {shlex.join(shown)}")
    with _recorded_as(shown):
        result = step.run()
    told(result, folder)
    label = _label(result)
    reason = Reason(
        criterion=step.name,
        outcome=Outcome.PASSED if label in step.expected.split(" or ") else Outcome.FAILED,
        sentence=f"expected '{step.expected}', got '{label}'",
        label="not as expected",
    )
    progress.log(f"demo: {reason}")
    return reason


@contextmanager
def _recorded_as(words: Sequence[str]) -> Iterator[None]:
    """Set the arguments that run.json records."""
    arguments = sys.argv
    sys.argv = [arguments[0], *words]
    try:
        yield
    finally:
        sys.argv = arguments


def _label(result: StepResult) -> str:
    if isinstance(result, Summary):
        return f"exit code {DAMAGED}" if result.damaged else "done"
    if isinstance(result, IngestResult):
        return f"exit code {result.exit_code}" if result.exit_code else "done"
    return "done" if isinstance(result, (ExportResult, SimulateResult)) else result.verdict.label


def _draw(data: Path, out: Path, threads: int) -> None:
    newest: dict[str, RgbdFrame] = {}
    joints: JointState | None = None
    source = open_source(out / "tabletop.capture")
    for record in source.records():
        if isinstance(record, JointState):
            joints = record
        else:
            newest[record.camera] = record
    scene = open_scene(out / "scene")
    comparison_picture(out / "renders.png", [_comparison(frame, scene, threads) for frame in newest.values()])
    model = RobotModel.from_urdf(data / "robot.urdf", data / "robot_spheres.yaml").moved_by(source.joint_names)
    assert joints is not None
    centers = model.sphere_centers(model.positions_of(source.joint_names, joints.position))
    field_slice_picture(
        out / "field_slice.png",
        read_npz(out / "field" / "field.npz"),
        2,
        float(np.median(centers[model.moving_spheres][-4:, 2])),
        (centers, model.sphere_set.radii),
        "distance to the map, with the arm's spheres",
    )


def _comparison(frame: RgbdFrame, scene: SceneFolder, threads: int) -> ComparisonRow:
    view, depth = rendered_with_shell(scene.splats(), scene.shell_at(None), frame, scene.background, threads)
    figure = psnr(view.color, frame.color / 255.0, depth > 0)
    return ComparisonRow(
        title=f"{frame.camera} ({'scoring only' if frame.camera in SCORING else 'training'})",
        figures=f"{figure:.1f} dB on mapped pixels",
        photo=frame.color,
        render=view.color,
        photo_depth=frame.depth,
        render_depth=depth,
    )
