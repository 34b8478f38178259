"""The CSV of a replay."""

from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.jobs.replay.files import write_steps


def test_a_row_per_step_with_nothing_where_there_is_no_value(tmp_path: Path) -> None:
    columns = {"stamp_ns": [1, 2], "d": [np.float64(0.123456789012), float("nan")], "name": ["a[0]", "b; c"]}
    write_steps(tmp_path / "steps.csv", [columns])
    assert (tmp_path / "steps.csv").read_text() == "stamp_ns,d,name\n1,0.123456789,a[0]\n2,,b; c\n"


def test_columns_of_unequal_length_are_an_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="shorter"):
        write_steps(tmp_path / "steps.csv", [{"a": [1, 2], "b": [1]}])
