"""Splat files, point clouds and exports of other tools."""

import gzip
import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray

from splatctrl_cli.formats.ply import read_points, read_positions
from tests.cases.case import Case, Run, expect_result

SIDE = 20  # splats along a side of the plane

SPACING = 0.05  # [m]

FORMATS = {"<": "binary_little_endian", ">": "binary_big_endian", "=": "ascii"}

TYPES = {"f8": "double", "f4": "float", "u1": "uchar", "i4": "int"}

EMPTY_FACES = ("element face 0\nproperty list uchar int vertex_indices\n", b"", b"")

TRIANGLES = (
    "element face 2\nproperty list uchar int vertex_indices\nproperty uchar flags\n",
    b"3 0 1 2 7\n4 0 1 2 3 7\n",
    b"",
)

UTM = (500000.0, 5400000.0, 312.0)


def plane_rows(
    origin: Sequence[float] = (0, 0, 0), place: str = "f8", unit: float = 1.0, **others: float
) -> NDArray[Any]:
    """A plane of round splats of 20 mm, 50 mm apart, its metres in `unit`; `others` are columns beside, None for no
    such column.
    """
    x, y = np.meshgrid(SPACING * np.arange(SIDE) - 0.475, SPACING * np.arange(SIDE) - 0.475)
    scales = dict.fromkeys(("scale_0", "scale_1", "scale_2"), float(np.log(0.02)))
    colour = {**dict.fromkeys(("f_dc_0", "f_dc_1", "f_dc_2"), 0.3), "opacity": 4.0, **scales}
    given = {**colour, "rot_0": 1.0, "rot_1": 0.0, "rot_2": 0.0, "rot_3": 0.0, **others}
    columns = {name: value for name, value in given.items() if value is not None}
    rows = np.zeros(SIDE * SIDE, [*((axis, place) for axis in "xyz"), *((name, "f4") for name in columns)])
    for axis, values, offset in zip("xyz", (x, y, 0.01 * np.sin(7 * x)), origin, strict=True):
        rows[axis] = unit * (values.ravel() + offset)
    for name, value in columns.items():
        rows[name] = value
    return rows


def write_ply(
    path: Path,
    rows: NDArray[Any],
    order: str = "<",
    *,
    before: tuple[str, bytes, bytes] = ("", b"", b""),
    after: tuple[str, bytes, bytes] = ("", b"", b""),
) -> None:
    """A table as element vertex in a byte order, with header lines, text and bytes of elements before and after."""
    fields: Mapping[str, Any] = rows.dtype.fields or {}
    properties = "".join(f"property {TYPES[kind.str[1:]]} {name}\n" for name, (kind, *_) in fields.items())
    vertex = f"element vertex {len(rows)}\n{properties}"
    header = f"ply\nformat {FORMATS[order]} 1.0\n{before[0]}{vertex}{after[0]}end_header\n".encode()
    if order == "=":
        text = "".join(" ".join(repr(value.item()) for value in row) + "\n" for row in rows)
        path.write_bytes(header + before[1] + text.encode() + after[1])
    else:
        swapped = rows.astype(rows.dtype.newbyteorder(order))
        path.write_bytes(header + before[2] + swapped.tobytes() + after[2])


def face_bytes(order: str) -> tuple[str, bytes, bytes]:
    """Two faces of 3 and 4 corners, in text and in bytes of an order."""
    bytes_ = b"".join(
        bytes([len(face)]) + np.array(face, f"{order}i4").tobytes() + b"\x07" for face in ([0, 1, 2], [0, 1, 2, 3])
    )
    return TRIANGLES[0], TRIANGLES[1], bytes_


def _examine_double(folder: Path, out: Path, run: Run) -> None:
    source = folder / "10-double-utm.ply"
    moves = "has steps of 0.5 m there and would move them by 0.2"
    expect_result(run, ["sdf-bake", source, "-o", out / "field"], moves, "'splatctrl export", code=4)
    for suffix, bound, is_kept in ((".ply", 1e-6, True), (".glb", 1e-6, True), (".spz", 2e-4, False)):
        file = out / f"moved{suffix}"
        said = expect_result(run, ["export", source, "-o", file], "centres are less the origin 500000 5400000 300 m")
        assert ("not kept: origin" in said.text) is not is_kept
        assert 0 < exported(run, source, out / f"again{suffix}")["differences"]["center"] <= bound
        baked(run, file, out / f"field{suffix}")
    assert "origin" in run(["info", out / "moved.ply"]).text
    moved = read_positions(out / "moved.ply") + np.array([500000, 5400000, 300])
    np.testing.assert_allclose(moved, read_positions(source), rtol=0, atol=1e-6)


