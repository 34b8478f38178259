"""Arrays in a ``.npz`` without the clock in it: the same arrays give the same bytes."""

import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def savez(path: Path, arrays: Mapping[str, NDArray[np.generic]], *, level: int = 1) -> None:
    """What `np.savez_compressed` writes, at zlib's `level` (0: stored), one array at a time."""
    method = zipfile.ZIP_DEFLATED if level else zipfile.ZIP_STORED
    with zipfile.ZipFile(path, "w", method, compresslevel=level) as archive:
        for name, array in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            entry.compress_type = method
            with archive.open(entry, "w", force_zip64=array.nbytes >= 2**30) as stream:
                np.lib.format.write_array(stream, np.asarray(array), allow_pickle=False)
