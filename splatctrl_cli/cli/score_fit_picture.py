"""The picture of ``score --fit``: one held-out view, its photo and what each method makes of it."""

import argparse
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from splatctrl_cli.cli.common import Console
from splatctrl_cli.cli.score_reference import cameras_to_score, open_reference
from splatctrl_cli.cli.score_views import rendered
from splatctrl_cli.evaluate.images import psnr
from splatctrl_cli.evaluate.views import views_to_score
from splatctrl_cli.report.view_picture import renders_picture
from splatctrl_cli.scene_files.scene_folder import open_scene


def draw_methods(args: argparse.Namespace, console: Console, scenes: Mapping[str, Path], path: Path) -> None:
    """Write the first view that is scored, as photographed and as rendered from each of `scenes`, by method."""
    opened = {name: open_scene(scene) for name, scene in scenes.items()}
    training = next(iter(opened.values())).cameras
    reference = open_reference(args, console)
    views = views_to_score(
        reference.source,
        scoring=cameras_to_score(args, reference, training),
        training=training,
        has_clock=False,
        numbered_by_stamp=reference.numbered_by_stamp,
    )
    view = next(views)
    frame = view.frame
    renders = {}
    for name, scene in opened.items():
        splats = scene.gaussians() if scene.is_anisotropic else scene.splats()
        rendering = rendered(splats, frame.intrinsics, frame.T_world_camera, args.threads).before(scene.background)
        color = np.clip(rendering.color, 0.0, 1.0)
        words = f"{name}   {psnr(color, frame.color / 255.0):.1f} dB all, {len(splats):,} splats"
        renders[words] = color
    renders_picture(path, view.name, frame.color, renders)
