"""Points of a CSV file: headers, blocks, and each thing that is wrong, by its line."""

import io

import numpy as np
import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.formats import ply
from splatctrl_cli.formats.ply import point_blocks


def points_in(text: str) -> list[list[float]]:
    return [row for block in point_blocks(io.StringIO(text), "a.csv") for row in block.tolist()]


@pytest.mark.parametrize(
    "text",
    [
        "1,2,3\n4,5,6\n",
        "x,y,z\n1,2,3\n\n4,5,6",
        "\ufeffx,y,z\r\n1,2,3\r\n4,5,6\r\n",
        'name, Z ,x,y\n"a, b",3,1,2\nc,6,4,5\n',
    ],
)
def test_columns_are_found_with_a_header_and_without(text: str) -> None:
    assert points_in(text) == [[1, 2, 3], [4, 5, 6]]


def test_a_table_comes_in_blocks_that_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ply, "POINTS_PER_BLOCK", 4)
    blocks = [*point_blocks(io.StringIO("x,y,z\n" + "1,2,3\n" * 10), "a.csv")]
    assert [len(block) for block in blocks] == [4, 4, 2]
    assert all(block.dtype == np.float64 for block in blocks)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "a.csv: has no points; give"),
        ("x,y,z\n", "a.csv: has a header and no points"),
        ("x,y\n1,2\n", "a.csv: no column z: expected a header with x, y and z, or three numbers a line, got 'x,y'"),
        ("x,y,z,x\n1,2,3,4\n", "a.csv: several columns x"),
        ("1,2\n3,4\n", "a.csv: no column x"),
        ("1,2,3,4\n", "three numbers a line, got '1,2,3,4'"),
        ("x,y,z\n1,2,3\n\n1,2\n", "a.csv: line 4: expected 3 columns, got 2"),
        ("1,2,3\n1,2,3,4\n", "a.csv: line 2: expected 3 columns, got 4"),
        ("1,2,3\n1,nan,3\n", "a.csv: line 2: column y: expected a finite number up to 1e+06 m, got 'nan'"),
        ("z,y,x\n1,2,inf\n", "a.csv: line 2: column x: expected a finite number"),
        ("x,y,z\n1,,3\n", "line 2: column y: expected a finite number up to 1e+06 m, got ''"),
        ("x,y,z\n1,2,3\n1,2,1e7\n", "line 3: column z"),
        ('x,y,z\n1,2,"' + "3" * 200_000 + '"\n', "line 2: no CSV text: field larger"),
    ],
)
def test_what_is_no_table_of_points_is_refused_by_its_line(text: str, said: str) -> None:
    with pytest.raises(InputError) as refused:
        points_in(text)
    assert said in str(refused.value)
