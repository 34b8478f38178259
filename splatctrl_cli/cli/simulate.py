"""``splatctrl simulate``: a recorded log with known truth."""

import argparse
from pathlib import Path
from typing import Any

from splatctrl_cli.cli.common import Console, Subparsers, add_command, add_output, table
from splatctrl_cli.cli.numbers import MAX_SEED, real, whole
from splatctrl_cli.datasets.dtu import DtuView, write_dtu
from splatctrl_cli.datasets.idr import write_idr
from splatctrl_cli.files.output import Stopwatch, output_path, write_json, write_run
from splatctrl_cli.logs.mcap_writer import mcap_log
from splatctrl_cli.records import JointState
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.simulate.arm import arm_spheres_yaml, arm_urdf
from splatctrl_cli.simulate.primitives import luminance_std
from splatctrl_cli.simulate.recording import Recording, RecordingOptions
from splatctrl_cli.simulate.shared_workspace import DURATION_S
from splatctrl_cli.simulate.tabletop import object_mask, turntable_views
from splatctrl_cli.simulate.truth import Truth, truth_document


def register(subparsers: Subparsers) -> None:
    """Add the subcommand to the parser."""
    parser = add_command(subparsers, "simulate", run)
    add_output(parser, default="simulated", what="folder for log.mcap, truth.json, robot.urdf, robot_spheres.yaml")
    parser.add_argument(
        "--seed", type=whole(0, MAX_SEED), default=0, help="seed of the noise and of --human-arm (default: 0)"
    )
    parser.add_argument(
        "--duration",
        type=real(0.5, 600, "s"),
        metavar="S",
        help="length in seconds (default: 7, with --human-arm 24)",
    )
    parser.add_argument(
        "--fps", type=real(0.1, 60, "Hz"), default=5.0, metavar="HZ", help="frames a second (default: 5)"
    )
    parser.add_argument(
        "--width", type=whole(16, 4096, "px"), default=320, metavar="PX", help="image width (default: 320)"
    )
    parser.add_argument(
        "--height", type=whole(16, 4096, "px"), default=240, metavar="PX", help="image height (default: 240)"
    )
    parser.add_argument(
        "--noise", choices=("none", "realsense"), default="realsense", help="depth noise (default: realsense)"
    )
    parser.add_argument(
        "--person", action="store_true", help="a walking person with masks, instead of the standing cylinder"
    )
    parser.add_argument(
        "--human-arm",
        choices=("near-pickup", "near-goal"),
        help="a table shared with a person's arm, with masks, that works beside the arm's pickup or its goal",
    )
    parser.add_argument(
        "--dtu",
        action="store_true",
        help="write PATH/dtu and PATH/idr too: a DTU scan of a static scene, in MVSNet's layout and in"
        " IDR's, with masks of its things",
    )


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    default_s = 7.0 if args.human_arm is None else DURATION_S
    console = Console(args)
    options = RecordingOptions(
        duration_s=default_s if args.duration is None else args.duration,
        fps=args.fps,
        width=args.width,
        height=args.height,
        noise=args.noise,
        seed=args.seed,
        with_person=args.person,
        human_arm=args.human_arm,
    )
    stopwatch = Stopwatch()
    out = args.out or Path("simulated")
    with output_path(out, force=args.force, is_folder=True) as folder:
        with stopwatch.stage("log"):
            truth, num_frames = _record(folder, options, console)
        write_json(folder / "truth.json", truth_document(truth))
        if args.dtu:
            with stopwatch.stage("dtu"):
                _write_scan(folder)
        metrics = _metrics(truth, num_frames)
        write_run(
            folder,
            command="simulate",
            config=vars(options),
            inputs={},
            metrics=metrics,
            stopwatch=stopwatch,
            seed=options.seed,
        )
        sizes = _sizes(folder)
    console.result({"out": str(out), "bytes": sizes, **metrics}, _report(out, truth, num_frames, sizes))
    return 0


