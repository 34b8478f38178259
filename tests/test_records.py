"""The box that a person types, and the order of records."""

from types import SimpleNamespace

import numpy as np
import pytest

from splatctrl_cli.errors import UsageError
from splatctrl_cli.records import Box, PointCloud, by_stamp


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


def test_columns_that_are_joined_are_those_of_each_in_order() -> None:
    one, two, none = (PointCloud(points=np.ones((n, 3), np.float32) * n, colors=np.eye(3)[:n]) for n in (1, 2, 0))
    both = two.joined(none, one)
    assert (len(both), both.points[:, 0].tolist(), both.points.dtype) == (3, [2, 2, 1], np.float32)
    assert both.colors.tolist() == [*np.eye(3)[:2].tolist(), np.eye(3)[0].tolist()]
    assert one.joined().points.tolist() == one.points.tolist()
