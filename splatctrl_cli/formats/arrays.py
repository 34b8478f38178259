"""Arrays in ``.npz`` (same arrays, same bytes), read within a size limit.

NPZ, HDF5 and Parquet (extra `tables`: h5py, pyarrow) are read in blocks of rows. HDF5 names arrays by path
(``observations/qpos``), Parquet by column; a column of equally long lists is an array (T, K).
"""

import tokenize
import zipfile
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from io import BytesIO
from math import prod
from pathlib import Path
from typing import IO, Any

import numpy as np

from splatctrl_cli.errors import InputError, refuse_faults, refuse_if
from splatctrl_cli.files.spilled_rows import BLOCK, RowFile, Rows, ranges
from splatctrl_cli.formats.unpacking import PIECE
from splatctrl_cli.libraries import import_extra
from splatctrl_cli.records import Array, Stamps, Values

DAMAGE = (  # what reading a damaged or foreign .npz raises; an OSError where a place in it lies before its start
    *(zipfile.BadZipFile, zlib.error, ValueError, EOFError, KeyError, NotImplementedError, RuntimeError),
    *(SyntaxError, tokenize.TokenError, OverflowError),
)


Pieces = tuple[str, tuple[int, ...], Callable[[], Iterable[Values]]]
"""An array made during writing: dtype, shape, and a maker of its values in C order."""


def savez(path: Path, arrays: Mapping[str, Values | Pieces], *, level: int = 6) -> None:
    """Write as `np.savez_compressed`, at zlib's `level` (0: stored), one array at a time."""
    method = zipfile.ZIP_DEFLATED if level else zipfile.ZIP_STORED
    with zipfile.ZipFile(path, "w", method, compresslevel=level) as archive:
        for name, array in arrays.items():
            dtype, shape = array[:2] if isinstance(array, tuple) else (array.dtype, array.shape)
            size = np.dtype(dtype).itemsize * int(np.prod(shape))
            with archive.open(f"{name}.npy", "w", force_zip64=size >= 2**30) as stream:
                if isinstance(array, tuple):
                    header = {"descr": dtype, "fortran_order": False, "shape": shape}
                    np.lib.format.write_array_header_1_0(stream, header)
                    stream.writelines(piece.tobytes() for piece in array[2]())
                else:
                    np.lib.format.write_array(stream, np.asarray(array), allow_pickle=False)


def read_arrays(path: Path, names: Collection[str] | None = None, *, most: int) -> dict[str, Values]:
    """Read the arrays `names` (default: all) of a ``.npz``, at most `most` bytes together.

    Raises OSError, KeyError for a missing array, ValueError for objects, over `most` bytes or a wrong size, and
    `DAMAGE`.
    """
    with path.open("rb") as stream, zipfile.ZipFile(stream) as archive:
        chosen = (
            [n.removesuffix(".npy") for n in archive.namelist() if n.endswith(".npy")] if names is None else names
        )
        left, arrays = most, {}
        for name in dict.fromkeys(chosen):
            with archive.open(f"{name}.npy") as member:
                arrays[name] = _array(member, f"{name}: ", archive.getinfo(f"{name}.npy").file_size, left)
            left -= arrays[name].nbytes
    return arrays


def has_arrays(path: Path, head: bytes, names: Collection[str]) -> bool:
    """True for a ``.npz`` with these arrays; head: its first bytes."""
    if not head.startswith(b"PK\x03\x04"):
        return False
    with suppress(*DAMAGE, OSError), zipfile.ZipFile(path) as archive:
        return {f"{name}.npy" for name in names} <= set(archive.namelist())
    return False


