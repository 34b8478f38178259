"""Splats of 32 bytes, `.spz`, glTF and OpenUSD: the bytes of one Gaussian, files of other tools, what is refused."""

import errno
import gzip
import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from splatctrl_cli.formats.splat.gaussian_ply import differences
from splatctrl_cli.formats.splat.gltf import read_gltf, write_glb
from splatctrl_cli.formats.splat.packed_splats import read_splat, read_spz, spz_bound, write_splat, write_spz
from splatctrl_cli.formats.splat.usd import read_usd, write_usd
from splatctrl_cli.records import GaussianSet
from tests.formats.splat.test_gaussian_ply import changed, gaussian_set
from tests.refused import expect_refusal

ROW = struct.Struct("<6f8B")


def test_one_gaussian_has_the_32_bytes_that_viewers_expect(tmp_path: Path) -> None:
    one = changed(
        gaussian_set(1),
        centers=[[1, 2, 3]],
        scales=[[0.01, 0.02, 0.03]],
        quats_wxyz=[[0.5, 0.5, -0.5, 0.5]],
        opacities=[0.4],
        harmonics=[[[0.0, 0.5 / 0.28209479, -0.3 / 0.28209479]]],
    )
    write_splat(tmp_path / "a.splat", one, {})
    row = ROW.unpack((tmp_path / "a.splat").read_bytes())
    np.testing.assert_allclose(row[:6], [1, 2, 3, 0.01, 0.02, 0.03], rtol=1e-6)
    # 0.5 rounds to even; the same rotation, its first component negative
    assert (row[6:10], row[10:]) == ((128, 255, 51, 102), (64, 64, 192, 64))
    write_splat(tmp_path / "b.splat", changed(one, quats_wxyz=[[1, 0, 0, 0]]), {})
    assert np.abs(read_splat(tmp_path / "b.splat")[0].quats_wxyz).tolist() == [[1, 0, 0, 0]], "no rotation is exact"


def test_a_file_of_another_tool_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.splat").write_bytes(ROW.pack(1, 2, 3, 0.1, 0.2, 0.3, 255, 0, 51, 255, 255, 128, 128, 128) * 2)
    g, comments = read_splat(tmp_path / "a.splat")
    assert (len(g), comments, g.opacities[0], g.quats_wxyz[0].tolist()) == (2, {}, 1, [1, 0, 0, 0])
    np.testing.assert_allclose(0.5 + 0.28209479 * g.harmonics[0, 0], [1, 0, 0.2], atol=1e-6)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (ROW.pack(0, float("nan"), 0, 1, 1, 1, *[200] * 8), "splat 1: center: expected finite"),
        (ROW.pack(0, 0, 0, 1, -1, 1, *[200] * 8), "splat 1: sigma: expected more than 0 m"),
        (ROW.pack(0, 0, 0, 1, 1, 1, *[128] * 8), "splat 1: rotation: expected a quaternion that is not zero"),
        (b"tail", "expected a multiple of 32 bytes, one row per splat, got 36"),
    ],
)
def test_rows_that_are_no_gaussians_are_refused(tmp_path: Path, row: bytes, message: str) -> None:
    (tmp_path / "a.splat").write_bytes(ROW.pack(0, 0, 0, 1, 1, 1, *[200] * 8) + row)
    expect_refusal(message, read_splat, tmp_path / "a.splat")


HEADER = struct.Struct("<IIIBBBB")

MAGIC = 0x5053474E


def packed(path: Path, *parts: bytes) -> Path:
    path.write_bytes(gzip.compress(b"".join(parts)))
    return path


def test_one_gaussian_has_the_bytes_of_version_3(tmp_path: Path) -> None:
    one = changed(
        gaussian_set(1),
        centers=[[1, -2, 0.25]],
        scales=np.exp([[-4, -5, -6]]),
        quats_wxyz=[[-0.3, 0.8, 0.4, np.sqrt(0.11)]],  # x is largest
        opacities=[0.2],
        harmonics=[[[0.0, 1.0, -1.0], [0.5, -0.5, 0.25], [0, 0, 0], [-1, 0.125, 0]]],
    )
    write_spz(tmp_path / "a.spz", one, {})
    content = gzip.decompress((tmp_path / "a.spz").read_bytes())
    centers = b"".join(int(v * 4096).to_bytes(3, "little", signed=True) for v in (1, -2, 0.25))
    colors = [51, 128, 166, 89, 96, 80, 64]  # opacity, 38.25 f_dc + 127.5, scales
    rotation = 0 << 30 | 289 << 20 | 240 << 10 | 512 + 217  # x of x y z w is largest; y, z, w; 511 is sqrt(1/2)
    harmonics = [192, 64, 160, 128, 128, 128, 0, 144, 128]
    body = centers + bytes(colors) + rotation.to_bytes(4, "little") + bytes(harmonics)
    assert content == HEADER.pack(MAGIC, 3, 1, 1, 12, 0, 0) + body


