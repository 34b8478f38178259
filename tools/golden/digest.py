"""Digests of files, without parts that rightly differ between two runs of the same code."""

import hashlib
import json
import os
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

# Keys whose values may differ between two runs of the same code: times; the machine and the libraries of a run.json;
# and what follows from these, the digests and sizes of files with times in them.
LEFT_OUT = frozenset(
    {
        "seconds",
        "planning_time_s",
        "birrt_planning_time_s",
        "versions",
        "splatctrl",
        "python",
        "machine",
        "parts",
        "bytes",
    }
)
ALIKE = 12  # more files than this of one suffix in one folder are one line

Stamps = Mapping[str, tuple[int, int]]


def digest(data: bytes) -> str:
    """The first 16 digits of the SHA-256."""
    return hashlib.sha256(data).hexdigest()[:16]


def stamps(folder: Path) -> dict[str, tuple[int, int]]:
    """Time and size of each file below `folder`, links not followed, by its path relative to it."""
    found = {}
    for root, _, names in os.walk(folder):
        for path in (Path(root, name) for name in names):
            status = path.lstat()
            found[path.relative_to(folder).as_posix()] = (status.st_mtime_ns, status.st_size)
    return found


def written(folder: Path, before: Stamps, places: Mapping[str, str]) -> dict[str, str]:
    """Digest of each artefact below `folder` that is new or changed since `before`, by name.

    Each key of a run.json is one artefact; many similar files in one folder are one artefact. `places`: names that
    replace paths that differ between machines.
    """
    names = sorted(name for name, stamp in stamps(folder).items() if before.get(name) != stamp)
    alike: dict[str, list[str]] = defaultdict(list)
    for name in names:
        path = Path(name)
        alike[f"{path.parent.as_posix()}/*{path.suffix}"].append(name)
    digests = {}
    for pattern, members in alike.items():
        found = {name: (folder / name).read_bytes() for name in members}
        if len(members) > ALIKE:
            listed = "\n".join(f"{name} {digest(data)}" for name, data in found.items())
            digests[f"{pattern} ({len(members)})"] = digest(listed.encode())
            continue
        for name, data in found.items():
            if Path(name).name == "run.json":
                digests.update(of_run_file(name, data, places))
            elif Path(name).suffix == ".json":
                digests[name] = of_json(data.decode(), places)
            else:
                digests[name] = digest(_placed(data, places))
    return digests


def of_run_file(name: str, data: bytes, places: Mapping[str, str]) -> dict[str, str]:
    """Digest of each key of a run.json, except `LEFT_OUT`, as `name:key`."""
    return {
        f"{name}:{key}": of_json(json.dumps(part), places)
        for key, part in json.loads(data).items()
        if key not in LEFT_OUT
    }


def of_json(text: str, places: Mapping[str, str]) -> str:
    """Digest of a JSON value without `LEFT_OUT`; of empty text if a command printed nothing."""
    lasting = json.dumps(_lasting(json.loads(text)), sort_keys=True) if text else ""
    return digest(_placed(lasting.encode(), places))


def _lasting(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _lasting(part) for key, part in value.items() if key not in LEFT_OUT}
    return [_lasting(part) for part in value] if isinstance(value, list) else value


def _placed(data: bytes, places: Mapping[str, str]) -> bytes:
    for path, name in places.items():
        data = data.replace(path.encode(), name.encode())
    return data


def parse(text: str) -> dict[str, str]:
    """Digests by `case artefact`, as `lines` wrote them."""
    entries = (line.rpartition("  ") for line in text.splitlines() if line and not line.startswith("#"))
    return {name: value for name, _, value in entries}


def lines(digests: Mapping[str, str]) -> Iterator[str]:
    """`case artefact  digest`, sorted."""
    return (f"{name}  {value}" for name, value in sorted(digests.items()))
