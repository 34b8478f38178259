"""``splatctrl reconstruct``: a log into splats, occupancy, audit and snapshots."""

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from splatctrl_cli.cli.common import (
    Console,
    Subparsers,
    add_command,
    add_config,
    add_gates,
    add_output,
    check_gate_names,
    check_gates,
    configured,
    table,
)
from splatctrl_cli.cli.source_options import add_source, source_options
from splatctrl_cli.errors import InputError, UsageError

if TYPE_CHECKING:
    from splatctrl_cli.config import Config
    from splatctrl_cli.records import Box, RecordSource
    from splatctrl_cli.robot.model import RobotModel
    from splatctrl_cli.scene.fitter import AuditRow, SceneFitter
    from splatctrl_cli.scene.posture import RobotPosture
    from splatctrl_cli.scene.time_steps import TimeStep

DAMAGED = 3
GATED = (
    *("time_steps", "iterations", "splats", "robot_splats", "added", "relocated", "unmet"),
    *("loss", "psnr"),
)  # what --require can name


def register(subparsers: Subparsers) -> None:
    """Add the subcommand to the parser."""
    parser = add_command(subparsers, "reconstruct", run, summary="fit splats to a log, a capture or a DTU scan")
    parser.add_argument("source", type=Path, nargs="?", help="log, capture folder, or an image folder's .toml")
    parser.add_argument("--dtu", type=Path, metavar="ROOT", help="a DTU data set in MVSNet's layout, instead")
    parser.add_argument("--scan", metavar="NAME", help="which scan of --dtu (default: the only one)")
    add_output(parser, default="scene", what="scene folder")
    add_source(parser)
    parser.add_argument("--max-splats", type=int, metavar="N", help="budget of splats (default: 5000)")
    parser.add_argument("--urdf", type=Path, metavar="FILE", help="the robot: labels its splats, sets the workspace")
    parser.add_argument("--spheres", type=Path, metavar="FILE.yaml", help="its collision spheres")
    parser.add_argument(
        "--box", metavar="X0,Y0,Z0,X1,Y1,Z1", help="workspace [m] (default: the robot's reach, else the valid depth)"
    )
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="where to compute")
    add_config(parser)
    add_gates(parser)


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    from splatctrl_cli.io.output import Stopwatch, output_path, write_run

    if args.device == "cuda":
        raise UsageError("--device cuda: this build has no CUDA kernels", remedy="give --device cpu")
    check_gate_names(args.require, GATED)
    console, stopwatch, config = Console(args), Stopwatch(), _config(args)
    source = _open(args)
    robot = _robot(args, source)
    for doubt in () if robot is None else robot.doubts:
        console.log(f"warning: {doubt}")
    out = args.out or Path("scene")
    with output_path(out, force=args.force, is_folder=True) as partial:
        fitted = _Reconstruction(args, config, source, robot, partial)
        with stopwatch.stage("fit"):
            fitted.run(console)
        with stopwatch.stage("write"):
            fitted.finish()
        inputs = source.digests()
        metrics = fitted.metrics()
        write_run(
            partial,
            command="reconstruct",
            config=config.as_dict(),
            inputs=inputs,
            metrics=metrics,
            stopwatch=stopwatch,
            seed=args.seed,
        )
    last = fitted.rows[-1]
    removed = {name: sum(row.removed[name] for row in fitted.rows) for name in last.removed}
    lines = table(
        ["time steps", "splats", "robot", "added", "relocated", "unmet", "training dB", "seconds"],
        [
            [
                metrics["time_steps"], last.alive, last.robot, metrics["added"], metrics["relocated"],
                metrics["unmet"], "-" if last.psnr is None else f"{last.psnr:.2f}", f"{stopwatch.seconds['fit']:.1f}",
            ]
        ],
    )  # fmt: skip
    lines.append("removed: " + (", ".join(f"{n} {reason}" for reason, n in removed.items() if n) or "none"))
    lines += [f"note: {note}" for note in source.loss.notes]
    console.result({"scene": str(out), "metrics": metrics, "removed": removed}, [*lines, f"wrote {out}"])
    check_gates(args.require, {name: _number(metrics[name]) for name in GATED})
    return DAMAGED if source.loss.damaged else 0


