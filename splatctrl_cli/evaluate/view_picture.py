"""One scored view: photo and render side by side, and below them how far the colours and the depths are apart."""

from pathlib import Path

import numpy as np

from splatctrl_cli.evaluate.pictures import MAX_DEPTH_ERROR, WIDTH, ComparisonRow, drawn_figure, save_figure

MAX_COLOR_ERROR = 0.25  # of the range of a channel, mean of the three: top of the colour error's bar


def view_picture(path: Path, row: ComparisonRow) -> None:
    """Write photo | render over colour error [% of the range] | depth error [cm]."""
    height, width = row.photo.shape[:2]
    render = np.clip(row.render, 0.0, 1.0)
    color_error = 100.0 * np.abs(render - row.photo / 255.0).mean(axis=2)
    both = (row.photo_depth > 0) & (row.render_depth > 0)
    depth_error = np.where(both, 100.0 * np.abs(row.render_depth - row.photo_depth), np.nan)
    median = (
        f"median {np.nanmedian(depth_error):.2f} cm, grey: no depth" if both.any() else "no pixel has both depths"
    )
    with drawn_figure(2 * ((WIDTH - 1.5) / 2 * height / width + 0.4) + 0.2) as figure:
        axes = figure.subplots(2, 2)
        axes[0, 0].imshow(row.photo, interpolation="nearest")
        axes[0, 1].imshow(render, interpolation="nearest")
        color = axes[1, 0].imshow(
            color_error, cmap="cividis", vmin=0.0, vmax=100.0 * MAX_COLOR_ERROR, interpolation="nearest"
        )
        axes[1, 1].set_facecolor("#d9d9d9")
        depth = axes[1, 1].imshow(
            depth_error, cmap="cividis", vmin=0.0, vmax=100.0 * MAX_DEPTH_ERROR, interpolation="nearest"
        )
        for image, panel in ((color, axes[1, 0]), (depth, axes[1, 1])):
            figure.colorbar(image, ax=panel, extend="max", fraction=0.045, pad=0.02)
        titles = (
            f"photo   {row.title}",
            f"render   {row.figures}",
            f"colour error [%]   mean {color_error.mean():.1f}",
            f"depth error [cm]   {median}",
        )
        for panel, text in zip(axes.flat, titles, strict=True):
            panel.set_title(text, fontsize=10, pad=5)
            panel.set(xticks=[], yticks=[])
            panel.spines[:].set_visible(False)
        save_figure(figure, path)
