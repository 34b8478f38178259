"""A DTU scan (MVSNet layout) as a record source: views to train from and views held out for scoring."""

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

from splatctrl_cli.errors import UsageError
from splatctrl_cli.io.dtu import read_dtu
from splatctrl_cli.io.output import sha256
from splatctrl_cli.records import LossReport, Record, RgbdFrame

TRAINING_CAMERA = "camera"
HOLDOUT_CAMERA = "holdout"


def view_numbers(words: Sequence[str]) -> list[int]:
    """View numbers as a person gives them, ``2`` and ``5``; raises UsageError for what is none."""
    bad = [word for word in words if not word.isdigit()]
    if bad:
        raise UsageError(f"--holdout: expected view numbers such as 2,5, got {bad[0]!r}")
    return [int(word) for word in words]


class DtuSource:
    """The views of a scan that have depth, numbered from 0 in the scan's order; their numbers are their stamps.

    The scene does not move, so there is no clock. Views whose number is in `holdout` belong to camera ``holdout``,
    the others to ``camera``.
    """

    def __init__(self, root: Path, scan: str | None = None, holdout: Collection[int] = ()) -> None:
        self._root = root
        found = read_dtu(root, scan)
        self._name, self._views, self._files = found.name, found.views, found.files
        self._holdout = frozenset(holdout)
        notes = [f"{name}: without depth, left out" for name in found.without_depth]
        self._loss = LossReport(unpaired_color=len(notes), notes=notes)
        outside = sorted(number for number in self._holdout if not 0 <= number < len(self._views))
        if outside:
            raise UsageError(
                f"--holdout {outside[0]}: {root} has no such view", remedy=f"views: 0 to {len(self._views) - 1}"
            )
        if self._holdout and len(self._holdout) == len(self._views):
            raise UsageError(f"--holdout: all {len(self._views)} views of {root} are held out", remedy="leave some")

    @property
    def name(self) -> str:
        return f"{self._root.name}/{self._name}"

    @property
    def cameras(self) -> tuple[str, ...]:
        return (TRAINING_CAMERA, HOLDOUT_CAMERA) if self._holdout else (TRAINING_CAMERA,)

    @property
    def joint_names(self) -> tuple[str, ...]:
        return ()

    @property
    def has_clock(self) -> bool:
        return False

    @property
    def loss(self) -> LossReport:
        return self._loss

    def records(self) -> Iterator[Record]:
        for number, view in enumerate(self._views):
            yield RgbdFrame(
                stamp_ns=number,
                camera=HOLDOUT_CAMERA if number in self._holdout else TRAINING_CAMERA,
                color=view.color,
                depth=view.depth,
                intrinsics=view.intrinsics,
                T_world_camera=view.T_world_camera,
            )

    def digests(self) -> dict[str, str]:
        return {str(path.relative_to(self._root)): sha256(path) for path in sorted(set(self._files))}
