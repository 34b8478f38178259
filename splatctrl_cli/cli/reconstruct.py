"""``splatctrl reconstruct``: a log into splats, occupancy, audit and snapshots."""

import argparse
from pathlib import Path

from splatctrl_cli.cli.common import Console, config_of, request_of, table
from splatctrl_cli.errors import UsageError, refuse_if
from splatctrl_cli.evaluate.verdict import Result
from splatctrl_cli.jobs.reconstruct.reconstruct import reconstruct
from splatctrl_cli.jobs.reconstruct.reconstruction import ReconstructRequest
from splatctrl_cli.jobs.recordings.open_recording import RecordingRequest, open_to_train
from splatctrl_cli.jobs.running.device import DECIDING_OPTIONS, describe_device
from splatctrl_cli.kernels import native


def run(args: argparse.Namespace, console: Console) -> int:
    native.keep_freed_memory()
    config = config_of(args)  # refused before the source is opened
    refuse_if(
        (args.source is None) == (args.dtu is None),
        "reconstruct: expected a SOURCE or --dtu ROOT, and not both",
        error=UsageError,
    )
    allowed = {"views-agreement", "views-scale"} if args.allow_disagreement or args.refine_poses else set()
    request = request_of(
        ReconstructRequest,
        args,
        config=config,
        source=open_to_train(
            recording_of(args, args.source),
            max_pose_jump=args.max_pose_jump,
            needs_depth=args.points is None,
            allowed=allowed | ({"alignment"} if args.allow_disagreement else set()),
        ),
        options={name: getattr(args, name) for name in DECIDING_OPTIONS},
    )
    result = reconstruct(request, console)
    return console.show(result, [*_lines(result), f"wrote {result.out}"])


def recording_of(args: argparse.Namespace, path: Path, beside: tuple[Path, ...] = ()) -> RecordingRequest:
    return request_of(RecordingRequest, args, path=args.dtu or path, is_dtu=args.dtu is not None, beside=beside)


def _lines(result: Result) -> list[str]:
    metrics, removed = result.metrics, result.document["removed"]
    psnr = metrics["psnr"]
    columns = {
        **{name.replace("_", " "): metrics[name] for name in ("time_steps", "splats")},
        "robot": metrics["robot_splats"],
        "shell": metrics["shell_splats"],
        **{name: metrics[name] for name in ("added", "relocated", "unmet")},
        "training dB": "-" if psnr is None else f"{psnr:.2f}",
        "seconds": f"{sum(result.seconds.values()):.1f}",
    }
    reasons = (f"{count} {reason.replace('_', ' ')}" for reason, count in removed.items() if count)
    return [
        *table(list(columns), [list(columns.values())]),
        f"removed: {', '.join(reasons) or 'none'}",
        f"computed on {', then '.join(map(describe_device, metrics['devices']))}",
    ]
