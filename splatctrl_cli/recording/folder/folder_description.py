"""The TOML description of an image folder (docs/input.md)."""

import tomllib
from collections.abc import Callable, Collection, Mapping
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from splatctrl_cli.errors import InputError, did_you_mean, refuse_faults, refuse_if, require
from splatctrl_cli.recording.folder.poses import AXES, CONVENTIONS, FORMATS, rigid
from splatctrl_cli.recording.log.registration import DISTORTION_MODELS
from splatctrl_cli.records import Float64, Intrinsics

DEPTH_ENCODINGS = ("uint16", "uint16-rotated3", "float32")


@dataclass(frozen=True, kw_only=True)
class CameraTable:
    """``[camera]`` or ``[depth_camera]``; pixel_center: coordinate of the first pixel's centre (0 or 0.5)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    pixel_center: float = 0.0
    name: str = "camera"
    distortion: list[float] = field(default_factory=list)
    distortion_model: str = "plumb_bob"
    depth_to_color: list[list[float]] = field(default_factory=list)

    @property
    def intrinsics(self) -> Intrinsics:
        """Intrinsics with pixel (0, 0) centred at u = v = 0."""
        return Intrinsics(
            fx=self.fx,
            fy=self.fy,
            cx=self.cx - self.pixel_center,
            cy=self.cy - self.pixel_center,
            width=self.width,
            height=self.height,
        )


@dataclass(frozen=True, kw_only=True)
class FramesTable:
    """``[frames]``: globs with one ``*``; files with the same text for ``*`` belong together.

    human_mask: 8-bit grey, not 0 on a person.
    """

    color: str
    depth: str
    human_mask: str = ""


@dataclass(frozen=True, kw_only=True)
class DepthTable:
    """``[depth]``: encoding, metres per count, and a further invalid count (-1: none)."""

    encoding: str = "uint16"
    scale: float = 1e-3
    invalid: int = -1


@dataclass(frozen=True, kw_only=True)
class PosesTable:
    """``[poses]``; heading selects the blocks of `matrix-blocks`."""

    format: str
    file: str
    convention: str = "camera_to_world"
    axes: str = "opencv"
    heading: str = ""


@dataclass(frozen=True, kw_only=True)
class StampsTable:
    """``[stamps]``: rate [1/s] of frame numbers; names: True if names are seconds."""

    rate: float | None = None
    names: bool = False


@dataclass(frozen=True, kw_only=True)
class SplitTable:
    """``[split]``: frames (position or name) for camera `holdout`."""

    holdout: list[int | str] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class ImagePart:
    """An image inside a file, used like an image file's path.

    number: its index. size: (columns, rows). read_bytes: returns an image file of `suffix`, empty if damaged.
    """

    file: Path
    number: int
    size: tuple[int, int]
    suffix: str
    read_bytes: Callable[[], bytes]

    @property
    def name(self) -> str:
        return f"{self.file.name}#{self.number}"

    def __str__(self) -> str:
        return str(self.file.with_name(self.name))


ImageFile = Path | ImagePart


def whole_file(image: ImageFile) -> Path:
    """The file that an image is, or is a part of."""
    return image.file if isinstance(image, ImagePart) else image


@dataclass(frozen=True, kw_only=True)
class ListedView:
    """A view by its files, for layouts that list them.

    depth: None if no view has any. matrix: pose as written, or None. camera: None for [camera]'s. depth_scale: metres
    per count, None for [depth]'s. valid: 8-bit grey, 0 on invalid pixels, or None.
    """

    name: str
    color: ImageFile
    depth: ImageFile | None
    matrix: Float64 | None
    human: Path | None = None
    stamp_ns: int | None = None
    camera: CameraTable | None = None
    depth_scale: float | None = None
    valid: Path | None = None


@dataclass(frozen=True, kw_only=True)
class Description:
    """A description; transforms.json may give camera and frames, --camera-pose the poses.

    listed: a layout's views, instead of frames. is_depth_resized: to colour, by nearest pixels. unpaired: colour and
    depth files without partner. num_damaged: views lost to damage. supply: how to add depth if no view has it. notes:
    assumptions on what the layout leaves open.
    """

    path: Path
    root: Path
    poses: PosesTable | None
    camera: CameraTable | None = None
    depth_camera: CameraTable | None = None
    frames: FramesTable | None = None
    depth: DepthTable = field(default_factory=DepthTable)
    stamps: StampsTable = field(default_factory=StampsTable)
    split: SplitTable = field(default_factory=SplitTable)
    listed: tuple[ListedView, ...] = ()
    is_depth_resized: bool = False
    unpaired: tuple[int, int] = (0, 0)
    num_damaged: int = 0
    supply: str = "describe colour and depth files in a .toml (splatctrl help input)"
    notes: tuple[str, ...] = ()

    @property
    def T_color_depth(self) -> Float64:
        """``depth_to_color`` (4, 4): maps depth-camera to colour-camera coordinates."""
        where = f"{self.path}: depth_camera.depth_to_color"
        rows = self.depth_camera.depth_to_color if self.depth_camera is not None else []
        with refuse_faults(lambda _: f"{where}: expected a 4x4 matrix", ValueError, remedy=_HELP):
            matrix = np.array(rows, dtype=np.float64) if rows else np.eye(4)
        return rigid(matrix, where)


T = TypeVar("T")


_HELP = "see splatctrl help input"


def read_description(path: Path, root: Path | None = None) -> Description:
    """Parse a description. Raises InputError naming an unknown, missing or wrong key."""
    return _read(_content(path), path, root)


def read_table(
    kind: type[T],
    path: Path,
    name: str,
    *,
    others: Collection[str] = (),
    fill: Callable[[Mapping[str, Any]], Mapping[str, Any]] | None = None,
) -> T:
    """Read table [name] of a TOML file; `fill` adds keys left out.

    Raises InputError for a wrong key.
    """
    content = _content(path)
    _check_keys(content, {name, *others}, str(path), "")
    if fill is not None and isinstance(content.get(name), dict):
        content[name] = fill(content[name])
    return require(_optional(kind, content, name, path), f"{path}: [{name}] is missing", remedy=_HELP)


def has_table(path: Path, name: str) -> bool:
    """True if the file has a table [name]. Raises InputError if not TOML."""
    return name in _content(path)


def read_rig(path: Path, root: Path | None = None) -> list[Description]:
    """A description per ``[[cameras]]`` table; empty without any.

    Keys are those of [camera], and `color`, `depth`, `poses` for files; other tables are common. Raises InputError
    for a wrong key, and a shared or missing name.
    """
    content = _content(path)
    cameras = content.pop("cameras", [])
    refuse_if(
        not isinstance(cameras, list) or not all(isinstance(camera, dict) for camera in cameras),
        f"{path}: cameras: expected tables [[cameras]], got {cameras!r}",
        remedy=_HELP,
    )
    names = [camera.get("name") for camera in cameras]
    refuse_if(
        None in names or len(set(names)) < len(names),
        f"{path}: [[cameras]]: expected a name for each of its own, got {names}",
        remedy=_HELP,
    )
    refuse_if(
        cameras and not {"camera", "frames", "split"}.isdisjoint(content),
        f"{path}: [[cameras]] beside [camera], [frames] or [split]",
        remedy="leave the single tables out",
    )
    return [_read(_describe_camera(content, camera, path), path, root) for camera in cameras]


def _describe_camera(common: dict[str, Any], camera: dict[str, Any], path: Path) -> dict[str, Any]:
    for key in ("color", "depth", "poses"):
        refuse_if(not isinstance(camera.get(key), str), f"{path}: [[cameras]]: {key} is missing", remedy=_HELP)
    return {
        **common,
        "camera": {key: value for key, value in camera.items() if key not in ("color", "depth", "poses")},
        "frames": {"color": camera["color"], "depth": camera["depth"]},
        "poses": {"format": "matrix-files", **common.get("poses", {}), "file": camera["poses"]},
    }


def _content(path: Path) -> dict[str, Any]:
    with refuse_faults(f"{path}: not valid TOML", tomllib.TOMLDecodeError, UnicodeDecodeError, remedy=_HELP):
        return tomllib.loads(path.read_text(encoding="utf-8"))


def _read(content: dict[str, Any], path: Path, root: Path | None) -> Description:
    known = {f.name for f in fields(Description)} - {
        *("path", "listed", "is_depth_resized", "unpaired", "num_damaged", "supply", "notes")
    }
    _check_keys(content, known, str(path), "")
    with refuse_faults(
        lambda _: f"{path}: root: no home folder of {content.get('root')}", RuntimeError, remedy="give --root"
    ):  # ~ of an unknown user
        folder = root or path.parent / Path(str(content.get("root", "."))).expanduser()
    refuse_if(not folder.is_dir(), f"{path}: root {folder}: no such folder", remedy="correct `root`, or give --root")
    description = Description(
        path=path,
        root=folder,
        poses=_optional(PosesTable, content, "poses", path),
        camera=_optional(CameraTable, content, "camera", path),
        depth_camera=_optional(CameraTable, content, "depth_camera", path),
        frames=_optional(FramesTable, content, "frames", path),
        depth=_optional(DepthTable, content, "depth", path) or DepthTable(),
        stamps=_optional(StampsTable, content, "stamps", path) or StampsTable(),
        split=_optional(SplitTable, content, "split", path) or SplitTable(),
    )
    poses = description.poses
    for key, value, allowed in [
        *([] if poses is None else [("poses.format", poses.format, FORMATS)]),
        *([] if poses is None else [("poses.convention", poses.convention, CONVENTIONS)]),
        *([] if poses is None else [("poses.axes", poses.axes, AXES)]),
        ("depth.encoding", description.depth.encoding, DEPTH_ENCODINGS),
    ]:
        refuse_if(
            value not in allowed, f"{path}: {key}: expected one of {', '.join(allowed)}, got {value!r}", remedy=_HELP
        )
    for name, camera in (("camera", description.camera), ("depth_camera", description.depth_camera)):
        if camera is not None:
            check_camera(camera, f"{path}: {name}")
    refuse_if(
        not 0 < description.depth.scale < 1e3,
        f"{path}: depth.scale: expected metres per count, got {description.depth.scale}",
        remedy=_HELP,
    )
    if poses is None or poses.format != "nerfstudio":
        for name in ("camera", "frames"):
            refuse_if(getattr(description, name) is None, f"{path}: [{name}] is missing", remedy=_HELP)
    return description


def check_camera(camera: CameraTable, where: str) -> None:
    """Raise InputError naming an impossible size or focal length."""
    for name in ("width", "height", "fx", "fy"):
        value = getattr(camera, name)
        refuse_if(
            not 1e-2 <= value < 1e5,
            f"{where}.{name}: expected a positive number of pixels, got {value}",
            remedy=_HELP,
        )
    for name in ("cx", "cy"):
        refuse_if(
            not abs(getattr(camera, name)) < 1e5,
            f"{where}.{name}: expected pixels, got {getattr(camera, name)}",
            remedy=_HELP,
        )
    refuse_if(
        not all(isinstance(value, int | float) for value in camera.distortion),
        f"{where}.distortion: expected numbers, got {camera.distortion}",
        remedy=_HELP,
    )
    names, model = ", ".join(DISTORTION_MODELS), camera.distortion_model
    what = f"{where}.distortion_model: expected one of {names}, got {model!r}"
    refuse_if(model not in DISTORTION_MODELS, what, remedy=_HELP)


def _optional(kind: type[T], content: dict[str, Any], name: str, path: Path) -> T | None:
    if name not in content:
        return None
    table = content[name]
    refuse_if(not isinstance(table, dict), f"{path}: {name}: expected a table [{name}], got {table!r}", remedy=_HELP)
    declared = {f.name: f for f in fields(kind)}  # type: ignore[arg-type]
    _check_keys(table, set(declared), str(path), f"{name}.")
    for key, f in declared.items():
        refuse_if(
            key not in table and f.default is MISSING and f.default_factory is MISSING,
            f"{path}: {name}.{key} is missing",
            remedy=_HELP,
        )
    return kind(**{key: _convert(value, declared[key].type, f"{path}: {name}.{key}") for key, value in table.items()})


def _convert(value: Any, hint: Any, where: str) -> Any:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    good = {
        int: isinstance(value, int) and is_number,
        float: is_number,
        str: isinstance(value, str),
        bool: isinstance(value, bool),
        float | None: is_number,
        int | None: isinstance(value, int) and is_number,
    }.get(hint, isinstance(value, list))
    refuse_if(not good, f"{where}: expected {getattr(hint, '__name__', hint)}, got {value!r}", remedy=_HELP)
    return float(value) if hint in (float, float | None) else value


def _check_keys(table: dict[str, Any], known: set[str], where: str, prefix: str) -> None:
    for key in table:
        if key not in known:
            raise InputError(
                f"{where}: unknown key {prefix}{key}",
                remedy=did_you_mean(key, known, f"known here: {', '.join(sorted(known))}", prefix=prefix, cutoff=0.4),
            )
