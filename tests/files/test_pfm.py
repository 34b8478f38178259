"""PFM images: either byte order, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.files.pfm import read_pfm


@pytest.mark.parametrize("is_little", [True, False])
def test_pfm_of_either_byte_order_starts_at_the_bottom_row(tmp_path: Path, is_little: bool) -> None:
    rows = np.array([[3, 4], [1, 2]], dtype="<f4" if is_little else ">f4")
    (tmp_path / "a.pfm").write_bytes(f"Pf\n2 2\n{'-1.0' if is_little else '1'}\n".encode() + rows.tobytes())
    np.testing.assert_array_equal(read_pfm(tmp_path / "a.pfm"), [[1, 2], [3, 4]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"P6\n2 2\n255\n", "expected a PFM image"),
        (b"PF\n2 2\n-1.0\n", "expected one channel"),
        (b"Pf\n2 2\n-2.5\n" + b"\0" * 16, "of scale 1, got Pf of scale -2.5"),
        (b"Pf\n2 2\n-1.0\n" + b"\0" * 15, "expected 16 bytes for 2x2, got 15"),
        (b"Pf\n0 " + b"8" * 55 + b"\n-1.0\n", "expected pixels, got 0x888"),
    ],
)
def test_damaged_pfm_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "a.pfm").write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_pfm(tmp_path / "a.pfm")
