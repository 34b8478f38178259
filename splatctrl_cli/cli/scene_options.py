"""The options of the commands that make and judge scenes: ``reconstruct``, ``export``, ``sdf-bake``, ``query``,
``score``.
"""

from pathlib import Path

from splatctrl_cli.cli.options import (
    BOX,
    add_config,
    add_declare,
    add_device,
    add_disagreement,
    add_gates,
    add_output,
    add_scan,
    add_self_model,
    add_settings,
    add_source,
    add_threads,
)
from splatctrl_cli.cli.parser import MAX_SECONDS, Options, Parser, real, setting, whole, words
from splatctrl_cli.config import FieldConfig, SceneConfig
from splatctrl_cli.config.map import MOST_ITERATIONS

SPLAT_FORMATS = (".ply", ".splat", ".spz", ".glb", ".usda", ".usdc")  # as the registries have them, which are not
GRID_FORMATS = ("npz", "vti", "nrrd", "vdb", "curobo", "moveit", "ply", "obj", "stl")  # imported for a help text
CHANNELS = ("sdf", "gradient", "bound", "observed", "probability", "label", "hard", "se", "gpdf")


def reconstruct_options(add: Options, parser: Parser) -> None:
    add("SOURCE", "log, capture folder, or an image folder's .toml", Path, nargs="?")
    add("--dtu ROOT", "a DTU data set in MVSNet's layout, or in IDR's and NeuS's, instead", Path)
    add_output(add, "scene folder", default="scene")
    add("--resume", "continue an interrupted run, to the same bytes")
    add("--urdf FILE", "the robot (default: the log's own): labels its splats, sets the workspace", Path)
    add("--spheres FILE.yaml", "its collision spheres", Path)
    add_self_model(add)
    add(f"--box {BOX}", "workspace [m] (default: the robot's reach, else the valid depth)")
    budget = "budget of splats (default: 5000)"
    add("--max-splats N", budget, setting(SceneConfig, "max_splats"))
    add_config(add, parser)
    add_gates(add)
    add_source(add)
    add_scan(add.group("scan of --dtu"))
    more = add.group("fit")
    more(
        "--method",
        "a fixed budget of isotropic splats, or 3D Gaussian splatting, a baseline for views of a scene that stands"
        " still, without distances",
        ("budget", "3dgs"),
        "budget",
    )
    more(
        "--points FILE.ply",
        "coloured points to start from instead of depth, for colour cameras alone (no occupancy)",
        Path,
    )
    add_declare(more)
    add_disagreement(more)
    more("--refine-poses", "put views of a still scene where they show the same surfaces; free depth of its bend")
    more("--refine-exposure", "give the views of a still scene one brightness and white balance")
    add_device(parser)


def export_options(add: Options, parser: Parser) -> None:
    suffixes = ", ".join(SPLAT_FORMATS)
    add("SCENE", f"a scene folder, or a splat file: {suffixes}; with --mcap also a replay or a field", Path)
    add_output(add, f"the file to write; its suffix is the format: {suffixes}", default="SCENE.ply, beside SCENE")
    add("--mcap", "write an MCAP of Foxglove's schemas, over time (default of --out: SCENE.mcap); docs/report.md")
    add("--labels NAME,...", "only splats of these labels: object, robot, human (default: all)")
    add(
        "--layout",
        "of a PLY: short has label and density, full the reference's 62 properties (default: short for isotropic"
        " splats, for others full, and a label where one is not object)",
        ("short", "full"),
    )
    add("--isotropic", "make anisotropic Gaussians round: same volume, opacity and mean colour")
    add(
        "--root DIR ...",
        "with --mcap: folder in which the scene and robot of a replay's command line are looked for",
        Path,
    )


