"""A scene's surface against reference points or a mesh."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from splatctrl_cli.config.fixed import CLOUD_DISTANCE, CLOUD_SPACING
from splatctrl_cli.evaluate.cloud import cloud_score, points_on, spaced, thinned
from splatctrl_cli.evaluate.protocols import ObservedSpace, cloud_of_scan, read_observed
from splatctrl_cli.evaluate.views import seen_by, surface_points
from splatctrl_cli.files.ply import is_mesh, read_positions
from splatctrl_cli.jobs.score_views import final_splats, rendered
from splatctrl_cli.mesh_distance import load_mesh
from splatctrl_cli.records import Float64, Label, RgbdFrame
from splatctrl_cli.scene_files.scene_folder import SceneFolder


@dataclass(frozen=True, kw_only=True)
class CloudSettings:
    """path: reference points or a mesh, or a folder of them by scan; unit: metres per unit of the file. Points
    farther than `max_distance` [m] count in a share, not in a mean; both sides are thinned to `spacing` [m]. masks:
    DTU's folder of what it observed, of one scan read into `space`.
    """

    path: Path
    unit: float = 1.0
    max_distance: float = CLOUD_DISTANCE
    spacing: float = CLOUD_SPACING
    masks: Path | None = None
    space: ObservedSpace | None = None

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


def cloud_figures(
    settings: CloudSettings, scene: SceneFolder, frames: Sequence[RgbdFrame], threads: int
) -> dict[str, float]:
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


def _reference(settings: CloudSettings) -> Float64:
    if not is_mesh(settings.path):
        return settings.unit * read_positions(settings.path)
    mesh = load_mesh(settings.path)
    return points_on(replace(mesh, vertices=settings.unit * mesh.vertices), settings.spacing)


def _surface(scene: SceneFolder, frames: Sequence[RgbdFrame], threads: int, spacing: float) -> Float64:
    """World points (P, 3) [m] of the final splats' rendered depth at the poses of `frames`, the robot left out,
    `spacing` [m] apart."""
    splats = final_splats(scene)
    splats = splats.select(splats.labels != Label.ROBOT)
    parts = []
    for frame in frames:
        depth = rendered(splats, frame.intrinsics, frame.T_world_camera, threads).normalised_depth()
        parts.append(thinned(surface_points(replace(frame, depth=depth))[0], spacing / 2))
    return spaced(np.concatenate(parts), spacing) if parts else np.empty((0, 3))