def npy_head(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Read only a ``.npy`` header: shape, is_by_columns, dtype. Raises ValueError without one."""
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, is_fortran, dtype = read(stream)
    refuse_if(
        any(not isinstance(n, int) or n < 0 for n in shape),
        f"shape {shape}, expected whole numbers",
        error=ValueError,
    )
    return tuple(shape), is_fortran, dtype


def check_numbers(dtype: np.dtype[Any]) -> None:
    """Raise ValueError for objects, which would be unpickled."""
    refuse_if(dtype.hasobject, "objects, expected numbers", error=ValueError)


def _array(member: IO[bytes], name: str, file_size: int, most: int | None) -> Values:
    shape, is_fortran, dtype = npy_head(member)
    check_numbers(dtype)
    size = prod(shape) * dtype.itemsize
    refuse_if(most is not None and size > most, f"{name}{size} bytes, expected at most {most}", error=ValueError)
    refuse_if(
        size != file_size - member.tell(),
        f"{name}announces {size} bytes, holds {file_size - member.tell()}",
        error=ValueError,
    )
    content = bytearray(size)
    view, at = memoryview(content), 0
    while at < size and (piece := member.read(min(size - at, PIECE))):
        view[at : at + len(piece)] = piece
        at += len(piece)
    refuse_if(
        at < size or member.read(1),
        f"{name}expected {size} bytes, got {'more' if at == size else at}",
        error=ValueError,
    )  # reading to the end is what checks the sum
    values: Values = np.frombuffer(content, dtype) if size else np.zeros(0, dtype)
    return values.reshape(shape, order="F" if is_fortran else "C")


def npy_of(data: bytes) -> Values:
    """The array of ``.npy`` bytes. Raises ValueError for objects or another size."""
    return _array(BytesIO(data), "", len(data), None)


FREE_BYTES = 1 << 30  # of an array, unpacked, and beside it:
MOST_RATIO = 100  # times the file's size; joint states as recorded compress 2 to 20 times


class ArrayFile(ABC):
    """A file of arrays (T, ...); flattened rows are columns."""

    names: Sequence[str]

    def __init__(self, path: Path) -> None:
        self.path = path

    @abstractmethod
    def _header(self, name: str) -> tuple[tuple[int, ...], np.dtype[Any]] | None:
        """Shape and dtype, None if missing."""

    @abstractmethod
    def _blocks(self, name: str) -> Iterator[Array]:
        """Yield about `BLOCK` rows at a time."""

    def columns(self, names: Sequence[str]) -> Rows:
        """Arrays side by side as columns (T, K).

        Raises InputError if missing, not numbers or of several lengths.
        """
        headers = [self._checked(name) for name in names]
        lengths = [shape[0] for shape, _ in headers]
        texts = ", ".join(f"{name} {length}" for name, length in zip(names, lengths, strict=True))
        refuse_if(
            len(set(lengths)) > 1, f"{self.path}: expected arrays of one length, got {texts}", remedy="check the file"
        )
        widths = [prod(shape[1:]) for shape, _ in headers]
        parts = [  # each array's blocks have their own number of rows
            RowFile((width,), (part.reshape(len(part), width).astype(np.float64) for part in self._blocks(name)))
            for name, width in zip(names, widths, strict=True)
        ]
        blocks = (np.hstack([part.read(*block) for part in parts]) for block in ranges(max(lengths, default=0)))
        return Rows(RowFile((sum(widths),), blocks))

    def read(
        self, time: str, unit_ns: int, groups: Mapping[str, Sequence[str]], epoch_ns: int
    ) -> tuple[Stamps, dict[str, Rows]]:
        """Read `stamps`, and each group's `columns`."""
        columns = {key: self.columns(names) for key, names in groups.items()}
        return self.stamps(time, unit_ns, epoch_ns), columns

    def rows(self, name: str) -> Rows:
        """An array (T, ...); T may be 0. Raises InputError if not numbers."""
        shape, _ = self._checked(name, least=0)
        return Rows(RowFile(shape[1:], (block.astype(np.float64) for block in self._blocks(name))))

    def stamps(self, name: str, unit_ns: int, epoch_ns: int, *, least: int = 1) -> Stamps:
        """Stamps (T,) [ns] of times in `unit_ns`, or of datetime64 in its own unit."""
        _, dtype = self._checked(name, least=least, kinds="iufM")
        times = np.concatenate([np.zeros(0, dtype), *(block.reshape(-1) for block in self._blocks(name))])
        refuse_if(
            not np.isfinite(times).all(),
            f"{self.path}: {name}: expected times, got NaN, NaT or infinity",
            remedy="check the file",
        )
        if times.dtype.kind == "M":
            times, unit_ns = times.astype("datetime64[ns]").astype(np.int64), 1
        if times.dtype.kind in "iu":
            return np.asarray(times.astype(np.int64) * unit_ns + epoch_ns)
        whole = np.floor(times)
        return np.asarray(
            whole.astype(np.int64) * unit_ns + np.round((times - whole) * unit_ns).astype(np.int64) + epoch_ns
        )

    def _checked(self, name: str, *, least: int = 1, kinds: str = "iuf") -> tuple[tuple[int, ...], np.dtype[Any]]:
        header = self._header(name)
        if header is None or header[1].kind not in kinds or not header[0]:
            actual = "none" if header is None else f"{header[1]} of shape {header[0]}"
            raise InputError(
                f"{self.path}: {name!r}: expected an array of numbers, got {actual}",
                remedy=f"arrays there: {', '.join(self.names)}",
            )
        size = prod(header[0]) * header[1].itemsize
        refuse_if(
            size > FREE_BYTES + MOST_RATIO * self.path.stat().st_size,  # no recording packs so small
            f"{self.path}: {name}: {size} bytes unpacked, over {MOST_RATIO} times the size of the file",
            remedy="check the file",
        )
        refuse_if(header[0][0] < least, f"{self.path}: {name}: expected rows, got none", remedy="record it again")
        return header

    def _read_as(self, kind: str, *faults: type[Exception]) -> AbstractContextManager[None]:
        return refuse_faults(
            lambda error: (
                f"{self.path}: cannot be read as {kind}: {' '.join(str(error).split()) or type(error).__name__}"
            ),
            *faults,
            remedy="check the file",
        )


_MOST_BY_COLUMNS = 1 << 28  # bytes, as they are in memory at once
_DAMAGE = (OSError, *DAMAGE)


class NpzFile(ArrayFile):
    def __init__(self, path: Path) -> None:
        """Raises InputError for another kind of file."""
        super().__init__(path)
        with self._read_as("NPZ", *_DAMAGE), zipfile.ZipFile(path) as archive:
            self.names = [name.removesuffix(".npy") for name in archive.namelist()]

    def _header(self, name: str) -> tuple[tuple[int, ...], np.dtype[Any]] | None:
        if name not in self.names:
            return None
        with self._opened(name) as (shape, dtype, _, _):
            return shape, dtype

    def _blocks(self, name: str) -> Iterator[Array]:
        with self._opened(name) as (shape, dtype, is_by_columns, stream):
            size, step = prod(shape) * dtype.itemsize, max(shape[0], 1) if is_by_columns else BLOCK
            refuse_if(
                is_by_columns and size > _MOST_BY_COLUMNS,
                f"{name}: over {_MOST_BY_COLUMNS} bytes by columns, expected rows",
                error=ValueError,
            )
            for first in range(0, shape[0], step):
                num = min(step, shape[0] - first)
                rows = np.frombuffer(_read(stream, num * prod(shape[1:]) * dtype.itemsize), dtype).reshape(
                    num, *shape[1:], order="F" if is_by_columns else "C"
                )
                yield from (rows[start : start + BLOCK] for start in range(0, num, BLOCK))

    @contextmanager
    def _opened(self, name: str) -> Iterator[tuple[tuple[int, ...], np.dtype[Any], bool, IO[bytes]]]:
        with (
            self._read_as("NPZ", *_DAMAGE),
            zipfile.ZipFile(self.path) as archive,
            archive.open(f"{name}.npy") as stream,
        ):
            shape, is_by_columns, dtype = npy_head(stream)
            yield shape, dtype, is_by_columns and len(shape) > 1, stream


def _read(stream: IO[bytes], num: int) -> bytes:
    content = stream.read(num)
    refuse_if(len(content) < num, f"expected {num} bytes, got {len(content)}", error=EOFError)
    return content


_RAGGED = "write rows of one length: an array (T, K), or a column for each joint"
_EXTRA = "tables"


class Hdf5File(ArrayFile):
    def __init__(self, path: Path) -> None:
        """Raises InputError for another kind of file."""
        super().__init__(path)
        self._h5py = import_extra("h5py", _EXTRA, "HDF5 files")
        self.names = names = list[str]()
        with self._opened() as file:
            file.visititems(lambda name, item: names.append(name) if isinstance(item, self._h5py.Dataset) else None)

    def _header(self, name: str) -> tuple[tuple[int, ...], np.dtype[Any]] | None:
        name = name.strip("/")
        if name not in self.names:
            return None
        with self._opened() as file:
            array = file[name]
            refuse_if(
                self._h5py.check_vlen_dtype(array.dtype) not in {None, str, bytes},
                f"{self.path}: {name}: ragged: its rows differ in length",
                remedy=_RAGGED,
            )
            return array.shape, array.dtype

    def _blocks(self, name: str) -> Iterator[Array]:
        with self._opened() as file:
            array = file[name]
            for first in range(0, array.shape[0], BLOCK):
                yield np.asarray(array[first : first + BLOCK])

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        faults = (OSError, RuntimeError, KeyError, ValueError)
        with self._read_as("HDF5", *faults), self._h5py.File(self.path, "r") as file:
            yield file


class ParquetFile(ArrayFile):
    """A Parquet file; only (column, value): its rows with this value."""

    def __init__(self, path: Path, only: tuple[str, int] | None = None) -> None:
        """Raises InputError for another kind of file."""
        super().__init__(path)
        self._arrow, self._parquet = (
            import_extra(name, _EXTRA, "Parquet files") for name in ("pyarrow", "pyarrow.parquet")
        )
        self._only = only
        with self._opened() as file:
            self.names = list(file.schema_arrow.names)
            self._num: int = file.metadata.num_rows
        if only is not None:
            refuse_if(
                only[0] not in self.names,
                f"{path}: no column {only[0]}",
                remedy=f"columns there: {', '.join(self.names)}",
            )
            self._num = sum(len(block) for block in self._blocks(only[0]))

    def __len__(self) -> int:
        return self._num

    def _header(self, name: str) -> tuple[tuple[int, ...], np.dtype[Any]] | None:
        if name not in self.names:
            return None
        block = next(self._blocks(name), None)
        return ((0,), np.dtype(np.float64)) if block is None else ((self._num, *block.shape[1:]), block.dtype)

    def _blocks(self, name: str) -> Iterator[Array]:
        shape: tuple[int, ...] | None = None
        names = [name] if self._only is None else list(dict.fromkeys([name, self._only[0]]))
        with self._opened() as file:
            for batch in file.iter_batches(batch_size=BLOCK, columns=names):
                values = self._values(batch.column(name), name)
                if self._only is not None:
                    values = values[self._values(batch.column(self._only[0]), self._only[0]) == self._only[1]]
                self._refuse_ragged(shape not in (None, values.shape[1:]), name)
                shape = values.shape[1:]
                if len(values):
                    yield values

    def _values(self, column: Any, name: str) -> Array:
        if not hasattr(column.type, "value_type") or self._arrow.types.is_dictionary(column.type):
            return np.asarray(column.to_numpy(zero_copy_only=False))
        self._refuse_ragged(
            column.null_count or len(set(column.value_lengths().to_numpy(zero_copy_only=False).tolist())) > 1, name
        )
        inner = self._values(column.flatten(), name)
        return inner.reshape(len(column), -1, *inner.shape[1:])

    def _refuse_ragged(self, is_ragged: object, name: str) -> None:
        refuse_if(is_ragged, f"{self.path}: {name}: ragged: its rows differ in length, or have none", remedy=_RAGGED)

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        faults = (OSError, ValueError, KeyError, self._arrow.ArrowException)
        with self._read_as("Parquet", *faults), self._parquet.ParquetFile(self.path) as file:
            yield file
