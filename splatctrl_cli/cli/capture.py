"""``splatctrl capture``: a capture as one MCAP for viewers, and back."""

import argparse
from pathlib import Path

from splatctrl_cli.captures.capture_pack import pack_capture, unpack_capture
from splatctrl_cli.cli.common import Console, Subparsers, add_command, add_named, add_output
from splatctrl_cli.errors import InputError
from splatctrl_cli.files.output import output_path


def register(subparsers: Subparsers) -> None:
    """Add the subcommand and its actions to the parser."""
    parser = add_named(subparsers, "capture")
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    pack = add_command(actions, "pack", run_pack, summary="write a capture as one MCAP")
    pack.add_argument("capture", type=Path, help="capture folder")
    add_output(pack, default="CAPTURE.mcap", what="MCAP file")
    unpack = add_command(actions, "unpack", run_unpack, summary="write the capture that `pack` made an MCAP of")
    unpack.add_argument("packed", type=Path, help="MCAP file")
    add_output(unpack, default="PACKED.capture", what="capture folder")


def run_pack(args: argparse.Namespace) -> int:
    """Run the action and return its exit code."""
    console = Console(args)
    if not args.capture.is_dir():
        raise InputError(f"{args.capture}: no such folder", remedy="expected what `splatctrl ingest` writes")
    out = args.out or Path(args.capture.resolve().name.removesuffix(".capture") + ".mcap")

    def progress(num_frames: int) -> None:
        if num_frames % 100 == 0:
            console.log(f"{num_frames} frames")

    with output_path(out, force=args.force, is_folder=False) as partial:
        num_frames = pack_capture(args.capture, partial, progress)
        size = partial.stat().st_size
    console.result({"mcap": str(out), "frames": num_frames, "bytes": size}, [f"frames: {num_frames}", f"wrote {out}"])
    return 0


def run_unpack(args: argparse.Namespace) -> int:
    """Run the action and return its exit code."""
    if not args.packed.is_file():
        raise InputError(f"{args.packed}: no such file", remedy="expected what `splatctrl capture pack` writes")
    out = args.out or Path(args.packed.stem + ".capture")
    with output_path(out, force=args.force, is_folder=True) as partial:
        num_frames = unpack_capture(args.packed, partial)
    Console(args).result({"capture": str(out), "frames": num_frames}, [f"frames: {num_frames}", f"wrote {out}"])
    return 0
