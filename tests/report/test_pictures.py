"""Pictures are written at the promised width, the same each time, and say what they cannot draw."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import matplotlib as mpl
import numpy as np
import pytest

from experiments.pictures import Panel, trials_picture
from splatctrl_cli.errors import NotEvaluableError, UsageError
from splatctrl_cli.records import DistanceGrid, UInt8
from splatctrl_cli.report import replay_pictures
from splatctrl_cli.report.field_pictures import (
    field_slice_picture,
    gradient_picture,
    probability_picture,
    reliability,
    reliability_picture,
    slices_picture,
)
from splatctrl_cli.report.pictures import (
    CURVE_COLORS,
    ComparisonRow,
    comparison_picture,
    view_picture,
)
from splatctrl_cli.report.replay_pictures import (
    SHORTEST,
    clearance_picture,
    column,
    commands_picture,
    envelope,
    open_loop_picture,
    spans,
)
from tests.quick import painted
from tests.refused import expect_refusal

__all__ = ["painted"]

pytestmark = pytest.mark.usefixtures("painted")

H, W = 30, 40


def row(depth_error: float = 0.0, color_error: float = 0.0) -> ComparisonRow:
    depth = np.ones((H, W), np.float32)
    return ComparisonRow(
        title="cam0-0000",
        figures="20.0 dB",
        photo=np.full((H, W, 3), 102, np.uint8),
        render=np.full((H, W, 3), 0.4 + color_error, np.float32),
        photo_depth=depth,
        render_depth=depth + np.float32(depth_error),
    )


def grid(*, observed: int = 1, distance: float = 0.0, header: str = "from the grid") -> DistanceGrid:
    """A ball of 0.2 m about (0.5, 0.5, 0.5); `distance` is added to what a cell has."""
    offset = 0.05 * np.stack(np.meshgrid(*[np.arange(20)] * 3, indexing="ij"), axis=-1) - 0.5
    from_center = np.linalg.norm(offset, axis=3)
    sdf = (from_center - 0.2 + distance).astype(np.float32)
    channels = {
        "sdf": sdf,
        "observed": np.full(sdf.shape, observed, np.uint8),
        "gradient": (offset / np.maximum(from_center, 1e-9)[..., None] + distance).astype(np.float32),
        "probability": np.clip(1 - from_center, 0, 1).astype(np.float32),
    }
    return DistanceGrid(origin=np.zeros(3), voxel=0.05, channels=channels, header={"observed": header})


SPHERES = np.array([[0.2, 0.2, 0.5], [0.8, 0.8, 0.9]]), np.array([0.1, 0.1])


NUM = 6000  # states: more than a picture has columns
SECONDS = np.linspace(0, 5, NUM)
EVENTS = {"below-margin": [(1.0, 2.0), (4.0, 4.0)], "unknown-space": [(0.0, 5.0)], "stale-map": []}
CURVES = {
    "exact": 0.05 * np.cos(SECONDS),
    "barrier": 0.05 * np.cos(SECONDS) - 0.01,
    "certified": np.where(SECONDS < 2, np.nan, 0.03),
    "truth": np.full(NUM, np.nan),
}
MOVES = np.where(SECONDS < 0.08, np.nan, [np.sin(SECONDS), 0.001 * np.cos(SECONDS)]).T
JOINTS, LIMITS, MIDDLE, FAR = ("shoulder", "elbow"), np.array([0.9, 2.0]), (0.5, 0.5, 0.5), (-9.0, 99.0, 0.0)
LONG = np.broadcast_to(np.linspace(-1, 1, 1300, dtype=np.float32)[:, None, None], (1300, 2, 2))
LARGE = DistanceGrid(origin=np.zeros(3), voxel=0.001, channels={"sdf": LONG}, header={})
CURVE = reliability(np.array([0.0, 0.95]), np.array([False, True]))  # with empty bins

DRAWN: dict[str, Callable[[Path], None]] = {
    "comparison": lambda path: comparison_picture(path, [row(0.0), row(0.1)]),
    "slice": lambda path: field_slice_picture(path, grid(), 0.5, SPHERES, "A ball"),
    "slices": lambda path: slices_picture(path, grid(), MIDDLE),
    "slices of nothing": lambda path: slices_picture(path, grid(distance=np.nan), MIDDLE),
    "large slices": lambda path: slices_picture(path, LARGE, (0.5, 0.0, 0.0)),
    "gradient": lambda path: gradient_picture(path, grid(), [0, 3, 100, 1], 0.5, MIDDLE),
    "gradient of nothing": lambda path: gradient_picture(path, grid(distance=np.nan), [0, 0], 0.5, FAR),
    "probability": lambda path: probability_picture(path, grid(), FAR),
    "reliability": lambda path: reliability_picture(path, {"calibrated": CURVE, "paper": CURVE}),
    "clearance": lambda path: clearance_picture(path, SECONDS, CURVES, 0.02, "Clearance", EVENTS),
    "quiet clearance": lambda path: clearance_picture(
        path, np.zeros(1), {"exact": np.array([0.1])}, 0.02, "Clearance", {}
    ),
    "commands": lambda path: commands_picture(
        path, SECONDS, MOVES, JOINTS, LIMITS, {"scene": [(1.0, 2.0)], "self": []}, MOVES + 0.1
    ),
    "open loop": lambda path: open_loop_picture(
        path, SECONDS, np.nan_to_num(MOVES), JOINTS, np.cos(SECONDS), [(1.0, 1.0)]
    ),
}


@cache
def drawn_bytes(name: str) -> bytes:
    """Bytes of a picture that several tests look at."""
    with TemporaryDirectory() as folder:
        DRAWN[name](Path(folder) / "a.png")
        return (Path(folder) / "a.png").read_bytes()


def picture_of(data: bytes) -> UInt8:
    """Blue, green and red of each pixel."""
    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), np.uint8)


@pytest.mark.parametrize("name", DRAWN)
def test_a_picture_is_1200_pixels_wide_and_the_same_each_time(tmp_path: Path, name: str) -> None:
    before = dict(mpl.rcParams)
    DRAWN[name](tmp_path / "a.png")
    image = picture(tmp_path / "a.png")
    assert image.shape[1] == 1200 and image.std() > 1.0
    assert (tmp_path / "a.png").read_bytes() == drawn_bytes(name)
    assert dict(mpl.rcParams) == before


def picture(path: Path) -> UInt8:
    return picture_of(path.read_bytes())


def test_the_depth_error_saturates_in_the_colour_bar_s_top_colour(tmp_path: Path) -> None:
    comparison_picture(tmp_path / "a.png", [row(0.0)])
    comparison_picture(tmp_path / "b.png", [row(0.2)])
    exact, wrong = (picture(tmp_path / name)[150, 950, ::-1] for name in ("a.png", "b.png"))
    assert wrong.astype(int)[:2].min() > 200, "yellow: at or above 5 cm"
    assert exact.astype(int).max() < 120, "dark blue: no error"


def test_never_seen_space_shows_in_a_slice_where_somebody_looked_and_the_point_that_was_asked_for(
    tmp_path: Path,
) -> None:
    path = tmp_path / "a.png"
    field_slice_picture(path, grid(observed=0), 0.5, SPHERES, "A ball")
    assert path.read_bytes() != drawn_bytes("slice")
    never, unknown = grid(observed=0), grid(observed=0, header="no occupancy grid: all never seen")
    others = []
    for cells, place in ((never, MIDDLE), (unknown, MIDDLE), (grid(), (0.0, 0.0, 0.0))):
        slices_picture(path, cells, place)
        others.append(picture(path))
    seen = picture_of(drawn_bytes("slices"))
    assert np.any(seen != others[0]) and np.any(others[0] != others[1]) and np.any(seen != others[2])


def test_a_sphere_is_drawn_as_the_circle_of_the_cut(tmp_path: Path) -> None:
    areas = []
    for height in (0.5, 0.58, 0.8):
        sphere = np.array([[0.2, 0.2, height]]), np.array([0.1])
        field_slice_picture(tmp_path / "a.png", grid(), 0.5, sphere, "A ball")
        areas.append(num_orange(picture(tmp_path / "a.png")))
    whole, small = areas[0] - areas[2], areas[1] - areas[2]
    assert whole > 1000 and small / whole == pytest.approx(0.6**2, rel=0.05), "sqrt(0.1^2 - 0.08^2) = 0.06"


def num_orange(image: UInt8) -> int:
    blue, _, red = np.moveaxis(image.astype(int), -1, 0)
    return int(np.count_nonzero(red - blue > 100))


def panel(image: UInt8, right: bool) -> UInt8:
    """The middle of an error's panel."""
    height, x = image.shape[0], 860 if right else 260
    return image[int(0.7 * height) : int(0.8 * height), x - 60 : x + 60]


