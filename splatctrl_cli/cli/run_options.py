"""Options of commands on recordings and runs."""

import argparse
from functools import partial
from pathlib import Path

from splatctrl_cli.cli.common import BASE, LOCK, OF_FOLDERS, PACKAGES, SEVERAL_LOGS, names_of, numbers, output, seed
from splatctrl_cli.cli.parser import group, option, real, whole
from splatctrl_cli.errors import refuse_if

ROOT = "folder in which the scene and robot of a replay's command line are looked for, if they were moved"


def _shard(text: str) -> tuple[int, int]:
    index, _, count = text.partition("/")
    refuse_if(
        not (index.isdigit() and count.isdigit() and 1 <= int(index) <= int(count)),
        f"expected I/N with I from 1 to N, got {text!r}",
        error=argparse.ArgumentTypeError,
    )
    return int(index), int(count)


REPORT = (
    option("PATH", "the folder of a run, or of a batch", Path),
    *output("HTML file to write", default="PATH.html, next to PATH"),
    option(
        "--against BEFORE",
        "say what changed since an earlier run or batch, or a baseline of compare --update-baseline",
        Path,
    ),
    option("--all-scenes", "of a batch, every replay in 3-D, not only the failed, changed and worst"),
    option("--root DIR ...", ROOT, Path, fields={"roots": tuple}),
)
VIEW = (
    option("PATH", "a run, scene or field folder, a field.npz, or a splat file", Path),
    *output("HTML file to write", default="PATH.html, next to PATH"),
    option("--no-open", "do not open it in a browser"),
    option("--root DIR ...", ROOT, Path, fields={"roots": tuple}),
)
BATCH = (
    option("SUITE", "TOML file of recordings and jobs (splatctrl help batch); with --list also an output", Path),
    option(
        "-o/--out DIR", "folder of the batch, which a second run continues (default: the suite's, or SUITE.out)", Path
    ),
    option("--workers N", "nodes that run at once (default: one per core)", whole(1, 256)),
    option("--shard I/N", "only every N-th recording, from the I-th on", _shard),
    option("--again", "run what is done, too"),
    option("--dry-run", "print the nodes and their command lines, and run nothing"),
    option("--dask ADDRESS", "run the nodes on a Dask cluster that shares this folder"),
    group(
        "ledger",
        option("--list", "print what ran last, and run nothing"),
        option("--failed", "as --list, of what did not end as expected"),
        option("--where COLUMN=VALUE ...", "as --list, of the runs for which it holds; also !=, <, >, <=, >="),
        option("--csv FILE", "as --list, into a table with every column", Path),
    ),
)
SWEEP = (
    option("REPLAY", "the folder that replay wrote", Path),
    option(
        "--over KEY=A:B ...",
        "what is varied, from A to B: splats, cameras-out, depth-noise, pose-error, pose-turn, latency, margin, ..."
        " (splatctrl help sweep), or a setting",
    ),
    option("-o/--out DIR", "folder of the sweep, which a second run continues (default: sweep)", Path),
    option(
        "--tolerance SHARE",
        "how near the two sides of a flip are to lie, as a share of the range",
        real(1e-6, 0.5),
        1 / 64,
    ),
    option("--workers N", "runs at once (default: one per core)", whole(1, 256)),
    option("--dask ADDRESS", "make the runs on a Dask cluster that shares this folder"),
)
COMPARE = (
    option(
        "OUTPUT",
        "folder that a command or a batch wrote; of two the earlier first",
        Path,
        nargs="+",
        fields={"runs": tuple},
    ),
    option("--against FILE", "compare the only OUTPUT with this stored baseline", Path),
    option("--update-baseline FILE", "write the last OUTPUT as a baseline, alone or after the comparison", Path),
)


UNMODELLED = ("tool", "cable", "bracket")  # as simulate.arm has them, which is not imported for a help text
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
    option("--duration S", "length in seconds (default: 7)", real(0.5, 600, "s"), dest="duration_s"),
    option("--free", "free space: floor and walls, no table and nothing on it", dest="is_free"),
    option("--person", "a walking person with masks, instead of the standing cylinder", dest="with_person"),
    option(
        "--visitor X,Y,RADIUS",
        "where the standing cylinder is, and its radius [m] (default: 0.42,0.08,0.06)",
        numbers,
    ),
    option(
        "--dtu",
        "write PATH/dtu and PATH/idr too: a DTU scan of a static scene, in MVSNet's layout and in IDR's, with masks"
        " of its objects",
    ),
    option("--width PX", "image width", whole(16, 4096, "px"), 320),
    option("--height PX", "image height", whole(16, 4096, "px"), 240),
    option("--noise", "depth noise; stereo fattens edges", ("none", "realsense", "stereo"), "realsense"),
    group(
        "arm and cameras",
        option(
            "--slim",
            "draw the arm by visual shapes that lie 3 mm (median) to 27 mm (95 %) inside of its collision shapes",
            dest="is_slim",
        ),
        option(
            "--unmodelled PARTS",
            "parts of the arm that images and truth.json have and robot.urdf has not: tool,cable,bracket, or some",
            fields={"unmodelled": partial(names_of, "--unmodelled", UNMODELLED)},
        ),
        option("--fps HZ", "frames a second", real(0.1, 60, "Hz"), 5.0),
    ),
)
INGEST = (
    option("SOURCE", f"{FILES}, {OTHERS}; {SEVERAL_LOGS}", Path, nargs="+", fields={"paths": tuple}),
    *output("capture folder", default="NAME.capture in this folder, NAME that of SOURCE"),
    option("--resume", "continue an interrupted run, if there is one; the result has the same bytes"),
    *OF_FOLDERS,
)
INFO = (option("PATH", "file or folder", Path), *OF_FOLDERS)
CHECK = (
    option("SOURCE", f"{FILES}, capture, {OTHERS}; {SEVERAL_LOGS}", Path, nargs="+", fields={"paths": tuple}),
    option(
        "--fail-on", "exit with 1 for a finding of this severity or worse", ("error", "warning", "never"), "error"
    ),
    option(
        "--quick N",
        f"read the first N images of a topic only (default of N: {QUICK})",
        _num_images,
        dest="num_images",
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
    option(
        "SOURCE",
        f"the recording to calibrate: {FILES}, capture, {OTHERS}; {SEVERAL_LOGS}",
        Path,
        nargs="+",
        fields={"paths": tuple},
    ),
    *output("TOML file that commands take as --calibration", default="calibration.toml"),
    option("--urdf FILE", "place the cameras by this robot's surface, where its joint states have it", Path),
    option("--hold CAMERA", "what stays as recorded (default: the robot's base, without --urdf the first camera)"),
    option(
        "--board COLUMNSxROWS:M",
        "begin where a board of so many inner corners (chessboard or ChArUco), squares of M metres, has the cameras",
        fields={"board": "calibration.board:board_of"},
    ),
    option("--allow-unobserved", "write the result although the recording does not determine all of it"),
    group(
        "robot",
        option("--spheres FILE", "its spheres (default: those of the URDF), for links without geometry", Path),
        BASE,
        PACKAGES,
        LOCK,
    ),
    *OF_FOLDERS,
)