def sdf_bake_options(add: Options, parser: Parser) -> None:
    add("SCENE", "a folder that reconstruct wrote, or a file of round splats: .ply, .splat, .spz", Path)
    add_output(add, "folder to write: the grid, field.json, report/, run.json", default="field")
    later = "the scene as known that long after its start"
    add("--at SECONDS", later, real(-MAX_SECONDS, MAX_SECONDS, "s"))
    add(f"--box {BOX}", "what the grid covers [m]; write --box=-1,... for a negative start")
    add("--urdf URDF", "cover the reach of this robot around its base, without --box", Path)
    add("--voxel M", "cell size (field.voxel)", setting(FieldConfig, "voxel"))
    add("--formats NAME,...", f"of {', '.join(GRID_FORMATS)}", str, "npz,vti")
    add("--truth truth.json", "measure the field against this truth", Path)
    add("--seen-by LOG", "the log or capture whose cameras saw the scene, for --truth", Path)
    add("--resume", "continue an interrupted bake, to the same bytes")
    add_config(add, parser)
    add_device(parser)
    add_gates(add)
    more = add.group("field")
    more("--include NAME,...", "labels in the field beside object: robot, human, or none", str, "human")
    more("--spheres FILE.yaml", "spheres of --urdf (default: the URDF's own)", Path)
    more(
        "--channels NAME,...",
        f"what is baked beside sdf, of {', '.join(CHANNELS)} (default: {','.join(CHANNELS[:4])})",
    )
    more(
        "--distance",
        "what sdf is: min(se, hard), min(gpdf, hard), the exact distance, either kernel field (field.distance)",
        words(FieldConfig, "distance"),
    )
    weights = "of the kernel field: row sums, voxels, the full GP (field.weights)"
    more("--weights", weights, words(FieldConfig, "weights"))
    more("--length-scale M", "l of the kernel (field.length_scale)", setting(FieldConfig, "length_scale"))
    more("--unknown", "what never-seen space counts as (field.unknown)", words(FieldConfig, "unknown"))
    more(
        "--probability",
        "bake the channel probability, of collision, in this form (field.probability)",
        words(FieldConfig, "probability"),
    )
    more = add.group("accuracy and update")
    more("--reference-mesh FILE", "measure the field against this mesh (world, metres)", Path)
    more(
        "--held-out LOG[:CAMERA,...]",
        "measure the field against depth of cameras that did not train; --urdf tells which pixels are robot",
    )
    more("--no-report", "draw no pictures")
    more("--update FIELD", "bake anew only what changed since that field folder was baked", Path)
    more("--previous-scene SCENE", "what --update's field was baked from (default: SCENE)", Path)


def query_options(add: Options, parser: Parser) -> None:
    add("SOURCE", "a folder that sdf-bake or reconstruct wrote, a field.npz, or a file of round splats", Path)
    add("POINTS", "CSV file with columns x,y,z [m] in the world, with or without a header; - for stdin", Path)
    add_output(add, "CSV file of the answers, in the order of the points", default="stdout, with --json none")
    add("--scene SCENE", "what SOURCE, a field, was baked from: adds what a grid does not know", Path)
    later = "of a scene: as known that long after its start"
    add("--at SECONDS", later, real(-MAX_SECONDS, MAX_SECONDS, "s"))
    add("--include NAME,...", "of a scene: labels that count beside object: robot, human, or none", str, "human")
    add("--config FILE.toml", "configuration, see docs/config.md", Path)
    add_settings(add, ", such as field.distance=hard")
    add_threads(parser)
    add_device(parser)


def score_options(add: Options, parser: Parser) -> None:
    scenes = "a folder that reconstruct wrote, one of such folders, named like the scans of --dtu, or a splat file"
    add("SCENE", scenes, Path, nargs="?")
    either = add.either(required=True)
    reference = "a log, a capture, or an image folder's TOML; logs of one session are read as one"
    either("--reference PATH ...", reference, Path)
    either("--dtu ROOT", "a DTU data set in MVSNet's layout, or in IDR's and NeuS's", Path)
    add_output(add, "folder for scores and pictures", default="none, the scores are only printed")
    add(
        "--baseline FILE",
        "score.json of an earlier score -o: prints the change of each figure, gated as change_NAME",
        Path,
    )
    add_config(add, parser)
    add_gates(add)
    add_source(add)
    more = add.group("scan of --dtu")
    add_scan(more)
    more("--masks DIR", "object masks 000.png and so on, for MVSNet's layout", Path)
    more = add.group("views")
    newest = "render each view from the newest snapshot by then, or all from the final splats"
    more("--snapshots", newest, ("newest", "final"), "newest")
    more("--allow-training", "also score cameras that trained the scene")
    more("--allow-other-recording", "continue although this is not the recording that made the scene")
    pictures = "with -o: pictures of every view, of each camera's best and worst, or of none"
    more("--images", pictures, ("all", "best-worst", "none"), "best-worst")
    more("--lpips FILE.npz", "weights of LPIPS (docs/score.md); none are included", Path)
    more = add.group("surface")
    more(
        "--cloud FILE",
        "reference points (.ply) or mesh: accuracy, completeness, Chamfer; or a folder of stl024_total.ply or"
        " scan24.ply",
        Path,
    )
    more(
        "--cloud-masks DIR", "DTU's folder ObsMask (ObsMask24_10.mat, Plane24.mat): compare only where DTU does", Path
    )
    more("--cloud-unit M", "metres per unit (default: 0.001 with --dtu, else 1)", real(1e-9, 1e3, "m"))
    more("--cloud-max M", "farther points count in a share, not in a mean", real(1e-6, 1e3, "m"), 0.02)
    more("--cloud-spacing M", "both sides are thinned to points this far apart", real(1e-6, 1e3, "m"), 0.0002)
    add_device(parser)
    more = add.group("fit")
    more(
        "--fit",
        "fit the scans of --dtu (--scan A,B; default: all), or the image folder of --reference, with both methods and"
        " score them (default protocol: dtu-holdout8)",
    )
    more(
        "--fit-iterations N", "of each method (default: those of the configuration, 2300)", whole(1, MOST_ITERATIONS)
    )
    more(
        "--fit-splats N",
        "the budget, and Gaussians to begin with (default: 10000)",
        setting(SceneConfig, "max_splats"),
    )
