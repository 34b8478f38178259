"""Scored views as pictures: photo and render side by side, and below them how far colours and depths are apart.

The bars of the errors end at the same values in every picture, so that views and methods can be compared by eye.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.libraries import mpl
from splatctrl_cli.records import Float64, UInt8
from splatctrl_cli.report.pictures import MAX_DEPTH_ERROR, WIDTH, ComparisonRow, drawn_figure, save_figure

MAX_COLOR_ERROR = 0.10  # of the range of a channel, mean of the three: top of the colour error's bar
HOLE = "#d55e00"  # recorded, but not rendered
UNRECORDED = "#d9d9d9"
OUTLINE = "#ffffff"


def view_picture(path: Path, row: ComparisonRow) -> None:
    """Write photo | render over colour error | depth error, with the mask's outline where there is one."""
    height, width = row.photo.shape[:2]
    render = np.clip(row.render, 0.0, 1.0)
    color_error = _color_error(render, row.photo)
    both = (row.photo_depth > 0) & (row.render_depth > 0)
    depth_error = np.where(both, 100.0 * np.abs(row.render_depth - row.photo_depth), np.nan)
    hole = (row.photo_depth > 0) & ~both
    median = f"median {np.nanmedian(depth_error):.2f} cm" if both.any() else "no pixel has both depths"
    with drawn_figure(2 * ((WIDTH - 1.9) / 2 * height / width + 0.4) + 0.2) as figure:
        axes = figure.subplots(2, 2)
        axes[0, 0].imshow(row.photo, interpolation="nearest")
        axes[0, 1].imshow(render, interpolation="nearest")
        color = _draw_color_error(axes[1, 0], color_error)
        axes[1, 1].set_facecolor(UNRECORDED)
        depth = axes[1, 1].imshow(
            depth_error, cmap="cividis", vmin=0.0, vmax=100.0 * MAX_DEPTH_ERROR, interpolation="nearest"
        )
        axes[1, 1].imshow(np.where(hole[:, :, None], _rgba(HOLE), 0.0), interpolation="nearest")
        labels = ("mean of |render - photo| over RGB, % of the range", "|render - recorded depth|, cm")
        for image, panel, label in zip((color, depth), axes[1], labels, strict=True):
            figure.colorbar(image, ax=panel, extend="max", fraction=0.045, pad=0.02, label=label)
        if row.mask is not None:
            _outline(axes.flat, row.mask)
        titles = (
            f"photo   {row.title}" + ("" if row.mask is None else ", outlined: the mask"),
            f"render   {row.figures}",
            f"colour error   mean {color_error.mean():.1f}%",
            f"depth error   {median}; orange: no render, grey: no record",
        )
        for panel, text in zip(axes.flat, titles, strict=True):
            _finish(panel, text)
        save_figure(figure, path)


def renders_picture(path: Path, view: str, photo: UInt8, renders: Mapping[str, NDArray[np.floating]]) -> None:
    """Write a photo (H, W, 3) beside renders (H, W, 3) in [0, 1] under their titles, their colour errors below."""
    height, width = photo.shape[:2]
    columns = 1 + len(renders)
    with drawn_figure(2 * ((WIDTH - 0.6) / columns * height / width + 0.4) + 0.2) as figure:
        axes = figure.subplots(2, columns, squeeze=False)
        axes[0, 0].imshow(photo, interpolation="nearest")
        _finish(axes[0, 0], f"photo   {view}")
        axes[1, 0].set_axis_off()
        for (title, render), (above, below) in zip(renders.items(), axes.T[1:], strict=True):
            error = _color_error(render, photo)
            above.imshow(np.clip(render, 0.0, 1.0), interpolation="nearest")
            image = _draw_color_error(below, error)
            _finish(above, title)
            _finish(below, f"colour error   mean {error.mean():.1f}%")
        bar = figure.colorbar(image, ax=axes[1, 0], extend="max", orientation="horizontal", fraction=0.3)
        bar.set_label("mean of |render - photo| over RGB, % of the range")
        save_figure(figure, path)


def _color_error(render: NDArray[np.floating], photo: UInt8) -> Float64:
    return np.asarray(100.0 * np.abs(render - photo / 255.0).mean(axis=2))


def _draw_color_error(panel: Any, error: Float64) -> Any:
    return panel.imshow(error, cmap="cividis", vmin=0.0, vmax=100.0 * MAX_COLOR_ERROR, interpolation="nearest")


def _outline(panels: Any, mask: NDArray[np.bool_]) -> None:
    if mask.all() or not mask.any() or min(mask.shape) < 2:
        return
    for panel in panels:
        panel.contour(mask.astype(float), levels=[0.5], colors=OUTLINE, linewidths=1.0)


def _rgba(color: str) -> Float64:
    return np.asarray(mpl.colors.to_rgba(color))


def _finish(panel: Any, text: str) -> None:
    panel.set_title(text, fontsize=10, pad=5)
    panel.set(xticks=[], yticks=[])
    panel.spines[:].set_visible(False)
