"""Scores of rendered views and of surfaces."""

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from math import isnan
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.calibration.displacement import correct_pose
from splatctrl_cli.config.fixed import CLOUD_DISTANCE, CLOUD_SPACING
from splatctrl_cli.errors import NotEvaluableError, UsageError, refuse_if
from splatctrl_cli.evaluate.held_out_depth import cloud_score, points_on, space_out, thin
from splatctrl_cli.evaluate.protocols import ObservedSpace, cloud_of_scan, read_observed
from splatctrl_cli.evaluate.score import CORRECTABLE, CORRECTED, Doubts, score_view
from splatctrl_cli.evaluate.views import View, seen_by, seen_pixels, surface_points, views_to_score
from splatctrl_cli.files.output import Stopwatch
from splatctrl_cli.formats.mesh import load_mesh
from splatctrl_cli.formats.ply import is_mesh, read_positions
from splatctrl_cli.formats.scene.scene_folder import SceneFolder
from splatctrl_cli.jobs.reconstruct.correct_views import corrected, corrected_among
from splatctrl_cli.jobs.running.progress import Progress, Wait
from splatctrl_cli.jobs.score.reference import Reference
from splatctrl_cli.records import Float32, Float64, GaussianSet, Intrinsics, Label, RgbdFrame, SplatSet
from splatctrl_cli.report.pictures import ComparisonRow
from splatctrl_cli.scene.render import Color, Rendering, render, render_gaussians

Ranked = tuple[float, ComparisonRow]
"""PSNR [dB] over seen pixels, else over all, and the view's pictures."""


