"""``splatctrl export``: a scene's splats as a 3D-GS PLY, read back and rendered to check that it is the same."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatctrl_cli.cli.common import Console, Subparsers, add_command, add_output
from splatctrl_cli.errors import InputError, NotEvaluableError, UsageError, WriteError

if TYPE_CHECKING:
    from splatctrl_cli.records import Float32, Float64, Intrinsics, SplatSet

MAX_PIXEL_DIFFERENCE = 0.01 / 255  # of a colour or opacity; depths by that share of the scene's size
NUM_VIEWS = 4  # around the scene
IMAGE_SIZE = (320, 240)


def register(subparsers: Subparsers) -> None:
    """Add the subcommand to the parser."""
    parser = add_command(
        subparsers, "export", run, summary="write a scene's splats as a 3D-GS PLY that stock viewers open"
    )
    parser.add_argument("scene", type=Path, metavar="SCENE", help="a scene folder, or a splats.ply")
    parser.add_argument(
        "--labels",
        metavar="NAME,...",
        help="only splats of these labels: object, robot, human (default: all)",
    )
    add_output(parser, default="SCENE.ply, beside SCENE", what="the PLY file to write")


def run(args: argparse.Namespace) -> int:
    """Run the subcommand and return its exit code."""
    from splatctrl_cli.io.output import output_path, sha256
    from splatctrl_cli.io.splats import read_ply, write_ply

    source = _splat_file(args.scene)
    out = args.out or _beside(args.scene)
    if out.resolve() == source.resolve():
        raise UsageError(f"{out}: is the input itself", remedy="give another --out")
    splats, comments = read_ply(source)
    chosen = _select(splats, args.labels, source)
    if not len(chosen):
        raise NotEvaluableError(f"{source}: no splat to write among {len(splats)}", remedy="give other --labels")
    with output_path(out, force=args.force, is_folder=False) as partial:
        write_ply(partial, chosen, {**comments, "exported_from": f"{source.name} sha256 {sha256(source)}"})
        difference, covered = _compare(chosen, read_ply(partial)[0])
        if not difference <= MAX_PIXEL_DIFFERENCE:
            raise WriteError(
                f"{out}: does not render as its source: largest pixel difference {difference:.3g}, expected at most "
                f"{MAX_PIXEL_DIFFERENCE:.3g}"
            )
        result = {
            "file": str(out),
            "bytes": partial.stat().st_size,
            "sha256": sha256(partial),
            "num_splats": len(chosen),
            "num_left_out": len(splats) - len(chosen),
            "num_views_compared": NUM_VIEWS,
            "largest_pixel_difference": difference,
            "covered_share": covered,
        }
    Console(args).result(result, _lines(result))
    return 0


def _lines(result: dict[str, Any]) -> list[str]:
    left_out = f", {result['num_left_out']} left out by label" if result["num_left_out"] else ""
    return [
        f"{result['file']}: {result['num_splats']} splats{left_out}, {result['bytes']} bytes",
        f"read back and rendered from {result['num_views_compared']} views ({100 * result['covered_share']:.0f} % of "
        f"their pixels covered): largest pixel difference {result['largest_pixel_difference']:.2g}",
    ]


def _beside(scene: Path) -> Path:
    place = scene if scene.name.strip(".") else scene.resolve()  # . and .. have no name of their own
    return place.with_name(f"{place.name.removesuffix('.ply')}.ply")


def _splat_file(scene: Path) -> Path:
    if not scene.exists():
        raise InputError(f"{scene}: no such scene", remedy="give a folder that reconstruct wrote, or a splats.ply")
    file = scene / "splats.ply" if scene.is_dir() else scene
    if not file.is_file():
        raise InputError(
            f"{scene}: has no splats.ply", remedy="give a folder that reconstruct wrote, or a splats.ply"
        )
    return file


def _select(splats: "SplatSet", names: str | None, source: Path) -> "SplatSet":
    import numpy as np

    from splatctrl_cli.records import Label

    if names is None:
        return splats
    known = {label.name.lower(): label for label in Label}
    chosen = [name.strip() for name in names.split(",")]
    unknown = [name for name in chosen if name not in known]
    if unknown:
        raise UsageError(f"--labels {names}: unknown label {unknown[0]!r}", remedy=f"known here: {', '.join(known)}")
    return splats.select(np.isin(splats.labels, [known[name] for name in chosen]))


def _compare(a: "SplatSet", b: "SplatSet") -> tuple[float, float]:
    """Largest difference of a colour, opacity, or depth over the scene's size, in views around it; share covered.

    A pixel is covered where anything shows.
    """
    import numpy as np

    from splatctrl_cli.scene.render import render

    intrinsics, poses, size = _views(a.centers)
    largest, covered = 0.0, 0.0
    for T_world_camera in poses:
        one, two = (render(splats, intrinsics, T_world_camera) for splats in (a, b))
        pairs = ((one.color, two.color), (one.opacity, two.opacity), (one.depth / size, two.depth / size))
        largest = max(largest, *(float(np.abs(x.astype(np.float64) - y).max()) for x, y in pairs))
        covered += float(np.mean(one.opacity > 0)) / len(poses)
    return largest, covered


def _views(centers: "Float32") -> tuple["Intrinsics", "list[Float64]", float]:
    """Cameras evenly around the box that holds most of the splats, from above, and that box's diagonal [m]."""
    import numpy as np

    from splatctrl_cli.geometry import look_at
    from splatctrl_cli.records import Intrinsics

    lower, upper = np.percentile(centers.astype(np.float64), [2, 98], axis=0)
    middle, size = (lower + upper) / 2, max(float(np.linalg.norm(upper - lower)), 0.1)
    width, height = IMAGE_SIZE
    intrinsics = Intrinsics(fx=width, fy=width, cx=(width - 1) / 2, cy=(height - 1) / 2, width=width, height=height)
    angles = 2 * np.pi * (np.arange(NUM_VIEWS) + 0.5) / NUM_VIEWS
    directions = np.column_stack([np.cos(angles), np.sin(angles), np.full(NUM_VIEWS, 0.7)])
    return intrinsics, [look_at(middle + size * direction, middle) for direction in directions], size
