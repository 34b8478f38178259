"""The box that a person types, and the order of records."""

from types import SimpleNamespace

import pytest

from splatctrl_cli.errors import UsageError
from splatctrl_cli.records import Box, by_stamp


def test_a_box_is_read_lower_corner_first() -> None:
    box = Box.from_text("-1,-2,0,1,2.5,3e-1")
    assert box.lower.tolist() == [-1, -2, 0]
    assert box.upper.tolist() == [1, 2.5, 0.3]


@pytest.mark.parametrize(
    "text", ["0,0,0,1,1", "0,0,0,1,1,0", "0,0,0,1,1,a", "-inf,0,0,1,1,1", "0,0,0,1,1,inf", "0,0,0,1,1,nan"]
)
def test_a_box_that_is_not_six_finite_numbers_in_order_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match=f"--box {text}: expected finite x0,y0,z0"):
        Box.from_text(text)


def test_of_one_stamp_the_items_of_an_earlier_stream_come_first_each_in_its_own_order() -> None:
    streams = [[(1, "a"), (3, "b"), (3, "c")], [(3, "d"), (4, "e")], [(0, "f"), (3, "g")]]
    merged = by_stamp(*([SimpleNamespace(stamp_ns=stamp, name=name) for stamp, name in items] for items in streams))
    assert "".join(item.name for item in merged) == "fabcdge"
