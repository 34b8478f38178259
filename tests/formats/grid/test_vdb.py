import ast
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.formats.grid.npz_grid import write_npz
from splatctrl_cli.formats.grid.vdb import openvdb, read_vdb_head, write_vdb
from splatctrl_cli.recording.source import describe
from tests.formats.grid.make_grid import random_grid, with_unknown

ROOT = Path(__file__).parents[3]
ROUND_TRIP = """
import ast, sys
from pathlib import Path
import numpy as np
from splatctrl_cli.formats.grid.vdb import openvdb, write_vdb
from splatctrl_cli.records import DistanceGrid
folder, vdb = Path(sys.argv[1]), openvdb()
arrays = dict(np.load(folder / "arrays.npz"))
header = ast.literal_eval(sys.argv[2])
grid = DistanceGrid(origin=np.array([-0.1, 0.2, 0.3]), voxel=0.02, channels=arrays, header=header)
for name in ("a.vdb", "b.vdb"):
    write_vdb(folder / name, grid)
read, found = {}, []
for made in vdb.readAll(str(folder / "a.vdb"))[0]:
    values = np.full(arrays[made.name].shape, 99.0, np.float32)
    made.copyToArray(values)
    read[made.name] = values
    outside = made.getConstAccessor().probeValue((-1, 0, 0))
    found.append((made.name, made.gridClass, made.activeVoxelCount(), outside, made.background,
                  made.transform.indexToWorld((4, 1, 10)), dict(made.metadata)))
np.savez(folder / "read.npz", **read)
print(repr(found))
"""


def python_with_openvdb() -> str:
    """An interpreter that has OpenVDB's module and a NumPy that it was built for."""
    for python in (sys.executable, "/usr/bin/python3"):
        program = "import numpy, sys\ntry: import openvdb\nexcept ImportError: import pyopenvdb\n"
        if not shutil.which(python):
            continue
        if subprocess.run([python, "-c", program], capture_output=True, check=False).returncode == 0:
            return python
    pytest.skip("no Python with OpenVDB's module here: .vdb files are not tried on OpenVDB itself")


def test_openvdb_reads_every_value_at_its_place(tmp_path: Path) -> None:
    python = python_with_openvdb()
    grid = with_unknown(random_grid(shape=(20, 9, 13)))
    np.savez(tmp_path / "arrays.npz", **grid.channels)  # type: ignore[arg-type]
    result = subprocess.run(
        [python, "-c", ROUND_TRIP, str(tmp_path), repr(grid.header)],
        capture_output=True,
        text=True,
        check=False,
        env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"},
    )
    assert result.returncode == 0, result.stderr
    found = {name: rest for name, *rest in ast.literal_eval(result.stdout)}
    assert found.keys() == grid.channels.keys()
    with np.load(tmp_path / "read.npz") as read:
        for name, values in grid.channels.items():
            kind, num_active, outside, background, place, metadata = found[name]
            blank = np.isnan(values)
            is_vector = values.ndim == 4
            np.testing.assert_array_equal(read[name][~blank], values[~blank].astype(np.float32))
            np.testing.assert_array_equal(read[name][blank], 0.0 if is_vector else np.float32(background))
            assert num_active == values[..., 0].size - blank[..., 0].sum() if is_vector else values.size - blank.sum()
            assert outside == (background, False)
            assert is_vector or np.float32(background) == np.nextafter(np.nanmax(values).astype("f4"), np.float32(9))
            np.testing.assert_allclose(place, (-0.02, 0.22, 0.5), atol=1e-12)
            assert kind == ("level set" if name in {"sdf", "hard", "se", "gpdf"} else "unknown")
            assert metadata["sign"] == "positive outside"
            assert metadata["labels"] == '["human", "object"]'
            assert metadata["length_scale"] == 0.02
    heads = {name: (kind, metadata) for name, kind, metadata in read_vdb_head(tmp_path / "a.vdb")}
    assert heads.keys() == grid.channels.keys()
    assert heads["gradient"][0] == "Tree_vec3s_5_4_3"
    assert {key: heads["sdf"][1][key] for key in ("frame", "version", "note")} == {
        key: grid.header[key] for key in ("frame", "version", "note")
    }
    assert (tmp_path / "a.vdb").read_bytes() == (tmp_path / "b.vdb").read_bytes()
    summary = describe(tmp_path / "a.vdb")
    assert (summary.kind, summary.facts["grids"]) == ("OpenVDB", len(grid.channels))
    assert (summary.facts["labels"], summary.facts["distance"]) == (["human", "object"], "safe")
    assert ["sdf", "Tree_float_5_4_3", "level set", 20 * 9 * 13 - 12] in list(summary.grids[0].rows)
    content = (tmp_path / "a.vdb").read_bytes()
    for length in (9, 30, 70, 200):
        (tmp_path / "cut.vdb").write_bytes(content[:length])
        with pytest.raises(InputError, match="not a readable OpenVDB file"):
            read_vdb_head(tmp_path / "cut.vdb")


def test_without_openvdb_the_remedy_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "openvdb", None)
    monkeypatch.setitem(sys.modules, "pyopenvdb", None)
    with pytest.raises(UsageError, match=r"cannot be imported.*; install OpenVDB's Python module: conda-forge"):
        openvdb()
    with pytest.raises(UsageError):
        write_vdb(tmp_path / "field.vdb", random_grid())
    write_npz(tmp_path / "field.npz", random_grid())
    with pytest.raises(InputError, match="expected an OpenVDB file"):
        read_vdb_head(tmp_path / "field.npz")
