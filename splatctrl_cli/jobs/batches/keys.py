"""What a node's result depends on, as one key: its words, the content of its inputs, and the code."""

import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib import metadata
from pathlib import Path

import splatctrl_cli
from splatctrl_cli.errors import InputError
from splatctrl_cli.files.output import PACKAGES
from splatctrl_cli.jobs.batches.graph import Node
from splatctrl_cli.jobs.batches.ledger import Ledger

WITHOUT_EFFECT = ("--force", "--resume", "--quiet", "-q", "--json")
THREADS = "--threads"  # changes no byte
_CODE = {".py", ".so", ".toml", ".json"}
_MESH = re.compile(r'filename\s*=\s*"([^"]+)"')


def keys_of(nodes: Sequence[Node], ledger: Ledger, entry: str) -> dict[str, str]:
    """A key for each node, of nodes after those that they need. Raises InputError for an input that is not there."""
    code, digests = code_version(), dict[Path, str]()
    keys: dict[str, str] = {}
    outs = {node.name: str(node.out) for node in nodes}
    for node in nodes:
        for path in node.inputs:
            if path not in digests:
                digests[path] = _digest(path, ledger)
        named = {str(path): digests[path] for path in node.inputs}
        named |= {outs[need]: keys[need] for need in node.needs} | {str(node.out): "out"}
        inputs = [digests[path] for path in node.inputs] + [keys[need] for need in node.needs]
        said = [entry, code, node.command, *inputs, *_said(node.words, named)]
        keys[node.name] = hashlib.sha256(json.dumps(said).encode()).hexdigest()
    return keys


@cache
def code_version() -> str:
    """A digest of the package's files, and the versions of the libraries that decide figures."""
    folder = Path(splatctrl_cli.__file__).parent
    files = sorted(place for place in folder.rglob("*") if place.suffix in _CODE)
    found = hashlib.sha256()
    for place in files:
        found.update(f"{place.relative_to(folder)}\0".encode() + place.read_bytes())
    for name in PACKAGES:
        found.update(f"{name} {metadata.version(name)}\0".encode())
    return found.hexdigest()


def _said(words: Sequence[str], named: Mapping[str, str]) -> Iterator[str]:
    """Words without those that change no result, paths replaced by what they hold."""
    longest_first = sorted(named, key=len, reverse=True)
    skip = False
    for word in words:
        if skip or word in WITHOUT_EFFECT:
            skip = False
            continue
        if word.startswith(THREADS):
            skip = word == THREADS
            continue
        said = word
        for path in longest_first:
            said = said.replace(path, f"<{named[path]}>")
        yield said


def _digest(path: Path, ledger: Ledger) -> str:
    """Of an input and what it names: the folder of an image folder's description, the meshes of a URDF."""
    try:
        digest = ledger.digest(path.parent if path.suffix == ".toml" and path.parent != Path() else path)
        if path.suffix != ".urdf":
            return digest
        meshes = [place for place in _meshes(path) if place.is_file()]
        return " ".join([digest, *(ledger.digest(place) for place in meshes)])
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}", remedy="check the suite's paths") from None


def _meshes(urdf: Path) -> Iterator[Path]:
    """Where the meshes that a URDF names may be: beside it, or below one of the folders above."""
    for name in dict.fromkeys(_MESH.findall(urdf.read_text(encoding="utf-8", errors="replace"))):
        if "://" not in name:
            yield urdf.parent / name
            continue
        parts = Path(name.split("://", 1)[1]).parts
        for folder in urdf.absolute().parents:
            yield folder.joinpath(*parts)
            yield folder.joinpath(*parts[1:])