@dataclass(kw_only=True)
class Scorer:
    """Scorer of views of `reference`; `draw` gets every view's row of pictures.

    newest: as in `ScoreRequest`. `run` fills the other fields. sizes: of views [px]. skipped: views before the first
    snapshot. extremes: best and worst view by camera. training: training frames known at the last view.
    """

    scene: SceneFolder
    reference: Reference
    cameras: tuple[str, ...]
    draw: Callable[[ComparisonRow], None] | None = None
    newest: bool = True
    allow_training: bool = False
    threads: int = 0
    views: list[dict[str, Any]] = field(default_factory=list)
    figures: list[dict[str, float]] = field(default_factory=list)
    sizes: set[tuple[int, int]] = field(default_factory=set)
    skipped: list[str] = field(default_factory=list)
    extremes: dict[str, tuple[Ranked, Ranked]] = field(default_factory=dict)
    training: tuple[RgbdFrame, ...] = ()
    doubts: list[str] = field(default_factory=list)

    @property
    def has_clock(self) -> bool:
        return self.scene.has_clock and self.reference.source.has_clock

    def run(self, progress: Progress, stopwatch: Stopwatch) -> None:
        """Score every view. Raises NotEvaluableError without views, or if no pixel was seen."""
        scene, has_clock = self.scene, self.has_clock
        off = scene.run.get("metrics", {}).get("displaced_cameras") or {}
        stamps = sorted(snapshot.stamp_ns for snapshot in scene.snapshots) if has_clock else []
        splats_at = lru_cache(maxsize=1)(partial(splats_and_shell, scene))  # each snapshot is read once
        views = views_to_score(
            self.reference.source,
            scoring=self.cameras,
            training=scene.cameras,
            has_clock=has_clock,
            numbered_by_stamp=self.reference.numbered_by_stamp,
            corrected=lambda frame: corrected(correct_pose(frame, off), scene.corrections),
        )
        may_train = self.allow_training or self.reference.scores_training
        wait = Wait(progress, f"scores {', '.join(self.cameras)}", "views").announce()
        doubts = Doubts(is_still=not has_clock, may_train=may_train, mask_rule=self.reference.mask_rule)
        for view in views:
            refuse_if(
                view.frame.stamp_ns in scene.training_stamps_ns and not may_train,
                f"{view.name}: trained the scene, its score says nothing about other views",
                remedy="give the --holdout or --protocol that reconstruct was given, or --allow-training",
                error=UsageError,
            )
            num_known = bisect_right(stamps, view.frame.stamp_ns)
            if has_clock and not num_known:
                self.skipped.append(view.name)
                continue
            with stopwatch.stage("score"):
                shown = splats_at(stamps[num_known - 1] if has_clock and self.newest else None)
                self._score_one(doubts, view, *shown)
            wait.at(len(self.views))
        self._check()
        self.doubts += [*self.reference.doubts, *doubts.lines()]
        if not scene.names_its_views:
            self.doubts.append(
                f"{scene.path}: does not say which views trained it, and figures of training views say nothing about"
                " others; give the --cameras that did not train"
            )

    def _check(self) -> None:
        where, cameras = self.reference.where, ", ".join(self.cameras)
        refuse_if(
            not self.views,
            f"{where}: no view of {cameras} to score; {len(self.skipped)} lie before the first snapshot of the scene",
            remedy="give the recording that the scene was reconstructed from, or other --cameras",
            error=NotEvaluableError,
        )
        has_training = self.scene.names_its_views
        refuse_if(
            has_training and self.reference.has_depth and not any(view["seen_share"] for view in self.figures),
            f"{where}: no pixel of {cameras} was seen by a training camera ({', '.join(self.scene.cameras)})",
            remedy="is it the same world and the same scene? give the recording that reconstruct was given",
            error=NotEvaluableError,
        )

    def _score_one(self, doubts: Doubts, view: View, splats: SplatSet | GaussianSet, shell: SplatSet | None) -> None:
        frame = view.frame
        figures, row = self._compare(view, frame, splats, shell)
        doubts.look(view, row.render, row.mask)
        if self.scene.corrections:
            there = corrected_among(frame, view.training, self.scene.corrections)
            figures_there, _ = self._compare(view, there, splats, shell)
            figures |= {f"{n}{CORRECTED}": value for n, value in figures_there.items() if n in CORRECTABLE}
        self.views.append({"view": view.name, "camera": frame.camera, "stamp_ns": frame.stamp_ns})
        self.figures.append(figures)
        self.sizes.add((frame.intrinsics.width, frame.intrinsics.height))
        self.training = view.training
        rank = figures["psnr_all" if isnan(figures["psnr_seen"]) else "psnr_seen"]
        if self.draw is not None:
            self.draw(row)
        best, worst = self.extremes.get(frame.camera, ((rank, row), (rank, row)))
        self.extremes[frame.camera] = (
            max(best, (rank, row), key=itemgetter(0)),
            min(worst, (rank, row), key=itemgetter(0)),
        )

    def _compare(
        self, view: View, frame: RgbdFrame, splats: SplatSet | GaussianSet, shell: SplatSet | None
    ) -> tuple[dict[str, float], ComparisonRow]:
        protocol = self.reference.protocol
        rendering, depth = render_with_shell(
            splats, shell, frame.intrinsics, frame.T_world_camera, self.scene.background, self.threads
        )
        mask = None if self.reference.mask is None else self.reference.mask(frame)
        figures = score_view(
            color=rendering.color,
            depth=depth,
            frame=frame,
            seen=seen_pixels(frame, view.training),
            mask=mask,
            fill=0.0 if protocol is None else protocol.fill,
            is_zero_padded=protocol is not None and protocol.is_zero_padded,
        )
        return figures, ComparisonRow(
            title=view.name,
            figures=_caption(figures),
            photo=frame.color,
            render=rendering.color,
            photo_depth=frame.depth,
            render_depth=depth,
            mask=mask,
        )


def _caption(figures: Mapping[str, float]) -> str:
    values = {name: figures.get(f"psnr_{name}") for name in ("seen", "masked", "all")}
    parts = [f"{v:.1f} {name}" for name, v in values.items() if v is not None and not (name == "seen" and isnan(v))]
    return "dB: " + ", ".join(parts)


