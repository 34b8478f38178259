"""Which views of a scan train a scene and which score it, by the names under which published figures are compared.

Views are numbered from 0: view 0 is ``rect_001`` of DTU.
"""

import difflib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from splatctrl_cli.errors import InputError, UsageError

MaskRule = Literal["given", "object", "depth"]
EVERY = 8
REGNERF_INPUTS = (25, 22, 28, 40, 44, 48, 0, 8, 13)  # the first 3, 6 or 9 train
REGNERF_EXCLUDED = (3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 36, 37, 38, 39)
REGNERF_SCANS = (8, 21, 30, 31, 34, 38, 40, 41, 45, 55, 63, 82, 103, 110, 114)
MVSNERF_TRAINING = (25, 21, 33, 22, 14, 15, 26, 30, 31, 35, 34, 43, 46, 29, 16, 36)
MVSNERF_SCORED = (32, 24, 23, 44)
MVSNERF_SCANS = (1, 8, 21, 103, 114)
SURFACE_SCANS = (24, 37, 40, 55, 63, 65, 69, 83, 97, 105, 106, 110, 114, 118, 122)  # those IDR has masks for
DTU_VIEWS = 49
NAMES = ("dtu-train", "dtu-holdout8", "regnerf-3", "regnerf-6", "regnerf-9", "mvsnerf", "holdout:RULE")
RULES = "expected holdout:everyN, holdout:everyN+FIRST or holdout:2,5"


@dataclass(frozen=True, kw_only=True)
class Split:
    """View numbers: those that train, those that are scored, and those that neither may touch."""

    training: tuple[int, ...]
    scored: tuple[int, ...]
    left_out: tuple[int, ...] = ()

    def words(self) -> str:
        """``train 0, 1, 3; score 2; leave out 4``."""
        parts = [f"train {_ranges(self.training)}", f"score {_ranges(self.scored)}"]
        return "; ".join(parts + ([f"leave out {_ranges(self.left_out)}"] if self.left_out else []))


@dataclass(frozen=True, kw_only=True)
class ScoreProtocol:
    """What a name fixes.

    mask: what of a view counts in the published figure: the pixels of a mask where one is given, those of the object
    (a mask has to be given), or those with a reference depth. fill: colour outside the mask in the published SSIM;
    is_zero_padded: without a mask that has zeros beyond the image's border.
    size: width and height [px] of the published figures. scans: of DTU, in the published mean. Empty training and
    scored views say that a rule splits the views.
    """

    name: str
    source: str
    mask: MaskRule = "given"
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
        """Whether the views that are scored are those that trained."""
        return not (self.scored or self.every)

    def split(self, numbers: Sequence[int], where: str) -> Split:
        """The views `numbers` of a scan, named `where`, by this protocol.

        Views that it does not name are left out. Raises InputError where views that it names are missing.
        """
        if self.scores_training:
            return Split(training=tuple(numbers), scored=tuple(numbers))
        if self.every:
            scored = tuple(n for i, n in enumerate(numbers) if i % self.every == self.first)
        else:
            missing = sorted(set(self.training + self.scored) - set(numbers))
            if missing:
                raise InputError(
                    f"{where}: protocol {self.name}: expected views {_ranges(self.training + self.scored)}, got no "
                    f"view {_ranges(missing)}",
                    remedy=f"the scan has views {_ranges(numbers)}; give a protocol for it, such as dtu-holdout8",
                )
            scored = self.scored
        training = self.training or tuple(n for n in numbers if n not in scored)
        if not scored or not training:
            raise InputError(
                f"{where}: protocol {self.name}: expected views to train and views to score, got {len(training)} and "
                f"{len(scored)} of {len(numbers)} views",
                remedy="give another holdout rule",
            )
        used = {*training, *scored}
        return Split(training=training, scored=scored, left_out=tuple(n for n in numbers if n not in used))