def _number(value: object) -> float | None:
    return None if value is None else float(str(value))


def _config(args: argparse.Namespace) -> "Config":
    from dataclasses import replace

    config = configured(args)
    if args.max_splats is None:
        return config
    if args.max_splats < 1:
        raise UsageError(f"--max-splats: expected at least 1, got {args.max_splats}")
    return replace(config, scene=replace(config.scene, max_splats=args.max_splats))


def _open(args: argparse.Namespace) -> "RecordSource":
    from splatctrl_cli.io.source import open_source

    if (args.source is None) == (args.dtu is None):
        raise UsageError("reconstruct: expected a SOURCE or --dtu ROOT, and not both")
    if args.dtu is None:
        return open_source(args.source, source_options(args))
    from splatctrl_cli.io.dtu_source import DtuSource, view_numbers

    return DtuSource(args.dtu, args.scan, view_numbers([word for word in (args.holdout or "").split(",") if word]))


def _robot(args: argparse.Namespace, source: "RecordSource") -> "RobotModel | None":
    if args.urdf is None:
        if args.spheres is not None:
            raise UsageError(f"--spheres {args.spheres}: belongs to a robot", remedy="give its --urdf as well")
        return None
    from splatctrl_cli.robot.model import RobotModel

    model = RobotModel.from_urdf(args.urdf, args.spheres)
    if source.joint_names:
        model.joint_order(source.joint_names)
    return model


