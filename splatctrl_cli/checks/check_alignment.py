"""Whether the edges of colour and depth images meet: else depth is of another camera, or not registered."""

from collections.abc import Sequence

import cv2
import numpy as np

from splatctrl_cli.checks.finding import Finding, error
from splatctrl_cli.records import Float32, Float64, RgbdFrame

NUM_FRAMES = 4  # of a camera
STEP = 0.05  # of the depth, across an edge
BORDER = 3  # [px] that are left out
CLEAR, AHEAD = 0.2, 1.35  # correlation of a peak, and how far above the next one, for it to be believed
SHIFT = 0.015  # of the width
AROUND = 3  # [px] of a peak, and around no shift
SEARCHED = 8  # a shift of up to an eighth of the image


def alignment_findings(frames: Sequence[RgbdFrame]) -> list[Finding]:
    """Of every camera whose frames have colour."""
    edges = {
        camera: [_spectra(f) for f in its[:: max(1, len(its) // NUM_FRAMES)][:NUM_FRAMES]]
        for camera in sorted({frame.camera for frame in frames})
        if (its := [frame for frame in frames if frame.camera == camera and frame.color.any()])
    }
    found: list[Finding] = []
    for camera, spectra in edges.items():
        surface = np.mean([_correlation(color, depth) for color, depth in spectra], axis=0)
        where = f"camera {camera}"
        dv, du, peak, runner_up = _peak(surface)
        width = surface.shape[1]
        if max(peak, 0.0) >= CLEAR and peak >= AHEAD * runner_up:
            if max(abs(du), abs(dv)) > SHIFT * width:
                found.append(_shifted(where, du, dv, width, peak))
            continue
        other = _other(camera, edges, _at_zero(surface))
        if other is not None:
            found.append(_exchanged(where, *other))
    return found


def _shifted(where: str, du: int, dv: int, width: int, peak: float) -> Finding:
    share = 100 * max(abs(du), abs(dv)) / width
    text = f"depth edges lie {-du:+d} px across and {-dv:+d} px down from colour edges in images {width} px wide"
    text = f"{text} ({share:.1f} % of the width, correlation {peak:.2f} there): depth is not registered to colour"
    remedy = "record depth aligned to colour, or with its own frame and CameraInfo, that ingest may register it"
    return error("alignment", where, text, remedy, value=max(abs(du), abs(dv)), unit="px")


def _exchanged(where: str, other: str, own: float, peak: float) -> Finding:
    text = (
        f"its colour edges meet the depth edges of camera {other} (correlation {peak:.2f}), not its own ({own:.2f})"
    )
    return error("alignment", where, text, "exchange the depth topics, with --camera NAME=COLOR,DEPTH", value=own)


def _other(
    camera: str, edges: dict[str, list[tuple[Float64, Float64]]], own: float
) -> tuple[str, float, float] | None:
    """The camera whose depth fits this one's colour clearly, its own score, and the other's."""
    scores = {}
    for name, its in edges.items():
        pairs = list(zip(edges[camera], its, strict=False))
        if name != camera and all(a[0].shape == b[1].shape for a, b in pairs):
            scores[name] = _at_zero(np.mean([_correlation(a[0], b[1]) for a, b in pairs], axis=0))
    best = max(scores, key=lambda name: scores[name], default=None)
    if best is None or scores[best] < max(CLEAR, 2 * own):
        return None
    return best, own, scores[best]


def _spectra(frame: RgbdFrame) -> tuple[Float64, Float64]:
    """Transforms of where colour and where depth change, each of mean 0 and length 1."""
    gray = cv2.GaussianBlur(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1.0)
    slope = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1))
    slope = np.minimum(slope, np.percentile(slope, 95))
    around = np.ones((5, 5), np.uint8)
    far = cv2.dilate(frame.depth, around)
    near = cv2.erode(np.where(frame.depth > 0, frame.depth, np.float32(1e9)), around)
    is_edge = (far - near > STEP * near) & (near < 1e8)
    is_edge[:BORDER] = is_edge[-BORDER:] = False
    is_edge[:, :BORDER] = is_edge[:, -BORDER:] = False
    return _transformed(slope), _transformed(is_edge.astype(np.float32))


def _transformed(image: Float32) -> Float64:
    window = np.outer(np.hanning(image.shape[0]) ** 0.25, np.hanning(image.shape[1]) ** 0.25)
    centred = (image - image.mean()) * window
    length = float(np.linalg.norm(centred))
    return np.asarray(np.fft.rfft2(centred / length if length > 0 else centred))


def _correlation(color: Float64, depth: Float64) -> Float64:
    """(h, w) by shift of the colour edges against the depth edges, no shift in the middle."""
    return np.fft.fftshift(np.fft.irfft2(color * np.conj(depth)))


def _peak(surface: Float64) -> tuple[int, int, float, float]:
    """Rows and columns of the best shift, its correlation, and the best one apart from it."""
    height, width = surface.shape
    rows, columns = height // SEARCHED, width // SEARCHED
    near = surface[
        height // 2 - rows : height // 2 + rows + 1, width // 2 - columns : width // 2 + columns + 1
    ].copy()
    v, u = np.unravel_index(int(np.argmax(near)), near.shape)
    peak = float(near[v, u])
    near[max(0, v - 2 * AROUND) : v + 2 * AROUND + 1, max(0, u - 2 * AROUND) : u + 2 * AROUND + 1] = -1.0
    return int(v) - rows, int(u) - columns, peak, float(near.max())


def _at_zero(surface: Float64) -> float:
    v, u = surface.shape[0] // 2, surface.shape[1] // 2
    return float(surface[v - AROUND : v + AROUND + 1, u - AROUND : u + AROUND + 1].max())
