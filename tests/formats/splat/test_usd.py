"""OpenUSD particle fields: what the library says of the file, and what is refused."""

import errno
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.formats.splat.usd import read_usd, write_usd
from tests.formats.splat.test_gaussian_ply import gaussian_set

pxr = pytest.importorskip("pxr", reason="usd-core is not installed: USD was not written")


def test_the_stage_is_a_particle_field_in_metres_with_z_up(tmp_path: Path) -> None:
    from pxr import Usd, UsdGeom, UsdVol

    gaussians = gaussian_set(5, degree=1)
    write_usd(tmp_path / "a.usda", gaussians, {}, suffix=".usda")
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    field = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    quat = field.GetOrientationsAttr().Get()[0]
    np.testing.assert_array_equal([quat.GetReal(), *quat.GetImaginary()], gaussians.quats_wxyz[0])
    assert field.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 1
    coefficients = np.asarray(field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get())
    np.testing.assert_array_equal(coefficients[:4], gaussians.harmonics[0])
    lower, upper = np.asarray(field.GetExtentAttr().Get())
    assert (lower <= gaussians.centers).all() and (gaussians.centers <= upper).all()


def test_what_is_no_particle_field_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.usda").write_text('#usda 1.0\ndef Xform "World" {}\n')
    with pytest.raises(InputError, match="expected one ParticleField3DGaussianSplat, got 0"):
        read_usd(tmp_path / "a.usda", suffix=".usda")
    (tmp_path / "b.usda").write_text("no such file")
    with pytest.raises(InputError, match="no USD file that the library can open"):
        read_usd(tmp_path / "b.usda", suffix=".usda")


def test_a_field_without_scales_is_refused(tmp_path: Path) -> None:
    write_usd(tmp_path / "a.usda", gaussian_set(2), {}, suffix=".usda")
    text = (tmp_path / "a.usda").read_text().replace("float3[] scales", "float3[] sizes")
    (tmp_path / "a.usda").write_text(text)
    with pytest.raises(InputError, match="its ParticleField3DGaussianSplat has no scales"):
        read_usd(tmp_path / "a.usda", suffix=".usda")


def test_a_disk_that_is_full_is_an_error_of_writing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pxr import Sdf, Tf

    def export(_layer: object, _path: str) -> None:
        raise Tf.ErrorException("Error occurred writing file: No space left on device")

    monkeypatch.setattr(Sdf.Layer, "Export", export)
    with pytest.raises(OSError, match="No space left on device") as caught:
        write_usd(tmp_path / "a.usdc", gaussian_set(2), {}, suffix=".usdc")
    assert caught.value.errno == errno.ENOSPC
    assert not list(tmp_path.iterdir())