def score_protocol(name: str) -> ScoreProtocol:
    """The protocol of that name. Raises UsageError with the choices.

    dtu-train: every view trains and is scored, as surface methods print it (2D Gaussian splatting, repository
    hbb1/2d-gaussian-splatting, thread 13: DTU has no test views; its scans by scripts/dtu_eval.py). dtu-holdout8:
    every 8th view from the first on is scored (graphdeco-inria/gaussian-splatting, scene/dataset_readers.py,
    ``llffhold = 8``). regnerf-N: the first N of nine input views, 25 scored, 15 left out (google-research/
    google-research, regnerf/internal/datasets.py, class DTU, split 'pixelnerf'; figures over the object,
    regnerf/eval.py, 400x300 by ``factor = 4`` of regnerf/configs). mvsnerf: 16 views train, four are scored, pixels
    without reference depth left out (apchenstu/mvsnerf, data/dtu_ft.py and renderer.ipynb; the numbers of its
    configs/pairs.th as autonomousvision/murf, datasets/dtu.py, writes them out).
    """
    if name == "dtu-train":
        return ScoreProtocol(
            name=name,
            scans=SURFACE_SCANS,
            is_zero_padded=True,
            source="every view trains and is scored: DTU has no test views (hbb1/2d-gaussian-splatting, thread 13)",
        )
    if name == "dtu-holdout8":
        return ScoreProtocol(
            name=name,
            every=EVERY,
            is_zero_padded=True,
            source="every 8th view from view 0 on (graphdeco-inria/gaussian-splatting, scene/dataset_readers.py)",
        )
    if name == "mvsnerf":
        return ScoreProtocol(
            name=name,
            mask="depth",
            size=(640, 512),
            scans=MVSNERF_SCANS,
            training=MVSNERF_TRAINING,
            scored=MVSNERF_SCORED,
            source="apchenstu/mvsnerf, data/dtu_ft.py, renderer.ipynb, configs/pairs.th",
        )
    if name in ("regnerf-3", "regnerf-6", "regnerf-9"):
        return _regnerf(name)
    if name.startswith("holdout:"):
        return _holdout(name)
    near = difflib.get_close_matches(name, NAMES, n=1)
    choice = f"did you mean {near[0]}?" if near else "use one of: " + ", ".join(NAMES)
    raise UsageError(f"--protocol {name}: unknown", remedy=choice)


def _regnerf(name: str) -> ScoreProtocol:
    unused = {*REGNERF_INPUTS, *REGNERF_EXCLUDED}
    return ScoreProtocol(
        name=name,
        mask="object",
        fill=1.0,
        size=(400, 300),
        scans=REGNERF_SCANS,
        training=REGNERF_INPUTS[: int(name[-1])],
        scored=tuple(n for n in range(DTU_VIEWS) if n not in unused),
        source="google-research/google-research, regnerf/internal/datasets.py, regnerf/eval.py",
    )


def _holdout(name: str) -> ScoreProtocol:
    rule = name.removeprefix("holdout:")
    source = "a rule given by hand"
    every = re.fullmatch(r"every(\d+)(?:\+(\d+))?", rule)
    if every:
        step, first = int(every[1]), int(every[2] or 0)
        if step < 2 or first >= step:
            raise UsageError(
                f"--protocol {name}: expected every N of at least 2 and FIRST below N, got {step} and {first}",
                remedy="holdout:every8 scores views 0, 8, 16, ..., and holdout:every8+4 views 4, 12, ...",
            )
        return ScoreProtocol(name=name, every=step, first=first, source=source)
    if re.fullmatch(r"\d+(,\d+)*", rule):
        scored = tuple(sorted({int(word) for word in rule.split(",")}))
        return ScoreProtocol(name=name, scored=scored, source=source)
    raise UsageError(f"--protocol {name}: {RULES}", remedy="such as holdout:every8")


def _ranges(numbers: Sequence[int]) -> str:
    """``0-3, 7``: in order."""
    runs: list[list[int]] = []
    for number in sorted(set(numbers)):
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    parts = [str(r[0]) if len(r) == 1 else f"{r[0]}-{r[-1]}" for r in runs]
    return ", ".join(parts) or "none"
