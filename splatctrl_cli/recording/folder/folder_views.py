"""The views of an image folder's description, matched by name."""

import os
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from splatctrl_cli.config.fixed import PLAUSIBLE_DEPTH, UNIT_APART, UNIT_BASELINE, UNIT_DEPTH
from splatctrl_cli.errors import InputError, UsageError, refuse_if, require
from splatctrl_cli.geometry import transform_from
from splatctrl_cli.recording.folder.folder_description import (
    CameraTable,
    Description,
    ImageFile,
    ListedView,
    PosesTable,
    whole_file,
)
from splatctrl_cli.recording.folder.poses import (
    READERS,
    read_matrix_blocks,
    read_matrix_file,
    stamp_of_text,
    trajectory,
    world_camera,
)
from splatctrl_cli.recording.source_options import SourceOptions, still_note
from splatctrl_cli.records import MILLIMETRE, SECOND_NS, Float64, LossReport

HOLDOUT = "holdout"
UNITS = {MILLIMETRE: "millimetres", 0.01: "centimetres"}  # [m] of each, the likelier first


@dataclass(frozen=True, kw_only=True)
class View:
    """A pair of files with an optional mask; name is the text of `*`.

    camera: its name, or HOLDOUT. lens: its camera. depth_scale: metres per count. valid: mask of usable pixels.
    """

    name: str
    color: ImageFile
    depth: ImageFile | None
    human: Path | None
    T_world_camera: Float64
    stamp_ns: int
    camera: str
    lens: CameraTable
    depth_scale: float
    valid: Path | None = None

    def convert(self, metres: float) -> "View":
        """Scale pose and depth to metres; metres: per unit of the recording."""
        T = self.T_world_camera.copy()
        T[:3, 3] *= metres
        return replace(self, T_world_camera=T, depth_scale=self.depth_scale * metres)


def length_unit(median: float, apart: float) -> float:
    """Metres per unit of a recording, by its median depth and its cameras' distance.

    1 unless the depth is too large for metres, and the cameras' distance has the same unit.
    """
    if median <= PLAUSIBLE_DEPTH[1] or apart < UNIT_APART * median:
        return 1.0
    low, high = UNIT_DEPTH
    fits = [unit for unit in UNITS if low <= unit * median <= high and unit * apart > UNIT_BASELINE]
    return fits[0] if fits else 1.0


def views_of(description: Description, options: SourceOptions, loss: LossReport) -> list[View]:
    """Views sorted by stamp; losses are counted in `loss`.

    Raises InputError if no view is left, or all are held out (UsageError if by --holdout).
    """
    listed = _present(description, loss) if description.listed else _listed(description, options, loss)
    names = [view.name for view in listed]
    held_out = _holdout(description, names, options)
    views = []
    for position, view in enumerate(listed):
        lens = view.camera or description.camera
        assert lens is not None
        T = _pose(description.poses, view, lens, options)
        if T is not None:
            views.append(
                View(
                    name=view.name,
                    color=view.color,
                    depth=view.depth,
                    human=view.human,
                    T_world_camera=T,
                    stamp_ns=_stamp_ns(description, view, position),
                    camera=HOLDOUT if view.name in held_out else lens.name,
                    lens=lens,
                    depth_scale=_scale(description, view, options),
                    valid=view.valid,
                )
            )
    loss.without_pose += len(listed) - len(views)
    loss.unpaired_color += description.unpaired[0]
    loss.unpaired_depth += description.unpaired[1]
    loss.damaged += description.num_damaged
    loss.notes.extend(description.notes)
    loss.notes.extend(still_note(name) for name in options.camera_poses if any(v.lens.name == name for v in views))
    if not views:
        file = "" if description.poses is None else description.poses.file
        refuse_if(
            file and "*" not in file and not (description.root / file).is_file(),
            f"{description.root / file}: no such file, and no other file has its poses",
            remedy="copy it too, or give --camera-pose NAME=identity for a camera that stands still",
        )
        remedy = "check the clock or the numbers that images and poses share, or give --camera-pose"
        raise InputError(f"{description.path}: {file} has no pose for any image ({names[0]}, ...)", remedy=remedy)
    if held_out and all(view.camera == HOLDOUT for view in views):
        remedy = "leave some to train with"
        refuse_if(
            options.holdout is not None,
            f"--holdout: all {len(views)} views are held out",
            remedy=remedy,
            error=UsageError,
        )
        raise InputError(f"{description.path}: [split] holds all {len(views)} views out", remedy=remedy)
    return sorted(views, key=lambda view: (view.stamp_ns, view.name))


def _present(description: Description, loss: LossReport) -> list[ListedView]:
    root, present, absent = description.root.absolute(), [], []
    for view in description.listed:
        files = [whole_file(path) for path in (view.color, view.depth, view.valid) if path is not None]
        for path in files:
            refuse_if(
                not Path(os.path.normpath(path.absolute())).is_relative_to(os.path.normpath(root)),
                f"{description.path}: {path} is not in {description.root}",
                remedy="give the folder that holds all files",
            )
        missing = [path for path in files if not path.is_file()]
        absent += missing[:1]
        present += [] if missing else [view]
        has_color, has_depth = (
            whole_file(view.color) not in missing,
            view.depth is None or whole_file(view.depth) not in missing,
        )
        loss.unpaired_color += has_color and not has_depth
        loss.unpaired_depth += has_depth and not has_color
    if absent:
        loss.notes.append(f"{len(absent)} of {len(description.listed)} views lack a file ({absent[0]}, ...)")
    if not present:
        raise InputError(
            f"{description.path}: {absent[0]}: no such file, nor any other", remedy="copy the images too"
        )
    return present


