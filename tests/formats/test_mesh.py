from pathlib import Path

import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.formats.mesh import load_mesh


def test_files_that_are_no_mesh_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"gone.obj: expected a mesh, got no such file"):
        load_mesh(tmp_path / "gone.obj")
    (tmp_path / "words.stl").write_text("nothing of the kind")
    with pytest.raises(InputError, match=r"words.stl: expected a mesh, got .*; give"):
        load_mesh(tmp_path / "words.stl")
    (tmp_path / "cloud.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    with pytest.raises(InputError, match=r"cloud.obj: expected a mesh, got"):
        load_mesh(tmp_path / "cloud.obj")
    (tmp_path / "nan.obj").write_text("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(InputError, match=r"nan.obj: expected finite vertices"):
        load_mesh(tmp_path / "nan.obj")
