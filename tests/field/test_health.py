import numpy as np
import pytest

from splatctrl_cli.field.health import field_health, median_spacing


def square_lattice(spacing: float) -> np.ndarray:
    x, y = np.meshgrid(np.arange(10) * spacing, np.arange(10) * spacing)
    return np.stack([x.ravel(), y.ravel(), np.zeros(100)], axis=1)


def test_spacing_of_a_lattice_is_its_pitch() -> None:
    assert median_spacing(square_lattice(0.01)) == pytest.approx(0.01)
    assert median_spacing(np.zeros((1, 3))) == 0.0
    assert median_spacing(np.zeros((5, 3))) == 0.0


def test_dense_thick_splats_have_no_warning() -> None:
    assert field_health(square_lattice(0.01), np.full(100, 0.01), 0.02).warnings == ()


def test_each_ratio_out_of_range_has_its_warning() -> None:
    thin = field_health(square_lattice(0.01), np.full(100, 0.005), 0.02)
    assert [w.split(":")[1] for w in thin.warnings] == [" the exact field's surface has holes between splats"]
    short = field_health(square_lattice(0.01), np.full(100, 0.008), 0.009)
    assert [w.split(":")[0][:7] for w in short.warnings] == ["spacing", "the ker"]
    assert short.radius_per_spacing == pytest.approx(0.8)
