"""``score --cloud``: the scene's surface against reference points or a mesh."""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.cli.numbers import real
from splatctrl_cli.cli.score_views import rendered
from splatctrl_cli.datasets.dtu_observed import ObservedSpace, cloud_of_scan, read_observed
from splatctrl_cli.errors import UsageError
from splatctrl_cli.evaluate.cloud import cloud_score, points_on, spaced, thinned
from splatctrl_cli.evaluate.visibility import seen_by, surface_points
from splatctrl_cli.mesh_distance import load_mesh
from splatctrl_cli.records import Float64, GaussianSet, Label, RgbdFrame, SplatSet
from splatctrl_cli.scene_files.scene_folder import SceneFolder
from splatctrl_cli.splat_files.points import is_mesh, read_positions


@dataclass(frozen=True, kw_only=True)
class CloudSettings:
    """What --cloud and its options say. unit: metres per unit of the file."""

    path: Path
    unit: float
    max_distance: float
    spacing: float
    masks: Path | None = None
    space: "ObservedSpace | None" = None

    def of_scan(self, scan: str | None) -> "CloudSettings":
        """The same with the files of one scan, where folders of several were given.

        Raises InputError naming the files looked for.
        """
        path = cloud_of_scan(self.path, scan or "") if self.path.is_dir() else self.path
        return replace(self, path=path, space=None if self.masks is None else read_observed(self.masks, scan or ""))

    def words(self) -> str:
        """How the figures come about."""
        within = "" if self.masks is None else f"; within the masks and above the planes of {self.masks}"
        return (
            f"{self.path}, 1 unit = {self.unit:g} m; points {1e3 * self.spacing:g} mm apart; means below"
            f" {1e3 * self.max_distance:g} mm{within}"
        )


def add_cloud(parser: argparse.ArgumentParser) -> None:
    """``--cloud`` and what goes with it."""
    group = parser.add_argument_group("surface")
    group.add_argument(
        "--cloud",
        type=Path,
        metavar="FILE",
        help="reference points (.ply) or mesh: accuracy, completeness, Chamfer; or a folder of stl024_total.ply or"
        " scan24.ply",
    )
    group.add_argument(
        "--cloud-masks",
        type=Path,
        metavar="DIR",
        help="DTU's folder ObsMask (ObsMask24_10.mat, Plane24.mat): compare only where its own evaluation does",
    )
    group.add_argument(
        "--cloud-unit",
        type=real(1e-9, 1e3, "m"),
        metavar="M",
        help="metres per unit (default: 0.001 with --dtu, else 1)",
    )
    group.add_argument(
        "--cloud-max",
        type=real(1e-6, 1e3, "m"),
        default=0.02,
        metavar="M",
        help="farther points count in a share, not in a mean",
    )
    group.add_argument(
        "--cloud-spacing",
        type=real(1e-6, 1e3, "m"),
        default=0.0002,
        metavar="M",
        help="both sides are thinned to points this far apart (default: 0.0002)",
    )


def cloud_settings(args: argparse.Namespace) -> CloudSettings | None:
    """None where no cloud is given. Raises UsageError for options that mean nothing here."""
    if args.cloud is None:
        for name in ("unit", "masks"):
            if getattr(args, f"cloud_{name}") is not None:
                raise UsageError(f"--cloud-{name}: only with --cloud", remedy="leave it out")
        return None
    if args.dtu is None and (args.cloud_masks is not None or args.cloud.is_dir()):
        what = "--cloud-masks" if args.cloud_masks is not None else f"--cloud {args.cloud}"
        raise UsageError(f"{what}: a folder of scans, only with --dtu", remedy="give the file of this recording")
    unit = args.cloud_unit if args.cloud_unit is not None else (0.001 if args.dtu is not None else 1.0)
    return CloudSettings(
        path=args.cloud, unit=unit, max_distance=args.cloud_max, spacing=args.cloud_spacing, masks=args.cloud_masks
    )


def cloud_figures(
    settings: CloudSettings, scene: "SceneFolder", frames: "Sequence[RgbdFrame]", threads: int
) -> dict[str, Any]:
    """The figures by flat name. `frames`: the training views that the surface is looked at from."""
    reference, space, counts = spaced(_reference(settings), settings.spacing), settings.space, None
    points = _surface(scene, frames, threads, settings.spacing)
    if space is not None:
        reference, points = reference[space.above(reference)], points[space.near(points)]
        counts = space.observed(points)
    score = cloud_score(
        points,
        reference,
        seen_by(reference, frames),
        max_distance=settings.max_distance,
        counts=counts,
        unit=settings.unit,
        threads=threads or -1,
    )
    return score.figures()


def _reference(settings: CloudSettings) -> "Float64":
    if not is_mesh(settings.path):
        return settings.unit * read_positions(settings.path)
    mesh = load_mesh(settings.path)
    return points_on(replace(mesh, vertices=settings.unit * mesh.vertices), settings.spacing)


def _surface(scene: "SceneFolder", frames: "Sequence[RgbdFrame]", threads: int, spacing: float) -> "Float64":
    """World points (P, 3) [m] of the final splats' rendered depth at the poses of `frames`, the robot left out,
    `spacing` [m] apart."""
    splats = _without_robot(scene)
    parts = []
    for frame in frames:
        depth = rendered(splats, frame.intrinsics, frame.T_world_camera, threads).normalised_depth()
        parts.append(thinned(surface_points(replace(frame, depth=depth))[0], spacing / 2))
    return spaced(np.concatenate(parts), spacing) if parts else np.empty((0, 3))


def _without_robot(scene: "SceneFolder") -> "SplatSet | GaussianSet":
    if scene.is_anisotropic:
        return scene.gaussians()
    splats = scene.splats()
    kept = splats.labels != Label.ROBOT
    return replace(splats, **{name: values[kept] for name, values in vars(splats).items()})
