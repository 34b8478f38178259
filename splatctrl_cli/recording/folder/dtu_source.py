"""A DTU scan (MVSNet or IDR) as training and held-out records."""

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from splatctrl_cli.errors import UsageError, refuse_if
from splatctrl_cli.evaluate.protocols import ScoreProtocol, Split
from splatctrl_cli.files.output import sha256
from splatctrl_cli.recording.folder.dtu import DtuScan, DtuView, Shrink, read_dtu
from splatctrl_cli.recording.folder.idr import idr_scans, read_idr
from splatctrl_cli.records import Bool, Intrinsics, LossReport, Record, RgbdFrame

TRAINING_CAMERA = "camera"
HOLDOUT_CAMERA = "holdout"


def view_numbers(words: Sequence[str]) -> list[int]:
    """Parse view numbers such as ``2`` and ``5``. Raises UsageError for other words."""
    bad = [word for word in words if not word.isdigit()]
    refuse_if(bad, f"--holdout: expected view numbers such as 2,5, got {''.join(bad[:1])!r}", error=UsageError)
    return [int(word) for word in words]


class DtuSource:
    """A scan's views by number (view 0 is ``rect_001``), which is also the stamp.

    The scene is static, without a clock. Views in `holdout` belong to camera ``holdout``, others to ``camera``,
    unless a `protocol` assigns or drops them. masks, depths: folders of what the layout lacks. downscale: shrink
    factor; None: to the protocol's size, if that is a whole factor. layout: ``MVSNet`` or ``IDR``; split: training
    and held-out views.
    """

    joint_names: tuple[str, ...] = ()
    has_clock = False

    def __init__(
        self,
        root: Path,
        scan: str | None = None,
        holdout: Collection[int] = (),
        *,
        protocol: ScoreProtocol | None = None,
        masks: Path | None = None,
        depths: Path | None = None,
        downscale: int | None = None,
    ) -> None:
        self.layout = "IDR" if not (root / "Rectified").is_dir() and idr_scans(root) else "MVSNet"
        self._root = root
        found = self._read(
            scan,
            masks,
            depths,
            lambda view: shrink_view(view, _factor(view, protocol) if downscale is None else downscale),
        )
        self.scan, self.name = found.name, f"{root.name}/{found.name}"
        self._files = found.files
        self._views = dict(zip(found.numbers, found.views, strict=True))
        numbers = tuple(self._views)
        if protocol is not None:
            refuse_if(
                holdout,
                "--holdout: the protocol says what is held out",
                remedy="leave one of them out",
                error=UsageError,
            )
            self.split = protocol.split(numbers, f"{root}/{found.name}")
        else:
            self.split = _held_out(numbers, frozenset(holdout), root)
        self._held = set(self.split.scored) - set(self.split.training)
        self.cameras = (TRAINING_CAMERA, HOLDOUT_CAMERA) if self._held else (TRAINING_CAMERA,)
        is_left_out = self.layout == "MVSNet"
        notes = [f"{name}: without depth{', left out' if is_left_out else ''}" for name in found.without_depth]
        self.loss = LossReport(unpaired_color=len(notes), notes=notes)

    def _read(self, scan: str | None, masks: Path | None, depths: Path | None, shrink: Shrink) -> DtuScan:
        if self.layout == "MVSNet":
            refuse_if(
                depths is not None,
                f"--depths {depths}: MVSNet's layout has its own",
                remedy="leave it out",
                error=UsageError,
            )
            return read_dtu(self._root, scan, masks, shrink)
        refuse_if(
            masks is not None, f"--masks {masks}: IDR's layout has its own", remedy="leave it out", error=UsageError
        )
        return read_idr(self._root, scan, depths, shrink)

    @property
    def has_depth(self) -> bool:
        return any(bool((view.depth > 0).any()) for view in self._views.values())

    def mask(self, number: int) -> Bool | None:
        """(H, W) True on the object; None if unknown."""
        return self._views[number].mask

    def records(self) -> Iterator[Record]:
        left_out = set(self.split.left_out)
        for number, view in self._views.items():
            if number in left_out:
                continue
            yield RgbdFrame(
                stamp_ns=number,
                camera=HOLDOUT_CAMERA if number in self._held else TRAINING_CAMERA,
                color=view.color,
                depth=view.depth,
                intrinsics=view.intrinsics,
                T_world_camera=view.T_world_camera,
            )

    def digests(self) -> dict[str, str]:
        return {
            str(path.relative_to(self._root) if path.is_relative_to(self._root) else path): sha256(path)
            for path in sorted(set(self._files))
        }


def shrink_view(view: DtuView, factor: int) -> DtuView:
    """Merge every `factor` x `factor` pixels: mean colour, the middle's depth, the first's mask.

    Colour and mask follow RegNeRF (regnerf/internal/datasets.py, downsample). Pixel (0, 0) has its centre at (0, 0):
    u becomes (u + 0.5) / factor - 0.5. Raises UsageError for a factor that does not divide the size.
    """
    k = view.intrinsics
    refuse_if(
        factor < 1 or k.width % factor or k.height % factor,
        f"--downscale {factor}: expected a whole factor of {k.width}x{k.height}",
        error=UsageError,
    )
    if factor == 1:
        return view
    size = (k.width // factor, k.height // factor)
    sample = slice(factor // 2, None, factor)
    return DtuView(
        name=view.name,
        color=np.asarray(cv2.resize(view.color, size, interpolation=cv2.INTER_AREA), np.uint8),
        depth=np.ascontiguousarray(view.depth[sample, sample]),
        intrinsics=Intrinsics(
            fx=k.fx / factor,
            fy=k.fy / factor,
            cx=(k.cx + 0.5) / factor - 0.5,
            cy=(k.cy + 0.5) / factor - 0.5,
            width=size[0],
            height=size[1],
        ),
        T_world_camera=view.T_world_camera,
        mask=None if view.mask is None else np.ascontiguousarray(view.mask[::factor, ::factor]),
    )


def _factor(view: DtuView, protocol: ScoreProtocol | None) -> int:
    """Shrink factor to the protocol's published size; 1 if not whole."""
    if protocol is None or protocol.size is None:
        return 1
    width, height = protocol.size
    factor = view.intrinsics.width // width
    is_whole = factor >= 1 and (view.intrinsics.width, view.intrinsics.height) == (factor * width, factor * height)
    return factor if is_whole else 1


def _held_out(numbers: tuple[int, ...], holdout: frozenset[int], root: Path) -> Split:
    outside = sorted(holdout - set(numbers))
    refuse_if(
        outside,
        f"--holdout {min(outside, default=0)}: {root} has no such view",
        remedy=f"views: {_span(numbers)}",
        error=UsageError,
    )
    refuse_if(
        holdout and len(holdout) == len(numbers),
        f"--holdout: all {len(numbers)} views of {root} are held out",
        remedy="leave some",
        error=UsageError,
    )
    return Split(training=tuple(n for n in numbers if n not in holdout), scored=tuple(sorted(holdout)))


def _span(numbers: tuple[int, ...]) -> str:
    is_whole = numbers == tuple(range(numbers[0], numbers[-1] + 1))
    return f"{numbers[0]} to {numbers[-1]}" if is_whole else ", ".join(map(str, numbers))