def render_with_shell(
    splats: SplatSet | GaussianSet,
    shell: SplatSet | None,
    intrinsics: Intrinsics,
    T_world_camera: Float64,
    background: Color,
    threads: int,
) -> tuple[Rendering, Float32]:
    """Render splats and shell before a background; depth (H, W) [m] excludes the shell."""
    camera = intrinsics, T_world_camera
    rendering = render_splats(splats, *camera, threads)
    depth = rendering.normalised_depth()
    if isinstance(splats, SplatSet) and shell is not None:
        rendering = render_splats(splats.joined(shell), *camera, threads)
    return rendering.before(background), depth


def render_splats(
    splats: SplatSet | GaussianSet, intrinsics: Intrinsics, T_world_camera: Float64, threads: int = 0
) -> Rendering:
    if isinstance(splats, GaussianSet):
        return render_gaussians(splats, intrinsics, T_world_camera, threads=threads)
    return render(splats, intrinsics, T_world_camera, threads=threads)


def splats_and_shell(scene: SceneFolder, stamp_ns: int | None) -> tuple[SplatSet | GaussianSet, SplatSet | None]:
    """Splats and shell as known at a stamp [ns], or at the end."""
    splats = final_splats(scene) if stamp_ns is None else scene.splats_at(stamp_ns)
    return splats, scene.shell_at(stamp_ns)


def final_splats(scene: SceneFolder) -> SplatSet | GaussianSet:
    return scene.gaussians() if scene.is_anisotropic else scene.splats()


@dataclass(frozen=True, kw_only=True)
class CloudSettings:
    """Reference points or mesh at `path`, or a folder of them by scan.

    unit: metres per unit of the file. Points farther than `max_distance` [m] from the other surface count in a share,
    not in a mean. Both surfaces are thinned to `spacing` [m]. masks: DTU's folder of observed space, read into
    `space`.
    """

    path: Path
    unit: float = 1.0
    max_distance: float = CLOUD_DISTANCE
    spacing: float = CLOUD_SPACING
    masks: Path | None = None
    space: ObservedSpace | None = None

    def select_scan(self, scan: str | None) -> "CloudSettings":
        """Settings with one scan's files. Raises InputError naming missing files."""
        path = cloud_of_scan(self.path, scan or "") if self.path.is_dir() else self.path
        return replace(self, path=path, space=None if self.masks is None else read_observed(self.masks, scan or ""))

    def words(self) -> str:
        within = "" if self.masks is None else f"; within the masks and above the planes of {self.masks}"
        return (
            f"{self.path}, 1 unit = {self.unit:g} m; points {1e3 * self.spacing:g} mm apart; means below"
            f" {1e3 * self.max_distance:g} mm{within}"
        )


def cloud_figures(
    settings: CloudSettings, scene: SceneFolder, frames: Sequence[RgbdFrame], threads: int
) -> dict[str, float]:
    """Figures by name of the surface seen from training views `frames`."""
    reference, space, counts = space_out(_reference(settings), settings.spacing), settings.space, None
    points = _surface(scene, frames, threads, settings.spacing)
    if space is not None:
        reference, points = reference[space.above(reference)], points[space.near(points)]
        counts = space.observed(points)
    return cloud_score(
        points,
        reference,
        seen_by(reference, frames),
        max_distance=settings.max_distance,
        counts=counts,
        unit=settings.unit,
        threads=threads or -1,
    )


def _reference(settings: CloudSettings) -> Float64:
    if not is_mesh(settings.path):
        return settings.unit * read_positions(settings.path)
    mesh = load_mesh(settings.path)
    return points_on(replace(mesh, vertices=settings.unit * mesh.vertices), settings.spacing)


def _surface(scene: SceneFolder, frames: Sequence[RgbdFrame], threads: int, spacing: float) -> Float64:
    """World points (P, 3) [m] of depth rendered at `frames` without robot, `spacing` apart."""
    splats = final_splats(scene)
    splats = splats.select(splats.labels != Label.ROBOT)
    shown = (render_splats(splats, frame.intrinsics, frame.T_world_camera, threads) for frame in frames)
    seen = (replace(f, depth=image.normalised_depth()) for f, image in zip(frames, shown, strict=True))
    parts = [thin(surface_points(frame)[0], spacing / 2) for frame in seen]
    return space_out(np.concatenate(parts), spacing) if parts else np.empty((0, 3))
