"""7-Scenes and 3DMatch: ``frame-NNNNNN.color.png``, ``.depth.png``, ``.pose.txt``, in one folder or in ``seq-NN/``.

Depth in millimetres with 65535 for none, poses camera to world. 7-Scenes publishes no calibration but the depth
camera's default of 585, 585, 320, 240 (Shotton et al., CVPR 2013, and the dataset's page); 3DMatch (Zeng et al., CVPR
2017) has a ``camera-intrinsics.txt`` and no lost frames but those whose matrix is not finite.
"""

from pathlib import Path

from splatctrl_cli.errors import InputError
from splatctrl_cli.io.folder_description import CameraTable, DepthTable, Description, ListedView, PosesTable
from splatctrl_cli.io.layout import by_numbers, described, given_lens, pinhole, pose_or_none
from splatctrl_cli.io.options import SourceOptions
from splatctrl_cli.io.poses import read_matrix_file, read_numbers
from splatctrl_cli.records import Float64

DEFAULT = (585.0, 585.0, 320.0, 240.0)
NO_DEPTH = 65535
_SEQUENCES = ("", "seq-*/")


def matches(folder: Path) -> bool:
    """Whether the folder, or a sequence in it, has frames with a pose each."""
    return any(next(folder.glob(f"{sequence}frame-*.pose.txt"), None) is not None for sequence in _SEQUENCES)


def read(folder: Path, options: SourceOptions) -> Description:
    """The folder, or all its sequences, as a description."""
    sequence = next(s for s in _SEQUENCES if next(folder.glob(f"{s}frame-*.pose.txt"), None) is not None)
    colors = _files(folder, f"{sequence}frame-*.color.*", ".color")
    depths = _files(folder, f"{sequence}frame-*.depth.png", ".depth")
    views = [
        ListedView(name=name, color=colors[name], depth=depths[name], matrix=_pose(folder / f"{name}.pose.txt"))
        for name in colors
        if name in depths
    ]
    camera, notes = _lens(folder, options, views[0].color) if views else (None, ())
    return described(
        folder,
        folder,
        views,
        poses=PosesTable(format="matrix-files", file=f"{sequence}frame-*.pose.txt"),
        camera=camera,
        depth=DepthTable(invalid=NO_DEPTH),
        unpaired=(len(colors) - len(views), len(depths) - len(views)),
        notes=notes,
    )


def _files(folder: Path, pattern: str, kind: str) -> dict[str, Path]:
    """Files by their path up to `kind`, in the order of their numbers."""
    paths = sorted(folder.glob(pattern), key=lambda p: by_numbers(p.relative_to(folder).as_posix()))
    return {path.relative_to(folder).as_posix().partition(kind)[0]: path for path in paths}


def _pose(path: Path) -> Float64 | None:
    return pose_or_none(read_matrix_file(path)) if path.is_file() else None


def _lens(folder: Path, options: SourceOptions, image: Path) -> tuple[CameraTable, tuple[str, ...]]:
    given = given_lens(options, image)
    if given is not None:
        return given, ()
    for file in (folder / "camera-intrinsics.txt", folder.parent / "camera-intrinsics.txt"):
        if file.is_file():
            values = read_numbers(file)
            if len(values) != 9:
                raise InputError(
                    f"{file}: expected a 3x3 matrix, got {len(values)} numbers", remedy="correct the file"
                )
            return pinhole((values[0], values[4], values[2], values[5]), image), ()
    note = (
        "no camera-intrinsics.txt: 7-Scenes' default 585, 585, 320, 240 is taken, and colour as if it lay on depth;"
        " --intrinsics camera=FX,FY,CX,CY says otherwise"
    )
    return pinhole(DEFAULT, image), (note,)