def test_files_of_version_2_are_read(tmp_path: Path) -> None:
    centers = b"".join(value.to_bytes(3, "little", signed=True) for value in (256, -512, 3))
    body = [centers, bytes([255]), bytes([127, 128, 0]), bytes([160, 0, 255]), bytes([128, 128, 218])]
    g, _ = read_spz(packed(tmp_path / "a.spz", HEADER.pack(MAGIC, 2, 1, 0, 8, 1, 0), *body))
    np.testing.assert_allclose(g.centers, [[1, -2, 3 / 256]])
    np.testing.assert_allclose(g.scales, np.exp([[0, -10, 255 / 16 - 10]]), rtol=1e-6)
    x, z = 128 / 127.5 - 1, 218 / 127.5 - 1
    np.testing.assert_allclose(g.quats_wxyz, [[np.sqrt(1 - 2 * x * x - z * z), x, x, z]], rtol=1e-6)
    np.testing.assert_allclose(g.harmonics[0, 0], (np.array([127, 128, 0]) / 255 - 0.5) / 0.15, rtol=1e-6)


@pytest.mark.parametrize("index", [0, 1, 2, 3])
@pytest.mark.parametrize("sign", [-1, 1])
def test_every_largest_component_and_sign_keeps_its_rotation(tmp_path: Path, index: int, sign: int) -> None:
    quats = np.random.default_rng(index).uniform(-0.9, 0.9, (200, 4))
    quats[:, index] = sign
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    gaussians = replace(gaussian_set(200), quats_wxyz=quats.astype(np.float32))
    write_spz(tmp_path / "a.spz", gaussians, {})
    assert differences(gaussians, read_spz(tmp_path / "a.spz")[0]).rotation <= spz_bound(gaussians).rotation


def test_what_is_farther_than_2_km_is_held_in_larger_steps(tmp_path: Path) -> None:
    gaussians = gaussian_set(50)
    gaussians.centers[7] = [3000.0, -5000.0, 1.0]
    write_spz(tmp_path / "a.spz", gaussians, {})
    bound = spz_bound(gaussians)
    assert bound.center == pytest.approx(0.5 / 1024, rel=1e-3)
    assert differences(gaussians, read_spz(tmp_path / "a.spz")[0]).center <= bound.center


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ((MAGIC, 4, 0, 0, 12, 0, 0), ".spz version: expected 2 or 3 in gzip and 4 in plain, got 4"),
        ((MAGIC, 3, 0, 4, 12, 0, 0), "expected degree 0 to 3"),
        ((MAGIC, 3, 0, 0, 12, 2, 0), "has vendor extensions"),
        ((MAGIC, 3, 1, 0, 12, 0, 0), "expected 20 bytes for 1 splats, got 0"),
        ((7, 3, 0, 0, 12, 0, 0), "no .spz file: expected it to start with 0x5053474e"),
    ],
)
def test_what_is_no_file_of_these_versions_is_refused(tmp_path: Path, header: tuple[int, ...], message: str) -> None:
    expect_refusal(message, read_spz, packed(tmp_path / "a.spz", HEADER.pack(*header)))


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
    head = struct.pack("<4sII I4s", b"glTF", 2, 28 + len(text) + len(binary), len(text), b"JSON")
    path.write_bytes(head + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary)
    return path


@pytest.fixture
def written(tmp_path: Path) -> tuple[Path, GaussianSet]:
    gaussians = gaussian_set(20, degree=1)
    write_glb(tmp_path / "a.glb", gaussians, {"scene": "made up"})
    return tmp_path / "a.glb", gaussians


def test_the_document_is_what_the_extension_asks_for(written: tuple[Path, GaussianSet]) -> None:
    path, gaussians = written
    document, binary = document_of(path)
    primitive, accessors = document["meshes"][0]["primitives"][0], document["accessors"]
    assert (document["extensionsUsed"], primitive["mode"]) == ([SPLATS], 0)
    said = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    assert said.items() <= primitive["extensions"][SPLATS].items()
    names = ["ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0", *(f"SH_DEGREE_1_COEF_{k}" for k in range(3))]
    assert list(primitive["attributes"]) == ["POSITION", "COLOR_0", *(f"{SPLATS}:{name}" for name in names)]
    types = [accessors[i]["type"] for i in primitive["attributes"].values()]
    assert types == ["VEC3", "VEC4", "VEC4", "VEC3", "SCALAR", *["VEC3"] * 4]
    position = accessors[primitive["attributes"]["POSITION"]]
    np.testing.assert_array_equal(np.float32(position["min"]), gaussians.centers.min(axis=0))
    assert all(view["byteOffset"] % 4 == 0 for view in document["bufferViews"])
    rotation = accessors[primitive["attributes"][f"{SPLATS}:ROTATION"]]
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
    kinds = [(5126, "VEC3"), (5120, "VEC4"), (5126, "VEC3"), (5121, "SCALAR"), (5126, "VEC3")]
    accessors = [
        {"bufferView": 0, "byteOffset": offset, "componentType": kind, "count": 2, "type": shape}
        | ({"normalized": True} if kind != 5126 else {})
        for (kind, shape), (_, offset) in zip(kinds, (rows.dtype.fields or {}).values(), strict=True)
    ]
    names = ["POSITION", *(f"{SPLATS}:{name}" for name in ("ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0"))]
    attributes = {name: i for i, name in enumerate(names)}
    document = {
        "asset": {"version": "2.0"},
        "meshes": [{"primitives": [{"attributes": attributes, "extensions": {SPLATS: {"kernel": "ellipse"}}}]}],
        "accessors": accessors,
        "bufferViews": [{"buffer": 0, "byteLength": rows.nbytes, "byteStride": rows.itemsize}],
        "buffers": [{"byteLength": rows.nbytes}],
    }
    g, comments = read_gltf(with_document(tmp_path / "a.glb", document, rows.tobytes()))
    expected = ({}, rows["p"].tolist(), [[1, 0, 0, 0], [0, 1, 0, 0]])
    assert (comments, g.centers.tolist(), g.quats_wxyz.tolist()) == expected
    np.testing.assert_allclose(g.opacities, [1, 0.2], rtol=1e-6)