def shown(path: Path, row: ComparisonRow) -> UInt8:
    view_picture(path, row)
    assert picture(path).shape[1] == 1200
    return picture(path)[:, :, ::-1]


def test_errors_have_one_scale_whatever_the_view(tmp_path: Path) -> None:
    small, large, larger = (
        panel(shown(tmp_path / "a.png", row(color_error=e)), right=False).mean((0, 1)) for e in (0.05, 0.1, 0.3)
    )
    assert np.abs(small - large).max() > 50
    assert np.abs(large - larger).max() < 1, "10% and more have the top colour"


def test_what_was_not_rendered_is_orange_and_what_was_not_recorded_grey(tmp_path: Path) -> None:
    hole, unknown = row(), row()
    hole.render_depth[:] = 0.0
    unknown.photo_depth[:] = 0.0
    assert panel(shown(tmp_path / "a.png", hole), right=True).mean((0, 1)) == pytest.approx([0xD5, 0x5E, 0], abs=2)
    assert panel(shown(tmp_path / "b.png", unknown), right=True).mean((0, 1)) == pytest.approx([0xD9] * 3, abs=2)


def test_the_mask_is_outlined(tmp_path: Path) -> None:
    mask = np.zeros((H, W), np.bool_)
    mask[10:20, 10:30] = True
    plain, outlined, whole = (
        shown(tmp_path / "a.png", replace(row(), mask=m)) for m in (None, mask, np.ones((H, W), np.bool_))
    )
    height = plain.shape[0] // 2
    assert not np.array_equal(plain[60 : height - 30], outlined[60 : height - 30])
    assert np.array_equal(plain[60 : height - 30], whole[60 : height - 30]), "nothing to outline"


