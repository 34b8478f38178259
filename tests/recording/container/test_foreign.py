"""Recordings of other tools that are not read: each is named, with what to do."""

import zipfile
from pathlib import Path

import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.recording.container.foreign import FOREIGN, Foreign, refuse_foreign
from splatctrl_cli.recording.source import describe, open_source
from tests.recording.log.make_log import make_log

NAMED = [(kind, suffix) for kind in FOREIGN for suffix in kind.suffixes]
MARKED = [kind for kind in FOREIGN if kind.magic]
HOLDING = [kind for kind in FOREIGN if kind.entry]


@pytest.mark.parametrize(("kind", "suffix"), NAMED, ids=[suffix for _, suffix in NAMED])
def test_an_ending_names_its_format_in_either_case(tmp_path: Path, kind: Foreign, suffix: str) -> None:
    for name in (f"run{suffix}", f"run{suffix.upper()}"):
        (tmp_path / name).write_bytes(b"any content")
        with pytest.raises(InputError) as caught:
            open_source(tmp_path / name)
        assert kind.what in caught.value.message
        assert caught.value.remedy == kind.remedy


@pytest.mark.parametrize("kind", MARKED, ids=lambda kind: kind.what)
def test_first_bytes_name_a_format_under_another_ending(tmp_path: Path, kind: Foreign) -> None:
    path = tmp_path / "run.dat"
    path.write_bytes(kind.magic + bytes(5000) + kind.mark)
    for read in (open_source, describe):
        with pytest.raises(InputError, match=kind.what):
            read(path)


@pytest.mark.parametrize("kind", HOLDING, ids=lambda kind: kind.what)
def test_an_entry_names_a_folder_or_a_zip_file(tmp_path: Path, kind: Foreign) -> None:
    inside = tmp_path / "run" / kind.entry
    inside.mkdir(parents=True)
    with zipfile.ZipFile(tmp_path / "run.bin", "w") as archive:
        archive.writestr(f"{kind.entry}0.jpg" if kind.entry.endswith("/") else kind.entry, b"x")
    for path in (tmp_path / "run", tmp_path / "run.bin"):
        with pytest.raises(InputError, match=kind.what):
            describe(path)


def test_marks_inside_a_log_that_is_read_name_nothing(tmp_path: Path) -> None:
    path = make_log(tmp_path / "run.mcap")
    path.write_bytes(path.read_bytes() + b"K4A_DEPTH_DELAY_NS rgbd/")
    refuse_foreign(path)
