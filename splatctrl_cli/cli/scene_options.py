"""Options of commands on scenes and motions."""

import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path

from splatctrl_cli.cli.common import (
    BASE,
    BOX,
    CONFIG,
    CONFIG_FILE,
    DECLARE,
    DEVICE,
    DISAGREEMENT,
    GATES,
    HOLDOUT,
    LOCK,
    OF_FOLDERS,
    PACKAGES,
    POSE,
    SCAN,
    SELF_MODEL,
    SOURCE,
    THREADS,
    names_of,
    numbers,
    output,
    pose,
    settings,
)
from splatctrl_cli.cli.parser import MAX_SECONDS, either, group, option, real, whole
from splatctrl_cli.config import FieldConfig, SceneConfig

SPLAT_FORMATS = (".ply", ".splat", ".spz", ".glb", ".usda", ".usdc")  # as the registries have them, which are not
GRID_FORMATS = ("npz", "vti", "nrrd", "vdb", "curobo", "moveit", "ply", "obj", "stl")  # imported for a help text
AS_BOX: Mapping[str, str] = {"box": "records:Box.from_text"}
AS_LABELS: Mapping[str, str] = {"labels": "cli.sdf_bake:labels_of"}
CHANNELS = ("sdf", "gradient", "bound", "observed", "probability", "label", "hard", "se", "gpdf")


def split_cameras(text: str) -> tuple[Path, tuple[str, ...]]:
    """Log and cameras of ``LOG:camera,...``; without names, all cameras that did not train."""
    path, colon, cameras = text.rpartition(":")
    if not colon or Path(text).exists():
        return Path(text), ()
    return Path(path), tuple(name.strip() for name in cameras.split(",") if name.strip())


