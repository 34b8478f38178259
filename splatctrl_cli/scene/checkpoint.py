"""State of a fitter as arrays, to continue with the same bytes."""

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np

from splatctrl_cli.records import Box, Intrinsics, RgbdFrame, Values
from splatctrl_cli.scene.buffer import Filled
from splatctrl_cli.scene.fitter import SceneFitter
from splatctrl_cli.scene.keyframes import Window
from splatctrl_cli.scene.posture import POSTURE_NAMES, RobotPosture
from splatctrl_cli.scene.removal import REASONS
from splatctrl_cli.scene.seeding import SeedDensity
from splatctrl_cli.scene.self_mask import object_mask
from splatctrl_cli.scene.time_steps import Refined
from splatctrl_cli.voxels import Balls, LostEdges

Arrays = Mapping[str, Values]

GRID_NAMES = ("log_odds", "num_updates", "entity", "last_seen")
DENSITY_NAMES = ("edge", "tolerance", "num_candidates")
FILLED_NAMES = ("added", "relocated", "unmet")
FRAME_NAMES = tuple(field.name for field in fields(RgbdFrame))


def fitter_state(fitter: SceneFitter) -> dict[str, Values]:
    """Splats, moments, occupancy, frames and counters, not copied."""
    arrays: dict[str, Values] = dict(fitter.buffer.arrays())
    arrays |= {name: getattr(fitter.occupancy, name) for name in GRID_NAMES}
    arrays["step_stamps_ns"] = np.array(fitter.occupancy.step_stamps_ns, np.int64)
    arrays["workspace"] = np.array([fitter.workspace.lower, fitter.workspace.upper])
    arrays["counters"] = np.array([fitter.num_steps, fitter.descent.num_iterations], np.int64)
    arrays |= {"people/voxels": fitter.people.voxels, "people/stamps_ns": fitter.people.stamps_ns}
    for camera, edges in fitter.occupancy.edges.items():
        arrays[f"edges/{camera}"] = np.column_stack([edges.centers, edges.radii])
    filled = [getattr(fitter.refined.filled, name) for name in FILLED_NAMES]
    removed = [fitter.refined.removed[reason] for reason in REASONS]
    arrays["refined"] = np.array([fitter.refined.num_blocks, *filled, *removed], np.int64)
    arrays |= {f"objects/{camera}": pixels for camera, pixels in fitter.objects.items()}
    arrays |= {f"mounted/{camera}": mask for camera, mask in fitter.mounted.items()}
    if fitter.shell is not None:
        arrays |= {f"shell/{name}": array for name, array in fitter.shell.arrays().items()}
    if fitter.descent.background is not None:
        arrays["background"] = np.array(fitter.descent.background)
    if fitter.density is not None:
        arrays["density"] = np.array([getattr(fitter.density, name) for name in DENSITY_NAMES])
    if fitter.posture is not None:
        arrays |= {f"posture/{name}": getattr(fitter.posture, name) for name in POSTURE_NAMES}
    for kind, views in (("newest", fitter.window.newest), ("keyframe", fitter.window.keyframes)):
        for index, view in enumerate(views):
            arrays |= {f"{kind}/{index}/{name}": array for name, array in _frame_arrays(view.frame).items()}
    arrays |= {f"seen/{index}": mask.kinds for index, (_, mask) in enumerate(fitter.seen)}
    for name, balls in (("unrepresented", fitter.unrepresented), ("bare", fitter.bare)):
        if balls is not None:
            arrays |= {f"{name}/centers": balls.centers, f"{name}/labels": balls.labels}
    return arrays


