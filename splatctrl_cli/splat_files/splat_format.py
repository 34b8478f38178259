"""What a format of splat files declares: how it is written and read, and how exact it is."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from splatctrl_cli.records import GaussianSet
from splatctrl_cli.splat_files.splat_differences import Differences, float32_bound

Comments = dict[str, str]


@dataclass(frozen=True, kw_only=True)
class SplatFormat:
    """One kind of file, in the ``ENTRIES`` of its module: all that the program and its docs know of it.

    `held` is what of a set it can hold, before rounding; `bound` is how far it may round; `check` raises UsageError
    where its library is not installed. `docs` are its rows in docs/artefacts.md, cells between bars, an empty line
    between rows: suffix, what it is, what it rounds to, what it does not hold.
    """

    name: str
    order: int
    suffix: str
    write: Callable[[Path, GaussianSet, Mapping[str, str]], None]
    read: Callable[[Path], tuple[GaussianSet, Comments]]
    held: Callable[[GaussianSet], GaussianSet] = lambda gaussians: gaussians
    bound: Callable[[GaussianSet], Differences] = float32_bound
    check: Callable[[], object] = lambda: None
    docs: str = ""

    @property
    def is_rounded(self) -> bool:
        """Whether it rounds to less than float32."""
        return self.bound is not float32_bound


def without_labels(gaussians: GaussianSet) -> GaussianSet:
    """`gaussians`, all of them objects."""
    return replace(gaussians, labels=np.zeros_like(gaussians.labels))
