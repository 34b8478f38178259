"""The files in which a baked distance grid can be written, by the name that ``sdf-bake --formats`` takes."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.grid_files.curobo_grid import VERSIONS as CUROBO_VERSIONS
from splatctrl_cli.grid_files.curobo_grid import write_curobo
from splatctrl_cli.grid_files.grid import read_npz, write_npz
from splatctrl_cli.grid_files.iso_surface import iso_surface, write_surface
from splatctrl_cli.grid_files.moveit_field import write_moveit
from splatctrl_cli.grid_files.nrrd import write_nrrd
from splatctrl_cli.grid_files.vdb import openvdb, write_vdb
from splatctrl_cli.grid_files.vti import read_vti, write_vti
from splatctrl_cli.records import DistanceGrid

STEM = "field"


@dataclass(frozen=True, kw_only=True)
class GridOptions:
    """What some formats leave open: level [m] of the surface, the cuRobo that reads, the distance that it gets."""

    level: float = 0.0
    curobo_version: str = CUROBO_VERSIONS[0]
    curobo_channel: str = "sdf"


@dataclass(frozen=True, kw_only=True)
class GridFormat:
    """One kind of file: `files` names those it writes of some channels, `write` writes them into a folder.

    `needs` are channels of which the grid must have one; `holds_unknown` is whether cells that are NaN can be told;
    `check` raises UsageError where what writes it is not installed.
    """

    title: str
    files: Callable[[Collection[str]], tuple[str, ...]]
    write: Callable[[Path, DistanceGrid, GridOptions], None]
    needs: frozenset[str] = frozenset({"sdf"})
    holds_unknown: bool = True
    check: Callable[[], object] = lambda: None


def check_formats(names: Sequence[str], channels: Collection[str], *, unknown: str = "free") -> None:
    """Raise UsageError where `write_grid` could not write one of `names`: to be asked before a bake that takes long.

    `unknown` is the policy on unknown space, which blanks cells where it is ``nan``.
    """
    strange = [name for name in names if name not in FORMATS]
    if strange or not names:
        raise UsageError(f"formats: expected some of {', '.join(FORMATS)}, got {', '.join(strange) or 'none'}")
    for name in names:
        kind = FORMATS[name]
        if not kind.needs & set(channels):
            raise UsageError(
                f"format {name}: expected one of the channels {', '.join(sorted(kind.needs))}, "
                f"got {', '.join(channels)}",
                remedy="bake it too, or leave the format out",
            )
        if unknown == "nan" and not kind.holds_unknown:
            raise UsageError(
                f"format {name}: cannot hold cells without a distance",
                remedy="bake with field.unknown=obstacle or free, or leave the format out",
            )
        kind.check()


def write_grid(
    folder: Path, grid: DistanceGrid, names: Sequence[str], options: GridOptions | None = None
) -> tuple[Path, ...]:
    """Write the grid in each of the formats `names` into `folder`, and return the files.

    Channels may be memory maps: none is held in memory whole (but for vdb). Raises as `check_formats`
    does, and NotEvaluableError where a surface is asked for that the grid does not have.
    """
    check_formats(names, grid.channels)
    written: list[Path] = []
    for name in dict.fromkeys(names):
        FORMATS[name].write(folder, grid, options or GridOptions())
        written += [folder / file for file in FORMATS[name].files(grid.channels)]
    return tuple(written)


def read_grid(path: Path) -> DistanceGrid:
    """The grid of a ``.npz`` or ``.vti`` that `write_grid` wrote. Raises InputError for any other file."""
    readers = {".npz": read_npz, ".vti": read_vti}
    if path.suffix not in readers:
        raise InputError(
            f"{path}: expected a distance grid to read, {' or '.join(readers)}, got {path.suffix or 'no suffix'}",
            remedy="give the field.npz of the bake",
        )
    return readers[path.suffix](path)


def _one(suffix: str) -> Callable[[Collection[str]], tuple[str, ...]]:
    return lambda _: (STEM + suffix,)


def _surface(suffix: str) -> GridFormat:
    def write(folder: Path, grid: DistanceGrid, options: GridOptions) -> None:
        write_surface(folder / f"{STEM}{suffix}", iso_surface(grid, options.level))

    return GridFormat(title=f"surface of sdf, {suffix}", files=_one(suffix), write=write)


def _write_nrrd(folder: Path, grid: DistanceGrid, _options: GridOptions) -> None:
    for channel in grid.channels:
        write_nrrd(folder / f"{STEM}.{channel}.nrrd", grid, channel)


def _write_curobo(folder: Path, grid: DistanceGrid, options: GridOptions) -> None:
    path = folder / f"{STEM}.curobo.npz"
    write_curobo(path, grid, version=options.curobo_version, channel=options.curobo_channel)


FORMATS: Mapping[str, GridFormat] = {
    "npz": GridFormat(
        title="arrays of NumPy",
        files=_one(".npz"),
        write=lambda folder, grid, _: write_npz(folder / "field.npz", grid),
    ),
    "vti": GridFormat(
        title="ParaView image data",
        files=_one(".vti"),
        write=lambda folder, grid, _: write_vti(folder / "field.vti", grid),
    ),
    "nrrd": GridFormat(
        title="NRRD, a file a channel",
        files=lambda channels: tuple(f"{STEM}.{channel}.nrrd" for channel in channels),
        write=_write_nrrd,
    ),
    "vdb": GridFormat(
        title="OpenVDB",
        files=_one(".vdb"),
        write=lambda folder, grid, _: write_vdb(folder / "field.vdb", grid),
        check=openvdb,
    ),
    "curobo": GridFormat(
        title="cuRobo voxel grid", files=_one(".curobo.npz"), write=_write_curobo, holds_unknown=False
    ),
    "moveit": GridFormat(
        title="MoveIt distance field stream",
        files=_one(".moveit"),
        write=lambda folder, grid, _: write_moveit(folder / "field.moveit", grid),
        needs=frozenset({"bound", "hard"}),
    ),
    "ply": _surface(".ply"),
    "obj": _surface(".obj"),
    "stl": _surface(".stl"),
}
