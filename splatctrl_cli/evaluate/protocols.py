"""DTU's scoring protocols, for published figures: view splits, and where points count.

Views are numbered from 0: view 0 is ``rect_001`` of DTU.

ObsMaskN_10.mat and PlaneN.mat of DTU's ObsMask folder, in millimetres, define where points count. ObsMask (X, Y, Z)
marks cells, Res wide, of the box BB (2, 3) that the reference scanner observed. Reference points count above the
ground, at ``P (4) . (x, y, z, 1) > 0`` (DTU's PointCompareMain.m; jzhangbs/DTUeval-python, eval.py).
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from splatctrl_cli.errors import InputError, UsageError, did_you_mean, refuse_if, require
from splatctrl_cli.libraries import scipy_io
from splatctrl_cli.records import MILLIMETRES, Bool, Float64

REGNERF_INPUTS = (25, 22, 28, 40, 44, 48, 0, 8, 13)  # the first 3, 6 or 9 train
SURFACE_SCANS = (24, 37, 40, 55, 63, 65, 69, 83, 97, 105, 106, 110, 114, 118, 122)  # those IDR has masks for
BEFORE, BEYOND = 0.060, 0.120  # [m] outside the box within which points are kept (eval.py: patch_size, twice that)


@dataclass(frozen=True, kw_only=True)
class Split:
    """View numbers for training, for scoring, and left out of both."""

    training: tuple[int, ...]
    scored: tuple[int, ...]
    left_out: tuple[int, ...] = ()

    def words(self) -> str:
        """``train 0, 1, 3; score 2; leave out 4``."""
        parts = [f"train {_ranges(self.training)}", f"score {_ranges(self.scored)}"]
        return "; ".join(parts + ([f"leave out {_ranges(self.left_out)}"] if self.left_out else []))


@dataclass(frozen=True, kw_only=True)
class ScoreProtocol:
    """A named scoring protocol.

    mask: pixels of the published figure: of a given mask, of the object, or with reference depth. fill: grey outside
    the mask in the published SSIM; is_zero_padded: without a mask, that SSIM has zeros beyond the border. size
    (width, height) [px], scans: as published. Without `scored`, every `every`-th view from `first` on is scored; with
    `every` 0, all views are scored and train. Without `training`, views that are not scored train.
    """

    name: str
    source: str
    mask: Literal["given", "object", "depth"] = "given"
    fill: float = 0.0
    is_zero_padded: bool = False
    size: tuple[int, int] | None = None
    scans: tuple[int, ...] = ()
    training: tuple[int, ...] = ()
    scored: tuple[int, ...] = ()
    every: int = 0
    first: int = 0

    @property
    def scores_training(self) -> bool:
        return not (self.scored or self.every)

    def split(self, numbers: Sequence[int], where: str) -> Split:
        """Split the views `numbers` of a scan, named `where` in errors.

        Raises InputError if named views are missing, or if none train or are scored.
        """
        if self.scores_training:
            return Split(training=tuple(numbers), scored=tuple(numbers))
        if self.every:
            scored = tuple(n for i, n in enumerate(numbers) if i % self.every == self.first)
        else:
            if missing := sorted(set(self.training + self.scored) - set(numbers)):
                raise InputError(
                    f"{where}: protocol {self.name}: expected views {_ranges(self.training + self.scored)}, got no "
                    f"view {_ranges(missing)}",
                    remedy=f"the scan has views {_ranges(numbers)}; give a protocol for it, such as dtu-holdout8",
                )
            scored = self.scored
        training = self.training or tuple(n for n in numbers if n not in scored)
        refuse_if(
            not scored or not training,
            f"{where}: protocol {self.name}: expected views to train and views to score, got {len(training)} and "
            f"{len(scored)} of {len(numbers)} views",
            remedy="give another holdout rule",
        )
        used = {*training, *scored}
        return Split(training=training, scored=scored, left_out=tuple(n for n in numbers if n not in used))


def _regnerf(num_training: int) -> ScoreProtocol:
    """The first N of nine input views train, 25 are scored, the others left out.

    google-research/google-research, regnerf/internal/datasets.py, class DTU, split 'pixelnerf'; figures over the
    object (regnerf/eval.py), 400x300 by ``factor = 4`` of regnerf/configs.
    """
    unused = {*REGNERF_INPUTS, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 36, 37, 38, 39}
    return ScoreProtocol(
        name=f"regnerf-{num_training}",
        mask="object",
        fill=1.0,
        size=(400, 300),
        scans=(8, 21, 30, 31, 34, 38, 40, 41, 45, 55, 63, 82, 103, 110, 114),
        training=REGNERF_INPUTS[:num_training],
        scored=tuple(n for n in range(49) if n not in unused),
        source="google-research/google-research, regnerf/internal/datasets.py, regnerf/eval.py",
    )


_FIXED = (
    ScoreProtocol(  # as surface methods print it (scripts/dtu_eval.py)
        name="dtu-train",
        scans=SURFACE_SCANS,
        is_zero_padded=True,
        source="every view trains and is scored: DTU has no test views (hbb1/2d-gaussian-splatting, thread 13)",
    ),
    ScoreProtocol(  # ``llffhold = 8``
        name="dtu-holdout8",
        every=8,
        is_zero_padded=True,
        source="every 8th view from view 0 on (graphdeco-inria/gaussian-splatting, scene/dataset_readers.py)",
    ),
    *(_regnerf(num_training) for num_training in (3, 6, 9)),
    ScoreProtocol(  # the views of its configs/pairs.th as autonomousvision/murf, datasets/dtu.py, writes them out
        name="mvsnerf",
        mask="depth",
        size=(640, 512),
        scans=(1, 8, 21, 103, 114),
        training=(25, 21, 33, 22, 14, 15, 26, 30, 31, 35, 34, 43, 46, 29, 16, 36),
        scored=(32, 24, 23, 44),
        source="apchenstu/mvsnerf, data/dtu_ft.py, renderer.ipynb, configs/pairs.th",
    ),
)
PROTOCOLS = {protocol.name: protocol for protocol in _FIXED}


def score_protocol(name: str) -> ScoreProtocol:
    """The protocol of a name or ``holdout:`` rule. Raises UsageError, with the choices, for others."""
    if name.startswith("holdout:"):
        return _holdout(name)
    if name in PROTOCOLS:
        return PROTOCOLS[name]
    choices = (*PROTOCOLS, "holdout:RULE")
    raise UsageError(
        f"--protocol {name}: unknown", remedy=did_you_mean(name, choices, f"use one of: {', '.join(choices)}")
    )


def _holdout(name: str) -> ScoreProtocol:
    rule = name.removeprefix("holdout:")
    source = "a rule given by hand"
    every = re.fullmatch(r"every(\d+)(?:\+(\d+))?", rule)
    if every:
        step, first = int(every[1]), int(every[2] or 0)
        refuse_if(
            step < 2 or first >= step,
            f"--protocol {name}: expected every N of at least 2 and FIRST below N, got {step} and {first}",
            remedy="holdout:every8 scores views 0, 8, 16, ..., and holdout:every8+4 views 4, 12, ...",
            error=UsageError,
        )
        return ScoreProtocol(name=name, every=step, first=first, source=source)
    if re.fullmatch(r"\d+(,\d+)*", rule):
        return ScoreProtocol(name=name, scored=tuple(sorted({int(word) for word in rule.split(",")})), source=source)
    raise UsageError(
        f"--protocol {name}: expected holdout:everyN, holdout:everyN+FIRST or holdout:2,5",
        remedy="such as holdout:every8",
    )


def _ranges(numbers: Sequence[int]) -> str:
    runs: list[list[int]] = []
    for number in sorted(set(numbers)):
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ", ".join(str(r[0]) if len(r) == 1 else f"{r[0]}-{r[-1]}" for r in runs) or "none"


@dataclass(frozen=True, kw_only=True)
class ObservedSpace:
    """Observed cells (X, Y, Z), `resolution` [m] wide, of a box `low` to `high` [m].

    plane (4,): ``plane . (x, y, z, 1) > 0`` is above the ground [m].
    """

    is_observed: Bool
    low: Float64
    high: Float64
    resolution: float
    plane: Float64

    def near(self, points: Float64) -> Bool:
        """(Q,) True for points (Q, 3) [m] in or near the box, which are compared."""
        return np.asarray(((points >= self.low - BEFORE) & (points < self.high + BEYOND)).all(axis=1))

    def observed(self, points: Float64) -> Bool:
        """(Q,) True for points (Q, 3) [m] in observed cells, which count in the accuracy."""
        cells = np.rint((points - self.low) / self.resolution).astype(np.int64)
        inside = np.flatnonzero(((cells >= 0) & (cells < self.is_observed.shape)).all(axis=1))
        observed = np.zeros(len(points), np.bool_)
        observed[inside] = self.is_observed[tuple(cells[inside].T)]
        return observed

    def above(self, points: Float64) -> Bool:
        """(Q,) True for points (Q, 3) [m] above the ground, which count in the completeness."""
        return np.asarray(points @ self.plane[:3] + self.plane[3] > 0)


def scan_number(scan: str) -> int:
    """24 for ``scan24``. Raises InputError without a number."""
    number = re.search(r"\d+$", scan)
    return int(require(number, f"scan '{scan}': expected a name with DTU's number, such as scan24")[0])


def cloud_of_scan(folder: Path, scan: str) -> Path:
    """Path of ``scan24.ply`` or ``stl024_total.ply``. Raises InputError without either."""
    names = [f"{scan}.ply"] + ([f"stl{scan_number(scan):03d}_total.ply"] if scan[-1:].isdigit() else [])
    for name in names:
        if (folder / name).is_file():
            return folder / name
    raise InputError(f"{folder}: expected the points of {scan}, {' or '.join(names)}, got neither")


def read_observed(folder: Path, scan: str) -> ObservedSpace:
    """A scan's observed space. Raises InputError naming the file."""
    number = scan_number(scan)
    path, plane_path = folder / f"ObsMask{number}_10.mat", folder / f"Plane{number}.mat"
    box, resolution = _array(path, "BB", 6).reshape(2, 3), float(_array(path, "Res", 1)[0])
    mask = np.asarray(_variable(path, "ObsMask")) != 0
    refuse_if(
        mask.ndim != 3 or not resolution > 0 or not (box[1] > box[0]).all(),
        f"{path}: expected ObsMask (X, Y, Z), a box BB and a width Res above 0, got {mask.shape}, {box.tolist()}"
        f" and {resolution:g}",
    )
    return ObservedSpace(
        is_observed=mask,
        low=box[0] / MILLIMETRES,
        high=box[1] / MILLIMETRES,
        resolution=resolution / MILLIMETRES,
        plane=_array(plane_path, "P", 4) * [1.0, 1.0, 1.0, 1.0 / MILLIMETRES],
    )


def _array(path: Path, name: str, size: int) -> Float64:
    values = np.asarray(_variable(path, name), np.float64).ravel()
    refuse_if(
        values.size != size or not np.isfinite(values).all(),
        f"{path}: {name}: expected {size} numbers, got {values.size}",
    )
    return values


def _variable(path: Path, name: str) -> Any:
    refuse_if(not path.is_file(), f"{path}: no such file", remedy="give the folder ObsMask of DTU's SampleSet")
    try:
        return scipy_io.loadmat(path, variable_names=[name])[name]
    except KeyError:
        raise InputError(f"{path}: expected a variable {name}, got none") from None
    except Exception as error:  # scipy raises many kinds for a file that is not a .mat
        raise InputError(f"{path}: not a MATLAB file that can be read: {error}") from None