def test_each_kind_of_event_that_came_up_has_a_row() -> None:
    image = picture_of(drawn_bytes("clearance")).astype(int)
    orange, purple, brown = ((0, 159, 230), (167, 121, 204), (59, 109, 138))
    widths = [int(np.all(np.abs(image - color) < 3, axis=2).sum(axis=1).max()) for color in (orange, purple, brown)]
    assert widths[1] > 3 * widths[0] > 0 and widths[2] == 0


def test_a_short_series_is_drawn_as_it_is() -> None:
    _, lowest, highest = envelope(np.linspace(0, 1, 20), np.arange(20.0), columns=10)
    assert lowest is highest
    np.testing.assert_array_equal(lowest, np.arange(20.0))


@pytest.mark.parametrize("block", [1, 3, 7, 50])
def test_a_column_is_read_by_blocks(monkeypatch: pytest.MonkeyPatch, block: int) -> None:
    monkeypatch.setattr(replay_pictures, "BLOCK", block)
    rows = np.arange(14.0).reshape(7, 2)
    np.testing.assert_array_equal(column(rows, 1), rows[:, 1])


def test_a_long_series_keeps_its_extremes_where_they_are() -> None:
    rng = np.random.default_rng(0)
    seconds, values = np.sort(rng.uniform(0, 100, 5000)), rng.normal(size=5000)
    values[1234], values[4321] = -50.0, 70.0
    times, lowest, highest = envelope(seconds, values, columns=100)
    assert lowest is not highest and len(times) == 100
    low, high = int(np.nanargmin(lowest)), int(np.nanargmax(highest))
    assert (lowest[low], highest[high]) == (-50.0, 70.0)
    np.testing.assert_allclose([times[low], times[high]], seconds[[1234, 4321]], atol=0.51)
    column = np.minimum((100 * (seconds - seconds[0]) / np.ptp(seconds)).astype(int), 99)
    for k in (0, 50, 99):
        assert lowest[k] == values[column == k].min() and highest[k] == values[column == k].max()


