"""The options of commands that make, read or check a recording."""

import argparse
from pathlib import Path

from splatctrl_cli.cli.options import (
    POSE,
    SEVERAL_LOGS,
    add_lock,
    add_output,
    add_packages,
    add_seed,
    add_source,
    numbers,
    pose,
)
from splatctrl_cli.cli.parser import Options, Parser, real, whole

QUICK = 30  # images of a topic


def simulate_options(add: Options, parser: Parser) -> None:
    files = "folder for log.mcap, truth.json, robot.urdf, robot_spheres.yaml"
    add_output(add, files, default="simulated")
    add("--urdf FILE", "another arm with collision geometry, its base on the table; spheres are fitted to it", Path)
    add_packages(add)
    add_seed(add, "the noise, of --environment and of --human-arm")
    add(
        "--duration S",
        "length in seconds (default: 7; with --environment 12, with --human-arm 24)",
        real(0.5, 600, "s"),
    )
    add("--free", "free space: floor and walls, no table and nothing on it")
    add("--person", "a walking person with masks, instead of the standing cylinder")
    cylinder = "where the standing cylinder is, and its radius [m] (default: 0.42,0.08,0.06)"
    add("--visitor X,Y,RADIUS", cylinder, numbers)
    shared = "a table shared with a person's arm, with masks, that works beside the arm's pickup or its goal"
    add("--human-arm", shared, ("near-pickup", "near-goal"))
    drawn = "things on tables, or a shelf, drawn by the seed, and a way through"
    add("--environment", drawn, ("tabletop", "cubby", "merged-cubby"))
    add(
        "--dtu",
        "write PATH/dtu and PATH/idr too: a DTU scan of a static scene, in MVSNet's layout and in IDR's, with masks"
        " of its things",
    )
    add("--width PX", "image width", whole(16, 4096, "px"), 320)
    add("--height PX", "image height", whole(16, 4096, "px"), 240)
    add("--noise", "depth noise; stereo fattens edges", ("none", "realsense", "stereo"), "realsense")
    more = add.group("arm and cameras")
    inside = "draw the arm by visual shapes that lie 3 mm (median) to 27 mm (95 %) inside of its collision shapes"
    more("--slim", inside)
    parts = "parts of the arm that images and truth.json have and robot.urdf has not: tool,cable,bracket, or some"
    more("--unmodelled PARTS", parts)
    more("--num-cameras N", "with --environment: 2 to 6 about the arm", whole(2, 6), 4)
    more("--fps HZ", "frames a second", real(0.1, 60, "Hz"), 5.0)


def ingest_options(add: Options, parser: Parser) -> None:
    kinds = ".mcap, .bag, .db3, ROS 2 bag folder, folder of a dataset, or .toml of an image folder"
    add("SOURCE", f"{kinds}; {SEVERAL_LOGS}", Path, nargs="+")
    add_output(add, "capture folder", default="NAME.capture in this folder, NAME that of SOURCE")
    add("--resume", "continue an interrupted run, if there is one, to the same bytes")
    add_source(add)


def info_options(add: Options, parser: Parser) -> None:
    add("PATH", "file or folder", Path)
    add_source(add)


def check_options(add: Options, parser: Parser) -> None:
    kinds = ".mcap, .bag, .db3, ROS 2 bag folder, capture, folder of a dataset, or .toml of an image folder"
    add("SOURCE", f"{kinds}; {SEVERAL_LOGS}", Path, nargs="+")
    fatal = "exit with 1 where a finding is as bad as this"
    add("--fail-on", fatal, ("error", "warning", "never"), "error")
    add(
        "--quick N",
        f"read the first N images of a topic only (default of N: {QUICK})",
        _num_images,
        nargs="?",
        const=QUICK,
    )
    add("--urdf FILE", "compare joint states and depth with this robot (with --spheres: the log's own)", Path)
    add("--spheres FILE", "its spheres (default: those of the URDF)", Path)
    more = add.group("robot")
    more(f"--base {POSE}", "pose of the URDF's root in the world (default: at its origin)", pose)
    add_lock(more)
    add_source(add)


def calibrate_options(add: Options, parser: Parser) -> None:
    kinds = ".mcap, .bag, .db3, ROS 2 bag folder, capture, folder of a dataset, or .toml of an image folder"
    add("SOURCE", f"the recording to calibrate: {kinds}; {SEVERAL_LOGS}", Path, nargs="+")
    add_output(add, "TOML file that commands take as --calibration", default="calibration.toml")
    add("--urdf FILE", "place the cameras by this robot's surface, where its joint states have it", Path)
    add("--hold CAMERA", "what stays as recorded (default: the robot's base, without --urdf the first camera)")
    add(
        "--board COLUMNSxROWS:M",
        "begin where a board of so many inner corners (chessboard or ChArUco), squares of M metres, has the cameras",
    )
    add("--allow-unobserved", "write what the recording says, although not all can be told from it")
    more = add.group("robot")
    more("--spheres FILE", "its spheres (default: those of the URDF), for links without geometry", Path)
    more(f"--base {POSE}", "pose of the URDF's root in the world (default: at its origin)", pose)
    add_packages(more)
    add_lock(more)
    add_source(add)


def _num_images(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        hint = f"put it behind the input, or write --quick={QUICK}"
        raise argparse.ArgumentTypeError(f"expected a number of images, got {text!r}: {hint}") from None


def capture_pack_options(add: Options, parser: Parser) -> None:
    add("CAPTURE", "capture folder", Path)
    add_output(add, "MCAP file", default="CAPTURE.mcap")


def capture_unpack_options(add: Options, parser: Parser) -> None:
    add("PACKED", "MCAP file", Path)
    add_output(add, "capture folder", default="PACKED.capture")