def _record(folder: Path, options: "RecordingOptions", console: Console) -> "tuple[Truth, dict[str, int]]":
    """Write robot files and log; the truth and the number of frames by camera."""
    urdf, spheres = folder / "robot.urdf", folder / "robot_spheres.yaml"
    urdf.write_text(arm_urdf(), encoding="utf-8")
    spheres.write_text(arm_spheres_yaml(), encoding="utf-8")
    recording = Recording(options, RobotModel.from_urdf(urdf, spheres))
    contrast: dict[str, float] = {}
    num_frames = {camera.name: 0 for camera in recording.cameras}
    with mcap_log(folder / "log.mcap") as log:
        log.add_transforms(recording.start_ns, recording.static_transforms(), is_static=True)
        for record in recording.records():
            if isinstance(record, JointState):
                log.add_joint_state(record, recording.robot.joint_names)
                log.add_transforms(record.stamp_ns, recording.link_transforms(record.position), is_static=False)
                continue
            log.add_frame(record)
            contrast[record.camera] = min(contrast.get(record.camera, 1.0), luminance_std(record.color))
            num_frames[record.camera] += 1
            if record.camera == recording.cameras[-1].name and num_frames[record.camera] % 10 == 0:
                console.log(f"simulate: {(record.stamp_ns - recording.start_ns) / 1e9:.1f} s recorded")
    return _truth(folder, recording, contrast), num_frames


def _truth(folder: Path, recording: "Recording", contrast: dict[str, float]) -> "Truth":
    stamps, clearance = recording.clearances()
    return Truth(
        path=folder / "truth.json",
        primitives=recording.primitives,
        cameras=recording.cameras,
        luminance_std=contrast,
        joint_names=recording.robot.joint_names,
        robot_urdf=folder / "robot.urdf",
        robot_spheres=folder / "robot_spheres.yaml",
        T_world_base=recording.robot.T_world_base,
        stamps=stamps,
        clearance=clearance,
    )


def _write_scan(folder: Path) -> None:
    scan = [
        DtuView(
            name=frame.camera,
            color=frame.color,
            depth=frame.depth,
            intrinsics=frame.intrinsics,
            T_world_camera=frame.T_world_camera,
            mask=object_mask(frame),
        )
        for frame in turntable_views()
    ]
    write_dtu(folder / "dtu", "scan1", scan)
    write_idr(folder / "idr", "scan1", scan)


def _sizes(folder: Path) -> dict[str, int]:
    """Bytes of each file, and of each folder's files in all."""
    sizes = {}
    for path in sorted(folder.iterdir()):
        parts = [path] if path.is_file() else [part for part in path.rglob("*") if part.is_file()]
        sizes[path.name if path.is_file() else f"{path.name}/"] = sum(part.stat().st_size for part in parts)
    return sizes


def _metrics(truth: "Truth", num_frames: dict[str, int]) -> dict[str, Any]:
    training = [camera.name for camera in truth.cameras if camera.is_training]
    return {
        "frames": num_frames,
        "joint_states": len(truth.stamps),
        "luminance_std": {name: round(value, 4) for name, value in truth.luminance_std.items()},
        "min_luminance_std": round(min(truth.luminance_std[name] for name in training), 4),
        "min_clearance": round(float(truth.clearance.min()), 4),
    }


def _report(out: Path, truth: "Truth", num_frames: dict[str, int], sizes: dict[str, int]) -> list[str]:
    cameras = [
        (
            camera.name,
            "training" if camera.is_training else "scoring",
            num_frames[camera.name],
            f"{camera.intrinsics.width}x{camera.intrinsics.height}",
            f"{truth.luminance_std[camera.name]:.3f}",
        )
        for camera in truth.cameras
    ]
    lines = [f"{out}", "", *table(("file", "bytes"), list(sizes.items())), ""]
    lines += table(("camera", "role", "frames", "size", "luminance std"), cameras)
    lines += ["", f"joint states {len(truth.stamps)}, true clearance at least {truth.clearance.min() * 100:.1f} cm"]
    return lines
