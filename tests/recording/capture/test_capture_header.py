"""capture.json of another program is read only where it says what a capture needs; frames.csv and SHA256SUMS are read
a row at a time.
"""

import hashlib
from pathlib import Path
from typing import Any

import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.recording.capture.capture_header import COLUMNS, FileSums, FrameRows, check_header

CAMERA = {"width": 8, "height": 6, "fx": 9.0, "fy": 9, "cx": 3.5, "cy": 2.5, "depth_scale": 0.001}
HEADER: dict[str, Any] = {
    **{"world_frame": "world", "has_clock": True, "joint_names": ["a"], "cameras": {"cam": CAMERA}},
    **{"loss": {"damaged": 1, "notes": ["x"]}, "sources": {}, "name": "x"},
}


def test_what_is_right_passes() -> None:
    check_header(Path("capture.json"), HEADER)
    check_header(Path("capture.json"), HEADER | {"cameras": {"cam": CAMERA | {"depth_scale": None}}})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("world_frame", 3), ("has_clock", "yes"), ("joint_names", "ab"), ("joint_names", [1]), ("sources", [])),
        *(("loss", {"odd": 1}), ("loss", {"notes": "x"}), ("loss", []), ("loss", {"damaged": "1"}), ("cameras", [])),
        *(("cameras", {"cam": {**CAMERA, key: value}}) for key in CAMERA for value in ("1", -1, 1e400, True, [])
          if not (key in {"cx", "cy"} and value == -1) and not (key in {"width", "height"} and value is True)),
        *(("cameras", {"cam": {k: v for k, v in CAMERA.items() if k != key}}) for key in list(CAMERA)[:-1]),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(name: str, value: object) -> None:
    with pytest.raises(InputError, match=rf"^x/capture.json: {name}: expected"):
        check_header(Path("x/capture.json"), HEADER | {name: value})
    with pytest.raises(InputError, match=rf"^x/capture.json: {name} is missing"):
        check_header(Path("x/capture.json"), {key: entry for key, entry in HEADER.items() if key != name})


HEAD = ",".join(COLUMNS) + "\n"


def line(camera: str, number: int, source: str = "a b") -> str:
    return f"{camera},{number},color/{camera}/{number}.jpg,depth/{camera}/{number}.png,0,0,0,0,0,0,1,{source}\n"


def frames(folder: Path, *lines: str, head: str = HEAD) -> Path:
    path = folder / "frames.csv"
    path.write_bytes((head + "".join(lines)).encode())
    return path


def test_rows_are_those_of_the_cameras(tmp_path: Path) -> None:
    lines = [line("a", 0), "\n", line("b", 1), line("a", 2, '"two\nlines, é"'), line("a", 3).rstrip("\n")]
    rows = list(FrameRows(frames(tmp_path, *lines), ("a",)))
    assert [row["stamp_ns"] for row in rows] == ["0", "2", "3"]
    assert rows[1]["source"] == "two\nlines, é" and rows[2]["depth"] == "depth/a/3.png"
    assert rows[0]["camera"] == "a"


@pytest.mark.parametrize(
    "lines",
    [
        (line("a", 0), "a,1,b\n"),
        (line("a", 0).replace("a,0,", "a,x,"),),
        (line("a", 0).replace(",0,0,0,0", ",0,?,0,0"),),
        (line("a", 0).replace("color/a", "color/../../a"),),
        (line("a", 0).replace("depth/a", "/depth/a"),),
        ("a" * (1 << 17),),
        ("\xff\x00".encode("latin-1").decode("latin-1") + '"',),
    ],
)
def test_what_is_no_row_is_refused(tmp_path: Path, lines: tuple[str, ...]) -> None:
    with pytest.raises(InputError, match=r"frames.csv: .*; run `splatctrl ingest` again"):
        FrameRows(frames(tmp_path, *lines), ("a",))


def test_other_columns_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected columns camera, stamp_ns"):
        FrameRows(frames(tmp_path, head=HEAD.replace("qw", "w")), ("a",))
    with pytest.raises(InputError, match="expected columns camera, stamp_ns"):
        FrameRows(frames(tmp_path, head=""), ("a",))


def test_sums_are_found_by_name_and_the_last_line_of_a_name_holds(tmp_path: Path) -> None:
    digests = {f"color/é{i}.jpg": hashlib.sha256(bytes([i])).hexdigest() for i in range(200)}
    lines = [f"{digest}  {name}\n" for name, digest in reversed(digests.items())]
    odd = ["no line\n", f"{'0' * 64}  color/é7.jpg\n", "zz" * 32 + "  color/é8.jpg\n", "\n"]
    (tmp_path / "SHA256SUMS").write_text("".join([*odd[:2], *lines, *odd[2:]]), encoding="utf-8")
    sums = FileSums(tmp_path)
    assert {name: sums.get(name) for name in digests} == digests
    assert sums.get("color/é200.jpg") is None and sums.get("") is None
    (tmp_path / "SHA256SUMS").write_text("")
    assert FileSums(tmp_path).get("a") is None
    with pytest.raises(InputError, match="missing; the capture was not finished"):
        FileSums(tmp_path / "none")
