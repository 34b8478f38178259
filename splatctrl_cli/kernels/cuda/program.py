"""Kernels compiled at run time with NVRTC, cached on disk."""

import hashlib
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from cuda.core import ObjectCode, Program, ProgramOptions
from cuda.core.utils import FileStreamProgramCache, make_program_cache_key

from splatctrl_cli.kernels.cuda.memory import FIT

HERE = Path(__file__).parent
FOLDERS = (HERE / "src", HERE / "include", HERE.parent / "src")  # as #include looks through them


@cache
def source_digest() -> bytes:
    """Digest of all files that kernels may include."""
    digest = hashlib.sha256()
    for folder in FOLDERS:
        for path in sorted(p for p in folder.iterdir() if p.suffix in {"", ".h", ".cu", ".cuh"} and p.is_file()):
            digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.digest()


def compiled(capability: tuple[int, int], cache_folder: Path | None = None, *, source: str = FIT) -> Any:
    """Machine code of a source for a compute capability, cached in cuda-core's or the given folder, if writable."""
    options = ProgramOptions(
        name=source, arch=f"sm_{capability[0]}{capability[1]}", std="c++17", include_path=[str(f) for f in FOLDERS]
    )
    code = (HERE / "src" / source).read_text()
    key = make_program_cache_key(
        code=code, code_type="c++", options=options, target_type="cubin", extra_digest=source_digest()
    )
    try:
        store = FileStreamProgramCache(cache_folder)
        known = store.get(key)
    except OSError:
        return Program(code, "c++", options).compile("cubin")
    if known is not None:
        return ObjectCode.from_cubin(known)
    made = Program(code, "c++", options).compile("cubin")
    with suppress(OSError):
        store[key] = made
    return made