def _siblings_of_double(folder: Path) -> None:
    write_ply(folder / "small.ply", plane_rows((0.123456789, 1.0, 2.0)))
    write_ply(folder / "float.ply", plane_rows(UTM, "f4"))
    write_ply(folder / "text.ply", plane_rows(UTM), "=")
    text = (folder / "text.ply").read_text().replace("property double", "property float")
    (folder / "text_float.ply").write_text(text)
    write_ply(folder / "big.ply", plane_rows(UTM, scale_1=-3.0), ">")


def _examine_siblings_of_double(folder: Path, out: Path, run: Run) -> None:
    found = exported(run, folder / "small.ply", out / "small.ply")
    assert found["origin"] is None and 1e-9 < found["differences"]["center"] < 1.3e-7
    baked(run, folder / "small.ply", out / "field")
    rounded = "rounded to float32, whose steps of 0.5 m there are larger than the splats (sigma 0.02 m)"
    neither(run, folder / "float.ply", out, rounded)
    for name in ("text.ply", "text_float.ply", "big.ply"):
        assert exported(run, folder / name, out / name)["origin"] == "500000 5400000 300"


LINEAR = "expected log(sigma [m]), got 0.02 to 0.02: splats of 1.02 m, 0.05"


def _examine_linear(folder: Path, out: Path, run: Run) -> None:
    looks = "the scales look like sigmas: write their logarithms"
    neither(run, folder / "11-linear-scale.ply", out, LINEAR, looks)


def _siblings_of_linear(folder: Path) -> None:
    flat: dict[str, Any] = {"scale_1": None, "scale_2": None}
    scales, rotations = ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
    sigmas = dict.fromkeys(("sigma_0", "sigma_1", "sigma_2"), 0.02)
    millimetres = plane_rows(unit=1000.0, **dict.fromkeys(scales, float(np.log(20.0))))
    files = {
        "alone_linear": plane_rows(scale_0=0.02, **flat),
        "alone": plane_rows(**flat, **dict.fromkeys(rotations)),  # type: ignore[arg-type]
        "two": plane_rows(scale_2=None),  # type: ignore[arg-type]
        "zero": plane_rows(scale_0=0.02, scale_1=0.01, scale_2=0.0),
        "other_unit": plane_rows(**dict.fromkeys(scales, 3.0)),
        "millimetres": millimetres,
        "sigma": plane_rows(**dict.fromkeys(scales), **sigmas),  # type: ignore[arg-type]
    }
    for name, rows in files.items():
        write_ply(folder / f"{name}.ply", rows)


def _examine_siblings_of_linear(folder: Path, out: Path, run: Run) -> None:
    sentences = {
        "alone_linear.ply": "splats of 1.02 m, 0.05",
        "zero.ply": "got 0 to 0.02",
        "other_unit.ply": "write scales and centres in one unit",
        "two.ply": "the flat splats of 2D-GS have no third sigma",
        "sigma.ply": "write them by these names: scale_* is log(sigma [m])",
    }
    for name, sentence in sentences.items():
        neither(run, folder / name, out, sentence)
    for name in ("alone.ply", "millimetres.ply"):
        assert exported(run, folder / name, out / name)["num_splats"] == SIDE * SIDE
    baked(run, folder / "alone.ply", out / "field")


def _points() -> NDArray[Any]:
    colours = ("red", "green", "blue", "alpha")
    rows = np.zeros(SIDE * SIDE, [*((axis, "f4") for axis in "xyz"), *((name, "u1") for name in colours)])
    for axis in "xyz":
        rows[axis] = plane_rows()[axis]
    rows["red"] = 255
    return rows


def _empty_faces(folder: Path) -> None:
    write_ply(folder / "11-face0.ply", plane_rows(place="f4"), after=EMPTY_FACES)
    write_ply(folder / "11-face0-ascii.ply", plane_rows(place="f4"), "=", after=EMPTY_FACES)
    write_ply(folder / "11-points-face0.ply", _points(), after=EMPTY_FACES)