COMPRESSED = {"KHR_gaussian_splatting_compression_spz_2": {}}


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
            lambda p: p["extensions"][SPLATS].update(extensions=COMPRESSED),
            "packed by KHR_gaussian_splatting_compression_spz_2, expected plain attributes",
        ),
    ],
)
def test_what_is_no_plain_set_of_gaussians_is_refused(
    written: tuple[Path, GaussianSet], change: Callable[[dict[str, Any]], object], message: str
) -> None:
    path, gaussians = written
    document, binary = document_of(path)
    primitive, accessors = document["meshes"][0]["primitives"][0], document["accessors"]
    scale = accessors[primitive["attributes"][f"{SPLATS}:SCALE"]]
    start = document["bufferViews"][scale["bufferView"]]["byteOffset"]
    logs = np.log(gaussians.scales).tobytes()
    drafts = with_document(path, document, binary[:start] + logs + binary[start + len(logs) :])
    expect_refusal("splat 0: .*:SCALE: expected no negative sigma, got .*drafts", read_gltf, drafts)
    accessors[0]["count"] = 10**6
    expect_refusal(
        r"accessor 0: reaches beyond the \d+ bytes of data", read_gltf, with_document(path, document, binary)
    )
    accessors[0]["count"] = len(gaussians)
    change(primitive)
    expect_refusal(message, read_gltf, with_document(path, document, binary))


@pytest.fixture
def usd_core() -> Any:
    return pytest.importorskip("pxr", reason="usd-core is not installed: USD was not written")


@pytest.mark.usefixtures("usd_core")
def test_the_stage_is_a_particle_field_in_metres_with_z_up(tmp_path: Path) -> None:
    from pxr import Usd, UsdGeom, UsdVol

    gaussians = gaussian_set(5, degree=1)
    write_usd(tmp_path / "a.usda", gaussians, {}, suffix=".usda")
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == (UsdGeom.Tokens.z, 1)
    field = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    quat = field.GetOrientationsAttr().Get()[0]
    np.testing.assert_array_equal([quat.GetReal(), *quat.GetImaginary()], gaussians.quats_wxyz[0])
    assert field.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 1
    coefficients = np.asarray(field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get())
    np.testing.assert_array_equal(coefficients[:4], gaussians.harmonics[0])
    lower, upper = np.asarray(field.GetExtentAttr().Get())
    assert (lower <= gaussians.centers).all() and (gaussians.centers <= upper).all()


@pytest.mark.usefixtures("usd_core")
def test_what_is_no_particle_field_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.usda"
    write_usd(path, replace(gaussian_set(2), labels=np.uint8([0, 1])), {}, suffix=".usda")
    good = path.read_text()
    for text, said in (
        ('#usda 1.0\ndef Xform "World" {}\n', "expected one ParticleField3DGaussianSplat, got 0"),
        ("no such file", "no USD file that the library can open"),
        (
            good.replace("label = [0, 1]", "label = [0, 1, 1]"),
            "label: expected a number from 0 to 255 for each of 2",
        ),
        (good.replace("float3[] scales", "float3[] sizes"), "its ParticleField3DGaussianSplat has no scales"),
    ):
        path.write_text(text)
        expect_refusal(said, read_usd, path, suffix=".usda")


@pytest.mark.usefixtures("usd_core")
def test_a_disk_that_is_full_is_an_error_of_writing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pxr import Sdf, Tf

    def export(_layer: object, _path: str) -> None:
        raise Tf.ErrorException("Error occurred writing file: No space left on device")

    monkeypatch.setattr(Sdf.Layer, "Export", export)
    with pytest.raises(OSError, match="No space left on device") as caught:
        write_usd(tmp_path / "a.usdc", gaussian_set(2), {}, suffix=".usdc")
    assert caught.value.errno == errno.ENOSPC
    assert not list(tmp_path.iterdir())