class _Reconstruction:
    """The fitter over a source's time steps, with what it writes on the way."""

    def __init__(
        self,
        args: argparse.Namespace,
        config: "Config",
        source: "RecordSource",
        robot: "RobotModel | None",
        folder: Path,
    ) -> None:
        from splatctrl_cli.io.scene_folder import FORMAT, SceneWriter

        self.args = args
        self.config = config
        self.source = source
        self.robot = robot
        self.cameras = [camera for camera in source.cameras if camera != "holdout"]
        if not self.cameras:
            raise UsageError(
                f"{source.name}: no camera is left to train on", remedy="camera 'holdout' is kept for score"
            )
        self.writer = SceneWriter(folder, {"format": FORMAT, "frame": "world", "units": "m", "source": source.name})
        self.fitter: SceneFitter | None = None
        self.rows: list[AuditRow] = []
        self.stamps: list[int] = []

    def run(self, console: Console) -> None:
        """Step through the log."""
        from tqdm import tqdm

        scene = self.config.scene
        steps = tqdm(self._steps(), disable=True if console.is_quiet else None, unit=" steps")
        early: TimeStep | None = None
        for index, step in enumerate(steps):
            if self.fitter is None and not step.has_depth and self._needs_depth():
                console.log(f"time step {index} left out: no depth yet, and nothing else says where the workspace is")
                early = early or step
                continue
            if self.fitter is None:
                self.fitter = self._new_fitter(step)
            elif not self.source.has_clock and self.fitter.num_steps == 1:
                console.log(
                    "warning: more views than fit in one time step; the last ones are refined on, the rest seed"
                )
            row = self.fitter.step(step.frames, self._posture(step))
            self.stamps.extend(frame.stamp_ns for frame in step.frames)
            self.rows.append(row)
            self.writer.audit(row)
            if index % 10 == 0 and not steps.disable:
                steps.set_postfix(splats=row.alive, dB=row.psnr)
            if steps.disable and index % 10 == 0:
                quality = (
                    "nothing of the workspace in view" if row.psnr is None else f"{row.psnr:.1f} dB on its own views"
                )
                console.log(f"time step {index}: {row.alive} splats, {quality}")
            if index % scene.snapshot_every == 0 and self.source.has_clock:
                self.writer.snapshot(step.stamp_ns, self.fitter.splats())
        if self.fitter is None and early is not None:
            self._workspace(early)  # says that there is no depth
        if self.fitter is None:
            raise InputError(
                f"{self.source.name}: no frame with colour, depth and pose from camera {', '.join(self.cameras)}",
                remedy="'splatctrl info' says what the input lacks",
            )
        if not any(row.alive for row in self.rows):
            raise InputError(
                f"{self.source.name}: no pixel of camera {', '.join(self.cameras)} has a depth inside the workspace",
                remedy="give a --box that holds what the cameras saw; 'splatctrl info' says where they stand",
            )
        if not self.source.has_clock:
            row = self.fitter.refine(scene.refine_iterations, progress=self._refined(console))
            self.rows.append(row)
            self.writer.audit(row)
            self.writer.snapshot(self.rows[-1].stamp_ns, self.fitter.splats())

    def _refined(self, console: Console) -> "Callable[[int], None]":
        total = self.config.scene.refine_iterations
        return lambda done: console.log(f"refined {done} of {total} iterations")

    def _steps(self) -> "Iterator[TimeStep]":
        from splatctrl_cli.scene.time_steps import time_steps

        return time_steps(self.source.records(), self.cameras, has_clock=self.source.has_clock)

    def _new_fitter(self, first: "TimeStep") -> "SceneFitter":
        from splatctrl_cli.scene.fitter import SceneFitter

        return SceneFitter(
            self.config.scene,
            self.config.occupancy,
            self._workspace(first),
            seed=self.args.seed,
            threads=self.args.threads,
        )

    def _needs_depth(self) -> bool:
        """Whether only depth can say where the workspace is."""
        return self.args.box is None and self.robot is None

    def _workspace(self, first: "TimeStep") -> "Box":
        from splatctrl_cli.records import Box
        from splatctrl_cli.scene.time_steps import depth_box

        if self.args.box:
            return Box.from_text(self.args.box)
        if self.robot is not None:
            reach, base = self.robot.reach(), self.robot.base_position
            return Box(lower=base - reach, upper=base + reach)
        return depth_box(first.frames, self.config.occupancy.max_range)

    def _posture(self, step: "TimeStep") -> "RobotPosture | None":
        import numpy as np

        from splatctrl_cli.scene.posture import RobotPosture

        if self.robot is None or step.position is None:
            return None
        q = step.position[self.robot.joint_order(self.source.joint_names)]
        spheres = self.robot.sphere_set
        pose = {link: self.robot.frame_pose(q, link) for link in set(spheres.links)}
        return RobotPosture(
            centers=self.robot.sphere_centers(q),
            radii=spheres.radii,
            T_world_link=np.array([pose[link] for link in spheres.links]),
        )

    def finish(self) -> None:
        """Write what the end of the log left."""
        assert self.fitter is not None
        fitter = self.fitter
        self.writer.finish(self.rows[-1].stamp_ns, fitter.splats(), fitter.occupancy_grid(), fitter.state())

    def metrics(self) -> dict[str, object]:
        """For ``run.json`` and gates."""
        assert self.fitter is not None
        last = self.rows[-1]
        return {
            "cameras": self.cameras,
            "has_clock": self.source.has_clock,
            "stamp_ns": last.stamp_ns,
            "training_stamps_ns": [] if self.source.has_clock else self.stamps,
            "time_steps": self.fitter.num_steps,
            "iterations": self.fitter.num_iterations,
            "splats": last.alive,
            "robot_splats": last.robot,
            "added": sum(row.added for row in self.rows),
            "relocated": sum(row.relocated for row in self.rows),
            "unmet": sum(row.unmet for row in self.rows),
            "loss": last.loss,
            "psnr": last.psnr,
            "workspace": [*self.fitter.workspace.lower.tolist(), *self.fitter.workspace.upper.tolist()],
        }