def test_gaps_and_missing_values_stay_gaps() -> None:
    seconds = np.concatenate([np.linspace(0, 4, 500), np.linspace(6, 10, 500)])
    values = np.ones(1000)
    values[:100] = np.nan
    times, lowest, highest = envelope(seconds, values, columns=50)
    is_gap = np.isnan(lowest)
    np.testing.assert_array_equal(is_gap, np.isnan(highest))
    assert is_gap[(times > 4.2) & (times < 5.8)].all() and is_gap[times < 0.7].all()
    assert not is_gap[(times > 1) & (times < 3.8)].any()


def test_short_intervals_can_be_seen_and_those_that_touch_are_one() -> None:
    least = 10 * SHORTEST
    found = spans([(5.0, 6.0), (1.0, 1.0), (1.0 + least / 2, 1.0 + least / 2), (5.5, 5.6)], (0.0, 10.0))
    np.testing.assert_allclose(found, [(1.0, 1.5 * least), (5.0, 1.0)])
    assert spans([], (0.0, 10.0)) == []
    many = [(t, t) for t in np.linspace(0, 10, 100_000)]
    assert spans(many, (0.0, 10.0)) == [(0.0, pytest.approx(10.0 + least))]


def test_a_picture_of_trials_has_a_colour_for_each_group_and_leaves_out_what_a_method_lacks(tmp_path: Path) -> None:
    values = np.array([[1.0, 2.0], [1.5, np.nan], [2.0, 3.0]])
    panels = [Panel(title="time [s]", values=values, level=(1.2, "alone")), Panel(title="distance", values=values)]
    for name, groups in (("a", ["near", "near", "far"]), ("b", ["near", "near", "far"]), ("c", ["near"] * 3)):
        trials_picture(tmp_path / f"{name}.png", ["one", "other"], panels, groups, "Trials")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    for name, num in (("a", 2), ("c", 1)):  # without other groups there is no legend
        image = picture(tmp_path / f"{name}.png")
        assert image.shape[1] == 1200
        for color in CURVE_COLORS[:num]:
            ink = 255.0 - np.array([int(color[k : k + 2], 16) for k in (5, 3, 1)])
            share = (255.0 - image) @ ink / (ink @ ink)  # of the colour on white: lines and marks let shine through
            is_of_it = np.all(np.abs(255.0 - image - share[..., None] * ink) < 6, axis=2)
            assert np.sum(is_of_it & (share > 0.4)) > 60, color


def test_a_probability_that_is_drawn_by_itself_is_reliable() -> None:
    rng = np.random.default_rng(0)
    probability = rng.uniform(0, 1, 200_000)
    curve = reliability(probability, rng.uniform(0, 1, 200_000) < probability)
    np.testing.assert_allclose(curve.predicted, np.arange(0.05, 1, 0.1), atol=2e-3)
    np.testing.assert_allclose(curve.observed, curve.predicted, atol=0.02)
    assert curve.calibration_error < 0.005 and curve.count.sum() == 200_000


def test_bins_hold_what_they_say() -> None:
    curve = reliability(np.array([0.0, 0.1, 0.6, 0.8, 1.0]), np.array([False, True, True, True, False]), bins=4)
    np.testing.assert_array_equal(curve.count, [2, 0, 1, 2])
    np.testing.assert_allclose(curve.predicted, [0.05, np.nan, 0.6, 0.9])
    np.testing.assert_allclose(curve.observed, [0.5, np.nan, 1.0, 0.5])
    assert curve.calibration_error == pytest.approx((2 * 0.45 + 1 * 0.4 + 2 * 0.4) / 5)


@pytest.mark.parametrize(
    ("draw", "words"),
    [
        (
            lambda path: field_slice_picture(path, grid(), 2.0, SPHERES, "A ball"),
            r"slice z = 2 m: expected 0\.000 to 0\.950 m",
        ),
        (lambda path: comparison_picture(path, []), "no view to draw"),
        (lambda path: reliability(np.empty(0), np.empty(0, bool)), "at least one point"),
        (
            lambda path: reliability(np.array([0.5, np.nan]), np.ones(2, bool)),
            r"point 1: expected a probability in \[0, 1\], got nan",
        ),
        (lambda path: reliability(np.array([1.5]), np.ones(1, bool)), r"point 0: .* got 1.5"),
    ],
)
def test_what_cannot_be_drawn_is_refused(tmp_path: Path, draw: Callable[[Path], object], words: str) -> None:
    expect_refusal(words, draw, tmp_path / "a.png", error=(NotEvaluableError, UsageError))
