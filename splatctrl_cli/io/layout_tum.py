"""TUM RGB-D: ``rgb.txt``, ``depth.txt``, ``groundtruth.txt``; everything by stamps, depth in 1/5000 m.

Files, factor and cameras are those of the dataset's page (Sturm et al., A benchmark for the evaluation of RGB-D SLAM
systems, IROS 2012; "File Formats" and "Intrinsic Camera Calibration"). Depth is registered to the colour image as it
was taken, so both are undistorted alike.
"""

from pathlib import Path

from splatctrl_cli.errors import InputError
from splatctrl_cli.io.folder_description import CameraTable, DepthTable, Description, ListedView, PosesTable
from splatctrl_cli.io.layout import described, given_lens, pinhole
from splatctrl_cli.io.options import SourceOptions
from splatctrl_cli.io.pairing import pair_by_stamp
from splatctrl_cli.io.poses import Trajectory, read_tum, stamp_of_text

SCALE = 1.0 / 5000.0  # [m] per count
LENSES = {  # fx, fy, cx, cy and k1, k2, p1, p2, k3 by what the folder's name contains
    "freiburg1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "freiburg2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "freiburg3": ((535.4, 539.2, 320.1, 247.6), ()),
}


def matches(folder: Path) -> bool:
    """Whether the folder lists its images in rgb.txt and depth.txt."""
    return all((folder / name).is_file() for name in ("rgb.txt", "depth.txt"))


def read(folder: Path, options: SourceOptions) -> Description:
    """The folder as a description: pairs within the pairing tolerance, poses interpolated."""
    colors, depths = _listed(folder / "rgb.txt"), _listed(folder / "depth.txt")
    color_ns, depth_ns = [stamp for stamp, _ in colors], [stamp for stamp, _ in depths]
    pairs = pair_by_stamp(color_ns, depth_ns, round(options.pairing_tolerance_s * 1e9))
    file = folder / "groundtruth.txt"
    trajectory = Trajectory(read_tum(file) if file.is_file() else {})
    views = [
        ListedView(
            name=f"{color_ns[i] / 1e9:.6f}",
            color=colors[i][1],
            depth=depths[j][1],
            matrix=trajectory.at(color_ns[i]),
            stamp_ns=color_ns[i],
        )
        for i, j in pairs
    ]
    return described(
        folder / "rgb.txt",
        folder,
        views,
        poses=PosesTable(format="tum", file=file.name),
        camera=_lens(folder, options, views[0].color) if views else None,
        depth=DepthTable(scale=SCALE),
        has_stamps=True,
        unpaired=(len(colors) - len(pairs), len(depths) - len(pairs)),
    )


def _lens(folder: Path, options: SourceOptions, image: Path) -> CameraTable:
    given = given_lens(options, image)
    if given is not None:
        return given
    for word, (values, distortion) in LENSES.items():
        if word in folder.resolve().name:
            return pinhole(values, image, distortion)
    raise InputError(
        f"{folder}: expected a name with one of {', '.join(LENSES)}, whose cameras are known, got {folder.name!r}",
        remedy="give --intrinsics camera=FX,FY,CX,CY (the Kinect's default: 525,525,319.5,239.5)",
    )


def _listed(path: Path) -> list[tuple[int, Path]]:
    """Stamp [ns] and file of each line ``stamp path``."""
    found = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        words = line.split()
        if words and not line.startswith("#"):
            stamp_ns = stamp_of_text(words[0])
            if stamp_ns is None or len(words) != 2:
                raise InputError(f"{path}:{number}: expected 'stamp file', got {line!r}", remedy="correct the line")
            found.append((stamp_ns, path.parent / words[1]))
    return found
