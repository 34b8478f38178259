"""What the options of ``sdf-bake`` ask for: names, the configuration, and the box of the grid."""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from splatctrl_cli.cli.common import add_config, add_gates, add_output
from splatctrl_cli.cli.numbers import MAX_SECONDS, real, setting, words
from splatctrl_cli.config import Config, FieldConfig
from splatctrl_cli.errors import UsageError
from splatctrl_cli.field.layout import bounding_box, check_loss
from splatctrl_cli.field.selection import field_splats
from splatctrl_cli.grid_files import grid_formats
from splatctrl_cli.records import Box, Label, SplatSet
from splatctrl_cli.robot.model import RobotModel

FORMATS = tuple(grid_formats.FORMATS)
# As the rooms have them, which --help does not wait for; a test holds these to those.
CHANNELS = ("sdf", "gradient", "bound", "observed", "probability", "label", "hard", "se", "gpdf")
DEFAULT_CHANNELS = ("sdf", "gradient", "bound", "observed")
EXACT = frozenset({"bound", "hard"})


def add_options(parser: argparse.ArgumentParser) -> None:
    """Every option of the subcommand but those that all commands have."""
    parser.add_argument("scene", type=Path, metavar="SCENE", help="a folder that reconstruct wrote, or a splats.ply")
    add_output(parser, default="field", what="folder to write: the grid, field.json, report/, run.json")
    parser.add_argument(
        "--at",
        type=real(-MAX_SECONDS, MAX_SECONDS, "s"),
        metavar="SECONDS",
        help="the scene as known that long after its start",
    )
    parser.add_argument(
        "--include",
        default="human",
        metavar="NAME,...",
        help="labels in the field beside object: robot, human, or none (default: human; the robot is left out)",
    )
    _add_grid(parser)
    _add_field(parser)
    _add_truth(parser)
    _add_going_on(parser)
    add_config(parser)
    add_gates(parser)


def _add_grid(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--box", metavar="X0,Y0,Z0,X1,Y1,Z1", help="what the grid covers [m]; write --box=-1,... for a negative start"
    )
    parser.add_argument("--urdf", type=Path, help="cover the reach of this robot around its base, without --box")
    parser.add_argument("--spheres", type=Path, metavar="FILE.yaml", help="its spheres (default: the URDF's own)")
    parser.add_argument("--voxel", type=setting(FieldConfig, "voxel"), metavar="M", help="cell size (field.voxel)")
    parser.add_argument(
        "--channels",
        metavar="NAME,...",
        help=f"what is baked beside sdf, of {', '.join(CHANNELS)} (default: {','.join(DEFAULT_CHANNELS)})",
    )
    parser.add_argument(
        "--formats", default="npz,vti", metavar="NAME,...", help=f"of {', '.join(FORMATS)} (default: npz,vti)"
    )


def _add_field(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--distance",
        choices=words(FieldConfig, "distance"),
        help="what sdf is: min(se, hard), min(gpdf, hard), the exact distance, either kernel field (field.distance)",
    )
    parser.add_argument(
        "--weights",
        choices=words(FieldConfig, "weights"),
        help="of the kernel field: row sums, voxels, the full GP (field.weights)",
    )
    parser.add_argument(
        "--length-scale",
        type=setting(FieldConfig, "length_scale"),
        metavar="M",
        help="l of the kernel (field.length_scale)",
    )
    parser.add_argument(
        "--unknown", choices=words(FieldConfig, "unknown"), help="what never-seen space counts as (field.unknown)"
    )
    parser.add_argument(
        "--probability",
        choices=words(FieldConfig, "probability"),
        help="bake the channel probability, of collision, in this form (field.probability)",
    )


def _add_truth(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--truth", type=Path, metavar="truth.json", help="measure the field against this truth")
    parser.add_argument(
        "--seen-by", type=Path, metavar="LOG", help="the log or capture whose cameras saw the scene, for --truth"
    )
    parser.add_argument(
        "--reference-mesh", type=Path, metavar="FILE", help="measure the field against this mesh (world, metres)"
    )
    parser.add_argument(
        "--held-out",
        metavar="LOG[:CAMERA,...]",
        help="measure the field against depth of cameras that did not train; --urdf tells which pixels are robot",
    )
    parser.add_argument("--no-report", action="store_true", help="draw no pictures")


def _add_going_on(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--update", type=Path, metavar="FIELD", help="bake anew only what changed since that field folder was baked"
    )
    parser.add_argument(
        "--previous-scene", type=Path, metavar="SCENE", help="what --update's field was baked from (default: SCENE)"
    )
    parser.add_argument(
        "--resume", action="store_true", help="go on with a bake that was interrupted, to the same bytes"
    )


def names_of(text: str, choices: Sequence[str], option: str) -> tuple[str, ...]:
    """The names in a list with commas. Raises UsageError for one that is no choice, or none at all."""
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    unknown = [name for name in names if name not in choices]
    if unknown or not names:
        raise UsageError(f"{option} {text}: expected some of: {', '.join(choices)}")
    return names


def labels_of(text: str) -> "frozenset[Label]":
    """The labels in the field: objects, and those that --include names."""
    if text.strip() == "none":
        return frozenset({Label.OBJECT})
    names = names_of(text, ("robot", "human"), "--include")
    return frozenset({Label.OBJECT, *(Label[name.upper()] for name in names)})


def channels_of(args: argparse.Namespace, default: Sequence[str], unknown: str) -> tuple[str, ...]:
    """The channels to bake, sdf first. Raises UsageError where another one is needed for what is asked."""
    names = default if args.channels is None else ("sdf", *names_of(args.channels, CHANNELS, "--channels"))
    names = names if args.probability is None else (*names, "probability")
    chosen = tuple(name for name in CHANNELS if name in names)
    for option in ("truth", "reference_mesh", "held_out"):
        if getattr(args, option) is not None and not EXACT & set(chosen):
            raise UsageError(
                f"--{option.replace('_', '-')}: compares with the exact distance, too",
                remedy="bake the channel bound or hard as well",
            )
    if unknown != "free" and "observed" not in chosen:
        raise UsageError(f"field.unknown = {unknown}: needs to be told", remedy="bake the channel observed as well")
    return chosen


def with_options(config: "Config", args: argparse.Namespace) -> "Config":
    """The configuration with what the options say of the field. Raises UsageError for cells that are too coarse."""
    names = ("distance", "weights", "unknown", "probability", "voxel", "length_scale")
    given = {name: getattr(args, name) for name in names}
    field: FieldConfig = replace(config.field, **{name: value for name, value in given.items() if value is not None})
    check_loss(field.voxel, field.max_loss)
    return replace(config, field=field)


def box_of(args: argparse.Namespace, splats: "SplatSet", labels: "frozenset[Label]", padding: float) -> "Box":
    """What the grid covers: --box, the reach of the robot, or the splats and `padding` [m] around them."""
    if args.box is not None:
        return Box.from_text(args.box)
    if args.urdf is not None:
        robot = RobotModel.from_urdf(args.urdf, args.spheres)
        return Box(lower=robot.base_position - robot.reach(), upper=robot.base_position + robot.reach())
    return bounding_box(field_splats(splats, labels), padding)
