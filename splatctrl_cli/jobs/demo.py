"""Main jobs on the sample recording, with pictures."""

import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatctrl_cli.errors import UsageError, refuse_if
from splatctrl_cli.evaluate.verdict import Outcome, Reason, Verdict, verdict_of
from splatctrl_cli.evaluate.views import psnr
from splatctrl_cli.files.output import Stopwatch, output_path, recorded_as, sha256, write_run
from splatctrl_cli.formats.grid.npz_grid import read_npz
from splatctrl_cli.formats.scene.scene_folder import SceneFolder, open_scene
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.jobs.score.views import render_with_shell
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.records import JointState, RgbdFrame
from splatctrl_cli.report.field_pictures import field_slice_picture
from splatctrl_cli.report.pictures import ComparisonRow, comparison_picture
from splatctrl_cli.robot.model import RobotModel

TRAINED, SCORED = "--cameras cam0,cam1,cam2", "cam3"
INPUTS = ("log.mcap", "truth.json", "robot.urdf", "robot_spheres.yaml")
SAMPLE = Path(__file__).parents[2] / "sample_data" / "tabletop"  # of a checkout; an installed package has none
CAPTURE, USING, TRUTH = "{out}/tabletop.capture", "--threads {threads}", "--truth {data}/truth.json"
ROBOT = "--urdf {data}/robot.urdf --spheres {data}/robot_spheres.yaml"
AGAINST = f"replay {CAPTURE} --scene {{out}}/scene {ROBOT} {TRUTH}"
STEPS = {  # command lines, each with the labels that are right, joined by "or"
    "info {data}/log.mcap": "done",
    f"ingest {{data}}/log.mcap -o {CAPTURE}": "done",
    # 5000 splats are all in use when the visitor comes
    f"reconstruct {CAPTURE} {TRAINED} --max-splats 8000 {ROBOT} -o {{out}}/scene {USING}": "passed",
    "export {out}/scene -o {out}/tabletop.ply": "done",
    f"sdf-bake {{out}}/scene {ROBOT} {TRUTH} --seen-by {CAPTURE} -o {{out}}/field {USING}": "passed",
    f"score {{out}}/scene --reference {CAPTURE} --cameras {SCORED} -o {{out}}/score {USING}": "passed",
    f"{AGAINST} -o {{out}}/audit {USING}": "safe",
    # before 1.8 s the visitor would appear inside the driven arm; the arm goes up to its margin, in a map that errs
    # by millimetres
    f"{AGAINST} --mode closed-loop --start-time 1.8 -o {{out}}/closed_loop {USING}": (
        "safe or not evaluable or margin broken"
    ),
}
PICTURES = {
    "renders.png": "photo, render and depth error of each camera",
    "field_slice.png": "a slice of the distance field with the arm's spheres",
    "audit/clearance.png": "clearance of the logged motion over time",
    "closed_loop/clearance.png": "clearance of the controller's motion over time",
}

Perform = Callable[[Sequence[str], Path], str]
"""Run a command line that writes into the folder; return its verdict's label, "done" or "exit code N"."""


@dataclass(frozen=True, kw_only=True)
class DemoRequest:
    """Demo on `data`, a folder of `splatctrl simulate`, into the folder `out`.

    data: None for the sample recording, simulated into `out` if not installed.
    """

    data: Path | None = None
    out: Path = Path("demo_output")
    threads: int = 0
    force: bool = False


def demo(request: DemoRequest, perform: Perform, progress: Progress = SILENT) -> Verdict:
    """Run all steps, and draw `PICTURES`. Raises InputError if `data` is no recording."""
    stopwatch, out = Stopwatch(), request.out
    recorded = request.data or (SAMPLE if SAMPLE.is_dir() else None)
    if recorded is not None:
        refuse_if(
            missing := [name for name in INPUTS if not (recorded / name).is_file()],
            f"{recorded}: has no {', '.join(missing)}",
            remedy="make a recording with 'splatctrl simulate -o DIR'",
        )
        refuse_if(
            out.resolve() == recorded.resolve(),
            f"{out}: is the input folder",
            remedy="give another --out",
            error=UsageError,
        )
    with output_path(out, force=request.force, is_folder=True) as folder:
        data = recorded or folder / "recording"
        simulated = {} if recorded else {"simulate -o {data}": "done"}  # the same scene, with the arm of primitives
        reasons = []
        with stopwatch.stage("commands"):
            for text, expected in (simulated | STEPS).items():
                words = [word.format(data=data, out=folder, threads=request.threads) for word in text.split()]
                shown = [word.replace(str(folder), str(out)) for word in words]
                progress.log(f"\n$ splatctrl {shlex.join(shown)}")
                with recorded_as(shown):
                    label = perform(words, folder)
                is_right = label in expected.split(" or ")
                reasons.append(
                    Reason(
                        criterion=words[0] + (" --mode closed-loop" if "closed-loop" in words else ""),
                        outcome=Outcome.PASSED if is_right else Outcome.FAILED,
                        sentence=label if is_right else f"expected '{expected}', got '{label}'",
                        label="not as expected",
                    )
                )
                progress.log(f"demo: {reasons[-1]}")
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
    return verdict


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
        float(np.median(centers[model.moving_spheres][-4:, 2])),
        (centers, model.sphere_set.radii),
        "distance to the map, with the arm's spheres",
    )


def _comparison(frame: RgbdFrame, scene: SceneFolder, threads: int) -> ComparisonRow:
    view, depth = render_with_shell(
        scene.splats(), scene.shell_at(None), frame.intrinsics, frame.T_world_camera, scene.background, threads
    )
    figure = psnr(view.color, frame.color / 255.0, depth > 0)
    return ComparisonRow(
        title=f"{frame.camera} ({'scoring only' if frame.camera == SCORED else 'training'})",
        figures=f"{figure:.1f} dB on mapped pixels",
        photo=frame.color,
        render=view.color,
        photo_depth=frame.depth,
        render_depth=depth,
    )