def restore_fitter(fitter: SceneFitter, arrays: Arrays) -> None:
    """Restore a fitter's state, of the same configuration, seed and workspace."""
    for name, array in fitter.buffer.arrays().items():
        array[...] = arrays[name]
    for name in GRID_NAMES:
        getattr(fitter.occupancy, name)[...] = arrays[name]
    fitter.occupancy.step_stamps_ns = [int(stamp) for stamp in arrays["step_stamps_ns"]]
    fitter.num_steps, fitter.descent.num_iterations = (int(n) for n in arrays["counters"])
    fitter.people.voxels = np.asarray(arrays["people/voxels"], np.int64)
    fitter.people.stamps_ns = np.asarray(arrays["people/stamps_ns"], np.int64)
    fitter.occupancy.edges = {
        name.removeprefix("edges/"): LostEdges(
            centers=np.asarray(a[:, :3], np.float32), radii=np.asarray(a[:, 3], np.float32)
        )
        for name, a in arrays.items()
        if name.startswith("edges/")
    }
    num_blocks, added, relocated, unmet, *removed = (int(n) for n in arrays["refined"])
    fitter.refined = Refined(
        num_blocks=num_blocks,
        filled=Filled(added=added, relocated=relocated, unmet=unmet),
        removed=dict(zip(REASONS, removed, strict=True)),
    )
    fitter.mounted, fitter.objects = (
        {name.removeprefix(kind): np.asarray(mask, bool) for name, mask in arrays.items() if name.startswith(kind)}
        for kind in ("mounted/", "objects/")
    )
    if fitter.shell is not None:
        fitter.shell.restore({name.removeprefix("shell/"): a for name, a in arrays.items() if name[:6] == "shell/"})
    if "background" in arrays:
        red, green, blue = (float(value) for value in arrays["background"])
        fitter.descent.background = (red, green, blue)
    if "density" in arrays:
        edge, tolerance, num_candidates = (float(x) for x in arrays["density"])
        fitter.density = SeedDensity(edge=edge, tolerance=tolerance, num_candidates=int(num_candidates))
    if "posture/radii" in arrays:
        fitter.posture = RobotPosture(
            centers=np.asarray(arrays["posture/centers"], float),
            radii=np.asarray(arrays["posture/radii"], float),
            T_world_link=np.asarray(arrays["posture/T_world_link"], float),
        )
    fitter.window = Window(fitter.config)
    fitter.window.newest = [fitter.view(frame) for frame in _frames(arrays, "newest")]
    fitter.window.keyframes = [fitter.view(frame) for frame in _frames(arrays, "keyframe")]
    fitter.unrepresented, fitter.bare = (
        Balls.from_voxels(
            np.asarray(arrays[f"{name}/centers"], np.float32),
            fitter.occupancy.config.voxel,
            np.asarray(arrays[f"{name}/labels"], np.uint8),
        )
        for name in ("unrepresented", "bare")
    )
    kinds = [arrays[f"seen/{index}"] for index in range(sum(name.startswith("seen/") for name in arrays))]
    frames = [view.frame for view in fitter.window.newest[len(fitter.window.newest) - len(kinds) :]]
    fitter.seen = [
        (frame, replace(object_mask(frame), kinds=np.asarray(kind, np.uint8)))
        for frame, kind in zip(frames, kinds, strict=True)
    ]


def workspace_of(arrays: Arrays) -> Box:
    lower, upper = np.asarray(arrays["workspace"], np.float64)
    return Box(lower=lower, upper=upper)


def _frame_arrays(frame: RgbdFrame) -> dict[str, Values]:
    values = {name: getattr(frame, name) for name in FRAME_NAMES}
    k = frame.intrinsics
    values["intrinsics"] = [k.fx, k.fy, k.cx, k.cy, k.width, k.height]
    return {name: np.asarray(value) for name, value in values.items() if value is not None}


def _frames(arrays: Arrays, kind: str) -> list[RgbdFrame]:
    frames: list[RgbdFrame] = []
    while f"{kind}/{len(frames)}/color" in arrays:
        start = f"{kind}/{len(frames)}/"
        values: dict[str, Any] = {name: arrays[start + name] for name in FRAME_NAMES if start + name in arrays}
        fx, fy, cx, cy, width, height = (float(x) for x in values["intrinsics"])
        values["intrinsics"] = Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=int(width), height=int(height))
        values["stamp_ns"], values["camera"] = int(values["stamp_ns"]), str(values["camera"])
        frames.append(RgbdFrame(**values))
    return frames