PLACED = (BASE, LOCK, PACKAGES)
FITTED = "default: the URDF's own, else fitted to it once"
RECONSTRUCT = (
    option("SOURCE", "log, capture folder, or an image folder's .toml", Path, nargs="?", fields={"recording": Path}),
    option("--dtu ROOT", "instead, a DTU data set in the layout of MVSNet, or of IDR and NeuS", Path),
    *output("scene folder", default="scene"),
    option("--resume", "continue an interrupted run; the result has the same bytes"),
    option("--urdf FILE", "the robot (default: the log's own): labels its splats, sets the workspace", Path),
    option("--spheres FILE.yaml", f"its collision spheres ({FITTED})", Path),
    *PLACED,
    SELF_MODEL,
    option(f"--box {BOX}", "workspace [m] (default: the robot's reach, else the valid depth)", fields=AS_BOX),
    option(
        "--max-splats N",
        "budget of splats (default: 5000)",
        sets=(SceneConfig, "max_splats"),
    ),
    *CONFIG,
    GATES,
    *OF_FOLDERS,
    group("scan of --dtu", *SCAN),
    group(
        "fit",
        option(
            "--points FILE.ply",
            "coloured points to start from instead of depth, for colour cameras alone (no occupancy)",
            Path,
        ),
        DECLARE,
        *DISAGREEMENT,
        option(
            "--refine-poses",
            "put views of a still scene where they show the same surfaces; free depth of its bend",
            fields={"poses": bool},
        ),
        option(
            "--refine-exposure",
            "give the views of a still scene one brightness and white balance, even if they differ by less than 5 %",
            fields={"exposure": bool},
        ),
    ),
    DEVICE,
)
EXPORT = (
    option(
        "SCENE",
        f"a scene folder, or a splat file: {', '.join(SPLAT_FORMATS)}; with --mcap also a replay or a field",
        Path,
        fields={"scene": Path, "path": Path},
    ),
    *output(
        f"the file to write; its suffix is the format: {', '.join(SPLAT_FORMATS)}", default="SCENE.ply, next to SCENE"
    ),
    option("--mcap", "write an MCAP for Foxglove, over time (default of --out: SCENE.mcap; splatctrl help report)"),
    option(
        "--labels NAME,...",
        "only splats of these labels: object, robot, human (default: all)",
        fields={"labels": "cli.export:labels_of"},
    ),
    option(
        "--layout",
        "of a PLY: short has label and density, full the reference's 62 properties (default: short for isotropic"
        " splats, for others full, and a label where one is not object)",
        ("short", "full"),
    ),
    option("--isotropic", "make anisotropic Gaussians round: same volume, opacity and mean colour"),
    option(
        "--root DIR ...",
        "with --mcap: folder in which the scene and robot of a replay's command line are looked for",
        Path,
        fields={"roots": tuple},
    ),
)
SDF_BAKE = (
    option("SCENE", "a folder that reconstruct wrote, or a file of round splats: .ply, .splat, .spz", Path),
    *output("folder to write: the grid, field.json, report/, run.json", default="field"),
    option("--at SECONDS", "the scene as known at this time after its start", real(-MAX_SECONDS, MAX_SECONDS, "s")),
    option(
        f"--box {BOX}", "box that the grid covers [m]; write --box=-1,... if it begins with a minus", fields=AS_BOX
    ),
    option("--urdf URDF", "cover the reach of this robot around its base, without --box", Path),
    option("--voxel M", "cell size (field.voxel)", sets=(FieldConfig, "voxel")),
    option(
        "--formats NAME,...",
        f"of {', '.join(GRID_FORMATS)}",
        str,
        "npz,vti",
        fields={"formats": partial(names_of, "--formats", GRID_FORMATS)},
    ),
    option("--truth truth.json", "measure the field against this truth", Path),
    option("--seen-by LOG", "the log or capture whose cameras saw the scene, for --truth", Path),
    option("--resume", "continue an interrupted bake; the result has the same bytes"),
    *CONFIG,
    DEVICE,
    GATES,
    group(
        "field",
        option(
            "--include NAME,...",
            "labels in the field in addition to object: robot, human, or none",
            str,
            "human",
            fields=AS_LABELS,
        ),
        option("--spheres FILE.yaml", f"spheres of --urdf ({FITTED})", Path),
        option(
            "--channels NAME,...",
            f"channels to bake besides sdf, of {', '.join(CHANNELS)} (default: {','.join(CHANNELS[:4])})",
            fields={"channels": partial(names_of, "--channels", CHANNELS)},
        ),
        option(
            "--distance",
            "what sdf is: min(se, hard), min(gpdf, hard), the exact distance, either kernel field (field.distance)",
            sets=(FieldConfig, "distance"),
        ),
        option(
            "--weights",
            "of the kernel field: row sums, voxels, the full GP (field.weights)",
            sets=(FieldConfig, "weights"),
        ),
        option(
            "--length-scale M",
            "l of the kernel (field.length_scale)",
            sets=(FieldConfig, "length_scale"),
        ),
        option(
            "--unknown",
            "what never-seen space counts as (field.unknown)",
            sets=(FieldConfig, "unknown"),
        ),
        option(
            "--probability",
            "bake the channel probability, of collision, in this form (field.probability)",
            fields={"with_probability": bool},
            sets=(FieldConfig, "probability"),
        ),
    ),
    group(
        "accuracy and update",
        option("--reference-mesh FILE", "measure the field against this mesh (world, metres)", Path),
        option(
            "--held-out LOG[:CAMERA,...]",
            "measure the field against depth of cameras that did not train; --urdf tells which pixels are robot",
            fields={
                "held_out": lambda text: split_cameras(text)[0],
                "held_out_cameras": lambda text: split_cameras(text)[1],
            },
        ),
        option("--no-report", "draw no pictures"),
        option("--update FIELD", "bake anew only what changed since that field folder was baked", Path),
        option("--previous-scene SCENE", "what --update's field was baked from (default: SCENE)", Path),
    ),
)
QUERY = (
    option("SOURCE", "a folder that sdf-bake or reconstruct wrote, a field.npz, or a file of round splats", Path),
    option(
        "POINTS",
        "CSV file with columns x,y,z [m] in the world, with or without a header; - for stdin",
        Path,
        fields={"points": lambda path: sys.stdin if str(path) == "-" else path},
    ),
    *output("CSV file of the answers, in the order of the points", default="stdout, with --json none"),
    option("--scene SCENE", "what SOURCE, a field, was baked from: adds what a grid does not know", Path),
    option("--at SECONDS", "of a scene: as known at this time after its start", real(-MAX_SECONDS, MAX_SECONDS, "s")),
    option(
        "--include NAME,...",
        "of a scene: labels that count in addition to object: robot, human, or none",
        str,
        "human",
        fields=AS_LABELS,
    ),
    CONFIG_FILE,
    *settings(", such as field.distance=hard"),
    THREADS,
    DEVICE,
)
SCORE = (
    option(
        "SCENE",
        "a folder that reconstruct wrote (with --dtu: one with such folders, named like the scans), or a splat file",
        Path,
    ),
    either(
        option(
            "--reference PATH ...",
            "a log, a capture, or an image folder's TOML; logs of one session are read as one",
            Path,
        ),
        option("--dtu ROOT", "a DTU data set in the layout of MVSNet, or of IDR and NeuS", Path),
        required=True,
    ),
    *output("folder for scores and pictures", default="none, the scores are only printed"),
    option(
        "--baseline FILE",
        "score.json of an earlier score -o: prints the change of each figure, gated as change_NAME",
        Path,
    ),
    THREADS,
    GATES,
    *OF_FOLDERS,
    group(
        "scan of --dtu",
        *SCAN,
        option("--masks DIR", "object masks 000.png and so on, for MVSNet's layout", Path),
    ),
    group(
        "views",
        option(
            "--snapshots",
            "render each view from the newest snapshot by then, or all from the final splats",
            ("newest", "final"),
            "newest",
            fields={"newest": lambda word: word == "newest"},
        ),
        option("--allow-training", "also score cameras that trained the scene"),
        option("--allow-other-recording", "continue although this is not the recording that made the scene"),
        option(
            "--images",
            "with -o: pictures of every view, of each camera's best and worst, or of none",
            ("all", "best-worst", "none"),
            "best-worst",
        ),
    ),
    group(
        "surface",
        option(
            "--cloud FILE",
            "reference points (.ply) or mesh: accuracy, completeness, Chamfer; or a folder of stl024_total.ply or"
            " scan24.ply",
            Path,
        ),
        option(
            "--cloud-masks DIR",
            "DTU's folder ObsMask (ObsMask24_10.mat, Plane24.mat): compare only where DTU does",
            Path,
        ),
        option("--cloud-unit M", "metres per unit (default: 0.001 with --dtu, else 1)", real(1e-9, 1e3, "m")),
        option("--cloud-max M", "farther points count in a share, not in a mean", real(1e-6, 1e3, "m"), 0.02),
        option("--cloud-spacing M", "both sides are thinned to points this far apart", real(1e-6, 1e3, "m"), 0.0002),
    ),
)


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    return whole(16, 8192, "px")(width), whole(16, 8192, "px")(height)


