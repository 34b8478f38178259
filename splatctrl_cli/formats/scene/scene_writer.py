"""A writer of the ``scene/`` folder and its checkpoints."""

import json
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splatctrl_cli.errors import InputError, refuse_if
from splatctrl_cli.files.output import Parts, flush, sha256, write_durably, write_table
from splatctrl_cli.formats.arrays import read_arrays, savez
from splatctrl_cli.formats.scene.scene_folder import SELF_MODEL, SHELL_FILE, Snapshot
from splatctrl_cli.formats.scene.voxel_file import write_occupancy, write_states
from splatctrl_cli.formats.splat.splats import SHELL, write_ply
from splatctrl_cli.records import SplatSet, UInt8, Values
from splatctrl_cli.voxels import KnownVoxels

CHECKPOINT = "checkpoint/state.npz"
AUDIT = "audit.jsonl"
START_OVER = "start over: the same command without --resume"

State = Mapping[str, Values]


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """An interrupted run: `SceneWriter.checkpoint`'s `progress`, the fitter's `state`, and the files.

    snapshots: (stamp, number of splats). parts: sha256 of the snapshots' files by name, None in an older checkpoint.
    """

    progress: dict[str, Any]
    state: State
    audit_bytes: int
    snapshots: tuple[tuple[int, int], ...]
    parts: dict[str, str] | None = None


def read_checkpoint(folder: Path) -> Checkpoint:
    """Read a checkpoint. Raises InputError if unreadable."""
    path = folder / CHECKPOINT
    try:
        state = read_arrays(path, most=1 << 32)  # the largest grid takes 2.8e9 bytes, its splats the rest
        header = json.loads(str(state.pop("progress")))
        return Checkpoint(
            progress=header["progress"],
            state=state,
            audit_bytes=int(header["audit_bytes"]),
            snapshots=tuple((int(stamp_ns), int(count)) for stamp_ns, count in header["snapshots"]),
            parts=header.get("parts"),
        )
    except Exception as error:
        raise InputError(f"{path}: cannot be read: {error}", remedy=START_OVER) from error


class SceneWriter:
    """A writer of a scene during fitting, into an empty folder or a checkpoint's.

    Snapshots are written in the background; the next call raises their errors.
    """

    def __init__(self, folder: Path, comments: Mapping[str, str], checkpoint: Checkpoint | None = None) -> None:
        self.folder, self.comments = folder, dict(comments)
        self.snapshots: list[Snapshot] = []
        self._audit = folder / AUDIT
        self._thread, self._unwritten = ThreadPoolExecutor(1), deque[Future[None]]()
        self._num_flushed = 0  # snapshots that are known to be on disk
        self._digests: dict[str, str] = {}  # of their files, by name
        if checkpoint is None:
            (folder / "snapshots").mkdir()
            (folder / CHECKPOINT).parent.mkdir()
            self._audit.touch()
            self._digests |= {path.name: sha256(path) for path in [folder / SELF_MODEL] if path.is_file()}
        else:
            self._go_back_to(checkpoint)

    def _go_back_to(self, checkpoint: Checkpoint) -> None:
        self.snapshots += [
            Snapshot(stamp_ns=stamp_ns, path=self._place(index), num_splats=num_splats)
            for index, (stamp_ns, num_splats) in enumerate(checkpoint.snapshots)
        ]
        self._num_flushed = len(self.snapshots)
        files = {self._audit, self.folder / CHECKPOINT}
        files |= {path for s in self.snapshots for path in (s.path, s.occupancy_path)}
        files |= {self.folder / name for name in checkpoint.parts or {}}
        missing = sorted(path.name for path in files if not path.is_file())
        refuse_if(
            missing or self._audit.stat().st_size < checkpoint.audit_bytes,
            f"{self.folder}: {missing[0] if missing else AUDIT}: not as the checkpoint left it",
            remedy=START_OVER,
        )
        written = Parts(folder=self.folder, digests=checkpoint.parts, remedy=START_OVER)
        for path in sorted(files - {self._audit, self.folder / CHECKPOINT}):
            written.checked(path)
        self._digests = dict(checkpoint.parts or {})
        for path in sorted(self.folder.rglob("*")):
            if path not in files and not path.is_dir():
                path.unlink()
        with self._audit.open("r+b") as stream:
            stream.truncate(checkpoint.audit_bytes)

    def _place(self, index: int) -> Path:
        return self.folder / "snapshots" / f"{index:06d}.ply"

    def audit(self, row: object) -> None:
        assert is_dataclass(row) and not isinstance(row, type)
        with self._audit.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(asdict(row)) + "\n")

    def audited(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self._audit.read_text(encoding="utf-8").splitlines()]

    def snapshot(
        self, stamp_ns: int, splats: SplatSet, known: KnownVoxels, states: UInt8, shell: SplatSet | None = None
    ) -> None:
        """Write splats, shell and voxel `states` (X, Y, Z) of `stamp_ns`.

        The writer owns the arrays from then on; `settle` waits for the files.
        """
        snapshot = Snapshot(stamp_ns=stamp_ns, path=self._place(len(self.snapshots)), num_splats=len(splats))

        def write() -> None:
            write_ply(snapshot.path, splats, self.comments | {"stamp_ns": str(stamp_ns)})
            write_states(snapshot.occupancy_path, known, states)
            self._write_shell(snapshot.shell_path, stamp_ns, shell)

        self.settle(but=1)
        self._unwritten.append(self._thread.submit(write))
        self.snapshots.append(snapshot)

    def settle(self, *, but: int = 0) -> None:
        """Wait for all snapshots but the last `but`. Raises their errors."""
        while len(self._unwritten) > but:
            self._unwritten.popleft().result()

    def close(self) -> None:
        """Wait for the current snapshot, ignoring errors."""
        self._thread.shutdown()

    def _write_shell(self, path: Path, stamp_ns: int, shell: SplatSet | None) -> None:
        if shell is not None and len(shell):
            write_ply(path, shell, self.comments | SHELL | {"stamp_ns": str(stamp_ns)})

    def checkpoint(self, progress: Mapping[str, Any], state: State, *, is_last: bool = False) -> None:
        """Replace the checkpoint atomically, once its files are on disk; compress the last."""
        self.settle()
        flush(self._audit)
        for snapshot in self.snapshots[self._num_flushed :]:
            for path in filter(Path.is_file, (snapshot.path, snapshot.occupancy_path, snapshot.shell_path)):
                flush(path)
                self._digests[path.relative_to(self.folder).as_posix()] = sha256(path)
        self._num_flushed = len(self.snapshots)
        header = {
            "progress": progress,
            "audit_bytes": self._audit.stat().st_size,
            "snapshots": [[s.stamp_ns, s.num_splats] for s in self.snapshots],
            "parts": self._digests,
        }
        arrays = {"progress": np.array(json.dumps(header)), **state}
        write_durably(self.folder / CHECKPOINT, lambda path: savez(path, arrays, level=1 if is_last else 0))

    def finish(self, stamp_ns: int, splats: SplatSet, known: KnownVoxels, shell: SplatSet | None = None) -> None:
        self.settle()
        write_ply(self.folder / "splats.ply", splats, self.comments | {"stamp_ns": str(stamp_ns)})
        self._write_shell(self.folder / SHELL_FILE, stamp_ns, shell)
        write_occupancy(self.folder / "occupancy.npz", known)
        rows = (
            {"stamp_ns": s.stamp_ns, "file": f"snapshots/{s.path.name}", "num_splats": s.num_splats}
            for s in self.snapshots
        )
        write_table(self.folder / "snapshots.csv", ("stamp_ns", "file", "num_splats"), rows)
