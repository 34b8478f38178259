"""The distance grid formats by ``sdf-bake --formats`` name."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from splatctrl_cli.errors import UsageError, refuse_if
from splatctrl_cli.formats.grid.grid_format import STEM, GridFormat
from splatctrl_cli.libraries import entries_of
from splatctrl_cli.records import DistanceGrid

FORMATS: Mapping[str, GridFormat] = {kind.name: kind for kind in entries_of(__package__, GridFormat)}


def check_formats(names: Sequence[str], channels: Collection[str], *, unknown: str = "free") -> None:
    """Raise UsageError if `write_grid` would fail for `names`.

    unknown: the policy; ``nan`` leaves cells without a distance.
    """
    strange = [name for name in names if name not in FORMATS]
    refuse_if(
        strange or not names,
        f"formats: expected some of {', '.join(FORMATS)}, got {', '.join(strange) or 'none'}",
        error=UsageError,
    )
    for name in names:
        kind = FORMATS[name]
        refuse_if(
            not kind.needs & set(channels),
            f"format {name}: expected one of the channels {', '.join(sorted(kind.needs))}, got {', '.join(channels)}",
            remedy="bake it too, or leave the format out",
            error=UsageError,
        )
        refuse_if(
            unknown == "nan" and not kind.holds_unknown,
            f"format {name}: cannot hold cells without a distance",
            remedy="bake with field.unknown=obstacle or free, or leave the format out",
            error=UsageError,
        )
        kind.check()


def write_grid(folder: Path, grid: DistanceGrid, names: Sequence[str]) -> tuple[Path, ...]:
    """Write the grid in the formats `names` into `folder`; return the files.

    Only vdb needs whole channels in memory. Raises UsageError as `check_formats`, NotEvaluableError without a
    surface.
    """
    check_formats(names, grid.channels)
    kinds = [FORMATS[name] for name in dict.fromkeys(names)]
    for kind in kinds:
        kind.write(folder / f"{STEM}{kind.suffix}", grid)
    return tuple(folder / file for kind in kinds for file in kind.files(grid.channels))
