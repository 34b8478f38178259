"""The options of commands that make, read or check a recording."""

import argparse
from pathlib import Path

from splatctrl_cli.cli.options import BASE, LOCK, OF_FOLDERS, PACKAGES, SEVERAL_LOGS, numbers, output, seed
from splatctrl_cli.cli.parser import group, option, real, whole

QUICK = 30  # images of a topic
FILES = ".mcap, .bag, .db3, ROS 2 bag folder"
OTHERS = "folder of a dataset, or .toml of an image folder"


def _num_images(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        hint = f"put it behind the input, or write --quick={QUICK}"
        raise argparse.ArgumentTypeError(f"expected a number of images, got {text!r}: {hint}") from None


SIMULATE = (
    *output("folder for log.mcap, truth.json, robot.urdf, robot_spheres.yaml", default="simulated"),
    option("--urdf FILE", "another arm with collision geometry, its base on the table", Path),
    option("--spheres FILE", "its spheres (default: fitted to it)", Path),
    PACKAGES,
    seed("the noise"),
    option("--duration S", "length in seconds (default: 7)", real(0.5, 600, "s")),
    option("--free", "free space: floor and walls, no table and nothing on it"),
    option("--person", "a walking person with masks, instead of the standing cylinder"),
    option(
        "--visitor X,Y,RADIUS",
        "where the standing cylinder is, and its radius [m] (default: 0.42,0.08,0.06)",
        numbers,
    ),
    option(
        "--dtu",
        "write PATH/dtu and PATH/idr too: a DTU scan of a static scene, in MVSNet's layout and in IDR's, with masks"
        " of its things",
    ),
    option("--width PX", "image width", whole(16, 4096, "px"), 320),
    option("--height PX", "image height", whole(16, 4096, "px"), 240),
    option("--noise", "depth noise; stereo fattens edges", ("none", "realsense", "stereo"), "realsense"),
    group(
        "arm and cameras",
        option(
            "--slim",
            "draw the arm by visual shapes that lie 3 mm (median) to 27 mm (95 %) inside of its collision shapes",
        ),
        option(
            "--unmodelled PARTS",
            "parts of the arm that images and truth.json have and robot.urdf has not: tool,cable,bracket, or some",
        ),
        option("--fps HZ", "frames a second", real(0.1, 60, "Hz"), 5.0),
    ),
)
INGEST = (
    option("SOURCE", f"{FILES}, {OTHERS}; {SEVERAL_LOGS}", Path, nargs="+"),
    *output("capture folder", default="NAME.capture in this folder, NAME that of SOURCE"),
    option("--resume", "continue an interrupted run, if there is one, to the same bytes"),
    *OF_FOLDERS,
)
INFO = (option("PATH", "file or folder", Path), *OF_FOLDERS)
CHECK = (
    option("SOURCE", f"{FILES}, capture, {OTHERS}; {SEVERAL_LOGS}", Path, nargs="+"),
    option("--fail-on", "exit with 1 where a finding is as bad as this", ("error", "warning", "never"), "error"),
    option(
        "--quick N",
        f"read the first N images of a topic only (default of N: {QUICK})",
        _num_images,
        nargs="?",
        const=QUICK,
    ),
    option("--urdf FILE", "compare joint states and depth with this robot (with --spheres: the log's own)", Path),
    option("--spheres FILE", "its spheres (default: those of the URDF)", Path),
    group(
        "robot",
        BASE,
        LOCK,
    ),
    *OF_FOLDERS,
)
CALIBRATE = (
    option("SOURCE", f"the recording to calibrate: {FILES}, capture, {OTHERS}; {SEVERAL_LOGS}", Path, nargs="+"),
    *output("TOML file that commands take as --calibration", default="calibration.toml"),
    option("--urdf FILE", "place the cameras by this robot's surface, where its joint states have it", Path),
    option("--hold CAMERA", "what stays as recorded (default: the robot's base, without --urdf the first camera)"),
    option(
        "--board COLUMNSxROWS:M",
        "begin where a board of so many inner corners (chessboard or ChArUco), squares of M metres, has the cameras",
    ),
    option("--allow-unobserved", "write what the recording says, although not all can be told from it"),
    group(
        "robot",
        option("--spheres FILE", "its spheres (default: those of the URDF), for links without geometry", Path),
        BASE,
        PACKAGES,
        LOCK,
    ),
    *OF_FOLDERS,
)
