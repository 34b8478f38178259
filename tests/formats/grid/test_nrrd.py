import json
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.formats.grid.nrrd import PREFIX, write_nrrd
from tests.formats.grid.make_grid import random_grid, with_unknown


@pytest.mark.parametrize("channel", ["sdf", "gradient", "observed", "bound"])
def test_pynrrd_reads_every_value_at_its_place(tmp_path: Path, channel: str) -> None:
    nrrd = pytest.importorskip("nrrd", reason="pynrrd is not installed: not tried on its reader")
    grid = with_unknown(random_grid())
    write_nrrd(tmp_path / "field.nrrd", grid, channel)
    values, header = nrrd.read(str(tmp_path / "field.nrrd"))
    is_vector = channel == "gradient"
    np.testing.assert_array_equal(np.moveaxis(values, 0, -1) if is_vector else values, grid.channels[channel])
    assert values.dtype == grid.channels[channel].dtype
    assert (header["space"], header["content"]) == ("3D-right-handed", channel)
    directions = header["space directions"][1:] if is_vector else header["space directions"]
    np.testing.assert_array_equal(directions, 0.02 * np.eye(3))
    np.testing.assert_array_equal(header["space origin"], grid.origin)
    assert header["kinds"] == ["vector"] * is_vector + ["domain"] * 3
    assert header["space units"] == ["m", "m", "m"]
    assert header.get("sample units") == (None if channel in {"gradient", "observed"} else "m")
    ours = {key.removeprefix(PREFIX): json.loads(text) for key, text in header.items() if key.startswith(PREFIX)}
    assert ours == grid.header
