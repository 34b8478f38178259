"""Splats in glTF and OpenUSD, as other readers find them."""

import errno
import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from splatctrl_cli.errors import InputError
from splatctrl_cli.formats.splat.gltf import read_gltf, write_glb
from splatctrl_cli.formats.splat.usd import read_usd, write_usd
from splatctrl_cli.records import GaussianSet
from tests.formats.splat.test_gaussian_ply import gaussian_set

SPLATS = "KHR_gaussian_splatting"


def document_of(path: Path) -> tuple[dict[str, Any], bytes]:
    content = path.read_bytes()
    magic, version, length, json_length, kind = struct.unpack_from("<4sII I4s", content)
    assert (magic, version, length, kind) == (b"glTF", 2, len(content), b"JSON")
    binary_length, kind = struct.unpack_from("<I4s", content, 20 + json_length)
    assert (28 + json_length + binary_length, kind) == (length, b"BIN\0")
    document: dict[str, Any] = json.loads(content[20 : 20 + json_length])
    return document, content[28 + json_length :]


def with_document(path: Path, document: dict[str, Any], binary: bytes) -> Path:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary))
    path.write_bytes(
        head + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0")
    )
    with path.open("ab") as stream:
        stream.write(binary)
    return path


@pytest.fixture
def written(tmp_path: Path) -> tuple[Path, GaussianSet]:
    gaussians = gaussian_set(20, degree=1)
    write_glb(tmp_path / "a.glb", gaussians, {"scene": "made up"})
    return tmp_path / "a.glb", gaussians


def test_the_document_is_what_the_extension_asks_for(written: tuple[Path, GaussianSet]) -> None:
    path, gaussians = written
    document, binary = document_of(path)
    primitive = document["meshes"][0]["primitives"][0]
    assert document["extensionsUsed"] == [SPLATS]
    assert primitive["mode"] == 0
    assert primitive["extensions"][SPLATS]["kernel"] == "ellipse"
    assert primitive["extensions"][SPLATS]["colorSpace"] == "srgb_rec709_display"
    names = ["ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0", *(f"SH_DEGREE_1_COEF_{k}" for k in range(3))]
    assert list(primitive["attributes"]) == ["POSITION", "COLOR_0", *(f"{SPLATS}:{name}" for name in names)]
    types = [document["accessors"][i]["type"] for i in primitive["attributes"].values()]
    assert types == ["VEC3", "VEC4", "VEC4", "VEC3", "SCALAR", *["VEC3"] * 4]
    position = document["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_array_equal(np.float32(position["min"]), gaussians.centers.min(axis=0))
    assert all(view["byteOffset"] % 4 == 0 for view in document["bufferViews"])
    rotation = document["accessors"][primitive["attributes"][f"{SPLATS}:ROTATION"]]
    start = document["bufferViews"][rotation["bufferView"]]["byteOffset"]
    w, x, y, z = gaussians.quats_wxyz[0]
    assert struct.unpack_from("<4f", binary, start) == (x, y, z, w)


def test_another_reader_finds_the_points_and_their_colours_with_z_turned_up(
    written: tuple[Path, GaussianSet],
) -> None:
    path, gaussians = written
    scene = trimesh.load(path)
    (cloud,) = scene.geometry.values()
    assert np.array_equal(cloud.vertices, gaussians.centers)
    colors = np.clip(0.5 + 0.28209479 * gaussians.harmonics[:, 0], 0, 1)
    np.testing.assert_allclose(cloud.colors[:, :3] / 255, colors, atol=0.5001 / 255)
    (node,) = scene.graph.nodes_geometry
    np.testing.assert_allclose(scene.graph.get(node)[0][:3, :3] @ [0, 0, 1], [0, 1, 0], atol=1e-7)


def test_normalised_bytes_interleaved_with_others_are_read(tmp_path: Path) -> None:
    rows = np.zeros(2, np.dtype([("p", "<f4", 3), ("q", "i1", 4), ("s", "<f4", 3), ("o", "u1", 4), ("c", "<f4", 3)]))
    rows["p"], rows["s"], rows["c"] = [[1, 2, 3], [4, 5, 6]], 0.5, 0.25
    rows["q"], rows["o"][:, 0] = [[0, 0, 0, 127], [127, 0, 0, 0]], [255, 51]
    kinds = {
        "p": (5126, "VEC3"),
        "q": (5120, "VEC4"),
        "s": (5126, "VEC3"),
        "o": (5121, "SCALAR"),
        "c": (5126, "VEC3"),
    }
    fields = rows.dtype.fields or {}
    accessors = [
        {"bufferView": 0, "byteOffset": fields[name][1], "componentType": kind, "count": 2, "type": shape}
        | ({"normalized": True} if kind != 5126 else {})
        for name, (kind, shape) in kinds.items()
    ]
    attributes = dict(zip(["POSITION", "ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0"], range(5), strict=True))
    attributes = {(name if name == "POSITION" else f"{SPLATS}:{name}"): i for name, i in attributes.items()}
    document = {
        "asset": {"version": "2.0"},
        "meshes": [{"primitives": [{"attributes": attributes, "extensions": {SPLATS: {"kernel": "ellipse"}}}]}],
        "accessors": accessors,
        "bufferViews": [{"buffer": 0, "byteLength": rows.nbytes, "byteStride": rows.itemsize}],
        "buffers": [{"byteLength": rows.nbytes}],
    }
    g, comments = read_gltf(with_document(tmp_path / "a.glb", document, rows.tobytes()))
    assert comments == {}
    np.testing.assert_array_equal(g.centers, rows["p"])
    np.testing.assert_array_equal(g.quats_wxyz, [[1, 0, 0, 0], [0, 1, 0, 0]])
    np.testing.assert_allclose(g.opacities, [1, 0.2], rtol=1e-6)


def edit(document: dict[str, Any], change: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
    change(document["meshes"][0]["primitives"][0])
    return document


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: p["extensions"].clear(), f"expected one primitive with {SPLATS}, got 0 of 1"),
        (lambda p: p["attributes"].pop(f"{SPLATS}:SCALE"), f"its Gaussians have no {SPLATS}:SCALE"),
        (lambda p: p["attributes"].pop(f"{SPLATS}:SH_DEGREE_1_COEF_2"), "expected 1, 4, 9 or 16 coefficients, got 3"),
        (lambda p: p["extensions"][SPLATS].update(kernel="cube"), "expected ellipse, got cube"),
        (lambda p: p["attributes"].update(POSITION=99), "glTF not understood: IndexError"),
        (lambda p: p["attributes"].update(POSITION=1), "accessor 1: expected a plain VEC3, got VEC4"),
        (
            lambda p: p["extensions"][SPLATS].update(extensions={"KHR_gaussian_splatting_compression_spz_2": {}}),
            "packed by KHR_gaussian_splatting_compression_spz_2, expected plain attributes",
        ),
    ],
)
def test_what_is_no_plain_set_of_gaussians_is_refused(
    written: tuple[Path, GaussianSet], change: Callable[[dict[str, Any]], object], message: str
) -> None:
    path, _ = written
    document, binary = document_of(path)
    with pytest.raises(InputError, match=message):
        read_gltf(with_document(path, edit(document, change), binary))


