"""capture.json of another program is read only where it says what a capture needs."""

from pathlib import Path
from typing import Any

import pytest

from splatctrl_cli.captures.capture_header import check_header
from splatctrl_cli.errors import InputError

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
