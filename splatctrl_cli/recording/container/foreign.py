"""Recordings of unsupported tools: their marks, and how to export them."""

import zipfile
from dataclasses import dataclass
from pathlib import Path

from splatctrl_cli.errors import InputError

_BAG = "and record its image, camera_info and tf topics with `ros2 bag record`"
_FOLDER = "write colour and 16-bit PNG depth with poses as an image folder (splatctrl help input)"
_TABLE = f"describe joint states in it in a .toml (splatctrl help replay, Logs); of images {_FOLDER}"
AZURE_KINECT = f"play it with azure_kinect_ros_driver (recording_file:=FILE) {_BAG}, depth from /depth_to_rgb"
_ENDS = 1 << 20  # bytes at either end of a file that are searched for its marks


@dataclass(frozen=True, kw_only=True)
class Foreign:
    """An unsupported format: what it is, the remedy, and its marks.

    Marks: name endings, first bytes with a mark near either end, or an entry of a zip file or folder.
    """

    what: str
    remedy: str
    suffixes: tuple[str, ...] = ()
    magic: bytes = b""
    mark: bytes = b""
    entry: str = ""


FOREIGN = (
    Foreign(
        what="a Record3D recording",
        suffixes=(".r3d",),
        entry="rgbd/",
        remedy=f"export it in the Record3D app as `EXR + JPG` sequence; {_FOLDER}",
    ),
    Foreign(
        what="an Azure Kinect recording",
        magic=b"\x1a\x45\xdf\xa3",  # Matroska
        mark=b"K4A_",
        remedy=AZURE_KINECT,
    ),
    Foreign(
        what="a ZED recording", suffixes=(".svo", ".svo2"), remedy=f"play it with zed_wrapper (svo_path:=FILE) {_BAG}"
    ),
    Foreign(
        what="a Rerun recording",
        suffixes=(".rrd", ".rbl"),
        magic=b"RRF",
        remedy="give the log that it was made from, or write its images with their poses as an image folder",
    ),
    Foreign(what="an OpenNI recording", suffixes=(".oni",), remedy=f"play it with openni2_camera {_BAG}"),
    Foreign(what="an HDF5 file", suffixes=(".h5", ".hdf5"), magic=b"\x89HDF\r\n\x1a\n", remedy=_TABLE),
    Foreign(what="a Parquet file", suffixes=(".parquet",), magic=b"PAR1", remedy=_TABLE),
    Foreign(what="a LeRobot dataset", entry="meta/info.json", remedy=_TABLE),
    Foreign(what="a TensorFlow dataset", suffixes=(".tfrecord",), entry="dataset_info.json", remedy=_FOLDER),
    Foreign(what="a Zarr store", suffixes=(".zarr",), entry=".zgroup", remedy=_FOLDER),
    Foreign(what="a Python pickle", suffixes=(".pkl", ".pickle"), remedy=_FOLDER),
    Foreign(what="a Project Aria recording", suffixes=(".vrs",), remedy=f"export it with its own tools; {_FOLDER}"),
    Foreign(what="a Kintinuous or ElasticFusion log", suffixes=(".klg",), remedy=f"export its images; {_FOLDER}"),
    Foreign(what="an LCM log", suffixes=(".lcm",), remedy="write its messages as MCAP with ROS 2 or Foxglove types"),
    Foreign(
        what="a packed file",
        suffixes=(".gz", ".tgz", ".bz2", ".xz", ".lz4", ".7z", ".tar", ".zip", ".rar"),
        remedy="unpack it, and give what is in it",
    ),
)


def refuse_foreign(path: Path) -> None:
    """Raise InputError for a known unsupported format, with its name and export.

    Some are supported containers with other contents (a .svo2 is an MCAP, an Azure Kinect's .mkv a video).
    """
    ends, names = (b"", []) if path.is_dir() else (_ends(path), _entries(path))
    for kind in FOREIGN:
        is_named = path.suffix.lower() in kind.suffixes
        is_marked = bool(kind.magic) and ends.startswith(kind.magic) and kind.mark in ends
        holds = kind.entry and ((path / kind.entry).exists() or any(name.startswith(kind.entry) for name in names))
        if is_named or is_marked or holds:
            raise InputError(f"{path}: {kind.what}, which is not read", remedy=kind.remedy)


def _ends(path: Path) -> bytes:
    with path.open("rb") as stream:
        start = stream.read(_ENDS)
        stream.seek(max(len(start), path.stat().st_size - _ENDS))
        return start + stream.read()


def _entries(path: Path) -> list[str]:
    try:
        with zipfile.ZipFile(path) as archive:
            return archive.namelist()
    except (zipfile.BadZipFile, NotImplementedError):  # the second of a later version of the format
        return []
