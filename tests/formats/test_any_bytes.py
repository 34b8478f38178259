"""Any bytes are read, or end in the errors that the reader names: of every reader of foreign bytes in the program."""

import contextlib
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.fuzz_mutate import mutated
from benchmarks.readers import Reader, all_readers, splat_suffixes
from tests.properties import few

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
