"""What speaks against a score: masks turned inside out, views that trained, pictures that belong to other poses."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.config.fixed import OTHER_VIEW_CLEARLY, SAME_PLACE_DEGREES, SAME_PLACE_METRES
from splatctrl_cli.errors import InputError
from splatctrl_cli.evaluate.views import View
from splatctrl_cli.geometry import invert_transform
from splatctrl_cli.records import Bool, Float64

THUMBNAIL = (16, 12)  # pixels


@dataclass(kw_only=True)
class Doubts:
    """Gathers what is odd while views are scored.

    is_still: nothing moves, so that every view has its one picture; may_train: views that trained are scored on
    purpose.
    """

    is_still: bool
    may_train: bool = False
    mask_rule: str = "none"
    _names: list[str] = field(default_factory=list)
    _photos: list[Float64] = field(default_factory=list)
    _renders: list[Float64] = field(default_factory=list)
    _masks: list[str] = field(default_factory=list)
    _twins: list[str] = field(default_factory=list)

    def look(self, view: View, render: NDArray[np.floating], mask: Bool | None) -> None:
        """Take in a view, its render (H, W, 3) in [0, 1] and the pixels (H, W) of its mask.

        Raises InputError for a mask without a pixel: the mean would be over other views than the protocol's.
        """
        if mask is not None and not mask.any():
            raise InputError(
                f"{view.name}: mask rule '{self.mask_rule}': expected pixels to score, got none of {mask.size}",
                remedy="the masks have to be this scan's, 255 on the object",
            )
        if mask is not None and self.mask_rule == "object mask":
            self._masks += [f"{view.name} {doubt}"] if (doubt := _mask_doubt(mask)) else []
        if not self.is_still:
            return
        self._twins += [] if self.may_train else _twin(view)
        self._names.append(view.name)
        self._photos.append(_thumbnail(view.frame.color / 255.0))
        self._renders.append(_thumbnail(np.clip(render, 0.0, 1.0)))

    def lines(self) -> list[str]:
        """Each doubt in words, with its figure and what to look at."""
        lines = []
        if self._masks:
            lines.append(
                f"{self._masks[0]}{_and_more(self._masks)}: is the mask turned inside out? it has to be 255 on the"
                " object and 0 around it"
            )
        if self._twins:
            lines.append(
                f"{self._twins[0]}{_and_more(self._twins)}: a view that trained says nothing about others; is a view"
                " there twice?"
            )
        strangers = _strangers(self._names, self._photos, self._renders)
        if strangers:
            lines.append(
                f"{strangers[0]}{_and_more(strangers)}: do the cameras belong to these images, and in this order?"
            )
        return lines


def _and_more(lines: Sequence[str]) -> str:
    return "" if len(lines) == 1 else f" (and {len(lines) - 1} more)"


def _mask_doubt(mask: Bool) -> str:
    border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    at_border, share = float(border.mean()), float(mask.mean())
    if at_border > 0.5 and at_border >= share:
        return f"has its mask on {100 * at_border:.0f}% of the image's border and {100 * share:.0f}% of the image"
    return ""


def _twin(view: View) -> list[str]:
    T_camera_world = invert_transform(view.frame.T_world_camera)
    for other in view.training:
        between = T_camera_world @ other.T_world_camera
        metres = float(np.linalg.norm(between[:3, 3]))
        degrees = float(np.degrees(np.arccos(np.clip((np.trace(between[:3, :3]) - 1) / 2, -1, 1))))
        if metres <= SAME_PLACE_METRES and degrees <= SAME_PLACE_DEGREES:
            return [f"{view.name} stands {1e3 * metres:.1f} mm and {degrees:.2f} degrees from a training view"]
    return []


def _thumbnail(image: NDArray[np.floating]) -> Float64:
    small = cv2.resize(np.asarray(image, np.float32), THUMBNAIL, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float64).ravel()


def _strangers(names: Sequence[str], photos: Sequence[Float64], renders: Sequence[Float64]) -> list[str]:
    """Views whose photo is clearly nearer the render of another view than its own."""
    if len(names) < 2:
        return []
    x, y = np.stack(photos), np.stack(renders)
    squared = np.square(x).sum(axis=1)[:, None] + np.square(y).sum(axis=1) - 2 * x @ y.T
    decibels = -10 * np.log10(np.maximum(squared / x.shape[1], 1e-8))
    own, best = np.diag(decibels), decibels.argmax(axis=1)
    size = "{}x{}".format(*THUMBNAIL)
    return [
        f"{name}'s photo is nearer the render of {names[j]} ({decibels[i, j]:.1f} dB at {size}) than its own"
        f" ({own[i]:.1f} dB)"
        for i, (name, j) in enumerate(zip(names, best, strict=True))
        if decibels[i, j] > own[i] + OTHER_VIEW_CLEARLY
    ]