def _examine_empty_faces(folder: Path, out: Path, run: Run) -> None:
    for name in ("11-face0.ply", "11-face0-ascii.ply"):
        assert exported(run, folder / name, out / name)["num_splats"] == SIDE * SIDE
        baked(run, folder / name, out / f"field {name}")
    points = read_points(folder / "11-points-face0.ply").points
    assert np.array_equal(points, read_positions(folder / "11-face0.ply").astype(np.float32))


def _faces(folder: Path) -> None:
    for order, name in (("<", "little"), (">", "big"), ("=", "text")):
        rows, faces = plane_rows(place="f4"), face_bytes("<" if order == "=" else order)
        write_ply(folder / f"before {name}.ply", rows, order, before=faces)
        write_ply(folder / f"after {name}.ply", rows, order, after=faces)
        write_ply(folder / f"points {name}.ply", _points(), order, before=faces, after=EMPTY_FACES)
    whole = (folder / "after little.ply").read_bytes()
    (folder / "cut.ply").write_bytes(whole[:-3])
    (folder / "long.ply").write_bytes(whole + b"123")


def _examine_faces(folder: Path, out: Path, run: Run) -> None:
    wanted = plane_rows(place="f4")
    for name in ("little", "big", "text"):
        for place in ("before", "after"):
            file = folder / f"{place} {name}.ply"
            assert exported(run, file, out / file.name)["num_splats"] == SIDE * SIDE
            assert np.array_equal(read_positions(out / file.name)[:, 2].astype(np.float32), wanted["z"])
        assert np.array_equal(read_positions(folder / f"points {name}.ply")[:, 0].astype(np.float32), wanted["x"])
    for name, sentence in (("cut.ply", "cut short"), ("long.ply", "longer than its header says")):
        expect_result(run, ["export", folder / name, "-o", out / name], sentence, code=4)


def spz_parts(degree: int = 0) -> list[bytes]:
    """Centres, opacities, colours, sigmas, rotations and harmonics of a plane of 400 splats at z = 0.5."""
    grid = np.rint(4096 * np.linspace(0, 1, SIDE)).astype(int)
    places = [(x, y, 2048) for y in grid.tolist() for x in grid.tolist()]
    centers = b"".join(value.to_bytes(3, "little", signed=True) for place in places for value in place)
    num, sigma = len(places), round(16 * (np.log(0.02) + 10))
    rotations = struct.pack("<I", 3 << 30) * num  # w is the largest, the others are 0
    harmonics = bytes([128]) * (num * 3 * ((degree + 1) ** 2 - 1))
    return [centers, bytes([240]) * num, bytes([200]) * 3 * num, bytes([sigma]) * 3 * num, rotations, harmonics]


def spz_4(
    parts: Sequence[bytes], *, version: int = 4, degree: int = 0, place: int = 32, flags: int = 0, level: int = 3
) -> bytes:
    """A file of version 4: a plain header, sizes, a stream of zstd for each of the parts."""
    packed = [zstandard.ZstdCompressor(level=level, write_content_size=level > 1).compress(part) for part in parts]
    head = struct.pack("<IIIBBBBI12x", 0x5053474E, version, SIDE * SIDE, degree, 12, flags, len(parts), place)
    table = b"".join(struct.pack("<QQ", len(short), len(part)) for short, part in zip(packed, parts, strict=True))
    return head.ljust(place, b"\0") + table + b"".join(packed)


def _examine_spz(folder: Path, out: Path, run: Run) -> None:
    assert exported(run, folder / "06-v4.spz", out / "a.ply")["num_splats"] == SIDE * SIDE
    centers = read_positions(out / "a.ply")
    assert np.abs(centers[:, 2] - 0.5).max() < 1e-3
    assert np.abs(np.sort(np.unique(centers[:, 0].round(3))) - np.linspace(0, 1, SIDE)).max() < 1e-3
    baked(run, folder / "06-v4.spz", out / "field")
    assert "0.0195, 0.0195, 0.0195" in run(["info", folder / "06-v4.spz"]).text


