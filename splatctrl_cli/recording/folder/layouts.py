"""Dataset layouts known by their own files, without a description."""

from pathlib import Path

from splatctrl_cli.errors import InputError
from splatctrl_cli.files.summary import names_in
from splatctrl_cli.libraries import entries_of
from splatctrl_cli.recording.capture.capture_writer import check_not_partial
from splatctrl_cli.recording.container.log_formats import SUFFIXES, is_bag_folder
from splatctrl_cli.recording.folder.idr import idr_scans
from splatctrl_cli.recording.folder.image_folder import ImageFolderSource
from splatctrl_cli.recording.folder.layout import Layout, images_of
from splatctrl_cli.recording.source_options import SourceOptions

_COLORS = ("images", "image", "rgb", "color")  # where folders of colour alone keep it
_MOST_LOOKED_AT, _MOST_NAMED = 200, 8  # things in a folder that is not itself one

LAYOUTS = entries_of(__package__, Layout)


def layout_of(path: Path) -> Layout | None:
    if path.is_file():
        return next((layout for layout in LAYOUTS if layout.suffix == path.suffix.lower() != ""), None)
    return next((layout for layout in LAYOUTS if layout.matches(path)), None)


def has_views(path: Path) -> bool:
    """True for a folder that is no ROS 2 bag, or a file with a layout."""
    return layout_of(path) is not None if path.is_file() else path.is_dir() and not is_bag_folder(path)


def open_layout(folder: Path, options: SourceOptions) -> ImageFolderSource:
    """Open a dataset's folder. Raises InputError for an unknown layout."""
    check_not_partial(folder)
    layout = layout_of(folder)
    if layout is None and ((folder / "Rectified").is_dir() or idr_scans(folder)):
        raise InputError(
            f"{folder}: a DTU data set, which only reconstruct and score read",
            remedy='give it as --dtu (in a suite dtu = "{recording}")',
        )
    if layout is None:
        names = ", ".join(known.name for known in LAYOUTS)
        raise unknown_folder(
            folder,
            f"a folder that is neither a capture nor a ROS 2 bag, nor laid out as {names}",
            "give the capture, the bag, one scene of the dataset, or a .toml for images (splatctrl help input)",
        )
    options.refuse(("root",), f"a folder laid out as {layout.name}", folder)
    return ImageFolderSource(folder, options, layout.read(folder, options))


def unknown_folder(folder: Path, what: str, remedy: str) -> InputError:
    """The error for a folder that is not read: it names readable parts, else missing depth."""
    inside = _readable_in(folder)
    if not inside and (found := _bare_images(folder)):
        return InputError(
            f"{folder}: {found}",
            remedy="describe colour, depth, lens and poses in a .toml (splatctrl help input); info, score and"
            " reconstruct --points CLOUD.ply work without depth, but not without poses: a transforms.json"
            " (ns-process-data writes it)",
        )
    return InputError(f"{folder}: {what}", remedy=f"give one that is in it: {inside}" if inside else remedy)


def _bare_images(folder: Path) -> str:
    """Words for missing depth in a folder of colour; "" without images."""
    num = max(len(images_of(place)) for place in (folder, *(folder / name for name in _COLORS)) if place.is_dir())
    is_colmap = any((folder / place).exists() for place in ("sparse", "images.bin", "images.txt"))
    return f"depth is missing: images{' of a COLMAP model' if is_colmap else ''} alone ({num})" if num else ""


def _readable_in(folder: Path) -> str:
    """Names of readable parts, or ""."""
    found = []
    for name in names_in(folder)[:_MOST_LOOKED_AT]:
        path = folder / name
        if path.is_file() and (path.suffix in SUFFIXES or layout_of(path) is not None):
            found.append(path.name)
        elif path.is_dir() and (layout := layout_of(path)) is not None:
            found.append(f"{path.name} ({layout.name})")
        elif path.is_dir() and (path / "metadata.yaml").is_file():
            found.append(f"{path.name} (ROS 2 bag)")
        elif path.is_dir() and (path / "capture.json").is_file():
            found.append(f"{path.name} (capture)")
    return ", ".join(found[:_MOST_NAMED]) + (
        f" and {len(found) - _MOST_NAMED} more" if len(found) > _MOST_NAMED else ""
    )