RENDER = (
    option("SCENE", "a folder that reconstruct wrote", Path),
    *output("FILE.png, FILE.mp4 (pip install 'splatctrl-cli[video]'), or a folder of pictures", default="render.png"),
    option("--camera NAME", "from this training camera (default: the first)"),
    option("--reference LOG", "where the camera moves as in this recording (default: it stays where it began)", Path),
    option(
        "--path FILE",
        "or along this path, .csv or .json: time_s, x, y, z, qx, qy, qz, qw, poses of the optical frame in world",
        Path,
    ),
    option(
        "--at SECONDS",
        "one picture, that long after the scene's start (default: all the time; of a .png the end)",
        real(-MAX_SECONDS, MAX_SECONDS, "s"),
    ),
    option("--size WxH", "in pixels (default: the camera's)", _size),
    option("--fps HZ", "pictures a second", real(0.01, 240, "Hz"), 10.0),
    option("--depth", "depth in colours from red (near) to blue (the farthest of the first picture)"),
    THREADS,
)


MODES = ("audit", "open-loop", "closed-loop")
STEP_LIMIT = 10.0  # [s]


REPLAY = (  # what people use, and in groups the rest
    option("LOG", "a log or capture with joint states", Path),
    either(
        option("--field FIELD", "a baked field (folder or field.npz)", Path),
        option("--scene SCENE", "a reconstruction: its splats, as known at each time", Path),
        option("--lockstep", "reconstruct the scene from LOG's own cameras, in step with the replay"),
        required=True,
    ),
    option("--urdf FILE", "the robot's URDF (default: the log's own robot_description)", Path),
    option("--spheres FILE.yaml", f"its spheres ({FITTED})", Path),
    option("--mode", "what to replay", MODES, "audit"),
    option(
        "--start-time S",
        "start at this time of the log [s], or first-map: at the first map",
        lambda text: text if text == "first-map" else real(0, MAX_SECONDS, "s or first-map")(text),
    ),
    option("--truth FILE", "truth.json of a simulated log", Path),
    option(
        "--evidence CAMERA|K",
        "bound the map's error by depth that is held out: this camera's, or with --lockstep every K-th frame set's",
    ),
    either(
        option(
            "--controller MODULE:CLASS",
            "this Python class, a policy at ws://HOST:PORT, or `recorded` commands",
        ),
        option("--controller-command 'PROGRAM ARGS'", "or this program, by JSON on its stdin and stdout"),
    ),
    *output("folder to write", default="replay"),
    *CONFIG,
    DEVICE,
    GATES,
    *SOURCE,
    group(
        "robot",
        *PLACED,
        SELF_MODEL,
        option("--srdf FILE", "leave the pairs of its disable_collisions out of the self-collision rows", Path),
        DECLARE,
    ),
    group(  # the goal in one of five forms, and how an arm is driven there
        "goal",
        option("--frame LINK", "the link to drive (default: the last of the URDF)"),
        either(
            option(f"--goal {POSE}", "goal pose in world (default: the logged pose at the end)", pose),
            option(
                "--goal-joints Q1,Q2,...", "goal configuration [rad]; a gripper's fingers may be left out", numbers
            ),
            option("--waypoints FILE", "goals in order, poses or configurations (.toml or .csv)", Path),
            option("--follow", "the logged pose of each time is the goal (the default of --mode open-loop)"),
            option(
                "--twist-topic NAME",
                "track the twists of this topic of LOG (Twist, TwistStamped), or of a .toml's table: twists",
            ),
        ),
        option("--twist-frame LINK", "axes of the twists: world or those of a link (default: as the log says)"),
        option(
            "--re-anchor S",
            "put the arm back into the logged configuration every S seconds",
            real(1e-3, MAX_SECONDS, "s"),
        ),
    ),
    group(  # a controller of the user's own in place of ours (docs/controllers.md)
        "controller",
        option(
            "--controller-step-limit S",
            "a controller that takes longer for a step has failed",
            real(1e-3, MAX_SECONDS, "s"),
            STEP_LIMIT,
        ),
        option("--controller-twice", "ask two of it the same: a difference is a failure"),
    ),
    group(
        "evidence",
        HOLDOUT,
        option("--max-unknown SHARE", "never-seen share allowed", real(0, 1), 0.05),
        option("--max-map-age S", "largest age of a map that counts as evidence", real(1e-3, MAX_SECONDS, "s"), 1.0),
        option(
            "--latency S",
            "a map is known this long after its frames' stamp (--scene, --lockstep)",
            real(0, MAX_SECONDS, "s"),
            0.0,
        ),
        option("--real-time", "a map is known when this machine has computed it (--lockstep)"),
        option("--require-evidence", "not evaluable (exit 5) without a bound on the map's error"),
        option(
            "--unseen",
            "space near the arm not seen free: judge it (splatctrl help verdict), or take it for an obstacle",
            ("judge", "occupied"),
            "judge",
        ),
        option(
            "--separation FILE.toml",
            "measure the protective separation distance of ISO/TS 15066 (splatctrl help separation)",
            Path,
        ),
        option("--require-proof", "not evaluable (exit 5) if space near the arm was assumed to be free"),
        *DISAGREEMENT,
    ),
    group(
        "report",
        option(
            "--worst-frames N",
            "write worst_1.png ...: camera images of the N events of least clearance",
            whole(0, 1000),
            3,
        ),
        option("--report-only", "exit 0 whatever the verdict; a --require still counts"),
        option("--steps", "print a row per step as well"),
    ),
)
AUDIT = (
    option("LOG", "a log, a capture, or an image folder's .toml; with joint states", Path),
    either(
        option("--urdf FILE", "the robot's URDF (default: the log's own)", Path),
        option("--robot NAME", "robot NAME.urdf of an installed Python package; an unknown name lists all"),
    ),
    option("--spheres FILE.yaml", f"its spheres ({FITTED})", Path),
    *PLACED,
    either(
        option(f"--goal {POSE}", "also audit a closed loop to this pose, in world", pose),
        option("--goal-joints Q1,Q2,...", "or to this configuration [rad]", numbers),
    ),
    option("--frame LINK", "the link that a goal is of (default: the last of the URDF)"),
    option("-o/--out PATH", "folder of the steps and report.html; steps done there are kept (default: audit)", Path),
    option("--force", "repeat every step"),
    option("--resume", "continue an interrupted reconstruction; the result has the same bytes"),
    *CONFIG,
    DEVICE,
    *SOURCE,
)