def test_a_table_that_reaches_beyond_the_data_is_refused(written: tuple[Path, GaussianSet]) -> None:
    path, _ = written
    document, binary = document_of(path)
    document["accessors"][0]["count"] = 10**6
    with pytest.raises(InputError, match=r"accessor 0: reaches beyond the \d+ bytes of data"):
        read_gltf(with_document(path, document, binary))


def test_logarithms_of_sigmas_as_drafts_had_them_are_refused(written: tuple[Path, GaussianSet]) -> None:
    path, gaussians = written
    document, binary = document_of(path)
    scale = document["meshes"][0]["primitives"][0]["attributes"][f"{SPLATS}:SCALE"]
    start = document["bufferViews"][document["accessors"][scale]["bufferView"]]["byteOffset"]
    logs = np.log(gaussians.scales).tobytes()
    with pytest.raises(InputError, match=r"splat 0: .*:SCALE: expected no negative sigma, got .*drafts"):
        read_gltf(with_document(path, document, binary[:start] + logs + binary[start + len(logs) :]))


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
    write_usd(tmp_path / "c.usda", replace(gaussian_set(2), labels=np.uint8([0, 1])), {}, suffix=".usda")
    text = (tmp_path / "c.usda").read_text().replace("label = [0, 1]", "label = [0, 1, 1]")
    (tmp_path / "c.usda").write_text(text)
    with pytest.raises(InputError, match="label: expected a number from 0 to 255 for each of 2 Gaussians"):
        read_usd(tmp_path / "c.usda", suffix=".usda")


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
