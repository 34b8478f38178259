"""Arrays that hold gigabytes in a small file are refused by what may be meant, before they are read; and any bytes
are read, or end in the errors that the reader names: of every reader of foreign bytes in the program.
"""

import contextlib
import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.fuzz_mutate import mutated
from benchmarks.readers import Reader, all_readers, splat_suffixes
from splatctrl_cli.formats.arrays import DAMAGE, NpzFile, read_arrays, savez
from splatctrl_cli.formats.grid.npz_grid import MOST_PACKED, read_npz
from splatctrl_cli.formats.scene.scene_writer import CHECKPOINT, read_checkpoint
from splatctrl_cli.formats.scene.voxel_file import read_occupancy, read_states
from splatctrl_cli.recording.folder.idr import read_idr
from splatctrl_cli.recording.source import describe
from tests.formats.make_npz import write_zeros
from tests.properties import few
from tests.refused import expect_refusal

GIB4 = (1 << 14, 1 << 9, 1 << 9)  # of bytes


def read_columns(path: Path) -> object:
    return NpzFile(path).rows("position")


def read_scan(path: Path) -> object:
    path.rename(path.with_name("cameras.npz"))
    return read_idr(path.parent)


def read_state(path: Path) -> object:
    (path.parent / CHECKPOINT).parent.mkdir()
    path.rename(path.parent / CHECKPOINT)
    return read_checkpoint(path.parent)


@pytest.mark.parametrize(
    ("read", "name", "dtype", "said"),
    [
        (read_occupancy, "log_odds", "<f4", "17179869184 bytes, expected at most 28"),
        (read_states, "states", "|u1", "4294967296 bytes, expected at most 40"),
        (read_columns, "position", "<f8", "34359738368 bytes unpacked, over 100 times the size of the file"),
        (read_npz, "sdf", "<f4", f"bytes in compressed arrays, expected at most {MOST_PACKED}"),
        (read_scan, "world_mat_0", "<f8", "34359738368 bytes, expected at most 167771"),
        (read_state, "alive", "<f4", "17179869184 bytes, expected at most 429"),
    ],
)
def test_gigabytes_of_zeros_in_a_small_file_are_refused_unread(
    tmp_path: Path, read: Callable[[Path], object], name: str, dtype: str, said: str
) -> None:
    path = write_zeros(tmp_path / "x.npz", {name: (GIB4, dtype)}, header="{}", origin=np.zeros(3), voxel=0.1)
    assert path.stat().st_size < 40_000_000
    expect_refusal(said, read, path)


@pytest.mark.parametrize("name", ["sdf", "features"])
def test_a_zip_of_a_later_version_is_no_fault_of_the_program(tmp_path: Path, name: str) -> None:
    path = tmp_path / "x.npz"
    savez(path, {name: np.zeros(3)})
    content = bytearray(path.read_bytes())
    content[content.index(b"PK\x01\x02") + 6] = 255
    path.write_bytes(content)
    expect_refusal("x.npz: not a readable .npz: zip file version 25.5", describe, path)


def test_arrays_that_are_missing_too_large_or_not_whole_raise(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    savez(path, {"a": np.arange(100.0), "b": np.arange(100.0)})
    assert len(read_arrays(path, most=1600)) == 2
    with pytest.raises(ValueError, match=r"b: 800 bytes, expected at most 799"):
        read_arrays(path, most=1599)
    with pytest.raises(KeyError):
        read_arrays(path, ["c"], most=1600)
    np.savez(path, a=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match="objects"):
        read_arrays(path, most=1600)
    write_zeros(path, {"a": ((1 << 20,), "|u1")})
    with pytest.raises(DAMAGE, match="Bad CRC-32"):
        read_arrays(path, most=1 << 20)


NAMES = (
    *("mcap", "bag", "db3", "capture.json", "frames.csv", "joints.npz", "compressed image", "image", "image head"),
    *("rvl", "protobuf", "arrays", "npy", "grid.npz", "vti", "nrrd", "pfm"),
    *(suffix[1:] for suffix in splat_suffixes()),
    *("x.urdf", "x.yaml", "x.toml", "x.tum", "x.log", "transforms.json"),
)


@pytest.fixture(scope="module")
def readers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Reader]:
    return {reader.name: reader for reader in all_readers(tmp_path_factory.mktemp("readers"))}


def test_every_reader_takes_the_input_that_it_starts_from(readers: dict[str, Reader]) -> None:
    assert tuple(readers) == NAMES
    for reader in readers.values():
        for seed in reader.seeds:
            reader.read(seed)


@pytest.mark.parametrize("name", NAMES)
def test_any_bytes_are_read_or_end_in_a_named_error(readers: dict[str, Reader], name: str) -> None:
    reader = readers[name]

    @few(12)
    @given(
        st.integers(0, len(reader.seeds) - 1),
        st.integers(0, 2**32),
        st.one_of(st.none(), st.binary(max_size=200), st.integers(0, 2**16)),
    )
    def check(seed: int, change: int, other: bytes | int | None) -> None:
        data = reader.seeds[seed]
        if other is None:
            data = mutated(data, random.Random(change))
        elif isinstance(other, int):
            data = data[:other]
        else:
            data = data[: change % 32] + other
        with contextlib.suppress(*reader.errors):
            reader.read(data)

    check()