def _other_spz(folder: Path) -> None:
    parts, whole = spz_parts(), spz_4(spz_parts())
    header = struct.pack("<IIIBBBB", 0x5053474E, 3, SIDE * SIDE, 0, 12, 0, 0)
    many = struct.pack("<IIIBBBB", 0x5053474E, 3, 1 << 31, 0, 12, 0, 0)
    files = {
        "five.spz": spz_4(parts[:5]),
        "far.spz": spz_4(parts, place=64, level=1),
        "harmonics.spz": spz_4(spz_parts(3), degree=3),
        "v3.spz": gzip.compress(header + b"".join(parts)),
        "v5.spz": spz_4(parts, version=5),
        "v9.spz": gzip.compress(header.replace(b"\x03", b"\x09", 1) + b"".join(parts)),
        "cut.spz": whole[:-3],
        "header.spz": whole[:20],
        "damaged.spz": whole[:300] + bytes(40) + whole[340:],
        "wrong.spz": spz_4([parts[0][:-9], *parts[1:]]),
        "three.spz": spz_4(parts[:3]),
        "extended.spz": spz_4(parts, flags=2),
        "bomb.spz": gzip.compress(header + bytes(1 << 26)),
        "many.spz": gzip.compress(many + bytes(1 << 20)),
        "text.spz": b"splats",
    }
    for name, content in files.items():
        (folder / name).write_bytes(content)


def _examine_other_spz(folder: Path, out: Path, run: Run) -> None:
    for name in ("five.spz", "far.spz", "harmonics.spz", "v3.spz"):
        assert exported(run, folder / name, out / f"{name}.ply")["num_splats"] == SIDE * SIDE
        assert (read_positions(out / f"{name}.ply")[:, 2] == 0.5).all()
    sentences = {
        "v5.spz": "expected 2 or 3 in gzip and 4 in plain, got 5",
        "v9.spz": "expected 2 or 3 in gzip and 4 in plain, got 9",
        "cut.spz": "copy or write the file again",
        "header.spz": "expected 6 streams after 32 bytes",
        "damaged.spz": "stream 0: cannot be decompressed; copy or write the file again",
        "wrong.spz": "stream 0: expected 3600 bytes unpacked, got 3591",
        "three.spz": "expected 6 streams after 32 bytes, got 3",
        "extended.spz": "has vendor extensions (flags 0x2), expected none; write it without them",
        "bomb.spz": "expected 8000 bytes for 400 splats, got more",
        "many.spz": "announces 2147483648 splats, more than a file of",
        "text.spz": "expected it to start as gzip or with NGSP",
    }
    again = "write the file again"
    for name, sentence in sentences.items():
        neither(run, folder / name, out, sentence)
        said = run(["export", folder / name, "-o", out / "export.ply"]).text
        assert (again in said) is (again in sentence)


CASES: tuple[Case, ...] = (
    Case(
        name="08-ply-double-utm",
        make=lambda folder: write_ply(folder / "10-double-utm.ply", plane_rows(UTM)),
        examine=_examine_double,
        has_shared=True,
    ),
    Case(name="ply-double-and-float-coordinates", make=_siblings_of_double, examine=_examine_siblings_of_double),
    Case(
        name="33-ply-linear-scales",
        make=lambda folder: write_ply(
            folder / "11-linear-scale.ply", plane_rows(scale_0=0.02, scale_1=0.02, scale_2=0.02)
        ),
        examine=_examine_linear,
        has_shared=True,
    ),
    Case(name="ply-scales-of-other-kinds", make=_siblings_of_linear, examine=_examine_siblings_of_linear),
    Case(
        name="18-spz-v4",
        make=lambda folder: (folder / "06-v4.spz").write_bytes(spz_4(spz_parts())),
        examine=_examine_spz,
        has_shared=True,
    ),
    Case(name="spz-of-other-versions", make=_other_spz, examine=_examine_other_spz),
    Case(name="19-ply-empty-face-element", make=_empty_faces, examine=_examine_empty_faces, has_shared=True),
    Case(name="ply-faces-before-and-after", make=_faces, examine=_examine_faces),
)


def exported(run: Run, source: Path, out: Path) -> dict[str, Any]:
    """What `export --json` says of a file that it could write."""
    found: dict[str, Any] = json.loads(expect_result(run, ["export", source, "-o", out, "--json"]).out)
    return found


def baked(run: Run, source: Path, out: Path) -> None:
    """Assert that a field is made of all splats; a coarse one, for speed."""
    words = ["sdf-bake", source, "-o", out, "--json", "--voxel", "0.1", "--set", "field.max_loss=1", "--no-report"]
    assert f'"num_splats": {SIDE * SIDE}' in expect_result(run, words).out


def neither(run: Run, source: Path, out: Path, *parts: str) -> None:
    """Assert that `export` and `sdf-bake` refuse a file with these words."""
    for command in ("export", "sdf-bake"):
        expect_result(run, [command, source, "-o", out / f"{command}.ply"], *parts, code=4)