def find_files(root: Path, pattern: str) -> list[tuple[str, Path]]:
    """Pairs (text of `*`, file) in order of paths; without `*`, one file with empty text."""
    if "*" not in pattern:
        return [("", root / pattern)] if (root / pattern).is_file() else []
    expression = re.compile(".*".join(re.escape(part) for part in pattern.split("*")).replace(".*", "(.*)", 1))
    matches = ((expression.fullmatch(path.relative_to(root).as_posix()), path) for path in sorted(root.glob(pattern)))
    return [(match[1], path) for match, path in matches if match is not None]


def _pose(table: PosesTable | None, view: ListedView, lens: CameraTable, options: SourceOptions) -> Float64 | None:
    option = options.camera_poses.get(lens.name)
    if option is not None:
        return transform_from(option[:3], option[3:])
    if view.matrix is None or not np.isfinite(view.matrix).all():  # so trackers write that they were lost
        return None
    assert table is not None
    return world_camera(view.matrix, table.convention, table.axes, f"{table.file}: pose of {view.name}")


def _scale(description: Description, view: ListedView, options: SourceOptions) -> float:
    if options.depth_scale is not None:
        return options.depth_scale
    scale = description.depth.scale if view.depth_scale is None else view.depth_scale
    refuse_if(
        not 0 < scale < np.inf,
        f"{description.path}: depth of {view.name}: expected metres per count, got {scale}",
        remedy="correct the file, or give --depth-scale",
    )
    return scale


def _listed(description: Description, options: SourceOptions, loss: LossReport) -> list[ListedView]:
    frames, camera = description.frames, description.camera
    assert frames is not None and camera is not None
    colors = dict(find_files(description.root, frames.color))
    depths = dict(find_files(description.root, frames.depth))
    for pattern, files in ((frames.color, colors), (frames.depth, depths)):
        refuse_if(
            not files,
            f"{description.path}: no file matches {description.root / pattern}",
            remedy="correct [frames] or root",
        )
    masks = _masks(description, list(colors), loss)
    names = [name for name in colors if name in depths]
    refuse_if(
        not names,
        f"{description.path}: no colour file has a depth file of the same name"
        f" ({next(iter(colors))!r}, {next(iter(depths))!r}, ...)",
        remedy="the * of [frames] color and depth must stand for the same text",
    )
    loss.unpaired_color += len(colors) - len(names)
    loss.unpaired_depth += len(depths) - len(names)
    poses = {} if camera.name in options.camera_poses else _poses(description, {name: colors[name] for name in names})
    return [
        ListedView(name=name, color=colors[name], depth=depths[name], human=masks.get(name), matrix=poses.get(name))
        for name in names
    ]


def _masks(description: Description, names: list[str], loss: LossReport) -> dict[str, Path]:
    assert description.frames is not None
    pattern = description.frames.human_mask
    if not pattern:
        return {}
    masks = dict(find_files(description.root, pattern))
    refuse_if(
        not any(name in masks for name in names),
        f"{description.path}: no file of {description.root / pattern} is named like a colour image",
        remedy="the * of [frames] human_mask and color must stand for the same text",
    )
    num_without = sum(name not in masks for name in names)
    if num_without:
        loss.notes.append(f"{num_without} of {len(names)} colour images have no mask")
    return masks


def _poses(description: Description, colors: dict[str, Path]) -> dict[str, Float64]:
    table, root = description.poses, description.root
    remedy = "describe them, or give --camera-pose NAME=identity for a camera that stands still"
    table = require(table, f"{description.path}: [poses] is missing", remedy=remedy)
    if table.format == "matrix-files":
        files = dict(find_files(root, table.file))
        if "" in files:  # a camera that does not move
            return dict.fromkeys(colors, read_matrix_file(files[""]))
        return {name: read_matrix_file(files[name]) for name in colors if name in files}
    is_of_blocks = table.format == "matrix-blocks"
    file = root / table.file
    by_key = read_matrix_blocks(file, table.heading) if is_of_blocks else READERS[table.format](file)
    if table.format == "tum":
        pose_at = trajectory(by_key)
        at_stamp = {name: pose_at(stamp) for name in colors if (stamp := stamp_of_text(name)) is not None}
        return {name: pose for name, pose in at_stamp.items() if pose is not None}
    if table.format == "nerfstudio":
        keys = {name: path.relative_to(root).as_posix() for name, path in colors.items()}
        by_key = {key.removeprefix("./"): pose for key, pose in by_key.items()}
    else:
        keys = {name: str(_number(name)) for name in colors}
    return {name: by_key[key] for name, key in keys.items() if key in by_key}


def _holdout(description: Description, names: list[str], options: SourceOptions) -> set[str]:
    entries = description.split.holdout if options.holdout is None else options.holdout
    held_out = set()
    for entry in entries:
        if str(entry) in names:
            held_out.add(str(entry))
        elif str(entry).isdigit() and int(entry) < len(names):
            held_out.add(names[int(entry)])
        else:
            raise InputError(
                f"{description.path}: holdout {entry!r}: no such frame",
                remedy=f"use a name ({names[0]} to {names[-1]}) or a position (0 to {len(names) - 1})",
            )
    return held_out


def _stamp_ns(description: Description, view: ListedView, position: int) -> int:
    stamps = description.stamps
    if view.stamp_ns is not None:
        return view.stamp_ns
    if stamps.names:
        what = f"{description.path}: stamps.names: expected seconds, got {view.name!r}"
        return require(stamp_of_text(view.name), what, remedy="see splatctrl help input")
    return round(_number(view.name) * SECOND_NS / stamps.rate) if stamps.rate is not None else position * SECOND_NS


def _number(name: str) -> int:
    numbers = re.findall(r"\d+", name)
    return int(numbers[-1]) if numbers else -1
